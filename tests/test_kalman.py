"""The paper's filter against filterpy and plain matrices, and the released code's additions."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from witness import DenseKalman, DenseLaePvt, FilterpyKalman

from lae_sim.forecast import Lanes
from lae_sim.kalman import PAPER, RESTART_IOU, Kalman, KalmanLaePvt, clip, filter_lanes

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
        _, velocity = filter_lanes(lanes, PAPER, RESTART_IOU)
        assert (velocity[1] == 0).all() == restarts
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


def test_lanes_of_any_order_of_lengths_do_not_mix() -> None:
    random = np.random.default_rng(1)
    lengths = [1, 7, 3, 7, 1, 12]
    offsets = np.cumsum([0, *lengths])
    frames = np.concatenate([np.arange(n) * 2 for n in lengths])
    boxes = random.uniform(10, 60, (offsets[-1], 4))
    together = filter_lanes(Lanes(offsets, frames, boxes, np.full((6, 2), np.inf)))
    for low, high in pairwise(offsets):
        part = Lanes(
            np.array([0, high - low]), frames[low:high], boxes[low:high], np.full((1, 2), np.inf)
        )
        alone = filter_lanes(part)
        for one, all_ in zip(alone, together):
            assert one.tobytes() == all_[low:high].tobytes()
