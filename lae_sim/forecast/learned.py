"""The learned forecaster: a small network over the last outputs, in NumPy alone.

It sees the last velocities of the target, in target sizes per frame, the intervals between them,
the target's size, and the first velocities of the sequence, which begin at the truth and so tell
whether a tracker's boxes are early, late, larger or smaller than it. With every output it answers
with weights for these velocities and corrections, from which the box at any later frame follows. A
regression on past motion is PVT++'s idea (Li et al., "PVT++: A Simple End-to-End Latency-Aware
Visual Tracking Framework", ICCV 2023, Sec. 4); weights over velocities, and training on the overlap
and on made-up motion, are new here.

Answers are the same bits for one sequence and for thousands, on every processor, so that no
tolerance is needed: the network counts in whole numbers (:mod:`lae_sim.forecast.network`) and sums
of velocities are of multiples of 2**-20, both exact in any order, whatever BLAS and its threads do;
all else is addition, multiplication, division, square roots and rounding, which IEEE 754 defines to
the last bit, number by number in one order.
Logarithms are not defined so: sizes change by r = 2 (b - a) / (b + a), which is about log(b / a),
and of which b = a (2 + r) / (2 - r) is the inverse.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.datasets.names import video_of
from lae_sim.errors import LaeError
from lae_sim.forecast.arithmetic import Number, at_least, nearest, root, within
from lae_sim.forecast.base import Forecaster, ImageSize, Lanes
from lae_sim.forecast.guard import Guarded
from lae_sim.forecast.network import ONE, Network, read_network, write_network

VELOCITIES = 8
STARTS = 3
HORIZONS = (2.0, 8.0)
RATES = 1 + len(HORIZONS)
SLOPE = 20.0
CORRECTION = 1 / 16
OFFSET = 1 / 8

SHIPPED = Path(__file__).with_name("learned.npz")
"""The weights that come with the package."""

_SEEN = 6  # numbers of each velocity: x, y, w, h, the interval, whether it is known
INPUTS = _SEEN * (VELOCITIES + STARTS) + 3
MIXING = 2 * RATES * VELOCITIES
OUTPUTS = MIXING + 4 * RATES + 4
_FINE = 2.0**20  # velocities are multiples of its inverse, so that sums of them are exact
_FASTEST = 8.0
_PART = 1024


@dataclass(frozen=True)
class Place:
    """Where a target is and how large, as numbers or as arrays [n]: pixels, centre, sides >= 1."""

    x: Number
    y: Number
    w: Number
    h: Number
    size: Number

    @classmethod
    def of(cls, x: Number, y: Number, w: Number, h: Number) -> Place:
        """The place of a box."""
        wide, high = at_least(w, 1.0), at_least(h, 1.0)
        return cls(x + w * 0.5, y + h * 0.5, wide, high, root(wide * high))

    def chosen(self, which: Ints) -> Place:
        """Some of the places."""
        return Place(*(each.take(which) for each in (self.x, self.y, self.w, self.h, self.size)))

    def velocity(self, before: Place, interval: Number) -> tuple[Number, ...]:
        """Of the centre in sizes per frame, of the sides as ratios per frame, after an interval."""
        moves = (
            (self.x - before.x) / self.size,
            (self.y - before.y) / self.size,
            2.0 * (self.w - before.w) / (self.w + before.w),
            2.0 * (self.h - before.h) / (self.h + before.h),
        )
        return tuple(nearest(within(move / interval, _FASTEST) * _FINE) / _FINE for move in moves)

    def shape(self, age: Number) -> tuple[Number, ...]:
        """What the network sees of it and of the number of outputs so far."""
        parts = self.size / (self.size + 50.0), self.w / (self.w + self.h), age / (age + 8.0)
        return tuple(nearest(part * ONE) for part in parts)

    def moved(self, rates: Any, offset: Any, ahead: Number) -> tuple[Number, ...]:
        """The box so many frames later.

        Args:
            rates: [RATES][4], of numbers or arrays.
            offset: [4].
            ahead: frames, above 0.
        """
        near, far = ahead / (ahead + HORIZONS[0]), ahead / (ahead + HORIZONS[1])
        x, y, w, h = (
            (rates[0][i] + rates[1][i] * near + rates[2][i] * far) * ahead + offset[i]
            for i in range(4)
        )
        w, h = within(w, 1.0), within(h, 1.0)
        wide, high = self.w * (2.0 + w) / (2.0 - w), self.h * (2.0 + h) / (2.0 - h)
        left, top = self.x + x * self.size - wide * 0.5, self.y + y * self.size - high * 0.5
        return left, top, wide, high


@dataclass(frozen=True, eq=False)
class Past:
    """The motion that led to each of N outputs, a row for each of its numbers.

    Attributes:
        place: where the target is then, arrays [N].
        velocity: see :meth:`Place.velocity`, [4, N]; 0 for the first of a lane.
        interval: frames since the output before, [N]; 0 for the first of a lane.
        first: first item of each one's lane, int64 [N].
    """

    place: Place
    velocity: Floats
    interval: Floats
    first: Ints

    @classmethod
    def of(cls, lanes: Lanes) -> Past:
        """The motion of some lanes."""
        every, first = np.arange(len(lanes.frames)), lanes.firsts()
        before = np.maximum(every - 1, first)
        place = Place.of(*lanes.boxes.T)
        interval = (lanes.frames - lanes.frames[before]).astype(np.float64)
        since = np.where(interval > 0, interval, 1.0)
        velocity = np.stack(place.velocity(place.chosen(before), since))
        velocity[:, interval <= 0] = 0.0
        return cls(place, velocity, np.maximum(interval, 0.0), first)

    def window(self, item: Ints) -> Ints:
        """The outputs whose motion is seen as of some items, [n, VELOCITIES + STARTS].

        They are the last ones, newest first, and the first ones of the lane. Where there is none it
        is the lane's first output, which nothing led to.
        """
        start = self.first[item, None]
        last = np.maximum(item[:, None] - np.arange(VELOCITIES), start)
        opening = start + 1 + np.arange(STARTS)
        return np.concatenate([last, np.where(opening <= item[:, None], opening, start)], axis=1)


def rows_of(velocity: Floats, interval: Floats) -> Floats:
    """What the network sees of velocities [4, ...] after intervals [...], [6, ...]."""
    return np.stack([*_row(velocity, interval), np.where(interval > 0, ONE, 0.0)])


def _row(velocity: Sequence[Number] | Floats, interval: Number) -> tuple[Number, ...]:
    """What the network sees of a velocity, in its whole numbers."""
    steep = [SLOPE * each for each in velocity]
    bent = [each / root(1.0 + abs(each)) for each in steep]
    return *(nearest(each * ONE) for each in bent), nearest(interval / (interval + 4.0) * ONE)


_LEAD = VELOCITIES - 1  # columns of zeros before the first item, to which windows may reach back


def _led(rows: Floats) -> Floats:
    """Rows [k, N] after the leading zeros, [k, _LEAD + N]."""
    return np.concatenate([np.zeros((len(rows), _LEAD)), rows], axis=1)


def _lag(rows: Floats, begin: int, out: Floats) -> None:
    """Write the columns of the last outputs as of each of some items, newest first.

    They are slices of the rows, which takes far less time than to gather them. As of a lane's first
    items some are of the lane before; there is nothing then. Two lanes, a and b:

        rows        a0 a1 a2 b0 b1 b2
        out[0]      a0 a1 a2 b0 b1 b2
        out[1]      .  a0 a1 a2 b0 b1       a2: nothing
        out[2]      .  .  a0 a1 a2 b0       a1, a2: nothing

    Args:
        rows: of all items, [k, _LEAD + N]; see :func:`_led`.
        begin: the first of the items.
        out: [VELOCITIES, k, n].
    """
    for k, columns in enumerate(out):
        last = begin + _LEAD - k
        columns[:] = rows[:, last : last + columns.shape[1]]


def mirrored(motion: Floats) -> Floats:
    """By what to multiply x and y so that motions [VELOCITIES, 4, ...] go right and down, [2, ...].

    By 0 if they go neither way: of a mirrored world everything is mirrored, of one at rest too.
    """
    signs: Floats = np.sign(sum(part * each for part, each in zip(_FADING, motion[:, :2])))
    return signs


@dataclass(frozen=True, eq=False)
class Learned:
    """The factory of forecasters that go by a network.

    Attributes:
        network: from ``INPUTS`` numbers to ``OUTPUTS``.
    """

    network: Network

    @property
    def document(self) -> Mapping[str, Any]:
        """What it was trained on and how, as JSON; ``sequences`` names real ones."""
        return self.network.document

    def notes(self, sequences: Sequence[str]) -> list[str]:
        """Its weights' digest, and whether it was trained on these sequences or their videos."""
        known = {video_of(name) for name in self.document.get("sequences", ())}
        seen = sum(video_of(name) in known for name in sequences)
        notes = [f"weights {self.network.digest[:16]}"]
        return notes + ([f"trained on {seen} of these {len(sequences)} sequences"] if seen else [])

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        """The forecaster of one sequence."""
        return _Following(self.network, box)

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints | Floats) -> Floats:
        """The same for many lanes at once, to the last bit."""
        past = Past.of(lanes)
        ahead = (frame - lanes.frames[item]).astype(np.float64)
        boxes: Floats = lanes.boxes.take(item, axis=0)
        asked = np.flatnonzero((ahead > 0) & (item > past.first[item]))  # else nothing has moved
        item, ahead = item[asked], ahead[asked]
        for part, rates, offset in self._outlooks(past):
            some = slice(*np.searchsorted(item, [part.start, part.stop]))
            place, at = past.place.chosen(item[some]), item[some] - part.start
            moved = place.moved(
                [[each.take(at) for each in row] for row in rates],
                [each.take(at) for each in offset],
                ahead[some],
            )
            boxes[asked[some]] = np.stack(moved, axis=1)
        return boxes

    def _outlooks(self, past: Past) -> Iterator[tuple[slice, list[list[Floats]], list[Floats]]]:
        """The rates and offsets after each item of a part of them, one part after another."""
        count = len(past.first)
        age = np.arange(count) - past.first
        velocity = _led(past.velocity)
        rows = _led(rows_of(past.velocity, past.interval))
        shape = np.stack(past.place.shape(age.astype(np.float64)))
        motions, sights = np.empty((VELOCITIES, 4, _PART)), np.empty((INPUTS, _PART))
        windows = sights[:-3].reshape(VELOCITIES + STARTS, _SEEN, _PART)
        for begin in range(0, count, _PART):
            part = slice(begin, min(begin + _PART, count))
            n, old = part.stop - begin, age[part]
            motion, inputs, seen = motions[..., :n], sights[:, :n], windows[..., :n]
            none, at = np.nonzero(old < np.arange(VELOCITIES)[:, None])
            for last, out in ((velocity, motion), (rows, seen[:VELOCITIES])):
                _lag(last, begin, out)
                out[none, :, at] = 0.0
            for k in range(STARTS):
                opening = past.first[part] + np.where(old > k, k + 1, 0)
                seen[VELOCITIES + k] = rows.take(_LEAD + opening, axis=1)
            mirror = mirrored(motion)
            seen[:, :2] *= mirror
            inputs[-3:] = shape[:, part]
            answers = self.network(inputs)
            mixed = np.einsum(
                "srvn,vscn->rscn",
                answers[:MIXING].reshape(2, RATES, VELOCITIES, n),
                motion.reshape(VELOCITIES, 2, 2, n),
            ).reshape(RATES, 4, n)
            yield part, *_outlook(mixed, answers[MIXING:], mirror)


_FADING = 0.5 ** np.arange(VELOCITIES)
"""Weights of the velocities by which a motion is mirrored to go right and down: sums are exact."""

_MIRRORS = np.ones((3, 3, INPUTS))
"""What inputs are multiplied by, for a factor of 0, 1 or -1 of x and of y."""
for _factor in (0, -1):
    _MIRRORS[_factor, :, 0:-3:_SEEN] = _factor
    _MIRRORS[:, _factor, 1:-3:_SEEN] = _factor


def _outlook(
    mixed: Any, more: Any, mirror: Sequence[Number] | Floats
) -> tuple[list[list[Number]], list[Number]]:
    """What the network's answers mean, in numbers or arrays; all of it is exact.

    Args:
        mixed: sums of velocities by the network's weights, [RATES][4]; ``ONE`` is 1.
        more: its other answers, corrections of these and offsets, [4 * RATES + 4]; ``ONE`` is 1.
        mirror: by what x and y were multiplied, see :func:`mirrored`, [2].

    Returns:
        Rates [RATES][4] and offsets [4] for :meth:`Place.moved`.
    """
    x, y = mirror
    more = [each * turn for each, turn in zip(more, [x, y, 1.0, 1.0] * (RATES + 1))]
    rates = [
        [mix / ONE + CORRECTION / ONE * each for mix, each in zip(row, more[4 * k :])]
        for k, row in enumerate(mixed)
    ]
    return rates, [OFFSET / ONE * each for each in more[-4:]]


class _Following:
    """The streaming form, with one column of the arrays above."""

    def __init__(self, network: Network, box: Sequence[float]) -> None:
        self._network = network
        self._frame: float = 0
        self._count = 0
        self._box = box
        self._place = Place.of(*map(float, box))
        self._inputs = np.zeros(INPUTS)
        self._motion = np.zeros((VELOCITIES, 4))
        self._rates: Any = None
        self._offset: Any = None

    def update(self, frame: int, box: Sequence[float]) -> None:
        """Take in the box of a newer frame."""
        place, interval = Place.of(*map(float, box)), float(frame - self._frame)
        inputs, motion, seen_last = self._inputs, self._motion, _SEEN * VELOCITIES
        inputs[_SEEN:seen_last] = inputs[: seen_last - _SEEN]
        motion[1:] = motion[:-1]
        inputs[:_SEEN], motion[0] = 0.0, 0.0
        if interval > 0:
            velocity = place.velocity(self._place, interval)
            motion[0] = velocity
            inputs[:_SEEN] = (*_row(velocity, interval), ONE)
        self._count += 1
        if self._count <= STARTS:
            at = seen_last + _SEEN * (self._count - 1)
            inputs[at : at + _SEEN] = inputs[:_SEEN]
        inputs[-3:] = place.shape(float(self._count))
        self._box, self._frame, self._place = box, frame, place
        x, y = _FADING.dot(motion).tolist()[:2]
        mirror = (x > 0) - (x < 0), (y > 0) - (y < 0)
        answers = self._network(inputs * _MIRRORS[mirror])
        mixed = answers[:MIXING].reshape(2 * RATES, VELOCITIES).dot(motion).tolist()
        mixed = [[*row[:2], *other[2:]] for row, other in zip(mixed, mixed[RATES:])]
        self._rates, self._offset = _outlook(mixed, answers[MIXING:].tolist(), mirror)

    def predict(self, frame: int) -> Sequence[float]:
        """The box at a frame, from the boxes so far."""
        ahead = float(frame - self._frame)
        if ahead <= 0 or self._rates is None:
            return self._box
        return self._place.moved(self._rates, self._offset, ahead)


def read_learned(path: str | os.PathLike[str]) -> Learned:
    """Read a trained forecaster; nothing in the file is executed.

    Raises:
        LaeError: if the file is missing, damaged, or no such forecaster.
    """
    network = read_network(path, INPUTS, OUTPUTS)
    sequences = network.document.get("sequences", [])
    if not isinstance(sequences, list) or not all(isinstance(name, str) for name in sequences):
        raise LaeError(f"{path}: not a forecaster that lae-sim train wrote: no names of sequences")
    return Learned(network)


def shipped() -> Guarded:
    """The forecaster that comes with the package, guarded.

    ``lae-sim train --made-up`` made its weights: no real motion is in them
    (docs/concepts/forecasters.md).
    """
    return Guarded(read_learned(SHIPPED))


def write_learned(learned: Learned, path: str | os.PathLike[str]) -> None:
    """Write a trained forecaster, whole or not at all; see :func:`.network.write_network`.

    Raises:
        LaeError: if the file cannot be written.
    """
    write_network(learned.network, path)
