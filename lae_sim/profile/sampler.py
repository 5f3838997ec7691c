"""Sensors read in the background while a tracker runs, and what they say of its calls.

What a device takes between calls, when frames are decoded, is told apart from what it takes during
them. Of a power or a clock that is read now and then, the readings during calls count. Of a counter
of energy, each step is part of both: the two powers are those that explain the steps best. The
pauses between readings vary, so that they do not fall in step with the frames.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from time import perf_counter_ns
from types import TracebackType

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.profile.sensors import Sensor, attempt

INTERVAL_S = 0.05
"""The mean time between two readings of a sensor."""

SHARE = 0.005
"""Readings take no more of a core than this; where they are slow, there are fewer."""

GAP_S = 2.0
"""What was read this long ago says nothing of the power since; a counter still does."""

PATIENCE_S = 1.0
"""How long a reading may take before nobody waits for it any more."""

FEWEST = 5
"""Readings, or steps of a counter, that are enough to tell calls and pauses apart."""

ALIKE_S = 0.002
"""How precisely the time of a counter's value is known: some are renewed as rarely."""

LEAST_COVER = 0.5
"""A mean is told if its sensor answered during so much of the time."""


@dataclass
class Sampler:
    """Reads sensors in a thread, from ``with`` to its end.

    Without sensors there is no thread. A sensor that fails does so alone: what it said before and
    says later counts.

    Attributes:
        sensors: what to read.
        interval_s: mean time between two readings.
        failures: by the name of a sensor that failed, how many of its readings did.
        readings: how often all were read.
    """

    sensors: Sequence[Sensor]
    interval_s: float = INTERVAL_S
    failures: dict[str, int] = field(default_factory=dict)
    readings: int = 0

    def __post_init__(self) -> None:
        self._stamps: list[list[int]] = []
        self._values: list[list[float]] = []
        self._lock = threading.Lock()
        self._wanted, self._ended = threading.Event(), False
        self._fresh = threading.Condition(self._lock)
        self._thread: threading.Thread | None = None
        self._asked = ""  # the sensor that is being read
        self._waits = True

    def __enter__(self) -> Sampler:
        if self.sensors:
            self._thread = threading.Thread(target=self._run, name="sampler", daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended = True
        self._wanted.set()
        if self._thread is not None:
            self._thread.join(PATIENCE_S)

    def clear(self) -> None:
        """Forget what was read, and read all once now."""
        with self._lock:
            self._stamps, self._values = [], []
        self._refresh()

    def means(self, spans_ns: Ints) -> dict[str, float]:
        """The mean of each sensor over spans of time, in its unit; counters of energy, W.

        Args:
            spans_ns: beginnings and ends by ``perf_counter_ns``, int64 [n, 2].

        Returns:
            By the names of the sensors that answered during half of the time at least.
        """
        if not len(spans_ns) or not self.sensors:
            return {}
        self._refresh()
        found = {}
        for sensor, at_ns, read in self._read():
            value = mean_over(spans_ns, at_ns, read, sensor)
            if value is not None:
                found[sensor.name] = value
        return found

    def unread(self) -> dict[str, float]:
        """The shares of the readings, since they were cleared, that sensors failed in."""
        shares = {sensor.name: float(np.isnan(read).mean()) for sensor, _, read in self._read()}
        return {name: share for name, share in shares.items() if share}

    def rest(self, seconds: float) -> dict[str, float]:
        """The means over so many seconds, in which this thread does nothing."""
        if not self.sensors or not seconds:
            return {}
        self.clear()
        start = perf_counter_ns()
        time.sleep(seconds)
        return self.means(np.array([[start, perf_counter_ns()]]))

    def _read(self) -> Iterator[tuple[Sensor, Ints, Floats]]:
        """Of each sensor, when it was read and what it said."""
        with self._lock:
            stamps, values = np.array(self._stamps, np.int64), np.array(self._values, float)
        if len(stamps):
            yield from zip(self.sensors, stamps.T, values.T)

    def _refresh(self) -> None:
        """Have all read now; a sensor that hangs is not waited for again."""
        if self._thread is None or not self._waits:
            return
        with self._fresh:
            before = self.readings
            self._wanted.set()
            self._waits = self._fresh.wait_for(lambda: self.readings > before, PATIENCE_S)
            if not self._waits:
                self._count_failure(self._asked)

    def _count_failure(self, name: str) -> None:
        self.failures[name] = self.failures.get(name, 0) + 1

    def _run(self) -> None:
        chance = random.Random(0)
        while not self._ended:
            start = time.thread_time()
            stamps, values = [], []
            for sensor in self.sensors:
                self._asked, before = sensor.name, perf_counter_ns()
                value = attempt(sensor.read)
                stamps.append((before + perf_counter_ns()) // 2)
                values.append(np.nan if value is None else value)
                if value is None:
                    self._count_failure(sensor.name)
            with self._fresh:
                self._stamps.append(stamps)
                self._values.append(values)
                self.readings += 1
                self._wanted.clear()
                self._fresh.notify_all()
            if self._ended:  # said before it was wanted, which is forgotten now
                return
            pause = self.interval_s * chance.uniform(0.5, 1.5)
            self._wanted.wait(max(pause, (time.thread_time() - start) / SHARE))


def mean_over(spans_ns: Ints, at_ns: Ints, read: Floats, sensor: Sensor) -> float | None:
    """The mean of a sensor over spans of time; None where it was not read during half of it.

    Args:
        spans_ns: beginnings and ends, ascending, int64 [n, 2].
        at_ns: when it was read, ascending, int64 [k].
        read: what it said, float64 [k], NaN where nothing.
        sensor: the sensor.
    """
    answered = np.isfinite(read)
    at_ns, read = at_ns[answered], read[answered]
    if len(at_ns) < 2:
        return None
    seconds = np.diff(at_ns) / 1e9
    if sensor.counts:
        grown = np.diff(read)
        grown = np.where(grown < 0, grown + sensor.wraps_at, grown)
        known = np.isfinite(grown)
    else:
        grown = (read[1:] + read[:-1]) / 2 * seconds
        known = seconds < GAP_S
    during = _within(spans_ns, at_ns) * known
    if during.sum() <= LEAST_COVER * float(np.diff(spans_ns).sum()) / 1e9:
        return None
    if sensor.counts:
        here = known & (during > 0)
        if np.count_nonzero(here) >= FEWEST:
            return _rate_during(grown[here], during[here], (seconds - during)[here])
    else:
        inside = read[_are_within(spans_ns, at_ns)]
        if len(inside) >= FEWEST:
            return float(inside.mean())
    rates = np.where(known, grown, 0.0) / np.where(seconds > 0, seconds, 1.0)
    return float(rates @ during / during.sum())  # too few to tell calls and pauses apart


def _rate_during(grown: Floats, during: Floats, between: Floats) -> float:
    """The rate during calls that, with one between them, explains best what has grown.

    Least squares, neither rate below 0; where steps cannot tell the two apart, they are alike
    (a ridge, as of Hoerl and Kennard, 1970, on their difference).

    Args:
        grown: from each reading to the next, float64 [k].
        during, between: how many of the seconds from each to the next were calls, or not.
    """
    calls, pauses = during @ during + ALIKE_S**2, between @ between + ALIKE_S**2
    both = during @ between - ALIKE_S**2
    of_calls, of_pauses = grown @ during, grown @ between
    if of_pauses * calls < of_calls * both:  # less than nothing between calls
        return float(of_calls / calls)
    return max(0.0, float((of_calls * pauses - of_pauses * both) / (calls * pauses - both**2)))


def _within(spans_ns: Ints, at_ns: Ints) -> Floats:
    """How much of the time from each reading to the next lies in the spans, s, float64 [k - 1]."""
    start = at_ns[0]
    ends = np.concatenate([[0], np.cumsum(spans_ns[:, 1] - spans_ns[:, 0])])
    edges = (spans_ns - start).ravel()
    so_far = np.interp(at_ns - start, edges, np.repeat(ends, 2)[1:-1])
    seconds: Floats = np.diff(so_far) / 1e9
    return seconds


def _are_within(spans_ns: Ints, at_ns: Ints) -> Bools:
    """Which readings were made during the spans."""
    inside: Bools = np.searchsorted(spans_ns.ravel(), at_ns, side="right") % 2 == 1
    return inside
