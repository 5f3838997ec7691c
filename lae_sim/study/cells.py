"""The cells of a study: one forecaster and convention on one replay of one trace.

A cell is named by a digest of all that its figures depend on, so that a finished one is found
again, and one whose input has changed is not. Cells of the same replay are computed together.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import chain, groupby
from typing import Any

import numpy as np

from lae_sim import __version__
from lae_sim._arrays import Floats
from lae_sim.engine.lanes import batchable
from lae_sim.evaluation.caveats import notes_on
from lae_sim.evaluation.evaluate import Evaluation, ReplayStatistics, evaluate_together
from lae_sim.evaluation.metrics import find_convention
from lae_sim.evaluation.modelled import MODELLED, over_sigmas
from lae_sim.evaluation.totals import CurveTotals, ModelledTotals
from lae_sim.files import text_digest
from lae_sim.forecast.base import AnyFactory
from lae_sim.forecast.costs import cost_notes
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.latency import RandomSource
from lae_sim.replay.names import kind_of, label_of
from lae_sim.replay.pipeline import pipeline_document
from lae_sim.replay.run import Repetitions, Run, RunBatch, Runs, replay_together
from lae_sim.replay.search import SearchModel
from lae_sim.replay.world import World
from lae_sim.study.rows import CellRows, RowsFile
from lae_sim.study.spec import is_random
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata

VERSION = 6
"""Of the cells' files; another version is another cell."""

GROUP = 1 << 17
"""World frames that are scored at once."""


@dataclass(frozen=True)
class Input:
    """A trace that a study reads.

    Attributes:
        path: file or URL.
        label: its name in tables.
        digest: SHA-256 of its content.
        stamp: size and time of a local file when the digest was taken; empty of any other.
    """

    path: str
    label: str
    digest: str
    stamp: str = ""


@dataclass(frozen=True)
class Setting:
    """One way to replay and score one trace.

    Attributes:
        trace: the boxes and the truth.
        timing: another device's trace that the times come from; the world names it too.
        passes: strided and gap passes; the world names them too.
        world: how the trace is replayed, of random times with their seed; conventions, forecasters
            and costs are the cells'.
        code: of a user's own policy or latency, or times in a pipeline, a digest of its file.
        first, count: which repetitions of a random latency; 0 and 1 of any other.
        sequences: those wanted; all if empty.
    """

    trace: Input
    timing: Input | None
    passes: tuple[Input, ...]
    world: World
    code: str
    first: int
    count: int
    sequences: tuple[str, ...]

    @property
    def run(self) -> str:
        """The trace's label, and that of the one whose times it takes, if it is another."""
        return self.trace.label + ("" if self.timing is None else f" at {self.timing.label}")

    @property
    def fps(self) -> Fraction:
        """World frame rate, which a study always knows."""
        if self.world.fps is None:
            raise ValueError("the world of a setting has a frame rate of its own")
        return self.world.fps

    @property
    def policy(self) -> str:
        """The policy as the study names it."""
        return self.world.policy_label

    @property
    def latency(self) -> str:
        """The latency as the study names it, without the seed of a random one."""
        latency = label_of(self.world.latency)
        kind, (_, comma, init) = kind_of(latency), latency.partition(",")
        return f"{kind}{comma}{init}" if is_random(latency) else latency

    @property
    def pre_forecaster(self) -> str:
        """What says where the tracker searches, as tables name it."""
        name = self.world.pre_forecaster or "none"
        return f"{name}, size kept" if self.world.keep_size else name

    @property
    def inputs(self) -> list[Input]:
        """All files that are read."""
        return [self.trace, *([] if self.timing is None else [self.timing]), *self.passes]

    def columns(self) -> dict[str, str]:
        """What names the replay in tables."""
        return {
            "trace": self.trace.label,
            "times_from": (self.timing or self.trace).label,
            "policy": self.policy,
            "fps": str(self.fps),
            "latency": self.latency,
            "scale": str(self.world.scale),
            "search": self.world.search,
            "pre_forecaster": self.pre_forecaster,
        }

    def document(self) -> dict[str, Any]:
        """Plain values of all that the rows depend on: labels and contents of files, not paths."""
        pipeline = self.world.pipeline
        return {
            **({} if pipeline is None else {"pipeline": pipeline_document(pipeline)}),
            **self.columns(),
            "trace": [self.trace.label, self.trace.digest],
            "timing": self.timing and [self.timing.label, self.timing.digest],
            "passes": [[each.label, each.digest] for each in self.passes],
            "code": self.code,
            "latency": label_of(self.world.latency),
            "first": self.first,
            "count": self.count,
            "sigmas": [str(sigma) for sigma in self.world.sigmas],
            "sequences": list(self.sequences),
            "forget_arrivals": self.world.forget_arrivals,
        }


@dataclass(frozen=True)
class Cell:
    """One forecaster and convention on one replay.

    Attributes:
        setting: the replay.
        forecaster: its name.
        code: what else it depends on: a digest of its file or of its training.
        cost_ns: what an answer costs.
        convention: how frames and thresholds count.
    """

    setting: Setting
    forecaster: str
    code: str
    cost_ns: int
    convention: str

    @cached_property
    def key(self) -> str:
        """Digest of all that the figures depend on."""
        document = {
            "lae_sim": __version__,
            "version": VERSION,
            "setting": self.setting.document(),
            "forecaster": self.forecaster,
            "code": self.code,
            "cost_ns": self.cost_ns,
            "convention": self.convention,
        }
        return text_digest(json.dumps(document, sort_keys=True))

    def about(self, metadata: Metadata) -> dict[str, str]:
        """The columns that are the same in all its rows."""
        return {
            **self.setting.columns(),
            "tracker": metadata.tracker,
            "dataset": metadata.dataset,
            "convention": self.convention,
            "forecaster": self.forecaster,
        }


@dataclass(frozen=True)
class Task:
    """Cells of one replay, to be computed together.

    Attributes:
        cells: of the same setting.
        factories: their forecasters, by name.
    """

    cells: tuple[Cell, ...]
    factories: Mapping[str, AnyFactory]


@dataclass(frozen=True)
class Result:
    """What was computed of a cell.

    Attributes:
        key: the cell's.
        rows: a Parquet file (see :mod:`lae_sim.study.rows`); empty where cells share one.
        first, count: the first of the cell's rows in its file, and how many they are.
        about: curves at the first sigma, how many outputs are approximate, the engine, where times
            of initialisations are from, notes, what is modelled (see :func:`_modelled`).
    """

    key: str
    rows: bytes
    first: int
    count: int
    about: dict[str, Any]


def compute(
    tasks: Sequence[Task], traces: Sequence[Trace], shared: RowsFile | None = None
) -> list[list[Result]]:
    """Replay once for each convention, and score; small tasks at once.

    Args:
        tasks: what to do; with several, all are of held traces.
        traces: the trace of each.
        shared: the file that the rows go to; by default each cell has its own.

    Returns:
        The results of each task.

    Raises:
        LaeError: whatever replaying and scoring raise.
    """
    shares: list[_Share] = []
    for place, (task, trace) in enumerate(zip(tasks, traces)):
        for convention in dict.fromkeys(cell.convention for cell in task.cells):
            cells = [cell for cell in task.cells if cell.convention == convention]
            shares.append(_Share(place, cells, task.factories, trace, shared))
    alike: dict[Any, list[_Share]] = {}
    for share in shares:
        alike.setdefault(share.way, []).append(share)
    for some in alike.values():
        _score(some)
    results: list[list[Result]] = [[] for _ in tasks]
    for share in shares:
        results[share.place] += share.results()
    return results


def _score(shares: Sequence[_Share]) -> None:
    """Score what is scored in the same way."""
    first = shares[0]
    for place, part in evaluate_together(
        _runs(shares),
        [share.trace.metadata for share in shares],
        first.factories,
        first.setting.world.sigmas,
        first.convention,
        costs=first.costs,
        frames=GROUP,
    ):
        shares[place].add(part)


def _runs(shares: Sequence[_Share]) -> Iterator[tuple[int, RunBatch]]:
    """The runs of each share, with its place."""
    for repeats, some in groupby(enumerate(shares), lambda each: each[1].replay.repeats):
        places, own = zip(*some)
        replays = [share.replay for share in own]
        if repeats:
            for place, replay in zip(places, replays):
                yield from ((place, batch) for batch in replay.batches())
        else:
            for i, batch in replay_together([replay.runs for replay in replays]):
                yield places[i], batch


class _Share:
    """The cells of one setting and one convention, and what is known of them so far."""

    def __init__(
        self,
        place: int,
        cells: Sequence[Cell],
        factories: Mapping[str, AnyFactory],
        trace: Trace,
        shared: RowsFile | None,
    ) -> None:
        self.place, self.cells, self.trace = place, cells, trace
        self.setting = cells[0].setting
        self.convention = find_convention(cells[0].convention)
        self.factories = {cell.forecaster: factories[cell.forecaster] for cell in cells}
        self.costs = {cell.forecaster: cell.cost_ns for cell in cells if cell.cost_ns}
        self.replay = replayed(self.setting, trace)
        sigmas = self.setting.world.sigmas
        self._writers = [CellRows(sigmas, cell.about(trace.metadata), shared) for cell in cells]
        self._curves, self._modelled = CurveTotals(), ModelledTotals(0)
        self._kept: list[ReplayStatistics] = []
        self._departures = self._calls = 0

    @property
    def way(self) -> tuple[Any, ...]:
        """Shares that differ in it cannot be scored at once."""
        made = tuple((name, id(factory)) for name, factory in self.factories.items())
        return self.convention.name, self.setting.world.sigmas, made, tuple(self.costs.items())

    def add(self, part: Evaluation) -> None:
        """Take in what was scored of some runs."""
        repetitions = part.replay.repetition.astype(np.int32)
        for f, writer in enumerate(self._writers):
            writer.add(part, f, repetitions)
        self._curves.add(part)
        self._modelled.add(part)
        self._departures += int(part.replay.departures.sum())
        self._calls += int((part.replay.processed - 1).sum())
        first = np.flatnonzero(repetitions == self.setting.first)
        self._kept.append(part.replay.chosen(first))

    def results(self) -> list[Result]:
        """The results of the cells."""
        about, metadata = ReplayStatistics.joined(self._kept), self.trace.metadata
        results = []
        for f, (cell, writer) in enumerate(zip(self.cells, self._writers)):
            only = {cell.forecaster: self.factories[cell.forecaster]}
            details = {
                "engine": self.replay.engine,
                "repetitions": self.setting.count,
                "curves": _curves(self._curves, f),
                "approximate_outputs": self._departures,
                "calls": self._calls,
                "init_source": self.setting.world.init_source(self.replay.runs.times.metadata),
                "modelled": _modelled(self._modelled, f, self.replay.runs.search),
                "notes": [
                    *notes_on(about, metadata, self.convention, only),
                    *self.replay.runs.notes(),
                    *cost_notes({cell.forecaster: cell.cost_ns} if cell.cost_ns else {}),
                ],
            }
            results.append(Result(cell.key, *writer.finish(), details))
        return results


def _curves(totals: CurveTotals, f: int) -> dict[str, list[float] | None]:
    """Those of a forecaster, and offline; None where no sequence counts."""
    forecast, offline = totals.curves(f), totals.offline
    named = {
        "success": forecast.success,
        "offline_success": offline.success,
        "precision": forecast.precision,
        "offline_precision": offline.precision,
    }
    return {name: None if np.isnan(c[0]) else c.tolist() for name, c in named.items()}


def _modelled(totals: ModelledTotals, f: int, search: SearchModel | None) -> dict[str, Any] | None:
    """Of a forecaster's modelled scores what its rows do not say; None where nothing is modelled.

    That is whether the reach is known, from where, and the joint draws (see
    :class:`lae_sim.evaluation.modelled.ModelledScores`) of the scores at the first sigma, and of
    their means over sigma: sums over the sequences and repetitions, and how many count.
    """
    if search is None or totals.known is None:
        return None
    draws = {metric: totals.draws(metric)[:, f] for metric in MODELLED}  # [2, J, M]
    return {
        "known": totals.known,
        "source": search.source,
        "unexplained": dict(totals.unexplained),
        "first": {metric: _distinct(each[..., 0]) for metric, each in draws.items()},
        "mean": {metric: _distinct(over_sigmas(each)[..., 0]) for metric, each in draws.items()},
    }


def _distinct(draws: Floats) -> list[list[float]]:
    """Draws, or one of them where they are all the same."""
    same = bool((draws == draws[:, :1]).all())
    kept: list[list[float]] = (draws[:, :1] if same else draws).tolist()
    return kept


@dataclass(frozen=True)
class Replayed:
    """The replay of a setting.

    Attributes:
        setting: which trace, and how.
        runs: its runs, of random times those of one repetition.
        engine: ``"batch"``, or ``"simpy"`` where the policy or the source of times knows no lanes,
            or there is a pipeline.
    """

    setting: Setting
    runs: Runs
    engine: str

    @property
    def repeats(self) -> bool:
        """Whether times are random, so that they may be drawn again and again."""
        return isinstance(self.runs.source, RandomSource)

    def __iter__(self) -> Iterator[Run]:
        return chain.from_iterable(self.batches())

    def batches(self) -> Iterator[RunBatch]:
        """All runs, repetition after repetition."""
        if self.repeats:
            return Repetitions(self.runs, self.setting.count, self.setting.first).batches()
        return self.runs.batches()


def replayed(setting: Setting, trace: Trace) -> Replayed:
    """Replay a setting: its sequences and repetitions at once, where that is possible.

    Args:
        setting: which trace, and how.
        trace: the setting's, as it was read.
    """
    name = setting.world.pre_forecaster
    searches = None if name is None else load_forecaster(name)
    runs = setting.world.replay(trace, pre_forecaster=searches)
    times = runs.source(next(iter(runs.times)))
    in_lanes = (
        batchable([times], runs.policy) and runs.arrivals != "recorded" and runs.pipeline is None
    )
    return Replayed(setting, runs, "batch" if in_lanes else "simpy")
