"""A tracker with a stopwatch, wherever it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from lae_sim.datasets.frames import Image
from lae_sim.errors import LaeError


class TrackerError(LaeError):
    """A tracker that raised, crashed, or took too long; it must be initialised again."""


@dataclass(frozen=True)
class Answer:
    """What a tracker answered for a frame, and how long it took.

    Attributes:
        box: ``x, y, w, h`` in pixels, or None where the target was not found.
        score: the tracker's confidence, or None.
        elapsed_ns: wall time of the call, ns.
        cpu_ns: CPU time of the tracker's process during the call, ns, all threads.
        stages: what the stages took that the tracker marked, ns, by name; parts of ``elapsed_ns``.
    """

    box: tuple[float, float, float, float] | None
    score: float | None
    elapsed_ns: int
    cpu_ns: int
    stages: Mapping[str, int] = field(default_factory=dict)


class TimedTracker(Protocol):
    """A tracker and a stopwatch, in this process or another."""

    @property
    def sets_search(self) -> bool:
        """Whether the tracker can be told where to search."""

    def init(self, frame: Image, box: Sequence[float]) -> Answer:
        """Start on a new sequence; the answer's box is the given one."""

    def track(self, frame: Image, search: Sequence[float] | None = None) -> Answer:
        """Find the target in the next frame.

        Args:
            frame: uint8 [H, W, 3].
            search: centre and size ``cx, cy, w, h`` of the search in pixels, set before the
                stopwatch starts; only where ``sets_search``.

        Raises:
            TrackerError: if the tracker raised, crashed, answered anything but a box, or took
                too long.
        """

    def describe(self) -> Mapping[str, Any]:
        """What the tracker says of itself, and the interpreter and libraries it runs on."""

    def close(self) -> None:
        """End the tracker and what runs it."""
