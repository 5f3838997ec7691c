"""Pipelines in a replay: files, times of stages, and worlds that have one."""

from __future__ import annotations

import sys
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import TRACES
from witness import moving

from lae_sim.engine.clock import Clock
from lae_sim.engine.pipeline import Camera, Pipeline, Stage
from lae_sim.engine.stages import PipelineSchedule
from lae_sim.errors import LaeError
from lae_sim.replay.latency import bootstrap, constant
from lae_sim.replay.pipeline import (
    PipelineTimes,
    parse_drops,
    parse_pipeline,
    parse_time,
    read_pipeline,
)
from lae_sim.replay.run import Runs, replay_repeated
from lae_sim.replay.world import World, replay_trace
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

CLOCK = Clock.at(Fraction(25))
MS = 1_000_000
ONE = Pipeline([Stage("tracker")])
TWO = Pipeline([Stage("decode"), Stage("tracker")])


def staged(length: int = 40) -> Recording:
    decode = np.arange(length) * 1_000 + 5 * MS
    return replace(moving(length), stages={"decode": decode})


def trace_of(*recordings: Recording) -> Trace:
    return Trace(Metadata.new("25", "every-frame"), list(recordings))


def run(pipeline: Pipeline, recording: Recording, scale: int = 1) -> PipelineSchedule:
    times = PipelineTimes.of(pipeline, Fraction(scale))
    return times.schedule(recording, CLOCK, constant("47ms")(recording))


def took_ms(schedule: PipelineSchedule, stage: str) -> np.ndarray:
    log = schedule.stages[stage]
    done = log.finished >= 0
    return (log.finished[done] - log.started[done]) / CLOCK.ticks_per_ns / MS


def test_a_file(tmp_path: Path) -> None:
    path = tmp_path / "drone.toml"
    path.write_text(
        """
        [camera]
        exposure = "4ms"
        delivery = "3ms"
        jitter = "uniform:0ms-8ms:1"
        drops = [7, 8]
        [resources]
        gpu = 1
        [[stages]]
        name = "decode"
        time = "6ms"
        queue = "unbounded"
        [[stages]]
        name = "tracker"
        resource = "gpu"
        priority = -1
        when_full = "block"
        [[stages]]
        name = "beside"
        time = "uniform:1ms-1.5ms:3"
        after = "camera"
        resource = "gpu"
        workers = 2
        every = 2
        """
    )
    assert read_pipeline(path) == Pipeline(
        [
            Stage("decode", "6ms", queue=None),
            Stage("tracker", resource="gpu", priority=-1, when_full="block"),
            Stage(
                "beside",
                "uniform:1ms-1.5ms:3",
                after="camera",
                resource="gpu",
                workers=2,
                every=2,
            ),
        ],
        Camera("4ms", "3ms", "uniform:0ms-8ms:1", (7, 8)),
        {"gpu": 1},
        name="drone",
    )


def test_the_sample_is_one() -> None:
    assert read_pipeline(TRACES / "pipeline.toml").output == "publish"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "stages: a pipeline has at least one"),
        ("stages = 3", "stages: a pipeline has at least one"),
        ("stages = [3]", "stages: number 1: a table"),
        ("stages = [{time = '6ms'}]", "stages: number 1: name: it is missing"),
        (
            "stages = [{name = 'decode', que = 3}]",
            "'decode': unknown key 'que'; did you mean 'queue",
        ),
        ("stages = [{name = 'tracker', queue = 0}]", "stage 'tracker': queue: 0 is not"),
        ("stages = [{name = 'tracker', queue = inf}]", "stage 'tracker': queue: 'inf' is not"),
        ("stages = [{name = 'tracker', time = inf}]", "stage 'tracker': time: no latency 'inf'"),
        ("stages = [{name = 'tracker', time = 'inf'}]", "stage 'tracker': time: no latency 'inf'"),
        (
            "stages = [{name = 'tracker', time = '-1ms'}]",
            "stage 'tracker': time: no latency '-1ms'",
        ),
        ("stages = [{name = 'tracker', time = '6m'}]", "stage 'tracker': time: no latency '6m'"),
        ("stages = [{name = 'tracker', time = 'uniform:8ms'}]", "'tracker': time: .*LOW-HIGH:SEED"),
        (
            "stages = [{name = 'tracker', time = 'uniform:9ms-8ms:1'}]",
            "stage 'tracker': time: a range of times goes from the lower",
        ),
        ("stages = [{name = 'tracker'}, {name = 'tracker'}]", "stage 'tracker': name: two"),
        ("stages = [{name = 'tracker', after = 'tracker'}]", "stage 'tracker': after: a loop"),
        ("stages = [{name = 'tracker', resource = 'gpu'}]", "stage 'tracker': resource: no 'gpu'"),
        ("resources = 3\nstages = [{name = 'tracker'}]", "resources: whole numbers by name"),
        ("camera = {delay = '3ms'}\nstages = [{name = 'tracker'}]", "camera: unknown key 'delay'"),
        ("camera = {jitter = 'recorded'}\nstages = [{name = 'tracker'}]", "camera: jitter: 'reco"),
        (
            "camera = {drops = 'some'}\nstages = [{name = 'tracker'}]",
            "camera: drops: 'some': write",
        ),
        (
            f"stages = [{{name = 'tracker', time = 'uniform:0ms-8ms:{'9' * 5000}'}}]",
            "stage 'tracker': time: SEED: .* is not a whole number",
        ),
        (
            f"camera = {{drops = 'share:0.5:{'9' * 5000}'}}\nstages = [{{name = 'tracker'}}]",
            "camera: drops: SEED: .* is not a whole number",
        ),
        ("camera = {drops = [-1]}\nstages = [{name = 'tracker'}]", "camera: drops: -1 is not"),
        ("stage = 3", "pipeline: unknown key 'stage'; did you mean 'stages'"),
        ("stages = ", "Invalid value"),
    ],
)
def test_bad_files_are_named_with_the_stage_and_the_key(
    text: str, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "drone.toml"
    path.write_text(text)
    with pytest.raises(LaeError, match=says) as caught:
        read_pipeline(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).count("\n") < 2


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=4,
)
WORDS = st.sampled_from(
    ["tracker", "decode", "camera", "gpu", "block", "6ms", "uniform:1ms-2ms:1", "share:1/2:3"]
    + ["every:9", "stage:decode", "recorded,init=1ms", ":", "os:path", "-1ms", "9" * 5000 + "ms"]
)


def tables(kind: type) -> st.SearchStrategy[Any]:
    """Tables of a record's keys, with whatever values."""
    values = {each.name: ANYTHING | WORDS for each in fields(kind)}
    return st.fixed_dictionaries({}, optional=values)


@settings(max_examples=60)
@given(
    tables(Pipeline),
    st.lists(tables(Stage), max_size=3),
    tables(Camera) | ANYTHING,
    st.dictionaries(WORDS, st.integers(0, 2)) | ANYTHING,
)
def test_any_document_is_a_pipeline_or_refused(
    document: dict[str, Any], stages: list[Any], camera: Any, resources: Any
) -> None:
    first = {"name": "tracker", "after": "camera"}
    document = {**document, "stages": [first, *stages], "camera": camera, "resources": resources}
    document["tracker"] = "tracker"
    try:
        pipeline = parse_pipeline(document)
    except LaeError:
        return
    assert parse_pipeline(document) == pipeline
    World.of(pipeline=pipeline)


@pytest.mark.parametrize("time", ["6ms", "uniform:6ms-6ms:1", "constant:6ms", "stage:decode"])
def test_every_time_may_tell_the_initialisation_apart(time: str) -> None:
    recording = replace(moving(5), stages={"decode": np.full(5, 6 * MS)})
    pipeline = Pipeline([Stage("decode", f"{time},init=90ms")], tracker="decode")
    (run,) = replay_trace(trace_of(recording), pipeline=pipeline)
    assert took_ms(run.schedule, "decode").tolist()[:3] == [90, 6, 6]
    before = Pipeline([Stage("decode", f"{time},init=90ms"), Stage("tracker", "1ms")])
    (run,) = replay_trace(trace_of(recording), pipeline=before)
    assert took_ms(run.schedule, "decode").tolist()[:3] == [90, 6, 6]
    assert World.of(pipeline=pipeline).label().endswith(",init=90ms")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(LaeError, match="no such file"):
        read_pipeline(tmp_path / "drone.toml")
    with pytest.raises(LaeError, match="read from a TOML file, not 3"):
        read_pipeline(3)  # type: ignore[arg-type]


def test_a_stage_takes_what_was_recorded_for_it() -> None:
    recording = staged()
    done = run(TWO, recording).stages["decode"].finished >= 0
    expected = recording.stages["decode"][done] / MS
    assert took_ms(run(TWO, recording), "decode").tolist() == expected.tolist()


def test_what_is_recorded_of_other_stages_is_no_part_of_the_tracker_s_time() -> None:
    recording = staged(6)
    whole = recording.elapsed_ns
    for pipeline, parts in [
        (TWO, ["decode"]),
        (Pipeline([Stage("decode", "1ms"), Stage("tracker")]), ["decode"]),
        (Pipeline([Stage("read", "stage:decode,init=9ms"), Stage("tracker")]), ["decode"]),
        (Pipeline([Stage("read", "1ms"), Stage("tracker")]), []),
        (Pipeline([Stage("tracker")]), []),
    ]:
        for latency in ("recorded", "resample:1"):
            runs = replay_trace(trace_of(recording), pipeline=pipeline, latency=latency)
            (found,) = runs
            left = whole - sum(recording.stages[part] for part in parts)
            schedule = found.schedule
            took = (schedule.ready - schedule.start) // schedule.clock.ticks_per_ns
            if latency == "recorded":
                assert took.tolist() == left[schedule.frames].tolist()
            else:
                assert set(took.tolist()) <= set(left.tolist())
    unknown = replace(recording, stages={"decode": np.full(6, -1)})
    assert PipelineTimes.of(TWO).of_tracker(unknown).elapsed_ns.tolist() == whole.tolist()


@pytest.mark.parametrize("time", ["recorded", "by-call", "bootstrap:1", "lognormal:1"])
def test_other_latencies_draw_on_the_stage_s_own_times(time: str) -> None:
    took = took_ms(run(Pipeline([Stage("decode", time), Stage("tracker")]), staged()), "decode")
    assert (took < 6).all()
    assert (took > 4.5).all()


def test_times_are_scaled_but_not_the_camera() -> None:
    camera = Camera(delivery="3ms", jitter="2ms")
    pipeline = Pipeline([Stage("decode", "6ms"), Stage("tracker")], camera)
    schedule = run(pipeline, moving(5), scale=2)
    assert set(took_ms(schedule, "decode").tolist()) == {12.0}
    assert (schedule.delivered / CLOCK.ticks_per_ns / MS).tolist() == [5, 45, 85, 125, 165]


def test_a_trace_without_the_stage_s_times_says_what_to_do() -> None:
    decode = Stage("decode", "stage:read+scale")
    for stages, name in ((TWO.stages, "decode"), ([decode, Stage("tracker")], "read")):
        says = f"sequence 'a': the trace has no times of stage '{name}': give .* 'decode' a time"
        with pytest.raises(LaeError, match=says):
            run(Pipeline(stages), moving(5))


def test_streams_differ_from_stage_to_stage_and_from_sequence_to_sequence() -> None:
    time = "uniform:1ms-9ms:1"
    pipeline = Pipeline(
        [Stage("first", time), Stage("second", time), Stage("tracker")], Camera(jitter=time)
    )

    def drawn(recording: Recording) -> list[list[float]]:
        schedule = run(pipeline, recording)
        return [took_ms(schedule, stage)[:9].tolist() for stage in ("first", "second")]

    a, b = drawn(moving(20)), drawn(moving(20, name="b"))
    assert a == drawn(moving(20))
    assert len({tuple(each) for each in (*a, *b)}) == 4
    times = parse_time(time)(moving(1000)).ns  # type: ignore[attr-defined]
    assert 1 * MS <= times.min() < 1.1 * MS
    assert 8.9 * MS < times.max() <= 9 * MS


def test_frames_that_a_camera_loses() -> None:
    recording = moving(1000)
    assert parse_drops([3, 7])(recording) == {3, 7}
    assert sorted(parse_drops("every:10")(recording))[:2] == [9, 19]
    lost = parse_drops("share:0.05:1")(recording)
    assert 30 < len(lost) < 70
    assert lost == parse_drops("share:1/20:1")(recording)
    assert lost != parse_drops("share:0.05:2")(recording)
    assert parse_drops("share:0:2")(recording) == set()
    for drops in ("share:1:2", "share:0.5", "every:1", "every:x"):
        with pytest.raises(LaeError, match="drops"):
            parse_drops(drops)


def test_the_world_s_latency_is_the_tracker_s() -> None:
    assert World.of(pipeline=ONE).label() == "recorded"
    own = Pipeline([Stage("tracker", "47ms")], name="own")
    world = World.of(pipeline=own)
    assert (world.label(), world.times_kind) == ("constant:47ms", "constant")
    assert replace(world, sigmas=(Fraction(1),)).label() == "constant:47ms"
    assert world.policy_label == "pipeline:own"
    assert World.of(pipeline=own, latency="constant:47ms") == world
    with pytest.raises(
        LaeError, match="latency: constant:3ms, and the pipeline says constant:47ms"
    ):
        World.of(pipeline=own, latency="constant:3ms")
    with pytest.raises(LaeError, match="policy: fifo does not go with a pipeline"):
        World.of(pipeline=own, policy="fifo")
    with pytest.raises(LaeError, match="pipeline: a Pipeline, or the path"):
        World.of(pipeline=3)  # type: ignore[arg-type]


def test_a_sweep_crosses_pipelines() -> None:
    other = Pipeline([Stage("tracker", queue=10)], name="ten")
    worlds = World.sweep(pipeline=[ONE, other, ONE], scale=[1, 2])
    assert [(world.policy_label, world.scale) for world in worlds] == [
        ("pipeline:pipeline", 1),
        ("pipeline:pipeline", 2),
        ("pipeline:ten", 1),
        ("pipeline:ten", 2),
    ]
    with pytest.raises(LaeError, match="pipeline: two are called 'pipeline'"):
        World.sweep(pipeline=[ONE, TWO])


@pytest.mark.parametrize(
    ("stage", "policy"),
    [
        (Stage("tracker"), "latest"),
        (Stage("tracker", queue=None), "fifo"),
        (Stage("tracker", queue=None, every=2), "every:2"),
    ],
)
@pytest.mark.parametrize("latency", ["recorded", "bootstrap:3", "constant:70ms,init=300ms"])
def test_one_stage_is_the_policy(stage: Stage, policy: str, latency: str) -> None:
    evenly = moving(60)
    arrivals = np.cumsum(np.random.default_rng(1).integers(1, 80 * MS, 60))
    trace = trace_of(evenly, replace(moving(60, 3, "b"), arrival_ns=arrivals - arrivals[0]))
    piped = replay_trace(trace, latency=latency, pipeline=Pipeline([stage]))
    for found, expected in zip(piped, replay_trace(trace, latency=latency, policy=policy)):
        for what in ("frames", "start", "ready"):
            assert getattr(found.schedule, what).tolist() == (
                getattr(expected.schedule, what).tolist()
            )
        assert found.departures == expected.departures
        assert np.array_equal(found.boxes, expected.boxes)
        assert isinstance(found.schedule, PipelineSchedule)


def test_repetitions_draw_every_stage_anew() -> None:
    pipeline = Pipeline([Stage("decode", "bootstrap:1:1"), Stage("tracker")])
    runs = Runs(trace_of(staged()), CLOCK, bootstrap(1), pipeline=PipelineTimes.of(pipeline))
    schedules = [run.schedule for _, run in replay_repeated(runs, 2)]
    decode = [took_ms(each, "decode").tolist() for each in schedules]  # type: ignore[arg-type]
    assert decode[0] != decode[1]
    alone = [run.schedule for _, run in replay_repeated(runs, 1, first=1)]
    assert took_ms(alone[0], "decode").tolist() == decode[1]  # type: ignore[arg-type]


def test_times_of_one_s_own_are_functions() -> None:
    pipeline = Pipeline([Stage("decode", lambda recording: lambda frame: 7 * MS), Stage("tracker")])
    assert set(took_ms(run(pipeline, moving(5)), "decode").tolist()) == {7.0}
    wrong = Pipeline([Stage("decode", lambda recording: lambda frame: -1), Stage("tracker")])
    with pytest.raises(LaeError, match=r"sequence 'a': stage 'decode', frame 0: .* negative"):
        list(replay_trace(trace_of(moving(5)), pipeline=wrong))
    endless = Pipeline(
        [Stage("decode", lambda recording: lambda frame: float("inf")), Stage("tracker")]
    )
    with pytest.raises(LaeError, match="sequence 'a': stage 'decode', frame 0: TypeError"):
        list(replay_trace(trace_of(moving(5)), pipeline=endless))
    with pytest.raises(LaeError, match="stage 'decode': time: 3 is no time"):
        World.of(pipeline=Pipeline([Stage("decode", 3), Stage("tracker")]))  # type: ignore[arg-type]


def test_plug_ins_are_made_once(tmp_path: Path) -> None:
    (tmp_path / "made_once.py").write_text(
        "made = []\n\nclass Mine:\n    def __init__(self, ms, more=0):\n"
        "        self.ns = (ms + more) * 1_000_000\n        made.append(ms)\n\n"
        "    def __call__(self, recording):\n        return lambda frame: self.ns\n"
    )
    (tmp_path / "drone.toml").write_text(
        "camera = {jitter = 'made_once:Mine:ms=3'}\n"
        "stages = [{name = 'decode', time = 'made_once:Mine:ms=6,more=1'},"
        " {name = 'tracker', time = 'made_once:Mine:ms=40,init=90ms'}]\n"
    )
    trace = trace_of(moving(6))
    worlds = World.sweep(pipeline=tmp_path / "drone.toml", scale=[1, 2])
    (run,), (other,) = (world.replay(trace) for world in worlds)
    assert sorted(sys.modules["made_once"].made) == [3, 6, 40]
    assert took_ms(run.schedule, "decode").tolist()[:2] == [7, 7]
    assert took_ms(other.schedule, "tracker").tolist()[:2] == [180, 80]
    assert worlds[0].label() == "made_once:Mine:ms=40,init=90ms"


def test_a_document_has_a_name_of_its_own() -> None:
    document = {"name": "drone", "tracker": "siam", "stages": [{"name": "siam"}]}
    assert parse_pipeline(document).name == "drone"
