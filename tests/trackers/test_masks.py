from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lae_sim.errors import LaeError
from lae_sim.trackers import box_of
from lae_sim.trackers.stopwatch import _checked

SIDES = st.tuples(st.integers(0, 9), st.integers(0, 9))


@given(arrays(bool, SIDES))
def test_the_box_covers_the_pixels_and_no_more(mask):
    found = box_of(mask)
    pixels = [(i, j) for j, row in enumerate(mask) for i, one in enumerate(row) if one]
    if not pixels:
        assert found is None
        return
    columns, rows = zip(*pixels)
    x, y, w, h = found
    assert (x, x + w) == (min(columns), max(columns) + 1)
    assert (y, y + h) == (min(rows), max(rows) + 1)


def test_one_pixel_is_one_wide():
    mask = np.zeros((5, 7), bool)
    mask[3, 6] = True
    assert box_of(mask) == (6.0, 3.0, 1.0, 1.0)
    assert all(type(number) is float for number in box_of(mask))


@pytest.mark.parametrize("kind", ["uint8", "int64", "float32", "float64", "list"])
@pytest.mark.parametrize("high", [1, 255])
def test_numbers_are_masks_too(kind, high):
    mask = np.zeros((6, 8), "float64" if kind == "list" else kind)
    mask[1:4, 2:7] = high
    assert box_of(mask.tolist() if kind == "list" else mask) == (2, 1, 5, 3)


def test_a_probability_counts_from_a_half_on():
    mask = np.full((6, 8), 0.5, np.float32)
    assert box_of(mask) is None
    mask[2, 3:5] = 0.51
    mask[0, 0] = np.nan
    assert box_of(mask) == (3, 2, 2, 1)


@pytest.mark.parametrize("order", ["C", "F", "steps"])
def test_whatever_lies_in_memory(order):
    mask = np.zeros((40, 50), bool)
    mask[7:30, 11:13] = True
    given = np.repeat(mask, 2, axis=1)[:, ::2] if order == "steps" else np.array(mask, order=order)
    assert box_of(given) == (11, 7, 2, 23)


def test_it_is_a_trackers_answer():
    assert _checked(box_of(np.ones((3, 4))))[0] == [0, 0, 4, 3]
    assert _checked(box_of(np.zeros((3, 4))))[0] is None


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((1, 4, 5)), r"numbers \[H, W\], not float64 \[1, 4, 5\]"),
        (np.zeros(4), r"\[4\]"),
        (None, "not object"),
        ([["a"]], "not <U1"),
        (np.array([[0.2, -7.5]]), "logits > 0"),
        (np.array([[-1, 1]]), "logits > 0"),
    ],
)
def test_what_is_no_mask(mask, message):
    with pytest.raises(LaeError, match=message):
        box_of(mask)
