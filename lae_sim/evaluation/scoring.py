"""Scoring answers: shares of frames and curves, for any number of permitted latencies at once.

Each distinct pair of a world frame and an output is scored once, and its counts are added over the
range of sigmas that it answers by difference arrays; counts are whole numbers, so that no order of
summation changes a result.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lae_sim._arrays import Bools, Floats, Frames, Ints
from lae_sim._compiled import compiled
from lae_sim.evaluation.metrics import (
    CENTRE_THRESHOLDS,
    METRICS,
    NORM_THRESHOLDS,
    Convention,
    FrameCounts,
    frame_counts,
    is_box,
    is_scored,
)
from lae_sim.evaluation.pairing import Histories, Pairing, Pairs, ranges
from lae_sim.trace.recording import Recording

_CHUNK = 1 << 14  # pairs at once: what is made of them stays in the cache
_LAGS = 16  # frames from an output's to the one that it answers for, of which more is kept
_SUMS = (*METRICS, "within50")
_EXACT = 52  # bits of whole numbers that float64 holds, with one to spare


@dataclass(frozen=True, eq=False)
class Scored:
    """One forecaster's part of a :class:`.evaluate.Evaluation`: without its axis F."""

    scores: Mapping[str, Floats]
    failure: Ints
    success: Floats
    precision: Floats


class Scorer:
    """Scores answers for some recordings against their truth."""

    def __init__(self, recordings: Sequence[Recording], convention: Convention) -> None:
        self._recordings, self._convention = recordings, convention
        self._lengths = np.array([len(recording) for recording in recordings], np.int64)
        self._bases = np.cumsum(self._lengths) - self._lengths
        self._truth = _columns([convention.truth_of(r.truth, r.visible) for r in recordings])
        counted = self._lengths
        if convention.leaves_out and not convention.of_all:
            valid = convention.valid_success(self._truth.T)
            counted = np.add.reduceat(valid.astype(np.int64), self._bases)
        self._is_scored = np.array([is_scored(recording.truth) for recording in recordings])
        self._counted = np.where(self._is_scored & (counted > 0), counted, np.nan)

    def of(
        self,
        which: Ints,
        parts: Iterable[tuple[Histories, Pairs, Floats]],
        count: int,
        curves_at: int = 0,
    ) -> Scored:
        """Score paired answers for so many sigmas, with the curves at one of them.

        Args:
            which: the recording of each sequence, by its place, int64 [S].
            parts: histories, their pairs and the boxes of those.
            count: number of sigmas M.
            curves_at: index of one.
        """
        return self._scored(
            which,
            (
                (np.repeat(fed.sequence, np.diff(fed.offsets)).take(paired.item), paired, boxes)
                for fed, paired, boxes in parts
            ),
            count,
            curves_at,
        )

    def held(
        self,
        which: Ints,
        pairing: Pairing,
        table: Floats,
        row: Ints,
        own: Bools,
        curves_at: int = 0,
    ) -> Scored | None:
        """Score the latest output's box as the answer to each query, in one kernel.

        It is what :meth:`of` makes of the answers of :class:`.base.Hold`, bit for bit.

        Args:
            which: the recording of each sequence, by its place, int64 [S].
            pairing: of the sequences.
            table, row: boxes, float64 [N, 4], and the row of each output's, int64 [n].
            own: whether a sequence's boxes are those of its recording, bool [S].
            curves_at: index of a permitted latency.

        Returns:
            None where there are no kernels, or not for this.
        """
        replaces = self._convention.keeps_answer and not is_box(table).all()
        if pairing.steps is None or replaces or not compiled():
            return None
        from lae_sim.evaluation.kernels import count_held

        tally = self._tally(which, len(pairing.sigmas), curves_at)
        repeats = len(which) > len(self._recordings)
        steps, success, precision = tally.empty()
        count_held(
            self._bases[which],
            self._truth,
            pairing.lengths,
            pairing.offsets,
            pairing.frames,
            pairing.steps,
            pairing.scale,
            pairing.sigmas,
            np.ascontiguousarray(table),
            row,
            own & repeats,
            self._found if repeats else np.empty((0, 0), np.int32),
            *self._rule,
            tally.curves_at,
            steps,
            success,
            precision,
            tally.failure,
        )
        tally.add_counted(steps, success, precision)
        return self._shares(which, tally)

    @cached_property
    def _found(self) -> Frames:
        """What pairs of near frames of a recording count, as kernels find out (``count_held``)."""
        return np.zeros((len(self._truth[0]), _LAGS), np.int32)

    @property
    def _rule(self) -> tuple[int, bool, bool, bool, int]:
        """The convention as kernels take it."""
        convention = self._convention
        return (
            ("size", "positive", "finite").index(convention.valid),
            convention.leaves_out,
            convention.by_centre,
            convention.first_frame_is_truth,
            convention.thresholds - 1,
        )

    def offline(self) -> Scored:
        """Score every frame's own box of each recording; NaN for those that lack some."""
        boxes = np.concatenate([recording.boxes for recording in self._recordings])
        each = np.arange(len(self._bases))
        sequence = np.repeat(each, self._lengths)
        frame = np.arange(len(sequence)) - self._bases[sequence]
        none = np.zeros_like(frame)
        scored = self._scored(each, [(sequence, Pairs(frame, frame, none, none + 1), boxes)], 1)
        missing = np.add.reduceat(np.isnan(boxes[:, 0]).astype(np.int64), self._bases) > 0
        for values in (*scored.scores.values(), scored.success, scored.precision):
            values[missing] = np.nan
        return scored

    def _scored(
        self,
        which: Ints,
        parts: Iterable[tuple[Ints, Pairs, Floats]],
        count: int,
        curves_at: int = 0,
    ) -> Scored:
        """Score answers, each part with the sequence of each pair, int64 [P]."""
        tally = self._tally(which, count, curves_at)
        counted = self._by_kernel if compiled() else self._by_numpy
        for part in parts:
            counted(tally, self._bases[which], *_kept(*part, self._convention))
        return self._shares(which, tally)

    def _tally(self, which: Ints, count: int, curves_at: int) -> _Tally:
        """Nothing counted yet, of some recordings."""
        return _Tally(self._lengths[which], count, curves_at, self._convention.thresholds)

    def _shares(self, which: Ints, tally: _Tally) -> Scored:
        """What all pairs of some recordings come to."""
        tally.failure[~self._is_scored[which]] = -1
        thresholds = {"auc": self._convention.thresholds, "norm_auc": len(NORM_THRESHOLDS)}
        every = self._counted[which, None]
        sums = tally.sums
        scores = {m: sums[m] / (every * thresholds.get(m, 1)) for m in METRICS}
        success, precision = tally.success / every, tally.precision / every
        if self._convention.drops_zeros:
            bests = ("auc", "within50", "norm_auc", "norm_auc")
            for metric, best in zip(METRICS, bests):
                scores[metric] = np.where(sums[best] > 0, scores[metric], np.nan)
            success[np.isnan(scores["auc"][:, tally.curves_at])] = np.nan
            precision[np.isnan(scores["dp20"][:, tally.curves_at])] = np.nan
        return Scored(scores, tally.failure, success, precision)

    def _by_numpy(
        self, tally: _Tally, bases: Ints, sequence: Ints, paired: Pairs, boxes: Floats
    ) -> None:
        """Count pairs, so many at once that what is made of them stays in the cache."""
        for begin in range(0, len(boxes), _CHUNK):
            now = slice(begin, begin + _CHUNK)
            some = paired.some(now)
            truth = self._truth.take(bases[sequence[now]] + some.frame, axis=1).T
            tally.add(
                sequence[now],
                some,
                frame_counts(truth, boxes[now], some.frame, self._convention),
            )

    def _by_kernel(
        self, tally: _Tally, bases: Ints, sequence: Ints, paired: Pairs, boxes: Floats
    ) -> None:
        """Count pairs one after another; equal bit for bit."""
        from lae_sim.evaluation.kernels import count_pairs

        steps, success, precision = tally.empty()
        count_pairs(
            bases,
            self._truth,
            sequence,
            paired.frame,
            paired.sigma_from,
            paired.sigma_to,
            np.ascontiguousarray(boxes),
            *self._rule,
            tally.curves_at,
            steps,
            success,
            precision,
            tally.failure,
        )
        tally.add_counted(steps, success, precision)


class _Tally:
    """Sums of what pairs count, by sequence and sigma, int64 [S, M] each.

    A pair counts for a range of sigmas: its value is added where the range begins and taken off
    where it ends, in M + 1 columns, so that a running sum along a row gives every sigma's total::

        column               0     1     2     3     4 = M
        value v for 0, 1    +v          -v
        w for 1, 2, 3             +w                -w
        running sum          v    v+w    w     w

    Counts are whole, and small in a chunk, so that several share one float64, which is exact to 53
    bits, and one ``bincount`` adds them all::

        bit   51 50             34 33             17 16              0
              |  |    within50    |   norm_dp20     |      dp20      |   17 bits each
              |       norm_auc            |            auc           |   26 bits each
              51                       26 25                         0

    A chunk has 2**14 pairs, of which each adds at most 101 to ``auc`` and 1 to ``dp20``: the sums
    take 21 and 15 bits, so that none reaches its neighbour. The steps may be negative, but each
    count in a running sum is that of some pairs, and not below zero.
    """

    def __init__(self, lengths: Ints, count: int, curves_at: int, thresholds: int) -> None:
        self._count, self.curves_at = count, curves_at
        self.sums = {name: np.zeros((len(lengths), count), np.int64) for name in _SUMS}
        self.failure = np.repeat(lengths[:, None], count, axis=1)
        self.success = np.zeros((len(lengths), thresholds))
        self.precision = np.zeros((len(lengths), len(CENTRE_THRESHOLDS)))

    def add(self, sequence: Ints, paired: Pairs, counts: FrameCounts) -> None:
        """Add at most ``_CHUNK`` pairs, whose frames ascend in each sequence at each sigma."""
        here = sequence[np.diff(sequence, prepend=-1) != 0]  # each once: they ascend
        rank = np.zeros(here[-1] + 1, np.int64)
        rank[here] = np.arange(len(here))
        local, width = rank.take(sequence), self._count + 1
        begin, end = local * width + paired.sigma_from, local * width + paired.sigma_to
        size = len(here) * width
        groups: tuple[Mapping[str, Floats | Bools], ...] = (
            {"auc": counts.success, "norm_auc": counts.norm},
            {"dp20": counts.dp, "norm_dp20": counts.norm_dp, "within50": counts.within50},
        )
        for group in groups:
            bits = _EXACT // len(group)
            packed = np.zeros(len(begin))
            for k, values in enumerate(group.values()):
                packed += values * 2.0 ** (k * bits)
            steps = np.bincount(begin, packed, size) - np.bincount(end, packed, size)
            sums = steps.reshape(-1, width).cumsum(axis=1)[:, : self._count].astype(np.int64)
            for name in group:
                self.sums[name][here] += sums & (1 << bits) - 1
                sums >>= bits
        shown = np.flatnonzero(
            (paired.sigma_from <= self.curves_at) & (self.curves_at < paired.sigma_to)
        )
        of_shown = local.take(shown)
        for curves, passed in (
            (self.success, counts.success),
            (self.precision[:, ::-1], counts.precision),
        ):
            width = curves.shape[1] + 1
            cell = of_shown * width + passed.take(shown).astype(np.int64)
            curves[here] += _above(np.bincount(cell, minlength=len(here) * width), width)
        self._note_failures(sequence, paired, np.flatnonzero(counts.apart))

    def empty(self) -> tuple[Ints, Ints, Ints]:
        """Arrays to count in for :meth:`add_counted`."""
        sequences = len(self.failure)
        return (
            np.zeros((sequences, self._count + 1, len(_SUMS)), np.int64),
            np.zeros((sequences, self.success.shape[1] + 1), np.int64),
            np.zeros((sequences, self.precision.shape[1] + 1), np.int64),
        )

    def add_counted(self, steps: Ints, success: Ints, precision: Ints) -> None:
        """Add pairs that are counted.

        Args:
            steps: values where their ranges begin, less those where they end, in the order of
                ``_SUMS``: int64 [S, M + 1, 5].
            success, precision: how many frames of the curves pass 0, 1, 2, ... thresholds, int64
                [S, thresholds + 1].
        """
        for k, name in enumerate(_SUMS):
            self.sums[name] += steps[:, :-1, k].cumsum(axis=1)
        self.success += _above(success, success.shape[1])
        self.precision += _above(precision, precision.shape[1])[:, ::-1]

    def _note_failures(self, sequence: Ints, paired: Pairs, lost: Ints) -> None:
        """Note the first pair of each sequence and sigma that is lost."""
        begin = sequence[lost] * self._count + paired.sigma_from[lost]
        sizes = paired.sigma_to[lost] - paired.sigma_from[lost]
        # of losses in a row, in which one or two outputs answer each frame, the first will do
        new = np.ones(len(lost), np.bool_)
        for back in (1, 2):
            new[back:] &= (begin[back:] != begin[:-back]) | (sizes[back:] != sizes[:-back])
        begin, sizes, lost = begin[new], sizes[new], lost[new]
        at = ranges(begin, sizes)
        np.minimum.at(self.failure.reshape(-1), at, np.repeat(paired.frame[lost], sizes))


def _kept(
    sequence: Ints, paired: Pairs, boxes: Floats, convention: Convention
) -> tuple[Ints, Pairs, Floats]:
    """The same, but for answers in whose place that for the frame before counts.

    Which that is depends on the permitted latency: a pair with such an answer, and there are few,
    becomes one for each of its sigmas.
    """
    if not convention.keeps_answer or (usable := is_box(boxes)).all():
        return sequence, paired, boxes
    replaced, sigmas, sources = [], [], []
    for s in np.unique(sequence[~usable]):
        begin, end = np.searchsorted(sequence, [s, s + 1])
        low, high = paired.sigma_from[begin:end], paired.sigma_to[begin:end]
        for m in range(high.max()):
            # at one sigma there is a pair for each frame, and they ascend
            at = begin + np.flatnonzero((low <= m) & (m < high))
            source = at[convention.kept(boxes[at])]
            others = np.flatnonzero(~usable[at])
            replaced.append(at[others])
            sigmas.append(np.full(len(others), m))
            sources.append(source[others])
    good, one_sigma = np.flatnonzero(usable), np.concatenate(sigmas)
    at, source = np.concatenate([good, *replaced]), np.concatenate([good, *sources])
    sigma_from = np.concatenate([paired.sigma_from[good], one_sigma])
    sigma_to = np.concatenate([paired.sigma_to[good], one_sigma + 1])
    order = np.lexsort(
        (paired.frame[at], sequence[at])
    )  # as they were: sequences and frames ascend
    at, source = at[order], source[order]
    kept = Pairs(paired.item[at], paired.frame[at], sigma_from[order], sigma_to[order])
    return sequence[at], kept, boxes[source]


def _columns(boxes: Sequence[Floats]) -> Floats:
    """The columns of boxes one after another, float64 [4, n], each in one piece."""
    return np.ascontiguousarray(np.concatenate(boxes).T)


def _above(counts: Ints, width: int) -> Ints:
    """How many frames passed more than 0, 1, 2, ... thresholds, int64 [S, width - 1].

    Args:
        counts: how many passed 0, 1, 2, ... of them, S rows of that width.
    """
    above: Ints = counts.reshape(-1, width)[:, :0:-1].cumsum(axis=1)[:, ::-1]
    return above
