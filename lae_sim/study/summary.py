"""The summary of a study: means with intervals, what latency costs, how stale answers are.

Two things are uncertain, and kept apart. *Sequences*: 95 % percentile bootstrap over them, of the
scores averaged over the repetitions; *jitter*: the range that holds 95 % of the repetitions' means,
for these very sequences.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, partial
from itertools import groupby, islice, product
from sys import intern
from typing import Any, TypeAlias

import numpy as np

from lae_sim._arrays import Bools, Floats
from lae_sim.comparison.statistics import RESAMPLES, Interval, holm
from lae_sim.engine.clock import Clock
from lae_sim.evaluation.metrics import METRICS
from lae_sim.evaluation.modelled import MODELLED, Ranking, interval, summed
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.study.cells import Cell, Input, Setting
from lae_sim.study.executors import RunAll, run_here
from lae_sim.study.plan import Plan, Source
from lae_sim.study.records import (
    MEAN,
    Behind,
    Consumption,
    Modelled,
    Staleness,
    SummaryRow,
    Uncertainty,
)
from lae_sim.study.rows import COLUMNS
from lae_sim.study.store import Documents, Store
from lae_sim.study.uncertainty import (
    Answers,
    Resamples,
    Sample,
    difference_of,
    differences,
    plain,
    uncertainties,
    uncertainty_of,
)
from lae_sim.trace.columns import to_numpy
from lae_sim.trace.energy import Energy
from lae_sim.trace.metadata import Metadata


@dataclass(frozen=True, eq=False)
class Scores:
    """The finished cells of one trace, setting, convention and forecaster, all repetitions.

    Attributes:
        source: the trace.
        timed: the trace that the times come from.
        setting: the first of the settings, which differ in their repetitions.
        forecaster, convention: names.
        sequences: names, S of them.
        means: per score over the repetitions, float64 [S, M] in 0..1; and of ``mismatch_mean``
            and ``age_mean``; of ``age_max`` and ``longest_stale`` the largest. Where something is
            modelled, ``modelled_auc`` and ``modelled_dp20`` are there and below, those of exact
            replays as they are.
        repeated: ``auc``, ``dp20``, ``failure_frame`` and ``failure_time`` at the first sigma,
            float64 [R, S].
        over_sigmas: ``auc`` and ``dp20`` as plain means over sigma, float64 [R, S].
        once: means by sequence of ``world_frames``, ``processed``, ``elapsed_ms``, ``init_ms``,
            ``lost_share`` and the offline scores, float64 [S].
        keys: of each cell.
        about: of each cell (see :class:`lae_sim.study.cells.Result`); made anew at each look.
        engine, init_source: as of a row of the summary.
        calls, departures: processed frames but the initialisations, and those of them whose output
            follows another frame than when it was recorded.
        notes: on the replays.
        known: whether the reach is known; None where nothing is modelled.
        reach_sources: from where it is known, of each cell where something is modelled.
        intervals: of modelled AUC and DP, at the ``"first"`` sigma and of the ``"mean"`` over them.
    """

    source: Source
    timed: Source
    setting: Setting
    forecaster: str
    convention: str
    sequences: tuple[str, ...]
    means: Mapping[str, Floats]
    repeated: Mapping[str, Floats]
    over_sigmas: Mapping[str, Floats]
    once: Mapping[str, Floats]
    keys: tuple[str, ...]
    about: Sequence[Mapping[str, Any]]
    engine: str
    init_source: str
    calls: int
    departures: int
    notes: tuple[str, ...]
    known: bool | None
    reach_sources: tuple[str, ...]
    intervals: Mapping[str, Mapping[str, Interval]]

    @property
    def is_exact(self) -> bool:
        """Whether every output follows the same frame as when it was recorded."""
        return not self.departures

    @cached_property
    def group(self) -> tuple[str, ...]:
        """What scores must share to be compared: dataset, world, latency, search, convention."""
        setting = self.setting
        return (
            self.source.metadata.dataset,
            setting.policy,
            str(setting.fps),
            setting.latency,
            str(setting.world.scale),
            setting.world.search,
            setting.pre_forecaster,
            self.convention,
        )

    @property
    def identity(self) -> tuple[Any, ...]:
        """What a forecaster and hold share: the group, the trace and where its times are from."""
        return (self.setting.trace, self.setting.timing, *self.group)

    def by_repetition(self, over_sigmas: bool) -> Mapping[str, Floats]:
        """AUC and DP, float64 [R, S]: plain means over sigma, or at the first."""
        return self.over_sigmas if over_sigmas else self.repeated


FEW = 20_000
"""Sequences of missing answers, about, that are sooner resampled here than handed to workers."""

_MEASURED = ("recorded", "by-call", "resample", "lognormal")  # latencies of a trace's own times
_AS_DEAR = 30  # sequences as the rest of an answer
_PIECE = 128  # answers
_WORST = {"age_max", "longest_stale"}
_STALENESS = ("mismatch_mean", "age_mean", *sorted(_WORST))
_REPEATED = ("auc", "dp20", "failure_frame", "failure_time")
_ONCE = ("world_frames", "processed", "elapsed_ms", "init_ms", "lost_share",
         *(f"offline_{m}" for m in METRICS))  # fmt: skip
_MODELLED = tuple(f"modelled_{metric}" for metric in MODELLED)
_Group: TypeAlias = tuple[Sequence[Cell], Sequence[Mapping[str, Any]]]
_READ = tuple(dict.fromkeys(
    ["sequence", "repetition", *METRICS, *_STALENESS, *_MODELLED, *_REPEATED, *_ONCE]
))  # fmt: skip


class Layer(Mapping[str, Floats]):
    """One of several of the same shape, whose arrays are held together.

    Args:
        arrays: of all of them, along the first axis.
        place: of this one there.
    """

    __slots__ = ("_arrays", "_place")

    def __init__(self, arrays: Mapping[str, Floats], place: int) -> None:
        self._arrays, self._place = arrays, place

    def __getitem__(self, name: str) -> Floats:
        values: Floats = self._arrays[name][self._place]
        return values

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)


def read_scores(plan: Plan, store: Store) -> Iterator[Scores]:
    """The finished cells of a study, in the order of the plan; one after another."""
    sources = {source.input: source for source in plan.sources}
    together: dict[tuple[Setting, str, str], list[Cell]] = {}
    for cell in plan.cells:
        same = replace(cell.setting, first=0, count=1)
        together.setdefault((same, cell.forecaster, cell.convention), []).append(cell)
    finished = (
        (cells, tuple(store.about(cell) for cell in cells))
        for cells in together.values()
        if all(map(store.has, cells))
    )

    def alike(group: _Group) -> tuple[object, ...]:
        """What those have in common that are read at once."""
        cells, about = group
        setting, (file, _, rows) = cells[0].setting, store.place(cells[0])
        is_modelled = about[0]["modelled"] is not None
        alone = cells[0].key if len(cells) > 1 else ""
        return file, rows, setting.count, len(setting.world.sigmas), is_modelled, alone

    for _, some in groupby(finished, alike):
        groups, about = zip(*some)
        yield from _read(groups, about, sources, store)
    store.forget()


def _read(
    groups: Sequence[Sequence[Cell]],
    about: Sequence[Sequence[Mapping[str, Any]]],
    sources: Mapping[Input, Source],
    store: Store,
) -> Iterator[Scores]:
    """The scores of some groups of cells, each of the same shape and with its rows in one file.

    The cells of a group differ in their repetitions alone: where there is more than one group, each
    is of one cell.
    """
    modelled = _MODELLED if any(each["modelled"] for each in about[0]) else ()
    totals: dict[str, Floats] = {}  # by group and sequence, and by sigma or not
    repeated: dict[str, list[Floats]] = {name: [] for name in (*_REPEATED, *modelled)}
    over_sigmas: dict[str, list[Floats]] = {name: [] for name in (*MODELLED, *modelled)}
    applies: Bools | None = None
    names: list[tuple[str, ...]] = []
    for cells in zip(*groups):
        entries = _Entries(cells, store)
        names, here = entries.names, entries.is_modelled
        applies = here if applies is None else np.logical_or(applies, here)
        for name in dict.fromkeys([*METRICS, *_STALENESS, *modelled, *_REPEATED, *_ONCE]):
            values = entries.column(name)
            if name in repeated:
                repeated[name].append(values[..., 0])
            if name in over_sigmas:
                over_sigmas[name].append(values.mean(axis=3))
            if name in _ONCE:
                values = values[..., 0]
            # one after another from the first repetition on, however they were dealt out
            before = [totals[name][:, None]] if name in totals else []
            combine = np.maximum if name in _WORST else np.add
            totals[name] = combine.reduce(np.concatenate([*before, values], axis=1), axis=1)
    count = sum(cell.setting.count for cell in groups[0])
    for name in totals.keys() - _WORST:
        totals[name] = totals[name] / count
    means = {name: totals[name] for name in (*METRICS, *_STALENESS, *modelled)}
    once = {name: totals[name] for name in _ONCE}
    by_repetition, plain_means = (
        {name: np.concatenate(parts, axis=1) for name, parts in some.items()}
        for some in (repeated, over_sigmas)
    )
    for n, group in enumerate(groups):
        yield Scores(
            source=sources[group[0].setting.trace],
            timed=sources[group[0].setting.timing or group[0].setting.trace],
            setting=group[0].setting,
            forecaster=group[0].forecaster,
            convention=group[0].convention,
            sequences=names[n],
            means=Layer(means, n),
            repeated=Layer(by_repetition, n),
            over_sigmas=Layer(plain_means, n),
            once=Layer(once, n),
            keys=tuple(cell.key for cell in group),
            about=Documents(store.about, group),
            engine=intern(about[n][0]["engine"]),
            init_source=intern(about[n][0]["init_source"]),
            calls=sum(each["calls"] for each in about[n]),
            departures=sum(each["approximate_outputs"] for each in about[n]),
            notes=tuple(intern(note) for each in about[n] for note in each["notes"]),
            known=next((each["modelled"]["known"] for each in about[n] if each["modelled"]), None),
            reach_sources=tuple(
                intern(each["modelled"]["source"]) for each in about[n] if each["modelled"]
            ),
            intervals=_intervals(
                about[n],
                0 if applies is None else int(applies[n].sum()),
                _is_whole_grid(group[0].setting.world.sigmas),
            ),
        )


def _intervals(
    about: Sequence[Mapping[str, Any]], sequences: int, over_sigmas: bool
) -> dict[str, dict[str, Interval]]:
    """Intervals of modelled scores, from the joint draws of cells; none where they say nothing.

    Args:
        about: of cells that differ in their repetitions alone.
        sequences: of how many the search model says something.
        over_sigmas: whether those of the means over sigma are wanted too.
    """
    cells = [each["modelled"] for each in about if each["modelled"]]
    repetitions = sum(each["repetitions"] for each in about)
    found: dict[str, dict[str, Interval]] = {}
    wanted = ("first", "mean")[: 1 + over_sigmas] if cells else ()
    for draws, metric in product(wanted, MODELLED):
        runs = summed([np.array(cell[draws][metric]) for cell in cells])
        # of one sequence, what is drawn and what is unexplained are the same in all repetitions
        each = runs[:, None, :, None] / repetitions
        rest = max(cell["unexplained"][metric] for cell in cells)
        low, high = interval(each, cells[0]["known"], rest, sequences)
        if np.isfinite(low).all():
            # in whatever chunks repetitions are dealt out, whose sums differ in the last bits
            ends = (round(end.item(), 12) for end in (low, high))
            found.setdefault(draws, {})[metric] = Interval(*ends)
    return found


class _Entries:
    """The rows of N cells of the same shape, which stand in the same file.

    Attributes:
        names: of each cell's sequences, sorted.
    """

    def __init__(self, cells: Sequence[Cell], store: Store) -> None:
        self._file = store.file(cells[0], _READ)
        setting = cells[0].setting
        count, repetitions = len(setting.world.sigmas), setting.count
        sequences = self._file.column("sequence").chunk(0)  # its take imports pyarrow.compute
        repetition = to_numpy(self._file.column("repetition").chunk(0), COLUMNS["repetition"])
        known: dict[tuple[str, ...], tuple[str, ...]] = {}  # most are the same
        self.names, rows = [], []
        for cell in cells:
            _, first, size = store.place(cell)
            some = np.arange(first, first + size, count)  # the first row of each entry
            of_entry = [sequences[row].as_py() for row in some.tolist()]
            names = tuple(map(intern, sorted(set(of_entry))))
            place = {name: s for s, name in enumerate(names)}
            by_name = np.array([place[name] for name in of_entry])
            # by repetition, then by sequence
            rows.append(some[np.lexsort((by_name, repetition[some]))])
            self.names.append(known.setdefault(names, names))
        places = np.stack(rows).reshape(len(cells), repetitions, -1, 1)
        self._rows = places + np.arange(count)  # [N, R, S, M]
        self._exact = np.isnan(self._values("lost_share"))

    @property
    def is_modelled(self) -> Bools:
        """Of which sequences the search model says something that is scored, bool [N, S]."""
        here = ~self._exact[..., 0] & (self._values("failure_frame")[..., 0] >= 0)
        modelled: Bools = np.logical_or.reduce(here, axis=1)
        return modelled

    def column(self, name: str) -> Floats:
        """A column by cell, repetition, sequence and sigma, float64 [N, R, S, M].

        What is modelled is as recorded where the replay is exact, and no output is lost there.
        """
        values = self._values(name)
        if name in _MODELLED:
            return np.where(self._exact, self._values(name.removeprefix("modelled_")), values)
        return np.where(self._exact, 0.0, values) if name == "lost_share" else values

    def _values(self, name: str) -> Floats:
        values = to_numpy(self._file.column(name).chunk(0), COLUMNS[name])
        chosen: Floats = values[self._rows].astype(np.float64, copy=False)
        return chosen


def summarise_study(
    scores: Sequence[Scores],
    seed: int = 0,
    resamples: int = RESAMPLES,
    answers: Answers | None = None,
    run: RunAll = run_here,
) -> list[SummaryRow]:
    """A row per trace, setting, convention, forecaster and sigma, and one of their means.

    Args:
        scores: all of a study.
        seed: of the resamples.
        resamples: of the bootstrap.
        answers: those that are known, which are not sought again; new ones are added.
        run: the workers, for what is worth to be handed to them.

    Returns:
        Rows in the order of the scores. Intervals and tests stand in the rows of the first sigma
        and of the mean over sigma; so does how far each trace with each forecaster is behind the
        best of those with the same sequences.
    """
    how, answers = Resamples(seed, resamples), Answers() if answers is None else answers
    hold = {each.identity: each for each in scores if each.forecaster == "hold"}
    rankings = rankings_of(scores)
    _resample([(each, hold.get(each.identity)) for each in scores], how, answers, run)
    rows: list[SummaryRow] = []
    rivals: dict[tuple[Any, ...], list[int]] = {}
    ranks: dict[tuple[Any, ...], list[tuple[int, Scores]]] = {}
    for each in scores:
        for row in _rows(each, hold.get(each.identity), how, answers):
            row = replace(row, ranked_by=rankings[each.group].by)
            rival = (*each.group, each.sequences, each.forecaster, row.sigma)
            rivals.setdefault(rival, []).append(len(rows))
            if row.certainty("auc") and row.score("auc") is not None:
                rank = (*each.group, each.sequences, row.sigma)
                ranks.setdefault(rank, []).append((len(rows), each))
            rows.append(row)
    for places in rivals.values():
        for place in _front([rows[place] for place in places]):
            rows[places[place]] = replace(rows[places[place]], pareto=True)
        for place in _front([rows[place] for place in places], _joules):
            row = rows[places[place]]
            if row.energy is not None:
                rows[places[place]] = replace(row, energy=replace(row.energy, pareto=True))
    for some in ranks.values():
        ranked_rows = [(rows[place], each) for place, each in some]
        behind = _behind(ranked_rows, rankings[some[0][1].group], how, answers)
        for (place, _), found in zip(some, behind):
            rows[place] = replace(rows[place], behind=found)
    return rows


def _behind(
    rivals: Sequence[tuple[SummaryRow, Scores]], ranking: Ranking, how: Resamples, answers: Answers
) -> list[Behind | None]:
    """How far each of some rows is behind the best of them; None of that one.

    The best is chosen by these very scores. Corrected for the others alone, the true best is still
    among those not told apart from it, as often as the level says: Hsu, "Multiple Comparisons",
    1996, Ch. 4.
    """
    best, of_best = max(rivals, key=lambda rival: rival[0].score("auc") or 0)
    over_sigmas = best.sigma == MEAN
    keys = {
        i: how.key("behind", ranking.by, over_sigmas, scores.keys, of_best.keys)
        for i, (row, scores) in enumerate(rivals)
        if row is not best
    }
    margins: dict[str, Floats] = {}
    for i, key in keys.items():
        if not answers.has(key):
            first, second = _paired(rivals[i][1], of_best, ranking, over_sigmas)
            answers.put(key, None)
            if first.size:
                margins[key] = first.mean(axis=0) - second.mean(axis=0)
    for key, difference in zip(margins, differences([*margins.values()], how)):
        answers.put(key, plain(difference))
    known = {i: difference_of(answers[key]) for i, key in keys.items() if answers[key] is not None}
    corrected = dict(zip(known, holm([difference.p for difference in known.values()])))
    name = best.run, best.forecaster
    return [
        Behind(name, known[i], corrected[i]) if i in known else None for i in range(len(rivals))
    ]


def rankings_of(scores: Sequence[Scores]) -> dict[tuple[str, ...], Ranking]:
    """By what the scores of each group are ranked and compared."""
    replays: dict[tuple[str, ...], list[tuple[bool | None, bool]]] = {}
    for each in scores:
        replays.setdefault(each.group, []).append((each.known, each.is_exact))
    return {group: Ranking.of(some) for group, some in replays.items()}


def _rows(
    scores: Scores, hold: Scores | None, how: Resamples, answers: Answers
) -> Iterator[SummaryRow]:
    setting, metadata, sigmas = scores.setting, scores.source.metadata, scores.setting.world.sigmas
    departures, calls = scores.departures, scores.calls
    frames = scores.once["world_frames"]
    row = SummaryRow(
        trace=setting.trace.label,
        tracker=metadata.tracker,
        dataset=metadata.dataset,
        device=metadata.device,
        times_from=(setting.timing or setting.trace).label,
        policy=setting.policy,
        fps=setting.fps,
        latency=setting.latency,
        scale=setting.world.scale,
        search=setting.world.search,
        pre_forecaster=setting.pre_forecaster,
        convention=scores.convention,
        forecaster=scores.forecaster,
        sequences=len(scores.sequences),
        repetitions=len(scores.repeated["auc"]),
        engine=scores.engine,
        exact=departures == 0,
        approximate_share=departures / calls if calls else 0.0,
        elapsed_ms=_mean(scores.once["elapsed_ms"]),
        init_ms=float(scores.once["init_ms"].mean()),
        init_source=scores.init_source,
        skip_rate=float(1 - scores.once["processed"].sum() / frames.sum()),
        sigma=MEAN,
        scores={},
        offline={metric: _mean(scores.once[f"offline_{metric}"]) for metric in METRICS},
    )
    row = replace(row, energy=_energy(row, scores.timed.metadata))
    for s, sigma in enumerate(sigmas):
        yield replace(
            row,
            sigma=sigma,
            scores={metric: _mean(scores.means[metric][:, s]) for metric in METRICS},
            uncertainty=_uncertainty(_key(scores, hold, False, how), answers) if s == 0 else {},
            staleness=_staleness(scores, s),
            modelled=_modelled(scores, [s], "first" if s == 0 else None),
        )
    if _has_grid(sigmas):
        grid = [s for s, sigma in enumerate(sigmas) if sigma in SIGMA_GRID]
        whole = len(grid) == len(sigmas)
        yield replace(
            row,
            scores={metric: _mean_of_means(scores.means[metric][:, grid]) for metric in METRICS},
            uncertainty=_uncertainty(_key(scores, hold, True, how), answers) if whole else {},
            modelled=_modelled(scores, grid, "mean" if whole else None),
        )


def _energy(row: SummaryRow, timed: Metadata) -> Consumption | None:
    """What the calls of a row take, at the power that was measured when its times were.

    Args:
        row: whose times are as they were measured, or drawn from those.
        timed: of the trace that they come from.
    """
    energy = Energy.of(timed.document)
    if energy is None or row.scale != 1 or row.elapsed_ms is None or energy.watts is None:
        return None
    if row.latency.partition(":")[0].partition(",")[0] not in _MEASURED or timed.timing_note:
        return None
    seconds, rest = row.elapsed_ms / 1e3, energy.idle_watts
    above = None if rest is None else (energy.watts - rest) * seconds
    processed_per_second = float(row.fps) * (1 - row.skip_rate)
    watts = None if rest is None or above is None else rest + above * processed_per_second
    return Consumption(energy.watts * seconds, above, watts)


def _modelled(scores: Scores, at: Sequence[int], draws: str | None) -> Modelled | None:
    """Scores under the search model, as plain means over some sigmas.

    Args:
        scores: of all sequences and repetitions.
        at: indices of the sigmas.
        draws: which intervals belong to it; None for none.
    """
    if scores.known is None:
        return None
    means = {m: _mean_of_means(scores.means[f"modelled_{m}"][:, at]) for m in MODELLED}
    outputs = scores.once["processed"]
    lost = float(scores.once["lost_share"] @ outputs / outputs.sum())
    return Modelled(scores.known, lost, means, scores.intervals.get(draws or "", {}))


def _resample(
    all_scores: Iterable[tuple[Scores, Scores | None]],
    how: Resamples,
    answers: Answers,
    run: RunAll,
) -> None:
    """Add the answers that are missing: how sure the means of scores are, beside hold's."""
    missing = {
        key: (scores, hold, over_sigmas)
        for scores, hold in all_scores
        for over_sigmas in (False, True)[: 1 + _is_whole_grid(scores.setting.world.sigmas)]
        if not answers.has(key := _key(scores, hold, over_sigmas, how))
    }
    few = sum(len(scores.sequences) + _AS_DEAR for scores, _, _ in missing.values()) < FEW
    asked = ((key, _samples(*each)) for key, each in missing.items())
    pieces = iter(lambda: [*islice(asked, _PIECE)], [])
    work = partial(_resampled, how=how)
    with closing((run_here if few else run)(work, pieces)) as found:
        for piece, of_piece in found:
            for (key, _), answer in zip(piece, of_piece):
                answers.put(key, answer)


def _resampled(
    piece: Sequence[tuple[str, Mapping[str, Sample]]], how: Resamples
) -> list[dict[str, Any]]:
    """The answers to a piece, by metric."""
    found = iter(uncertainties([each for _, some in piece for each in some.values()], how))
    return [{metric: plain(next(found)) for metric in some} for _, some in piece]


def _key(scores: Scores, hold: Scores | None, over_sigmas: bool, how: Resamples) -> str:
    """Digest of all that the answer depends on."""
    base = None if hold is None or hold is scores else hold.keys
    return how.key("mean", over_sigmas, scores.keys, base)


def _samples(scores: Scores, hold: Scores | None, over_sigmas: bool) -> dict[str, Sample]:
    """What is uncertain of AUC and DP; of those of a known reach too."""
    samples = {}
    for metric in (*MODELLED, *(_MODELLED if scores.known else ())):
        values = scores.by_repetition(over_sigmas)[metric]
        base = None if hold is None or hold is scores else hold.by_repetition(over_sigmas)[metric]
        kept = ~np.isnan(values.mean(axis=0))
        if base is not None:
            kept &= ~np.isnan(base.mean(axis=0))
        if not kept.any():
            continue
        if base is None:
            samples[metric] = Sample(values[:, kept])
        else:
            offline = scores.once[f"offline_{metric.removeprefix('modelled_')}"][kept]
            samples[metric] = Sample(values[:, kept], base[:, kept].mean(axis=0), offline)
    return samples


def _uncertainty(key: str, answers: Answers) -> dict[str, Uncertainty]:
    """How sure mean AUC and DP are, and what is won over hold; those of a known reach too."""
    return {metric: uncertainty_of(answer) for metric, answer in answers[key].items()}


def _is_whole_grid(sigmas: Sequence[Fraction]) -> bool:
    """Whether the sigmas are those of the grid, so that means over them are uncertain too."""
    return _has_grid(sigmas) and set(sigmas) == set(SIGMA_GRID)


def _has_grid(sigmas: Sequence[Fraction]) -> bool:
    """Whether all sigmas of the grid are among some."""
    return len(sigmas) >= len(SIGMA_GRID) and set(SIGMA_GRID) <= set(sigmas)


def _staleness(scores: Scores, s: int) -> Staleness:
    """How old answers are, and how long the target is held, in world time, at one sigma."""
    sigma, clock = scores.setting.world.sigmas[s], Clock.at(scores.setting.fps)
    frames, frame_ms = scores.once["world_frames"], clock.milliseconds(1)
    mismatch, age = (
        float((scores.means[name][:, s] * frames).sum() / frames.sum())
        for name in ("mismatch_mean", "age_mean")
    )
    staleness = Staleness(
        mismatch_mean=mismatch,
        age_ms=(age + float(sigma)) * frame_ms,
        age_max_ms=float(scores.means["age_max"][:, s].max() + sigma) * frame_ms,
        longest_stale_ms=float(scores.means["longest_stale"][:, s].max()) * frame_ms,
    )
    if s:
        return staleness
    failure = scores.repeated["failure_frame"]
    scored = failure >= 0
    failed = (failure < frames)[scored]
    median = _median_survival(scores.repeated["failure_time"][scored], failed)
    return replace(
        staleness,
        failed=float(failed.mean()) if len(failed) else None,
        time_to_failure_ms=None if median is None else median * frame_ms,
    )


def _median_survival(times: Floats, failed: Bools) -> float | None:
    """Median time to failure, in the unit of the times; None if less than half fail.

    Sequences that end without failure are censored: the estimate is that of Kaplan and Meier,
    "Nonparametric Estimation from Incomplete Observations", 1958. In exact numbers, for in floats
    (as scipy.stats.ecdf has it) half of them may not be half.
    """
    alive = Fraction(1)
    for time in np.unique(times[failed]):
        lost = np.count_nonzero(failed & (times == time))
        alive *= 1 - Fraction(int(lost), int(np.count_nonzero(times >= time)))
        if alive <= Fraction(1, 2):
            return float(time)
    return None


def _elapsed_ms(row: SummaryRow) -> float | None:
    return row.elapsed_ms


def _joules(row: SummaryRow) -> float | None:
    return None if row.energy is None else row.energy.joules_per_frame


def _front(
    rivals: Sequence[SummaryRow], cost_of: Callable[[SummaryRow], float | None] = _elapsed_ms
) -> list[int]:
    """Those on the Pareto front of rivals: no other has a higher AUC and calls that cost less.

    Rivals are the traces with the same sequences, world, latency, convention, forecaster and sigma.
    """
    known = [
        (place, auc, cost)
        for place, row in enumerate(rivals)
        if (auc := row.score("auc")) is not None and (cost := cost_of(row)) is not None
    ]
    return [
        place
        for place, auc, cost in known
        if not any(
            other >= auc and others_cost <= cost and (other, others_cost) != (auc, cost)
            for _, other, others_cost in known
        )
    ]


def _mean(values: Floats) -> float | None:
    """Mean of the sequences that have a value."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None


def _mean_of_means(values: Floats) -> float | None:
    """Plain mean over sigma of the means over sequences; values are [S, M]."""
    means = [_mean(values[:, s]) for s in range(values.shape[1])]
    known = [mean for mean in means if mean is not None]
    return float(np.mean(known)) if len(known) == len(means) else None


def _paired(a: Scores, b: Scores, ranking: Ranking, over_sigmas: bool) -> tuple[Floats, Floats]:
    """The AUCs that count of the sequences that have one in both, float64 [R, S] each."""
    both = sorted(set(a.sequences) & set(b.sequences))
    first, second = (
        ranked(one.by_repetition(over_sigmas), ranking)[
            :, [one.sequences.index(name) for name in both]
        ]
        for one in (a, b)
    )
    kept = ~np.isnan(first.mean(axis=0) + second.mean(axis=0))
    return first[:, kept], second[:, kept]


def ranked(values: Mapping[str, Floats], ranking: Ranking) -> Floats:
    """The AUC that counts, of ``means``, ``repeated`` or ``over_sigmas`` of some scores."""
    name = "modelled_auc" if ranking.modelled else "auc"
    return values.get(name, values["auc"])  # without the first where the replay is exact
