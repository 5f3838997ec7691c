"""Types of the NumPy arrays that the package passes around."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


Bools = npt.NDArray[np.bool_]


Ints = npt.NDArray[np.int64]


Frames = npt.NDArray[np.int32]
"""Frame numbers where there are very many of them."""


Count = TypeVar("Count", int, Ints)
"""Frames or ticks: a number, or int64 [n]."""
