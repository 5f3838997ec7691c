"""What is reported of a pipeline: worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest
from witness import moving

from lae_sim.api.evaluation import EvaluationResult, evaluate
from lae_sim.engine.pipeline import Camera, Pipeline, Stage
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata


def evaluated(pipeline: Pipeline, length: int = 6, **others: Any) -> EvaluationResult:
    trace = Trace(Metadata.new("25", "every-frame"), [moving(length)])  # 40 ms a frame
    return evaluate(trace, pipeline=pipeline, forecasters="hold", search="off", **others)


def report(pipeline: Pipeline, **others: Any) -> dict[str, Any]:
    (document,) = evaluated(pipeline, **others).document()["traces"]
    return document


STAGES = [Stage("decode", "10ms"), Stage("tracker", "60ms"), Stage("publish", "5ms")]
SLOW = Pipeline(STAGES, Camera("4ms", "6ms", drops=[5]))


def test_where_frames_go_and_how_old_they_are() -> None:
    # frames 0 1 2 3 4 are delivered at 10, 50, 90, 130, 170 ms and decoded 10 ms later; the tracker
    # takes 0 at 20, 1 at 80, 3 at 140, as it comes and pushes 2 out, and 4 at 200
    found = report(SLOW)["pipeline"]
    assert found["camera"] == {"frames": 6, "lost": 1, "delay_ms": 10, "delay_max_ms": 10}
    decode, tracker, publish = found["stages"]
    assert (decode["arrived"], decode["done"], decode["dropped"]) == (5, 5, {})
    assert decode["utilisation"] == pytest.approx(50 / 240)
    assert (decode["age_in_ms"], decode["age_out_ms"]) == (10, 20)
    assert (tracker["arrived"], tracker["done"]) == (5, 4)
    assert tracker["dropped"] == {"queue full": 1}
    assert tracker["wait_ms"] == pytest.approx((0 + 20 + 0 + 20) / 4)
    assert tracker["work_ms"] == 60
    assert tracker["utilisation"] == pytest.approx((60 + 60 + 60 + 40) / 240)  # until the end
    assert tracker["age_out_ms"] == pytest.approx((80 + 100 + 80 + 100) / 4)
    assert (publish["arrived"], publish["done"]) == (3, 3)  # not the initialisation
    assert publish["age_out_max_ms"] == 105
    assert (found["outputs"], found["overtaken"]) == (3, 0)
    assert found["output"] == "publish"


def test_the_age_that_includes_the_camera_has_a_name_of_its_own() -> None:
    # outputs 1 and 3 are there at 145 and 205 ms: frames 0 to 3 are answered by the initial box,
    # 4 and 5 by frame 1, which was delivered 10 ms after its capture
    (result,) = report(SLOW)["results"]
    assert result["capture_age_ms"] == pytest.approx((0 + 40 + 80 + 120 + 120 + 160) / 6)
    assert result["age_ms"] == pytest.approx(result["capture_age_ms"] - (10 + 10) / 6)
    at_once = report(Pipeline([Stage("tracker", "60ms")]))["results"][0]
    assert at_once["capture_age_ms"] == at_once["age_ms"]


def test_it_is_reported_at_each_permitted_latency() -> None:
    results = report(SLOW, sigma=[Fraction(0), Fraction(3)])["results"]
    # at sigma 3, frames are asked for at 120, 160, ... ms, and answered by 0, 1, 1, 3, 4 and 4
    ages = [120 - 0, 160 - 40, 200 - 40, 240 - 120, 280 - 160, 320 - 160]
    assert results[1]["capture_age_ms"] == pytest.approx(sum(ages) / 6)
    assert results[1]["age_ms"] == pytest.approx(results[1]["capture_age_ms"] - 50 / 6)


def test_resources_and_answers_that_are_overtaken() -> None:
    times = iter([90, 10, 10, 10, 10])
    stages = [
        Stage("tracker", "10ms", resource="gpu"),
        Stage("publish", lambda recording: lambda frame: next(times) * 10**6, workers=2),
    ]
    found = report(Pipeline(stages, resources={"gpu": 2}))["pipeline"]
    assert found["resources"] == [
        {
            "resource": "gpu",
            "capacity": 2,
            "load": pytest.approx(6 * 10 / (2 * 240)),
            "utilisation": pytest.approx(6 * 10 / (2 * 240)),
        }
    ]
    assert (found["outputs"], found["overtaken"]) == (5, 1)


def test_the_waterfall_adds_up_to_the_age_of_the_answers() -> None:
    # answers 1, 3 and 4 (see above) wait 20, 0 and 20 ms for the tracker
    steps = report(SLOW)["pipeline"]["waterfall"]
    means = {(step["stage"], step["part"]): step["mean_ms"] for step in steps}
    assert means == {
        ("camera", "exposure"): 4,
        ("camera", "delivery"): 6,
        ("decode", "queue"): 0,
        ("decode", "work"): 10,
        ("tracker", "queue"): pytest.approx(40 / 3),
        ("tracker", "work"): 60,
        ("publish", "queue"): 0,
        ("publish", "work"): 5,
    }
    assert steps[-1]["capture_age_ms"] == pytest.approx(sum(means.values()))
    assert steps[-1]["capture_age_ms"] == pytest.approx((105 + 85 + 105) / 3)
    waits = next(step for step in steps if step["stage"] == "tracker")
    assert (waits["p95_ms"], waits["capture_age_p95_ms"]) == (pytest.approx(20), pytest.approx(40))


def test_what_blocks_and_what_is_shared_has_its_place_in_the_waterfall() -> None:
    stages = [
        Stage("tracker", "10ms", resource="gpu"),
        Stage("publish", "60ms", when_full="block"),
    ]
    steps = report(Pipeline(stages, resources={"gpu": 1}), length=12)["pipeline"]["waterfall"]
    parts = [(step["stage"], step["part"]) for step in steps[2:]]
    assert parts == [
        ("tracker", "queue"), ("tracker", "resource"), ("tracker", "work"), ("tracker", "blocked"),
        ("publish", "queue"), ("publish", "work"),
    ]  # fmt: skip
    assert steps[5]["mean_ms"] > 0
    assert steps[-1]["capture_age_ms"] == pytest.approx(sum(step["mean_ms"] for step in steps))


def slow(*stages: Stage, length: int = 100, **others: Any) -> tuple[str, str, float] | None:
    """Kind, name and load of what is too slow, 40 ms a frame."""
    found = report(Pipeline(stages, **others), length=length)["pipeline"]["bottleneck"]
    return found and (found["kind"], found["name"], round(found["load"], 2))


def test_the_first_stage_that_is_too_slow_is_named() -> None:
    decode, publish = Stage("decode", "10ms"), Stage("publish", "5ms")
    assert slow(decode, Stage("tracker", "38ms"), publish) is None
    assert slow(decode, Stage("tracker", "50ms"), publish) == ("stage", "tracker", 1.25)
    assert slow(decode, Stage("tracker", "50ms", workers=2), publish) is None
    assert slow(decode, Stage("tracker", "50ms", queue=None)) == ("stage", "tracker", 1.25)
    assert slow(decode, Stage("tracker", "90ms", every=2)) == ("stage", "tracker", 1.12)
    both = Stage("decode", "50ms"), Stage("tracker", "60ms")
    assert slow(*both) == ("stage", "decode", 1.25)


def test_a_resource_that_is_too_slow_is_named_rather_than_a_stage_that_waits_for_it() -> None:
    stages = Stage("decode", "15ms", resource="core"), Stage("tracker", "29ms", resource="core")
    assert slow(*stages, resources={"core": 1}) == ("resource", "core", 44 / 40)
    assert slow(*stages, resources={"core": 2}) is None


def test_of_stages_that_block_each_other_the_one_that_is_slow_is_named() -> None:
    stages = (
        Stage("decode", "5ms"),
        Stage("tracker", "10ms", when_full="block"),
        Stage("forecaster", "5ms", when_full="block"),
        Stage("publish", "60ms", when_full="block"),
    )
    kind, name, load = slow(*stages) or ("", "", 0)
    assert (kind, name, load) == ("stage", "publish", pytest.approx(1, abs=0.1))


def test_bursts_are_no_slow_stage() -> None:
    times = [200, *[10] * 99]
    stage = Stage("tracker", lambda recording: lambda frame: times[frame % 50] * 10**6)
    assert slow(stage) == ("bursts", "tracker", 0.3)  # 4 frames are lost, twice
    text = report(Pipeline([stage]), length=100)["pipeline"]["bottleneck"]["text"]
    assert text.startswith("tracker loses 8 of 100 frames, though they are 30% of what it can do")
    assert "200.0 ms at most" in text


def test_an_initialisation_makes_no_stage_slow() -> None:
    times = [900, *[30] * 99]
    stage = Stage("tracker", lambda recording: lambda frame: times[frame] * 10**6)
    assert slow(stage) == ("bursts", "tracker", 0.75)


def test_sequences_add_up() -> None:
    trace = Trace(Metadata.new("25", "every-frame"), [moving(6), replace(moving(6), name="b")])
    result = evaluate(trace, pipeline=SLOW, forecasters="hold", search="off")
    both = result.document()["traces"][0]["pipeline"]
    alone = report(SLOW)["pipeline"]
    assert both["camera"]["frames"] == 12
    for one, two in zip(alone["stages"], both["stages"]):
        assert two["arrived"] == 2 * one["arrived"]
        assert two["utilisation"] == pytest.approx(one["utilisation"])
        assert two["age_out_ms"] == pytest.approx(one["age_out_ms"])


def test_without_a_pipeline_nothing_is_said_of_one() -> None:
    trace = Trace(Metadata.new("25", "every-frame"), [moving(6)])
    (document,) = evaluate(trace).document()["traces"]
    assert "pipeline" not in document
    assert "capture_age_ms" not in document["results"][0]


def scores(result: EvaluationResult) -> list[list[float]]:
    figures = ["auc", "dp20", "norm_auc", "norm_dp20", "offline_auc"]
    return result.summary.sort_values(["forecaster", "sigma"])[figures].values.tolist()


def test_what_comes_after_the_tracker_delays_answers_as_a_forecaster_s_cost_does() -> None:
    trace = Trace(Metadata.new("25", "every-frame"), [moving(120), moving(90, 5, "b")])
    common: dict[str, Any] = {"forecasters": ["hold", "kalman"], "sigma": "grid", "search": "off"}
    stages = [Stage("tracker"), Stage("forecaster", "3ms"), Stage("publish", "9ms")]
    piped = evaluate(trace, pipeline=Pipeline(stages), **common)
    costs = {"hold": "12ms", "kalman": "12ms"}
    assert scores(piped) == scores(evaluate(trace, costs=costs, **common))


def test_a_camera_that_is_late_makes_all_answers_late() -> None:
    trace = Trace(Metadata.new("25", "every-frame"), [moving(120)])  # 40 ms a frame
    common: dict[str, Any] = {"forecasters": ["hold", "kalman"], "search": "off"}
    late = Pipeline([Stage("tracker")], Camera("4ms", "6ms"))
    piped = evaluate(trace, pipeline=late, sigma=["1/4", "1/2", "1"], **common)
    assert scores(piped) == scores(evaluate(trace, sigma=[0, "1/4", "3/4"], **common))
