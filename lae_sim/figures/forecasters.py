"""Pictures of a comparison, from what :mod:`lae_sim.comparison.statistics` computed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from lae_sim.comparison.statistics import ALL_TRACES
from lae_sim.figures.labels import METRIC_LABELS, setting_label
from lae_sim.figures.lines import Line, Panel, draw_sweep
from lae_sim.figures.style import (
    Style,
    forecaster_styles,
    legend_below,
    new_figure,
    panel_grid,
    styled,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_TRACES = 6
_RECOVERED_LIMITS = (-100, 150)  # where little was lost, an interval knows no bounds
_SLANTED = {"rotation": 25, "ha": "right", "rotation_mode": "anchor"}
_SHARE_LABEL = "latency loss recovered (%)"


@styled
def overview(summary: pd.DataFrame, metric: str = "auc") -> Figure:
    """The mean with its interval for each forecaster and latency, and the recovered share beside.

    A row of panels for each trace, or for all traces together if there are more than six; at the
    smallest permitted latency of the summary. An interval that is not known is not drawn.
    """
    chosen = _few_traces(summary[summary["metric"] == metric])
    chosen = chosen[chosen["sigma"] == chosen["sigma"].min()]
    traces, styles = chosen["trace"].unique(), _styles(chosen)
    settings = [setting_label(*pair) for pair in zip(chosen["latency"], chosen["scale"])]
    chosen = chosen.assign(setting=settings)
    settings = list(dict.fromkeys(settings))
    figure = new_figure(11, 1.2 + 2.6 * len(traces))
    rows = figure.subplots(len(traces), 2, squeeze=False, sharex=True, sharey="col")
    places = np.arange(len(settings))
    answering = [name for name in styles if name != "offline"]
    forecasting = [name for name in answering if name != "hold"]
    for (left, right), trace in zip(rows, traces):
        of_trace = chosen[chosen["trace"] == trace]
        for name, style in styles.items():
            one = of_trace[of_trace["forecaster"] == name].set_index("setting").reindex(settings)
            if name == "offline":
                known = one["mean"].notna().to_numpy()
                ends = places[known] - 0.42, places[known] + 0.42
                left.hlines(one["mean"][known], *ends, label=name, **style)
                continue
            _dots(left, places + _offset(answering, name), one, "mean", 1, name, style)
            if name in forecasting:
                _dots(
                    right, places + _offset(forecasting, name), one, "recovered", 100, name, style
                )
        right.axhline(0, color="0.4", linewidth=0.8)
        if of_trace["recovered"].isna().all():
            right.text(
                0.5, 0.5, "not known: no offline scores", transform=right.transAxes, ha="center"
            )
        left.set(ylabel=_label(metric), title=trace)
        right.set(ylabel=_SHARE_LABEL, title=trace)
        for axes in (left, right):
            axes.set_xticks(places, settings, **(_SLANTED if len(settings) > 4 else {}))
            axes.set_xlim(-0.5, len(settings) - 0.5)
            axes.grid(visible=False, axis="x")
            for edge in range(1, len(settings)):
                axes.axvline(edge - 0.5, color="0.85", linewidth=0.8)
    _within_limits(rows[0, 1].set_ylim, rows[0, 1].get_ylim())
    legend_below(figure, list(styles))
    return figure


def against(
    summary: pd.DataFrame,
    x: Literal["scale", "sigma"],
    metric: str = "auc",
    value: Literal["mean", "vs_hold"] = "mean",
) -> Figure:
    """A metric over the latency's scale or the permitted latency.

    Args:
        summary: what :func:`.statistics.summarise` gave. There is a panel for each trace
            (for all traces together if there are more than six) and each remaining setting.
        x: the scale of the latency, or the permitted latency.
        metric: whose.
        value: the mean, or its paired difference to hold with the interval as a band. (A mean has
            no band: how far sequences differ says little of how far forecasters do.)
    """
    chosen = _few_traces(summary[summary["metric"] == metric])
    if value == "vs_hold":
        chosen = chosen[chosen["forecaster"] != "offline"]
    styles = _styles(chosen)
    xlabel = "scale of the latency" if x == "scale" else "permitted latency σ (frames)"  # noqa: RUF001
    ylabel = _label(metric) + (" minus that of hold" if value == "vs_hold" else "")
    other = "sigma" if x == "scale" else "scale"
    several = chosen[other].nunique() > 1
    panels = []
    for (trace, latency, rest), group in chosen.groupby(["trace", "latency", other], sort=False):
        title = f"{trace}, {setting_label(latency, rest if other == 'scale' else 1)}"
        title += f", σ = {rest:g}" if other == "sigma" and several else ""  # noqa: RUF001
        lines = []
        for name, style in styles.items():
            one = group[group["forecaster"] == name].sort_values(x)
            band = (one["vs_hold_low"], one["vs_hold_high"]) if value == "vs_hold" else None
            lines.append(Line(name, one[x], one[value], style, band))
        panels.append(Panel(title, xlabel, ylabel, lines, x == "scale" and group[x].min() > 0))
    return draw_sweep(panels, 3, names=list(styles))


@styled
def attribute_bars(
    summary: pd.DataFrame, metric: str = "auc", value: Literal["recovered", "mean"] = "recovered"
) -> Figure:
    """Bars with intervals for each attribute, which says its number of sequences.

    Args:
        summary: what :func:`.statistics.by_attribute` gave. There is a panel for each
            setting, and for each trace unless there are rows of all traces.
        metric: whose.
        value: the share of the latency loss recovered, or the mean of the metric, where marks show
            the offline mean.
    """
    chosen = summary[summary["metric"] == metric]
    if (chosen["trace"] == ALL_TRACES).any():
        chosen = chosen[chosen["trace"] == ALL_TRACES]
    styles = _styles(chosen)
    rivals = [n for n in styles if n != "offline" and (n != "hold" or value == "mean")]
    counts = chosen.groupby("attribute", sort=False)["sequences"].max()
    groups = list(chosen.groupby(["trace", "latency", "scale", "sigma"], sort=False))
    places, factor = np.arange(len(counts)), 100 if value == "recovered" else 1
    height = 1.2 + len(counts) * max(0.35, 0.1 * len(rivals))
    figure, panels = panel_grid(len(groups), 4, 4, height, sharex=True, sharey=True)
    for axes, ((trace, latency, scale, sigma), group) in zip(panels, groups):
        title = f"{trace}, {setting_label(latency, scale)}"
        axes.set_title(title + (f", σ = {sigma:g}" if sigma else ""))  # noqa: RUF001
        for name in styles if value == "mean" else rivals:
            one = group[group["forecaster"] == name].set_index("attribute").reindex(counts.index)
            known = one[value].notna().to_numpy()
            one, at = one[known], places[known]
            middle = factor * one[value]
            if name == "offline":
                axes.plot(middle, at, "|", color="black", markersize=14, label=name)
                continue
            axes.barh(
                at + _offset(rivals, name),
                middle,
                0.8 / len(rivals),
                color=styles[name]["color"],
                label=name,
                xerr=_errors(one, value, factor),
                error_kw={"elinewidth": 0.8},
            )
        axes.set(
            xlabel=_SHARE_LABEL if factor == 100 else _label(metric), ylim=(places[-1] + 0.5, -0.5)
        )
        axes.axvline(0, color="0.4", linewidth=0.8)
        axes.set_yticks(places, [f"{name} (n = {count})" for name, count in counts.items()])
        axes.grid(visible=False, axis="y")
    if factor == 100:
        _within_limits(panels[0].set_xlim, panels[0].get_xlim())
    legend_below(figure, list(styles))
    return figure


def _few_traces(summary: pd.DataFrame) -> pd.DataFrame:
    """Rows of all traces alone, if there are more traces than can be shown."""
    together = summary["trace"] == ALL_TRACES
    many = summary["trace"][~together].nunique() > _MOST_TRACES
    return summary[together] if many and together.any() else summary


def _styles(summary: pd.DataFrame) -> dict[str, Style]:
    """The style of each forecaster, hold first, offline last."""
    names = sorted(
        summary["forecaster"].unique(), key=lambda name: (name != "hold", name == "offline")
    )
    return forecaster_styles(names)


def _offset(names: Sequence[str], name: str) -> float:
    """Where a forecaster stands within its group, which is 0.8 wide."""
    return 0.8 * ((names.index(name) + 0.5) / len(names) - 0.5)


def _dots(
    axes: Axes, places: Any, rows: pd.DataFrame, value: str, factor: float, name: str, style: Any
) -> None:
    known = rows[value].notna().to_numpy()
    rows = rows[known]
    axes.errorbar(
        places[known],
        factor * rows[value],
        _errors(rows, value, factor),
        color=style["color"],
        marker=style["marker"],
        markersize=4.5,
        linestyle="none",
        elinewidth=1,
        label=name,
    )


def _errors(rows: pd.DataFrame, value: str, factor: float) -> Any:
    """Distances of the interval's ends from a value, [2, n]; 0 where there is no interval."""
    low, high = ("low", "high") if value == "mean" else (f"{value}_low", f"{value}_high")
    ends = [rows[value] - rows[low], rows[high] - rows[value]]
    # a skewed percentile interval can leave its value outside
    return np.nan_to_num(factor * np.clip(ends, 0, None))


def _within_limits(setter: Any, limits: tuple[float, float]) -> None:
    setter(max(limits[0], _RECOVERED_LIMITS[0]), min(limits[1], _RECOVERED_LIMITS[1]))


def _label(metric: str) -> str:
    return METRIC_LABELS.get(metric, metric)
