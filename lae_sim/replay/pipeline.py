"""Pipelines in a replay: read from TOML, and fed with times of recordings.

A pipeline is a TOML file, or a table of a study::

    [camera]
    exposure = "4ms"
    delivery = "3ms"
    jitter = "uniform:0ms-8ms:1"

    [resources]
    gpu = 1

    [[stages]]
    name = "decode"
    time = "6ms"

    [[stages]]
    name = "tracker"
    resource = "gpu"

with the attributes of :class:`.Pipeline`, :class:`.Camera` and :class:`.Stage` as keys.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.decoding import read_toml
from lae_sim.engine.clock import Clock, exact, parse_duration, split_init, whole
from lae_sim.engine.pipeline import CAMERA, Camera, Pipeline, Stage, TimeSource
from lae_sim.engine.scheduler import Service
from lae_sim.errors import LaeError, explained, hint, listed, shown
from lae_sim.plugins import looking_in
from lae_sim.replay.latency import (
    Constant,
    Initialised,
    LatencySource,
    RandomSource,
    StageTimes,
    Uniform,
    by_call,
    by_frame,
    initialised,
    scaled,
    stream,
)
from lae_sim.replay.names import LATENCIES, Plugin, kind_of, named, parse_latency
from lae_sim.trace.recording import Recording

if TYPE_CHECKING:
    from lae_sim.engine.stages import PipelineSchedule

_RANGE = re.compile(r"([0-9.]+[a-z]+)-([0-9.]+[a-z]+):([0-9]+)\Z")
_TIMES = (*LATENCIES, "uniform")
_SHARE = re.compile(r"([0-9./]+):([0-9]+)\Z")


def read_pipeline(path: str | os.PathLike[str]) -> Pipeline:
    """Read a pipeline from a TOML file; modules of yours are found in its folder.

    Args:
        path: of the file.

    Raises:
        LaeError: if it cannot be read, is not TOML, or is no valid pipeline; it names the file, the
            stage and the key.

    Example:
        >>> from lae_sim.replay import read_pipeline
        >>> read_pipeline("traces/pipeline.toml")
        <Pipeline 'pipeline': camera > decode > tracker > publish>
    """
    if not isinstance(path, (str, os.PathLike)):
        raise LaeError(f"pipeline: it is read from a TOML file, not {shown(path)}")
    document = read_toml(path, "a pipeline")
    try:
        with looking_in(Path(path).parent):
            return parse_pipeline(document, Path(path).stem)
    except LaeError as error:
        raise LaeError(f"{path}: {error}") from error


def parse_pipeline(document: Mapping[str, Any], name: str = "pipeline") -> Pipeline:
    """A pipeline from plain values, as TOML or JSON has them.

    Args:
        document: with the keys ``stages``, and perhaps ``camera``, ``resources``, ``tracker`` and
            ``name``; a stage's ``queue`` may be ``"unbounded"``.
        name: of the pipeline, unless it has one of its own.

    Raises:
        LaeError: if a key is unknown, or a value impossible; it names the stage and the key.
    """
    values = dict(_checked("pipeline", document, Pipeline))
    stages = values.get("stages")
    if not isinstance(stages, (list, tuple)) or not stages:
        raise LaeError("stages: a pipeline has at least one: [[stages]], with its name")
    values |= {
        "name": values.get("name", name),
        "camera": Camera(**_checked("camera", values.get("camera", {}), Camera)),
        "stages": [_stage(place, each) for place, each in enumerate(stages, 1)],
    }
    pipeline = with_plugins(Pipeline(**values))
    PipelineTimes.of(pipeline)  # whose names are looked up
    return pipeline


def pipeline_document(pipeline: Pipeline) -> dict[str, Any]:
    """A pipeline as plain values, which :func:`parse_pipeline` makes the same pipeline of.

    Raises:
        LaeError: if a time is a function, which has no name; it says where.
    """
    camera = _values(pipeline.camera)
    if not isinstance(camera["drops"], str):
        camera["drops"] = list(camera["drops"])
    if camera["jitter"] is None:
        del camera["jitter"]
    return {
        "name": pipeline.name,
        "tracker": pipeline.tracker,
        "camera": {key: _plain("camera", key, value) for key, value in camera.items()},
        "resources": dict(pipeline.resources),
        "stages": [_plain_stage(stage) for stage in pipeline.stages],
    }


def _plain_stage(stage: Stage) -> dict[str, Any]:
    values = {**_values(stage), "queue": "unbounded" if stage.queue is None else stage.queue}
    where = f"stage {stage.name!r}"
    return {key: _plain(where, key, value) for key, value in values.items() if value is not None}


def _values(record: Camera | Stage) -> dict[str, Any]:
    return {each.name: getattr(record, each.name) for each in fields(record)}


def _plain(where: str, key: str, value: Any) -> Any:
    if isinstance(value, Plugin):
        return value.label
    if callable(value):
        raise LaeError(f"{where}: {key}: a function: name it, as 'package.module:object'")
    return value


def times_named(pipeline: Pipeline) -> list[str]:
    """The names of all times in a pipeline."""
    times = [pipeline.camera.jitter, *(stage.time for stage in pipeline.stages)]
    named = [time.label if isinstance(time, Plugin) else time for time in times]
    return [time for time in named if isinstance(time, str)]


def _checked(what: str, document: Any, kind: type) -> Mapping[str, Any]:
    """A table whose keys are those of a record.

    Raises:
        LaeError: if it is none, or has another key.
    """
    if not isinstance(document, Mapping):
        raise LaeError(f"{what}: a table of keys and values, not {shown(document)}")
    known = [each.name for each in fields(kind)]
    for key in document:
        if key not in known:
            near = hint(key, known) or f": there are {listed(known, 12)}"
            raise LaeError(f"{what}: unknown key {shown(key)}{near}")
    return document


def _stage(place: int, document: Any) -> Stage:
    given = document.get("name") if isinstance(document, Mapping) else None
    where = f"stage {given!r}" if isinstance(given, str) else f"stages: number {place}"
    values = dict(_checked(where, document, Stage))
    if "name" not in values:
        raise LaeError(f"{where}: name: it is missing")
    if values.get("queue") == "unbounded":
        values["queue"] = None
    return Stage(**values)


def parse_time(name: str) -> LatencySource:
    """A source of a stage's times by name: that of a latency, a duration, or a range.

    Args:
        name: as :func:`.names.parse_latency` takes it; or ``"6ms"``, for ``"constant:6ms"``; or
            ``"uniform:0ms-8ms:SEED"``, drawn evenly; all of them perhaps with ``,init=TIME``.

    Raises:
        LaeError: if it is none of these.
    """
    alone, init_ns = split_init(name)
    if init_ns is not None:
        return initialised(parse_time(alone), init_ns)
    kind, _, value = name.partition(":")
    if kind == "uniform":
        if (found := _RANGE.match(value)) is None:
            raise LaeError(f"{name!r}: write uniform:LOW-HIGH:SEED, such as uniform:0ms-8ms:1")
        seed = named("SEED", whole, found[3])
        return Uniform(parse_duration(found[1]), parse_duration(found[2]), seed)
    if name[:1].isdigit() and name[-1:] == "s":
        return Constant(parse_duration(name))
    try:
        return parse_latency(name)
    except LaeError as error:
        if kind in LATENCIES or ":" in name:
            raise
        raise LaeError(f"{error}; or a duration, 6ms, or uniform:LOW-HIGH:SEED") from error


def with_plugins(pipeline: Pipeline) -> Pipeline:
    """The pipeline with what its times name of a user's own, made once.

    Raises:
        LaeError: if there is none of a name; it names the stage and the key.
    """

    def made(what: str, time: TimeSource | None) -> TimeSource | None:
        own = isinstance(time, str) and ":" in time and kind_of(time) not in _TIMES
        return Plugin(str(time), named(what, parse_time, time)) if own else time

    camera, stages = pipeline.camera, pipeline.stages
    return replace(
        pipeline,
        camera=replace(camera, jitter=made("camera: jitter", camera.jitter)),
        stages=[replace(s, time=made(f"stage {s.name!r}: time", s.time)) for s in stages],
    )


def parse_drops(drops: Any) -> Callable[[Recording], frozenset[int]]:
    """Which frames a camera loses, as :class:`.Camera` names them.

    Raises:
        LaeError: if they are neither numbers nor such a name.
    """
    if not isinstance(drops, str):
        numbers = frozenset(named("drops", whole, each) for each in drops)
        return lambda recording: numbers
    kind, _, value = drops.partition(":")
    if kind == "every":
        return partial(_every, named("drops", partial(whole, least=2), value))
    if kind == "share" and (found := _SHARE.match(value)):
        share = named("drops", exact, found[1])
        if 0 <= share < 1:
            return partial(_share, share, named("drops: SEED", whole, found[2]))
    raise LaeError(
        f"drops: {shown(drops)}: write every:N, share:P:SEED with P from 0 to below 1, or a list "
        "of frames"
    )


def _every(n: int, recording: Recording) -> frozenset[int]:
    return frozenset(range(n - 1, len(recording), n))


def _share(share: Fraction, seed: int, recording: Recording) -> frozenset[int]:
    words = stream(seed, f"{recording.name}, stage {CAMERA}: drops", 0, len(recording))
    below = np.uint64(share * 2**64 // 1)
    return frozenset(np.flatnonzero(words < below).tolist())


@dataclass(frozen=True)
class PipelineTimes:
    """A pipeline with the sources of its times, found by their names.

    The streams of random sources differ from stage to stage, whatever their seeds.

    Attributes:
        pipeline: the stages.
        sources: by stage; that of the tracker only if it is not the world's latency.
        jitter: of the camera; None for none.
        lost: the frames of a recording that the camera loses.
        scale: exact factor on the times of the stages in ``sources``; not on the jitter.
    """

    pipeline: Pipeline
    sources: Mapping[str, LatencySource] = field(hash=False)
    jitter: LatencySource | None
    lost: Callable[[Recording], frozenset[int]]
    scale: Fraction = Fraction(1)

    @classmethod
    def of(cls, pipeline: Pipeline, scale: Fraction = Fraction(1)) -> PipelineTimes:
        """Those of a pipeline.

        Raises:
            LaeError: if there is no source of a name; it names the stage and the key.
        """
        found = {}
        for stage in pipeline.stages:
            if stage.time is None and stage.name == pipeline.tracker:
                continue
            time = f"stage:{stage.name}" if stage.time is None else stage.time
            found[stage.name] = _source(f"stage {stage.name!r}: time", time)
        camera, jitter = pipeline.camera, None
        if camera.jitter is not None:
            jitter = _source("camera: jitter", camera.jitter)
            if _draws_on_recorded(jitter):
                raise LaeError(
                    f"camera: jitter: {camera.jitter!r} are a tracker's times: write a duration, "
                    "or uniform:LOW-HIGH:SEED, such as uniform:0ms-8ms:1"
                )
        return cls(pipeline, found, jitter, named("camera", parse_drops, camera.drops), scale)

    def of_tracker(self, recording: Recording) -> Recording:
        """A recording whose times are those of the tracker alone.

        What it says of the pipeline's other stages is a part of the call's time, and would count
        twice: it is taken off.
        """
        apart = {stage for stage in self.sources if stage != self.pipeline.tracker}
        for stage in tuple(apart):
            apart.update(_recorded_stages(self.sources[stage]))
        elapsed = recording.elapsed_ns
        for stage in apart & recording.stages.keys():
            elapsed = elapsed - np.maximum(recording.stages[stage], 0)
        return replace(recording, elapsed_ns=elapsed)

    def schedule(
        self, recording: Recording, clock: Clock, tracker: Service, repetition: int = 0
    ) -> PipelineSchedule:
        """Run the pipeline on a sequence.

        Args:
            recording: what the times are drawn from.
            clock: of the sequence.
            tracker: the tracker's times.
            repetition: of random sources.

        Raises:
            LaeError: if the recording lacks a stage's times, or one is impossible.
        """
        from lae_sim.engine.stages import simulate_pipeline  # with SimPy, which few replays need

        services: dict[str, Service] = {self.pipeline.tracker: tracker}
        for stage in self.pipeline.stages:
            if stage.name != self.pipeline.tracker:
                services[stage.name] = self._service(stage.name, recording, repetition)
        jitter = None
        if self.jitter is not None:
            jitter = _repeated(self.jitter, repetition)(_named_after(CAMERA, recording))
        try:
            return simulate_pipeline(
                self.pipeline, len(recording), clock, services, jitter, self.lost(recording)
            )
        except LaeError as error:
            if str(error).startswith("sequence "):
                raise
            raise LaeError(f"sequence {recording.name!r}: {error}") from error

    def _service(self, stage: str, recording: Recording, repetition: int) -> Service:
        source = _repeated(self.sources[stage], repetition)
        drawn = _draws_on_recorded(source)
        for name in (stage,) if drawn else _recorded_stages(source):
            if name not in recording.stages:
                raise LaeError(
                    f"sequence {recording.name!r}: the trace has no times of stage {name!r}: give "
                    f"the pipeline's stage {stage!r} a time, such as '6ms'"
                )
        own = _named_after(stage, recording)
        with explained(f"stage {stage!r}: time"):
            if drawn:
                own = replace(own, elapsed_ns=StageTimes((stage,))(own).ns)
            return scaled(source, self.scale)(own)


def _source(what: str, source: TimeSource) -> LatencySource:
    if isinstance(source, Plugin):
        made: LatencySource = source.made
        return made
    if isinstance(source, str):
        return named(what, parse_time, source)
    if not callable(source):
        raise LaeError(f"{what}: {shown(source)} is no time, such as '6ms', and no function")
    return source


def _repeated(source: LatencySource, repetition: int) -> LatencySource:
    if isinstance(source, Initialised):
        return replace(source, source=_repeated(source.source, repetition))
    if isinstance(source, (RandomSource, Uniform)):
        return replace(source, repetition=source.repetition + repetition)
    return source


def _draws_on_recorded(source: LatencySource) -> bool:
    """Whether a source of the package's needs recorded times."""
    if isinstance(source, Initialised):
        return _draws_on_recorded(source.source)
    return source in (by_frame, by_call) or isinstance(source, RandomSource)


def _recorded_stages(source: LatencySource) -> tuple[str, ...]:
    """The recorded stages whose times a source takes."""
    if isinstance(source, Initialised):
        return _recorded_stages(source.source)
    return source.stages if isinstance(source, StageTimes) else ()


def _named_after(stage: str, recording: Recording) -> Recording:
    """A recording under a name of the stage's own, for messages, and for streams of its own."""
    return replace(recording, name=f"{recording.name}, stage {stage}")
