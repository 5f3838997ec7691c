"""The g-h filter and IMM, against plain formulas and filterpy used directly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from filterpy.gh import GHFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from walks import lanes_and_queries, one_lane, streaming
from witness import DenseKalman

from lae_sim.errors import LaeError
from lae_sim.forecast.base import forecast
from lae_sim.forecast.filters import GH, IMM
from lae_sim.forecast.kalman import Kalman

FACTORIES = [GH(), GH(0.3, 0.05), IMM(), IMM(quiet=0, agile=3, r=1, p0=10, stay=0.5)]


@given(case=lanes_and_queries(), g=st.floats(0, 1), h=st.floats(0, 2))
def test_g_h_agrees_with_its_formulas_and_with_a_filter_per_coordinate(
    case: Any, g: float, h: float
) -> None:
    lanes = case[0]
    low, high = lanes.offsets[:2]
    item = np.arange(high - low)
    found = forecast(GH(g, h), lanes, item, lanes.frames[item] + 3)
    x, dx = lanes.boxes[0], np.zeros(4)
    scalars = [GHFilter(value, 0.0, 1.0, g, h) for value in x]
    for k in item.tolist():
        if k:
            dt = float(lanes.frames[k] - lanes.frames[k - 1])
            residual = lanes.boxes[k] - (x + dt * dx)  # Brookner, Eqs. 1.2-8 and 1.2-10
            x, dx = x + dt * dx + g * residual, dx + h * residual / dt
            for scalar, measured in zip(scalars, lanes.boxes[k]):
                scalar.dt = dt
                scalar.update(measured)
        np.testing.assert_allclose(found[k], x + 3 * dx, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(
            found[k], [s.x + 3 * s.dx for s in scalars], rtol=1e-9, atol=1e-7
        )


class DenseIMM:
    """Interacting multiple models as Blom and Bar-Shalom have them, matrices written out."""

    def __init__(self, box: Any, settings: IMM) -> None:
        self.noises, self.r = (settings.quiet, settings.agile), settings.r
        self.states = [np.array([*box, 0, 0, 0, 0], float)] * 2
        self.covariances = [settings.p0 * np.eye(8)] * 2
        self.chances = np.array([0.5, 0.5])
        self.switch = np.array(
            [[settings.stay, 1 - settings.stay], [1 - settings.stay, settings.stay]]
        )
        self.frame = 0

    def update(self, frame: int, box: Any) -> None:
        dt = frame - self.frame
        f, h = DenseKalman.transition(dt), np.eye(4, 8)
        expected = self.chances @ self.switch
        states, covariances, likelihoods = [], [], []
        for j, q in enumerate(self.noises):
            mix = self.switch[:, j] * self.chances / expected[j]
            x = sum(m * s for m, s in zip(mix, self.states))
            p = sum(
                m * (c + np.outer(s - x, s - x))
                for m, s, c in zip(mix, self.states, self.covariances)
            )
            x, p = f @ x, f @ p @ f.T + q * dt**2 * np.eye(8)
            error = np.asarray(box, float) - h @ x
            s = h @ p @ h.T + self.r * np.eye(4)
            k = p @ h.T @ np.linalg.inv(s)
            density = -0.5 * (
                error @ np.linalg.solve(s, error) + np.linalg.slogdet(2 * np.pi * s)[1]
            )
            states.append(x + k @ error)
            covariances.append(p - k @ h @ p)
            likelihoods.append(density)
        chances = expected * np.exp(np.array(likelihoods) - max(likelihoods))
        self.states, self.covariances = states, covariances
        self.chances, self.frame = chances / chances.sum(), frame

    def predict(self, frame: int) -> np.ndarray:
        mean = sum(c * s for c, s in zip(self.chances, self.states))
        return mean[:4] + (frame - self.frame) * mean[4:]


@given(case=lanes_and_queries(jumps=0.0), imm=st.sampled_from([IMM(), IMM(0.1, 100, 30, 50, 0.8)]))
@settings(max_examples=15)
def test_imm_agrees_with_matrices(case: Any, imm: IMM) -> None:
    lanes = case[0]
    item = np.arange(lanes.offsets[1])
    found = forecast(imm, lanes, item, lanes.frames[item] + 2)
    dense = DenseIMM(lanes.boxes[0], imm)
    for k in item.tolist():
        if k:
            dense.update(int(lanes.frames[k]), lanes.boxes[k])
        np.testing.assert_allclose(
            found[k], dense.predict(int(lanes.frames[k]) + 2), rtol=0, atol=1e-6
        )


@given(case=lanes_and_queries())
@settings(max_examples=10)
def test_imm_of_two_equal_models_is_the_kalman_filter(case: Any) -> None:
    found, expected = forecast(IMM(1, 1), *case), streaming(Kalman, *case)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("factory", FACTORIES, ids=str)
def test_constant_velocity_is_followed(factory: Any) -> None:
    model = factory([0, 0, 20, 20], None)
    assert list(model.predict(7)) == [0, 0, 20, 20]
    for frame in range(2, 240, 2):
        model.update(frame, [3 * frame, -frame, 20, 20])
    np.testing.assert_allclose(model.predict(250), [750, -250, 20, 20], atol=0.5)


def test_imm_answers_after_a_jump_of_hardly_any_likelihood() -> None:
    """Of 5e-324, the smallest number above 0, half is 0: then no model would be likely at all."""
    for distance in np.arange(530, 600, 0.25):
        model = IMM(1, 1)([0, 0, 20, 20], None)
        model.update(1, [distance, 0, 20, 20])
        assert np.isfinite(model.predict(2)).all()


@pytest.mark.parametrize("factory", FACTORIES, ids=str)
def test_a_target_that_jumps_far_is_answered(factory: Any) -> None:
    boxes = [[0, 0, 20, 20], [1e5, 0, 20, 20], [0, -1e5, 900, 1], [5, 5, 20, 20]]
    lanes = one_lane(boxes, [0, 1, 900, 901])
    item = np.arange(4)
    assert np.isfinite(forecast(factory, lanes, item, lanes.frames[item] + 100)).all()


@pytest.mark.parametrize(
    ("factory", "wrong"),
    [
        *((GH, {name: value}) for name in "gh" for value in (-0.1, 2.1, math.nan)),
        *((IMM, {n: v}) for n in ("quiet", "agile", "p0", "r") for v in (-1, math.nan, math.inf)),
        *((IMM, {"stay": value}) for value in (0, 1, math.nan)),
        (IMM, {"r": 0}),
    ],
    ids=str,
)
def test_parameters_that_cannot_be_are_refused(factory: Any, wrong: dict[str, float]) -> None:
    with pytest.raises(LaeError, match=r"^an? (g-h filter|IMM) needs"):
        factory(**wrong)
