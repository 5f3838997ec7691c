"""The event log of a run: what happened, in order, at exact ticks."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

from lae_sim.engine.clock import Number, exact
from lae_sim.evaluation.pairing import Pairing, pair
from lae_sim.replay.run import Run

KINDS = (
    "frame arrived",
    "processing started",
    "frame skipped",
    "output ready",
    "forecaster updated",
    "query answered",
)
"""Kinds of events, in the order of a frame's life."""


class Event(NamedTuple):
    """One event.

    Attributes:
        tick: instant in ticks of the run's clock (a query between two ticks: the tick before it).
        kind: one of ``KINDS``.
        frame: the world frame it is about.
        source_frame: for a query, the frame of the output that answers it.
    """

    tick: int
    kind: str
    frame: int
    source_frame: int | None = None


def event_log(run: Run, sigma: Number = Fraction(0), pairing: Pairing | None = None) -> list[Event]:
    """All events of a run, for queries at one permitted latency.

    Within one tick frames arrive first, then come the tracker's events as it made them, then
    queries. A frame is skipped at the moment when a newer one starts, or at the end of the stream.

    Args:
        run: one replayed sequence.
        sigma: permitted latency of the queries, frames.
        pairing: of the run at that sigma, where it is known already.

    Raises:
        LaeError: if the permitted latency is no exact number.

    Example:
        >>> import lae_sim
        >>> runs = lae_sim.replay_trace("traces/synthetic-slow.parquet", latency="constant:47ms")
        >>> log = lae_sim.event_log(next(iter(runs)))
        >>> [(event.kind, event.frame) for event in log[:3]]
        [('frame arrived', 0), ('processing started', 0), ('query answered', 0)]
    """
    sigma = exact(sigma)
    queries = _queries(run, sigma, pairing or pair([run.schedule], [sigma]))
    events = [*_world(run), *_tracker(run), *queries]
    return sorted(events, key=lambda event: event.tick)  # stable: each stream is in causal order


def _world(run: Run) -> Iterator[Event]:
    for frame in range(run.schedule.length):
        yield Event(run.schedule.clock.arrival(frame), "frame arrived", frame)


def _tracker(run: Run) -> Iterator[Event]:
    schedule = run.schedule
    expected = 0
    for frame, start, ready in zip(
        schedule.frames.tolist(), schedule.start.tolist(), schedule.ready.tolist()
    ):
        yield Event(start, "processing started", frame)
        for skipped in range(expected, frame):
            yield Event(start, "frame skipped", skipped)
        yield Event(ready, "output ready", frame)
        expected = frame + 1
    for skipped in range(expected, schedule.length):
        yield Event(schedule.clock.end(schedule.length), "frame skipped", skipped)


def _queries(run: Run, sigma: Fraction, pairing: Pairing) -> Iterator[Event]:
    clock = run.schedule.clock
    spans = zip(pairing.frames.tolist(), pairing.first[:, 0].tolist(), pairing.end[:, 0].tolist())
    for source, first, end in spans:
        for frame in range(first, end):
            tick = clock.query(frame, sigma)
            if frame == first and source > 0:
                yield Event(tick, "forecaster updated", source)
            yield Event(tick, "query answered", frame, source)
