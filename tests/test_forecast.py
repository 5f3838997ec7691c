"""Forecasters: streaming and lane versions, custom ones, loading by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lae_sim.errors import LaeError
from lae_sim.forecast import ConstantVelocity, Hold, Lanes, forecast
from lae_sim.kalman import Kalman, KalmanLaePvt

BUILT_IN = {
    "hold": Hold,
    "constant-velocity": ConstantVelocity,
    "kalman": Kalman,
    "kalman-lae-pvt": KalmanLaePvt,
}


@st.composite
def lanes_and_queries(draw: st.DrawFn) -> tuple[Lanes, np.ndarray, np.ndarray]:
    """Some lanes of random walks, with queries as of their items."""
    lengths = draw(st.lists(st.integers(1, 12), min_size=1, max_size=6))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    frames, boxes = [], []
    for length in lengths:
        frames.append(np.concatenate([[0], np.cumsum(random.integers(1, 6, length - 1))]))
        walk = random.normal(0, 12, (length, 4)).cumsum(axis=0)
        walk += [300, 200, 40, 30]
        walk[:, 2:] = np.abs(walk[:, 2:])
        far = random.random(length) < 0.15
        walk[far, :2] += random.normal(0, 200, (far.sum(), 2))
        boxes.append(walk)
    sizes = np.where(
        random.random((len(lengths), 1)) < 0.3, np.inf, random.integers(200, 700, (len(lengths), 2))
    )
    offsets = np.cumsum([0, *lengths])
    lanes = Lanes(offsets, np.concatenate(frames).astype(np.int64), np.concatenate(boxes), sizes)
    item = np.sort(random.integers(0, offsets[-1], 3 * offsets[-1]))
    ahead = random.integers(0, 9, len(item))
    return lanes, item, lanes.frames[item] + ahead


@pytest.mark.parametrize("factory", BUILT_IN.values(), ids=BUILT_IN)
@given(case=lanes_and_queries())
@settings(max_examples=40)
def test_streaming_and_lanes_are_equal_bit_for_bit(factory: Any, case: Any) -> None:
    lanes, item, frame = case
    by_lanes = forecast(factory, lanes, item, frame)
    streaming = forecast(lambda box, size: factory(box, size), lanes, item, frame)
    assert by_lanes.dtype == streaming.dtype == np.float64
    assert by_lanes.tobytes() == streaming.tobytes()


def one_lane(boxes: Sequence[Sequence[float]], frames: Sequence[int]) -> Lanes:
    return Lanes(
        np.array([0, len(boxes)]),
        np.array(frames),
        np.array(boxes, float),
        np.array([[640.0, 360.0]]),
    )


TWO = one_lane([[0, 0, 10, 10], [4, 2, 12, 10]], [0, 2])
ITEM, FRAME = np.array([0, 1, 1]), np.array([1, 2, 5])


@pytest.mark.parametrize(
    ("factory", "expected"),
    [
        (Hold, [[0, 0, 10, 10], [4, 2, 12, 10], [4, 2, 12, 10]]),
        (ConstantVelocity, [[0, 0, 10, 10], [4, 2, 12, 10], [10, 5, 15, 10]]),
    ],
)
def test_simple_forecasters_by_hand(factory: Any, expected: list[list[float]]) -> None:
    assert forecast(factory, TWO, ITEM, FRAME).tolist() == expected
    assert forecast(lambda *both: factory(*both), TWO, ITEM, FRAME).tolist() == expected


def test_a_custom_forecaster_is_fed_in_order_and_asked_as_of_each_item() -> None:
    log: list[Any] = []

    class Scribe:
        def __init__(self, box: Sequence[float], image_size: Any = None) -> None:
            log.append(("made", list(box), image_size))

        def update(self, frame: int, box: Sequence[float]) -> None:
            log.append(("update", frame, list(box)))

        def predict(self, frame: int) -> Sequence[float]:
            log.append(("predict", frame))
            return [1, 2, 3, 4]

    offsets = np.array([0, 3, 4])
    boxes = np.arange(16, dtype=float).reshape(4, 4)
    sizes = np.array([[640, 360], [np.inf, np.inf]])
    lanes = Lanes(offsets, np.array([0, 2, 5, 0]), boxes, sizes)
    found = forecast(Scribe, lanes, np.array([0, 2, 2, 3]), np.array([1, 6, 7, 0]))
    assert found.tolist() == [[1, 2, 3, 4]] * 4
    assert log == [
        ("made", boxes[0].tolist(), (640, 360)),
        ("predict", 1),
        ("update", 2, boxes[1].tolist()),
        ("update", 5, boxes[2].tolist()),
        ("predict", 6),
        ("predict", 7),
        ("made", boxes[3].tolist(), None),
        ("predict", 0),
    ]
    assert all(type(value) is int for value in log[0][2])


class Answers:
    """Answers the same to every question."""

    answer: Any = None

    def __init__(self, box: Sequence[float], image_size: Any = None) -> None:
        pass

    def update(self, frame: int, box: Sequence[float]) -> None:
        pass

    def predict(self, frame: int) -> Any:
        return self.answer


@pytest.mark.parametrize(
    "answer",
    [
        None,
        [],
        [1, 2, 3],
        [1, 2, 3, 4, 5],
        [[1, 2, 3, 4]],
        [1, 2, 3, float("nan")],
        [1, 2, float("inf"), 4],
        3.0,
        "box",
        ["a", "b", "c", "d"],
        [1, 2, 3, None],
        [[1], 2, 3, 4],
        {"x": 1},
        [1, 2, 3, 10**400],
        [1, 2, 3, 1j],
    ],
)
def test_an_answer_that_is_no_box_is_refused(answer: Any) -> None:
    factory = type("Odd", (Answers,), {"answer": answer})
    with pytest.raises(LaeError, match=r"odd: predicted .* for frame 1"):
        forecast(factory, TWO, ITEM, FRAME, "odd")


@pytest.mark.parametrize("answer", [[1, 2, 3, 4], (1.0, 2, 3, 4), np.array([1, 2, 3, 4])])
def test_any_four_numbers_are_a_box(answer: Any) -> None:
    factory = type("Fine", (Answers,), {"answer": answer})
    assert forecast(factory, TWO, ITEM, FRAME).tolist() == [[1, 2, 3, 4]] * 3


@pytest.mark.parametrize("base", [Hold, ConstantVelocity, Kalman])
def test_a_subclass_that_predicts_otherwise_is_asked(base: type) -> None:
    class Elsewhere(base):  # type: ignore[misc]
        def predict(self, frame: int) -> list[float]:
            return [9.0, 9.0, 9.0, 9.0]

    lanes = Lanes(np.array([0, 1]), np.array([0]), np.ones((1, 4)), np.full((1, 2), np.inf))
    answered = forecast(Elsewhere, lanes, np.array([0]), np.array([3]))
    np.testing.assert_array_equal(answered, [[9.0] * 4])
