"""An embedded dataset: targets filmed from a UAV, drawn on demand.

It needs no download, so a tracker can be tried and a device profiled anywhere. Every motion is a
sum of sines of time, so any frame can be drawn alone and in any order, and the ground truth is
exact. Motion blur is a mean over the exposure, so it follows each thing's apparent motion. The
same seed gives the same pixels with the same OpenCV and NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats
from lae_sim.datasets.frames import Dataset, Image, ImageSequence
from lae_sim.errors import LaeError, shown

_SIZE = np.array([640.0, 360.0])
_CENTRE = complex(*(_SIZE - 1) / 2)
_MARGIN = 700  # the ground is repeated so far beyond its tile; reaches any corner of the image
_EXPOSURES = 4  # moments averaged over an exposure
_OUTLINE = np.linspace(0, 2 * np.pi, 128, endpoint=False)
_NOISE = 6.0  # sensor noise, standard deviation in levels

Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class _Scene:
    """What makes a sequence hard; lengths in pixels, angles in radians, times in frames.

    Attributes:
        name, seed, frames: of the sequence.
        size, aspect, corner: the target's length, its width over its length, and the exponent of
            its outline, a superellipse (2 is an ellipse, 6 nearly a rectangle).
        colour: blue, green, red of the target.
        speed, reach: root mean square speed of the target in the image without shake, and how much
            of the image its path covers; above 1 it leaves the image.
        flight, shake: the camera's speed over the ground, and rms speed of its shake.
        zoom, spin: amplitudes of the logarithm of the scale, and of the camera's rotation.
        gait: how far the target deforms.
        rivals, covers: numbers of look-alikes, and of trees that it passes under.
        exposure: share of the time between two frames.
        clutter: number of things of the target's colour on each tile of the ground.
    """

    name: str
    seed: int = 0
    frames: int = 160
    size: float = 52
    aspect: float = 0.5
    corner: float = 5
    colour: tuple[int, int, int] = (50, 50, 185)
    speed: float = 5
    reach: float = 0.75
    flight: float = 7
    shake: float = 0.8
    zoom: float = 0.12
    spin: float = 0.15
    gait: float = 0
    rivals: int = 0
    covers: int = 0
    exposure: float = 0
    clutter: int = 0


_SCENES = (
    _Scene("boat", size=64, aspect=0.36, corner=2.5, colour=(190, 200, 205), zoom=0.5, spin=0.4),
    _Scene("bus", size=96, aspect=0.3, colour=(40, 150, 200), covers=2, speed=4, shake=1.5),
    _Scene("car", covers=3, spin=0.5),
    _Scene("chase", colour=(60, 60, 60), rivals=3, speed=5.5, clutter=25),
    _Scene("cyclist", size=40, aspect=0.45, corner=2.5, gait=0.3, zoom=0.35, speed=5, shake=2),
    _Scene("drone", size=36, aspect=0.9, corner=3, colour=(70, 60, 60), speed=9, shake=3),
    _Scene("herd", size=34, aspect=0.5, corner=2.3, colour=(70, 95, 120), gait=0.25, rivals=4),
    _Scene("race", colour=(40, 160, 215), speed=8, flight=14, shake=4, exposure=0.6, spin=0.5),
    _Scene("runner", size=30, aspect=0.6, corner=2.2, gait=0.4, covers=2, clutter=40, speed=4),
    _Scene("skater", size=44, aspect=0.55, corner=2.3, gait=0.35, speed=6, spin=0.9),
    _Scene("truck", size=70, aspect=0.42, colour=(170, 120, 50), reach=1.15, zoom=0.3, speed=6),
    _Scene("van", size=58, colour=(200, 205, 210), zoom=0.45, exposure=0.4, shake=4),
)


def synthetic_dataset(seed: int = 0) -> Dataset:
    """Twelve sequences of 160 frames, 640 x 360 pixels, at 30 frames per second.

    Nothing is drawn before a frame is read. Attributes have DTB70's names, and are what the scenes
    show. The truth is the box of the whole target, also where a tree hides it; NaN where less than
    a quarter of the box is in the image.

    Args:
        seed: another seed gives other paths and textures of about the same difficulty.

    Raises:
        LaeError: if the seed is no whole number from 0.

    Example:
        >>> import lae_sim
        >>> race = lae_sim.synthetic_dataset().sequences[7]
        >>> race.name, len(race), race.truth[0].round().tolist()
        ('race', 160, [362.0, 139.0, 29.0, 55.0])
    """
    if type(seed) is not int or seed < 0:
        raise LaeError(f"seed: a whole number from 0, not {shown(seed)}")
    scenes = (replace(scene, seed=seed) for scene in _SCENES)
    return Dataset("synthetic", Fraction(30), [_sequence(scene) for scene in scenes])


def _sequence(scene: _Scene) -> ImageSequence:
    path, time = _Path(scene), np.arange(float(scene.frames))
    truth = path.boxes(time)
    area, ratio = truth[:, 2:].prod(axis=1), truth[:, 2] / truth[:, 3]
    corners = np.clip(truth[:, None, :2] + truth[:, None, 2:] * [[0], [1]], 0, _SIZE)
    visible = (corners[:, 1] - corners[:, 0]).prod(axis=1) / area
    difficulties = {
        "Scale variation": area.max() / area.min() > 2.5,
        "Aspect ratio variation": max(ratio.max() / ratio[0], ratio[0] / ratio.min()) > 2,
        "Occlusion": scene.covers > 0,
        "Deformation": scene.gait > 0,
        "Fast camera motion": scene.shake >= 3 or scene.flight > 10,
        "In-plane rotation": np.ptp(np.unwrap(np.angle(path.heading(time)))) > np.pi / 2,
        "Out-of-view": visible.min() < 0.5,
        "Background clutter": scene.clutter > 0,
        "Similar objects around": scene.rivals > 0,
        "Motion blur": scene.exposure > 0,
    }
    truth[visible < 0.25] = np.nan
    attributes = tuple(name for name, holds in difficulties.items() if holds)
    return ImageSequence(scene.name, truth, partial(_read, scene), attributes)


class _Path:
    """Where everything is at any times [n]: places x + iy, turns and scales, all complex [n]."""

    def __init__(self, scene: _Scene) -> None:
        rng = _rng(scene, "path")
        self.scene = scene
        rates = np.array([[1.0, 2.9], [1.45, 3.7]]) * rng.uniform(0.85, 1.15, (2, 2))
        reach = scene.reach / 2 * _SIZE[:, None] * [[0.8, 0.2], [0.75, 0.25]]
        rates *= scene.speed / np.sqrt((reach**2 * rates**2).sum() / 2)
        middle = rng.choice([0, np.pi], (2, 1)) + rng.uniform(-0.5, 0.5, (2, 2))
        self._across = _sines(rates, reach, middle)
        rates = rng.uniform(0.2, 0.6, (2, 5))
        self._shake = _sines(rates, scene.shake * np.sqrt(0.2) / rates, _phases(rng, 5))
        self._start = rng.uniform(0, TILE) + 1j * rng.uniform(0, TILE)
        self._flight = scene.flight * np.exp(2j * np.pi * rng.uniform())
        views = np.array([[scene.zoom], [scene.spin]]) * [0.65, 0.35]
        self._view = _sines(rng.uniform(0.02, 0.06, (2, 2)), views, _phases(rng, 2))
        around = scene.size * np.array([[1.5, 0.8], [1.2, 0.8]])
        self._rivals = [
            _sines(rng.uniform(0.035, 0.09, (2, 2)), around, _phases(rng, 2))
            for _ in range(scene.rivals)
        ]
        # A tree stands where the target is fastest over the ground: it must come out again.
        time = np.arange(0.2 * scene.frames, scene.frames - 10)
        speed = np.abs(self.on_ground(time + 1) - self.on_ground(time))
        parts = np.array_split(np.arange(len(time)), max(scene.covers, 1))[: scene.covers]
        self.covers = self.on_ground(time[[part[np.argmax(speed[part])] for part in parts]])
        self.crowns = scene.size * rng.uniform(1.0, 1.5, scene.covers)

    def camera(self, time: Floats) -> tuple[Complex, Complex, Complex]:
        """Ground to image: scale and turn, and the ground's point that is at the image's."""
        there = self._start + self._flight * time
        return np.exp(self._view(time)), there, _CENTRE + self._shake(time)

    def on_ground(self, time: Floats) -> Complex:
        """The target's place on the ground."""
        turn, there, _ = self.camera(time)
        return there + self._across(time) / turn

    def heading(self, time: Floats) -> Complex:
        """The direction in the image in which the target moves over the ground; its scale."""
        ahead = self.on_ground(time + 3) - self.on_ground(time - 3)
        return np.exp(self._view(time)) * ahead / np.abs(ahead)

    def target(self, time: Floats, rival: int | None = None) -> tuple[Floats, Complex]:
        """Target, or a rival, to image: matrices [n, 2, 2], and its middle in the image."""
        place = self.camera(time)[2] + self._across(time)
        if rival is not None:
            place = place + self._rivals[rival](time)
        phase = 0.55 * time + 2.0 * (rival or 0)
        shape = np.tile(np.eye(2), (len(time), 1, 1))
        shape[:, 0, 0] += 0.5 * self.scene.gait * np.sin(phase)
        shape[:, 0, 1] += self.scene.gait * np.sin(phase + 1)
        return _matrices(self.heading(time)) @ shape, place

    def boxes(self, time: Floats) -> Floats:
        """The boxes ``x, y, w, h`` around the target's outline, [n, 4]."""
        matrix, place = self.target(time)
        x, y = np.cos(_OUTLINE), np.sin(_OUTLINE)
        corner = self.scene.corner
        radius = (np.abs(x) ** corner + np.abs(y) ** corner) ** (-1 / corner)
        half = np.array([1, self.scene.aspect])[:, None] * self.scene.size / 2
        outline = matrix @ (half * radius * np.stack([x, y])) + _points(place)[..., None]
        least, most = outline.min(axis=2), outline.max(axis=2)
        return np.concatenate([least + 0.5, most - least], axis=1)  # pixel 0 covers 0 to 1


class _Layer(NamedTuple):
    """A picture, its alpha multiplied in, and where it is at each of n moments."""

    picture: Image
    matrix: Floats  # picture to image, [n, 2, 2]
    place: Floats  # of the picture's middle, [n, 2]


class _Film:
    """A scene ready to be drawn: its textures, and all motions at all moments."""

    def __init__(self, scene: _Scene) -> None:
        self._scene = scene
        self._steps = _EXPOSURES if scene.exposure else 1
        within = (np.arange(self._steps) + 0.5) / self._steps - 0.5
        time = (np.arange(scene.frames)[:, None] + scene.exposure * within).ravel()
        path, rng = _Path(scene), _rng(scene, "textures")
        tile = ground(rng, scene.colour, scene.clutter)
        self._ground = np.pad(tile, [(_MARGIN, _MARGIN), (_MARGIN, _MARGIN), (0, 0)], "wrap")
        noise = rng.normal(32, _NOISE, (540, 960, 3))
        self._noise = np.clip(noise, 0, 64).astype(np.uint8)
        turn, there, here = path.camera(time)
        corner = _points(there) % TILE + _MARGIN - _points(here / turn)
        self._views = np.concatenate([_matrices(1 / turn), corner[..., None]], axis=2)
        self._layers: list[_Layer] = []
        pattern, size = rng.integers(1 << 32), (scene.size, scene.size * scene.aspect)
        for number in [*range(scene.rivals), None]:
            colour = np.array(scene.colour) + (0 if number is None else rng.normal(0, 12, 3))
            body = sprite(np.random.default_rng(pattern), size, scene.corner, colour)
            shadow = np.asarray(body * [0, 0, 0, 0.45], np.uint8)
            matrix, place = path.target(time, number)
            below = _points(place) + 0.06 * scene.size * matrix.sum(axis=2)
            self._layers.append(_Layer(shadow, matrix, below))
            self._layers.append(_Layer(body, matrix, _points(place)))
        for where, width in zip(path.covers, path.crowns):
            crown, place = tree(rng, 160), here + turn * (where - there)
            scale = width / (0.8 * len(crown))
            self._layers.append(_Layer(crown, _matrices(scale * turn), _points(place)))

    def draw(self, frame: int) -> Image:
        """A frame, uint8 [360, 640, 3]."""
        import cv2

        moments = range(frame * self._steps, (frame + 1) * self._steps)
        total = np.zeros((*_SIZE[::-1].astype(int), 3), np.float32)
        for moment in moments:
            cv2.accumulate(self._snapshot(moment), total)
        image = cv2.convertScaleAbs(total, alpha=1 / self._steps)
        y, x = _rng(self._scene, f"noise {frame}").integers(0, (180, 320))
        noise = self._noise[y : y + 360, x : x + 640]
        return np.asarray(cv2.addWeighted(image, 1, noise, 1, -32), np.uint8)

    def _snapshot(self, moment: int) -> Image:
        import cv2

        flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
        size = _SIZE.astype(int).tolist()
        view = self._views[moment]
        image = np.asarray(cv2.warpAffine(self._ground, view, size, flags=flags), np.uint8)
        for layer in self._layers:
            _draw(image, layer.picture, layer.matrix[moment], layer.place[moment])
        return image


@lru_cache(maxsize=1)  # 25 MB a scene; sequences are read one after the other
def _film(scene: _Scene) -> _Film:
    return _Film(scene)


def _read(scene: _Scene, frame: int) -> Image:
    if not 0 <= frame < scene.frames:
        raise LaeError(f"sequence {scene.name!r} has no frame {frame}")
    return _film(scene).draw(frame)


def _draw(image: Image, picture: Image, matrix: Floats, place: Floats) -> None:
    """Draw a picture with its middle at a place of the image."""
    import cv2

    middle = (np.array(picture.shape[1::-1]) - 1) / 2
    reach = np.abs(matrix) @ (middle + 1)
    low = np.clip(np.floor(place - reach), 0, _SIZE).astype(int)
    high = np.clip(np.ceil(place + reach) + 1, 0, _SIZE).astype(int)
    if (high <= low).any():
        return
    view = np.column_stack([matrix, place - matrix @ middle - low])
    drawn = np.asarray(cv2.warpAffine(picture, view, (high - low).tolist(), flags=cv2.INTER_LINEAR))
    part = image[low[1] : high[1], low[0] : high[0]]
    under = cv2.merge([255 - drawn[..., 3]] * 3)
    part[:] = cv2.add(cv2.multiply(part, under, scale=1 / 255), drawn[..., :3])


def _rng(scene: _Scene, use: str) -> np.random.Generator:
    """A stream of its own for each sequence and use, whichever is drawn first."""
    return np.random.default_rng([scene.seed, *f"{scene.name} {use}".encode()])


def _sines(rates: Floats, amplitudes: Floats, phases: Floats) -> Callable[[Floats], Complex]:
    """Sums of sines, of the real and of the imaginary part: arrays are [2, any]."""

    def at(time: Floats) -> Complex:
        x, y = (amplitudes * np.sin(rates * time[:, None, None] + phases)).sum(axis=2).T
        return np.asarray(x + 1j * y)

    return at


def _phases(rng: np.random.Generator, count: int) -> Floats:
    return rng.uniform(0, 2 * np.pi, (2, count))


def _points(places: Complex) -> Floats:
    """Complex numbers [n] as points [n, 2]."""
    return np.stack([places.real, places.imag], axis=-1)


def _matrices(turns: Complex) -> Floats:
    """Multiplications by complex numbers [n] as matrices [n, 2, 2]."""
    return np.stack([_points(turns), _points(1j * turns)], axis=-1)


TILE = 1024
"""The ground repeats after this many pixels, in both directions."""

Single = npt.NDArray[np.float32]
Colour = Sequence[float] | Floats | Single
"""Blue, green, red."""

_MEADOW = np.array([(42, 74, 70), (58, 104, 94), (96, 142, 146)], np.float32)


def ground(rng: np.random.Generator, strewn: Colour, count: int) -> Image:
    """Meadows, fields, roads and trees from above, uint8 [TILE, TILE, 3]; seamless.

    Args:
        rng: draws everything.
        strewn, count: colour and number of small things that lie about.
    """
    meadow = _MEADOW + rng.normal(0, 8, 3).astype(np.float32)
    tone = _noise(rng, TILE)[..., None]
    tile = np.asarray(meadow[0] + (meadow[2] - meadow[0]) * tone, np.float32)
    for _ in range(12):
        colour = meadow[rng.integers(3)] * rng.uniform(0.8, 1.3) + rng.normal(0, 7, 3)
        _paint(tile, _rectangle(rng, rng.uniform(110, 260), rng.uniform(80, 160)), colour)
    for across in (False, True, True):
        along = np.linspace(-16, TILE + 16, 140)
        bend = rng.uniform(20, 70) * np.sin(2 * np.pi * along / TILE + rng.uniform(0, 6))
        road = np.stack([along, rng.uniform(0, TILE) + bend], axis=1)
        for side, grey in ((36, 90), (30, 125), (1.5, 205)):  # a verge, asphalt, a line along it
            edges = np.concatenate([road - [0, side], (road + [0, side])[::-1]])
            _paint(tile, edges[:, ::-1] if across else edges, [grey] * 3)
    for _ in range(count):
        thing = _rectangle(rng, *rng.uniform(14, 44, 2))
        _paint(tile, thing + 3, meadow[0] * 0.5)
        _paint(tile, thing, np.asarray(strewn) * rng.uniform(0.75, 1.25) + rng.normal(0, 10, 3))
    for _ in range(70):
        middle, radius = rng.uniform(0, TILE, 2), rng.uniform(7, 22)
        angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
        crown = (
            radius * rng.uniform(0.85, 1.15, (14, 1)) * np.stack([np.cos(angle), np.sin(angle)], 1)
        )
        for part, shade in ((1.2, 0.45), (1, 0.8), (0.5, 1.1)):  # its shadow, leaves, light on them
            _paint(tile, middle + part * crown + 6 * (part - 1), meadow[1] * shade)
    grain = 0.7 + 0.6 * _noise(rng, TILE, 0.35)[..., None]
    return np.asarray(np.clip(tile * grain, 0, 255), np.uint8)


def sprite(
    rng: np.random.Generator, size: tuple[float, float], corner: float, colour: Colour
) -> Image:
    """A target from above, heading right: uint8 [h, w, 4], colours multiplied by their alpha.

    The outline is the superellipse ``|2x/length|^corner + |2y/width|^corner = 1`` about the
    middle of the image.

    Args:
        rng: draws its pattern.
        size: length and width in pixels.
        corner: exponent of the outline.
        colour: of the body.
    """
    import cv2

    half = np.array(size) / 2
    fine = 4  # subpixels
    shape = np.ceil(2 * half + 4).astype(int)
    x, y = np.meshgrid(*((np.arange(n * fine) + 0.5 - n * fine / 2) / fine for n in shape))
    u, v = x / half[0], y / half[1]
    inside = np.abs(u) ** corner + np.abs(v) ** corner
    body = np.ones((*u.shape, 3)) * np.asarray(colour, float)
    stripes = zip(rng.uniform(-0.6, 0.2, 2), (0.05, 0.03))
    for at, width in ((0.42, 0.16), (-0.72, 0.09), *stripes):  # windows, a load
        body[np.abs(u - at - 0.06 * v**2) < width] = (45, 40, 35)
    body[np.abs(v - rng.uniform(-0.4, 0.4)) < 0.13] *= 0.55
    body[(np.abs(u + 0.2) < 0.2) & (np.abs(v) < 0.55)] += rng.uniform(-50, 50, 3)
    body[np.abs(v) > 0.86] *= 0.6
    body[(u > 0.86) & (np.abs(np.abs(v) - 0.6) < 0.2)] = (200, 235, 240)  # it heads to the right
    body[inside > 0.85] *= 0.7
    body *= 0.85 + 0.3 * cv2.resize(rng.random((10, 16)), u.shape[::-1])[..., None]
    alpha = (inside <= 1)[..., None] * 255.0
    whole = np.concatenate([np.clip(body, 0, 255) * (alpha / 255), alpha], axis=2)
    small = cv2.resize(whole, (int(shape[0]), int(shape[1])), interpolation=cv2.INTER_AREA)
    return np.asarray(np.round(small), np.uint8)


def tree(rng: np.random.Generator, size: int) -> Image:
    """The crown of a tree from above, uint8 [size, size, 4], colours multiplied by alpha."""
    noise = _noise(rng, 256)
    leaves = _noise(rng, 256, 0.3)[:size, :size]
    y, x = (np.indices((size, size), np.float32) + 0.5) / size * 2 - 1
    radius = np.hypot(x, y) + 0.5 * (noise[:size, :size] - 0.5)
    alpha = np.clip((0.8 - radius) * 12, 0, 1)[..., None]
    shade = 0.45 + 0.85 * leaves - 0.25 * (x + y)
    colour = (_MEADOW[1] * rng.uniform(0.7, 1.1)) * np.clip(shade, 0.2, 1.4)[..., None]
    return np.concatenate([np.clip(colour, 0, 255) * alpha, 255 * alpha], axis=2).astype(np.uint8)


def _noise(rng: np.random.Generator, size: int, falloff: float = 0.8) -> Single:
    """Value noise that repeats, float32 [size, size] in 0..1; ``falloff``: weight of the coarse."""
    import cv2

    total = np.zeros((size, size), np.float32)
    cells = 4
    while cells <= size // 2:
        coarse = np.pad(rng.random((cells, cells), np.float32), 2, mode="wrap")
        step = size // cells
        wide = cv2.resize(coarse, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)
        total += wide[2 * step : -2 * step, 2 * step : -2 * step] / float(cells) ** falloff
        cells *= 2
    low, high = np.quantile(total[::4, ::4], (0.01, 0.99))
    return np.asarray(np.clip((total - low) / (high - low), 0, 1), np.float32)


def _paint(tile: Single, corners: Floats, colour: Colour) -> None:
    """Fill a polygon, wherever the repetition shows it."""
    import cv2

    first = np.floor(corners.min(axis=0) / TILE).astype(int)
    last = np.floor(corners.max(axis=0) / TILE).astype(int)
    for column in range(first[0], last[0] + 1):
        for row in range(first[1], last[1] + 1):
            moved = corners - np.array([column, row]) * TILE
            fixed = np.round(moved * 16).astype(np.int32)
            cv2.fillPoly(tile, [fixed], [float(level) for level in colour], cv2.LINE_8, 4)


def _rectangle(rng: np.random.Generator, length: float, width: float) -> Floats:
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)]) * length / 2
    across = np.array([-np.sin(angle), np.cos(angle)]) * width / 2
    corners = np.array([-along - across, along - across, along + across, across - along])
    return corners + rng.uniform(0, TILE, 2)
