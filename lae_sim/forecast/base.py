"""Forecasters: where the target is now, from outputs that are already old.

A forecaster is made for one sequence from its initial box, is fed the outputs in order, and
predicts the box at any later frame. Anything with these two methods will do:

    class MyForecaster:
        def __init__(self, box, image_size=None): ...
        def update(self, frame, box): ...
        def predict(self, frame): return [x, y, w, h]

The class itself is the factory; name it ``package.module:MyForecaster`` on the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Optional, Protocol, runtime_checkable

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.errors import LaeError, explained

ImageSize = Optional[tuple[int, int]]
"""Width and height of the images in pixels, or None if unknown."""


class Forecaster(Protocol):
    """One target's motion, from the outputs so far; boxes are ``x, y, w, h`` in pixels."""

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far; may be asked many times, in any order."""


ForecasterFactory = Callable[[Sequence[float], ImageSize], Forecaster]
"""``factory(initial_box, image_size)`` makes the forecaster of one sequence."""


@dataclass(frozen=True)
class Lanes:
    """The outputs that forecasters are fed, lane after lane; a lane is one forecaster's life.

    Attributes:
        offsets: first item of each lane, and N: int64 [lanes + 1]. A lane's first item is the
            initial box at frame 0.
        frames: frame of each item, int64 [N].
        boxes: box of each item, float64 [N, 4].
        image_sizes: per lane, float64 [lanes, 2], infinite = unknown.
    """

    offsets: Ints
    frames: Ints
    boxes: Floats
    image_sizes: Floats

    def lane(self, item: Ints) -> Ints:
        """The lane of each item, int64 [P]."""
        found: Ints = np.searchsorted(self.offsets, item, "right") - 1
        return found

    def first(self, item: Ints) -> Ints:
        """The first item of each item's lane, int64 [P]."""
        first: Ints = self.offsets[self.lane(item)]
        return first

    def chosen(self, lanes: Bools, item: Ints) -> tuple[Lanes, Bools, Ints]:
        """Some of the lanes, by a mark for each: bool [lanes].

        Returns:
            The lanes, which of some items [P] are theirs, bool [P], and those items' places there.
        """
        sizes = np.diff(self.offsets)
        kept = np.repeat(lanes, sizes)
        part = Lanes(
            np.concatenate([[0], np.cumsum(sizes[lanes])]),
            self.frames[kept],
            self.boxes[kept],
            self.image_sizes[lanes],
        )
        theirs = kept[item]
        return part, theirs, (np.cumsum(kept) - 1)[item[theirs]]


@runtime_checkable
class LaneFactory(Protocol):
    """A factory that can also answer for many lanes at once, faster than box after box."""

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints) -> Floats:
        """Boxes for some frames, float64 [P, 4], each as of one of the lanes' items.

        The arguments are those of :func:`forecast`.
        """


class Sequenced(Protocol):
    """What a recording and an image sequence have in common."""

    @property
    def name(self) -> str:
        """The sequence's name."""

    @property
    def truth(self) -> Floats:
        """Ground truth, float64 [T, 4]; NaN where there is none."""


@runtime_checkable
class SequenceFactory(Protocol):
    """A maker of factories for those that must know which sequence it is: its truth, its frames."""

    def for_sequence(self, sequence: Sequenced) -> ForecasterFactory:
        """The factory for one sequence."""


@runtime_checkable
class NotedFactory(Protocol):
    """A factory that has something to say of what its scores are worth."""

    def notes(self, sequences: Sequence[str]) -> list[str]:
        """What to say of its forecasts of these sequences, a sentence each."""


AnyFactory = ForecasterFactory | SequenceFactory


def factory_for(factory: AnyFactory, sequence: Sequenced) -> ForecasterFactory:
    """The factory of a sequence's forecasters."""
    return factory.for_sequence(sequence) if isinstance(factory, SequenceFactory) else factory


def own_notes(factory: Any, sequences: Sequence[str]) -> list[str]:
    """What a factory has to say of its forecasts of some sequences."""
    return factory.notes(sequences) if isinstance(factory, NotedFactory) else []


class Hold:
    """No forecast: the latest box stands. The baseline of every comparison."""

    memoryless = True  # looks at the latest output alone, so one history serves every sigma

    def __init__(self, box: Sequence[float], image_size: ImageSize = None) -> None:
        self._box = box

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        self._box = box

    def predict(self, frame: int) -> Sequence[float]:
        """The latest box."""
        return self._box

    @staticmethod
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints) -> Floats:
        """The same for many lanes at once."""
        boxes: Floats = lanes.boxes.take(item, axis=0)
        return boxes


class ConstantVelocity:
    """The latest box moved on by the difference of the last two."""

    def __init__(self, box: Sequence[float], image_size: ImageSize = None) -> None:
        self._frame = 0
        self._box = [float(value) for value in box]
        self._velocity = [0.0] * 4

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        interval = float(frame - self._frame)
        self._velocity = [(new - old) / interval for new, old in zip(box, self._box)]
        self._frame, self._box = frame, [float(value) for value in box]

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the last two boxes."""
        interval = float(frame - self._frame)
        return [p + interval * v for p, v in zip(self._box, self._velocity)]

    @staticmethod
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints) -> Floats:
        """The same for many lanes at once; equal bit for bit."""
        before = np.maximum(item - 1, lanes.first(item))
        interval = np.maximum(lanes.frames[item] - lanes.frames[before], 1).astype(np.float64)
        velocity = (lanes.boxes[item] - lanes.boxes[before]) / interval[:, None]
        ahead = (frame - lanes.frames[item]).astype(np.float64)
        boxes: Floats = lanes.boxes[item] + ahead[:, None] * velocity
        return boxes


class Oracle:
    """The truth at every frame, and the latest box where there is none: the ceiling."""

    @staticmethod
    def for_sequence(sequence: Sequenced) -> ForecasterFactory:
        """The factory that answers with this sequence's truth."""
        return partial(_Told, sequence.truth)


class _Told(Hold):
    def __init__(self, truth: Floats, box: Sequence[float], image_size: ImageSize = None) -> None:
        super().__init__(box)
        self._truth = truth

    def predict(self, frame: int) -> Sequence[float]:
        truth: list[float] = self._truth[min(frame, len(self._truth) - 1)].tolist()
        return truth if truth[2] > 0 and truth[3] > 0 else super().predict(frame)


def own(factory: AnyFactory, name: str) -> bool:
    """Whether a factory's class itself has an attribute.

    What it inherits does not count: a subclass may have changed the methods that a shortcut of its
    base stands for.
    """
    return name in vars(factory if isinstance(factory, type) else type(factory))


def forecast(
    factory: ForecasterFactory, lanes: Lanes, item: Ints, frame: Ints, name: str = "forecaster"
) -> Floats:
    """Forecasts of each lane's forecaster, each as of one of the lane's items.

    Args:
        factory: makes the forecasters.
        lanes: what they are fed.
        item: index of the latest item that a forecast has seen, int64 [P], not decreasing.
        frame: the frame it is for, int64 [P].
        name: the forecaster's name, for messages.

    Returns:
        Boxes, float64 [P, 4].

    Raises:
        LaeError: if a forecaster fails, or answers anything but four finite numbers.
    """
    with explained(name):
        if own(factory, "forecast_lanes") and isinstance(factory, LaneFactory):
            boxes = np.asarray(factory.forecast_lanes(lanes, item, frame), np.float64)
            if boxes.shape != (len(item), 4):
                raise LaeError(f"{name}: answered {boxes.shape}, not {(len(item), 4)}")
            good = np.isfinite(boxes).all(axis=1)
            if not good.all():
                told, at = boxes[~good][0], frame[~good][0]
                raise LaeError(f"{name}: predicted {told} for frame {at}, not a box x, y, w, h")
            return boxes
        return _streamed(factory, lanes, item, frame, name)


def _streamed(
    factory: ForecasterFactory, lanes: Lanes, item: Ints, frame: Ints, name: str
) -> Floats:
    """The forecasts of forecasters that are fed one box after another."""
    answers = np.empty((len(item), 4))
    fed, current = -1, -1
    forecaster: Any = None
    for p, (i, k) in enumerate(zip(item.tolist(), lanes.lane(item).tolist())):
        if k != current:
            current, fed = k, int(lanes.offsets[k])
            size = lanes.image_sizes[k]
            known = (int(size[0]), int(size[1])) if np.isfinite(size).all() else None
            forecaster = factory(lanes.boxes[fed].tolist(), known)
        while fed < i:
            fed += 1
            forecaster.update(int(lanes.frames[fed]), lanes.boxes[fed].tolist())
        told = forecaster.predict(int(frame[p]))
        try:
            answer = np.asarray(told, np.float64)
        except (TypeError, ValueError, OverflowError):
            answer = np.array(np.nan)
        if answer.shape != (4,) or not np.isfinite(answer).all():
            raise LaeError(
                f"{name}: predicted {told!r:.80} for frame {frame[p]}, not a box x, y, w, h"
            )
        answers[p] = answer
    return answers
