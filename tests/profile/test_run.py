"""Whole profiles, from Python."""

from __future__ import annotations

import os
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fakes import bright_frame

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


def test_a_failure_shows_in_html_as_text() -> None:
    failed = Profile((), (Failure("<b>", "<script>"),))
    assert "<script>" not in failed._repr_html_()
    assert "failed: &lt;b&gt;: &lt;script&gt;" in failed._repr_html_()


def test_a_name_that_no_trace_can_hold_is_refused_before_the_work(
    tmp_path: Path, quick: dict[str, Any]
) -> None:
    root = tmp_path / "data"
    shutil.copytree(quick["root"], root)
    try:
        os.rename(os.fsencode(root / "race"), os.fsencode(root) + b"/bad\xff")
    except OSError:
        pytest.skip("this disk has names of Unicode text only")
    with pytest.raises(LaeError, match=r"sequence 'bad.udcff' has a name that no trace can hold"):
        profile_tracker("dcf", out=tmp_path / "t.parquet", **{**quick, "root": root})
    assert os.listdir(tmp_path) == ["data"]
