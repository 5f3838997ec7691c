"""A guard: where a forecaster has lately done worse than holding the box, the box is held.

With every output one can see what the forecaster had said for that frame, as of the output before,
and how far the held box was off. Means of both errors, which forget, are kept for each coordinate:
the centre's two, the width and the height. Hold answers in a coordinate once the forecaster's error
is clearly above hold's, until it is below. Nothing of the truth is used, so what a tracker does
wrong by habit, and a forecaster mends, looks like an error of the forecaster: the guard is slow to
believe it, above all of the sides, where habits are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.forecast.arithmetic import Number, root, within
from lae_sim.forecast.base import (
    AnyFactory,
    Forecaster,
    ForecasterFactory,
    ImageSize,
    Lanes,
    Sequenced,
    SequenceFactory,
    defines,
    forecast,
    notes_of,
)

_KEPT = 0.9
_WORSE, _BETTER = 1.5, 1.1
# Of the errors, in target sizes, that count for nothing: of x, y, w and h.
_SLACK = (0.004, 0.004, 0.1, 0.1)
_MOST = 1.0  # a single error counts for no more, such as that of a jump
_PART = 1 << 11  # items at once: what is computed on the way stays in the cache
_FEWEST = 2  # outputs before one can be judged: with the initial box alone every forecast is that


def guarded(base: AnyFactory) -> AnyFactory:
    """A factory whose forecasters are guarded."""
    return _OfSequences(base) if isinstance(base, SequenceFactory) else Guarded(base)


@dataclass(frozen=True)
class _OfSequences:
    """Guards what is made for a sequence."""

    base: SequenceFactory

    def for_sequence(self, sequence: Sequenced) -> ForecasterFactory:
        return Guarded(self.base.for_sequence(sequence))

    @property
    def sees_frames(self) -> bool:
        return bool(getattr(self.base, "sees_frames", False))

    def notes(self, sequences: Sequence[str]) -> list[str]:
        return notes_of(self.base, sequences)


@dataclass(frozen=True)
class Guarded:
    """The factory of forecasters that hold the box where forecasting has lately been worse.

    Attributes:
        base: makes the forecasters that are guarded.

    Example:
        >>> import lae_sim
        >>> lae_sim.load_forecaster("guarded+kalman")
        Guarded(base=<class 'lae_sim.forecast.kalman.Kalman'>)
    """

    base: ForecasterFactory

    @property
    def by_number(self) -> bool:
        """Whether the base may look things up by a frame's number (see :class:`.LaneFactory`)."""
        return not defines(self.base, "forecast_lanes") or getattr(self.base, "by_number", False)

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        """The forecaster of one sequence."""
        return _Watched(self.base(box, image_size), box)

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """The same for many lanes at once, to the last bit if the base is."""
        before = np.maximum(np.arange(len(lanes.frames)) - 1, lanes.firsts())
        both = np.concatenate([item, before])  # asked together, the base works once
        order = np.argsort(both, kind="stable")
        answers = np.empty((len(both), 4))
        frames = np.concatenate([frame, lanes.frames])
        answers[order] = forecast(self.base, lanes, both[order], frames[order])
        boxes, said = answers[: len(item)], answers[len(item) :]
        held = self._held(lanes, said, lanes.boxes.take(before, axis=0)).take(item, axis=1)
        some = held.any(axis=0)
        boxes[some] = np.stack(
            _mixed(boxes[some].T, lanes.boxes[item[some]].T, held[:, some]), axis=1
        )
        return boxes

    @staticmethod
    def _held(lanes: Lanes, said: Floats, latest: Floats) -> Bools:
        """In which coordinates hold answers after each item, bool [4, N].

        Args:
            lanes: what is known.
            said: what the base said of each item's frame before it came, [N, 4].
            latest: the box before, [N, 4].
        """
        order, running = lanes.in_step()
        ends = np.cumsum(running)
        steps = [  # each with the places of its lanes in the step before
            (slice(end - n, end), slice(end - n - last, end - last))
            for last, n, end in zip(
                running[_FEWEST - 1 :].tolist(),
                running[_FEWEST:].tolist(),
                ends[_FEWEST:].tolist(),
            )
        ]
        means = np.empty((4, 2, len(order)))  # of the base and of hold, in time-major order
        for begin in range(0, len(order), _PART):
            part = slice(begin, begin + _PART)
            base, hold, box = (
                each.take(order[part], axis=0).T for each in (said, latest, lanes.boxes)
            )
            errors = _errors(np.stack([base, hold], axis=1), np.ascontiguousarray(box))
            for mean, error in zip(means, errors):
                mean[:, part] = _share(error)  # to which that of the steps before is added
        means[..., : ends[:_FEWEST].max(initial=0)] = 0.0
        for now, before in steps:
            means[..., now] += _KEPT * means[..., before]
        own, holds = means[:, 0], means[:, 1]
        slack = np.array(_SLACK)[:, None]
        held = own > _WORSE * holds + slack
        still = own > _BETTER * holds + 0.5 * slack
        for now, before in steps:
            held[:, now] |= held[:, before] & still[:, now]
        by_item: Bools = np.empty_like(held)
        by_item[:, order] = held
        return by_item

    def notes(self, sequences: Sequence[str]) -> list[str]:
        """What the base has to say."""
        return notes_of(self.base, sequences)


class _Watched:
    """The streaming form."""

    def __init__(self, base: Forecaster, box: Sequence[float]) -> None:
        self._base, self._box = base, box
        self._outputs = 0
        self._own, self._holds = [0.0] * 4, [0.0] * 4
        self._held = [False] * 4

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame, and see how well it was forecast."""
        self._outputs += 1
        if self._outputs >= _FEWEST:
            own = _errors(self._base.predict(frame), box)
            holds = _errors(self._box, box)
            self._own = [_KEPT * mean + _share(error) for mean, error in zip(self._own, own)]
            self._holds = [_KEPT * mean + _share(error) for mean, error in zip(self._holds, holds)]
            self._held = [
                a > (_BETTER * b + 0.5 * slack if held else _WORSE * b + slack)
                for a, b, slack, held in zip(self._own, self._holds, _SLACK, self._held)
            ]
        self._base.update(frame, box)
        self._box = box

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame."""
        box = self._base.predict(frame)
        return _mixed(box, self._box, self._held) if any(self._held) else box

    def resize(self, image_size: ImageSize) -> None:
        """Tell the base that images have another size."""
        if hasattr(self._base, "resize"):
            self._base.resize(image_size)


def _share(error: Number) -> Number:
    """What an error adds to its mean."""
    return (1.0 - _KEPT) * abs(error)


def _errors(said: Any, box: Any) -> tuple[Number, ...]:
    """By how much a box is off in x, y of the centre, w and h, in target sizes."""
    (x, y, w, h), (x1, y1, w1, h1) = said, box
    size = root(abs(w1 * h1) + 1.0)
    off = (x + w * 0.5) - (x1 + w1 * 0.5), (y + h * 0.5) - (y1 + h1 * 0.5), w - w1, h - h1
    return tuple(within(each / size, _MOST) for each in off)


def _mixed(box: Any, latest: Any, held: Any) -> tuple[Any, ...]:
    """A box with the coordinates that are held from the latest one; numbers or arrays."""
    (x, y, w, h), (x1, y1, w1, h1) = box, latest
    ways = zip(held, (x + w * 0.5, y + h * 0.5, w, h), (x1 + w1 * 0.5, y1 + h1 * 0.5, w1, h1))
    x, y, w, h = (
        np.where(keep, old, new) if isinstance(keep, np.ndarray) else (old if keep else new)
        for keep, new, old in ways
    )
    return x - w * 0.5, y - h * 0.5, w, h
