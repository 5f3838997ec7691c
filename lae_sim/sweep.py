"""The picture of a sweep: scores over the world's frame rate, or over the scale of the times."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING

from lae_sim.plots import new_figure
from lae_sim.report import Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
