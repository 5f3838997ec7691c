"""Logs as tables: columns, units, exact times, gaps."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.errors import LaeError
from lae_sim.importers.log_table import read_table

HEADER = "frame,arrived_ms,ready_ms,x,y,w,h"
ROWS = ["0,0,40,10,20,30,40", "1,33.3,,,,,", "2,66.7,95.5,12,20,30,40"]


@pytest.fixture
def table(tmp_path: Path):
    def write(header: str = HEADER, rows: list[str] = ROWS) -> Path:
        path = tmp_path / "flight.csv"
        path.write_text("\n".join([header, *rows]), "utf-8")
        return path

    return write


def test_a_table(table) -> None:
    log = read_table(table())
    assert [frame.arrived_ns for frame in log.frames] == [0, 33_300_000, 66_700_000]
    assert [frame.captured_ns for frame in log.frames] == [None] * 3
    first, second = log.outputs
    assert (first.frame, first.box, first.ready_ns) == (0, (10, 20, 30, 40), 40_000_000)
    assert (second.frame, second.ready_ns, second.started_ns) == (2, 95_500_000, None)
    assert second.where.endswith("flight.csv, line 4")
    assert (log.tracker, log.facts, log.truth) == ("flight", {"format": "csv"}, {})


@pytest.mark.parametrize(
    "name", ["ready_{}", "ready [{}]", "ready ({})", "Ready[{}]", " ready {} "]
)
@pytest.mark.parametrize(
    ("unit", "ns"),
    [("s", 10**9), ("ms", 10**6), ("us", 1000), ("\u00b5s", 1000), ("ns", 1), ("sec", 10**9)],
)
def test_units_are_those_of_the_header(table, name: str, unit: str, ns: int) -> None:
    path = table(f"frame,arrived_ms,{name.format(unit)},x,y,w,h", ["0,0,7,1,2,3,4"])
    assert read_table(path).outputs[0].ready_ns == 7 * ns


@given(st.decimals(0, 10**9, places=12))
def test_times_are_exact(tmp_path_factory: pytest.TempPathFactory, seconds) -> None:
    path = tmp_path_factory.mktemp("t") / "t.csv"
    path.write_text(f"frame,arrived_s,ready_s,x,y,w,h\n0,0,{seconds:f},1,2,3,4")
    assert read_table(path).outputs[0].ready_ns == round(Fraction(seconds) * 10**9)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_separators_other_columns_and_quotes(table, separator: str) -> None:
    rows = [separator.join(['"0"', "5", "-1.5e0", "2", "3", "4", "a b", "0.5", "1e1"])]
    header = ["frame", "ready_ms", "x", "y", "w", "h", "remark", "score", "captured_us"]
    log = read_table(table("\ufeff" + separator.join(header), [*rows, separator * 8, ""]))
    assert log.outputs[0].box == (-1.5, 2, 3, 4)
    assert (log.outputs[0].score, log.frames[0].captured_ns) == (0.5, 10_000)
    assert log.notes == ("columns left out: remark",)


def test_an_output_without_a_box_and_truth(table) -> None:
    header = f"{HEADER},truth_x,truth_y,truth_w,truth_h"
    log = read_table(table(header, ["0,0,40,1,2,3,4,,,,", "1,33,70,nan,nan,nan,nan,5,6,7,8"]))
    assert log.outputs[1].box is None
    assert log.truth == {1: (5, 6, 7, 8)}


def test_gaps_are_asked_about(table) -> None:
    rows = ["5,0,40,1,2,3,4", "9,100,140,1,2,3,4", "10,133,,,,,"]
    with pytest.raises(
        LaeError, match=r"line 3: frame 9 follows frame 5: were those between never"
    ):
        read_table(table(HEADER, rows))
    log = read_table(table(HEADER, rows), "dropped")
    assert [output.frame for output in log.outputs] == [0, 1]
    log = read_table(table(HEADER, rows), "skipped")
    assert [frame.arrived_ns for frame in log.frames] == [
        0, 25_000_000, 50_000_000, 75_000_000, 100_000_000, 133_000_000,
    ]  # fmt: skip
    assert ([output.frame for output in log.outputs], log.interpolated) == ([0, 4], 3)
    assert log.facts == {"format": "csv", "gaps": "skipped"}


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        (HEADER, [], r"flight.csv: no rows: the first line names the columns"),
        (
            "frame,arrived,ready_ms,x,y,w,h",
            ROWS,
            r"'arrived' names no unit of its times: write arr",
        ),
        ("frame,arrived_ms,ready_min,x,y,w,h", ROWS, r"'ready_min' names no unit"),
        ("frame,arrived_ms,ready [h],x,y,w,h", ROWS, r"'ready \[h\]' names no unit"),
        ("frame,arrived_ms,ready_ms,x,y,w,w", ROWS, r"column 'w' is there twice"),
        ("frame,arrived_ms,readi_ms,x,y,w,h", ROWS, r"no column ready; did you mean 'readi_ms'\?"),
        ("image,at_ms,ready_ms,x,y,w,h", ROWS, r"line 1: no column frame"),
        ("frame,at_ms,ready_ms,x,y,w,h", ROWS, r"no column arrived \(or captured\)"),
        (f"{HEADER},truth_x", ROWS, r"of truth_x, truth_y, truth_w, truth_h only truth_x"),
        (HEADER, ["0,0,40,10,20"], r"line 2: 5 cells, fewer than the header has"),
        (HEADER, ["0,0,40,10,20,30,"], r"line 2: a box without h"),
        (HEADER, ["0,0,,10,20,30,40"], r"line 2: a box, and no time when it was ready"),
        (HEADER, ["0,0,soon,10,20,30,40"], r"line 2: ready is 'soon', not a number"),
        (HEADER, ["0,0,1_0,10,20,30,40"], r"line 2: ready is '1_0', not a number"),
        (HEADER, ["0,0,1e99,10,20,30,40"], r"line 2: ready is '1e99', an impossible number"),
        (
            HEADER,
            ["0,0,1e15,10,20,30,40"],
            r"line 2: ready: too long a time: 292 years are the most",
        ),
        (HEADER, ["0.5,0,1,10,20,30,40"], r"line 2: frame is '0.5', no whole number"),
        (HEADER, [",0,1,10,20,30,40"], r"line 2: frame is '', no whole number"),
        (HEADER, [*ROWS, "2,80,90,1,2,3,4"], r"line 5: frame 2 does not come after frame 2"),
        (HEADER, ["0,0,1,1,2,3,4", "9999999,9,,,,,"], r"line 3: frame 9999999 follows frame 0"),
    ],
)
def test_what_is_no_such_table(table, header: str, rows: list[str], message: str) -> None:
    with pytest.raises(LaeError, match=message):
        read_table(table(header, rows))


def test_a_gap_of_millions_is_none(table) -> None:
    path = table(HEADER, ["0,0,1,1,2,3,4", "9999999,9,,,,,"])
    with pytest.raises(LaeError, match="line 3: frame 9999999 follows frame 0"):
        read_table(path, "skipped")
