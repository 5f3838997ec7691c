"""How traces are replayed and scored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from lae_sim.engine.clock import parse_duration, whole
from lae_sim.engine.policies import latest
from lae_sim.engine.scheduler import Policy
from lae_sim.errors import LaeError
from lae_sim.replay.latency import LatencySource, by_frame, scaled
from lae_sim.replay.run import Run, replay_trace
from lae_sim.trace.file import Trace

if TYPE_CHECKING:
    from lae_sim.engine.scheduler import Policy
    from lae_sim.replay.latency import LatencySource


@dataclass(frozen=True)
class World:
    """How traces are replayed.

    Attributes:
        latencies: latency sources by name.
        scales: exact factors on all times.
        fps: world frame rate; each trace's own if None.
        policy: which frame is processed next.
    """

    latencies: Mapping[str, LatencySource]
    scales: Sequence[Fraction] = (Fraction(1),)
    fps: Fraction | None = None
    policy: Policy = latest

    def replays(self, trace: Trace) -> Iterator[tuple[str, Fraction, list[Run]]]:
        """The latency's name, the scale and the runs of each way to replay a trace."""
        for name, source in self.latencies.items():
            for scale in self.scales:
                runs = replay_trace(trace, self.fps, scaled(source, scale), self.policy)
                yield name, scale, list(runs)


RECORDED = World({"recorded": by_frame})


def parse_policy(text: str) -> Policy:
    """A policy by name.

    A user's own is named ``package.module:object``: a policy, or a class that makes one.

    Raises:
        LaeError: if there is none of that name, or its value does not fit.
    """
    from lae_sim.engine import policies

    name, colon, value = text.partition(":")
    if text == "latest":
        return policies.latest
    if text == "fifo":
        return policies.fifo
    if name == "every":
        return policies.every(_number(text, value, least=1))
    if name == "shrinking-tail" and value:
        return policies.shrinking_tail(parse_duration(value))
    if name == "vot-realtime":
        return policies.vot_realtime(*([_number(text, value)] if value else []))
    if colon and name not in ("latest", "fifo", "shrinking-tail"):
        policy: Policy = _own("policy", text)
        return policy
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
    from lae_sim.replay import latency

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
    from lae_sim.plugins import bound, imported

    found = imported(f"{what} {text!r}", text)
    return bound(f"{what} {text!r}", found, [], {}) if isinstance(found, type) else found


def _number(text: str, value: str, least: int = 0) -> int:
    try:
        return whole(value, least)
    except LaeError as error:
        raise LaeError(f"{text!r} needs a whole number from {least} after the colon") from error
