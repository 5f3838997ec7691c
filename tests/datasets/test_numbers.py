from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.datasets.numbers import read_durations, read_numbers
from lae_sim.errors import LaeError


@pytest.fixture
def written(tmp_path):
    def write(text, name="table.txt"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


@pytest.mark.parametrize(
    "text",
    [
        "1,2.5,-3,4e1\n5,6,7,8\n",
        "1\t2.5\t-3\t4e1\n5\t6\t7\t8",
        "1 2.5  -3 40.0\n 5 6 7 8 \n\n",
        "1; 2.5; -3; 40\r\n5;6;7;8\r\n",
        "1, 2.5, -3, 40,\n5, 6, 7, 8,\n",
        "\ufeff1,2.5,-3,40\n5,6,7,8\n",
        "1 ,2.5 ,\t-3, 40\n5, 6,7,  8\n",
        "1,2.5,-3,40\n5,6,7,8\n".encode("utf-16"),
    ],
)
def test_separators(written, text):
    assert read_numbers(written(text)).tolist() == [[1, 2.5, -3, 40], [5, 6, 7, 8]]


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("1,2\n3,4,5\n", 2, "3 columns"),
        ("1,2\n3\n", 2, "1 columns"),
        ("1,2\n\n3,4\n", 2, "empty line"),
        ("1,2\n3,x\n", 2, "'x' is not a number"),
        ("1,2\n3,1_000\n", 2, "'1_000'"),
        ("1,inf\n", 1, "'inf'"),
        ("1,nan\n", 1, "'nan'"),
        ("1,1e999\n", 1, "'1e999'"),
        ("1,,2\n", 1, "''"),
        ("1,5;2,5\n", 1, "decimal points, and one separator"),
        ("1,5 2,5\n", 1, "decimal points, and one separator"),
        ("1,2\n10\t2,5\n", 2, "decimal points, and one separator"),
        ("x,y\n1,2\n", 1, "'x' is not a number; the line looks like a header: remove it"),
    ],
)
def test_faults_name_the_line(written, text, line, problem):
    path = written(text)
    with pytest.raises(LaeError) as caught:
        read_numbers(path)
    assert str(caught.value).startswith(f"{path}, line {line}: ")
    assert problem in str(caught.value)


def test_nan_where_allowed(written):
    assert np.isnan(read_numbers(written("NaN,nan\n1,2\n"), nan=True)[0]).all()
    with pytest.raises(LaeError, match="'nana'"):
        read_numbers(written("nana,1\n"), nan=True)


def test_rows_without_a_target_where_allowed(written):
    table = read_numbers(written("1,2\n0\nnan,NaN,nan\n3,4\nnan\n"), nan=True, absent=True)
    assert np.isnan(table[[1, 2, 4]]).all()
    assert table[[0, 3]].tolist() == [[1, 2], [3, 4]]
    assert np.isnan(read_numbers(written("nan,nan\nNaN,NaN\n"), nan=True, absent=True)).all()
    with pytest.raises(LaeError, match="line 2: 1 columns, and the lines before have 2"):
        read_numbers(written("1,2\n1\n"), nan=True, absent=True)


@pytest.mark.parametrize(
    ("text", "problem"), [("", "empty"), ("\n\n", "empty"), (b"\xff\xfe\x00", "not a text file")]
)
def test_no_table(written, text, problem):
    with pytest.raises(LaeError, match=problem):
        read_numbers(written(text))


def test_no_file(tmp_path):
    with pytest.raises(LaeError, match="no such file"):
        read_numbers(tmp_path / "none.txt")
    with pytest.raises(LaeError, match="a folder, not a file"):
        read_numbers(tmp_path)


def test_durations_are_exact(written):
    # 0.0262550005 s * 1e9 in floats is 26255000.499999996; half to even is 26255000 all the same.
    path = written("0.007319\n0.1\n2.6255e-2\n0.0262550005\n0.0000000015\n")
    assert read_durations(path).tolist() == [7_319_000, 10**8, 26_255_000, 26_255_000, 2]


@given(st.decimals(0, 1000, places=12, allow_nan=False))
def test_any_duration_is_rounded_exactly(tmp_path_factory, seconds):
    path = tmp_path_factory.getbasetemp() / "times.txt"
    path.write_text(f"{seconds:f}\n")
    assert read_durations(path, "s").tolist() == [round(Fraction(seconds) * 10**9)]


def test_units_and_columns(written):
    path = written("35.2,1\n34.8,2\n36,3\n")
    assert read_durations(path, "ms").tolist() == [35_200_000, 34_800_000, 36_000_000]
    assert read_durations(path, "s", column=1).tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    with pytest.raises(LaeError, match="has 2 columns of times, not 3"):
        read_durations(path, "ms", column=2)


@pytest.mark.parametrize(
    ("median", "unit"), [("35.2", "ms"), ("35200", "us"), ("35200000", "ns"), ("1.4", "ms")]
)
def test_other_units_are_guessed(written, median, unit):
    path = written(f"0.4\n{median}\n{median}\n")
    with pytest.raises(LaeError, match=f"look like {unit}.*add --time-unit {unit}"):
        read_durations(path)
    assert len(read_durations(path, "s")) == 3


def test_too_short_for_seconds(written):
    with pytest.raises(LaeError, match="too short"):
        read_durations(written("1e-6\n2e-6\n"))


@pytest.mark.parametrize("cell", ["-0.1", "nan", "fast", "1e20"])
def test_no_duration(written, cell):
    with pytest.raises(LaeError, match="line 2"):
        read_durations(written(f"0.1\n{cell}\n"))


def test_a_huge_number_is_refused_quickly(written):
    for text in ("1e999999999\n", "9" * 10_000 + "\n"):
        with pytest.raises(LaeError):
            read_durations(written(text))


def test_all_zero_times_have_no_unit(written):
    assert read_durations(written("0\n0.0\n")).tolist() == [0, 0]


def test_paths_are_named(written):
    path = written("x\n", "Basketball_time.txt")
    with pytest.raises(LaeError, match=Path(path).name):
        read_durations(path)
