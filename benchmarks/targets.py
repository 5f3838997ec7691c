"""What speed and memory are to be: the targets, and measurements that are held against them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Target:
    """What a figure must be: at most a limit, or at least.

    Attributes:
        work: what is measured, in words.
        limit: in the unit.
        unit: as it is printed after a figure.
        at_least: whether the figure must not be below the limit.
    """

    work: str
    limit: float
    unit: str
    at_least: bool = False

    def __str__(self) -> str:
        return f"{'>=' if self.at_least else '<='} {self.limit:g} {self.unit}"

    def worst(self, figures: Iterable[float]) -> float | None:
        """The figure that is farthest from the target, if there is one."""
        return (min if self.at_least else max)(figures, default=None)

    def is_met(self, figure: float) -> bool:
        """Whether a figure is as it must be."""
        return figure >= self.limit if self.at_least else figure <= self.limit


_TRACE = "one trace of UAV123's size, 51 sigmas, whole process"
_STUDY = "study of 8 such traces, 51 sigmas"
_SMALL = "traces of 8 x 60 frames, 20 datasets"
_READING = "x reading the file"

TARGETS = {
    "script-hold": Target(f"{_TRACE}: hold, against by_hand.py", 6, "x as fast", True),
    "script-kalman": Target(f"{_TRACE}: hold + kalman, the same", 100, "x as fast", True),
    "trace-hold": Target(f"{_TRACE}: hold", 2.5, _READING),
    "trace-kalman": Target(f"{_TRACE}: hold + kalman", 3, _READING),
    "constant-hold": Target(f"{_STUDY}, constant times: hold", 4, _READING),
    "constant-kalman": Target(f"{_STUDY}, constant times: hold + kalman", 6, _READING),
    "jitter-hold": Target(f"{_STUDY}, 10 % jitter: hold", 5, _READING),
    "jitter-kalman": Target(f"{_STUDY}, 10 % jitter: hold + kalman", 8, _READING),
    "schedule": Target("random latencies, 10,000 lanes: schedules", 150, "M frames/s", True),
    "scores": Target("random latencies: boxes and scores, hold", 20, "M frames/s", True),
    "kalman-lanes": Target("kalman over lanes: an update and a prediction", 0.02, "us"),
    "compare": Target("compare with tuned-kalman, a trace of DTB70's size", 2, "s"),
    "pairs": Target("a pair of trackers, 123 sequences", 0.2, "ms"),
    "small": Target(f"study of 1,000 {_SMALL}", 8, "s"),
    "small-again": Target(f"study of 1,000 {_SMALL}: nothing to do", 2, "s"),
    "large": Target(f"study of 10,000 {_SMALL}", 600, "s"),
    "large-parent": Target(f"study of 10,000 {_SMALL}: parent", 500, "MiB"),
    "large-report": Target(f"study of 10,000 {_SMALL}: report.html", 5, "MB"),
    "memory": Target("memory, 100,000 sequences: replay, hold + kalman", 150, "MiB"),
    "memory-grid": Target("memory, 100,000 sequences: 51 sigmas", 300, "MiB"),
    "workers": Target(f"{_STUDY}, 10 % jitter: 2 workers against 1", 1.7, "x as fast", True),
    "stopwatch": Target("profile: engine and stopwatch, 1 ms tracker", 10, "us"),
    "stopwatch-5ms": Target("profile: engine and stopwatch, 5 ms tracker", 50, "us"),
    "engine": Target("engine: schedule of latest, constant 47 ms", 1, "us a frame"),
    "learned": Target("learned: an update and a prediction", 40, "us"),
    "learned-lanes": Target("learned over lanes: an update and a prediction", 1.5, "us"),
    "search": Target("search model, c known", 2, "x without it"),
    "search-draws": Target("search model, c measured, 40 draws", 15, "x without it"),
    "help": Target("lae_sim.replay --help", 0.3, _READING),
}


@dataclass(frozen=True)
class Line:
    """A line of a table of measurements.

    Attributes:
        cells: as they are printed.
        figures: those that have targets, by their keys in :data:`TARGETS`.
    """

    cells: Sequence[str]
    figures: Mapping[str, float] = field(default_factory=dict)

    @property
    def row(self) -> list[str]:
        """What is printed of it, the targets too."""
        return [*self.cells, ", ".join(str(TARGETS[key]) for key in self.figures)]


@dataclass(frozen=True)
class Verdict:
    """A target beside what was measured: the worst, if several lines bear on it; None without."""

    target: Target
    figure: float | None

    @property
    def is_met(self) -> bool | None:
        """None if nothing was measured."""
        return None if self.figure is None else self.target.is_met(self.figure)

    @property
    def row(self) -> list[str]:
        """As it is printed."""
        measured = "" if self.figure is None else f"{self.figure:.3g} {self.target.unit}"
        words = {True: "met", False: "missed", None: "not measured"}
        return [self.target.work, measured, str(self.target), words[self.is_met]]

    def document(self) -> dict[str, Any]:
        """The same as JSON has it."""
        return {**vars(self.target), "measured": self.figure, "met": self.is_met}


def verdicts(lines: Sequence[Line]) -> list[Verdict]:
    """Every target, beside what was measured."""
    return [
        Verdict(target, target.worst(line.figures[key] for line in lines if key in line.figures))
        for key, target in TARGETS.items()
    ]
