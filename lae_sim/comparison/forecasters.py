"""Comparing forecasters: every score of every sequence in one tidy table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.errors import LaeError
from lae_sim.evaluation.caveats import left_search, notes_on
from lae_sim.evaluation.evaluate import Evaluation, evaluate_runs
from lae_sim.evaluation.metrics import METRICS, find_convention
from lae_sim.forecast.base import AnyFactory, Hold
from lae_sim.forecast.costs import cost_notes, resolve_costs
from lae_sim.forecast.kalman import TunedKalman
from lae_sim.learning.folds import Examples, Trainer, assign_folds, cross_fitted
from lae_sim.replay.world import RECORDED, World, label_of
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
) -> DataFrame:
    """Score forecasters on every sequence of some traces.

    Those that must be trained are trained once per fold of the sequences, on all the replays of the
    other folds, and score only the sequences that they have not seen. Sequences of the same name in
    several traces, and parts of one video, are in the same fold.

    Args:
        traces: traces by name.
        forecasters: factories, or trainers, by name; ``"hold"`` is always compared.
        worlds: how the traces are replayed, one after another; they share permitted latencies,
            convention and costs. Their own forecasters do not count.
        folds: in how many parts the sequences are dealt out, if anything is trained.
        seed: of the folds and the training.
        progress: told what is done next.

    Returns:
        A row per trace, dataset, sequence, latency, scale, forecaster, sigma and metric, with its
        value in 0..1, NaN where the sequence leaves the mean. The scores of the tracker's own boxes
        at their own frames stand as the forecaster ``"offline"``. ``attrs["notes"]`` says what was
        trained and which replays are approximations, ``attrs["init"]`` what initialisations cost in
        each replay.

    Raises:
        LaeError: if there is no trace, the worlds differ in what they share, or whatever replaying,
            training and scoring raise.
    """
    if not traces:
        raise LaeError("there is nothing to compare: name at least one trace")
    if OFFLINE in forecasters:
        raise LaeError(f"{OFFLINE} is the name of the tracker's own scores, not of a forecaster")
    if len({(world.sigmas, world.convention, world.costs) for world in worlds}) != 1:
        raise LaeError("the worlds must share their permitted latencies, convention and costs")
    sigmas, convention = worlds[0].sigmas, find_convention(worlds[0].convention)
    ready, notes = fitted(traces, {"hold": Hold, **forecasters}, worlds, folds, seed, progress)
    tables, inits = [], []
    for label, trace in traces.items():
        dataset, about = trace.metadata.dataset, []
        for world in worlds:
            replay = world.replay(trace)
            runs = list(replay)
            progress(f"{label}, {world.label()}")
            costs = resolve_costs(world.costs, ready, [runs[0].recording])
            evaluation = evaluate_runs(runs, trace.metadata, ready, sigmas, convention, costs=costs)
            rows = _rows(evaluation, list(ready), sigmas)
            setting = {"latency": label_of(world.latency), "scale": float(world.scale)}
            tables.append(rows.assign(trace=label, dataset=dataset, **setting))
            init = InitCost.of(evaluation.replay.init_ns, world.init_source(replay.times.metadata))
            inits.append(
                {
                    "trace": label,
                    **setting,
                    **asdict(init),
                    "left_search": left_search(evaluation.replay),
                }
            )
            notes += _notes(f"{label}, {world.label()}", evaluation, costs, init)
            about += notes_on(evaluation.replay, trace.metadata, convention, ready)
        notes += [f"{label}: {note}" for note in dict.fromkeys(about)]
    return _joined(tables, notes, inits)


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
    examples = Examples.of_traces(traces.values(), worlds)
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


def _notes(where: str, found: Evaluation, costs: Mapping[str, int], init: InitCost) -> list[str]:
    """What keeps the figures of one replay from being what they seem."""
    notes = [f"{where}: {init}"]
    if share := found.replay.approximate_share:
        notes.append(
            f"{where}: approximate, {100 * share:.3g}% of the outputs follow another frame than "
            "when recorded"
        )
    return notes + [f"{where}: {note}" for note in cost_notes(costs)]


def _rows(found: Evaluation, forecasters: Sequence[str], sigmas: Sequence[Fraction]) -> DataFrame:
    """The scores of one replay: sequence, forecaster, sigma, metric and value."""
    import pandas as pd

    sequences, count = found.replay.sequences, len(sigmas)
    shape = 1, len(sequences), count
    values = [
        np.concatenate([found.scores[m], np.broadcast_to(found.offline[m][:, None], shape)])
        for m in METRICS
    ]
    axes = [METRICS, [*forecasters, OFFLINE], sequences, [float(sigma) for sigma in sigmas]]
    index = pd.MultiIndex.from_product(axes, names=["metric", "forecaster", "sequence", "sigma"])
    return pd.DataFrame({"value": np.stack(values).ravel()}, index).reset_index()


def _joined(
    tables: Sequence[DataFrame], notes: Sequence[str], inits: Sequence[Mapping[str, Any]]
) -> DataFrame:
    """The tables as one, columns in order."""
    import pandas as pd

    columns = ["trace", "dataset", "sequence", "latency", "scale", "forecaster", "sigma"]
    joined = pd.concat(tables, ignore_index=True)[[*columns, "metric", "value"]]
    joined.attrs |= {"notes": list(notes), "init": list(inits)}
    return joined
