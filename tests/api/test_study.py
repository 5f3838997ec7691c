"""Running studies in one call."""

from __future__ import annotations

import json
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from nasty import nasty_traces
from places import TRACES

import lae_sim
from lae_sim.cli.study import main
from lae_sim.errors import LaeError

SLOW, FAST = TRACES / "synthetic-slow.parquet", TRACES / "synthetic-fast.parquet"
TOML = """
traces = ["synthetic-slow.parquet"]
scales = [0.1, 1]
"""


@pytest.fixture
def results(tmp_path: Path) -> lae_sim.StudyResults:
    return lae_sim.run_study(
        traces=[SLOW, str(FAST)], scales=[0.1, 1], folder=tmp_path / "out", workers=1
    )


def test_scores_are_those_of_evaluating(results: lae_sim.StudyResults) -> None:
    assert results.plan.study.scales == (Fraction(1, 10), 1)
    evaluated = lae_sim.evaluate([SLOW, FAST], scale=[0.1, 1])
    summary = results.summary_frame()
    assert len(summary) == len(evaluated.summary) == 8
    for row in evaluated.summary.itertuples():
        (found,) = [
            each
            for each in results.summary
            if f"{each.trace}.parquet" == row.trace
            and each.forecaster == row.forecaster
            and float(each.scale) == row.scale
        ]
        assert found.scores["auc"] == pytest.approx(row.auc, abs=1e-12)
        assert found.offline["auc"] == pytest.approx(row.offline_auc, abs=1e-12)
        assert found.exact == row.exact
    assert len(results.to_frame()) == len(evaluated.to_frame())


def test_the_times_of_stages_are_a_latency_of_a_study(tmp_path: Path) -> None:
    staged = TRACES / "cases" / "valid" / "stages.parquet"
    latencies = ["recorded", "stage:decode,init=60ms", "stage:warp"]
    results = lae_sim.run_study(
        traces=[staged], latencies=latencies, forecasters="hold", folder=tmp_path, workers=1
    )
    (lacking,) = results.failures
    assert "no times of stage 'warp'" in lacking.reason
    evaluated = [
        lae_sim.evaluate(staged, latency=each, forecasters="hold") for each in latencies[:2]
    ]
    expected = {row.latency: row.auc for each in evaluated for row in each.summary.itertuples()}
    found = {row.latency: row.scores["auc"] for row in results.summary}
    assert found == pytest.approx(expected, abs=1e-12)
    assert len(set(found.values())) == 2


def test_what_is_left_in_the_folder(results: lae_sim.StudyResults) -> None:
    folder = results.folder
    assert (folder / "report.html").is_file()
    assert (folder / "tables" / "ranking.tex").is_file()
    document = json.loads((folder / "study.json").read_text())
    assert document == json.loads(json.dumps(results.document()))
    again = lae_sim.run_study(results.plan.study, folder, workers=1, report=False)
    assert (results.computed, again.computed) == (8, 0)
    assert not (folder / "report.html").exists()
    pd.testing.assert_frame_equal(again.to_frame(), results.to_frame())


def test_a_file_a_mapping_and_keys_are_the_same_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(SLOW, tmp_path)
    (tmp_path / "mine.toml").write_text(TOML)
    monkeypatch.chdir(tmp_path)
    from_file = lae_sim.run_study(Path("mine.toml"), workers=1, report=False)
    assert from_file.folder == Path("mine-results")
    keys = {"traces": "synthetic-slow.parquet", "scales": [0.1, 1]}
    from_mapping = lae_sim.run_study(keys, workers=1, report=False)
    assert from_mapping.folder == Path("study-results")
    from_keys = lae_sim.run_study(**keys, folder="third", workers="1", report=False)
    made = lae_sim.run_study(lae_sim.Study(**keys), "fourth", workers=1, report=False)
    for each in (from_mapping, from_keys, made):
        assert each.plan.study.scales == from_file.plan.study.scales
        pd.testing.assert_frame_equal(each.to_frame(), from_file.to_frame())


def test_an_open_trace_stands_for_its_file(tmp_path: Path) -> None:
    trace = lae_sim.read_trace(SLOW)
    results = lae_sim.run_study(traces=trace, folder=tmp_path / "out", workers=1, report=False)
    assert [source.input.path for source in results.plan.sources] == [str(SLOW)]


def test_a_video_without_truth_has_a_report_of_its_times(tmp_path: Path) -> None:
    trace = lae_sim.read_trace(SLOW, ["boat-calm"])
    [one] = trace
    one.truth[1:] = float("nan")
    path = tmp_path / "video.parquet"
    lae_sim.write_trace(lae_sim.Trace(trace.metadata, [one]), path)
    results = lae_sim.run_study(
        traces=path, scales=[0.5, 1], folder=tmp_path / "out", workers=1, require_auc=0.5
    )
    assert results.to_frame()["auc"].isna().all()
    assert "no ground truth after the first frame" in " ".join(results.notes())
    assert not any("measure c" in note for note in results.notes())
    figures = [path.stem for path in (results.folder / "figures").glob("*.pdf")]
    assert any(name.startswith("times-") for name in figures)
    assert not any(name.startswith("success-") for name in figures)


def test_displays(results: lae_sim.StudyResults) -> None:
    assert repr(results) == f"<StudyResults of 8 settings, 8 cells in {results.folder}>"
    html = results._repr_html_()
    assert html.startswith("<table")
    assert "<th>scale</th>" in html
    assert "<th>policy</th>" not in html


def test_html_escapes_names(tmp_path: Path) -> None:
    results = lae_sim.run_study(
        traces=nasty_traces(tmp_path), folder=tmp_path / "out", workers=1, report=False
    )
    assert "<script" not in results._repr_html_()
    assert "<script>alert" not in repr(results)


def test_a_progress_bar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys = {"traces": SLOW, "workers": 1, "report": False}
    lae_sim.run_study(**keys, folder=tmp_path / "a")
    assert capsys.readouterr() == ("", "")
    lae_sim.run_study(**keys, folder=tmp_path / "b", progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "100%" in err
    told = []
    lae_sim.run_study(**keys, folder=tmp_path / "c", progress=lambda *each: told.append(each))
    done, total, what = told[-1]
    assert (done, what) == (total, "summing up")
    assert [each[:2] for each in told[:-1]] == [(k, total) for k in range(1, total + 1)]


OWN = """
class Ahead:
    def __init__(self, box, image_size=None):
        self.box = box
    def update(self, frame, box):
        self.box = box
    def predict(self, frame):
        return self.box

def latest(clock, calls):
    last, _, now = calls[-1]
    frame = max(last + 1, clock.newest(now))
    return frame, max(now, clock.arrival(frame))
"""


def test_the_report_shows_frames_and_knows_what_lies_beside_the_study(tmp_path: Path) -> None:
    (tmp_path / "study_of_own.py").write_text(OWN)
    truth = np.array([[5 + frame, 10, 12, 8] for frame in range(20)], float)
    for folder in ("data/walk/img", "elsewhere"):
        (tmp_path / folder).mkdir(parents=True)
    for frame in range(20):
        image = np.full((40, 64, 3), 10 * frame, np.uint8)
        cv2.imwrite(str(tmp_path / f"data/walk/img/{frame + 1:05d}.jpg"), image)
    np.savetxt(tmp_path / "data/walk/groundtruth_rect.txt", truth, "%g", ",")
    recording = lae_sim.Recording.new("walk", truth, truth, [50_000_000] * 20)
    metadata = lae_sim.Metadata.new(30, "every-frame", dataset={"name": "walks"})
    lae_sim.write_trace(lae_sim.Trace(metadata, [recording]), tmp_path / "walk.parquet")
    study = tmp_path / "study.toml"
    study.write_text(
        'traces = "walk.parquet"\nforecasters = ["hold", "study_of_own:Ahead"]\n'
        'policies = ["study_of_own:latest"]\nsearch = "off"\n'
    )
    results = lae_sim.run_study(study, tmp_path / "out", workers=1, root=tmp_path / "data")
    assert not results.failures
    text = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "those from 0 to 19" in text
    assert text.count('href="data:image/jpeg;base64,') == 1
    lae_sim.write_report(results, tmp_path / "bare.html")
    bare = (tmp_path / "bare.html").read_text("utf-8")
    assert "without frames" in bare
    assert "image/jpeg" not in bare.partition("<script>")[0]
    assert main(f"{study} --out {tmp_path / 'out'} --root {tmp_path / 'none'}".split()) == 2


@pytest.mark.parametrize(("root", "told"), [(3, "root: a path"), ("none", "root: there is no")])
def test_a_root_that_is_none(root: Any, told: str, tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=told):
        lae_sim.run_study(traces=SLOW, folder=tmp_path / "out", root=root)
    assert not (tmp_path / "out").exists()
