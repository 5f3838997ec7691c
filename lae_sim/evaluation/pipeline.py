"""What happened in a pipeline: how old frames are at each stage, where they wait, and are lost.

What a stage can do is named by its *load*, the traffic intensity of queueing theory: the work that
comes, over the time that its workers have. Above 1 it cannot keep up, whatever its queue.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from operator import itemgetter
from typing import Any, TypeVar

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.engine.clock import parse_duration
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

_REFUSED = (Drop.NOT_ITS_TURN, Drop.OVERTAKEN, Drop.TOO_EARLY)
_FULL = 1 + 1e-9  # a load above it is more than can be done; less is the rounding of a sum


Row = TypeVar("Row")


def shared_out(spans: Iterable[tuple[int, float, Row]]) -> Iterator[tuple[int, Row]]:
    """Spans of time, each with the first of several places that is free as it begins.

    Workers of a stage are alike: so frames are shared out among them, from when a worker takes one
    until it is free again. There are no more places than workers.

    Args:
        spans: begin, end, and what it is, in any order.
    """
    free_from: list[float] = []
    for begin, end, row in sorted(spans, key=itemgetter(0, 1)):
        place = next((p for p, tick in enumerate(free_from) if tick <= begin), len(free_from))
        free_from[place : place + 1] = [end]
        yield place, row


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
    def mean_ns(self) -> float:
        """Their mean, ns; 0 of none."""
        return self.total / self.count if self.count else 0.0

    @property
    def mean_ms(self) -> float | None:
        """Their mean, ms; None of none."""
        return self.total / self.count / 1e6 if self.count else None

    @property
    def max_ms(self) -> float | None:
        """The longest, ms; None of none."""
        return self.most / 1e6 if self.count else None


@dataclass
class _Step:
    """A part of the way of the answers that were published.

    Attributes:
        spans: how long it took, and how old the frames were when it was over.
        taken, ages: each of these times, float32, ns.
    """

    spans: tuple[_Spans, _Spans] = field(default_factory=lambda: (_Spans(), _Spans()))
    taken: list[Floats] = field(default_factory=list)
    ages: list[Floats] = field(default_factory=list)

    def add(self, captured: Ints, begin: Ints, end: Ints, ticks_per_ns: int) -> None:
        """Take in the answers of a sequence: instants, ticks."""
        for spans, kept, since in zip(self.spans, (self.taken, self.ages), (begin, captured)):
            spans.add(since, end, ticks_per_ns)
            kept.append(((end - since) / ticks_per_ns).astype(np.float32))

    def report(self) -> dict[str, float | None]:
        """Means, and what 95 % of the answers stay within, ms; None of no answers."""
        return {
            "mean_ms": self.spans[0].mean_ms,
            "p95_ms": _p95_ms(self.taken),
            "capture_age_ms": self.spans[1].mean_ms,
            "capture_age_p95_ms": _p95_ms(self.ages),
        }


def _ms(value: float | None) -> str:
    return "no time" if value is None else f"{value:.1f} ms"


def _p95_ms(parts: Sequence[Floats]) -> float | None:
    values = np.concatenate(parts) if parts else np.empty(0, np.float32)
    return float(np.quantile(values, 0.95, method="inverted_cdf")) / 1e6 if len(values) else None


@dataclass
class StageTotals:
    """What happened at one stage in some sequences.

    Attributes:
        stage: which it is.
        arrived, done: frames that came, and that it finished.
        dropped: how many it dropped, by why.
        due: how many of the frames that came it was to work on.
        steady: the time of the work on these, initialisations aside.
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
    due: int = 0
    steady: _Spans = field(default_factory=_Spans)
    busy: float = 0.0
    wait: _Spans = field(default_factory=_Spans)
    resource_wait: _Spans = field(default_factory=_Spans)
    work: _Spans = field(default_factory=_Spans)
    blocked: _Spans = field(default_factory=_Spans)
    age_in: _Spans = field(default_factory=_Spans)
    age_out: _Spans = field(default_factory=_Spans)

    @property
    def lost(self) -> int:
        """Frames that it could not take in time."""
        return self.dropped[Drop.FULL] + self.dropped[Drop.END]

    @property
    def asked(self) -> float:
        """Work on all frames that it was to work on, as if none were an initialisation, ns."""
        return self.steady.mean_ns * self.due

    def add(self, log: StageLog, captured: Ints, end: int, ticks_per_ns: int) -> None:
        """Take in a sequence."""
        self.arrived += int((log.arrived >= 0).sum())
        self.done += int((log.finished >= 0).sum())
        reasons, counts = np.unique(log.dropped, return_counts=True)
        found = zip(reasons.tolist(), counts.tolist())
        self.dropped.update({Drop(why): count for why, count in found if why})
        self.due += int(((log.arrived >= 0) & ~np.isin(log.dropped, _REFUSED)).sum())
        self.steady.add(log.started[1:], log.finished[1:], ticks_per_ns)
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


@dataclass(frozen=True)
class Bottleneck:
    """What keeps the first frames that are lost, or wait ever longer, from getting on.

    Attributes:
        kind: ``"stage"`` or ``"resource"`` if it is too slow; ``"bursts"`` of a stage that keeps
            up on average, but not when several frames come close to each other.
        name: of the stage, or the resource.
        load: work that comes over what it can do.
        text: a sentence of it.
    """

    kind: str
    name: str
    load: float
    text: str


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
        self._exposure_ns = parse_duration(pipeline.camera.exposure)
        self._steps: dict[tuple[str, str], _Step] = {}
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
        answers = schedule.frames[1:][published >= 0]
        for step, begin, until in self._way(schedule, captured):
            kept = self._steps.setdefault(step, _Step())
            kept.add(captured[answers], begin[answers], until[answers], ticks_per_ns)
        visible = schedule.visible
        if visible is not None:
            self.outputs += int((published >= 0).sum())
            self.overtaken += int(((published > visible[1:]) & (visible[1:] < NEVER)).sum())
        delay = (schedule.delivered - captured)[schedule.frames] / ticks_per_ns
        delay[0] = 0  # the initial box is there without a camera
        for s, sigma in enumerate(self._sigmas):
            pairing = scored.pairing(sigma)
            self._delays[s] += float((pairing.end - pairing.first)[:, 0] @ delay)

    def _way(
        self, schedule: PipelineSchedule, captured: Ints
    ) -> Iterator[tuple[tuple[str, str], Ints, Ints]]:
        """The parts of an answer's way, one after another: of which stage, from when until when."""
        exposed = captured + self._exposure_ns * schedule.clock.ticks_per_ns
        yield (CAMERA, "exposure"), captured, exposed
        yield (CAMERA, "delivery"), exposed, schedule.delivered
        way = self.pipeline.way
        for stage, following in zip(way, (*way[1:], None)):
            log = schedule.stages[stage.name]
            yield (stage.name, "queue"), log.arrived, log.taken
            if stage.resource is not None:
                yield (stage.name, "resource"), log.taken, log.started
            yield (stage.name, "work"), log.started, log.finished
            if following is not None and following.when_full == "block":
                entered = schedule.stages[following.name].arrived
                yield (stage.name, "blocked"), log.finished, entered

    def answer_delay_ms(self, sigma: Fraction) -> float:
        """How long the camera took with the frames of the answers at a sigma, mean, ms."""
        return float(self._delays[self._sigmas.index(sigma)]) / max(self.frames, 1) / 1e6

    def report(self) -> dict[str, Any]:
        """The figures as a JSON object (described in docs/reference/json.md)."""
        pipeline, bottleneck = self.pipeline, self.bottleneck()
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
                    "load": self._resource_load(name),
                    "utilisation": self._share(
                        sum(each.busy for each in self._sharing(name)), capacity
                    ),
                }
                for name, capacity in pipeline.resources.items()
            ],
            "stages": [self._stage(each) for each in self.stages],
            "waterfall": [
                {"stage": stage, "part": part, **step.report()}
                for (stage, part), step in self._steps.items()
            ],
            "bottleneck": bottleneck and asdict(bottleneck),
            "outputs": self.outputs,
            "overtaken": self.overtaken,
        }

    def bottleneck(self) -> Bottleneck | None:
        """The first stage that is too slow, or what keeps it; None where all keep up."""
        for totals in self.stages:
            resource = totals.stage.resource
            if self._load(totals) > _FULL:
                return self._slow_stage(totals)
            if resource is not None and self._resource_load(resource) > _FULL:
                return self._slow_resource(resource)
            if totals.dropped[Drop.FULL]:
                return self._cause(totals)
        return None

    def _cause(self, totals: StageTotals) -> Bottleneck:
        """What keeps a stage that could do its own work."""
        stage, work = totals.stage, totals.work.total
        blocked, waits = totals.blocked.total, totals.resource_wait.total
        if blocked > max(work, waits):
            after = [each for each in self.stages if each.stage.after == stage.name]
            slow = max(after, key=lambda each: (each.stage.when_full == "block", self._load(each)))
            if slow.blocked.total > slow.work.total:
                return self._cause(slow)
            if slow.stage.resource is None or slow.resource_wait.total < slow.work.total:
                return self._slow_stage(slow)
            return self._slow_resource(slow.stage.resource)
        if stage.resource is not None and waits > work:
            return self._slow_resource(stage.resource)
        text = (
            f"{stage.name} loses {totals.lost:,} of {totals.arrived:,} frames, though they are "
            f"{self._load(totals):.0%} of what it can do: they come close to each other, or some "
            f"take long ({_ms(totals.work.mean_ms)} on average, {_ms(totals.work.max_ms)} at most)"
        )
        return Bottleneck("bursts", stage.name, self._load(totals), text)

    def _slow_stage(self, totals: StageTotals) -> Bottleneck:
        stage, load = totals.stage, self._load(totals)
        workers = f", {stage.workers} at once" if stage.workers > 1 else ""
        text = (
            f"{stage.name} is too slow: a frame takes it {_ms(totals.steady.mean_ms)}{workers}, "
            f"and one comes every {_ms(self.duration / totals.due / 1e6)}: {load:.0%} of what it "
            f"can do; {totals.lost:,} of {totals.arrived:,} are lost"
        )
        return Bottleneck("stage", stage.name, load, text)

    def _slow_resource(self, resource: str) -> Bottleneck:
        sharing, load = self._sharing(resource), self._resource_load(resource)
        takes = [f"{each.stage.name} for {_ms(each.steady.mean_ms)}" for each in sharing]
        lost = sum(each.lost for each in sharing)
        text = (
            f"{resource} is too slow: each frame needs it, {' and '.join(takes)}: {load:.0%} of "
            f"what it can do; {lost:,} frames are lost"
        )
        return Bottleneck("resource", resource, load, text)

    def _sharing(self, resource: str) -> list[StageTotals]:
        return [each for each in self.stages if each.stage.resource == resource]

    def _lost_before(self, totals: StageTotals, resource: str) -> float:
        """Frames that a stage was to work on, lost where the same resource is needed before it."""
        by_name = {each.stage.name: each for each in self.stages}
        lost, before = 0, by_name.get(totals.stage.after or CAMERA)
        while before is not None:
            lost += before.lost if before.stage.resource == resource else 0
            before = by_name.get(before.stage.after or CAMERA)
        return lost / totals.stage.every

    def _load(self, totals: StageTotals) -> float:
        return self._share(totals.asked, totals.stage.workers)

    def _resource_load(self, resource: str) -> float:
        """What is asked of a resource, too of frames that were lost as it was not there in time."""
        asked = sum(
            each.asked + each.steady.mean_ns * self._lost_before(each, resource)
            for each in self._sharing(resource)
        )
        return self._share(asked, self.pipeline.resources[resource])

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
            "load": self._load(totals),
            "utilisation": self._share(totals.busy, stage.workers),
            "wait_ms": totals.wait.mean_ms,
            "resource_wait_ms": totals.resource_wait.mean_ms,
            "work_ms": totals.work.mean_ms,
            "blocked_ms": totals.blocked.mean_ms,
            "age_in_ms": totals.age_in.mean_ms,
            "age_out_ms": totals.age_out.mean_ms,
            "age_out_max_ms": totals.age_out.max_ms,
        }
