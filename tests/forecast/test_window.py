"""Windows over the last outputs, one sequence or many at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from walks import lanes_and_queries, streaming

from lae_sim.forecast.base import Lanes, forecast
from lae_sim.forecast.window import LeastSquares, Window, Windowed


def test_a_window_by_hand() -> None:
    # two lanes of outputs at frames 0, 2, 5 and 0, 3; the boxes are numbered 0 to 4
    boxes = np.arange(5.0)[:, None] + np.array([0, 0.1, 0.2, 0.3])
    lanes = Lanes(np.array([0, 3, 5]), np.array([0, 2, 5, 0, 3]), boxes, np.full((2, 2), np.inf))
    window = Window.of(lanes, np.array([0, 1, 2, 3, 4, 4]), 3)
    assert window.frames.tolist() == [
        [0, 0, 0], [2, 0, 0], [5, 2, 0], [0, 0, 0], [3, 0, 0], [3, 0, 0],
    ]  # fmt: skip
    assert window.boxes[..., 0].tolist() == [
        [0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 3, 3], [4, 3, 3], [4, 3, 3],
    ]  # fmt: skip
    assert (window.boxes - window.boxes[..., :1]).tolist()[2][1] == pytest.approx(
        [0, 0.1, 0.2, 0.3]
    )
    assert window.known.sum(axis=1).tolist() == [1, 2, 3, 1, 2, 2]
    assert (np.diff(window.known.astype(int)) <= 0).all()


@given(case=lanes_and_queries(), size=st.integers(1, 15))
def test_a_window_holds_what_a_plain_loop_finds(case: Any, size: int) -> None:
    lanes, item, _ = case
    window = Window.of(lanes, item, size)
    for p, i in enumerate(item.tolist()):
        first = max(offset for offset in lanes.offsets[:-1].tolist() if offset <= i)
        expected = list(range(i, first - 1, -1))[:size]
        known = len(expected)
        expected += [first] * (size - known)
        assert window.frames[p].tolist() == lanes.frames[expected].tolist()
        assert window.boxes[p].tolist() == lanes.boxes[expected].tolist()
        assert window.known[p].tolist() == [True] * known + [False] * (size - known)


@dataclass(frozen=True)
class Spy:
    """A rule that answers with what it sees."""

    size: int = 4

    def __call__(self, window: Window, ahead: np.ndarray) -> np.ndarray:
        last = window.known.sum(axis=1) - 1
        oldest = window.boxes[np.arange(len(last)), last]
        columns = [ahead, window.frames[:, 0], last, oldest[:, 0]]
        return np.column_stack(columns).astype(float)


@given(case=lanes_and_queries())
def test_a_rule_is_told_the_same_either_way(case: Any) -> None:
    lanes, item, frame = case
    found = forecast(Windowed(Spy()), *case)
    assert found.tobytes() == streaming(Windowed(Spy()), *case).tobytes()
    np.testing.assert_array_equal(found[:, 0], frame - lanes.frames[item])


@given(
    case=lanes_and_queries(),
    rule=st.builds(
        LeastSquares, st.integers(1, 12), st.floats(0.1, 1), st.sampled_from([0.01, 0.1, 10])
    ),
)
def test_least_squares_stream_as_they_answer_for_lanes(case: Any, rule: LeastSquares) -> None:
    found, expected = forecast(Windowed(rule), *case), streaming(Windowed(rule), *case)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
