"""Exact numbers, durations and the tick clock."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.engine.clock import Clock, parse_duration, parse_fps, parse_rational
from lae_sim.errors import LaeError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("30", Fraction(30)),
        ("29.97", Fraction(2997, 100)),
        ("30000/1001", Fraction(30000, 1001)),
        ("0.5", Fraction(1, 2)),
        ("007", Fraction(7)),
        ("-1/2", Fraction(-1, 2)),
        ("-0.02", Fraction(-1, 50)),
        ("0/5", Fraction(0)),
        ("999999999999", Fraction(999999999999)),
    ],
)
def test_exact_numbers(text: str, value: Fraction) -> None:
    assert parse_rational(text) == value


@pytest.mark.parametrize(
    "text",
    [
        "",
        "-",
        "--1",
        "+1",
        "1e9",
        "1/0",
        "1/00",
        "0/0",
        "1/2/3",
        "1.5/2",
        "1/-2",
        ".5",
        "5.",
        "nan",
        "inf",
        " 30",
        "30 ",
        "30\n",
        "30\0",
        "1_000",
        "0x10",
        "30,0",
        "9" * 13,
        "9" * 5000,
        "1/" + "9" * 5000,
        "0." + "1" * 13,
        "\N{SUPERSCRIPT TWO}",
        "1/\N{ARABIC-INDIC DIGIT ZERO}",
        "1/\N{FULLWIDTH DIGIT ZERO}",
    ],
)
def test_other_text_is_refused(text: str) -> None:
    with pytest.raises(LaeError):
        parse_rational(text)


@given(st.text(max_size=20) | st.from_regex(r"-?\d+([./]\d+)?", fullmatch=True))
def test_any_text_is_a_number_or_refused(text: str) -> None:
    try:
        value = parse_rational(text)
    except LaeError:
        return
    assert value == Fraction(text)


@pytest.mark.parametrize("text", ["0", "-30", "0.0", "0/1", "-1/2"])
def test_a_frame_rate_is_above_zero(text: str) -> None:
    with pytest.raises(LaeError, match="above zero"):
        parse_fps(text)


def test_a_frame_rate_is_exact() -> None:
    assert parse_fps("24000/1001") == Fraction(24000, 1001)


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("47ms", 47_000_000),
        ("0.1s", 100_000_000),
        ("1us", 1_000),
        ("3ns", 3),
        ("0ms", 0),
        ("0.000001ms", 1),
        ("1.5us", 1_500),
    ],
)
def test_durations(text: str, ns: int) -> None:
    assert parse_duration(text) == ns


@pytest.mark.parametrize("text", ["47", "ms", "47 ms", "47min", "-1ms", "1e3ms", "47ms\n", "1/2s"])
def test_a_duration_has_a_unit(text: str) -> None:
    with pytest.raises(LaeError, match="not a duration"):
        parse_duration(text)


def test_a_duration_is_whole_nanoseconds() -> None:
    with pytest.raises(LaeError, match="whole number of nanoseconds"):
        parse_duration("0.5ns")


@pytest.mark.parametrize(
    ("fps", "ticks_per_ns", "frame_ticks"),
    [("30", 30, 10**9), ("30000/1001", 30000, 1001 * 10**9), ("29.97", 2997, 100 * 10**9)],
)
def test_the_clock_of_a_frame_rate(fps: str, ticks_per_ns: int, frame_ticks: int) -> None:
    clock = Clock.at(parse_fps(fps))
    assert (clock.ticks_per_ns, clock.frame_ticks) == (ticks_per_ns, frame_ticks)
    assert clock.fps == Fraction(fps)
    assert clock.milliseconds(1) == pytest.approx(float(1000 / Fraction(fps)))


def test_no_float_loses_a_frame() -> None:
    clock = Clock.at(Fraction(30))
    assert all(i * clock.frame_ticks // clock.frame_ticks == i for i in range(20_000))
    assert sum(int((i / 30) * 30) != i for i in range(20_000)) == 404  # what floats would do
