"""Frames for tests of trackers: a textured target that moves over a smooth background."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import pytest

from lae_sim.datasets.frames import Image

cv2 = pytest.importorskip("cv2", reason="needs OpenCV")

HEIGHT, WIDTH = 240, 320


def moving(boxes: Sequence[Sequence[float] | None], seed: int = 0) -> Iterator[Image]:
    """Frames in which the target fills each of the boxes; None leaves it out of the frame."""
    random = np.random.default_rng(seed)
    background = _texture(random, HEIGHT, WIDTH, 12)
    background = cv2.addWeighted(background, 0.5, np.full_like(background, 128), 0.5, 0)
    target = _texture(random, 48, 48, 3)
    for box in boxes:
        frame = background.copy()
        if box is not None:
            _paste(frame, target, box)
        yield cv2.add(frame, random.integers(0, 10, frame.shape, np.uint8))


def straight(
    count: int, start: Sequence[float] = (60, 80, 40, 40), step: Sequence[float] = (3, 1.5, 0, 0)
) -> npt.NDArray[np.float64]:
    """Boxes that move, and grow, by a constant step."""
    return np.array(start, float) + np.arange(count)[:, None] * np.array(step, float)


def centre_error(found: Sequence[float], box: Sequence[float]) -> float:
    """Distance of the centres, pixels."""
    a, b = np.asarray(found, float), np.asarray(box, float)
    return float(np.hypot(*(a[:2] + a[2:] / 2 - b[:2] - b[2:] / 2)))


def _texture(random: np.random.Generator, height: int, width: int, sigma: float) -> Image:
    grey = cv2.GaussianBlur(random.normal(size=(height, width, 3)), (0, 0), sigma)
    return np.clip(128 + 60 * grey / grey.std(), 0, 255).astype(np.uint8)


def _paste(frame: Image, target: Image, box: Sequence[float]) -> None:
    """Draw the target into the box; what lies outside of the frame is cut off."""
    x, y, w, h = box
    sx, sy = w / target.shape[1], h / target.shape[0]
    matrix = np.array([[sx, 0, x + sx / 2 - 0.5], [0, sy, y + sy / 2 - 0.5]])
    size = (frame.shape[1], frame.shape[0])
    drawn = cv2.warpAffine(target, matrix, size)
    mask = cv2.warpAffine(np.ones(target.shape, np.float32), matrix, size)
    frame[:] = np.where(mask > 0.5, drawn, frame)
