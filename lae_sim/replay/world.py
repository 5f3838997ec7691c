"""World: under what traces are replayed and scored, as names and plain values.

Command lines, study files and keyword arguments all make worlds, through the parsers here.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import product
from typing import Any, TypeAlias, TypeVar

from lae_sim.engine import policies
from lae_sim.engine.clock import Clock, Number, exact, parse_fps, split_init, whole
from lae_sim.engine.scheduler import Policy, scores_latency
from lae_sim.errors import LaeError, hint, shown
from lae_sim.files import sequence_names
from lae_sim.forecast.base import AnyFactory
from lae_sim.plugins import bound, imported, with_options
from lae_sim.replay import latency as sources
from lae_sim.replay.latency import (
    Constant,
    Initialised,
    LatencySource,
    RandomSource,
    initialised,
    scaled,
    time_label,
)
from lae_sim.replay.passes import split_passes
from lae_sim.replay.recorded import RECORDED_POLICY, AsRecorded
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

_POLICIES = ("latest", "fifo", "every", "shrinking-tail", "vot-realtime", "recorded")
_LATENCIES = ("recorded", "by-call", "stage", "constant", "resample", "lognormal", "bootstrap")

_TRACES_OWN = (RandomSource, sources.StageTimes)  # sources whose initialisations are the trace's
_TRACE = (str, os.PathLike, Trace)
_A_TRACE = "a path, a URL or what read_trace gives"


@dataclass(frozen=True)
class Plugin:
    """A user's own policy or source of times, made once, under the name that asks for it.

    Attributes:
        label: ``package.module:object``.
        made: what that is, or an instance of it if it is a class.
    """

    label: str
    made: Any = field(compare=False)


_PLUGIN: tuple[Any, ...] = (str, Plugin, Callable)


@dataclass(frozen=True)
class World:
    """Under what traces are replayed and scored.

    Attributes:
        fps: frames that the world shows per second; each trace's own if None.
        forget_arrivals: let frames arrive evenly also where a trace says when each of them arrived,
            which is needed for another rate.
        policy: which frame a free tracker takes: a name (see :func:`parse_policy`), or a policy.
        latency: where processing times come from: a name (see :func:`parse_latency`), or a source.
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
    policy: str | Policy | Plugin = "latest"
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

    def __post_init__(self) -> None:
        for name in ("passes", "sigmas", "forecasters", "costs"):
            if not isinstance(getattr(self, name), tuple):
                raise LaeError(f"{name} of a World is a tuple; World.of takes one value too")
        _check_kinds(
            "policy",
            [self.policy],
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
        scaled(self.source(), self.scale)
        check_sigmas(self.sigmas)
        if not scores_latency(self.rule()):
            for given, what in ((any(self.sigmas), "permitted latency"), (self.costs, "cost")):
                if given:
                    raise LaeError(
                        f"{label_of(self.policy)} never scores latency: it goes with no {what}"
                    )

    @classmethod
    def of(
        cls,
        *,
        fps: Number | None = None,
        policy: str | Policy | Plugin = "latest",
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
    ) -> World:
        """A world from text and plain numbers, as command lines and files have them.

        One value will do where several are possible; ``sigma`` may be ``"grid"``. A float counts as
        it is written: 1.5 is 3/2, 0.1 is 1/10.

        Raises:
            LaeError: if a value is impossible; it names the argument.
        """
        return cls(
            fps=None if fps is None else named("fps", parse_fps, fps),
            policy=_made("policy", policy, parse_policy, _POLICIES),
            latency=_made("latency", latency, parse_latency, _LATENCIES),
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
        )

    @classmethod
    def sweep(
        cls,
        *,
        policy: Any = "latest",
        fps: Any = None,
        latency: Any = "recorded",
        scale: Any = 1,
        **others: Any,
    ) -> tuple[World, ...]:
        """The worlds of every combination of some policies, rates, latencies and scales.

        Each is one value or several; the last varies fastest. ``others`` are as in :meth:`of`. A
        plug-in that is named is made once, and shared by the worlds.

        Raises:
            LaeError: as :meth:`of`, or if there is nothing of one, or two have the same name.
        """
        rules = [_made("policy", each, parse_policy, _POLICIES) for each in several(policy)]
        times = [_made("latency", each, parse_latency, _LATENCIES) for each in several(latency)]
        rates = [named("fps", parse_fps, each) for each in several(fps)]
        factors = [named("scale", _factor, each) for each in several(scale)]
        swept: dict[str, list[Any]] = {
            "policy": _distinct("policy", rules),
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

    def rule(self) -> Policy:
        """The policy itself."""
        if isinstance(self.policy, Plugin):
            return self.policy.made  # type: ignore[no-any-return]
        return parse_policy(self.policy) if isinstance(self.policy, str) else self.policy

    def source(self) -> LatencySource:
        """The source of the processing times, before they are scaled."""
        if isinstance(self.latency, Plugin):
            return self.latency.made  # type: ignore[no-any-return]
        return parse_latency(self.latency) if isinstance(self.latency, str) else self.latency

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
            self.rule(),
            None if self.timing is None else open_trace(self.timing),
            (*(each if names is None else each.chosen(names) for each in strided), *gaps),
            find_search(self.search, opened.metadata, gaps, pre_forecaster, self.keep_size),
            self.forget_arrivals,
        )


def replay_trace(
    trace: TraceLike,
    *,
    fps: Number | None = None,
    policy: str | Policy = "latest",
    latency: str | LatencySource = "recorded",
    scale: Number = 1,
    timing: TraceLike | None = None,
    passes: TraceLike | Iterable[TraceLike] = (),
    search: str = "trace",
    forget_arrivals: bool = False,
) -> Runs:
    """Replay every sequence of a trace, one after another.

    Args:
        trace: the boxes and the truth: an open trace, or the path or URL of one.
        fps, policy, latency, scale, timing, passes, search, forget_arrivals: see :meth:`World.of`.

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


def parse_policy(text: str) -> Policy:
    """A policy by name.

    A user's own is named ``package.module:object``: a policy, or a class that makes one; parameters
    may follow, as in ``mine:Patient:frames=2``.

    Raises:
        LaeError: if there is none of that name, or its value does not fit.
    """
    name, colon, value = text.partition(":")
    if text == "latest":
        return policies.latest
    if text == "fifo":
        return policies.fifo
    if text == RECORDED_POLICY:
        return AsRecorded()
    if name == "every":
        return policies.every(_number(text, value, least=1))
    if name == "shrinking-tail" and value:
        return policies.shrinking_tail(value)
    if name == "vot-realtime":
        return policies.vot_realtime(*([_number(text, value)] if value else []))
    if colon and name not in ("latest", "fifo", "shrinking-tail", RECORDED_POLICY):
        policy: Policy = _plugin("policy", text, _POLICIES, ("clock", "calls"))
        return policy
    raise LaeError(
        f"no policy {text!r}: there are latest, fifo, every:N, shrinking-tail:TIME, "
        f"vot-realtime[:GRACE], recorded, package.module:object{hint(name, _POLICIES)}"
    )


def parse_latency(text: str) -> LatencySource:
    """A latency source by name.

    A user's own is named ``package.module:object``: a source, or a class that makes one; parameters
    may follow, as in ``mine:Jitter:ms=40,seed=3``. Every name may end in ``,init=TIME``, what the
    initialisation takes: ``constant:47ms,init=800ms``.

    Raises:
        LaeError: if there is none of that name, or its value does not fit.
    """
    text, init_ns = split_init(text)
    if init_ns is not None:
        return initialised(parse_latency(text), init_ns)
    name, colon, value = text.partition(":")
    if text == "recorded":
        return sources.by_frame
    if text == "by-call":
        return sources.by_call
    if name == "stage":
        return named(f"latency {shown(text)}", _stages, value)
    if name == "constant":
        return sources.constant(value)
    if name == "resample":
        return sources.resampled(_number(text, value))
    if name == "lognormal":
        return sources.lognormal(_number(text, value))
    if name == "bootstrap":
        seed, *block = value.split(":", 1)
        return sources.bootstrap(_number(text, seed), *(_number(text, n, least=1) for n in block))
    if colon and name not in ("recorded", "by-call"):
        source: LatencySource = _plugin("latency", text, _LATENCIES, ("recording",))
        return source
    meant = hint(name, _LATENCIES)
    if text[:1].isdigit():
        unit = "" if text[-1:].isalpha() else "ms"
        meant = f"; did you mean constant:{text:.40}{unit}?"
    raise LaeError(
        f"no latency {shown(text)}: there are recorded, by-call, stage:NAME[+NAME], "
        "constant:47ms, resample:SEED, lognormal:SEED, bootstrap:SEED[:BLOCK], "
        f"package.module:object, all of them perhaps with ,init=TIME{meant}"
    )


def _stages(value: str) -> sources.StageTimes:
    return sources.StageTimes(tuple(value.split("+")))


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


def several(value: Any) -> tuple[Any, ...]:
    """One value, or several, as a tuple; None is none. Text, a trace, a function are one value."""
    if value is None:
        return ()
    one = isinstance(value, (str, bytes, os.PathLike, Trace)) or not isinstance(value, Iterable)
    return (value,) if one else tuple(value)


def text(value: Any) -> str:
    """Text that is not empty.

    Raises:
        LaeError: if the value is none.
    """
    if not isinstance(value, str) or not value:
        own = ": name your own as 'package.module:object'" if callable(value) else ""
        raise LaeError(f"{shown(value)} is not text{own}")
    return value


def flag(value: Any) -> bool:
    """True or false.

    Raises:
        LaeError: if the value is neither.
    """
    if not isinstance(value, bool):
        raise LaeError(f"{shown(value)} is neither true nor false")
    return value


def named(name: str, parse: Callable[[Any], Value], value: Any) -> Value:
    """What a parser makes of an argument's value.

    Raises:
        LaeError: what the parser raises, with the argument's name.
    """
    try:
        return parse(value)
    except LaeError as error:
        if str(error).startswith(f"{name}: "):
            raise
        raise type(error)(f"{name}: {error}") from error


def _made(name: str, given: Any, parse: Callable[[str], object], known: Iterable[str]) -> Any:
    """A policy or a source of times: a name of ours that has been looked up, or what it is."""
    if not isinstance(given, str):
        return given
    made = named(name, parse, given)
    return given if kind_of(given) in known else Plugin(given, made)


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


def label_of(plugin: object) -> str:
    """The name of a policy or a source of times in tables."""
    if isinstance(plugin, str):
        return plugin
    if isinstance(plugin, Initialised):
        return f"{label_of(plugin.source)},init={time_label(plugin.init_ns)}"
    own = {id(sources.by_frame): "recorded", id(sources.by_call): "by-call"}.get(id(plugin))
    label = own or getattr(plugin, "label", None) or getattr(plugin, "__name__", None)
    return str(label or type(plugin).__name__)


def kind_of(label: str) -> str:
    """What kind of policy or source a label names: all before its values, as ``"constant"``."""
    return re.split("[:,]", label, maxsplit=1)[0]


def _plugin(what: str, text: str, known: Iterable[str], arguments: Sequence[str]) -> Any:
    """What a user made, or an instance of it if it is a class, with options; checked.

    Args:
        what: what it is.
        text: its name.
        known: what else may have been meant.
        arguments: names of those that it will be called with.
    """
    try:
        made, options = imported(f"{what} {text!r}", text)
    except LaeError as error:
        raise LaeError(f"{error}{hint(text.partition(':')[0], known)}") from error
    if isinstance(made, type):
        made, options = bound(f"{what} {text!r}", made, [], options), {}
    return with_options(f"{what} {text!r}", made, options, arguments)


def _number(text: str, value: str, least: int = 0) -> int:
    try:
        return whole(value, least)
    except LaeError as error:
        raise LaeError(f"{text!r} needs a whole number from {least} after the colon") from error


def _check_kinds(name: str, values: Iterable[object], kinds: tuple[Any, ...], what: str) -> None:
    for value in values:
        if not isinstance(value, kinds):
            raise LaeError(f"{name}: {shown(value)} is not {what}")


RECORDED = World()
"""Every trace as it was recorded, without a permitted latency."""
