"""The tables of a study: what the page shows, and CSV and LaTeX for a paper.

Tables for a paper show the settings that stand for all (see :mod:`lae_sim.report.study_view`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.comparison.statistics import ALL_TRACES
from lae_sim.files import written_whole
from lae_sim.report.study_text import number, percent
from lae_sim.report.study_view import (
    SETTINGS,
    View,
    eval_scale,
    run_of,
    setting_of,
    several,
    told_setting,
)
from lae_sim.report.table import Entry, Table, latex, p_label, printable, write_csv
from lae_sim.study.summary import MEAN, Row

if TYPE_CHECKING:
    from lae_sim.study.run import StudyResults


MOST_PAIRS = 300
"""Comparisons that are shown, at most, before only those of settings that stand for all are."""

_Cell = Callable[[Row], Entry]


def _number(
    name: str, form: str = ".3f", factor: float = 1, unit: str = "", ends: str = ""
) -> _Cell:
    """A number of a row, with its interval where it has one."""

    def entry(row: Mapping[str, Any]) -> Entry:
        value, low, high = (row.get(name + end) for end in ("", "_low", "_high"))
        if value is None or value != value:
            return Entry("-", None)
        text = f"{factor * value:{form}}{unit}"
        if low is None or high is None or low != low:
            return Entry(text, value)
        about = f"{factor * low:{ends or form}}, {factor * high:{ends or form}}"
        return Entry(f"{text} [{about}]", value, (low, high))

    return entry


def _share(name: str) -> _Cell:
    return lambda row: Entry(percent(row.get(name)), row.get(name))


def _p(name: str) -> _Cell:
    return lambda row: (
        Entry("-", None) if (p := row.get(name)) is None or p != p else Entry(p_label(p), p)
    )


def _name(key: str) -> _Cell:
    """A name, or an exact number that is sorted as one."""
    if key in ("scale", "fps"):
        return lambda row: Entry(str(row[key]), eval_scale(row[key]))
    return lambda row: Entry(printable(row[key]), str(row[key]))


def _change(now: float | None, before: float | None) -> Entry:
    """How much better or worse something is, relative to what it was."""
    if now is None or not before:
        return Entry("-", None)
    return Entry(f"{100 * (now / before - 1):+.1f}%", now / before - 1)


def _jitter(row: Row) -> Entry:
    if "auc_jitter_low" not in row:
        return Entry("-", None)
    low, high = row["auc_jitter_low"], row["auc_jitter_high"]
    return Entry(f"{low:.3f} to {high:.3f}", high - low, (low, high))


def _label(row: Row) -> Entry:
    share = row["approximate_share"]
    return Entry("exact" if row["exact"] else f"approximate ({100 * share:.3g}%)", share)


_RECOVERED = _number("recovered_auc", ".1f", 100, "%", ".0f")
_RANKING: dict[str, tuple[_Cell, str]] = {
    "n": (_number("sequences", ".0f"), "number of sequences"),
    "AUC": (_number("auc"), "with its 95 % interval over sequences"),
    "jitter": (_jitter, "the range of 95 % of the repetitions' AUC"),
    "offline": (_number("offline_auc"), "AUC without latency"),
    "change": (lambda row: _change(row["auc"], row["offline_auc"]), "of the AUC, to offline"),
    "recovered": (_RECOVERED, "share of the AUC lost to latency that the forecaster wins back"),
    "vs hold": (_number("vs_hold_auc", "+.3f"), "AUC won over hold"),
    "p": (_p("vs_hold_auc_p"), "of no difference to hold: Wilcoxon's signed-rank test over "
          "sequences, not corrected"),
    "DP": (_number("dp20"), "precision at 20 px"),
    "offline DP": (_number("offline_dp20"), "without latency"),
    "ms/call": (_number("elapsed_ms", ".1f"), "mean processing time"),
    "skipped": (_share("skip_rate"), "share of frames never processed"),
    "age ms": (_number("age_ms", ".0f"), "mean age of the outputs that answer, at the first sigma; "
               "what forecasting costs is not in it"),
    "stale ms": (_number("longest_stale_ms", ".0f"), "longest time that one output answered"),
    "failed": (_share("failed"), "share of sequences in which an answer misses the target wholly"),
    "to failure s": (_number("time_to_failure_ms", ".1f", 1e-3), "median time to the first such "
                     "answer (Kaplan and Meier); unknown if less than half fail"),
    "front": (lambda row: Entry("★" if row["pareto"] else "", int(row["pareto"])),
              "with the same forecaster, no other trace is both faster and better"),
    "replay": (_label, "the share of outputs that follow another frame than when recorded"),
    "engine": (_name("engine"), "batch, or simpy where policy or latency need it"),
}  # fmt: skip
TABLES = ("ranking", "table2", "attributes", "comparisons", "required")
_PAPER = ("AUC", "offline", "change", "recovered", "vs hold", "p", "DP", "ms/call")
LEGEND = {title: meaning for title, (_, meaning) in _RANKING.items()}
"""What the columns of the ranking mean."""


def ranking(view: View) -> Table:
    """A row per trace, setting and forecaster, the best AUC of a setting first."""
    differ = several(view.rows)

    def key(row: Row) -> tuple[str, ...]:
        return (row["dataset"], *(str(row[name]) for name in differ))

    order = {its: i for i, its in enumerate(dict.fromkeys(map(key, view.rows)))}
    rows = sorted(view.rows, key=lambda row: (order[key(row)], -(row["auc"] or 0)))
    header = ["tracker", "forecaster", "dataset", *differ]
    repeated = any("auc_jitter_low" in row for row in rows)
    titles = [title for title in _RANKING if repeated or title != "jitter"]
    cells = [*map(_name, header), *(_RANKING[title][0] for title in titles)]
    named = [{**row, "tracker": view.names[run_of(row)]} for row in rows]
    paper = [c for c, title in enumerate([*header, *titles]) if title in (
        "dataset", "tracker", "forecaster", *_PAPER
    )]  # fmt: skip
    return Table(
        "ranking",
        f"The best AUC of each setting first: {told_setting(rows)}",
        (*header, *titles),
        tuple(tuple(cell(row) for cell in cells) for row in named),
        len(header),
        paper=(paper, [i for i, row in enumerate(rows) if view.stands(row)]),
        paper_caption=f"The best AUC first: {told_setting(view.standing)}",
    )


def table2(view: View) -> Table:
    """Trackers with and without forecasters in rows, datasets in columns.

    In the manner of Table II of Li et al., "Predictive Visual Tracking", 2021: AUC and DP of each
    dataset, and how they change: without a forecaster relative to offline, with one relative to
    without. (Rows and columns are ours; the print may order them otherwise.)
    """
    rows = view.standing
    found = {(view.names[run_of(row)], row["dataset"], row["forecaster"]): row for row in rows}
    datasets = list(dict.fromkeys(row["dataset"] for row in rows))
    mean = "m" if rows[0]["sigma"] == MEAN else ""
    lines = []
    for tracker in dict.fromkeys(tracker for tracker, _, _ in found):
        for forecaster in ("offline", *view.forecasters):
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
        online = [line for line in lines if line[1].value != "offline" and line[c].value]
        for rank, text in enumerate(sorted({line[c].text for line in online})[:-3:-1], 1):
            for line in online:  # what reads the same is as good
                if line[c].text == text:
                    line[c] = Entry(text, line[c].value, rank=rank)
    return Table(
        "table2",
        "Trackers with and without forecasters: hold changes relative to offline, forecasters "
        "relative to hold; the best of each column under latency is bold, the second underlined; "
        + told_setting(rows),
        ("tracker", "forecaster", *[f"{mean}AUC", "Δ", f"{mean}DP", "Δ"] * len(datasets)),
        tuple(map(tuple, lines)),
        2,
        tuple((printable(dataset), 4) for dataset in datasets),
    )


def attribute_table(view: View) -> Table | None:
    """A row per attribute, tracker and forecaster; None if there are none."""
    if view.attributes is None:
        return None
    keys, rows, offline = ("dataset", "attribute", "trace"), [], {}
    for row in view.attributes.to_dict("records"):
        row |= {"mean_low": row["low"], "mean_high": row["high"]}
        if row["forecaster"] == "offline":
            offline[tuple(row[key] for key in keys)] = row["mean"]
            continue
        if row["forecaster"] == "hold":
            row |= dict.fromkeys(("vs_hold", "vs_hold_p", "recovered"))
        rows.append(row)
    cells = [
        *map(_name, (*keys, "forecaster")),
        _number("sequences", ".0f"), _number("mean"),
        lambda row: _number("mean")({"mean": offline.get(tuple(row[key] for key in keys))}),
        _number("vs_hold", "+.3f"), _p("vs_hold_p"),
        _number("recovered", ".1f", 100, "%", ".0f"),
    ]  # fmt: skip
    together = [i for i, row in enumerate(rows) if row["trace"] == ALL_TRACES]
    header = ("dataset", "attribute", "tracker", "forecaster", "n", "AUC", "offline", "vs hold")
    return Table(
        "attributes",
        "AUC on the sequences of each attribute (n of them), at the first sigma; "
        + told_setting(view.standing, but="sigma"),
        (*header, "p", "recovered"),
        tuple(tuple(cell(row) for cell in cells) for row in rows),
        4,
        paper=(range(len(cells)), together or range(len(rows))),
    )


def comparison_table(view: View) -> Table:
    """A row per pair of traces; where there are many, of settings that stand for all."""
    rows, told = list(view.results.comparisons), ""
    if len(rows) > MOST_PAIRS:
        rows = [row for row in rows if view.chosen[row["a"]] == setting_of(row)]
        told = f"; {len(view.results.comparisons):,} pairs of all settings are in comparisons.csv"
    keys = [key for key in ("dataset", *SETTINGS[1:]) if len({row[key] for row in rows}) > 1]
    keys += ["forecaster", "a", "b"]
    named = [{**row, "a": view.names[row["a"]], "b": view.names[row["b"]]} for row in rows]
    cells = [
        *map(_name, keys), _number("sequences", ".0f"), _number("difference", "+.3f"), _p("p"),
        _p("p_holm"),
        _number("better_here", ".2f"), _number("better", ".2f"),
    ]  # fmt: skip
    return Table(
        "comparisons",
        f"Trackers against each other{told}",
        (*keys, "n", "AUC of a - b", "p", "p (Holm)", "a better here", "a better"),
        tuple(tuple(cell(row) for cell in cells) for row in named),
        len(keys),
    )


def required_table(view: View) -> Table:
    """A row per trace, setting and forecaster: how slow it may be."""
    rows = [{**row, "trace": run_of(row)} for row in view.results.required]
    for row in rows:
        row["most"] = None if row["scale"] is None else eval_scale(row["scale"])
    keys = [key for key in ("policy", "fps", "latency", "convention")
            if len({row[key] for row in rows}) > 1]  # fmt: skip
    keys = ["trace", *keys, "forecaster"]
    cells = [
        *map(_name, keys), _number("required_auc", ".3g"), _number("auc_without_latency"),
        _number("most", ".2f"), _number("auc"), _number("speed_up", ".2f"),
        _number("fps_at_most", ".1f"),
    ]  # fmt: skip
    header = ("AUC asked", "without latency", "times at most x", "AUC there", "speed-up needed")
    return Table(
        "required",
        "How slow a device may be, and how fast the world may move (with the recorded motion from "
        f"frame to frame), for the required AUC at sigma {rows[0]['sigma']}",
        (*keys, *header, "world fps at most"),
        tuple(tuple(cell(row) for cell in cells) for row in rows),
        len(keys),
    )


def write_tables(results: StudyResults | View, folder: str | os.PathLike[str]) -> None:
    """Write every table as CSV, with numbers in full, and as LaTeX for a paper's ``input``.

    Args:
        results: of a study, or a view of them, which the report may have in common.
        folder: where to; made if it is not there.

    Raises:
        LaeError: if a file cannot be written.
    """
    view = results if isinstance(results, View) else View(results)
    results = view.results
    Path(folder).mkdir(parents=True, exist_ok=True)
    tables: Sequence[Table | None] = (
        ranking(view),
        table2(view),
        attribute_table(view),
        comparison_table(view) if results.comparisons else None,
        required_table(view) if results.required else None,
    )
    for stale in (*Path(folder).glob("*.csv"), *Path(folder).glob("*.tex")):
        if stale.stem in TABLES:
            stale.unlink()
    for table in tables:
        if table is not None:
            with written_whole(Path(folder, f"{table.name}.csv")) as temporary:
                write_csv(table, temporary)
            with written_whole(Path(folder, f"{table.name}.tex")) as temporary:
                temporary.write_text(latex(table), "utf-8")
