"""The comparison of forecasters as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.comparison.statistics import KEYS
from lae_sim.report.table import METRIC_LABELS, number_text, p_label, setting_label
from lae_sim.report.table import table as text_table

if TYPE_CHECKING:
    import pandas as pd


def comparison_table(summary: pd.DataFrame) -> str:
    """The summary as text: a line per trace, setting and forecaster, then how it was computed.

    The first metric has intervals and tests, the others have their means. ``summary`` is what
    :func:`summarise` or :func:`by_attribute` gave, or some rows of it.
    """
    first, *others = summary["metric"].unique()
    baselines = [name[3:-7] for name in summary if name.endswith("_better")]
    summary = summary.assign(
        latency=[setting_label(*both) for both in zip(summary["latency"], summary["scale"])],
        sigma=[s if isinstance(s, str) else f"{s:g}" for s in summary["sigma"]],
    )
    settings = ["trace", "latency", "sigma"]
    several = [name for name in settings if summary[name].nunique() > 1]
    told = ", ".join(f"{name} {summary[name].iloc[0]}" for name in settings if name not in several)
    left = [*(["attribute"] if "attribute" in summary else []), *several, "forecaster"]
    header = [*left, "n", METRIC_LABELS.get(first, first), "recovered"]
    for baseline in baselines:
        header += [f"vs {baseline}", "p", "+/-"]
    header += [METRIC_LABELS.get(metric, metric) for metric in others]
    keys = [key for key in KEYS[:-1] if key in summary]
    means = summary.set_index([*keys, "metric"])["mean"].to_dict()
    lines = []
    for row in summary[summary["metric"] == first].to_dict("records"):
        line = [*(row[key] for key in left), str(row["sequences"])]
        line += [_interval(row["mean"], row["low"], row["high"])]
        if row["forecaster"] in ("hold", "offline"):
            line += ["-"]
        else:
            line += [_share(row["recovered"], row["recovered_low"], row["recovered_high"])]
        for baseline in baselines:
            line += _difference(row, baseline)
        key = [row[name] for name in keys]
        lines.append(line + [number_text(means.get((*key, m), np.nan), "{:.3f}") for m in others])
    table = text_table(header, lines, len(left))
    return "\n".join([f"{told}\n" * bool(told), table, summary.attrs.get("method", "")]).strip()


def _difference(row: Mapping[str, Any], baseline: str) -> list[str]:
    """Three cells: mean paired difference, p, sequences better and worse."""
    name = f"vs_{baseline}"
    if row["forecaster"] == baseline or np.isnan(row[name]):
        return ["-"] * 3
    counts = f"{row[f'{name}_better']}/{row[f'{name}_worse']}"
    return [f"{row[name]:+.3f}", p_label(row[f"{name}_p"]), counts]


def _interval(value: float, low: float, high: float) -> str:
    return f"{value:.3f} [{low:.3f}, {high:.3f}]"


def _share(value: float, low: float, high: float) -> str:
    text = number_text(100 * value, "{:.1f}%")
    return text if np.isnan(low) else f"{text} [{100 * low:.0f}, {100 * high:.0f}]"
