"""What trackers require of a frame and a box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lae_sim.errors import LaeError
from lae_sim.trackers.protocol import Image


def checked_frame(frame: Any) -> Image:
    """The frame, contiguous in memory.

    Raises:
        LaeError: if it is not uint8 [H, W, 3] with at least one pixel.
    """
    array = np.ascontiguousarray(frame)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3 or not array.size:
        raise LaeError(f"a frame must be uint8 [H, W, 3], not {array.dtype} {list(array.shape)}")
    return array


def checked_box(box: Sequence[float]) -> tuple[float, float, float, float]:
    """The box ``x, y, w, h`` as floats, no thinner than a pixel.

    Raises:
        LaeError: if it is not four finite numbers, or its width or height is negative.
    """
    x, y, w, h = numbers = [float(value) for value in box]
    if not np.isfinite(numbers).all() or w < 0 or h < 0:
        raise LaeError(f"not a box x, y, w, h that a tracker can use: {numbers}")
    return x, y, max(w, 1.0), max(h, 1.0)
