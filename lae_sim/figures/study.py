"""The pictures of a study, as SVG: the same results give the same bytes.

A tracker has one colour and mark throughout, and a forecaster one kind of line, or one colour where
there are no trackers to tell apart. Pictures that would hold too much choose, and say so.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.comparison.statistics import ALL_TRACES, Interval
from lae_sim.engine.clock import parse_duration, split_init
from lae_sim.errors import visible
from lae_sim.figures.lines import Curve, Line, Panel, draw_curves, draw_sweep
from lae_sim.figures.style import (
    BLUE,
    GREY,
    VERMILION,
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
from lae_sim.replay.search import ReachRange, parse_search
from lae_sim.study.records import SummaryRow
from lae_sim.study.summary import Scores
from lae_sim.study.view import SETTINGS, View, run_of, score_name, setting_of, shared_setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_CURVES, MOST_PAIRS, MOST_BARS, MOST_HISTOGRAMS = 8, 6, 30, 30
"""What one picture holds of curves, rows and histograms, and how many curve pictures there are."""


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
    groups: dict[tuple[Any, ...], list[Scores]] = {}
    for scores in view.results.scores:
        groups.setdefault(scores.group, []).append(scores)
    ordered = sorted(
        groups.values(), key=lambda group: not any(view.stands(view.row_of(s)) for s in group)
    )
    for group in ordered[:MOST_PAIRS]:
        kept, left_out = _best_runs(view, [view.row_of(scores) for scores in group])
        shown = [scores for scores in group if scores.setting.run in kept]
        rows = [view.row_of(scores) for scores in shown]
        yield Picture(
            f"{visible(rows[0].dataset)}: {_recorded(rows)}{left_out}. In brackets: AUC, "
            "and precision at 20 px.",
            svg_of(draw_curves([curve for scores in shown for curve in _curves(view, scores)])),
        )
    if len(ordered) > MOST_PAIRS:
        left = len(ordered) - MOST_PAIRS
        yield Picture(f"{left} more settings are in the ranking, and not drawn here.", b"")


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
    varied = "latency" if key == "init" else key  # whose name says the initialisation
    points: list[tuple[float, SummaryRow]] = []
    for row in view.results.summary if key == "sigma" else view.rows:
        chosen = dict(zip(SETTINGS, view.chosen[run_of(row)]))
        x = _place(row, key, str(chosen["latency"]))
        settings = zip(SETTINGS, setting_of(row))
        if x is not None and all(own == chosen[name] for name, own in settings if name != varied):
            points.append((x, row))
    if len({x for x, _ in points}) < 2:
        return None
    caption = f"Over {SWEEPS[key].split(' (')[0]}: {shared_setting(view.standing, but=varied)}"
    panels: list[Panel] = []
    for dataset in dict.fromkeys(row.dataset for _, row in points):
        within = [(x, row) for x, row in points if row.dataset == dataset]
        kept, left_out = _best_runs(view, [row for _, row in within])
        caption += left_out and f"{left_out} on {_short(dataset)}"
        shown = [(x, row) for x, row in within if run_of(row) in kept]
        panels += _sweep_panels(view, _short(dataset), shown, key)
    return Picture(caption, svg_of(draw_sweep(panels, 2, sharex=True)))


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
    points = [
        Point(row, row.elapsed_ms, auc)
        for row in view.standing
        if row.elapsed_ms is not None and (auc := row.score("auc")) is not None
    ]
    if not points:
        return None
    rows = [point.row for point in points]
    caption = (
        f"{score_name('AUC', rows)} against the mean time of a call; hollow: hold; lines join what "
        f"no other tracker beats in both: {shared_setting(rows)}"
    )
    return Picture(caption, svg_of(_front(view, points)))


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
    styles, lines = _styles(view), forecaster_lines(view.forecasters)
    for axes, dataset in zip(panels, datasets):
        within = [point for point in points if point.row.dataset == dataset]
        for forecaster in view.forecasters:
            best = [p for p in within if p.row.forecaster == forecaster and p.row.pareto]
            best.sort(key=lambda point: point.ms)
            style = {"color": GREY, "linestyle": lines[forecaster], "zorder": 1}
            xs, ys = [point.ms for point in best], [point.auc for point in best]
            axes.plot(xs, ys, label=f"front, {_short(forecaster)}", **style)
        for point in within:
            filled = "full" if point.row.forecaster != "hold" else "none"
            style = {**styles[run_of(point.row), "hold"], "linestyle": "", "fillstyle": filled}
            axes.plot(point.ms, point.auc, **{**style, "markersize": 7})
        axes.margins(x=0.2, y=0.1)
        _name_trackers(axes, view, within)
        name = score_name("AUC", [point.row for point in points])
        axes.set(xlabel="mean time of a call (ms)", ylabel=name, title=_short(dataset))
    legend_below(figure)
    return figure


def _name_trackers(axes: Axes, view: View, points: Sequence[Point]) -> None:
    """A label beside each tracker's best point, moved up where one is too near below."""
    # the worst first
    best = {run_of(point.row): point for point in sorted(points, key=lambda point: point.auc)}
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    taken: list[tuple[float, float]] = []
    for run, point in best.items():
        x, y, least = point.ms, point.auc, 0.055 * (high - low)
        for other, height in taken:
            if abs(other - x) < 0.4 * (right - left):
                y = max(y, height + least)
        taken.append((x, y))
        aside: dict[str, Any] = {"xytext": (8, 0), "ha": "left"}
        if x > (left + right) / 2:
            aside = {"xytext": (-8, 0), "ha": "right"}
        label = {"textcoords": "offset points", "va": "center", "fontsize": 8, **aside}
        axes.annotate(_short(view.names[run]), (x, y), **label)
    axes.set_ylim(low, max(high, *(y + 0.05 * (high - low) for _, y in taken)))


def gains(view: View) -> Picture | None:
    """What each forecaster wins over hold for each tracker; None if there is only hold."""
    best: dict[str, float] = {}
    for row in view.standing:
        if (sure := row.certainty("auc")) and (won := sure.vs_hold) is not None:
            best[run_of(row)] = max(best.get(run_of(row), -1), won.value)
    if not best:
        return None
    kept = sorted(best, key=lambda run: -best[run])[:MOST_BARS]
    left_out = f", the {len(kept)} largest of {len(best)}" if len(kept) < len(best) else ""
    caption = f"What forecasters win over hold{left_out}, with 95 % intervals over sequences"
    rows = [row for row in view.standing if run_of(row) in kept]
    return Picture(f"{caption}: {shared_setting(rows)}", svg_of(_gains(view, rows, kept)))


@styled
def _gains(view: View, rows: Sequence[SummaryRow], runs: Sequence[str]) -> Figure:
    rivals = [name for name in view.forecasters if name != "hold"]
    figure = new_figure(10, 1.3 + 0.3 * len(runs) + 0.1 * len(runs) * len(rivals))
    panels = figure.subplots(1, 2, sharey=True)
    styles = forecaster_styles(view.forecasters)
    datasets = {run_of(row): _short(row.dataset) for row in rows}
    several = len(set(datasets.values())) > 1
    for axes in panels:
        axes.axvline(0, color=GREY, linewidth=0.8)
    for forecaster in rivals:
        style = {**styles[forecaster], "linestyle": "", "label": _short(forecaster)}
        aside = 0.7 * ((rivals.index(forecaster) + 0.5) / len(rivals) - 0.5)
        for row in rows:
            uncertainty = row.certainty("auc") if row.forecaster == forecaster else None
            if uncertainty is None or uncertainty.vs_hold is None:
                continue
            y = runs.index(run_of(row)) + aside
            won, recovered = uncertainty.vs_hold, uncertainty.recovered
            _dot(panels[0], y, won.value, won.interval, style)
            if recovered is not None and recovered.share is not None:
                _dot(panels[1], y, recovered.share, recovered.interval, style, 100)
    name = score_name("AUC", rows)
    panels[0].set(xlabel=f"{name} won over hold", ylim=(len(runs) - 0.5, -0.5))
    panels[1].set(xlabel="latency loss recovered (%)")
    low, high = panels[1].get_xlim()
    panels[1].set_xlim(max(low, -100), min(high, 150))  # where little was lost, intervals are wide
    panels[0].set_yticks(
        range(len(runs)),
        [_short(view.names[r]) + (f" ({datasets[r]})" if several else "") for r in runs],
    )
    legend_below(figure)
    return figure


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
    from lae_sim.figures.forecasters import attribute_bars

    if view.attributes is None:
        return
    for dataset, group in view.attributes.groupby("dataset", sort=False):
        pooled = group[group["trace"] == ALL_TRACES]
        shown = group if pooled.empty else pooled
        is_recovered = shown["recovered"].notna().any()
        figure = attribute_bars(shown, "auc", "recovered" if is_recovered else "mean")
        what = "share of the latency loss recovered" if is_recovered else "AUC"
        yield Picture(
            f"{dataset}: {what} on the sequences of each attribute (n of them), with 95 % "
            "intervals where they are known; at the first sigma",
            svg_of(figure),
        )


def histograms(view: View) -> Picture | None:
    """How long the calls of each trace took."""
    traces = [trace for trace in view.results.traces if trace["times"]["histogram"]]
    if not traces:
        return None
    shown = traces[:MOST_HISTOGRAMS]
    left_out = ""
    if len(shown) < len(traces):
        left_out = f"; the first {len(shown)} of {len(traces)} traces"
    caption = f"Times of the calls; dashed: the interval between frames{left_out}"
    return Picture(caption, svg_of(_histograms(shown)))


@styled
def _histograms(traces: Sequence[Mapping[str, Any]]) -> Figure:
    figure, panels = panel_grid(len(traces), 3, 10 / 3, 1.9)
    for axes, trace in zip(panels, traces):
        times, interval = trace["times"], trace["times"]["frame_interval_ms"]
        counts, edges = times["histogram"]["counts"], times["histogram"]["edges_ms"]
        axes.stairs(counts, edges, fill=True, color=BLUE)
        axes.set_title(_short(trace["trace"]), fontsize=8)
        outside = times["histogram"]["below"] + times["histogram"]["above"]
        axes.set_xlabel(f"ms ({outside:,} of {times['calls']['n']:,} calls outside)")
        if edges[0] < interval < edges[-1]:
            axes.axvline(interval, color=VERMILION, linestyle="--", linewidth=1)
    return figure
