"""Comparisons as text: of forecasters, and of replays with the closed loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from lae_sim.comparison.fidelity import FidelityRow, FidelitySummary
from lae_sim.comparison.statistics import KEYS
from lae_sim.report.table import (
    METRIC_LABELS,
    SCORE,
    SIGNED,
    Column,
    Number,
    Table,
    is_unknown,
    p_label,
    setting_label,
    text_of,
)

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]


def comparison_table(summary: pd.DataFrame) -> str:
    """The summary as text: a line per trace, setting and forecaster, then how it was computed.

    The first metric has intervals and tests, the others have their means; the search model's means
    have its own intervals. ``summary`` is what :func:`summarise` or :func:`by_attribute` gave, or
    some rows of it, perhaps with the columns of the model.
    """
    first, *others = summary["metric"].unique()
    baselines = [name[3:-7] for name in summary if name.endswith("_better")]
    summary = summary.assign(
        latency=[setting_label(*both) for both in zip(summary["latency"], summary["scale"])],
        sigma=[s if isinstance(s, str) else f"{s:g}" for s in summary["sigma"]],
    )
    settings = ["trace", "latency", "sigma"]
    several = [name for name in settings if summary[name].nunique() > 1]
    shared = [f"{name} {summary[name].iloc[0]}" for name in settings if name not in several]
    labels = [*(["attribute"] if "attribute" in summary else []), *several, "forecaster"]
    keys = [key for key in KEYS[:-1] if key in summary]
    means = summary.set_index([*keys, "metric"])["mean"].to_dict()

    def mean_of(metric: str) -> Callable[[Row], float | None]:
        return lambda row: means.get((*(row[name] for name in keys), metric))

    columns = [
        *(Column(name, name, is_label=True) for name in labels),
        Column("n", "sequences"),
        Column(METRIC_LABELS.get(first, first), "mean", SCORE),
        Column("recovered", "recovered", Number(".1f", 100, "%", ".0f")),
        *(column for baseline in baselines for column in _against(baseline)),
        *(Column(METRIC_LABELS.get(name, name), mean_of(name), SCORE) for name in others),
    ]
    modelled = [
        name[:-4] for name in summary if name.startswith("modelled_") and name[-4:] == "_low"
    ]
    if first in modelled:  # whose interval is that over sequences
        at = next(i for i, column in enumerate(columns) if column.value == "mean") + 1
        columns.insert(at, Column("[low, high]", partial(_ends, first)))
    else:
        columns += [Column(METRIC_LABELS[name], name, SCORE) for name in modelled]
    rows = (
        summary[summary["metric"] == first]
        .rename(columns={"low": "mean_low", "high": "mean_high"})
        .to_dict("records")
    )
    for row in rows:
        if row["forecaster"] in ("hold", "offline"):
            row["recovered"] = None
        for baseline in baselines:
            if row["forecaster"] == baseline:
                row[f"vs_{baseline}"] = None
    intervals = [METRIC_LABELS.get(name, name) for name in (first, *modelled)]
    caption = ", ".join(shared) + "\n\n" if shared else ""
    method = f"\n{summary.attrs['method']}" if "method" in summary.attrs else ""
    return caption + text_of(Table.of(columns, rows), [*intervals, "recovered"]) + method


def _ends(name: str, row: Row) -> str | None:
    """The ends of an interval."""
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return None if is_unknown(low) else f"[{SCORE(low)}, {SCORE(high)}]"


def _against(baseline: str) -> list[Column]:
    """The mean paired difference to a baseline, its p, the sequences better and worse."""
    name = f"vs_{baseline}"

    def where_known(text: Callable[[Row], str]) -> Callable[[Row], str | None]:
        return lambda row: None if is_unknown(row[name]) else text(row)

    return [
        Column(f"vs {baseline}", name, SIGNED),
        Column("p", where_known(lambda row: p_label(row[f"{name}_p"]))),
        Column("+/-", where_known(lambda row: f"{row[f'{name}_better']}/{row[f'{name}_worse']}")),
    ]


_REPLAYED = ("closed_loop", "forecaster", "replay")
_FIDELITY = {
    "closed_auc": "closed AUC",
    "auc": "AUC",
    "mean_abs_d_auc": "mean |d|",
    "median_abs_d_auc": "median",
    "max_abs_d_auc": "max",
    "d_auc": "d",
    "closed_dp20": "closed DP",
    "dp20": "DP",
    "mean_abs_d_dp20": "mean |d|",
    "d_dp20": "d",
}


def fidelity_table(rows: Sequence[FidelityRow] | Sequence[FidelitySummary]) -> str:
    """How far replays are from closed loops: a line per closed loop, forecaster and replay.

    Of rows per sequence, a line each.
    """
    each = isinstance(rows[0], FidelityRow)
    labels = [*_REPLAYED, "sequence"] if each else _REPLAYED
    columns = [Column(key.replace("_", " "), key, is_label=True) for key in labels]
    if not each:
        columns.append(Column("sequences", "sequences"))
    columns += [
        Column(title, key, SIGNED if key.startswith("d_") else SCORE)
        for key, title in _FIDELITY.items()
        if hasattr(rows[0], key)
    ]
    if each:
        columns += [Column("parted at", "parted"), Column("disagree", "disagreement", SCORE)]
    return text_of(Table.of(columns, rows))
