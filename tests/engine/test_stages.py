"""Pipelines at work: against an independent witness, and as the policies of one tracker."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from arriving import Arriving, arriving
from hypothesis import given, settings
from hypothesis import strategies as st
from piping import Piped, Witness, piped

from lae_sim.engine.arrivals import with_arrivals
from lae_sim.engine.clock import Clock
from lae_sim.engine.pipeline import Camera, Pipeline, Stage
from lae_sim.engine.policies import every, fifo, latest
from lae_sim.engine.scheduler import NEVER, Policy, Schedule, simulate
from lae_sim.engine.stages import Drop, PipelineSchedule, simulate_pipeline
from lae_sim.errors import LaeError
from lae_sim.evaluation.pairing import pair

CLOCK = Clock.at(Fraction(25))  # 40 ms a frame
MS = 1_000_000


def clock_of(world: Piped) -> Clock:
    captured = world.captured
    clock = Clock.at(10**9 / world.interval)
    if all(at == frame * world.interval for frame, at in enumerate(captured)):
        return clock
    return with_arrivals(clock, [int(at) for at in captured])


def by_call(times: tuple[int, ...]) -> Callable[[int], int]:
    following = iter(times)
    return lambda frame: next(following)


def pipeline_of(world: Piped) -> Pipeline:
    names = [stage.name for stage in world.stages]
    stages = [
        Stage(
            stage.name,
            workers=stage.workers,
            queue=stage.queue,
            when_full=stage.when_full,
            resource=stage.resource,
            priority=stage.priority,
            after="camera" if stage.after < 0 else names[stage.after],
            every=stage.every,
        )
        for stage in world.stages
    ]
    camera = Camera(
        exposure=f"{world.delay // 2}ns", delivery=f"{world.delay - world.delay // 2}ns"
    )
    return Pipeline(stages, camera, world.resources)


def run(world: Piped) -> PipelineSchedule:
    services = {
        stage.name: by_call(stage.times) if stage.by_call else stage.times.__getitem__
        for stage in world.stages
    }
    clock = clock_of(world)
    return simulate_pipeline(
        pipeline_of(world),
        len(world.captured),
        clock,
        services,
        world.jitter.__getitem__,
        world.lost,
    )


@given(piped())
@settings(max_examples=400)
def test_the_event_driven_witness_agrees(world: Piped) -> None:
    witness = Witness(world)
    if witness.log[world.tracker][0].started is None:
        with pytest.raises(LaeError, match="ends before its first frame"):
            run(world)
        return
    schedule = run(world)
    ticks = schedule.clock.ticks_per_ns

    def at(values: np.ndarray) -> list[Fraction | None]:
        return [None if tick < 0 else Fraction(tick, ticks) for tick in values.tolist()]

    assert at(schedule.delivered) == witness.delivered
    assert list(schedule.stages) == [stage.name for stage in world.stages]
    for (name, log), passages in zip(schedule.stages.items(), witness.log):
        for what in ("arrived", "taken", "started", "finished", "left", "gone"):
            expected = [getattr(passage, what) for passage in passages]
            assert at(getattr(log, what)) == expected, (name, what)
        assert [Drop(each).name for each in log.dropped.tolist()] == [
            passage.dropped or "NONE" for passage in passages
        ]


@given(piped(), st.sampled_from([Fraction(0), Fraction(1, 3), Fraction(1), Fraction(7, 2)]))
@settings(max_examples=200)
def test_queries_are_answered_by_the_newest_output(world: Piped, sigma: Fraction) -> None:
    witness = Witness(world)
    if witness.log[world.tracker][0].started is None:
        return
    schedule = run(world)
    pairing = pair([schedule], [sigma])
    found = np.repeat(pairing.frames, pairing.end[:, 0] - pairing.first[:, 0])
    queries = [captured + sigma * world.interval for captured in world.captured]
    assert found.tolist() == [witness.source(query) for query in queries]


def same_calls(a: Schedule, b: Schedule) -> bool:
    return all(
        getattr(a, what).tolist() == getattr(b, what).tolist()
        for what in ("frames", "start", "ready")
    )


@pytest.mark.parametrize(
    ("policy", "stage"),
    [
        (latest, Stage("tracker")),
        (fifo, Stage("tracker", queue=None)),
        (fifo, Stage("tracker", queue=10**6, when_full="drop-newest")),
        (every(2), Stage("tracker", queue=None, every=2)),
        (every(3), Stage("tracker", queue=None, every=3)),
    ],
)
@given(arriving())
@settings(max_examples=150)
def test_one_stage_is_a_policy_tick_for_tick(policy: Policy, stage: Stage, world: Arriving) -> None:
    length, times = len(world.arrival_ns), world.elapsed_ns.__getitem__
    for clock in (Clock.at(world.fps), with_arrivals(Clock.at(world.fps), world.arrival_ns)):
        schedule = simulate_pipeline(Pipeline([stage]), length, clock, {"tracker": times})
        assert same_calls(schedule, simulate(length, clock, times, policy))
        assert schedule.visible is not None
        assert schedule.visible.tolist() == schedule.ready.tolist()


def constant(**ms: int) -> dict[str, Callable[[int], int]]:
    return {name: lambda frame, time=time: time * MS for name, time in ms.items()}


def ms(values: np.ndarray) -> list[float]:
    return [float(Fraction(tick, CLOCK.ticks_per_ns) / MS) for tick in values.tolist()]


def test_a_frame_that_arrives_as_the_worker_becomes_free_is_taken() -> None:
    schedule = simulate_pipeline(Pipeline([Stage("tracker")]), 5, CLOCK, constant(tracker=80))
    assert schedule.frames.tolist() == [0, 2, 4]
    dropped = schedule.stages["tracker"].dropped
    assert [Drop(each) for each in dropped.tolist()] == [0, Drop.FULL, 0, Drop.FULL, 0]


def test_the_stage_nearest_to_the_camera_takes_first_and_what_it_does_in_no_time_goes_on() -> None:
    stages = [Stage("decode"), Stage("tracker")]
    schedule = simulate_pipeline(Pipeline(stages), 3, CLOCK, constant(decode=0, tracker=40))
    assert ms(schedule.start) == [0, 40, 80]


def test_the_more_urgent_gets_the_resource_at_the_tick_when_it_comes_back() -> None:
    stages = [
        Stage("decode", resource="gpu"),
        Stage("tracker", resource="gpu", priority=-1),
    ]
    pipeline = Pipeline(stages, resources={"gpu": 1})
    schedule = simulate_pipeline(pipeline, 4, CLOCK, constant(decode=40, tracker=40))
    # the tracker's frame 0 and decode's frame 1 want it at 40 ms
    assert ms(schedule.start)[:2] == [40, 120]
    assert ms(schedule.stages["decode"].started)[:2] == [0, 80]
    even = Pipeline(
        [Stage("decode", resource="gpu"), Stage("tracker", resource="gpu")], resources={"gpu": 1}
    )
    assert ms(simulate_pipeline(even, 4, CLOCK, constant(decode=40, tracker=40)).start)[0] == 80


def test_an_older_output_never_replaces_a_newer_one() -> None:
    took = [10, 90, 10, 10]
    stages = [Stage("tracker"), Stage("publish", workers=2)]
    services = {"tracker": lambda frame: 10 * MS, "publish": lambda frame: took[frame] * MS}
    schedule = simulate_pipeline(Pipeline(stages), 4, CLOCK, services)
    assert ms(schedule.stages["publish"].finished)[1:] == [140, 100, 140]
    assert schedule.visible is not None
    assert ms(schedule.visible)[1:] == [100, 100, 140]


def test_an_output_that_is_dropped_on_its_way_answers_nothing() -> None:
    stages = [Stage("tracker"), Stage("publish", when_full="drop-newest")]
    schedule = simulate_pipeline(Pipeline(stages), 6, CLOCK, constant(tracker=1, publish=500))
    log = schedule.stages["publish"]
    assert [Drop(each) for each in log.dropped.tolist()[3:]] == [Drop.FULL] * 3
    assert schedule.visible is not None
    assert (schedule.visible[3:] == NEVER).all()
    pairing = pair([schedule], [Fraction(0), Fraction(10**6)])
    assert (pairing.first[3:] == pairing.end[3:]).all()


def test_a_full_queue_that_blocks_keeps_the_worker_before_it() -> None:
    stages = [Stage("decode"), Stage("tracker", when_full="block")]
    schedule = simulate_pipeline(Pipeline(stages), 12, CLOCK, constant(decode=10, tracker=100))
    decode = schedule.stages["decode"]
    assert ms(decode.finished)[3] == 130
    assert ms(decode.left)[3] == 210  # when the tracker takes its third
    assert Drop.FULL not in schedule.stages["tracker"].dropped.tolist()


def test_frames_that_the_camera_loses_or_delays() -> None:
    camera = Camera(exposure="4ms", delivery="8ms")
    schedule = simulate_pipeline(
        Pipeline([Stage("tracker")], camera),
        5,
        CLOCK,
        constant(tracker=1),
        lambda frame: [0, 60, 0, 0, 0][frame] * MS,
        {0, 3},
    )
    tick = CLOCK.ticks_per_ns * MS
    assert [t / tick for t in schedule.delivered.tolist()] == [12, 112, 112, -1 / tick, 172]
    assert schedule.frames.tolist() == [0, 2, 4]  # 2 pushes 1 out at the same tick


def test_what_overtakes_the_initialisation_is_dropped() -> None:
    stages = [Stage("decode", workers=2), Stage("tracker")]
    services = {"decode": lambda frame: (1 if frame else 100) * MS, "tracker": lambda frame: MS}
    schedule = simulate_pipeline(Pipeline(stages), 5, CLOCK, services)
    assert schedule.frames.tolist() == [0, 3, 4]
    dropped = schedule.stages["tracker"].dropped.tolist()
    assert dropped[1:3] == [Drop.TOO_EARLY, Drop.TOO_EARLY]


def test_a_full_queue_lets_the_initialisation_in() -> None:
    stages = [Stage("decode", workers=3), Stage("scale", when_full="block"), Stage("tracker")]
    services = {
        "decode": lambda frame: (1 if frame else 100) * MS,
        **constant(scale=60, tracker=1),
    }
    schedule = simulate_pipeline(Pipeline(stages), 5, CLOCK, services)
    scale = schedule.stages["scale"]
    assert ms(scale.arrived)[:3] == [100, 41, 81]
    assert ms(scale.taken)[:3] == [101, 41, 161]


def test_workers_without_end_are_as_many_as_there_are_frames() -> None:
    stages = [Stage("decode", workers=10**18), Stage("tracker", queue=None)]
    schedule = simulate_pipeline(Pipeline(stages), 4, CLOCK, constant(decode=100, tracker=1))
    assert ms(schedule.stages["decode"].started) == [0, 40, 80, 120]


def test_no_worker_of_the_tracker_begins_before_it_is_initialised() -> None:
    services = {"tracker": lambda frame: (10 if frame else 90) * MS}
    stages = [Stage("tracker", workers=2, queue=None)]
    schedule = simulate_pipeline(Pipeline(stages), 4, CLOCK, services)
    assert ms(schedule.start) == [0, 90, 90, 120]


def test_two_trackers_on_one_gpu_take_turns() -> None:
    stages = [Stage(name, resource="gpu", after="camera") for name in ("tracker", "other")]
    pipeline = Pipeline(stages, resources={"gpu": 1})
    schedule = simulate_pipeline(pipeline, 9, CLOCK, constant(tracker=40, other=40))
    # each waits for the other with a frame in its hands, which is 40 ms old as it begins
    assert ms(schedule.start) == [0, 80, 160, 240, 320]
    assert schedule.frames.tolist() == [0, 1, 3, 5, 7]
    other = schedule.stages["other"]
    assert ms(other.started[other.started >= 0]) == [40, 120, 200, 280]
    alone = simulate_pipeline(Pipeline([Stage("tracker")]), 9, CLOCK, constant(tracker=40))
    assert alone.frames.tolist() == list(range(9))


@pytest.mark.parametrize("when_full", ["drop-oldest", "drop-newest"])
def test_a_queue_of_ten_makes_everything_late(when_full: str) -> None:
    def age_ms(queue: int) -> float:
        stage = Stage("tracker", queue=queue, when_full=when_full)
        schedule = simulate_pipeline(Pipeline([stage]), 2000, CLOCK, constant(tracker=47))
        ages = schedule.start - CLOCK.arrival(schedule.frames)
        return float(ages[len(ages) // 2 :].mean()) / CLOCK.ticks_per_ns / MS

    # nine or ten frames wait: nine calls of 47 ms more, or nine frames of 40 ms
    more = 9 * 40 if when_full == "drop-oldest" else 9 * 47
    assert age_ms(10) - age_ms(1) == pytest.approx(more, abs=1)


@pytest.mark.parametrize(
    ("time", "says"),
    [
        (-1, "a time cannot be negative"),
        (2**63, "done at tick .* beyond 64 bits"),
        (0.5, "TypeError: 'float'"),
        (None, "TypeError: 'NoneType'"),
        (float("inf"), "TypeError: 'float'"),
    ],
)
def test_times_that_are_none(time: int, says: str) -> None:
    services = {"decode": lambda frame: time, "tracker": lambda frame: 1}
    with pytest.raises(LaeError, match=f"stage 'decode', frame 0: {says}"):
        simulate_pipeline(Pipeline([Stage("decode"), Stage("tracker")]), 2, CLOCK, services)


def test_what_a_service_raises_is_told_with_its_place() -> None:
    times = iter([1])  # of one frame
    services = {"tracker": lambda frame: next(times)}
    with pytest.raises(LaeError, match=r"'tracker', frame 1: StopIteration \(.*test_stages\.py"):
        simulate_pipeline(Pipeline([Stage("tracker")]), 2, CLOCK, services)


def test_an_empty_sequence_and_a_negative_jitter() -> None:
    one = Pipeline([Stage("tracker")])
    with pytest.raises(LaeError, match="at least one frame"):
        simulate_pipeline(one, 0, CLOCK, constant(tracker=1))
    with pytest.raises(LaeError, match="camera: jitter, frame 0: a time cannot be negative"):
        simulate_pipeline(one, 2, CLOCK, constant(tracker=1), lambda frame: -1)
