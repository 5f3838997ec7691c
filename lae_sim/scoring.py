"""Scoring answers: shares of frames and curves, for any number of permitted latencies at once.

Each distinct pair of a world frame and an output is scored once, and its counts are added over the
range of sigmas that it answers by difference arrays; counts are integers, so that no order of
summation changes a result.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lae_sim.boxes import Floats
from lae_sim.engine import Ints
from lae_sim.metrics import (
    CENTRE_THRESHOLDS,
    METRICS,
    NORM_THRESHOLDS,
    Convention,
    FrameCounts,
    frame_counts,
)
from lae_sim.pairing import Histories, Pairs
from lae_sim.run import Run


@dataclass(frozen=True, eq=False)
class Scored:
    """One forecaster's part of a :class:`lae_sim.evaluation.Evaluation`: without its axis F."""

    scores: Mapping[str, Floats]
    failure: Ints
    success: Floats
    precision: Floats


class Scorer:
    """Scores answers of some runs against their truth."""

    def __init__(self, runs: Sequence[Run], convention: Convention) -> None:
        self._convention = convention
        self._lengths = np.array([len(run.recording) for run in runs], np.int64)
        self._bases = np.cumsum(self._lengths) - self._lengths
        self._truth = np.concatenate([run.recording.truth for run in runs])
        self._boxes = np.concatenate([run.recording.boxes for run in runs])
        counted = self._lengths
        if convention.leaves_out:
            valid = convention.valid_success(self._truth)
            counted = np.add.reduceat(valid.astype(np.int64), self._bases)
        self._counted = np.where(counted > 0, counted, np.nan)

    def of(self, parts: Iterable[tuple[Histories, Pairs, Floats]], count: int) -> Scored:
        """Score paired answers for so many sigmas."""
        return self._scored(
            (
                (fed.sequence[np.searchsorted(fed.offsets, found.item, "right") - 1], found, boxes)
                for fed, found, boxes in parts
            ),
            count,
        )

    def offline(self) -> Scored:
        """Score every frame's own box; NaN for sequences that lack some."""
        sequence = np.repeat(np.arange(len(self._bases)), self._lengths)
        frame = np.arange(len(self._truth)) - self._bases[sequence]
        none = np.zeros_like(frame)
        scored = self._scored([(sequence, Pairs(frame, frame, none, none + 1), self._boxes)], 1)
        missing = np.add.reduceat(np.isnan(self._boxes[:, 0]).astype(np.int64), self._bases) > 0
        for values in (*scored.scores.values(), scored.success, scored.precision):
            values[missing] = np.nan
        return scored

    def _scored(self, parts: Iterable[tuple[Ints, Pairs, Floats]], count: int) -> Scored:
        """Score answers, each part with the sequence of each pair, int64 [P]."""
        tally = _Tally(self._lengths, count, self._convention.thresholds)
        for sequence, found, boxes in parts:
            truth = self._truth[self._bases[sequence] + found.frame]
            counts = frame_counts(truth, boxes, found.frame, self._convention)
            tally.add(sequence, found, counts)
        thresholds = {"auc": self._convention.thresholds, "norm_auc": len(NORM_THRESHOLDS)}
        counted = self._counted[:, None]
        scores = {m: tally.sums[m] / (counted * thresholds.get(m, 1)) for m in METRICS}
        success, precision = tally.success / counted, tally.precision / counted
        if self._convention.drops_zeros:
            bests = ("auc", "within50", "norm_auc", "norm_auc")
            for metric, best in zip(METRICS, bests):
                scores[metric] = np.where(tally.sums[best] > 0, scores[metric], np.nan)
            success[np.isnan(scores["auc"][:, 0])] = np.nan
            precision[np.isnan(scores["dp20"][:, 0])] = np.nan
        return Scored(scores, tally.failure, success, precision)


class _Tally:
    """Sums of what pairs count, by sequence and sigma."""

    def __init__(self, lengths: Ints, count: int, thresholds: int) -> None:
        self._count, self._sequences = count, len(lengths)
        names = (*METRICS, "within50")
        self.sums = {name: np.zeros((len(lengths), count), np.int64) for name in names}
        self.failure = np.repeat(lengths[:, None], count, axis=1)
        self.success = np.zeros((len(lengths), thresholds))
        self.precision = np.zeros((len(lengths), len(CENTRE_THRESHOLDS)))

    def add(self, sequence: Ints, found: Pairs, counts: FrameCounts) -> None:
        """Add pairs, whose frames ascend in each sequence at each sigma."""
        width = self._count + 1
        begin, end = sequence * width + found.sigma_from, sequence * width + found.sigma_to
        size = self._sequences * width
        columns = {
            "auc": counts.success,
            "dp20": counts.dp,
            "norm_dp20": counts.norm_dp,
            "norm_auc": counts.norm,
            "within50": counts.within50,
        }
        for name, values in columns.items():
            steps = np.bincount(begin, values, size) - np.bincount(end, values, size)
            sums = steps.reshape(-1, width).cumsum(axis=1)[:, : self._count]
            self.sums[name] += sums.astype(np.int64)
        first = found.sigma_from == 0
        of_first = sequence[first]
        for curves, passed in (
            (self.success, counts.success),
            (self.precision[:, ::-1], counts.precision),
        ):
            curves += _above(of_first, passed[first], *curves.shape)
        self._note_failures(sequence, found, np.flatnonzero(counts.apart))

    def _note_failures(self, sequence: Ints, found: Pairs, lost: Ints) -> None:
        """Note the first pair of each sequence and sigma that is lost."""
        sequence, frame = sequence[lost], found.frame[lost]
        begin, end = found.sigma_from[lost], found.sigma_to[lost]
        for m in range(self._count):
            of_m = np.flatnonzero((begin <= m) & (m < end))
            those = sequence[of_m]
            first = np.flatnonzero(np.diff(those, prepend=-1))
            self.failure[those[first], m] = frame[of_m[first]]


def _above(sequence: Ints, passed: Ints, sequences: int, most: int) -> Ints:
    """How many frames passed more than 0, 1, ..., ``most`` - 1 thresholds, int64 [S, most]."""
    width = most + 1
    counts = np.bincount(sequence * width + passed, minlength=sequences * width)
    above: Ints = counts.reshape(-1, width)[:, :0:-1].cumsum(axis=1)[:, ::-1]
    return above
