"""One sequence of a trace in memory."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sized
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.engine.scheduler import Schedule
from lae_sim.errors import LaeError
from lae_sim.trackers.stages import STAGE_NAME, checked_stage

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """One sequence of a trace, by world frame.

    Attributes:
        name: the sequence's name.
        truth: ground truth boxes ``x, y, w, h`` in pixels, float64 [T, 4]; NaN = none.
        boxes: the tracker's boxes, float64 [T, 4]; NaN = frame not processed.
        elapsed_ns: processing times in ns, int64 [T]; -1 = frame not processed.
        score: the tracker's confidence, float32 [T]; NaN = none.
        arrival_ns: when each frame arrived, ns after the first, int64 [T], ascending from 0; None =
            at the world's frame rate.
        visible: False where the annotators say that the target is absent or fully covered, bool
            [T]; None = they say nothing.
        stages: parts of the processing times in ns by the name of the stage, such as
            ``"inference"``, int64 [T] each; -1 = unknown, as where the frame was not processed.

    Example:
        >>> import lae_sim
        >>> truth = [[10, 20, 30, 40], [12, 20, 30, 40]]
        >>> boxes = [[10, 20, 30, 40], [11, 20, 30, 40]]
        >>> recording = lae_sim.Recording.new("car", truth, boxes, [5_000_000, 47_000_000])
        >>> len(recording), recording.elapsed_ns.tolist()
        (2, [5000000, 47000000])
    """

    name: str
    truth: Floats
    boxes: Floats
    elapsed_ns: Ints
    score: npt.NDArray[np.float32]
    arrival_ns: Ints | None = None
    visible: Bools | None = None
    stages: Mapping[str, Ints] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of world frames T."""
        return len(self.elapsed_ns)

    def __repr__(self) -> str:
        processed = int((self.elapsed_ns >= 0).sum())
        return f"<Recording of {self.name!r}: {len(self):,} frames, {processed:,} processed>"

    def to_frame(self) -> DataFrame:
        """A row per world frame, with the columns of the trace format; NaN is unknown."""
        import pandas as pd

        columns = {"sequence": self.name, "frame": np.arange(len(self))}
        columns |= dict(zip(("truth_x", "truth_y", "truth_w", "truth_h"), self.truth.T))
        columns |= dict(zip(("x", "y", "w", "h"), self.boxes.T))
        columns |= {"elapsed_ns": self.elapsed_ns, "score": self.score}
        return pd.DataFrame(columns | self.columns)

    @property
    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """What it has of a trace's optional columns, by their names."""
        found: dict[str, npt.NDArray[Any]] = {}
        if self.arrival_ns is not None:
            found["arrival_ns"] = self.arrival_ns
        if self.visible is not None:
            found["visible"] = self.visible
        if self.stages:  # most have none, and there may be many recordings
            found |= {stage_column(name): self.stages[name] for name in in_order(self.stages)}
        return found

    @classmethod
    def new(
        cls,
        name: str,
        truth: npt.ArrayLike,
        boxes: npt.ArrayLike,
        elapsed_ns: npt.ArrayLike,
        score: npt.ArrayLike | None = None,
        arrival_ns: npt.ArrayLike | None = None,
        visible: npt.ArrayLike | None = None,
        stages: Mapping[str, npt.ArrayLike] | None = None,
    ) -> Recording:
        """A recording from anything array-like (not copied); what is optional defaults to none.

        Raises:
            LaeError: if the lengths differ, something is not made of numbers, or a stage has no
                name of small letters, digits and underscores.
        """
        try:
            times = _whole(elapsed_ns, f"{name}: elapsed_ns")
            no_score = np.full(len(times), np.nan, np.float32)
            recording = cls(
                name,
                np.asarray(truth, np.float64).reshape(-1, 4),
                np.asarray(boxes, np.float64).reshape(-1, 4),
                times,
                no_score if score is None else np.asarray(score, np.float32),
                None if arrival_ns is None else _whole(arrival_ns, f"{name}: arrival_ns"),
                None if visible is None else _flags(visible, f"{name}: visible"),
                {
                    stage: _whole(ns, f"{name}: {stage_column(stage)}")
                    for stage, ns in (stages or {}).items()
                },
            )
        except (TypeError, ValueError) as error:
            raise LaeError(f"{name}: not boxes [T, 4] and times in ns [T]: {error}") from error
        names = ("truth", "boxes", "elapsed_ns", "score")
        known = {each: getattr(recording, each) for each in names} | recording.columns
        lengths = {len(values) for values in known.values()}
        if len(lengths) != 1:
            raise LaeError(f"{name}: differ in length: {', '.join(known)}: {sorted(lengths)}")
        return recording

    @classmethod
    def of_run(
        cls,
        name: str,
        schedule: Schedule,
        boxes: Floats,
        truth: Floats,
        score: npt.NDArray[np.float32] | None = None,
        visible: Bools | None = None,
    ) -> Recording:
        """The real-time recording of a schedule.

        Args:
            name: the sequence's name.
            schedule: what the engine returned.
            boxes: the box of each processed frame, float64 [n, 4].
            truth: ground truth of every world frame, float64 [T, 4].
            score: the confidence of each processed frame, float32 [n], if known.
            visible: whether the target is, in every world frame, bool [T], if known.
        """
        all_boxes = np.full((schedule.length, 4), np.nan)
        elapsed = np.full(schedule.length, -1, np.int64)
        all_scores = np.full(schedule.length, np.nan, np.float32)
        all_boxes[schedule.frames] = boxes
        all_scores[schedule.frames] = np.nan if score is None else score
        elapsed[schedule.frames] = schedule.elapsed_ns
        clock, arrivals = schedule.clock, None
        if not clock.is_even:
            arrivals = clock.arrival(np.arange(schedule.length)) // clock.ticks_per_ns
        return cls.new(name, truth, all_boxes, elapsed, all_scores, arrivals, visible)


OPTIONAL_COLUMNS: Mapping[str, type[np.generic]] = {"arrival_ns": np.int64, "visible": np.bool_}
"""What a recording may have besides, by the names of its attributes and of a trace's columns."""

STAGES = ("decode", "preprocess", "inference", "postprocess")
"""The usual stages of a call, in their order; a pipeline may have others."""


def stage_column(stage: str) -> str:
    """The name of the column of a stage.

    Raises:
        LaeError: if that is no name of a stage.
    """
    return f"stage_{checked_stage(stage)}_ns"


def stage_of(column: str) -> str | None:
    """The stage whose times a column has; None of another column."""
    found = _STAGE_COLUMN.fullmatch(column)
    return None if found is None else found[1]


def is_optional(column: str) -> bool:
    """Whether a trace need not have a column that recordings may have."""
    return column in OPTIONAL_COLUMNS or stage_of(column) is not None


def in_order(stages: Iterable[str]) -> list[str]:
    """Names of stages: the usual ones in their order, then others by name."""
    places = {name: place for place, name in enumerate(STAGES)}
    return sorted(stages, key=lambda name: (places.get(name, len(places)), name))


def _whole(values: npt.ArrayLike, what: str) -> Ints:
    with np.errstate(invalid="ignore"):
        times = np.asarray(values, np.int64)
    if not np.array_equal(times, values):
        raise LaeError(f"{what}: times are whole nanoseconds")
    return times


def _flags(values: npt.ArrayLike, what: str) -> Bools:
    flags: Bools = np.asarray(values)
    if flags.dtype != np.bool_:
        raise LaeError(f"{what}: a flag is True or False, not of type {flags.dtype}")
    return flags


_STAGE_COLUMN = re.compile(f"stage_({STAGE_NAME.pattern})_ns")

BATCH_ROWS = 1 << 15

BESIDE = 64
"""World frames that take as much memory as what is known of a sequence beside its frames."""

Item = TypeVar("Item", bound=Sized)


def batched(
    items: Iterable[Item], frames: int = BATCH_ROWS, beside: int = 0
) -> Iterator[list[Item]]:
    """Recordings or runs in groups of about ``frames`` world frames together.

    Args:
        items: what is grouped.
        frames: how many world frames fill a group.
        beside: how many each item counts for, beside its own.
    """
    group: list[Item] = []
    pending = 0
    for item in items:
        group.append(item)
        pending += len(item) + beside
        if pending >= frames:
            yield group
            group, pending = [], 0
    if group:
        yield group
