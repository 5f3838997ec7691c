"""The picture of a fidelity report: replays against closed loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lae_sim.comparison.fidelity import FidelityRow
from lae_sim.report.style import BLUE, GREY, SKY_BLUE, VERMILION, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def fidelity_figure(rows: Sequence[FidelityRow], title: str = "") -> Figure:
    """AUC of replays over that of closed loops: recorded boxes, and the search model's.

    A point is one sequence of one closed loop under one forecaster. On the diagonal a replay says
    what the closed loop scored; above it, it is too optimistic.

    Args:
        rows: of :func:`lae_sim.comparison.fidelity.compare_closed_loops`.
        title: of the figure.
    """
    figure = new_figure(9.6, 5.0)
    recorded, modelled = figure.subplots(1, 2, sharex=True, sharey=True)
    figure.suptitle(title)
    of_kind = {
        kind: [row for row in rows if row.replay == kind and np.isfinite(row.auc + row.closed_auc)]
        for kind in ("every-frame", "strided", "modelled")
    }
    for kind, colour, marker in (("every-frame", GREY, "o"), ("strided", SKY_BLUE, "s")):
        _points(recorded, of_kind[kind], kind, colour, marker)
    _axes(recorded, "recorded boxes")
    inside = [row for row in of_kind["modelled"] if row.covered]
    outside = [row for row in of_kind["modelled"] if row.covered is False]
    for some, colour in ((inside, BLUE), (outside, VERMILION)):
        label = "the interval holds the closed loop" if some is inside else "it does not"
        ends = np.array([[row.auc_low, row.auc_high] for row in some], float).reshape(-1, 2)
        at = [row.closed_auc for row in some]
        modelled.vlines(at, *ends.T, color=colour, alpha=0.45, linewidth=1.2)
        _points(modelled, some, label, colour, "o")
    _axes(modelled, "search model, with its interval of 95 %")
    recorded.set_ylabel("AUC of the replay")
    return figure


def _points(axes: Axes, rows: Sequence[FidelityRow], label: str, colour: str, marker: str) -> None:
    if not rows:
        return
    off = np.mean([abs(row.d_auc) for row in rows])
    axes.scatter(
        [row.closed_auc for row in rows],
        [row.auc for row in rows],
        s=18,
        color=colour,
        marker=marker,
        alpha=0.8,
        linewidths=0,
        label=f"{label}: {len(rows)}, off by {off:.3f} on average",
        zorder=3,
    )


def _axes(axes: Axes, title: str) -> None:
    axes.plot([0, 1], [0, 1], color="black", linewidth=0.8, zorder=1)
    axes.set(title=title, xlabel="AUC of the closed loop", xlim=(0, 1), ylim=(0, 1))
    axes.set_aspect("equal")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14))
