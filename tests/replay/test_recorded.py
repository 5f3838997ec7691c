"""The policy 'recorded': what a trace holds is processed again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from witness import moving

from lae_sim.api.evaluation import evaluate
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, fifo, latest
from lae_sim.engine.scheduler import Policy, simulate
from lae_sim.errors import LaeError
from lae_sim.replay.latency import scaled
from lae_sim.replay.names import parse_policy
from lae_sim.replay.recorded import AsRecorded
from lae_sim.replay.run import Runs, replay_sequence
from lae_sim.replay.world import World
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

CLOCK = Clock.at(30)  # type: ignore[arg-type]


def run_in_real_time(policy: Policy, seed: int = 0, length: int = 40) -> Recording:
    """The recording of a run under a policy."""
    source = moving(length, seed, "s", 90_000_000)
    schedule = simulate(length, CLOCK, lambda frame: int(source.elapsed_ns[frame]), policy)
    return Recording.of_run("s", schedule, source.boxes[schedule.frames], source.truth)


@given(st.sampled_from([latest, fifo, every(3)]), st.integers(0, 5), st.integers(1, 60))
def test_a_run_under_any_policy_is_repeated(policy: Policy, seed: int, length: int) -> None:
    recording = run_in_real_time(policy, seed, length)
    own = replay_sequence(recording, CLOCK, policy=policy).schedule
    again = replay_sequence(recording, CLOCK, policy=AsRecorded()).schedule
    for name in ("frames", "start", "ready"):
        assert getattr(again, name).tolist() == getattr(own, name).tolist()


def test_sequences_of_a_trace_have_rules_of_their_own() -> None:
    recordings = [
        run_in_real_time(rule, seed) for seed, rule in enumerate([latest, every(5), fifo])
    ]
    named = [
        Recording.new(name, each.truth, each.boxes, each.elapsed_ns)
        for name, each in zip("abc", recordings)
    ]
    trace = Trace(Metadata.new("30", "real-time", schedule={"policy": "recorded"}), named)
    world = World.of(policy="recorded")
    runs = list(world.replay(trace))
    for run, recording in zip(runs, named):
        processed = np.flatnonzero(recording.elapsed_ns >= 0)
        assert run.schedule.frames.tolist() == processed[: len(run.schedule.frames)].tolist()
        assert run.departures == 0
    assert world.replay(trace).notes() == []
    assert Runs(trace, CLOCK).notes() == [
        "the times are those of a log, whose own schedule policy 'recorded' repeats"
    ]


def test_a_log_is_replayed_as_recorded_unless_a_policy_is_named() -> None:
    log = run_in_real_time(every(4))
    trace = Trace(Metadata.new("30", "real-time", schedule={"policy": "recorded"}), [log])
    every_frame = Trace(Metadata.new("30", "every-frame"), [moving(40, 9, "s")])
    [run] = World().replay(trace)
    assert run.schedule.frames.tolist()[:4] == [0, 4, 8, 12]
    assert World().settled(trace).policy_label == "recorded"
    assert World(timing=trace).settled(every_frame).policy_label == "recorded"
    assert World(timing=every_frame).settled(trace).policy_label == "latest"
    assert World().settled(every_frame).policy_label == World().policy_label == "latest"
    assert World.of(policy="fifo").settled(trace).policy_label == "fifo"
    with pytest.raises(LaeError, match="the policy that it was recorded under"):
        list(World.of(policy="latest").replay(trace))
    result = evaluate({"log": trace, "full": every_frame}, forecasters="hold")
    assert result.summary["policy"].tolist() == ["recorded", "latest"]


def test_frames_queue_where_times_are_longer() -> None:
    recording = run_in_real_time(every(4))
    slow = replay_sequence(
        recording, CLOCK, source=scaled(lambda r: _times(r), 3), policy=AsRecorded()
    )  # type: ignore[arg-type]
    gaps = np.diff(slow.schedule.start) >= np.diff(slow.schedule.ready)
    assert slow.schedule.frames.tolist()[:4] == [0, 4, 8, 12]
    assert gaps.any()


def _times(recording: Recording):
    from lae_sim.replay.latency import by_frame

    return by_frame(recording)


def test_the_boxes_of_another_trace_at_a_log_s_schedule() -> None:
    log = run_in_real_time(every(4))
    full = moving(40, 9, "s")
    run = replay_sequence(full, CLOCK, policy=AsRecorded(), times=log)
    own = replay_sequence(log, CLOCK, policy=AsRecorded())
    assert run.schedule.ready.tolist() == own.schedule.ready.tolist()
    every_frame = Trace(Metadata.new("30", "every-frame"), [full])
    timing = Trace(Metadata.new("30", "real-time", schedule={"policy": "recorded"}), [log])
    [again] = World.of(policy="recorded", timing=timing).replay(every_frame)
    assert again.schedule.frames.tolist() == own.schedule.frames.tolist()
    assert run.boxes.tolist() == full.boxes[run.schedule.frames].tolist()


def test_it_is_of_replays_only() -> None:
    policy = parse_policy("recorded")
    assert policy == AsRecorded()
    with pytest.raises(LaeError, match="'recorded' repeats what a trace holds"):
        simulate(9, CLOCK, lambda frame: 47_000_000, policy)
    with pytest.raises(LaeError, match=r"no policy 'recoded'.*did you mean 'recorded'"):
        parse_policy("recoded")
    with pytest.raises(LaeError, match="no policy 'recorded:2'"):
        parse_policy("recorded:2")
