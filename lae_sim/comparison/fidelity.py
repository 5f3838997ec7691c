"""How far replays are from closed loops, in which the tracker really skipped frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats
from lae_sim.boxes import PARTED_IOU, iou
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError, listed
from lae_sim.evaluation.evaluate import Evaluation, evaluate_runs
from lae_sim.evaluation.metrics import find_convention
from lae_sim.evaluation.modelled import MODELLED
from lae_sim.forecast.base import AnyFactory
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.names import parse_policy
from lae_sim.replay.run import Run, Runs
from lae_sim.replay.search import SearchModel, find_search
from lae_sim.trace.file import Trace, read_held, read_trace
from lae_sim.trace.restarts import RestartName

REPEATED_WITHIN = 0.02
"""AUC; where closed loops of one setting are farther apart, a single figure for them is luck."""

FAR_OFF = 0.05
"""AUC; a replay that is farther from its closed loops on average is not to be trusted."""

# closed loops are of one setting where mean times are alike so far, and the spread of a call's
_SAME_CALL, _SAME_INIT, _SAME_SPREAD = 0.05, 0.1, 0.05
_ROUNDING = 1e-9  # a mean over equal outcomes may differ from them in the last bits
_TRACKER = (("tracker", "name"), ("tracker", "settings"), ("tracker", "weights_digest"))
_SEARCH = (("schedule", "pre_forecaster"), ("schedule", "search"), ("schedule", "keep_size"))


@dataclass(frozen=True)
class FidelityRow:
    """One sequence of a closed loop, and a replay of it.

    Attributes:
        closed_loop: path of the closed loop's trace.
        forecaster: its name.
        replay: which boxes were replayed: ``"every-frame"``, ``"strided"``, or ``"modelled"``: what
            the search model makes of the best of these.
        sequence: its name.
        closed_auc, auc, d_auc: of the closed loop, of the replay, and replay - closed loop.
        closed_dp20, dp20, d_dp20: the same of the precision at 20 pixels.
        parted: the first processed frame whose boxes overlap less than half; None if none does.
            Of a modelled replay it is that of the likeliest outcome.
        approximate_outputs: outputs of the replay after another number of skipped frames than
            in the traces.
        disagreement: of the strides (see :class:`lae_sim.replay.run.Run`); None where there is
            none.
        auc_low, auc_high, dp20_low, dp20_high: the ends of a modelled replay's intervals; the
            scores themselves where the replay is exact, None for the other kinds.
        covered, covered_dp20: whether the closed loop's scores are inside; None for the other
            kinds, and where there is no score.
        c_known: whether the tracker's reach is known, so that the interval is one of 95 %, or else
            what an assumed range spans; None where the replay is exact, and for the other kinds.
        trace: path of the trace that was replayed.
        tracker: its name.
        setting: the closed loop's rate, times, policy and pre-forecaster in words; the same for all
            closed loops of the trace whose times are alike.
    """

    closed_loop: str
    forecaster: str
    replay: str
    sequence: str
    closed_auc: float
    auc: float
    d_auc: float
    closed_dp20: float
    dp20: float
    d_dp20: float
    parted: int | None
    approximate_outputs: int
    disagreement: float | None
    auc_low: float | None
    auc_high: float | None
    covered: bool | None
    dp20_low: float | None
    dp20_high: float | None
    covered_dp20: bool | None
    c_known: bool | None
    trace: str
    tracker: str
    setting: str


@dataclass(frozen=True)
class FidelitySummary:
    """All sequences of a closed loop, or of several, and a replay of them.

    Attributes:
        closed_loop, forecaster, replay: as of the rows; the closed loop is ``"all"`` if they are of
            all.
        sequences: how many rows.
        closed_auc, auc, closed_dp20, dp20: means over the sequences that have a score.
        mean_abs_d_auc, median_abs_d_auc, max_abs_d_auc: of ``|d_auc|`` over these.
        mean_abs_d_dp20, median_abs_d_dp20, max_abs_d_dp20: of ``|d_dp20|`` over these.
        covered, covered_dp20: share of them whose closed loop is inside the interval; None if the
            replay has no intervals.
        width_auc, width_dp20: mean width of the intervals; None if the replay has none.
    """

    closed_loop: str
    forecaster: str
    replay: str
    sequences: int
    closed_auc: float
    auc: float
    mean_abs_d_auc: float
    median_abs_d_auc: float
    max_abs_d_auc: float
    closed_dp20: float
    dp20: float
    mean_abs_d_dp20: float
    median_abs_d_dp20: float
    max_abs_d_dp20: float
    covered: float | None
    covered_dp20: float | None
    width_auc: float | None
    width_dp20: float | None


@dataclass(frozen=True)
class ClosedLoopSpread:
    """How far closed loops of one setting are apart on a sequence.

    Attributes:
        trace, setting, forecaster, sequence: as of the rows.
        closed_loops: how many there are, at least 2.
        auc_low, auc_high, dp20_low, dp20_high: the lowest and the highest of their scores.
        spread: ``auc_high - auc_low``.
    """

    trace: str
    setting: str
    forecaster: str
    sequence: str
    closed_loops: int
    auc_low: float
    auc_high: float
    dp20_low: float
    dp20_high: float
    spread: float


def compare_closed_loops(
    traces: str | Sequence[str],
    closed_loops: Sequence[str],
    *,
    passes: Sequence[str] = (),
    forecasters: Sequence[str] = ("hold",),
    convention: str = "pysot",
    search: str = "trace",
) -> list[FidelityRow]:
    """Compare closed loops with replays at their times.

    Of several traces, each closed loop goes with the one of its tracker and dataset that has its
    sequences, and so does each pass. A closed loop that had a pre-forecaster goes with a trace that
    had the same, or with one that had none: then it is the search model that says what the
    pre-forecaster does, and the recorded boxes know nothing of it.

    Args:
        traces: path of a trace of every frame, or of several.
        closed_loops: paths of real-time traces of the same trackers.
        passes: paths of traces of passes on every N-th frame, and of gap passes.
        forecasters: names (see :func:`lae_sim.learning.registry.load_forecaster`).
        convention: how frames and thresholds count, by name.
        search: see :func:`lae_sim.replay.search.parse_search`.

    Returns:
        A row per closed loop, replay, forecaster and sequence. The replay ``"strided"`` is there
        if passes are given, and ``"modelled"`` unless the search model is off, or a trace was
        recorded with a pre-forecaster.

    Raises:
        LaeError: if a trace cannot be read, is not of the kind needed or of another tracker, or
            there is no such forecaster, convention or search.
    """
    paths = [traces] if isinstance(traces, str) else list(dict.fromkeys(traces))
    factories = {name: load_forecaster(name) for name in forecasters}
    find_convention(convention)
    replayed = _with_passes(paths, list(dict.fromkeys(passes)))
    settings: dict[str, list[_Setting]] = {}

    @cache
    def model(of: _Replayed, pre_forecaster: str | None, keep_size: bool) -> SearchModel | None:
        factory = None if pre_forecaster is None else load_forecaster(pre_forecaster)
        return find_search(search, of.trace.metadata, of.gaps, factory, keep_size)

    rows: list[FidelityRow] = []
    for path in dict.fromkeys(closed_loops):
        closed = read_trace(path)
        of = _replayed_for(path, closed, replayed)
        schedule = closed.metadata.document["schedule"]
        setting = _setting(closed, settings.setdefault(of.path, []))
        # the model stands in for a pre-forecaster that the replayed trace had not
        stood_in = (
            closed.metadata.pre_forecaster if of.trace.metadata.pre_forecaster is None else None
        )
        keep_size = stood_in is not None and bool(schedule.get("keep_size"))
        searches = model(of, stood_in, keep_size)
        rows += _rows(path, closed, of, setting, searches, factories, convention)
    return rows


def summarise_closed_loops(rows: Sequence[FidelityRow]) -> list[FidelitySummary]:
    """The rows of each closed loop, forecaster and replay in short."""
    groups: dict[tuple[str, str, str], list[FidelityRow]] = {}
    for row in rows:
        groups.setdefault((row.closed_loop, row.forecaster, row.replay), []).append(row)
    return [_summary(*key, group) for key, group in groups.items()]


def summarise_replays(rows: Sequence[FidelityRow]) -> list[FidelitySummary]:
    """The rows of each forecaster and replay in short, over all closed loops."""
    groups: dict[tuple[str, str], list[FidelityRow]] = {}
    for row in rows:
        groups.setdefault((row.forecaster, row.replay), []).append(row)
    return [_summary("all", *key, group) for key, group in groups.items()]


def closed_loop_spreads(rows: Sequence[FidelityRow]) -> list[ClosedLoopSpread]:
    """How far closed loops of one setting are apart, where there are several."""
    groups: dict[tuple[str, str, str, str], list[FidelityRow]] = {}
    for row in rows:
        if row.replay == "every-frame":  # any: the closed loop's scores are the same
            key = row.trace, row.setting, row.forecaster, row.sequence
            groups.setdefault(key, []).append(row)
    spreads = []
    for key, group in groups.items():
        if len(group) > 1:
            auc, dp20 = ([getattr(row, f"closed_{m}") for row in group] for m in MODELLED)
            low, high = min(auc), max(auc)
            each = ClosedLoopSpread(*key, len(group), low, high, min(dp20), max(dp20), high - low)
            spreads.append(each)
    return spreads


@dataclass(frozen=True, eq=False)
class _Replayed:
    """A trace of every frame with its passes."""

    path: str
    trace: Trace
    strided: tuple[Trace, ...] = ()
    gaps: tuple[Trace, ...] = ()

    def with_pass(self, trace: Trace) -> _Replayed:
        if trace.metadata.kind == "restarts":
            return replace(self, gaps=(*self.gaps, trace))
        return replace(self, strided=(*self.strided, trace))


def _with_passes(paths: Sequence[str], passes: Sequence[str]) -> list[_Replayed]:
    """Traces of every frame, each with those of the passes that are of its tracker and sequences.

    Raises:
        LaeError: if a trace is of another kind, or a pass goes with none.
    """
    replayed = [_Replayed(path, read_held(path)) for path in paths]
    opened = [(path, read_held(path)) for path in passes]
    for each in replayed:
        if each.trace.metadata.kind == "restarts":
            raise LaeError(f"{each.path}: a gap pass goes to --strided, beside TRACE")
    kinds = {each.metadata.kind for each in (*(r.trace for r in replayed), *(t for _, t in opened))}
    if "real-time" in kinds:
        raise LaeError("TRACE and --strided take traces of every frame, not real-time ones")
    for path, trace in opened:
        mine = [
            k
            for k, each in enumerate(replayed)
            if len(replayed) == 1 or _goes_with(trace, each.trace)
        ]
        if not mine:
            raise LaeError(f"{path}: none of the traces is of its tracker, dataset and sequences")
        for k in mine:
            _check_same(f"the pass {path}", trace, replayed[k], (*_TRACKER, *_SEARCH))
            replayed[k] = replayed[k].with_pass(trace)
    return replayed


def _goes_with(one: Trace, every: Trace) -> bool:
    """Whether a pass is of the tracker of a trace, and of some of its sequences."""
    alike = one.metadata.dataset == every.metadata.dataset
    if not alike or _difference(one, every, (*_TRACKER, *_SEARCH)):
        return False
    names: Iterable[str] = one.names
    if one.metadata.kind == "restarts":
        names = (RestartName.parse(name).sequence for name in names)
    return not set(every.names).isdisjoint(names)


def _replayed_for(path: str, closed: Trace, replayed: Sequence[_Replayed]) -> _Replayed:
    """The trace that a closed loop is compared with.

    Raises:
        LaeError: if it is no closed loop, or none or several of the traces are of its tracker and
            sequences.
    """
    if closed.metadata.kind != "real-time":
        raise LaeError(
            f"{path}: a trace of kind {closed.metadata.kind} is no closed loop: give one that "
            "'lae-sim profile --closed-loop' or '--mode real-time' left"
        )
    found = list(replayed)
    if len(replayed) > 1:
        found = [
            each
            for each in replayed
            if not _difference(closed, each.trace, _TRACKER)
            and closed.metadata.dataset == each.trace.metadata.dataset
            and set(closed.names) <= set(each.trace.names)
        ]
        searched_alike = [e for e in found if not _difference(closed, e.trace, _SEARCH)]
        found = searched_alike or [
            each for each in found if each.trace.metadata.pre_forecaster is None
        ]
    if len(found) != 1:
        several = listed(each.path for each in found)
        raise LaeError(
            f"{path}: {several} are of its tracker and have its sequences: give one of them"
            if several
            else f"{path}: none of the traces is of its tracker, dataset and sequences"
        )
    (one,) = found
    # the search model can stand in for a pre-forecaster, but cannot undo one
    _check_same("the closed loop", closed, one, _TRACKER)
    if one.trace.metadata.pre_forecaster is not None:
        _check_same("the closed loop", closed, one, _SEARCH)
    return one


def _difference(
    one: Trace, other: Trace, keys: Iterable[tuple[str, str]]
) -> tuple[str, object, object] | None:
    """The first of some keys that two traces differ in, with what they say; None if none."""
    documents = one.metadata.document, other.metadata.document
    for section, key in keys:
        here, there = (document.get(section, {}).get(key) for document in documents)
        if here != there:
            return f"{section}.{key}", here, there
    return None


def _check_same(
    what: str, trace: Trace, replayed: _Replayed, keys: Iterable[tuple[str, str]]
) -> None:
    """Check that a trace is of the tracker that is replayed, searching in the same way.

    Raises:
        LaeError: if it is not.
    """
    if difference := _difference(trace, replayed.trace, keys):
        key, here, there = difference
        raise LaeError(
            f"{what}'s {key} is {here!r:.60}, and that of {replayed.path} {there!r:.60}: they must "
            "be of the same tracker"
        )


@dataclass(frozen=True)
class _Setting:
    """Under what a closed loop ran.

    Attributes:
        rules: rate, policy and pre-forecaster in words.
        call_ns, init_ns: mean times of a call and of an initialisation.
        spread: standard deviation of a call's time over its mean.
    """

    rules: str
    call_ns: float
    init_ns: float
    spread: float

    def __str__(self) -> str:
        varied = f" +- {self.spread:.0%}" if self.spread >= 0.005 else ""
        call, init = (f"{round(ns / 1e6, 2):g} ms" for ns in (self.call_ns, self.init_ns))
        return f"{call}{varied}, init {init}, {self.rules}"

    def is_like(self, other: _Setting) -> bool:
        """Whether another run is a repetition of this one."""
        return (
            self.rules == other.rules
            and abs(self.call_ns - other.call_ns) <= _SAME_CALL * self.call_ns
            and abs(self.init_ns - other.init_ns) <= _SAME_INIT * self.init_ns
            and abs(self.spread - other.spread) <= _SAME_SPREAD
        )


def _setting(closed: Trace, known: list[_Setting]) -> str:
    """The setting of a closed loop: one of those known if it is alike, otherwise a new one."""
    schedule = closed.metadata.document["schedule"]
    rules = [f"{closed.metadata.fps} fps", str(schedule.get("policy", "latest"))]
    if closed.metadata.pre_forecaster is not None:
        rules.append(f"pre-forecaster {closed.metadata.pre_forecaster}")
        rules += ["size kept"] if schedule.get("keep_size") else []
    elapsed = [recording.elapsed_ns[recording.elapsed_ns >= 0] for recording in closed]
    calls = np.concatenate([each[1:] for each in elapsed])
    mean = float(calls.mean()) if len(calls) else 0.0
    spread = float(calls.std()) / mean if mean else 0.0
    init = float(np.mean([each[0] for each in elapsed]))
    mine = _Setting(", ".join(rules), mean, init, spread)
    like = next((each for each in known if each.is_like(mine)), None)
    if like is None:
        known.append(mine)
    return str(like or mine)


@dataclass(frozen=True, eq=False)
class _Replay:
    """A replay that was scored: scores and the ends of their intervals per metric, [F, S, 1]."""

    kind: str
    runs: Sequence[Run]
    scores: Mapping[str, Floats]
    ends: tuple[Mapping[str, Floats], Mapping[str, Floats]] | None = None


def _rows(
    path: str,
    closed: Trace,
    of: _Replayed,
    setting: str,
    search: SearchModel | None,
    forecasters: Mapping[str, AnyFactory],
    convention: str,
) -> Iterator[FidelityRow]:
    """The rows of one closed loop."""
    names = closed.names
    every, strided = of.trace.chosen(names), tuple(each.chosen(names) for each in of.strided)
    policy = parse_policy(closed.metadata.document["schedule"].get("policy", "latest"))
    clock, scoring = Clock.at(closed.metadata.fps), find_convention(convention)

    def scored(runs: Sequence[Run]) -> Evaluation:
        return evaluate_runs(runs, closed.metadata, forecasters, (Fraction(0),), scoring)

    closed_runs = list(Runs(closed, clock, policy=policy))
    closed_scores = scored(closed_runs).scores
    replays = []
    for kind, passes in {"every-frame": (), "strided": strided}.items():
        if kind == "strided" and not passes:
            continue
        is_best = passes == strided  # and therefore the one that is modelled
        best = search if is_best else None
        runs = list(Runs(every, clock, policy=policy, timing=closed, passes=passes, search=best))
        evaluation = scored(runs)
        replays.append(_Replay(kind, runs, evaluation.scores))
        if best is not None:
            modelled = evaluation.modelled
            ends = modelled.low, modelled.high
            replays.append(_Replay("modelled", runs, modelled.mean, ends))
    for replay in replays:
        for f, forecaster in enumerate(forecasters):
            for s, (run, closed_run) in enumerate(zip(replay.runs, closed_runs)):
                theirs = {m: float(closed_scores[m][f, s, 0]) for m in MODELLED}
                score = {m: float(replay.scores[m][f, s, 0]) for m in MODELLED}
                low, high, covered = _interval(replay, f, s, theirs)
                outcomes = None if replay.ends is None else run.modelled
                yield FidelityRow(
                    closed_loop=path,
                    forecaster=forecaster,
                    replay=replay.kind,
                    sequence=run.recording.name,
                    closed_auc=theirs["auc"],
                    auc=score["auc"],
                    d_auc=score["auc"] - theirs["auc"],
                    closed_dp20=theirs["dp20"],
                    dp20=score["dp20"],
                    d_dp20=score["dp20"] - theirs["dp20"],
                    parted=_parted(
                        run.boxes if outcomes is None else outcomes.likeliest, closed_run
                    ),
                    approximate_outputs=run.departures,
                    disagreement=None if np.isnan(run.disagreement) else run.disagreement,
                    auc_low=low["auc"],
                    auc_high=high["auc"],
                    covered=covered["auc"],
                    dp20_low=low["dp20"],
                    dp20_high=high["dp20"],
                    covered_dp20=covered["dp20"],
                    c_known=None if outcomes is None else outcomes.known,
                    trace=of.path,
                    tracker=of.trace.metadata.tracker,
                    setting=setting,
                )


def _interval(
    replay: _Replay, f: int, s: int, closed: Mapping[str, float]
) -> tuple[dict[str, float | None], dict[str, float | None], dict[str, bool | None]]:
    """By metric: the ends of a score's interval, and whether the closed loop's is inside."""
    low: dict[str, float | None] = dict.fromkeys(MODELLED)
    high: dict[str, float | None] = dict.fromkeys(MODELLED)
    covered: dict[str, bool | None] = dict.fromkeys(MODELLED)
    for end, ends in zip((low, high), replay.ends or ()):
        for metric in MODELLED:
            if np.isfinite(value := float(ends[metric][f, s, 0])):
                end[metric] = value
    for metric, score in closed.items():
        first, last = low[metric], high[metric]
        if first is not None and last is not None and np.isfinite(score):
            covered[metric] = first - _ROUNDING <= score <= last + _ROUNDING
    return low, high, covered


def _parted(boxes: Floats, closed: Run) -> int | None:
    """The first processed frame whose boxes in replay and closed loop overlap less than half."""
    apart = np.flatnonzero(iou(boxes, closed.boxes) < PARTED_IOU)
    return int(closed.schedule.frames[apart[0]]) if len(apart) else None


def _summary(
    closed_loop: str, forecaster: str, replay: str, rows: Sequence[FidelityRow]
) -> FidelitySummary:
    d_auc = np.abs([row.d_auc for row in rows])
    d_dp20 = np.abs([row.d_dp20 for row in rows])
    return FidelitySummary(
        closed_loop=closed_loop,
        forecaster=forecaster,
        replay=replay,
        sequences=len(rows),
        closed_auc=_known(np.mean, [row.closed_auc for row in rows]),
        auc=_known(np.mean, [row.auc for row in rows]),
        mean_abs_d_auc=_known(np.mean, d_auc),
        median_abs_d_auc=_known(np.median, d_auc),
        max_abs_d_auc=_known(np.max, d_auc),
        closed_dp20=_known(np.mean, [row.closed_dp20 for row in rows]),
        dp20=_known(np.mean, [row.dp20 for row in rows]),
        mean_abs_d_dp20=_known(np.mean, d_dp20),
        median_abs_d_dp20=_known(np.median, d_dp20),
        max_abs_d_dp20=_known(np.max, d_dp20),
        covered=_mean(row.covered for row in rows),
        covered_dp20=_mean(row.covered_dp20 for row in rows),
        width_auc=_mean(_width(row.auc_low, row.auc_high) for row in rows),
        width_dp20=_mean(_width(row.dp20_low, row.dp20_high) for row in rows),
    )


def _known(how: Callable[[Floats], Any], values: npt.ArrayLike) -> float:
    """The mean, the median or the largest of the values that are known; NaN if none is."""
    scores = np.asarray(values, np.float64)
    scores = scores[~np.isnan(scores)]
    return float(how(scores)) if len(scores) else np.nan


def _width(low: float | None, high: float | None) -> float | None:
    return None if low is None or high is None else high - low


def _mean(values: Iterable[float | None]) -> float | None:
    """The mean of those that are known; None if none is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
