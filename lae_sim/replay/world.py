"""World: under what traces are replayed and scored, as names and plain values.

Command lines, study files and keyword arguments all make worlds, through the parsers here.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from typing import Any, TypeAlias, TypeVar

from lae_sim.engine import policies
from lae_sim.engine.clock import Clock, Number, exact, parse_fps
from lae_sim.engine.pipeline import Pipeline
from lae_sim.engine.scheduler import Policy, scores_latency
from lae_sim.errors import LaeError, shown
from lae_sim.files import sequence_names
from lae_sim.forecast.base import AnyFactory
from lae_sim.replay import latency as sources
from lae_sim.replay.latency import (
    Constant,
    Initialised,
    LatencySource,
    RandomSource,
    scaled,
)
from lae_sim.replay.names import (
    LATENCIES,
    POLICIES,
    Plugin,
    flag,
    kind_of,
    label_of,
    named,
    parse_latency,
    parse_policy,
    several,
    text,
)
from lae_sim.replay.passes import split_passes
from lae_sim.replay.pipeline import PipelineTimes, parse_time, read_pipeline, with_plugins
from lae_sim.replay.recorded import RECORDED_POLICY, is_log
from lae_sim.replay.run import Runs
from lae_sim.replay.search import find_search, parse_search
from lae_sim.trace.describe import AS_A_FRAME, ASSUMED
from lae_sim.trace.file import Trace, read_trace
from lae_sim.trace.metadata import Metadata

SIGMA_GRID = tuple(Fraction(m, 50) for m in range(51))
"""The permitted latencies that PVT++ averages over: 0, 0.02, ..., 1 frames.

Example:
    >>> import lae_sim
    >>> len(lae_sim.SIGMA_GRID), lae_sim.SIGMA_GRID[1]
    (51, Fraction(1, 50))
    >>> lae_sim.World.of(sigma="grid").sigmas == lae_sim.SIGMA_GRID
    True
"""

TraceLike: TypeAlias = "str | os.PathLike[str] | Trace"
"""An open trace, or the path or URL of one."""

Value = TypeVar("Value")

_TRACES_OWN = (RandomSource, sources.StageTimes)  # sources whose initialisations are the trace's
_TRACE = (str, os.PathLike, Trace)
_A_TRACE = "a path, a URL or what read_trace gives"


_PLUGIN: tuple[Any, ...] = (str, Plugin, Callable)


@dataclass(frozen=True)
class World:
    """Under what traces are replayed and scored.

    Attributes:
        fps: frames that the world shows per second; each trace's own if None.
        forget_arrivals: let frames arrive evenly also where a trace says when each of them arrived,
            which is needed for another rate.
        policy: which frame a free tracker takes: a policy, or a name of one (see
            :func:`.names.parse_policy`); None is each trace's own: ``"recorded"`` of a measured
            log, ``"latest"`` of any other.
        latency: where processing times come from: a source, or a name of one (see
            :func:`.names.parse_latency`).
        scale: exact factor on all times.
        timing: another device's trace of the same sequences, to take the times from.
        passes: traces of the same tracker at other strides, one of which each sequence's boxes
            come from (see :func:`lae_sim.replay.run.replay_sequence`), and gap passes.
        search: what is assumed of how far the tracker finds its target, by name (see
            :func:`lae_sim.replay.search.parse_search`).
        pre_forecaster: name of the forecaster that says where the tracker searches, in the search
            model; None where that is its last answer.
        keep_size: whether it says the centre only.
        sigmas: permitted latencies in frames, ascending.
        convention: how frames and thresholds count, by name.
        forecasters: names.
        costs: what forecasting costs, such as ``"2ms"`` or ``"kalman=2ms"``.
        pipeline: stages around the tracker, whose queues say which frames it takes, rather than a
            policy; the latency is the tracker's, unless that stage has times of its own.

    Raises:
        LaeError: if a value is impossible, or some do not go together.

    Example:
        >>> import lae_sim
        >>> world = lae_sim.World.of(fps="30000/1001", latency="constant:47ms", scale=1.5)
        >>> world.fps, world.scale, world.label()
        (Fraction(30000, 1001), Fraction(3, 2), 'constant:47ms x 3/2')
        >>> runs = world.replay("traces/synthetic-slow.parquet")
        >>> next(iter(runs)).schedule.frames[:4].tolist()
        [0, 2, 4, 6]
    """

    fps: Fraction | None = None
    policy: str | Policy | Plugin | None = None
    latency: str | LatencySource | Plugin = "recorded"
    scale: Fraction = Fraction(1)
    timing: TraceLike | None = None
    passes: tuple[TraceLike, ...] = ()
    search: str = "trace"
    pre_forecaster: str | None = None
    keep_size: bool = False
    sigmas: tuple[Fraction, ...] = (Fraction(0),)
    convention: str = "pysot"
    forecasters: tuple[str, ...] = ("hold",)
    costs: tuple[str, ...] = ()
    forget_arrivals: bool = False
    pipeline: Pipeline | None = None

    def __post_init__(self) -> None:
        for name in ("passes", "sigmas", "forecasters", "costs"):
            if not isinstance(getattr(self, name), tuple):
                raise LaeError(f"{name} of a World is a tuple; World.of takes one value too")
        _check_kinds(
            "policy",
            [] if self.policy is None else [self.policy],
            (str, Plugin, Callable),
            "a name, such as 'latest', or a function",
        )
        latency = "a name, such as 'recorded' or 'constant:47ms', or a function"
        _check_kinds("latency", [self.latency], _PLUGIN, latency)
        traces = [*self.passes] if self.timing is None else [self.timing, *self.passes]
        _check_kinds("timing and passes", traces, _TRACE, _A_TRACE)
        named("search", parse_search, named("search", text, self.search))
        named("keep_size", flag, self.keep_size)
        named("forget_arrivals", flag, self.forget_arrivals)
        if self.pre_forecaster is not None:
            named("pre_forecaster", text, self.pre_forecaster)
            if self.search == "off":
                raise LaeError(
                    "pre_forecaster: what it is worth is the search model's: do not turn it off"
                )
        if self.keep_size and self.pre_forecaster is None:
            raise LaeError("keep_size is a way to use a pre_forecaster")
        _check_kinds("convention", [self.convention], (str,), "a name, such as 'pysot'")
        _check_kinds("forecasters", self.forecasters, (str,), "a name, such as 'kalman'")
        _check_kinds("costs", self.costs, (str,), "text, such as '2ms' or 'kalman=2ms'")
        if self.fps is not None:
            Clock.at(self.fps)
            if self.fps <= 0:
                raise LaeError(f"fps: a frame rate must be above zero, not {self.fps}")
        numbers: tuple[object, ...] = (self.scale, *self.sigmas)
        if not all(isinstance(n, (Fraction, int)) and not isinstance(n, bool) for n in numbers):
            raise LaeError("scale and sigmas of a World are exact; World.of takes text too")
        if self.pipeline is not None:
            if not isinstance(self.pipeline, Pipeline):
                raise LaeError(
                    f"pipeline: a Pipeline, or the path of its file, not {shown(self.pipeline)}"
                )
            object.__setattr__(self, "pipeline", with_plugins(self.pipeline))
            object.__setattr__(self, "latency", self._tracker_latency(self.pipeline))
        scaled(self.source(), self.scale)
        check_sigmas(self.sigmas)
        if not scores_latency(self.rule()):
            for given, what in ((any(self.sigmas), "permitted latency"), (self.costs, "cost")):
                if given:
                    raise LaeError(
                        f"{label_of(self.policy)} never scores latency: it goes with no {what}"
                    )

    def _tracker_latency(self, pipeline: Pipeline) -> str | LatencySource | Plugin:
        """The world's latency, which is that of the pipeline's tracker if this has one."""
        if self.rule() is not policies.latest:
            raise LaeError(
                f"policy: {label_of(self.policy)} does not go with a pipeline, whose queues say "
                "which frames are taken"
            )
        PipelineTimes.of(pipeline)
        time = next(each.time for each in pipeline.stages if each.name == pipeline.tracker)
        if time is None:
            return self.latency
        own: str | LatencySource | Plugin = time
        if isinstance(time, str):
            source = parse_time(time)
            every = source.source if isinstance(source, Initialised) else source
            own = source if hasattr(every, "label") else time
        alike = isinstance(self.latency, str) and label_of(self.latency) == label_of(own)
        if not (alike or self.latency in ("recorded", own)):
            raise LaeError(
                f"latency: {label_of(self.latency)}, and the pipeline says {label_of(own)}: leave "
                f"out the time of its stage {pipeline.tracker!r}"
            )
        return own

    @classmethod
    def of(
        cls,
        *,
        fps: Number | None = None,
        policy: str | Policy | Plugin | None = None,
        latency: str | LatencySource | Plugin = "recorded",
        scale: Number = 1,
        timing: TraceLike | None = None,
        passes: TraceLike | Iterable[TraceLike] = (),
        search: str = "trace",
        pre_forecaster: str | None = None,
        keep_size: bool = False,
        sigma: Number | Iterable[Number] = 0,
        convention: str = "pysot",
        forecasters: str | Iterable[str] = ("hold",),
        costs: str | Iterable[str] = (),
        forget_arrivals: bool = False,
        pipeline: Pipeline | str | os.PathLike[str] | None = None,
    ) -> World:
        """A world from text and plain numbers, as command lines and files have them.

        One value will do where several are possible; ``sigma`` may be ``"grid"``. A float counts as
        it is written: 1.5 is 3/2, 0.1 is 1/10.

        Raises:
            LaeError: if a value is impossible; it names the argument.
        """
        return cls(
            fps=None if fps is None else named("fps", parse_fps, fps),
            policy=_made("policy", policy, parse_policy, POLICIES),
            latency=_made("latency", latency, parse_latency, LATENCIES),
            scale=named("scale", _factor, scale),
            timing=timing,
            passes=several(passes),
            search=search,
            pre_forecaster=pre_forecaster,
            keep_size=keep_size,
            sigmas=named("sigma", parse_sigmas, sigma),
            convention=convention,
            forecasters=tuple(dict.fromkeys(several(forecasters))),
            costs=several(costs),
            forget_arrivals=forget_arrivals,
            pipeline=_pipeline(pipeline),
        )

    @classmethod
    def sweep(
        cls,
        *,
        policy: Any = None,
        pipeline: Any = None,
        fps: Any = None,
        latency: Any = "recorded",
        scale: Any = 1,
        **others: Any,
    ) -> tuple[World, ...]:
        """The worlds of all combinations of some policies, pipelines, rates, latencies and scales.

        Each is one value or several; the last varies fastest. ``others`` are as in :meth:`of`. A
        plug-in that is named is made once, and shared by the worlds.

        Raises:
            LaeError: as :meth:`of`, or if there is nothing of one, or two have the same name.
        """
        rules = [_made("policy", each, parse_policy, POLICIES) for each in several(policy)]
        times = [_made("latency", each, parse_latency, LATENCIES) for each in several(latency)]
        rates = [named("fps", parse_fps, each) for each in several(fps)]
        factors = [named("scale", _factor, each) for each in several(scale)]
        swept: dict[str, list[Any]] = {
            "policy": [None] if policy is None else _distinct("policy", rules),
            "pipeline": [None] if pipeline is None else _pipelines(several(pipeline)),
            "fps": [None] if fps is None else list(dict.fromkeys(rates)),
            "latency": _distinct("latency", times),
            "scale": list(dict.fromkeys(factors)),
        }
        for name, values in swept.items():
            if not values:
                raise LaeError(f"{name}: name at least one")
        for name, value in others.items():
            if isinstance(value, Iterator):  # which gives its values once
                others[name] = tuple(value)
        combinations = product(*swept.values())
        return tuple(cls.of(**dict(zip(swept, values)), **others) for values in combinations)

    def settled(self, trace: TraceLike) -> World:
        """This world with the policy of a trace, which is that of its times, if none is named.

        Raises:
            LaeError: if a trace is missing or damaged.
        """
        if self.policy is not None:
            return self
        times = open_trace(trace if self.timing is None else self.timing)
        is_recorded = self.pipeline is None and is_log(times.metadata)
        return replace(self, policy=RECORDED_POLICY if is_recorded else "latest")

    def rule(self) -> Policy:
        """The policy itself; ``latest`` if none is named."""
        if self.policy is None:
            return policies.latest
        if isinstance(self.policy, Plugin):
            return self.policy.made  # type: ignore[no-any-return]
        return parse_policy(self.policy) if isinstance(self.policy, str) else self.policy

    def source(self) -> LatencySource:
        """The source of the processing times, before they are scaled."""
        if isinstance(self.latency, Plugin):
            return self.latency.made  # type: ignore[no-any-return]
        return parse_latency(self.latency) if isinstance(self.latency, str) else self.latency

    @property
    def policy_label(self) -> str:
        """What says which frames are taken: the policy, or ``"pipeline:NAME"``."""
        if self.pipeline is not None:
            return f"pipeline:{self.pipeline.name}"
        return "latest" if self.policy is None else label_of(self.policy)

    def label(self) -> str:
        """The latency and its scale, such as ``"recorded x 2"``."""
        name = label_of(self.latency)
        return name if self.scale == 1 else f"{name} x {self.scale}"

    @property
    def times_kind(self) -> str:
        """What kind of times these are, such as ``"recorded"`` or ``"constant"``."""
        return kind_of(label_of(self.latency))

    def init_source(self, times: Metadata) -> str:
        """How one knows what initialisations cost (see :class:`.describe.InitCost`).

        Args:
            times: of the trace that the times are taken from.
        """
        source = self.source()
        if isinstance(source, (Initialised, RandomSource)) and source.init_ns is not None:
            found = f"{ASSUMED}{source.init_ns / 1e6:g} ms"
        elif isinstance(source, Constant):
            found = AS_A_FRAME
        elif isinstance(source, _TRACES_OWN) or source in (sources.by_frame, sources.by_call):
            found = times.init_source
        else:
            found = f"given by {label_of(self.latency)}"
        return found if self.scale == 1 else f"{found} x {self.scale}"

    def replay(
        self,
        trace: TraceLike,
        sequences: str | Iterable[str] | None = None,
        pre_forecaster: AnyFactory | None = None,
    ) -> Runs:
        """Replay a trace in this world.

        Args:
            trace: the boxes and the truth.
            sequences: those wanted; all by default.
            pre_forecaster: what the world's name of one stands for (see
                :func:`lae_sim.learning.registry.load_forecaster`).

        Raises:
            LaeError: if a trace is missing or damaged, the passes do not go together, or what the
                name of a pre-forecaster stands for is not given.
        """
        if self.pre_forecaster is not None and pre_forecaster is None:
            raise LaeError(
                f"pre_forecaster: give what {self.pre_forecaster!r} stands for, such as "
                f"load_forecaster({self.pre_forecaster!r})"
            )
        names = None if sequences is None else sequence_names(sequences)
        opened = open_trace(trace, names)
        strided, gaps = split_passes(map(open_trace, self.passes))
        return Runs(
            opened,
            Clock.at(opened.metadata.fps if self.fps is None else self.fps),
            scaled(self.source(), self.scale),
            self.settled(opened).rule(),
            None if self.timing is None else open_trace(self.timing),
            (*(each if names is None else each.chosen(names) for each in strided), *gaps),
            find_search(self.search, opened.metadata, gaps, pre_forecaster, self.keep_size),
            self.forget_arrivals,
            None if self.pipeline is None else PipelineTimes.of(self.pipeline, self.scale),
        )


def replay_trace(
    trace: TraceLike,
    *,
    fps: Number | None = None,
    policy: str | Policy | None = None,
    latency: str | LatencySource = "recorded",
    scale: Number = 1,
    timing: TraceLike | None = None,
    passes: TraceLike | Iterable[TraceLike] = (),
    search: str = "trace",
    forget_arrivals: bool = False,
    pipeline: Pipeline | str | os.PathLike[str] | None = None,
) -> Runs:
    """Replay every sequence of a trace, one after another.

    Args:
        trace: the boxes and the truth: an open trace, or the path or URL of one.
        fps, policy, latency, scale, timing, passes, search, forget_arrivals, pipeline: see
            :meth:`World.of`; a pipeline may be the path of its file.

    Returns:
        The runs, which are made while one goes through them, and may be gone through again.

    Raises:
        LaeError: if an argument is impossible or a file missing; while the runs are made, if a
            sequence or frame that is asked for is not there.

    Example:
        >>> import lae_sim
        >>> runs = lae_sim.replay_trace("traces/synthetic-slow.parquet", latency="constant:47ms")
        >>> [len(run) for run in runs][:3]
        [300, 300, 300]
    """
    opened = named("trace", open_trace, trace)
    world = World.of(
        fps=fps,
        policy=policy,
        latency=latency,
        scale=scale,
        search=search,
        forget_arrivals=forget_arrivals,
        pipeline=pipeline,
        **open_others(timing, passes),
    )
    return world.replay(opened)


def open_trace(trace: TraceLike, sequences: Iterable[str] | None = None) -> Trace:
    """The trace, opened if it is not yet; with some of its sequences only, if they are named.

    Raises:
        LaeError: if it is neither a trace nor a path, cannot be opened, or lacks a sequence.
    """
    if isinstance(trace, Trace):
        return trace if sequences is None else trace.chosen(sequences)
    if not isinstance(trace, (str, os.PathLike)):
        raise LaeError(f"a trace is {_A_TRACE}, not {shown(trace)}")
    return read_trace(trace, sequences)


def open_others(
    timing: TraceLike | None, passes: TraceLike | Iterable[TraceLike]
) -> dict[str, Any]:
    """The traces of times and passes, opened, as arguments of :meth:`World.of`.

    Raises:
        LaeError: as :func:`open_trace`; it names the argument.
    """
    return {
        "timing": None if timing is None else named("timing", open_trace, timing),
        "passes": tuple(named("passes", open_trace, each) for each in several(passes)),
    }


def parse_sigmas(value: Number | Iterable[Number]) -> tuple[Fraction, ...]:
    """Permitted latencies in ascending order: one, several, or ``"grid"``.

    Raises:
        LaeError: if one is not an exact number.
    """
    if isinstance(value, str) and value == "grid":
        return SIGMA_GRID
    return tuple(sorted({exact(each) for each in several(value)}))


def check_sigmas(sigmas: tuple[Fraction, ...]) -> None:
    """Check permitted latencies.

    Raises:
        LaeError: if they are not ascending, each of them once.
    """
    if not sigmas:
        raise LaeError("sigma: name at least one permitted latency, such as 0 or 'grid'")
    if list(sigmas) != sorted(set(sigmas)):
        raise LaeError("sigma: permitted latencies must be ascending, each of them once")


def _made(name: str, given: Any, parse: Callable[[str], object], known: Iterable[str]) -> Any:
    """A policy or a source of times: a name of ours that has been looked up, or what it is."""
    if not isinstance(given, str):
        return given
    made = named(name, parse, given)
    return given if kind_of(given) in known else Plugin(given, made)


def _pipeline(given: Any) -> Pipeline | None:
    """A pipeline, read if it is the path of a file, whose plug-ins are made."""
    if isinstance(given, (str, os.PathLike)):
        return named("pipeline", read_pipeline, given)
    made: Pipeline | None = with_plugins(given) if isinstance(given, Pipeline) else given
    return made


def _pipelines(given: Iterable[Any]) -> list[Pipeline | None]:
    """Pipelines, each once, no two of the same name."""
    found: dict[str, Pipeline | None] = {}
    for each in map(_pipeline, given):
        name = getattr(each, "name", "")
        if found.setdefault(name, each) != each:
            raise LaeError(f"pipeline: two are called {name!r}: give them names of their own")
    return list(found.values())


def _distinct(name: str, plugins: Iterable[Any]) -> list[Any]:
    """Policies or sources, each once; no two under the same name."""
    found: dict[str, Any] = {}
    for each in plugins:
        label = label_of(each)
        known = isinstance(each, str) or hasattr(each, "label")  # which says all of it
        if label in found and not (known or each == found[label]):
            raise LaeError(f"{name}: two are called {label!r}: give functions names")
        found.setdefault(label, each)
    return list(found.values())


def _factor(value: Number) -> Fraction:
    factor = exact(value)
    if factor < 0:
        raise LaeError(f"times cannot be scaled by {factor}, below zero")
    return factor


def _check_kinds(name: str, values: Iterable[object], kinds: tuple[Any, ...], what: str) -> None:
    for value in values:
        if not isinstance(value, kinds):
            raise LaeError(f"{name}: {shown(value)} is not {what}")


RECORDED = World()
"""Every trace as it was recorded, without a permitted latency."""
