"""The benchmark that makes the figures of the forecasters."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from moving import cv2, moving, straight
from places import TRACES, benchmark

import lae_sim
from lae_sim import Metadata, Recording, Trace

SLOW = TRACES / "synthetic-slow.parquet"


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    return benchmark("forecasters")


@pytest.fixture(scope="module")
def few() -> Trace:
    """Two sequences of the sample trace."""
    trace = lae_sim.read_trace(SLOW)
    return Trace(trace.metadata, [trace["bike-pan"], trace["drone-fast"]])


@pytest.fixture
def one(every_frame: Metadata) -> Trace:
    """A sequence whose boxes and truth are told apart by their frames."""
    truth = straight(2000)
    return Trace(every_frame, [Recording.new("a", truth, truth + 0.5, np.full(2000, 30_000_000))])


@pytest.mark.parametrize(
    ("section", "lines"),
    [
        ("shares", 1),
        ("recorded", 2),
        ("conditions", 9),
        ("search", 10),
        ("early", 4),
    ],
)
def test_every_section_has_a_line_of_known_figures_per_setting(
    figures: ModuleType, few: Trace, section: str, lines: int
) -> None:
    asked = figures.SECTIONS[section]
    arguments = figures.Arguments({"few": few}, ["kalman"])
    rows = asked.measured(arguments)
    settings = len(figures.distinct(rows, "setting"))
    assert len(rows) == 2 * settings  # hold and kalman
    figure = "modelled_auc" if section == "search" else "auc"
    assert all(0 < row[figure] < row["offline_auc"] for row in rows if section != "early")
    printed = asked.printed(rows, arguments).splitlines()
    has_least = printed[-1].startswith("least over hold, AUC and DP: kalman ")
    assert has_least == (section in ("shares", "conditions"))
    assert len(printed) == 2 + lines + has_least
    assert "nan" not in "".join(printed)


def test_shares_are_those_of_a_replay(figures: ModuleType, few: Trace) -> None:
    rows = figures.SECTIONS["shares"].measured(figures.Arguments({"few": few}, ["kalman"]))
    found = lae_sim.evaluate(few, latency="constant:47ms", search="off").summary
    hold, kalman = found["auc"]
    (row,) = figures.of(rows, setting="47ms", forecaster="kalman")
    assert row["auc_over_hold"] == kalman - hold
    assert row["recovered_auc"] == found["recovered_auc"][1]


def test_times_jitter_around_their_mean(figures: ModuleType, one: Trace) -> None:
    (recording,) = one
    times = figures.Jittered(0.3)(recording).ns
    assert times[0] == 47_000_000
    assert times.mean() == pytest.approx(47e6, rel=0.03)
    assert times.std() == pytest.approx(0.3 * 47e6, rel=0.1)
    assert (figures.Jittered(0.0)(recording).ns == 47_000_000).all()


def test_dropped_frames_leave_the_others_at_their_times(figures: ModuleType, one: Trace) -> None:
    (whole,) = one
    (recording,) = figures.dropped(one, 0.3)
    assert len(recording) / len(whole) == pytest.approx(0.7, abs=0.03)
    frames = ((recording.truth[:, 0] - whole.truth[0, 0]) / 3).round().astype(int)
    assert (recording.arrival_ns == frames * 10**9 // 30).all()
    assert (recording.boxes == whole.boxes[frames]).all()
    assert frames[0] == 0


def test_a_slower_camera_has_every_so_manieth_frame(figures: ModuleType, one: Trace) -> None:
    thin = figures.thinned(one, 3)
    (whole,), (recording,) = one, thin
    assert thin.metadata.fps == 10
    assert (recording.boxes == whole.boxes[::3]).all()


def test_early_boxes_are_those_of_the_next_frame(figures: ModuleType, one: Trace) -> None:
    (whole,), (early,) = one, figures.shifted(one, 1)
    assert (early.boxes[0] == whole.boxes[0]).all()
    assert (early.boxes[1:-1] == whole.boxes[2:]).all()


def test_stand_ins_lose_as_much_as_what_was_published(figures: ModuleType, few: Trace) -> None:
    called = Metadata.of({**few.metadata.document, "dataset": {"name": "DTB70"}})
    arguments = figures.Arguments({"few": Trace(called, few.recordings)}, ["kalman"])
    rows = figures.beside_pvt_plus(arguments)
    assert len(rows) == 3 * 2 * 51
    lost = figures.of(rows, setting="as much lost", forecaster="hold", sigma=0)[0]
    slower = lae_sim.evaluate(few, latency=f"constant:{lost['call_ms'] + 1:g}ms").summary
    kept = 0.298 / 0.593 * lost["offline_auc"]
    assert slower["auc"][0] < kept <= lost["auc"]
    text = figures.published_and_stand_ins(rows, arguments)
    assert text.splitlines()[2].split()[-2:] == ["29", "34"]
    assert text.count("DTB70") == 1 + 3


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A folder with one dataset of one sequence of 12 frames."""
    boxes = straight(12)
    folder = tmp_path / "DTB70" / "Car1"
    (folder / "img").mkdir(parents=True)
    for number, frame in enumerate(moving(boxes), 1):
        cv2.imwrite(str(folder / "img" / f"{number:05}.jpg"), frame)
    np.savetxt(folder / "groundtruth_rect.txt", boxes, delimiter=",")
    return tmp_path


def test_sequences_with_frames_are_run_live_and_over_the_cameras_motion(
    figures: ModuleType, frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "searches", lambda names: [(None, False), ("kalman", True)])
    live = figures.Arguments({}, ["kalman"], frames)
    rows = figures.closed_loops(live)
    printed = figures.mean_scores(rows, live)
    assert "47ms, none " in printed
    assert "100ms, kalman, size kept" in printed
    assert len(rows) == 2 * 2 * 2

    boxes = straight(12)
    metadata = Metadata.new("30", "every-frame", dataset={"name": "DTB70"})
    recordings = [Recording.new(name, boxes, boxes, [1] * 12) for name in ("Car1", "Car2")]
    of_camera = figures.Arguments({"t": Trace(metadata, recordings)}, ["kalman"], frames)
    rows = figures.camera_motion(of_camera)
    assert figures.distinct(rows, "forecaster") == ["hold", "kalman", "camera+kalman"]
    assert figures.distinct(rows, "sequence") == ["Car1"]  # of the other there are no frames
    assert len(figures.mean_of_sequences(rows, of_camera).splitlines()) == 2 + 4


def test_a_sequences_mean_is_over_its_traces(figures: ModuleType) -> None:
    aucs: Any = [("a", 0.2), ("a", 0.4), ("b", 0.9)]
    rows = [
        {"setting": "47ms", "forecaster": "hold", "sequence": name, "auc": auc, "offline_auc": 1.0}
        for name, auc in aucs
    ]
    printed = figures.mean_of_sequences(rows, figures.Arguments({}, []))
    assert printed.splitlines()[-1].split() == ["47ms", "60.0", "100.0"]


def test_it_prints(
    figures: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["forecasters.py", str(SLOW), "--forecaster", "kalman", "--section", "recorded"]
    monkeypatch.setattr(sys, "argv", given)
    figures.main()
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].startswith(f"lae_sim {lae_sim.__version__}, weights of learned ")
    assert len(printed[-1].rpartition(" ")[2]) == 16
    assert ".572 / .666  .629 / .802  .777 / .970" in printed[4]
    monkeypatch.setattr(sys, "argv", [*given, "--json"])
    figures.main()
    rows = json.loads(capsys.readouterr().out)
    assert [row["forecaster"] for row in rows] == ["hold", "kalman"] * 2
    monkeypatch.setattr(sys, "argv", ["forecasters.py", "--section", "camera"])
    with pytest.raises(SystemExit, match="--frames FOLDER"):
        figures.main()
