"""Image sequences: what a tracker is run on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from lae_sim.boxes import Floats

Image = npt.NDArray[np.uint8]
"""A frame as OpenCV has it: uint8 [H, W, 3], blue, green, red."""


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """One sequence of a dataset.

    Attributes:
        name: the sequence's name, unique within its dataset.
        truth: ground truth boxes ``x, y, w, h`` in pixels, float64 [T, 4]; NaN = none. The first
            row is the initial box.
        read: ``read(frame)`` decodes (or renders) a frame, in any order, from any thread.
        attributes: the dataset's attributes of the sequence, such as ``"Occlusion"``.
    """

    name: str
    truth: Floats
    read: Callable[[int], Image]
    attributes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of frames T."""
        return len(self.truth)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Sequences that belong together.

    Attributes:
        name: the dataset's name, such as ``"DTB70"``.
        fps: its frame rate, frames per second, exact.
        sequences: sorted by name.
    """

    name: str
    fps: Fraction
    sequences: Sequence[ImageSequence]
