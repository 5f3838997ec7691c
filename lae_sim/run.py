"""Replaying one recording: the engine fed with recorded times and boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lae_sim.boxes import Floats
from lae_sim.clock import Clock
from lae_sim.engine import Policy, Schedule, simulate
from lae_sim.errors import LaeError
from lae_sim.latency import LatencySource, by_frame
from lae_sim.policies import latest
from lae_sim.recording import Recording


@dataclass(frozen=True)
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

    @property
    def boxes(self) -> Floats:
        """The box of each processed frame, float64 [n, 4]."""
        boxes: Floats = self.recording.boxes[self.schedule.frames]
        return boxes


def replay_sequence(
    recording: Recording, clock: Clock, source: LatencySource = by_frame, policy: Policy = latest
) -> Run:
    """Replay a recording under a latency source and a policy.

    Raises:
        LaeError: if a frame is asked for that the recording lacks; it names sequence and frame.
    """
    schedule = simulate(len(recording), clock, source(recording), policy)
    recorded = np.flatnonzero(recording.elapsed_ns >= 0)
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
