"""What happened in a pipeline: how old frames are at each stage, where they wait, and are lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from lae_sim._arrays import Ints
from lae_sim.engine.pipeline import CAMERA, Pipeline, Stage
from lae_sim.engine.scheduler import NEVER
from lae_sim.engine.stages import Drop, PipelineSchedule, StageLog
from lae_sim.evaluation.evaluate import ScoredRun

WHY: Mapping[Drop, str] = {
    Drop.FULL: "queue full",
    Drop.NOT_ITS_TURN: "not its turn",
    Drop.OVERTAKEN: "overtaken",
    Drop.TOO_EARLY: "before the initialisation",
    Drop.END: "end of the stream",
}
"""Why stages drop frames, in words."""


@dataclass
class _Spans:
    """Times of some frames, ns.

    Attributes:
        count: of the frames.
        total, most: of their times.
    """

    count: int = 0
    total: float = 0.0
    most: float = 0.0

    def add(self, begin: Ints, end: Ints, ticks_per_ns: int) -> None:
        """Take in what lies between two instants, ticks; -1 is no instant."""
        spans = (end - begin)[(begin >= 0) & (end >= 0)] / ticks_per_ns
        if len(spans):
            self.count += len(spans)
            self.total += float(spans.sum())
            self.most = max(self.most, float(spans.max()))

    @property
    def mean_ms(self) -> float | None:
        """Their mean, ms; None of none."""
        return self.total / self.count / 1e6 if self.count else None

    @property
    def max_ms(self) -> float | None:
        """The longest, ms; None of none."""
        return self.most / 1e6 if self.count else None


@dataclass
class StageTotals:
    """What happened at one stage in some sequences.

    Attributes:
        stage: which it is.
        arrived, done: frames that came, and that it finished.
        dropped: how many it dropped, by why.
        busy: working time of all its workers until the stream ended, ns.
        wait: from a frame's arrival until a worker takes it.
        resource_wait: from then until the worker has the resource that it needs.
        work: from then until the frame is done.
        blocked: from then until it is handed on.
        age_in, age_out: of the frames that arrive, and that are done, since they were captured.
    """

    stage: Stage
    arrived: int = 0
    done: int = 0
    dropped: Counter[Drop] = field(default_factory=Counter)
    busy: float = 0.0
    wait: _Spans = field(default_factory=_Spans)
    resource_wait: _Spans = field(default_factory=_Spans)
    work: _Spans = field(default_factory=_Spans)
    blocked: _Spans = field(default_factory=_Spans)
    age_in: _Spans = field(default_factory=_Spans)
    age_out: _Spans = field(default_factory=_Spans)

    def add(self, log: StageLog, captured: Ints, end: int, ticks_per_ns: int) -> None:
        """Take in a sequence."""
        self.arrived += int((log.arrived >= 0).sum())
        self.done += int((log.finished >= 0).sum())
        reasons, counts = np.unique(log.dropped, return_counts=True)
        found = zip(reasons.tolist(), counts.tolist())
        self.dropped.update({Drop(why): count for why, count in found if why})
        worked = log.started >= 0
        spans = np.minimum(log.finished[worked], end) - np.minimum(log.started[worked], end)
        self.busy += float((spans / ticks_per_ns).sum())
        for kept, begin, until in (
            (self.wait, log.arrived, log.taken),
            (self.resource_wait, log.taken, log.started),
            (self.work, log.started, log.finished),
            (self.blocked, log.finished, log.left),
            (self.age_in, captured, log.arrived),
            (self.age_out, captured, log.finished),
        ):
            kept.add(begin, until, ticks_per_ns)


class PipelineTotals:
    """Takes in the runs of a pipeline as they are scored.

    Args:
        pipeline: which it is.
        sigmas: permitted latencies at which they are.

    Attributes:
        pipeline: which it is.
        stages: in their order.
        frames, lost: world frames, and those that the camera lost.
        delivery: from a frame's capture until it reaches the first stages.
        duration: of the streams, ns.
        outputs: answers that the pipeline published; not the initial boxes.
        overtaken: those of them that came after a newer one, and answer nothing.
    """

    def __init__(self, pipeline: Pipeline, sigmas: Sequence[Fraction]) -> None:
        self.pipeline = pipeline
        self.stages = [StageTotals(stage) for stage in pipeline.stages]
        self.frames = self.lost = self.outputs = self.overtaken = 0
        self.delivery = _Spans()
        self.duration = 0.0
        self._sigmas = tuple(sigmas)
        self._delays = np.zeros(len(self._sigmas))  # of the answers' frames, ns

    def __call__(self, scored: ScoredRun) -> None:
        """Take in a run."""
        schedule = scored.run.schedule
        if not isinstance(schedule, PipelineSchedule):
            return
        clock, ticks_per_ns = schedule.clock, schedule.clock.ticks_per_ns
        captured, end = clock.arrival(np.arange(schedule.length)), clock.end(schedule.length)
        for totals, log in zip(self.stages, schedule.stages.values()):
            totals.add(log, captured, end, ticks_per_ns)
        self.frames += schedule.length
        self.lost += int((schedule.delivered < 0).sum())
        self.delivery.add(captured, schedule.delivered, ticks_per_ns)
        self.duration += end / ticks_per_ns
        published = schedule.stages[self.pipeline.output].finished[schedule.frames][1:]
        visible = schedule.visible
        if visible is not None:
            self.outputs += int((published >= 0).sum())
            self.overtaken += int(((published > visible[1:]) & (visible[1:] < NEVER)).sum())
        delay = (schedule.delivered - captured)[schedule.frames] / ticks_per_ns
        delay[0] = 0  # the initial box is there without a camera
        for s, sigma in enumerate(self._sigmas):
            pairing = scored.pairing(sigma)
            self._delays[s] += float((pairing.end - pairing.first)[:, 0] @ delay)

    def answer_delay_ms(self, sigma: Fraction) -> float:
        """How long the camera took with the frames of the answers at a sigma, mean, ms."""
        return float(self._delays[self._sigmas.index(sigma)]) / max(self.frames, 1) / 1e6

    def report(self) -> dict[str, Any]:
        """The figures as a JSON object (described in docs/reference/json.md)."""
        pipeline = self.pipeline
        return {
            "name": pipeline.name,
            "tracker": pipeline.tracker,
            "output": pipeline.output,
            "camera": {
                "frames": self.frames,
                "lost": self.lost,
                "delay_ms": self.delivery.mean_ms,
                "delay_max_ms": self.delivery.max_ms,
            },
            "resources": [
                {
                    "resource": name,
                    "capacity": capacity,
                    "utilisation": self._share(
                        sum(each.busy for each in self.stages if each.stage.resource == name),
                        capacity,
                    ),
                }
                for name, capacity in pipeline.resources.items()
            ],
            "stages": [self._stage(each) for each in self.stages],
            "outputs": self.outputs,
            "overtaken": self.overtaken,
        }

    def _share(self, busy: float, workers: int) -> float:
        return busy / (self.duration * workers) if self.duration else 0.0

    def _stage(self, totals: StageTotals) -> dict[str, Any]:
        stage = totals.stage
        return {
            "stage": stage.name,
            "after": stage.after or CAMERA,
            "workers": stage.workers,
            "queue": stage.queue,
            "when_full": stage.when_full,
            "resource": stage.resource,
            "arrived": totals.arrived,
            "done": totals.done,
            "dropped": {WHY[why]: count for why, count in sorted(totals.dropped.items())},
            "utilisation": self._share(totals.busy, stage.workers),
            "wait_ms": totals.wait.mean_ms,
            "resource_wait_ms": totals.resource_wait.mean_ms,
            "work_ms": totals.work.mean_ms,
            "blocked_ms": totals.blocked.mean_ms,
            "age_in_ms": totals.age_in.mean_ms,
            "age_out_ms": totals.age_out.mean_ms,
            "age_out_max_ms": totals.age_out.max_ms,
        }
