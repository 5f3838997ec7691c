"""One table, four ways to show it: that they say the same, and what a column makes of a record."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

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
    latex_of,
    legend_of,
    p_label,
    relative_change,
    text_of,
    text_of_records,
    write_csv,
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
    assert header == ["tracker", "AUC", "AUC low", "AUC high", "lost"]
    assert first == ["slow\n", "0.51249", "0.4", "0.6", str(0.51249 - 1)]
    assert second == ["fast & rough", "", "", "", ""]


def test_latex_escapes_names_and_signs() -> None:
    lines = latex_of(TABLE).splitlines()
    assert lines[0] == "% What there is"
    assert r"slow\textbackslash{}n & 0.512 {[}0.400, 0.600] & $-$48.8\% \\" in lines
    assert r"fast \& rough & -- & -- \\" in lines


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("*", "{*}"),  # the star of the line break before it
        ("[x]", "{[}x]"),  # its optional argument
        ("?`", "?{}`"),  # a ligature for the Spanish question mark
        ("!`a``b", "!{}`a`{}`b"),
        ("--", "-{}-"),
        ("a---b", "a-{}-{}-b"),
        ("-", "-"),
        ("it''s", "it'{}'s"),
        ("\\", r"\textbackslash{}"),
        ('a<b>|c"', r"a\textless{}b\textgreater{}\textbar{}c\char34{}"),
        ("Müller", "Müller"),
    ],
)
def test_latex_holds_hostile_names(name: str, written: str) -> None:
    table = Table.of(COLUMNS[:2], [Tracker(name, None)], "t")
    lines = latex_of(table).splitlines()
    assert rf"{written} & -- \\" in lines
    assert not any(line.startswith("% compile") for line in lines)


def test_latex_says_what_pdflatex_has_no_font_for() -> None:
    text = latex_of(Table.of(COLUMNS[:1], [Tracker("追踪", 1.0)], "t"))
    assert "% compile with lualatex or xelatex, and a font for 踪追" in text.splitlines()
    assert r"追踪 \\" in text.splitlines()


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
    Column("offline", "offline", SCORE, name="AUC offline", importance=4),
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
    missing = [n for n, title in (("AUC offline", "offline"), ("frames",) * 2, ("DP",) * 2)
               if title not in shown]  # fmt: skip
    told = ", ".join(missing) + "; --json has all of it" if missing else ""
    assert said.replace("\n", " ") == told
    assert len({line.split()[0] for line in lines}) == 2  # shorter names stay apart


def test_a_table_that_is_not_for_a_terminal_is_whole() -> None:
    assert text_of_records(WIDE, RUNS) == text_of_records(WIDE, RUNS, 1000)
    assert text_of(Table.of(WIDE, RUNS)) == text_of_records(WIDE, RUNS)
    assert "a-tracker-on-a-device-1.parquet" in text_of_records(WIDE, RUNS)
