"""Made-up motion to train a forecaster on: targets, cameras and trackers, none of them real.

A forecaster sees boxes only, so what it must know of the world is how boxes move. That is made up
here from wide ranges, which know nothing of any dataset: whoever is scored was never trained on.

A target's velocity and the camera's add up. Each is *wandering*: noise with a memory, the simplest
motion that has a speed and a time in which it changes (an Ornstein-Uhlenbeck process). To this come
motions of their own kind: targets that go steadily, stop and go, or swing; cameras that sway, as a
drone does in the wind, shake, or jerk and are caught again. Speeds are in target sizes, since a
target that is near is large and fast. Zoom and distance change the size, turning the aspect.

What is annotated is not where the target is: rows are rounded, drawn with a hand that wanders, or
interpolated between frames. And a tracker's boxes are neither: they are off by noise, by slow
errors in place and size, by habit (always larger, always smaller), early or late; they follow
changes of size slowly or never, drift, lose the target to the background and find it again, and lie
on the grid of a tracker's cells.

Random numbers come from one generator with a seed. Shapes: N sequences, T frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

FRAMES = 200
_IMAGE = np.array([1280.0, 720.0])
Range = tuple[float, float]


@dataclass(frozen=True)
class _Draw:
    """Draws for n sequences at once, each with its own number.

    Attributes:
        rng: where they come from.
        n: sequences.
        frames: of each.
    """

    rng: np.random.Generator
    n: int
    frames: int

    def spread(self, low: float, high: float) -> Floats:
        """Numbers of any order of magnitude between two, [N, 1, 1]."""
        return np.exp(self.rng.uniform(np.log(low), np.log(high), (self.n, 1, 1)))

    def among(self, values: list[float], weights: list[float] | None = None) -> Floats:
        """One of some values each, [N, 1, 1]."""
        return self.rng.choice(np.array(values, float), (self.n, 1, 1), p=weights)

    def some(self, share: float) -> Bools:
        """True in that share of the sequences, [N, 1, 1]."""
        chosen: Bools = self.rng.random((self.n, 1, 1)) < share
        return chosen

    def wandering(self, forgets: Range, axes: int = 2) -> Floats:
        """Noise of variance 1 that forgets a share of itself with every frame, [N, T, axes].

        Args:
            forgets: between which shares; 1 is white noise.
            axes: independent ones.
        """
        memory = 1 - self.spread(*forgets)[:, 0]
        white = self.rng.normal(size=(self.frames, self.n, axes))
        white[1:] *= np.sqrt(1 - memory**2)
        for i in range(1, self.frames):
            white[i] += memory * white[i - 1]
        return white.transpose(1, 0, 2)

    def swinging(self, frequencies: Range) -> Floats:
        """Swings in x and y, [N, T, 2], of about as many cycles per frame."""
        time = np.arange(self.frames)[:, None]
        frequency = self.spread(*frequencies) * self.rng.uniform(0.7, 1.4, (self.n, 1, 2))
        phase = self.rng.uniform(0, 2 * np.pi, (self.n, 1, 2))
        strength = 1.5 * self.rng.normal(size=(self.n, 1, 2))
        swings: Floats = strength * np.sin(2 * np.pi * frequency * time + phase)
        return swings

    def bursts(self, rate: Range) -> Floats:
        """Jerks at random frames that die away, [N, T, 2]."""
        jerk = self.rng.random((self.n, self.frames, 1)) < self.spread(*rate)
        left = jerk * 3.0 * self.rng.normal(size=(self.n, self.frames, 2))
        fade = self.rng.uniform(0.3, 0.9, (self.n, 1))
        for i in range(1, self.frames):
            left[:, i] += fade * left[:, i - 1]
        return left


def made_up_motion(
    sequences: int, rng: np.random.Generator, frames: int = FRAMES
) -> tuple[Floats, Floats]:
    """Truth and a tracker's boxes of some sequences of made-up motion.

    Args:
        sequences: how many, N.
        rng: makes all choices.
        frames: of each sequence, T.

    Returns:
        Ground truth and boxes, ``x, y, w, h`` in pixels, float64 [N, T, 4]. Row 0 of the boxes is
        the truth, from which a tracker starts.
    """
    draw = _Draw(rng, sequences, frames)
    target, camera = _target_velocity(draw), _camera_velocity(draw)
    alone = rng.random((sequences, 1, 1))  # a camera on a mast, or a target at rest
    velocity = np.where(alone < 0.1, target, np.where(alone < 0.2, camera, target + camera))
    sides = _sides(draw)
    size = np.sqrt(sides.prod(axis=2, keepdims=True))
    path, background = np.cumsum(velocity * size, axis=1), np.cumsum(camera * size, axis=1)
    centre = path - path[:, :1] + rng.uniform([200, 150], [1000, 550], (sequences, 1, 2))
    centre = np.where(draw.some(0.4), _reflected(centre), centre + 5000)  # or far from any border
    shown = _frames_shown(draw)
    centre, sides, background = (
        np.take_along_axis(each, shown, axis=1) for each in (centre, sides, background)
    )
    truth = _annotated(draw, centre, sides)
    boxes = _tracked(draw, centre, sides, background)
    boxes[:, 0] = truth[:, 0]
    return truth, boxes


def _target_velocity(draw: _Draw) -> Floats:
    """Of the target over the ground, in target sizes per frame, [N, T, 2]."""
    wandering = draw.wandering((0.001, 0.05))
    steady = draw.rng.normal(size=(draw.n, 1, 2))
    going = np.clip(0.5 + 1.5 * draw.wandering((0.005, 0.05), axes=1), 0, 1)
    kinds = [
        wandering,
        steady + 0.3 * wandering,
        (steady + wandering) * going,
        0.4 * wandering + draw.swinging((0.005, 0.1)),
    ]
    kind = draw.rng.integers(len(kinds), size=(draw.n, 1, 1))
    velocity: Floats = draw.spread(0.004, 0.1) * np.choose(kind, kinds)
    return velocity


def _camera_velocity(draw: _Draw) -> Floats:
    """Of the ground through the image, in target sizes per frame, [N, T, 2]."""
    velocity = draw.wandering((0.004, 0.12))
    velocity += draw.some(0.35) * draw.swinging((0.01, 0.15))
    velocity += draw.some(0.3) * draw.spread(0.02, 0.3) * draw.wandering((0.5, 1.5))
    velocity += draw.some(0.3) * draw.bursts((0.002, 0.05))
    return draw.spread(0.006, 0.3) * velocity


def _sides(draw: _Draw) -> Floats:
    """Width and height in pixels, [N, T, 2]."""
    zoom = draw.some(0.9) * draw.spread(0.001, 0.04) * draw.wandering((0.003, 0.2), axes=1)
    turn = draw.some(0.7) * draw.spread(0.001, 0.03) * draw.wandering((0.005, 0.1), axes=1)
    size = np.clip(np.cumsum(zoom, axis=1), -1.3, 1.6)
    aspect = np.clip(np.cumsum(turn, axis=1), -1.5, 1.5) / 2
    aspect = aspect + np.clip(draw.rng.normal(0, 0.55, (draw.n, 1, 1)), -1.3, 1.3) / 2
    size = size + np.log(draw.spread(8, 140))
    sides: Floats = np.exp(np.concatenate([size + aspect, size - aspect], axis=2))
    return sides


def _reflected(centre: Floats) -> Floats:
    """Paths folded back and forth between the borders of the image."""
    folded: Floats = _IMAGE - np.abs(centre % (2 * _IMAGE) - _IMAGE)
    return folded


def _frames_shown(draw: _Draw) -> Ints:
    """Which moment each frame shows, [N, T, 1]: videos repeat frames, in turn or at random."""
    time = np.arange(draw.frames)[:, None]
    every = draw.among([2, 3], [2 / 3, 1 / 3]).astype(int)
    repeated = draw.rng.random((draw.n, draw.frames, 1)) < 0.4
    held = np.maximum.accumulate(np.where(repeated, 0, time), axis=1)
    in_turn = np.where(draw.some(0.1), time // every * every, time)
    shown: Ints = np.where(draw.some(0.05), held, in_turn)
    return shown


def _annotated(draw: _Draw, centre: Floats, sides: Floats) -> Floats:
    """The truth as somebody draws it, [N, T, 4]."""
    boxes = np.concatenate([centre - sides / 2, sides], axis=2)
    time = np.arange(draw.frames)
    every = draw.among([0, 5, 10, 15], [0.55, 0.15, 0.15, 0.15])
    for step in (5, 10, 15):  # between frames that were drawn the rest is interpolated
        low = time // step * step
        high = np.minimum(low + step, draw.frames - 1)
        part = ((time - low) / np.maximum(high - low, 1))[:, None]
        between = boxes[:, low] * (1 - part) + boxes[:, high] * part
        boxes = np.where(every == step, between, boxes)
    size = np.sqrt(sides[:, :1].prod(axis=2, keepdims=True))
    hand = draw.some(0.6) * draw.spread(0.001, 0.01) * draw.wandering((0.03, 1))
    boxes[..., :2] += hand * size
    boxes = np.where(draw.some(0.6), np.round(boxes), boxes)
    boxes[..., 2:] = np.maximum(boxes[..., 2:], 1)
    return boxes


def _tracked(draw: _Draw, centre: Floats, sides: Floats, background: Floats) -> Floats:
    """The boxes of a tracker, [N, T, 4]."""
    time = np.arange(draw.frames)[:, None]
    # Some trackers smooth, some predict, and some published rows are a frame off.
    early = draw.some(0.1) * draw.among([-1, 1, -0.5, 0.5], [0.25, 0.35, 0.2, 0.2])
    centre, sides = _shifted(centre, early), _shifted(sides, early)
    settled = 1 - np.exp(-time / draw.spread(0.3, 30))  # errors begin at the truth
    logs = _followed(draw, np.log(np.maximum(sides, 1)))
    habit = draw.rng.normal(size=(draw.n, 1, 1)) + 0.4 * draw.rng.normal(size=(draw.n, 1, 2))
    logs += np.clip(habit, -2.5, 2.5) * draw.spread(0.005, 0.15) * settled
    logs += draw.spread(0.0007, 0.008) * draw.wandering((0.5, 1))
    slow = draw.some(0.7) * draw.spread(0.004, 0.25) * draw.wandering((0.003, 0.06))
    both = draw.some(0.7) * draw.spread(0.002, 0.2) * draw.wandering((0.003, 0.06), axes=1)
    sides = np.exp(logs + (slow + both) * settled)
    size = np.sqrt(sides.prod(axis=2, keepdims=True))
    noise = draw.spread(0.002, 0.02)
    moved = np.abs(np.diff(centre, axis=1, prepend=centre[:, :1])) / size
    error = noise * draw.wandering((0.5, 1))
    error += draw.spread(0.005, 0.1) * draw.wandering((0.005, 0.08)) * settled
    blur = draw.some(0.5) * draw.rng.uniform(0, 0.3, (draw.n, 1, 1))
    error += blur * moved * draw.wandering((1, 1))
    drift = draw.some(0.4) * draw.spread(0.0005, 0.008)
    error += drift * np.cumsum(draw.rng.normal(size=(draw.n, draw.frames, 2)), axis=1)
    error += 0.04 * draw.rng.normal(size=(draw.n, 1, 2)) * settled
    rare = draw.some(0.2) * draw.spread(0.0005, 0.03)  # jumps to something else, for a frame
    error += (
        0.4
        * (draw.rng.random((draw.n, draw.frames, 1)) < rare)
        * draw.rng.normal(size=(draw.n, draw.frames, 2))
    )
    centre = centre + error * size
    for _ in range(2):
        centre = _lost(draw, centre, background, noise * size)
    cell = draw.among([0, 1, 2, 4], [1 / 3, 1 / 3, 1 / 6, 1 / 6])
    grid = np.maximum(cell, 1)
    corner = np.concatenate([centre - sides / 2, sides], axis=2)
    on_cells = np.round(centre / grid) * grid - sides / 2
    corner[..., :2] = np.where(cell >= 2, on_cells, corner[..., :2])
    corner = np.where(cell == 1, np.round(corner), corner)
    corner[..., 2:] = np.maximum(corner[..., 2:], 1)
    return corner


def _shifted(values: Floats, early: Floats) -> Floats:
    """Values so many frames earlier than they come, between frames interpolated."""
    length = values.shape[1]
    moment = np.clip(np.arange(length)[:, None] + early, 0, length - 1)
    low = np.floor(moment).astype(int)
    high = np.minimum(low + 1, length - 1)
    part = moment - low
    shifted: Floats = np.take_along_axis(values, low, 1) * (1 - part)
    shifted += np.take_along_axis(values, high, 1) * part
    return shifted


def _followed(draw: _Draw, logs: Floats) -> Floats:
    """Logarithms of sides as trackers follow them: at once, slowly, or never."""
    kind = draw.rng.random((draw.n, 1))
    rate = np.where(
        kind < 0.15, 0, np.where(kind < 0.5, 1, draw.rng.uniform(0.05, 0.8, (draw.n, 1)))
    )
    followed = logs.copy()
    for i in range(1, logs.shape[1]):
        followed[:, i] = followed[:, i - 1] + rate * (logs[:, i] - followed[:, i - 1])
    return followed


def _lost(draw: _Draw, centre: Floats, background: Floats, noise: Floats) -> Floats:
    """A tenth of the trackers stay where they are for a while: on the ground or in the image."""
    time = np.arange(draw.frames)[:, None]
    start = draw.rng.integers(5, draw.frames - 5, (draw.n, 1, 1))
    lost = (time >= start) & (time < start + draw.rng.integers(5, 80, (draw.n, 1, 1)))
    moved = background - np.take_along_axis(background, start, axis=1)
    place = np.take_along_axis(centre, start, axis=1) + draw.among([0, 1], [1 / 3, 2 / 3]) * moved
    place = place + noise * draw.rng.normal(size=centre.shape)
    return np.where(draw.some(0.1) & lost, place, centre)


def made_up_trace(sequences: int, seed: int, frames: int = FRAMES, dropped: bool = False) -> Trace:
    """A trace of made-up motion, with made-up times: 6 to 300 ms a frame, some with jitter.

    Args:
        sequences: how many.
        seed: of all choices; the same seed gives the same trace with the same NumPy.
        frames: of each sequence.
        dropped: whether a camera drops frames, and times of arrival jitter.
    """
    rng = np.random.default_rng([seed, int(dropped)])
    truth, boxes = made_up_motion(sequences, rng, frames)
    draw = _Draw(rng, sequences, frames)
    jitter = draw.among([0, 0.03, 0.15], [0.5, 0.25, 0.25])[..., 0]
    ms = draw.spread(6, 300)[..., 0] * np.exp(jitter * rng.normal(size=(sequences, frames)))
    ms[:, :1] *= np.where(draw.some(0.3), draw.spread(2, 20), 1.0)[..., 0]
    elapsed = np.maximum(np.round(ms * 1e6), 1).astype(np.int64)
    recordings = []
    for i in range(sequences):
        kept, arrival_ns = np.arange(frames), None
        if dropped:
            kept = np.flatnonzero(rng.random(frames) >= rng.uniform(0, 0.5))
            kept = np.union1d([0], kept)
            late = rng.uniform(0, 0.4) * rng.random(len(kept))
            late[0] = 0
            arrival_ns = np.round((kept + late) * 1e9 / 30).astype(np.int64)
        recordings.append(
            Recording.new(
                f"{'dropped' if dropped else 'even'}-{i:05}",
                truth[i, kept],
                boxes[i, kept],
                elapsed[i, kept],
                arrival_ns=arrival_ns,
            )
        )
    metadata = Metadata.new(
        "30",
        "every-frame",
        tracker={"name": "made up", "version": str(seed)},
        timing={"source": "made up, not measured"},
        dataset={"name": "made up"},
    )
    return Trace(metadata, recordings)
