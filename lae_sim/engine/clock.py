"""Exact time: rational frame rates, integer nanoseconds, integer ticks.

No float decides an event. With a world rate of p/q frames per second, one tick is 1/p ns: frame
``i`` arrives at exactly ``i * q * 10**9`` ticks, and ``n`` ns are ``n * p`` ticks. Where a trace
says when each frame really arrived, frame ``i`` arrives at ``arrival_ns[i] * p`` ticks instead, and
``q * 10**9`` ticks are the *nominal* frame interval: :class:`Clock` answers for both.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from numbers import Integral
from operator import index
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

from lae_sim.errors import LaeError, shown

if TYPE_CHECKING:  # command lines read numbers before they need NumPy
    from lae_sim._arrays import Count

NS_PER_SECOND = 10**9
MAX_INT64 = 2**63 - 1

Number: TypeAlias = int | float | str | Fraction
"""A number where users give one: see :func:`exact`."""

_DECIMAL = r"[0-9]{1,12}(?:\.[0-9]{1,12})?"
_RATIONAL = re.compile(rf"(?:{_DECIMAL}|[0-9]{{1,12}}/[0-9]{{1,12}})\Z")
_DURATION = re.compile(rf"({_DECIMAL})(ns|us|ms|s)\Z")
_BUDGET = re.compile(rf"({_DECIMAL}) ?(s|min|m|h)\Z")
_BUDGET_S = {"s": 1, "m": 60, "min": 60, "h": 3600}
UNIT_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": NS_PER_SECOND}


def parse_rational(text: str) -> Fraction:
    """Read an exact number such as ``"30"``, ``"29.97"``, ``"30000/1001"`` or ``"-1/2"``.

    Raises:
        LaeError: if the text is not a plain decimal or fraction.
    """
    digits = text[1:] if text.startswith("-") else text
    if not _RATIONAL.match(digits) or re.search(r"/0+\Z", digits):
        raise LaeError(
            f"{text[:40]!r} is not an exact number of at most 12 digits: write 30, 29.97 or "
            "30000/1001"
        )
    return Fraction(text)


def exact(value: Number) -> Fraction:
    """A number as it is written: text, or a plain number.

    A float is what its shortest decimal form says: 1.5 is 3/2, 0.1 is 1/10.

    Raises:
        LaeError: if it is no exact number, such as ``"1/0"``, 1e-9 or ``True``.
    """
    if isinstance(value, Integral) and not isinstance(value, bool):
        return Fraction(int(value))  # one of NumPy's too
    if isinstance(value, bool) or not isinstance(value, (float, str, Fraction)):
        raise LaeError(f"{shown(value)} is not an exact number, such as 2, 0.5 or '1/3'")
    return value if isinstance(value, Fraction) else parse_rational(str(value))


def parse_fps(value: Number) -> Fraction:
    """Read a frame rate in frames per second.

    Raises:
        LaeError: if it is not an exact number above zero.
    """
    fps = exact(value)
    if fps <= 0:
        raise LaeError(f"a frame rate must be above zero, not {value!r}")
    return fps


def parse_stride(value: Number) -> Fraction:
    """Read the stride of a pass (see :mod:`lae_sim.replay.strides`), such as ``2`` or ``3/2``.

    Raises:
        LaeError: if it is not an exact number above 1, or its numerator is above 1000.
    """
    stride = exact(value)
    if not (stride > 1 and stride.numerator <= 1000):
        raise LaeError(f"a stride is above 1, such as 2 or 3/2, not {value!r}")
    return stride


def parse_duration(text: str) -> int:
    """Read a duration with its unit (``"47ms"``, ``"0.1s"``) as integer nanoseconds.

    Raises:
        LaeError: if the unit is missing, or the duration is not a whole number of nanoseconds that
            fits in 64 bits.
    """
    match = _DURATION.match(text) if isinstance(text, str) else None
    if match is None:
        raise LaeError(f"{shown(text)} is not a duration: write it with its unit, such as 47ms")
    duration = Fraction(match[1]) * UNIT_NS[match[2]]
    if duration.denominator != 1:
        raise LaeError(f"{text!r} is not a whole number of nanoseconds")
    return fitting(int(duration), text)


def fitting(ns: int, text: str) -> int:
    """A time in ns as it is, if a trace can hold it.

    Raises:
        LaeError: if it does not fit in 64 bits; it quotes ``text``.
    """
    if ns > MAX_INT64:
        raise LaeError(f"{text}: too long a time: 292 years are the most")
    return ns


def parse_budget(text: str) -> int:
    """Read how long something may take (``"10m"``, ``"90s"``, ``"1.5h"``), in ns.

    Minutes are no unit of a processing time, where ``47m`` is a slip for ``47ms``.

    Raises:
        LaeError: if the unit is missing, or it is no time at all.
    """
    match = _BUDGET.match(text) if isinstance(text, str) else None
    budget = Fraction(match[1]) * _BUDGET_S[match[2]] * NS_PER_SECOND if match else Fraction(0)
    if budget < 1:
        raise LaeError(f"{shown(text)} is no time to spend: write it with its unit, such as 10m")
    return int(budget)


def split_init(text: str, path: bool = False) -> tuple[str, int | None]:
    """Split the name of some times, such as ``"constant:47ms,init=800ms"``.

    Args:
        text: the name, which may end in ``,init=TIME``: what the initialisation takes.
        path: whether the name is that of a file, which may hold commas of its own; the parameters
            of a plug-in do anyway.

    Returns:
        The name alone, and the time of the initialisation, ns; None if it is not named.

    Raises:
        LaeError: if that is not a duration, or something else stands behind the comma.
    """
    name, _, value = text.rpartition(",init=") if ",init=" in text else (text, "", None)
    if ",init=" in name:
        raise LaeError(f"{text!r}: init stands twice")
    options = name.partition(",")[0].count(":") > 1  # as module:object:a=1,b=2 has
    if "," in name and not path and not options:
        rest = name.partition(",")[2]
        raise LaeError(f"{text!r}: no {rest!r} here: after a comma comes init=TIME, as init=800ms")
    if value is None:
        return name, None
    try:
        return name, parse_duration(value)
    except LaeError as error:
        if _DURATION.match(value):  # too long, or too fine
            raise LaeError(f"{text!r}: init={error}") from error
        raise LaeError(
            f"{text!r}: init={value}: write a time of 0 or more with its unit, as init=800ms"
        ) from error


def duration_ns(duration: str | None, ns: int | None) -> int:
    """A duration that is given as text with a unit, or as integer nanoseconds by name.

    Raises:
        LaeError: if it is given in no way or in both, or is below zero.
        TypeError: if ``ns`` is not an integer, such as seconds as a float.
    """
    if (duration is None) == (ns is None):
        raise LaeError("give a duration as text with its unit, such as '47ms', or as ns=47_000_000")
    found = parse_duration(duration) if duration is not None else index(ns or 0)
    if found < 0:
        raise LaeError(f"a processing time cannot be negative ({found} ns)")
    return found


def whole(value: int | str, least: int = 0) -> int:
    """A whole number from ``least``, or the text of one.

    Raises:
        LaeError: if it is none, too low, or does not fit in 64 bits.
    """
    written = isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 19
    counted = isinstance(value, Integral) and not isinstance(value, bool)
    number = int(value) if written or counted else -1
    if not least <= number <= MAX_INT64:
        raise LaeError(f"{shown(value)} is not a whole number from {least}")
    return number


@dataclass(frozen=True)
class Clock:
    """The tick clock of one world frame rate.

    Policies ask it when a frame arrives (:meth:`arrival`), which is the newest one (:meth:`newest`)
    and when the stream ends (:meth:`end`), rather than count intervals, and so are right also
    where frames arrive at times of their own (:func:`.arrivals.with_arrivals`).

    Attributes:
        ticks_per_ns: p, the numerator of the frame rate p/q.
        frame_ticks: ticks of the nominal frame interval, ``q * 10**9``.
        is_even: whether frames arrive at equal intervals.

    Example:
        >>> from lae_sim.engine import Clock, with_arrivals
        >>> clock = Clock.at(30)
        >>> clock.arrival(2) / clock.ticks_per_ns == 2e9 / 30, clock.newest(clock.arrival(2))
        (True, 2)
        >>> dropped = with_arrivals(clock, [0, 33_333_333, 100_000_000])  # one frame never came
        >>> dropped.newest(clock.arrival(2)), dropped.end(3) == clock.end(4)
        (1, True)
    """

    is_even: ClassVar[bool] = True

    ticks_per_ns: int
    frame_ticks: int

    @classmethod
    def at(cls, fps: Fraction) -> Clock:
        """The clock of a world that delivers ``fps`` frames per second.

        Raises:
            LaeError: if it is not an exact number.
        """
        if not isinstance(fps, (Fraction, int)):
            raise LaeError(f"a frame rate must be exact: parse_fps('30000/1001'), not {fps!r}")
        return Clock(fps.numerator, fps.denominator * NS_PER_SECOND)

    @property
    def fps(self) -> Fraction:
        """World frames per second."""
        return Fraction(self.ticks_per_ns * NS_PER_SECOND, self.frame_ticks)

    def arrival(self, frame: Count) -> Count:
        """The tick at which a frame arrives, or int64 [n] of n frames."""
        return frame * self.frame_ticks

    def newest(self, tick: Count) -> Count:
        """The newest frame that has arrived at a tick, equality counts."""
        return tick // self.frame_ticks

    def end(self, length: int) -> int:
        """The tick at which a stream of so many frames ends: an interval after the last one."""
        return length * self.frame_ticks

    def tail_shrinks(self, newest: Count, now: Count, later: int) -> Any:
        """Whether an answer at ``now + later`` has a shorter tail than one at ``now``, bool.

        A tail is the time since the newest frame arrived. Where ``later`` is at most the interval
        from that frame to the next, it does not count as shorter.

        Args:
            newest: the newest frame that has arrived at ``now``.
            now: a tick.
            later: ticks from it to another.
        """
        interval = self.frame_ticks  # a tail shrinks where adding to it reaches an arrival
        return later > interval and now - newest * interval >= interval - later % interval

    def frame_time(self, frame: Count) -> Any:
        """When a frame arrives, in nominal frame intervals after frame 0: its number, or a float.

        It is its number where frames arrive evenly. Elsewhere it is a float, and of a single frame
        a :class:`.arrivals.FrameTime`, which knows the number as well.
        """
        return frame

    def milliseconds(self, frames: Fraction | int) -> float:
        """A time given in frames as milliseconds, for display."""
        return float(frames / self.fps * 1000)

    def arrival_ms(self, frame: int, sigma: Fraction = Fraction(0)) -> float:
        """When a frame's query is, ``sigma`` nominal intervals after its arrival, for display."""
        return self.milliseconds(Fraction(self.arrival(frame), self.frame_ticks) + sigma)

    def query(self, frame: int, sigma: Fraction = Fraction(0)) -> int:
        """The tick of that query, or the one before where it is between two ticks."""
        return self.arrival(frame) + int(sigma * self.frame_ticks // 1)
