"""Pipelines: the stages that a frame passes from the camera to the command, as data.

A camera delivers frames to the first stages, each stage hands them on to those that come after it,
and one of them is the tracker. :func:`.stages.simulate_pipeline` runs what is described here.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any, TypeAlias

from lae_sim.engine.clock import parse_duration
from lae_sim.errors import LaeError, hint, listed, shown

TimeSource: TypeAlias = "str | Callable[[Any], Any]"
"""Where times come from: a name, or a function of a recording (:mod:`lae_sim.replay.pipeline`)."""

CAMERA = "camera"
"""What the first stages come after."""

WHEN_FULL = ("drop-oldest", "drop-newest", "block")
"""What a stage may do where a frame comes and its queue is full."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}\Z")


@dataclass(frozen=True)
class Camera:
    """When frames reach the first stages, and which never do.

    World frames are captured when they arrive in a world without pipeline: evenly, or when a trace
    says that they did. A frame is delivered ``exposure + delivery + jitter`` later, but not before
    the one ahead of it: a link keeps the order. The frame of the initialisation is never lost.

    Attributes:
        exposure: from the instant that a frame shows until its exposure ends, such as ``"4ms"``.
        delivery: from then until it reaches the first stages, at least.
        jitter: where what the delivery takes longer comes from, if it does, such as
            ``"uniform:0ms-8ms:1"``; random ones name their seed.
        drops: frames that are lost: ``"every:10"`` (frames 9, 19, ...), ``"share:0.05:1"`` (each
            with that probability, by a seed), or their numbers.

    Raises:
        LaeError: if a duration is none, or the drops are neither text nor a list.

    Example:
        >>> import lae_sim
        >>> camera = lae_sim.Camera("4ms", "3ms", jitter="uniform:0ms-8ms:1", drops="every:30")
        >>> late = lae_sim.Pipeline([lae_sim.Stage("tracker")], camera=camera)
        >>> lae_sim.evaluate("traces/synthetic-fast.parquet", pipeline=late)
        <EvaluationResult of synthetic-fast.parquet, recorded: AUC hold 0.5812, kalman 0.5743>
    """

    exposure: str = "0ms"
    delivery: str = "0ms"
    jitter: TimeSource | None = None
    drops: str | Sequence[int] = ()

    def __post_init__(self) -> None:
        for key in ("exposure", "delivery"):
            _named(f"camera: {key}", parse_duration, getattr(self, key))
        if not isinstance(self.drops, str):
            if not isinstance(self.drops, Sequence):
                raise LaeError(
                    f"camera: drops: 'every:10', 'share:0.05:1' or a list of frames, not "
                    f"{shown(self.drops)}"
                )
            object.__setattr__(self, "drops", tuple(self.drops))

    @property
    def delay_ns(self) -> int:
        """The least that a frame takes from its capture to the first stages, ns."""
        return parse_duration(self.exposure) + parse_duration(self.delivery)


@dataclass(frozen=True)
class Stage:
    """What frames wait for in a queue, and one or several workers do with them.

    Attributes:
        name: of small letters, digits and ``_``.
        time: where its times come from: a duration such as ``"6ms"``, the name of a latency such as
            ``"lognormal:1"``, or a function of the recording. By default the tracker has the
            world's latency (of recorded times, what is left to it beside the pipeline's other
            stages), and another stage the times that the trace has recorded for it.
        workers: frames that it works on at once.
        queue: frames that may wait, besides those being worked on; None for any number.
        when_full: what is done with a frame that comes when so many wait: ``"drop-oldest"`` and
            ``"drop-newest"`` drop a frame, the newcomer among them; under ``"block"`` the worker
            that brings it waits.
        resource: what a worker needs besides, by its name in the pipeline; it waits for it with
            the frame in its hands.
        priority: how urgently it does: the lower, the sooner it gets it.
        after: the stage that its frames come from, or ``"camera"``; by default the one before it in
            the pipeline.
        every: it takes every n-th frame only, by the frames' numbers.

    Raises:
        LaeError: if a value is impossible; it names the stage and the key.

    Example:
        >>> import lae_sim
        >>> lae_sim.Stage("decode", "6ms", workers=2, when_full="drop-newest").queue
        1
        >>> try:
        ...     lae_sim.Stage("decode", queue=0)
        ... except lae_sim.LaeError as error:
        ...     print(error)
        stage 'decode': queue: 0 is not a whole number from 1, or None for any number of frames
    """

    name: str
    time: TimeSource | None = None
    workers: int = 1
    queue: int | None = 1
    when_full: str = "drop-oldest"
    resource: str | None = None
    priority: int = 0
    after: str | None = None
    every: int = 1

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not _NAME.match(self.name) or self.name == CAMERA:
            raise LaeError(
                f"name: {shown(self.name)} is no name of a stage: small letters, digits and _, a "
                "letter first; not 'camera'"
            )
        where = f"stage {self.name!r}"
        for key, least in (("workers", 1), ("every", 1), ("queue", 1), ("priority", None)):
            value = getattr(self, key)
            if key == "queue" and value is None:
                continue
            counted = isinstance(value, Integral) and not isinstance(value, bool)
            if not counted or (least is not None and value < least):
                least_one = "a whole number" if least is None else f"a whole number from {least}"
                more = ", or None for any number of frames" if key == "queue" else ""
                raise LaeError(f"{where}: {key}: {shown(value)} is not {least_one}{more}")
        for key in ("resource", "after"):
            value = getattr(self, key)
            if value is not None and (not isinstance(value, str) or not value):
                raise LaeError(f"{where}: {key}: a name, not {shown(value)}")
        if self.when_full not in WHEN_FULL:
            raise LaeError(
                f"{where}: when_full: no {shown(self.when_full)}: there are "
                f"{listed(WHEN_FULL)}{hint(self.when_full, WHEN_FULL)}"
            )


@dataclass(frozen=True)
class Pipeline:
    """Stages from a camera to the command, one of which is the tracker.

    Frames branch where several stages come after one. What the tracker answers goes on, without
    branching, to those after it, such as a forecaster and a message to the controller: an answer
    counts once the last of them is done with it.

    Attributes:
        stages: in any order, if they say what they come after.
        camera: what delivers the frames.
        resources: how many workers may hold each resource at once, by its name.
        tracker: the name of the stage that is the tracker.
        name: of the pipeline, in tables.

    Raises:
        LaeError: if the stages do not go together; it names the stage and the key.

    Example:
        >>> import lae_sim
        >>> stages = [lae_sim.Stage("decode", "6ms"), lae_sim.Stage("tracker", queue=2)]
        >>> drone = lae_sim.Pipeline(stages, camera=lae_sim.Camera(delivery="8ms"), name="drone")
        >>> drone
        <Pipeline 'drone': camera > decode > tracker>
        >>> lae_sim.evaluate("traces/synthetic-slow.parquet", pipeline=drone, scale=1.5)
        <EvaluationResult of synthetic-slow.parquet, recorded x 3/2: AUC hold ...>
    """

    stages: Sequence[Stage]
    camera: Camera = field(default_factory=Camera)
    resources: Mapping[str, int] = field(default_factory=dict, hash=False)
    tracker: str = "tracker"
    name: str = "pipeline"

    def __post_init__(self) -> None:
        stages = tuple(self.stages) if isinstance(self.stages, Iterable) else (self.stages,)
        if not all(isinstance(stage, Stage) for stage in stages):
            raise LaeError("stages: a pipeline has stages, such as Stage('decode', '6ms')")
        if not isinstance(self.camera, Camera):
            raise LaeError(f"camera: such as Camera(delivery='8ms'), not {shown(self.camera)}")
        object.__setattr__(self, "stages", _in_order(stages))
        if not isinstance(self.name, str) or not self.name or not self.name.isprintable():
            raise LaeError(f"name: {shown(self.name)} is no name of a pipeline: text in one line")
        names = [stage.name for stage in self.stages]
        if self.tracker not in names:
            raise LaeError(
                f"no stage is called {shown(self.tracker)}: there are {listed(names) or 'none'}; "
                "the key tracker says which of them is the tracker"
            )
        if not isinstance(self.resources, Mapping):
            raise LaeError(f"resources: whole numbers by name, not {shown(self.resources)}")
        object.__setattr__(self, "resources", dict(self.resources))
        for name, capacity in self.resources.items():
            counted = isinstance(capacity, Integral) and not isinstance(capacity, bool)
            if not counted or capacity < 1:
                raise LaeError(f"resources: {name}: {shown(capacity)} is not a whole number from 1")
        for stage in self.stages:
            where = f"stage {stage.name!r}"
            if stage.resource is not None and stage.resource not in self.resources:
                known = listed(self.resources) or "none"
                raise LaeError(
                    f"{where}: resource: no {shown(stage.resource)} among the pipeline's "
                    f"resources: {known}{hint(stage.resource, self.resources)}"
                )
            if stage.after == CAMERA and stage.when_full == "block":
                raise LaeError(
                    f"{where}: when_full: a camera does not wait, so that nothing can block it: "
                    "drop-oldest or drop-newest"
                )
        branches = [self.after(name) for name in (self.tracker, *self.below)]
        if several := next((each for each in branches if len(each) > 1), None):
            raise LaeError(
                f"stage {several[1].name!r}: after: what comes after the tracker does not branch, "
                f"and {several[0].name!r} comes after {several[0].after!r} already"
            )

    def after(self, name: str) -> tuple[Stage, ...]:
        """The stages that come after one, or after the camera."""
        return tuple(stage for stage in self.stages if stage.after == name)

    @property
    def below(self) -> tuple[str, ...]:
        """Names of the stages after the tracker, in their order."""
        found: list[str] = []
        last = self.tracker
        for stage in self.stages:
            if stage.after == last or stage.after in found:
                found.append(stage.name)
        return tuple(found)

    @property
    def output(self) -> str:
        """The stage whose results are the pipeline's answers: the last after the tracker."""
        return self.below[-1] if self.below else self.tracker

    @property
    def way(self) -> tuple[Stage, ...]:
        """The stages that an answer has passed, from the camera to the output."""
        by_name = {stage.name: stage for stage in self.stages}
        found, last = [], self.output
        while last != CAMERA:
            found.append(by_name[last])
            last = by_name[last].after or CAMERA
        return tuple(reversed(found))

    def __repr__(self) -> str:
        return f"<Pipeline {self.name!r}: {' > '.join([CAMERA, *(s.name for s in self.stages)])}>"


def _in_order(stages: Iterable[Stage]) -> tuple[Stage, ...]:
    """Stages with what each comes after, those that a frame passes first before the others.

    Raises:
        LaeError: if two have the same name, or one comes after no stage, or after itself.
    """
    before = CAMERA
    rest: dict[str, Stage] = {}
    for stage in stages:
        if stage.name in rest:
            raise LaeError(f"stage {stage.name!r}: name: two stages have it; one is the tracker")
        rest[stage.name] = stage if stage.after is not None else replace(stage, after=before)
        before = stage.name
    for stage in rest.values():
        if stage.after != CAMERA and stage.after not in rest:
            raise LaeError(
                f"stage {stage.name!r}: after: no stage {shown(stage.after)}"
                f"{hint(stage.after, [CAMERA, *rest])}"
            )
    ordered: dict[str, Stage] = {}
    while rest:
        ready = [stage for stage in rest.values() if stage.after in (CAMERA, *ordered)]
        if not ready:
            raise LaeError(
                f"stage {next(iter(rest))!r}: after: a loop: none of {listed(rest)} comes after "
                "the camera, or after what does"
            )
        ordered[ready[0].name] = rest.pop(ready[0].name)
    return tuple(ordered.values())


def _named(name: str, parse: Callable[[str], object], value: str) -> None:
    try:
        parse(value)
    except LaeError as error:
        raise LaeError(f"{name}: {error}") from error
