"""The pictures of a study, for its page and for a paper.

A tracker has one colour and mark throughout, and a forecaster one kind of line, or one colour where
there are no trackers to tell apart. Pictures that would hold too much choose, and say so.

None is drawn here: each comes with what draws it, which holds no more of the study than it shows
and can be pickled, so that workers can draw.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.comparison.statistics import ALL_TRACES, Interval
from lae_sim.engine.clock import parse_duration, split_init
from lae_sim.errors import visible
from lae_sim.figures.column import ColumnFigure, column_figure
from lae_sim.figures.forecasters import attribute_bars, attributes_in_columns, recovers
from lae_sim.figures.lines import (
    Curve,
    Line,
    Panel,
    draw_curves,
    draw_sweep,
    panel_in_column,
    panels_of,
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
EXAMPLES, FEW_HISTOGRAMS = 3, 12
"""Datasets and histograms that are drawn where there are more than the most: as examples."""
MOST_NAMED = 12
"""Trackers of a panel that have a name and a colour, at most, beside those of the front."""


@dataclass(frozen=True)
class Picture:
    """A picture of a page.

    Attributes:
        caption: what it shows, and what was chosen of more.
        draw: draws it; None if there is no more than the caption.
    """

    caption: str
    draw: Callable[[], Figure] | None = None


def _short(name: object) -> str:
    """A name that fits into a picture."""
    text = visible(name)
    return text if len(text) <= 36 else f"{text[:17]}…{text[-17:]}"


def _styles(view: View, runs: Iterable[str]) -> dict[tuple[str, str], Style]:
    """Colour and mark of the tracker, line of the forecaster, by run and forecaster."""
    trackers, lines = tracker_styles(view.names.values()), forecaster_lines(view.forecasters)
    return {
        (run, forecaster): {**trackers[view.names[run]], "linestyle": line}
        for run in runs
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


def _datasets(view: View) -> list[str]:
    """Those that are drawn: all, or the first few where they are examples of many."""
    every = list(dict.fromkeys(row.dataset for row in view.standing))
    return every if len(every) <= MOST_PAIRS else every[:EXAMPLES]


def _of_datasets(view: View) -> str:
    """Which datasets are drawn, in words, if not all are."""
    count, drawn = len({row.dataset for row in view.standing}), len(_datasets(view))
    return f"; the first {drawn} of {count} datasets" if drawn < count else ""


def curves(view: View) -> Iterator[Picture]:
    """Success and precision of each dataset, at the settings that stand for all, then others."""
    groups, count = _curve_groups(view)
    for scores, left_out in groups:
        rows = [view.row_of(each) for each in scores]
        yield Picture(
            f"{visible(rows[0].dataset)}: {_recorded(rows)}{left_out}. In brackets: AUC, "
            "and precision at 20 px.",
            partial(draw_curves, [curve for each in scores for curve in _curves(view, each)]),
        )
    if left := count - len(groups):
        yield Picture(f"{left} more settings are in the ranking, and not drawn here.")


def _curve_groups(view: View) -> tuple[list[tuple[list[Scores], str]], int]:
    """Scores whose curves are drawn together, and what was left out of them; of how many groups.

    What stands for all is first.
    """
    datasets = _datasets(view)
    groups: dict[tuple[Any, ...], list[Scores]] = {}
    for scores in view.results.scores:
        if scores.about[0]["curves"]["success"] is not None:  # something was scored
            groups.setdefault(scores.group, []).append(scores)
    ordered = sorted(
        groups.values(), key=lambda group: not any(view.stands(view.row_of(s)) for s in group)
    )
    chosen = []
    shown = [group for group in ordered if group[0].source.metadata.dataset in datasets]
    for group in shown[:MOST_PAIRS]:
        kept, left_out = _best_runs(view, [view.row_of(scores) for scores in group])
        chosen.append(([scores for scores in group if scores.setting.run in kept], left_out))
    return chosen, len(groups)


def _recorded(rows: Sequence[SummaryRow]) -> str:
    """The setting of curves, which are of the recorded boxes whatever is ranked."""
    shared = shared_setting([replace(row, ranked_by="recorded") for row in rows])
    return shared + (", of the recorded boxes" if any(row.modelled for row in rows) else "")


def _curves(view: View, scores: Scores) -> Iterator[Curve]:
    """The curve of a forecaster; before that of hold, the offline one."""
    run, cells = scores.setting.run, scores.about
    styles = _styles(view, [run])
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
    return Picture(caption, partial(draw_sweep, panels, 2, sharex=True)) if panels else None


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
    caption += _of_datasets(view)
    panels: list[Panel] = []
    for dataset in _datasets(view):
        within = [(x, row) for x, row in points if row.dataset == dataset]
        if not within:
            continue
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
    styles = _styles(view, dict.fromkeys(run for run, _ in order))
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


@dataclass(frozen=True)
class Cost:
    """What a score is set against.

    Attributes:
        name: of pictures of it.
        label: what an axis is called.
        meaning: the same in a sentence.
        of: of a row of the summary; None if it is not known.
        is_best: whether no other row is better and costs less.
    """

    name: str
    label: str
    meaning: str
    of: Callable[[SummaryRow], float | None]
    is_best: Callable[[SummaryRow], bool]


TIME = Cost(
    "front",
    "mean time of a call (ms)",
    "the mean time of a call",
    lambda row: row.elapsed_ms,
    lambda row: row.pareto,
)
ENERGY = Cost(
    "energy",
    "energy of a call (J)",
    "the energy of the device during a call",
    lambda row: None if row.energy is None else row.energy.joules_per_frame,
    lambda row: row.energy is not None and row.energy.pareto,
)


def front(view: View, cost: Cost = TIME) -> Picture | None:
    """AUC against what a call costs, and the Pareto front of each dataset and forecaster."""
    points = _points(view, cost)
    if not points:
        return None
    fronts = _fronts(view, points, cost)
    caption = f"{_front_caption(points, cost)}{_left_out(view, points)}{_grey(fronts)}"
    return Picture(caption, partial(_draw_fronts, fronts))


def _grey(fronts: Iterable[Front]) -> str:
    """That some trackers have no name, in words."""
    some = any(not mark.name for front in fronts for mark in front.marks)
    return "; grey: others, without their names" if some else ""


def _left_out(view: View, points: Sequence[Point]) -> str:
    """What of a study is not drawn as points, in words."""
    drawn = {point.row.dataset for point in points}
    within = sum(row.dataset in drawn for row in view.standing)
    said = f"; the best of {within:,}, and the fronts" if len(points) < within else ""
    return _of_datasets(view) + said


def _points(view: View, cost: Cost = TIME) -> list[Point]:
    """Those of the first datasets: all of the front, and the best of the others."""
    datasets: dict[str, list[Point]] = {}
    for row in view.standing:
        x, auc = cost.of(row), row.score("auc")
        if x is not None and auc is not None:
            datasets.setdefault(row.dataset, []).append(Point(row, x, auc))
    chosen: list[Point] = []
    for points in (datasets[name] for name in _datasets(view) if name in datasets):
        least = sorted((point.auc for point in points), reverse=True)[:MOST_POINTS][-1]
        chosen += [point for point in points if cost.is_best(point.row) or point.auc >= least]
    return chosen


def _front_caption(points: Sequence[Point], cost: Cost) -> str:
    rows = [point.row for point in points]
    return (
        f"{score_name('AUC', rows)} against {cost.meaning}; hollow: hold; lines join what "
        f"no other tracker beats in both: {shared_setting(rows)}"
    )


@dataclass(frozen=True)
class Point:
    """A row of the summary with what a call costs and its AUC, both known."""

    row: SummaryRow
    cost: float
    auc: float


@dataclass(frozen=True)
class Mark:
    """A point of a front's panel.

    Attributes:
        run: of its tracker.
        name: of its tracker, if that is named; others are grey.
        cost, auc: where it is.
        forecaster: what answers.
        style: colour and mark of the tracker.
        is_best: whether it is on the front.
    """

    run: str
    name: str
    cost: float
    auc: float
    forecaster: str
    style: Style
    is_best: bool


@dataclass(frozen=True)
class Front:
    """AUC against time on one dataset.

    Attributes:
        dataset: its name.
        xlabel: what the cost is called.
        ylabel: what the AUC is called.
        lines: the kind of line that joins the best marks of each forecaster.
        marks: those of trackers that are named, and of others.
    """

    dataset: str
    xlabel: str
    ylabel: str
    lines: Mapping[str, Any]
    marks: Sequence[Mark]


def _fronts(view: View, points: Iterable[Point], cost: Cost = TIME) -> list[Front]:
    """What is drawn of each dataset."""
    datasets: dict[str, list[Point]] = {}
    for point in points:
        datasets.setdefault(point.row.dataset, []).append(point)
    lines = forecaster_lines(view.forecasters)
    fronts = []
    for dataset, within in datasets.items():
        best = sorted(within, key=lambda point: (not cost.is_best(point.row), -point.auc))
        on_front = {run_of(point.row) for point in within if cost.is_best(point.row)}
        runs = list(dict.fromkeys(run_of(point.row) for point in best))
        named = runs[: max(len(on_front), MOST_NAMED)]
        styles = _styles(view, named)
        marks = [
            Mark(
                run,
                _short(view.names[run]) if run in named else "",
                point.cost,
                point.auc,
                point.row.forecaster,
                styles.get((run, "hold"), {"color": GREY, "marker": "."}),
                cost.is_best(point.row),
            )
            for point in within
            for run in [run_of(point.row)]
        ]
        ylabel = score_name("AUC", [point.row for point in within])
        kinds = {name: lines[name] for name in view.forecasters}
        fronts.append(Front(_short(dataset), cost.label, ylabel, kinds, marks))
    return fronts


@styled
def _draw_fronts(fronts: Sequence[Front]) -> Figure:
    columns = min(len(fronts), 2)
    figure, panels = panel_grid(len(fronts), columns, 10 / columns, 3.6)
    for axes, each in zip(panels, fronts):
        draw_front(axes, each)
        axes.set_title(each.dataset)
    legend_below(figure)
    return figure


def draw_front(axes: Axes, front: Front) -> None:
    """Draw the marks of one dataset, hollow ones of hold, and the front of each forecaster."""
    for forecaster, line in front.lines.items():
        of_it = [mark for mark in front.marks if mark.forecaster == forecaster]
        best = sorted((mark for mark in of_it if mark.is_best), key=lambda mark: mark.cost)
        style = {"color": GREY, "linestyle": line, "zorder": 1}
        xs, ys = [mark.cost for mark in best], [mark.auc for mark in best]
        axes.plot(xs, ys, label=f"front, {_short(forecaster)}", **style)
        shape: Style = {"linestyle": "", "fillstyle": "none" if forecaster == "hold" else "full"}
        if unnamed := [(mark.cost, mark.auc) for mark in of_it if not mark.name]:
            axes.plot(*zip(*unnamed), color=GREY, marker="o", markersize=3.5, alpha=0.6, **shape)
        for mark in of_it:
            if mark.name:
                axes.plot(mark.cost, mark.auc, **{**mark.style, **shape, "markersize": 7})
    axes.margins(x=0.2, y=0.1)
    _name_trackers(axes, front.marks)
    axes.set(xlabel=front.xlabel, ylabel=front.ylabel)


def _name_trackers(axes: Axes, marks: Iterable[Mark]) -> None:
    """A label beside each tracker's best mark; where there is no room, above and joined to it."""
    best = {mark.run: mark for mark in sorted(marks, key=lambda mark: mark.auc) if mark.name}
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    inches = axes.bbox.width / axes.figure.dpi
    letter, line = 0.055 * (right - left) / inches, 0.055 * (high - low)
    taken: list[tuple[float, float, float]] = []
    for mark in sorted(best.values(), key=lambda mark: mark.auc):  # the worst first
        name, x, y = mark.name, mark.cost, mark.auc
        is_left = x > (left + right) / 2
        length = letter * (len(name) + 3)
        start, stop = (x - length, x) if is_left else (x, x + length)
        for begin, end, height in sorted(taken, key=lambda label: label[2]):
            if begin < stop and start < end and abs(height - y) < line:
                y = height + line
        taken.append((start, stop, y))
        if y > mark.auc:
            axes.plot([x, x], [mark.auc, y], color=GREY, linewidth=0.5, zorder=1)
        axes.annotate(
            name,
            (x, y),
            (-8 if is_left else 8, 0) if y == mark.auc else (-2 if is_left else 2, 0),
            textcoords="offset points",
            ha="right" if is_left else "left",
            va="center",
            fontsize=8,
        )
    axes.set_ylim(low, max([high, *(y + line for *_, y in taken)]))


def gains(view: View) -> Picture | None:
    """What each forecaster wins over hold for each tracker; None if there is only hold."""
    caption, rows, runs = _gaining(view)
    if not runs:
        return None
    both = _won(view, rows, runs), _recovered(view, rows, runs)
    return Picture(caption, partial(_draw_both_gains, both))


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


@dataclass(frozen=True, eq=False)
class Gains:
    """What forecasters gain for each tracker.

    Attributes:
        xlabel: what it is.
        names: of the trackers, one below the other.
        styles: of the forecasters.
        values: by forecaster, the number of the tracker, the gain and the ends of its interval,
            NaN where that is not known, float64 [n, 4].
        limits: beyond which nothing is shown.
    """

    xlabel: str
    names: Sequence[str]
    styles: Mapping[str, Style]
    values: Mapping[str, Floats]
    limits: tuple[float, float] = (-np.inf, np.inf)


Gain = Callable[[Uncertainty], tuple[float, Interval | None] | None]
"""What a row gains, and its interval; None where it is not known."""


def _won(view: View, rows: Sequence[SummaryRow], runs: Sequence[str]) -> Gains:
    """The score won over hold."""

    def won(uncertainty: Uncertainty) -> tuple[float, Interval | None] | None:
        gain = uncertainty.vs_hold
        return None if gain is None else (gain.value, gain.interval)

    return _gained(view, rows, runs, f"{score_name('AUC', rows)} won over hold", won)


def _recovered(view: View, rows: Sequence[SummaryRow], runs: Sequence[str]) -> Gains:
    """The share of the loss won back."""

    def share(uncertainty: Uncertainty) -> tuple[float, Interval | None] | None:
        gain = uncertainty.recovered
        return None if gain is None or gain.share is None else (gain.share, gain.interval)

    found = _gained(view, rows, runs, "latency loss recovered (%)", share, 100)
    return replace(found, limits=(-100, 150))  # where little was lost, intervals are wide


def _gained(
    view: View,
    rows: Sequence[SummaryRow],
    runs: Sequence[str],
    xlabel: str,
    gain: Gain,
    factor: float = 1,
) -> Gains:
    datasets = {run_of(row): _short(row.dataset) for row in rows}
    several = len(set(datasets.values())) > 1
    names = [_short(view.names[r]) + (f" ({datasets[r]})" if several else "") for r in runs]
    styles = forecaster_styles(view.forecasters)
    del styles["hold"]
    places = {run: place for place, run in enumerate(runs)}
    values: dict[str, list[tuple[float, ...]]] = {name: [] for name in styles}
    for row in rows:
        uncertainty = row.certainty("auc") if row.forecaster in styles else None
        if uncertainty is not None and (found := gain(uncertainty)) is not None:
            value, interval = found
            ends = (np.nan, np.nan) if interval is None else (interval.low, interval.high)
            scaled = [factor * each for each in (value, *ends)]
            values[row.forecaster].append((places[run_of(row)], *scaled))
    arrays = {name: np.array(some, np.float64).reshape(-1, 4) for name, some in values.items()}
    return Gains(xlabel, names, styles, arrays)


@styled
def _draw_both_gains(both: Sequence[Gains]) -> Figure:
    count, rivals = len(both[0].names), len(both[0].styles)
    figure = new_figure(10, 1.3 + 0.3 * count + 0.1 * count * rivals)
    for axes, each in zip(figure.subplots(1, 2, sharey=True), both):
        draw_gains(axes, each)
    legend_below(figure)
    return figure


def draw_gains(axes: Axes, gains: Gains) -> None:
    """Draw a dot for each gain, and a line for its interval."""
    axes.axvline(0, color=GREY, linewidth=0.8)
    count = len(gains.styles)
    for number, (name, style) in enumerate(gains.styles.items()):
        places, values, low, high = gains.values[name].T
        heights = places + 0.7 * ((number + 0.5) / count - 0.5)
        axes.hlines(heights, low, high, color=style["color"])
        axes.plot(values, heights, **{**style, "linestyle": "", "label": _short(name)})
    axes.set_ylim(len(gains.names) - 0.5, -0.5)
    axes.set_yticks(range(len(gains.names)), gains.names)
    axes.set_xlabel(gains.xlabel)
    low, high = axes.get_xlim()
    axes.set_xlim(max(low, gains.limits[0]), min(high, gains.limits[1]))


def attributes(view: View) -> Iterator[Picture]:
    """Gains on the sequences of each attribute, all trackers of a dataset together."""
    for dataset, rows in _attribute_rows(view):
        is_recovered = recovers(rows)
        what = "share of the latency loss recovered" if is_recovered else "AUC"
        yield Picture(
            f"{dataset}: {what} on the sequences of each attribute (n of them), with 95 % "
            "intervals where they are known; at the first sigma",
            partial(attribute_bars, rows, "auc", "recovered" if is_recovered else "mean"),
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
    shown = traces if len(traces) <= MOST_HISTOGRAMS else traces[:FEW_HISTOGRAMS]
    left_out = ""
    if len(shown) < len(traces):
        left_out = f"; the first {len(shown)} of {len(traces)} traces"
    caption = (
        "Times of the calls: the area of a bar is its share of the calls; dashed: the interval "
        f"between frames; marks: stalls{left_out}"
    )
    return Picture(
        caption, partial(_histograms, [(_short(each["trace"]), each["times"]) for each in shown])
    )


@styled
def _histograms(traces: Sequence[tuple[str, Mapping[str, Any]]]) -> Figure:
    figure, panels = panel_grid(len(traces), 3, 10 / 3, 2.1)
    for axes, (name, times) in zip(panels, traces):
        draw_times(axes, times)
        axes.set_title(name, fontsize=8)
    return figure


def study_in_columns(view: View) -> Iterator[ColumnFigure]:
    """The figures of a study for a paper, at the settings that stand for all."""
    for scores, left_out in _curve_groups(view)[0]:
        rows = [view.row_of(each) for each in scores]
        if not any(map(view.stands, rows)):
            break
        caption = f"on {visible(rows[0].dataset)}: {_recorded(rows)}{left_out}"
        curves = [curve for each in scores for curve in _curves(view, each)]
        success, precision = panels_of(curves)
        name = rows[0].dataset
        yield ColumnFigure(
            f"success-{name}",
            f"Success {caption}. In brackets: AUC.",
            partial(panel_in_column, success),
        )
        yield ColumnFigure(
            f"precision-{name}",
            f"Precision {caption}. In brackets: precision at 20 px.",
            partial(panel_in_column, precision),
        )
    for key in SWEEPS:
        caption, panels = _sweep(view, key)
        for panel in panels:
            name = f"{panel.ylabel.lower()}-over-{key}-{panel.title}"
            said = f"{panel.ylabel} on {panel.title}. {caption}"
            yield ColumnFigure(name, said, partial(panel_in_column, panel))
    for cost in (TIME, ENERGY):
        points = _points(view, cost)
        for dataset in dict.fromkeys(point.row.dataset for point in points):
            within = [point for point in points if point.row.dataset == dataset]
            [drawn] = _fronts(view, within, cost)
            yield ColumnFigure(
                f"{cost.name}-{dataset}",
                f"{visible(dataset)}: {_front_caption(within, cost)}{_grey([drawn])}",
                partial(column_figure, partial(draw_front, front=drawn), 2.4),
            )
    caption, rows, runs = _gaining(view)
    height = 0.5 + len(runs) * (0.13 + 0.06 * (len(view.forecasters) - 1))
    if runs:
        won = partial(draw_gains, gains=_won(view, rows, runs))
        yield ColumnFigure("won", caption, partial(column_figure, won, height))
        share = partial(draw_gains, gains=_recovered(view, rows, runs))
        said = f"Share of the loss won back. {caption}"
        yield ColumnFigure("recovered", said, partial(column_figure, share, height))
    for dataset, group in _attribute_rows(view):
        yield from attributes_in_columns(group, "auc", dataset)
    several = view.results.traces[: MOST_HISTOGRAMS + 1]
    for trace in several if len(several) <= MOST_HISTOGRAMS else ():
        if trace["times"]["histogram"]:
            yield ColumnFigure(
                f"times-{trace['trace']}",
                f"Times of the calls of {visible(trace['trace'])}: the area of a bar is its share "
                "of the calls; dashed: the interval between frames; marks: stalls",
                partial(column_figure, partial(draw_times, times=trace["times"]), 1.6),
            )
