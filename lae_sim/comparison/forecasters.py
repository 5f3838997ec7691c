"""Comparing forecasters: every score of every sequence in one tidy table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.errors import LaeError
from lae_sim.evaluation.caveats import notes_on
from lae_sim.evaluation.evaluate import Evaluation, evaluate
from lae_sim.evaluation.metrics import METRICS, PYSOT, Convention
from lae_sim.forecast.base import AnyFactory, Hold
from lae_sim.forecast.costs import cost_notes, resolve_costs
from lae_sim.forecast.kalman import TunedKalman
from lae_sim.learning.folds import Examples, Trainer, assign_folds, cross_fitted
from lae_sim.replay.world import RECORDED, World
from lae_sim.trace.file import Trace

if TYPE_CHECKING:
    from pandas import DataFrame

OFFLINE = "offline"


def compare_forecasters(
    traces: Mapping[str, Trace],
    forecasters: Mapping[str, AnyFactory | Trainer],
    world: World = RECORDED,
    sigmas: Sequence[Fraction] = (Fraction(0),),
    convention: Convention = PYSOT,
    costs: Sequence[str] = (),
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
        world: how the traces are replayed.
        sigmas: permitted latencies in frames, ascending.
        convention: how frames and thresholds count.
        costs: what forecasting costs, which delays the answers (see
            :func:`lae_sim.forecast.costs.resolve_costs`).
        folds: in how many parts the sequences are dealt out, if anything is trained.
        seed: of the folds and the training.
        progress: told what is done next.

    Returns:
        A row per trace, dataset, sequence, latency, scale, forecaster, sigma and metric, with its
        value in 0..1, NaN where the sequence leaves the mean. The scores of the tracker's own boxes
        at their own frames stand as the forecaster ``"offline"``. ``attrs["notes"]`` says what was
        trained and which replays are approximations.

    Raises:
        LaeError: if there is no trace, or whatever replaying, training and scoring raise.
    """
    if not traces:
        raise LaeError("there is nothing to compare: name at least one trace")
    if OFFLINE in forecasters:
        raise LaeError(f"{OFFLINE} is the name of the tracker's own scores, not of a forecaster")
    ready, notes = fitted(traces, {"hold": Hold, **forecasters}, world, folds, seed, progress)
    tables = []
    for label, trace in traces.items():
        dataset = trace.metadata.dataset
        for latency, scale, runs in world.replays(trace):
            setting = latency if scale == 1 else f"{latency} x {scale}"
            progress(f"{label}, {setting}")
            priced = resolve_costs(costs, ready, [runs[0].recording])
            found = evaluate(runs, trace.metadata, ready, sigmas, convention, costs=priced)
            rows = _rows(found, list(ready), sigmas)
            named = {"trace": label, "dataset": dataset, "latency": latency, "scale": float(scale)}
            tables.append(rows.assign(**named))
            notes += _notes(f"{label}, {setting}", found, priced)
        about = notes_on(found, trace.metadata, convention, ready)
        notes += [f"{label}: {note}" for note in about]
    return _joined(tables, notes)


def fitted(
    traces: Mapping[str, Trace],
    forecasters: Mapping[str, AnyFactory | Trainer],
    world: World = RECORDED,
    folds: int = 5,
    seed: int = 0,
    progress: Callable[[str], object] = lambda what: None,
) -> tuple[dict[str, AnyFactory], list[str]]:
    """Train those forecasters that must be trained, across folds; see :func:`compare_forecasters`.

    Returns:
        A factory for each forecaster, and what to say of the training.
    """
    ready: dict[str, Any] = dict(forecasters)
    trainers = {name: each for name, each in forecasters.items() if isinstance(each, Trainer)}
    if not trainers:
        return ready, []
    examples = Examples.joined(
        [Examples.of(runs) for trace in traces.values() for *_, runs in world.replays(trace)]
    )
    dealt = assign_folds(examples.sequences, folds, seed)
    for name, trainer in trainers.items():
        told = partial(progress, f"training {name}")
        ready[name] = cross_fitted(trainer, examples, dealt, seed, told)
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
    world: World,
    folds: int,
) -> int:
    """How often ``progress`` is called by it, if there are at least ``folds`` videos."""
    trained = sum(isinstance(each, Trainer) for each in forecasters.values())
    return trained * folds + len(traces) * len(world.latencies) * len(world.scales)


def _notes(where: str, found: Evaluation, costs: Mapping[str, int]) -> list[str]:
    """What keeps the figures of one replay from being what they seem."""
    notes = []
    calls = int(found.processed.sum()) - len(found.sequences)
    if found.departures.any():
        share = 100 * found.departures.sum() / calls
        notes.append(
            f"{where}: approximate, {share:.3g}% of the outputs follow another frame than when "
            "recorded"
        )
    return notes + [f"{where}: {note}" for note in cost_notes(costs)]


def _rows(found: Evaluation, forecasters: Sequence[str], sigmas: Sequence[Fraction]) -> DataFrame:
    """The scores of one replay: sequence, forecaster, sigma, metric and value."""
    import pandas as pd

    count, sequences = len(sigmas), len(found.sequences)
    values = [
        np.concatenate(
            [found.scores[m], np.broadcast_to(found.offline[m][:, None], (1, sequences, count))]
        )
        for m in METRICS
    ]
    axes = [METRICS, [*forecasters, OFFLINE], found.sequences, [float(sigma) for sigma in sigmas]]
    index = pd.MultiIndex.from_product(axes, names=["metric", "forecaster", "sequence", "sigma"])
    return pd.DataFrame({"value": np.stack(values).ravel()}, index).reset_index()


def _joined(tables: Sequence[DataFrame], notes: Sequence[str]) -> DataFrame:
    """The tables as one, columns in order."""
    import pandas as pd

    columns = ["trace", "dataset", "sequence", "latency", "scale", "forecaster", "sigma"]
    joined = pd.concat(tables, ignore_index=True)[[*columns, "metric", "value"]]
    joined.attrs["notes"] = list(notes)
    return joined
