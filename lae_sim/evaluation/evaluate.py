"""Latency-aware and offline scores of runs, per sequence, for any number of permitted latencies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.errors import LaeError, explained
from lae_sim.evaluation.metrics import METRICS, PYSOT, Convention
from lae_sim.evaluation.pairing import Histories, Pairing, Pairs, histories, pair, pairs
from lae_sim.evaluation.scoring import Scorer
from lae_sim.forecast.base import AnyFactory, Lanes, SequenceFactory, defines, forecast
from lae_sim.replay.run import Run
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import BATCH_ROWS, Recording, batched

_PART = 1 << 19  # outputs that forecasters are fed at once


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of S sequences, F forecasters and M permitted latencies.

    Attributes:
        sequences: names, S of them.
        frames: world frames of each, int64 [S].
        truthless: world frames of each that have no ground truth, int64 [S].
        missing: world frames of each without a box in the trace, int64 [S].
        processed: processed frames of each, int64 [S].
        scores_latency: see :class:`lae_sim.engine.scheduler.Schedule`, bool [S].
        departures: see :class:`lae_sim.replay.run.Run`, int64 [S].
        disagreement: see :class:`lae_sim.replay.run.Run`, float64 [S].
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
    scores_latency: Bools
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
    costs: Mapping[str, int] | None = None,
) -> Evaluation:
    """Score the runs of one trace, in groups, so that memory does not grow with the trace.

    Args:
        runs: one per sequence, all of one clock.
        metadata: of the trace, for image sizes.
        forecasters: factories by name.
        sigmas: distinct permitted latencies in frames, ascending.
        convention: how frames and thresholds count.
        costs: what an answer costs, ns, by forecaster; 0 if not named. It delays the answers.

    Raises:
        LaeError: if there is no run or no forecaster, or whatever iterating over the runs raises.
    """
    parts = list(evaluate_groups(runs, metadata, forecasters, sigmas, convention, costs))
    if not parts:
        raise LaeError("there is nothing to evaluate: no sequences")
    return Evaluation.joined(parts)


def evaluate_groups(
    runs: Iterable[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction] = (Fraction(0),),
    convention: Convention = PYSOT,
    costs: Mapping[str, int] | None = None,
    frames: int = BATCH_ROWS,
) -> Iterator[Evaluation]:
    """The same, group after group of sequences, for those who keep less than all of it.

    The larger the groups (of about ``frames`` world frames), the faster, and the more memory.
    """
    if not forecasters:
        raise LaeError("name at least one forecaster, such as hold")
    alone: dict[Recording, _Alone] = {}
    for group in batched(runs, frames):
        alone = _alone([run.recording for run in group], convention, alone)
        yield _evaluate_group(group, metadata, forecasters, sigmas, convention, costs or {}, alone)


@dataclass(frozen=True, eq=False)
class _Alone:
    """What scores have of a recording alone, however it is replayed."""

    truthless: int
    missing: int
    offline: Sequence[float]
    success: Floats
    precision: Floats


def _alone(
    recordings: Iterable[Recording], convention: Convention, known: Mapping[Recording, _Alone]
) -> dict[Recording, _Alone]:
    """Those of some recordings; those of the group before may be the same, replayed again."""
    found = {recording: known.get(recording) for recording in recordings}
    new = [recording for recording, value in found.items() if value is None]
    if new:
        offline = Scorer(new, convention).offline()
        scores = np.stack([offline.scores[metric][:, 0] for metric in METRICS], axis=1).tolist()
        for r, recording in enumerate(new):
            truth, boxes = recording.truth[:, 0], recording.boxes[:, 0]
            missing = int(np.isnan(truth).sum()), int(np.isnan(boxes).sum())
            curves = offline.success[r], offline.precision[r]
            found[recording] = _Alone(*missing, scores[r], *curves)
    return {recording: value for recording, value in found.items() if value is not None}


def _evaluate_group(
    runs: Sequence[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction],
    convention: Convention,
    costs: Mapping[str, int],
    alone: Mapping[Recording, _Alone],
) -> Evaluation:
    """Score some runs at once."""
    schedules = [run.schedule for run in runs]
    needed = {0, *(costs.get(name, 0) for name in forecasters)}
    pairings = {cost: pair(schedules, sigmas, cost) for cost in needed}
    pairing = pairings[0]
    scorer = Scorer([run.recording for run in runs], convention)
    scored = [
        scorer.of(
            _answers(runs, metadata, pairings[costs.get(name, 0)], name, factory), len(sigmas)
        )
        for name, factory in forecasters.items()
    ]
    fixed = [alone[run.recording] for run in runs]
    offline = np.array([each.offline for each in fixed])
    elapsed = [run.schedule.elapsed_ns for run in runs]
    return Evaluation(
        sequences=tuple(run.recording.name for run in runs),
        frames=pairing.lengths,
        truthless=np.array([each.truthless for each in fixed], np.int64),
        missing=np.array([each.missing for each in fixed], np.int64),
        processed=np.diff(pairing.offsets),
        scores_latency=np.array([schedule.scores_latency for schedule in schedules]),
        departures=np.array([run.departures for run in runs], np.int64),
        disagreement=np.array([run.disagreement for run in runs]),
        init_ns=np.array([each[0] for each in elapsed], np.int64),
        calls_ns=np.array([each[1:].sum() for each in elapsed], np.int64),
        calls_hz=np.array([_rates(each[1:]).sum() for each in elapsed]),
        mismatch_sum=pairing.mismatch_sum,
        mismatch_max=pairing.mismatch_max,
        longest_hold=pairing.longest_hold,
        scores={m: np.stack([each.scores[m] for each in scored]) for m in METRICS},
        failure=np.stack([each.failure for each in scored]),
        success=np.stack([each.success for each in scored]),
        precision=np.stack([each.precision for each in scored]),
        offline=dict(zip(METRICS, offline.T)),
        offline_success=np.stack([each.success for each in fixed]),
        offline_precision=np.stack([each.precision for each in fixed]),
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
    cost_ns: int = 0,
) -> Answers:
    """What a forecaster answers for every world frame of one run."""
    pairing = pair([run.schedule], [sigma], cost_ns)
    ((fed, found, boxes),) = _answers([run], metadata, pairing, name, factory)
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
    frames = pairing.frames.take(fed.output)
    fed_boxes = boxes.take(fed.output, axis=0)
    return Lanes(fed.offsets, frames, fed_boxes, image_sizes[fed.sequence])


def _answers(
    runs: Sequence[Run],
    metadata: Metadata,
    pairing: Pairing,
    name: str,
    factory: AnyFactory,
) -> Iterator[tuple[Histories, Pairs, Floats]]:
    """The distinct pairs of a forecaster with their boxes, float64 [P, 4], in parts.

    Parts are of whole sequences. Where sigmas share no history there may be 51 times the outputs,
    so that a group of few frames is large.
    """
    if getattr(factory, "sees_frames", False) and pairing.sigmas[0] < 0:
        raise LaeError(
            f"{name} sees frames when they arrive: not before, as sigma < 0 would have it"
        )
    sizes = [metadata.image_size(run.recording.name) or (np.inf, np.inf) for run in runs]
    image_sizes = np.array(sizes, np.float64)
    with explained(name):
        factories = (
            [factory.for_sequence(run.recording) for run in runs]
            if isinstance(factory, SequenceFactory)
            else [factory] * len(runs)
        )
    for fed in histories(pairing, memoryless=defines(factory, "memoryless")).parts(_PART):
        found = pairs(pairing, fed)
        lanes = lanes_of(runs, pairing, fed, image_sizes)
        shared = {id(its): its for its in factories}.values()
        if len(shared) == 1:
            yield fed, found, forecast(factories[0], lanes, found.item, found.frame, name)
            continue
        answered = np.empty((len(found.item), 4))
        for each in shared:  # at once where several share one
            theirs = np.array([its is each for its in factories])[fed.sequence]
            part, asked, item = lanes.chosen(theirs, found.item)
            answered[asked] = forecast(each, part, item, found.frame[asked], name)
        yield fed, found, answered
