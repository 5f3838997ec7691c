"""Statistics over sequences: resample, compare, correct, recover; and a comparison's summary.

Sequences are the independent observations; frames are not. What is compared is measured on the same
sequences and shares the bootstrap's resamples, so that differences are paired.

:func:`summarise` does so in groups, one per trace, latency, scale, sigma and metric, of a tidy
table (described at :func:`lae_sim.comparison.forecasters.score_forecasters`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats
from lae_sim.errors import LaeError, listed
from lae_sim.evaluation.totals import recovered

if TYPE_CHECKING:
    import pandas as pd

Counts = npt.NDArray[np.unsignedinteger[Any]]

ALL_TRACES = "all traces"
ALL_SEQUENCES = "all sequences"
KEYS = ["attribute", "trace", "latency", "scale", "sigma", "forecaster", "metric"]
RESAMPLES = 10_000
_ROWS = 200  # resamples at once, at least
_AT_ONCE = 1 << 16  # counts
_FEW = 256  # sequences, whose counts are kept
_NOISE_DECIMALS = 12  # equal differences of scores in 0..1 are equal to this many decimals


@dataclass(frozen=True, slots=True)
class Interval:
    """The ends of an interval."""

    low: float
    high: float

    def columns(self, name: str) -> dict[str, float]:
        """The ends by their keys in a row in which the value is ``name``."""
        return {f"{name}_low": self.low, f"{name}_high": self.high}


@dataclass(frozen=True, slots=True)
class Difference:
    """A mean paired difference of scores over sequences.

    Attributes:
        value: the difference of the means.
        interval: of it, bootstrapped.
        p: of no difference (:func:`signed_rank_p`).
        better, worse: numbers of sequences.
    """

    value: float
    interval: Interval
    p: float
    better: int
    worse: int


@dataclass(frozen=True, slots=True)
class Recovered:
    """The share of the latency loss that a forecaster wins back.

    Attributes:
        share: of the means; None without a loss.
        interval: of it, bootstrapped; None if there is a resample without a loss.
    """

    share: float | None
    interval: Interval | None


class Bootstrap:
    """The percentile bootstrap over sequences.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, Ch. 13. All that have
    the same number of sequences share their resamples, which depend on the seed and that number
    alone.

    Args:
        resamples: how many.
        seed: of NumPy's PCG64.
        tails: the quantiles that are the ends of an interval.
    """

    def __init__(
        self,
        resamples: int = RESAMPLES,
        seed: int = 0,
        tails: tuple[float, float] = (0.025, 0.975),
    ) -> None:
        self.resamples, self.seed, self.tails = resamples, seed, tails
        self._counts: dict[int, Counts] = {}

    def counts(self, count: int) -> Counts:
        """How often each sequence is in each resample, uint16 [resamples, count] (or wider)."""
        if count not in self._counts:
            drawn = _drawn_again if count <= _FEW else _drawn
            self._counts[count] = drawn(self.resamples, self.seed, count)
        return self._counts[count]

    def means(self, values: Floats) -> Floats:
        """The mean of each row of values [F, S] in each resample, float64 [F, resamples]."""
        # not a product by BLAS, where a row's last bits depend on the number of rows
        counts = self.counts(values.shape[1])
        rows = max(_ROWS, _AT_ONCE // counts.shape[1])
        blocks = [
            np.einsum("fs,rs->fr", values, counts[row : row + rows] / counts.shape[1])
            for row in range(0, len(counts), rows)
        ]
        return np.concatenate(blocks, axis=1)

    def interval(
        self, samples: Floats, middle: float | None = None, spread: float = 0.0
    ) -> Interval:
        """The range between the tails of samples (see :func:`quantiles`)."""
        return Interval(*quantiles(samples, self.tails, middle, spread))

    def differences(
        self,
        values: Floats,
        baselines: Floats,
        means: Iterable[Floats],
        others: Iterable[Floats | float],
    ) -> list[Difference]:
        """The paired differences of some scores, each to a baseline's.

        Args:
            values, baselines: scores by sequence, float64 [F, S]; or differences, and 0.
            means, others: of each the means in the resamples, float64 [resamples].
        """
        margins = values - baselines
        rounded = np.round(margins, _NOISE_DECIMALS)
        return [
            Difference(
                value=float(np.mean(value) - np.mean(baseline)),
                interval=self.interval(mean - other, *spread(margin)),
                p=p,
                better=int((change > 0).sum()),
                worse=int((change < 0).sum()),
            )
            for value, baseline, mean, other, margin, change, p in zip(
                values, baselines, means, others, margins, rounded, signed_rank_ps(rounded)
            )
        ]

    def recover(self, won: float, lost: float, wins: Floats, losses: Floats) -> Recovered:
        """The share of a loss that is won back.

        Args:
            won, lost: differences of the means (see :func:`recovered`).
            wins, losses: the same in each resample, float64 [resamples].
        """
        shares = self.interval(wins / losses) if (losses > 0).all() else None
        return Recovered(recovered(won, lost), shares)


def _drawn(resamples: int, seed: int, count: int) -> Counts:
    """Those of :meth:`Bootstrap.counts`."""
    generator = np.random.Generator(np.random.PCG64(seed))
    counts = np.empty((resamples, count), np.uint16 if count < 2**16 else np.uint32)
    for row in range(0, resamples, _ROWS):  # the same stream, without a large array
        some = counts[row : row + _ROWS]
        some[:] = generator.multinomial(count, np.full(count, 1 / count), size=len(some))
    return counts


_drawn_again = lru_cache(4)(_drawn)
"""The same, if they were drawn before for another :class:`Bootstrap`; nobody changes them."""


def spread(values: Floats) -> tuple[float, float]:
    """About where the means of values, float64 [S], are in resamples: their mean and deviation."""
    return float(values.mean()), float(values.std()) / math.sqrt(len(values))


def quantiles(
    values: Floats, at: tuple[float, float], middle: float | None = None, spread: float = 0.0
) -> tuple[float, float]:
    """What ``numpy.quantile`` gives of values [N] without NaN, to the bit, in a part of its time.

    Args:
        values: float64 [N].
        at: of two quantiles the lower and the upper.
        middle, spread: mean and standard deviation, perhaps rough; the nearer, the faster.
    """
    places = [(len(values) - 1) * q for q in at]
    low, high = math.floor(places[0]), math.floor(places[1])
    if middle is None:
        middle, spread = float(values.mean()), float(values.std())
    # some of the lowest and of the highest are most often enough
    lowest = values.compress(values < middle - _tail(at[0]) * spread)
    highest = values.compress(values > middle + _tail(1 - at[1]) * spread)
    left_out, last = len(values) - len(highest), len(values) - 1
    if low + 1 < len(lowest) and high >= left_out:
        lowest.partition((low, low + 1))
        highest.partition((high - left_out, min(high + 1, last) - left_out))
    else:
        lowest = highest = np.sort(values)
        left_out = 0
    lower = _between(lowest[low], lowest[min(low + 1, last)], places[0] - low)
    upper = highest[high - left_out], highest[min(high + 1, last) - left_out]
    return lower, _between(*upper, places[1] - high)


@lru_cache(16)
def _tail(share: float) -> float:
    """Beyond how many standard deviations twice so large a share of normal values lies."""
    return NormalDist().inv_cdf(1 - min(2 * share, 0.5)) if share > 0 else 0.0


def _between(below: float, above: float, part: float) -> float:
    """A point on the way from one value to the next, in NumPy's order of operations."""
    below, above = float(below), float(above)
    step = above - below
    return below + step * part if part < 0.5 else above - step * (1 - part)


def holm(ps: Sequence[float]) -> list[float]:
    """p-values corrected for their number, in their order.

    Source: Holm, "A Simple Sequentially Rejective Multiple Test Procedure", 1979.
    """
    corrected, least = [0.0] * len(ps), 0.0
    for rank, i in enumerate(sorted(range(len(ps)), key=ps.__getitem__)):
        least = max(least, min(1.0, ps[i] * (len(ps) - rank)))
        corrected[i] = least
    return corrected


def summarise(
    table: pd.DataFrame,
    baselines: Sequence[str] = ("hold", "kalman"),
    metrics: Sequence[str] = ("auc", "dp20"),
    resamples: int = RESAMPLES,
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
        metrics: those to summarise, in the order of the rows.
        resamples, seed: of the :class:`Bootstrap`.
        confidence: of the intervals, between 0 and 1.

    Returns:
        One row per trace, latency, scale, sigma, forecaster and metric, each (metrics apart) in the
        order of its first appearance, with ``sequences`` (how many count), ``mean``, ``low``,
        ``high`` and:

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
    bootstrap = Bootstrap(resamples, seed, ((1 - confidence) / 2, (1 + confidence) / 2))
    parts = []
    keys = [key for key in order if key != "forecaster"]
    for values, group in wide.groupby(keys, sort=False):
        present = [name for name in order["forecaster"] if group[name].notna().any()]
        group = group.dropna(subset=[name for name in present if name != "offline"])
        present = [name for name in present if group[name].notna().all()]
        if group.empty or not present:
            continue
        scores = np.ascontiguousarray(group[present].to_numpy(np.float64).T)
        part = pd.DataFrame(_summary_rows(scores, present, baselines, bootstrap))
        parts.append(part.assign(forecaster=present, **dict(zip(keys, values))))
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
    if (summary["sequences"] == 1).all():
        summary.attrs["method"] += (
            "\none sequence alone: intervals have no width, and no test can tell anything apart"
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
    """The tidy table of the plain means over permitted latencies: metrics mauc, mdp20, ...

    Over 0, 0.02, ..., 1 these are mAUC and mDP of Li et al., "PVT++", 2023. ``sigma`` is 0 in all.
    Of modelled scores they are ``modelled_mauc``, ...
    """
    keys = [column for column in table if column not in ("sigma", "value")]
    means = table.groupby(keys, sort=False)["value"].mean().reset_index()
    return means.assign(metric=means["metric"].map(mean_over_sigmas), sigma=0.0)


def mean_over_sigmas(metric: str) -> str:
    """The name of a metric's mean over permitted latencies."""
    return f"modelled_m{metric[9:]}" if metric.startswith("modelled_") else f"m{metric}"


def _wide(table: pd.DataFrame, metrics: Sequence[str]) -> tuple[pd.DataFrame, dict[str, list[Any]]]:
    """A column for each forecaster, all traces last; and each key's values as they appear."""
    import pandas as pd

    missing = set(KEYS[1:] + ["dataset", "sequence", "value"]) - set(table)
    if missing:
        raise LaeError(f"the table of a comparison lacks the columns {listed(sorted(missing))}")
    table = table[table["metric"].isin(list(metrics))]
    keys = [key for key in KEYS if key in table]
    order = {key: list(table[key].unique()) for key in keys}
    order["metric"] = [metric for metric in metrics if metric in order["metric"]]
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


def _summary_rows(
    scores: Floats, names: Sequence[str], baselines: Sequence[str], bootstrap: Bootstrap
) -> list[dict[str, Any]]:
    """The columns of one group from its scores [F, S], a row for each of its F forecasters."""
    means = bootstrap.means(scores)
    place = {name: f for f, name in enumerate(names)}
    hold, offline = place.get("hold"), place.get("offline")
    rows = []
    for f in range(len(names)):
        interval = bootstrap.interval(means[f])
        row: dict[str, Any] = {
            "sequences": scores.shape[1],
            "mean": float(scores[f].mean()),
            "low": interval.low,
            "high": interval.high,
        }
        for baseline in baselines:
            b, difference = place.get(baseline), None
            if b is not None:
                one, other = slice(f, f + 1), slice(b, b + 1)
                [difference] = bootstrap.differences(
                    scores[one], scores[other], means[one], means[other]
                )
            row |= _difference_columns(f"vs_{baseline}", difference)
        share, ends = None, None
        if hold is not None and offline is not None:
            won, lost = (float(scores[i].mean() - scores[hold].mean()) for i in (f, offline))
            recovery = bootstrap.recover(
                won, lost, means[f] - means[hold], means[offline] - means[hold]
            )
            share, ends = recovery.share, recovery.interval
        row["recovered"] = math.nan if share is None else share
        row |= (ends or _UNKNOWN).columns("recovered")
        rows.append(row)
    return rows


_UNKNOWN = Interval(math.nan, math.nan)


def _difference_columns(name: str, difference: Difference | None) -> dict[str, float]:
    """The columns of a difference to a baseline, NaN and 0 where there is no such baseline."""
    if difference is None:
        difference = Difference(math.nan, _UNKNOWN, math.nan, 0, 0)
    return {
        name: difference.value,
        **difference.interval.columns(name),
        f"{name}_p": difference.p,
        f"{name}_better": difference.better,
        f"{name}_worse": difference.worse,
    }


def signed_rank_p(differences: Floats) -> float:
    """Two-sided p of Wilcoxon's signed-rank test.

    Source: Wilcoxon, "Individual Comparisons by Ranking Methods", 1945. Zeros leave first, as he
    has it; if nothing is left, p is 1. It is exact for up to 50 differences, ties or not: all signs
    are counted; else normal, corrected for ties. (scipy.stats takes a second to import.)

    Args:
        differences: paired, float64 [S].
    """
    return signed_rank_ps(differences[None])[0]


def signed_rank_ps(differences: Floats) -> list[float]:
    """:func:`signed_rank_p` of each row of differences, float64 [P, S].

    Signs are counted once for all rows whose ranks are the same, as they are without ties.
    """
    size = differences.shape[1]
    order = np.argsort(np.abs(differences), axis=1)
    ordered = np.take_along_axis(differences, order, axis=1)
    sizes, is_positive = np.abs(ordered), ordered > 0
    # first and last place of each one's group of ties
    place = np.arange(size)
    new = np.ones_like(is_positive)
    new[:, 1:] = sizes[:, 1:] != sizes[:, :-1]
    first = np.maximum.accumulate(np.where(new, place, 0), axis=1)
    last = np.full_like(first, size - 1)
    last[:, :-1] = np.where(new[:, 1:], place[:-1], size - 1)
    last = np.minimum.accumulate(last[:, ::-1], axis=1)[:, ::-1]
    zeros = (sizes == 0).sum(axis=1)
    # twice the mean rank of each group of ties; 0 of what is left out
    doubled = np.where(sizes == 0, 0, first + last + 2 - 2 * zeros[:, None])
    positive = (doubled * is_positive).sum(axis=1).tolist()
    tied = np.where(sizes == 0, 0, (last - first + 1) ** 2 - 1).sum(axis=1).tolist()
    ways: dict[bytes, Floats] = {}
    ps = []
    for row, left_out in enumerate(zeros.tolist()):
        count = size - left_out
        if not count:
            ps.append(1.0)
        elif count > 50:
            variance = count * (count + 1) * (2 * count + 1) / 24 - tied[row] / 48
            deviation = abs(positive[row] / 2 - count * (count + 1) / 4) / math.sqrt(variance)
            ps.append(math.erfc(deviation / math.sqrt(2)))
        else:
            ranks = doubled[row, left_out:]
            if (key := ranks.tobytes()) not in ways:
                ways[key] = _ways(ranks.tolist())
            # of all signs, those whose sum is as small, or as large: the sums lie evenly
            least = min(positive[row], count * (count + 1) - positive[row])
            ps.append(min(1.0, 2 * float(ways[key][least]) / 2.0**count))
    return ps


def _ways(ranks: Sequence[int]) -> Floats:
    """How many choices of signs have at most each sum of positive ranks, of at most 50 ranks.

    The coefficients of the product of ``1 + x**rank``, which has 64 bits of one number for each:
    there are 2**50 choices at most.
    """
    product = 1
    for rank in ranks:
        product += product << (64 * rank)
    words = np.frombuffer(product.to_bytes(8 * (sum(ranks) + 1), "little"), "<u8")
    return np.cumsum(words).astype(np.float64)
