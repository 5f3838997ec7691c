"""Replaying one recording: the engine fed with recorded times and boxes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from lae_sim.boxes import Floats
from lae_sim.clock import Clock
from lae_sim.engine import Policy, Schedule, simulate
from lae_sim.errors import LaeError
from lae_sim.latency import LatencySource, by_frame
from lae_sim.policies import latest
from lae_sim.recording import Recording
from lae_sim.trace import Trace


@dataclass(frozen=True, eq=False)
class Run:
    """One sequence replayed.

    Attributes:
        recording: the sequence as recorded: truth, and the boxes that outputs are taken from.
        schedule: what was processed, and when.
        departures: processed frames (the first left out) whose preceding processed frame is not
            the one they followed when they were recorded. Above 0, the boxes of a stateful tracker
            are an approximation: it would have seen other motion.
    """

    recording: Recording
    schedule: Schedule
    departures: int

    def __len__(self) -> int:
        """Number of world frames T."""
        return self.schedule.length

    @property
    def boxes(self) -> Floats:
        """The box of each processed frame, float64 [n, 4]."""
        boxes: Floats = self.recording.boxes[self.schedule.frames]
        return boxes


def replay_sequence(
    recording: Recording,
    clock: Clock,
    source: LatencySource = by_frame,
    policy: Policy = latest,
    times: Recording | None = None,
) -> Run:
    """Replay a recording under a latency source and a policy.

    Args:
        recording: the boxes and the truth.
        clock: the world's frame rate.
        source: how to take processing times from a recording.
        policy: which frame is processed next.
        times: the same sequence recorded on another device, to take the times from.

    Raises:
        LaeError: if a frame is asked for that the recording lacks, or the two recordings differ in
            length; it names the sequence and the frame.
    """
    times = recording if times is None else times
    if len(times) != len(recording):
        raise LaeError(
            f"sequence {recording.name!r} has {len(recording)} frames here and {len(times)} in the "
            "trace that the times come from"
        )
    schedule = simulate(len(recording), clock, source(times), policy)
    recorded = np.flatnonzero(~np.isnan(recording.boxes[:, 0]))
    place = np.searchsorted(recorded, schedule.frames)
    absent = np.flatnonzero(recorded[np.minimum(place, len(recorded) - 1)] != schedule.frames)
    if len(absent):
        raise LaeError(
            f"sequence {recording.name!r}, frame {schedule.frames[absent[0]]}: the trace has no "
            "box for it, since the tracker skipped it; replay a trace of every frame instead"
        )
    before = recorded[place[1:] - 1]
    departures = int(np.count_nonzero(before != schedule.frames[:-1]))
    return Run(recording, schedule, departures)


def replay_trace(
    trace: Trace,
    fps: Fraction | None = None,
    source: LatencySource = by_frame,
    policy: Policy = latest,
    timing: Trace | None = None,
) -> Iterator[Run]:
    """Replay every sequence of a trace, one after another.

    Args:
        trace: the boxes and the truth.
        fps: world frame rate; the trace's own by default.
        source: how to take processing times from a recording.
        policy: which frame is processed next.
        timing: another device's trace to take the times from; it must have the same sequences.

    Raises:
        LaeError: if a sequence or frame that is asked for is not there.
    """
    clock = Clock.at(trace.metadata.fps if fps is None else fps)
    others = iter(()) if timing is None else iter(timing)
    other: Recording | None = None
    for recording in trace:
        while timing is not None and (other is None or other.name < recording.name):
            other = next(others, None)  # both are sorted by name
            if other is None:
                break
        if timing is not None and (other is None or other.name != recording.name):
            raise LaeError(f"the trace of the times has no sequence {recording.name!r}")
        yield replay_sequence(recording, clock, source, policy, other)
