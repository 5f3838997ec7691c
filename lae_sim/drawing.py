"""Boxes and captions drawn on frames, with OpenCV."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim.boxes import Floats, iou
from lae_sim.errors import LaeError
from lae_sim.frames import Image

LEAST_WIDTH = 640
WHITE, DARK = (255, 255, 255), (24, 24, 24)
COLOURS = (
    (0, 159, 230),  # orange
    (233, 180, 86),  # sky blue
    (66, 228, 240),  # yellow
    (115, 158, 0),  # bluish green
    (167, 121, 204),  # reddish purple
    (0, 94, 213),  # vermilion
)
"""Blue, green, red; the colours of Okabe and Ito, "Color Universal Design" (2008)."""

Colour = tuple[int, int, int]
Item = tuple[str, Colour | None]


def draw_frame(
    image: Image,
    boxes: Mapping[str, npt.ArrayLike],
    truth: npt.ArrayLike | None = None,
    caption: Sequence[str] = (),
    width: int | None = None,
) -> Image:
    """Draw boxes on a copy of a frame, and what they are below it.

    The truth is white; the others have `COLOURS` in their order, and their IoU with the truth.

    Args:
        image: uint8 [H, W, 3].
        boxes: ``x, y, w, h`` in pixels by name; NaN = none.
        truth: the ground truth, likewise.
        caption: words to put below, each in one piece. Digits do not move what follows them.
        width: of the picture, pixels; by default the image's, but at least 640.
    """
    import cv2

    width = width or max(image.shape[1], LEAST_WIDTH)
    scale = width / image.shape[1]
    size = width, max(round(image.shape[0] * scale), 1)
    shrink = scale < 1
    picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    line = max(width // 320, 1)
    items: list[Item] = []
    drawn: list[tuple[Floats, Colour]] = []
    if truth is not None:
        drawn.append((_row(truth), WHITE))
        items.append(("truth", WHITE))
    for number, (name, box) in enumerate(boxes.items()):
        drawn.append((_row(box), COLOURS[number % len(COLOURS)]))
        items.append((name + _overlap(truth, box), drawn[-1][1]))
    for row, colour in drawn:
        if np.isfinite(row).all():
            corners = np.concatenate([row[:, :2], row[:, :2] + row[:, 2:]]) * scale
            low, high = map(tuple, np.clip(np.rint(corners), -(2**14), 2**14).astype(int).tolist())
            cv2.rectangle(picture, low, high, (0, 0, 0), line + max(line // 2, 2), cv2.LINE_AA)
            cv2.rectangle(picture, low, high, colour, line, cv2.LINE_AA)
    band = _caption([[(text, None) for text in caption], items], width)
    return np.concatenate([np.asarray(picture, np.uint8), band])


def film_strip(pictures: Sequence[Image], columns: int | None = None) -> Image:
    """Put pictures of one size side by side, row by row.

    Args:
        pictures: uint8 [H, W, 3] each.
        columns: pictures in a row; by default so that the strip is about 16:9.

    Raises:
        LaeError: if there are none, or their sizes differ.
    """
    if len({picture.shape for picture in pictures}) != 1:
        raise LaeError("a film strip needs pictures of one size, and at least one")
    height, width = pictures[0].shape[:2]
    across = columns or int(np.ceil(np.sqrt(len(pictures) * height / width * 16 / 9)))
    gap = max(width // 160, 1)
    rows = -(-len(pictures) // across)
    across = columns or -(-len(pictures) // rows)  # as few empty places as can be
    strip = np.full((rows * (height + gap) - gap, across * (width + gap) - gap, 3), 255, np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // across) * (height + gap), (number % across) * (width + gap)
        strip[top : top + height, left : left + width] = picture
    return strip


def follow(boxes: Floats, size: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Windows of one size that follow a target and hold the boxes that have not lost it.

    Args:
        boxes: ``x, y, w, h`` in pixels by frame, the target's first, float64 [T, k, 4]; NaN = none.
        size: width and height of the images, pixels.

    Returns:
        ``left, top, right, bottom`` by frame, int64 [T, 4], within the image and of its shape.
    """
    low, high = boxes[..., :2], boxes[..., :2] + boxes[..., 2:]
    middles = (low + high) / 2
    known = np.isfinite(middles[:, 0, 0])
    if not known.any():
        return np.tile([0, 0, *size], (len(boxes), 1))
    frames = np.arange(len(boxes))
    axes = [np.interp(frames, frames[known], axis[known]) for axis in middles[:, 0].T]
    middle = np.stack(axes, axis=1)[:, None]
    lost = np.abs(middles - middle).max(axis=2) > 4 * boxes[:, :1, 2:].max(axis=2)
    whole = np.array(size)
    reach = np.fmax(high - middle, middle - low) / whole
    needed = np.quantile(
        reach[known].max(axis=(1, 2), initial=0, where=~lost[known, :, None]), 0.98
    )
    window = np.ceil(whole * np.clip(2.5 * needed, 64 / whole.max(), 1)).astype(np.int64)
    corner = np.clip(np.rint(middle[:, 0] - window / 2).astype(np.int64), 0, whole - window)
    return np.concatenate([corner, corner + window], axis=1)


def _row(box: npt.ArrayLike) -> Floats:
    return np.asarray(box, np.float64).reshape(1, 4)


def _overlap(truth: npt.ArrayLike | None, box: npt.ArrayLike) -> str:
    """The IoU as text that is always as long."""
    if truth is None:
        return ""
    none = np.isnan(_row(truth)).any()
    return " IoU  -  " if none else f" IoU {iou(_row(truth), _row(box))[0]:.2f}"


def _caption(lines: Sequence[Sequence[Item]], width: int) -> Image:
    """A dark band with lines of words, each with its colour before it, wrapped where they end."""
    import cv2

    font, height = cv2.FONT_HERSHEY_SIMPLEX, max(width / 46, 8.0)
    space = round(height * 0.7)
    words = [item for items in lines for item in items]
    scale = height / _extent("0", 1.0)[1]
    widest = max((_extent(text, scale)[0] for text, _ in words), default=1)
    scale *= min(1.0, (width - 5 * space) / widest)
    placed: list[tuple[int, int, Item]] = []
    row = -1
    for items in lines:
        row, x = row + bool(items), space
        for text, colour in items:
            mark = 2 * space if colour else 0
            length = mark + _extent(text, scale)[0]
            if x > space and x + length > width - space:
                row, x = row + 1, space
            placed.append((x, row, (text, colour)))
            x += length + 2 * space
    step = round(1.8 * height)
    band = np.full(((row + 1) * step + space * bool(words), width, 3), DARK, np.uint8)
    for x, row, (text, colour) in placed:
        base = space + row * step + round(height)
        if colour:
            corner = x + round(1.3 * space), base - round(1.3 * space)
            cv2.rectangle(band, (x, base), corner, colour, -1)
            x += 2 * space
        thick = max(round(height / 14), 1)
        cv2.putText(band, text, (x, base), font, scale, WHITE, thick, cv2.LINE_AA)
    return band


def _extent(text: str, scale: float) -> Any:
    """Width and height of text, pixels, the same whatever its digits."""
    import cv2

    wide = re.sub(r"[\d -]", "0", text)
    return cv2.getTextSize(wide, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0]
