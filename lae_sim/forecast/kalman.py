"""The Kalman filter of the paper (Li et al., "Predictive Visual Tracking", 2021, Eqs. 6-9).

State [x, y, w, h, x', y', w', h'] with F(dt) = [[I, dt I], [0, I]], Q = dt^2 I, R = 10 I,
H = [I, 0] and P0 = 100 I (the last is not in the paper; the released code has it). With these
matrices the covariance stays [[a I, b I], [b I, c I]]: four coordinates share three scalars, and
the gain depends on the intervals alone. That holds for any multiples of those matrices and for a
velocity that decays, so the family :class:`TunedKalman` runs on the same code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.boxes import iou
from lae_sim.errors import LaeError
from lae_sim.forecast.base import ImageSize, Lanes

RESTART_IOU = 0.3
LEAST_AREA = 75
_CHUNK = 1 << 14  # forecasts at once: what is made of them stays in the cache

Number = TypeVar("Number", float, Floats)
Covariance = tuple[Number, Number, Number]


@dataclass(frozen=True)
class TunedKalman:
    """The paper's filter with other numbers in its place: a factory; the defaults are the paper's.

    Attributes:
        q: process noise; Q = q dt^2 I.
        r: measurement noise; R = r I.
        p0: initial covariance; P0 = p0 I.
        decay: what is left of the velocity after one frame, above 0 to 1: a damped trend, after
            Gardner and McKenzie, "Forecasting Trends in Time Series", 1985.
        state: ``"corner"`` is x, y, w, h; ``"centre"`` is the centre, the logarithm of the scale
            sqrt(w h) and that of the aspect w / h. The gains do not depend on the units, so both
            states share them.
    """

    q: float = 1.0
    r: float = 10.0
    p0: float = 100.0
    decay: float = 1.0
    state: Literal["corner", "centre"] = "corner"

    def __post_init__(self) -> None:
        fits = [0 <= value < np.inf for value in (self.q, self.p0)]
        if not (all(fits) and 0 < self.r < np.inf and 0 < self.decay <= 1):
            raise LaeError("a Kalman filter needs q >= 0, r > 0, p0 >= 0 and 0 < decay <= 1")
        if self.state not in ("corner", "centre"):
            raise LaeError(f"a Kalman filter's state is corner or centre, not {self.state!r}")

    def __str__(self) -> str:
        """Its name on command lines."""
        return f"kalman:q={self.q:g},decay={self.decay:g},state={self.state}" + (
            "" if (self.r, self.p0) == (10, 100) else f",r={self.r:g},p0={self.p0:g}"
        )

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Kalman:
        """The filter of one sequence."""
        return Kalman(box, image_size, self)

    def forecast_lanes(
        self, lanes: Lanes, item: Ints, frame: Ints, restart_iou: float | None = None
    ) -> Floats:
        """The same for many lanes at once; restarts as in :func:`filter_lanes`."""
        states, place = _filtered(lanes, self, restart_iou)
        forecasts = np.empty((4, len(item)))
        for begin in range(0, len(item), _CHUNK):
            now = slice(begin, begin + _CHUNK)
            found = states.take(place.take(item[now]), axis=0)
            position, velocity = np.ascontiguousarray(found.transpose(1, 2, 0))
            ahead = frame[now] - lanes.frames.take(item[now])
            velocity *= self.reach(ahead.astype(np.float64))
            np.add(position, velocity, out=forecasts[:, now])
        return self.boxes(forecasts.T)

    def reach(self, interval: Number) -> Number:
        """How many frames' velocity an interval of so many frames is worth."""
        if self.decay == 1:
            return interval
        worth: Number = (1 - self.decay**interval) / (1 - self.decay)
        return worth

    def transition(self, interval: Number) -> tuple[Number, Number, Number]:
        """What is left of the velocity after an interval, its reach, and the process noise."""
        return self.decay**interval, self.reach(interval), self.q * (interval * interval)

    def gain(
        self, covariance: Covariance[Number], keep: Number, reach: Number, noise: Number
    ) -> tuple[Covariance[Number], Number, Number]:
        """Predict the covariance over an interval and update it with a measurement.

        Args:
            covariance: of a position with itself, with its velocity, and of the velocity.
            keep, reach, noise: the :meth:`transition` over the interval.

        Returns:
            The new covariance, and the gains of position and velocity (Eqs. 7-9).
        """
        a, b, c = covariance
        a = a + 2.0 * reach * b + reach * reach * c + noise
        b = keep * (b + reach * c)
        c = keep * keep * c + noise
        position = a / (a + self.r)
        velocity = b / (a + self.r)
        return (a - position * a, b - position * b, c - velocity * b), position, velocity

    def states(self, boxes: Floats) -> Floats:
        """Boxes as positions of the filter's state, float64 [n, 4]."""
        if self.state == "corner":
            return boxes
        sides = np.log(np.maximum(boxes[:, 2:], 1.0))
        scale, aspect = sides.sum(axis=1) / 2, sides[:, 0] - sides[:, 1]
        return np.column_stack([boxes[:, :2] + boxes[:, 2:] / 2, scale, aspect])

    def boxes(self, states: Floats) -> Floats:
        """The inverse of :meth:`states`."""
        if self.state == "corner":
            return states
        scale, half = states[:, 2], states[:, 3] / 2
        sides = np.exp(np.clip(np.column_stack([scale + half, scale - half]), -20, 20))
        return np.concatenate([states[:, :2] - sides / 2, sides], axis=1)


PAPER = TunedKalman()


class Kalman:
    """The paper's filter, exactly; or another of its family."""

    def __init__(
        self,
        box: Sequence[float],
        image_size: ImageSize = None,
        settings: TunedKalman = PAPER,
    ) -> None:
        self._settings = settings
        self._restart(0, box)

    def _restart(self, frame: int, box: Sequence[float]) -> None:
        self._frame = frame
        self._position = self._measured(box)
        self._velocity = [0.0] * 4
        self._covariance = self._settings.p0, 0.0, self._settings.p0

    def _measured(self, box: Sequence[float]) -> list[float]:
        if self._settings.state == "corner":
            return [float(value) for value in box]
        state: list[float] = self._settings.states(np.array([box], np.float64))[0].tolist()
        return state

    def _extrapolate(self, frame: int) -> list[float]:
        reach = self._settings.reach(float(frame - self._frame))
        return [p + reach * v for p, v in zip(self._position, self._velocity)]

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        interval = float(frame - self._frame)
        predicted = self._extrapolate(frame)
        kept, reach, noise = self._settings.transition(interval)
        self._covariance, position, velocity = self._settings.gain(
            self._covariance, kept, reach, noise
        )
        errors = [measured - p for measured, p in zip(self._measured(box), predicted)]
        self._position = [p + position * error for p, error in zip(predicted, errors)]
        self._velocity = [kept * v + velocity * e for v, e in zip(self._velocity, errors)]
        self._frame = frame

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        predicted = self._extrapolate(frame)
        if self._settings.state == "corner":
            return predicted
        box: list[float] = self._settings.boxes(np.array([predicted]))[0].tolist()
        return box

    @staticmethod
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints) -> Floats:
        """The paper's filter over many lanes at once; equal bit for bit."""
        return PAPER.forecast_lanes(lanes, item, frame)


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
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints) -> Floats:
        """The same for many lanes at once; equal bit for bit."""
        forecasts = PAPER.forecast_lanes(lanes, item, frame, RESTART_IOU)
        return clip(forecasts, lanes.boxes[item], lanes.image_sizes[lanes.lane(item)])


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


def filter_lanes(
    lanes: Lanes,
    item: Ints,
    settings: TunedKalman = PAPER,
    restart_iou: float | None = None,
) -> tuple[Floats, Floats]:
    """Filter all lanes.

    Args:
        lanes: what the filters are fed.
        item: the items asked about, int64 [P].
        settings: the filter.
        restart_iou: a measurement that overlaps its prediction by less restarts the filter there.

    Returns:
        Position and velocity of the state after each of these items, float64 [4, P] each.
    """
    states, place = _filtered(lanes, settings, restart_iou)
    position, velocity = states.take(place.take(item), axis=0).transpose(1, 2, 0)
    return position, velocity


def _filtered(
    lanes: Lanes, settings: TunedKalman, restart_iou: float | None
) -> tuple[Floats, Ints]:
    """Filter all lanes in step: the k-th update of every lane that has one, for each k.

    Lanes are sorted by length, so that those still running are always the first ones, and items by
    their place in the lane, so that each step works on one stretch of memory.

    The arithmetic is that of :meth:`TunedKalman.gain`, in place: the fewer arrays are touched, the
    faster.

    Returns:
        States after all items, position and velocity, float64 [2, 4, N], and where each item has
        its own, int64 [N].
    """
    lengths = np.diff(lanes.offsets)
    longest = np.argsort(-lengths, kind="stable")
    running = np.searchsorted(-lengths[longest], -np.arange(lengths.max()))  # with more than k
    ends = np.cumsum(running)
    lane = np.arange(ends[-1]) - np.repeat(ends - running, running)
    order = lanes.offsets[longest].take(lane)
    order += np.repeat(np.arange(lengths.max()), running)
    interval = np.diff(lanes.frames, prepend=0).astype(np.float64)
    interval[lanes.offsets[:-1]] = 0.0
    interval = interval.take(order)
    keep, reach, noise = (np.asarray(each, np.float64) for each in settings.transition(interval))
    measured = np.ascontiguousarray(settings.states(lanes.boxes).take(order, axis=0).T)
    states = np.empty((len(order), 2, 4))
    width = int(running[0])
    state = np.zeros((2, 4, width))
    state[0] = measured[:, :width]
    states[:width] = state.transpose(2, 0, 1)
    start = np.array([[settings.p0], [0.0], [settings.p0]])
    covariance = np.repeat(start, width, axis=1)
    for n, end in zip(running[1:].tolist(), ends[1:].tolist()):
        now = slice(end - n, end)
        if n < width:
            width, state, covariance = n, state[:, :, :n].copy(), covariance[:, :n].copy()
        (position, velocity), (a, b, c) = state, covariance
        kept, reached, noisy = keep[now], reach[now], noise[now]
        term = 2.0 * reached
        term *= b
        a += term
        np.multiply(reached, reached, out=term)
        term *= c
        a += term
        a += noisy
        np.multiply(reached, c, out=term)
        b += term
        if settings.decay != 1:
            b *= kept
            c *= kept * kept
        c += noisy
        gains = covariance[:2] / np.add(a, settings.r, out=term)
        c -= np.multiply(gains[1], b, out=term)
        covariance[:2] -= gains[0] * covariance[:2]
        position += reached * velocity
        if settings.decay != 1:
            velocity *= kept
        measured_now = measured[:, now]
        if restart_iou is not None:
            lost = np.flatnonzero(iou(position.T, measured_now.T) < restart_iou)
        state += gains[:, None] * (measured_now - position)
        if restart_iou is not None:
            position[:, lost], velocity[:, lost] = measured_now[:, lost], 0.0
            covariance[:, lost] = start
        states[now] = state.transpose(2, 0, 1)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return states, place
