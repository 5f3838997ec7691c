"""One table, several ways to show it: they say the same; what a column makes of a record."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lae_sim.files import csv_cell
from lae_sim.report.table import (
    COUNT,
    PERCENT,
    SCORE,
    SIGNED,
    UNKNOWN,
    Cell,
    Column,
    Number,
    Table,
    legend_of,
    p_label,
    relative_change,
    text_of,
    text_of_records,
    write_csv,
    write_parquet,
)


@dataclass(frozen=True)
class Tracker:
    """A record for the tables here."""

    name: str
    auc: float | None
    auc_low: float | None = None
    auc_high: float | None = None


RECORDS = [Tracker("slow\n", 0.51249, 0.4, 0.6), Tracker("fast & rough", None)]
COLUMNS = [
    Column("tracker", "name", is_label=True),
    Column("AUC", "auc", SCORE, "mean over sequences"),
    Column("lost", lambda tracker: relative_change(tracker.auc, 1.0), PERCENT),
]
TABLE = Table.of(COLUMNS, RECORDS, "t", "What there is")


@pytest.mark.parametrize("records", [RECORDS, [vars(record) for record in RECORDS]])
def test_a_column_reads_records_and_mappings(records: list[Tracker]) -> None:
    first, second = Table.of(COLUMNS[:2], records).rows
    assert first == (
        Cell(r"slow\n", "slow\n"),
        Cell("0.512 [0.400, 0.600]", 0.51249, (0.4, 0.6)),
    )
    assert second == (Cell("fast & rough", "fast & rough"), UNKNOWN)


def test_text_is_aligned_and_leaves_intervals_out_if_asked() -> None:
    assert text_of(TABLE).splitlines() == [
        "tracker                        AUC    lost",
        "------------  --------------------  ------",
        r"slow\n        0.512 [0.400, 0.600]  -48.8%",
        "fast & rough                     -       -",
    ]
    assert text_of(TABLE, intervals=()).splitlines()[2] == r"slow\n        0.512  -48.8%"
    assert legend_of(TABLE) == "AUC: mean over sequences"


def test_csv_has_numbers_in_full(tmp_path: Path) -> None:
    write_csv(TABLE, tmp_path / "t.csv")
    with open(tmp_path / "t.csv", newline="") as file:
        header, first, second = csv.reader(file)
    assert header == ["name", "auc", "auc_low", "auc_high", "lost"]
    assert first == ["slow\n", "0.51249", "0.4", "0.6", str(0.51249 - 1)]
    assert second == ["fast & rough", "", "", "", ""]


def test_parquet_says_what_csv_says_in_numbers(tmp_path: Path) -> None:
    write_csv(TABLE, tmp_path / "t.csv")
    write_parquet(TABLE, tmp_path / "t.parquet")
    stored = pq.read_table(tmp_path / "t.parquet")
    with open(tmp_path / "t.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert stored.column_names == list(rows[0])
    assert stored.schema.field("auc").type == pa.float64()
    for name in ("auc", "auc_low", "auc_high", "lost"):
        values = [None if row[name] == "" else float(row[name]) for row in rows]
        assert stored[name].to_pylist() == values
    assert stored["name"].to_pylist() == [r"slow\n", "fast & rough"]


def test_whole_numbers_stay_whole_in_parquet(tmp_path: Path) -> None:
    columns = [Column("n", "n"), Column("none at all", "m")]
    write_parquet(Table.of(columns, [{"n": 3}, {"n": None}]), tmp_path / "t.parquet")
    stored = pq.read_table(tmp_path / "t.parquet")
    assert stored.to_pydict() == {"n": [3, None], "m": [None, None]}
    assert stored.schema.field("n").type == pa.int64()


def test_a_table_of_some_columns() -> None:
    some = TABLE.only(lambda place, column: column.is_label or place == 2)
    assert some.header == ("tracker", "lost")
    assert [row[0] for row in some.rows] == [row[0] for row in TABLE.rows]
    assert [row[1] for row in some.rows] == [row[2] for row in TABLE.rows]


def test_csv_has_no_formulas(tmp_path: Path) -> None:
    write_csv(Table.of(COLUMNS[:2], [Tracker("=2+3", -0.5)]), tmp_path / "t.csv")
    with open(tmp_path / "t.csv", newline="", encoding="utf-8") as file:
        assert list(csv.reader(file))[1] == ["'=2+3", "-0.5"]


@pytest.mark.parametrize("text", ["-0.5", "-1/2", "+3", "car", "a=b", ""])
def test_csv_leaves_numbers_and_other_texts(text: str) -> None:
    assert csv_cell(text) == text


def test_groups_stand_above_their_columns() -> None:
    columns = [Column("a", "auc", is_label=True)]
    columns += [Column(t, "auc", group=g) for g in ("one", "two") for t in ("x", "y")]
    assert Table.of(columns, []).groups == [("one", 2), ("two", 2)]


def test_numbers() -> None:
    assert [SIGNED(0.5), SCORE(None), SCORE(float("nan"))] == ["+0.500", "-", "-"]
    share = Number(".1f", 100, "%", ".0f")
    assert share(0.123, (0.1, 0.2)) == "12.3% [10, 20]"
    assert [p_label(0.0004), p_label(0.0126), p_label(None)] == ["<0.001", "0.013", "-"]
    assert relative_change(1.0, None) is None
    assert relative_change(1.0, 0.0) is None


WIDE = (
    Column("trace", "trace", is_label=True),
    Column("forecaster", "forecaster", is_label=True),
    Column("AUC", "auc", SCORE, importance=9),
    Column("offline", "offline", SCORE, importance=4),
    Column("frames", "frames", COUNT, importance=2),
    Column("DP", "auc", SCORE, importance=8),
)
RUNS = [
    {"trace": f"a-tracker-on-a-device-{n}.parquet", "forecaster": name, "auc": 0.5, "offline": 0.75,
     "frames": 12345}
    for n in (1, 2) for name in ("hold", "kalman")
]  # fmt: skip


@pytest.mark.parametrize(
    ("width", "shown"),
    [
        (20, ["AUC"]),
        (46, ["AUC"]),
        (47, ["AUC", "DP"]),
        (57, ["AUC", "DP"]),
        (58, ["AUC", "frames", "DP"]),
        (59, ["AUC", "offline", "DP"]),
        (66, ["AUC", "offline", "DP"]),
        (67, ["AUC", "offline", "frames", "DP"]),
        (72, ["AUC", "offline", "frames", "DP"]),
    ],
)
def test_a_table_fits_the_terminal_by_importance(width: int, shown: list[str]) -> None:
    text = text_of_records(WIDE, RUNS, width)
    table, _, said = text.partition("\nleft out for want of room: ")
    header, _, *lines = table.splitlines()
    assert header.split() == ["trace", "forecaster", *shown]
    assert width < 40 or max(map(len, [header, *lines])) <= width
    missing = [title for title in ("offline", "frames", "DP") if title not in shown]
    told = ", ".join(missing) + "; --json has all of it" if missing else ""
    assert said.replace("\n", " ") == told
    assert len({line.split()[0] for line in lines}) == 2  # shorter names stay apart


def test_a_table_that_is_not_for_a_terminal_is_whole() -> None:
    assert text_of_records(WIDE, RUNS) == text_of_records(WIDE, RUNS, 1000)
    assert text_of(Table.of(WIDE, RUNS)) == text_of_records(WIDE, RUNS)
    assert "a-tracker-on-a-device-1.parquet" in text_of_records(WIDE, RUNS)


def test_columns_of_one_title_are_told_apart_by_their_names() -> None:
    both = [
        Column("offline", "offline", SCORE, name=f"{of} offline", importance=n)
        for n, of in enumerate(("AUC", "DP"))
    ]
    text = " ".join(text_of_records([*WIDE[:3], *both], RUNS, 59).split())
    assert text.endswith("left out for want of room: AUC offline; --json has all of it")
