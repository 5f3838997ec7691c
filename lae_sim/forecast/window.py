"""Forecasters that look at the last few outputs only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.errors import LaeError
from lae_sim.forecast.base import Forecaster, ImageSize, Lanes, LastOutputs


@dataclass(frozen=True)
class Window:
    """The last n outputs before each of P forecasts, the newest first.

    A lane with outputs of the frames 0, 2, 5, asked as of each of them, n = 3:

        frames     known
        0  0  0    yes no  no
        2  0  0    yes yes no
        5  2  0    yes yes yes

    Attributes:
        frames: frame of each, int64 [P, n], or its time (see :class:`.base.Lanes`).
        boxes: box of each, float64 [P, n, 4].
        known: whether there is such an output, bool [P, n]; where not, the oldest one is repeated.
    """

    frames: Ints | Floats
    boxes: Floats
    known: Bools

    @classmethod
    def of(cls, lanes: Lanes, item: Ints, size: int) -> Window:
        """The last ``size`` outputs as of some items of the lanes."""
        index = item[:, None] - np.arange(size)
        first = lanes.first(item)[:, None]
        kept = np.maximum(index, first)
        return cls(lanes.frames[kept], lanes.boxes[kept], index >= first)


class Rule(Protocol):
    """A forecast from a window of outputs."""

    @property
    def size(self) -> int:
        """Outputs that it looks at."""

    def __call__(self, window: Window, ahead: Floats) -> Floats:
        """Boxes, float64 [P, 4], so many frames [P] after the newest output of each window."""


_QUERIES = 16_384


@dataclass(frozen=True)
class Windowed:
    """The factory of forecasters that follow a rule.

    Attributes:
        rule: the forecast from the last outputs.
    """

    rule: Rule

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        """The forecaster of one sequence."""
        return LastOutputs(self, self.rule.size, box)

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """The same for many lanes at once; equal but for rounding."""
        ahead = (frame - lanes.frames[item]).astype(np.float64)
        boxes = np.empty((len(item), 4))
        for first in range(0, len(item), _QUERIES):  # windows take much memory
            some = slice(first, first + _QUERIES)
            boxes[some] = self.rule(Window.of(lanes, item[some], self.rule.size), ahead[some])
        return boxes


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
