"""The plan of a study: its traces as they are found, and the cells that it is made of."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from lae_sim.comparison.forecasters import fitted
from lae_sim.engine.pipeline import Pipeline
from lae_sim.errors import LaeError
from lae_sim.files import labels, text_digest
from lae_sim.forecast.base import AnyFactory, Hold
from lae_sim.forecast.costs import resolve_costs
from lae_sim.learning.folds import Trainer
from lae_sim.learning.registry import base_name, files_named, load_any, load_forecaster
from lae_sim.replay.names import named
from lae_sim.replay.passes import passes_for
from lae_sim.replay.pipeline import times_named
from lae_sim.replay.run import check_rate
from lae_sim.replay.world import World
from lae_sim.study.cells import Cell, Input, Setting, Task
from lae_sim.study.spec import Study, is_random
from lae_sim.trace.file import read_trace
from lae_sim.trace.locate import digest, find_traces, stamp
from lae_sim.trace.metadata import Metadata

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
        sources: its traces, those of other devices' times, and passes.
        cells: in the order of the tables.
        forecasters: factories by name, and trainers of those that must be trained.
        training: digest of all that the training depends on.
    """

    study: Study
    sources: tuple[Source, ...]
    cells: tuple[Cell, ...]
    forecasters: Mapping[str, AnyFactory | Trainer]
    training: str

    @property
    def trainers(self) -> list[str]:
        """Names of the forecasters that must be trained."""
        return [name for name, each in self.forecasters.items() if isinstance(each, Trainer)]

    def trained(
        self, progress: Callable[[str], object] = lambda what: None
    ) -> tuple[dict[str, AnyFactory], list[str]]:
        """Train, across folds, on replays with the recorded and constant times of the study.

        Returns:
            A factory for each forecaster, and what to say of the training.
        """
        study, wanted = self.study, self.study.sequences or None
        own = {cell.setting.trace: None for cell in self.cells}
        read = {each.label: read_trace(each.path, wanted) for each in own}
        fixed = [name for name in study.times if not is_random(name)] or ["recorded"]
        worlds = World.sweep(
            policy=study.policies[0] if study.policies else "latest",
            fps=study.fps[0],
            latency=fixed,
            scale=study.scales,
            search="off",
            forget_arrivals=study.forget_arrivals,
        )
        return fitted(read, self.forecasters, worlds, study.folds, study.seed, progress)


def make_plan(study: Study, base: Path | None = None) -> Plan:
    """Find the traces, and list the cells.

    Args:
        study: what is asked for.
        base: the folder that relative paths are from; the current one by default.

    Raises:
        LaeError: if a trace is missing or damaged, or there is no such forecaster.
    """
    own, timed, passed = (
        find_traces(each, base) for each in (study.traces, study.timing, study.passes)
    )
    paths = list(dict.fromkeys([*own, *timed, *passed]))
    sources = {}
    for path, label in zip(paths, labels([path.removesuffix(".parquet") for path in paths])):
        trace = read_trace(path)
        for fps in study.fps if path in own and not study.forget_arrivals else ():
            try:
                check_rate(trace, trace.metadata.fps if fps is None else fps)
            except LaeError as error:
                raise LaeError(f"fps: {path}: {error}") from error
        found = Input(path, label, digest(path), stamp(path))
        sources[path] = Source(found, trace.metadata, trace.frames or 0)
    traces, timing = [sources[path] for path in own], [sources[path] for path in timed]
    for other in timing:
        if not any(_same_runs(source, other) for source in traces):
            metadata = other.metadata
            raise LaeError(
                f"timing: {other.input.path} is of {metadata.tracker} on {metadata.dataset}: none "
                "of the traces is of the same tracker and dataset on another device"
            )
    passes = passes_for(traces, [sources[path] for path in passed])
    names = dict.fromkeys(["hold", *study.forecasters])
    forecasters = {name: load_any(name) for name in names}
    training = _training(study, traces)
    codes = {name: _code(name, each, training) for name, each in forecasters.items()}
    for name in filter(None, study.pre_forecaster):
        named("pre_forecaster", load_forecaster, name)
    costs = resolve_costs(study.costs, dict.fromkeys(names, Hold), ())  # none is measured
    cells = [
        Cell(setting, name, codes[name], costs.get(name, 0), convention)
        for source, own_passes in zip(traces, passes)
        for setting in _settings(study, source, timing, own_passes)
        for convention in study.conventions
        for name in forecasters
    ]
    return Plan(study, tuple(sources.values()), tuple(cells), forecasters, training)


def tasks(cells: Iterable[Cell], factories: Mapping[str, AnyFactory]) -> list[Task]:
    """The cells of each setting together."""
    together: dict[Setting, list[Cell]] = {}
    for cell in cells:
        together.setdefault(cell.setting, []).append(cell)
    return [
        Task(tuple(some), {cell.forecaster: factories[cell.forecaster] for cell in some})
        for some in together.values()
    ]


def _settings(
    study: Study, source: Source, timing: Sequence[Source], passes: Sequence[Source]
) -> list[Setting]:
    """All ways in which a trace is replayed."""
    other_times = [other.input for other in timing if _same_runs(source, other)]
    codes = {name: _own_code(name) for name in study.times}
    rules: list[tuple[str, Pipeline | None]] = [(policy, None) for policy in study.policies]
    rules += [("latest", pipeline) for pipeline in study.pipelines]
    searching = {name: "" if name is None else _file_code(name) for name in study.pre_forecaster}
    rates = dict.fromkeys(source.metadata.fps if fps is None else fps for fps in study.fps)
    found = []
    chunk = max(1, CHUNK_FRAMES // (max(source.frames, 1) * max(1, len(study.sigmas) // 8)))
    for times, (policy, pipeline), fps, latency, scale, search, pre_forecaster in product(
        [None, *other_times],
        rules,
        rates,
        study.times,
        study.scales,
        study.search,
        study.pre_forecaster,
    ):
        world = World(
            fps=fps,
            policy=policy,
            latency=study.seeded(latency),
            scale=scale,
            timing=None if times is None else times.path,
            passes=tuple(each.input.path for each in passes),
            search=search,
            pre_forecaster=pre_forecaster,
            keep_size=study.keep_size and pre_forecaster is not None,
            sigmas=study.sigmas,
            forget_arrivals=study.forget_arrivals,
            pipeline=pipeline,
        )
        own = [policy] if pipeline is None else times_named(pipeline)
        setting = Setting(
            trace=source.input,
            timing=times,
            passes=tuple(each.input for each in passes),
            world=world,
            code="".join(map(_own_code, own)) + codes[latency] + searching[pre_forecaster],
            first=0,
            count=1,
            sequences=tuple(sorted(study.sequences)),
        )
        repetitions = study.repetitions if is_random(latency) else 1
        found += [
            replace(setting, first=first, count=min(chunk, repetitions - first))
            for first in range(0, repetitions, chunk)
        ]
    return found


def _same_runs(source: Source, other: Source) -> bool:
    """Whether two traces are of one tracker on one dataset, on different devices."""
    return source.metadata.goes_with(other.metadata) and source.input.path != other.input.path


def _training(study: Study, traces: Sequence[Source]) -> str:
    """Digest of what trained forecasters depend on."""
    document = {**study.document(), "latencies": list(study.times)}
    keys = ("latencies", "scales", "fps", "forget_arrivals", "policies",
            "sequences", "folds", "seed")  # fmt: skip
    values = [*(document[key] for key in keys), *(source.input.digest for source in traces)]
    return text_digest(repr(values))


def _code(name: str, forecaster: AnyFactory | Trainer, training: str) -> str:
    """What else a forecaster's figures depend on: its file, its code, its training."""
    return (training if isinstance(forecaster, Trainer) else "") + _file_code(name)


def _file_code(name: str) -> str:
    """Digest of the file that a forecaster's name names, of weights or of code; or empty."""
    name = base_name(name)
    if name.partition(":")[0] == "learned":
        return digest(*files_named(name))
    return _own_code(name)


def _own_code(name: str) -> str:
    """Digest of the file of a plug-in ``package.module:object``; empty of what is not one.

    It must have been imported. (Of the package itself, the version says what is needed.)
    """
    module = sys.modules.get(name.partition(":")[0])
    path = getattr(module, "__file__", None)
    return digest(path) if path else ""
