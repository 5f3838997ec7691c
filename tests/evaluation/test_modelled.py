"""Scores under the search model: means, intervals, and what leaves them null."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from places import SHARED, TRACES

import lae_sim
from lae_sim.evaluation.evaluate import Evaluation, evaluate_groups, evaluate_runs
from lae_sim.evaluation.metrics import PYSOT
from lae_sim.evaluation.modelled import MODELLED, UNEXPLAINED, Ranking, over_sigmas
from lae_sim.evaluation.totals import ModelledTotals
from lae_sim.forecast.base import Hold
from lae_sim.forecast.kalman import Kalman
from lae_sim.replay.reach import Reach
from lae_sim.replay.run import Runs
from lae_sim.replay.search import Outcomes, SearchModel
from lae_sim.replay.world import SIGMA_GRID, World

SLOW = TRACES / "synthetic-slow.parquet"
FORECASTERS = {"hold": Hold, "kalman": Kalman}
REACH = Reach(0.3, 0.05, 0.01, 0.01, 1000)
MEASURED = SearchModel(REACH.quantiles(40), True, "drawn")


def runs_of(search, latency="constant:100ms,init=500ms"):
    return World.of(latency=latency, search=search).replay(SLOW)


def evaluated(runs, sigmas=(Fraction(0),), **options):
    return evaluate_runs(runs, runs.trace.metadata, FORECASTERS, sigmas, **options)


def draws_one_by_one(runs: Runs, metric: str) -> np.ndarray:
    """Scores of hold and kalman for each of the reaches, as runs of recorded boxes: [40, F, S]."""
    scores = []
    for reach in MEASURED.reaches:
        fixed = SearchModel(np.array([reach]), True, "one")
        replaced = [
            replace(run, boxes=run.modelled.boxes[0], modelled=None) if run.modelled else run
            for run in replace(runs, search=fixed)
        ]
        found = evaluate_runs(replaced, runs.trace.metadata, FORECASTERS)
        scores.append(found.scores[metric][:, :, 0])
    return np.array(scores)


def test_the_mean_is_that_of_the_draws_and_the_interval_holds_95_percent_of_them():
    runs = replace(runs_of("off"), search=MEASURED)
    found = evaluated(runs).modelled
    assert found.applies.all()
    assert found.known
    for metric in MODELLED:
        draws = draws_one_by_one(runs, metric)
        assert np.allclose(found.mean[metric][:, :, 0], draws.mean(axis=0), atol=1e-12)
        low, high = (each[metric][:, :, 0] for each in (found.low, found.high))
        ranked = np.sort(draws, axis=0)
        # of 40 draws, one lies beyond 2.5 % on either side
        assert np.allclose(low, np.maximum(ranked[0] - UNEXPLAINED[metric], 0))
        assert np.allclose(high, np.minimum(ranked[38] + UNEXPLAINED[metric], 1)) or np.allclose(
            high, np.minimum(ranked[39] + UNEXPLAINED[metric], 1)
        )
        assert np.ptp(draws, axis=0).max() > 0.05  # or nothing was asked


def test_a_datasets_interval_is_that_of_independent_sequences():
    result = lae_sim.evaluate(SLOW, latency="constant:100ms,init=500ms", search="off")
    (part,) = result.parts
    scenario = replace(part.scenario, runs=replace(part.scenario.runs, search=MEASURED))
    report = scenario.evaluate().document(per_sequence=True)
    runs = replace(runs_of("off"), search=MEASURED)
    draws = draws_one_by_one(runs, "auc")
    random = np.random.default_rng(1)
    for f, row in enumerate(report["results"]):
        modelled = row["modelled"]
        sequences = [each["modelled"] for each in row["per_sequence"]]
        assert modelled["auc"] == pytest.approx(np.mean([each["auc"] for each in sequences]))
        assert modelled["auc_low"] < modelled["auc"] < modelled["auc_high"]
        widths = [each["auc_high"] - each["auc_low"] for each in sequences]
        assert modelled["auc_high"] - modelled["auc_low"] < np.mean(widths)
        drawn = [
            np.mean([draws[random.integers(40), f, s] for s in range(draws.shape[2])])
            for _ in range(4000)
        ]
        rest = UNEXPLAINED["auc"] / np.sqrt(draws.shape[2])
        expected = np.quantile(drawn, [0.025, 0.975]) + [-rest, rest]
        assert [modelled["auc_low"], modelled["auc_high"]] == pytest.approx(expected, abs=0.01)


def test_where_the_reach_is_unknown_the_ends_and_the_middle_are_three_figures():
    latency = "constant:100ms,init=500ms"

    def modelled(search):
        document = lae_sim.evaluate(SLOW, latency=latency, search=search).document(
            per_sequence=True
        )
        (trace,) = document["traces"]
        return trace["search"], trace["results"]

    about, unknown = modelled("c=0.1-0.7")
    assert not about["c_known"]
    fixed = [modelled(f"c={c}")[1] for c in ("0.1", "0.4", "0.7")]
    for f, row in enumerate(unknown):
        for metric in MODELLED:
            three = [each[f]["modelled"][metric] for each in fixed]
            found = [row["modelled"][f"{metric}{end}"] for end in ("", "_low", "_high")]
            assert found == pytest.approx([three[1], min(three), max(three)])
        assert row["modelled"]["c_known"] is False
        assert fixed[0][f]["modelled"]["c_known"] is True


def test_an_exact_replay_is_not_modelled():
    (trace,) = lae_sim.evaluate(SLOW, latency="constant:1ms").document(per_sequence=True)["traces"]
    assert trace["exact"]
    assert trace["search"] is None
    for row in trace["results"]:
        assert row["modelled"] is None
        assert all(each["modelled"] is None for each in row["per_sequence"])


def test_sequences_that_are_exact_keep_their_scores_in_the_modelled_mean():
    runs = list(replace(runs_of("off"), search=MEASURED))
    runs[:3] = [replace(run, modelled=None) for run in runs[:3]]
    metadata = lae_sim.read_trace(SLOW).metadata
    found = evaluate_runs(runs, metadata, FORECASTERS)
    assert found.modelled.applies.tolist() == [False] * 3 + [True] * (len(runs) - 3)
    for metric in MODELLED:
        for values in (found.modelled.mean, found.modelled.low, found.modelled.high):
            assert np.array_equal(values[metric][:, :3], found.scores[metric][:, :3])


def test_groups_of_sequences_change_nothing():
    runs = replace(runs_of("off"), search=MEASURED)
    sigmas = SIGMA_GRID[::10]
    whole = evaluated(runs, sigmas)
    parts = evaluate_groups(runs, runs.trace.metadata, FORECASTERS, sigmas, frames=1)
    joined = Evaluation.joined(list(parts))
    for metric in MODELLED:
        for name in ("mean", "low", "high"):
            here, there = (getattr(e.modelled, name)[metric] for e in (whole, joined))
            assert np.array_equal(here, there), (metric, name)
        assert np.allclose(whole.modelled.draws[metric], joined.modelled.draws[metric])


def test_an_outcome_in_which_a_sequence_leaves_the_mean_has_no_weight():
    """By some conventions a sequence that scores 0 everywhere leaves the mean."""
    run = next(iter(runs_of("c=0.2")))
    far = np.full_like(run.boxes, 5000.0)  # nowhere near, at the first frame too
    outcomes = Outcomes((run.boxes, far), np.array([0.0, 1.0]), np.array([[0.3, 0.7]]), True)
    metadata, dropping = lae_sim.read_trace(SLOW).metadata, replace(PYSOT, drops_zeros=True)
    found = evaluate_runs(
        [replace(run, modelled=outcomes)], metadata, {"hold": Hold}, convention=dropping
    )
    assert np.isfinite(found.modelled.mean["auc"]).all()
    assert found.modelled.mean["auc"][0, 0, 0] == pytest.approx(found.scores["auc"][0, 0, 0])


def test_the_model_changes_nothing_of_what_was_recorded():
    plain, modelled = (evaluated(runs_of(search)) for search in ("off", "c=0.2"))
    for metric, scores in plain.scores.items():
        assert np.array_equal(scores, modelled.scores[metric])
    assert plain.modelled.known is None
    everywhere = evaluated(runs_of("c=inf")).modelled
    for metric in MODELLED:
        assert np.array_equal(everywhere.mean[metric], plain.scores[metric])


@pytest.mark.skipif(not SHARED.exists(), reason="the real data is not beside the checkout")
@pytest.mark.parametrize(
    ("tracker", "world", "forecaster", "expected"),
    [
        ("SiamAPN", {"latency": "constant:47ms,init=400ms", "search": "c=0.85"}, "hold",
         (0.299, 0.397)),
        ("SiamAPN", {"latency": "constant:47ms,init=400ms", "search": "c=0.85"}, "kalman",
         (0.361, 0.499)),
        ("NanoTrackV3", {"latency": "constant:167ms,init=500ms", "search": "c=0.7"}, "hold",
         (0.142, 0.188)),
        ("NanoTrackV3", {"latency": "constant:167ms,init=500ms", "search": "c=0.7",
                         "pre_forecaster": "kalman", "keep_size": True}, "kalman", (0.201, 0.267)),
    ],
)  # fmt: skip
def test_the_figures_of_the_prototype(tracker, world, forecaster, expected, tmp_path):
    boxes = SHARED / f"data/results_boxes/DTB70/{tracker}.npz"
    trace = lae_sim.convert_results(boxes, SHARED / "data/DTB70", time="constant:47ms")[0]
    result = lae_sim.evaluate(trace, forecasters=forecaster, **world).summary
    row = result[result.forecaster == forecaster].iloc[0]
    assert (row.modelled_auc, row.modelled_dp20) == pytest.approx(expected, abs=0.0006)


KNOWN, UNKNOWN, EXACT, SILENT = (True, False), (False, False), (None, True), (None, False)


@pytest.mark.parametrize(
    ("replays", "modelled", "reason"),
    [
        ([EXACT], False, ""),
        ([SILENT, EXACT], False, ""),
        ([KNOWN], True, "the reach is given or measured"),
        ([KNOWN, EXACT, (True, True)], True, "the reach is given or measured"),
        ([KNOWN, UNKNOWN], False, "the reach is unknown, and the model's are for a range of it"),
        ([KNOWN, SILENT], False, "the search model says nothing of some approximate replays"),
    ],
)
def test_modelled_scores_rank_where_all_of_them_can(replays, modelled, reason):
    ranking = Ranking.of(iter(replays))
    assert (ranking.modelled, ranking.reason) == (modelled, reason)
    assert ranking.by == ("modelled" if modelled else "recorded")
    assert str(ranking).startswith(
        "ranked by the " + ("modelled scores" if modelled else "scores of the recorded boxes")
    )
    assert str(ranking).endswith(reason)


def test_joint_draws_of_means_over_sigma_are_means_of_joint_draws():
    random = np.random.default_rng(0)
    means, counts = random.random((2, 7, 5)), np.full((2, 7, 5), 4.0)
    sums, over = over_sigmas(np.stack([means * counts, counts]))
    assert over.shape == (2, 7, 1)
    assert np.allclose(sums / over, means.mean(axis=-1, keepdims=True))
    counts[0, 0, 2] = 0  # no sequence counts at one sigma
    sums, over = over_sigmas(np.stack([means * counts, counts]))
    assert (sums[0, 0], over[0, 0]) == (0, 0)
    assert over[1:].all()


def test_the_interval_over_the_grid_is_inside_those_of_its_sigmas():
    runs = replace(runs_of("off"), search=MEASURED)
    totals = ModelledTotals(0)
    totals.add(evaluated(runs, SIGMA_GRID))
    each, over = totals.figures(), totals.figures(over_grid=True)
    for metric in MODELLED:
        assert np.allclose(over[metric], each[metric].mean(axis=1, keepdims=True))
        low, high = over[f"{metric}_low"], over[f"{metric}_high"]
        assert (low < over[metric]).all()
        assert (over[metric] < high).all()
        assert (low >= each[f"{metric}_low"].min(axis=1, keepdims=True)).all()
        assert (high <= each[f"{metric}_high"].max(axis=1, keepdims=True)).all()
