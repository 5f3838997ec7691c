"""What a tracker is, what it is given and what it answers."""

from __future__ import annotations

import hashlib
import os
from typing import TYPE_CHECKING, Any, Optional, Protocol, Sequence, Tuple, Union

from lae_sim.errors import LaeError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Array = npt.NDArray[Any]
    Image = npt.NDArray[np.uint8]
else:  # without NumPy, for quick command lines; and NumPy before 1.20 has no typing
    Array = Image = Any

"""A frame as OpenCV has it: uint8 [H, W, 3], blue, green, red."""

Box = Sequence[float]
"""``x, y, w, h`` in pixels, origin at the top left."""

Output = Optional[Union[Box, Tuple[Box, float]]]
"""A box, a box with a confidence, or None where the target was not found."""


class Tracker(Protocol):
    """A single-object tracker.

    A tracker may also have

    - ``prepare()``: get ready for ``init``, untimed;
    - ``set_search(cx, cy, w, h)``: search the next frame around this centre for a target of this
      size (float, pixels) instead of where it was last seen;
    - ``sync()``: wait for the device to finish; the stopwatch calls it before each reading (for
      torch on CUDA it does so itself);
    - ``describe() -> dict``: name, version, settings, weights_digest, libraries (JSON values), and
      search: ``{"half_side": 1.0, "window": True, "source": "127 and 255 pixels"}``, where it looks
      for the target. A square around the last answer, half its side in units of
      ``sqrt((w + p)(h + p))``, ``p = (w + h) / 2``, of that answer (a Siamese tracker's exemplar);
      whether a cosine window weighs what is searched, so that a target near its edge is harder to
      find; and where the number is from, in words. Leave search out where it is not known;
    - ``close()``: give resources back.

    In its calls it may mark stages, whose times the trace then has (`lae_sim.trackers.stage`).
    """

    def init(self, frame: Image, box: Box) -> None:
        """Start on a new sequence; may be called again for the next one."""

    def track(self, frame: Image) -> Output:
        """Find the target in the next frame."""


def checked_frame(frame: Any) -> Image:
    """The frame, contiguous in memory.

    Raises:
        LaeError: if it is not uint8 [H, W, 3] with at least one pixel.
    """
    import numpy as np

    array = np.ascontiguousarray(frame)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3 or not array.size:
        raise LaeError(f"a frame must be uint8 [H, W, 3], not {array.dtype} {list(array.shape)}")
    return array


def checked_box(box: Sequence[float]) -> tuple[float, float, float, float]:
    """The box ``x, y, w, h`` as floats, no thinner than a pixel.

    Raises:
        LaeError: if it is not four finite numbers, or its width or height is negative.
    """
    import numpy as np

    x, y, w, h = numbers = [float(value) for value in box]
    if not np.isfinite(numbers).all() or w < 0 or h < 0:
        raise LaeError(f"not a box x, y, w, h that a tracker can use: {numbers}")
    return x, y, max(w, 1.0), max(h, 1.0)


def checked_search(cx: float, cy: float, w: float, h: float) -> tuple[Array, Array]:
    """Centre and size of a search as float64 [2] each, no thinner than a pixel.

    Raises:
        LaeError: if a number is not finite.
    """
    import numpy as np

    if not np.isfinite([cx, cy, w, h]).all():
        raise LaeError(f"cannot search around {cx, cy} for a target of {w, h} pixels")
    return np.array([cx, cy], float), np.maximum([w, h], 1.0)


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


def weights_digest(*paths: str | os.PathLike[str]) -> str:
    """The SHA-256 of files one after the other, in hexadecimal digits."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
