"""Policies and latencies by name, and plain values as people give them, each checked."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from lae_sim.engine import policies
from lae_sim.engine.clock import split_init, whole
from lae_sim.engine.scheduler import Policy
from lae_sim.errors import LaeError, hint, shown
from lae_sim.plugins import bound, imported, with_options
from lae_sim.replay import latency as sources
from lae_sim.replay.latency import Initialised, LatencySource, initialised, time_label
from lae_sim.replay.recorded import RECORDED_POLICY, AsRecorded
from lae_sim.trace.file import Trace

POLICIES = ("latest", "fifo", "every", "shrinking-tail", "vot-realtime", "recorded")
LATENCIES = ("recorded", "by-call", "stage", "constant", "resample", "lognormal", "bootstrap")
"""The names of those that come with the package, before their values."""

Value = TypeVar("Value")


@dataclass(frozen=True)
class Plugin:
    """A user's own policy or source of times, made once, under the name that asks for it.

    Attributes:
        label: ``package.module:object``.
        made: what that is, or an instance of it if it is a class.
    """

    label: str
    made: Any = field(compare=False)

    def __call__(self, *arguments: Any) -> Any:
        """What it makes of some arguments."""
        return self.made(*arguments)


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
        policy: Policy = _plugin("policy", text, POLICIES, ("clock", "calls"))
        return policy
    raise LaeError(
        f"no policy {text!r}: there are latest, fifo, every:N, shrinking-tail:TIME, "
        f"vot-realtime[:GRACE], recorded, package.module:object{hint(name, POLICIES)}"
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
        source: LatencySource = _plugin("latency", text, LATENCIES, ("recording",))
        return source
    meant = hint(name, LATENCIES)
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
