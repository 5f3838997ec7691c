"""The benchmark that stands public boxes beside the paper's tables."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from places import TRACES, benchmark

import lae_sim


@pytest.fixture(scope="module")
def paper() -> ModuleType:
    return benchmark("paper_tables")


@pytest.fixture
def dtb70(shared_data: Path, tmp_path: Path) -> Path:
    """The data of one dataset alone, which is fast."""
    (tmp_path / "results_boxes").mkdir()
    for part in ("DTB70", "results_boxes/DTB70"):
        (tmp_path / part).symlink_to(shared_data / part)
    return tmp_path


def test_the_published_figures_are_copied_right(paper: ModuleType, shared_data: Path) -> None:
    figures = {(each.dataset, each.tracker): each for each in paper.published()}
    assert len(figures) == 24
    rows = list(csv.DictReader((shared_data / "paper_lae.csv").read_text().splitlines()))
    for row in rows:
        found = figures[row["dataset"], row["tracker"]]
        name = "figure" if row["source"] == "figure" else row["forecasters"]
        assert found.scores[name] == (float(row["auc"]), float(row["dp20"]))
        if row["fps"]:
            assert found.fps == float(row["fps"])
    assert len(rows) == sum(len(each.scores) - 1 for each in figures.values())  # without offline


@pytest.mark.parametrize(
    ("boxes", "fps", "init_ms", "reach", "expected"),
    [
        ("SiamAPN", 21.2, 400, 0.85, {"none": (0.299, 0.397), "post": (0.361, 0.499)}),
        ("NanoTrackV3", 6.0, 500, 0.7, {"none": (0.142, 0.188), "both": (0.201, 0.267)}),
    ],
)
def test_prototypes(
    paper: ModuleType,
    shared_data: Path,
    boxes: str,
    fps: float,
    init_ms: int,
    reach: float,
    expected: dict[str, tuple[float, float]],
) -> None:
    trace = paper.read_boxes(shared_data, "DTB70", boxes)
    found = paper.replayed(trace, fps, init_ms, [reach])
    for row, scores in expected.items():
        assert found[row][0] == pytest.approx(scores, abs=0.002)


def test_all_four_rows_of_table_3_from_one_initialisation_and_one_reach(
    paper: ModuleType, shared_data: Path
) -> None:
    (mob,) = (
        each
        for each in paper.published()
        if (each.dataset, each.tracker) == ("DTB70", "SiamRPN++_mob")
    )
    init_ms, reach = paper.ASSUMED[mob.tracker]
    trace = paper.read_boxes(shared_data, "DTB70", mob.stand_in)
    found = paper.replayed(trace, mob.fps, init_ms, [reach])
    for row in paper.ROWS:
        assert found[row][0] == pytest.approx(mob.scores[row], abs=0.015)


def test_several_reaches_at_once_are_what_replays_of_each_say(paper: ModuleType) -> None:
    trace = lae_sim.read_trace(TRACES / "synthetic-slow.parquet")
    reaches = [0.3, 0.7, np.inf]
    found = paper.replayed(trace, 10, 400, reaches)
    for pre, rows in ((None, ("none", "post")), ("kalman", ("pre", "both"))):
        for c, reach in enumerate(reaches):
            summary = lae_sim.evaluate(
                trace,
                latency="constant:100ms,init=400ms",
                forecasters=("hold", "kalman"),
                search=f"c={reach}",
                pre_forecaster=pre,
                keep_size=pre is not None,
            ).summary
            for row, said in zip(rows, summary.itertuples()):
                expected = (said.modelled_auc, said.modelled_dp20)
                assert found[row][c] == pytest.approx(expected, abs=1e-12)
                if reach == np.inf:
                    assert expected == pytest.approx((said.auc, said.dp20), abs=1e-12)
    assert found["none"][0, 0] < found["none"][2, 0]


def test_the_benchmark_prints(
    paper: ModuleType,
    dtb70: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(paper, "INITS", (200, 400))
    monkeypatch.setattr(paper, "REACHES", (0.45, 0.85))
    monkeypatch.setattr(sys, "argv", ["paper_tables.py", "--data", str(dtb70)])
    paper.main()
    shown = capsys.readouterr().out
    assert "0.305/0.387  0.402/0.556" in shown  # the paper, and a replay without init and c
    assert "Table III, 4 figures: best 200 ms, c = 0.45" in shown
    assert "UAV123" not in shown
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--json"])
    paper.main()
    found = json.loads(capsys.readouterr().out)
    assert len(found["comparison"]) == 4 * 4 + 4
    assert np.shape(found["family"]["difference"]) == (9, 2, 2)


def test_without_boxes_it_says_which(
    paper: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["paper_tables.py", "--data", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"no boxes of a stand-in.*SiamAPN\.npz"):
        paper.main()
