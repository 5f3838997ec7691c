"""The scheduler: against two independent models, and its central property."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import (
    SECOND,
    SIGMAS,
    DenseKalman,
    event_driven,
    follow,
    psi,
    same,
    schedule_latest,
    worlds,
)

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, fifo, latest, shrinking_tail, vot_realtime
from lae_sim.engine.scheduler import Call, Policy, Schedule, simulate
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import answers
from lae_sim.forecast.kalman import Kalman
from lae_sim.replay.latency import by_call, by_frame, constant
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

CLOCK = Clock.at(Fraction(25))  # 40 ms a frame

World = tuple[Fraction, list[int], list[list[float]]]


def table(schedule: Schedule) -> list[tuple[int, int, int]]:
    return list(zip(schedule.frames.tolist(), schedule.start.tolist(), schedule.ready.tolist()))


def recording_of(world: World, name: str = "a") -> Recording:
    _, elapsed, boxes = world
    return Recording.new(name, boxes, boxes, elapsed)


@given(worlds())
@settings(max_examples=200)
def test_latest_agrees_with_the_fractions(world: World) -> None:
    fps, elapsed, _ = world
    schedule = simulate(len(elapsed), Clock.at(fps), elapsed.__getitem__, latest)
    seconds = fps.numerator * SECOND
    found = [
        (f, Fraction(start, seconds), Fraction(ready, seconds))
        for f, start, ready in table(schedule)
    ]
    assert found == schedule_latest(fps, elapsed)
    assert schedule.elapsed_ns.tolist() == [elapsed[f] for f in schedule.frames]


@given(worlds(), SIGMAS)
def test_latest_agrees_with_the_event_driven_world(world: World, sigmas: list[Fraction]) -> None:
    fps, elapsed, boxes = world
    processed, tellings = event_driven(fps, elapsed, boxes, sigmas)
    run = replay_sequence(recording_of(world), Clock.at(fps))
    assert table(run.schedule) == processed
    metadata = Metadata.new("30", "every-frame")
    for sigma, told in zip(sigmas, tellings):
        found = answers(run, metadata, "kalman", Kalman, sigma)
        assert found.source_frame.tolist() == told.psi
        np.testing.assert_allclose(found.boxes, told.boxes, rtol=0, atol=1e-6)


@given(worlds(), SIGMAS)
@settings(max_examples=30)
def test_the_two_witnesses_agree(world: World, sigmas: list[Fraction]) -> None:
    fps, elapsed, boxes = world
    processed, tellings = event_driven(fps, elapsed, boxes, sigmas)
    done = schedule_latest(fps, elapsed)
    assert [frame for frame, _, _ in processed] == [frame for frame, _, _ in done]
    for sigma, told in zip(sigmas, tellings):
        psis = psi(done, fps, len(elapsed), sigma)
        assert told.psi == psis
        np.testing.assert_array_equal(told.boxes, follow(psis, boxes, DenseKalman))


POLICIES: dict[str, Policy] = {
    "latest": latest,
    "fifo": fifo,
    "every 2": every(2),
    "every 3": every(3),
    "shrinking tail 47 ms": shrinking_tail(ns=47_000_000),
    "shrinking tail 100 ms": shrinking_tail(ns=100_000_000),
    "vot": vot_realtime(),
    "vot without grace": vot_realtime(0),
}


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
@given(world=worlds())
@settings(max_examples=25)
def test_a_profile_written_read_and_replayed_equals_itself(policy: Policy, world: World) -> None:
    fps, elapsed, boxes = world
    schedule = simulate(len(elapsed), Clock.at(fps), elapsed.__getitem__, policy)
    outputs = np.array(boxes)[schedule.frames]
    profiled = Recording.of_run("a", schedule, outputs, np.array(boxes))
    metadata = Metadata.new(f"{fps.numerator}/{fps.denominator}", "real-time")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.parquet"
        write_trace(Trace(metadata, [profiled]), path)
        trace = read_trace(path)
        (recording,) = trace
    assert trace.metadata.fps == fps
    assert same(recording, profiled)
    for source in (by_frame, by_call):
        run = replay_sequence(recording, Clock.at(trace.metadata.fps), source, policy)
        assert table(run.schedule) == table(schedule)
        assert run.boxes.tobytes() == outputs.tobytes()
        assert run.departures == 0
        again = Recording.of_run("a", run.schedule, run.boxes, recording.truth)
        assert same(again, profiled)


@given(worlds())
@settings(max_examples=30)
def test_a_repeated_run_is_the_same_to_the_byte(world: World) -> None:
    recording = recording_of(world)
    first, second = (replay_sequence(recording, Clock.at(world[0])).schedule for _ in "ab")
    for column in ("frames", "start", "ready"):
        assert getattr(first, column).tobytes() == getattr(second, column).tobytes()
        assert getattr(first, column).dtype == np.int64
        assert getattr(first, column).flags.c_contiguous


def test_the_service_is_asked_once_for_each_processed_frame_in_order() -> None:
    asked: list[int] = []

    def service(frame: int) -> int:
        asked.append(frame)
        return 100_000_000

    schedule = simulate(20, CLOCK, service, latest)
    assert asked == schedule.frames.tolist() == [0, 2, 5, 7, 10, 12, 15, 17]


def test_one_frame() -> None:
    schedule = simulate(1, CLOCK, lambda frame: 7, latest)
    assert table(schedule) == [(0, 0, 7 * 25)]


def test_an_output_that_ends_exactly_at_the_end_is_the_last() -> None:
    end_ns = 3 * 40_000_000
    assert simulate(3, CLOCK, lambda frame: end_ns, latest).frames.tolist() == [0]
    assert simulate(3, CLOCK, lambda frame: end_ns - 1, latest).frames.tolist() == [0, 2]


def test_an_empty_sequence_is_refused() -> None:
    with pytest.raises(LaeError, match="at least one frame"):
        simulate(0, CLOCK, lambda frame: 0, latest)


def test_a_negative_time_is_refused() -> None:
    with pytest.raises(LaeError, match=r"frame 1: .*negative"):
        simulate(3, CLOCK, lambda frame: -1 if frame else 0, latest)


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
@pytest.mark.parametrize("frame", [0, 1, 3])
def test_instants_beyond_64_bits_are_refused(policy: Policy, frame: int) -> None:
    stalled: list[int] = []

    def service(asked: int) -> int:
        if asked < frame or stalled:
            return 1
        stalled.append(asked)
        return 2**62

    with pytest.raises(LaeError, match="64 bits"):
        simulate(5, CLOCK, service, policy)
    assert stalled


def test_the_largest_instant_of_64_bits_is_kept() -> None:
    clock = Clock.at(Fraction(1))
    assert simulate(1, clock, lambda frame: 2**63 - 1, latest).ready.tolist() == [2**63 - 1]
    with pytest.raises(LaeError, match="64 bits"):
        simulate(1, clock, lambda frame: 2**63, latest)


def _answers(frame: int, tick: int) -> Policy:
    def policy(clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        return frame, tick

    return policy


@pytest.mark.parametrize(
    ("policy", "why"),
    [
        (_answers(0, CLOCK.frame_ticks), "the same frame"),
        (_answers(-1, CLOCK.frame_ticks), "an older frame"),
        (_answers(2, 2 * CLOCK.frame_ticks - 1), "a tick before arrival"),
        (_answers(1, -1), "before time 0"),
    ],
)
def test_a_policy_cannot_go_back_or_start_before_arrival(policy: Policy, why: str) -> None:
    with pytest.raises(LaeError, match="must move forward"):
        simulate(9, CLOCK, lambda frame: 0, policy)


def test_a_policy_cannot_go_back_in_time_between_calls() -> None:
    def policy(clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        return (1, 6 * clock.frame_ticks) if len(calls) == 1 else (2, 5 * clock.frame_ticks)

    with pytest.raises(LaeError, match="must move forward"):
        simulate(9, CLOCK, lambda frame: 0, policy)


@pytest.mark.parametrize(
    "policy", [_answers(9, CLOCK.frame_ticks), _answers(1, 9 * CLOCK.frame_ticks)]
)
def test_a_policy_ends_the_sequence_beyond_its_end(policy: Policy) -> None:
    assert simulate(9, CLOCK, lambda frame: 0, policy).frames.tolist() == [0]


# ---------------------------------------------------------------------- exact or approximate


def test_departures_count_outputs_that_follow_another_frame_than_recorded() -> None:
    boxes = np.ones((20, 4))
    recording = Recording.new("a", boxes, boxes, [100_000_000] * 20)  # of every frame
    run = replay_sequence(recording, CLOCK)
    assert run.schedule.frames.tolist() == [0, 2, 5, 7, 10, 12, 15, 17]
    assert run.departures == 7
    assert replay_sequence(recording, CLOCK, constant(ns=0)).departures == 0


def test_departures_of_a_real_time_trace_under_other_times() -> None:
    boxes = np.ones((9, 4))
    schedule = simulate(9, CLOCK, lambda frame: 60_000_000, latest)
    assert schedule.frames.tolist() == [0, 1, 3, 4, 6, 7]
    recording = Recording.of_run("a", schedule, boxes[schedule.frames], boxes)

    def skip_4(clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        last, _, ready = calls[-1]
        following = {0: 1, 1: 3, 3: 6, 6: 7, 7: 9}[last]
        return following, max(ready, following * clock.frame_ticks)

    assert replay_sequence(recording, CLOCK).departures == 0
    run = replay_sequence(recording, CLOCK, policy=skip_4)
    assert run.schedule.frames.tolist() == [0, 1, 3, 6, 7]
    assert run.departures == 1


@given(worlds(), st.integers(1, 3))
@settings(max_examples=40)
def test_departures_of_a_trace_of_every_frame_are_its_skips(world: World, n: int) -> None:
    run = replay_sequence(recording_of(world), Clock.at(world[0]), policy=every(n))
    assert run.departures == (0 if n == 1 else len(run.schedule.frames) - 1)


@pytest.mark.parametrize("source", [by_frame, constant(ns=50_000_000)])
def test_a_frame_that_the_trace_lacks_is_named(source: object) -> None:
    boxes = np.ones((9, 4))
    elapsed = np.full(9, 50_000_000)
    boxes[3], elapsed[3] = np.nan, -1
    recording = Recording.new("Gull2", np.ones((9, 4)), boxes, elapsed)
    with pytest.raises(LaeError, match=r"sequence 'Gull2', frame 3"):
        replay_sequence(recording, CLOCK, source, fifo)


def test_a_time_in_float_seconds_is_refused() -> None:
    with pytest.raises(TypeError):
        simulate(3, Clock(30, 10**9), lambda frame: 0.047, latest)  # type: ignore[arg-type, return-value]
