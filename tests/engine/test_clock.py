"""Exact numbers, durations and the tick clock."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.engine.clock import Clock, parse_duration, parse_fps, parse_rational, split_init
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


def test_a_duration_fits_in_64_bits() -> None:
    assert parse_duration("9223372036.854775807s") == 2**63 - 1
    for text in ("9223372036.854775808s", "999999999999s"):
        with pytest.raises(LaeError, match=f"{text}: too long a time"):
            parse_duration(text)
        with pytest.raises(LaeError, match=f"init={text}: too long a time"):
            split_init(f"recorded,init={text}")


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


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("constant:47ms", ("constant:47ms", None)),
        ("constant:47ms,init=800ms", ("constant:47ms", 800_000_000)),
        ("bootstrap:1:30,init=0s", ("bootstrap:1:30", 0)),
    ],
)
def test_a_time_of_the_initialisation_stands_behind_a_comma(
    text: str, found: tuple[str, int | None]
) -> None:
    assert split_init(text) == split_init(text, path=True) == found


def test_only_paths_hold_commas_of_their_own() -> None:
    assert split_init("a,b.parquet", path=True) == ("a,b.parquet", None)
    assert split_init("a,b.parquet,init=1s", path=True) == ("a,b.parquet", 10**9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("constant:47ms,init=", "init=: write a time of 0 or more with its unit, as init=800ms"),
        ("constant:47ms,init=-1s", "init=-1s: write a time of 0 or more"),
        ("constant:47ms,init=800", "init=800: write a time of 0 or more"),
        ("constant:47ms,init=1s,init=2s", "init stands twice"),
        ("constant:47ms,int=1s", "no 'int=1s' here: after a comma comes init=TIME, as init=800ms"),
        ("constant:47ms,800ms", "no '800ms' here: after a comma comes init=TIME"),
        ("constant:47ms,init=1s,x", "init=1s,x: write a time of 0 or more"),
        ("constant:47ms,", "no '' here"),
    ],
)
def test_what_else_stands_behind_a_comma_is_an_error(text: str, said: str) -> None:
    with pytest.raises(LaeError) as caught:
        split_init(text)
    assert said in str(caught.value)
    assert repr(text) in str(caught.value)
