"""``--out DIR`` of replay and compare, and what a study writes for a paper."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest
from command_line import run_here
from places import TRACES

SLOW, FAST = TRACES / "synthetic-slow.parquet", TRACES / "synthetic-fast.parquet"
FEW = ("--sequence", "boat-calm", "car-chase")
TABLES = ("csv", "parquet", "tex")


def files_in(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def names(files: dict[str, bytes], folder: str, ending: str) -> set[str]:
    start, end = f"{folder}/", f".{ending}"
    return {
        name[len(start) : -len(end)]
        for name in files
        if name.startswith(start) and name.endswith(end)
    }


def test_replay_writes_figures_tables_and_everything_it_knows(tmp_path: Path) -> None:
    words = ("replay", SLOW, *FEW, "--sigma", 0, "1/2", "--json", "--out", tmp_path / "paper")
    done = run_here(*words)
    assert (done.returncode, done.stderr) == (0, "")
    files = files_in(tmp_path / "paper")
    figures = {"success", "precision", "auc-over-sigma", "dp20-over-sigma", "timeline-boat-calm"}
    assert names(files, "figures", "pdf") == names(files, "figures", "svg") == figures
    assert names(files, "tables", "tex") == {
        "table2", "table2-long", "attributes", "attributes-long"
    }  # fmt: skip
    for kind in ("csv", "parquet"):
        tables = {"table2", "attributes", "scores", "sequences"}
        assert names(files, "tables", kind) == tables
    printed, kept = json.loads(done.stdout), json.loads(files["replay.json"])
    [trace] = kept["traces"]
    assert trace["results"][0]["auc"] == printed["traces"][0]["results"][0]["auc"]
    sequences = pd.read_parquet(tmp_path / "paper" / "tables" / "sequences.parquet")
    assert len(sequences) == 2 * len(trace["results"])
    scores = pd.read_parquet(tmp_path / "paper" / "tables" / "scores.parquet")
    assert scores["auc"].tolist() == [result["auc"] for result in trace["results"]]
    assert scores["scale"].dtype == scores["fps"].dtype == "float64"
    layout = pd.read_csv(tmp_path / "paper" / "tables" / "table2.csv")
    assert layout["synthetic auc"].tolist()[1:] == [scores["auc"][0], scores["auc"][2]]
    assert run_here(*words).returncode == 0
    assert files_in(tmp_path / "paper") == files  # the same bytes


def test_a_sweep_of_traces_has_a_figure_for_each(tmp_path: Path) -> None:
    done = run_here(
        "replay", SLOW, FAST, *FEW, "--latency-scale", 1, 2, "--out", tmp_path / "paper"
    )
    assert done.returncode == 0, done.stderr
    files = files_in(tmp_path / "paper")
    swept = {
        f"{metric}-over-latency-scale-synthetic-{trace}"
        for metric in ("auc", "dp20")
        for trace in ("slow", "fast")
    }
    assert names(files, "figures", "pdf") == swept | {"timeline-boat-calm"}
    layout = pd.read_csv(tmp_path / "paper" / "tables" / "table2.csv")
    assert layout["tracker"].unique().tolist() == [
        "slow-and-accurate, times x 1", "slow-and-accurate, times x 2",
        "fast-and-rough, times x 1", "fast-and-rough, times x 2",
    ]  # fmt: skip


def test_compare_writes_the_same_kinds_of_files(tmp_path: Path) -> None:
    words = ("compare", SLOW, *FEW, "--forecaster", "kalman", "--sigma", 0, 1)
    done = run_here(*words, "--json", "--out", tmp_path / "paper")
    assert (done.returncode, done.stderr) == (0, "")
    files = files_in(tmp_path / "paper")
    figures = names(files, "figures", "pdf")
    assert {"auc-synthetic-slow", "dp20-synthetic-slow", "recovered-auc-synthetic-slow"} < figures
    assert {"auc-over-sigma-synthetic-slow-recorded"} < figures
    assert names(files, "figures", "svg") == figures
    assert {"comparison", "table2", "attributes"} < names(files, "tables", "tex")
    assert json.loads(files["compare.json"]) == json.loads(done.stdout)
    table = pd.read_parquet(tmp_path / "paper" / "tables" / "comparison.parquet")
    summary = json.loads(done.stdout)["summary"]
    means = [row["mean"] for row in summary if row["metric"] == "auc"]
    assert table["auc"].tolist() == means
    assert run_here(*words, "--out", tmp_path / "scores.csv").returncode == 0
    tidy = pd.read_csv(tmp_path / "scores.csv")
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "paper/tables/sequences.csv"), tidy)


def test_compare_over_the_grid_draws_each_sigma(tmp_path: Path) -> None:
    words = ("compare", SLOW, *FEW, "--forecaster", "kalman", "--sigma-grid")
    assert run_here(*words, "--out", tmp_path / "paper").returncode == 0
    files = files_in(tmp_path / "paper")
    figures = names(files, "figures", "svg")
    assert {"mauc-synthetic-slow", "auc-over-sigma-synthetic-slow-recorded"} < figures
    assert b"mAUC & mDP" in files["tables/table2.tex"]


def test_hold_alone_recovers_nothing_that_could_be_drawn(tmp_path: Path) -> None:
    words = ("compare", SLOW, *FEW, "--forecaster", "hold", "--out", tmp_path / "paper")
    assert run_here(*words).returncode == 0
    figures = names(files_in(tmp_path / "paper"), "figures", "pdf")
    assert not [name for name in figures if name.startswith("recovered")]
    assert "attributes-auc-synthetic-slow-recorded" in figures


def test_a_study_writes_figures_and_takes_old_ones_away(tmp_path: Path) -> None:
    study = tmp_path / "study.toml"
    study.write_text(f'traces = ["{SLOW}"]\nsequences = ["boat-calm", "car-chase"]\n')
    words = ("study", study, "--workers", 1, "--out", tmp_path / "out")
    assert run_here(*words).returncode == 0
    files = files_in(tmp_path / "out")
    figures = names(files, "figures", "pdf")
    assert {"success-synthetic", "precision-synthetic", "front-synthetic", "won"} < figures
    for kind in TABLES:
        assert {"ranking", "table2"} < names(files, "tables", kind)
    scores = pd.read_parquet(tmp_path / "out" / "tables" / "scores.parquet")
    for key in ("scale", "fps", "sigma", "auc"):
        assert scores[key].dtype == "float64"
    own = tmp_path / "out" / "figures" / "own.pdf"
    own.write_text("mine")
    assert run_here(*words, "--no-report").returncode == 0
    left = files_in(tmp_path / "out")
    assert names(left, "figures", "pdf") == {"own"}
    assert not names(left, "tables", "tex")
    assert "report.html" not in left


@pytest.mark.parametrize("command", ["replay", "compare"])
def test_what_cannot_be_the_folder_is_told_before_the_work(tmp_path: Path, command: str) -> None:
    (tmp_path / "notes").write_text("mine")
    done = run_here(command, SLOW, "--out", tmp_path / "notes")
    assert done.returncode == 2
    assert "notes: name a folder" in done.stderr
    done = run_here(command, SLOW, "--root", tmp_path, "--out", tmp_path)
    assert "would replace a file that is read" in done.stderr
    done = run_here(command, SLOW, "--out", tmp_path / "scores.txt")
    assert "scores.txt: name a folder" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]
