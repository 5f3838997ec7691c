"""Frames that arrive at times of their own: queries, ages and forecasts."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from operator import index
from typing import Any

import numpy as np
import pytest
from arriving import Arriving, arriving
from hypothesis import given, settings
from hypothesis import strategies as st

import lae_sim
from lae_sim.engine.arrivals import with_arrivals
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import latest, vot_realtime
from lae_sim.engine.scheduler import Schedule, simulate
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import Evaluation, answers, evaluate_runs
from lae_sim.evaluation.events import event_log
from lae_sim.evaluation.pairing import Pairing, histories, pair, pairs
from lae_sim.forecast.base import ConstantVelocity, Hold, Oracle
from lae_sim.forecast.camera import Camera, CameraCompensated, CameraMotion
from lae_sim.forecast.filters import GH, IMM
from lae_sim.forecast.kalman import Kalman, KalmanLaePvt, TunedKalman
from lae_sim.forecast.window import LeastSquares, Windowed
from lae_sim.replay.run import Run, replay_sequence
from lae_sim.replay.search import find_search
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

MS = 1_000_000
POLICIES = {"latest": latest, "vot": vot_realtime(1)}
SIGMAS = [Fraction(-1, 2), Fraction(0), Fraction(1, 3), Fraction(1, 2), Fraction(1), Fraction(5, 2)]
RATE = Fraction(10**9, 7)


def schedule_of(world: Arriving, policy: str = "latest") -> Schedule:
    clock = with_arrivals(Clock.at(world.fps), world.arrival_ns)
    times = world.elapsed_ns.__getitem__
    return simulate(len(world.arrival_ns), clock, times, POLICIES[policy])


def sources(pairing: Pairing, sequence: int, m: int) -> list[int]:
    span = slice(*pairing.offsets[sequence : sequence + 2])
    return np.repeat(pairing.frames[span], (pairing.end - pairing.first)[span, m]).tolist()


@given(
    st.lists(arriving(RATE), min_size=1, max_size=3),
    st.lists(st.sampled_from(SIGMAS), min_size=1, unique=True).map(sorted),
    st.sampled_from(sorted(POLICIES)),
    st.sampled_from([0, 0, 5]),
)
@settings(max_examples=60)
def test_pairing_agrees_with_the_fractions(
    worlds: list[Arriving], sigmas: list[Fraction], policy: str, cost_ns: int
) -> None:
    pairing = pair([schedule_of(world, policy) for world in worlds], sigmas, cost_ns)
    listed = pairs(pairing, histories(pairing))
    for s, world in enumerate(worlds):
        frames = range(len(world.arrival_ns))
        for m, sigma in enumerate(sigmas):
            expected = world.sources(policy, sigma, cost_ns)
            assert sources(pairing, s, m) == expected
            ages = [world.arrival(i) - world.arrival(k) for i, k in zip(frames, expected)]
            held = []
            for k in set(expected):
                some = [i for i in frames if expected[i] == k]
                until = some[-1] + 1
                stop = world.end if until == len(frames) else world.arrival(until)
                held.append(stop - world.arrival(some[0]))
            for name, seconds in (
                ("age_sum", sum(ages)),
                ("age_max", max(ages)),
                ("longest_stale", max(held)),
            ):
                in_frames = float(seconds / world.interval)
                assert getattr(pairing, name)[s, m] == pytest.approx(in_frames, rel=1e-12)
            assert pairing.mismatch_sum[s, m] == sum(i - k for i, k in zip(frames, expected))
    fed = histories(pairing)
    item_sequence = np.repeat(fed.sequence, np.diff(fed.offsets))
    found = sorted(
        (int(item_sequence[item]), m, int(frame), int(pairing.frames[fed.output[item]]))
        for item, frame, low, high in zip(
            listed.item, listed.frame, listed.sigma_from, listed.sigma_to
        )
        for m in range(low, high)
    )
    assert found == sorted(
        (s, m, i, k)
        for s, world in enumerate(worlds)
        for m, sigma in enumerate(sigmas)
        for i, k in enumerate(world.sources(policy, sigma, cost_ns))
    )


def recording_of(arrival_ns: list[int] | None, length: int = 40, took: int = 70 * MS) -> Recording:
    rng = np.random.default_rng(3)
    truth = np.array([100, 90, 30, 40]) + np.cumsum(rng.normal(1, 2, (length, 4)), axis=0)
    truth[:, 2:] = np.maximum(truth[:, 2:], 20)
    boxes = truth + rng.normal(0, 1, truth.shape)
    times = rng.integers(took // 2, took * 2, length)
    return Recording.new("a", truth, boxes, times, arrival_ns=arrival_ns)


def evaluated(recording: Recording, fps: int, makers: dict[str, Any]) -> Evaluation:
    run = replay_sequence(recording, Clock.at(Fraction(fps)))
    metadata = Metadata.new(fps, "every-frame")
    return evaluate_runs([run], metadata, makers, [Fraction(0), Fraction(1, 2), Fraction(1)])


def camera(length: int) -> Camera:
    transforms = np.tile(np.eye(2, 3), (length, 1, 1))
    transforms[1:, :, 2] = np.random.default_rng(4).normal(0, 3, (length - 1, 2))
    motion = CameraMotion(transforms, np.zeros(length, np.int64))
    return Camera({}, Fraction(25), 1, {"a": motion})


MAKERS: dict[str, Any] = {
    "hold": Hold,
    "cv": ConstantVelocity,
    "kalman": Kalman,
    "kalman-lae-pvt": KalmanLaePvt,
    "tuned": TunedKalman(decay=0.9, state="centre"),
    "least-squares": Windowed(LeastSquares()),
    "g-h": GH(),
    "imm": IMM(),
    "oracle": Oracle,
    "camera": CameraCompensated(Kalman, camera(40)),
}


def test_even_arrivals_change_no_bit() -> None:
    even = [40 * MS * i for i in range(40)]
    told = evaluated(recording_of(even), 25, MAKERS)
    silent = evaluated(recording_of(None), 25, MAKERS)
    assert {m: told.scores[m].tolist() for m in told.scores} == {
        m: silent.scores[m].tolist() for m in silent.scores
    }
    assert told.staleness.age_sum.tolist() == silent.staleness.age_sum.tolist()
    assert silent.staleness.age_sum.tolist() == silent.staleness.mismatch_sum.tolist()
    assert silent.staleness.age_max.tolist() == silent.staleness.mismatch_max.tolist()
    assert silent.staleness.longest_stale.tolist() == silent.staleness.longest_hold.tolist()


def dropped(recording: Recording, kept: np.ndarray[Any, Any]) -> Recording:
    """What is left of a recording whose camera drops frames."""
    return Recording.new(
        "a",
        recording.truth[kept],
        recording.boxes[kept],
        recording.elapsed_ns[kept],
        arrival_ns=kept * 40 * MS,
    )


KEPT = np.array([i for i in range(40) if i % 4 != 2 and i not in (20, 21)])


def processing(times: Recording, frames: list[int]) -> Run:
    """A run which processes these frames, each as it arrives, at no time."""
    clock = with_arrivals(Clock.at(Fraction(25)), times.arrival_ns)
    ticks = np.array([clock.arrival(frame) for frame in frames])
    schedule = Schedule(clock, len(times), np.array(frames), ticks, ticks)
    return Run(times, schedule, times.boxes[frames], 0)


@pytest.mark.parametrize("name", sorted(set(MAKERS) - {"oracle", "camera"}))
def test_forecasts_are_those_of_the_world_in_which_no_frame_was_dropped(name: str) -> None:
    """The same outputs at the same times: only the dropped frames have no query."""
    whole = recording_of(None)
    short = dropped(whole, KEPT)
    some = list(range(0, len(KEPT), 3))
    metadata = Metadata.new(25, "every-frame")
    full = answers(processing(whole, KEPT[some].tolist()), metadata, name, MAKERS[name])
    part = answers(processing(short, some), metadata, name, MAKERS[name])
    assert part.boxes == pytest.approx(full.boxes[KEPT], rel=1e-12)
    assert KEPT[part.source_frame].tolist() == full.source_frame[KEPT].tolist()


def test_the_oracle_and_the_camera_look_frames_up_by_number() -> None:
    short = dropped(recording_of(None), KEPT)
    run = replay_sequence(short, Clock.at(Fraction(25)))
    metadata = Metadata.new(25, "every-frame")
    assert answers(run, metadata, "oracle", Oracle).boxes.tolist() == short.truth.tolist()
    still = CameraMotion(np.tile(np.eye(2, 3), (len(KEPT), 1, 1)), np.zeros(len(KEPT), np.int64))
    unmoved = CameraCompensated(Kalman, Camera({}, Fraction(25), 1, {"a": still}), always=True)
    bare = answers(run, metadata, "kalman", Kalman).boxes
    over = answers(run, metadata, "camera", unmoved).boxes
    assert over == pytest.approx(bare, abs=1e-9)
    moving = replace(unmoved, camera=camera(len(KEPT)))
    assert np.abs(answers(run, metadata, "camera", moving).boxes - bare).max() > 1


def test_a_users_forecaster_is_given_times_that_are_numbers_as_an_index() -> None:
    seen: list[tuple[float, int]] = []

    class Mine:
        def __init__(self, box: Any, image_size: Any = None) -> None:
            self.box = box

        def update(self, frame: int, box: Any) -> None:
            seen.append((frame, index(frame)))

        def predict(self, frame: int) -> Any:
            seen.append((frame, index(frame)))
            return self.box

    short = dropped(recording_of(None), KEPT)
    answers(
        replay_sequence(short, Clock.at(Fraction(25))), Metadata.new(25, "every-frame"), "m", Mine
    )
    assert {number for _, number in seen} == set(range(len(KEPT)))
    assert all(time == KEPT[number] for time, number in seen)
    seen.clear()
    even = recording_of(None)
    answers(
        replay_sequence(even, Clock.at(Fraction(25))), Metadata.new(25, "every-frame"), "m", Mine
    )
    assert all(type(frame) is int and frame == number for frame, number in seen)


def test_the_models_pre_forecaster_counts_time() -> None:
    times: list[float] = []

    class Mine(Kalman):
        def predict(self, frame: int) -> Any:
            times.append(frame)
            return super().predict(frame)

    metadata = Metadata.new(25, "every-frame")
    search = find_search("c=0.7", metadata, pre_forecaster=Mine)
    short = dropped(recording_of(None), KEPT)
    run = replay_sequence(short, Clock.at(Fraction(25)), search=search)
    assert times == [float(KEPT[frame]) for frame in run.schedule.frames[1:]]


def test_events_and_pictures_go_by_arrivals() -> None:
    from lae_sim.report.timeline import trace_events

    short = dropped(recording_of(None), KEPT)
    run = replay_sequence(short, Clock.at(Fraction(25)))
    ticks = {e.frame: e.tick for e in event_log(run) if e.kind == "frame arrived"}
    per_ns = run.schedule.clock.ticks_per_ns
    assert ticks == {i: int(k) * 40 * MS * per_ns for i, k in enumerate(KEPT)}
    queries = {
        e.frame: e.tick for e in event_log(run, Fraction(1, 2)) if e.kind == "query answered"
    }
    assert queries == {frame: tick + 20 * MS * per_ns for frame, tick in ticks.items()}
    skipped = [e for e in event_log(run) if e.kind == "frame skipped"]
    assert max(e.tick for e in skipped) <= ticks[len(KEPT) - 1] + 40 * MS * per_ns
    shown = [e for e in trace_events(run, Fraction(0), {"hold": 0}) if e.get("ph") == "X"]
    camera_track = [e for e in shown if "skipped" in e["args"]]
    assert [e["ts"] for e in camera_track] == [int(k) * 40_000 for k in KEPT]
    gap = int(np.argmax(np.diff(KEPT)))
    assert camera_track[gap]["dur"] == int(np.diff(KEPT)[gap]) * 40_000
    assert run.schedule.clock.arrival_ms(gap + 1) == KEPT[gap + 1] * 40


def trace_of(*recordings: Recording, fps: int = 25) -> lae_sim.Trace:
    return lae_sim.Trace(Metadata.new(fps, "every-frame"), recordings)


def test_another_rate_is_refused_unless_arrivals_are_forgotten() -> None:
    short = dropped(recording_of(None), KEPT)
    trace = trace_of(short)
    assert trace.has_arrivals
    assert lae_sim.replay_trace(trace).arrivals == "recorded"
    assert next(iter(lae_sim.replay_trace(trace, fps=25))).schedule.clock.arrival(2) == 3 * 10**9
    with pytest.raises(LaeError, match=r"nominal 25 frames/s: for 10 frames/s forget the arrivals"):
        lae_sim.replay_trace(trace, fps=10)
    runs = lae_sim.replay_trace(trace, fps=10, forget_arrivals=True)
    assert runs.arrivals == "forgotten"
    even = trace_of(replace(short, arrival_ns=None))
    (forgotten,), (never) = list(runs), lae_sim.replay_trace(even, fps=10)
    assert never.arrivals is None
    assert forgotten.schedule.start.tolist() == next(iter(never)).schedule.start.tolist()


def test_traces_that_disagree_on_arrivals_are_refused() -> None:
    short = dropped(recording_of(None), KEPT)
    later = replace(short, arrival_ns=KEPT * 40 * MS + np.arange(len(KEPT)))
    silent = replace(short, arrival_ns=None)
    ours = next(iter(lae_sim.replay_trace(trace_of(short))))
    for other in (short, silent):
        run = next(iter(lae_sim.replay_trace(trace_of(short), timing=trace_of(other))))
        assert run.schedule.ready.tolist() == ours.schedule.ready.tolist()
    for one, other in ((short, later), (silent, short)):
        with pytest.raises(LaeError, match="arrived at other times in one trace than in another"):
            list(lae_sim.replay_trace(trace_of(one), timing=trace_of(other)))
        list(lae_sim.replay_trace(trace_of(one), timing=trace_of(other), forget_arrivals=True))


def test_many_sequences_are_replayed_as_each_by_itself() -> None:
    whole = recording_of(None)
    some = [
        replace(dropped(whole, KEPT[: 8 + k]), name=f"s{k}")
        if k % 2
        else replace(whole, name=f"s{k}")
        for k in range(9)
    ]
    runs = lae_sim.replay_trace(trace_of(*some))
    for run, recording in zip(runs, some):
        alone = lae_sim.replay_sequence(recording, runs.clock)
        assert run.schedule.ready.tolist() == alone.schedule.ready.tolist()


def test_instants_beyond_64_bits_name_the_sequence() -> None:
    far = replace(recording_of(None, 2), arrival_ns=np.array([0, 2**62]))
    with pytest.raises(LaeError, match=r"sequence 'a': the last frame arrives after .* beyond 64"):
        list(lae_sim.replay_trace(trace_of(far)))
