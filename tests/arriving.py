"""Worlds whose frames arrive at times of their own, in Fractions: an independent witness.

It shares no code with the package: seconds instead of ticks, loops over all frames, no search.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from hypothesis import strategies as st


@dataclass(frozen=True)
class Arriving:
    """One sequence: frames per second, arrivals [T] and processing times [T], ns."""

    fps: Fraction
    arrival_ns: tuple[int, ...]
    elapsed_ns: tuple[int, ...]

    @property
    def interval(self) -> Fraction:
        return 1 / self.fps

    @property
    def end(self) -> Fraction:
        return self.arrival(len(self.arrival_ns) - 1) + self.interval

    def arrival(self, frame: int) -> Fraction:
        """In seconds; frames that are not there would come at nominal intervals."""
        last = len(self.arrival_ns) - 1
        beyond = max(frame - last, 0)
        return Fraction(self.arrival_ns[min(frame, last)], 10**9) + beyond * self.interval

    def newest(self, now: Fraction) -> int:
        frame = 0
        while self.arrival(frame + 1) <= now:
            frame += 1
        return frame

    def calls(self, policy: str) -> list[tuple[int, Fraction, Fraction]]:
        """Frame, start and ready of each call."""
        calls: list[tuple[int, Fraction, Fraction]] = []
        frame, now, late = 0, Fraction(0), 0
        while True:
            took = Fraction(self.elapsed_ns[frame], 10**9)
            calls.append((frame, now, now + took))
            ready = now + took
            late += took > self.interval
            following = self.next_frame(policy, frame, ready, took, late)
            start = self.arrival(following)
            if policy != "vot":
                start = max(start, ready)
            if following >= len(self.arrival_ns) or start >= self.end:
                return calls
            frame, now = following, start

    def next_frame(self, policy: str, last: int, now: Fraction, took: Fraction, late: int) -> int:
        if policy == "latest":
            return max(self.newest(now), last + 1)
        if policy.startswith("every"):
            return last + int(policy.removeprefix("every"))
        if policy.startswith("tail"):
            expected = Fraction(int(policy.removeprefix("tail")), 10**9)
            newest = self.newest(now)
            waits = False
            if expected > self.arrival(newest + 1) - self.arrival(newest):
                then = now + expected
                waits = then - self.arrival(self.newest(then)) < now - self.arrival(newest)
            return max(newest + waits, last + 1)
        owed = took - self.interval  # vot, with a grace of 1
        skipped = 0
        if late > 1:
            while owed > self.interval:
                owed -= self.interval
                skipped += 1
        return last + 1 + skipped

    def sources(self, policy: str, sigma: Fraction, cost_ns: int = 0) -> list[int]:
        """The frame of the output that answers each frame's query."""
        found = []
        for frame in range(len(self.arrival_ns)):
            query = self.arrival(frame) + sigma * self.interval
            source = 0
            for processed, _, ready in self.calls(policy)[1:]:
                if policy == "vot":
                    ready = self.arrival(processed)
                else:
                    ready += Fraction(cost_ns, 10**9)
                if ready <= query:
                    source = processed
            found.append(source)
        return found


# a few ns a frame, so that instants coincide
FEW_NS = [Fraction(10**9, 4), Fraction(10**9, 7), Fraction(3 * 10**9, 20), Fraction(10**9, 1)]


@st.composite
def arriving(draw: st.DrawFn, fps: Fraction | None = None, most: int = 12) -> Arriving:
    """A sequence of up to ``most`` frames."""
    steps = draw(st.lists(st.integers(1, 15), max_size=most - 1))
    arrivals = [0]
    for step in steps:
        arrivals.append(arrivals[-1] + step)
    length = len(arrivals)
    elapsed = draw(st.lists(st.integers(0, 30), min_size=length, max_size=length))
    rate = fps or draw(st.sampled_from(FEW_NS))
    return Arriving(rate, tuple(arrivals), tuple(elapsed))
