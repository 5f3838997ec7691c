"""The frames of strided passes."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.replay.strides import followed, phases

STRIDES = st.fractions(1, 6, max_denominator=5)


def test_by_hand() -> None:
    assert [p.tolist() for p in phases(Fraction(1), 4)] == [[0, 1, 2, 3]]
    assert [p.tolist() for p in phases(Fraction(2), 6)] == [[0, 2, 4], [0, 1, 3, 5]]
    found = [p.tolist() for p in phases(Fraction(3, 2), 9)]
    assert found == [[0, 1, 3, 4, 6, 7], [0, 2, 3, 5, 6, 8]]
    assert followed(Fraction(3, 2), 9).tolist() == [0, 0, 0, 1, 3, 3, 4, 6, 6]
    assert [p.tolist() for p in phases(Fraction(9), 3)] == [[0, 1], [0, 2]]
    assert [p.tolist() for p in phases(Fraction(2), 1)] == [[0]]


@given(stride=STRIDES, length=st.integers(1, 60))
def test_every_frame_is_seen_and_steps_are_those_of_the_stride(
    stride: Fraction, length: int
) -> None:
    found = phases(stride, length)
    assert set(np.concatenate(found).tolist()) == set(range(length))
    least, most = stride.numerator // stride.denominator, -(-stride.numerator // stride.denominator)
    for frames in found:
        assert frames[0] == 0
        assert len(frames) > 1 or length == 1
        steps = np.diff(frames)
        assert (steps[1:] >= least).all()
        assert (steps <= most).all()
        assert (steps > 0).all()


@given(stride=st.integers(1, 9), length=st.integers(1, 40))
def test_a_whole_stride_follows_the_frame_a_stride_before(stride: int, length: int) -> None:
    expected = np.maximum(np.arange(length) - stride, 0)
    np.testing.assert_array_equal(followed(Fraction(stride), length), expected)
