"""Types of the NumPy arrays that the package passes around."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


Bools = npt.NDArray[np.bool_]


Ints = npt.NDArray[np.int64]
