"""Pipelines frame by frame: an independent witness of ``lae_sim.engine.stages``.

It shares no code with the package and knows no SimPy: a heap of instants in Fractions of a ns, and
at each instant the rules, the first that applies, again and again until none does.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from hypothesis import strategies as st

NOT_YET = None


@dataclass(frozen=True)
class Staged:
    """A stage as plain values; times [T] in ns, by frame or by call."""

    name: str
    after: int  # place of the stage it comes after, -1: the camera
    times: tuple[int, ...]
    by_call: bool = False
    workers: int = 1
    queue: int | None = 1
    when_full: str = "drop-oldest"
    resource: str | None = None
    priority: int = 0
    every: int = 1


@dataclass(frozen=True)
class Piped:
    """A pipeline and one sequence: a stage never comes before the one it comes after."""

    interval: Fraction  # ns
    captured: tuple[Fraction, ...]  # ns
    delay: int  # ns
    jitter: tuple[int, ...]  # ns
    lost: frozenset[int]
    stages: tuple[Staged, ...]
    tracker: int
    resources: Mapping[str, int]

    def below(self) -> list[int]:
        found = [self.tracker]
        for place, stage in enumerate(self.stages):
            if stage.after in found:
                found.append(place)
        return found[1:]


@dataclass
class Passage:
    """What happened to one frame at one stage."""

    arrived: Fraction | None = NOT_YET
    taken: Fraction | None = NOT_YET
    started: Fraction | None = NOT_YET
    finished: Fraction | None = NOT_YET
    left: Fraction | None = NOT_YET
    dropped: str = ""
    gone: Fraction | None = NOT_YET


@dataclass
class _State:
    stage: Staged
    passages: list[Passage]
    waiting: list[int] = field(default_factory=list)
    held_up: list[tuple[int, int]] = field(default_factory=list)  # frame, stage that brings it
    idle: int = 0
    calls: int = 0
    last: int = -1


class Witness:
    """Plays a pipeline; ``log[place][frame]`` is a passage, ``delivered[frame]`` an instant."""

    def __init__(self, piped: Piped) -> None:
        self.piped = piped
        length = len(piped.captured)
        self.end = piped.captured[-1] + piped.interval
        self.ended = [place for place in range(len(piped.stages)) if place not in piped.below()]
        self.delivered: list[Fraction | None] = [None] * length
        self.states = [
            _State(stage, [Passage() for _ in range(length)], idle=stage.workers)
            for stage in piped.stages
        ]
        self.log = [state.passages for state in self.states]
        self.free = dict(piped.resources)
        self.asking: list[tuple[int, int, int]] = []  # priority, stage, frame
        self.queueing: dict[str, list[tuple[int, int, int, int]]] = {r: [] for r in piped.resources}
        self.returning: list[str] = []
        self.pending: dict[tuple[int, int], int] = {}  # (stage, frame): followers not yet entered
        self.order = 0
        self.due: list[
            tuple[Fraction, int, int, int]
        ] = []  # when, order, stage (-1: camera), frame
        before = Fraction(0)
        for frame in range(length):
            if frame and frame in piped.lost:
                continue
            before = max(before, piped.captured[frame] + piped.delay + piped.jitter[frame])
            self.delivered[frame] = before
            self.plan(before, -1, frame)
        while self.due:
            self.now = self.due[0][0]
            while self.step():
                pass
        for place, state in enumerate(self.states):
            for frame in [*state.waiting, *(frame for frame, _ in state.held_up)]:
                passage = self.log[place][frame]
                passage.dropped = "END"
                passage.gone = max(self.end, passage.arrived or self.end)

    def plan(self, when: Fraction, place: int, frame: int) -> None:
        self.order += 1
        heapq.heappush(self.due, (when, self.order, place, frame))

    def step(self) -> bool:
        if self.due and self.due[0][0] == self.now:
            _, _, place, frame = heapq.heappop(self.due)
            if place >= 0:
                self.log[place][frame].finished = self.now
                if (resource := self.states[place].stage.resource) is not None:
                    self.returning.append(resource)
            self.hand_on(place, frame)
            return True
        for place, state in enumerate(self.states):
            first = state.passages[0]
            if place == self.piped.tracker and first.taken != NOT_YET and first.finished == NOT_YET:
                continue
            if state.idle and state.waiting and not self.is_over(place, state.waiting[0]):
                self.take(place, state)
                return True
        if self.asking:
            self.asking.sort()
            priority, place, frame = self.asking.pop(0)
            resource = self.states[place].stage.resource
            assert resource is not None
            if self.free[resource]:
                self.free[resource] -= 1
                self.start(place, frame)
            else:
                self.order += 1
                self.queueing[resource].append((priority, self.order, place, frame))
            return True
        if self.returning:
            resource = self.returning.pop(0)
            if queue := sorted(self.queueing[resource]):
                self.queueing[resource].remove(queue[0])
                self.start(*queue[0][2:])
            else:
                self.free[resource] += 1
            return True
        return False

    def is_over(self, place: int, frame: int) -> bool:
        return frame != 0 and place in self.ended and self.now >= self.end

    def hand_on(self, place: int, frame: int) -> None:
        following = [p for p, s in enumerate(self.piped.stages) if s.after == place]
        if place == self.piped.tracker and frame == 0:
            following = []
        kept = 0
        for other in following:
            state = self.states[other]
            full = state.stage.queue is not None and len(state.waiting) >= state.stage.queue
            if (
                full
                and state.stage.when_full == "block"
                and frame
                and not self.refused(other, frame)
            ):
                state.held_up.append((frame, place))
                kept += 1
            else:
                self.enter(other, frame)
        if place >= 0:
            self.pending[place, frame] = kept
            if not kept:
                self.release(place, frame)

    def release(self, place: int, frame: int) -> None:
        self.log[place][frame].left = self.now
        self.states[place].idle += 1

    def refused(self, place: int, frame: int) -> str:
        state = self.states[place]
        if frame % state.stage.every != 0:
            return "NOT_ITS_TURN"
        if place == self.piped.tracker and frame < state.last:
            return "OVERTAKEN"
        if place == self.piped.tracker and frame > 0 and state.passages[0].arrived is None:
            return "TOO_EARLY"
        return ""

    def enter(self, place: int, frame: int) -> None:
        state = self.states[place]
        state.passages[frame].arrived = self.now
        if why := self.refused(place, frame):
            state.passages[frame].dropped = why
            state.passages[frame].gone = self.now
            return
        state.waiting = sorted([*state.waiting, frame])
        queue = state.stage.queue
        if queue is None or len(state.waiting) <= queue or state.stage.when_full == "block":
            return
        droppable = [each for each in state.waiting if each != 0]
        victim = droppable[0] if state.stage.when_full == "drop-oldest" else droppable[-1]
        state.waiting.remove(victim)
        state.passages[victim].dropped = "FULL"
        state.passages[victim].gone = self.now

    def take(self, place: int, state: _State) -> None:
        frame = state.waiting.pop(0)
        state.idle -= 1
        state.last = frame
        state.passages[frame].taken = self.now
        while state.held_up and len(state.waiting) < (state.stage.queue or 0):
            other, source = state.held_up.pop(0)
            self.enter(place, other)
            self.pending[source, other] -= 1
            if not self.pending[source, other]:
                self.release(source, other)
        if state.stage.resource is None:
            self.start(place, frame)
        else:
            self.asking.append((state.stage.priority, place, frame))

    def start(self, place: int, frame: int) -> None:
        state = self.states[place]
        if self.is_over(place, frame):
            state.passages[frame].dropped = "END"
            state.passages[frame].gone = self.now
            state.idle += 1
            assert state.stage.resource is not None
            self.returning.append(state.stage.resource)
            return
        state.passages[frame].started = self.now
        ns = state.stage.times[state.calls if state.stage.by_call else frame]
        state.calls += 1
        self.plan(self.now + ns, place, frame)

    def outputs(self) -> list[tuple[int, Fraction]]:
        """Frames that answer, with when: each is newer than those before it."""
        last = ([self.piped.tracker, *self.piped.below()])[-1]
        published = [
            (passage.finished, frame)
            for frame, passage in enumerate(self.log[last])
            if frame and passage.finished is not None
        ]
        newest: list[tuple[int, Fraction]] = []
        for when, frame in sorted(published):
            if newest and newest[-1][1] == when:  # at once with an older one
                newest.pop()
            if not newest or frame > newest[-1][0]:
                newest.append((frame, when))
        return newest

    def source(self, query: Fraction) -> int:
        """The frame of the output that answers a query."""
        return max((frame for frame, when in self.outputs() if when <= query), default=0)


INTERVALS = [Fraction(4), Fraction(7), Fraction(20, 3), Fraction(1), Fraction(12)]  # ns


@st.composite
def piped(draw: st.DrawFn, most: int = 12) -> Piped:
    """A random pipeline of up to five stages, and a sequence of up to ``most`` frames."""
    interval = draw(st.sampled_from(INTERVALS))
    length = draw(st.integers(1, most))
    if draw(st.booleans()):
        captured = [interval * frame for frame in range(length)]
    else:
        captured = [Fraction(0)]
        for _ in range(length - 1):
            captured.append(captured[-1] + draw(st.integers(1, 15)))
    count = draw(st.integers(1, 5))
    tracker = draw(st.integers(0, count - 1))
    resources = draw(st.sampled_from([{}, {"gpu": 1}, {"gpu": 1, "cpu": 2}]))
    stages: list[Staged] = []
    last = tracker  # of those below the tracker
    for place in range(count):
        if place <= tracker:
            after = draw(st.integers(-1, place - 1))
        else:
            after = draw(st.sampled_from([last, *range(-1, tracker)]))
            if after == last:
                last = place
        rules = ["drop-oldest", "drop-newest", *(["block"] if after >= 0 else [])]
        stages.append(
            Staged(
                "tracker" if place == tracker else f"s{place}",
                after,
                tuple(draw(st.lists(st.integers(0, 12), min_size=length, max_size=length))),
                draw(st.booleans()),
                draw(st.sampled_from([1, 1, 2, 3])),
                draw(st.sampled_from([1, 1, 2, 3, None])),
                draw(st.sampled_from(rules)),
                draw(st.sampled_from([None, *resources])),
                draw(st.integers(-1, 1)),
                draw(st.sampled_from([1, 1, 1, 2])),
            )
        )
    jitter = draw(st.lists(st.integers(0, 9), min_size=length, max_size=length))
    return Piped(
        interval,
        tuple(captured),
        draw(st.integers(0, 20)),
        tuple(jitter) if draw(st.booleans()) else (0,) * length,
        frozenset(draw(st.sets(st.integers(0, length - 1), max_size=3))),
        tuple(stages),
        tracker,
        resources,
    )


def by_name(log: Sequence[Any], stages: Sequence[Staged]) -> dict[str, Any]:
    return {stage.name: each for stage, each in zip(stages, log)}
