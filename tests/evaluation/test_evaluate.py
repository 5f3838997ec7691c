"""Evaluation of groups of sequences over many sigmas, against the witnesses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import (
    SIGMAS,
    DenseKalman,
    DenseLaePvt,
    event_driven,
    follow,
    moving,
    psi,
    schedule_latest,
    scores,
    worlds,
)

from lae_sim.boxes import iou
from lae_sim.engine.clock import Clock, parse_duration
from lae_sim.engine.policies import vot_realtime
from lae_sim.errors import LaeError
from lae_sim.evaluation.caveats import left_search, notes_on
from lae_sim.evaluation.evaluate import (
    Evaluation,
    ScoredRun,
    answers,
    evaluate_groups,
    evaluate_runs,
    evaluate_together,
)
from lae_sim.evaluation.metrics import (
    CONVENTIONS,
    METRICS,
    PYSOT,
    is_scored,
    precision_curve,
    success_curve,
)
from lae_sim.evaluation.pairing import pair
from lae_sim.forecast.base import ConstantVelocity, Hold
from lae_sim.forecast.kalman import Kalman, KalmanLaePvt
from lae_sim.replay.latency import LatencySource, by_frame, constant, initialised
from lae_sim.replay.run import Run, RunBatch, replay_sequence
from lae_sim.replay.search import SearchModel
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.trace.metadata import ImageSizes, Metadata
from lae_sim.trace.recording import Recording

CLOCK = Clock.at(Fraction(30))
EVERY = Metadata.new("30", "every-frame")
FORECASTERS = {
    "hold": Hold,
    "velocity": ConstantVelocity,
    "kalman": Kalman,
    "kalman-lae-pvt": KalmanLaePvt,
}


@st.composite
def groups(draw: st.DrawFn) -> tuple[Fraction, list[Recording]]:
    """Some sequences of one frame rate, with truth near the boxes.

    Of some frames the truth is missing, and of some the box has no size.
    """
    fps, elapsed, boxes = draw(worlds(20))
    shift = st.integers(-24, 24).map(lambda v: v / 4)
    group = [(elapsed, boxes)]
    for _ in range(draw(st.integers(0, 2))):
        _, elapsed, boxes = draw(worlds(12))
        group.append((elapsed, boxes))
    recordings = []
    for s, (elapsed, boxes) in enumerate(group):
        truth = np.array(boxes)
        truth[:, :2] += draw(shift)
        for i in draw(st.sets(st.integers(0, len(boxes) - 1), max_size=4)):
            truth[i] = draw(st.sampled_from([math.nan, 0.0]))
        for i in draw(st.sets(st.integers(0, len(boxes) - 1), max_size=4)):
            boxes[i] = draw(st.sampled_from([[0.0] * 4, [*boxes[i][:2], 9.0, -1.0]]))
        flags = st.lists(st.booleans(), min_size=len(boxes), max_size=len(boxes))
        visible = draw(st.none() | flags)
        recordings.append(Recording.new(f"s{s}", truth, boxes, elapsed, visible=visible))
    return fps, recordings


def plain_truth(recording: Recording) -> list[list[float] | None]:
    return [None if math.isnan(row[0]) else row for row in recording.truth.tolist()]


@given(groups(), SIGMAS, st.sampled_from(list(CONVENTIONS)))
@settings(max_examples=45)
def test_scores_agree_with_plain_loops_over_the_oracle(
    group: tuple[Fraction, list[Recording]], sigmas: list[Fraction], name: str
) -> None:
    fps, recordings = group
    clock = Clock.at(fps)
    runs = [replay_sequence(recording, clock) for recording in recordings]
    found = evaluate_runs(runs, EVERY, FORECASTERS, sigmas, CONVENTIONS[name])
    chosen = sorted({0, len(sigmas) // 2, len(sigmas) - 1})
    for s, (recording, run) in enumerate(zip(recordings, runs)):
        truth = plain_truth(recording)
        done = schedule_latest(fps, recording.elapsed_ns.tolist())
        for m in chosen:
            psis = psi(done, fps, len(recording), sigmas[m])
            for f, (forecaster, factory) in enumerate(FORECASTERS.items()):
                told = answers(run, EVERY, forecaster, factory, sigmas[m])
                assert told.source_frame.tolist() == psis
                if forecaster == "hold":
                    assert told.boxes.tolist() == recording.boxes[psis].tolist()
                    expected = scores(truth, told.boxes.tolist(), name, visible=recording.visible)
                else:
                    expected = scores(truth, told.boxes.tolist(), name, float, recording.visible)
                for metric, value in expected.items():
                    value = math.nan if value is None else float(value)
                    score = found.scores[metric][f, s, m]
                    assert score == pytest.approx(value, abs=1e-12, nan_ok=True)


def test_otb_takes_the_answer_before_at_each_permitted_latency() -> None:
    """That of frame 2 has no size. Where it answers, it is as the output before it that did."""
    truth = np.tile([10.0, 50, 40, 30], (8, 1))
    boxes = truth + np.array([[0], [4], [0], [8], [0], [2], [1], [3]]) * [1, 0, 0, 0]
    boxes[2] = boxes[5] = 0
    run = replay_sequence(Recording.new("a", truth, boxes, np.full(8, 40_000_000)), CLOCK)
    found = evaluate_runs([run], EVERY, FORECASTERS, SIGMA_GRID, CONVENTIONS["otb"])
    seen = set()
    for m, sigma in enumerate(SIGMA_GRID):
        told = answers(run, EVERY, "hold", Hold, sigma).boxes.tolist()
        expected = scores(truth.tolist(), told, "otb", float)["auc"]
        assert found.scores["auc"][0, 0, m] == pytest.approx(expected, abs=1e-12)
        seen.add(round(expected, 9))
        without = scores(truth.tolist(), told, "elae", float)["auc"]
        assert without < expected
    assert len(seen) > 2


@given(groups(), SIGMAS, st.sampled_from(list(CONVENTIONS)))
@settings(max_examples=20)
def test_curves_and_failures_agree_with_those_of_single_sequences(
    group: tuple[Fraction, list[Recording]], sigmas: list[Fraction], name: str
) -> None:
    fps, recordings = group
    convention = CONVENTIONS[name]
    runs = [replay_sequence(recording, Clock.at(fps)) for recording in recordings]
    found = evaluate_runs(runs, EVERY, FORECASTERS, sigmas, convention)
    for s, run in enumerate(runs):
        truth, visible = run.recording.truth, run.recording.visible
        valid = convention.valid_success(truth)
        if name == "lasot" and visible is not None:
            valid &= visible
        for f, (forecaster, factory) in enumerate(FORECASTERS.items()):
            for m, sigma in enumerate(sigmas):
                boxes = answers(run, EVERY, forecaster, factory, sigma).boxes
                boxes = boxes[convention.kept(boxes)]
                if convention.first_frame_is_truth:
                    boxes[0] = truth[0]
                overlaps = (iou(truth[i : i + 1], boxes[i : i + 1])[0] for i in range(len(run)))
                apart = [i for i, overlap in enumerate(overlaps) if valid[i] and overlap == 0]
                first = min(apart, default=len(run)) if is_scored(truth) else -1
                assert found.failure[f, s, m] == first
            boxes = answers(run, EVERY, forecaster, factory, sigmas[0]).boxes
            for curves, curve, metric in (
                (found.curves.success, success_curve, "auc"),
                (found.curves.precision, precision_curve, "dp20"),
            ):
                if math.isnan(found.scores[metric][f, s, 0]):
                    assert np.isnan(curves[f, s]).all()
                else:
                    expected = curve(truth, boxes, convention, visible)
                    np.testing.assert_array_equal(curves[f, s], expected)


@given(groups(), SIGMAS)
@settings(max_examples=40)
def test_kalman_answers_agree_with_dense_matrices(
    group: tuple[Fraction, list[Recording]], sigmas: list[Fraction]
) -> None:
    fps, recordings = group
    for recording in recordings:
        run = replay_sequence(recording, Clock.at(fps))
        done = schedule_latest(fps, recording.elapsed_ns.tolist())
        for sigma in sigmas[:3]:
            psis = psi(done, fps, len(recording), sigma)
            told = answers(run, EVERY, "kalman", Kalman, sigma)
            expected = follow(psis, recording.boxes, DenseKalman)
            np.testing.assert_allclose(told.boxes, expected, rtol=0, atol=1e-7)


@given(groups(), SIGMAS)
@settings(max_examples=30)
def test_evaluation_agrees_with_the_event_driven_world(
    group: tuple[Fraction, list[Recording]], sigmas: list[Fraction]
) -> None:
    fps, recordings = group
    runs = [replay_sequence(recording, Clock.at(fps)) for recording in recordings]
    found = evaluate_runs(runs, EVERY, {"kalman": Kalman}, sigmas)
    for s, recording in enumerate(recordings):
        processed, tellings = event_driven(
            fps, recording.elapsed_ns.tolist(), recording.boxes.tolist(), sigmas
        )
        assert found.replay.processed[s] == len(processed)
        lags = [[i - source for i, source in enumerate(told.psi)] for told in tellings]
        assert found.staleness.mismatch_sum[s].tolist() == [sum(lag) for lag in lags]
        assert found.staleness.mismatch_max[s].tolist() == [max(lag) for lag in lags]


@given(groups(), st.booleans())
@settings(max_examples=25)
def test_the_grid_is_its_sigmas_one_by_one_and_groups_are_their_sequences(
    group: tuple[Fraction, list[Recording]], scores_latency: bool
) -> None:
    fps, recordings = group
    runs = [replay_sequence(recording, Clock.at(fps)) for recording in recordings]
    runs = [
        replace(run, schedule=replace(run.schedule, scores_latency=scores_latency)) for run in runs
    ]
    sigmas = [Fraction(-1, 2), *SIGMA_GRID[::5], Fraction(4, 3)]
    together = evaluate_runs(runs, EVERY, FORECASTERS, sigmas)
    for s, run in enumerate(runs):
        for m, sigma in enumerate(sigmas):
            alone = evaluate_runs([run], EVERY, FORECASTERS, [sigma])
            for metric in METRICS:
                np.testing.assert_array_equal(
                    together.scores[metric][:, s, m], alone.scores[metric][:, 0, 0]
                )
            assert together.staleness.mismatch_sum[s, m] == alone.staleness.mismatch_sum[0, 0]
            assert together.staleness.longest_hold[s, m] == alone.staleness.longest_hold[0, 0]


def test_streaming_and_lane_forecasters_score_the_same() -> None:
    runs = [replay_sequence(moving(60, seed, f"s{seed}"), CLOCK) for seed in range(4)]
    lanes = evaluate_runs(runs, EVERY, FORECASTERS, SIGMA_GRID)
    streaming = {
        name: lambda box, size, factory=factory: factory(box, size)
        for name, factory in FORECASTERS.items()
    }
    found = evaluate_runs(runs, EVERY, streaming, SIGMA_GRID)
    for metric in METRICS:
        assert found.scores[metric].tobytes() == lanes.scores[metric].tobytes()


def test_kalman_lae_pvt_agrees_with_matrices_through_answers() -> None:
    from collections import Counter

    DenseLaePvt.hits = Counter()
    size = (260, 190)
    metadata = Metadata.new("30", "every-frame", sequences={"a": {"image_size": list(size)}})
    for seed in range(6):
        recording = moving(150, seed)
        run = replay_sequence(recording, CLOCK, constant(ns=90_000_000))
        for sigma in (Fraction(0), Fraction(1, 2), Fraction(-1)):
            told = answers(run, metadata, "kalman-lae-pvt", KalmanLaePvt, sigma)
            expected = follow(
                told.source_frame.tolist(),
                recording.boxes,
                lambda box: DenseLaePvt(box, size),
            )
            np.testing.assert_allclose(told.boxes, expected, rtol=0, atol=1e-7)
    assert DenseLaePvt.hits["clipped"] > 100
    assert DenseLaePvt.hits["update"] > 100


@pytest.mark.parametrize("dropped", [0, 3])
def test_forecasts_are_clipped_to_images_that_change_size(dropped: int) -> None:
    times = (np.arange(30) + dropped * (np.arange(30) > 9)) * 10**9 // 30
    arrival_ns = times if dropped else None
    boxes = np.array([[100.0 + 8 * i, 40, 40, 30] for i in range(30)])
    other, recording = (
        Recording.new(name, boxes, boxes, np.full(30, 90_000_000), arrival_ns=arrival_ns)
        for name in "ab"
    )
    sizes = ImageSizes((0, 12, 20), ((640, 360), (250, 90), (640, 360)))
    metadata = Metadata.new("30", "every-frame", sequences={"b": sizes.entry()})
    runs = [replay_sequence(each, CLOCK) for each in (other, recording)]
    freely, clipped = (answers(run, metadata, "kalman-lae-pvt", KalmanLaePvt).boxes for run in runs)
    inside = slice(12, 20)
    expected = freely.copy()
    expected[inside, 2] = np.minimum(freely[inside, 0] + freely[inside, 2], 250) - freely[inside, 0]
    kept = expected[:, 2] > 3  # where too little is left, the raw box answers
    assert kept[:12].all()
    assert (expected[inside][kept[inside], 2] < freely[inside][kept[inside], 2]).any()
    np.testing.assert_allclose(clipped[kept], expected[kept], atol=1e-9)
    forecasters = {"kalman-lae-pvt": KalmanLaePvt}
    found = evaluate_runs(runs, metadata, forecasters)
    notes = notes_on(found.replay, metadata, PYSOT, forecasters)
    assert any("images of 1 of 2 sequences change size, such as those of 'b'" in n for n in notes)


def test_the_initial_box_answers_until_the_first_output_is_fed() -> None:
    # DESIGN 4: while psi(i) = 0 the answer is the initial box, even where it leaves the image
    boxes = np.tile([-10.3, 20.1, 40.7, 30.9], (9, 1))
    recording = Recording.new("a", boxes, boxes, [10**9] * 9)
    metadata = Metadata.new("30", "every-frame", sequences={"a": {"image_size": [640, 360]}})
    run = replay_sequence(recording, CLOCK)
    for name in ("hold", "velocity", "kalman"):
        told = answers(run, metadata, name, FORECASTERS[name])
        assert told.boxes.tolist() == boxes.tolist()


# ----------------------------------------------------------------------------- what else it says


def test_counts_by_hand() -> None:
    # 25 frames/s; 0 is ready at 100 ms, then frame 2 at 140, 3 at 160, and 4 starts at 160
    times = [100_000_000, 1, 40_000_000, 20_000_000, 0]
    recording = Recording.new("a", np.ones((5, 4)), np.ones((5, 4)), times)
    run = replay_sequence(recording, Clock.at(Fraction(25)))
    assert run.schedule.frames.tolist() == [0, 2, 3, 4]
    found = evaluate_runs([run], EVERY, {"hold": Hold}, [Fraction(0), Fraction(1, 2)])
    assert found.replay.sequences == ("a",)
    assert found.replay.frames.tolist() == [5]
    assert found.replay.processed.tolist() == [4]
    assert found.replay.departures.tolist() == [1]
    assert found.replay.init_ns.tolist() == [100_000_000]
    assert found.replay.calls_ns.tolist() == [60_000_000]
    assert found.replay.calls_hz.tolist() == [np.inf]  # a call took 0 ns
    # sigma 0: psi = 0 0 0 0 4; sigma 1/2: queries at 20, 60, 100, 140, 180: psi = 0 0 0 2 4
    assert found.staleness.mismatch_sum.tolist() == [[6, 4]]
    assert found.staleness.mismatch_max.tolist() == [[3, 2]]
    assert found.staleness.longest_hold.tolist() == [[4, 3]]


def test_offline_scores_need_every_frame() -> None:
    full = moving(40)
    run = replay_sequence(full, CLOCK)
    sparse = Recording.of_run("b", run.schedule, run.boxes, full.truth)
    found = evaluate_runs([run, replay_sequence(sparse, CLOCK)], EVERY, {"hold": Hold})
    for metric in METRICS:
        assert np.isnan(found.offline[metric]).tolist() == [False, True]
        assert found.scores[metric][0, 0, 0] == found.scores[metric][0, 1, 0]


def test_joined_is_the_evaluation_of_all() -> None:
    runs = [replay_sequence(moving(20 + seed, seed, f"s{seed}"), CLOCK) for seed in range(5)]

    def of(some: list[Run]) -> Evaluation:
        return evaluate_runs(some, EVERY, FORECASTERS, SIGMA_GRID)

    whole = of(runs)
    joined = Evaluation.joined([of(runs[a:b]) for a, b in pairwise([0, 2, 3, 5])])
    assert joined.replay.sequences == whole.replay.sequences
    for field in ("frames", "processed", "departures", "init_ns", "calls_ns", "calls_hz"):
        assert getattr(joined.replay, field).tolist() == getattr(whole.replay, field).tolist()
    for field in ("mismatch_sum", "mismatch_max", "longest_hold"):
        both = getattr(joined.staleness, field), getattr(whole.staleness, field)
        assert both[0].tolist() == both[1].tolist()
    for metric in METRICS:
        assert joined.scores[metric].tobytes() == whole.scores[metric].tobytes()
        assert joined.offline[metric].tobytes() == whole.offline[metric].tobytes()


COSTS = {"kalman": 15_000_000}


@pytest.mark.parametrize("frames", [1, 60, 10**6])
def test_observers_see_what_is_scored(frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lae_sim.evaluation.evaluate._PART", 40)  # outputs: a sequence or two
    runs = [replay_sequence(moving(20 + 9 * seed, seed, f"s{seed}"), CLOCK) for seed in range(5)]
    sigmas = [Fraction(-1, 3), Fraction(0), Fraction(3, 4)]
    observed = [(name, sigma) for name in ("kalman", "hold") for sigma in (sigmas[2], sigmas[0])]
    seen: list[ScoredRun] = []
    more = {"frames": frames, "observers": [seen.append], "observed": observed}
    parts = evaluate_groups(runs, EVERY, FORECASTERS, sigmas, costs=COSTS, **more)  # type: ignore[arg-type]
    found = Evaluation.joined(list(parts))
    assert [scored.run.recording for scored in seen] == [run.recording for run in runs]
    for s, (run, scored) in enumerate(zip(runs, seen)):
        assert set(scored.answers) == set(observed)
        for (name, sigma), one in scored.answers.items():
            cost = COSTS.get(name, 0)
            separate = answers(run, EVERY, name, FORECASTERS[name], sigma, cost)
            assert one.boxes.tobytes() == separate.boxes.tobytes()
            assert one.source_frame.tolist() == separate.source_frame.tolist()
            score = success_curve(run.recording.truth, one.boxes, PYSOT).mean()
            f, m = list(FORECASTERS).index(name), sigmas.index(sigma)
            assert found.scores["auc"][f, s, m] == pytest.approx(score)
        for sigma in sigmas:
            for cost in (0, *COSTS.values()):
                chosen, alone = scored.pairing(sigma, cost), pair([run.schedule], [sigma], cost)
                for field in ("lengths", "offsets", "frames", "first", "end"):
                    assert getattr(chosen, field).tolist() == getattr(alone, field).tolist()
                for field in ("mismatch_sum", "mismatch_max", "longest_hold"):
                    assert getattr(chosen, field).tolist() == getattr(alone, field).tolist()


@pytest.mark.parametrize("frames", [1, 200, 800, 10**6])
def test_replays_that_are_scored_together_have_the_scores_that_they_have_alone(frames: int) -> None:
    def replayed(seed: int, fps: Fraction, reach: float) -> list[Run]:
        search = SearchModel(np.array([reach]), True, "given")
        return [
            replay_sequence(moving(20 + 9 * s, seed + s, f"s{s}"), Clock.at(fps), search=search)
            for s in range(4)
        ]

    rates = [Fraction(30), Fraction(30), Fraction(25), Fraction(30)]
    replays = [replayed(10 * k, fps, 0.3 + k) for k, fps in enumerate(rates)]
    of = [Metadata.new("30", "every-frame", dataset={"name": str(k)}) for k in range(4)]
    sigmas = [Fraction(0), Fraction(3, 4)]
    more = {"costs": COSTS, "frames": frames}
    runs = (
        (k, RunBatch.of(some[a:b])) for k, some in enumerate(replays) for a, b in ((0, 1), (1, 4))
    )
    together = evaluate_together(runs, of, FORECASTERS, sigmas, **more)  # type: ignore[arg-type]
    alone = [
        (k, part)
        for k, some in enumerate(replays)
        for part in evaluate_groups(some, of[k], FORECASTERS, sigmas, **more)  # type: ignore[arg-type]
    ]
    assert [(k, _contents(part)) for k, part in together] == [(k, _contents(p)) for k, p in alone]
    assert len(alone) == {1: 16, 200: 8}.get(frames, 4)


def _contents(record: object) -> object:
    """All that is in records of records, arrays to the byte."""
    if isinstance(record, np.ndarray):
        return record.dtype, record.shape, record.tobytes()
    if isinstance(record, Mapping):
        return {name: _contents(value) for name, value in record.items()}
    if is_dataclass(record):
        return [_contents(getattr(record, field.name)) for field in fields(record)]
    return record


def test_curves_are_at_the_sigma_that_is_asked_for() -> None:
    runs = [replay_sequence(moving(30, seed, f"s{seed}"), CLOCK) for seed in range(3)]
    sigmas = [Fraction(0), Fraction(1, 2), Fraction(1)]
    for sigma in sigmas:
        (part,) = evaluate_groups(runs, EVERY, FORECASTERS, sigmas, curves_at=sigma)
        only = evaluate_runs(runs, EVERY, FORECASTERS, [sigma])
        assert part.curves.success.tobytes() == only.curves.success.tobytes()
        assert part.curves.precision.tobytes() == only.curves.precision.tobytes()
    first = evaluate_runs(runs, EVERY, FORECASTERS, sigmas).curves.success
    assert first.tobytes() == evaluate_runs(runs, EVERY, FORECASTERS).curves.success.tobytes()


def test_nothing_to_evaluate_is_said() -> None:
    with pytest.raises(LaeError, match="no sequences"):
        evaluate_runs([], EVERY, FORECASTERS)
    with pytest.raises(LaeError, match="at least one forecaster"):
        evaluate_runs([replay_sequence(moving(9), CLOCK)], EVERY, {})


def test_chosen_sequences_keep_their_statistics() -> None:
    runs = [replay_sequence(moving(20 + seed, seed, f"s{seed}"), CLOCK) for seed in range(5)]
    replay = evaluate_runs(runs, EVERY, {"hold": Hold}).replay
    some = replay.chosen(np.array([3, 1]))
    assert some.sequences == ("s3", "s1")
    assert some.frames.tolist() == [23, 21]
    assert some.calls_ns.tolist() == replay.calls_ns[[3, 1]].tolist()


def test_vot_scores_each_output_at_its_own_frame() -> None:
    recording = moving(50, elapsed=10_000_000)
    run = replay_sequence(recording, CLOCK, policy=vot_realtime())
    found = evaluate_runs([run], EVERY, {"hold": Hold})
    for metric in METRICS:
        assert found.scores[metric].item() == found.offline[metric].item()
    assert found.staleness.mismatch_sum.item() == 0


def test_a_forecaster_that_answers_nonsense_is_named() -> None:
    class Nonsense(ConstantVelocity):
        def predict(self, frame: int) -> list[float]:
            return [math.nan] * 4

    def factory(box: list[float], size: object) -> Nonsense:
        return Nonsense(box)

    with pytest.raises(LaeError, match="mine: predicted"):
        evaluate_runs([replay_sequence(moving(9), CLOCK)], EVERY, {"mine": factory})


@pytest.mark.parametrize("size", [1e-300, 1e-9, 1e9])
def test_tiny_and_huge_boxes_are_scored_without_a_warning(size: float) -> None:
    boxes = moving(30).boxes * size
    recording = Recording.new("a", boxes, boxes[::-1], [40_000_000] * 30)
    metadata = Metadata.new("30", "every-frame", sequences={"a": {"image_size": [640, 360]}})
    found = evaluate_runs([replay_sequence(recording, CLOCK)], metadata, FORECASTERS, SIGMA_GRID)
    for metric in METRICS:
        assert ((found.scores[metric] >= 0) & (found.scores[metric] <= 1)).all()


# ------------------------------------------------- targets that leave during the initialisation


def leaving(name: str, *, speed: float, size: float = 10.0, at: int = 0) -> Recording:
    """A square target that moves by so many pixels a frame from a frame on."""
    x = speed * np.maximum(np.arange(40) - at, 0.0)
    boxes = np.stack([x, np.zeros(40), *np.full((2, 40), size)], axis=1)
    return Recording.new(name, boxes, boxes, np.full(40, 10**7))


def left(init: str, *recordings: Recording, source: LatencySource = by_frame) -> list[str]:
    timed = initialised(source, parse_duration(init))
    runs = [replay_sequence(each, CLOCK, timed) for each in recordings]
    return left_search(evaluate_runs(runs, EVERY, {"hold": Hold}).replay)


def test_the_target_has_left_once_it_is_a_search_regions_half_side_away() -> None:
    # a = sqrt((10 + 10)(10 + 10)) = 20 px: at 2 px a frame, frame 10 is the first beyond reach
    steady, large = leaving("steady", speed=2), leaving("large", speed=2, size=20)
    assert left("320ms", steady, large) == []
    assert left("333333333ns", steady, large) == []  # frame 9 is still the latest
    assert left("333333334ns", steady, large) == ["steady"]
    assert left("700ms", steady, large) == ["steady", "large"]


def test_who_misses_no_frame_or_sees_no_other_loses_nobody() -> None:
    fast = leaving("fast", speed=100)
    assert left("30ms", fast) == []  # frame 1 is next, however fast the target is
    assert left("34ms", fast) == []
    assert left("67ms", fast) == ["fast"]
    assert left("100s", fast) == []
    assert left("1s", leaving("late", speed=100, at=30)) == []
    assert left("1s", leaving("late", speed=100, at=29)) == ["late"]


def test_where_there_is_no_truth_nothing_is_known_to_have_left() -> None:
    unseen, sizeless = leaving("unseen", speed=9), leaving("sizeless", speed=9, size=0)
    truth = unseen.truth.copy()
    truth[30] = np.nan
    unseen = replace(unseen, truth=truth)
    assert left("1s", unseen, sizeless) == []
    assert left("900ms", unseen, sizeless) == ["unseen"]


def test_each_sequence_whose_target_leaves_is_named() -> None:
    recordings = [leaving(f"s{speed}", speed=speed) for speed in range(4)]
    runs = [replay_sequence(each, CLOCK, initialised(by_frame, 10**9)) for each in recordings]
    found = evaluate_runs(runs, EVERY, {"hold": Hold}).replay
    [note] = notes_on(found, EVERY, PYSOT, {"hold": Hold})
    assert "initialisation (1,000 ms) ends so late in 3 of 4 sequences" in note
    assert note.endswith(": s1, s2, s3")


def test_sequences_of_which_nothing_but_the_first_frame_is_processed_are_told() -> None:
    long = leaving("long", speed=0)
    short = replace(
        long,
        name="short",
        **{name: getattr(long, name)[:20] for name in ("truth", "boxes", "elapsed_ns", "score")},
    )
    runs = [replay_sequence(each, CLOCK, initialised(by_frame, 10**9)) for each in (long, short)]
    found = evaluate_runs(runs, EVERY, {"hold": Hold}).replay
    [note] = notes_on(found, EVERY, PYSOT, {"hold": Hold})
    assert "after the initialisation (1,000 ms) is processed in 1 of 2 sequences" in note
    assert note.endswith("such as 'short'")


def test_what_was_recorded_with_a_pre_forecaster_is_said_to_have_no_model() -> None:
    schedule = {"pre_forecaster": "kalman"}
    searched = Metadata.new("30", "every-frame", schedule=schedule)
    for latency, told in ((constant("10ms"), []), (constant("47ms"), ["'kalman'"])):
        runs = [replay_sequence(leaving("a", speed=0), CLOCK, latency)]
        found = evaluate_runs(runs, searched, {"hold": Hold}).replay
        notes = notes_on(found, searched, PYSOT, {"hold": Hold})
        assert [note.split(",")[0].split()[-1] for note in notes] == told


def flagged(name: str, absent: int | None) -> Recording:
    still = leaving(name, speed=0)
    visible = None if absent is None else np.arange(len(still)) >= absent
    return replace(still, visible=visible)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_scored_frames_of_an_absent_target_are_said(name: str) -> None:
    group = [flagged("a", 7), flagged("b", None), flagged("c", 0), flagged("d", 2)]
    group[3] = replace(group[3], truth=group[3].truth.copy())
    group[3].truth[0] = np.nan  # no truth, and nothing to score
    runs = [replay_sequence(each, CLOCK) for each in group]
    found = evaluate_runs(runs, EVERY, {"hold": Hold}).replay
    notes = [n for n in notes_on(found, EVERY, CONVENTIONS[name], {"hold": Hold}) if "absent" in n]
    if name == "lasot":
        assert notes == [
            "nothing says in 1 of 4 sequences where the target is absent: lasot counts every frame "
            "with a truth there"
        ]
        return
    assert notes == [
        f"8 frames in 2 of 4 sequences are scored by {name} although their target is said to be "
        "absent; --convention lasot leaves them out"
    ]


def test_lasot_says_where_no_sequence_has_flags() -> None:
    def notes(*recordings: Recording) -> list[str]:
        runs = [replay_sequence(each, CLOCK) for each in recordings]
        found = evaluate_runs(runs, EVERY, {"hold": Hold}).replay
        return notes_on(found, EVERY, CONVENTIONS["lasot"], {"hold": Hold})

    assert notes(flagged("a", None)) == [
        "nothing says where the target is absent: lasot counts every frame with a truth there"
    ]
    assert notes(flagged("a", 3), flagged("b", 0)) == []


def test_modelled_scores_leave_absent_frames_out_too() -> None:
    """Where a lost tracker's answers are off in those frames alone, nothing is lost."""
    still = leaving("a", speed=0)
    visible = np.arange(len(still)) < len(still) // 2
    truth = still.truth.copy()
    truth[~visible, 0] += 5000
    recording = replace(still, truth=truth, boxes=truth.copy(), visible=visible)
    search = SearchModel(np.ones(3), known=True, source="given")
    run = replay_sequence(recording, CLOCK, constant("60ms"), search=search)
    assert run.modelled is not None
    found = evaluate_runs([run], EVERY, {"hold": Hold}, convention=CONVENTIONS["lasot"])
    assert found.modelled.mean["dp20"].item() == found.scores["dp20"].item() == 0.5
    assert evaluate_runs([run], EVERY, {"hold": Hold}).modelled.mean["dp20"].item() < 0.6
