"""Least squares over the last outputs, against scipy and plain loops."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from walks import lanes_and_queries, one_lane

from lae_sim.errors import LaeError
from lae_sim.forecast.base import forecast
from lae_sim.forecast.window import LeastSquares, Windowed

FRAMES = [0, 2, 3, 7, 8, 10]
STRAIGHT = [[100 + 3 * t, 50 - 2 * t, 40 + t, 30 - 0.5 * t] for t in FRAMES]


def centred(box: Any) -> np.ndarray:
    x, y, w, h = box
    return np.array([x + w / 2, y + h / 2, w, h])


def predicted(rule: LeastSquares, boxes: Any, ahead: int = 4) -> list[float]:
    """The forecast after all the boxes."""
    item = np.array([len(boxes) - 1])
    lanes = one_lane(boxes, FRAMES[: len(boxes)])
    answer: list[float] = forecast(Windowed(rule), lanes, item, lanes.frames[item] + ahead)[
        0
    ].tolist()
    return answer


@pytest.mark.parametrize(
    "rule", [LeastSquares(), LeastSquares(1), LeastSquares(3, 1.0, 10)], ids=str
)
@pytest.mark.parametrize("known", [2, 3, 6])
def test_constant_velocity_is_exact(rule: LeastSquares, known: int) -> None:
    t = FRAMES[known - 1] + 4
    expected = [100 + 3 * t, 50 - 2 * t, 40 + t, 30 - 0.5 * t]
    assert predicted(rule, STRAIGHT[:known]) == pytest.approx(expected, abs=1e-9)


def test_before_any_output_the_box_stands() -> None:
    assert predicted(LeastSquares(), STRAIGHT[:1], 1000) == pytest.approx(STRAIGHT[0], abs=1e-12)


def test_sides_stay_sides_and_gaps_of_any_length_do_no_harm() -> None:
    lanes = one_lane([[0, 0, 90, 90], [40, 40, 10, 10]], [0, 3])
    for ahead in (9, 2**40):
        [box] = forecast(Windowed(LeastSquares()), lanes, np.array([1]), np.array([3 + ahead]))
        assert box.tolist() == pytest.approx([44.5, 44.5, 1, 1])  # about the same centre
    lanes = one_lane([[0, 0, 9, 9], [7, 0, 9, 9]], [0, 10**6])
    assert np.isfinite(
        forecast(Windowed(LeastSquares()), lanes, np.array([1]), np.array([10**6 + 5]))
    ).all()


def test_an_outlier_moves_a_robust_fit_less() -> None:
    boxes = [list(box) for box in STRAIGHT]
    boxes[3][0] += 60
    straight = centred(predicted(LeastSquares(), STRAIGHT))
    robust, plain = (
        abs(centred(predicted(LeastSquares(huber=huber), boxes)) - straight)[0]
        for huber in (0.01, 1e6)
    )
    assert 0 < robust < plain / 3
    assert plain > 5


def reweighted(ages: Any, changes: Any, scale: float, rule: LeastSquares) -> float:
    """The slope through the origin, by iteratively reweighted least squares in plain loops."""
    weights = [rule.forgetting**age for age in ages]
    for _ in range(4):
        squares = sum(w * t * t for w, t in zip(weights, ages))
        slope = sum(w * t * d for w, t, d in zip(weights, ages, changes)) / squares
        errors = [abs(d - t * slope) / scale for t, d in zip(ages, changes)]
        weights = [
            rule.forgetting**t * (1 if e <= rule.huber else rule.huber / e)
            for t, e in zip(ages, errors)
        ]
    return slope


@given(
    case=lanes_and_queries(least=5.0),
    rule=st.builds(
        LeastSquares, st.integers(1, 7), st.sampled_from([0.3, 0.7, 1]), st.floats(0.01, 2)
    ),
)
def test_it_agrees_with_plain_loops(case: Any, rule: LeastSquares) -> None:
    lanes = case[0]
    item = lanes.offsets[1:] - 1
    found = forecast(Windowed(rule), lanes, item, lanes.frames[item] + 2)
    for answer, low, high in zip(found, lanes.offsets, lanes.offsets[1:]):
        seen = slice(max(low, high - 1 - rule.n), high - 1)
        ages = lanes.frames[high - 1] - lanes.frames[seen]
        last = centred(lanes.boxes[high - 1])
        others = np.array([centred(box) for box in lanes.boxes[seen]]).reshape(-1, 4)
        slopes = [
            reweighted(ages, changes, math.sqrt(last[2] * last[3]), rule) if len(ages) else 0.0
            for changes in (last - others).T
        ]
        expected = last + 2 * np.array(slopes)
        expected[2:] = np.maximum(expected[2:], 1)
        np.testing.assert_allclose(centred(answer), expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("huber", [0.01, 0.05, 0.3])
def test_its_rounds_lead_to_scipys_robust_least_squares(
    huber: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lae_sim.forecast.window._ROUNDS", 500)
    boxes = np.array(STRAIGHT) + np.random.default_rng(0).normal(0, 0.6, (6, 4))
    boxes[2, :2] += 9
    outputs = np.array([centred(box) for box in boxes])
    ages = FRAMES[-1] - np.array(FRAMES[:-1], float)
    scale = math.sqrt(boxes[-1, 2] * boxes[-1, 3])
    slopes = (centred(predicted(LeastSquares(5, 1.0, huber), boxes)) - outputs[-1]) / 4
    for slope, changes in zip(slopes, (outputs[-1] - outputs[:-1]).T):

        def residuals(v: float, changes: np.ndarray = changes) -> np.ndarray:
            return (changes - ages * v) / scale

        fit = least_squares(residuals, [0.0], loss="huber", f_scale=huber, xtol=1e-15, gtol=1e-15)
        assert slope == pytest.approx(fit.x[0], abs=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"n": value} for value in (0, -1, 1001, 2.5, math.nan)),
        *({"forgetting": value} for value in (0, -0.5, 1.1, math.nan)),
        *({"huber": value} for value in (0, -1, math.nan, math.inf)),
    ],
    ids=str,
)
def test_parameters_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(LaeError, match=r"^least squares need"):
        LeastSquares(**wrong)
