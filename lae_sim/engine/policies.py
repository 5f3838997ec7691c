"""Scheduling policies: which frame a free tracker processes next.

Each is a plain function of the clock and the calls so far (see :data:`.scheduler.Policy`), or
makes one. The last call's frame is the last one processed, the tick when it was ready is *now*, and
``clock.newest(now)`` is the newest frame that has arrived (equality counts). Those that need no
more than these two say so by a second method, :class:`LanePolicy`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from lae_sim._arrays import Count, Ints
from lae_sim.engine.clock import Clock, duration_ns
from lae_sim.engine.scheduler import Call, Policy


class LanePolicy(Protocol):
    """A policy that can also choose for many sequences at once (:mod:`lae_sim.engine.lanes`).

    Its frames start at once, or at their arrival if that is still to come.
    """

    def __call__(self, clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        """The frame to process next and the tick to start it."""

    def next_lanes(self, clock: Clock, last: Ints, now: Ints) -> Ints:
        """The frame of each lane, from its last one and the tick when that was ready.

        All are int64 [lanes]. A lane that has ended may be asked about, whatever the answer.
        """


class CompiledPolicy(LanePolicy, Protocol):
    """One whose rule two numbers say, so that it can be compiled (:mod:`.engine.kernels`)."""

    def in_numbers(self, clock: Clock) -> tuple[int, int] | None:
        """The rule of ``next_lanes`` where frames arrive evenly.

        Returns:
            The stride of a policy that takes every n-th frame, or 0; and from how many ticks after
            the newest frame's arrival on it waits for the next, or 0 if it never does. None if it
            has no such form.
        """


def _later(a: Count, b: Count) -> Count:
    """The greater of two frames, or of each two."""
    if type(a) is int:  # np.maximum on two numbers takes as long as the rest of the engine
        return a if a > b else b
    greater: Count = np.maximum(a, b)
    return greater


class _ByLastCall(ABC):
    """A policy by a rule that is the same for one sequence, in Python's integers, and for lanes.

    Numbers are no lane of one: they have any size, and take 1.4 us a call where an array of one
    takes 4.3.
    """

    @abstractmethod
    def next_lanes(self, clock: Clock, last: Count, now: Count) -> Count:
        """As in :class:`LanePolicy`; of numbers, a number."""

    def __call__(self, clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        last, _, now = calls[-1]
        frame = self.next_lanes(clock, last, now)
        arrival = clock.arrival(frame)
        return frame, now if now > arrival else arrival


@dataclass(frozen=True)
class _Latest(_ByLastCall):
    label: ClassVar[str] = "latest"

    def __call__(self, clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        last, _, now = calls[-1]  # of most replays, so without the rule's detours
        newest = clock.newest(now)
        if newest > last:
            return newest, now
        following = last + 1
        return following, clock.arrival(following)

    def next_lanes(self, clock: Clock, last: Count, now: Count) -> Count:
        return _later(clock.newest(now), last + 1)

    def in_numbers(self, clock: Clock) -> tuple[int, int]:
        return 0, 0


@dataclass(frozen=True)
class _Every(_ByLastCall):
    n: int

    @property
    def label(self) -> str:
        return "fifo" if self.n == 1 else f"every:{self.n}"

    def next_lanes(self, clock: Clock, last: Count, now: Count) -> Count:
        return last + min(self.n, _BEYOND)

    def in_numbers(self, clock: Clock) -> tuple[int, int] | None:
        return (min(self.n, _BEYOND), 0) if self.n > 0 else None


@dataclass(frozen=True)
class _ShrinkingTail(_ByLastCall):
    expected_ns: int

    @property
    def label(self) -> str:
        return f"shrinking-tail:{self.expected_ns}ns"

    def next_lanes(self, clock: Clock, last: Count, now: Count) -> Count:
        newest = clock.newest(now)
        expected = self.expected_ns * clock.ticks_per_ns
        chosen: Count = newest + clock.tail_shrinks(newest, now, expected)
        return _later(chosen, last + 1)

    def in_numbers(self, clock: Clock) -> tuple[int, int]:
        interval, expected = clock.frame_ticks, self.expected_ns * clock.ticks_per_ns
        return 0, interval - expected % interval if expected > interval else 0


_BEYOND = 2**40  # no sequence has so many frames

latest: LanePolicy = _Latest()
"""The newest frame that has arrived, or the next to arrive (PVT 2021, Eqs. 3-4)."""

fifo: LanePolicy = _Every(1)
"""Every frame in order; frames queue while the tracker is busy."""


def every(n: int) -> LanePolicy:
    """Every ``n``-th frame in order, a fixed stride; they queue if the tracker is slower."""
    return _Every(n)


def shrinking_tail(expected: str | None = None, *, ns: int | None = None) -> LanePolicy:
    """The newest frame, or the next one if waiting for it lowers the expected tail.

    Li, Wang and Ramanan, "Towards Streaming Perception" (2020), Alg. 1: with the tail
    tau(t) = t - floor(t) in frames, a tracker that becomes free at s and needs r > 1 frames waits
    iff tau(s + r) < tau(s). A tracker that needs at most one frame interval never waits. Where
    frames arrive at times of their own, tau(t) is the time since the last arrival up to t, and the
    interval is the one from the newest frame to the next, as if the camera announced its frames.

    Args:
        expected: the expected processing time r with its unit, such as ``"47ms"``.
        ns: the same in nanoseconds.

    Raises:
        LaeError: if it is not a duration.
    """
    return _ShrinkingTail(duration_ns(expected, ns))


def listed(frames: Sequence[int]) -> Policy:
    """These frames in order; they queue if the tracker is slower."""

    def next_listed(clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        _, _, now = calls[-1]
        frame = frames[len(calls)] if len(calls) < len(frames) else frames[-1] + _BEYOND
        return frame, max(now, clock.arrival(frame))

    return next_listed


@dataclass(frozen=True)
class _VotRealtime:
    grace: int
    scores_latency: ClassVar[bool] = False

    @property
    def label(self) -> str:
        return f"vot-realtime:{self.grace}"

    def __call__(self, clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        interval = clock.frame_ticks
        last, start, ready = calls[-1]
        overtime = ready - start - interval
        skipped = 0
        if overtime > interval and _late_calls(calls, interval, self.grace + 1) > self.grace:
            skipped = -(-overtime // interval) - 1
        following = last + 1 + skipped
        return following, clock.arrival(following)


def vot_realtime(grace: int = 3) -> Policy:
    """The real-time rule of the VOT toolkit, which skips frames but never scores latency.

    Every call starts at its frame's arrival, as if the tracker were free. A call that takes longer
    than the frame interval owes its overtime: while more than one interval is owed, a frame is
    skipped and one interval repaid; what is left is forgiven. The first ``grace`` calls over time
    owe nothing (VOT 2022: 3). The toolkit scores each output at its own frame, and so does
    whatever evaluates such a schedule (see :class:`.scheduler.Schedule`). It knows frames, not
    times: the interval is the nominal one also where frames arrive at times of their own.
    """
    return _VotRealtime(grace)


def _late_calls(calls: Sequence[Call], interval: int, most: int) -> int:
    """How many calls took longer than a frame interval, counted up to ``most``."""
    late = 0
    for _, start, ready in calls:
        late += ready - start > interval
        if late == most:
            break
    return late
