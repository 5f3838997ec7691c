"""Latency-aware and offline scores of runs, per sequence, for any number of permitted latencies.

Each distinct pair of a world frame and an output is scored once, and its counts are added over the
range of sigmas that it answers by difference arrays; counts are integers, so that no order of
summation changes a result.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim.boxes import Bools, Floats
from lae_sim.engine import Ints
from lae_sim.errors import LaeError, explained
from lae_sim.forecast import AnyFactory, Lanes, SequenceFactory, forecast, own
from lae_sim.metadata import Metadata
from lae_sim.metrics import (
    CENTRE_THRESHOLDS,
    METRICS,
    NORM_THRESHOLDS,
    PYSOT,
    Convention,
    frame_counts,
)
from lae_sim.pairing import Histories, Pairing, Pairs, histories, pair, pairs
from lae_sim.run import Run
from lae_sim.trace import BATCH_ROWS, batched


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of S sequences, F forecasters and M permitted latencies.

    Attributes:
        sequences: names, S of them.
        frames: world frames of each, int64 [S].
        truthless: world frames of each that have no ground truth, int64 [S].
        missing: world frames of each without a box in the trace, int64 [S].
        processed: processed frames of each, int64 [S].
        departures: see :class:`lae_sim.run.Run`, int64 [S].
        disagreement: see :class:`lae_sim.run.Run`, float64 [S].
        init_ns: time of the initialisation, int64 [S].
        calls_ns: total time of the other calls, int64 [S].
        calls_hz: sum of 1/elapsed over the other calls, per second, [S]; infinite if one took 0.
        mismatch_sum, mismatch_max: of i - psi(i), frames, int64 [S, M].
        longest_hold: most queries in a row with one answering output, frames, int64 [S, M].
        scores: per metric of ``METRICS``, float64 [F, S, M] in 0..1; NaN = leaves the mean.
        failure: the first world frame whose answer does not overlap the truth at all, int64
            [F, S, M]; the number of world frames if there is none.
        success: over the convention's IoU thresholds at the first sigma, float64 [F, S, N]; NaN as
            in the scores.
        precision: over 0, 1, ..., 50 px at the first sigma, float64 [F, S, 51].
        offline: per metric, of the trace's boxes at their own frames, float64 [S]; NaN where the
            trace does not hold every frame.
        offline_success, offline_precision: their curves, float64 [S, N] and [S, 51].
    """

    sequences: tuple[str, ...]
    frames: Ints
    truthless: Ints
    missing: Ints
    processed: Ints
    departures: Ints
    disagreement: Floats
    init_ns: Ints
    calls_ns: Ints
    calls_hz: Floats
    mismatch_sum: Ints
    mismatch_max: Ints
    longest_hold: Ints
    scores: Mapping[str, Floats]
    failure: Ints
    success: Floats
    precision: Floats
    offline: Mapping[str, Floats]
    offline_success: Floats
    offline_precision: Floats

    @classmethod
    def joined(cls, parts: Sequence[Evaluation]) -> Evaluation:
        """The evaluations of some groups of sequences as one."""
        by_forecaster = ("failure", "success", "precision")
        columns = {
            field.name: np.concatenate(
                [getattr(part, field.name) for part in parts], axis=int(field.name in by_forecaster)
            )
            for field in fields(cls)
            if field.name not in ("sequences", "scores", "offline")
        }
        return cls(
            sequences=tuple(name for part in parts for name in part.sequences),
            scores={m: np.concatenate([p.scores[m] for p in parts], axis=1) for m in METRICS},
            offline={m: np.concatenate([p.offline[m] for p in parts]) for m in METRICS},
            **columns,
        )


def evaluate(
    runs: Iterable[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction] = (Fraction(0),),
    convention: Convention = PYSOT,
    at_arrival: bool = False,
    costs: Mapping[str, int] | None = None,
) -> Evaluation:
    """Score the runs of one trace, in groups, so that memory does not grow with the trace.

    Args:
        runs: one per sequence, all of one clock.
        metadata: of the trace, for image sizes.
        forecasters: factories by name.
        sigmas: distinct permitted latencies in frames, ascending.
        convention: how frames and thresholds count.
        at_arrival: score outputs at their own frames, as VOT does (see :func:`pair`).
        costs: what an answer costs, ns, by forecaster; 0 if not named. It delays the answers.

    Raises:
        LaeError: if there is no run or no forecaster, or whatever iterating over the runs raises.
    """
    parts = list(
        evaluate_groups(runs, metadata, forecasters, sigmas, convention, at_arrival, costs)
    )
    if not parts:
        raise LaeError("there is nothing to evaluate: no sequences")
    return Evaluation.joined(parts)


def evaluate_groups(
    runs: Iterable[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction] = (Fraction(0),),
    convention: Convention = PYSOT,
    at_arrival: bool = False,
    costs: Mapping[str, int] | None = None,
    frames: int = BATCH_ROWS,
) -> Iterator[Evaluation]:
    """The same, group after group of sequences, for those who keep less than all of it.

    The larger the groups (of about ``frames`` world frames), the faster, and the more memory.
    """
    if not forecasters:
        raise LaeError("name at least one forecaster, such as hold")
    for group in batched(runs, frames):
        yield _evaluate_group(
            group, metadata, forecasters, sigmas, convention, at_arrival, costs or {}
        )


def _evaluate_group(
    runs: Sequence[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction],
    convention: Convention,
    at_arrival: bool,
    costs: Mapping[str, int],
) -> Evaluation:
    """Score some runs at once."""
    schedules = [run.schedule for run in runs]
    needed = {0, *(costs.get(name, 0) for name in forecasters)}
    pairings = {cost: pair(schedules, sigmas, at_arrival, cost) for cost in needed}
    pairing = pairings[0]
    scorer = _Scorer(runs, convention)
    scored = [
        scorer.of(*_answers(runs, metadata, pairings[costs.get(name, 0)], name, factory), sigmas)
        for name, factory in forecasters.items()
    ]
    offline = scorer.offline()
    calls = [run.schedule.elapsed_ns[1:] for run in runs]
    return Evaluation(
        sequences=tuple(run.recording.name for run in runs),
        frames=pairing.lengths,
        truthless=np.array([np.isnan(run.recording.truth[:, 0]).sum() for run in runs], np.int64),
        missing=np.array([np.isnan(run.recording.boxes[:, 0]).sum() for run in runs], np.int64),
        processed=np.diff(pairing.offsets),
        departures=np.array([run.departures for run in runs], np.int64),
        disagreement=np.array([run.disagreement for run in runs]),
        init_ns=np.array([run.schedule.elapsed_ns[0] for run in runs], np.int64),
        calls_ns=np.array([elapsed.sum() for elapsed in calls], np.int64),
        calls_hz=np.array([_rates(elapsed).sum() for elapsed in calls]),
        mismatch_sum=pairing.mismatch_sum,
        mismatch_max=pairing.mismatch_max,
        longest_hold=pairing.longest_hold,
        scores={m: np.stack([each.scores[m] for each in scored]) for m in METRICS},
        failure=np.stack([each.failure for each in scored]),
        success=np.stack([each.success for each in scored]),
        precision=np.stack([each.precision for each in scored]),
        offline={metric: share[:, 0] for metric, share in offline.scores.items()},
        offline_success=offline.success,
        offline_precision=offline.precision,
    )


def _rates(elapsed_ns: Ints) -> Floats:
    """Frames per second of each call, infinite for one that took no time."""
    rates = np.full(len(elapsed_ns), np.inf)
    np.divide(1e9, elapsed_ns, out=rates, where=elapsed_ns > 0)
    return rates


@dataclass(frozen=True, eq=False)
class Answers:
    """The answer for every world frame of one sequence at one sigma.

    Attributes:
        source_frame: psi(i), the frame of the output it comes from, int64 [T].
        boxes: float64 [T, 4].
    """

    source_frame: Ints
    boxes: Floats


def answers(
    run: Run,
    metadata: Metadata,
    name: str,
    factory: AnyFactory,
    sigma: Fraction = Fraction(0),
    at_arrival: bool = False,
    cost_ns: int = 0,
) -> Answers:
    """What a forecaster answers for every world frame of one run."""
    pairing = pair([run.schedule], [sigma], at_arrival, cost_ns)
    fed, found, boxes = _answers([run], metadata, pairing, name, factory)
    return Answers(pairing.frames[fed.output[found.item]], boxes)


def lanes_of(runs: Sequence[Run], pairing: Pairing, fed: Histories, image_sizes: Floats) -> Lanes:
    """What forecasters are fed in some histories of some runs.

    Args:
        runs: those that were paired.
        pairing: of their schedules.
        fed: histories of the pairing.
        image_sizes: of each run, float64 [S, 2], infinite = unknown.
    """
    boxes = np.concatenate([run.boxes for run in runs])
    frames = pairing.frames[fed.output]
    return Lanes(fed.offsets, frames, boxes[fed.output], image_sizes[fed.sequence])


def _answers(
    runs: Sequence[Run],
    metadata: Metadata,
    pairing: Pairing,
    name: str,
    factory: AnyFactory,
) -> tuple[Histories, Pairs, Floats]:
    """The distinct pairs of a forecaster with their boxes, float64 [P, 4]."""
    if getattr(factory, "sees_frames", False) and pairing.sigmas[0] < 0:
        raise LaeError(
            f"{name} sees frames when they arrive: not before, as sigma < 0 would have it"
        )
    fed = histories(pairing, memoryless=own(factory, "memoryless"))
    found = pairs(pairing, fed)
    sizes = [metadata.image_size(run.recording.name) or (np.inf, np.inf) for run in runs]
    lanes = lanes_of(runs, pairing, fed, np.array(sizes, np.float64))
    if not isinstance(factory, SequenceFactory):
        return fed, found, forecast(factory, lanes, found.item, found.frame, name)
    with explained(name):
        factories = [factory.for_sequence(run.recording) for run in runs]
    answered = np.empty((len(found.item), 4))
    for each in {id(its): its for its in factories}.values():  # at once where several share one
        theirs = np.array([its is each for its in factories])[fed.sequence]
        part, asked, item = lanes.chosen(theirs, found.item)
        answered[asked] = forecast(each, part, item, found.frame[asked], name)
    return fed, found, answered


@dataclass(frozen=True, eq=False)
class _Scored:
    """The scores of one forecaster; see :class:`Evaluation`, without the first axis."""

    scores: Mapping[str, Floats]
    failure: Ints
    success: Floats
    precision: Floats


class _Scorer:
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

    def of(
        self, fed: Histories, found: Pairs, boxes: Floats, sigmas: Sequence[Fraction]
    ) -> _Scored:
        """Score paired answers."""
        history = np.searchsorted(fed.offsets, found.item, "right") - 1
        return self._scored(fed.sequence[history], found, boxes, len(sigmas))

    def offline(self) -> _Scored:
        """Score every frame's own box; NaN for sequences that lack some."""
        sequence = np.repeat(np.arange(len(self._bases)), self._lengths)
        frame = np.arange(len(self._truth)) - self._bases[sequence]
        none = np.zeros_like(frame)
        scored = self._scored(sequence, Pairs(frame, frame, none, none + 1), self._boxes, 1)
        missing = np.add.reduceat(np.isnan(self._boxes[:, 0]).astype(np.int64), self._bases) > 0
        for values in (*scored.scores.values(), scored.success, scored.precision):
            values[missing] = np.nan
        return scored

    def _scored(self, sequence: Ints, found: Pairs, boxes: Floats, count: int) -> _Scored:
        truth = self._truth[self._bases[sequence] + found.frame]
        counts = frame_counts(truth, boxes, found.frame, self._convention)
        width = count + 1
        begin, end = sequence * width + found.sigma_from, sequence * width + found.sigma_to

        def summed(values: npt.NDArray[Any]) -> Ints:
            size = len(self._bases) * width
            steps = np.bincount(begin, values, size) - np.bincount(end, values, size)
            return steps.reshape(-1, width).cumsum(axis=1)[:, :count].astype(np.int64)

        sums = {
            "auc": summed(counts.success),
            "dp20": summed(counts.dp),
            "norm_dp20": summed(counts.norm_dp),
            "norm_auc": summed(counts.norm),
        }
        thresholds = {"auc": self._convention.thresholds, "norm_auc": len(NORM_THRESHOLDS)}
        counted = self._counted[:, None]
        scores = {m: sums[m] / (counted * thresholds.get(m, 1)) for m in METRICS}
        at_first = found.sigma_from == 0
        success, precision = (
            _shares_above(sequence[at_first], passed[at_first], most, len(self._bases)) / counted
            for passed, most in (
                (counts.success, self._convention.thresholds),
                (counts.precision, len(CENTRE_THRESHOLDS)),
            )
        )
        if self._convention.drops_zeros:
            bests = (sums["auc"], summed(counts.within50), sums["norm_auc"], sums["norm_auc"])
            for metric, best in zip(METRICS, bests):
                scores[metric] = np.where(best > 0, scores[metric], np.nan)
            success[np.isnan(scores["auc"][:, 0])] = np.nan
            precision[np.isnan(scores["dp20"][:, 0])] = np.nan
        failure = self._failure(sequence, found, counts.apart, count)
        return _Scored(scores, failure, success, precision[:, ::-1])

    def _failure(self, sequence: Ints, found: Pairs, apart: Bools, count: int) -> Ints:
        """The first frame of each sequence whose answer is apart from the truth, int64 [S, M]."""
        failure = np.repeat(self._lengths[:, None], count, axis=1)
        lost = np.flatnonzero(apart)
        sequence, frame = sequence[lost], found.frame[lost]
        begin, end = found.sigma_from[lost], found.sigma_to[lost]
        for m in range(count):
            of_m = np.flatnonzero((begin <= m) & (m < end))  # their frames ascend in each sequence
            those = sequence[of_m]
            first = np.flatnonzero(np.diff(those, prepend=-1))
            failure[those[first], m] = frame[of_m[first]]
        return failure


def _shares_above(sequence: Ints, passed: Ints, most: int, sequences: int) -> Floats:
    """How many frames passed more than 0, 1, ..., ``most`` - 1 thresholds, float64 [S, most]."""
    width = most + 1
    counts = np.bincount(sequence * width + passed, minlength=sequences * width)
    above = counts.reshape(-1, width)[:, :0:-1].cumsum(axis=1)[:, ::-1]
    return above.astype(np.float64)
