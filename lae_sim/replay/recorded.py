"""The policy ``recorded``: the frames that the trace of the times holds, one after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import listed
from lae_sim.engine.scheduler import Call, Policy
from lae_sim.errors import LaeError
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

RECORDED_POLICY = "recorded"
"""Its name, and the ``schedule.policy`` of traces whose schedule follows no rule of ours."""


def is_log(metadata: Metadata) -> bool:
    """Whether a trace was measured under no policy of ours: its schedule can only be repeated."""
    return bool(metadata.document["schedule"].get("policy") == RECORDED_POLICY)


@dataclass(frozen=True)
class AsRecorded:
    """What was processed is processed again, in order, each frame once it is there.

    A measured log need not follow any rule: messages are lost, queues fill, stages overlap. What it
    processed is known all the same, and with times that reach from when a frame was there, and the
    output before it ready, to its own output, every output is ready when the log says.
    """

    label: ClassVar[str] = RECORDED_POLICY

    def of(self, recording: Recording) -> Policy:
        """That of one sequence, whose times the recording has."""
        return listed(np.flatnonzero(recording.elapsed_ns >= 0).tolist())

    def __call__(self, clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        """As a policy of any sequence it has no answer."""
        raise LaeError("policy 'recorded' repeats what a trace holds: it is for replays of one")
