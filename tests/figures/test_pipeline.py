"""Waterfalls of pipelines: what stands in them, and where."""

from __future__ import annotations

from typing import Any

import pytest
from matplotlib.axes import Axes
from witness import moving

import lae_sim
from lae_sim.api.evaluation import plot_waterfalls
from lae_sim.errors import LaeError
from lae_sim.figures.pipeline import draw_waterfall, waterfalls_for_paper
from lae_sim.figures.replay import timeline_figure, timeline_for_paper
from lae_sim.figures.style import new_figure
from lae_sim.trace.file import Trace

DRONE = lae_sim.Pipeline(
    [
        lae_sim.Stage("decode", "10ms", resource="core"),
        lae_sim.Stage("tracker", "35ms", resource="core", priority=-1),
        lae_sim.Stage("publish", "5ms", when_full="block"),
    ],
    lae_sim.Camera("4ms", "6ms"),
    {"core": 1},
    name="drone",
)
PLAIN = lae_sim.Pipeline([lae_sim.Stage("tracker", "30ms")], name="plain")


def evaluated(*pipelines: lae_sim.Pipeline, **others: Any) -> lae_sim.EvaluationResult:
    trace = Trace(lae_sim.Metadata.new("25", "every-frame"), [moving(100)])
    return lae_sim.evaluate(trace, pipeline=pipelines or None, search="off", **others)


def drawn(pipeline: lae_sim.Pipeline) -> tuple[Axes, dict[str, Any]]:
    (document,) = evaluated(pipeline).document()["traces"]
    axes = new_figure(8, 3).subplots()
    draw_waterfall(axes, document)
    return axes, document


def test_each_part_begins_where_the_one_before_it_ends() -> None:
    axes, document = drawn(DRONE)
    steps = [step for step in document["pipeline"]["waterfall"] if step["mean_ms"]]
    bars = [bar for bar in axes.patches if bar.get_width() > 0]
    assert [bar.get_width() for bar in bars] == pytest.approx([step["mean_ms"] for step in steps])
    ends = [bar.get_x() + bar.get_width() for bar in bars]
    assert ends == pytest.approx([step["capture_age_ms"] for step in steps])
    assert [bar.get_x() for bar in bars] == pytest.approx([0, *ends[:-1]])
    (diamond,) = (line for line in axes.lines if line.get_marker() == "D")
    assert list(diamond.get_xdata()) == [document["results"][0]["capture_age_ms"]]


def test_what_is_too_slow_is_said() -> None:
    axes, document = drawn(DRONE)
    labels = {text.get_text(): text.get_fontweight() for text in axes.get_yticklabels()}
    assert labels == {
        "camera": "normal", "decode (core)": "bold", "tracker (core)": "bold", "publish": "normal",
        "when queried": "normal",
    }  # fmt: skip
    notes = [text.get_text() for text in axes.texts]
    load = document["pipeline"]["bottleneck"]["load"]
    assert f"core too slow: {load:.0%}" in notes[1]
    assert notes[1].endswith("% lost")


def test_parts_differ_in_grey_print() -> None:
    axes, _ = drawn(DRONE)
    bars = {bar.get_label(): bar for bar in axes.patches}
    looks = {(bar.get_hatch(), bar.get_facecolor()[:3]) for bar in axes.patches}
    grey = [(hatch, round(0.3 * r + 0.6 * g + 0.1 * b, 1)) for hatch, (r, g, b) in looks]
    assert len(set(grey)) == len(grey) >= 5
    assert bars


def test_a_camera_that_takes_no_time_has_no_row() -> None:
    axes, _ = drawn(PLAIN)
    assert [text.get_text() for text in axes.get_yticklabels()] == ["tracker", "when queried"]
    assert not [text for text in axes.texts if "slow" in text.get_text()]


def test_pipelines_stand_one_above_the_other_on_one_axis() -> None:
    figure = evaluated(DRONE, PLAIN, scale=[1, 2]).plot_waterfall()
    titles = [axes.get_title("left") for axes in figure.axes]
    assert [title.split(":")[0] for title in titles] == [
        "drone, times x 1", "drone, times x 2", "plain, times x 1", "plain, times x 2",
    ]  # fmt: skip
    assert "core is too slow" in titles[0]
    assert titles[2] == (
        "plain, times x 1: every stage keeps up; tracker, the busiest, with 75% of what it can do"
    )
    (ends,) = {axes.get_xlim() for axes in figure.axes}
    widest = max(bar.get_x() + bar.get_width() for axes in figure.axes for bar in axes.patches)
    assert ends[0] == 0
    assert widest < ends[1]


def test_a_paper_has_a_figure_for_each() -> None:
    documents = evaluated(DRONE, PLAIN).document()["traces"]
    figures = list(waterfalls_for_paper(documents, ["drone", "plain"]))
    assert [figure.name for figure in figures] == ["waterfall-drone", "waterfall-plain"]
    assert "core is too slow" in figures[0].caption
    for figure in figures:
        assert figure.draw().get_figwidth() == 3.4


def test_a_timeline_has_a_row_for_each_stage() -> None:
    trace = Trace(lae_sim.Metadata.new("25", "every-frame"), [moving(9)])
    side = lae_sim.Stage("log", "90ms", after="camera", workers=2)
    pipeline = lae_sim.Pipeline([*DRONE.stages, side], DRONE.camera, DRONE.resources)
    (run,) = lae_sim.replay_trace(trace, pipeline=pipeline)
    (axes,) = timeline_figure(run).axes
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert labels[:-1] == ["query and source", "publish", "log", "tracker", "decode"]
    log = run.schedule.stages["tracker"]  # no call waits for its core: it is the most urgent
    bars = [bar for bar in axes.patches if 2.5 < bar.get_y() + bar.get_height() / 2 < 3.5]
    shown = [bar for bar in bars if bar.get_facecolor() != (1, 1, 1, 1)]
    ticks_per_ms = run.schedule.clock.ticks_per_ns * 1e6
    began = log.started[log.started >= 0] / ticks_per_ms
    assert sorted(bar.get_x() for bar in shown) == pytest.approx(began.tolist())
    places = {round(bar.get_y(), 2) for bar in axes.patches if 1.5 < bar.get_y() + 0.3 < 2.5}
    assert len(places) == 2  # of the two workers that log
    caption = timeline_for_paper(run).caption
    assert "the stages at work (hollow: a frame is held up" in caption


def test_without_a_pipeline_there_is_nothing_to_draw() -> None:
    with pytest.raises(LaeError, match="no pipeline has answered a frame"):
        plot_waterfalls(evaluated().parts)
