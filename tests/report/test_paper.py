"""A folder for a paper: written whole, replaced as far as it is ours, and what its tables hold."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq
import pytest

from lae_sim.errors import LaeError
from lae_sim.figures.column import ColumnFigure, DrawnFigure, column_figure, drawn
from lae_sim.report.latex import latex_of
from lae_sim.report.paper import (
    MOST_ROWS,
    Paper,
    PaperTable,
    Records,
    TrackerScores,
    in_two_forms,
    remove_paper,
    with_and_without,
    write_frame,
    write_paper,
    write_table,
)
from lae_sim.report.table import SCORE, Column, Table

TABLE = Table.of([Column("name", "name", is_label=True), Column("AUC", "auc", SCORE)],
                 [{"name": "a", "auc": 0.5}, {"name": "b", "auc": 0.25}], "t", "Some")  # fmt: skip
TABLES = [PaperTable(TABLE, TABLE, TABLE)]


def figures(*names: str) -> Iterator[DrawnFigure]:
    draw = partial(column_figure, lambda axes: axes.plot([0, 1]))
    return (drawn(ColumnFigure(name, f"of {name}", draw)) for name in names)


def files_in(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_a_folder_holds_figures_and_tables_and_says_what_they_are(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "paper"
    frame = pd.DataFrame({"auc": [0.5, None], "name": ["x", "=1+2"]})
    paper = Paper(figures("success"), TABLES, {"scores": frame}, {"replay.json": {"a": 1.5}})
    write_paper(paper, folder)
    expected = {"figures/success.pdf", "figures/success.svg"}
    expected |= {f"tables/t{end}" for end in (".csv", ".parquet", ".tex", "-long.tex")}
    expected |= {"tables/scores.csv", "tables/scores.parquet"}
    assert files_in(folder) == expected | {"replay.json", "contents.json"}
    contents = json.loads((folder / "contents.json").read_text())
    assert {name for each in contents["contents"] for name in each["files"]} == expected
    assert contents["contents"][0]["caption"] == "of success"
    assert pd.read_csv(folder / "tables" / "scores.csv")["name"].tolist() == ["x", "'=1+2"]
    pd.testing.assert_frame_equal(pd.read_parquet(folder / "tables" / "scores.parquet"), frame)
    assert json.loads((folder / "replay.json").read_text()) == {"a": 1.5}


def test_names_are_such_as_latex_takes_and_do_not_meet(tmp_path: Path) -> None:
    names = ["auc-a b.parquet, recorded", "auc_a b recorded", "..", "追踪", "a/../../b"]
    write_paper(Paper(figures(*names)), tmp_path)
    written = {name for name in files_in(tmp_path) if name.endswith(".pdf")}
    assert len(written) == len(names)
    assert "figures/auc-a-b-recorded.pdf" in written
    stems = [name.removeprefix("figures/").removesuffix(".pdf") for name in written]
    assert all(stem.replace("-", "").isalnum() and stem.isascii() for stem in stems)


def test_a_failure_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    write_paper(Paper(figures("one"), TABLES), tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)}

    def breaks() -> Iterator[DrawnFigure]:
        yield from figures("one", "two")
        raise LaeError("broken")

    with pytest.raises(LaeError, match="broken"):
        write_paper(Paper(breaks()), tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)} == before
    with pytest.raises(LaeError, match="broken"):
        write_paper(Paper(breaks()), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_what_an_earlier_call_wrote_goes_and_other_files_stay(tmp_path: Path) -> None:
    write_paper(Paper(figures("one", "two"), TABLES), tmp_path)
    own = tmp_path / "figures" / "own.pdf"
    own.write_text("mine")
    (tmp_path / "paper.tex").write_text("mine")
    write_paper(Paper(figures("two")), tmp_path)
    assert {name for name in files_in(tmp_path) if not name.endswith(".json")} == {
        "figures/own.pdf", "figures/two.pdf", "figures/two.svg", "paper.tex"
    }  # fmt: skip
    remove_paper(tmp_path)
    assert files_in(tmp_path) == {"figures/own.pdf", "paper.tex"}
    assert not (tmp_path / "tables").exists()


@pytest.mark.parametrize(
    "contents",
    [
        '{"contents": [{"files": ["../victim.csv", "figures/../../victim.csv", 3]}]}',
        '{"contents": [{"files": ["paper.tex", "tables/../paper.tex", "/etc/passwd"]}]}',
        '{"contents": 5}',
        '{"contents": [{}]}',
        "nonsense",
        "[1]",
    ],
)
def test_what_others_wrote_as_contents_removes_nothing_else(tmp_path: Path, contents: str) -> None:
    folder = tmp_path / "paper"
    folder.mkdir()
    for path in (tmp_path / "victim.csv", folder / "paper.tex"):
        path.write_text("mine")
    (folder / "contents.json").write_text(contents)
    write_paper(Paper(tables=TABLES), folder)
    assert (tmp_path / "victim.csv").read_text() == (folder / "paper.tex").read_text() == "mine"


@pytest.mark.parametrize("name", ["figures", "tables/t.csv"])
def test_what_stands_in_the_way_is_told(tmp_path: Path, name: str) -> None:
    place = tmp_path / name
    if name == "figures":
        place.write_text("a file")
    else:
        place.mkdir(parents=True)
    with pytest.raises(LaeError, match="is there already and is"):
        write_paper(Paper(figures("one"), TABLES), tmp_path)
    assert not (tmp_path / "contents.json").exists()


def scores(datasets: int) -> list[TrackerScores]:
    return [
        TrackerScores(
            tracker,
            f"set {d}",
            forecaster,
            {"auc": base + 0.1 * (forecaster == "kalman"), "dp20": base},
            {"auc": 0.9, "dp20": 0.95},
        )
        for d in range(datasets)
        for tracker, base in (("slow", 0.4), ("fast", 0.45))
        for forecaster in ("hold", "kalman")
    ]


TITLES = {"auc": "AUC", "dp20": "DP"}


def test_the_layout_of_the_paper_ranks_what_is_under_latency() -> None:
    table = with_and_without(scores(1), ["hold", "kalman"], TITLES, "sigma 0")
    lines = [[cell.text for cell in row] for row in table.rows]
    assert lines[1] == ["slow", "hold", "0.400", "-55.6%", "0.400", "-57.9%"]
    assert lines[2][:4] == ["slow", "kalman", "0.500", "+25.0%"]
    assert [row[2].rank for row in table.rows] == [0, 0, 2, 0, 0, 1]
    text = latex_of(in_two_forms(table).short)
    assert r" & kalman & \textbf{.550} & \textbf{.450} \\" in text.splitlines()
    assert "hold changes relative to offline" not in text
    assert "sigma 0" in text


def test_rows_of_which_nothing_is_known_are_left_out() -> None:
    rows = [
        TrackerScores("a", "D", name, {"auc": 0.5, "dp20": 0.6}, {"auc": None, "dp20": None})
        for name in ("hold", "kalman")
    ]
    table = with_and_without(rows, ["hold", "kalman"], TITLES, "")
    assert [row[1].text for row in table.rows] == ["hold", "kalman"]


@pytest.mark.parametrize(("datasets", "columns"), [(1, 4), (2, 6), (3, 5), (4, 6)])
def test_a_column_holds_few_numbers(datasets: int, columns: int) -> None:
    forms = in_two_forms(with_and_without(scores(datasets), ["hold", "kalman"], TITLES, ""))
    assert len(forms.short.columns) == columns
    assert len(forms.long.columns) == 2 + 4 * datasets


def test_tables_longer_than_a_page_are_cut_in_latex_alone(tmp_path: Path) -> None:
    records = [{"name": str(i), "auc": i / 100} for i in range(MOST_ROWS + 20)]
    table = Table.of(TABLE.columns, records, "t", "Many")
    write_table(PaperTable(table, table, table), tmp_path)
    text = (tmp_path / "t.tex").read_text()
    assert f"Many; {MOST_ROWS} of {MOST_ROWS + 20} rows, all in t.csv." in text
    assert text.count(r" \\") == MOST_ROWS + 1
    assert pq.read_table(tmp_path / "t.parquet").num_rows == MOST_ROWS + 20


def test_labels_that_do_not_differ_are_in_the_caption(tmp_path: Path) -> None:
    columns = [Column(key, key, is_label=True) for key in ("tracker", "dataset")]
    records = [{"tracker": name, "dataset": "D", "auc": 0.5} for name in "ab"]
    table = Table.of([*columns, Column("AUC", "auc", SCORE)], records, "t", "Some")
    write_table(PaperTable(table, table, table), tmp_path)
    text = (tmp_path / "t.tex").read_text()
    assert r"\caption{Some; dataset D.}" in text
    assert r"tracker & AUC \\" in text
    assert (tmp_path / "t.csv").read_text().startswith("tracker,dataset,auc\n")


def test_records_are_written_as_a_frame_of_them_would_be(tmp_path: Path) -> None:
    some: list[dict[str, Any]] = [
        {"name": "=1+2", "whole": 3, "partly": 1, "real": 0.1, "is": True, "empty": None},
        {"name": "b", "whole": 4, "real": math.nan, "is": False, "late": "x", "empty": None},
    ]
    rows = some * 700  # more than are held at once
    names = ["name", "whole", "partly", "real", "is", "empty", "late"]
    frame = pd.DataFrame(rows, columns=names)
    write_frame(frame, tmp_path / "frame")
    write_frame(Records(names, lambda: iter(rows)), tmp_path / "records")
    texts = [(tmp_path / f"{name}.csv").read_bytes() for name in ("frame", "records")]
    assert texts[0] == texts[1]
    read = [pd.read_parquet(tmp_path / f"{name}.parquet") for name in ("frame", "records")]
    pd.testing.assert_frame_equal(*read)
