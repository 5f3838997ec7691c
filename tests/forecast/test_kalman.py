"""The paper's filter against filterpy and matrices, the released code's additions, its family."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from walks import lanes_and_queries, one_lane, streaming
from witness import DenseKalman, DenseLaePvt, FilterpyKalman

from lae_sim.errors import LaeError
from lae_sim.forecast.base import Lanes, forecast
from lae_sim.forecast.kalman import (
    PAPER,
    RESTART_IOU,
    Kalman,
    KalmanLaePvt,
    TunedKalman,
    clip,
    filter_lanes,
)
from lae_sim.trace.metadata import ImageSizes

BOXES = st.tuples(*[st.floats(-1000, 3000)] * 2, *[st.floats(0.5, 900)] * 2)


@pytest.mark.parametrize(("longest", "tolerance"), [(10, 1e-9), (100, 1e-6)])
@given(data=st.data())
def test_kalman_agrees_with_filterpy_and_with_dense_matrices(
    longest: int, tolerance: float, data: st.DataObject
) -> None:
    # The dense filters subtract nearly equal covariances after long intervals, hence two cases.
    box = data.draw(BOXES)
    outputs = data.draw(st.lists(st.tuples(st.integers(1, longest), BOXES), max_size=25))
    ours, filterpy, dense = Kalman(box), FilterpyKalman(box), DenseKalman(box)
    frame = 0
    for interval, measured in outputs:
        frame += interval
        for model in (ours, filterpy, dense):
            model.update(frame, measured)
        for ahead in (0, 1, 7):
            found = ours.predict(frame + ahead)
            for witness in (filterpy, dense):
                expected = witness.predict(frame + ahead)
                np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_before_any_update_the_answer_is_the_initial_box() -> None:
    box = [0.1, 0.2, 30.3, 40.4]
    assert [Kalman(box).predict(frame) for frame in (0, 1, 1000)] == [box] * 3


def test_one_update_by_hand() -> None:
    # dt = 2: a = 100 + 4 * 100 + 4 = 504, b = 200; gains 504/514 and 200/514
    model = Kalman([0, 0, 10, 10])
    model.update(2, [51.4, 0, 10, 10])
    x, y, w, h = model.predict(2)
    assert x == pytest.approx(50.4)
    assert model.predict(3)[0] == pytest.approx(50.4 + 20)
    assert (y, w, h) == (0, 10, 10)


def test_a_target_of_constant_velocity_is_followed() -> None:
    model = Kalman([0, 0, 20, 20])
    for frame in range(2, 200, 2):
        model.update(frame, [3 * frame, -frame, 20, 20])
    np.testing.assert_allclose(model.predict(210), [630, -210, 20, 20], atol=0.5)


# ------------------------------------------------------------------------------ kalman-lae-pvt

SIZE = (640, 360)


def walk(seed: int) -> list[tuple[int, list[float]]]:
    """A target that moves, jumps, leaves the image, and is sometimes small."""
    random = np.random.default_rng(seed)
    box = np.array([300.0, 150, *random.uniform(6, 60, 2)])
    velocity = random.normal(0, 9, 2)
    frame, outputs = 0, [(0, box.tolist())]
    for _ in range(40):
        interval = int(random.integers(1, 5))
        frame += interval
        box[:2] += velocity * interval + random.normal(0, 2, 2)
        box[2:] = np.maximum(box[2:] * random.uniform(0.8, 1.2, 2), 1.5)
        if random.random() < 0.1:
            box[:2] = random.uniform(0, SIZE)
            velocity = random.normal(0, 9, 2)
        outputs.append((frame, box.tolist()))
    return outputs


@pytest.mark.parametrize("size", [SIZE, None])
def test_kalman_lae_pvt_agrees_with_matrices_and_reaches_every_branch(
    size: tuple[int, int] | None,
) -> None:
    DenseLaePvt.hits = Counter()
    for seed in range(20):
        outputs = walk(seed)
        ours, dense = KalmanLaePvt(outputs[0][1], size), DenseLaePvt(outputs[0][1], size)
        for frame, box in outputs[1:]:
            ours.update(frame, box)
            dense.update(frame, box)
            for ahead in (0, 1, 4, 20):
                found, expected = ours.predict(frame + ahead), dense.predict(frame + ahead)
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)
    hits = DenseLaePvt.hits
    assert min(hits[branch] for branch in ("restart", "update", "too small")) > 10
    assert hits["not positive"] > 5
    assert (hits["clipped"] > 50) == (size is not None)


def iou_case(wanted: float) -> list[float]:
    """A box whose IoU with (0, 0, 100, 100) is wanted, by a shift in x: (100-d)/(100+d)."""
    shift = 100 * (1 - wanted) / (1 + wanted)
    return [shift, 0.0, 100.0, 100.0]


def test_a_restart_needs_an_iou_strictly_below_0_3() -> None:
    # 0.3 exactly, in numbers without rounding: boxes 10 x 13 that share 10 x 6, 60 / 200
    kept, lost = KalmanLaePvt([0, 0, 10, 13]), KalmanLaePvt([0, 0, 10, 13])
    kept.update(1, [0, 7, 10, 13])
    lost.update(1, [0, 7.0625, 10, 13])
    assert kept.predict(2)[1] > 7  # it moves on
    assert lost.predict(2) == [0, 7.0625, 10, 13]  # zero velocity
    for shift, restarts in ((7, False), (7.0625, True)):
        boxes = np.array([[0, 0, 10, 13], [0, shift, 10, 13]], float)
        lanes = Lanes(np.array([0, 2]), np.array([0, 1]), boxes, np.full((1, 2), np.inf))
        states, place = filter_lanes(lanes, PAPER, RESTART_IOU)
        assert (states[place[1], 1] == 0).all() == restarts
    for wanted, restarts in ((0.29, True), (0.31, False)):
        model = KalmanLaePvt([0, 0, 100, 100])
        model.update(1, iou_case(wanted))
        assert (model.predict(5)[0] == model.predict(1)[0]) == restarts


def test_after_a_restart_the_covariance_is_that_of_the_start() -> None:
    restarted, fresh = KalmanLaePvt([0, 0, 20, 20]), KalmanLaePvt([500, 0, 20, 20])
    restarted.update(3, [1, 0, 20, 20])
    restarted.update(7, [500, 0, 20, 20])
    for model, frame in ((restarted, 9), (fresh, 2)):
        model.update(frame, [504, 1, 20, 20])
    assert restarted.predict(12) == fresh.predict(5)


@pytest.mark.parametrize(
    ("forecast", "expected"),
    [
        ([10, 20, 30, 40], [10, 20, 30, 40]),  # inside
        ([-5, -5, 30, 40], [0, 0, 25, 35]),  # clipped left and above
        ([620, 340, 40, 40], [620, 340, 20, 20]),  # clipped right and below
        ([-10, -10, 700, 400], [0, 0, 640, 360]),  # larger than the image
        ([10, 20, 15, 5], [10, 20, 15, 5]),  # 75 is enough
        ([10, 20, 15.9, 4.9], "raw"),  # 15 * 4
        ([10, 20, 12.99, 6.99], "raw"),  # 12 * 6 = 72 though the area is 90
        ([10, 20, 1e3, 0.9], "raw"),  # int(0.9) = 0
        ([700, 100, 30, 40], "raw"),  # outside
        ([-50, 100, 30, 40], "raw"),
        ([638, 100, 30, 40], [638, 100, 2, 40]),  # 80 is left of it
        ([639, 100, 30, 40], "raw"),
        ([100, 100, -30, 40], "raw"),  # a negative side
        ([100, 100, -30, -40], "raw"),  # the product of two is positive
        ([100, 100, 0, 40], "raw"),
    ],
)
def test_clipping_and_the_fallback_to_the_raw_box(forecast: list[float], expected: object) -> None:
    raw = [1.0, 2.0, 3.0, 4.0]
    found = clip(np.array([forecast], float), np.array([raw]), np.array([SIZE], float))
    assert found.tolist() == [raw if expected == "raw" else expected]


def test_the_raw_box_of_the_fallback_is_the_last_fed_and_not_clipped() -> None:
    model = KalmanLaePvt([-30, 100, 32, 40], SIZE)
    assert model.predict(0) == [0, 100, 2, 40]
    model.update(1, [-33, 100, 32, 40])
    assert model.predict(1) == [-33, 100, 32, 40]


def test_without_an_image_size_nothing_is_clipped() -> None:
    far = [5000.0, -300.0, 30.0, 40.0]
    assert KalmanLaePvt(far).predict(3) == far


def test_image_sizes_are_per_lane() -> None:
    box = [90.0, 10.0, 40.0, 40.0]
    lanes = np.array([[100, 100], [np.inf, np.inf], [120, 30]], float)
    found = clip(np.array([box] * 3), np.array([box] * 3), lanes)
    assert found.tolist() == [[90, 10, 10, 40], box, [90, 10, 30, 20]]


def test_clipping_follows_images_that_change_size() -> None:
    box = [90.0, 10.0, 40.0, 40.0]
    sizes = ImageSizes((0, 2, 5), ((120, 90), (110, 30), (900, 900)))
    lanes = Lanes(
        np.array([0, 1, 2]), np.array([0, 0]), np.array([box] * 2), np.array([[120, 90.0]] * 2),
        resized=        {1: sizes},
    )  # fmt: skip
    item, frame = np.array([0, 0, 1, 1, 1, 1]), np.array([0, 6, 1, 2, 4, 5])
    whole, narrow = [90, 10, 30, 40], [90, 10, 20, 20]
    expected = [whole, whole, whole, narrow, narrow, box]
    assert KalmanLaePvt.forecast_lanes(lanes, item, frame).tolist() == expected
    assert streaming(KalmanLaePvt, lanes, item, frame).tolist() == expected
    part, inside, moved = lanes.chosen(np.array([False, True]), item)
    assert part.resized == {0: sizes}
    assert KalmanLaePvt.forecast_lanes(part, moved, frame[inside]).tolist() == expected[2:]


def test_lanes_of_any_order_of_lengths_do_not_mix() -> None:
    random = np.random.default_rng(1)
    lengths = [1, 7, 3, 7, 1, 12]
    offsets = np.cumsum([0, *lengths])
    frames = np.concatenate([np.arange(n) * 2 for n in lengths])
    boxes = random.uniform(10, 60, (offsets[-1], 4))
    states, place = filter_lanes(Lanes(offsets, frames, boxes, np.full((6, 2), np.inf)))
    assert sorted(place) == list(range(offsets[-1]))
    for low, high in pairwise(offsets):
        part = Lanes(
            np.array([0, high - low]), frames[low:high], boxes[low:high], np.full((1, 2), np.inf)
        )
        alone, in_order = filter_lanes(part)
        assert alone[in_order].tobytes() == states[place[low:high]].tobytes()


# -------------------------------------------------------------------------- its family, TunedKalman


class DenseFamily:
    """The family with its matrices written out, over any four numbers."""

    def __init__(self, position: Sequence[float], q: float, r: float, p0: float, decay: float):
        self.q, self.r, self.decay = q, r, decay
        self.frame = 0
        self.state = np.array([*position, 0, 0, 0, 0], float)
        self.covariance = p0 * np.eye(8)

    def transition(self, interval: int) -> np.ndarray:
        """Frame by frame the position gains the velocity, and the velocity decays."""
        reach = sum(self.decay**k for k in range(interval))
        keep = self.decay**interval
        return np.kron([[1, reach], [0, keep]], np.eye(4))

    def update(self, frame: int, position: Sequence[float]) -> None:
        interval = frame - self.frame
        f, h = self.transition(interval), np.eye(4, 8)
        self.state = f @ self.state
        self.covariance = f @ self.covariance @ f.T + self.q * interval**2 * np.eye(8)
        s = h @ self.covariance @ h.T + self.r * np.eye(4)
        k = self.covariance @ h.T @ np.linalg.inv(s)
        self.state = self.state + k @ (np.asarray(position, float) - h @ self.state)
        self.covariance = (np.eye(8) - k @ h) @ self.covariance
        self.frame = frame

    def predict(self, frame: int) -> np.ndarray:
        return (self.transition(frame - self.frame) @ self.state)[:4]


def centre_state(box: Sequence[float]) -> list[float]:
    x, y, w, h = box
    return [x + w / 2, y + h / 2, math.log(math.sqrt(w * h)), math.log(w / h)]


def box_of_centre_state(state: Sequence[float]) -> list[float]:
    cx, cy, scale, aspect = state
    w, h = (math.exp(min(max(scale + a / 2, -20), 20)) for a in (aspect, -aspect))
    return [cx - w / 2, cy - h / 2, w, h]


NUMBERS = st.fixed_dictionaries(
    {
        "q": st.sampled_from([0.0, 1e-3, 0.3, 1.0, 3, 100.0]),
        "r": st.floats(0.1, 100),
        "p0": st.sampled_from([0.0, 1.0, 100, 1e4]),  # 100: a whole number is one too,
        "decay": st.sampled_from([0.3, 0.9, 0.99, 0.999999, 1.0, 1]),
    }
)


@pytest.mark.parametrize("state", ["corner", "centre"])
@given(numbers=NUMBERS, data=st.data())
def test_the_family_agrees_with_dense_matrices(
    state: str, numbers: dict[str, float], data: st.DataObject
) -> None:
    boxes = st.tuples(*[st.floats(-1000, 3000)] * 2, *[st.floats(1, 900)] * 2)
    into, back = (list, list) if state == "corner" else (centre_state, box_of_centre_state)
    box = data.draw(boxes)
    ours = TunedKalman(**numbers, state=state)(box)
    dense = DenseFamily(into(box), **numbers)
    frame = 0
    for interval, measured in data.draw(st.lists(st.tuples(st.integers(1, 9), boxes), max_size=9)):
        frame += interval
        ours.update(frame, measured)
        dense.update(frame, into(measured))
        for ahead in (0, 1, 7):
            expected = back(dense.predict(frame + ahead).tolist())
            np.testing.assert_allclose(ours.predict(frame + ahead), expected, rtol=1e-8, atol=1e-6)


@given(case=lanes_and_queries())
def test_the_default_is_the_papers_filter_to_the_bit(case: Any) -> None:
    for answers in (forecast, streaming):
        assert answers(TunedKalman(), *case).tobytes() == answers(Kalman, *case).tobytes()


@pytest.mark.parametrize("state", ["corner", "centre"])
@given(numbers=NUMBERS, case=lanes_and_queries())
def test_the_family_streams_as_it_answers_for_lanes(
    state: str, numbers: dict[str, float], case: Any
) -> None:
    factory = TunedKalman(**numbers, state=state)
    found, expected = forecast(factory, *case), streaming(factory, *case)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_a_velocity_decays() -> None:
    # with p0 = 0 and q = 0 nothing is learnt; with r tiny the first step is taken as it is
    model = TunedKalman(r=1e-9, q=0, decay=0.5)([0, 0, 10, 10])
    model.update(1, [8, 0, 10, 10])  # gains: 1 and decay * b / a = 0.25
    assert [model.predict(1 + k)[0] for k in range(4)] == pytest.approx([8, 10, 11, 11.5])
    still = TunedKalman(q=0, p0=0)([0, 0, 10, 10])
    still.update(1, [8, 0, 10, 10])
    assert still.predict(5) == [0, 0, 10, 10]


@pytest.mark.parametrize("state", ["corner", "centre"])
@pytest.mark.parametrize("decay", [1e-9, 0.9, 1.0])
def test_a_forecast_for_long_after_is_finite(state: str, decay: float) -> None:
    factory = TunedKalman(decay=decay, state=state)
    lanes = one_lane([[0, 0, 10, 10], [500, 300, 90, 0]], [0, 1])
    case = lanes, np.array([1, 1]), np.array([10_000, 2**40])
    for answers in (forecast, streaming):
        assert np.isfinite(answers(factory, *case)).all()


@pytest.mark.parametrize(
    "wrong",
    [
        *({name: value} for name in ("q", "r", "p0") for value in (-1, math.nan, math.inf)),
        *({"decay": value} for value in (0, -0.1, 1.01, math.nan)),
        {"r": 0},
        {"state": "corners"},
        {"state": None},
    ],
    ids=str,
)
def test_a_filter_that_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(LaeError, match=r"^a Kalman filter"):
        TunedKalman(**wrong)
