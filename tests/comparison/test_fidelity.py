"""Closed loops of trackers that obey the search model by construction, against their replays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from restarted import gap_pass

from lae_sim.comparison.fidelity import (
    FidelityRow,
    closed_loop_spreads,
    compare_closed_loops,
    summarise_closed_loops,
    summarise_replays,
)
from lae_sim.engine.clock import Clock
from lae_sim.engine.scheduler import simulate
from lae_sim.errors import LaeError
from lae_sim.forecast.kalman import Kalman
from lae_sim.replay.names import parse_policy
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

MS = 1_000_000
REACH = 0.5
PRE = {"pre_forecaster": "kalman", "search": "native", "keep_size": False}
# the pixels that the target goes in a frame; its search side is 48, so a reach of .5 is 24 pixels
SPEEDS = {"fast": 14.0, "mid": 5.0}
LENGTH = 60


def truth(speed: float) -> np.ndarray:
    """A target of 24 x 24 pixels that goes right for 20 frames, then left, and so on."""
    x = 200 + speed * np.abs((np.arange(LENGTH) + 20) % 40 - 20)
    return np.stack([x, np.full(LENGTH, 50.0), np.full(LENGTH, 24.0), np.full(LENGTH, 24.0)], 1)


def every_frame(path: Path, speeds: Mapping[str, float] = SPEEDS, **more: Any) -> str:
    """A trace of every frame of a tracker that follows its target."""
    boxes = {name: truth(speed) for name, speed in sorted(speeds.items())}
    made = [Recording.new(n, b, b, np.full(LENGTH, 5 * MS)) for n, b in boxes.items()]
    return written(path, "every-frame", made, **more)


def closed_loop(
    path: Path,
    times: Callable[[int], int],
    speeds: Mapping[str, float] = SPEEDS,
    reach: float = REACH,
    pre_forecaster: bool = False,
    policy: str = "latest",
    **more: Any,
) -> str:
    """What a tracker answers that searches near its last answer, or where the filter says."""
    made = []
    for name, speed in sorted(speeds.items()):
        at = truth(speed)
        schedule = simulate(LENGTH, Clock.at(Fraction(30)), times, parse_policy(policy))
        boxes, elapsed = np.full((LENGTH, 4), np.nan), np.full(LENGTH, -1)
        elapsed[schedule.frames] = schedule.elapsed_ns
        answer = boxes[0] = at[0]
        kalman = Kalman(answer.tolist())
        for frame in schedule.frames[1:].tolist():
            searched = np.array(kalman.predict(frame)) if pre_forecaster else answer
            centre = searched[:2] + searched[2:] / 2
            side = np.sqrt((searched[2:] + searched[2:].mean()).prod())
            found = np.abs(at[frame, :2] + at[frame, 2:] / 2 - centre).max() < reach * side
            answer = boxes[frame] = at[frame] if found else searched
            kalman.update(frame, answer.tolist())
        made.append(Recording.new(name, at, boxes, elapsed))
    schedule_of = {"policy": policy, **(PRE if pre_forecaster else {})}
    return written(path, "real-time", made, schedule=schedule_of, **more)


def written(path: Path, kind: str, recordings: Sequence[Recording], **more: Any) -> str:
    more = {"tracker": {"name": "obeying"}, "dataset": {"name": "made"}, **more}
    write_trace(Trace(Metadata.new("30", kind, **more), recordings), path)
    return str(path)


def constant(ms: float, init: float | None = None) -> Callable[[int], int]:
    return lambda frame: round(MS * (ms if frame or init is None else init))


def by_kind(rows: Sequence[FidelityRow], sequence: str) -> dict[str, FidelityRow]:
    return {row.replay: row for row in rows if row.sequence == sequence}


def test_a_tracker_that_obeys_the_model_is_reproduced(tmp_path: Path) -> None:
    every = every_frame(tmp_path / "t.parquet")
    closed = closed_loop(tmp_path / "c.parquet", constant(60, init=300))
    rows = compare_closed_loops(every, [closed], search=f"c={REACH}")
    assert [(row.replay, row.sequence) for row in rows] == [
        (kind, name) for kind in ("every-frame", "modelled") for name in ("fast", "mid")
    ]
    fast, mid = by_kind(rows, "fast"), by_kind(rows, "mid")
    assert mid["every-frame"].d_auc > 0.05  # recorded boxes find the target again
    assert mid["every-frame"].parted is not None
    for row in (fast["modelled"], mid["modelled"]):
        assert row.d_auc == pytest.approx(0, abs=1e-12)
        assert row.d_dp20 == pytest.approx(0, abs=1e-12)
        assert row.parted is None
        assert row.approximate_outputs > 0
        assert row.auc_low < row.auc < row.auc_high
        assert row.covered is row.covered_dp20 is row.c_known is True
    for row in (fast["every-frame"], mid["every-frame"]):
        assert row.covered is row.auc_low is row.dp20_high is row.c_known is None
    wrong = by_kind(compare_closed_loops(every, [closed], search="c=inf"), "mid")["modelled"]
    assert wrong.covered is False
    assert wrong.auc == mid["every-frame"].auc


def test_an_exact_replay_is_its_own_interval(tmp_path: Path) -> None:
    every = every_frame(tmp_path / "t.parquet")
    closed = closed_loop(tmp_path / "c.parquet", constant(20), reach=np.inf)
    rows = compare_closed_loops(every, [closed], forecasters=("hold", "kalman"))
    modelled = [row for row in rows if row.replay == "modelled"]
    assert len(modelled) == 4
    for row in modelled:
        assert row.closed_auc == row.auc == row.auc_low == row.auc_high
        assert row.covered is True
        assert row.c_known is None
        assert row.approximate_outputs == 0


def test_an_unknown_reach_spans_a_range(tmp_path: Path) -> None:
    every = every_frame(tmp_path / "t.parquet")
    closed = closed_loop(tmp_path / "c.parquet", constant(60, init=300))
    rows = compare_closed_loops(every, [closed])
    assert {row.c_known for row in rows if row.replay == "modelled"} == {False}
    off = compare_closed_loops(every, [closed], search="off")
    assert {row.replay for row in off} == {"every-frame"}
    assert off == [row for row in rows if row.replay == "every-frame"]


def test_a_pre_forecaster_is_replayed_by_the_model(tmp_path: Path) -> None:
    every = every_frame(tmp_path / "t.parquet")
    loop = closed_loop(tmp_path / "c.parquet", constant(60), pre_forecaster=True)
    bare = closed_loop(tmp_path / "b.parquet", constant(60))
    rows = compare_closed_loops(every, [loop, bare], search=f"c={REACH}")
    modelled = [row for row in rows if row.replay == "modelled"]
    assert len(modelled) == 4
    for row in modelled:
        assert row.d_auc == pytest.approx(0, abs=1e-9)
    scores = {row.closed_loop: row.auc for row in modelled if row.sequence == "fast"}
    assert scores[loop] != scores[bare]
    settings = {row.setting for row in rows}
    assert {("pre-forecaster kalman" in setting) for setting in settings} == {True, False}


def test_a_trace_with_the_same_pre_forecaster_is_preferred(tmp_path: Path) -> None:
    every = every_frame(tmp_path / "t.parquet")
    searched = every_frame(tmp_path / "p.parquet", schedule=PRE)
    loop = closed_loop(tmp_path / "c.parquet", constant(60), pre_forecaster=True)
    bare = closed_loop(tmp_path / "b.parquet", constant(60))
    rows = compare_closed_loops([every, searched], [loop, bare])
    assert {(row.closed_loop, row.trace) for row in rows} == {(loop, searched), (bare, every)}
    assert {row.replay for row in rows if row.closed_loop == loop} == {"every-frame"}
    with pytest.raises(LaeError, match=r"schedule.pre_forecaster is None.*same tracker"):
        compare_closed_loops(searched, [bare])


def test_each_closed_loop_goes_with_the_trace_of_its_dataset(tmp_path: Path) -> None:
    parts: dict[str, list[str]] = {"traces": [], "passes": [], "closed": []}
    for dataset, speed in (("a", 14.0), ("b", 5.0)):
        speeds, more = {"car": speed}, {"dataset": {"name": dataset}}
        every = every_frame(tmp_path / f"{dataset}.parquet", speeds, **more)
        name = f"{dataset}.stride2.parquet"
        passed = every_frame(tmp_path / name, speeds, schedule={"stride": "2"}, **more)
        closed = closed_loop(tmp_path / f"{dataset}.c.parquet", constant(60), speeds, **more)
        for key, path in zip(parts, (every, passed, closed)):
            parts[key].append(path)
    rows = compare_closed_loops(
        parts["traces"], parts["closed"][::-1], passes=parts["passes"], search=f"c={REACH}"
    )
    assert [(row.closed_loop, row.trace) for row in rows[::3]] == [
        (closed, every) for every, closed in zip(parts["traces"], parts["closed"])
    ][::-1]
    assert [row.replay for row in rows] == ["every-frame", "strided", "modelled"] * 2
    alone = [
        row
        for every, passed, closed in zip(*parts.values())
        for row in compare_closed_loops(every, [closed], passes=[passed], search=f"c={REACH}")
    ]
    assert alone == [*rows[3:], *rows[:3]]
    assert len(summarise_closed_loops(rows)) == 6
    assert [each.sequences for each in summarise_replays(rows)] == [2, 2, 2]


def test_traces_that_do_not_go_together_are_told(tmp_path: Path) -> None:
    every = every_frame(tmp_path / "t.parquet")
    again = every_frame(tmp_path / "u.parquet")
    other = every_frame(tmp_path / "o.parquet", dataset={"name": "other"})
    strange = every_frame(tmp_path / "s.parquet", tracker={"name": "strange"})
    closed = closed_loop(tmp_path / "c.parquet", constant(60))
    for traces, passes, message in (
        ([every, again], (), r"t.parquet, .*u.parquet are of its tracker .*give one"),
        ([other, strange], (), "c.parquet: none of the traces"),
        ([every, other], [strange], "s.parquet: none of the traces"),
        (every, [strange], "tracker.name is 'strange'.*same tracker"),
        (strange, (), "tracker.name is 'obeying'.*same tracker"),
        (every, [closed], "not real-time"),
        (closed, (), "not real-time"),
    ):
        with pytest.raises(LaeError, match=message):
            compare_closed_loops(traces, [closed], passes=passes)
    gaps = str(gap_pass(read_trace(every).metadata, tmp_path / "g.parquet"))
    for path, kind in ((every, "every-frame"), (gaps, "restarts")):
        with pytest.raises(LaeError, match=f"of kind {kind} is no closed loop"):
            compare_closed_loops(every, [path])
    with pytest.raises(LaeError, match=r"g\.parquet: a gap pass goes to --strided"):
        compare_closed_loops(gaps, [closed])


def test_closed_loops_of_like_times_are_of_one_setting(tmp_path: Path) -> None:
    every = every_frame(tmp_path / "t.parquet")

    def jittered(seed: int) -> Callable[[int], int]:
        random = np.random.default_rng(seed)
        return lambda frame: round(47 * MS * (1 + 0.02 * random.standard_normal()))

    repeats = [closed_loop(tmp_path / f"r{n}.parquet", jittered(n)) for n in range(3)]
    others = [
        closed_loop(tmp_path / "c53.parquet", constant(53)),
        closed_loop(tmp_path / "init.parquet", constant(47, init=60)),
        closed_loop(tmp_path / "fifo.parquet", constant(47), policy="fifo"),
    ]
    rows = compare_closed_loops(every, [*repeats, *others])
    settings = {row.closed_loop: row.setting for row in rows}
    assert len({settings[path] for path in repeats}) == 1
    assert len(set(settings.values())) == 4
    assert settings[others[0]] == "53 ms, init 53 ms, 30 fps, latest"
    spreads = closed_loop_spreads(rows)
    assert [(each.sequence, each.closed_loops) for each in spreads] == [("fast", 3), ("mid", 3)]
    for each in spreads:
        scores = {
            row.closed_loop: row.closed_auc
            for row in rows
            if row.sequence == each.sequence and row.closed_loop in repeats
        }
        assert each.spread == max(scores.values()) - min(scores.values())
        assert (each.auc_low, each.auc_high) == (min(scores.values()), max(scores.values()))


def test_a_sequence_without_a_score_is_in_no_mean(tmp_path: Path) -> None:
    speeds = {"fast": 14.0}
    every = every_frame(tmp_path / "t.parquet", speeds)
    closed = closed_loop(tmp_path / "c.parquet", constant(60), speeds)
    (row, *_) = compare_closed_loops(every, [closed], search=f"c={REACH}")
    unknown = FidelityRow(**{**vars(row), "auc": np.nan, "d_auc": np.nan})
    (summary,) = summarise_replays([row, unknown])
    assert summary.sequences == 2
    assert summary.mean_abs_d_auc == abs(row.d_auc)
    assert summary.covered is None
    assert not isnan(summary.auc)
    (summary,) = summarise_replays([unknown])  # without a warning
    assert isnan(summary.auc)
    assert isnan(summary.max_abs_d_auc)
