from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.errors import LaeError
from lae_sim.importers.times import (
    UNITS,
    MeasuredTimes,
    ascending_note,
    check_seconds,
    looks_cumulative,
    parse_unit,
    read_times,
    understood,
)


@pytest.fixture
def written(tmp_path):
    def write(text, name="car_time.txt"):
        path = tmp_path / name
        path.write_text(text, "utf-8")
        return path

    return write


def ns(path, unit=None, column=0):
    return read_times(path, unit, column)[0].tolist()


def test_times_are_exact(written):
    # 0.0262550005 s * 1e9 in floats is 26255000.499999996; half to even is 26255000 all the same.
    path = written("0.007319\n0.1\n2.6255e-2\n0.0262550005\n0.0000000015\n")
    times, unit = read_times(path)
    assert times.tolist() == [7_319_000, 10**8, 26_255_000, 26_255_000, 2]
    assert unit is None


@given(st.decimals(0, 1000, places=12, allow_nan=False))
def test_any_time_is_rounded_exactly(tmp_path_factory, seconds):
    path = tmp_path_factory.getbasetemp() / "times.txt"
    path.write_text(f"{seconds:f}\n")
    assert ns(path, "s") == [round(Fraction(seconds) * 10**9)]


def test_units_and_columns(written):
    path = written("35.2,1\n34.8,2\n36,3\n")
    assert ns(path, "ms") == [35_200_000, 34_800_000, 36_000_000]
    assert ns(path, "s", column=1) == [10**9, 2 * 10**9, 3 * 10**9]
    with pytest.raises(LaeError, match="has 2 columns of times, not 3"):
        read_times(path, "ms", 2)


def test_rates_are_inverted(written):
    assert ns(written("25\n3\n40.0\n"), "fps") == [40_000_000, 333_333_333, 25_000_000]
    with pytest.raises(LaeError, match="line 2: 0 frames per second is no rate"):
        read_times(written("25\n0\n"), "fps")


def test_times_since_the_start(written):
    path = written("0.3\n0.8\n0.8\n1.0000000015\n")
    assert ns(path, "cumulative-s") == [300_000_000, 500_000_000, 0, 200_000_002]
    assert ns(path, "cumulative-ms") == [300_000, 500_000, 0, 200_000]
    with pytest.raises(LaeError, match="line 3: the time since the start goes back"):
        read_times(written("1\n2\n1.5\n"), "cumulative-s")
    with pytest.raises(LaeError, match=r"begins at 1,700,000,000 s: readings of a clock"):
        read_times(written("1700000000.1\n1700000000.2\n"), "cumulative-s")


def test_times_that_ascend_are_asked_about(written):
    path = written("0.5\n1\n1.5\n2\n")
    with pytest.raises(LaeError) as caught:
        read_times(path)
    assert str(caught.value).startswith(f"{path}: its times ascend from row to row, 0.5 to 2: add ")
    assert "--time-unit cumulative-s (500 ms a frame) or" in str(caught.value)
    assert ns(path, "s") == [500_000_000, 10**9, 1_500_000_000, 2 * 10**9]


@pytest.mark.parametrize(
    ("values", "cumulative"),
    [
        (np.arange(1, 11) / 2, True),
        (4 + 0.02 * np.arange(40), True),  # a long initialisation
        (np.cumsum(np.random.default_rng(0).gamma(5, 0.004, 500)), True),
        (np.round(np.cumsum(np.full(100, 0.007)), 2), True),  # a coarse clock
        ([0.0, 0.02, 0.04], True),
        ([0.02, 0.021, 0.0215], False),  # three ascend by chance
        ([0.02, 0.04], False),
        (np.full(100, 0.02), False),
        ([0.02] * 50 + [0.03] * 50, False),
        ([1.2, *np.full(20, 0.02)], False),
        (np.random.default_rng(0).gamma(5, 0.004, 500), False),
    ],
)
def test_what_looks_cumulative(values, cumulative):
    assert looks_cumulative(np.asarray(values, float)) == cumulative


@pytest.mark.parametrize(
    ("header", "unit", "expected"),
    [
        ("time_ms", "ms", [900_000, 800_000]),
        ("Time[ms]", "ms", [900_000, 800_000]),
        ("milliseconds", "ms", [900_000, 800_000]),
        ("elapsed_us", "us", [900, 800]),
        ("FPS", "fps", [1_111_111_111, 1_250_000_000]),
        ("seconds", "s", [900_000_000, 800_000_000]),
        ("time", None, [900_000_000, 800_000_000]),
        ("\ufefftime_ns", "ns", [1, 1]),
        ("# Time (ms)", "ms", [900_000, 800_000]),
        ("inference time [s]", "s", [900_000_000, 800_000_000]),
    ],
)
def test_a_header_may_name_the_unit(written, header, unit, expected):
    times, found = read_times(written(f"{header}\n0.9\n0.8\n"))
    assert (times.tolist(), found) == (expected, unit)


def test_a_column_that_counts_the_frames_holds_no_times(written):
    for first in (0, 1):
        rows = "".join(f"{first + k} {0.02 + k % 2}\n" for k in range(6))
        with pytest.raises(LaeError, match=f"column 1 counts the frames, {first} to {first + 5}"):
            read_times(written(rows), "ms")
        assert ns(written(rows), column=1) == [20_000_000, 1_020_000_000] * 3


def test_a_header_may_say_that_times_are_since_the_start(written):
    times, unit = read_times(written("cumulative_time_ms\n20\n45\n"))
    assert (times.tolist(), unit) == ([20_000_000, 25_000_000], "cumulative-ms")
    assert ns(written("time_ms\n20\n45\n"), "s") == [20 * 10**9, 45 * 10**9]


@pytest.mark.parametrize("cell", ["-0.1", "nan", "fast", "1e20", "0.02s", "time"])
def test_no_time(written, cell):
    with pytest.raises(LaeError, match="line 2"):
        read_times(written(f"0.1\n{cell}\n"))


def test_a_huge_number_is_refused_quickly(written):
    for text in ("1e999999999\n", "9" * 10_000 + "\n", "1e999\n", "1\n2\n1e400\n"):
        for unit in (None, *UNITS):
            with pytest.raises(LaeError, match=r"car_time\.txt"):
                read_times(written(text), unit)


def test_no_such_unit():
    with pytest.raises(LaeError, match=r"no 'mss': there are s, ms.*did you mean 'ms'"):
        parse_unit("mss")
    assert [parse_unit(unit) for unit in UNITS] == list(UNITS)


def files(*seconds, unit=None):
    return [
        MeasuredTimes(f"s{k}", Path(f"s{k}.txt"), np.full(9, round(s * 1e9)), unit)
        for k, s in enumerate(seconds)
    ]


@pytest.mark.parametrize("seconds", [[0.0005], [0.25], [0.0004, 0.02, 0.3], [0, 0.02]])
def test_times_that_are_seconds(seconds):
    check_seconds(files(*seconds))


@pytest.mark.parametrize(
    ("seconds", "choices"),
    [
        ([0.9], "s (900 ms a frame) or --time-unit ms (0.9 ms a frame) or --time-unit fps (1,110 "),
        ([35.2], "ms (35.2 ms a frame) or --time-unit fps (28.4 ms a frame)"),
        ([0.0004], "s (0.4 ms a frame)"),
        ([60], "fps (16.7 ms a frame)"),
        ([35200], "us (35.2 ms a frame)"),
        ([35_200_000], "ns (35.2 ms a frame)"),
        ([1e-9], "with it, one of s, ms"),
    ],
)
def test_times_that_are_perhaps_not_seconds(seconds, choices):
    with pytest.raises(LaeError, match=r"s0\.txt: the unit of its times is not known") as caught:
        check_seconds(files(*seconds))
    assert f"--time-unit {choices}" in str(caught.value)
    check_seconds(files(*seconds, unit="s"))


def test_times_that_are_all_0_are_asked_about():
    with pytest.raises(LaeError, match=r"s0\.txt: all times are 0, .*--time constant:47ms"):
        check_seconds(files(0, 0))
    check_seconds(files(0, 0, unit="s"))


def test_one_file_in_another_unit_is_found():
    with pytest.raises(LaeError, match=r"s2\.txt: the unit"):
        check_seconds(files(0.02, 0.025, 35.2))


def test_what_was_understood_is_said():
    assert understood(files(0.02)) == "seconds per frame, as no unit was given"
    assert understood(files(0.02, unit="ms")) == "milliseconds per frame"
    assert understood(files(0.02, unit="cumulative-us")) == "microseconds since the start"
    both = [*files(0.02, unit="fps"), *files(0.02, unit="ns")]
    assert understood(both) == "frames per second of each frame and nanoseconds per frame"


def test_times_that_ascend_though_they_are_said_to_be_of_each_frame():
    sums = np.arange(1, 10) * 10**6
    note = ascending_note([MeasuredTimes("a", Path("a.txt"), sums, "ms"), *files(0.02)])
    assert note.startswith("times ascend from row to row in 1 of 2 sequences (a); if they are")
    assert ascending_note([MeasuredTimes("a", Path("a.txt"), sums, "cumulative-ms")]) is None
