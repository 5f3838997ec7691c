import numpy as np
import pytest

from lae_sim.datasets.numbers import read_numbers
from lae_sim.decoding import max_decoded
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
        ("0,047\n0,2\n", 1, "'0,047' looks like a number with a decimal comma"),
        ("0,147\n0,2\n", 1, "write decimal points"),
        ("1,5\n12,05\n", 1, "write decimal points"),
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


def test_utf_16_without_a_mark_is_named(written):
    for encoding in ("utf-16-le", "utf-16-be"):
        with pytest.raises(LaeError, match="in UTF-16: save it as UTF-8"):
            read_numbers(written("1,2\n3,4\n".encode(encoding)))


def test_a_table_that_would_take_too_much_memory(written):
    path = written("1,2,3,4\n" * 20_000)
    with max_decoded("9MiB"):
        assert read_numbers(path).shape == (20_000, 4)
    for size in ("100KiB", "1MiB", "4MiB"):
        with (
            max_decoded(size),
            pytest.raises(LaeError, match=r"table\.txt: would take more than .* of memory"),
        ):
            read_numbers(path)


def test_no_file(tmp_path):
    with pytest.raises(LaeError, match="no such file"):
        read_numbers(tmp_path / "none.txt")
    with pytest.raises(LaeError, match="a folder, not a file"):
        read_numbers(tmp_path)
