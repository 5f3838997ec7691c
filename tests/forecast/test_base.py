"""Forecasters: streaming and lane versions, custom ones, the oracle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from walks import lanes_and_queries, one_lane, streaming

from lae_sim.errors import LaeError
from lae_sim.forecast.base import ConstantVelocity, Hold, Lanes, Oracle, factory_for, forecast
from lae_sim.forecast.kalman import Kalman, KalmanLaePvt
from lae_sim.trace.recording import Recording

BUILT_IN = {
    "hold": Hold,
    "constant-velocity": ConstantVelocity,
    "kalman": Kalman,
    "kalman-lae-pvt": KalmanLaePvt,
}


@pytest.mark.parametrize("factory", BUILT_IN.values(), ids=BUILT_IN)
@given(case=lanes_and_queries())
@settings(max_examples=40)
def test_streaming_and_lanes_are_equal_bit_for_bit(factory: Any, case: Any) -> None:
    lanes, item, frame = case
    by_lanes = forecast(factory, lanes, item, frame)
    one_by_one = streaming(factory, lanes, item, frame)
    assert by_lanes.dtype == one_by_one.dtype == np.float64
    assert by_lanes.tobytes() == one_by_one.tobytes()


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


def test_items_in_step() -> None:
    """The lanes of the docstring, the longest of them last."""
    lengths = np.array([3, 1, 4])
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    lanes = Lanes(offsets, np.arange(8), np.zeros((8, 4)), np.full((3, 2), np.inf))
    order, running = lanes.in_step()
    assert order.tolist() == [4, 0, 3, 5, 1, 6, 2, 7]
    assert running.tolist() == [3, 2, 2, 1]
    assert lanes.firsts().tolist() == lanes.first(np.arange(8)).tolist() == [0] * 3 + [3] + [4] * 4
    none = Lanes(np.array([0]), np.arange(0), np.zeros((0, 4)), np.zeros((0, 2)))
    assert [len(each) for each in none.in_step()] == [0, 0]


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


class Many:
    """A user's factory that answers for many lanes at once, whatever it is told to."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def __call__(self, box: Sequence[float], image_size: Any = None) -> Hold:
        raise AssertionError("the lanes are there")

    def forecast_lanes(self, lanes: Lanes, item: np.ndarray, frame: np.ndarray) -> Any:
        return self.answer


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        ([[1, 2, 3, 4], [1, 2, 3, 4], [1, 2, np.nan, 4]], "predicted .* for frame 5, not a box"),
        ([[1, 2, 3, 4], [1, -np.inf, 3, 4], [1, 2, 3, 4]], "predicted .* for frame 2, not a box"),
        ([1, 2, 3, 4], r"answered \(4,\), not \(3, 4\)"),
        ([[1, 2, 3, 4]], r"answered \(1, 4\)"),
        (None, r"answered \(\)"),
        (["a"], "ValueError"),
    ],
)
def test_lanes_that_answer_no_boxes_are_refused_by_name(answer: Any, problem: str) -> None:
    with pytest.raises(LaeError, match=f"^mine: {problem}"):
        forecast(Many(answer), TWO, ITEM, FRAME, "mine")


def test_lanes_may_answer_any_numbers() -> None:
    found = forecast(Many([[1, 2, 3, 4]] * 3), TWO, ITEM, FRAME)
    assert found.dtype == np.float64
    assert found.tolist() == [[1, 2, 3, 4]] * 3


TRUTH = [[5, 5, 9, 9], [6, 5, 9, 9], [np.nan] * 4, [8, 5, 0, 9], [9, 5, 9, 9]]
KNOWN = Recording.new("known", TRUTH, [[1, 1, 4, 4]] * 5, [1] * 5)


def test_the_oracle_tells_the_truth_or_holds() -> None:
    lanes = one_lane([[0, 0, 10, 10], [4, 2, 12, 10]], [0, 2])
    item, frame = np.array([0, 0, 1, 1, 1, 1]), np.array([0, 1, 2, 3, 4, 99])
    expected = [TRUTH[0], TRUTH[1], [4, 2, 12, 10], [4, 2, 12, 10], TRUTH[4], TRUTH[4]]
    factory = factory_for(Oracle, KNOWN)
    assert forecast(factory, lanes, item, frame).tolist() == expected
    assert streaming(factory, lanes, item, frame).tolist() == expected


def test_a_factory_is_made_for_its_sequence_where_it_asks_for_it() -> None:
    other = Recording.new("other", [[7, 7, 7, 7]], [[1, 1, 4, 4]], [1])
    for factory in (Oracle, Oracle()):
        told = [factory_for(factory, r)([0, 0, 1, 1], None).predict(0) for r in (KNOWN, other)]
        assert told == [TRUTH[0], [7, 7, 7, 7]]
    assert factory_for(Hold, KNOWN) is Hold
