"""Sums over groups of sequences, against the means of all sequences at once."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from witness import moving

from lae_sim.engine.clock import Clock
from lae_sim.evaluation.evaluate import evaluate_groups, evaluate_runs
from lae_sim.evaluation.metrics import CONVENTIONS, METRICS
from lae_sim.evaluation.totals import RECOVERED, Mean, Totals
from lae_sim.forecast.base import ConstantVelocity, Hold
from lae_sim.replay.run import Run, replay_sequence
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import BESIDE, Recording

CLOCK = Clock.at(Fraction(30))
EVERY = Metadata.new("30", "every-frame")
FORECASTERS = {"velocity": ConstantVelocity, "hold": Hold}
SIGMAS = [Fraction(m, 4) for m in range(5)]


def recordings() -> list[Recording]:
    """Some of them without a truth, and one that the tracker never finds."""
    some = [moving(20 + 7 * seed, seed, f"s{seed}") for seed in range(6)]
    bare = Recording.new("s6", np.full((25, 4), np.nan), moving(25).boxes, [40_000_000] * 25)
    lost = Recording.new("s7", moving(25).truth, moving(25).boxes + 9e6, [40_000_000] * 25)
    return [*some, bare, lost]


@pytest.mark.parametrize("name", CONVENTIONS)
@pytest.mark.parametrize("frames", [1, 60, 10**6])
def test_totals_of_groups_are_the_means_of_all(name: str, frames: int) -> None:
    runs = [replay_sequence(recording, CLOCK) for recording in recordings()]
    convention = CONVENTIONS[name]
    totals = Totals(hold=1)
    for part in evaluate_groups(runs, EVERY, FORECASTERS, SIGMAS, convention, frames=frames):
        members = [i for i, name in enumerate(part.replay.sequences) if name in ("s1", "s4", "s7")]
        totals.add(part, {"some": members} if members else {})
    whole = evaluate_runs(runs, EVERY, FORECASTERS, SIGMAS, convention)
    for scores, which in (
        (totals.scores, list(range(8))),
        (totals.by_attribute["some"], [1, 4, 7]),
    ):
        assert scores.sequences == len(which)
        assert scores.complete
        for metric in METRICS:
            values, offline = whole.scores[metric][:, which], whole.offline[metric][which]
            expected = np.nanmean(values, axis=1)
            np.testing.assert_allclose(scores.mean(metric), expected, rtol=0, atol=1e-14)
            assert scores.offline(metric) == pytest.approx(np.nanmean(offline), rel=0, abs=1e-14)
        for metric in RECOVERED:
            values, offline = whole.scores[metric][:, which], whole.offline[metric][which]
            counted = ~np.isnan(values + values[1] + offline[:, None])
            won = np.where(counted, values - values[1], 0).sum(axis=1)
            lost = np.where(counted, offline[:, None] - values[1], 0).sum(axis=1)
            changes = scores.changes(metric)
            np.testing.assert_allclose(changes.won.total, won, rtol=0, atol=1e-13)
            np.testing.assert_allclose(changes.lost.total, lost, rtol=0, atol=1e-13)
    for f in range(2):
        curves = totals.curves.curves(f)
        for got, values in (
            (curves.success, whole.curves.success[f]),
            (curves.precision, whole.curves.precision[f]),
        ):
            np.testing.assert_allclose(got, np.nanmean(values, axis=0), rtol=0, atol=1e-14)
    offline = np.nanmean(whole.offline_curves.precision, axis=0)
    np.testing.assert_allclose(totals.curves.offline.precision, offline, rtol=0, atol=1e-14)
    assert totals.replay.sequences == whole.replay.sequences
    assert totals.replay.calls_ns.tolist() == whole.replay.calls_ns.tolist()
    assert totals.staleness.mismatch_sum.tolist() == whole.staleness.mismatch_sum.sum(0).tolist()
    assert totals.staleness.mismatch_max.tolist() == whole.staleness.mismatch_max.max(0).tolist()
    assert totals.staleness.longest_hold.tolist() == whole.staleness.longest_hold.max(0).tolist()


def test_one_group_has_the_bits_of_the_plain_mean() -> None:
    runs = [replay_sequence(recording, CLOCK) for recording in recordings()[:6]]
    totals = Totals(hold=1)
    for part in evaluate_groups(runs, EVERY, FORECASTERS, SIGMAS):
        totals.add(part)
    for metric in METRICS:
        scores = part.scores[metric]
        plain = [[scores[f, :, m].mean() for m in range(len(SIGMAS))] for f in range(2)]
        assert totals.scores.mean(metric).tolist() == plain
        assert totals.scores.offline(metric) == part.offline[metric].mean()


def test_a_skipped_box_leaves_no_offline_mean() -> None:
    full = moving(40)
    run = replay_sequence(full, CLOCK)
    sparse = Recording.of_run("b", run.schedule, run.boxes, full.truth)
    totals = Totals(hold=1)
    for part in evaluate_groups([run, replay_sequence(sparse, CLOCK)], EVERY, FORECASTERS):
        totals.add(part)
    assert not totals.scores.complete
    assert not totals.curves.complete
    assert np.isnan(totals.scores.offline("auc"))


def test_a_mean_of_nothing_is_nan() -> None:
    mean = Mean()
    assert np.isnan(mean.value)
    mean.add(np.array([[np.nan, np.nan], [1, np.nan]]))
    mean.add(np.array([[np.nan], [3.0]]))
    np.testing.assert_array_equal(mean.value, [np.nan, 2])


def test_what_is_kept_of_a_sequence_does_not_grow_with_sigmas_or_thresholds() -> None:
    run = replay_sequence(moving(3), CLOCK)
    count = 4000

    def runs() -> Iterator[Run]:
        for index in range(count):
            recording = replace(run.recording, name=f"s{index:06}")
            yield replace(run, recording=recording)

    totals = Totals(hold=1)
    tracemalloc.start()
    for part in evaluate_groups(runs(), EVERY, FORECASTERS, SIGMA_GRID, frames=500 * (3 + BESIDE)):
        totals.add(part)
    del part
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(totals.replay.sequences) == count
    # its name and ten numbers; the scores alone would be 3,264 bytes, the curves 1,728
    assert kept / count < 300
