"""Boxes, captions and film strips."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("cv2", reason="drawing needs OpenCV")

import cv2

from lae_sim.errors import LaeError
from lae_sim.figures.film import WHITE, colours_of, draw_frame, film_strip

NONE = [np.nan] * 4


@pytest.fixture
def texts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is written on pictures."""
    written: list[str] = []
    put = cv2.putText

    def noted(image: np.ndarray, text: str, *arguments: object) -> object:
        written.append(text)
        return put(image, text, *arguments)

    monkeypatch.setattr(cv2, "putText", noted)
    return written


HOLD, KALMAN = colours_of(["hold", "kalman"]).values()
OTHER = colours_of(["a"])["a"]


def grey(height: int = 360, width: int = 640) -> np.ndarray:
    return np.full((height, width, 3), 90, np.uint8)


def test_each_box_has_its_colour_and_place() -> None:
    image = grey()
    boxes = {"hold": (300, 60, 80, 40), "kalman": (30.4, 200, 50, 70)}
    picture = draw_frame(image, boxes, (100, 100, 60, 50))
    assert (image == 90).all()
    assert picture.dtype == np.uint8
    assert picture.shape[1] == 640
    assert picture.shape[0] > 360
    for x, y, colour in [(300, 80, HOLD), (380, 80, HOLD), (340, 100, HOLD)]:
        assert tuple(picture[y, x]) == colour
    assert tuple(picture[235, 30]) == KALMAN
    assert tuple(picture[125, 160]) == WHITE
    assert (picture[:360][70:90, 310:370] == 90).all()  # nothing inside a box
    drawn = (picture[:360] != 90).any(axis=2)
    assert 0.005 < drawn.mean() < 0.03


def test_small_frames_are_enlarged_with_their_boxes() -> None:
    picture = draw_frame(grey(90, 160), {"a": (20, 30, 40, 20)})
    assert picture.shape[1] == 640
    assert tuple(picture[160, 80]) == OTHER  # x 20 and the middle of y, four times as large
    assert tuple(picture[200, 160]) == OTHER
    narrow = draw_frame(grey(1080, 1920), {"a": (300, 300, 600, 300)}, width=640)
    assert narrow.shape[1] == 640
    assert tuple(narrow[150, 100]) == OTHER


def test_lines_and_letters_grow_with_the_frame() -> None:
    def thickness(width: int) -> int:
        image = grey(width * 9 // 16, width)
        row = draw_frame(image, {"a": (width // 4, 0, width // 2, width // 2)})[width // 8]
        return int((row[: width // 2] == OTHER).all(axis=1).sum())

    assert [thickness(width) for width in (640, 1280, 3840)] == [3, 5, 13]
    bands = [
        draw_frame(grey(w * 9 // 16, w), {"a": NONE}).shape[0] - w * 9 // 16 for w in (640, 3840)
    ]
    assert bands[1] == pytest.approx(6 * bands[0], rel=0.05)


def test_what_is_unknown_is_not_drawn(texts: list[str]) -> None:
    picture = draw_frame(grey(), {"hold": NONE}, NONE)
    assert (picture[:360] == 90).all()
    far = draw_frame(grey(), {"hold": (1e12, -1e12, 5, 5)}, (10, 10, 10, 10))
    assert far.shape == picture.shape
    assert texts == ["truth", "hold IoU -", "truth", "hold IoU 0.00"]


def test_captions_say_the_overlap(texts: list[str]) -> None:
    boxes = {"hold": (10, 0, 10, 10), "kalman": (0, 0, 10, 10)}
    draw_frame(grey(), boxes, (0, 0, 20, 10), ["ball", "frame 3"])
    assert texts == ["ball", "frame 3", "truth", "hold IoU 0.50", "kalman IoU 0.50"]
    texts.clear()
    draw_frame(grey(), boxes)
    assert texts == ["hold", "kalman"]


def test_long_captions_shrink_to_the_width() -> None:
    for words in (["a long word"] * 12, ["w" * 300]):
        band = draw_frame(grey(), {"hold": NONE}, None, words)[360:]
        assert (band[:, -4:] == band[0, 0]).all()  # nothing is cut off at the right
        assert (band > 100).any()


def test_a_film_strip_is_a_grid() -> None:
    pictures = [np.full((36, 64, 3), n, np.uint8) for n in range(5)]
    strip = film_strip(pictures, columns=3)
    assert strip.shape == (36 * 2 + 1, 64 * 3 + 2, 3)
    for number in range(5):
        top, left = number // 3 * 37, number % 3 * 65
        assert (strip[top : top + 36, left : left + 64] == number).all()
    assert (strip[37:, 130:] == 255).all()
    assert film_strip(pictures[:1]).shape == (36, 64, 3)
    assert film_strip([grey()] * 12).shape[:2] == (3 * 360 + 8, 4 * 640 + 12)  # about 16:9
    assert film_strip([grey()] * 4).shape[:2] == (2 * 360 + 4, 2 * 640 + 4)  # none left empty
    with pytest.raises(LaeError, match="one size"):
        film_strip([pictures[0], pictures[1][1:]])
    with pytest.raises(LaeError, match="at least one"):
        film_strip([])
