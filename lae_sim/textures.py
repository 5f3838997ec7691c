"""Textures of the synthetic dataset: a ground that repeats, targets and trees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lae_sim.boxes import Floats
from lae_sim.frames import Image

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
