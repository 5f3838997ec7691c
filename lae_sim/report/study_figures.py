"""The pictures of a study, as SVG: the same results give the same bytes.

A tracker has one colour and mark throughout, and a forecaster one kind of line. Pictures that would
hold too much choose, and say so.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.comparison.statistics import ALL_TRACES
from lae_sim.engine.clock import parse_duration
from lae_sim.evaluation.metrics import CENTRE_THRESHOLDS
from lae_sim.report.figures import new_figure
from lae_sim.report.study_view import SETTINGS, View, row_of, run_of, setting_of, shared_setting
from lae_sim.report.table import printable
from lae_sim.study.summary import MEAN, Row, Scores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_CURVES, MOST_PAIRS, MOST_BARS, MOST_HISTOGRAMS = 8, 6, 30, 30
"""What one picture holds of curves, rows and histograms, and how many curve pictures there are."""

# Okabe and Ito, "Color Universal Design", 2008, less the yellow, and three darker ones
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#332288", "#999933")
_MARKS = "osD^vP*X"
_LINES = ("-", "-.", (0, (3, 1, 1, 1, 1, 1)), (0, (5, 1)), (0, (1, 1)))


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
    text = printable(name)
    return text if len(text) <= 36 else f"{text[:17]}…{text[-17:]}"


def _style(view: View, run: str, forecaster: str = "hold") -> dict[str, Any]:
    """Colour and mark of the tracker, line of the forecaster."""
    place, n = list(dict.fromkeys(view.names.values())).index(view.names[run]), len(_COLOURS)
    return {
        "color": _COLOURS[place % n],
        "marker": _MARKS[(place + place // n) % len(_MARKS)],
        "linestyle": _line(view, forecaster),
        "markersize": 4,
    }


def _line(view: View, forecaster: str) -> Any:
    """Hold is dotted, and offline, which is no forecaster, dashed."""
    place = view.forecasters.index(forecaster)
    return _LINES[(place - 1) % len(_LINES)] if place else ":"


def _best(view: View, rows: Sequence[Row]) -> tuple[list[Row], str]:
    """The rows of the best trackers, as many as a panel may hold, and what was left out."""
    best: dict[str, float] = {}
    for row in rows:
        best[run_of(row)] = max(best.get(run_of(row), 0), row["auc"] or 0)
    shown = max(1, MOST_CURVES // len(view.forecasters))
    kept = sorted(best, key=lambda run: -best[run])[:shown]
    told = f"; the best {len(kept)} of {len(best)} trackers" if len(kept) < len(best) else ""
    return [row for row in rows if run_of(row) in kept], told


def drawn(caption: str, draw: Callable[[], Figure]) -> Picture:
    """Draw a picture."""
    import matplotlib
    from cycler import cycler

    settings: dict[Any, Any] = {
        "svg.hashsalt": "lae_sim",
        "svg.fonttype": "none",
        "text.parse_math": False,  # names hold what they hold
        "axes.prop_cycle": cycler(color=_COLOURS),
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "font.size": 9,
        "legend.frameon": False,
    }
    file = io.BytesIO()
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)
        draw().savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return Picture(caption, file.getvalue())


def _below(figure: Figure) -> None:
    """One legend of all panels, below them, in as many columns as fit."""
    found = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels())
    }
    columns = max(1, min(4, 150 // (max(map(len, found), default=0) + 8)))
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=columns)


def curves(view: View) -> Iterator[Picture]:
    """Success and precision of each dataset, at the settings that stand for all, then others."""
    groups: dict[tuple[Any, ...], list[Scores]] = {}
    for scores in view.results.scores:
        groups.setdefault(scores.group, []).append(scores)
    ordered = sorted(
        groups.values(), key=lambda group: not any(view.stands(row_of(s)) for s in group)
    )
    for group in ordered[:MOST_PAIRS]:
        rows, told = _best(view, [{**row_of(s), "auc": _mean(s), "scores": s} for s in group])
        what = f"{printable(rows[0]['dataset'])}: {shared_setting(rows)}{told}"
        yield drawn(
            f"{what}. In brackets: AUC, and precision at 20 px.",
            lambda rows=rows: _curves(view, rows),  # type: ignore[misc]
        )
    if len(ordered) > MOST_PAIRS:
        left = len(ordered) - MOST_PAIRS
        yield Picture(f"{left} more settings are in the ranking, and not drawn here.", b"")


def _mean(scores: Scores) -> float:
    known = scores.means["auc"][:, 0]
    return float(np.nanmean(known)) if (known == known).any() else 0.0


def _curves(view: View, rows: Sequence[Row]) -> Figure:
    figure = new_figure(10, 4.2 + 0.17 * len(rows) / 2)
    left, right = figure.subplots(1, 2)
    for row in rows:
        run, forecaster = run_of(row), row["forecaster"]
        style = {**_style(view, run, forecaster), "marker": ""}
        lines = [(f"{_short(view.names[run])}, {_short(forecaster)}", "", style)]
        if forecaster == "hold":
            lines.insert(
                0, (f"{_short(view.names[run])}, offline", "offline_", {**style, "ls": "--"})
            )
        for name, which, style in lines:
            style.pop("linestyle" if which else "", None)
            cells = row["scores"].about
            if cells[0]["curves"][f"{which}success"] is None:
                continue
            weights = [cell["repetitions"] for cell in cells]
            success, precision = (
                np.average([cell["curves"][which + kind] for cell in cells], 0, weights)
                for kind in ("success", "precision")
            )
            label = f"{name} [{success.mean():.3f}, {precision[20]:.3f}]"
            left.plot(np.linspace(0, 1, len(success)), success, label=label, **style)
            right.plot(CENTRE_THRESHOLDS, precision, label=label, **style)
    left.set(xlabel="overlap threshold", ylabel="success", xlim=(0, 1), ylim=(0, 1))
    right.set(xlabel="centre error threshold (px)", ylabel="precision", xlim=(0, 50), ylim=(0, 1))
    _below(figure)
    return figure


SWEEPS = {
    "sigma": "permitted latency σ (frames)",  # noqa: RUF001
    "scale": "scale of all times (2: half as fast)",
    "fps": "world rate (frames/s)",
    "latency": "constant latency (ms)",
}
"""What scores are drawn over, if a study has several: the key of the summary, and its label."""


def sweep(view: View, key: str) -> Picture | None:
    """AUC and DP of each dataset over a key of ``SWEEPS``; None if it has one value only."""
    points = []
    for row in view.results.summary if key == "sigma" else view.rows:
        alike = zip(SETTINGS[1:], setting_of(row), view.chosen[run_of(row)])
        x = _place(key, row[key])
        if x is not None and all(ours == its for name, ours, its in alike if name != key):
            points.append({**row, "x": x})
    if len({row["x"] for row in points}) < 2:
        return None
    datasets = list(dict.fromkeys(row["dataset"] for row in points))
    kept, caption = (
        [],
        f"Over {SWEEPS[key].split(' (')[0]}: {shared_setting(view.standing, but=key)}",
    )
    for dataset in datasets:
        best, told = _best(view, [row for row in points if row["dataset"] == dataset])
        kept += best
        caption += told and f"{told} on {_short(dataset)}"
    return drawn(caption, lambda: _sweep(view, kept, datasets, key))


def _place(key: str, value: str) -> float | None:
    """Where a value stands on its axis; None if it is not on it."""
    if key == "latency":
        name, _, time = value.partition(":")
        return parse_duration(time) / 1e6 if name == "constant" else None
    return None if value == MEAN else float(Fraction(value))


def _sweep(view: View, rows: Sequence[Row], datasets: Sequence[str], key: str) -> Figure:
    figure = new_figure(10, 0.8 + 2.7 * len(datasets))
    panels = figure.subplots(len(datasets), 2, squeeze=False, sharex=True)
    mean = "m" if rows[0]["sigma"] == MEAN else ""
    for pair, dataset in zip(panels, datasets):
        lines: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            if row["dataset"] == dataset:
                lines.setdefault((run_of(row), row["forecaster"]), []).append(row)
        for axes, metric, label in zip(pair, ("auc", "dp20"), (f"{mean}AUC", f"{mean}DP")):
            for (run, forecaster), its in lines.items():
                its = sorted(its, key=lambda row: row["x"])
                style = _style(view, run, forecaster) | ({"marker": ""} if len(its) > 12 else {})
                ys = [np.nan if row[metric] is None else row[metric] for row in its]
                name = f"{_short(view.names[run])}, {_short(forecaster)}"
                axes.plot([row["x"] for row in its], ys, label=name, **style)
            axes.set(ylabel=label, title=_short(dataset))
            if axes.get_subplotspec().is_last_row():
                axes.set_xlabel(SWEEPS[key])
            xs = sorted({row["x"] for row in rows})
            if key == "scale" and xs[0] > 0:
                axes.set_xscale("log", base=2)
            if len(xs) <= 8:
                axes.set_xticks(xs, [f"{x:g}" for x in xs])
    _below(figure)
    return figure


def front(view: View) -> Picture | None:
    """AUC against the time of a call, and the Pareto front of each dataset and forecaster."""
    rows = [row for row in view.standing if None not in (row["auc"], row["elapsed_ms"])]
    if not rows:
        return None
    caption = "AUC against the mean time of a call; hollow: hold; lines join what no other tracker"
    return drawn(f"{caption} beats in both: {shared_setting(rows)}", lambda: _front(view, rows))


def _front(view: View, rows: Sequence[Row]) -> Figure:
    datasets = list(dict.fromkeys(row["dataset"] for row in rows))
    columns = min(len(datasets), 2)
    lines = -(-len(datasets) // columns)
    figure = new_figure(10, 0.8 + 3.6 * lines)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, dataset in zip(panels, datasets):
        ours = [row for row in rows if row["dataset"] == dataset]
        for forecaster in view.forecasters:
            its = sorted(
                (row for row in ours if row["forecaster"] == forecaster and row["pareto"]),
                key=lambda row: row["elapsed_ms"],
            )
            xs, ys = [row["elapsed_ms"] for row in its], [row["auc"] for row in its]
            style = {"color": "0.45", "linestyle": _line(view, forecaster), "zorder": 1}
            axes.plot(xs, ys, label=f"front, {_short(forecaster)}", **style)
        for row in ours:
            filled = "full" if row["forecaster"] != "hold" else "none"
            style = {**_style(view, run_of(row)), "linestyle": "", "fillstyle": filled}
            axes.plot(row["elapsed_ms"], row["auc"], **{**style, "markersize": 7})
        axes.margins(x=0.2, y=0.1)
        best: dict[str, Row] = {}
        for row in sorted(ours, key=lambda row: row["auc"]):
            best[run_of(row)] = row
        # a label beside each tracker's best point, moved up where one is too near below
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        taken: list[tuple[float, float]] = []
        for run, row in best.items():
            x, y, least = row["elapsed_ms"], row["auc"], 0.055 * (high - low)
            for other, height in taken:
                if abs(other - x) < 0.4 * (right - left):
                    y = max(y, height + least)
            taken.append((x, y))
            aside: dict[str, Any] = {"xytext": (8, 0), "ha": "left"}
            if x > (left + right) / 2:
                aside = {"xytext": (-8, 0), "ha": "right"}
            label = {"textcoords": "offset points", "va": "center", "fontsize": 8, **aside}
            axes.annotate(_short(view.names[run]), (x, y), **label)
        axes.set(xlabel="mean time of a call (ms)", ylabel="AUC", title=_short(dataset))
        axes.set_ylim(low, max(high, *(y + 0.05 * (high - low) for _, y in taken)))
    for axes in panels[len(datasets) :]:
        axes.remove()
    _below(figure)
    return figure


def gains(view: View) -> Picture | None:
    """What each forecaster wins over hold for each tracker; None if there is only hold."""
    rows = [row for row in view.standing if "vs_hold_auc_low" in row]
    if not rows:
        return None
    best: dict[str, float] = {}
    for row in rows:
        best[run_of(row)] = max(best.get(run_of(row), -1), row["vs_hold_auc"])
    kept = sorted(best, key=lambda run: -best[run])[:MOST_BARS]
    told = f", the {len(kept)} largest of {len(best)}" if len(kept) < len(best) else ""
    caption = f"What forecasters win over hold{told}, with 95 % intervals over sequences"
    rows = [row for row in rows if run_of(row) in kept]
    return drawn(f"{caption}: {shared_setting(rows)}", lambda: _gains(view, rows, kept))


def _gains(view: View, rows: Sequence[Row], runs: Sequence[str]) -> Figure:
    figure = new_figure(10, 1.3 + 0.3 * len(runs) + 0.1 * len(rows))
    panels = figure.subplots(1, 2, sharey=True)
    rivals = [name for name in view.forecasters if name != "hold"]
    datasets = {run_of(row): _short(row["dataset"]) for row in rows}
    several = len(set(datasets.values())) > 1
    for axes, key, factor in zip(panels, ("vs_hold_auc", "recovered_auc"), (1, 100)):
        axes.axvline(0, color="0.4", linewidth=0.8)
        for f, forecaster in enumerate(rivals):
            its = {run_of(row): row for row in rows if row["forecaster"] == forecaster}
            for run, row in its.items():
                if (value := row.get(key)) is None:
                    continue
                y = runs.index(run) + 0.7 * ((f + 0.5) / len(rivals) - 0.5)
                colour = _COLOURS[f % len(_COLOURS)]
                ends = [
                    factor * row[f"{key}_{end}"] for end in ("low", "high") if f"{key}_{end}" in row
                ]
                axes.plot(ends, [y] * len(ends), color=colour, linewidth=1.5)
                label = _short(forecaster)
                axes.plot(factor * value, y, _MARKS[f % 8], color=colour, label=label, markersize=5)
    panels[0].set(xlabel="AUC won over hold", ylim=(len(runs) - 0.5, -0.5))
    panels[1].set(xlabel="latency loss recovered (%)")
    low, high = panels[1].get_xlim()
    panels[1].set_xlim(max(low, -100), min(high, 150))  # where little was lost, intervals are wide
    panels[0].set_yticks(
        range(len(runs)),
        [_short(view.names[r]) + (f" ({datasets[r]})" if several else "") for r in runs],
    )
    _below(figure)
    return figure


def attributes(view: View) -> Iterator[Picture]:
    """Gains on the sequences of each attribute, all trackers of a dataset together."""
    from lae_sim.report.forecaster_figures import attribute_bars

    if view.attributes is None:
        return
    for dataset, group in view.attributes.groupby("dataset", sort=False):
        pooled = group[group["trace"] == ALL_TRACES]
        shown = group if pooled.empty else pooled
        value = "recovered" if shown["recovered"].notna().any() else "mean"
        what = "share of the latency loss recovered" if value == "recovered" else "AUC"
        yield drawn(
            f"{dataset}: {what} on the sequences of each attribute (n of them), with 95 % "
            "intervals where they are known; at the first sigma",
            lambda shown=shown, value=value: attribute_bars(shown, "auc", value),  # type: ignore[misc]
        )


def histograms(view: View) -> Picture | None:
    """How long the calls of each trace took."""
    traces = [trace for trace in view.results.traces if trace["times"]["histogram"]]
    if not traces:
        return None
    shown = traces[:MOST_HISTOGRAMS]
    told = f"; the first {len(shown)} of {len(traces)} traces" if len(shown) < len(traces) else ""
    caption = "Times of the calls; dashed: the interval between frames"
    return drawn(caption + told, lambda: _histograms(shown))


def _histograms(traces: Sequence[Row]) -> Figure:
    lines = -(-len(traces) // 3)
    figure = new_figure(10, 0.3 + 1.9 * lines)
    panels = figure.subplots(lines, 3, squeeze=False).ravel()
    for axes, trace in zip(panels, traces):
        found, interval = trace["times"]["histogram"], trace["times"]["frame_interval_ms"]
        axes.stairs(found["counts"], found["edges_ms"], fill=True, color=_COLOURS[0])
        axes.set_title(_short(trace["trace"]), fontsize=8)
        outside = found["below"] + found["above"]
        axes.set_xlabel(f"ms ({outside:,} of {trace['times']['calls']['n']:,} calls outside)")
        if found["edges_ms"][0] < interval < found["edges_ms"][-1]:
            axes.axvline(interval, color=_COLOURS[1], linestyle="--", linewidth=1)
    for axes in panels[len(traces) :]:
        axes.remove()
    return figure
