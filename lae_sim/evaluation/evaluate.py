"""Latency-aware and offline scores of runs, per sequence, for any number of permitted latencies."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from itertools import groupby, islice
from operator import itemgetter
from typing import Any, TypeAlias, TypeVar

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import search_distance
from lae_sim.errors import LaeError, explained, shown
from lae_sim.evaluation.metrics import METRICS, PYSOT, Convention, is_scored
from lae_sim.evaluation.modelled import MODELLED, ModelledScores, modelled_scores
from lae_sim.evaluation.pairing import Histories, Pairing, Pairs, histories, pair, pairs
from lae_sim.evaluation.scoring import Scored, Scorer
from lae_sim.forecast.base import AnyFactory, Lanes, SequenceFactory, defines, forecast
from lae_sim.replay.run import Run
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import ImageSizes, Metadata
from lae_sim.trace.recording import BESIDE, Recording, batched

Record = TypeVar("Record", "Staleness", "Curves")

PairedBoxes: TypeAlias = "tuple[Histories, Pairs, Floats]"
"""Histories, their pairs with frames, and the box of each pair, float64 [P, 4]."""

GROUP_FRAMES = 1 << 16
"""World frames that are scored at once, unless more memory than a small process has is there."""

_PART = 1 << 19  # outputs that forecasters are fed at once


@dataclass(frozen=True, eq=False)
class ReplayStatistics:
    """How S sequences were replayed, whatever was forecast.

    Attributes:
        sequences: names, S of them.
        frames: world frames of each, int64 [S].
        truthless: world frames of each that have no ground truth, int64 [S].
        absent: world frames of each whose target is said to be absent though they have a truth,
            int64 [S]; -1 where nothing is said.
        scored: whether each has a truth to score by (:func:`.metrics.is_scored`), bool [S].
        missing: world frames of each without a box in the trace, int64 [S].
        processed: processed frames of each, int64 [S].
        scores_latency: see :class:`lae_sim.engine.scheduler.Schedule`, bool [S].
        departures: see :class:`lae_sim.replay.run.Run`, int64 [S].
        disagreement: see :class:`lae_sim.replay.run.Run`, float64 [S].
        init_ns: time of the initialisation, int64 [S].
        left_search: whether the first frame after the initialisation comes so late that the target
            has left the region which a tracker would search around the initial box (see
            :func:`lae_sim.boxes.search_distance`), bool [S].
        calls_ns: total time of the other calls, int64 [S].
        calls_hz: sum of 1/elapsed over the other calls, per second, [S]; infinite if one took 0.
    """

    sequences: tuple[str, ...]
    frames: Ints
    truthless: Ints
    absent: Ints
    scored: Bools
    missing: Ints
    processed: Ints
    scores_latency: Bools
    departures: Ints
    disagreement: Floats
    init_ns: Ints
    left_search: Bools
    calls_ns: Ints
    calls_hz: Floats

    @property
    def approximate_share(self) -> float:
        """Share of the outputs that follow another frame than when recorded, in 0..1."""
        calls = int(self.processed.sum()) - len(self.sequences)
        return int(self.departures.sum()) / calls if calls else 0.0

    @classmethod
    def joined(cls, parts: Sequence[ReplayStatistics]) -> ReplayStatistics:
        """Those of some groups of sequences as one."""
        names = tuple(name for part in parts for name in part.sequences)
        columns = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(cls)
            if field.name != "sequences"
        }
        return cls(sequences=names, **columns)

    def chosen(self, which: Ints) -> ReplayStatistics:
        """Those of some sequences, by their indices."""
        columns = {
            field.name: getattr(self, field.name)[which]
            for field in fields(self)
            if field.name != "sequences"
        }
        return ReplayStatistics(sequences=tuple(self.sequences[s] for s in which), **columns)


@dataclass(frozen=True, eq=False)
class Staleness:
    """How old the answers are in S sequences at M permitted latencies; i - psi(i) is the mismatch.

    Attributes:
        mismatch_sum, mismatch_max: over the world frames, frames, int64 [S, M].
        longest_hold: most queries in a row with one answering output, frames, int64 [S, M].
        age_sum, age_max, longest_stale: the same in time, by when frames arrive, in nominal frame
            intervals, float64 [S, M]; the permitted latency is not in it.
    """

    mismatch_sum: Ints
    mismatch_max: Ints
    longest_hold: Ints
    age_sum: Floats
    age_max: Floats
    longest_stale: Floats

    @classmethod
    def of(cls, pairing: Pairing) -> Staleness:
        """That of paired outputs and queries."""
        return cls(*(getattr(pairing, field.name) for field in fields(cls)))


@dataclass(frozen=True, eq=False)
class Curves:
    """Shares of frames over thresholds; NaN where the sequence leaves the mean.

    Attributes:
        success: over the convention's IoU thresholds, float64 [..., N].
        precision: over 0, 1, ..., 50 px, float64 [..., 51].
    """

    success: Floats
    precision: Floats


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of S sequences, F forecasters and M permitted latencies.

    Attributes:
        replay: how the sequences were replayed.
        staleness: how old the answers are, where forecasts cost nothing.
        scores: per metric of ``METRICS``, float64 [F, S, M] in 0..1; NaN = leaves the mean.
        failure: the first world frame whose answer does not overlap the truth at all, int64
            [F, S, M]; the number of world frames if there is none, -1 without a truth to score by.
        failure_time: when that frame arrives, or the stream ends, in nominal frame intervals,
            float64 [F, S, M]; -1 without a truth to score by.
        curves: at one permitted latency, [F, S, ...].
        offline: per metric, of the trace's boxes at their own frames, float64 [S]; NaN where the
            trace does not hold every frame.
        offline_curves: likewise, [S, ...].
        modelled: the same under the search model.
    """

    replay: ReplayStatistics
    staleness: Staleness
    scores: Mapping[str, Floats]
    failure: Ints
    failure_time: Floats
    curves: Curves
    offline: Mapping[str, Floats]
    offline_curves: Curves
    modelled: ModelledScores

    @classmethod
    def joined(cls, parts: Sequence[Evaluation]) -> Evaluation:
        """The evaluations of some groups of sequences as one."""
        return cls(
            replay=ReplayStatistics.joined([part.replay for part in parts]),
            staleness=_joined([part.staleness for part in parts]),
            scores={m: np.concatenate([p.scores[m] for p in parts], axis=1) for m in METRICS},
            failure=np.concatenate([part.failure for part in parts], axis=1),
            failure_time=np.concatenate([part.failure_time for part in parts], axis=1),
            curves=_joined([part.curves for part in parts], axis=1),
            offline={m: np.concatenate([p.offline[m] for p in parts]) for m in METRICS},
            offline_curves=_joined([part.offline_curves for part in parts]),
            modelled=ModelledScores.joined([part.modelled for part in parts]),
        )


def _joined(records: Sequence[Record], axis: int = 0) -> Record:
    """Records of arrays alone as one."""
    first = records[0]
    names = [field.name for field in fields(first)]
    columns = ([getattr(record, name) for record in records] for name in names)
    return type(first)(*(np.concatenate(column, axis) for column in columns))


def _pieces(record: Record, span: slice, axis: int = 0) -> Record:
    """A span of each of a record's arrays."""
    columns = (getattr(record, field.name) for field in fields(record))
    return type(record)(*(_piece(column, span, axis) for column in columns))


def _piece(values: Any, span: slice, axis: int = 0) -> Any:
    """A span of an array, in one piece: sums over it are those over an array of its own."""
    return np.ascontiguousarray(values[(slice(None),) * axis + (span,)])


@dataclass(frozen=True, eq=False)
class Answers:
    """The answer for every world frame of one sequence at one sigma.

    Attributes:
        source_frame: psi(i), the frame of the output it comes from, int64 [T].
        boxes: float64 [T, 4].
    """

    source_frame: Ints
    boxes: Floats


@dataclass(frozen=True, eq=False)
class ScoredRun:
    """A run that is being scored, for those who write down more than its scores.

    Attributes:
        run: the sequence.
        answers: those that were asked for, by forecaster and permitted latency.
    """

    run: Run
    answers: Mapping[tuple[str, Fraction], Answers]
    _place: int
    _sigmas: Sequence[Fraction]
    _pairings: Mapping[int, Pairing]

    def pairing(self, sigma: Fraction, cost_ns: int = 0) -> Pairing:
        """Its pairing at one of the sigmas, at a cost that some forecaster has, or at none."""
        return self._pairings[cost_ns].chosen(self._place, self._sigmas.index(sigma))


Observer: TypeAlias = "Callable[[ScoredRun], object]"
"""``observer(scored)`` takes a run that is being scored, each in its turn."""


def evaluate_runs(
    runs: Iterable[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction] = (Fraction(0),),
    convention: Convention = PYSOT,
    costs: Mapping[str, int] | None = None,
) -> Evaluation:
    """Score the runs of one trace, in groups, so that no more than the scores is kept.

    Args:
        runs: one per sequence, all of one frame rate.
        metadata: of the trace, for image sizes.
        forecasters: factories by name.
        sigmas: distinct permitted latencies in frames, ascending.
        convention: how frames and thresholds count.
        costs: what an answer costs, ns, by forecaster; 0 if not named. It delays the answers.

    Raises:
        LaeError: if there is no run or no forecaster, or whatever iterating over the runs raises.

    Example:
        >>> import lae_sim
        >>> runs = lae_sim.replay_trace("traces/synthetic-slow.parquet", latency="constant:47ms")
        >>> makers = {"hold": lae_sim.Hold, "kalman": lae_sim.Kalman}
        >>> scores = lae_sim.evaluate_runs(runs, runs.trace.metadata, makers).scores["auc"]
        >>> scores.shape, scores.mean(axis=(1, 2)).round(4).tolist()
        ((2, 8, 1), [0.5791, 0.6414])
    """
    if isinstance(runs, (str, os.PathLike, Trace)):
        raise LaeError(f"runs: what replay_trace gives, not {shown(runs)}; evaluate takes traces")
    if not isinstance(forecasters, Mapping):
        raise LaeError(f"forecasters: factories by name, not {shown(forecasters)}")
    groups = evaluate_groups(runs, metadata, forecasters, sigmas, convention, costs)
    return Evaluation.joined(list(groups))


def evaluate_groups(
    runs: Iterable[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction] = (Fraction(0),),
    convention: Convention = PYSOT,
    costs: Mapping[str, int] | None = None,
    frames: int = GROUP_FRAMES,
    curves_at: Fraction | None = None,
    observers: Sequence[Observer] = (),
    observed: Collection[tuple[str, Fraction]] = (),
) -> Iterator[Evaluation]:
    """The same, group after group of sequences, for those who keep less than all of it.

    Args:
        runs, metadata, forecasters, sigmas, convention, costs: see :func:`evaluate_runs`.
        frames: about how many world frames are scored at once: the more, the faster, and the more
            memory.
        curves_at: the sigma of the success and precision curves; the first by default.
        observers: take each run, in order, once its group is scored.
        observed: the answers that they look at, by forecaster and sigma.

    Raises:
        LaeError: as :func:`evaluate_runs`.
    """
    scoring = _Scoring(
        forecasters,
        sigmas,
        convention,
        costs or {},
        0 if curves_at is None else sigmas.index(curves_at),
        observers,
        observed,
    )
    offline: dict[Recording, _Offline] = {}
    for group in batched(runs, frames, BESIDE):
        offline = _offline([run.recording for run in group], convention, offline)
        yield from scoring.of([_Part(metadata, group)], offline)
    if not offline:
        raise LaeError("there is nothing to evaluate: no sequences")


def evaluate_together(
    runs: Iterable[tuple[int, Run]],
    metadata: Sequence[Metadata],
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction],
    convention: Convention = PYSOT,
    costs: Mapping[str, int] | None = None,
    frames: int = GROUP_FRAMES,
) -> Iterator[tuple[int, Evaluation]]:
    """The groups of :func:`evaluate_groups` of several replays; small groups are scored at once.

    Args:
        runs: each with the place of its replay, in the order of the replays.
        metadata: of the trace of each replay.
        forecasters, sigmas, convention, costs, frames: see :func:`evaluate_groups`.

    Yields:
        The place of the replay, and a group of its sequences.

    Raises:
        LaeError: if there is no forecaster, or whatever iterating over the runs raises.
    """
    scoring = _Scoring(forecasters, sigmas, convention, costs or {})
    parts = (
        _Part(metadata[place], group, place)
        for place, own in groupby(runs, itemgetter(0))
        for group in batched((run for _, run in own), frames, BESIDE)
    )
    offline: dict[Recording, _Offline] = {}
    for _, alike in groupby(parts, _Part.way):
        for some in _merged(alike, frames):
            recordings = [run.recording for part in some for run in part.runs]
            offline = _offline(recordings, convention, offline)
            yield from zip((part.place for part in some), scoring.of(some, offline))


@dataclass(frozen=True, eq=False)
class _Part:
    """Runs of one replay that are scored at once.

    Attributes:
        metadata: of the trace.
        runs: some of the replay's.
        place: the replay's.
    """

    metadata: Metadata
    runs: Sequence[Run]
    place: int = 0

    def __len__(self) -> int:
        """About how many world frames take as much memory."""
        return sum(len(run) + BESIDE for run in self.runs)

    def way(self) -> tuple[int, int, bool, bool]:
        """Parts that differ in it cannot be paired together, or not as they are alone."""
        schedules = [run.schedule for run in self.runs]
        clock, scored = schedules[0].clock, schedules[0].scores_latency
        even = all(schedule.clock.is_even for schedule in schedules)
        return clock.ticks_per_ns, clock.frame_ticks, scored, even


def _merged(parts: Iterable[_Part], frames: int) -> Iterator[list[_Part]]:
    """Parts that are together about no larger than one may be."""
    some: list[_Part] = []
    pending = 0
    for part in parts:
        if some and pending + len(part) > frames:
            yield some
            some, pending = [], 0
        some.append(part)
        pending += len(part)
    if some:
        yield some


@dataclass(frozen=True, eq=False)
class _Offline:
    """What is scored of a recording alone, however it is replayed.

    Attributes:
        truthless, absent, scored, missing: see :class:`ReplayStatistics`.
        scores: in the order of ``METRICS``.
        success, precision: see :class:`Curves`.
    """

    truthless: int
    absent: int
    scored: bool
    missing: int
    scores: Sequence[float]
    success: Floats
    precision: Floats


def _offline(
    recordings: Iterable[Recording], convention: Convention, known: Mapping[Recording, _Offline]
) -> dict[Recording, _Offline]:
    """Those of some recordings; those of the group before may be the same, replayed again."""
    scored = {recording: known.get(recording) for recording in recordings}
    new = [recording for recording, value in scored.items() if value is None]
    if new:
        offline = Scorer(new, convention).offline()
        scores = np.stack([offline.scores[metric][:, 0] for metric in METRICS], axis=1).tolist()
        for r, recording in enumerate(new):
            scored[recording] = _Offline(
                truthless=int(np.isnan(recording.truth[:, 0]).sum()),
                absent=_absent(recording),
                scored=is_scored(recording.truth),
                missing=int(np.isnan(recording.boxes[:, 0]).sum()),
                scores=scores[r],
                success=offline.success[r],
                precision=offline.precision[r],
            )
    return {recording: value for recording, value in scored.items() if value is not None}


def _absent(recording: Recording) -> int:
    """How many frames with a truth are said to lack the target; -1 if nothing is said."""
    if recording.visible is None:
        return -1
    return int((~recording.visible & ~np.isnan(recording.truth[:, 0])).sum())


@dataclass(frozen=True, eq=False)
class _Scoring:
    """How groups of runs are scored: the arguments of :func:`evaluate_groups`."""

    forecasters: Mapping[str, AnyFactory]
    sigmas: Sequence[Fraction]
    convention: Convention
    costs: Mapping[str, int]
    curves_at: int = 0
    observers: Sequence[Observer] = ()
    observed: Collection[tuple[str, Fraction]] = ()

    def __post_init__(self) -> None:
        if not self.forecasters:
            raise LaeError("name at least one forecaster, such as hold")

    def of(
        self, parts: Sequence[_Part], offline: Mapping[Recording, _Offline]
    ) -> Iterator[Evaluation]:
        """Score some parts at once; each as it is alone."""
        runs = [run for part in parts for run in part.runs]
        names = [(part.metadata, run.recording.name) for part in parts for run in part.runs]
        sizes = [metadata.image_sizes(name) for metadata, name in names]
        pairings = self._paired(runs, {0})
        kept: list[dict[tuple[str, Fraction], Answers]] = [{} for _ in runs]
        scored = self._scored(runs, sizes, pairings, kept)
        scores = {m: np.stack([each.scores[m] for each in scored]) for m in METRICS}
        failure = np.stack([each.failure for each in scored])
        of_sequence = np.broadcast_to(np.arange(len(runs))[:, None], failure.shape)
        failed_at = pairings[0].frame_times(of_sequence, np.maximum(failure, 0))
        for place, run in enumerate(runs if self.observers else ()):
            one = ScoredRun(run, kept[place], place, self.sigmas, pairings)
            for observer in self.observers:
                observer(one)
        alone = [offline[run.recording] for run in runs]
        replay = _replay_statistics(runs, alone, pairings[0])
        staleness = Staleness.of(pairings[0])
        failure_time = np.where(failure < 0, -1.0, failed_at)
        curves, offline_curves = (
            Curves(
                np.stack([each.success for each in some]),
                np.stack([each.precision for each in some]),
            )
            for some in (scored, alone)
        )
        offline_scores = np.array([each.scores for each in alone]).T
        outcomes = self._outcomes(runs, sizes, scores)
        end = 0
        for part in parts:
            begin, end = end, end + len(part.runs)
            own = slice(begin, end)
            of_part = {m: _piece(scores[m], own, 1) for m in METRICS}
            yield Evaluation(
                replay=replay.chosen(np.arange(begin, end)),
                staleness=_pieces(staleness, own),
                scores=of_part,
                failure=_piece(failure, own, 1),
                failure_time=_piece(failure_time, own, 1),
                curves=_pieces(curves, own, 1),
                offline=dict(zip(METRICS, offline_scores[:, own])),
                offline_curves=_pieces(offline_curves, own),
                modelled=modelled_scores(part.runs, of_part, outcomes[own]),
            )

    def _paired(self, runs: Sequence[Run], besides: Collection[int] = ()) -> dict[int, Pairing]:
        """The runs' outputs and queries at each cost that a forecaster has, and besides."""
        schedules = [run.schedule for run in runs]
        costs = {*besides, *(self.costs.get(name, 0) for name in self.forecasters)}
        return {cost: pair(schedules, self.sigmas, cost) for cost in sorted(costs)}

    def _scored(
        self,
        runs: Sequence[Run],
        image_sizes: Sequence[ImageSizes | None],
        pairings: Mapping[int, Pairing],
        kept: Sequence[dict[tuple[str, Fraction], Answers]],
    ) -> list[Scored]:
        """The scores of each forecaster."""
        scorer = Scorer([run.recording for run in runs], self.convention)
        scored = []
        for name, factory in self.forecasters.items():
            pairing = pairings[self.costs.get(name, 0)]
            parts = _answers(runs, image_sizes, pairing, name, factory)
            parts = self._observed(parts, pairing, name, kept)
            scored.append(scorer.of(parts, len(self.sigmas), self.curves_at))
        return scored

    def _outcomes(
        self,
        runs: Sequence[Run],
        image_sizes: Sequence[ImageSizes | None],
        recorded: Mapping[str, Floats],
    ) -> list[dict[str, Floats]]:
        """The scores of the outcomes of the search model (see :func:`modelled_scores`)."""
        scores: list[dict[str, Floats]] = []
        others = []
        for s, run in enumerate(runs):
            boxes = () if run.modelled is None else run.modelled.boxes
            scores.append(
                {m: np.stack([recorded[m][:, s]] * len(boxes), 1) for m in MODELLED}
                if boxes
                else {}
            )
            for r, each in enumerate(boxes):
                if not np.array_equal(each, run.boxes):
                    others.append((s, r, replace(run, boxes=each)))
        unobserved, places = replace(self, observed=()), iter(others)
        for group in batched([run for *_, run in others], GROUP_FRAMES, BESIDE):
            here = [*islice(places, len(group))]
            sizes = [image_sizes[s] for s, *_ in here]
            scored = unobserved._scored(group, sizes, self._paired(group), [])
            for i, (s, r, _) in enumerate(here):
                for metric in MODELLED:
                    scores[s][metric][:, r] = [each.scores[metric][i] for each in scored]
        return scores

    def _observed(
        self,
        parts: Iterable[PairedBoxes],
        pairing: Pairing,
        name: str,
        kept: Sequence[dict[tuple[str, Fraction], Answers]],
    ) -> Iterator[PairedBoxes]:
        """The parts as they pass, and the answers among them that observers look at."""
        wanted = [sigma for forecaster, sigma in self.observed if forecaster == name]
        for part in parts:
            for sigma in wanted:
                for place, one in _answers_at(self.sigmas.index(sigma), pairing, part):
                    kept[place][name, sigma] = one
            yield part


def _replay_statistics(
    runs: Sequence[Run], offline: Sequence[_Offline], pairing: Pairing
) -> ReplayStatistics:
    elapsed = [run.schedule.elapsed_ns for run in runs]
    return ReplayStatistics(
        sequences=tuple(run.recording.name for run in runs),
        frames=pairing.lengths,
        truthless=np.array([each.truthless for each in offline], np.int64),
        absent=np.array([each.absent for each in offline], np.int64),
        scored=np.array([each.scored for each in offline]),
        missing=np.array([each.missing for each in offline], np.int64),
        processed=np.diff(pairing.offsets),
        scores_latency=np.array([run.schedule.scores_latency for run in runs]),
        departures=np.array([run.departures for run in runs], np.int64),
        disagreement=np.array([run.disagreement for run in runs]),
        init_ns=np.array([each[0] for each in elapsed], np.int64),
        left_search=_left_search(runs),
        calls_ns=np.array([each[1:].sum() for each in elapsed], np.int64),
        calls_hz=np.array([_rates(each[1:]).sum() for each in elapsed]),
    )


def _left_search(runs: Sequence[Run]) -> Bools:
    """Whether the target leaves the search region during each initialisation, bool [S]."""
    # of a run that processes nothing more, and of one that skips nothing, frame 0: no distance
    resumed = [int(run.schedule.frames[1:2].sum()) for run in runs]
    truth = [
        run.recording.truth[[0, frame if frame > 1 else 0]] for run, frame in zip(runs, resumed)
    ]
    initial, then = np.array(truth).transpose(1, 0, 2)
    left: Bools = search_distance(initial, then) >= 1
    return left


def _rates(elapsed_ns: Ints) -> Floats:
    """Frames per second of each call, infinite for one that took no time."""
    rates = np.full(len(elapsed_ns), np.inf)
    np.divide(1e9, elapsed_ns, out=rates, where=elapsed_ns > 0)
    return rates


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
    sizes = metadata.image_sizes(run.recording.name)
    (part,) = _answers([run], [sizes], pairing, name, factory)
    ((_, only),) = _answers_at(0, pairing, part)
    return only


def _answers_at(m: int, pairing: Pairing, part: PairedBoxes) -> Iterator[tuple[int, Answers]]:
    """Each sequence of a part, by its index in the pairing, with its answers at one sigma."""
    fed, paired, boxes = part
    # at one sigma the pairs of a sequence stand together, and their frames ascend from 0
    at = np.flatnonzero((paired.sigma_from <= m) & (m < paired.sigma_to))
    item = paired.item.take(at)
    sequence = np.repeat(fed.sequence, np.diff(fed.offsets)).take(item)
    source_frame = pairing.frames.take(fed.output.take(item))
    answered = boxes.take(at, axis=0)
    begins = np.flatnonzero(np.diff(sequence, prepend=-1)).tolist()
    for begin, end in zip(begins, [*begins[1:], len(at)]):
        yield int(sequence[begin]), Answers(source_frame[begin:end], answered[begin:end])


def lanes_of(
    runs: Sequence[Run],
    pairing: Pairing,
    fed: Histories,
    image_sizes: Sequence[ImageSizes | None],
) -> Lanes:
    """What forecasters are fed in some histories of some runs.

    Args:
        runs: those that were paired.
        pairing: of their schedules.
        fed: histories of the pairing.
        image_sizes: of each run; None = unknown.
    """
    boxes = np.concatenate([run.boxes for run in runs])
    numbers = pairing.frames.take(fed.output)
    frames = pairing.frame_times(np.repeat(fed.sequence, np.diff(fed.offsets)), numbers)
    fed_boxes = boxes.take(fed.output, axis=0)
    first = [(np.inf, np.inf) if sizes is None else sizes.at(0) for sizes in image_sizes]
    resized: dict[int, ImageSizes] = {}
    for s, sizes in enumerate(image_sizes):
        if sizes is not None and sizes.change:
            starts = pairing.frame_times(np.full(len(sizes.starts), s), np.array(sizes.starts))
            timed = ImageSizes(tuple(starts.tolist()), sizes.sizes)
            resized |= {int(lane): timed for lane in np.flatnonzero(fed.sequence == s)}
    return Lanes(
        fed.offsets,
        frames,
        fed_boxes,
        np.array(first, np.float64)[fed.sequence],
        None if frames is numbers else numbers,
        resized,
    )


def _answers(
    runs: Sequence[Run],
    image_sizes: Sequence[ImageSizes | None],
    pairing: Pairing,
    name: str,
    factory: AnyFactory,
) -> Iterator[PairedBoxes]:
    """The distinct pairs of a forecaster with their boxes, float64 [P, 4], in parts.

    Parts are of whole sequences. Where sigmas share no history there may be 51 times the outputs,
    so that a group of few frames is large.
    """
    if getattr(factory, "sees_frames", False) and pairing.sigmas[0] < 0:
        raise LaeError(
            f"{name} sees frames when they arrive: not before, as sigma < 0 would have it"
        )
    with explained(name):
        factories = (
            [factory.for_sequence(run.recording) for run in runs]
            if isinstance(factory, SequenceFactory)
            else [factory] * len(runs)
        )
    for fed in histories(pairing, memoryless=defines(factory, "memoryless")).parts(_PART):
        paired = pairs(pairing, fed)
        lanes = lanes_of(runs, pairing, fed, image_sizes)
        frame: Ints | Floats = paired.frame
        number: Ints | None = None
        if lanes.numbers is not None:
            sequence = fed.sequence.take(lanes.lane(paired.item))
            frame, number = pairing.frame_times(sequence, paired.frame), paired.frame
        distinct = {id(one): one for one in factories}.values()
        if len(distinct) == 1:
            yield fed, paired, forecast(factories[0], lanes, paired.item, frame, name, number)
            continue
        answered = np.empty((len(paired.item), 4))
        for one in distinct:  # at once where several sequences share one
            chosen = np.array([other is one for other in factories])[fed.sequence]
            part, asked, item = lanes.chosen(chosen, paired.item)
            some = None if number is None else number[asked]
            answered[asked] = forecast(one, part, item, frame[asked], name, some)
        yield fed, paired, answered
