"""Latency-aware and offline scores of runs, per sequence, for any number of permitted latencies.

Each distinct pair of a world frame and an output is scored once, and its counts are added over the
range of sigmas that it answers by difference arrays; counts are integers, so that no order of
summation changes a result.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from lae_sim.boxes import Floats
from lae_sim.engine import Ints
from lae_sim.errors import LaeError, explained
from lae_sim.forecast import AnyFactory, Lanes, SequenceFactory, forecast, own
from lae_sim.metadata import Metadata
from lae_sim.metrics import (
    METRICS,
    NORM_THRESHOLDS,
    PYSOT,
    Convention,
    FrameCounts,
    frame_counts,
)
from lae_sim.pairing import Histories, Pairing, Pairs, histories, pair, pairs
from lae_sim.run import Run
from lae_sim.trace import batched


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
        offline: per metric, of the trace's boxes at their own frames, float64 [S]; NaN where the
            trace does not hold every frame.
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
    offline: Mapping[str, Floats]

    @classmethod
    def joined(cls, parts: Sequence[Evaluation]) -> Evaluation:
        """The evaluations of some groups of sequences as one."""
        columns = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
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
    if not forecasters:
        raise LaeError("name at least one forecaster, such as hold")
    parts = [
        _evaluate_group(group, metadata, forecasters, sigmas, convention, at_arrival, costs or {})
        for group in batched(runs)
    ]
    if not parts:
        raise LaeError("there is nothing to evaluate: no sequences")
    return Evaluation.joined(parts)


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
    per_forecaster = [
        scorer.scores_of(
            *_answers(runs, metadata, pairings[costs.get(name, 0)], name, factory), len(sigmas)
        )
        for name, factory in forecasters.items()
    ]
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
        scores={m: np.stack([scores[m] for scores in per_forecaster]) for m in METRICS},
        offline=scorer.offline(),
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


class _Scorer:
    """Scores answers of some runs against their truth."""

    def __init__(self, runs: Sequence[Run], convention: Convention) -> None:
        self._convention = convention
        lengths = np.array([len(run.recording) for run in runs], np.int64)
        self._bases = np.cumsum(lengths) - lengths
        self._truth = np.concatenate([run.recording.truth for run in runs])
        self._boxes = np.concatenate([run.recording.boxes for run in runs])
        self._sequence = np.repeat(np.arange(len(runs)), lengths)
        self._success_frames = self._success_base = lengths
        if convention.leaves_out:
            valid = convention.valid_success(self._truth)
            self._success_frames = np.add.reduceat(valid.astype(np.int64), self._bases)

    def scores_of(
        self, fed: Histories, found: Pairs, boxes: Floats, count: int
    ) -> dict[str, Floats]:
        """Per metric, float64 [S, count], of paired answers."""
        history = np.searchsorted(fed.offsets, found.item, "right") - 1
        sequence = fed.sequence[history]
        truth = self._truth[self._bases[sequence] + found.frame]
        counts = frame_counts(truth, boxes, found.frame, self._convention)
        width = count + 1
        begin, end = sequence * width + found.sigma_from, sequence * width + found.sigma_to

        def summed(values: Ints) -> Ints:
            size = len(self._bases) * width
            steps = np.bincount(begin, values, size) - np.bincount(end, values, size)
            return steps.reshape(-1, width).cumsum(axis=1)[:, :count].astype(np.int64)

        return self._shares(FrameCounts(*(summed(column) for column in _columns(counts))))

    def offline(self) -> dict[str, Floats]:
        """Per metric, float64 [S], of every frame's own box."""
        frame = np.arange(len(self._truth)) - self._bases[self._sequence]
        counts = frame_counts(self._truth, self._boxes, frame, self._convention)
        missing = np.add.reduceat(np.isnan(self._boxes[:, 0]).astype(np.int64), self._bases) > 0
        sums = (np.add.reduceat(column, self._bases)[:, None] for column in _columns(counts))
        shares = self._shares(FrameCounts(*sums))
        return {name: np.where(missing, np.nan, share[:, 0]) for name, share in shares.items()}

    def _shares(self, sums: FrameCounts) -> dict[str, Floats]:
        """Sums of counts [S, M] as shares; NaN where a sequence leaves the mean."""
        frames = np.where(self._success_frames > 0, self._success_frames, np.nan)[:, None]
        shares = {
            "auc": sums.success / (frames * self._convention.thresholds),
            "dp20": sums.dp / frames,
            "norm_dp20": sums.norm_dp / frames,
            "norm_auc": sums.norm / (frames * len(NORM_THRESHOLDS)),
        }
        if self._convention.drops_zeros:
            for name, best in zip(METRICS, (sums.success, sums.within50, sums.norm, sums.norm)):
                shares[name] = np.where(best > 0, shares[name], np.nan)
        return shares


def _columns(counts: FrameCounts) -> list[npt.NDArray[np.int64]]:
    return [getattr(counts, field.name) for field in fields(counts)]
