"""Strided passes: which frames a tracker is run on so that every frame is seen at one stride.

A stride p/q is the mean number of frames from one processed frame to the next: 2 is every second
frame, 3/2 two frames of three. One run at a stride sees only some frames; the phases of a pass are
runs that together see them all.
"""

from __future__ import annotations

from fractions import Fraction
from math import ceil

import numpy as np

from lae_sim._arrays import Ints


def phases(stride: Fraction, length: int) -> list[Ints]:
    """The frames of each run of a pass, frame 0 first.

    Phase j of the stride p/q holds frame 0 and ``floor((n p + j) / q)`` for n = 0, 1, ...; phases
    are added until all frames are seen.

    Args:
        stride: at least 1.
        length: number of frames.
    """
    p, q = stride.numerator, stride.denominator
    seen = np.zeros(length, bool)
    seen[0] = length > 1  # it is in every phase
    found = []
    for j in range(p):
        frames = (np.arange(ceil(length / stride) + 1) * p + j) // q
        frames = np.unique(np.append(frames[frames < length], 0))
        if not seen[frames].all():
            seen[frames] = True
            found.append(frames)
        if seen.all():
            break
    return found


def followed(stride: Fraction, length: int) -> Ints:
    """The frame that each frame follows in the first phase that holds it, int64 [length]; 0 for 0.

    That phase is the one whose box and time a strided trace has of the frame.
    """
    before = np.full(length, -1, np.int64)
    for frames in phases(stride, length):
        new = before[frames] < 0
        before[frames[new]] = np.append(0, frames[:-1])[new]
    return before
