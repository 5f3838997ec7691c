"""The tables of a study: what the page shows, and CSV and LaTeX for a paper.

Where there are many settings, tables for a paper show one of each trace: the first that the study
names, at scale 1 if it has that (:func:`reference`). CSV holds all.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.errors import LaeError
from lae_sim.files import written_whole
from lae_sim.statistics import ALL_TRACES, by_attribute, p_label
from lae_sim.study_summary import MEAN, Row, Scores
from lae_sim.study_text import SETTINGS, eval_scale, number, percent, primary, several
from lae_sim.tabular import Entry, Table, latex, printable, write_csv

if TYPE_CHECKING:
    from pandas import DataFrame

    from lae_sim.study_run import StudyResults

MOST_PAIRS = 300
"""Comparisons that a page or paper shows, at most, before it shows one setting of each trace."""


def run_of(row: Mapping[str, Any]) -> str:
    """The trace of a row of the summary, and where its times come from, if from another."""
    trace, times = str(row["trace"]), row["times_from"]
    return trace if times == trace else f"{trace} at {times}"


def setting_of(row: Mapping[str, Any]) -> tuple[str, ...]:
    """The setting of a row of the summary, but for where its times come from."""
    return tuple(str(row[name]) for name in SETTINGS[1:])


def reference(rows: Iterable[Row]) -> dict[str, tuple[str, ...]]:
    """The setting that stands for all, of each run: the first, at scale 1 if there is one."""
    found: dict[str, tuple[str, ...]] = {}
    for row in rows:
        first = found.setdefault(run_of(row), setting_of(row))
        if row["scale"] == "1" and first[3] != "1":
            found[run_of(row)] = setting_of(row)
    return found


def referred(rows: Iterable[Row]) -> list[Row]:
    """The rows of the settings that stand for all."""
    rows = list(rows)
    chosen = reference(rows)
    return [row for row in rows if chosen[run_of(row)] == setting_of(row)]


def names(rows: Iterable[Row]) -> dict[str, str]:
    """Names of the runs: their trackers, where these tell the runs of each dataset apart."""
    runs = {run_of(row): (row["dataset"], row["tracker"]) for row in rows}
    alone = len(set(runs.values())) == len(runs) and (
        "unknown" not in {t for _, t in runs.values()}
    )
    return {run: printable(tracker if alone else run) for run, (_, tracker) in runs.items()}


def whole_rows(results: StudyResults) -> list[Row]:
    """Rows with intervals; those of means over sigma say how stale answers are at the first."""
    first: dict[tuple[str, ...], Row] = {}
    for row in results.summary:
        first.setdefault((run_of(row), *setting_of(row), row["forecaster"]), row)
    return [
        {**first[(run_of(row), *setting_of(row), row["forecaster"])], **row}
        if row["sigma"] == MEAN
        else row
        for row in primary(results.summary)
    ]


def told_setting(rows: Sequence[Row], but: str = "") -> str:
    """What some rows have in common, in words; one key may be left out."""
    parts = []
    labels = ("policy", "world", "latency", "times x", "convention")
    for name, label in zip(SETTINGS[1:], labels):
        values = {str(row[name]) for row in rows}
        value = (
            values.pop() if len(values) == 1 else "of each trace" if name == "fps" else "various"
        )
        unit = " fps" if name == "fps" and value[0].isdigit() else ""
        parts += [f"{label} {value}{unit}"] if name != but else []
    sigma = rows[0]["sigma"]
    told = "mean over sigma = 0, 0.02, ..., 1" if sigma == MEAN else f"sigma {sigma}"
    return ", ".join(parts if but == "sigma" else [*parts, told])


def _figure(row: Mapping[str, Any], name: str, form: str = ".3f", factor: float = 1) -> Entry:
    """A number of a row, with its interval where it has one."""
    value, low, high = (row.get(name + end) for end in ("", "_low", "_high"))
    if value is None or value != value:
        return Entry("-", None)
    sign = "%" if factor == 100 else ""
    text = f"{factor * value:{form}}{sign}"
    if low is None or high is None or low != low:
        return Entry(text, value)
    form = "+.0f" if sign and "+" in form else ".0f" if sign else form
    return Entry(f"{text} [{factor * low:{form}}, {factor * high:{form}}]", value, (low, high))


def _p(row: Mapping[str, Any], name: str) -> Entry:
    value = row.get(name)
    return Entry("-" if value is None else p_label(value), None if value != value else value)


def _name(row: Mapping[str, Any], key: str) -> Entry:
    return Entry(printable(row[key]), str(row[key]))


def _share(row: Mapping[str, Any], name: str) -> Entry:
    return Entry(percent(row.get(name)), row.get(name))


def _change(now: float | None, before: float | None) -> Entry:
    """How much better or worse something is, relative to what it was."""
    if now is None or not before:
        return Entry("-", None)
    return Entry(f"{100 * (now / before - 1):+.1f}%", now / before - 1)


def _jitter(row: Mapping[str, Any]) -> Entry:
    if "auc_jitter_low" not in row:
        return Entry("-", None)
    low, high = row["auc_jitter_low"], row["auc_jitter_high"]
    return Entry(f"{low:.3f} to {high:.3f}", high - low, (low, high))


def _label(row: Mapping[str, Any]) -> Entry:
    share = row["approximate_share"]
    return Entry("exact" if row["exact"] else f"approximate ({100 * share:.3g}%)", share)


_RANKING: dict[str, tuple[Callable[[Row], Entry], str]] = {
    "AUC": (lambda row: _figure(row, "auc"), "with its 95 % interval over sequences"),
    "jitter": (_jitter, "the range of 95 % of the repetitions' AUC"),
    "offline": (lambda row: _figure(row, "offline_auc"), "AUC without latency"),
    "change": (lambda row: _change(row["auc"], row["offline_auc"]), "of the AUC, to offline"),
    "recovered": (
        lambda row: _figure(row, "recovered_auc", ".1f", 100),
        "share of the AUC lost to latency that the forecaster wins back, with its interval",
    ),
    "vs hold": (lambda row: _figure(row, "vs_hold_auc", "+.3f"), "AUC won over hold"),
    "p": (lambda row: _p(row, "vs_hold_auc_p"), "that there is no difference to hold: Wilcoxon's "
          "signed-rank test over sequences, not corrected"),
    "DP": (lambda row: _figure(row, "dp20"), "precision at 20 px"),
    "offline DP": (lambda row: _figure(row, "offline_dp20"), "without latency"),
    "ms/call": (lambda row: _figure(row, "elapsed_ms", ".1f"), "mean processing time"),
    "skipped": (lambda row: _share(row, "skip_rate"), "share of frames never processed"),
    "age (ms)": (lambda row: _figure(row, "age_ms", ".0f"), "mean age of the answering output's "
                 "frame, at the first sigma"),
    "stale (ms)": (lambda row: _figure(row, "longest_stale_ms", ".0f"), "longest time that one "
                   "output had to answer"),
    "failed": (lambda row: _share(row, "failed"), "share of sequences in which the target is lost "
               "(no overlap) at least once"),
    "to failure (s)": (
        lambda row: _figure({"s": None if (ms := row.get("time_to_failure_ms")) is None
                             else ms / 1e3}, "s", ".1f"),
        "median time to failure (Kaplan and Meier); unknown if less than half fail",
    ),
    "front": (lambda row: Entry("★" if row["pareto"] else "", int(row["pareto"])),
              "no other trace is both faster and better"),
    "replay": (_label, "the share of outputs that follow another frame than when recorded"),
    "engine": (lambda row: _name(row, "engine"), "batch, or simpy where policy or latency need it"),
}  # fmt: skip
_PAPER = ("AUC", "offline", "change", "recovered", "vs hold", "p", "DP", "ms/call")
LEGEND = {title: meaning for title, (_, meaning) in _RANKING.items()}
"""What the columns of the ranking mean."""


def ranking(results: StudyResults) -> Table:
    """A row per trace, setting and forecaster, the best AUC of a setting first."""
    rows = whole_rows(results)
    differ, named = several(rows), names(rows)
    order = {key: i for i, key in enumerate(dict.fromkeys(_key(row, differ) for row in rows))}
    rows.sort(key=lambda row: (order[_key(row, differ)], -(row["auc"] or 0)))
    titles = [
        title
        for title in _RANKING
        if title != "jitter" or any("auc_jitter_low" in row for row in rows)
    ]
    left = ["dataset", *differ, "trace", "forecaster"]
    left = left[1:] if len({row["dataset"] for row in rows}) == 1 else left
    own = {run_of(row) for row in rows if named[run_of(row)] != row["trace"]}
    header = [*left[:-1], *(["tracker"] if own else []), left[-1]]
    entries = tuple(
        (
            *(_name({**row, "tracker": named[run_of(row)]}, key) for key in header),
            *(_RANKING[title][0](row) for title in titles),
        )
        for row in rows
    )
    chosen = {id(row) for row in referred(rows)}
    paper = [header.index(key) for key in header if key in ("dataset", "trace", "forecaster")]
    paper += [len(header) + i for i, title in enumerate(titles) if title in _PAPER]
    return Table(
        "ranking",
        "Ranking by AUC",
        (*header, *titles),
        entries,
        len(header),
        paper=(paper, [i for i, row in enumerate(rows) if id(row) in chosen]),
    )


def _key(row: Row, names: Sequence[str]) -> tuple[str, ...]:
    return (row["dataset"], *(str(row[name]) for name in names))


def table2(results: StudyResults) -> Table:
    """Trackers with and without forecasters in rows, datasets in columns.

    After Table II of Li et al., "Predictive Visual Tracking", 2021: AUC and DP of each dataset,
    and how they change: without a forecaster relative to offline, with one relative to without.
    """
    rows = referred(whole_rows(results))
    named = names(rows)
    found = {(named[run_of(row)], row["dataset"], row["forecaster"]): row for row in rows}
    trackers, datasets, forecasters = (
        list(dict.fromkeys(key[i] for key in found)) for i in range(3)
    )
    mean = "m" if rows[0]["sigma"] == MEAN else ""
    lines = []
    for tracker in trackers:
        for forecaster in ("offline", *forecasters):
            line = [Entry(tracker, tracker), Entry(printable(forecaster), forecaster)]
            for dataset in datasets:
                hold = found.get((tracker, dataset, "hold"), {})
                row = found.get((tracker, dataset, forecaster), {})
                for metric in ("auc", "dp20"):
                    offline, held = hold.get(f"offline_{metric}"), hold.get(metric)
                    now = offline if forecaster == "offline" else row.get(metric)
                    before = {"offline": None, "hold": offline}.get(forecaster, held)
                    line += [Entry(number(now), now), _change(now, before)]
            lines.append(line)
    for c in range(2, 2 + 4 * len(datasets), 2):
        online = {line[c].value for line in lines if line[1].value != "offline"} - {None}
        best = sorted(online, reverse=True)[:2]  # type: ignore[type-var]  # numbers alone
        for line in lines:
            if line[1].value != "offline" and line[c].value in best:
                line[c] = Entry(line[c].text, line[c].value, rank=1 + best.index(line[c].value))
    return Table(
        "table2",
        "Trackers with and without forecasters. Hold changes relative to offline, forecasters "
        "relative to hold; the best of each column under latency is bold, the second underlined. "
        f"{told_setting(rows).capitalize()}",
        ("tracker", "forecaster", *[f"{mean}AUC", "Δ", f"{mean}DP", "Δ"] * len(datasets)),
        tuple(map(tuple, lines)),
        2,
        tuple((printable(dataset), 4) for dataset in datasets),
    )


def attribute_summary(results: StudyResults) -> DataFrame | None:
    """:func:`lae_sim.statistics.by_attribute` of each dataset that names attributes, or None.

    At the first sigma and the setting that stands for all; a column ``dataset`` comes first.
    """
    import pandas as pd

    study = results.plan.study
    if not study.attributes:
        return None
    chosen, named = reference(results.summary), names(results.summary)
    found = []
    for dataset in dict.fromkeys(row["dataset"] for row in results.summary):
        rows: list[Row] = []
        attributes: dict[tuple[str, str], tuple[str, ...]] = {}
        for scores in results.scores:
            row = scores_row(scores)
            if row["dataset"] != dataset or chosen[run_of(row)] != setting_of(row):
                continue
            row |= {"trace": named[run_of(row)], "sigma": 0.0, "metric": "auc"}
            row |= {"scale": eval_scale(row["scale"])}
            values = {row["forecaster"]: scores.means["auc"][:, 0]}
            if row["forecaster"] == "hold":
                values["offline"] = scores.once["offline_auc"]
            for forecaster, its in values.items():
                rows += [
                    {**row, "forecaster": forecaster, "sequence": sequence, "value": value}
                    for sequence, value in zip(scores.sequences, its.tolist())
                    if value == value
                ]
            for sequence in scores.sequences:
                marks = map(printable, scores.source.metadata.attributes(sequence))
                attributes[dataset, sequence] = tuple(marks)
        if not any(attributes.values()):
            continue
        try:
            summary = by_attribute(
                pd.DataFrame(rows), attributes, baselines=("hold",), metrics=("auc",),
                seed=study.seed,
            )  # fmt: skip
        except LaeError:  # no sequence has scores of all forecasters
            continue
        summary.insert(0, "dataset", printable(dataset))
        found.append(summary)
    return pd.concat(found, ignore_index=True) if found else None


def scores_row(scores: Scores) -> Row:
    """What says which scores these are, as the rows of the summary say it."""
    setting = scores.setting
    return {
        "trace": setting.trace.label,
        "times_from": (setting.timing or setting.trace).label,
        "dataset": scores.source.metadata.dataset,
        "policy": setting.policy,
        "fps": str(setting.fps),
        "latency": setting.latency,
        "scale": str(setting.scale),
        "convention": scores.convention,
        "forecaster": scores.forecaster,
    }


def attribute_table(summary: DataFrame) -> Table:
    """A row per attribute, tracker and forecaster."""
    keys = ("dataset", "attribute", "trace", "forecaster")
    records = summary[summary["forecaster"] != "offline"].to_dict("records")
    offline = summary[summary["forecaster"] == "offline"].set_index([*keys[:3]])["mean"].to_dict()
    lines = []
    for row in records:
        row |= {"auc": row["mean"], "auc_low": row["low"], "auc_high": row["high"]}
        row |= {"offline": offline.get(tuple(row[key] for key in keys[:3]))}
        row |= {} if row["forecaster"] != "hold" else dict.fromkeys(("vs_hold", "recovered"))
        p = _p(row, "vs_hold_p") if row["vs_hold"] is not None else Entry("-", None)
        lines.append((
            *(_name(row, key) for key in keys),
            Entry(str(row["sequences"]), row["sequences"]), _figure(row, "auc"),
            _figure(row, "offline"), _figure(row, "vs_hold", "+.3f"), p,
            _figure(row, "recovered", ".1f", 100),
        ))  # fmt: skip
    together = [i for i, row in enumerate(records) if row["trace"] == ALL_TRACES]
    header = (*keys[:2], "tracker", "forecaster", "n", "AUC", "offline", "vs hold", "p")
    return Table(
        "attributes",
        "AUC on the sequences of each attribute (n of them), at the smallest permitted latency",
        (*header, "recovered"),
        tuple(lines),
        4,
        paper=(range(10), together or range(len(lines))),
    )


def comparison_table(results: StudyResults) -> Table:
    """A row per pair of traces; of many settings, those that stand for all."""
    rows, told = list(results.comparisons), ""
    if len(rows) > MOST_PAIRS:
        chosen = reference(results.summary)
        rows = [row for row in rows if chosen[row["a"]] == setting_of(row)]
        left_out = len(results.comparisons) - len(rows)
        told = f"; {left_out:,} pairs in other settings are in comparisons.csv" if left_out else ""
    differ = [key for key in ("dataset", *SETTINGS[1:]) if len({row[key] for row in rows}) > 1]
    named, keys = names(results.summary), [*differ, "forecaster", "a", "b"]
    lines = tuple(
        (
            *(_name({**row, "a": named[row["a"]], "b": named[row["b"]]}, key) for key in keys),
            _figure(row, "difference", "+.3f"), _p(row, "p"), _p(row, "p_holm"),
            _figure(row, "better_here", ".2f"), _figure(row, "better", ".2f"),
        )
        for row in rows
    )  # fmt: skip
    header = (*keys, "AUC of a - b", "p", "p (Holm)", "a better here", "a better")
    return Table("comparisons", f"Trackers against each other{told}", header, lines, len(keys))


def required_table(results: StudyResults) -> Table:
    """A row per trace, setting and forecaster: how slow it may be."""
    rows = results.required
    keys = [key for key in SETTINGS if len({str(row[key]) for row in rows}) > 1]
    keys = ["trace", *keys, "forecaster"]
    lines = tuple(
        (
            *(_name(row, key) for key in keys),
            _figure(row, "required_auc", ".3g"), _figure(row, "auc_without_latency"),
            _figure({"x": row["scale"] and eval_scale(row["scale"])}, "x", ".2f"),
            _figure(row, "auc"), _figure(row, "speed_up", ".2f"),
            _figure(row, "fps_at_most", ".1f"),
        )
        for row in rows
    )  # fmt: skip
    header = (*keys, "AUC asked", "without latency", "times at most x", "AUC there")
    caption = "How slow a device may be, and how fast the world, for the required AUC"
    header += ("speed-up needed", "world fps at most")
    return Table("required", caption, header, lines, len(keys))


def all_tables(results: StudyResults, attributes: DataFrame | None) -> list[Table]:
    """Those that a study has."""
    return [
        ranking(results),
        table2(results),
        *([] if attributes is None else [attribute_table(attributes)]),
        *([comparison_table(results)] if results.comparisons else []),
        *([required_table(results)] if results.required else []),
    ]


def write_tables(results: StudyResults, folder: str | os.PathLike[str]) -> None:
    """Write every table as CSV, with numbers in full, and as LaTeX for a paper's ``input``.

    Raises:
        LaeError: if a file cannot be written.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    for table in all_tables(results, attribute_summary(results)):
        with written_whole(Path(folder, f"{table.name}.csv")) as temporary:
            write_csv(table, temporary)
        with written_whole(Path(folder, f"{table.name}.tex")) as temporary:
            temporary.write_text(latex(table), "utf-8")
