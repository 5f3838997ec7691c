"""The plan of a study: its traces as they are found, and the cells that it is made of."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from lae_sim.cells import Cell, Input, Setting, Task
from lae_sim.comparison import World, fitted
from lae_sim.costs import resolve_costs
from lae_sim.errors import LaeError
from lae_sim.examples import Trainer
from lae_sim.files import labels
from lae_sim.forecast import AnyFactory
from lae_sim.locate import digest, find_traces
from lae_sim.metadata import Metadata
from lae_sim.options import parse_latency, parse_policy
from lae_sim.study_file import RANDOM, Study
from lae_sim.trace import Trace, read_trace
from lae_sim.zoo import load_any

CHUNK_FRAMES = 2_000_000
"""World frames that a task replays, at most, where repetitions can be dealt out."""


@dataclass(frozen=True)
class Source:
    """A trace of a study.

    Attributes:
        input: the file.
        metadata: what it says of itself.
        frames: world frames of all its sequences.
    """

    input: Input
    metadata: Metadata
    frames: int


@dataclass(frozen=True)
class Plan:
    """What a study computes.

    Attributes:
        study: what was asked for.
        sources: its traces, and those of other devices' times.
        cells: in the order of the tables.
        factories: forecasters by name, trained where they must be.
        notes: what to say of the training.
    """

    study: Study
    sources: tuple[Source, ...]
    cells: tuple[Cell, ...]
    factories: Mapping[str, AnyFactory]
    notes: tuple[str, ...]

    def tasks(self, done: Callable[[Cell], bool]) -> list[Task]:
        """The cells that are not done, those of one setting together."""
        together: dict[Setting, list[Cell]] = {}
        for cell in self.cells:
            if not done(cell):
                together.setdefault(cell.setting, []).append(cell)
        return [
            Task(tuple(cells), {cell.forecaster: self.factories[cell.forecaster] for cell in cells})
            for cells in together.values()
        ]


def make_plan(
    study: Study,
    base: Path | None = None,
    progress: Callable[[str], object] = lambda what: None,
) -> Plan:
    """Find the traces, train what must be trained, and list the cells.

    Args:
        study: what is asked for.
        base: the folder that relative paths are from; the current one by default.
        progress: told what is done next.

    Raises:
        LaeError: if a trace is missing or damaged, or there is no such forecaster.
    """
    own, timed = find_traces(study.traces, base), find_traces(study.timing, base)
    paths = list(dict.fromkeys([*own, *timed]))
    sources = {}
    for path, label in zip(paths, labels(paths)):
        trace = read_trace(path)
        found = Input(path, label.removesuffix(".parquet"), digest(path))
        sources[path] = Source(found, trace.metadata, trace.frames or 0)
    traces, timing = [sources[path] for path in own], [sources[path] for path in timed]
    asked = {name: load_any(name) for name in dict.fromkeys(["hold", *study.forecasters])}
    factories, notes = _trained(study, traces, asked, progress)
    codes = {
        name: _code(name, factory, study, traces, isinstance(asked[name], Trainer))
        for name, factory in factories.items()
    }
    costs = resolve_costs(study.costs, factories, ())
    cells = [
        Cell(setting, name, codes[name], costs.get(name, 0), convention)
        for source in traces
        for setting in _settings(study, source, timing)
        for convention in study.conventions
        for name in factories
    ]
    return Plan(study, tuple(sources.values()), tuple(cells), factories, tuple(notes))


def _settings(study: Study, source: Source, timing: Sequence[Source]) -> list[Setting]:
    """All ways in which a trace is replayed."""
    theirs = [other.input for other in timing if _same_runs(source, other)]
    rates = dict.fromkeys(source.metadata.fps if fps is None else fps for fps in study.fps)
    found = []
    for times, policy, fps, latency, scale in product(
        [None, *theirs], study.policies, rates, study.latencies, study.scales
    ):
        repetitions = study.repetitions if latency in RANDOM else 1
        chunk = max(1, CHUNK_FRAMES // max(source.frames, 1))
        setting = Setting(
            trace=source.input,
            timing=times,
            policy=policy,
            fps=fps,
            latency=latency,
            scale=scale,
            first=0,
            count=1,
            seed=study.seed if latency in RANDOM else 0,
            block=study.block if latency == "bootstrap" else 0,
            sigmas=study.sigmas,
            sequences=tuple(sorted(study.sequences)),
        )
        found += [
            replace(setting, first=first, count=min(chunk, repetitions - first))
            for first in range(0, repetitions, chunk)
        ]
    return found


def _same_runs(source: Source, other: Source) -> bool:
    """Whether two traces are of one tracker on one dataset, on different devices."""
    ours, theirs = source.metadata, other.metadata
    same = (ours.tracker, ours.dataset) == (theirs.tracker, theirs.dataset)
    return same and source.input.path != other.input.path


def _trained(
    study: Study,
    traces: Sequence[Source],
    asked: Mapping[str, AnyFactory | Trainer],
    progress: Callable[[str], object],
) -> tuple[dict[str, AnyFactory], list[str]]:
    """Train across folds what must be trained, on replays with recorded or constant times."""
    wanted = study.sequences or None
    read: dict[str, Trace] = {s.input.label: read_trace(s.input.path, wanted) for s in traces}
    fixed = [name for name in study.latencies if name not in RANDOM] or ["recorded"]
    world = World(
        {name: parse_latency(name) for name in fixed},
        study.scales,
        study.fps[0],
        parse_policy(study.policies[0])[0],
    )
    return fitted(read, asked, world, study.folds, study.seed, progress)


def _code(
    name: str, factory: AnyFactory, study: Study, traces: Sequence[Source], trained: bool
) -> str:
    """What else a forecaster's figures depend on: its file, its code, or what it was trained on."""
    kind, _, value = name.partition(":")
    if kind == "learned" and value:
        return digest(value)
    if trained:
        document = study.document()
        told = [document[key] for key in ("latencies", "scales", "fps", "policies", "sequences")]
        found = [source.input.digest for source in traces]
        return hashlib.sha256(repr([told, found, study.folds, study.seed]).encode()).hexdigest()
    module = sys.modules.get(getattr(factory, "__module__", type(factory).__module__))
    if module is None or module.__name__.partition(".")[0] == "lae_sim":
        return ""  # the version of the package says it
    try:
        return digest(inspect.getsourcefile(module) or "")
    except (TypeError, OSError, LaeError):
        return ""
