"""The pictures of a study, as SVG: the same results give the same bytes.

A tracker has one colour and mark throughout, and a forecaster one kind of line, or one colour where
there are no trackers to tell apart. Pictures that would hold too much choose, and say so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.comparison.statistics import ALL_TRACES, Interval
from lae_sim.engine.clock import parse_duration, split_init
from lae_sim.errors import visible
from lae_sim.figures.column import ColumnFigure, column_figure
from lae_sim.figures.forecasters import attribute_bars, attributes_in_columns, recovers
from lae_sim.figures.lines import (
    Curve,
    Line,
    Panel,
    curves_in_column,
    draw_curves,
    draw_sweep,
    panel_in_column,
)
from lae_sim.figures.style import (
    GREY,
    Style,
    forecaster_lines,
    forecaster_styles,
    legend_below,
    new_figure,
    panel_grid,
    styled,
    svg_of,
    tracker_styles,
)
from lae_sim.figures.times import draw_times
from lae_sim.replay.search import ReachRange, parse_search
from lae_sim.study.records import SummaryRow, Uncertainty
from lae_sim.study.summary import Scores
from lae_sim.study.view import SETTINGS, View, run_of, score_name, setting_of, shared_setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

MOST_CURVES, MOST_PAIRS, MOST_BARS, MOST_HISTOGRAMS, MOST_POINTS = 8, 6, 30, 30, 40
"""What one picture holds of curves, rows and histograms, how many pictures of curves and panels of
datasets there are, and how many points a panel has beside those of the front."""


@dataclass(frozen=True)
class Picture:
    """A picture of a page.

    Attributes:
        caption: what it shows, and what was chosen of more.
        svg: the file.
    """

    caption: str
    svg: bytes


def _short(name: object) -> str:
    """A name that fits into a picture."""
    text = visible(name)
    return text if len(text) <= 36 else f"{text[:17]}…{text[-17:]}"


def _styles(view: View) -> dict[tuple[str, str], Style]:
    """Colour and mark of the tracker, line of the forecaster, by run and forecaster."""
    trackers, lines = tracker_styles(view.names.values()), forecaster_lines(view.forecasters)
    return {
        (run, forecaster): {**trackers[name], "linestyle": line}
        for run, name in view.names.items()
        for forecaster, line in lines.items()
    }


def _label(view: View, run: str, forecaster: str) -> str:
    return f"{_short(view.names[run])}, {_short(forecaster)}"


def _best_runs(view: View, rows: Sequence[SummaryRow]) -> tuple[list[str], str]:
    """The runs of the best trackers, as many as a panel may hold, and what was left out."""
    best: dict[str, float] = {}
    for row in rows:
        best[run_of(row)] = max(best.get(run_of(row), 0), row.score("auc") or 0)
    shown = max(1, MOST_CURVES // len(view.forecasters))
    kept = sorted(best, key=lambda run: -best[run])[:shown]
    left_out = f"; the best {len(kept)} of {len(best)} trackers" if len(kept) < len(best) else ""
    return kept, left_out


def curves(view: View) -> Iterator[Picture]:
    """Success and precision of each dataset, at the settings that stand for all, then others."""
    groups = _curve_groups(view)
    for scores, left_out in groups[:MOST_PAIRS]:
        rows = [view.row_of(each) for each in scores]
        yield Picture(
            f"{visible(rows[0].dataset)}: {_recorded(rows)}{left_out}. In brackets: AUC, "
            "and precision at 20 px.",
            svg_of(draw_curves([curve for each in scores for curve in _curves(view, each)])),
        )
    if len(groups) > MOST_PAIRS:
        left = len(groups) - MOST_PAIRS
        yield Picture(f"{left} more settings are in the ranking, and not drawn here.", b"")


def _curve_groups(view: View) -> list[tuple[list[Scores], str]]:
    """Scores whose curves are drawn together, and what was left out; what stands for all first."""
    groups: dict[tuple[Any, ...], list[Scores]] = {}
    for scores in view.results.scores:
        if scores.about[0]["curves"]["success"] is not None:  # something was scored
            groups.setdefault(scores.group, []).append(scores)
    ordered = sorted(
        groups.values(), key=lambda group: not any(view.stands(view.row_of(s)) for s in group)
    )
    chosen = []
    for group in ordered:
        kept, left_out = _best_runs(view, [view.row_of(scores) for scores in group])
        chosen.append(([scores for scores in group if scores.setting.run in kept], left_out))
    return chosen


def _recorded(rows: Sequence[SummaryRow]) -> str:
    """The setting of curves, which are of the recorded boxes whatever is ranked."""
    shared = shared_setting([replace(row, ranked_by="recorded") for row in rows])
    return shared + (", of the recorded boxes" if any(row.modelled for row in rows) else "")


def _curves(view: View, scores: Scores) -> Iterator[Curve]:
    """The curve of a forecaster; before that of hold, the offline one."""
    run, styles, cells = scores.setting.run, _styles(view), scores.about
    weights = [cell["repetitions"] for cell in cells]
    names = {"offline": "offline_"} if scores.forecaster == "hold" else {}
    for name, prefix in {**names, scores.forecaster: ""}.items():
        if cells[0]["curves"][f"{prefix}success"] is not None:
            success, precision = (
                np.average([cell["curves"][prefix + kind] for cell in cells], 0, weights)
                for kind in ("success", "precision")
            )
            yield Curve(_label(view, run, name), success, precision, styles[run, name])


SWEEPS = {
    "sigma": "permitted latency σ (frames)",  # noqa: RUF001
    "scale": "scale of all times (2: half as fast)",
    "fps": "world rate (frames/s)",
    "latency": "constant latency (ms)",
    "init": "time of an initialisation (ms)",
    "search": "reach c (search sides)",
}
"""What scores are drawn over, if a study has several: the key of the summary, and its label."""


def sweep(view: View, key: str) -> Picture | None:
    """AUC and DP of each dataset over a key of ``SWEEPS``; None if it has one value only."""
    caption, panels = _sweep(view, key)
    return Picture(caption, svg_of(draw_sweep(panels, 2, sharex=True))) if panels else None


def _sweep(view: View, key: str) -> tuple[str, list[Panel]]:
    """The caption and the panels of a sweep, AUC and DP by turns; none of one value only."""
    varied = "latency" if key == "init" else key  # whose name says the initialisation
    points: list[tuple[float, SummaryRow]] = []
    for row in view.results.summary if key == "sigma" else view.rows:
        chosen = dict(zip(SETTINGS, view.chosen[run_of(row)]))
        x = _place(row, key, str(chosen["latency"]))
        settings = zip(SETTINGS, setting_of(row))
        if x is not None and all(own == chosen[name] for name, own in settings if name != varied):
            points.append((x, row))
    if len({x for x, _ in points}) < 2:
        return "", []
    caption = f"Over {SWEEPS[key].split(' (')[0]}: {shared_setting(view.standing, but=varied)}"
    panels: list[Panel] = []
    for dataset in dict.fromkeys(row.dataset for _, row in points):
        within = [(x, row) for x, row in points if row.dataset == dataset]
        kept, left_out = _best_runs(view, [row for _, row in within])
        caption += left_out and f"{left_out} on {_short(dataset)}"
        shown = [(x, row) for x, row in within if run_of(row) in kept]
        panels += _sweep_panels(view, _short(dataset), shown, key)
    return caption, panels


def _place(row: SummaryRow, key: str, chosen: str) -> float | None:
    """Where a row stands on the axis of a key; None if it is not on it.

    Constant latencies are drawn at the initialisation of the latency that stands for all, and
    initialisations at its other times.
    """
    if key in ("latency", "init"):
        (times, init_ns), (its_times, its_init_ns) = split_init(row.latency), split_init(chosen)
        if key == "init":
            return None if init_ns is None or times != its_times else init_ns / 1e6
        kind, _, time = times.partition(":")
        return parse_duration(time) / 1e6 if (kind, init_ns) == ("constant", its_init_ns) else None
    if key == "search":
        reach = parse_search(row.search)
        return reach.low if isinstance(reach, ReachRange) and reach.low == reach.high else None
    value = getattr(row, key)
    return float(value) if isinstance(value, Fraction) else None


def _sweep_panels(
    view: View, title: str, points: Sequence[tuple[float, SummaryRow]], key: str
) -> Iterator[Panel]:
    """AUC and DP of one dataset."""
    lines: dict[tuple[str, str], list[tuple[float, SummaryRow]]] = {}
    for x, row in sorted(points, key=lambda point: point[0]):
        lines.setdefault((run_of(row), row.forecaster), []).append((x, row))
    order = dict.fromkeys((run_of(row), row.forecaster) for _, row in points)
    rows = [row for _, row in points]
    logarithmic = key == "scale" and min(x for x, _ in points) > 0
    styles = _styles(view)
    for metric, name in (("auc", score_name("AUC", rows)), ("dp20", score_name("DP", rows))):
        drawn = [
            Line(
                _label(view, *which),
                [x for x, _ in lines[which]],
                np.array([row.score(metric) for _, row in lines[which]], np.float64),
                styles[which],
            )
            for which in order
        ]
        yield Panel(title, SWEEPS[key], name, drawn, logarithmic)


def front(view: View) -> Picture | None:
    """AUC against the time of a call, and the Pareto front of each dataset and forecaster."""
    points = _points(view)
    if not points:
        return None
    left_out = _left_out(view, points)
    return Picture(f"{_front_caption(points)}{left_out}", svg_of(_front(view, points)))


def _left_out(view: View, points: Sequence[Point]) -> str:
    """What of a study is not drawn as points, in words."""
    datasets, drawn = ({row.dataset for row in some} for some in
                       (view.standing, [point.row for point in points]))  # fmt: skip
    said = f"; the first {len(drawn)} of {len(datasets)} datasets" if drawn < datasets else ""
    within = sum(row.dataset in drawn for row in view.standing)
    return said + (f"; the best of {within:,}, and the fronts" if len(points) < within else "")


def _points(view: View) -> list[Point]:
    """Those of the first datasets: all of the front, and the best of the others."""
    datasets: dict[str, list[Point]] = {}
    for row in view.standing:
        if row.elapsed_ms is not None and (auc := row.score("auc")) is not None:
            datasets.setdefault(row.dataset, []).append(Point(row, row.elapsed_ms, auc))
    chosen: list[Point] = []
    for points in [*datasets.values()][:MOST_PAIRS]:
        least = sorted((point.auc for point in points), reverse=True)[:MOST_POINTS][-1]
        chosen += [point for point in points if point.row.pareto or point.auc >= least]
    return chosen


def _front_caption(points: Sequence[Point]) -> str:
    rows = [point.row for point in points]
    return (
        f"{score_name('AUC', rows)} against the mean time of a call; hollow: hold; lines join what "
        f"no other tracker beats in both: {shared_setting(rows)}"
    )


@dataclass(frozen=True)
class Point:
    """A row of the summary with its time of a call (ms) and its AUC, both known."""

    row: SummaryRow
    ms: float
    auc: float


@styled
def _front(view: View, points: Sequence[Point]) -> Figure:
    datasets = list(dict.fromkeys(point.row.dataset for point in points))
    columns = min(len(datasets), 2)
    figure, panels = panel_grid(len(datasets), columns, 10 / columns, 3.6)
    for axes, dataset in zip(panels, datasets):
        within = [point for point in points if point.row.dataset == dataset]
        _draw_front(axes, view, within)
        axes.set_title(_short(dataset))
    legend_below(figure)
    return figure


def _draw_front(axes: Axes, view: View, points: Sequence[Point]) -> None:
    """The points of one dataset, and the front of each forecaster."""
    styles, lines = _styles(view), forecaster_lines(view.forecasters)
    for forecaster in view.forecasters:
        best = [p for p in points if p.row.forecaster == forecaster and p.row.pareto]
        best.sort(key=lambda point: point.ms)
        style = {"color": GREY, "linestyle": lines[forecaster], "zorder": 1}
        xs, ys = [point.ms for point in best], [point.auc for point in best]
        axes.plot(xs, ys, label=f"front, {_short(forecaster)}", **style)
    for point in points:
        filled = "full" if point.row.forecaster != "hold" else "none"
        style = {**styles[run_of(point.row), "hold"], "linestyle": "", "fillstyle": filled}
        axes.plot(point.ms, point.auc, **{**style, "markersize": 7})
    axes.margins(x=0.2, y=0.1)
    _name_trackers(axes, view, points)
    name = score_name("AUC", [point.row for point in points])
    axes.set(xlabel="mean time of a call (ms)", ylabel=name)


def _name_trackers(axes: Axes, view: View, points: Sequence[Point]) -> None:
    """A label beside each tracker's best point; where there is no room, above and joined to it."""
    best = {run_of(point.row): point for point in sorted(points, key=lambda point: point.auc)}
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    inches = axes.bbox.width / axes.figure.dpi
    letter, line = 0.055 * (right - left) / inches, 0.055 * (high - low)
    taken: list[tuple[float, float, float]] = []
    for run, point in sorted(best.items(), key=lambda each: each[1].auc):  # the worst first
        name, x, y = _short(view.names[run]), point.ms, point.auc
        is_left = x > (left + right) / 2
        length = letter * (len(name) + 3)
        start, stop = (x - length, x) if is_left else (x, x + length)
        for begin, end, height in sorted(taken, key=lambda label: label[2]):
            if begin < stop and start < end and abs(height - y) < line:
                y = height + line
        taken.append((start, stop, y))
        if y > point.auc:
            axes.plot([x, x], [point.auc, y], color=GREY, linewidth=0.5, zorder=1)
        axes.annotate(
            name,
            (x, y),
            (-8 if is_left else 8, 0) if y == point.auc else (-2 if is_left else 2, 0),
            textcoords="offset points",
            ha="right" if is_left else "left",
            va="center",
            fontsize=8,
        )
    axes.set_ylim(low, max(high, *(y + line for *_, y in taken)))


def gains(view: View) -> Picture | None:
    """What each forecaster wins over hold for each tracker; None if there is only hold."""
    caption, rows, runs = _gaining(view)
    return Picture(caption, svg_of(_gains(view, rows, runs))) if runs else None


def _gaining(view: View) -> tuple[str, list[SummaryRow], list[str]]:
    """A caption, the rows and the runs of the largest gains; nothing if there is only hold."""
    best: dict[str, float] = {}
    for row in view.standing:
        if (sure := row.certainty("auc")) and (won := sure.vs_hold) is not None:
            best[run_of(row)] = max(best.get(run_of(row), -1), won.value)
    if not best:
        return "", [], []
    kept = sorted(best, key=lambda run: -best[run])[:MOST_BARS]
    left_out = f", the {len(kept)} largest of {len(best)}" if len(kept) < len(best) else ""
    caption = f"What forecasters win over hold{left_out}, with 95 % intervals over sequences"
    rows = [row for row in view.standing if run_of(row) in kept]
    return f"{caption}: {shared_setting(rows)}", rows, kept


@styled
def _gains(view: View, rows: Sequence[SummaryRow], runs: Sequence[str]) -> Figure:
    rivals = len(view.forecasters) - 1
    figure = new_figure(10, 1.3 + 0.3 * len(runs) + 0.1 * len(runs) * rivals)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, draw in zip(panels, (_draw_won, _draw_recovered)):
        draw(axes, view, rows, runs)
    legend_below(figure)
    return figure


Gain = Callable[[Uncertainty], tuple[float, Interval | None] | None]
"""What a row gains, and its interval; None where it is not known."""


def _draw_won(axes: Axes, view: View, rows: Sequence[SummaryRow], runs: Sequence[str]) -> None:
    """The score won over hold."""

    def won(uncertainty: Uncertainty) -> tuple[float, Interval | None] | None:
        gain = uncertainty.vs_hold
        return None if gain is None else (gain.value, gain.interval)

    _draw_gains(axes, view, rows, runs, won)
    axes.set_xlabel(f"{score_name('AUC', rows)} won over hold")


def _draw_recovered(
    axes: Axes, view: View, rows: Sequence[SummaryRow], runs: Sequence[str]
) -> None:
    """The share of the loss won back."""

    def share(uncertainty: Uncertainty) -> tuple[float, Interval | None] | None:
        gain = uncertainty.recovered
        return None if gain is None or gain.share is None else (gain.share, gain.interval)

    _draw_gains(axes, view, rows, runs, share, 100)
    axes.set_xlabel("latency loss recovered (%)")
    low, high = axes.get_xlim()
    axes.set_xlim(max(low, -100), min(high, 150))  # where little was lost, intervals are wide


def _draw_gains(
    axes: Axes,
    view: View,
    rows: Sequence[SummaryRow],
    runs: Sequence[str],
    gain: Gain,
    factor: float = 1,
) -> None:
    rivals = [name for name in view.forecasters if name != "hold"]
    styles = forecaster_styles(view.forecasters)
    datasets = {run_of(row): _short(row.dataset) for row in rows}
    several = len(set(datasets.values())) > 1
    axes.axvline(0, color=GREY, linewidth=0.8)
    for forecaster in rivals:
        style = {**styles[forecaster], "linestyle": "", "label": _short(forecaster)}
        aside = 0.7 * ((rivals.index(forecaster) + 0.5) / len(rivals) - 0.5)
        for row in rows:
            uncertainty = row.certainty("auc") if row.forecaster == forecaster else None
            found = None if uncertainty is None else gain(uncertainty)
            if found is not None:
                value, interval = found
                _dot(axes, runs.index(run_of(row)) + aside, value, interval, style, factor)
    axes.set_ylim(len(runs) - 0.5, -0.5)
    axes.set_yticks(
        range(len(runs)),
        [_short(view.names[r]) + (f" ({datasets[r]})" if several else "") for r in runs],
    )


def _dot(
    axes: Axes, y: float, x: float, interval: Interval | None, style: Style, factor: float = 1
) -> None:
    """A value and its interval."""
    if interval is not None:
        ends = factor * interval.low, factor * interval.high
        axes.plot(ends, (y, y), color=style["color"])
    axes.plot(factor * x, y, **style)


def attributes(view: View) -> Iterator[Picture]:
    """Gains on the sequences of each attribute, all trackers of a dataset together."""
    for dataset, rows in _attribute_rows(view):
        is_recovered = recovers(rows)
        what = "share of the latency loss recovered" if is_recovered else "AUC"
        yield Picture(
            f"{dataset}: {what} on the sequences of each attribute (n of them), with 95 % "
            "intervals where they are known; at the first sigma",
            svg_of(attribute_bars(rows, "auc", "recovered" if is_recovered else "mean")),
        )


def _attribute_rows(view: View) -> Iterator[tuple[str, DataFrame]]:
    """Each dataset that has attributes, and what is drawn of it."""
    if view.attributes is not None:
        for dataset, group in view.attributes.groupby("dataset", sort=False):
            pooled = group[group["trace"] == ALL_TRACES]
            yield str(dataset), group if pooled.empty else pooled


def histograms(view: View) -> Picture | None:
    """How long the calls of each trace took."""
    traces = [trace for trace in view.results.traces if trace["times"]["histogram"]]
    if not traces:
        return None
    shown = traces[:MOST_HISTOGRAMS]
    left_out = ""
    if len(shown) < len(traces):
        left_out = f"; the first {len(shown)} of {len(traces)} traces"
    caption = (
        "Times of the calls: the area of a bar is its share of the calls; dashed: the interval "
        f"between frames; marks: stalls{left_out}"
    )
    return Picture(caption, svg_of(_histograms(shown)))


@styled
def _histograms(traces: Sequence[Mapping[str, Any]]) -> Figure:
    figure, panels = panel_grid(len(traces), 3, 10 / 3, 2.1)
    for axes, trace in zip(panels, traces):
        draw_times(axes, trace["times"])
        axes.set_title(_short(trace["trace"]), fontsize=8)
    return figure


def study_in_columns(view: View) -> Iterator[ColumnFigure]:
    """The figures of a study for a paper, at the settings that stand for all."""
    for scores, left_out in _curve_groups(view)[:MOST_PAIRS]:
        rows = [view.row_of(each) for each in scores]
        if not any(map(view.stands, rows)):
            break
        caption = f"on {visible(rows[0].dataset)}: {_recorded(rows)}{left_out}"
        curves = [curve for each in scores for curve in _curves(view, each)]
        success, precision = curves_in_column(curves)
        name = rows[0].dataset
        yield ColumnFigure(f"success-{name}", f"Success {caption}. In brackets: AUC.", success)
        yield ColumnFigure(
            f"precision-{name}",
            f"Precision {caption}. In brackets: precision at 20 px.",
            precision,
        )
    for key in SWEEPS:
        caption, panels = _sweep(view, key)
        for panel in panels:
            name = f"{panel.ylabel.lower()}-over-{key}-{panel.title}"
            figure = panel_in_column(panel)
            yield ColumnFigure(name, f"{panel.ylabel} on {panel.title}. {caption}", figure)
    points = _points(view)
    for dataset in dict.fromkeys(point.row.dataset for point in points):
        within = [point for point in points if point.row.dataset == dataset]
        yield ColumnFigure(
            f"front-{dataset}",
            f"{visible(dataset)}: {_front_caption(within)}",
            column_figure(partial(_draw_front, view=view, points=within), 2.4),
        )
    caption, rows, runs = _gaining(view)
    height = 0.5 + len(runs) * (0.13 + 0.06 * (len(view.forecasters) - 1))
    if runs:
        won = column_figure(partial(_draw_won, view=view, rows=rows, runs=runs), height)
        yield ColumnFigure("won", caption, won)
        share = column_figure(partial(_draw_recovered, view=view, rows=rows, runs=runs), height)
        yield ColumnFigure("recovered", f"Share of the loss won back. {caption}", share)
    for dataset, group in _attribute_rows(view):
        yield from attributes_in_columns(group, "auc", dataset)
    several = view.results.traces[: MOST_HISTOGRAMS + 1]
    for trace in several if len(several) <= MOST_HISTOGRAMS else ():
        if trace["times"]["histogram"]:
            yield ColumnFigure(
                f"times-{trace['trace']}",
                f"Times of the calls of {visible(trace['trace'])}: the area of a bar is its share "
                "of the calls; dashed: the interval between frames; marks: stalls",
                column_figure(partial(draw_times, times=trace["times"]), 1.6),
            )
