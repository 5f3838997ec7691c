"""Sums over sequences, taken group after group: what means need, however many sequences there are.

A replay's report says means over all sequences. Their scores at 51 permitted latencies are some
thousand numbers a sequence, and the curves another two hundred: no more of them is kept than their
sums.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.evaluation.evaluate import Curves, Evaluation, ReplayStatistics, Staleness
from lae_sim.evaluation.metrics import METRICS
from lae_sim.evaluation.modelled import MODELLED, interval, named_figures, over_sigmas
from lae_sim.replay.search import SearchModel

RECOVERED = ("auc", "dp20")
"""The metrics of which a share of the latency loss can be recovered."""


def recovered(won: float, lost: float) -> float | None:
    """The share of the latency loss won back; None without a loss.

    Args:
        won: forecast - hold, of means or sums of scores over some sequences.
        lost: offline - hold, over the same.
    """
    return won / lost if lost > 0 else None


class Mean:
    """A mean over sequences of arrays of numbers, of which those that are NaN leave it."""

    def __init__(self) -> None:
        self.total: Floats = np.zeros(())
        self._counts: Ints = np.zeros((), np.int64)

    def add(self, values: Floats, axis: int = -1) -> None:
        """Add some sequences, one after another along an axis."""
        known = ~np.isnan(values)
        values = np.ascontiguousarray(values if known.all() else np.where(known, values, 0.0))
        self.total = self.total + values.sum(axis=axis)
        self._counts = self._counts + known.sum(axis=axis)

    @property
    def value(self) -> Floats:
        """The mean so far; NaN of nothing."""
        return self.total / np.where(self._counts > 0, self._counts, np.nan)


class Changes:
    """What F forecasters win over hold at M permitted latencies, added up over sequences.

    Attributes:
        won: forecast - hold, of the sequences where this and what was lost are known.
        lost: offline - hold, of the same.
    """

    def __init__(self, hold: int) -> None:
        """With the index of hold."""
        self._hold = hold
        self.won, self.lost = Mean(), Mean()

    def add(self, scores: Floats, offline: Floats) -> None:
        """Add some sequences: their scores, float64 [F, M, S], and the offline ones, [S]."""
        hold = scores[self._hold]
        won, lost = scores - hold, np.broadcast_to(offline - hold, scores.shape)
        counted = ~np.isnan(won + lost)
        self.won.add(np.where(counted, won, np.nan))
        self.lost.add(np.where(counted, lost, np.nan))

    def recovered(self, f: int, m: int) -> float | None:
        """The share of the latency loss that a forecaster wins back; None without a loss."""
        return recovered(float(self.won.total[f, m]), float(self.lost.total[f, m]))


class ScoreTotals:
    """Scores of F forecasters at M permitted latencies, added up over sequences.

    Attributes:
        sequences: how many there are.
        complete: whether the trace holds every frame of all of them.
    """

    def __init__(self, hold: int) -> None:
        """With the index of the forecaster that others are to do better than."""
        self.sequences = 0
        self.complete = True
        self._scores = {metric: Mean() for metric in METRICS}
        self._offline = {metric: Mean() for metric in METRICS}
        self._changes = {metric: Changes(hold) for metric in RECOVERED}

    def add(self, part: Evaluation, which: slice | Sequence[int] = slice(None)) -> None:
        """Add some sequences of a part."""
        missing = part.replay.missing[which]
        self.sequences += len(missing)
        self.complete = self.complete and not missing.any()
        for metric in METRICS:
            scores = part.scores[metric][:, which].transpose(0, 2, 1)  # [F, M, S]
            offline = part.offline[metric][which]
            self._scores[metric].add(scores)
            self._offline[metric].add(offline)
            if metric in RECOVERED and self.complete:
                self._changes[metric].add(scores, offline)

    def mean(self, metric: str) -> Floats:
        """Mean scores, float64 [F, M]; NaN if no sequence counts."""
        return self._scores[metric].value

    def offline(self, metric: str) -> float:
        """The mean of the trace's own boxes; NaN unless it is complete and a sequence counts."""
        return float(self._offline[metric].value) if self.complete else np.nan

    def changes(self, metric: str) -> Changes:
        """What forecasters win over hold, and what there is to win."""
        return self._changes[metric]


class CurveTotals:
    """Mean success and precision curves of F forecasters and of the offline boxes.

    Attributes:
        complete: whether the trace holds every frame of all sequences.
    """

    def __init__(self) -> None:
        self.complete = True
        self._means = tuple(Mean() for _ in range(4))

    def add(self, part: Evaluation) -> None:
        """Add the sequences of a part."""
        self.complete = self.complete and not part.replay.missing.any()
        arrays = (
            part.curves.success,
            part.curves.precision,
            part.offline_curves.success,
            part.offline_curves.precision,
        )
        for mean, values in zip(self._means, arrays):
            mean.add(values, axis=-2)

    def curves(self, f: int) -> Curves:
        """Those of a forecaster, NaN if no sequence counts."""
        success, precision, *_ = self._means
        return Curves(success.value[f], precision.value[f])

    @property
    def offline(self) -> Curves:
        """Those of the offline boxes, NaN if no sequence has all of them and counts."""
        *_, success, precision = self._means
        return Curves(success.value, precision.value)


class ModelledTotals:
    """Scores under the search model, added up over sequences.

    Attributes:
        known: see :class:`.modelled.ModelledScores`; None too as long as nothing is scored.
        applies: number of scored sequences whose replay is not exact.
        unexplained: see :class:`.modelled.ModelledScores`.
    """

    def __init__(self, hold: int) -> None:
        """With the index of the forecaster that others are to do better than."""
        self.known: bool | None = None
        self.applies = 0
        self.unexplained: Mapping[str, float] = {}
        self._draws: dict[str, Floats] = dict.fromkeys(MODELLED, np.zeros(()))
        self._scores = {metric: Mean() for metric in MODELLED}
        self._changes = {metric: Changes(hold) for metric in MODELLED}
        self._outputs = self._lost_outputs = 0.0

    def add(self, part: Evaluation) -> None:
        """Add the sequences of a part."""
        modelled, outputs = part.modelled, part.replay.processed
        if self.known is None:
            self.known = modelled.known if part.replay.scored.any() else None
            self.unexplained = modelled.unexplained
        self.applies += int((modelled.applies & part.replay.scored).sum())
        self._outputs += float(outputs.sum())
        self._lost_outputs += float(modelled.lost_share @ outputs)
        for metric in MODELLED:
            self._draws[metric] = self._draws[metric] + modelled.draws[metric]
            scores = modelled.mean[metric].transpose(0, 2, 1)
            self._scores[metric].add(scores)
            self._changes[metric].add(scores, part.offline[metric])

    @property
    def lost_share(self) -> float:
        """Share of the outputs answered while the target is lost, 0..1."""
        return self._lost_outputs / self._outputs if self._outputs else 0.0

    def draws(self, metric: str) -> Floats:
        """Joint draws over all sequences, float64 [2, F, J, M] (see :class:`.ModelledScores`)."""
        return self._draws[metric]

    def figures(self, over_grid: bool = False) -> dict[str, Floats]:
        """Mean scores and the ends of their intervals, by the names of :data:`.modelled.FIGURES`.

        Args:
            over_grid: whether they are of the plain means over the permitted latencies.

        Returns:
            float64 [F, M]; with ``over_grid`` [F, 1].
        """
        means, lows, highs = {}, {}, {}
        for metric in MODELLED:
            draws = self.draws(metric)
            mean = self._scores[metric].value
            if over_grid:
                draws, mean = over_sigmas(draws), mean.mean(axis=1, keepdims=True)
            ends = interval(draws, bool(self.known), self.unexplained[metric], self.applies)
            means[metric], (lows[metric], highs[metric]) = mean, ends
        return named_figures(means, lows, highs)

    def changes(self, metric: str) -> Changes:
        """What forecasters win over hold by the modelled scores, and what there is to win."""
        return self._changes[metric]


def search_report(
    search: SearchModel | None, pre_forecaster: str | None, totals: ModelledTotals
) -> dict[str, Any] | None:
    """What the search model rests on; None where it says nothing of a trace."""
    if search is None or totals.known is None:
        return None
    reach = search.reach
    return {
        "source": search.source,
        "c_known": search.known,
        "c_low": float(search.reaches[0]) if np.isfinite(search.reaches[0]) else None,
        "c_high": float(search.reaches[-1]) if np.isfinite(search.reaches[-1]) else None,
        "reach": None if reach is None else {"centre": reach.centre, "spread": reach.spread},
        "own_jumps": len(search.jumps),
        "pre_forecaster": pre_forecaster,
        "keep_size": search.keep_size,
        "sequences": totals.applies,
        "lost_share": totals.lost_share,
    }


class Totals:
    """All that is said of a trace as a whole.

    Attributes:
        scores: over all sequences.
        modelled: the same under the search model.
        by_attribute: over those of each attribute.
        curves: over all sequences.
    """

    def __init__(self, hold: int) -> None:
        """With the index of the forecaster that others are to do better than."""
        self.scores = ScoreTotals(hold)
        self.by_attribute: dict[str, ScoreTotals] = {}
        self.modelled = ModelledTotals(hold)
        self.curves = CurveTotals()
        self._hold = hold
        self._replays: list[ReplayStatistics] = []
        self._staleness: list[Staleness] = []

    def add(self, part: Evaluation, members: Mapping[str, Sequence[int]] | None = None) -> None:
        """Add a group, with the indices of its sequences of each attribute."""
        self.scores.add(part)
        self.modelled.add(part)
        self.curves.add(part)
        for name, which in (members or {}).items():
            self.by_attribute.setdefault(name, ScoreTotals(self._hold)).add(part, which)
        self._replays.append(part.replay)
        staleness = part.staleness
        self._staleness.append(
            Staleness(
                staleness.mismatch_sum.sum(axis=0, keepdims=True),
                staleness.mismatch_max.max(axis=0, keepdims=True),
                staleness.longest_hold.max(axis=0, keepdims=True),
                staleness.age_sum.sum(axis=0, keepdims=True),
                staleness.age_max.max(axis=0, keepdims=True),
                staleness.longest_stale.max(axis=0, keepdims=True),
            )
        )

    @property
    def replay(self) -> ReplayStatistics:
        """How all sequences were replayed."""
        return ReplayStatistics.joined(self._replays)

    @property
    def staleness(self) -> Staleness:
        """How old the answers are over all sequences: the sums and the maxima, [M]."""
        return Staleness(
            np.sum([each.mismatch_sum for each in self._staleness], axis=(0, 1)),
            np.max([each.mismatch_max for each in self._staleness], axis=(0, 1)),
            np.max([each.longest_hold for each in self._staleness], axis=(0, 1)),
            np.sum([each.age_sum for each in self._staleness], axis=(0, 1)),
            np.max([each.age_max for each in self._staleness], axis=(0, 1)),
            np.max([each.longest_stale for each in self._staleness], axis=(0, 1)),
        )
