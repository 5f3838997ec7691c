"""Forecasters: where the target is now, from outputs that are already old.

A forecaster is made for one sequence from its initial box, is fed the outputs in order, and
predicts the box at any later frame. Anything with these two methods will do:

    class MyForecaster:
        def __init__(self, box, image_size=None): ...
        def update(self, frame, box): ...
        def predict(self, frame): return [x, y, w, h]

The class itself is the factory; name it ``package.module:MyForecaster`` on the command line.

A frame stands for the time when it arrives. Where frames arrive evenly that is its number, an int.
Where they arrive at times of their own, as those of a camera that dropped some, it is a float, the
time since frame 0 in nominal frame intervals: a frame that comes after a dropped one is 2 later
than the one before. So differences of frames are intervals, whatever the world. Used as an index
(``truth[frame]``) or by ``operator.index(frame)`` such a float is the frame's number.

That is the *streaming* form, and all that a forecaster needs: :func:`forecast` feeds it box after
box. A factory may have a second form for many sequences and permitted latencies at once, its
*lanes* (:class:`LaneFactory`). The built-in ones that have it keep it as the only form, or nearly:

    hold                a stored box, and one `take` over lanes: nothing to share
    constant-velocity   lanes; streaming is a lane of its last two outputs (:class:`LastOutputs`)
    windows             lanes; streaming is a lane of as many outputs as the rule looks at
    kalman              one update that works on one filter and on n of them in step
    g-h, imm, oracle    streaming
    camera+NAME         both: over lanes all frames are mapped at once, 30 times as fast, while
                        streaming by a lane would ask for all outputs so far at every frame
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import index
from typing import Any, Optional, Protocol, runtime_checkable

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.engine.arrivals import FrameTime
from lae_sim.errors import LaeError, explained
from lae_sim.plugins import bound, check_methods, with_options
from lae_sim.trace.metadata import ImageSizes

ImageSize = Optional[tuple[int, int]]
"""Width and height of the images in pixels, or None if unknown."""


class Forecaster(Protocol):
    """One target's motion, from the outputs so far; boxes are ``x, y, w, h`` in pixels.

    Any class with these methods will do; it is made with the first box and the image size. One that
    also has ``resize(image_size)`` is told before anything else when images have another size.

    Example:
        >>> import lae_sim
        >>> class Drift:
        ...     def __init__(self, box, image_size=None):
        ...         self.frame, self.box = 0, box
        ...
        ...     def update(self, frame, box):
        ...         self.frame, self.box = frame, box
        ...
        ...     def predict(self, frame):
        ...         x, y, w, h = self.box
        ...         return [x + 2 * (frame - self.frame), y, w, h]
        >>> lae_sim.evaluate("traces/synthetic-slow.parquet", forecasters=Drift)
        <EvaluationResult of synthetic-slow.parquet, recorded: AUC hold 0.5722, Drift 0.5542>
    """

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame.

        Args:
            frame: its number; where frames arrive at times of their own, a float: the time since
                frame 0 in nominal frame intervals, and as an index the frame's number.
            box: ``x, y, w, h`` in pixels.
        """

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far; may be asked many times, in any order."""


@runtime_checkable
class Resizable(Protocol):
    """A forecaster that follows images which change size."""

    def resize(self, image_size: ImageSize) -> None:
        """What comes next is of images of this width and height, pixels."""


def resize(forecaster: Forecaster, image_sizes: ImageSizes | None, frame: float) -> None:
    """Tell a forecaster that follows it the size of a frame's image, if sizes change."""
    if image_sizes is not None and image_sizes.change and isinstance(forecaster, Resizable):
        forecaster.resize(image_sizes.at(frame))


_METHODS = {"update": ("frame", "box"), "predict": ("frame",)}


ForecasterFactory = Callable[[Sequence[float], ImageSize], Forecaster]
"""``factory(initial_box, image_size)`` makes the forecaster of one sequence."""


@dataclass(frozen=True)
class Lanes:
    """The outputs that forecasters are fed, lane after lane; a lane is one forecaster's life.

    Three lanes with N = 6 items, outputs of the frames 0, 2, 5 of one sequence and so on:

        item      0  1  2 | 3 | 4  5
        frames    0  2  5 | 0 | 0  3
        offsets   0         3   4      6

    Attributes:
        offsets: first item of each lane, and N: int64 [lanes + 1]. A lane's first item is the
            initial box at frame 0.
        frames: frame of each item, int64 [N]; float64, their times in nominal frame intervals,
            where frames arrive at times of their own.
        boxes: box of each item, float64 [N, 4].
        image_sizes: per lane, float64 [lanes, 2], infinite = unknown; of frame 0.
        numbers: the frames' numbers, int64 [N], where ``frames`` are times.
        resized: of lanes whose images change size, all their sizes, by ``frames``.
    """

    offsets: Ints
    frames: Ints | Floats
    boxes: Floats
    image_sizes: Floats
    numbers: Ints | None = None
    resized: Mapping[int, ImageSizes] = field(default_factory=dict)

    def lane(self, item: Ints) -> Ints:
        """The lane of each item, int64 [P]."""
        lane: Ints = np.searchsorted(self.offsets, item, "right") - 1
        return lane

    def first(self, item: Ints) -> Ints:
        """The first item of each item's lane, int64 [P]."""
        first: Ints = self.offsets[self.lane(item)]
        return first

    def firsts(self) -> Ints:
        """The first item of every item's lane, int64 [N]."""
        return np.repeat(self.offsets[:-1], np.diff(self.offsets))

    def in_step(self) -> tuple[Ints, Ints]:
        """The items in time-major order: the k-th of every lane that has one, for each k.

        What goes through all lanes in step works on one stretch of memory at each step: lanes are
        sorted by length, so those that go on are the first ones of the step before. Three lanes of
        4, 3 and 1 items:

            lane       in time-major order
            a0 a1 a2 a3     a0 b0 c0 | a1 b1 | a2 b2 | a3
            b0 b1 b2        running = 3, 2, 2, 1
            c0

        Returns:
            The item at each place of that order, int64 [N], and how many lanes have more than k
            items, int64 [items of the longest].
        """
        lengths = np.diff(self.offsets)
        longest = np.argsort(-lengths, kind="stable")
        steps = np.arange(lengths.max(initial=0))
        running: Ints = np.searchsorted(-lengths[longest], -steps)
        begins = np.cumsum(running) - running
        lane = np.arange(len(self.frames)) - np.repeat(begins, running)
        order: Ints = self.offsets[longest].take(lane)
        order += np.repeat(steps, running)
        return order, running

    def image_sizes_at(self, item: Ints, frame: Ints | Floats) -> Floats:
        """Width and height of frames' images in the lanes of some items, float64 [P, 2].

        Args:
            item: int64 [P], not decreasing.
            frame: int64 [P], or float64, as ``frames`` are.
        """
        lane = self.lane(item)
        sizes: Floats = self.image_sizes[lane]
        for k, changing in self.resized.items():
            begin, end = np.searchsorted(lane, [k, k + 1])
            which = np.searchsorted(changing.starts, frame[begin:end], "right") - 1
            sizes[begin:end] = np.array(changing.sizes)[which]
        return sizes

    def chosen(self, lanes: Bools, item: Ints) -> tuple[Lanes, Bools, Ints]:
        """Some of the lanes, by a mark for each: bool [lanes].

        Returns:
            The lanes, which of some items [P] are in them, bool [P], and those items' places there.
        """
        sizes = np.diff(self.offsets)
        kept = np.repeat(lanes, sizes)
        place = np.cumsum(lanes) - 1
        part = Lanes(
            np.concatenate([[0], np.cumsum(sizes[lanes])]),
            self.frames[kept],
            self.boxes[kept],
            self.image_sizes[lanes],
            None if self.numbers is None else self.numbers[kept],
            {int(place[k]): sizes for k, sizes in self.resized.items() if lanes[k]},
        )
        inside = kept[item]
        return part, inside, (np.cumsum(kept) - 1)[item[inside]]


@runtime_checkable
class LaneFactory(Protocol):
    """A factory that can also answer for many lanes at once, faster than box after box."""

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """Boxes for some frames, float64 [P, 4], each as of one of the lanes' items.

        The arguments are those of :func:`forecast`. A factory that looks things up by a frame's
        number says so by an attribute, ``by_number = True``: where frames are times it is asked
        box after box.
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


def own_factory(what: str, made: Any, options: Mapping[str, Any] | None = None) -> AnyFactory:
    """The factory that something of a user's is, with options, checked to take what it is given.

    Args:
        what: what it is, for messages.
        made: a class of forecasters, or a function that makes one, which takes the options beside
            the box and the image size; an object that makes forecasters, or a class of such, which
            takes the options alone.
        options: keyword arguments.

    Raises:
        LaeError: if it does not take them, or its forecasters lack a method.
    """
    makes = isinstance(made, type) and not hasattr(made, "predict")
    if makes and ("__call__" in dir(made) or (options and hasattr(made, "for_sequence"))):
        made, options = bound(what, made, [], options or {}), None
    if isinstance(made, SequenceFactory):
        return made
    if isinstance(made, type):
        check_methods(what, made, _METHODS)
    return with_options(what, made, options or {}, ("box", "image_size"))


def notes_of(factory: Any, sequences: Sequence[str]) -> list[str]:
    """What a factory has to say of its forecasts of some sequences."""
    return factory.notes(sequences) if isinstance(factory, NotedFactory) else []


class Hold:
    """No forecast: the latest box stands. The baseline of every comparison.

    Example:
        >>> import lae_sim
        >>> forecaster = lae_sim.Hold([10, 20, 30, 40])
        >>> forecaster.update(3, [16, 20, 30, 40])
        >>> forecaster.predict(6)
        [16, 20, 30, 40]
    """

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
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """The same for many lanes at once."""
        boxes: Floats = lanes.boxes.take(item, axis=0)
        return boxes


class LastOutputs:
    """The streaming form of a forecaster over lanes that looks at the last few outputs only.

    They are a lane by themselves, of which the factory is asked.
    """

    def __init__(self, factory: LaneFactory, count: int, box: Sequence[float]) -> None:
        self._factory = factory
        self._outputs = deque([(0, tuple(box))], maxlen=count)

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        self._outputs.append((frame, tuple(box)))

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the last boxes."""
        frames, boxes = zip(*self._outputs)
        count = len(frames)
        lane = Lanes(
            np.array([0, count]),
            np.array(frames),
            np.array(boxes, np.float64),
            np.full((1, 2), np.inf),
        )
        forecasts = self._factory.forecast_lanes(lane, np.array([count - 1]), np.array([frame]))
        box: list[float] = forecasts[0].tolist()
        return box


class ConstantVelocity(LastOutputs):
    """The latest box moved on by the difference of the last two."""

    def __init__(self, box: Sequence[float], image_size: ImageSize = None) -> None:
        super().__init__(ConstantVelocity, 2, box)

    @staticmethod
    def forecast_lanes(lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """Forecasts of many lanes at once."""
        before = np.maximum(item - 1, lanes.first(item))
        interval = (lanes.frames[item] - lanes.frames[before]).astype(np.float64)
        interval[interval == 0] = 1.0
        velocity = (lanes.boxes[item] - lanes.boxes[before]) / interval[:, None]
        ahead = (frame - lanes.frames[item]).astype(np.float64)
        boxes: Floats = lanes.boxes[item] + ahead[:, None] * velocity
        return boxes


class Oracle:
    """The truth at every frame, and the latest box where there is none: the ceiling."""

    @staticmethod
    def for_sequence(sequence: Sequenced) -> ForecasterFactory:
        """The factory that answers with this sequence's truth."""
        return partial(_Truth, sequence.truth)


class _Truth(Hold):
    def __init__(self, truth: Floats, box: Sequence[float], image_size: ImageSize = None) -> None:
        super().__init__(box)
        self._truth = truth

    def predict(self, frame: int) -> Sequence[float]:
        truth: list[float] = self._truth[min(index(frame), len(self._truth) - 1)].tolist()
        return truth if truth[2] > 0 and truth[3] > 0 else super().predict(frame)


def defines(factory: AnyFactory, name: str) -> bool:
    """Whether a factory's class itself defines an attribute.

    What it inherits does not count: a subclass may have changed the methods that a shortcut of its
    base stands for.
    """
    return name in vars(factory if isinstance(factory, type) else type(factory))


def forecast(
    factory: ForecasterFactory,
    lanes: Lanes,
    item: Ints,
    frame: Ints | Floats,
    name: str = "forecaster",
    number: Ints | None = None,
) -> Floats:
    """Forecasts of each lane's forecaster, each as of one of the lane's items.

    Args:
        factory: makes the forecasters.
        lanes: what they are fed.
        item: index of the latest item that a forecast has seen, int64 [P], not decreasing.
        frame: the frame it is for, int64 [P]; its time, float64 [P], where the lanes have times.
        name: the forecaster's name, for messages.
        number: the frame's number, int64 [P], where ``frame`` is its time.

    Returns:
        Boxes, float64 [P, 4].

    Raises:
        LaeError: if a forecaster fails, or answers anything but four finite numbers.
    """
    with explained(name):
        in_lanes = defines(factory, "forecast_lanes")
        if number is not None and getattr(factory, "by_number", False):
            in_lanes = False
        if in_lanes and isinstance(factory, LaneFactory):
            boxes = np.asarray(factory.forecast_lanes(lanes, item, frame), np.float64)
            if boxes.shape != (len(item), 4):
                raise LaeError(f"{name}: answered {boxes.shape}, not {(len(item), 4)}")
            if not np.isfinite(boxes).all():
                bad = int(np.argmin(np.isfinite(boxes).all(axis=1)))
                box, at = boxes[bad], frame[bad]
                raise LaeError(f"{name}: predicted {box} for frame {at}, not a box x, y, w, h")
            return boxes
        return _streamed(factory, lanes, item, frame, name, number)


def _frames(frame: Ints | Floats, number: Ints | None) -> list[Any]:
    """Frames as forecasters are given them one by one."""
    return frame.tolist() if number is None else list(map(FrameTime, frame, number.tolist()))


def _streamed(
    factory: ForecasterFactory,
    lanes: Lanes,
    item: Ints,
    frame: Ints | Floats,
    name: str,
    number: Ints | None,
) -> Floats:
    """The forecasts of forecasters that are fed one box after another."""
    boxes = np.empty((len(item), 4))
    fed_frames, asked = _frames(lanes.frames, lanes.numbers), _frames(frame, number)
    fed, current = -1, -1
    forecaster: Any = None
    for p, (i, k) in enumerate(zip(item.tolist(), lanes.lane(item).tolist())):
        if k != current:
            current, fed = k, int(lanes.offsets[k])
            size = lanes.image_sizes[k]
            image_size = (int(size[0]), int(size[1])) if np.isfinite(size).all() else None
            forecaster = factory(lanes.boxes[fed].tolist(), image_size)
            check_methods(name, forecaster, _METHODS)
        while fed < i:
            fed += 1
            resize(forecaster, lanes.resized.get(k), fed_frames[fed])
            forecaster.update(fed_frames[fed], lanes.boxes[fed].tolist())
        resize(forecaster, lanes.resized.get(k), asked[p])
        answer = forecaster.predict(asked[p])
        try:
            box = np.asarray(answer, np.float64)
        except (TypeError, ValueError, OverflowError):
            box = np.array(np.nan)
        if box.shape != (4,) or not np.isfinite(box).all():
            raise LaeError(
                f"{name}: predicted {answer!r:.80} for frame {frame[p]}, not a box x, y, w, h"
            )
        boxes[p] = box
    return boxes
