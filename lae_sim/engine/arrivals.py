"""The clock of a sequence whose frames arrive at times of their own, as where some were dropped."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from lae_sim._arrays import Count, Ints
from lae_sim.engine.clock import MAX_INT64, Clock
from lae_sim.errors import LaeError, shown


def with_arrivals(clock: Clock, arrival_ns: Ints | Sequence[int] | None) -> Clock:
    """The clock of one sequence whose frames arrive at times of their own.

    Args:
        clock: of the nominal frame rate.
        arrival_ns: when each frame arrives, ns after the first one, int64 [T]; None where they
            arrive evenly.

    Returns:
        The clock itself where they arrive evenly.

    Raises:
        LaeError: if they do not ascend from 0, or an instant does not fit in 64-bit ticks.
    """
    if arrival_ns is None:
        return clock
    times = np.asarray(arrival_ns)
    if times.ndim != 1 or not len(times) or times.dtype.kind not in "iu":
        raise LaeError(f"arrival times are whole nanoseconds, one a frame, not {shown(times)}")
    if times[0] != 0 or (times[1:] <= times[:-1]).any():
        raise LaeError("arrival times ascend from 0, that of the first frame")
    last = max(int(times[-1]) * clock.ticks_per_ns, clock.arrival(len(times)))
    if last + clock.frame_ticks > MAX_INT64:
        raise LaeError(
            f"the last frame arrives after {int(times[-1])} ns, beyond 64-bit ticks: check the "
            f"arrival times, or write the frame rate {clock.fps} more simply"
        )
    ticks = times.astype(np.int64) * clock.ticks_per_ns
    if np.array_equal(ticks, clock.arrival(np.arange(len(ticks)))):
        return clock
    return _ArrivalClock(clock.ticks_per_ns, clock.frame_ticks, ticks)


def same_arrivals(told: Ints | None, own: Ints | None) -> bool:
    """Whether what another trace tells of when frames arrive agrees with one's own, ns [T].

    None tells nothing, and agrees with everything; as one's own it means that frames come evenly.
    """
    return told is None or (own is not None and np.array_equal(told, own))


@dataclass(frozen=True, eq=False, repr=False)
class _ArrivalClock(Clock):
    """Answers by a table.

    After its last frame frames go on at nominal intervals, since policies may ask.

    Attributes:
        ticks: when each frame arrives, int64 [T].
    """

    is_even: ClassVar[bool] = False

    ticks: Ints

    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __repr__(self) -> str:
        return f"<Clock at {self.fps} fps, {len(self.ticks):,} arrival times>"

    @cached_property
    def _table(self) -> list[int]:
        table: list[int] = self.ticks.tolist()  # in which bisect is fast
        return table

    def arrival(self, frame: Count) -> Count:
        if isinstance(frame, np.ndarray):
            return self.ticks[frame]
        beyond = frame - len(self._table) + 1
        return self._table[frame] if beyond <= 0 else self._table[-1] + beyond * self.frame_ticks

    def newest(self, tick: Count) -> Count:
        if isinstance(tick, np.ndarray):
            return np.searchsorted(self.ticks, tick, "right") - 1
        beyond = max(tick - self._table[-1], 0) // self.frame_ticks
        return bisect_right(self._table, tick) - 1 + beyond

    def end(self, length: int) -> int:
        if length != len(self.ticks):
            raise LaeError(f"{length} frames, but arrival times of {len(self.ticks)}")
        return self._table[-1] + self.frame_ticks

    def tail_shrinks(self, newest: Count, now: Count, later: int) -> Any:
        arrived, then = self.arrival(newest), now + later
        longer = later > self.arrival(newest + 1) - arrived
        return longer & (then - self.arrival(self.newest(then)) < now - arrived)

    def frame_time(self, frame: Count) -> Any:
        time = self.arrival(frame) / self.frame_ticks
        return time if isinstance(frame, np.ndarray) else FrameTime(time, frame)


class FrameTime(float):
    """When a frame arrives, in nominal frame intervals after frame 0; as an index, its number.

    Example:
        >>> from lae_sim.engine import Clock, with_arrivals
        >>> clock = with_arrivals(Clock.at(25), [0, 40_000_000, 120_000_000])  # one was dropped
        >>> frame = clock.frame_time(2)
        >>> frame - 1, ["a", "b", "c"][frame]
        (2.0, 'c')
    """

    def __new__(cls, time: float, number: int) -> FrameTime:
        """The time of the frame of that number."""
        made = super().__new__(cls, time)
        made._number = number
        return made

    _number: int

    def __index__(self) -> int:
        return self._number

    def __getnewargs__(self) -> tuple[float, int]:  # type: ignore[override]  # of copies
        return float(self), self._number
