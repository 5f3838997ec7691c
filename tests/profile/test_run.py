"""Whole profiles, from Python."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from lae_sim.comparison.fidelity import compare_closed_loops, summarise_closed_loops
from lae_sim.errors import LaeError
from lae_sim.profile.run import ProfilePlan, run_profile
from lae_sim.trace.file import read_trace

QUICK = {"sequences": ["race"], "in_process": True, "warmup": 0}


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


def test_passes_progress_and_closed_loops(tmp_path: Path) -> None:
    progress: list[tuple[int, int]] = []
    notices: list[str] = []
    out = tmp_path / "t.parquet"
    out.write_bytes(b"")
    profile = run_profile(
        ProfilePlan.of(tracker="dcf", closed_loops=["constant:100ms"], **QUICK),
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
        ("hold", "every-frame", "race"),
        ("kalman", "every-frame", "race"),
    ]
    for row, summary in zip(rows, summarise_closed_loops(rows), strict=True):
        assert row.d_auc == row.auc - row.closed_auc
        assert summary.sequences == 1
        assert summary.auc == row.auc
        assert summary.median_abs_d_auc == abs(row.d_auc)
    notices.clear()
    assert run_profile(ProfilePlan(), out, resume=True, notice=notices.append).traces == ()
    assert "nothing to resume" in notices[0]
