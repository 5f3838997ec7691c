"""Forecasters that know how the camera moves, where frames are at hand.

A drone's camera moves more than most targets, and what is on the ground moves with it. The camera's
motion from one frame to the next is seen in the background: corners (Shi and Tomasi, "Good Features
to Track", 1994) are followed by pyramidal Lucas-Kanade flow (Lucas and Kanade, 1981; Bouguet,
"Pyramidal Implementation of the Affine Lucas Kanade Feature Tracker", 2001), and RANSAC (Fischler
and Bolles, 1981) fits a similarity to them. Forecasting over it is after BoT-SORT (Aharon et al.,
"BoT-SORT: Robust Associations Multi-Pedestrian Tracking", 2022, Sec. 3.2).

A similarity of the plane, z -> m z + c with complex z = x + iy, is the pair (m, c).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from operator import index
from time import perf_counter_ns
from typing import Any, ClassVar, cast

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats, Ints
from lae_sim.boxes import centre
from lae_sim.datasets.frames import ImageSequence
from lae_sim.errors import LaeError
from lae_sim.forecast.base import (
    AnyFactory,
    Forecaster,
    ForecasterFactory,
    ImageSize,
    Lanes,
    Resizable,
    Sequenced,
    factory_for,
    forecast,
    notes_of,
)

LONGER_SIDE = 320  # of the images that are looked at, pixels; 480 costs twice and gains nothing
CORNERS = 200
LEAST_INLIERS = 12
LEAST_SHARE = 0.3
SCALES = 0.8, 1.25
STEPS = 3  # the camera's velocity is the mean of the last so many

Complexes = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """The camera's motion through one sequence.

    Attributes:
        transforms: similarities that map pixels of frame i-1 to frame i,
            ``[[a, -b, x], [b, a, y]]``, float64 [T, 2, 3]; the identity at frame 0 and where the
            estimate failed.
        elapsed_ns: what each estimate took on one core of this machine, without decoding,
            int64 [T].
    """

    transforms: Floats
    elapsed_ns: Ints

    def lag(self, fps: Fraction) -> int:
        """Frames, at least one, within which nearly all estimates (95 %) are ready."""
        cost = int(np.percentile(self.elapsed_ns, 95, method="higher"))
        return max(1, math.ceil(cost * fps / 10**9))


def estimate_camera(
    sequence: ImageSequence, progress: Callable[[int], object] = lambda frames: None
) -> CameraMotion:
    """Estimate the camera's motion from frame to frame, on one core; the same bits every time.

    An estimate fails if fewer than 12 corners, or less than 30 % of those followed, agree with it,
    or if it scales by less than 0.8 or more than 1.25.

    Args:
        sequence: the frames.
        progress: called with how many more frames are done, after each.

    Raises:
        LaeError: if a frame cannot be read.
    """
    import cv2

    transforms = np.tile(np.eye(2, 3), (len(sequence), 1, 1))
    elapsed_ns = np.zeros(len(sequence), np.int64)
    before = None
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for frame in range(len(sequence)):
            image = sequence.read(frame)
            start = perf_counter_ns()
            scale = min(1.0, LONGER_SIDE / max(image.shape[:2]))
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            if scale < 1:
                grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            if before is not None and before.shape == grey.shape:
                similarity = _similarity(before, grey)
                if similarity is not None:
                    transforms[frame] = _enlarged(similarity, scale)
            before = grey
            elapsed_ns[frame] = perf_counter_ns() - start
            progress(1)
    finally:
        cv2.setNumThreads(threads)
    return CameraMotion(transforms, elapsed_ns)


def _similarity(before: Any, now: Any) -> Floats | None:
    """The similarity from one grey image to the next, float64 [2, 3]; None if it is unknown."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, CORNERS, qualityLevel=0.01, minDistance=8)
    if corners is None or len(corners) < LEAST_INLIERS:
        return None
    there, followed, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, np.empty_like(corners))
    back, returned, _ = cv2.calcOpticalFlowPyrLK(now, before, there, np.empty_like(there))
    closed = np.abs(corners - back).max(axis=(1, 2)) < 0.5
    good = closed & (followed[:, 0] == 1) & (returned[:, 0] == 1)
    if good.sum() < LEAST_INLIERS:
        return None
    similarity, inliers = cv2.estimateAffinePartial2D(  # RANSAC seeds itself, always the same
        corners[good], there[good], method=cv2.RANSAC, ransacReprojThreshold=1.0
    )
    if similarity is None or inliers.sum() < max(LEAST_INLIERS, LEAST_SHARE * good.sum()):
        return None
    plausible = SCALES[0] <= math.hypot(similarity[0, 0], similarity[1, 0]) <= SCALES[1]
    return np.asarray(similarity, np.float64) if plausible else None


def _enlarged(transform: Floats, scale: float) -> Floats:
    """A similarity of downscaled pixels as one of whole pixels; centres of pixels are integers."""
    offset = (scale - 1) / 2
    moved = transform[:, :2].sum(axis=1) * offset + transform[:, 2] - offset
    return np.column_stack([transform[:, :2], moved / scale])


@dataclass(frozen=True, eq=False)
class Camera:
    """The camera's motion through sequences whose frames are at hand, estimated when first asked.

    The cost is counted so: the motion is estimated beside the tracker on a core of its own, so that
    it delays nobody, but is late. The query for frame i knows it up to frame i - lag, and the mean
    of the last three known steps is repeated from there. The motion up to an output's own frame
    counts as known with the output: a tracker takes longer than an estimate.

    Attributes:
        sequences: the frames at hand, by name. A live tracker's own sequence need not be there.
        fps: the world's frame rate.
        lag: by how many frames the motion is late; by default by what an estimate takes on this
            machine (see :meth:`CameraMotion.lag`). 0 is the ceiling.
        known: the estimates so far, by sequence; other sources, such as a gimbal, may fill it.
    """

    sequences: Mapping[str, ImageSequence]
    fps: Fraction
    lag: int | None = None
    known: dict[str, CameraMotion] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if self.lag is not None and self.lag < 0:
            raise LaeError(f"the camera's motion cannot be known {-self.lag} frames early")

    def lag_of(self, name: str) -> int:
        """By how many frames the motion of a known sequence is late."""
        return self.known[name].lag(self.fps) if self.lag is None else self.lag

    def outlooks(self, sequence: Sequenced) -> Complexes:
        """The map from frame 0 to frame k + d as known at k, complex128 [lag + 1 (d), T (k), 2].

        Raises:
            LaeError: if the sequence's frames are not at hand, or not as many as the truth's rows.
        """
        name = sequence.name
        if name not in self.known:
            live = sequence if isinstance(sequence, ImageSequence) else None
            images = self.sequences.get(name, live)
            if images is None:
                raise LaeError(f"sequence {name!r}: the camera's motion needs its frames")
            self.known[name] = estimate_camera(images)
        transforms = self.known[name].transforms
        frames, images_seen = len(sequence.truth), len(transforms)
        if frames != images_seen:
            raise LaeError(f"sequence {name!r} has {frames} frames here, and {images_seen} images")
        return _outlooks(transforms, self.lag_of(name))


@dataclass(frozen=True, eq=False)
class CameraCompensated:
    """A forecaster of the target's motion over the camera's, where that lately helped.

    Boxes are mapped to frame 0 by the camera's motion since, the base forecaster works there, and
    its predictions are mapped to the frame asked for: the centre by the similarity, the sides by
    its scale. Where the camera follows the target, that is worse than the base forecaster by
    itself; so both are run, and the closest of the two answers (see :class:`Closest`).

    Attributes:
        base: the forecaster of the target's motion. It is given no image size, since what it sees
            is not the image.
        camera: the camera's motion.
        always: whether the camera's motion counts even where it lately did not help.
    """

    base: AnyFactory
    camera: Camera
    always: bool = False
    sees_frames: ClassVar[bool] = True

    def for_sequence(self, sequence: Sequenced) -> ForecasterFactory:
        """The factory for one sequence.

        Raises:
            LaeError: as :meth:`Camera.outlooks`.
        """
        base = factory_for(self.base, sequence)
        moving = _Moving(base, self.camera.outlooks(sequence))
        return moving if self.always else Closest((base, moving))

    def notes(self, sequences: Sequence[str]) -> list[str]:
        """By how many frames the camera's motion was late on these sequences."""
        lags = sorted({self.camera.lag_of(n) for n in sequences if n in self.camera.known})
        why = "by what estimating takes on this machine" if self.camera.lag is None else "as told"
        late = f"the camera's motion is late by {' or '.join(map(str, lags))} frames, {why}"
        return [late] * bool(lags) + notes_of(self.base, sequences)


def _outlooks(transforms: Floats, lag: int) -> Complexes:
    """The map from frame 0 to frame k + d as known at k, complex128 [lag + 1 (d), T (k), 2].

    With a lag of 2, the motion up to frame 5 is known at frame 7 at the latest, and a forecast for
    frame 7 made on the output of frame 5 is read at d = 2, k = 5:

        k        0    1    2    3    4    5  ...
        d = 0    0    1    2    3    4    5       as estimated
        d = 1    1    2    3    4    5    6       one mean step beyond
        d = 2    2    3    4    5    6    7       two
    """
    steps = transforms[:, 0, [0, 2]] + 1j * transforms[:, 1, [0, 2]]
    velocity = steps.copy()
    outlooks = np.empty((lag + 1, *steps.shape), np.complex128)
    outlooks[0, 0] = steps[0]
    for k in range(1, len(steps)):
        outlooks[0, k] = _after(outlooks[0, k - 1], steps[k])
        velocity[k] = steps[max(k + 1 - STEPS, 1) : k + 1].mean(axis=0)
    for d in range(lag):
        outlooks[d + 1] = _after(outlooks[d], velocity)
    return outlooks


def _after(first: Complexes, second: Complexes) -> Complexes:
    """The similarity that does one, then another; complex128 [..., 2]."""
    m = second[..., 0]
    return np.stack([m * first[..., 0], m * first[..., 1] + second[..., 1]], axis=-1)


def _mapped(boxes: Floats, m: Complexes, c: Complexes) -> Floats:
    """Boxes under similarities, float64 [n, 4]."""
    scale = np.abs(m)[:, None]
    place = m * ((boxes[:, :2] + boxes[:, 2:] / 2) @ [1, 1j]) + c
    sides = boxes[:, 2:] * scale
    return np.concatenate([np.column_stack([place.real, place.imag]) - sides / 2, sides], axis=1)


@dataclass(frozen=True, eq=False)
class _Moving:
    """The base forecaster over the camera's motion, given as :func:`_outlooks`."""

    base: ForecasterFactory
    outlooks: Complexes
    by_number: ClassVar[bool] = True

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        return _OnMoving(self, box)

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """The same for many lanes at once."""
        frames = cast(Ints, lanes.frames)  # since it is asked by number
        still = self.stilled(lanes.boxes, frames)
        sizes = np.full_like(lanes.image_sizes, np.inf)
        boxes = forecast(self.base, Lanes(lanes.offsets, frames, still, sizes), item, frame)
        return self.moved(boxes, frames[item], cast(Ints, frame))

    def stilled(self, boxes: Floats, frame: Ints) -> Floats:
        """Boxes of outputs mapped from their frames to frame 0."""
        m, c = self.outlooks[0, frame].T
        return _mapped(boxes, 1 / m, -c / m)

    def moved(self, boxes: Floats, latest: Ints, frame: Ints) -> Floats:
        """Boxes mapped from frame 0 to those asked for, given the frames of the latest outputs."""
        lag = len(self.outlooks) - 1
        known = np.minimum(np.maximum(frame - lag, latest), frame)
        return _mapped(boxes, *self.outlooks[frame - known, known].T)


class _OnMoving:
    """The streaming form, by the same maps for one box."""

    def __init__(self, factory: _Moving, box: Sequence[float]) -> None:
        self._factory = factory
        self._base = factory.base(self._stilled(0, box), None)
        self._latest = 0

    def update(self, frame: int, box: Sequence[float]) -> None:
        self._latest = index(frame)
        self._base.update(frame, self._stilled(self._latest, box))

    def predict(self, frame: int) -> Sequence[float]:
        still = np.array([self._base.predict(frame)], np.float64)
        moved = self._factory.moved(still, np.array([self._latest]), np.array([index(frame)]))
        box: list[float] = moved[0].tolist()
        return box

    def _stilled(self, frame: int, box: Sequence[float]) -> list[float]:
        boxes = self._factory.stilled(np.array([box], np.float64), np.array([frame]))
        still: list[float] = boxes[0].tolist()
        return still


RECENT = 10


@dataclass(frozen=True, eq=False)
class Closest:
    """A factory of several forecasters run side by side: the one that lately missed least answers.

    An error is the distance of the centres of a prediction, made before an output came, and the
    output; the sum of the last ten counts.

    Attributes:
        several: their factories. The first one answers while none is better.
    """

    several: tuple[ForecasterFactory, ...]
    by_number: ClassVar[bool] = True

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        """The forecasters of one sequence."""
        return _Several([factory(box, image_size) for factory in self.several])

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """The same for many lanes at once."""
        fed = np.setdiff1d(np.arange(len(lanes.frames)), lanes.offsets[:-1])
        first, errors, boxes = lanes.first(item), [], []
        for factory in self.several:
            error = np.zeros(len(lanes.frames))  # stays 0 at a lane's first item
            predicted = forecast(factory, lanes, fed - 1, lanes.frames[fed])
            error[fed] = _distance(predicted, lanes.boxes[fed])
            recent = item[:, None] - np.arange(RECENT)
            errors.append(error[np.maximum(recent, first[:, None])].sum(axis=1))
            boxes.append(forecast(factory, lanes, item, frame))
        closest: Floats = np.stack(boxes)[np.argmin(errors, axis=0), np.arange(len(item))]
        return closest


class _Several:
    """The streaming form; its base forecasters may have no other."""

    def __init__(self, several: Sequence[Forecaster]) -> None:
        self._several = several
        self._errors: deque[Floats] = deque(maxlen=RECENT)

    def update(self, frame: int, box: Sequence[float]) -> None:
        predicted = np.array([each.predict(frame) for each in self._several], np.float64)
        self._errors.append(_distance(predicted, np.array([box], np.float64)))
        for each in self._several:
            each.update(frame, box)

    def resize(self, image_size: ImageSize) -> None:
        for each in self._several:
            if isinstance(each, Resizable):
                each.resize(image_size)

    def predict(self, frame: int) -> Sequence[float]:
        best = int(np.argmin(sum(self._errors))) if self._errors else 0
        return self._several[best].predict(frame)


def _distance(a: Floats, b: Floats) -> Floats:
    """Distance of centres, float64 [n]."""
    apart = centre(a) - centre(b)
    return np.hypot(apart[:, 0], apart[:, 1])
