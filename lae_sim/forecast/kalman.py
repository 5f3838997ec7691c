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

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim._compiled import compiled
from lae_sim.boxes import iou
from lae_sim.errors import LaeError
from lae_sim.forecast.base import ImageSize, Lanes

RESTART_IOU = 0.3
LEAST_AREA = 75
_CHUNK = 1 << 14  # forecasts at once: what is made of them stays in the cache

_LONGEST = 1 << 20  # frames, of a table of intervals

Number = TypeVar("Number", float, Floats)


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
        self, lanes: Lanes, item: Ints, frame: Ints | Floats, restart_iou: float | None = None
    ) -> Floats:
        """The same for many lanes at once; restarts as in :func:`filter_lanes`."""
        if compiled():
            tables = self._tables(lanes, item, frame)
            if tables is not None:
                return self._by_kernel(lanes, item, frame, restart_iou, tables)
        states, place = filter_lanes(lanes, self, restart_iou)
        forecasts = np.empty((4, len(item)))
        for begin in range(0, len(item), _CHUNK):
            now = slice(begin, begin + _CHUNK)
            latest = states.take(place.take(item[now]), axis=0)
            position, velocity = np.ascontiguousarray(latest.transpose(1, 2, 0))
            ahead = frame[now] - lanes.frames.take(item[now])
            velocity *= self.reach(ahead.astype(np.float64))
            np.add(position, velocity, out=forecasts[:, now])
        return self.boxes(forecasts.T)

    def _by_kernel(
        self,
        lanes: Lanes,
        item: Ints,
        frame: Ints | Floats,
        restart_iou: float | None,
        tables: tuple[Floats, Floats],
    ) -> Floats:
        from lae_sim.forecast.kernels import kalman_lanes

        forecasts = np.empty((len(item), 4))
        kalman_lanes(
            lanes.offsets,
            lanes.frames,
            self.states(lanes.boxes),
            *tables,
            self.q,
            self.r,
            self.p0,
            -1.0 if restart_iou is None else restart_iou,
            item,
            frame,
            forecasts,
        )
        return self.boxes(forecasts)

    def _tables(
        self, lanes: Lanes, item: Ints, frame: Ints | Floats
    ) -> tuple[Floats, Floats] | None:
        """What is left of the velocity after 0, 1, 2, ... frames, and its reach.

        They are empty where it does not decay, and None where intervals are no such numbers.
        """
        if self.decay == 1:
            return np.empty(0), np.empty(0)
        ahead = frame - lanes.frames.take(item)
        most = max(int(lanes.frames.max()), int(ahead.max(initial=0)))
        if lanes.numbers is not None or ahead.min(initial=0) < 0 or most > _LONGEST:
            return None
        keep, reach, _ = self.transition(np.arange(most + 1.0))
        return keep, reach

    def reach(self, interval: Number) -> Number:
        """How many frames' velocity an interval of so many frames is worth."""
        if self.decay == 1:
            return interval
        worth: Number = (1 - self.decay**interval) / (1 - self.decay)
        return worth

    def transition(self, interval: Number) -> tuple[Number, Number, Number]:
        """What is left of the velocity after an interval, its reach, and the process noise."""
        return self.decay**interval, self.reach(interval), self.q * (interval * interval)

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


class _Filter:
    """The state of one filter, or of n filters that take in their outputs in step.

                     one filter   n filters
        states       [2, 4]       [2, 4, n]   positions; velocities
        covariances  [3]          [3, n]      a; b; c of [[a I, b I], [b I, c I]]

    The arithmetic is along the last axes, so the same lines serve both: this is the only place
    where the filter's equations stand.
    """

    def __init__(self, settings: TunedKalman, position: Floats) -> None:
        self._settings = settings
        self._initial = np.array([[settings.p0], [0.0], [settings.p0]])
        self.states = np.empty((2, *position.shape))
        self._covariances = np.empty((3, *position.shape[1:]))
        self._restart(np.ones(position.shape[1:], np.bool_), position)

    def _restart(self, which: Bools, position: Floats) -> None:
        self.states[0][..., which] = position[..., which]
        self.states[1][..., which] = 0.0
        self._covariances[..., which] = self._initial

    def keep_first(self, n: int) -> None:
        """Go on with the first n filters only, in memory of their own."""
        self.states = self.states[:, :, :n].copy()
        self._covariances = self._covariances[:, :n].copy()

    def update(
        self,
        transition: tuple[Number, Number, Number],
        measured: Floats,
        restart_iou: float | None = None,
    ) -> None:
        """Predict over an interval and update with a measurement (Eqs. 6-9).

        Args:
            transition: :meth:`TunedKalman.transition` over the interval of each filter.
            measured: positions, float64 [4] or [4, n].
            restart_iou: a measurement that overlaps its prediction by less restarts the filter.
        """
        keep, reach, noise = transition
        position, velocity = self.states  # views: what is done in place is done to the states
        a, b, c = self._covariances  # views where there are n, which saves memory; else numbers
        a += 2.0 * reach * b
        a += reach * reach * c
        a += noise
        b += reach * c
        position += reach * velocity
        if self._settings.decay != 1:
            b *= keep
            c *= keep * keep
            velocity *= keep
        c += noise
        innovation_variance = a + self._settings.r
        position_gain, velocity_gain = a / innovation_variance, b / innovation_variance
        self._covariances[2] = c - velocity_gain * b
        self._covariances[1] = b - position_gain * b
        self._covariances[0] = a - position_gain * a
        if restart_iou is not None:
            overlap = iou(position.reshape(4, -1).T, measured.reshape(4, -1).T)
            lost = (overlap < restart_iou).reshape(position.shape[1:])
        innovation = measured - position
        position += position_gain * innovation
        innovation *= velocity_gain
        velocity += innovation
        if restart_iou is not None and lost.any():
            self._restart(lost, measured)


class Kalman:
    """The paper's filter, exactly; or another of its family.

    Example:
        >>> import lae_sim
        >>> forecaster = lae_sim.Kalman([10, 20, 30, 40])
        >>> for frame in range(1, 6):
        ...     forecaster.update(frame, [10 + 2 * frame, 20, 30, 40])
        >>> [round(value, 2) for value in forecaster.predict(8)]
        [25.93, 20.0, 30.0, 40.0]
    """

    def __init__(
        self,
        box: Sequence[float],
        image_size: ImageSize = None,
        settings: TunedKalman = PAPER,
        restart_iou: float | None = None,
    ) -> None:
        self._settings = settings
        self._restart_iou = restart_iou
        self._frame = 0
        self._filter = _Filter(settings, self._position(box))

    def _position(self, box: Sequence[float]) -> Floats:
        position: Floats = self._settings.states(np.array([box], np.float64))[0]
        return position

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        transition = self._settings.transition(float(frame - self._frame))
        self._filter.update(transition, self._position(box), self._restart_iou)
        self._frame = frame

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        box: list[float] = self._forecast(frame)[0].tolist()
        return box

    def _forecast(self, frame: int) -> Floats:
        position, velocity = self._filter.states
        forecast = position + self._settings.reach(float(frame - self._frame)) * velocity
        return self._settings.boxes(forecast[None])

    @staticmethod
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
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
        super().__init__(box, restart_iou=RESTART_IOU)
        self._raw = np.array([box], np.float64)
        self.resize(image_size)

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        self._raw = np.array([box], np.float64)
        super().update(frame, box)

    def resize(self, image_size: ImageSize) -> None:
        """The next forecast is clipped to this width and height."""
        self._size = np.array([image_size or (np.inf, np.inf)], np.float64)

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        box: list[float] = clip(self._forecast(frame), self._raw, self._size)[0].tolist()
        return box

    @staticmethod
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """The same for many lanes at once; equal bit for bit."""
        forecasts = PAPER.forecast_lanes(lanes, item, frame, RESTART_IOU)
        return clip(forecasts, lanes.boxes[item], lanes.image_sizes_at(item, frame))


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
    lanes: Lanes, settings: TunedKalman = PAPER, restart_iou: float | None = None
) -> tuple[Floats, Ints]:
    """Filter all lanes in step (:meth:`.base.Lanes.in_step`).

    Args:
        lanes: what the filters are fed.
        settings: the filter.
        restart_iou: a measurement that overlaps its prediction by less restarts the filter there.

    Returns:
        Position and velocity after each item in time-major order, float64 [N, 2, 4], and the place
        of each item there, int64 [N].
    """
    order, running = lanes.in_step()
    interval = np.diff(lanes.frames, prepend=0).astype(np.float64)
    interval[lanes.offsets[:-1]] = 0.0
    interval = interval.take(order)
    keep, reach, noise = (np.asarray(each, np.float64) for each in settings.transition(interval))
    measured = np.ascontiguousarray(settings.states(lanes.boxes).take(order, axis=0).T)
    states = np.empty((len(order), 2, 4))
    width = int(running[0])
    filters = _Filter(settings, measured[:, :width])
    states[:width] = filters.states.transpose(2, 0, 1)
    for n, end in zip(running[1:].tolist(), np.cumsum(running)[1:].tolist()):
        now = slice(end - n, end)
        if n < width:
            width = n
            filters.keep_first(n)
        filters.update((keep[now], reach[now], noise[now]), measured[:, now], restart_iou)
        states[now] = filters.states.transpose(2, 0, 1)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return states, place
