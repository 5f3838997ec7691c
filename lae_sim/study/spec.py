"""What a study asks for: traces, forecasters, worlds and repetitions, from TOML or Python."""

from __future__ import annotations

import difflib
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from lae_sim.decoding import read_toml
from lae_sim.engine.clock import exact, parse_duration, parse_fps, split_init, whole
from lae_sim.engine.pipeline import Pipeline
from lae_sim.engine.scheduler import scores_latency
from lae_sim.errors import LaeError, shown
from lae_sim.evaluation.metrics import find_convention
from lae_sim.plugins import looking_in
from lae_sim.replay.names import (
    flag,
    kind_of,
    named,
    parse_latency,
    parse_policy,
    several,
    text,
)
from lae_sim.replay.pipeline import parse_pipeline, pipeline_document, read_pipeline
from lae_sim.replay.search import parse_search
from lae_sim.replay.world import World, check_sigmas, parse_sigmas
from lae_sim.trace.file import Trace

RANDOM = ("bootstrap", "resample", "lognormal")
"""Latencies that are drawn anew in each repetition."""

Value = TypeVar("Value")


@dataclass(frozen=True)
class Study:
    """Traces, and all the ways in which they are replayed and scored: every list is crossed.

    Attributes:
        traces: files, folders, globs and URLs.
        timing: traces of other devices to take the times from too; each goes with the traces of
            its tracker and dataset. The traces' own times always count.
        passes: strided and gap passes (see :meth:`lae_sim.replay.world.World.of`); each goes with
            the traces of its tracker and dataset.
        forecasters: names, as on command lines; hold is always there.
        policies: which frame a free tracker takes.
        pipelines: stages around the tracker, besides the policies; in Python by their names, as
            pipelines, tables of their keys, or paths of files of these.
        fps: world frame rates; None is each trace's own.
        forget_arrivals: whether frames arrive evenly also where a trace says when each of them did.
        latencies: where times come from: ``"recorded"``, ``"by-call"``, ``"constant:47ms"``, or one
            of ``RANDOM``, which is repeated. Each may end in ``,init=TIME``.
        init: what the initialisation takes, one or several durations, each with every latency;
            none: what the latency says.
        scales: exact factors on all times.
        search: what is assumed of the trackers' reach (see :func:`.search.parse_search`).
        pre_forecaster: names of what says where the trackers search, in the search model; None, or
            ``"none"``, is their last answer.
        keep_size: whether a pre-forecaster says the centre only.
        sigmas: permitted latencies in frames, ascending.
        conventions: how frames and thresholds count.
        costs: what forecasting costs, such as ``"2ms"`` or ``"kalman=2ms"``.
        sequences: those wanted; all if empty.
        attributes: whether the report has scores per attribute.
        repetitions: how often random latencies are drawn.
        seed: of random latencies, resamples and training.
        block: consecutive calls that the bootstrap of latencies keeps together.
        folds: of the training, where a forecaster is trained.
        require_auc: one or several AUCs for which it is looked how slow trackers may be.

    Raises:
        LaeError: if a value is impossible; it names the key of the file.

    Example:
        >>> import lae_sim
        >>> study = lae_sim.Study(traces="traces/*.parquet", scales=[0.5, 1], sigmas="grid")
        >>> study.traces, study.scales, len(study.sigmas)
        (('traces/*.parquet',), (Fraction(1, 2), Fraction(1, 1)), 51)
    """

    traces: tuple[str, ...]
    timing: tuple[str, ...] = ()
    passes: tuple[str, ...] = ()
    forecasters: tuple[str, ...] = ("hold", "kalman")
    policies: tuple[str, ...] = ("latest",)
    pipelines: tuple[Pipeline, ...] = ()
    fps: tuple[Fraction | None, ...] = (None,)
    latencies: tuple[str, ...] = ("recorded",)
    init: tuple[str, ...] = ()
    scales: tuple[Fraction, ...] = (Fraction(1),)
    search: tuple[str, ...] = ("trace",)
    pre_forecaster: tuple[str | None, ...] = (None,)
    keep_size: bool = False
    sigmas: tuple[Fraction, ...] = (Fraction(0),)
    conventions: tuple[str, ...] = ("pysot",)
    costs: tuple[str, ...] = ()
    sequences: tuple[str, ...] = ()
    attributes: bool = True
    repetitions: int = 100
    seed: int = 0
    block: int = 30
    folds: int = 5
    require_auc: tuple[Fraction, ...] = ()
    forget_arrivals: bool = False

    def __post_init__(self) -> None:
        for each in fields(self):
            value, (key, parse) = getattr(self, each.name), _PARSERS[each.name]
            if value is not each.default:  # as plain as in a file
                object.__setattr__(self, each.name, named(key, parse, value))
        if self.repetitions > 1_000_000:
            raise LaeError(f"repetitions: {self.repetitions} are too many: at most a million")
        for latency in self.latencies:
            _check_latency(latency, swept=bool(self.init))
        if not self.policies and not self.pipelines:
            raise LaeError("policies: the list is empty, and there are no pipelines")
        for policy in self.policies:
            if not scores_latency(parse_policy(policy)):
                raise LaeError(f"policies: {policy} never scores latency: it goes with replay")
        for pipeline, latency in product(self.pipelines, self.times):
            try:
                World(latency=self.seeded(latency), pipeline=pipeline)
            except LaeError as error:
                raise LaeError(f"pipelines: {pipeline.name}: {error}") from error
        for cost in self.costs:
            if cost.rpartition("=")[2] == "measured":
                raise LaeError("costs: declare a time: one measured would differ on every worker")
        for convention in self.conventions:
            find_convention(convention)
        if "offline" in self.forecasters:
            raise LaeError("forecasters: offline is the tracker's own score, and always there")
        check_sigmas(self.sigmas)
        for search in self.search:
            named("search", parse_search, search)
        if any(self.pre_forecaster) and "off" in self.search:
            raise LaeError(
                "pre_forecaster: what it is worth is the search model's: do not turn it off"
            )
        if self.keep_size and not any(self.pre_forecaster):
            raise LaeError("keep_size: it is a way to use a pre_forecaster")
        if any(scale < 0 for scale in self.scales):
            raise LaeError("scales: times cannot be scaled by less than 0")
        for auc in self.require_auc:
            if not 0 < auc < 1:
                raise LaeError(f"require_auc: an AUC is between 0 and 1, not {auc}")

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Study:
        """A study from plain values, as TOML or JSON has them; numbers may be given as text.

        Raises:
            LaeError: if a key is unknown, or a value impossible; it names the key.
        """
        values = {}
        for key, value in document.items():
            if key not in _KEYS:
                raise LaeError(f"unknown key {shown(key)}{_meant(key)}")
            name, parse = _KEYS[key]
            values[name] = named(key, parse, value)
        if "traces" not in values:
            raise LaeError("the key 'traces' is missing: name files, folders, globs or URLs")
        return cls(**values)

    @property
    def times(self) -> tuple[str, ...]:
        """Every latency with every time of the initialisation, such as ``"recorded,init=1s"``."""
        if not self.init:
            return self.latencies
        return tuple(f"{latency},init={init}" for latency in self.latencies for init in self.init)

    def seeded(self, latency: str) -> str:
        """A latency of the study as a replay names it: random times with their seed."""
        if not is_random(latency):
            return latency
        name, comma, init = latency.partition(",")
        block = f":{self.block}" if name == "bootstrap" else ""
        return f"{name}:{self.seed}{block}{comma}{init}"

    def document(self) -> dict[str, Any]:
        """Plain values of everything, for provenance and digests."""
        document = {field.name: _plain(getattr(self, field.name)) for field in fields(self)}
        if len(self.require_auc) < 2:  # one is a number, as in files of version 0.1
            document["require_auc"] = next(iter(document["require_auc"]), None)
        return document


def is_random(latency: str) -> bool:
    """Whether a latency of a study is drawn anew in each repetition."""
    return kind_of(latency) in RANDOM


def read_study(path: str | os.PathLike[str]) -> Study:
    """Read a study from a TOML file; local traces, and modules of yours, are found in its folder.

    Args:
        path: of the file.

    Raises:
        LaeError: if it cannot be read, is not TOML, or is no valid study.

    Example:
        >>> import lae_sim
        >>> study = lae_sim.read_study("traces/study.toml")
        >>> study.traces, study.latencies
        (('synthetic-slow.parquet', 'synthetic-fast.parquet'), ('recorded', 'bootstrap'))
    """
    if not isinstance(path, (str, os.PathLike)):
        raise LaeError(f"path: a study is read from a TOML file, not {shown(path)}")
    document = read_toml(path, "a study")
    try:
        with looking_in(Path(path).parent):
            return Study.of(_beside(document, Path(path).parent))
    except RecursionError as error:
        raise LaeError(f"{path}: is nested too deeply for a study") from error
    except (ValueError, LaeError) as error:  # ValueError also of a number of thousands of digits
        raise LaeError(f"{path}: {error}") from error


def _beside(document: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A study's table, with paths of pipelines from its folder."""
    found = dict(document)
    if isinstance(given := found.get("pipelines"), Mapping):
        found["pipelines"] = {
            name: folder / value if isinstance(value, str) else value
            for name, value in given.items()
        }
    return found


def _pipelines(value: Any) -> tuple[Pipeline, ...]:
    """Pipelines by name, in plain values, or as they are."""
    if isinstance(value, Mapping):
        made = [named(str(name), partial(_pipeline, name=name), it) for name, it in value.items()]
    else:
        made = [_pipeline(each) for each in several(value)]
    for name, count in Counter(each.name for each in made).items():
        if count > 1:
            raise LaeError(f"two are called {name!r}: give them names of their own")
    return tuple(made)


def _pipeline(value: Any, name: str | None = None) -> Pipeline:
    if isinstance(value, Pipeline):
        made = parse_pipeline(pipeline_document(value))  # which refuses what has no name
    elif isinstance(value, Mapping):
        made = parse_pipeline(value, name or "pipeline")
    else:
        made = read_pipeline(value)
    return made if name is None else replace(made, name=name)


def _policies(value: Any) -> tuple[str, ...]:
    return () if value in ([], ()) else _several(text)(value)


def _check_latency(latency: str, swept: bool) -> None:
    name, init_ns = named("latencies", split_init, latency)
    if swept and init_ns is not None:
        raise LaeError(f"latencies: {latency!r} names its init, and so does the key init")
    if name in RANDOM:
        return
    if is_random(name):
        raise LaeError(f"latencies: {latency!r}: in a study the keys seed and block say so")
    try:
        parse_latency(name)
    except LaeError as error:
        raise LaeError(f"latencies: {error} (in a study: {', '.join(RANDOM)} as they are)") from (
            error
        )


def _meant(key: str) -> str:
    """A hint at what was meant."""
    close = difflib.get_close_matches(key, _KEYS, 1)
    return f": did you mean {close[0]!r}?" if close else f": there are {', '.join(_KEYS)}"


def _plain(value: Any) -> Any:
    if isinstance(value, Pipeline):
        return pipeline_document(value)
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, Fraction) else value


def _trace(value: Any) -> str:
    """The path or URL of a trace; an open one has to have been read from there."""
    path = getattr(value.recordings, "path", value) if isinstance(value, Trace) else value
    if isinstance(path, Trace):
        raise LaeError(f"{shown(value)} is in memory: write it first, with write_trace")
    return text(os.fspath(path) if isinstance(path, os.PathLike) else path)


def _rate(value: Any) -> Fraction | None:
    return None if value is None or value == "trace" else parse_fps(value)


def _forecaster(value: Any) -> str | None:
    return None if value is None or value == "none" else text(value)


def _duration(value: Any) -> str:
    parse_duration(value)
    return text(value)


def _sigmas(value: Any) -> tuple[Fraction, ...]:
    return parse_sigmas(value) if value == "grid" else parse_sigmas(_several(exact)(value))


def _several(parse: Callable[[Any], Value]) -> Callable[[Any], tuple[Value, ...]]:
    """A list of values, or one value; each once."""

    def parsed(value: Any) -> tuple[Value, ...]:
        values = [value] if isinstance(value, Mapping) or value is None else several(value)
        if not values:
            raise LaeError("the list is empty: leave the key out, or name something")
        return tuple(dict.fromkeys(map(parse, values)))

    return parsed


# key of the file -> (attribute, how its value is read)
_KEYS: Mapping[str, tuple[str, Callable[[Any], Any]]] = {
    "traces": ("traces", _several(_trace)),
    "timing": ("timing", _several(_trace)),
    "passes": ("passes", _several(_trace)),
    "forecasters": ("forecasters", _several(text)),
    "policies": ("policies", _policies),
    "pipelines": ("pipelines", _pipelines),
    "fps": ("fps", _several(_rate)),
    "forget_arrivals": ("forget_arrivals", flag),
    "latencies": ("latencies", _several(text)),
    "init": ("init", _several(_duration)),
    "scales": ("scales", _several(exact)),
    "search": ("search", _several(text)),
    "pre_forecaster": ("pre_forecaster", _several(_forecaster)),
    "keep_size": ("keep_size", flag),
    "sigma": ("sigmas", _sigmas),
    "conventions": ("conventions", _several(text)),
    "costs": ("costs", _several(text)),
    "sequences": ("sequences", _several(text)),
    "attributes": ("attributes", flag),
    "repetitions": ("repetitions", partial(whole, least=1)),
    "seed": ("seed", whole),
    "block": ("block", partial(whole, least=1)),
    "folds": ("folds", partial(whole, least=2)),
    "require_auc": ("require_auc", _several(exact)),
}
_PARSERS = {name: (key, parse) for key, (name, parse) in _KEYS.items()}
