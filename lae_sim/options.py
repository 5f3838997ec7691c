"""The options of a replay: policies and latency sources by name."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from lae_sim.cli import argument
from lae_sim.clock import parse_duration, parse_fps, parse_rational
from lae_sim.errors import LaeError

if TYPE_CHECKING:
    from lae_sim.engine import Policy
    from lae_sim.latency import LatencySource


def add_world(parser: argparse.ArgumentParser, sweeps: bool = False) -> None:
    """Add what decides a replay: the frame rate, the policy and the processing times.

    Args:
        parser: the command line.
        sweeps: whether the rate and the scale of the times may be several: they are lists then,
            that of the rates empty unless they are given.
    """
    add = _world_group(parser, sweeps)
    add(
        "--latency", default="recorded", help="where processing times come from (default: recorded)"
    )
    add(
        "--latency-scale",
        type=argument(parse_rational),
        metavar="FACTOR",
        **({"nargs": "+", "default": [Fraction(1)]} if sweeps else {"default": Fraction(1)}),
        help="multiply all times by an exact factor, such as 2 or 1/3"
        + (", or by several, one after another" if sweeps else ""),
    )
    add("--timing", metavar="TRACE", help="take the times from another device's trace")
    add(
        "--strided",
        nargs="+",
        default=[],
        metavar="TRACE",
        help="passes on every N-th frame (lae-sim profile --stride): each sequence's boxes come "
        "from the pass that is nearest to the frames skipped",
    )


def add_worlds(parser: argparse.ArgumentParser, scales: Sequence[Fraction]) -> None:
    """Add what decides several replays, one after another.

    Args:
        parser: the command line.
        scales: exact factors on all times, by default.
    """
    add = _world_group(parser)
    add(
        "--latency",
        nargs="+",
        default=["recorded"],
        metavar="SOURCE",
        help="processing times, one after another: recorded, constant:47ms, ... as in replay",
    )
    add(
        "--latency-scale",
        nargs="+",
        type=argument(parse_rational),
        default=list(scales),
        metavar="FACTOR",
        help="exact factors on all times, one after another "
        f"(default: {' '.join(map(str, scales))})",
    )


def _world_group(
    parser: argparse.ArgumentParser, sweeps: bool = False
) -> Callable[..., argparse.Action]:
    """A group of options that begins with the world's rate and the policy; what adds to it."""
    group = parser.add_argument_group("the world and the tracker")
    add: Callable[..., argparse.Action] = group.add_argument
    several = (
        "; several are a sweep of how fast the world moves, since the motion from one recorded "
        "frame to the next stays what it is"
    )
    add(
        "--fps",
        type=argument(parse_fps),
        **({"nargs": "+", "default": []} if sweeps else {}),
        help="world frame rate, exact (default: the trace's)" + (several if sweeps else ""),
    )
    add("--policy", default="latest", help="which frame a free tracker takes (default: latest)")
    return add


def parse_cost(text: str) -> int | None:
    """A cost such as ``2ms`` in ns, or None for ``measured``.

    Raises:
        LaeError: if the text is neither.
    """
    return None if text == "measured" else parse_duration(text)


def add_forecasting(parser: argparse.ArgumentParser) -> None:
    """Add what forecasters need: the frames of the camera's motion, and what they cost."""
    group = parser.add_argument_group("the forecasters")
    add = group.add_argument
    add("--root", metavar="PATH", help="folder of the dataset's frames, for camera+NAME")
    add("--dataset", metavar="NAME", help="the dataset in --root, if its folder does not say")
    add(
        "--camera-lag",
        type=argument(whole),
        metavar="FRAMES",
        help="by which the camera's motion is late (default: by what estimating it takes here)",
    )
    add(
        "--cost",
        nargs="+",
        default=[],
        metavar="[NAME=]TIME",
        help="what forecasting costs, such as 2ms, or measured; it delays the answers (default: 0)",
    )


def parse_policy(text: str) -> tuple[Policy, bool]:
    """A policy by name, and whether its outputs count from their own frames' arrival.

    A user's own is named ``package.module:object``: a policy, or a class that makes one.

    Raises:
        LaeError: if there is none of that name, or its value does not fit.
    """
    from lae_sim import policies

    name, colon, value = text.partition(":")
    if text == "latest":
        return policies.latest, False
    if text == "fifo":
        return policies.fifo, False
    if name == "every":
        return policies.every(_number(text, value, least=1)), False
    if name == "shrinking-tail" and value:
        return policies.shrinking_tail(parse_duration(value)), False
    if name == "vot-realtime":
        return policies.vot_realtime(*([_number(text, value)] if value else [])), True
    if colon and name not in ("latest", "fifo", "shrinking-tail"):
        policy: Policy = _own("policy", text)
        return policy, False
    raise LaeError(
        f"no policy {text!r}: there are latest, fifo, every:N, shrinking-tail:TIME, "
        "vot-realtime[:GRACE], package.module:object"
    )


def parse_latency(text: str) -> LatencySource:
    """A latency source by name.

    A user's own is named ``package.module:object``: a source, or a class that makes one.

    Raises:
        LaeError: if there is none of that name, or its value does not fit.
    """
    from lae_sim import latency

    name, colon, value = text.partition(":")
    if text == "recorded":
        return latency.by_frame
    if text == "by-call":
        return latency.by_call
    if name == "constant":
        return latency.constant(parse_duration(value))
    if name == "resample":
        return latency.resampled(_number(text, value))
    if name == "lognormal":
        return latency.lognormal(_number(text, value))
    if name == "bootstrap":
        seed, *block = value.split(":", 1)
        return latency.bootstrap(_number(text, seed), *(_number(text, n, least=1) for n in block))
    if colon and name not in ("recorded", "by-call"):
        source: LatencySource = _own("latency", text)
        return source
    raise LaeError(
        f"no latency {text!r}: there are recorded, by-call, constant:47ms, resample:SEED, "
        "lognormal:SEED, bootstrap:SEED[:BLOCK], package.module:object"
    )


def _own(what: str, text: str) -> Any:
    """What a user made, or an instance of it if it is a class."""
    from lae_sim.trackers.names import bound, imported

    found = imported(f"{what} {text!r}", text)
    return bound(f"{what} {text!r}", found, [], {}) if isinstance(found, type) else found


def parse_box(text: str) -> tuple[float, ...]:
    """A box ``x,y,w,h`` in pixels.

    Raises:
        LaeError: if the text is none.
    """
    try:
        x, y, w, h = (float(value) for value in text.split(","))
    except ValueError as error:
        raise LaeError(f"{text!r} is not a box x,y,w,h in pixels") from error
    return x, y, w, h


def parse_stride(text: str) -> Fraction:
    """A stride of a pass, such as ``2`` or ``3/2``.

    Raises:
        LaeError: if the text is none.
    """
    stride = parse_rational(text)
    if not (stride > 1 and stride.numerator <= 1000):
        raise LaeError(f"a stride is above 1, such as 2 or 3/2, not {text!r}")
    return stride


def key_and_value(text: str) -> tuple[str, str]:
    """An option such as ``size=3``.

    Raises:
        LaeError: if the text is none.
    """
    key, equals, value = text.partition("=")
    if not (equals and key.isidentifier()):
        raise LaeError(f"{text!r} is not key=value")
    return key, value


def whole(text: str, least: int = 0) -> int:
    """A whole number from ``least``.

    Raises:
        LaeError: if the text is none.
    """
    if not (text.isascii() and text.isdigit() and len(text) < 19 and int(text) >= least):
        raise LaeError(f"{text!r} is not a whole number from {least}")
    return int(text)


def _number(text: str, value: str, least: int = 0) -> int:
    try:
        return whole(value, least)
    except LaeError as error:
        raise LaeError(f"{text!r} needs a whole number from {least} after the colon") from error
