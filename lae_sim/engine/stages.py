"""Pipelines at work: every camera, worker and shared resource as a SimPy process on exact ticks.

What happens at one tick happens in this order, whatever was scheduled first:

1. Frames are delivered, stages finish frames and hand them on: they arrive in queues. What does not
   fit is dropped or, under ``block``, stays in the hands of the worker that brings it.
2. Idle workers take frames, one at a time, the stage nearest to the camera first. So a frame that
   arrives at the very tick at which a worker becomes free can be taken, or push out an older one.
3. Workers that have taken a frame ask for their stage's resource, the most urgent stage first.
4. Resources that were used go back, to the most urgent of those who wait, then the first to ask.

Whenever a step lets an earlier one happen, as a stage of 0 ns does, that one is next. A queue holds
frames by number, the oldest is taken first. Frame 0 is the tracker's initialisation: no queue drops
it, the tracker drops frames that come before it, none of its workers takes another meanwhile, and
nothing of it is passed on, since the initial box is known from time 0. The tracker drops a frame
that is older than its last one. From the end of the stream on, no stage but those after the tracker
begins a frame; what it has begun goes its way.
"""

from __future__ import annotations

from bisect import bisect
from collections import deque
from collections.abc import Callable, Collection, Generator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from operator import index
from typing import Any, TypeAlias

import numpy as np
import simpy
from simpy.events import EventPriority

from lae_sim._arrays import Ints
from lae_sim.engine.clock import Clock
from lae_sim.engine.pipeline import CAMERA, Pipeline, Stage
from lae_sim.engine.scheduler import NEVER, Schedule, Service
from lae_sim.errors import LaeError, described

Process: TypeAlias = "Generator[simpy.Event, Any, None]"


class Drop(IntEnum):
    """Why a stage dropped a frame."""

    NONE = 0
    """It did not."""
    FULL = 1
    """The queue was full."""
    NOT_ITS_TURN = 2
    """The stage takes every n-th frame only."""
    OVERTAKEN = 3
    """The tracker had taken a newer frame."""
    TOO_EARLY = 4
    """The tracker was not initialised."""
    END = 5
    """The stream ended before it could begin."""


@dataclass(frozen=True, eq=False)
class StageLog:
    """What happened to each of T world frames at one stage; -1 where it did not happen.

    Attributes:
        arrived: when it came, int64 [T], ticks.
        taken: when a worker took it from the queue, int64 [T], ticks.
        started: when the worker began, with the resource that it needs, int64 [T], ticks.
        finished: when it was done, int64 [T], ticks.
        left: when the worker had handed it on, and was free again, int64 [T], ticks.
        dropped: why it was dropped, :class:`Drop`, int64 [T]; 0 if it was not.
        gone: when it was dropped, int64 [T], ticks; at the end of the stream, if it still waits.
    """

    arrived: Ints
    taken: Ints
    started: Ints
    finished: Ints
    left: Ints
    dropped: Ints
    gone: Ints


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class PipelineSchedule(Schedule):
    """The schedule of a pipeline's tracker, and what happened to every frame at every stage.

    An output that the pipeline finishes after a newer one never replaces that: it answers nothing.

    Attributes:
        pipeline: what was run.
        delivered: see :class:`.scheduler.Schedule`; -1 for frames that the camera lost. They are
            captured at ``clock.arrival(frame)``.
        stages: by name, in the pipeline's order.
    """

    pipeline: Pipeline
    delivered: Ints
    stages: Mapping[str, StageLog]


def simulate_pipeline(
    pipeline: Pipeline,
    length: int,
    clock: Clock,
    services: Mapping[str, Service],
    jitter: Service | None = None,
    lost: Collection[int] = (),
) -> PipelineSchedule:
    """Run a pipeline on one sequence of ``length`` world frames.

    Args:
        pipeline: the stages.
        length: number of world frames.
        clock: the world's, which says when frames are captured.
        services: by stage, how long a frame takes, ns; asked in the order in which frames start.
        jitter: how much longer than the camera says the delivery of a frame takes, ns.
        lost: frames that the camera does not deliver; frame 0 always is.

    Raises:
        LaeError: if the sequence is empty, a time is negative or no integer, such as seconds as a
            float, a service raises something, or an instant does not fit in 64-bit ticks; it names
            the stage and the frame.

    Example:
        >>> from lae_sim.engine import Clock, Pipeline, Stage, simulate_pipeline
        >>> pipeline = Pipeline([Stage("tracker"), Stage("publish")])
        >>> times = {"tracker": lambda frame: 47_000_000, "publish": lambda frame: 2_000_000}
        >>> schedule = simulate_pipeline(pipeline, 9, Clock.at(30), times)
        >>> schedule.frames.tolist(), (schedule.visible - schedule.ready).tolist()[1:3]
        ([0, 1, 2, 4, 5, 7, 8], [60000000, 60000000])
    """
    if length < 1:
        raise LaeError("a sequence needs at least one frame")
    environment = simpy.Environment()
    end = clock.end(length)
    resources = {
        name: simpy.PriorityResource(environment, capacity)
        for name, capacity in pipeline.resources.items()
    }
    urgencies = sorted({stage.priority for stage in pipeline.stages})
    work: dict[str, _Work] = {}
    for place, stage in enumerate(pipeline.stages):
        work[stage.name] = _Work(
            environment,
            stage,
            length,
            clock.ticks_per_ns,
            services[stage.name],
            None if stage.resource is None else resources[stage.resource],
            takes=_TAKES + place,
            asks=_TAKES + len(pipeline.stages) * (1 + urgencies.index(stage.priority)) + place,
            returns=_TAKES + len(pipeline.stages) * (1 + len(urgencies)),
            end=None if stage.name in pipeline.below else end,
            is_tracker=stage.name == pipeline.tracker,
        )
    for name, each in work.items():
        each.following = [work[stage.name] for stage in pipeline.after(name)]
        for _ in range(min(each.stage.workers, length)):  # more would never get a frame
            environment.process(each.worker())
    first = [work[stage.name] for stage in pipeline.after(CAMERA)]
    delivered: list[float] = [-1] * length
    environment.process(
        _camera(environment, pipeline.camera.delay_ns, clock, jitter, lost, delivered, first)
    )
    environment.run()
    for each in work.values():
        each.close()
    logs = {name: each.log() for name, each in work.items()}
    calls, answers = logs[pipeline.tracker], logs[pipeline.output]
    frames = np.flatnonzero(calls.started >= 0)
    if not len(frames) or frames[0]:
        raise LaeError("the stream ends before its first frame has reached the tracker")
    visible = answers.finished[frames]
    visible[visible < 0] = NEVER
    visible[0] = calls.finished[0]
    return PipelineSchedule(
        clock,
        length,
        frames,
        calls.started[frames],
        calls.finished[frames],
        visible=np.minimum.accumulate(visible[::-1])[::-1],
        pipeline=pipeline,
        delivered=np.array(delivered, np.int64),
        stages=logs,
    )


_TAKES = 2  # rank of the first stage's takings, after all of SimPy's own events of a tick


class _Turn(simpy.Event):
    """An event of the current tick that comes after those of lower rank."""

    def __init__(self, environment: simpy.Environment, rank: int) -> None:
        super().__init__(environment)
        self._ok = True
        self._value = None
        environment.schedule(self, EventPriority(rank))


def _camera(
    environment: simpy.Environment,
    delay_ns: int,
    clock: Clock,
    jitter: Service | None,
    lost: Collection[int],
    delivered: list[float],
    first: list[_Work],
) -> Process:
    """Delivers frames in their order."""
    ticks_per_ns = clock.ticks_per_ns
    for frame in range(len(delivered)):
        if frame and frame in lost:
            continue
        delay = delay_ns
        if jitter is not None:
            delay += _time("camera: jitter", jitter, frame)
        due = clock.arrival(frame) + delay * ticks_per_ns
        if due > environment.now:
            yield environment.timeout(due - environment.now)
        delivered[frame] = environment.now
        for work in first:
            work.offer(frame)


class _Work:
    """A stage at work: its queue and its workers."""

    def __init__(
        self,
        environment: simpy.Environment,
        stage: Stage,
        length: int,
        ticks_per_ns: int,
        service: Service,
        resource: simpy.PriorityResource | None,
        *,
        takes: int,
        asks: int,
        returns: int,
        end: int | None,
        is_tracker: bool,
    ) -> None:
        self.environment, self.stage, self.ticks_per_ns = environment, stage, ticks_per_ns
        self.service, self.resource = service, resource
        self.takes, self.asks, self.returns = takes, asks, returns
        self.end, self.is_tracker = end, is_tracker
        self.following: list[_Work] = []
        self.waiting: deque[int] = deque()
        self.blocked: deque[tuple[int, simpy.Event]] = deque()
        self.idle: deque[simpy.Event] = deque()
        self.has_turn = False
        self.last = -1  # frame that was taken
        # ticks, whole numbers all of them: SimPy's clock is typed to allow more
        self.arrived: list[float] = [-1] * length
        self.taken, self.started = self.arrived.copy(), self.arrived.copy()
        self.finished, self.left = self.arrived.copy(), self.arrived.copy()
        self.gone = self.arrived.copy()
        self.dropped = [0] * length

    def offer(self, frame: int) -> simpy.Event | None:
        """Let a frame in, or drop one; what to wait for where neither may be done."""
        queue = self.stage.queue
        if (
            self.stage.when_full == "block"
            and queue is not None
            and len(self.waiting) >= queue
            and frame
            and not self._refusal(frame)
        ):
            entered = self.environment.event()
            self.blocked.append((frame, entered))
            return entered
        self._enter(frame)
        return None

    def _enter(self, frame: int) -> None:
        self.arrived[frame] = self.environment.now
        if refusal := self._refusal(frame):
            self._drop(frame, refusal)
            return
        waiting, queue = self.waiting, self.stage.queue
        if not waiting or frame > waiting[-1]:
            waiting.append(frame)
        else:
            waiting.insert(bisect(waiting, frame), frame)
        if queue is not None and len(waiting) > queue and self.stage.when_full != "block":
            if self.stage.when_full == "drop-newest":
                loser = waiting.pop()
            else:
                oldest = int(waiting[0] == 0)
                loser = waiting[oldest]
                del waiting[oldest]
            self._drop(loser, Drop.FULL)
        self._let_take()

    def _drop(self, frame: int, why: Drop) -> None:
        self.dropped[frame], self.gone[frame] = why, self.environment.now

    def _refusal(self, frame: int) -> Drop:
        """Why a frame would not even be let in."""
        if frame % self.stage.every:
            return Drop.NOT_ITS_TURN
        if self.is_tracker:
            if frame < self.last:
                return Drop.OVERTAKEN
            if frame and self.arrived[0] < 0:
                return Drop.TOO_EARLY
        return Drop.NONE

    def _let_take(self) -> None:
        """Give a worker its turn at this tick, if one is idle and a frame waits."""
        initialises = self.is_tracker and self.taken[0] >= 0 and self.finished[0] < 0
        if self.idle and self.waiting and not self.has_turn and not initialises:
            self.has_turn = True
            _Turn(self.environment, self.takes).callbacks.append(self._take)

    def _take(self, turn: simpy.Event) -> None:
        self.has_turn = False
        if self._over(self.waiting[0]):
            return
        frame = self.last = self.waiting.popleft()
        self.taken[frame] = self.environment.now
        self.idle.popleft().succeed(frame)
        while self.blocked and len(self.waiting) < (self.stage.queue or 0):
            other, entered = self.blocked.popleft()
            entered.succeed()
            self._enter(other)
        self._let_take()

    def _over(self, frame: int) -> bool:
        """Whether a frame may not begin any more."""
        return frame > 0 and self.end is not None and self.environment.now >= self.end

    def worker(self) -> Process:
        """Takes a frame, works on it and hands it on, again and again."""
        environment, resource = self.environment, self.resource
        while True:
            frame_comes = environment.event()
            self.idle.append(frame_comes)
            self._let_take()
            frame = yield frame_comes
            if resource is not None:
                yield _Turn(environment, self.asks)
                holding = resource.request(self.stage.priority)
                yield holding
            if self._over(frame):
                self._drop(frame, Drop.END)
            else:
                self.started[frame] = environment.now
                ns = _time(f"stage {self.stage.name!r}", self.service, frame)
                yield environment.timeout(ns * self.ticks_per_ns)
                self.finished[frame] = environment.now
            if resource is not None:
                self._give_back(resource, holding)
            if self.finished[frame] >= 0:
                if frame or not self.is_tracker:
                    offered = [each.offer(frame) for each in self.following]
                    for entered in offered:
                        if entered is not None:
                            yield entered
                self.left[frame] = environment.now

    def _give_back(self, resource: simpy.PriorityResource, holding: Any) -> None:
        def release(turn: simpy.Event) -> None:
            resource.release(holding)

        _Turn(self.environment, self.returns).callbacks.append(release)

    def close(self) -> None:
        """Say of frames that still wait why they never began."""
        for frame in (*self.waiting, *(frame for frame, _ in self.blocked)):
            self.dropped[frame] = Drop.END
            self.gone[frame] = max(self.end or 0, self.arrived[frame])

    def log(self) -> StageLog:
        """What happened."""
        try:
            return StageLog(
                np.array(self.arrived, np.int64),
                np.array(self.taken, np.int64),
                np.array(self.started, np.int64),
                np.array(self.finished, np.int64),
                np.array(self.left, np.int64),
                np.array(self.dropped, np.int64),
                np.array(self.gone, np.int64),
            )
        except OverflowError as error:
            late = max(range(len(self.finished)), key=self.finished.__getitem__)
            raise LaeError(
                f"stage {self.stage.name!r}, frame {late}: done at tick {self.finished[late]}, "
                "beyond 64 bits: check its times, or write the frame rate more simply"
            ) from error


def _time(what: str, service: Callable[[int], int], frame: int) -> int:
    """What a frame takes, ns.

    Raises:
        LaeError: if it is negative or no integer, or the service raises something.
    """
    try:
        ns = index(service(frame))
    except LaeError:
        raise
    except Exception as error:  # SimPy would raise a copy, which does not tell where it was
        raise LaeError(f"{what}, frame {frame}: {described(error)}") from error
    if ns < 0:
        raise LaeError(f"{what}, frame {frame}: a time cannot be negative ({ns} ns)")
    return ns
