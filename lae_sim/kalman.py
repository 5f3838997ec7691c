"""The Kalman filter of the paper (Li et al., "Predictive Visual Tracking", 2021, Eqs. 6-9).

State [x, y, w, h, x', y', w', h'] with F(dt) = [[I, dt I], [0, I]], Q = dt^2 I, R = 10 I,
H = [I, 0] and P0 = 100 I (the last is not in the paper; the released code has it). With these
matrices the covariance stays [[a I, b I], [b I, c I]]: four coordinates share three scalars, and
the gain depends on the intervals alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from lae_sim.boxes import Floats, iou
from lae_sim.forecast import ImageSize, Lanes, Motion

MEASUREMENT_VARIANCE = 10.0
INITIAL_VARIANCE = 100.0
RESTART_IOU = 0.3
LEAST_AREA = 75

Number = TypeVar("Number", float, Floats)


def gain(
    a: Number, b: Number, c: Number, interval: Number
) -> tuple[Number, Number, Number, Number, Number]:
    """Predict the covariance over an interval and update it with a measurement.

    Args:
        a, b, c: covariance of a position with itself, with its velocity, and of the velocity.
        interval: dt in frames.

    Returns:
        The new a, b, c, and the gains of position and velocity (Eqs. 7-9).
    """
    noise = interval * interval
    a = a + 2.0 * interval * b + noise * c + noise
    b = b + interval * c
    c = c + noise
    position = a / (a + MEASUREMENT_VARIANCE)
    velocity = b / (a + MEASUREMENT_VARIANCE)
    return a - position * a, b - position * b, c - velocity * b, position, velocity


class Kalman:
    """The paper's filter, exactly."""

    def __init__(self, box: Sequence[float], image_size: ImageSize = None) -> None:
        self._restart(0, box)

    def _restart(self, frame: int, box: Sequence[float]) -> None:
        self._frame = frame
        self._position = [float(value) for value in box]
        self._velocity = [0.0] * 4
        self._covariance = INITIAL_VARIANCE, 0.0, INITIAL_VARIANCE

    def _extrapolate(self, frame: int) -> list[float]:
        interval = float(frame - self._frame)
        return [p + interval * v for p, v in zip(self._position, self._velocity)]

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        a, b, c, position, velocity = gain(*self._covariance, float(frame - self._frame))
        self._covariance = a, b, c
        predicted = self._extrapolate(frame)
        errors = [measured - p for measured, p in zip(box, predicted)]
        self._position = [p + position * error for p, error in zip(predicted, errors)]
        self._velocity = [v + velocity * error for v, error in zip(self._velocity, errors)]
        self._frame = frame

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        return self._extrapolate(frame)

    @staticmethod
    def run_lanes(lanes: Lanes) -> Motion:
        """The same filter over many lanes at once; equal bit for bit."""
        return _filter_lanes(lanes, restart_iou=None)


class KalmanLaePvt(Kalman):
    """The filter as the released LAE-PVT code runs it.

    A measurement that overlaps its prediction by IoU < 0.3 restarts the filter there with zero
    velocity and P0. A forecast is clipped to the image; if ``int(w) * int(h)`` is then below 75, or
    a side was not positive, the answer is the last raw box. Without a known image size nothing is
    clipped.
    """

    def __init__(self, box: Sequence[float], image_size: ImageSize = None) -> None:
        super().__init__(box)
        self._raw = self._position
        self._size = np.array([image_size or (np.inf, np.inf)], np.float64)

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        self._raw = [float(value) for value in box]
        predicted = np.array([self._extrapolate(frame)])
        if iou(predicted, np.array([self._raw]))[0] < RESTART_IOU:
            self._restart(frame, self._raw)
        else:
            super().update(frame, box)

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        forecast = np.array([self._extrapolate(frame)])
        answer: list[float] = clip(forecast, np.array([self._raw]), self._size)[0].tolist()
        return answer

    @staticmethod
    def run_lanes(lanes: Lanes) -> Motion:
        """The same filter over many lanes at once; equal bit for bit."""
        return _filter_lanes(lanes, restart_iou=RESTART_IOU)

    @staticmethod
    def finish(forecasts: Floats, raw: Floats, image_sizes: Floats) -> Floats:
        """Clip forecasts to their images, or fall back to the raw boxes."""
        return clip(forecasts, raw, image_sizes)


def clip(forecasts: Floats, raw: Floats, image_sizes: Floats) -> Floats:
    """Clip boxes to images; answer the raw box where too little is left.

    Args:
        forecasts, raw: boxes, float64 [n, 4].
        image_sizes: width and height in pixels, float64 [n, 2]; infinite = unknown.

    Returns:
        float64 [n, 4].
    """
    top_left = np.clip(forecasts[:, :2], 0.0, image_sizes)
    bottom_right = np.clip(forecasts[:, :2] + forecasts[:, 2:], 0.0, image_sizes)
    unknown = np.isinf(image_sizes)
    corner = np.where(unknown, forecasts[:, :2], top_left)
    size = np.where(unknown, forecasts[:, 2:], bottom_right - top_left)
    whole = np.trunc(size)
    kept = (forecasts[:, 2:] > 0).all(axis=1) & (whole[:, 0] * whole[:, 1] >= LEAST_AREA)
    return np.where(kept[:, None], np.concatenate([corner, size], axis=1), raw)


def _filter_lanes(lanes: Lanes, restart_iou: float | None) -> Motion:
    """Filter all lanes in step: the k-th update of every lane that has one, for each k.

    Lanes are sorted by length, so that those still running are always the first ones.
    """
    lengths = np.diff(lanes.offsets)
    order = np.argsort(-lengths, kind="stable")
    firsts, lengths = lanes.offsets[:-1][order], lengths[order]
    position = lanes.boxes[firsts]
    velocity = np.zeros_like(position)
    a, b, c = (np.full(len(order), value) for value in (INITIAL_VARIANCE, 0.0, INITIAL_VARIANCE))
    motion = Motion(lanes.boxes.copy(), np.zeros_like(lanes.boxes))
    running = np.searchsorted(-lengths, -np.arange(lengths[0]))  # lanes with more than k outputs
    for k in range(1, int(lengths[0])):
        n = int(running[k])
        item = firsts[:n] + k
        interval = (lanes.frames[item] - lanes.frames[item - 1]).astype(np.float64)
        measured = lanes.boxes[item]
        a_n, b_n, c_n, position_gain, velocity_gain = gain(a[:n], b[:n], c[:n], interval)
        predicted = position[:n] + interval[:, None] * velocity[:n]
        error = measured - predicted
        new_position = predicted + position_gain[:, None] * error
        new_velocity = velocity[:n] + velocity_gain[:, None] * error
        if restart_iou is not None:
            lost = np.flatnonzero(iou(predicted, measured) < restart_iou)
            new_position[lost], new_velocity[lost] = measured[lost], 0.0
            a_n[lost], b_n[lost], c_n[lost] = INITIAL_VARIANCE, 0.0, INITIAL_VARIANCE
        position[:n], velocity[:n] = new_position, new_velocity
        a[:n], b[:n], c[:n] = a_n, b_n, c_n
        motion.position[item], motion.velocity[item] = new_position, new_velocity
    return motion
