"""Measured logs of a running tracker: what they say, its clocks, and which frame a box is of.

A log says when frames came and when outputs were ready, on the clock of the machine that kept it.
Capture times may be those of another clock, the camera's.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from lae_sim.engine.clock import NS_PER_SECOND, parse_duration
from lae_sim.errors import LaeError
from lae_sim.trace.metadata import ImageSizes

Box: TypeAlias = "tuple[float, float, float, float]"
"""``x, y, w, h`` in pixels."""

_MOST_DELAY_NS = 10**9  # from capture to arrival, on one clock: more is another clock


@dataclass(frozen=True)
class LoggedFrame:
    """A frame of the camera.

    Attributes:
        where: its place in the log, for messages.
        captured_ns: when it was taken, on the camera's clock; None if that is not known.
        arrived_ns: when it arrived, on the log's clock; None if that is not known.
    """

    where: str
    captured_ns: int | None
    arrived_ns: int | None


@dataclass(frozen=True)
class LoggedOutput:
    """What the tracker made of a frame.

    Attributes:
        where: its place in the log, for messages.
        frame: the frame's place among the frames, from 0.
        box: None where the tracker found no target.
        ready_ns: when it was ready, on the log's clock.
        started_ns: when its call began, on the log's clock; None if that is not known.
        score: the tracker's confidence, if it is known.
    """

    where: str
    frame: int
    box: Box | None
    ready_ns: int
    started_ns: int | None = None
    score: float | None = None


@dataclass(frozen=True)
class Log:
    """What a log says of one sequence.

    Attributes:
        frames: all of them, in the order of the camera.
        outputs: in any order.
        tracker: a name for it, where none is given.
        facts: what the trace's metadata say of the log.
        truth: ground truth boxes by the frames' places.
        image_sizes: of the frames, if they are known.
        interpolated: frames that the log leaves out, and whose times are between those of others.
        notes: what is to be said of it, a sentence each.
    """

    frames: Sequence[LoggedFrame]
    outputs: Sequence[LoggedOutput]
    tracker: str
    facts: dict[str, Any]
    truth: dict[int, Box] = field(default_factory=dict)
    image_sizes: ImageSizes | None = None
    interpolated: int = 0
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Offset:
    """What is added to times of the camera's clock to have those of the log's.

    Attributes:
        ns: the offset.
        source: ``"given"``, ``"estimated"`` from the least delay, or ``"assumed"``.
    """

    ns: int
    source: str


def clock_offset(path: Path, delays_ns: Sequence[int], asked: str | None) -> Offset:
    """How far the camera's clock is from that of the log.

    Args:
        path: the log, for messages.
        delays_ns: from capture to arrival (or, where that is not known, to the output), each by its
            own clock.
        asked: a time such as ``"-3600s"``; ``"estimate"`` to take the least delay for none; None if
            the clocks are one.

    Raises:
        LaeError: if that is no time, or with it a frame would arrive before its capture, or later
            than a second after it throughout.
    """
    least = min(delays_ns)
    if asked == "estimate":
        return Offset(least, "estimated")
    ns = 0
    if asked is not None:
        try:
            ns = parse_duration(asked.removeprefix("-"))
        except LaeError as error:
            raise LaeError(
                f"--clock-offset: a time, such as -12ms, or estimate: {error}"
            ) from error
        ns = -ns if asked.startswith("-") else ns
    if not 0 <= least - ns <= _MOST_DELAY_NS:
        how = "after" if least >= ns else "before"
        raise LaeError(
            f"{path}: with {'the same clock' if asked is None else f'the offset {asked}'} the "
            f"quickest frame arrives {seconds(abs(least - ns))} {how} it was captured; say what to "
            "add to the camera's times with --clock-offset=TIME, or estimate it with "
            "--clock-offset estimate"
        )
    return Offset(ns, "assumed" if asked is None else "given")


def of_one_clock(delays_ns: Sequence[int]) -> bool:
    """Whether delays, from a stamp to when it was received, may be those of one clock."""
    return 0 <= min(delays_ns) <= _MOST_DELAY_NS


def seconds(ns: int) -> str:
    """A time in words."""
    return f"{ns / 1e6:,.3g} ms" if ns < 10**9 else f"{ns / 1e9:,.4g} s"


def in_seconds(ns: int) -> str:
    """A time in seconds, exactly."""
    whole, rest = divmod(abs(ns), NS_PER_SECOND)
    return f"{'-' if ns < 0 else ''}{whole}.{rest:09}"


def nearest_earlier(times_ns: Sequence[int], at_ns: int, tolerance_ns: int) -> int | None:
    """The place of the last time up to another, if it is no more than the tolerance before it."""
    place = bisect_right(times_ns, at_ns) - 1
    return place if place >= 0 and at_ns - times_ns[place] <= tolerance_ns else None
