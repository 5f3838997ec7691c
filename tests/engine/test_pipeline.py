"""Pipelines as data: their order, and what they refuse."""

from __future__ import annotations

from typing import Any

import pytest

from lae_sim.engine.pipeline import Camera, Pipeline, Stage
from lae_sim.errors import LaeError

TRACKER = Stage("tracker")


def test_each_stage_comes_after_the_one_before_it() -> None:
    pipeline = Pipeline([Stage("decode"), TRACKER, Stage("forecaster"), Stage("publish")])
    assert [stage.after for stage in pipeline.stages] == [
        "camera",
        "decode",
        "tracker",
        "forecaster",
    ]
    assert pipeline.below == ("forecaster", "publish")
    assert pipeline.output == "publish"
    assert repr(pipeline) == (
        "<Pipeline 'pipeline': camera > decode > tracker > forecaster > publish>"
    )


def test_stages_stand_in_any_order_if_they_say_what_they_come_after() -> None:
    stages = [
        Stage("publish", after="tracker"),
        Stage("tracker", after="decode"),
        Stage("other", after="camera"),
        Stage("decode", after="camera"),
    ]
    pipeline = Pipeline(stages)
    assert [stage.name for stage in pipeline.stages] == ["other", "decode", "tracker", "publish"]
    assert [stage.name for stage in pipeline.after("camera")] == ["other", "decode"]
    assert pipeline.output == "publish"


def test_what_it_is_made_of_is_its_own() -> None:
    resources = {"gpu": 1}
    made = Pipeline((stage for stage in [Stage("decode"), TRACKER]), resources=resources)
    resources["gpu"] = 0
    assert made == Pipeline([Stage("decode"), TRACKER], resources={"gpu": 1})
    assert Pipeline(TRACKER) == Pipeline([TRACKER])  # type: ignore[arg-type]


def test_the_tracker_may_be_called_otherwise() -> None:
    assert Pipeline([Stage("siam"), Stage("send")], tracker="siam").output == "send"


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"name": "Decode"}, "name: 'Decode' is no name of a stage"),
        ({"name": "camera"}, "not 'camera'"),
        ({"queue": 0}, "stage 'tracker': queue: 0 is not a whole number from 1, or None"),
        ({"queue": 1.5}, "stage 'tracker': queue: 1.5"),
        ({"workers": 0}, "stage 'tracker': workers: 0 is not a whole number from 1"),
        ({"workers": True}, "stage 'tracker': workers: True"),
        ({"every": 0}, "stage 'tracker': every: 0"),
        ({"priority": "high"}, "stage 'tracker': priority: 'high' is not a whole number"),
        ({"when_full": "drop_oldest"}, "did you mean 'drop-oldest'"),
        ({"when_full": []}, "stage 'tracker': when_full: no \\[\\]"),
        ({"resource": ["gpu"]}, "stage 'tracker': resource: a name, not \\['gpu'\\]"),
        ({"resource": ""}, "stage 'tracker': resource: a name, not ''"),
        ({"after": ["camera"]}, "stage 'tracker': after: a name, not \\['camera'\\]"),
    ],
)
def test_a_stage_refuses(values: dict[str, Any], says: str) -> None:
    with pytest.raises(LaeError, match=says):
        Stage(**{"name": "tracker", **values})


@pytest.mark.parametrize(
    ("stages", "says"),
    [
        ([], "no stage is called 'tracker': there are none"),
        ([Stage("decode")], "no stage is called 'tracker': there are decode"),
        ([TRACKER, TRACKER], "stage 'tracker': name: two stages have it"),
        ([Stage("decode", after="trakcer"), TRACKER], "did you mean 'tracker'"),
        ([Stage("tracker", after="tracker")], "stage 'tracker': after: a loop"),
        (
            [Stage("decode", after="tracker"), Stage("tracker", after="decode")],
            "after: a loop: none of decode, tracker comes after the camera",
        ),
        (
            [Stage("decode"), Stage("tracker", resource="gpu")],
            "stage 'tracker': resource: no 'gpu' among the pipeline's resources: none",
        ),
        ([Stage("tracker", when_full="block")], "stage 'tracker': when_full: a camera does not"),
        (
            [TRACKER, Stage("publish"), Stage("record", after="tracker")],
            "stage 'record': after: what comes after the tracker does not branch, and 'publish'",
        ),
        (["tracker"], "a pipeline has stages"),
        (5, "a pipeline has stages"),
    ],
)
def test_a_pipeline_refuses(stages: Any, says: str) -> None:
    with pytest.raises(LaeError, match=says) as caught:
        Pipeline(stages)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"resources": {"gpu": 0}}, "resources: gpu: 0 is not a whole number from 1"),
        ({"resources": ["gpu"]}, "resources: whole numbers by name, not \\['gpu'\\]"),
        ({"camera": "fast"}, "camera: such as Camera"),
        ({"tracker": "siam"}, "no stage is called 'siam'"),
        ({"tracker": ["siam"]}, "no stage is called \\['siam'\\]"),
        ({"name": "drone\n"}, "name: 'drone.n' is no name of a pipeline"),
        ({"name": 5}, "name: 5 is no name of a pipeline"),
    ],
)
def test_what_stands_beside_the_stages(values: dict[str, Any], says: str) -> None:
    with pytest.raises(LaeError, match=says):
        Pipeline([TRACKER], **values)


@pytest.mark.parametrize("key", ["exposure", "delivery"])
@pytest.mark.parametrize("value", ["4", 4, "-4ms", None])
def test_a_camera_takes_durations(key: str, value: Any) -> None:
    with pytest.raises(LaeError, match=f"camera: {key}: .* is not a duration"):
        Camera(**{key: value})


@pytest.mark.parametrize("drops", [5, True, {"every": 10}, None])
def test_a_camera_loses_frames_that_are_listed(drops: Any) -> None:
    with pytest.raises(LaeError, match=r"camera: drops: .* or a list of frames, not"):
        Camera(drops=drops)
