"""Densities of times: the area of a bar is its share, and stalls are in the picture."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch

from lae_sim.figures.times import draw_times
from lae_sim.trace.describe import describe
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

MS = 1_000_000


def drawn(ms: np.ndarray) -> tuple[Axes, dict[str, object]]:
    """The picture of times of calls, after an initialisation, and what is known of them."""
    boxes = np.tile([100.0, 50, 40, 30], (len(ms) + 1, 1))
    elapsed = np.concatenate([[50 * MS], (ms * MS).astype(np.int64)])
    trace = Trace(Metadata.new("30", "every-frame"), [Recording.new("a", boxes, boxes, elapsed)])
    times = describe(trace, "a.parquet")[0]["times"]
    axes = Figure().subplots()
    draw_times(axes, times)
    return axes, times


def area(axes: Axes) -> float:
    [bars] = [patch for patch in axes.patches if isinstance(patch, StepPatch)]
    values, edges, _ = bars.get_data()
    return float((values * np.diff(np.log2(edges))).sum())


@pytest.mark.parametrize("spread", [0.1, 0.9])
def test_the_area_is_the_share_of_the_calls(spread: float) -> None:
    axes, times = drawn(15 * np.random.default_rng(1).lognormal(0, spread, 3000))
    below = times["histogram"]["below"]
    assert area(axes) == pytest.approx(1 - below / 3000)
    assert f"{below:,} of 3,000 calls are shorter" in axes.get_xlabel()


def test_bars_of_any_width_compare() -> None:
    axes, _ = drawn(np.geomspace(1, 100, 5000))  # as many in each doubling
    [bars] = [patch for patch in axes.patches if isinstance(patch, StepPatch)]
    inside = bars.get_data().values[:-1]
    assert inside == pytest.approx(np.full(len(inside), 1 / np.log2(100)), rel=0.05)


def test_stalls_are_in_the_picture_and_told() -> None:
    axes, _ = drawn(np.concatenate([np.linspace(12, 18, 995), [2000.0, 14_000.0]]))
    low, high = axes.get_xlim()
    assert low < 12
    assert high > 14_000
    [marks] = [line for line in axes.lines if line.get_marker() == "|"]
    assert sorted(marks.get_xdata()) == [2000, 14_000]
    assert [text.get_text() for text in axes.texts] == ["2 stalls, the longest 14 s"]
    axes.figure.canvas.draw()
    ticks = [label.get_text() for label in axes.get_xticklabels()]
    assert {"10 ms", "1 s", "10 s"} <= set(ticks)


def test_the_interval_between_frames_is_in_the_picture() -> None:
    for ms in (15.0, 60.0):
        axes, _ = drawn(ms + np.linspace(0, 1, 200))
        [line] = [line for line in axes.lines if line.get_linestyle() == "--"]
        low, high = axes.get_xlim()
        assert low < line.get_xdata()[0] < high
        assert line.get_xdata()[0] == pytest.approx(100 / 3)


def test_times_below_the_first_bin_at_zero_are_drawn() -> None:
    axes, _ = drawn(np.linspace(0.001, 3, 500))
    assert axes.get_xlim()[0] > 0
    assert np.isfinite(area(axes))
