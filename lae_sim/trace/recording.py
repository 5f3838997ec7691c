"""One sequence of a trace in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sized
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.engine.scheduler import Schedule
from lae_sim.errors import LaeError

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
        return pd.DataFrame(columns | {name: getattr(self, name) for name in self.columns})

    @property
    def columns(self) -> tuple[str, ...]:
        """Those of :data:`OPTIONAL_COLUMNS` that it has."""
        return tuple(name for name in OPTIONAL_COLUMNS if getattr(self, name) is not None)

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
    ) -> Recording:
        """A recording from anything array-like (not copied); what is optional defaults to none.

        Raises:
            LaeError: if the lengths differ, or something is not made of numbers.
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
            )
        except (TypeError, ValueError) as error:
            raise LaeError(f"{name}: not boxes [T, 4] and times in ns [T]: {error}") from error
        per_frame = ["truth", "boxes", "elapsed_ns", "score", *recording.columns]
        lengths = {len(getattr(recording, each)) for each in per_frame}
        if len(lengths) != 1:
            what = ", ".join(per_frame)
            raise LaeError(f"{name}: differ in length: {what}: {sorted(lengths)}")
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
