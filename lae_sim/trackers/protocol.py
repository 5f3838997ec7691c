"""What a tracker is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Optional, Protocol, Sequence, Tuple, Union

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
    - ``describe() -> dict``: name, version, settings, weights_digest, libraries (JSON values);
    - ``close()``: give resources back.
    """

    def init(self, frame: Image, box: Box) -> None:
        """Start on a new sequence; may be called again for the next one."""

    def track(self, frame: Image) -> Output:
        """Find the target in the next frame."""
