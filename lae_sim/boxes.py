"""Geometry of boxes: ``x, y, w, h`` in pixels, top-left origin."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

PARTED_IOU = 0.5
"""Two answers for one frame that overlap less are not of the same place."""


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
    width = np.maximum(np.minimum(ax + aw, bx + bw) - np.maximum(ax, bx), 0.0)
    height = np.maximum(np.minimum(ay + ah, by + bh) - np.maximum(ay, by), 0.0)
    intersection = width * height
    union = aw * ah + bw * bh - intersection
    ratio = np.zeros(len(union))
    np.divide(intersection, union, out=ratio, where=union > 0)
    return np.clip(ratio, 0.0, 1.0)


def centre(boxes: Floats) -> Floats:
    """Centre pixel ``(x + (w-1)/2, y + (h-1)/2)`` as the pysot toolkit has it, float64 [n, 2]."""
    return boxes[:, :2] + (boxes[:, 2:] - 1.0) / 2.0
