"""The questions of docs/howto/pipeline-questions.md, worked out by hand.

The pipelines are those of the page; sequences are long, so that how they begin hardly counts.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from itertools import count
from typing import Any

import numpy as np
import pytest
from places import REPOSITORY
from witness import moving

import lae_sim
from lae_sim.engine.pipeline import Pipeline
from lae_sim.engine.stages import Drop, PipelineSchedule
from lae_sim.replay.pipeline import parse_pipeline
from lae_sim.trace.file import Trace

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PAGE = (REPOSITORY / "docs" / "howto" / "pipeline-questions.md").read_text("utf-8")
PIPELINES = {
    name: parse_pipeline(tomllib.loads(text), name)
    for name, text in re.findall(r'```toml title="([\w-]+)\.toml"\n(.*?)```', PAGE, re.DOTALL)
}
FRAMES = 3000
INTERVAL = 100 / 3  # ms


def replayed(pipeline: Pipeline, latency: str, fps: int = 30) -> PipelineSchedule:
    trace = Trace(lae_sim.Metadata.new(str(fps), "every-frame"), [moving(FRAMES)])
    (run,) = lae_sim.replay_trace(trace, latency=latency, pipeline=pipeline)
    assert isinstance(run.schedule, PipelineSchedule)
    return run.schedule


def ages_ms(schedule: PipelineSchedule, stage: str = "tracker") -> np.ndarray:
    """Of the frames that a stage finishes in the second half, from their capture on."""
    log = schedule.stages[stage]
    done = np.flatnonzero(log.finished >= 0)
    done = done[done >= FRAMES // 2]
    captured = schedule.clock.arrival(done)
    return (log.finished[done] - captured) / schedule.clock.ticks_per_ns / 1e6


def lost_share(schedule: PipelineSchedule, stage: str = "tracker") -> float:
    dropped = schedule.stages[stage].dropped[FRAMES // 2 :]
    return float((dropped == Drop.FULL).mean())


def bottleneck(pipeline: Pipeline, latency: str) -> dict[str, Any] | None:
    trace = Trace(lae_sim.Metadata.new("30", "every-frame"), [moving(FRAMES)])
    result = lae_sim.evaluate(trace, latency=latency, pipeline=pipeline, search="off")
    found: dict[str, Any] | None = result.document()["traces"][0]["pipeline"]["bottleneck"]
    return found


@pytest.mark.parametrize(("name", "queue"), [("queue-1", 1), ("queue-10", 10)])
def test_a_queue_of_ten_against_one(name: str, queue: int) -> None:
    schedule = replayed(PIPELINES[name], "constant:47ms")
    ages = ages_ms(schedule)
    assert ages.max() <= 47 * (queue + 1) + 1e-9  # a frame that arrives as another is taken
    assert ages.min() >= 47 * (queue + 1) - INTERVAL
    assert ages.mean() == pytest.approx(47 * (queue + 1) - INTERVAL / 2, abs=0.3)
    assert lost_share(schedule) == pytest.approx(1 - INTERVAL / 47, abs=0.005)
    slow = bottleneck(PIPELINES[name], "constant:47ms")
    assert slow is not None
    assert (slow["kind"], slow["name"]) == ("stage", "tracker")
    assert slow["load"] == pytest.approx(47 / INTERVAL, abs=1e-3)


def test_a_60_fps_camera_with_8_ms_of_jitter() -> None:
    even = ages_ms(replayed(PIPELINES["even"], "constant:14ms", 60))
    assert even == pytest.approx(14)
    schedule = replayed(PIPELINES["jitter"], "constant:14ms", 60)
    log = schedule.stages["tracker"]
    assert not log.dropped.any()  # the frame after next never comes before one is done
    captured = schedule.clock.arrival(np.arange(FRAMES)) / schedule.clock.ticks_per_ns / 1e6
    delivered = schedule.delivered / schedule.clock.ticks_per_ns / 1e6
    jitter = delivered - captured
    assert (jitter >= 0).all()
    assert (jitter < 8).all()
    assert jitter.mean() == pytest.approx(4, abs=0.15)
    # each frame is begun as it comes, or as the one before it is done
    done = [14 + delivered[0]]
    for arrival in delivered[1:]:
        done.append(max(arrival, done[-1]) + 14)
    finished = log.finished / schedule.clock.ticks_per_ns / 1e6
    assert finished == pytest.approx(np.array(done))
    assert (finished - captured < 8 + 14).all()
    # an answer that is not done by the next frame answers for the one after it only
    late = (finished - captured) > 1000 / 60
    assert late.mean() >= 2 / 3
    trace = Trace(lae_sim.Metadata.new("60", "every-frame"), [moving(FRAMES)])
    asked = {"latency": "constant:14ms", "pipeline": PIPELINES["jitter"], "search": "off"}
    (document,) = lae_sim.evaluate(trace, **asked).document()["traces"]
    expected = 1000 / 60 * (1 + late.mean())
    assert document["results"][0]["capture_age_ms"] == pytest.approx(expected, abs=0.05)


def test_decoding_on_the_core_of_the_tracker() -> None:
    assert ages_ms(replayed(PIPELINES["two-cores"], "constant:25ms")) == pytest.approx(12 + 25)
    assert bottleneck(PIPELINES["two-cores"], "constant:25ms") is None
    schedule = replayed(PIPELINES["one-core"], "constant:25ms")
    ages = ages_ms(schedule)
    # a frame from the queue, 0 to 33.3 ms old, waits for a call, is decoded, and is tracked
    assert ages.min() >= 25 + 12 + 25
    assert ages.max() <= 25 + 12 + 25 + INTERVAL
    assert ages.mean() == pytest.approx(25 + 12 + 25 + INTERVAL / 2, abs=0.5)
    assert lost_share(schedule, "decode") == pytest.approx(1 - INTERVAL / 37, abs=0.005)
    slow = bottleneck(PIPELINES["one-core"], "constant:25ms")
    assert slow is not None
    assert (slow["kind"], slow["name"]) == ("resource", "core")
    assert slow["load"] == pytest.approx(37 / INTERVAL, abs=1e-3)


def phases() -> Iterator[float]:
    """How old the newest frame is, every 40 ms."""
    return (40 * n % INTERVAL for n in count())


def test_two_trackers_on_one_gpu() -> None:
    alone = replayed(PIPELINES["two-gpus"], "constant:20ms")
    assert ages_ms(alone) == pytest.approx(20)
    assert not alone.stages["second"].dropped.any()

    alike = replayed(PIPELINES["alike"], "constant:20ms")
    ages = [age + 20 + 20 for age, _ in zip(phases(), range(5))]  # taken, the other's call, its own
    for stage in ("tracker", "second"):
        found = sorted(set(ages_ms(alike, stage).round(6).tolist()))
        assert found == pytest.approx(sorted(ages))
        assert ages_ms(alike, stage).mean() == pytest.approx(160 / 3, abs=0.05)
        assert lost_share(alike, stage) == pytest.approx(1 / 6, abs=1e-3)

    first = replayed(PIPELINES["first"], "constant:20ms")
    waits = sorted(set((ages_ms(first) - 20).round(6).tolist()))
    assert waits == pytest.approx([0, 20 / 3, 40 / 3])
    assert ages_ms(first).mean() == pytest.approx(20 + 20 / 3, abs=0.01)
    assert lost_share(first) == 0
    assert lost_share(first, "second") == pytest.approx(1 / 3, abs=1e-3)

    slow = bottleneck(PIPELINES["alike"], "constant:20ms")
    assert slow is not None
    assert (slow["kind"], slow["name"]) == ("resource", "gpu")
    assert slow["load"] == pytest.approx(40 / INTERVAL, abs=1e-3)
