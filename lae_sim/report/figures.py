"""Pictures of a replay: success and precision, and the timeline of a sequence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_groups
from lae_sim.evaluation.metrics import CENTRE_THRESHOLDS, PYSOT, Convention
from lae_sim.evaluation.pairing import Pairing, pair
from lae_sim.evaluation.totals import CurveTotals
from lae_sim.files import written_whole
from lae_sim.forecast.base import AnyFactory
from lae_sim.replay.run import Run
from lae_sim.report.replay import Report
from lae_sim.trace.metadata import Metadata

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Curves = dict[str, tuple[Floats, Floats]]
"""By name: success over IoU thresholds, and precision over 0..50 px, mean over sequences."""


def curves(
    runs: Iterable[Run],
    metadata: Metadata,
    forecasters: Mapping[str, AnyFactory],
    sigma: Fraction = Fraction(0),
    convention: Convention = PYSOT,
    costs: Mapping[str, int] | None = None,
) -> Curves:
    """Curves of the offline boxes, where the trace holds every frame, and of each forecaster."""
    totals = CurveTotals()
    for part in evaluate_groups(runs, metadata, forecasters, [sigma], convention, costs):
        totals.add(part)
    return named_curves(totals, list(forecasters))


def named_curves(totals: CurveTotals, forecasters: Sequence[str]) -> Curves:
    """Mean curves by name, of sequences that have been scored; offline too where it is known."""
    means = {name: totals.curves(f) for f, name in enumerate(forecasters)}
    if totals.complete:
        means = {"offline": totals.offline, **means}
    return {name: (mean.success, mean.precision) for name, mean in means.items()}


def success_and_precision(named: Mapping[str, tuple[Floats, Floats]], title: str = "") -> Figure:
    """Success and precision plots side by side, AUC and DP at 20 px in the legends.

    Args:
        named: curves by name; for several traces the names are ``"trace: forecaster"``.
        title: above both plots.
    """
    figure = new_figure(10, 4.2)
    left, right = figure.subplots(1, 2)
    figure.suptitle(title)
    traces = list(dict.fromkeys(name.rpartition(": ")[0] for name in named))
    kinds = list(dict.fromkeys(name.rpartition(": ")[2] for name in named))
    for name, (success, precision) in named.items():
        trace, kind = traces.index(name.rpartition(": ")[0]), kinds.index(name.rpartition(": ")[2])
        colour, style = f"C{trace if len(traces) > 1 else kind}", _style(kinds, kind, len(traces))
        overlap = np.linspace(0, 1, len(success))
        auc, dp = f"{name} [{success.mean():.3f}]", f"{name} [{precision[20]:.3f}]"
        left.plot(overlap, success, color=colour, linestyle=style, label=auc)
        right.plot(CENTRE_THRESHOLDS, precision, color=colour, linestyle=style, label=dp)
    left.set(xlabel="overlap threshold", ylabel="success", xlim=(0, 1), ylim=(0, 1))
    right.set(xlabel="centre error threshold (px)", ylabel="precision", xlim=(0, 50), ylim=(0, 1))
    if len(named) <= 6:
        left.legend(title="AUC", loc="lower left")
        right.legend(title="at 20 px", loc="lower right")
    else:
        left.legend(title="AUC", loc="upper center", bbox_to_anchor=(0.5, -0.12))
        right.legend(title="at 20 px", loc="upper center", bbox_to_anchor=(0.5, -0.12))
        figure.set_size_inches(10, 4.6 + 0.22 * len(named))
    for axes in (left, right):
        axes.grid(alpha=0.3)
    return figure


def _style(kinds: list[str], kind: int, traces: int) -> str:
    """Dashes for offline; for several traces, whose colour tells them apart, one per forecaster."""
    if kinds[kind] == "offline":
        return "--"
    others = [name for name in kinds if name != "offline"]
    return ("-", ":", "-.")[others.index(kinds[kind]) % 3] if traces > 1 else "-"


def timeline(
    run: Run,
    sigma: Fraction = Fraction(0),
    first: int = 0,
    count: int = 20,
    pairing: Pairing | None = None,
) -> Figure:
    """When frames arrived and were processed or skipped, and which output answered each query.

    Args:
        run: one replayed sequence.
        sigma: permitted latency of the queries, frames.
        first: first world frame shown.
        count: number of world frames shown.
        pairing: of the run at that sigma, where it is known already.
    """
    schedule = run.schedule
    clock = schedule.clock
    frame_ms = clock.milliseconds(1)
    end = min(first + count, schedule.length)
    figure = new_figure(12, 3.6)
    axes = figure.subplots()
    processed = set(schedule.frames.tolist())
    for frame in range(first, end):
        taken = frame in processed
        colour = "tab:blue" if taken else "tab:red"
        axes.plot(frame * frame_ms, 2, "o", color=colour, fillstyle="full" if taken else "none")
        axes.annotate(str(frame), (frame * frame_ms, 2.18), ha="center", fontsize=7)
    ticks_per_ms = clock.ticks_per_ns * 1e6
    for frame, start, ready in zip(schedule.frames, schedule.start, schedule.ready):
        if ready >= first * clock.frame_ticks and frame < end:
            begin, length = start / ticks_per_ms, (ready - start) / ticks_per_ms
            axes.barh(1, length, left=begin, height=0.42, color="tab:blue", edgecolor="white")
            if begin + length / 2 < (end + 0.5) * frame_ms:
                axes.text(begin + length / 2, 1, str(frame), ha="center", va="center", color="w")
    known = pairing or pair([schedule], [sigma])
    _draw_queries(axes, run, sigma, known, first, end)
    axes.set_yticks(
        [2, 1, 0], ["world frame\n(hollow: skipped)", "tracker busy", "query and source"]
    )
    axes.set(ylim=(-0.6, 2.5), xlabel="time (ms)", title=f"{run.recording.name}: who answers what")
    axes.set_xlim((first - 0.5) * frame_ms, (end + 0.5) * frame_ms)
    return figure


def _draw_queries(
    axes: Axes, run: Run, sigma: Fraction, pairing: Pairing, first: int, end: int
) -> None:
    """A mark for each query, joined to the moment when the output that answers it was ready."""
    schedule = run.schedule
    clock = schedule.clock
    spans = zip(schedule.frames, schedule.ready, pairing.first[:, 0], pairing.end[:, 0])
    for source, ready, begin, stop in spans:
        for frame in range(max(begin, first), min(stop, end)):
            query = clock.milliseconds(frame + sigma)
            axes.plot(query, 0, "|", color="black", markersize=12)
            axes.annotate(f"{source}", (query, -0.4), ha="center", fontsize=7)
            if source:
                axes.plot(
                    [ready / clock.ticks_per_ns / 1e6, query], [0.78, 0.12], lw=0.6, color="grey"
                )


def check_format(path: str) -> None:
    """Check that a picture can be drawn to a file of this name.

    Raises:
        LaeError: if its ending is not known.
    """
    if Path(path).suffix[1:].lower() not in new_figure(1, 1).canvas.get_supported_filetypes():
        raise LaeError(f"cannot draw to {path}: name a .png, .svg or .pdf file")


def save(figure: Figure, path: str) -> None:
    """Write a figure to a file whose ending says the format.

    Raises:
        LaeError: if it cannot be written, or the ending is not known.
    """
    check_format(path)
    with written_whole(path) as temporary:
        figure.savefig(temporary, format=Path(path).suffix[1:].lower(), dpi=150)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, of its own: pyplot would keep a list of all."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


_AXES = {"fps": "world frame rate (fps)", "latency_scale": "scale of the processing times"}
_SCORES = {"auc": "AUC", "dp20": "DP at 20 px"}


def sweep_figure(
    reports: Sequence[Report],
    labels: Sequence[str],
    sigma: float,
    swept: Sequence[str],
    title: str = "",
) -> Figure:
    """AUC and DP of each forecaster over what was swept.

    Args:
        reports: of traces, each in several worlds.
        labels: the trace's name for each report.
        sigma: the permitted latency to show.
        swept: ``"fps"``, ``"latency_scale"`` or both; the first is the horizontal axis, and there
            is a row of panels for each trace and value of the other.
        title: above all.
    """
    x, *others = swept
    rows: dict[str, list[Report]] = {}
    for label, report in zip(labels, reports):
        row = [label] if len(set(labels)) > 1 else []
        row += [f"times x {report[name]}" for name in others]
        rows.setdefault(", ".join(row), []).append(report)
    figure = new_figure(10, 0.8 + 3.4 * len(rows))
    figure.suptitle(title)
    panels = figure.subplots(len(rows), 2, squeeze=False, sharex=True, sharey="col")
    for axes_of_row, (row_name, members) in zip(panels, rows.items()):
        members.sort(key=lambda report: Fraction(report[x]))
        places = [float(Fraction(report[x])) for report in members]
        for axes, (metric, name) in zip(axes_of_row, _SCORES.items()):
            lines: dict[str, list[float]] = {}
            for report in members:
                for result in report["results"]:
                    if result["sigma"] == sigma:
                        lines.setdefault(result["forecaster"], []).append(_known(result[metric]))
            for forecaster, values in lines.items():
                axes.plot(places, values, "o-", label=forecaster)
            if members[0]["offline"] is not None:
                axes.axhline(members[0]["offline"][metric], color="0.4", ls="--", label="offline")
            axes.set(ylabel=name, title=row_name)
            axes.grid(alpha=0.3)
    for axes in panels[-1]:
        axes.set_xlabel(_AXES[x])
    legend = {}
    for axes in panels[:, 0]:
        legend.update(dict(zip(*reversed(axes.get_legend_handles_labels()))))
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=min(len(legend), 5))
    return figure


def _known(score: float | None) -> float:
    return float("nan") if score is None else score
