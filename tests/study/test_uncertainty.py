"""How sure means are: the same in batches as one by one, and as JSON has it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lae_sim.comparison.statistics import Bootstrap, signed_rank_p
from lae_sim.study.uncertainty import (
    Answers,
    Resamples,
    Sample,
    difference_of,
    differences,
    plain,
    uncertainties,
    uncertainty_of,
)

HOW = Resamples(seed=3, count=500)


def samples() -> list[Sample]:
    """Of 1, 5 and 8 sequences, with and without repetitions, hold and offline scores."""
    rng = np.random.default_rng(0)
    found = []
    for size in (5, 8, 5, 1, 8, 8, 5):
        for repetitions in (1, 4):
            values, hold, offline = rng.random((repetitions, size)), *rng.random((2, size))
            found += [Sample(values), Sample(values, hold, 1 + offline)]
    gaps = np.where(np.arange(8) == 2, np.nan, 0.9)
    return [*found, Sample(rng.random((1, 8)), rng.random(8), gaps)]


def test_of_many_each_has_what_it_has_alone():
    together = uncertainties(samples(), HOW)
    assert together == [uncertainties([sample], HOW)[0] for sample in samples()]
    assert together[-1].recovered is None  # offline is not known of all sequences


def test_the_numbers_are_those_of_numpy():
    sample = samples()[3]  # repeated, and beside hold
    assert sample.hold is not None
    assert sample.offline is not None
    [found] = uncertainties([sample], HOW)
    counts = Bootstrap(500, 3).counts(5) / 5
    mean = sample.values.mean(axis=0)
    ends = np.quantile(counts @ mean, [0.025, 0.975])
    assert (found.interval.low, found.interval.high) == pytest.approx(ends, abs=1e-12)
    assert found.jitter is not None
    assert found.vs_hold is not None
    assert found.recovered is not None
    runs = np.quantile(sample.values.mean(axis=1), [0.025, 0.975])
    assert (found.jitter.low, found.jitter.high) == pytest.approx(runs, abs=1e-12)
    won = mean - sample.hold
    ends = np.quantile(counts @ won, [0.025, 0.975])
    assert found.vs_hold.value == pytest.approx(won.mean(), abs=1e-12)
    low, high = found.vs_hold.interval.low, found.vs_hold.interval.high
    assert (low, high) == pytest.approx(ends, abs=1e-12)
    assert found.vs_hold.p == signed_rank_p(won)
    assert (found.vs_hold.better, found.vs_hold.worse) == ((won > 0).sum(), (won < 0).sum())
    lost = sample.offline - sample.hold
    assert found.recovered.share == pytest.approx(won.mean() / lost.mean(), abs=1e-12)


def test_differences_of_any_sizes_keep_their_order():
    rng = np.random.default_rng(1)
    some = [rng.normal(0.1, 1, size) for size in (3, 9, 3, 1, 9)]
    found = differences(some, HOW)
    assert found == [differences([each], HOW)[0] for each in some]
    assert [each.value for each in found] == pytest.approx([each.mean() for each in some])


def test_answers_are_plain_json_to_the_bit():
    for each in uncertainties(samples(), HOW):
        assert uncertainty_of(json.loads(json.dumps(plain(each)))) == each
    [one] = differences([np.array([0.1, 0.3, -0.2])], HOW)
    assert difference_of(json.loads(json.dumps(plain(one)))) == one


def test_answers_that_nobody_asked_for_are_not_kept_again():
    answers = Answers({"a": 1, "b": None})
    assert answers.has("a")
    assert not answers.has("c")
    answers.put("c", 3)
    assert (answers["a"], answers["c"], answers.document()) == (1, 3, {"a": 1, "c": 3})
    assert answers.differ
    again = Answers(answers.document())
    assert again.has("a")
    assert again.has("c")
    assert not again.differ


def test_other_resamples_are_other_questions():
    keys = {how.key("a") for how in (HOW, Resamples(4, 500), Resamples(3, 501))}
    assert len({*keys, HOW.key("b")}) == 4
