"""Statistics of a comparison, against plain Python, scipy itself, and what must not matter."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pandas as pd
import pytest
from scipy.stats import rankdata, wilcoxon
from tidy_scores import random_scores, tidy

from lae_sim.comparison.statistics import (
    Bootstrap,
    Interval,
    Recovered,
    by_attribute,
    holm,
    quantiles,
    recovered,
    signed_rank_p,
    signed_rank_ps,
    summarise,
)
from lae_sim.errors import LaeError
from lae_sim.figures.labels import setting_label
from lae_sim.report.comparison import comparison_table
from lae_sim.report.table import p_label

KEYS = ["trace", "latency", "scale", "sigma", "forecaster", "metric"]


def row(summary, forecaster="mine", **wanted):
    chosen = summary[summary["forecaster"] == forecaster]
    for key, value in {"metric": "auc", **wanted}.items():
        chosen = chosen[chosen[key] == value]
    [found] = chosen.to_dict("records")
    return found


def assert_same(summary, other):
    """Equal rows, whatever their order; the last bits may depend on the order of summation."""
    keys = [key for key in ["attribute", *KEYS] if key in summary]
    left, right = (one.sort_values(keys, ignore_index=True) for one in (summary, other))
    pd.testing.assert_frame_equal(left, right, rtol=0, atol=1e-12)


def quantile(values, share):
    """Linear interpolation between order statistics."""
    values, at = sorted(values), share * (len(values) - 1)
    low = math.floor(at)
    return values[low] + (at - low) * (values[min(low + 1, len(values) - 1)] - values[low])


def test_golden_values_of_a_plain_bootstrap():
    scores = random_scores(count=8)
    found = row(summarise(tidy(scores), resamples=200, seed=3, confidence=0.9))
    counts = np.random.Generator(np.random.PCG64(3)).multinomial(8, [1 / 8] * 8, size=200)

    def means(name):
        values = scores[name].tolist()
        return [sum(n * v for n, v in zip(c, values)) / 8 for c in counts.tolist()]

    mine, hold, kalman, offline = map(means, ["mine", "hold", "kalman", "offline"])
    samples = {
        "": mine,
        "vs_hold_": [a - b for a, b in zip(mine, hold)],
        "vs_kalman_": [a - b for a, b in zip(mine, kalman)],
        "recovered_": [(a - b) / (c - b) for a, b, c in zip(mine, hold, offline)],
    }
    for prefix, values in samples.items():
        assert found[f"{prefix}low"] == pytest.approx(quantile(values, 0.05), abs=1e-12)
        assert found[f"{prefix}high"] == pytest.approx(quantile(values, 0.95), abs=1e-12)
    m, h, k, o = (sum(scores[name]) / 8 for name in ("mine", "hold", "kalman", "offline"))
    assert found["sequences"] == 8
    assert found["mean"] == pytest.approx(m)
    assert found["vs_hold"] == pytest.approx(m - h)
    assert found["vs_kalman"] == pytest.approx(m - k)
    assert found["recovered"] == pytest.approx((m - h) / (o - h))
    expected = wilcoxon(scores["mine"], scores["kalman"]).pvalue
    assert found["vs_kalman_p"] == pytest.approx(expected, rel=1e-12)
    assert found["vs_kalman_better"] == sum(scores["mine"] > scores["kalman"])
    assert found["vs_kalman_worse"] == sum(scores["mine"] < scores["kalman"])


@pytest.mark.parametrize(
    ("differences", "p"),
    [
        ([], 1),
        ([0.0, 0], 1),
        ([0.3], 1),
        ([0.1, 0.2, 0.3, 0.4, 0.5, 0.0], 2 / 2**5),
        ([0.1, 0.1, 0.1], 2 / 2**3),
        ([0.1, 0.2, 0.3, -0.4], 14 / 16),  # of 16 signs, 7 have a rank sum of 4 or less
    ],
)
def test_signed_ranks_counted_by_hand(differences, p):
    assert signed_rank_p(np.array(differences)) == pytest.approx(p)


def test_signed_ranks_of_many_differences_are_normal_as_those_of_scipy():
    for differences in (np.linspace(-0.5, 1, 60), np.repeat([0.1, 0.2, -0.1, 0.3], 14)):
        expected = wilcoxon(differences, method="approx").pvalue
        assert signed_rank_p(differences) == pytest.approx(expected, rel=1e-12)
        assert signed_rank_p(np.append(differences, [0, 0])) == signed_rank_p(differences)


def test_signed_ranks_without_ties_are_exact_as_those_of_scipy():
    for count in (10, 25, 50):
        differences = np.random.default_rng(count).normal(0.3, 1, count)
        expected = wilcoxon(differences, method="exact").pvalue
        assert signed_rank_p(differences) == pytest.approx(expected, rel=1e-12)


def test_ties_are_exact_by_trying_all_signs():
    for differences in ([0.1, 0.1, -0.2, 0.3, 0.3, 0.3, -0.1], np.repeat([0.1, 0.2, -0.1], 4)):
        ranks = rankdata(np.abs(differences))
        signs = np.array(list(product((0, 1), repeat=len(ranks))))
        sums, found = signs @ ranks, ranks[np.array(differences) > 0].sum()
        tail = min((sums <= found).mean(), (sums >= found).mean())
        assert signed_rank_p(np.array(differences)) == pytest.approx(min(1, 2 * tail))


def test_ties_of_differences_survive_rounding_errors():
    scores = {"hold": [0.1, 0.2, 0.3], "mine": [0.1 + 0.2, 0.2 + 0.2, 0.1 + 0.2 + 1e-17]}
    found = row(summarise(tidy(scores), resamples=10))
    assert (found["vs_hold_better"], found["vs_hold_worse"], found["vs_hold_p"]) == (2, 0, 0.5)


def test_a_forecaster_like_the_baseline_differs_by_nothing():
    scores = random_scores()
    scores["mine"] = scores["kalman"]
    summary = summarise(tidy(scores), resamples=50)
    for name in ("mine", "kalman"):
        found = row(summary, name)
        assert found["vs_kalman_p"] == 1
        names = ["vs_kalman", "vs_kalman_low", "vs_kalman_high"]
        names += ["vs_kalman_better", "vs_kalman_worse"]
        assert [found[name] for name in names] == [0] * 5
    assert row(summary, "hold")["recovered"] == 0
    assert row(summary, "offline")["recovered_low"] == pytest.approx(1)


def whole_table():
    """Two traces with some sequences in common, two latencies, two metrics."""
    seeds = iter(range(100))
    return pd.concat(
        [
            tidy(random_scores(next(seeds), count), trace, latency, metric=metric)
            for trace, count in (("a", 7), ("b", 9))
            for latency in ("recorded", "constant:47ms")
            for metric in ("auc", "dp20")
        ],
        ignore_index=True,
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_rows_does_not_matter(seed):
    table = whole_table()
    shuffled = table.sample(frac=1, random_state=seed)
    assert_same(summarise(table, resamples=20), summarise(shuffled, resamples=20))


def test_rows_come_in_the_order_of_first_appearance():
    found = summarise(whole_table(), resamples=5)
    expected = [
        (trace, latency, 1.0, 0.0, forecaster, metric)
        for trace in ("a", "b", "all traces")
        for latency in ("recorded", "constant:47ms")
        for forecaster in ("hold", "kalman", "mine", "offline")
        for metric in ("auc", "dp20")
    ]
    assert list(found[KEYS].itertuples(index=False, name=None)) == expected


def test_another_forecaster_trace_or_latency_changes_no_row_of_the_others():
    table = whole_table()
    alone = table[(table["trace"] == "b") & (table["latency"] == "recorded")]
    alone = alone[alone["forecaster"] != "mine"]
    together = summarise(table, resamples=30)
    chosen = together[(together["trace"] == "b") & (together["latency"] == "recorded")]
    chosen = chosen[chosen["forecaster"] != "mine"].reset_index(drop=True)
    pd.testing.assert_frame_equal(summarise(alone, resamples=30), chosen, check_exact=True)


def test_all_traces_average_each_sequence_first():
    one, two = random_scores(1, 3), random_scores(2, 5)
    table = pd.concat([tidy(one, "a"), tidy(two, "b"), tidy(two, "c", dataset="E")])
    scores = {
        name: [(one[name][i] + two[name][i]) / 2 for i in range(3)] + [*two[name][3:], *two[name]]
        for name in one
    }
    found = summarise(table, resamples=40)
    found = found[found["trace"] == "all traces"].reset_index(drop=True)
    assert_same(found, summarise(tidy(scores, "all traces"), resamples=40))
    assert set(found["sequences"]) == {10}


def test_all_traces_have_no_offline_unless_all_have():
    table = pd.concat([tidy(random_scores(1), "a"), tidy(random_scores(2), "b")])
    table = table[(table["trace"] == "a") | (table["forecaster"] != "offline")]
    found = summarise(table, resamples=10)
    assert not math.isnan(row(found, trace="a")["recovered"])
    assert math.isnan(row(found, trace="b")["recovered"])
    assert math.isnan(row(found, trace="all traces")["recovered"])
    assert set(found[found["forecaster"] == "offline"]["trace"]) == {"a"}


def test_a_sequence_without_a_score_leaves_all_forecasters():
    scores = random_scores(count=6)
    scores["mine"][2] = np.nan
    kept = {name: np.delete(values, 2) for name, values in scores.items()}
    assert_same(summarise(tidy(scores), resamples=30), summarise(tidy(kept), resamples=30))
    absent = tidy(scores).dropna()
    assert_same(summarise(absent, resamples=30), summarise(tidy(kept), resamples=30))


def test_offline_missing_somewhere_is_no_reason_to_leave_sequences_out():
    scores = random_scores(count=6)
    scores["offline"][2] = np.nan
    found = summarise(tidy(scores), resamples=30)
    assert list(found["forecaster"]) == ["hold", "kalman", "mine"]
    assert set(found["sequences"]) == {6}
    assert found["recovered"].isna().all()


def test_a_baseline_that_is_not_there():
    scores = random_scores()
    del scores["kalman"]
    assert not any(name.startswith("vs_kalman") for name in summarise(tidy(scores), resamples=5))
    both = pd.concat([tidy(scores, latency="x"), tidy(random_scores(), latency="y")])
    found = row(summarise(both, resamples=5), latency="x")
    assert math.isnan(found["vs_kalman"])
    assert math.isnan(found["vs_kalman_p"])
    assert (found["vs_kalman_better"], found["vs_kalman_worse"]) == (0, 0)


def test_one_sequence_has_no_width_and_no_evidence():
    alone = summarise(tidy(random_scores(count=1)))
    assert "one sequence alone" in alone.attrs["method"]
    assert "alone" not in summarise(tidy(random_scores(count=2))).attrs["method"]
    found = row(alone)
    for name in ("mean", "vs_hold", "recovered"):
        prefix = "" if name == "mean" else f"{name}_"
        assert found[f"{prefix}low"] == pytest.approx(found[name])
        assert found[f"{prefix}high"] == pytest.approx(found[name])
    assert found["vs_hold_p"] == 1


def test_recovered_needs_a_loss():
    gain = {"hold": [0.5, 0.6], "offline": [0.4, 0.6], "mine": [0.5, 0.7]}
    assert math.isnan(row(summarise(tidy(gain), resamples=50))["recovered"])
    either = {"hold": [0.3, 0.6], "offline": [0.5, 0.5], "mine": [0.4, 0.6]}
    found = row(summarise(tidy(either), resamples=50))
    assert found["recovered"] == pytest.approx(1)
    assert math.isnan(found["recovered_low"])
    assert math.isnan(found["recovered_high"])


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    random = np.random.default_rng(5)
    table = pd.concat(
        [tidy({"hold": random.beta(2, 3, 40)}, latency=f"draw {i}") for i in range(200)]
    )
    found = summarise(table, resamples=1000)
    covered = ((found["low"] <= 0.4) & (found["high"] >= 0.4)).mean()
    assert 0.88 <= covered <= 0.98


def test_attributes_are_summaries_of_their_sequences():
    table = whole_table()
    attributes = {
        ("D", "s01"): ["blur"],
        ("D", "s08"): ["blur", "blur"],
        ("D", "s04"): ["a", "blur"],
    }
    found = by_attribute(table, attributes, resamples=20)
    assert list(found["attribute"].unique()) == ["all sequences", "a", "blur"]
    everything = found[found["attribute"] == "all sequences"].drop(columns="attribute")
    assert_same(everything, summarise(table, resamples=20))
    blurred = table[table["sequence"].isin(["s01", "s08", "s04"])]
    blur = found[found["attribute"] == "blur"].drop(columns="attribute")
    assert_same(blur, summarise(blurred, resamples=20))


def test_what_cannot_be_summarised_is_said():
    table = tidy(random_scores())
    with pytest.raises(LaeError, match=r"lacks the columns sigma, value"):
        summarise(table.drop(columns=["sigma", "value"]))
    with pytest.raises(LaeError, match=r"two values"):
        summarise(pd.concat([table, table]))
    with pytest.raises(LaeError, match=r"nothing to summarise"):
        summarise(table.assign(value=np.nan))
    with pytest.raises(LaeError, match=r"nothing to summarise"):
        summarise(table, metrics=["norm_auc"])
    with pytest.raises(LaeError, match=r"resamples >= 1"):
        summarise(table, resamples=0)


def test_the_text_table():
    scores = {
        "hold": [0.3, 0.4, 0.5, 0.6],
        "mine": [0.4, 0.45, 0.6, 0.55],
        "offline": [0.6, 0.7, 0.8, 0.9],
    }
    table = pd.concat([tidy(scores), tidy(scores, scale=2.0), tidy(scores, metric="dp20")])
    text = comparison_table(summarise(table))
    assert text.splitlines()[:-2] == [
        "trace a, sigma 0",
        "",
        "latency       forecaster  n                   AUC       recovered  vs hold      p"
        "  +/-  DP@20",
        "------------  ----------  -  --------------------  --------------  -------  -----"
        "  ---  -----",
        "recorded      hold        4  0.450 [0.350, 0.550]               -        -      -"
        "    -  0.450",
        "recorded      mine        4  0.500 [0.425, 0.575]  16.7% [-4, 33]   +0.050  0.375"
        "  3/1  0.500",
        "recorded      offline     4  0.750 [0.650, 0.850]               -   +0.300  0.125"
        "  4/0  0.750",
        "recorded x 2  hold        4  0.450 [0.350, 0.550]               -        -      -"
        "    -      -",
        "recorded x 2  mine        4  0.500 [0.425, 0.575]  16.7% [-4, 33]   +0.050  0.375"
        "  3/1      -",
        "recorded x 2  offline     4  0.750 [0.650, 0.850]               -   +0.300  0.125"
        "  4/0      -",
    ]
    last = " ".join(text.splitlines()[-2:])
    assert "95 % percentile bootstrap over sequences, 10,000 resamples, seed 0" in last
    assert "not corrected for the number of comparisons" in last


def test_the_text_table_names_sigmas_and_attributes_where_there_are_some():
    table = pd.concat([tidy(random_scores(), sigma=sigma) for sigma in (0.0, 0.5)])
    summary = by_attribute(table, {("D", "s00"): ["blur"]}, resamples=10)
    told, _, header, _, first, *_ = comparison_table(summary).splitlines()
    assert told == "trace a, latency recorded"
    assert header.split()[:3] == ["attribute", "sigma", "forecaster"]
    assert first.split()[:4] == ["all", "sequences", "0", "hold"]


def test_labels():
    assert [p_label(p) for p in (0.0129, 1.0, 1e-9, math.nan)] == [
        "0.013",
        "1.000",
        "<0.001",
        "-",
    ]
    assert setting_label("recorded", 1) == "recorded"
    assert setting_label("constant:47ms", 0.5) == "constant:47ms x 0.5"


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_the_recovered_share_needs_a_loss_in_every_resample():
    assert recovered(0.5, 2) == 0.25
    assert recovered(-0.5, 2) == -0.25
    assert recovered(0.5, 0) is None
    assert recovered(0.5, -1) is None
    bootstrap, wins = Bootstrap(), np.array([0.1, 0.2, 0.3])
    found = bootstrap.recover(0.2, 0.4, wins, np.array([0.4, 0.4, 0.4]))
    assert found.share == 0.5
    assert found.interval == Interval(*np.quantile(wins / 0.4, [0.025, 0.975]))
    assert bootstrap.recover(0.2, 0.4, wins, np.array([0.4, 0.0, 0.4])) == Recovered(0.5, None)
    assert bootstrap.recover(0.2, 0.0, wins, np.zeros(3)) == Recovered(None, None)


def test_resamples_are_drawn_once_and_depend_on_the_seed_and_their_number_alone():
    bootstrap = Bootstrap(resamples=450, seed=4)
    assert bootstrap.counts(7) is bootstrap.counts(7)
    counts = np.random.Generator(np.random.PCG64(4)).multinomial(7, [1 / 7] * 7, size=450)
    np.testing.assert_array_equal(bootstrap.counts(7), counts)
    scores = np.random.default_rng(0).random((3, 7))
    means = bootstrap.means(scores)
    np.testing.assert_allclose(means, scores @ counts.T / 7, rtol=0, atol=1e-12)
    for row, alone in zip(scores, means):
        np.testing.assert_array_equal(bootstrap.means(row[None])[0], alone)


def test_a_difference_is_paired():
    bootstrap = Bootstrap(resamples=300)
    values, baseline = np.array([0.5, 0.6, 0.7, 0.4]), np.array([0.4, 0.6, 0.5, 0.5])
    means, others = bootstrap.means(np.stack([values, baseline]))
    [found] = bootstrap.differences(values[None], baseline[None], [means], [others])
    assert found.value == pytest.approx(0.05)
    assert (found.better, found.worse) == (2, 1)
    assert found.p == signed_rank_p(np.array([0.1, 0.2, -0.1]))
    assert found.interval == bootstrap.interval(means - others)
    [margins] = bootstrap.means((values - baseline)[None])
    one = (values - baseline)[None]
    [alike] = bootstrap.differences(one, np.zeros_like(one), [margins], [0.0])
    assert (alike.p, alike.better, alike.worse) == (found.p, found.better, found.worse)
    assert alike.interval.low == pytest.approx(found.interval.low, abs=1e-12)


def test_rows_of_differences_have_the_p_that_each_has_alone():
    rng = np.random.default_rng(5)
    for size in (1, 2, 8, 49, 50, 51, 123):
        for decimals in (1, 12):  # many ties and zeros, and none
            rows = np.round(rng.normal(0, 0.3, (20, size)), decimals)
            rows[0] = 0
            assert signed_rank_ps(rows) == [signed_rank_p(row) for row in rows]
            assert signed_rank_ps(-rows) == signed_rank_ps(rows)
            assert signed_rank_p(rows[0]) == 1


def test_quantiles_are_those_of_numpy_to_the_bit():
    rng = np.random.default_rng(6)
    for size in (1, 2, 3, 41, 450, 10_000):
        for values in (
            *(np.round(rng.normal(size=size), decimals) for decimals in (0, 3, 17)),
            rng.lognormal(0, 2, size),
            -rng.lognormal(0, 2, size),
            np.zeros(size),
        ):
            for at in ((0.025, 0.975), (0, 1), (0.3, 0.5), (0.49, 0.98), (0.005, 0.995)):
                expected = tuple(np.quantile(values, at).tolist())
                assert quantiles(values, at) == expected
                assert quantiles(values, at, -0.3, 0.5) == expected  # whatever is guessed
