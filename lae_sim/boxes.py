"""Geometry of boxes: ``x, y, w, h`` in pixels, top-left origin."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.errors import LaeError

PARTED_IOU = 0.5
"""Two answers for one frame that overlap less are not of the same place."""

MOST_PIXELS = 1e9
"""Beyond any image."""


def iou(a: Floats, b: Floats) -> Floats:
    """Intersection over union, row by row.

    Args:
        a, b: boxes, float64 [n, 4].

    Returns:
        float64 [n] in 0..1; 0 where the union is empty or a box is NaN.
    """
    # columns of their own: arithmetic on rows of four is slow
    ax, ay, aw, ah = np.ascontiguousarray(a.T)
    bx, by, bw, bh = np.ascontiguousarray(b.T)
    intersection = _shared(ax, aw, bx, bw)
    intersection *= _shared(ay, ah, by, bh)
    union = aw * ah
    union += bw * bh
    union -= intersection
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: Floats = np.divide(intersection, union, out=intersection)
    ratio[~(union > 0)] = 0.0
    return np.clip(ratio, 0.0, 1.0, out=ratio)


def _shared(a: Floats, a_side: Floats, b: Floats, b_side: Floats) -> Floats:
    """Length of what two intervals share, float64 [n]."""
    length = a + a_side
    np.minimum(length, b + b_side, out=length)
    length -= np.maximum(a, b)
    return np.maximum(length, 0.0, out=length)


def centre(boxes: Floats) -> Floats:
    """Centre pixel ``(x + (w-1)/2, y + (h-1)/2)`` as the pysot toolkit has it, float64 [n, 2]."""
    return boxes[:, :2] + (boxes[:, 2:] - 1.0) / 2.0


def search_side(boxes: Floats) -> Floats:
    """Side of the square that a Siamese tracker's exemplar covers, pixels: the unit of a reach.

    ``a = sqrt((w + p)(h + p))`` with ``p = (w + h) / 2`` (Bertinetto et al., "Fully-Convolutional
    Siamese Networks for Object Tracking", 2016, sec. 2.2).

    Args:
        boxes: float64 [..., 4]; a size below 0 counts as none.

    Returns:
        float64 [...]; NaN where the box is.
    """
    w, h = (np.maximum(boxes[..., side], 0.0) for side in (2, 3))
    context = (w + h) / 2
    side: Floats = np.sqrt((w + context) * (h + context))
    return side


def search_distance(searched: Floats, boxes: Floats) -> Floats:
    """How far boxes lie from where a tracker searches for them, in units of :func:`search_side`.

    A tracker of SiamFC's kind searches a square whose half side that is: at 1 lies its edge.

    Args:
        searched: the boxes where the tracker searches, float64 [n, 4].
        boxes: where the target is, float64 [n, 4].

    Returns:
        The larger of |dx| and |dy| of the centres over the side, float64 [n]; NaN where a box is
        NaN or the one searched at has no size.
    """
    offset = np.abs(centre(boxes) - centre(searched)).max(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance: Floats = offset / search_side(searched)
    distance[~((searched[:, 2] > 0) & (searched[:, 3] > 0))] = np.nan
    return distance


def resized(box: Sequence[float], size_of: Sequence[float]) -> list[float]:
    """A box ``x, y, w, h`` around the same centre, with the size of another."""
    x, y, w, h = box
    _, _, new_w, new_h = size_of
    return [x + (w - new_w) / 2, y + (h - new_h) / 2, new_w, new_h]


def search_region(box: Sequence[float], image_size: tuple[int, int] | None) -> list[float]:
    """A predicted box as a search region: centre and size ``cx, cy, w, h`` within the image.

    The centre is ``x + w/2, y + h/2``, kept inside the image; a side is kept between 1 pixel and
    the image's, since trackers crash or stall on others.

    Args:
        box: ``x, y, w, h`` in pixels.
        image_size: width and height in pixels; None if unknown, and then nothing is too far out.

    Raises:
        LaeError: if the box is not finite, or beyond any image where the image's size is unknown.
    """
    x, y, w, h = (float(value) for value in box)
    beyond = image_size is None and max(map(abs, (x, y, w, h))) > MOST_PIXELS
    if beyond or not all(map(isfinite, (x, y, w, h))):
        raise LaeError(f"the pre-forecaster predicted {x:g}, {y:g}, {w:g}, {h:g}, not a box")
    centre_x, centre_y = x + w / 2, y + h / 2
    w, h = max(w, 1.0), max(h, 1.0)
    if image_size is not None:
        width, height = map(float, image_size)
        centre_x, centre_y = min(max(centre_x, 0.0), width), min(max(centre_y, 0.0), height)
        w, h = min(w, width), min(h, height)
    return [centre_x, centre_y, w, h]
