"""In which coordinates a tracker's boxes are, judged by the ground truth of their frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lae_sim._arrays import Bools, Floats
from lae_sim.boxes import iou

ROW_0_PX = 3.0
"""How far row 0 may be from the initial box: some toolkits round it or count from 1."""

# Of some 1,150 published results none fits its truth better by centre, by corners or scaled, over
# the first frames and over all, even at a quarter of this gain. By one frame some do, of trackers
# that lag: by .08 or .4 of what is missing to 1, and by .02 where rows 0 and 1 look shifted too.
_FIRST = 10
_FEWEST = 3
_LEAST_IOU = 0.4
_GAIN = 0.2
_SHIFT_GAIN = 0.05
_GAIN_WITH_ROW_0 = 0.02
_SAME_SCALE = (0.8, 1.25)
_MOST_NORMALISED = 1.5
_LEAST_LENGTH = 1e-6


@dataclass(frozen=True)
class Reading:
    """Another way to read boxes.

    Attributes:
        looks_like: what they are, so read.
        remedy: how to make boxes ``x, y, w, h`` in pixels of them.
        iou: mean IoU with the truth, so read; None if that needs the images' size.
        iou_as_is: mean IoU as ``x, y, w, h`` in pixels.
    """

    looks_like: str
    remedy: str
    iou: float | None
    iou_as_is: float


def row_0_is_off(truth: Floats, boxes: Floats) -> bool:
    """Whether a value of row 0 is more than :data:`ROW_0_PX` from that of the truth, if known."""
    return bool(_distance(truth[:1], boxes[:1]) > ROW_0_PX)


def other_reading(truth: Floats, boxes: Floats) -> Reading | None:
    """How boxes fit the truth that do not fit it as ``x, y, w, h`` in pixels; None if they do.

    They may be by centre, by corners, on images of another size, normalised, or a frame early or
    late. What counts is the mean IoU over the first frames and over all, row 0 apart. If row 0 is
    the initial box as it stands, which toolkits copy there, it takes more to read the others
    otherwise; if it is not, it has to be the initial box so read.

    Args:
        truth: boxes of every world frame, float64 [T, 4]; NaN = none.
        boxes: of the tracker, float64 [T, 4]; NaN = frame not processed.
    """
    if np.count_nonzero(_known(truth[1:], boxes[1:])) < _FEWEST:
        return None
    first, overall = _fit(truth[1:], boxes[1:])
    off = row_0_is_off(truth, boxes)
    row_0_iou = iou(truth[:1], boxes[:1])[0]
    normalised = np.nanmedian(np.abs(boxes[1:])) <= _MOST_NORMALISED
    best = None
    best_first = _LEAST_IOU
    for looks_like, remedy, read, fitted in (
        _normalised(truth, boxes, off) if normalised else _in_pixels(truth, boxes)
    ):
        so_first, so_overall = _fit(truth[1:], read[1:])
        if off:
            fits = iou(truth[:1], read[:1])[0] > max(0.7, row_0_iou)
        else:
            fits = not fitted or so_overall > _LEAST_IOU
        gain = _GAIN_WITH_ROW_0 if off and not fitted else _GAIN
        if fits and so_first > max(first + gain, best_first) and so_overall > overall + gain / 2:
            best, best_first = Reading(looks_like, remedy, so_overall, overall), so_first
    if best is None and normalised and off and 0 < boxes[0, 2:].max() <= _MOST_NORMALISED:
        return Reading(*_NORMALISED, None, overall)
    return best or _shifted(truth, boxes)


_NORMALISED = (
    "boxes normalised by the images' size",
    "multiply x and w by the images' width, y and h by their height",
)


def _layouts(boxes: Floats) -> Iterator[tuple[str, str, Floats]]:
    """What boxes may be but ``x, y, w, h``, how to mend it, and the boxes so read."""
    x, y, w, h = boxes.T
    by_centre = np.column_stack([x - w / 2, y - h / 2, w, h])
    yield "boxes by centre (cx, cy, w, h)", "subtract w/2 and h/2 from the centres", by_centre
    corners = np.column_stack([x, y, w - x, h - y])
    yield "corner boxes (x1, y1, x2, y2)", "write w = x2 - x1 and h = y2 - y1", corners


def _in_pixels(truth: Floats, boxes: Floats) -> Iterator[tuple[str, str, Floats, bool]]:
    """The layouts, and boxes on images of another size; the last says that a scale was fitted."""
    for layout in _layouts(boxes):
        yield (*layout, False)
    low, high = _SAME_SCALE
    scale = _ratio(*_centres(truth, boxes))
    if scale is not None and ((scale < low) | (scale > high)).any():
        (across, down), (x, y) = 1 / scale, scale
        size = (
            f"boxes on images of another size ({across:.2g} of the width, {down:.2g} of the height)"
        )
        mend = f"multiply x and w by {x:.3g}, y and h by {y:.3g}"
        yield size, mend, boxes * np.tile(scale, 2), True


def _normalised(truth: Floats, boxes: Floats, off: bool) -> Iterator[tuple[str, str, Floats, bool]]:
    """Normalised boxes in any layout, scaled by the size of row 0, if it is such, or by centres."""
    looks_like, remedy = _NORMALISED
    for layout, mend, read in [("", "", boxes), *_layouts(boxes)]:
        lengths = (truth[:1, 2:], read[:1, 2:]) if off else _centres(truth, read)
        scale = _ratio(*lengths)
        if scale is not None:
            words = ([looks_like, layout], [remedy, mend]) if layout else ([looks_like], [remedy])
            names, steps = (", ".join(part) for part in words)
            yield names, steps, read * np.tile(scale, 2), True


def _centres(truth: Floats, boxes: Floats) -> tuple[Floats, Floats]:
    """Those of both in the first rows after row 0 where both are known, float64 [n, 2] each."""
    known = 1 + np.flatnonzero(_known(truth[1:], boxes[1:]))[:_FIRST]
    of_truth, of_boxes = (rows[known, :2] + rows[known, 2:] / 2 for rows in (truth, boxes))
    return of_truth, of_boxes


def _ratio(of: Floats, to: Floats) -> Floats | None:
    """Median ratio of lengths in each direction, float64 [2]; None if they are all about 0."""
    known = ((of > _LEAST_LENGTH) & (to > _LEAST_LENGTH)).all(axis=1)
    return np.median(of[known] / to[known], axis=0) if known.any() else None


def _shifted(truth: Floats, boxes: Floats) -> Reading | None:
    """Whether boxes are those of the frame after or before.

    They fit better so; they explain rows 0 and 1 as well, or most of what is missing without.
    """
    as_is = np.array(_fit(truth[1:], boxes[1:]))
    to_start, to_next = (_distance(rows, boxes[:1]) for rows in (truth[:1], truth[1:2]))
    begins_early = to_start > ROW_0_PX and to_next < to_start
    moves = _distance(truth[:1], truth[1:2]) > ROW_0_PX
    begins_late = moves and _distance(truth[:1], boxes[1:2]) <= 1
    for looks_like, remedy, frames, read, begins_so in (
        (
            "boxes that are a frame early (row 0 is of frame 1)",
            "put the initial box before row 0 and drop the last row",
            truth[1:],
            boxes[:-1],
            begins_early,
        ),
        (
            "boxes that are a frame late (row 1 is of frame 0)",
            "remove row 0 and add the last frame's box",
            truth[:-1],
            boxes[1:],
            begins_late,
        ),
    ):
        shifted = np.array(_fit(frames, read))
        gain = shifted - as_is
        enough = np.maximum(_SHIFT_GAIN, 0 if begins_so else (1 - as_is) / 2)
        if shifted[0] > _LEAST_IOU and (gain > enough).all():
            return Reading(looks_like, remedy, float(shifted[1]), float(as_is[1]))
    return None


def _fit(truth: Floats, boxes: Floats) -> tuple[float, float]:
    """Mean IoU over the first rows where both are known, and over all of them."""
    known = _known(truth, boxes)
    overlap = iou(truth[known], boxes[known])
    if not len(overlap):
        return 0.0, 0.0
    return float(overlap[:_FIRST].mean()), float(overlap.mean())


def _known(truth: Floats, boxes: Floats) -> Bools:
    """The rows where there are both truth and a box, bool [n]."""
    known: Bools = np.all(np.isfinite(boxes) & (truth[:, [2, 3, 2, 3]] > 0), axis=1)
    return known


def _distance(a: Floats, b: Floats) -> float:
    """The largest difference of a value in two rows; NaN where one is unknown or not there."""
    if not (len(a) and len(b) and (a[:, 2:] > 0).all()):
        return np.nan
    return float(np.abs(a - b).max())
