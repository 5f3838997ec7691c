"""Filters of filterpy (Labbe, https://filterpy.readthedocs.io) as forecasters: g-h and IMM."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.errors import LaeError
from lae_sim.forecast.base import Forecaster, ImageSize

_COORDINATES = 4


@dataclass(frozen=True)
class GH:
    """The g-h (alpha-beta) filter: a factory.

    Source: Brookner, "Tracking and Kalman Filtering Made Easy", 1998, Ch. 1.

    Attributes:
        g: share of a measurement's error that corrects the position, 0 to 1.
        h: share that corrects the velocity, per frame of the interval, 0 to 2.
    """

    g: float = 0.95
    h: float = 0.8

    def __post_init__(self) -> None:
        if not (0 <= self.g <= 1 and 0 <= self.h <= 2):
            raise LaeError("a g-h filter needs 0 <= g <= 1 and 0 <= h <= 2")

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        """The filter of one sequence."""
        from filterpy.gh import GHFilter

        start = np.array(box, np.float64)
        return _GHForecaster(GHFilter(start, np.zeros(_COORDINATES), 1.0, self.g, self.h))


class _GHForecaster:
    def __init__(self, filter_: Any) -> None:
        self._filter = filter_
        self._frame = 0

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        self._filter.dt = float(frame - self._frame)
        self._filter.update(np.array(box, np.float64))
        self._frame = frame

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        ahead = frame - self._frame
        box: list[float] = (self._filter.x + ahead * self._filter.dx).tolist()
        return box


@dataclass(frozen=True)
class IMM:
    """Interacting multiple models: a factory of two of the paper's filters, quiet and agile.

    Source: Blom and Bar-Shalom, "The Interacting Multiple Model Algorithm for Systems with
    Markovian Switching Coefficients", 1988. The noises are as in the paper's filter: Q = q dt^2 I,
    R = r I.

    Attributes:
        quiet, agile: process noise q of the two models.
        r: measurement noise.
        p0: initial covariance.
        stay: probability that a model stays the right one from one output to the next.
    """

    quiet: float = 1.0
    agile: float = 30.0
    r: float = 10.0
    p0: float = 100.0
    stay: float = 0.95

    def __post_init__(self) -> None:
        fits = [0 <= value < np.inf for value in (self.quiet, self.agile, self.p0)]
        if not (all(fits) and 0 < self.r < np.inf and 0 < self.stay < 1):
            raise LaeError("an IMM needs quiet, agile, p0 >= 0, r > 0 and 0 < stay < 1")

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        """The filter of one sequence."""
        from filterpy.kalman import IMMEstimator, KalmanFilter

        class Model(KalmanFilter):  # type: ignore[misc]
            @property
            def likelihood(self) -> float:
                """At least the smallest normal number: half of a smaller one may be 0."""
                return max(float(super().likelihood), sys.float_info.min)

        models = []
        for _ in range(2):
            model = Model(dim_x=2 * _COORDINATES, dim_z=_COORDINATES)
            model.x = np.array([*box, *[0.0] * _COORDINATES], np.float64)
            model.H = np.eye(_COORDINATES, 2 * _COORDINATES)
            model.R *= self.r
            model.P *= self.p0
            models.append(model)
        switch = np.array([[self.stay, 1 - self.stay], [1 - self.stay, self.stay]])
        return _IMMForecaster(IMMEstimator(models, np.array([0.5, 0.5]), switch), self)


class _IMMForecaster:
    def __init__(self, estimator: Any, settings: IMM) -> None:
        self._estimator = estimator
        self._noises = settings.quiet, settings.agile
        self._frame = 0

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        interval = float(frame - self._frame)
        for model, q in zip(self._estimator.filters, self._noises):
            model.F = _transition(interval)
            model.Q = q * interval**2 * np.eye(2 * _COORDINATES)
        self._estimator.predict()
        self._estimator.update(np.array(box, np.float64))
        self._frame = frame

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        state = np.ravel(self._estimator.x)
        ahead = frame - self._frame
        box: list[float] = (state[:_COORDINATES] + ahead * state[_COORDINATES:]).tolist()
        return box


def _transition(interval: float) -> Floats:
    transition = np.eye(2 * _COORDINATES)
    transition[:_COORDINATES, _COORDINATES:] = interval * np.eye(_COORDINATES)
    return transition
