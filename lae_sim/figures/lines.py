"""Lines over something: panels of them, curves of success and precision, and what was varied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats
from lae_sim.evaluation.metrics import CENTRE_THRESHOLDS
from lae_sim.figures.column import column_figure, field_score
from lae_sim.figures.style import Style, legend_below, new_figure, panel_grid, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_MARKERS, MOST_TICKS = 12, 8
"""More points have no markers, or in a column only so many, and not each a tick."""

Limits = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Line:
    """A line of a panel.

    Attributes:
        label: in the legend.
        x, y: its points, [n].
        style: of the line.
        band: around it, lowest and highest y, [n] each.
    """

    label: str
    x: npt.ArrayLike
    y: npt.ArrayLike
    style: Style
    band: tuple[npt.ArrayLike, npt.ArrayLike] | None = None


@dataclass(frozen=True, eq=False)
class Panel:
    """Lines in one pair of axes.

    Attributes:
        title, xlabel, ylabel: what it shows.
        lines: on it.
        logarithmic: whether the horizontal axis is, to the base of 2.
        xlim, ylim: the ends of the axes, if they are not to fit the lines.
    """

    title: str
    xlabel: str
    ylabel: str
    lines: Sequence[Line]
    logarithmic: bool = False
    xlim: Limits | None = None
    ylim: Limits | None = None


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw the lines of a panel, those of many points without markers."""
    for line in panel.lines:
        style = line.style
        if np.size(line.x) > MOST_MARKERS and "markevery" not in style:
            style = {**style, "marker": ""}
        axes.plot(line.x, line.y, label=line.label, **style)
        if line.band is not None:
            colour = line.style["color"]
            axes.fill_between(line.x, *line.band, color=colour, alpha=0.12, linewidth=0)
    axes.set(title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel)
    if panel.logarithmic:
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter("{x:g}")  # powers would be mathematics, which no text is
    xs = np.unique(np.concatenate([np.ravel(line.x) for line in panel.lines]))
    if len(xs) <= MOST_TICKS:
        axes.set_xticks(xs, [f"{x:g}" for x in xs], minor=False)
    axes.set(xlim=panel.xlim, ylim=panel.ylim)


def panel_in_column(panel: Panel) -> Figure:
    """A panel as a figure for a paper, where markers tell lines apart in grey print too."""
    lines = []
    for place, line in enumerate(panel.lines):
        count = np.size(line.x)
        every = -(-count // MOST_MARKERS)
        first = place * every // len(panel.lines)  # beside those of the other lines
        marked = {"markevery": (first, every)} if count > MOST_MARKERS else {}
        lines.append(replace(line, style={**line.style, **marked}))
    return column_figure(partial(draw_panel, panel=replace(panel, lines=lines)))


@styled
def draw_sweep(
    panels: Sequence[Panel], columns: int, title: str = "", names: Sequence[str] = (), **shared: Any
) -> Figure:
    """Lines over what was varied, a legend for all panels below them.

    Args:
        panels: row by row.
        columns: panels in a row.
        title: above all.
        names: labels in the order of the legend; by default in that of the lines.
        shared: which axes panels share, as for Matplotlib's ``subplots``.
    """
    figure, grid = panel_grid(len(panels), columns, 10 / min(columns, 3), 3, **shared)
    figure.suptitle(title)
    for place, (axes, panel) in enumerate(zip(grid, panels)):
        draw_panel(axes, panel)
        if shared.get("sharex") and place + columns < len(panels):
            axes.set_xlabel("")
    legend_below(figure, names)
    return figure


@dataclass(frozen=True, eq=False)
class Curve:
    """A line of success and precision plots.

    Attributes:
        label: in the legend, which adds AUC and DP at 20 px.
        success: over the IoU thresholds, float64 [N].
        precision: over 0, 1, ..., 50 px, float64 [51].
        style: of the line.
    """

    label: str
    success: Floats
    precision: Floats
    style: Style

    @property
    def auc(self) -> float:
        """The mean of success over the thresholds."""
        return float(self.success.mean())

    @property
    def dp20(self) -> float:
        """Precision at 20 px."""
        return float(self.precision[20])


@styled
def draw_curves(curves: Sequence[Curve], title: str = "") -> Figure:
    """Success and precision plots side by side."""
    figure = new_figure(10, 4.2 + 0.1 * len(curves))
    figure.suptitle(title)
    labels = [f"{curve.label} [{curve.auc:.3f}, {curve.dp20:.3f}]" for curve in curves]
    for axes, panel in zip(figure.subplots(1, 2), _panels(curves, labels, labels)):
        draw_panel(axes, panel)
    legend_below(figure)
    return figure


def panels_of(curves: Sequence[Curve]) -> tuple[Panel, Panel]:
    """The success plot and the precision plot for a paper, the best first in their legends."""
    by_auc = sorted(curves, key=lambda curve: -curve.auc)
    by_dp20 = sorted(curves, key=lambda curve: -curve.dp20)
    aucs = [f"{curve.label} [{field_score(curve.auc)}]" for curve in by_auc]
    dps = [f"{curve.label} [{field_score(curve.dp20)}]" for curve in by_dp20]
    return _panels(by_auc, aucs, aucs)[0], _panels(by_dp20, dps, dps)[1]


def _panels(
    curves: Sequence[Curve], success: Sequence[str], precision: Sequence[str]
) -> tuple[Panel, Panel]:
    """The panels of the curves, with labels of both."""
    return (
        Panel(
            "", "overlap threshold", "success",
            [Line(label, np.linspace(0, 1, len(curve.success)), curve.success, curve.style)
             for label, curve in zip(success, curves)],
            xlim=(0, 1), ylim=(0, 1),
        ),
        Panel(
            "", "centre error threshold (px)", "precision",
            [Line(label, CENTRE_THRESHOLDS, curve.precision, curve.style)
             for label, curve in zip(precision, curves)],
            xlim=(0, 50), ylim=(0, 1),
        ),
    )  # fmt: skip
