"""How long calls took: the density of their times, with all stalls in the picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.figures.style import BLUE, VERMILION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis


def draw_times(axes: Axes, times: Mapping[str, Any]) -> None:
    """Draw the density of times over their logarithm, up to the longest.

    The area of a bar is its share of the calls, whatever its width. Each stall is a mark, and the
    interval between frames a dashed line. Few calls may be shorter than the first bin: the axis
    says how many.

    Args:
        axes: what to draw in.
        times: ``times`` of :func:`lae_sim.trace.describe.describe`, with a histogram.
    """
    found, calls = times["histogram"], times["calls"]
    edges, counts = np.array(found["edges_ms"]), np.array(found["counts"], float)
    if edges[0] <= 0:  # which a logarithmic axis never reaches
        edges[0] = edges[1] / 2
    if found["above"]:
        edges, counts = np.append(edges, calls["max_ms"]), np.append(counts, found["above"])
    shares = counts / calls["n"]
    axes.stairs(shares / np.diff(np.log2(edges)), edges, fill=True, color=BLUE)
    axes.set_xscale("log")
    interval = times["frame_interval_ms"]
    left, right = edges[0], edges[-1]
    if left / 4 < interval < 4 * right:
        left, right = min(left, interval), max(right, interval)
        axes.axvline(interval, color=VERMILION, linestyle="--", linewidth=1)
    if stalls := [stall["ms"] for stall in times["stalls"]]:
        up = axes.get_xaxis_transform()
        axes.plot(
            stalls, np.full(len(stalls), 0.03), "|", color=VERMILION, markersize=8, transform=up
        )
        what = "1 stall" if len(stalls) == 1 else f"{len(stalls):,} stalls, the longest"
        axes.annotate(
            f"{what} {_duration(max(stalls))}",
            (max(stalls), 0.08),
            xycoords=up,
            ha="right",
            va="bottom",
            color=VERMILION,
        )
    axes.set_xlim(left / 1.15, right * 1.15)
    name_durations(axes.xaxis, left, right)
    shorter = f"; {found['below']:,} of {calls['n']:,} calls are shorter" if found["below"] else ""
    axes.set(xlabel=f"time of a call{shorter}", ylabel="density (per doubling)")


def name_durations(axis: Axis, shortest: float, longest: float) -> None:
    """Have a logarithmic axis of times in ms name round ones, with their units.

    These are 1, 2 and 5 times powers of ten where there are few of them.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    decades = np.log10(longest / shortest)
    steps: tuple[float, ...] = (1.0, 2.0, 5.0) if decades < 2 else (1.0,)
    if decades < 0.4:
        steps = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    axis.set_major_locator(LogLocator(subs=steps, numticks=12))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda ms, _: _duration(ms)))


def _duration(ms: float) -> str:
    if ms >= 1000:
        return f"{ms / 1000:.3g} s"
    return f"{ms:.3g} ms" if ms >= 1 else f"{1000 * ms:.3g} \N{MICRO SIGN}s"
