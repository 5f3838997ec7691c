"""Masks as boxes, for trackers that segment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lae_sim.errors import LaeError

if TYPE_CHECKING:
    from lae_sim.trackers.protocol import Array


def box_of(mask: Array) -> tuple[float, float, float, float] | None:
    """The smallest box that covers a mask's pixels.

    The pixel in column i and row j covers the square from (i, j) to (i + 1, j + 1), so a width is
    ``last - first + 1`` columns: one pixel alone has the box ``(i, j, 1, 1)``.

    Args:
        mask: [H, W], as NumPy takes it. The pixels are those that are true, or above 0.5: a mask of
            0 and 1, of 0 and 255, or of probabilities. Of logits, such as SAM 2's, give
            ``logits > 0``.

    Returns:
        ``x, y, w, h`` in pixels of the mask; None if it has no pixel, which is also what a tracker
        answers that has not found its target.

    Raises:
        LaeError: if it is no array of numbers [H, W], or has numbers below 0, as logits have.

    Example:
        >>> import numpy as np
        >>> from lae_sim.trackers import box_of
        >>> mask = np.zeros((480, 640), bool)
        >>> mask[100:140, 200:230] = True
        >>> box_of(mask)
        (200.0, 100.0, 30.0, 40.0)
    """
    import numpy as np

    pixels = np.asarray(mask)
    if pixels.ndim != 2 or pixels.dtype.kind not in "biuf":
        raise LaeError(f"a mask is numbers [H, W], not {pixels.dtype} {list(pixels.shape)}")
    if pixels.dtype.kind in "if" and pixels.size and pixels.min() < 0:
        raise LaeError("a mask has no numbers below 0: of logits give logits > 0")
    if pixels.dtype.kind != "b":
        pixels = pixels > 0.5 if pixels.dtype.kind == "f" else pixels != 0
    (rows,) = np.nonzero(pixels.any(axis=1))
    if not rows.size:
        return None
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    (columns,) = np.nonzero(pixels[top:bottom].any(axis=0))
    left, right = int(columns[0]), int(columns[-1]) + 1
    return float(left), float(top), float(right - left), float(bottom - top)
