"""Latency-aware and offline scores of runs, per sequence, for any number of permitted latencies."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from itertools import groupby
from operator import itemgetter
from typing import Any, TypeAlias, TypeVar

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import search_distance
from lae_sim.engine.scheduler import Schedules
from lae_sim.errors import LaeError, explained, shown
from lae_sim.evaluation.metrics import METRICS, PYSOT, Convention, is_scored
from lae_sim.evaluation.modelled import MODELLED, ModelledScores, modelled_scores
from lae_sim.evaluation.pairing import Histories, Pairing, Pairs, histories, pair, pairs
from lae_sim.evaluation.scoring import Scored, Scorer
from lae_sim.forecast.base import AnyFactory, Hold, Lanes, SequenceFactory, defines, forecast
from lae_sim.replay.run import Run, RunBatch, distinct, grouped, regrouped
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import ImageSizes, Metadata
from lae_sim.trace.recording import BESIDE, Recording

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
        repetition: see :class:`lae_sim.replay.run.RunBatch`, int64 [S].
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
    repetition: Ints
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
            intervals, float64 [S, M]; the permitted latency is not in it, nor what a pipeline's
            camera takes to deliver a frame.
    """

    mismatch_sum: Ints
    mismatch_max: Ints
    longest_hold: Ints
    age_sum: Floats
    age_max: Floats
    longest_stale: Floats

    @classmethod
    def of(cls, pairing: Pairing, schedules: Schedules) -> Staleness:
        """That of paired outputs and queries, and of their schedules."""
        found = cls(*(getattr(pairing, field.name) for field in fields(cls)))
        for s, schedule in enumerate(schedules.whole or ()):
            if schedule.delivered is not None:
                found.age_sum[s], found.age_max[s] = pairing.ages_from(s, schedule.delivered)
        return found


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


def _pieces(record: Record, which: Any, axis: int = 0) -> Record:
    """Some sequences of each of a record's arrays."""
    columns = (getattr(record, field.name) for field in fields(record))
    return type(record)(*(_piece(column, which, axis) for column in columns))


def _piece(values: Any, which: Any, axis: int = 0) -> Any:
    """Some sequences of an array, in one piece: sums are those over an array of its own."""
    return np.ascontiguousarray(values[(slice(None),) * axis + (which,)])


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
    if not forecasters:
        raise LaeError("name at least one forecaster, such as hold")
    scoring = _Scoring(
        lambda recording: metadata.image_sizes(recording.name),
        forecasters,
        sigmas,
        convention,
        costs or {},
        0 if curves_at is None else sigmas.index(curves_at),
        observers,
        observed,
    )
    known: _Known | None = None
    for group in grouped(runs, frames):
        if known is None or not known.places.keys() >= set(group.recordings):
            known = _Known.of(group.distinct[0], convention, known)
        yield from scoring.of([group], known)
    if known is None:
        raise LaeError("there is nothing to evaluate: no sequences")


def evaluate_together(
    replays: Iterable[tuple[int, RunBatch]],
    metadata: Sequence[Metadata],
    forecasters: Mapping[str, AnyFactory],
    sigmas: Sequence[Fraction],
    convention: Convention = PYSOT,
    costs: Mapping[str, int] | None = None,
    frames: int = GROUP_FRAMES,
) -> Iterator[tuple[int, Evaluation]]:
    """The groups of :func:`evaluate_groups` of several replays; small groups are scored at once.

    Args:
        replays: the place of each replay with some of its runs, one replay after another.
        metadata: of the trace of each replay.
        forecasters, sigmas, convention, costs, frames: see :func:`evaluate_groups`; at least one
            forecaster.

    Yields:
        The place of a replay, and a group of its sequences.

    Raises:
        LaeError: whatever iterating over the replays raises.
    """
    of_recording: dict[Recording, Metadata] = {}

    def image_sizes(recording: Recording) -> ImageSizes | None:
        return of_recording[recording].image_sizes(recording.name)

    scoring = _Scoring(image_sizes, forecasters, sigmas, convention, costs or {})
    parts = (
        (place, group)
        for place, batches in groupby(replays, itemgetter(0))
        for group in regrouped((batch for _, batch in batches), frames)
    )
    known: _Known | None = None
    for _, alike in groupby(parts, lambda part: _way(part[1])):
        for some in _merged(alike, frames):
            for place, part in some:
                of_recording.update(dict.fromkeys(part.recordings, metadata[place]))
            recordings = dict.fromkeys(each for _, part in some for each in part.recordings)
            if known is None or not known.places.keys() >= recordings.keys():
                known = _Known.of([*recordings], convention, known)
            yield from zip((place for place, _ in some), scoring.of([p for _, p in some], known))


def _way(runs: RunBatch) -> tuple[int, int, bool, bool]:
    """Groups that differ in it cannot be paired together, or not as they are alone."""
    schedules = runs.schedules
    clock, scored = schedules.clocks[0], bool(schedules.scores_latency[0])
    even = all(clock.is_even for clock in schedules.clocks)
    return clock.ticks_per_ns, clock.frame_ticks, scored, even


def _merged(
    parts: Iterable[tuple[int, RunBatch]], frames: int
) -> Iterator[list[tuple[int, RunBatch]]]:
    """Groups, with their places, that are together about no larger than one may be."""
    some: list[tuple[int, RunBatch]] = []
    pending = 0
    for place, part in parts:
        size = int(part.schedules.lengths.sum()) + BESIDE * len(part)
        if some and pending + size > frames:
            yield some
            some, pending = [], 0
        some.append((place, part))
        pending += size
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


@dataclass(frozen=True, eq=False)
class _Known:
    """Recordings that are replayed, perhaps again and again, and what is scored of them alone.

    Attributes:
        places: of the recordings, in order.
        offline: of each.
        scorer: scores answers for them.
    """

    places: Mapping[Recording, int]
    offline: Sequence[_Offline]
    scorer: Scorer

    @classmethod
    def of(
        cls, recordings: Sequence[Recording], convention: Convention, known: _Known | None = None
    ) -> _Known:
        """Of distinct recordings, some of which may be known."""
        before = {} if known is None else dict(zip(known.places, known.offline))
        new = [recording for recording in recordings if recording not in before]
        scored = before | dict(zip(new, _offline(new, convention)))
        return cls(
            {recording: k for k, recording in enumerate(recordings)},
            [scored[recording] for recording in recordings],
            Scorer(recordings, convention),
        )

    def which(self, runs: RunBatch) -> Ints:
        """The place of each run's recording, int64 [S]."""
        return np.array([self.places[recording] for recording in runs.recordings])


def _offline(recordings: Sequence[Recording], convention: Convention) -> list[_Offline]:
    """What is scored of recordings alone."""
    if not recordings:  # all are known
        return []
    offline = Scorer(recordings, convention).offline()
    scores = np.stack([offline.scores[metric][:, 0] for metric in METRICS], axis=1).tolist()
    return [
        _Offline(
            truthless=int(np.isnan(recording.truth[:, 0]).sum()),
            absent=_absent(recording),
            scored=is_scored(recording.truth),
            missing=int(np.isnan(recording.boxes[:, 0]).sum()),
            scores=scores[r],
            success=offline.success[r],
            precision=offline.precision[r],
        )
        for r, recording in enumerate(recordings)
    ]


def _absent(recording: Recording) -> int:
    """How many frames with a truth are said to lack the target; -1 if nothing is said."""
    if recording.visible is None:
        return -1
    return int((~recording.visible & ~np.isnan(recording.truth[:, 0])).sum())


@dataclass(frozen=True, eq=False)
class _Scoring:
    """How groups of runs are scored: the arguments of :func:`evaluate_groups`."""

    image_sizes: Callable[[Recording], ImageSizes | None]
    forecasters: Mapping[str, AnyFactory]
    sigmas: Sequence[Fraction]
    convention: Convention
    costs: Mapping[str, int]
    curves_at: int = 0
    observers: Sequence[Observer] = ()
    observed: Collection[tuple[str, Fraction]] = ()

    def of(self, parts: Sequence[RunBatch], known: _Known) -> Iterator[Evaluation]:
        """Score parts of known recordings at once; each as it is alone."""
        runs = RunBatch.joined(parts)
        which = known.which(runs)
        offline = known.offline
        costs = {self.costs.get(name, 0) for name in self.forecasters}
        pairings = {cost: pair(runs.schedules, self.sigmas, cost) for cost in sorted({0, *costs})}
        kept: list[dict[tuple[str, Fraction], Answers]] = [{} for _ in runs.recordings]
        scored = self._scored(runs, pairings, known, kept)
        scores = {m: np.stack([each.scores[m] for each in scored]) for m in METRICS}
        failure = np.stack([each.failure for each in scored])
        of_sequence = np.broadcast_to(np.arange(len(runs))[:, None], failure.shape)
        failed_at = pairings[0].frame_times(of_sequence, np.maximum(failure, 0))
        for place, run in enumerate(runs if self.observers else ()):
            one = ScoredRun(run, kept[place], place, self.sigmas, pairings)
            for observer in self.observers:
                observer(one)
        replay = _replay_statistics(runs, offline, which)
        staleness = Staleness.of(pairings[0], runs.schedules)
        failure_time = np.where(failure < 0, -1.0, failed_at)
        curves, offline_curves = (
            Curves(
                np.stack([each.success for each in some]),
                np.stack([each.precision for each in some]),
            )
            for some in (scored, offline)
        )
        offline_scores = np.array([each.scores for each in offline])
        outcomes = self._outcomes(runs, pairings, known, scores)
        end = 0
        for part in parts:
            begin, end = end, end + len(part)
            own = slice(begin, end)
            of_part = {m: _piece(scores[m], own, 1) for m in METRICS}
            yield Evaluation(
                replay=replay.chosen(np.arange(begin, end)),
                staleness=_pieces(staleness, own),
                scores=of_part,
                failure=_piece(failure, own, 1),
                failure_time=_piece(failure_time, own, 1),
                curves=_pieces(curves, own, 1),
                offline=dict(zip(METRICS, offline_scores[which[own]].T)),
                offline_curves=_pieces(offline_curves, which[own]),
                modelled=modelled_scores(part, of_part, outcomes[own]),
            )

    def _scored(
        self,
        runs: RunBatch,
        pairings: Mapping[int, Pairing],
        known: _Known,
        kept: Sequence[dict[tuple[str, Fraction], Answers]],
    ) -> list[Scored]:
        """The scores of each forecaster."""
        which, scored = known.which(runs), []
        for name, factory in self.forecasters.items():
            pairing = pairings[self.costs.get(name, 0)]
            if factory is Hold and name not in map(itemgetter(0), self.observed):
                of_runs = runs.table, runs.row, runs.own
                held = known.scorer.held(which, pairing, *of_runs, self.curves_at)
                if held is not None:
                    scored.append(held)
                    continue
            parts = _answers(runs, self.image_sizes, pairing, name, factory)
            parts = self._observed(parts, pairing, name, kept)
            scored.append(known.scorer.of(which, parts, len(self.sigmas), self.curves_at))
        return scored

    def _outcomes(
        self,
        runs: RunBatch,
        pairings: Mapping[int, Pairing],
        known: _Known,
        recorded: Mapping[str, Floats],
    ) -> list[dict[str, Floats]]:
        """The scores of the search model's outcomes (see :func:`.modelled.modelled_scores`).

        They are of the runs' schedules, so that they are paired with queries as the runs are.
        """
        scores: list[dict[str, Floats]] = [{} for _ in runs.modelled]
        others: list[tuple[int, int]] = []  # that are not as recorded
        offsets = runs.schedules.offsets.tolist()
        for s, outcomes in enumerate(runs.modelled):
            if outcomes is None:
                continue
            boxes, own = outcomes.boxes, runs.boxes[offsets[s] : offsets[s + 1]]
            scores[s] = {m: np.stack([recorded[m][:, s]] * len(boxes), 1) for m in MODELLED}
            others += [(s, r) for r, each in enumerate(boxes) if not np.array_equal(each, own)]
        unobserved = replace(self, observed=())
        for some in _filled(others, runs.schedules.lengths, GROUP_FRAMES):
            which = np.array([s for s, _ in some])
            answered = [outcome.boxes[r] for s, r in some if (outcome := runs.modelled[s])]
            own_pairings = {cost: each.of_sequences(which) for cost, each in pairings.items()}
            group = runs.answering(which, answered)
            scored = unobserved._scored(group, own_pairings, known, [])
            for i, (s, r) in enumerate(some):
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


def _filled(
    outcomes: Iterable[tuple[int, int]], lengths: Ints, frames: int
) -> Iterator[list[tuple[int, int]]]:
    """Outcomes of sequences, which come first, in groups of about so many world frames."""
    group: list[tuple[int, int]] = []
    pending = 0
    for each in outcomes:
        group.append(each)
        pending += int(lengths[each[0]]) + BESIDE
        if pending >= frames:
            yield group
            group, pending = [], 0
    if group:
        yield group


def _replay_statistics(
    runs: RunBatch, offline: Sequence[_Offline], which: Ints
) -> ReplayStatistics:
    """Those of some runs, with what is scored of recordings alone, and which of them each is of."""
    schedules = runs.schedules
    firsts = schedules.offsets[:-1]
    elapsed = (schedules.ready - schedules.start) // schedules.clocks[0].ticks_per_ns
    init_ns = elapsed[firsts]
    with np.errstate(divide="ignore"):
        rates = 1e9 / elapsed  # infinite where a call took 0
    # zeros in place of initialisations: what is summed up are the other calls, in their order
    elapsed[firsts], rates[firsts] = 0, 0.0
    return ReplayStatistics(
        sequences=tuple(recording.name for recording in runs.recordings),
        repetition=runs.repetition,
        frames=schedules.lengths,
        truthless=np.array([each.truthless for each in offline], np.int64)[which],
        absent=np.array([each.absent for each in offline], np.int64)[which],
        scored=np.array([each.scored for each in offline])[which],
        missing=np.array([each.missing for each in offline], np.int64)[which],
        processed=np.diff(schedules.offsets),
        scores_latency=schedules.scores_latency,
        departures=runs.departures,
        disagreement=runs.disagreement,
        init_ns=init_ns,
        left_search=_left_search(runs),
        calls_ns=np.add.reduceat(elapsed, firsts),
        calls_hz=np.add.reduceat(rates, firsts),
    )


def _left_search(runs: RunBatch) -> Bools:
    """Whether the target leaves the search region during each initialisation, bool [S]."""
    # of a run that processes nothing more, and of one that skips nothing, frame 0: no distance
    offsets, frames = runs.schedules.offsets, runs.schedules.frames
    resumed = np.where(np.diff(offsets) > 1, frames.take(offsets[:-1] + 1, mode="clip"), 0)
    resumed[resumed == 1] = 0
    truths = [recording.truth for recording in runs.recordings]
    initial = np.array([truth[0] for truth in truths])
    then = np.array([truth[frame] for truth, frame in zip(truths, resumed.tolist())])
    left: Bools = search_distance(initial, then) >= 1
    return left


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
    (part,) = _answers(RunBatch.of([run]), lambda _: sizes, pairing, name, factory)
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
    runs: RunBatch,
    pairing: Pairing,
    fed: Histories,
    image_sizes: Callable[[Recording], ImageSizes | None],
) -> Lanes:
    """What forecasters are fed in some histories of some runs.

    Args:
        runs: those that were paired.
        pairing: of their schedules.
        fed: histories of the pairing.
        image_sizes: of the sequence of a recording; None = unknown.
    """
    numbers = pairing.frames.take(fed.output)
    frames = pairing.frame_times(np.repeat(fed.sequence, np.diff(fed.offsets)), numbers)
    fed_boxes = runs.table.take(runs.row.take(fed.output), axis=0)
    recordings, which = runs.distinct
    first = np.full((len(recordings), 2), np.inf)
    resized: dict[int, ImageSizes] = {}
    for k, recording in enumerate(recordings):
        sizes = image_sizes(recording)
        if sizes is None:
            continue
        first[k] = sizes.at(0)
        for s in np.flatnonzero(which == k) if sizes.change else ():
            starts = pairing.frame_times(np.full(len(sizes.starts), s), np.array(sizes.starts))
            timed = ImageSizes(tuple(starts.tolist()), sizes.sizes)
            resized |= {int(lane): timed for lane in np.flatnonzero(fed.sequence == s)}
    return Lanes(
        fed.offsets,
        frames,
        fed_boxes,
        first[which[fed.sequence]],
        None if frames is numbers else numbers,
        resized,
    )


def _answers(
    runs: RunBatch,
    image_sizes: Callable[[Recording], ImageSizes | None],
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
    recordings, which = runs.distinct
    with explained(name):
        own = (
            [factory.for_sequence(recording) for recording in recordings]
            if isinstance(factory, SequenceFactory)
            else [factory] * len(recordings)
        )
        factories, of_recording = distinct(own)
    factory_of = of_recording[which]
    for fed in histories(pairing, memoryless=defines(factory, "memoryless")).parts(_PART):
        paired = pairs(pairing, fed)
        lanes = lanes_of(runs, pairing, fed, image_sizes)
        frame: Ints | Floats = paired.frame
        number: Ints | None = None
        if lanes.numbers is not None:
            sequence = fed.sequence.take(lanes.lane(paired.item))
            frame, number = pairing.frame_times(sequence, paired.frame), paired.frame
        if len(factories) == 1:
            yield fed, paired, forecast(factories[0], lanes, paired.item, frame, name, number)
            continue
        answered = np.empty((len(paired.item), 4))
        for k, one in enumerate(factories):  # at once where several sequences share one
            part, asked, item = lanes.chosen(factory_of[fed.sequence] == k, paired.item)
            some = None if number is None else number[asked]
            answered[asked] = forecast(one, part, item, frame[asked], name, some)
        yield fed, paired, answered
