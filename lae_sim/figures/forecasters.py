"""Pictures of a comparison, from what :mod:`lae_sim.comparison.statistics` computed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from lae_sim.comparison.statistics import ALL_TRACES
from lae_sim.figures.column import ColumnFigure, column_figure
from lae_sim.figures.labels import METRIC_LABELS, setting_label
from lae_sim.figures.lines import Line, Panel, draw_sweep, panel_in_column
from lae_sim.figures.style import (
    Style,
    forecaster_styles,
    legend_below,
    new_figure,
    panel_grid,
    paper_styles,
    styled,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_TRACES = 6
_RECOVERED_LIMITS = (-100, 150)  # where little was lost, an interval knows no bounds
_SLANTED: Any = {"rotation": 25, "ha": "right", "rotation_mode": "anchor"}
_SHARE_LABEL = "latency loss recovered (%)"
_HATCHES = ("", "////", "....", "xxxx", "----")  # bars that differ in grey print


@styled
def overview(summary: pd.DataFrame, metric: str = "auc") -> Figure:
    """The mean with its interval for each forecaster and latency, and the recovered share beside.

    A row of panels for each trace, or for all traces together if there are more than six; at the
    smallest permitted latency of the summary. An interval that is not known is not drawn.
    """
    chosen = _at_least_sigma(summary, metric)
    traces, styles = chosen["trace"].unique(), _styles(chosen)
    settings = list(dict.fromkeys(chosen["setting"]))
    figure = new_figure(11, 1.2 + 2.6 * len(traces))
    rows = figure.subplots(len(traces), 2, squeeze=False, sharex=True, sharey="col")
    for (left, right), trace in zip(rows, traces):
        of_trace = chosen[chosen["trace"] == trace]
        _draw_means(left, of_trace, settings, styles, _label(metric))
        _draw_shares(right, of_trace, settings, styles)
        left.set_title(trace)
        right.set_title(trace)
    _within_limits(rows[0, 1].set_ylim, rows[0, 1].get_ylim())
    legend_below(figure, list(styles))
    return figure


def _at_least_sigma(summary: pd.DataFrame, metric: str) -> pd.DataFrame:
    """The rows of a metric at the smallest permitted latency, with a column ``setting``."""
    chosen = _few_traces(summary[summary["metric"] == metric])
    chosen = chosen[chosen["sigma"] == chosen["sigma"].min()]
    settings = [setting_label(*pair) for pair in zip(chosen["latency"], chosen["scale"])]
    return chosen.assign(setting=settings)


def _draw_means(
    axes: Axes,
    rows: pd.DataFrame,
    settings: Sequence[str],
    styles: Mapping[str, Style],
    ylabel: str,
) -> None:
    """The mean of each forecaster with its interval, setting by setting."""
    places = np.arange(len(settings))
    answering = [name for name in styles if name != "offline"]
    for name, style in styles.items():
        one = rows[rows["forecaster"] == name].set_index("setting").reindex(settings)
        if name == "offline":
            known = one["mean"].notna().to_numpy()
            ends = places[known] - 0.42, places[known] + 0.42
            axes.hlines(one["mean"][known], *ends, label=name, **style)
        else:
            _dots(axes, places + _offset(answering, name), one, "mean", 1, name, style)
    _name_settings(axes, settings)
    axes.set_ylabel(ylabel)


def _draw_shares(
    axes: Axes, rows: pd.DataFrame, settings: Sequence[str], styles: Mapping[str, Style]
) -> None:
    """The share of the loss that each forecaster recovers, setting by setting."""
    places = np.arange(len(settings))
    forecasting = [name for name in styles if name not in ("hold", "offline")]
    for name in forecasting:
        one = rows[rows["forecaster"] == name].set_index("setting").reindex(settings)
        at = places + _offset(forecasting, name)
        _dots(axes, at, one, "recovered", 100, name, styles[name])
    axes.axhline(0, color="0.4", linewidth=0.8)
    if rows["recovered"].isna().all():
        axes.text(0.5, 0.5, "not known: no offline scores", transform=axes.transAxes, ha="center")
    _name_settings(axes, settings)
    axes.set_ylabel(_SHARE_LABEL)


def _name_settings(axes: Axes, settings: Sequence[str]) -> None:
    """A tick for each setting, and lines between them."""
    slanted = len(settings) > 4 or sum(map(len, settings)) > 70
    axes.set_xticks(range(len(settings)), settings, **(_SLANTED if slanted else {}))
    axes.set_xlim(-0.5, len(settings) - 0.5)
    axes.grid(visible=False, axis="x")
    for edge in range(1, len(settings)):
        axes.axvline(edge - 0.5, color="0.85", linewidth=0.8)


def comparison_in_columns(summary: pd.DataFrame, metrics: Sequence[str]) -> Iterator[ColumnFigure]:
    """The mean of each forecaster for a paper, and the share recovered, a figure for each trace.

    Args:
        summary: what :func:`.statistics.summarise` gave.
        metrics: those drawn, the first also as share recovered.
    """
    for metric in metrics:
        chosen = _at_least_sigma(summary, metric)
        styles, settings = _styles(chosen), list(dict.fromkeys(chosen["setting"]))
        for trace, rows in chosen.groupby("trace", sort=False):
            draw = partial(_draw_means, settings=settings, styles=styles, ylabel=_label(metric))
            yield ColumnFigure(
                f"{metric}-{trace}",
                f"{_label(metric)} of forecasters on {trace}, with 95 % intervals over sequences",
                partial(column_figure, partial(draw, rows=rows)),
            )
            if metric == metrics[0] and recovers(rows):
                yield ColumnFigure(
                    f"recovered-{metric}-{trace}",
                    f"Share of the {_label(metric)} lost to latency that forecasters recover on "
                    f"{trace}, with 95 % intervals over sequences",
                    partial(column_figure, partial(_draw_all_shares, rows, settings, styles)),
                )


def recovers(rows: pd.DataFrame) -> bool:
    """Whether there is a forecaster whose share of the loss is known."""
    rivals = rows[~rows["forecaster"].isin(["hold", "offline"])]
    return bool(rivals["recovered"].notna().any())


def sweeps_in_columns(summary: pd.DataFrame, metrics: Sequence[str]) -> Iterator[ColumnFigure]:
    """Metrics over scale and permitted latency for a paper, where there are several of them.

    Over scale at the smallest permitted latency, and over that at scale 1, if it is among them.
    """
    scale = 1 if (summary["scale"] == 1).any() else summary["scale"].min()
    of_x: dict[Literal["scale", "sigma"], pd.DataFrame] = {
        "scale": summary[summary["sigma"] == summary["sigma"].min()],
        "sigma": summary[summary["scale"] == scale],
    }
    for metric in metrics:
        for x, rows in of_x.items():
            if rows[x].nunique() > 1:
                for panel in _panels(rows, x, metric, "mean", paper_styles):
                    yield ColumnFigure(
                        f"{metric}-over-{x}-{panel.title}",
                        f"{_label(metric)} over the {panel.xlabel}: {panel.title}",
                        partial(panel_in_column, panel),
                    )


def _draw_all_shares(
    rows: pd.DataFrame, settings: Sequence[str], styles: Mapping[str, Style], axes: Axes
) -> None:
    _draw_shares(axes, rows, settings, styles)
    _within_limits(axes.set_ylim, axes.get_ylim())


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
    return draw_sweep(_panels(summary, x, metric, value), 3, names=list(_styles(chosen)))


def _panels(
    summary: pd.DataFrame,
    x: Literal["scale", "sigma"],
    metric: str,
    value: Literal["mean", "vs_hold"],
    styles_of: Callable[[Iterable[str]], dict[str, Style]] = forecaster_styles,
) -> list[Panel]:
    """A panel for each trace and setting but for x."""
    chosen = _few_traces(summary[summary["metric"] == metric])
    if value == "vs_hold":
        chosen = chosen[chosen["forecaster"] != "offline"]
    styles = styles_of(_styles(chosen))
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
    return panels


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
    chosen, groups = _attribute_groups(summary, metric)
    styles, attributes = _styles(chosen), _attribute_counts(chosen)
    height = 1.2 + len(attributes) * max(0.35, 0.1 * len(styles))
    figure, panels = panel_grid(len(groups), 4, 4, height, sharex=True, sharey=True)
    for axes, (title, group) in zip(panels, groups):
        _draw_bars(axes, group, attributes, styles, metric, value)
        axes.set_title(title)
    if value == "recovered":
        _within_limits(panels[0].set_xlim, panels[0].get_xlim())
    legend_below(figure, list(styles))
    return figure


def _attribute_groups(
    summary: pd.DataFrame, metric: str
) -> tuple[pd.DataFrame, list[tuple[str, pd.DataFrame]]]:
    """The rows that are drawn, together and by trace and setting, whose name comes with them."""
    chosen = summary[summary["metric"] == metric]
    if (chosen["trace"] == ALL_TRACES).any():
        chosen = chosen[chosen["trace"] == ALL_TRACES]
    groups = []
    for (trace, latency, scale, sigma), group in chosen.groupby(
        ["trace", "latency", "scale", "sigma"], sort=False
    ):
        title = f"{trace}, {setting_label(latency, scale)}"
        groups.append((title + (f", σ = {sigma:g}" if sigma else ""), group))  # noqa: RUF001
    return chosen, groups


def _attribute_counts(rows: pd.DataFrame) -> dict[str, int]:
    """The number of sequences of each attribute."""
    counts: dict[str, int] = rows.groupby("attribute", sort=False)["sequences"].max().to_dict()
    return counts


def _draw_bars(
    axes: Axes,
    rows: pd.DataFrame,
    attributes: Mapping[str, int],
    styles: Mapping[str, Style],
    metric: str,
    value: Literal["recovered", "mean"],
    hatches: Sequence[str] = ("",),
) -> None:
    """Bars with intervals for each attribute, of one trace and setting."""
    rivals = [n for n in styles if n != "offline" and (n != "hold" or value == "mean")]
    places, factor = np.arange(len(attributes)), 100 if value == "recovered" else 1
    for name in styles if value == "mean" else rivals:
        one = rows[rows["forecaster"] == name].set_index("attribute").reindex([*attributes])
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
            hatch=hatches[rivals.index(name) % len(hatches)],
            label=name,
            xerr=_errors(one, value, factor),
            error_kw={"elinewidth": 0.8},
        )
    axes.set(
        xlabel=_SHARE_LABEL if factor == 100 else _label(metric), ylim=(places[-1] + 0.5, -0.5)
    )
    axes.axvline(0, color="0.4", linewidth=0.8)
    axes.set_yticks(places, [f"{name} (n = {count})" for name, count in attributes.items()])
    axes.grid(visible=False, axis="y")


def _draw_hatched(
    rows: pd.DataFrame,
    attributes: Mapping[str, int],
    styles: Mapping[str, Style],
    metric: str,
    value: Literal["recovered", "mean"],
    axes: Axes,
) -> None:
    _draw_bars(axes, rows, attributes, styles, metric, value, _HATCHES)
    if value == "recovered":
        _within_limits(axes.set_xlim, axes.get_xlim())


def attributes_in_columns(
    summary: pd.DataFrame, metric: str = "auc", of: str = ""
) -> Iterator[ColumnFigure]:
    """Bars for each attribute at the smallest sigma, a figure for a paper per trace and setting.

    Args:
        summary: what :func:`.statistics.by_attribute` gave.
        metric: whose share recovered is drawn, or where that is not known whose mean.
        of: what the names of the figures end in, beside trace and setting.
    """
    first = summary[summary["sigma"] == summary["sigma"].min()]
    chosen, groups = _attribute_groups(first, metric)
    styles, attributes = _styles(chosen), _attribute_counts(chosen)
    value: Literal["recovered", "mean"] = "recovered" if recovers(chosen) else "mean"
    what = _label(metric)
    if value == "recovered":
        what = f"share of the {what} lost that is recovered"

    height = 0.5 + len(attributes) * max(0.17, 0.06 * len(styles))
    for title, rows in groups:
        draw = partial(_draw_hatched, rows, attributes, styles, metric, value)
        yield ColumnFigure(
            f"attributes-{metric}-{of or title}",
            f"By attribute: {what}, with 95 % intervals where they are known; {title}",
            partial(column_figure, draw, height),
        )


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
