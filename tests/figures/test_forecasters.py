"""Pictures of a comparison: that what they show is what was computed."""

from __future__ import annotations

import io

import numpy as np
import pandas as pd
import pytest
from tidy_scores import random_scores, tidy

from lae_sim.comparison.statistics import by_attribute, summarise
from lae_sim.figures.forecasters import against, attribute_bars, overview


def table(traces=1, latencies=("recorded",), scales=(1.0,), sigmas=(0.0,)):
    return pd.concat(
        [
            tidy(random_scores(seed, 5), f"trace {seed}", latency, scale=scale, sigma=sigma)
            for seed in range(traces)
            for latency in latencies
            for scale in scales
            for sigma in sigmas
        ]
    )


def legend(figure):
    [found] = figure.legends
    return [text.get_text() for text in found.get_texts()]


@pytest.mark.parametrize(("traces", "rows"), [(1, 1), (2, 3), (6, 7), (7, 1)])
def test_overview_has_a_row_per_trace_up_to_six(traces, rows):
    figure = overview(summarise(table(traces, ("recorded", "constant:47ms")), resamples=10))
    assert len(figure.axes) == 2 * rows
    assert figure.axes[-1].get_title() == ("trace 0" if traces == 1 else "all traces")
    assert legend(figure) == ["hold", "kalman", "mine", "offline"]


def test_overview_shows_means_and_shares_at_the_smallest_sigma():
    summary = summarise(table(latencies=("x", "y"), scales=(1.0, 2.0), sigmas=(0.0, 1.0)))
    left, right = overview(summary).axes
    assert [len(axes.containers) for axes in (left, right)] == [3, 2]
    ours = summary[(summary["sigma"] == 0) & (summary["forecaster"] == "kalman")]
    np.testing.assert_allclose(left.containers[1].lines[0].get_ydata(orig=False), ours["mean"])
    np.testing.assert_allclose(
        right.containers[0].lines[0].get_ydata(orig=False), 100 * ours["recovered"]
    )
    [bars] = left.containers[1].lines[2]
    ends = [segment[:, 1] for segment in bars.get_segments()]
    np.testing.assert_allclose(ends, ours[["low", "high"]])
    ticks = [label.get_text() for label in right.get_xticklabels()]
    assert ticks == ["x", "x x 2", "y", "y x 2"]


def test_what_is_not_known_without_offline():
    rows = table()
    rows = rows[rows["forecaster"] != "offline"]
    figure = overview(summarise(rows, resamples=10))
    assert figure.axes[1].texts[0].get_text() == "not known: no offline scores"
    figure.savefig(io.BytesIO())
    figure = attribute_bars(by_attribute(rows, {}, resamples=10))
    assert not figure.axes[0].patches
    figure.savefig(io.BytesIO())


@pytest.mark.parametrize("x", ["scale", "sigma"])
@pytest.mark.parametrize("value", ["mean", "vs_hold"])
def test_against_draws_a_line_per_forecaster_and_bands_of_differences(x, value):
    rows = table(2, scales=(2.0, 1.0), sigmas=(0.0, 0.5, 1.0))
    summary = summarise(rows, resamples=10)
    figure = against(summary, x, value=value)
    assert len(figure.axes) == 3 * (3 if x == "scale" else 2)
    first = figure.axes[0]
    names = ["hold", "kalman", "mine", "offline"][: 4 if value == "mean" else 3]
    assert [line.get_label() for line in first.lines] == names
    assert [line.get_linestyle() for line in first.lines] == ["-", "-", "-", "--"][: len(names)]
    assert len(first.collections) == (0 if value == "mean" else 3)
    assert list(first.lines[0].get_xdata()) == ([1, 2] if x == "scale" else [0, 0.5, 1])
    at = {"trace": "trace 0", "scale": 1.0, "sigma": 0.0, "forecaster": "mine"}
    [row] = summary[(summary[list(at)] == pd.Series(at)).all(axis=1)].to_dict("records")
    assert first.lines[2].get_ydata()[0] == row[value]


@pytest.mark.parametrize(
    ("value", "names"),
    [("recovered", ["kalman", "mine"]), ("mean", ["hold", "kalman", "mine", "offline"])],
)
def test_attribute_bars(value, names):
    attributes = {("D", f"s{i:02}"): ["blur"] for i in range(3)} | {("D", "s04"): ["clutter"]}
    summary = by_attribute(table(2, ("x", "y")), attributes, resamples=10)
    figure = attribute_bars(summary, value=value)
    assert [axes.get_title() for axes in figure.axes] == ["all traces, x", "all traces, y"]
    first = figure.axes[0]
    labels = [label.get_text() for label in first.get_yticklabels()]
    assert labels == ["all sequences (n = 5)", "blur (n = 3)", "clutter (n = 1)"]
    assert len(first.patches) == 3 * len([name for name in names if name != "offline"])
    assert legend(figure) == names
    figure.savefig(io.BytesIO())
