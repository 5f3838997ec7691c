"""Metrics: values by hand for each convention, and curves that agree with the counts."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from witness import overlap, scores

from lae_sim.boxes import centre, iou
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import Evaluation, evaluate_runs
from lae_sim.evaluation.metrics import (
    CONVENTIONS,
    METRICS,
    PYSOT,
    _below,
    find_convention,
    frame_counts,
    precision_curve,
    success_curve,
)
from lae_sim.forecast.base import Hold
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

NONE = [math.nan] * 4
EVERY = pytest.mark.parametrize("name", CONVENTIONS)


def evaluated(truth: object, boxes: object, name: str, visible: object = None) -> Evaluation:
    """A tracker without latency: its scores are the offline ones."""
    recording = Recording.new("a", truth, boxes, np.zeros(len(boxes)), visible=visible)
    run = replay_sequence(recording, Clock.at(Fraction(30)))
    metadata = Metadata.new("30", "every-frame")
    return evaluate_runs([run], metadata, {"hold": Hold}, convention=CONVENTIONS[name])


def offline(truth: object, boxes: object, name: str, visible: object = None) -> dict[str, float]:
    found = evaluated(truth, boxes, name, visible)
    for metric in METRICS:  # without latency both are the same
        np.testing.assert_equal(found.scores[metric], found.offline[metric][None, :, None])
    return {metric: found.offline[metric].item() for metric in METRICS}


# truth, answer:                                          what is special about the frame
GOLDEN = [
    ([10, 10, 20, 20], [20, 10, 20, 20]),  # IoU 1/3, 10 px, normalised 0.5; OTB takes the truth
    ([10, 10, 20, 20], [10, 10, 20, 20]),  # perfect
    ([0, 0, 0, 0], [5, 5, 10, 10]),  # zeros; 14 px from the centre (-0.5, -0.5)
    (NONE, [5, 5, 10, 10]),
    ([-10, 10, 20, 20], [30, 10, 20, 20]),  # centre (-0.5, 19.5): not above 0; 40 px
    ([-5, 10, 20, 20], [-5, 10, 20, 20]),  # perfect, but x < 0
    ([100, 100, 20, 20], [121, 100, 20, 20]),  # 21 px
    ([100, 100, 20, 20], [120, 100, 20, 20]),  # 20 px exactly: a hit
]


@pytest.mark.parametrize(
    ("name", "auc", "dp20", "norm_dp20", "norm_auc"),
    [
        # IoU > t: 7 of the 21 thresholds for 1/3, 20 for 1; of 101 thresholds 34 and 100
        ("pysot", 47 / (21 * 8), 7 / 8, 5 / 8, 256 / (51 * 8)),
        ("elae", 27 / (21 * 8), 7 / 8, 5 / 8, 256 / (51 * 8)),
        # for precision, too, a truth with x < 0 is none: frames 0, 1 and four hits
        ("otb", 40 / (21 * 8), 7 / 8, 6 / 8, 306 / (51 * 8)),
        # as got10k, but the frame without truth is among those that are divided by
        ("lasot", 47 / (21 * 8), 5 / 8, 2 / 8, 103 / (51 * 8)),
        ("got10k", 47 / (21 * 7), 5 / 7, 2 / 7, 103 / (51 * 7)),
        ("got10k-101", 234 / (101 * 7), 5 / 7, 2 / 7, 103 / (51 * 7)),
        ("exclude", 47 / (21 * 6), 4 / 6, 2 / 6, 103 / (51 * 6)),
    ],
)
def test_golden_values(
    name: str, auc: float, dp20: float, norm_dp20: float, norm_auc: float
) -> None:
    truth, boxes = zip(*GOLDEN)
    expected = {"auc": auc, "dp20": dp20, "norm_dp20": norm_dp20, "norm_auc": norm_auc}
    assert offline(truth, boxes, name) == pytest.approx(expected, abs=1e-12)


def test_the_golden_values_reach_every_convention() -> None:
    known = {"pysot", "elae", "otb", "lasot", "got10k", "got10k-101", "exclude"}
    assert set(CONVENTIONS) == known


@EVERY
def test_a_perfect_tracker(name: str) -> None:
    random = np.random.default_rng(0)
    truth = random.uniform(1, 200, (500, 4))
    found = offline(truth, truth, name)
    assert found["auc"] == pytest.approx(100 / 101 if name == "got10k-101" else 20 / 21)
    assert found["dp20"] == found["norm_dp20"] == found["norm_auc"] == 1


@EVERY
def test_one_frame(name: str) -> None:
    found = offline([[10, 10, 20, 20]], [[10, 10, 20, 20]], name)
    assert found["auc"] == pytest.approx(100 / 101 if name == "got10k-101" else 20 / 21)


ZERO = [0.0] * 4


@EVERY
@pytest.mark.parametrize("truth", [[NONE] * 5, [[1, 2, 30, 40]] + [NONE] * 4,
                                   [[1, 2, 30, 40]] + [ZERO] * 4, [NONE], [ZERO]])  # fmt: skip
def test_no_score_without_a_truth(name: str, truth: list[list[float]]) -> None:
    """The truth of the first frame alone is but the initial box, as of a video."""
    boxes = [[1, 2, 30, 40]] * len(truth)
    assert all(math.isnan(value) for value in offline(truth, boxes, name).values())
    found = evaluated(truth, boxes, name)
    assert np.isnan(found.curves.success).all()
    assert np.isnan(found.curves.precision).all()
    assert found.replay.scored.tolist() == [False]
    assert found.failure.tolist() == [[[-1]]]


@EVERY
def test_one_truth_after_the_first_frame_is_enough(name: str) -> None:
    box = [100, 100, 30, 40]
    found = offline([box, NONE, box], [box] * 3, name)
    perfect = 100 / 101 if name == "got10k-101" else 20 / 21
    left_out = CONVENTIONS[name].leaves_out and name != "lasot"
    assert found["auc"] == pytest.approx(perfect if left_out else perfect * 2 / 3)
    assert found["dp20"] == (pytest.approx(2 / 3) if name == "lasot" else 1)


@pytest.mark.parametrize(
    ("truth", "dp20"),
    [([-3.0, 50, 40, 30], 1.0), ([0.0, 50, 40, 30], 1.0), ([50.0, -3, 40, 30], 1.0),
     ([50.0, 50, 0, 30], 1.0), (ZERO, 1.0), (NONE, 1.0), ([0.5, 50, 40, 30], 0.75)],
)  # fmt: skip
def test_otb_hits_any_truth_that_is_not_all_above_0(truth: list[float], dp20: float) -> None:
    box, far = [10.0, 50, 40, 30], [300.0, 50, 40, 30]
    assert offline([box, box, truth, box], [box, box, far, box], "otb")["dp20"] == dp20


LOST = [ZERO, [300.0, 50, 0, 30], [300.0, 50, 40, -1]]


@pytest.mark.parametrize("lost", LOST)
def test_otb_takes_the_answer_before_one_of_no_size(lost: list[float]) -> None:
    box = [10.0, 50, 40, 30]
    boxes = [box, box, lost, lost, box]
    assert offline([box] * 5, boxes, "otb")["auc"] == pytest.approx(20 / 21)
    assert offline([box] * 5, boxes, "otb")["dp20"] == 1
    assert offline([box] * 5, boxes, "pysot")["auc"] == pytest.approx(60 / 105)


def test_otb_takes_the_first_answer_as_it_was() -> None:
    """The toolkit replaces it by the truth after the answers that are none."""
    truth, first = [10.0, 50, 40, 30], [500.0, 50, 40, 30]
    found = offline([truth] * 3, [first, ZERO, truth], "otb")
    assert found["dp20"] == pytest.approx(2 / 3)
    assert offline([truth] * 3, [ZERO, ZERO, truth], "otb")["auc"] == pytest.approx(40 / 63)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_otb_takes_the_answer_before_one_that_is_not_finite(value: float) -> None:
    truth = np.tile([10.0, 50, 40, 30], (4, 1))
    answers = truth.copy()
    answers[2, 0] = value
    assert (success_curve(truth, answers, CONVENTIONS["otb"])[:20] == 1).all()
    assert (precision_curve(truth, answers, CONVENTIONS["otb"]) == 1).all()
    assert success_curve(truth, answers, PYSOT)[0] == 0.75


@pytest.mark.parametrize(
    ("name", "auc", "dp20"),
    [
        ("pysot", 10 / 21, 1.0),
        ("elae", 10 / 21, 1.0),
        ("otb", 10 / 21, 1.0),
        ("exclude", 20 / 21, 1.0),
        ("lasot", 10 / 21, 0.5),
        ("got10k", 10 / 21, 0.5),
        ("got10k-101", 50 / 101, 0.5),
    ],
)
def test_a_row_of_zeros_is_a_missing_truth_but_for_got10k(
    name: str, auc: float, dp20: float
) -> None:
    box = [90, 90, 20, 20]
    found = offline([[0, 0, 0, 0], box], [box, box], name)
    assert found["auc"] == pytest.approx(auc)
    assert found["dp20"] == dp20


# ------------------------------------------------------------------------------ absent targets

FLAGGED = [True] * 5 + [False] * 4 + [True]
MOVING = [[50.0, 40, 40, 30], [54.0, 42, 40, 30], [58.0, 44, 40, 30], [62.0, 46, 40, 30],
          *[[66.0, 48, 40, 30]] * 5, [86.0, 58, 40, 30]]  # fmt: skip


def test_lasot_leaves_absent_frames_out_and_divides_by_all() -> None:
    """Four of ten frames are absent, with stale boxes as their truth."""
    found = offline(MOVING, MOVING, "lasot", FLAGGED)
    assert found["auc"] == pytest.approx(0.6 * 20 / 21)
    assert found["dp20"] == found["norm_dp20"] == found["norm_auc"] == pytest.approx(0.6)
    assert round(found["auc"], 4) == 0.5714


@pytest.mark.parametrize("name", sorted(set(CONVENTIONS) - {"lasot"}))
def test_other_conventions_score_absent_frames(name: str) -> None:
    assert offline(MOVING, MOVING, name, FLAGGED) == offline(MOVING, MOVING, name)


def test_the_answer_for_an_absent_frame_does_not_matter_to_lasot() -> None:
    wrong = [[500.0, 400, 40, 30] if not v else box for v, box in zip(FLAGGED, MOVING)]
    assert offline(MOVING, wrong, "lasot", FLAGGED) == offline(MOVING, MOVING, "lasot", FLAGGED)
    assert evaluated(MOVING, wrong, "lasot", FLAGGED).failure.item() == len(MOVING)  # there is none
    assert evaluated(MOVING, wrong, "lasot").failure.item() == 5


def test_a_target_that_is_absent_from_frame_1_on_leaves_the_first_frame_to_lasot() -> None:
    found = offline(MOVING, MOVING, "lasot", [True] + [False] * 9)
    assert found["auc"] == pytest.approx(2 / 21)
    assert found["dp20"] == 0.1


def test_otb_drops_sequences_that_score_0_everywhere() -> None:
    truth, far = [[10.0, 10, 20, 20]] * 3, [[10.0, 10, 20, 20]] + [[900.0, 900, 20, 20]] * 2
    assert offline(truth, far, "otb")["auc"] == pytest.approx(20 / 63)  # frame 0 is the truth
    lost = offline([NONE] + truth, [[900.0, 900, 20, 20]] * 4, "otb")
    assert math.isnan(lost["auc"])
    assert lost["dp20"] == 0.25  # the frame without truth is a hit


def test_otb_drops_a_precision_curve_of_zeros_only_beyond_50_pixels() -> None:
    truth = [[100.0, 100, 20, 20]]
    near, far = [[150.0, 100, 20, 20]], [[151.0, 100, 20, 20]]
    counts = [frame_counts(np.array(truth), np.array(b), np.array([1]), CONVENTIONS["otb"])
              for b in (near, far)]  # fmt: skip
    assert [c.within50.item() for c in counts] == [1, 0]
    assert [c.dp.item() for c in counts] == [0, 0]


# ------------------------------------------------------------------------------ random boxes

QUARTERS = st.integers(-120, 800).map(lambda v: v / 4)
SIDES = st.integers(1, 400).map(lambda v: v / 4)
BOX = st.tuples(QUARTERS, QUARTERS, SIDES, SIDES).map(list)
TRUTH = st.one_of(BOX, BOX, st.just(None), st.just([0.0] * 4), st.just([5.0, 5.0, 0.0, 3.0]))


@st.composite
def tracked(draw: st.DrawFn) -> tuple[list[list[float] | None], list[list[float]]]:
    """Truth, and answers of which many are near it."""
    truth = draw(st.lists(TRUTH, min_size=1, max_size=20))
    shift = st.integers(-30, 30).map(lambda v: v / 4)
    answers = [
        [v + draw(shift) if i < 2 else max(v + draw(shift), 0.25) for i, v in enumerate(box)]
        if box is not None and draw(st.integers(0, 3))
        else draw(BOX)
        for box in truth
    ]
    for lost in draw(st.lists(st.integers(0, len(truth) - 1), max_size=3)):
        answers[lost] = draw(st.sampled_from(LOST))
    return truth, answers


def array(truth: list[list[float] | None]) -> np.ndarray:
    return np.array([NONE if box is None else box for box in truth])


@EVERY
@given(case=tracked(), data=st.data())
@settings(max_examples=30)
def test_metrics_agree_with_plain_loops_in_fractions(
    name: str, case: tuple, data: st.DataObject
) -> None:
    truth, answers = case
    flags = st.lists(st.booleans(), min_size=len(truth), max_size=len(truth))
    visible = data.draw(st.none() | flags)
    found = offline(array(truth), answers, name, visible)
    for metric, expected in scores(truth, answers, name, visible=visible).items():
        value = math.nan if expected is None else float(expected)
        assert found[metric] == pytest.approx(value, abs=1e-12, nan_ok=True)


@EVERY
@given(case=tracked())
@settings(max_examples=30)
def test_normalised_precision_agrees_with_a_plain_loop(name: str, case: tuple) -> None:
    truth, answers = case
    found = offline(array(truth), answers, name)
    errors: list[float] = []
    scored = any(true is not None and min(true[2:]) > 0 for true in truth[1:] or truth)
    for i, (true, answer) in enumerate(zip(truth, answers)):
        if name == "otb" and min(answer[2:]) <= 0:
            answers[i] = answer = answers[max(i - 1, 0)]
        valid = true is not None
        if name == "exclude":
            valid = valid and true[2] > 0 and true[3] > 0
        elif name == "otb":
            valid = valid and min(true) > 0
        if name in ("exclude", "got10k", "got10k-101"):
            if not valid:
                continue
        elif name == "lasot":
            if not valid:
                errors.append(math.inf)  # left out, but divided by
                continue
        elif not valid or true[0] + (true[2] - 1) / 2 <= 0 or true[1] + (true[3] - 1) / 2 <= 0:
            errors.append(-1.0)
            continue
        x, y, w, h = true if name == "otb" and i == 0 else answer
        if true[2] <= 0 or true[3] <= 0:
            errors.append(math.inf)
            continue
        dx = x + (w - 1) / 2 - (true[0] + (true[2] - 1) / 2)
        dy = y + (h - 1) / 2 - (true[1] + (true[3] - 1) / 2)
        errors.append(math.sqrt((dx / true[2]) ** 2 + (dy / true[3]) ** 2))
    if not errors or not scored:
        assert math.isnan(found["norm_dp20"])
        assert math.isnan(found["norm_auc"])
        return
    curve = [sum(e <= k / 100 for e in errors) / len(errors) for k in range(51)]
    if name == "otb" and not any(curve):
        assert math.isnan(found["norm_auc"])
        return
    assert found["norm_dp20"] == pytest.approx(curve[20], abs=1e-12)
    assert found["norm_auc"] == pytest.approx(sum(curve) / 51, abs=1e-12)


@EVERY
@given(case=tracked())
@settings(max_examples=30)
def test_the_curves_agree_with_the_scores(name: str, case: tuple) -> None:
    truth, answers = array(case[0]), np.array(case[1])
    visible = np.arange(len(truth)) % 3 < 2
    convention = CONVENTIONS[name]
    assume((truth[min(1, len(truth) - 1) :, 2:] > 0).all(axis=1).any())
    success = success_curve(truth, answers, convention, visible)
    precision = precision_curve(truth, answers, convention, visible)
    assert success.shape == convention.iou_thresholds.shape
    assert precision.shape == (51,)
    found = offline(truth, answers, name, visible)
    if not (convention.drops_zeros and not success.any()):
        assert success.mean() == pytest.approx(found["auc"], abs=1e-12)
    if not (convention.drops_zeros and not precision.any()):
        assert precision[20] == pytest.approx(found["dp20"], abs=1e-12)
    assert (np.diff(success) <= 0).all()
    assert (np.diff(precision) >= 0).all()


@EVERY
def test_the_curves_of_a_sequence_without_truth_need_no_warning(name: str) -> None:
    truth, answers = np.array([NONE] * 3), np.ones((3, 4))
    success = success_curve(truth, answers, CONVENTIONS[name])
    precision = precision_curve(truth, answers, CONVENTIONS[name])
    assert np.isnan(success).all()
    assert np.isnan(precision).all()


@given(BOX, BOX)
def test_iou_agrees_with_fractions(a: list[float], b: list[float]) -> None:
    exact = overlap([Fraction(v) for v in a], [Fraction(v) for v in b])
    assert iou(np.array([a]), np.array([b])).item() == float(exact)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ([0, 0, 0, 0], [0, 0, 0, 0]),
        ([0, 0, 0, 5], [0, 0, 0, 5]),
        ([0, 0, 5, 5], [5, 0, 5, 5]),  # they touch
        (NONE, [0, 0, 5, 5]),
        ([0, 0, 5, 5], NONE),
    ],
)
def test_iou_of_nothing_is_0(a: list[float], b: list[float]) -> None:
    assert iou(np.array([a], float), np.array([b], float)).tolist() == [0.0]


def test_the_centre_of_pysot() -> None:
    assert centre(np.array([[10.0, 20, 5, 6]])).tolist() == [[12, 22.5]]


@pytest.mark.parametrize("truth", [[-9.5, 10, 20, 20], [10, -9.5, 20, 20]])
def test_a_centre_of_0_is_not_above_0(truth: list[float]) -> None:
    far = [[500.0, 500, 20, 20]]
    assert offline([truth], far, "pysot")["dp20"] == 1  # invalid: a hit
    moved = [v + 0.125 if v < 0 else v for v in truth]
    assert offline([moved], far, "pysot")["dp20"] == 0


def test_a_normalised_error_of_0_20_is_a_hit() -> None:
    truth = [[100.0, 100, 20, 20]]
    assert offline(truth, [[104.0, 100, 20, 20]], "pysot")["norm_dp20"] == 1
    assert offline(truth, [[100.0, 104.125, 20, 20]], "pysot")["norm_dp20"] == 0


def test_thresholds_are_strict_for_success_and_not_for_precision() -> None:
    truth, half = np.array([[0.0, 0, 20, 20]]), np.array([[0.0, 0, 20, 10]])
    counts = frame_counts(truth, half, np.array([0]), PYSOT)
    assert counts.success.item() == 10  # 0, 0.05, ..., 0.45
    assert success_curve(truth, half, PYSOT).tolist() == [1.0] * 10 + [0.0] * 11


@EVERY
@pytest.mark.parametrize("side", [1e-9, 1e-200, 5e-324])
def test_a_truth_of_almost_no_size_is_a_miss_of_normalised_precision(
    name: str, side: float
) -> None:
    truth = [[100.0, 100, 20, 20], [100.0, 100, side, side]]
    found = offline(truth, [[100.0, 100, 20, 20], [100.0, 100, 20, 20]], name)
    assert found["norm_auc"] == found["norm_dp20"] == 0.5
    assert found["dp20"] == 1


def test_an_unknown_convention_is_refused() -> None:
    assert find_convention("pysot") is PYSOT
    with pytest.raises(LaeError, match="no convention 'voc': there are pysot, elae, otb"):
        find_convention("voc")


@pytest.mark.parametrize("steps", [20, 100])
def test_thresholds_are_counted_exactly(steps: int) -> None:
    """By arithmetic as by comparison with each, at every threshold and its neighbours too."""
    thresholds = np.arange(steps + 1) / steps
    near = [thresholds]
    for towards in (-1.0, 2.0):
        step = thresholds
        for _ in range(3):
            step = np.nextafter(step, towards)
            near.append(step)
    values = np.clip(np.concatenate([*near, np.random.default_rng(0).random(10_000)]), 0, 1)
    counted = (thresholds < values[:, None]).sum(axis=1)
    assert _below(values, steps).tolist() == counted.tolist()


@given(st.floats(0, 1), st.sampled_from([20, 100]))
def test_thresholds_below_a_value(value: float, steps: int) -> None:
    below = _below(np.array([value]), steps)
    assert below.tolist() == [sum(k / steps < value for k in range(steps + 1))]
