"""Statistics of a comparison: intervals, paired differences and tests, over sequences.

Sequences are the independent observations; frames are not. Everything is computed in groups, one
per trace, latency, scale, sigma and metric. All forecasters of a group are measured on the same
sequences, and share the bootstrap's resamples, so that their differences are paired. The tidy table
that goes in is described at :func:`lae_sim.comparison.forecasters.compare_forecasters`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats
from lae_sim.errors import LaeError

if TYPE_CHECKING:
    import pandas as pd

Counts = npt.NDArray[np.unsignedinteger[Any]]

ALL_TRACES = "all traces"
ALL_SEQUENCES = "all sequences"
KEYS = ["attribute", "trace", "latency", "scale", "sigma", "forecaster", "metric"]
_ROWS = 200  # resamples at once
_NOISE_DECIMALS = 12  # equal differences of scores in 0..1 are equal to this many decimals


def summarise(
    table: pd.DataFrame,
    baselines: Sequence[str] = ("hold", "kalman"),
    metrics: Sequence[str] = ("auc", "dp20"),
    resamples: int = 10_000,
    seed: int = 0,
    confidence: float = 0.95,
) -> pd.DataFrame:
    """Means, differences and recovered losses with bootstrap intervals, and paired tests.

    A sequence counts in a group if every forecaster of the group has a value there (``offline`` is
    no forecaster: it has rows in a group only if it has values for all sequences that count). If
    there are several traces, the rows of ``"all traces"`` come last: each sequence that counts is
    averaged over its traces first.

    Args:
        table: the tidy table; a column ``attribute`` divides the groups further.
        baselines: forecasters that the others are compared with, where the table has them.
        metrics: those to summarise.
        resamples: of the percentile bootstrap (Efron and Tibshirani, "An Introduction to the
            Bootstrap", 1993, Ch. 13). A group's depend on ``seed`` and its number of sequences
            alone.
        seed: of NumPy's PCG64.
        confidence: of the intervals, between 0 and 1.

    Returns:
        One row per trace, latency, scale, sigma, forecaster and metric, each in the order of its
        first appearance, with ``sequences`` (how many count), ``mean``, ``low``, ``high`` and:

        - per baseline ``vs_hold``, ``vs_hold_low``, ``vs_hold_high`` (the mean paired difference),
          ``vs_hold_p`` (:func:`signed_rank_p`), ``vs_hold_better``, ``vs_hold_worse`` (numbers of
          sequences); NaN and 0 in a group without that baseline;
        - ``recovered``, ``recovered_low``, ``recovered_high``: the share of the latency loss won
          back, (forecast - hold) / (offline - hold) of the means. NaN without offline or a loss;
          the interval is NaN if there is a resample without a loss.

        With one sequence an interval is its value. ``attrs["method"]`` says how it was computed.

    Raises:
        LaeError: if the table lacks a column, has two values for the same thing, or no sequence
            counts anywhere; or if a setting is out of its range.
    """
    import pandas as pd

    if resamples < 1 or not 0 < confidence < 1:
        raise LaeError("a bootstrap needs resamples >= 1 and 0 < confidence < 1")
    baselines = [name for name in baselines if (table["forecaster"] == name).any()]
    wide, order = _wide(table, metrics)
    counts: dict[int, Counts] = {}
    parts = []
    keys = [key for key in order if key != "forecaster"]
    for values, group in wide.groupby(keys, sort=False):
        present = [name for name in order["forecaster"] if group[name].notna().any()]
        group = group.dropna(subset=[name for name in present if name != "offline"])
        present = [name for name in present if group[name].notna().all()]
        count = len(group)
        if not count or not present:
            continue
        if count not in counts:
            counts[count] = bootstrap_counts(count, resamples, seed)
        scores = np.ascontiguousarray(group[present].to_numpy(np.float64).T)
        columns = _compared(scores, present, counts[count], baselines, confidence)
        columns = {"forecaster": present, "sequences": count, **columns}
        parts.append(pd.DataFrame({**dict(zip(keys, values)), **columns}))
    if not parts:
        raise LaeError("nothing to summarise: no sequence has a value for every forecaster")
    summary = pd.concat(parts)[[*order, *parts[0].columns.difference(list(order), sort=False)]]
    summary = summary.sort_values(
        list(order), key=lambda column: column.map(order[column.name].index), ignore_index=True
    )
    summary.attrs["method"] = (
        f"[ ]: {100 * confidence:g} % percentile bootstrap over sequences, {resamples:,} "
        f"resamples, seed {seed}; p: Wilcoxon's signed-rank test,\npaired over sequences, not "
        "corrected for the number of comparisons; +/-: sequences better and worse; n: sequences"
    )
    return summary


def by_attribute(
    table: pd.DataFrame, attributes: Mapping[tuple[str, str], Iterable[str]], **settings: Any
) -> pd.DataFrame:
    """:func:`summarise` of the sequences that have each attribute, in a first column ``attribute``.

    Args:
        table: the tidy table.
        attributes: those of each sequence, by its dataset and name.
        settings: those of :func:`summarise`.

    Returns:
        The rows of ``"all sequences"`` first, then the attributes in the order of their names.
    """
    import pandas as pd

    named = [(*sequence, name) for sequence, names in attributes.items() for name in set(names)]
    members = pd.DataFrame(named, columns=["dataset", "sequence", "attribute"])
    chosen = table.merge(members, on=["dataset", "sequence"])
    everything = table.assign(attribute=ALL_SEQUENCES)
    divided = pd.concat([everything, chosen.sort_values("attribute", kind="stable")])
    return summarise(divided, **settings)


def over_sigmas(table: pd.DataFrame) -> pd.DataFrame:
    """The tidy table of the plain means over its permitted latencies: metrics mauc, mdp20, ...

    Over 0, 0.02, ..., 1 these are mAUC and mDP of Li et al., "PVT++", 2023. ``sigma`` is 0 in all.
    """
    keys = [column for column in table if column not in ("sigma", "value")]
    means = table.groupby(keys, sort=False)["value"].mean().reset_index()
    return means.assign(metric="m" + means["metric"], sigma=0.0)


def _wide(table: pd.DataFrame, metrics: Sequence[str]) -> tuple[pd.DataFrame, dict[str, list[Any]]]:
    """A column for each forecaster, all traces last; and each key's values as they appear."""
    import pandas as pd

    missing = set(KEYS[1:] + ["dataset", "sequence", "value"]) - set(table)
    if missing:
        raise LaeError(f"the table of a comparison lacks the columns {', '.join(sorted(missing))}")
    table = table[table["metric"].isin(list(metrics))]
    keys = [key for key in KEYS if key in table]
    order = {key: list(table[key].unique()) for key in keys}
    rows = [*(key for key in keys if key != "forecaster"), "dataset", "sequence"]
    try:
        wide = table.set_index([*rows, "forecaster"])["value"].unstack("forecaster")
    except ValueError as error:
        raise LaeError("the table of a comparison has two values for the same thing") from error
    wide = wide.sort_index().reset_index()
    if len(order["trace"]) > 1:
        order["trace"].append(ALL_TRACES)
        whole = wide.dropna(subset=[name for name in order["forecaster"] if name != "offline"])
        alike = whole.drop(columns="trace").groupby([key for key in rows if key != "trace"])
        # pandas' mean skips NaN: without offline in one trace there is none in all
        pooled = alike.mean().where(alike.count().eq(alike.size(), axis=0)).reset_index()
        wide = pd.concat([wide, pooled.assign(trace=ALL_TRACES)])
    return wide, order


def bootstrap_counts(count: int, resamples: int, seed: int) -> Counts:
    """How often each sequence is in each resample, uint16 [resamples, count] (or wider)."""
    generator = np.random.Generator(np.random.PCG64(seed))
    counts = np.empty((resamples, count), np.uint16 if count < 2**16 else np.uint32)
    for row in range(0, resamples, _ROWS):  # the same stream, without a large array
        some = counts[row : row + _ROWS]
        some[:] = generator.multinomial(count, np.full(count, 1 / count), size=len(some))
    return counts


def resampled_means(values: Floats, counts: Counts) -> Floats:
    """The mean of each row of values [F, S] in each resample, float64 [F, resamples]."""
    # not a product by BLAS, where a row's last bits depend on the number of rows
    blocks = [
        np.einsum("fs,rs->fr", values, counts[row : row + _ROWS] / counts.shape[1])
        for row in range(0, len(counts), _ROWS)
    ]
    return np.concatenate(blocks, axis=1)


def _compared(
    scores: Floats,
    names: Sequence[str],
    counts: Counts,
    baselines: Sequence[str],
    confidence: float,
) -> dict[str, Any]:
    """The columns of one group from its scores [F, S], each of length F."""
    columns: dict[str, Any] = {}
    tails = [(1 - confidence) / 2, (1 + confidence) / 2]

    def add(name: str, value: Floats, samples: Floats, prefix: str) -> None:
        columns[name] = value
        columns[f"{prefix}low"], columns[f"{prefix}high"] = np.quantile(samples, tails, axis=1)

    mean = scores.mean(axis=1)
    resampled = resampled_means(scores, counts)
    unknown = np.full(len(names), np.nan)
    add("mean", mean, resampled, "")
    for baseline in baselines:
        name = f"vs_{baseline}"
        if baseline not in names:
            columns |= dict.fromkeys([name, f"{name}_low", f"{name}_high", f"{name}_p"], unknown)
            columns |= {f"{name}_better": 0, f"{name}_worse": 0}
            continue
        b = names.index(baseline)
        differences = np.round(scores - scores[b], _NOISE_DECIMALS)
        add(name, mean - mean[b], resampled - resampled[b], f"{name}_")
        columns[f"{name}_p"] = [signed_rank_p(row) for row in differences]
        columns[f"{name}_better"] = (differences > 0).sum(axis=1)
        columns[f"{name}_worse"] = (differences < 0).sum(axis=1)
    if {"hold", "offline"} <= set(names):
        hold, offline = names.index("hold"), names.index("offline")
        loss, losses = mean[offline] - mean[hold], resampled[offline] - resampled[hold]
        share = (mean - mean[hold]) / (loss if loss > 0 else np.nan)
        shares = (resampled - resampled[hold]) / np.where((losses > 0).all(), losses, np.nan)
        add("recovered", share, shares, "recovered_")
    else:
        columns |= dict.fromkeys(["recovered", "recovered_low", "recovered_high"], unknown)
    return columns


def signed_rank_p(differences: Floats) -> float:
    """Two-sided p of Wilcoxon's signed-rank test.

    Source: Wilcoxon, "Individual Comparisons by Ranking Methods", 1945. Zeros leave first, as he
    has it; if nothing is left, p is 1. It is exact for up to 50 differences, ties or not: all signs
    are counted; else normal, corrected for ties. (scipy.stats takes a second to import.)

    Args:
        differences: paired, float64 [S].
    """
    differences = differences[differences != 0]
    count = len(differences)
    if not count:
        return 1.0
    _, group, sizes = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    doubled = (2 * np.cumsum(sizes) - sizes + 1)[group]  # twice the mean rank of each group of ties
    positive = int(doubled[differences > 0].sum())
    if count > 50:
        variance = count * (count + 1) * (2 * count + 1) / 24 - int((sizes**3 - sizes).sum()) / 48
        deviation = abs(positive / 2 - count * (count + 1) / 4) / math.sqrt(variance)
        return math.erfc(deviation / math.sqrt(2))
    ways = np.ones(1)  # of signs that have each sum of positive ranks; exact, being below 2**53
    for rank in doubled.tolist():
        ways = np.concatenate([ways, np.zeros(rank)]) + np.concatenate([np.zeros(rank), ways])
    tail = float(np.minimum(ways[: positive + 1].sum(), ways[positive:].sum()))
    return min(1.0, 2 * tail / 2.0**count)
