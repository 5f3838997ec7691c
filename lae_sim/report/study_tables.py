"""The tables of a study: for its page, as CSV and LaTeX for a paper, and as text for a terminal.

Tables for a paper show the settings that stand for all (see :mod:`lae_sim.report.study_view`), and
those for a terminal fewer columns.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.comparison.statistics import ALL_TRACES
from lae_sim.files import written_whole
from lae_sim.report.study_view import (
    SETTINGS,
    View,
    eval_scale,
    run_of,
    setting_of,
    several,
    shared_setting,
)
from lae_sim.report.table import (
    CHANGE,
    PERCENT,
    SCORE,
    SIGNED,
    UNKNOWN,
    Cell,
    Column,
    Interval,
    Number,
    Table,
    latex_of,
    p_label,
    printable,
    relative_change,
    text_of,
    write_csv,
)
from lae_sim.study.summary import MEAN

if TYPE_CHECKING:
    from lae_sim.study.run import StudyResults

Row = Mapping[str, Any]

MOST_PAIRS = 300
"""Comparisons that are shown, at most, before only those of settings that stand for all are."""


def _field(key: str) -> Callable[[Row], Any]:
    """A value of a row, None where the row has none."""
    return lambda row: row.get(key)


def _ends(key: str) -> Callable[[Row], Interval | None]:
    """The interval of a value of a row."""

    def interval(row: Row) -> Interval | None:
        low, high = row.get(f"{key}_low"), row.get(f"{key}_high")
        return None if low is None or high is None else (low, high)

    return interval


def _number(title: str, key: str, form: Number = SCORE, meaning: str = "") -> Column:
    """A column of numbers, with their intervals where they have some."""
    return Column(title, _field(key), form, _ends(key), meaning)


def _label(key: str, value: Callable[[Row], object] | None = None) -> Column:
    """A column of names, or of exact numbers, which are sorted as such."""
    value = value or _field(key)
    if key in ("scale", "fps"):
        return Column(
            key, lambda row: Cell(str(value(row)), eval_scale(str(value(row)))), is_label=True
        )
    return Column(key, lambda row: str(value(row)), is_label=True)


def _jitter(row: Row) -> Cell:
    ends = _ends("auc_jitter")(row)
    if ends is None:
        return UNKNOWN
    return Cell(f"{ends[0]:.3f} to {ends[1]:.3f}", ends[1] - ends[0], ends)


def _exactness(row: Row) -> Cell:
    share = row["approximate_share"]
    return Cell("exact" if row["exact"] else f"approximate ({100 * share:.3g}%)", share)


_COUNT, _RECOVERED = Number(".0f"), Number(".1f", 100, "%", ".0f")
_RANKING = (
    _number("n", "sequences", _COUNT, "number of sequences"),
    _number("AUC", "auc", meaning="with its 95 % interval over sequences"),
    Column("jitter", _jitter, meaning="the range of 95 % of the repetitions' AUC"),
    _number("offline", "offline_auc", meaning="AUC without latency"),
    Column("change", lambda row: relative_change(row["auc"], row["offline_auc"]), CHANGE,
           meaning="of the AUC, to offline"),
    _number("recovered", "recovered_auc", _RECOVERED,
            "share of the AUC lost to latency that the forecaster wins back"),
    _number("vs hold", "vs_hold_auc", SIGNED, "AUC won over hold"),
    Column("p", _field("vs_hold_auc_p"), p_label, meaning="of no difference to hold: Wilcoxon's "
           "signed-rank test over sequences, not corrected"),
    _number("DP", "dp20", meaning="precision at 20 px"),
    _number("offline DP", "offline_dp20", meaning="without latency"),
    _number("ms/call", "elapsed_ms", Number(".1f"), "mean processing time"),
    _number("skipped", "skip_rate", PERCENT, "share of frames never processed"),
    _number("age ms", "age_ms", Number(".0f"), "mean age of the outputs that answer, at the first "
            "sigma; what forecasting costs is not in it"),
    _number("stale ms", "longest_stale_ms", Number(".0f"), "longest time that one output answered"),
    _number("failed", "failed", PERCENT,
            "share of sequences in which an answer misses the target wholly"),
    _number("to failure s", "time_to_failure_ms", Number(".1f", 1e-3), "median time to the first "
            "such answer (Kaplan and Meier); unknown if less than half fail"),
    Column("front", lambda row: Cell("★" if row["pareto"] else "", int(row["pareto"])),
           meaning="with the same forecaster, no other trace is both faster and better"),
    Column("replay", _exactness,
           meaning="the share of outputs that follow another frame than when recorded"),
    Column("engine", _field("engine"), meaning="batch, or simpy where policy or latency need it"),
)  # fmt: skip
_PAPER = ("AUC", "offline", "change", "recovered", "vs hold", "p", "DP", "ms/call")
_TERMINAL = ("n", "AUC", "jitter", "offline", "recovered", "vs hold", "p", "DP", "ms/call",
             "skipped", "age ms")  # fmt: skip


def _ranked(view: View) -> list[Row]:
    """The best AUC of each setting first."""
    keys = ("dataset", *several(view.rows))
    settings = [tuple(str(row[key]) for key in keys) for row in view.rows]
    order = {setting: i for i, setting in reversed([*enumerate(settings)])}
    ranks = [(order[s], -(row["auc"] or 0)) for s, row in zip(settings, view.rows)]
    return [view.rows[i] for i in sorted(range(len(ranks)), key=ranks.__getitem__)]


def _ranking_columns(
    view: View, titles: Container[str], settings: Sequence[str] = ()
) -> list[Column]:
    repeated = any("auc_jitter_low" in row for row in view.rows)
    return [
        _label("tracker", lambda row: view.names[run_of(row)]),
        *map(_label, ("forecaster", "dataset", *settings)),
        *(column for column in _RANKING if column.title in titles
          and (repeated or column.title != "jitter")),
    ]  # fmt: skip


def ranking(view: View, for_paper: bool = False) -> Table:
    """A row per trace, setting and forecaster, the best AUC of a setting first."""
    rows = _ranked(view)
    if for_paper:
        rows = [row for row in rows if view.stands(row)]
        caption = f"The best AUC first: {shared_setting(view.standing)}"
        return Table.of(_ranking_columns(view, _PAPER), rows, "ranking", caption)
    columns = _ranking_columns(view, {c.title for c in _RANKING}, several(view.rows))
    caption = f"The best AUC of each setting first: {shared_setting(rows)}"
    return Table.of(columns, rows, "ranking", caption)


def table2(view: View) -> Table:
    """Trackers with and without forecasters in rows, datasets in columns.

    In the manner of Table II of Li et al., "Predictive Visual Tracking", 2021: AUC and DP of each
    dataset, and how they change: without a forecaster relative to offline, with one relative to
    without. (Rows and columns are ours; the print may order them otherwise.)
    """
    rows = view.standing
    by_name = {(view.names[run_of(row)], row["dataset"], row["forecaster"]): row for row in rows}
    trackers = dict.fromkeys(tracker for tracker, _, _ in by_name)
    mean = "m" if rows[0]["sigma"] == MEAN else ""

    def columns(dataset: str, metric: str, title: str) -> list[Column]:
        """A score and its change; records are a tracker and a forecaster."""

        def score(record: tuple[str, str]) -> float | None:
            tracker, forecaster = record
            offline = forecaster == "offline"
            row = by_name.get((tracker, dataset, "hold" if offline else forecaster), {})
            return row.get(f"offline_{metric}" if offline else metric)

        def change(record: tuple[str, str]) -> float | None:
            tracker, forecaster = record
            if forecaster == "offline":
                return None
            before = "offline" if forecaster == "hold" else "hold"
            return relative_change(score(record), score((tracker, before)))

        group = printable(dataset)
        return [
            Column(title, score, SCORE, group=group),
            Column("Δ", change, CHANGE, group=group, name=f"{title} Δ"),
        ]

    scores = [
        column
        for dataset in dict.fromkeys(row["dataset"] for row in rows)
        for metric, title in (("auc", f"{mean}AUC"), ("dp20", f"{mean}DP"))
        for column in columns(dataset, metric, title)
    ]
    table = Table.of(
        [
            Column("tracker", itemgetter(0), is_label=True),
            Column("forecaster", itemgetter(1), is_label=True),
            *scores,
        ],
        product(trackers, ("offline", *view.forecasters)),
        "table2",
        "Trackers with and without forecasters: hold changes relative to offline, forecasters "
        "relative to hold; the best of each column under latency is bold, the second underlined; "
        + shared_setting(rows),
    )
    places = [c for c, column in enumerate(table.columns) if column.form is SCORE]
    return replace(table, rows=_with_ranks(table.rows, places))


def _with_ranks(
    rows: Iterable[tuple[Cell, ...]], columns: Sequence[int]
) -> tuple[tuple[Cell, ...], ...]:
    """Mark the best and the second best of some columns, but for offline."""
    lines = [list(row) for row in rows]
    for c in columns:
        online = [line for line in lines if line[1].value != "offline" and line[c].value]
        for rank, text in enumerate(sorted({line[c].text for line in online})[:-3:-1], 1):
            for line in online:  # what reads the same is as good
                if line[c].text == text:
                    line[c] = replace(line[c], rank=rank)
    return tuple(map(tuple, lines))


def attribute_table(view: View, for_paper: bool = False) -> Table | None:
    """A row per attribute, tracker and forecaster; None if there are none."""
    if view.attributes is None:
        return None
    records = view.attributes.to_dict("records")
    keys = ("dataset", "attribute", "trace")
    offline = {
        tuple(row[key] for key in keys): row["mean"]
        for row in records
        if row["forecaster"] == "offline"
    }
    rows = [row for row in records if row["forecaster"] != "offline"]
    together = [row for row in rows if row["trace"] == ALL_TRACES]

    def against_hold(key: str) -> Callable[[Row], Any]:
        return lambda row: None if row["forecaster"] == "hold" else row[key]

    columns = [
        _label("dataset"), _label("attribute"),
        replace(_label("trace"), title="tracker"), _label("forecaster"),
        _number("n", "sequences", _COUNT),
        Column("AUC", _field("mean"), SCORE, lambda row: (row["low"], row["high"])),
        Column("offline", lambda row: offline.get(tuple(row[key] for key in keys)), SCORE),
        Column("vs hold", against_hold("vs_hold"), SIGNED, _ends("vs_hold")),
        Column("p", against_hold("vs_hold_p"), p_label),
        Column("recovered", against_hold("recovered"), _RECOVERED, _ends("recovered")),
    ]  # fmt: skip
    return Table.of(
        columns,
        (for_paper and together) or rows,
        "attributes",
        "AUC on the sequences of each attribute (n of them), at the first sigma; "
        + shared_setting(view.standing, but="sigma"),
    )


def comparison_table(view: View) -> Table:
    """A row per pair of traces; where there are many, of settings that stand for all."""
    rows, left_out = list(view.results.comparisons), ""
    if len(rows) > MOST_PAIRS:
        rows = [row for row in rows if view.chosen[row["a"]] == setting_of(row)]
        left_out = f"; {len(view.results.comparisons):,} pairs of all settings are in "
        left_out += "comparisons.csv"
    keys = _differing(rows, ("dataset", *SETTINGS[1:]))
    columns = [
        *map(_label, (*keys, "forecaster")),
        _label("a", lambda row: view.names[row["a"]]),
        _label("b", lambda row: view.names[row["b"]]),
        _number("n", "sequences", _COUNT),
        _number("AUC of a - b", "difference", SIGNED),
        Column("p", _field("p"), p_label),
        Column("p (Holm)", _field("p_holm"), p_label),
        _number("a better here", "better_here", Number(".2f")),
        _number("a better", "better", Number(".2f")),
    ]
    return Table.of(columns, rows, "comparisons", f"Trackers against each other{left_out}")


def required_table(view: View) -> Table:
    """A row per trace, setting and forecaster: how slow it may be."""
    rows = view.results.required
    keys = _differing(rows, ("policy", "fps", "latency", "convention"))
    columns = [
        _label("trace", run_of),
        *map(_label, (*keys, "forecaster")),
        _number("AUC asked", "required_auc", Number(".3g")),
        _number("without latency", "auc_without_latency"),
        Column("times at most x", _most, Number(".2f")),
        _number("AUC there", "auc"),
        _number("speed-up needed", "speed_up", Number(".2f")),
        _number("world fps at most", "fps_at_most", Number(".1f")),
    ]
    return Table.of(
        columns,
        rows,
        "required",
        "How slow a device may be, and how fast the world may move (with the recorded motion from "
        f"frame to frame), for the required AUC at sigma {rows[0]['sigma']}",
    )


def _most(row: Row) -> float | None:
    return None if row["scale"] is None else eval_scale(row["scale"])


def _differing(rows: Iterable[Row], keys: Iterable[str]) -> list[str]:
    """The keys whose values differ between rows."""
    return [key for key in keys if len({row[key] for row in rows}) > 1]


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
    compared = comparison_table(view) if results.comparisons else None
    required = required_table(view) if results.required else None
    tables = {  # whole, and for a paper
        "ranking": (ranking(view), ranking(view, for_paper=True)),
        "table2": (table2(view),) * 2,
        "attributes": (attribute_table(view), attribute_table(view, for_paper=True)),
        "comparisons": (compared, compared),
        "required": (required, required),
    }
    for name, (whole, for_paper) in tables.items():
        csv, tex = (Path(folder, f"{name}.{ending}") for ending in ("csv", "tex"))
        for path in (csv, tex):
            path.unlink(missing_ok=True)  # it would be of other results
        if whole is not None and for_paper is not None:
            with written_whole(csv) as temporary:
                write_csv(whole, temporary)
            with written_whole(tex) as temporary:
                temporary.write_text(latex_of(for_paper), "utf-8")


def study_text(results: StudyResults | View) -> str:
    """The tables for a terminal, then what they rest on."""
    view = results if isinstance(results, View) else View(results)
    results, parts = view.results, [_ranking_text(view)]
    repeated = any(row["repetitions"] > 1 for row in view.rows)
    if results.comparisons and (repeated or len(results.comparisons) <= 30):
        parts.append(
            f"{text_of(comparison_table(view))}\na better here: probability that one run of a "
            "beats one of b on these sequences; a better: on others like them"
        )
    if results.required:
        parts.append(_required_text(view))
    lines = [f"{len(results.plan.cells)} cells, {results.computed} of them computed now"]
    approximate = [row["approximate_share"] for row in view.rows if not row["exact"]]
    if approximate:
        lines.append(
            f"approximate: up to {100 * max(approximate):.3g}% of the outputs of a replay follow "
            "another frame than when recorded"
        )
    lines += [f"not computed: {each['of']}: {each['reason']}" for each in results.failures]
    return "\n\n".join([*parts, "\n".join([*lines, *results.notes()])])


def _ranking_text(view: View) -> str:
    rows = _ranked(view)
    front = Column("front", lambda row: "*" * row["pareto"])  # not every terminal has stars
    columns = [
        column if column.title == "AUC" else replace(column, interval=None)
        for column in _ranking_columns(view, _TERMINAL, several(view.rows))
        if column.title != "dataset" or _differing(rows, ["dataset"])
    ] + [front]
    return (
        f"{shared_setting(rows)}\n{text_of(Table.of(columns, rows))}\n"
        "[ ]: 95 % bootstrap over sequences; jitter: 95 % of the repetitions; p: Wilcoxon's "
        "signed-rank test;\nn: sequences; front: with this forecaster no other trace is both "
        "faster and better" + "; age at the first sigma" * bool(rows[0]["sigma"] == MEAN)
    )


def _required_text(view: View) -> str:
    table, rows = required_table(view), view.results.required
    at_least = [" " if row["beyond"] is not None else ">=" for row in rows]
    place = table.header.index("times at most x")
    cells = [
        (*row[:place], replace(row[place], text=f"{sign} {row[place].text}"), *row[place + 1 :])
        if row[place] != UNKNOWN
        else row
        for row, sign in zip(table.rows, at_least)
    ]
    return (
        f"{text_of(replace(table, rows=tuple(cells)))}\ntimes at most: by bisection, in steps of "
        f"0.01; all at sigma {rows[0]['sigma']}; world fps at most: how fast the\nworld may move, "
        "with the recorded motion from frame to frame (unknown where a cost or a policy has a time "
        "of its own)"
    )
