"""Replays in batches and in repetitions: field for field those made one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from witness import moving

from lae_sim.engine import lanes as batch
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, latest, vot_realtime
from lae_sim.engine.scheduler import Call, Policy, Service
from lae_sim.errors import LaeError
from lae_sim.replay import run
from lae_sim.replay.latency import (
    LatencySource,
    bootstrap,
    by_call,
    by_frame,
    constant,
    lognormal,
    resampled,
    scaled,
)
from lae_sim.replay.run import (
    Repetitions,
    Run,
    Runs,
    grouped,
    replay_repeated,
    replay_sequence,
    replay_together,
)
from lae_sim.replay.world import replay_trace
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import BESIDE, Recording, batched

NAMES = [f"s{i:02}" for i in range(12)]
EVERY = Metadata.new("30", "every-frame")
TRACE = Trace(EVERY, [moving(20 + 7 * i, i, name) for i, name in enumerate(NAMES)])
SLOWER = Trace(EVERY, [moving(len(r), 99, r.name, 120_000_000) for r in TRACE])


def fields(run: Run) -> list[object]:
    """All of a run, to the byte."""
    schedule = run.schedule
    arrays = (schedule.frames, schedule.start, schedule.ready, run.boxes)
    return [
        run.recording.name,
        schedule.clock,
        schedule.length,
        *((array.dtype, array.shape, array.tobytes()) for array in arrays),
        run.departures,
        repr(run.disagreement),
    ]


@pytest.fixture(params=["one group", "small groups"])
def groups(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "small groups":
        monkeypatch.setattr(batch, "_CELLS", 500)
        monkeypatch.setattr(run, "_GROUP_FRAMES", 300)
        monkeypatch.setattr(run, "_LANE_FRAMES", 800)


def backwards_at_40(clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
    last, _, now = calls[-1]
    return (last + 1 if last < 40 else 0), max(now, (last + 1) * clock.frame_ticks)


@pytest.mark.usefixtures("groups")
@pytest.mark.parametrize("policy", [latest, every(2), vot_realtime()])
@pytest.mark.parametrize(
    "source", [by_frame, by_call, constant(ns=47_000_000), scaled(bootstrap(3), Fraction(2))]
)
def test_a_batch_gives_the_same_runs(source: LatencySource, policy: Policy) -> None:
    half = Trace(replace(EVERY, document={**EVERY.document, "schedule": {
        "kind": "every-frame", "stride": "2"}}), SLOWER.recordings)  # fmt: skip
    assert half.metadata.stride == 2
    for options in ({}, {"timing": SLOWER}, {"passes": [half]}, {"fps": Fraction(30000, 1001)}):
        runs = replay_trace(TRACE, latency=source, policy=policy, **options)  # type: ignore[arg-type]
        assert [fields(r) for r in runs] == [fields(r) for r in in_simpy(runs)]


@pytest.mark.usefixtures("groups")
def test_replays_together_are_what_they_are_alone() -> None:
    replays = [
        replay_trace(TRACE),
        replay_trace(SLOWER, latency=constant(ns=47_000_000)),
        replay_trace(TRACE, fps=Fraction(25)),
        replay_trace(TRACE, policy=every(2)),
        replay_trace(TRACE, latency=lambda recording: by_frame(recording).__call__),
    ]
    alone = [(k, fields(run)) for k, runs in enumerate(replays) for run in in_simpy(runs)]
    for frames in (1, 200, 10**6):
        together = replay_together(replays, frames)
        assert [(k, fields(run)) for k, batch in together for run in batch] == alone


def in_simpy(runs: Runs) -> Iterator[Run]:
    """The same runs, each sequence alone in the SimPy engine."""
    for recording in runs.trace:
        strided = {other.metadata.stride: other[recording.name] for other in runs.strided}
        times = None if runs.timing is None else runs.timing[recording.name]
        yield replay_sequence(
            recording, runs.clock, runs.source, runs.policy, times, strided=strided
        )


@pytest.mark.usefixtures("groups")
def test_a_batch_fails_where_its_runs_do() -> None:
    for policy, timing in ((backwards_at_40, None), (latest, gappy())):
        outcomes = []
        runs = replay_trace(TRACE, policy=policy, timing=timing)
        for made in (runs, in_simpy(runs)):
            names: list[str] = []
            with pytest.raises(LaeError) as error:
                names.extend(found.recording.name for found in made)
            outcomes.append((names, str(error.value)))
        assert outcomes[0] == outcomes[1]
        assert outcomes[0][0]


@pytest.mark.parametrize("policy", [latest, vot_realtime()])
def test_a_users_own_source_and_policy_see_one_sequence_after_another(policy: Policy) -> None:
    asked: list[str] = []

    def source(recording: Recording) -> Service:
        asked.append(recording.name)
        return by_frame(recording) if policy is not latest else by_frame(recording).__call__

    for found in replay_trace(TRACE, policy=policy, latency=source):
        assert asked[-1] == found.recording.name
    assert asked == NAMES


def gappy() -> Trace:
    recordings = list(TRACE)
    ns = np.where(np.arange(len(recordings[5])) == 3, -1, 1)
    recordings[5] = Recording.new("s05", recordings[5].truth, recordings[5].boxes, ns)
    return Trace(EVERY, recordings)


@pytest.mark.usefixtures("groups")
@pytest.mark.parametrize("make", [bootstrap, resampled, lognormal])
@pytest.mark.parametrize("policy", [latest, vot_realtime()])
@pytest.mark.parametrize("timing", [None, SLOWER])
def test_repetitions_are_replays(make, policy: Policy, timing: Trace | None) -> None:  # type: ignore[no-untyped-def]
    found = {}
    runs = replay_trace(TRACE, latency=make(7), policy=policy, timing=timing)
    for repetition, replayed in replay_repeated(runs, 3, first=2):
        found[repetition, replayed.recording.name] = fields(replayed)
    expected = {
        (repetition, replayed.recording.name): fields(replayed)
        for repetition in (2, 3, 4)
        for replayed in replay_trace(
            TRACE, latency=make(7, repetition=repetition), policy=policy, timing=timing
        )
    }
    assert found == expected


@pytest.mark.usefixtures("groups")
def test_repetitions_do_not_depend_on_other_sequences() -> None:
    drawn = replay_trace(TRACE, latency=bootstrap(7))
    alone = replay_trace(Trace(EVERY, [moving(20 + 7 * 4, 4, "s04")]), latency=bootstrap(7))
    among = [fields(r) for _, r in replay_repeated(drawn, 5) if r.recording.name == "s04"]
    assert among == [fields(r) for _, r in replay_repeated(alone, 5)]


def test_repetitions_come_one_after_another() -> None:
    runs = replay_trace(TRACE, latency=bootstrap(7))
    found = [(k, r.recording.name) for k, r in replay_repeated(runs, 2)]
    assert found == [(k, name) for k in range(2) for name in NAMES]
    assert list(replay_repeated(runs, 0)) == []
    with pytest.raises(LaeError, match="only random times can be drawn again"):
        next(replay_repeated(replay_trace(TRACE), 2))


@pytest.mark.parametrize("frames", [1, 90, 150, 10**6])
@pytest.mark.parametrize("lane_frames", [1, 700, 1 << 21])
def test_batches_are_grouped_as_runs_are(
    frames: int, lane_frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "_LANE_FRAMES", lane_frames)
    repeated = Repetitions(replay_trace(TRACE, latency=bootstrap(7)), 3, 2)
    found = list(grouped(repeated, frames))
    expected = list(batched(list(repeated), frames, BESIDE))
    assert [[fields(each) for each in batch] for batch in found] == [
        [fields(each) for each in group] for group in expected
    ]
    drawn = [r for batch in found for r in batch.repetition.tolist()]
    assert drawn == [r for r, _ in replay_repeated(repeated.runs, 3, 2)]
