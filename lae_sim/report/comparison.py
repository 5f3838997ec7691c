"""Comparisons as text: of forecasters, and of replays with the closed loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import fmean
from typing import TYPE_CHECKING, Any

from lae_sim.comparison.fidelity import (
    FAR_OFF,
    REPEATED_WITHIN,
    ClosedLoopSpread,
    FidelityRow,
    FidelitySummary,
)
from lae_sim.comparison.statistics import KEYS
from lae_sim.errors import visible
from lae_sim.figures.labels import METRIC_LABELS, setting_label
from lae_sim.report.paper import PaperTable, TrackerScores, in_two_forms, with_and_without
from lae_sim.report.table import (
    COUNT,
    PERCENT,
    SCORE,
    SIGNED,
    Column,
    Number,
    Table,
    ends_text,
    is_unknown,
    p_label,
    text_of,
)

if TYPE_CHECKING:
    import pandas as pd

    from lae_sim.trace.metadata import Metadata

Row = Mapping[str, Any]


def comparison_table(summary: pd.DataFrame, width: int | None = None) -> str:
    """The summary as text: a line per trace, setting and forecaster, then how it was computed.

    The first metric has intervals and tests, the others have their means; the search model's means
    have its own intervals. ``summary`` is what :func:`summarise` or :func:`by_attribute` gave, or
    some rows of it, perhaps with the columns of the model. ``width`` is as of
    :func:`lae_sim.report.table.text_of`.
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
        Column("n", "sequences", importance=3),
        Column(METRIC_LABELS.get(first, first), "mean", SCORE, importance=9),
        Column("recovered", "recovered", Number(".1f", 100, "%", ".0f")),
        *(column for baseline in baselines for column in _against(baseline)),
        *(Column(METRIC_LABELS.get(name, name), mean_of(name), SCORE, importance=4)
          for name in others),
    ]  # fmt: skip
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
    return caption + text_of(Table.of(columns, rows), [*intervals, "recovered"], width) + method


def paper_tables(
    summary: pd.DataFrame,
    metrics: Sequence[str],
    metadata: Mapping[str, Metadata],
    attributes: pd.DataFrame | None = None,
) -> list[PaperTable]:
    """The tables of a comparison, whole and for a paper.

    Args:
        summary: what :func:`summarise` gave.
        metrics: those compared: AUC first, then DP.
        metadata: of each trace.
        attributes: what :func:`by_attribute` gave.
    """
    tables = [_paper_table(summary, metrics[0], "comparison")]
    tables.append(_in_layout(summary, metrics, metadata))
    if attributes is not None:
        tables.append(_paper_table(attributes, metrics[0], "attributes"))
    return tables


def _paper_table(summary: pd.DataFrame, metric: str, name: str) -> PaperTable:
    """A row per trace, setting and forecaster; for a paper at the smallest sigma.

    In a column there are only means and what is recovered.
    """
    whole = _comparison(summary, metric, name)
    at_first = summary[summary["sigma"] == summary["sigma"].min()]
    long = _comparison(at_first, metric, name)
    short = long.only(lambda _, column: column.title not in ("n", "vs hold", "p"))
    return PaperTable(whole, long, short)


def _comparison(summary: pd.DataFrame, metric: str, name: str) -> Table:
    """A row per trace, setting and forecaster, with intervals."""
    label = METRIC_LABELS.get(metric, metric)
    rows = summary[summary["metric"] == metric]
    rows = rows.assign(trace=rows["trace"].str.removesuffix(".parquet"))
    rows = rows.assign(
        latency=[setting_label(*both) for both in zip(rows["latency"], rows["scale"])]
    )
    rows = rows.rename(columns={"low": "mean_low", "high": "mean_high"})
    labels = [*(["attribute"] if "attribute" in rows else []), "trace", "latency", "sigma"]
    shared = [f"{key} {rows[key].iloc[0]}" for key in labels[-3:-1] if rows[key].nunique() == 1]
    labels = [key for key in labels if rows[key].nunique() > 1]
    columns = [
        *(Column(key, key, is_label=True) for key in [*labels, "forecaster"]),
        Column("n", "sequences", COUNT),
        Column(label, "mean", SCORE, name=metric),
        Column("recovered", "recovered", Number(".1f", 100, "%", ".0f")),
        Column("vs hold", "vs_hold", SIGNED),
        Column("p", "vs_hold_p", p_label),
    ]
    records = rows.to_dict("records")
    for record in records:
        if record["forecaster"] in ("hold", "offline"):
            record["recovered"] = None
        if record["forecaster"] == "hold":
            record |= {"vs_hold": None, "vs_hold_p": None}
    caption = f"{label} of forecasters" + (" by attribute" if "attribute" in rows else "")
    return Table.of(columns, records, name, "; ".join([caption, *shared]))


def _in_layout(
    summary: pd.DataFrame, metrics: Sequence[str], metadata: Mapping[str, Metadata]
) -> PaperTable:
    """Trackers with and without forecasters, at the first sigma."""
    auc, dp20 = metrics[:2]
    rows = summary[
        summary["trace"].isin([*metadata]) & (summary["sigma"] == summary["sigma"].min())
    ]
    trackers = {name: visible(each.tracker) for name, each in metadata.items()}
    kinds = {(each.tracker, each.dataset) for each in metadata.values()}
    alone = len(kinds) == len(metadata) and "unknown" not in trackers.values()
    settings = ("latency", "scale")
    several = rows[[*settings]].drop_duplicates().shape[0] > 1
    scores = []
    for (trace, latency, scale), group in rows.groupby(["trace", *settings], sort=False):
        means = group.set_index(["forecaster", "metric"])["mean"].to_dict()
        name = trackers[trace] if alone else trace.removesuffix(".parquet")
        name += f", {setting_label(latency, scale)}" if several else ""
        offline = {"auc": means.get(("offline", auc)), "dp20": means.get(("offline", dp20))}
        for forecaster in dict.fromkeys(group["forecaster"]):
            if forecaster != "offline":
                of = {"auc": means[forecaster, auc], "dp20": means.get((forecaster, dp20))}
                dataset = str(metadata[trace].dataset)
                scores.append(TrackerScores(name, dataset, forecaster, of, offline))
    titles = {key: METRIC_LABELS[metric].replace("DP@20", "DP") for key, metric in
              zip(("auc", "dp20"), metrics)}  # fmt: skip
    latencies = [setting_label(*each) for each in zip(rows["latency"], rows["scale"])]
    setting = f"sigma {rows['sigma'].iloc[0]:g}" if "mauc" not in auc else "mean over sigma"
    setting += "" if several else f", latency {latencies[0]}"
    forecasters = dict.fromkeys(row.forecaster for row in scores)
    return in_two_forms(with_and_without(scores, forecasters, titles, setting))


def _ends(name: str, row: Row) -> str | None:
    """The ends of an interval."""
    return ends_text(row[f"{name}_low"], row[f"{name}_high"])


def _against(baseline: str) -> list[Column]:
    """The mean paired difference to a baseline, its p, the sequences better and worse."""
    name = f"vs_{baseline}"
    importance = 8 if baseline == "hold" else 2

    def where_known(text: Callable[[Row], str]) -> Callable[[Row], str | None]:
        return lambda row: None if is_unknown(row[name]) else text(row)

    return [
        Column(f"vs {baseline}", name, SIGNED, importance=importance),
        Column("p", where_known(lambda row: p_label(row[f"{name}_p"])),
               name=f"p vs {baseline}", importance=importance - 1),
        Column("+/-", where_known(lambda row: f"{row[f'{name}_better']}/{row[f'{name}_worse']}"),
               name=f"+/- vs {baseline}", importance=2),
    ]  # fmt: skip


_REPLAYED = ("closed_loop", "forecaster", "replay")
_FIDELITY = {
    "closed_auc": ("closed AUC", SCORE),
    "auc": ("AUC", SCORE),
    "mean_abs_d_auc": ("mean |d|", SCORE),
    "median_abs_d_auc": ("median", SCORE),
    "max_abs_d_auc": ("max", SCORE),
    "d_auc": ("d", SIGNED),
    "covered": ("covered", PERCENT),
    "width_auc": ("width", SCORE),
    "closed_dp20": ("closed DP", SCORE),
    "dp20": ("DP", SCORE),
    "mean_abs_d_dp20": ("mean |d|", SCORE),
    "d_dp20": ("d", SIGNED),
    "covered_dp20": ("covered", PERCENT),
}
_IMPORTANT = {"mean_abs_d_auc": 9, "auc": 8, "closed_auc": 8, "d_auc": 7, "covered": 7}


def fidelity_table(
    rows: Sequence[FidelityRow] | Sequence[FidelitySummary], width: int | None = None
) -> str:
    """How far replays are from closed loops: a line per closed loop, forecaster and replay.

    Of rows per sequence, a line each. ``width`` is as of :func:`lae_sim.report.table.text_of`.
    """
    each = isinstance(rows[0], FidelityRow)
    labels = [*_REPLAYED, "sequence"] if each else _REPLAYED
    columns = [Column(key.replace("_", " "), key, is_label=True) for key in labels]
    if not each:
        columns.append(Column("sequences", "sequences"))
    columns += [
        Column(
            title,
            key,
            _yes_or_no if each and key.startswith("covered") else form,
            name=f"{title} of DP" if key.endswith("_dp20") else title,
            importance=_IMPORTANT.get(key, 3 if key.endswith("dp20") else 5),
        )
        for key, (title, form) in _FIDELITY.items()
        if any(getattr(row, key, None) is not None for row in rows)
    ]
    if each:
        columns += [Column("parted at", "parted"), Column("disagree", "disagreement", SCORE)]
    return text_of(Table.of(columns, rows), width=width)


def _yes_or_no(value: bool) -> str:
    return "yes" if value else "no"


def spread_table(spreads: Sequence[ClosedLoopSpread], width: int | None = None) -> str:
    """How far closed loops of one setting are apart: a line per setting and sequence."""
    several = {each.trace for each in spreads}
    columns = [Column("trace", "trace", is_label=True)] if len(several) > 1 else []
    columns += [
        Column("setting", "setting", is_label=True),
        Column("forecaster", "forecaster", is_label=True),
        Column("sequence", "sequence", is_label=True),
        Column("closed loops", "closed_loops"),
        Column("lowest AUC", "auc_low", SCORE),
        Column("highest", "auc_high", SCORE),
        Column("apart", "spread", SCORE),
    ]
    return text_of(Table.of(columns, spreads), width=width)


_KINDS = {"strided": "strided passes", "every-frame": "recorded boxes alone"}


def fidelity_verdicts(
    rows: Sequence[FidelityRow], spreads: Sequence[ClosedLoopSpread] = ()
) -> list[str]:
    """How far the replays of each tracker can be trusted, and where not: a sentence each.

    Of several forecasters, it is the first that counts.
    """
    first = [row for row in rows if row.forecaster == rows[0].forecaster]
    trackers = dict.fromkeys(row.tracker for row in first)
    return [
        _verdict(tracker, [row for row in first if row.tracker == tracker], spreads)
        for tracker in trackers
    ]


def _verdict(tracker: str, rows: Sequence[FidelityRow], spreads: Sequence[ClosedLoopSpread]) -> str:
    by_kind: dict[str, list[FidelityRow]] = {}
    for row in rows:
        if not is_unknown(row.d_auc):
            by_kind.setdefault(row.replay, []).append(row)
    if not by_kind:
        return f"No sequence of {tracker} has a score."
    off = {kind: fmean(abs(row.d_auc) for row in of) for kind, of in by_kind.items()}
    best = next(kind for kind in ("modelled", "strided", "every-frame") if kind in off)
    others = ", ".join(f"{name} {SCORE(off[kind])}" for kind, name in _KINDS.items()
                       if kind in off and kind != best)  # fmt: skip
    what = "Modelled replays" if best == "modelled" else f"Replays of {_KINDS[best]}"
    said = f"{what} of {tracker} are within {SCORE(off[best])} AUC of its closed loops on average"
    parts = [said + (f" ({others})" if others else "")]
    counted = [row for row in by_kind[best] if row.covered is not None]
    if counted:
        share, count = fmean(bool(row.covered) for row in counted), len(counted)
        known = all(row.c_known is not False for row in counted)
        width = fmean((row.auc_high or 0.0) - (row.auc_low or 0.0) for row in counted)
        spans = "95 % intervals cover" if known else "the range assumed of its reach covers"
        parts.append(f"{spans} {share:.0%} of {count:,} closed-loop runs, {SCORE(width)} wide")
    by_sequence: dict[str, list[float]] = {}
    for row in by_kind[best]:
        by_sequence.setdefault(row.sequence, []).append(abs(row.d_auc))
    mine = {(row.trace, row.forecaster) for row in rows}
    apart = {
        each.sequence: None
        for each in spreads
        if (each.trace, each.forecaster) in mine and each.spread > REPEATED_WITHIN
    }
    far = [name for name, values in by_sequence.items() if fmean(values) > FAR_OFF]
    doubts = [f"{', '.join(far)} (off by more than {FAR_OFF:g} on average)"] if far else []
    if apart:
        doubts.append(
            f"{', '.join(apart)} (closed loops of one setting differ by more than "
            f"{REPEATED_WITHIN:g} among themselves: a single figure is luck)"
        )
    where = f"do not trust them on {' and '.join(doubts)}" if doubts else (
        f"on no sequence are they off by more than {FAR_OFF:g} on average"
    )  # fmt: skip
    return "; ".join([*parts, where]) + "."
