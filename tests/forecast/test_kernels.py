"""The Kalman filter compiled: the bits of NumPy's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from compiling import needs_numba, switched
from hypothesis import given, settings
from hypothesis import strategies as st
from walks import lanes_and_queries

from lae_sim.boxes import iou
from lae_sim.forecast.base import LaneFactory, Lanes
from lae_sim.forecast.kalman import Kalman, KalmanLaePvt, TunedKalman

FACTORIES: dict[str, LaneFactory] = {
    "kalman": Kalman,
    "kalman-lae-pvt": KalmanLaePvt,
    "decays": TunedKalman(q=0.3, r=2.0, p0=7.0, decay=0.85),
    "of centres": TunedKalman(q=3.0, decay=0.999, state="centre"),
    "no noise": TunedKalman(q=0.0, p0=0.0),
}

pytestmark = needs_numba


@given(
    walk=lanes_and_queries(jumps=0.3),
    name=st.sampled_from(sorted(FACTORIES)),
    in_time=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_it_forecasts_the_same(
    walk: tuple[Lanes, np.ndarray, np.ndarray], name: str, in_time: bool
) -> None:
    lanes, item, frame = walk
    if in_time:  # where frames arrive at times of their own
        lanes = replace(lanes, frames=lanes.frames * 1.03, numbers=lanes.frames)
        frame = frame * 1.03
    found = []
    for way in ("0", "1"):
        with switched(way):
            found.append(FACTORIES[name].forecast_lanes(lanes, item, frame))
    assert found[0].tobytes() == found[1].tobytes()


def test_lanes_of_one_box_and_nothing_asked() -> None:
    lanes = Lanes(np.arange(4), np.zeros(3, int), np.ones((3, 4)), np.full((3, 2), np.inf))
    nothing = np.empty(0, np.int64)
    for factory in FACTORIES.values():
        with switched("1"):
            assert factory.forecast_lanes(lanes, nothing, nothing).shape == (0, 4)
            found = factory.forecast_lanes(lanes, np.array([1]), np.array([5]))
            assert found == pytest.approx(np.ones((1, 4)))


NUMBER = st.sampled_from([0.0, -0.0, 1.0, 3.0, -2.0, 1e-300, 1e200, 1e308, np.nan, np.inf])
BOX = st.tuples(*[NUMBER] * 4)


@given(a=BOX, b=BOX)
@settings(max_examples=300, deadline=None)
def test_overlap_is_that_of_numpy(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    from lae_sim.forecast.kernels import overlap

    with np.errstate(all="ignore"):
        expected = iou(np.array([a]), np.array([b]))[0]
    assert overlap(a, b) == expected
