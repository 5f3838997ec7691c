"""Processing times that are known before the first call."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from lae_sim._arrays import Ints
from lae_sim.engine.scheduler import Service
from lae_sim.errors import LaeError

SKIPPED = (
    "the trace has no time for it, since the tracker skipped it; use the times by call, or a trace "
    "of every frame, or the policy that it was recorded under"
)


@dataclass(frozen=True, eq=False)
class Times:
    """A service whose times are all known before the first call.

    Attributes:
        name: the sequence's name.
        ns: int64 [n], at most the number of world frames; -1 where there is none.
        by_call: whether the k-th call takes the k-th of them, rather than each frame its own.
        absent: what is said of a frame that has none.
    """

    name: str
    ns: Ints
    by_call: bool = False
    absent: str = SKIPPED

    def __call__(self, frame: int) -> int:
        """The time of the next call, which is that of a frame.

        Raises:
            LaeError: if there is none.
        """
        return self._answer(frame)

    @cached_property
    def _answer(self) -> Service:
        if self.by_call:
            return _next_time(self.name, self.ns.tolist())
        return _frames_own(self.name, self.ns.tolist(), self.absent)


def _frames_own(name: str, elapsed: list[int], absent: str) -> Service:
    def look_up(frame: int) -> int:
        ns = elapsed[frame]
        if ns < 0:
            raise LaeError(f"sequence {name!r}, frame {frame}: {absent}")
        return ns

    return look_up


def _next_time(name: str, elapsed: list[int]) -> Service:
    times = iter(elapsed)

    def next_time(frame: int) -> int:
        for ns in times:
            return ns
        raise LaeError(
            f"sequence {name!r}, frame {frame}: call {len(elapsed) + 1} is asked for, "
            f"and the trace holds the times of {len(elapsed)} calls"
        )

    return next_time
