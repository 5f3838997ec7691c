"""The scheduler: which frames a busy tracker processes, and when its outputs are ready.

This is the scheduler of one tracker that takes its frames itself; :mod:`.engine.stages` is that of
whole pipelines. A *service* says how long a frame takes (a live tracker
runs and is timed; a recorded one looks the time up), a *policy* says which frame is next, and
SimPy moves the clock. See Li et al., "Predictive Visual Tracking" (2021), Eqs. 3 and 4.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import index, itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim._arrays import Bools, Ints
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError, shown

if TYPE_CHECKING:
    import simpy


Call = tuple[int, int, int]
"""One call of the tracker: frame, start, ready; instants in ticks (a bare tuple, for speed)."""

Service = Callable[[int], int]
"""``service(frame)`` processes a world frame and returns the time it took, in ns."""

Policy = Callable[[Clock, Sequence[Call]], tuple[int, int]]
"""``policy(clock, calls)`` returns the frame to process next and the tick to start it.

``calls`` holds the calls so far, the last one being the call that has just become ready. It must
depend on nothing else, so that a replay repeats a profile. The frame must be newer than
the last call's; a frame beyond the sequence ends it. ``clock.arrival(frame)`` and
``clock.newest(tick)`` say when frames arrive; multiples of ``clock.frame_ticks`` do so only where
they arrive evenly.

A policy with an attribute ``scores_latency`` that is False never scores latency: its outputs count
from the arrival of their own frames (see :class:`Schedule`).
"""


NEVER = 2**62
"""A tick that never comes."""


@dataclass(frozen=True, eq=False, repr=False)
class Schedule:
    """What one sequence's processing looked like, in processing order.

    Attributes:
        clock: the tick clock of the instants.
        length: number of world frames T.
        frames: processed frames, int64 [n], increasing, the first is 0.
        start: when each began, int64 [n], ticks.
        ready: when each output became available, int64 [n], ticks.
        scores_latency: whether an output counts only once it is ready, as the policy has it; False
            under the VOT toolkit's rule, which lets it count from its own frame's arrival.
        visible: from when each output answers queries, int64 [n], ticks, never decreasing;
            ``NEVER`` for one that never does. None: from when it is ready. Stages after a tracker
            make it later (see :class:`.stages.PipelineSchedule`).
        delivered: when each world frame reached the first stage, int64 [T], ticks; -1 where none
            did. None: as it was captured.
    """

    clock: Clock
    length: int
    frames: Ints
    start: Ints
    ready: Ints
    scores_latency: bool = True
    visible: Ints | None = None
    delivered: Ints | None = None

    def __repr__(self) -> str:
        processed = f"{len(self.frames):,} of {self.length:,} frames processed"
        return f"<Schedule at {self.clock.fps} fps: {processed}>"

    @property
    def elapsed_ns(self) -> Ints:
        """Processing time of each call, int64 [n], ns."""
        elapsed: Ints = (self.ready - self.start) // self.clock.ticks_per_ns
        return elapsed


@dataclass(frozen=True, eq=False, repr=False)
class Schedules:
    """Schedules of S sequences, their calls one after another.

    Attributes:
        clocks: of each sequence.
        lengths: number of world frames of each, int64 [S].
        offsets: first call of each, and n: int64 [S + 1].
        frames, start, ready: see :class:`Schedule`, int64 [n].
        scores_latency: of each sequence, bool [S].
        whole: each by itself, where they know more than that; None where they do not.
    """

    clocks: tuple[Clock, ...]
    lengths: Ints
    offsets: Ints
    frames: Ints
    start: Ints
    ready: Ints
    scores_latency: Bools
    whole: tuple[Schedule, ...] | None = None

    def __len__(self) -> int:
        """Number of sequences S."""
        return len(self.clocks)

    def __getitem__(self, s: int) -> Schedule:
        """That of one sequence."""
        if self.whole is not None:
            return self.whole[s]
        calls = slice(int(self.offsets[s]), int(self.offsets[s + 1]))
        columns = self.frames[calls], self.start[calls], self.ready[calls]
        return Schedule(
            self.clocks[s], int(self.lengths[s]), *columns, bool(self.scores_latency[s])
        )

    def __iter__(self) -> Iterator[Schedule]:
        """Each, in order."""
        return map(self.__getitem__, range(len(self)))

    @property
    def kinds(self) -> Collection[Clock]:
        """The clocks, each object once: to hash those of many lanes takes long."""
        return dict(zip(map(id, self.clocks), self.clocks)).values()

    @property
    def visible(self) -> Ints:
        """From when each output answers queries, int64 [n], ticks; see :class:`Schedule`."""
        if self.whole is None:
            return self.ready
        each = [one.ready if one.visible is None else one.visible for one in self.whole]
        return np.concatenate(each)

    def part(self, begin: int, end: int) -> Schedules:
        """Those of some sequences, one after another."""
        some, offsets = slice(begin, end), self.offsets[begin : end + 1]
        calls = slice(offsets[0], offsets[-1])
        return Schedules(
            self.clocks[some],
            self.lengths[some],
            offsets - offsets[0],
            self.frames[calls],
            self.start[calls],
            self.ready[calls],
            self.scores_latency[some],
            None if self.whole is None else self.whole[some],
        )

    @classmethod
    def of(cls, schedules: Sequence[Schedule]) -> Schedules:
        """Some schedules, at least one, as one record."""
        counts = [len(each.frames) for each in schedules]
        return cls(
            tuple(each.clock for each in schedules),
            np.array([each.length for each in schedules], np.int64),
            np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]),
            np.concatenate([each.frames for each in schedules]),
            np.concatenate([each.start for each in schedules]),
            np.concatenate([each.ready for each in schedules]),
            np.array([each.scores_latency for each in schedules]),
            None if all(each.visible is None for each in schedules) else tuple(schedules),
        )

    @classmethod
    def joined(cls, parts: Sequence[Schedules]) -> Schedules:
        """Those of several such records as one."""
        counts = np.concatenate([np.diff(part.offsets) for part in parts])
        return cls(
            tuple(chain.from_iterable(part.clocks for part in parts)),
            np.concatenate([part.lengths for part in parts]),
            np.concatenate([[0], np.cumsum(counts)]),
            np.concatenate([part.frames for part in parts]),
            np.concatenate([part.start for part in parts]),
            np.concatenate([part.ready for part in parts]),
            np.concatenate([part.scores_latency for part in parts]),
            None if all(part.whole is None for part in parts) else tuple(chain(*parts)),
        )


def simulate(length: int, clock: Clock, service: Service, policy: Policy) -> Schedule:
    """Schedule one sequence of ``length`` world frames.

    Frame 0 starts at time 0 (the initialisation); after that the policy chooses, until it would
    start at or after the end of the stream, a nominal frame interval after the last arrival.

    Args:
        length: number of world frames.
        clock: the world's.
        service: how long a frame takes, ns.
        policy: which frame is next.

    Raises:
        LaeError: if the sequence is empty, or not as long as the clock's arrival times, a time is
            negative, a policy goes back in time, or an instant does not fit in 64-bit ticks.
        TypeError: if a time is not an integer, such as seconds as a float.

    Example:
        >>> import lae_sim
        >>> from lae_sim.engine import Clock, latest
        >>> schedule = lae_sim.simulate(9, Clock.at(30), lambda frame: 47_000_000, latest)
        >>> schedule.frames.tolist()
        [0, 1, 2, 4, 5, 7, 8]
    """
    import simpy

    if not isinstance(clock, Clock):
        raise LaeError(f"clock: such as Clock.at(30), not {shown(clock)}")
    if length < 1:
        raise LaeError("a sequence needs at least one frame")
    calls: list[Call] = []
    environment = simpy.Environment()
    environment.process(_tracker(environment, length, clock, service, policy, calls))
    environment.run()
    try:
        flat = np.fromiter(chain.from_iterable(calls), np.int64, 3 * len(calls))
    except OverflowError as error:
        frame, _, ready = max(calls, key=itemgetter(2))
        raise LaeError(
            f"the output of frame {frame} is ready at tick {ready}, beyond 64 bits: "
            f"check the processing times, or write the frame rate {clock.fps} more simply"
        ) from error
    frames, starts, readies = flat.reshape(-1, 3).T.copy()
    return Schedule(clock, length, frames, starts, readies, scores_latency(policy))


def scores_latency(policy: Policy) -> bool:
    """Whether a policy's outputs count only once they are ready (see :data:`Policy`)."""
    return bool(getattr(policy, "scores_latency", True))


def _tracker(
    environment: simpy.Environment,
    length: int,
    clock: Clock,
    service: Service,
    policy: Policy,
    calls: list[Call],
) -> Generator[simpy.Event, Any, None]:
    """The tracker as a SimPy process with one timeout for each frame that it processes."""
    ticks_per_ns, end = clock.ticks_per_ns, clock.end(length)
    arrival, timeout = clock.arrival, environment.timeout
    frame = start = 0
    while True:
        elapsed_ns = index(service(frame))
        if elapsed_ns < 0:
            raise LaeError(f"frame {frame}: a processing time cannot be negative ({elapsed_ns} ns)")
        calls.append((frame, start, start + elapsed_ns * ticks_per_ns))
        following, begin = policy(clock, calls)
        if following >= length or begin >= end:
            return
        if following <= frame or begin < start or begin < arrival(following):
            raise LaeError(
                f"the policy answered frame {following} at tick {begin} after frame {frame}: "
                "it must move forward, and cannot start a frame before clock.arrival(frame)"
            )
        yield timeout(begin - start)
        frame, start = following, begin
