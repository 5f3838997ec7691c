"""Comparing forecasters: every score of every sequence in one tidy table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from fractions import Fraction
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.comparison.statistics import mean_over_sigmas
from lae_sim.errors import LaeError
from lae_sim.evaluation.caveats import left_search, notes_on, search_notes
from lae_sim.evaluation.evaluate import Evaluation, evaluate_runs
from lae_sim.evaluation.metrics import METRICS, UNSCORED, find_convention, is_scored
from lae_sim.evaluation.modelled import Ranking
from lae_sim.evaluation.totals import ModelledTotals, search_report
from lae_sim.forecast.base import AnyFactory, Hold
from lae_sim.forecast.costs import cost_notes, resolve_costs
from lae_sim.forecast.kalman import TunedKalman
from lae_sim.learning.folds import Examples, Trainer, assign_folds, cross_fitted
from lae_sim.replay.names import label_of
from lae_sim.replay.passes import passes_for
from lae_sim.replay.run import Runs
from lae_sim.replay.world import RECORDED, SIGMA_GRID, World, open_trace
from lae_sim.trace.describe import InitCost
from lae_sim.trace.file import Trace

if TYPE_CHECKING:
    from pandas import DataFrame

OFFLINE = "offline"


def score_forecasters(
    traces: Mapping[str, Trace],
    forecasters: Mapping[str, AnyFactory | Trainer],
    worlds: Sequence[World] = (RECORDED,),
    folds: int = 5,
    seed: int = 0,
    progress: Callable[[str], object] = lambda what: None,
    pre_forecaster: AnyFactory | None = None,
) -> DataFrame:
    """Score forecasters on every sequence of some traces.

    Those that must be trained are trained once per fold of the sequences, on all the replays of the
    other folds (of the traces' own boxes, whatever passes there are), and score only the sequences
    that they have not seen. Sequences of the same name in several traces, and parts of one video,
    are in the same fold.

    Args:
        traces: traces by name.
        forecasters: factories, or trainers, by name; ``"hold"`` is always compared.
        worlds: how the traces are replayed, one after another; they share permitted latencies,
            convention, costs, passes and search model. Each pass goes with the traces of its
            tracker and dataset. The worlds' own forecasters do not count.
        folds: in how many parts the sequences are dealt out, if anything is trained.
        seed: of the folds and the training.
        progress: told what is done next.
        pre_forecaster: what the worlds' name of one stands for.

    Returns:
        A row per trace, dataset, sequence, latency, scale, forecaster, sigma and metric, with its
        value in 0..1, NaN where the sequence leaves the mean. The scores of the tracker's own boxes
        at their own frames stand as the forecaster ``"offline"``. Where the search model says
        something of a replay, the metrics ``modelled_auc`` and ``modelled_dp20`` and the ends of
        their intervals, ``_low`` and ``_high``, are there too. ``attrs["notes"]`` says what was
        trained and which replays are approximations, ``attrs["init"]`` what initialisations cost in
        each replay, ``attrs["search"]`` what the search model rests on there, and
        ``attrs["modelled"]`` its mean scores with their intervals, by forecaster and sigma;
        ``attrs["ranking"]`` is the :class:`.modelled.Ranking`, as plain values.

    Raises:
        LaeError: if there is no trace, nothing can be scored, the worlds differ in what they share,
            or whatever replaying, training and scoring raise.
    """
    if not traces:
        raise LaeError("there is nothing to compare: name at least one trace")
    if OFFLINE in forecasters:
        raise LaeError(f"{OFFLINE} is the name of the tracker's own scores, not of a forecaster")
    if len({(world.sigmas, world.convention, world.costs) for world in worlds}) != 1:
        raise LaeError("the worlds must share their permitted latencies, convention and costs")
    searches = {(each.passes, each.search, each.pre_forecaster, each.keep_size) for each in worlds}
    if len(searches) != 1:
        raise LaeError("the worlds must share their passes and their search model")
    if not any(is_scored(recording.truth) for trace in traces.values() for recording in trace):
        raise LaeError(f"nothing to compare: {UNSCORED}; lae-sim replay says how late answers are")
    sigmas, convention = worlds[0].sigmas, find_convention(worlds[0].convention)
    ready, notes = fitted(traces, {"hold": Hold, **forecasters}, worlds, folds, seed, progress)
    passes = passes_for(list(traces.values()), [open_trace(each) for each in worlds[0].passes])
    tables, said = [], _Said(notes)
    for (label, trace), own in zip(traces.items(), passes):
        dataset, about = trace.metadata.dataset, []
        for world in worlds:
            replay = replace(world, passes=own).replay(trace, pre_forecaster=pre_forecaster)
            runs = list(replay)
            progress(f"{label}, {world.label()}")
            costs = resolve_costs(world.costs, ready, [runs[0].recording])
            evaluation = evaluate_runs(runs, trace.metadata, ready, sigmas, convention, costs=costs)
            setting = {"latency": label_of(world.latency), "scale": float(world.scale)}
            rows = _rows(evaluation, list(ready), sigmas)
            tables.append(rows.assign(trace=label, dataset=dataset, **setting))
            said.add({"trace": label, **setting}, world, replay, evaluation, list(ready), costs)
            about += notes_on(evaluation.replay, trace.metadata, convention, ready)
            about += replay.notes()
        said.notes += [f"{label}: {note}" for note in dict.fromkeys(about)]
    return _joined(tables, said)


class _Said:
    """What there is to say of some replays beside the scores of their sequences.

    Attributes:
        notes, init, search, modelled: see :func:`score_forecasters`.
        others: notes that several replays may have in common.
        replays: see :meth:`lae_sim.evaluation.modelled.Ranking.of`.
    """

    def __init__(self, notes: Sequence[str]) -> None:
        self.notes = list(notes)
        self.others: dict[str, None] = {}
        self.init: list[dict[str, Any]] = []
        self.search: list[dict[str, Any]] = []
        self.modelled: list[dict[str, Any]] = []
        self.replays: list[tuple[bool | None, bool]] = []

    def add(
        self,
        setting: Mapping[str, Any],
        world: World,
        replay: Runs,
        found: Evaluation,
        forecasters: Sequence[str],
        costs: Mapping[str, int],
    ) -> None:
        """Take in a replay, its scores, and what names it."""
        where = f"{setting['trace']}, {world.label()}"
        init = InitCost.of(found.replay.init_ns, world.init_source(replay.times.metadata))
        self.init.append({**setting, **asdict(init), "left_search": left_search(found.replay)})
        self.notes.append(f"{where}: {init}")
        if share := found.replay.approximate_share:
            self.notes.append(
                f"{where}: approximate, {100 * share:.3g}% of the outputs follow another frame "
                "than when recorded"
            )
        self.notes += [f"{where}: {note}" for note in cost_notes(costs)]
        totals = ModelledTotals(forecasters.index("hold"))
        totals.add(found)
        self.replays.append((totals.known, not found.replay.departures.any()))
        search = search_report(replay.search, world.pre_forecaster, totals)
        if search is None:
            return
        self.search.append({**setting, **search})
        model, rest, *others = search_notes(search)
        self.notes.append(f"{where}: {model} {rest}")
        self.others |= dict.fromkeys(others)
        grids = [False, True] if world.sigmas == SIGMA_GRID else [False]
        for over_grid in grids:
            figures = totals.figures(over_grid)
            sigmas = [0.0] if over_grid else [float(sigma) for sigma in world.sigmas]
            for (f, forecaster), (s, sigma) in product(enumerate(forecasters), enumerate(sigmas)):
                means = {name: _number(values[f, s]) for name, values in figures.items()}
                if over_grid:
                    means = {mean_over_sigmas(name): mean for name, mean in means.items()}
                row = {**setting, "sigma": sigma, "forecaster": forecaster}
                known = {"c_known": totals.known, "lost_share": totals.lost_share}
                self.modelled.append({**row, "over_sigmas": over_grid, **known, **means})


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def fitted(
    traces: Mapping[str, Trace],
    forecasters: Mapping[str, AnyFactory | Trainer],
    worlds: Sequence[World] = (RECORDED,),
    folds: int = 5,
    seed: int = 0,
    progress: Callable[[str], object] = lambda what: None,
) -> tuple[dict[str, AnyFactory], list[str]]:
    """Train those forecasters that must be trained, across folds; see :func:`score_forecasters`.

    Returns:
        A factory for each forecaster, and what to say of the training.
    """
    ready: dict[str, Any] = dict(forecasters)
    trainers = {name: each for name, each in forecasters.items() if isinstance(each, Trainer)}
    if not trainers:
        return ready, []
    own = [
        replace(world, passes=(), search="off", pre_forecaster=None, keep_size=False)
        for world in worlds
    ]
    examples = Examples.of_traces(traces.values(), own)
    dealt = assign_folds(examples.sequences, folds, seed)
    for name, trainer in trainers.items():
        ready[name] = cross_fitted(
            trainer, examples, dealt, seed, partial(progress, f"training {name}")
        )
    note = (
        f"{', '.join(trainers)}: trained in {max(dealt.values()) + 1} folds over {len(dealt)} "
        f"sequences (parts of a video together), seed {seed}: no sequence is scored by what was "
        "trained on it"
    )
    chosen = [
        f"{name} chose {', '.join(dict.fromkeys(map(str, ready[name].factories)))}"
        for name in trainers
        if isinstance(ready[name].factories[0], TunedKalman)
    ]
    return ready, [note, *chosen]


def steps(
    traces: Mapping[str, Trace],
    forecasters: Mapping[str, AnyFactory | Trainer],
    worlds: Sequence[World],
    folds: int,
) -> int:
    """How often ``progress`` is called by it, if there are at least ``folds`` videos."""
    trained = sum(isinstance(each, Trainer) for each in forecasters.values())
    return trained * folds + len(traces) * len(worlds)


def _rows(found: Evaluation, forecasters: Sequence[str], sigmas: Sequence[Fraction]) -> DataFrame:
    """The scores of one replay: sequence, forecaster, sigma, metric and value."""
    import pandas as pd

    sequences, count = found.replay.sequences, len(sigmas)
    shape = 1, len(sequences), count
    scores = {metric: (found.scores[metric], metric) for metric in METRICS}
    for name, each in found.modelled.figures().items():
        scores[f"modelled_{name}"] = (each, name.partition("_")[0])
    values = [
        np.concatenate([each, np.broadcast_to(found.offline[metric][:, None], shape)])
        for each, metric in scores.values()
    ]
    axes = [list(scores), [*forecasters, OFFLINE], sequences, [float(sigma) for sigma in sigmas]]
    index = pd.MultiIndex.from_product(axes, names=["metric", "forecaster", "sequence", "sigma"])
    return pd.DataFrame({"value": np.stack(values).ravel()}, index).reset_index()


def _joined(tables: Sequence[DataFrame], said: _Said) -> DataFrame:
    """The tables as one, columns in order; without modelled scores where nothing is modelled."""
    import pandas as pd

    columns = ["trace", "dataset", "sequence", "latency", "scale", "forecaster", "sigma"]
    joined = pd.concat(tables, ignore_index=True)[[*columns, "metric", "value"]]
    if not said.modelled:
        joined = joined[joined["metric"].isin(METRICS)].reset_index(drop=True)
    joined.attrs |= {
        "notes": [*said.notes, *said.others],
        "init": said.init,
        "search": said.search,
        "modelled": said.modelled,
        "ranking": asdict(Ranking.of(said.replays)),  # attributes are plain, to be written
    }
    return joined
