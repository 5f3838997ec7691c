"""Whole profiles, from Python."""

from __future__ import annotations

import os
import shutil
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fakes import bright_frame

from lae_sim.api.evaluation import evaluate
from lae_sim.comparison.fidelity import compare_closed_loops, summarise_closed_loops
from lae_sim.errors import LaeError
from lae_sim.profile.passes import Failure
from lae_sim.profile.run import Profile, ProfilePlan, profile_tracker, run_profile
from lae_sim.trace.file import read_trace

LENGTH = 20


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Settings of a quick profile, of a short sequence of small images."""
    root = tmp_path_factory.mktemp("data")
    folder = root / "race" / "img"
    folder.mkdir(parents=True)
    for i in range(LENGTH):
        cv2.imwrite(str(folder / f"{i + 1:04}.png"), bright_frame(5 + 2 * i, 20, size=(80, 64)))
    boxes = [f"{5 + 2 * i},20,12,10\n" for i in range(LENGTH)]
    (root / "race" / "groundtruth_rect.txt").write_text("".join(boxes))
    return {"root": root, "in_process": True, "warmup": 0}


def test_text_and_numbers_make_a_plan() -> None:
    plan = ProfilePlan.of(
        fps="30000/1001",
        strides=["3/2", 2],
        frame_timeout="600ms",
        pre_forecaster="kalman",
        pre_forecaster_cost="measured",
    )
    assert plan.fps == Fraction(30000, 1001)
    assert plan.strides == (Fraction(3, 2), Fraction(2))
    assert plan.frame_timeout == 600_000_000
    assert plan.pre_forecaster_cost is None
    assert ProfilePlan.of(fps=29.97).fps == Fraction(2997, 100)
    assert not plan.real_time
    assert ProfilePlan(timing="constant:47ms").real_time


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"strides": [1]}, "above 1"),
        ({"fps": 0}, "above zero"),
        ({"frame_timeout": "30"}, "unit"),
        ({"mode": "fast"}, "mode: no 'fast': there are every-frame and real-time"),
        ({"mode": "every-frame", "policy": "fifo"}, "real-time"),
        ({"mode": "real-time", "strides": [2]}, "every-frame"),
        ({"keep_size": True}, "pre_forecaster"),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(LaeError, match=message):
        ProfilePlan.of(**settings)


def test_passes_progress_and_closed_loops(tmp_path: Path, quick: dict[str, Any]) -> None:
    progress: list[tuple[int, int]] = []
    notices: list[str] = []
    out = tmp_path / "t.parquet"
    out.write_bytes(b"")
    profile = run_profile(
        ProfilePlan.of(tracker="dcf", closed_loops=["constant:100ms"], **quick),
        out,
        progress=lambda done, total: progress.append((done, total)),
        notice=notices.append,
    )
    assert notices == [f"{out} will be replaced"]
    frames = len(next(iter(read_trace(out))))
    assert progress[0] == (0, 2 * frames)
    assert progress[-1] == (2 * frames, 2 * frames)
    assert profile.failures == ()
    first, closed = profile.traces
    assert (first.processed, first.schedule["kind"]) == (frames, "every-frame")
    assert (closed.timing, closed.schedule["kind"]) == ("constant 100ms, not measured", "real-time")
    rows = compare_closed_loops(first.trace, [closed.trace], forecasters=["hold", "kalman"])
    assert [(row.forecaster, row.replay, row.sequence) for row in rows] == [
        (forecaster, replay, "race")
        for replay in ("every-frame", "modelled")
        for forecaster in ("hold", "kalman")
    ]
    for row, summary in zip(rows, summarise_closed_loops(rows), strict=True):
        assert row.d_auc == row.auc - row.closed_auc
        assert summary.sequences == 1
        assert summary.auc == row.auc
        assert summary.median_abs_d_auc == abs(row.d_auc)
    notices.clear()
    assert run_profile(ProfilePlan(), out, resume=True, notice=notices.append).traces == ()
    assert "nothing to resume" in notices[0]


def test_a_profile_in_one_call(
    tmp_path: Path, quick: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "t.parquet"
    settings = {**quick, "sequences": "race", "warmup": "0", "strides": 1.5}
    profile = profile_tracker("dcf", out=out, fps=29.97, **settings)
    assert capsys.readouterr() == ("", "")  # nobody looks
    first, strided = profile.traces
    assert (first.trace, strided.trace) == (str(out), str(tmp_path / "t.stride3-2.parquet"))
    trace = read_trace(out)
    assert (trace.metadata.fps, trace.names) == (Fraction(2997, 100), ("race",))
    assert read_trace(strided.trace).metadata.stride == Fraction(3, 2)
    times = trace["race"].elapsed_ns[1:] / 1e6
    assert repr(profile).startswith(
        f"<Profile of {out}: 1 sequence, median {np.median(times):.3g} ms; {strided.trace}: "
    )
    table = profile.to_frame()
    assert list(table["trace"]) == [first.trace, strided.trace]
    assert table["median_ms"].iloc[0] == np.median(times)
    assert profile._repr_html_().startswith("<table")
    assert "failed" not in repr(profile)


def test_a_profile_shows_its_progress_and_says_what_to_know(
    tmp_path: Path, quick: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "t.parquet"
    profile_tracker("dcf", out=out, progress=True, **quick)
    said, shown = capsys.readouterr()
    assert said == ""
    assert f"{LENGTH:.1f}/{LENGTH:.1f}" in shown
    again = profile_tracker("dcf", out=out, progress=True, resume=True, **quick)
    assert "nothing to resume" in capsys.readouterr().err
    assert repr(again) == "<Profile: nothing was left to do>"


def test_an_interruption_before_anything_is_complete_leaves_nothing(
    tmp_path: Path, quick: dict[str, Any]
) -> None:
    def interrupt(done: int, total: int) -> None:
        if done > LENGTH / 2:
            raise KeyboardInterrupt

    notices: list[str] = []
    plan, out = ProfilePlan.of(**quick), tmp_path / "t.parquet"
    with pytest.raises(KeyboardInterrupt):
        run_profile(plan, out, progress=interrupt, notice=notices.append)
    assert notices == ["no sequence is complete yet: nothing is kept"]
    assert not list(tmp_path.iterdir())
    assert len(run_profile(plan, out).traces) == 1


def test_passes_that_fail_alike_say_so_once(
    tmp_path: Path, quick: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "failing_tracker.py").write_text(
        "class Failing:\n"
        "    def init(self, frame, box): pass\n"
        "    def track(self, frame): return False, (1, 2, 3, 4)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    notices: list[str] = []
    settings = {**quick, "warmup": 2, "strides": [2, 3]}
    plan = ProfilePlan.of(tracker="failing_tracker:Failing", **settings)
    with pytest.raises(LaeError, match="no sequence could be profiled"):
        run_profile(plan, tmp_path / "t.parquet", notice=notices.append)
    [said] = [each for each in notices if each.startswith("failed: ")]
    assert said.endswith("; of OpenCV's (found, box) answer the box, or None if it is not found")


def test_images_that_change_size(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="frames are decoded with OpenCV")
    folder = tmp_path / "data" / "car"
    (folder / "img").mkdir(parents=True)
    for frame in range(9):
        width, height = (160, 120) if frame < 5 else (100, 90)
        image = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
        cv2.imwrite(str(folder / "img" / f"{frame}.png"), image[:height, :width])
    (folder / "groundtruth_rect.txt").write_text("40,30,30,20\n" * 9)
    notes: list[str] = []
    plan = ProfilePlan.of(tracker="dcf", root=tmp_path / "data", in_process=True, strides=[2])
    profile = run_profile(plan, tmp_path / "dcf.parquet", notice=notes.append)
    assert "images of 1 sequences change size, such as those of 'car'" in notes[-1]
    for summary in profile.traces:
        entry = read_trace(summary.trace).metadata.document["sequences"]["car"]
        assert entry["image_size"] == [160, 120]
        assert entry["image_sizes"] == [[0, 160, 120], [5, 100, 90]]
    result = evaluate(tmp_path / "dcf.parquet", forecasters="kalman-lae-pvt")
    assert any("images of 1 of 1 sequences change size" in note for note in result.notes)


def test_a_failure_shows_in_html_as_text() -> None:
    failed = Profile((), (Failure("<b>", "<script>"),))
    assert "<script>" not in failed._repr_html_()
    assert "failed: &lt;b&gt;: &lt;script&gt;" in failed._repr_html_()


def test_flags_of_absence_are_profiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "still.py").write_text(
        "class Still:\n"
        "    def init(self, frame, box):\n"
        "        self.box = list(box)\n"
        "    def track(self, frame):\n"
        "        return self.box\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for name, flags in (("a", None), ("b", "0,1,0,0"), ("c", "0,1")):
        folder = tmp_path / "data" / name
        (folder / "img").mkdir(parents=True)
        for i in range(4):
            cv2.imwrite(str(folder / "img" / f"{i + 1:04}.png"), np.zeros((40, 60, 3), np.uint8))
        (folder / "groundtruth.txt").write_text("10,10,20,20\n" * 4)
        if flags is not None:
            (folder / "full_occlusion.txt").write_text(flags)
    notices: list[str] = []
    plan = ProfilePlan.of(
        tracker="still:Still", root=tmp_path / "data", in_process=True, strides=[2]
    )
    profile = run_profile(plan, tmp_path / "t.parquet", notice=notices.append)
    [note] = [note for note in notices if "flags of absence" in note]
    assert note.startswith("flags of absence of 1 of 3 sequences are left out")
    assert "full_occlusion.txt: 2 flags, and there are 4 frames" in note
    for each in profile.traces:
        trace = read_trace(each.trace)
        assert trace.columns == {"visible"}
        assert trace.metadata.document["version"] == "1.1"
        a, b, c = trace
        assert (a.visible, c.visible) == (None, None)
        assert b.visible is not None
        assert b.visible.tolist() == [True, False, True, True]


@pytest.mark.parametrize(
    ("said", "problem"),
    [
        ("{'settings': {'lr': float('nan')}}", "NaN is not JSON"),
        ("{'settings': {'lr': float('-inf')}}", "-Infinity is not JSON"),
        ("{'version': '1.0\\x1b[2J'}", "'tracker.version' holds the control character"),
    ],
)
def test_what_a_tracker_says_of_itself_must_fit_a_trace(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    quick: dict[str, Any],
    said: str,
    problem: str,
) -> None:
    (tmp_path / "odd.py").write_text(
        "class Odd:\n"
        "    def init(self, frame, box):\n"
        "        pass\n"
        "    def track(self, frame):\n"
        "        return [1, 2, 3, 4]\n"
        "    def describe(self):\n"
        f"        return {said}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "odd", raising=False)
    with pytest.raises(LaeError, match=r"^odd:Odd: what describe\(\) says") as caught:
        run_profile(ProfilePlan.of(tracker="odd:Odd", **quick), tmp_path / "t.parquet")
    assert problem in str(caught.value)
    assert sorted(path.name for path in tmp_path.glob("t.*")) == []


def test_a_sequence_that_no_trace_can_name_is_refused_before_anything_is_run(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "data" / "a\x1b[2J"
    (folder / "img").mkdir(parents=True)
    cv2.imwrite(str(folder / "img" / "1.png"), np.zeros((40, 60, 3), np.uint8))
    (folder / "groundtruth.txt").write_text("10,10,20,20\n")
    plan = ProfilePlan.of(root=tmp_path / "data", in_process=True)
    with pytest.raises(LaeError, match=r"the name holds the control character .*: rename it"):
        run_profile(plan, tmp_path / "t.parquet")


def test_a_name_that_no_trace_can_hold_is_refused_before_the_work(
    tmp_path: Path, quick: dict[str, Any]
) -> None:
    root = tmp_path / "data"
    shutil.copytree(quick["root"], root)
    try:
        os.rename(os.fsencode(root / "race"), os.fsencode(root) + b"/bad\xff")
    except OSError:
        pytest.skip("this disk has names of Unicode text only")
    with pytest.raises(LaeError, match=r"sequence 'bad.udcff': the name is not Unicode text"):
        profile_tracker("dcf", out=tmp_path / "t.parquet", **{**quick, "root": root})
    assert os.listdir(tmp_path) == ["data"]
