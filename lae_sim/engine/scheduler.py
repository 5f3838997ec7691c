"""The scheduler: which frames a busy tracker processes, and when its outputs are ready.

This is the scheduler of one tracker that takes its frames itself; :mod:`.engine.stages` is that of
whole pipelines. A *service* says how long a frame takes (a live tracker
runs and is timed; a recorded one looks the time up), a *policy* says which frame is next, and
SimPy moves the clock. See Li et al., "Predictive Visual Tracking" (2021), Eqs. 3 and 4.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import index, itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim._arrays import Ints
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
    """

    clock: Clock
    length: int
    frames: Ints
    start: Ints
    ready: Ints
    scores_latency: bool = True
    visible: Ints | None = None

    def __repr__(self) -> str:
        processed = f"{len(self.frames):,} of {self.length:,} frames processed"
        return f"<Schedule at {self.clock.fps} fps: {processed}>"

    @property
    def elapsed_ns(self) -> Ints:
        """Processing time of each call, int64 [n], ns."""
        elapsed: Ints = (self.ready - self.start) // self.clock.ticks_per_ns
        return elapsed


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
