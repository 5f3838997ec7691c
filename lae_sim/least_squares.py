"""Least squares over the last outputs, with forgetting and a robust loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lae_sim.boxes import Floats
from lae_sim.errors import LaeError
from lae_sim.window import Window

_ROUNDS = 4


@dataclass(frozen=True)
class LeastSquares:
    """A rule: the velocity of the line through the newest output that fits the last ones best.

    Discounted least squares (Brown, "Smoothing, Forecasting and Prediction of Discrete Time
    Series", 1963) with Huber's loss ("Robust Estimation of a Location Parameter", 1964) by
    four rounds of iteratively reweighted least squares, for centre, width and height each.

    Attributes:
        n: outputs before the newest one.
        forgetting: weight of an output, to the power of its age in frames.
        huber: residuals count squared up to this many target sizes, and linearly beyond.
    """

    n: int = 8
    forgetting: float = 0.6
    huber: float = 0.1

    def __post_init__(self) -> None:
        counted = isinstance(self.n, int) and 1 <= self.n <= 1000
        if not (counted and 0 < self.forgetting <= 1 and 0 < self.huber < np.inf):
            raise LaeError(
                "least squares need a whole n of 1 to 1000, 0 < forgetting <= 1 and huber > 0"
            )

    @property
    def size(self) -> int:
        """Outputs that it looks at."""
        return self.n + 1

    def __call__(self, window: Window, ahead: Floats) -> Floats:
        """Boxes, float64 [P, 4], so many frames [P] after the newest output of each window."""
        age = (window.frames[:, :1] - window.frames[:, 1:]).astype(np.float64)[..., None]
        states = window.boxes.copy()
        states[..., :2] += states[..., 2:] / 2
        change = states[:, :1] - states[:, 1:]
        scale = np.sqrt(np.maximum(states[:, :1, 2:3] * states[:, :1, 3:], 1.0))
        base = window.known[:, 1:, None] * self.forgetting**age
        weight = np.broadcast_to(base, change.shape)
        for _ in range(_ROUNDS):
            squares = (weight * age * age).sum(axis=1)
            velocity = (weight * age * change).sum(axis=1) / np.where(squares > 0, squares, 1.0)
            residual = np.abs(change - age * velocity[:, None]) / scale
            weight = base * (self.huber / np.maximum(residual, self.huber))
        state = states[:, 0] + ahead[:, None] * velocity
        sides = np.maximum(state[:, 2:], 1.0)
        return np.concatenate([state[:, :2] - sides / 2, sides], axis=1)
