"""The tables of a study: for its page, as CSV and LaTeX for a paper, and as text for a terminal.

Tables for a paper show the settings that stand for all (see :mod:`lae_sim.study.view`), and
those for a terminal fewer columns.
"""

from __future__ import annotations

import os
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.comparison.statistics import ALL_TRACES
from lae_sim.errors import LaeError
from lae_sim.report.paper import (
    PaperTable,
    TrackerScores,
    in_two_forms,
    with_and_without,
    write_table,
)
from lae_sim.report.table import (
    CHANGE,
    FINE_SCORE,
    PERCENT,
    SCORE,
    SIGNED,
    Cell,
    Column,
    Number,
    Table,
    filled,
    legend_of,
    p_label,
    relative_change,
    text_of,
)
from lae_sim.study.records import Comparison, Requirement, SummaryRow
from lae_sim.study.verdict import device_in_words, shortfalls, significant
from lae_sim.study.view import (
    SETTINGS,
    View,
    run_of,
    score_name,
    setting_of,
    several,
    shared_setting,
)

if TYPE_CHECKING:
    from lae_sim.study.run import StudyResults

Row = Mapping[str, Any]

MOST_PAIRS = 300
"""Comparisons that are shown, at most, before only those of settings that stand for all are; and of
these, the nearest to the best of each setting."""

MOST_ROWS, MOST_TRACKERS, MOST_LINES = 400, 40, 60
"""Rows of a ranking, trackers of a table of them, and lines of a list that are shown, at most.

Files of numbers have them all."""


def _names(keys: Iterable[str]) -> list[Column]:
    """Columns of names, and of exact numbers, whose values are numbers."""
    exact = {key: partial(_exact, key) for key in ("scale", "fps")}
    return [Column(key, exact.get(key, key), is_label=True) for key in keys]


def _exact(key: str, row: Row) -> Cell:
    return Cell(str(row[key]), float(Fraction(row[key])))


def _jitter(row: Row) -> Cell | None:
    if "auc_jitter_low" not in row:
        return None
    low, high = row["auc_jitter_low"], row["auc_jitter_high"]
    return Cell(f"{low:.3f} to {high:.3f}", high - low, (low, high))


def _exactness(row: Row) -> Cell:
    share = row["approximate_share"]
    return Cell("exact" if row["exact"] else f"approximate ({100 * share:.3g}%)", share)


_COUNT, _MS, _RATIO, _RECOVERED = (
    Number(".0f"), Number(".1f"), Number(".2f"), Number(".1f", 100, "%", ".0f")
)  # fmt: skip
_RANKING = (
    Column("n", "sequences", _COUNT, "number of sequences", importance=3),
    Column("AUC", "auc", SCORE, "with its 95 % interval over sequences", importance=9),
    Column("modelled", "modelled_auc", SCORE, "AUC under the search model, with its interval",
           importance=8),
    Column("ranked by", "ranked_by", meaning="whose AUC is ranked, compared and tested",
           importance=2),
    Column("jitter", _jitter, meaning="the range of 95 % of the repetitions' AUC",
           name="auc_jitter", importance=3),
    Column("offline", "offline_auc", SCORE, "AUC without latency"),
    Column("change", lambda row: relative_change(row["ranked_auc"], row["offline_auc"]), CHANGE,
           "of the AUC, to offline", name="auc_change", importance=3),
    Column("recovered", "recovered_auc", _RECOVERED,
           "share of the AUC lost to latency that the forecaster wins back"),
    Column("vs hold", "vs_hold_auc", SIGNED, "AUC won over hold", importance=7),
    Column("p", "vs_hold_auc_p", p_label, "of no difference to hold: Wilcoxon's signed-rank test "
           "over sequences, not corrected", importance=6),
    Column("vs best", "vs_best_auc", SIGNED, "AUC to the best of the same setting and sequences",
           importance=6),
    Column("p (best)", "vs_best_auc_p_holm", p_label, "of no difference to the best: the same "
           "test, corrected by Holm's method for the number of those compared with it"),
    Column("DP", "dp20", SCORE, "precision at 20 px"),
    Column("modelled DP", "modelled_dp20", SCORE, "under the search model", importance=3),
    Column("lost", "lost_share", PERCENT, "share of the outputs answered while the target is lost",
           importance=3),
    Column("offline DP", "offline_dp20", SCORE, "without latency", importance=3),
    Column("ms/call", "elapsed_ms", _MS, "mean processing time", importance=6),
    Column("init ms", "init_ms", _MS, "mean time of an initialisation; the notes say where from",
           importance=2),
    Column("skipped", "skip_rate", PERCENT, "share of frames never processed"),
    Column("age ms", "age_ms", _COUNT, "mean age of the outputs that answer, at the first sigma; "
           "what forecasting costs is not in it", importance=4),
    Column("stale ms", "longest_stale_ms", _COUNT, "longest time that one output answered",
           importance=3),
    Column("failed", "failed", PERCENT,
           "share of sequences in which an answer misses the target wholly", importance=3),
    Column("to failure s", "time_to_failure_ms", Number(".1f", 1e-3), "median time to the first "
           "such answer (Kaplan and Meier); unknown if less than half fail", importance=3),
    Column("J/frame", "joules_per_frame", Number(".3g"), "energy of the device during a call",
           importance=6),
    Column("W", "watts", Number(".3g"), "mean power of the device while it tracks: that at rest, "
           "and what each processed frame takes above it", importance=4),
    Column("AUC/W", "auc_per_watt", Number(".3g"), "the AUC that is ranked, over this power",
           importance=6),
    Column("energy front", lambda row: Cell("★" if row.get("energy_pareto") else "",
                                            int(row.get("energy_pareto", False))),
           meaning="with the same forecaster, no other trace takes less energy and is better",
           name="energy_pareto"),
    Column("front", lambda row: Cell("★" if row["pareto"] else "", int(row["pareto"])),
           meaning="with the same forecaster, no other trace is both faster and better",
           name="pareto"),
    Column("replay", _exactness,
           meaning="the share of outputs that follow another frame than when recorded",
           name="approximate_share", importance=3),
    Column("engine", "engine", meaning="batch, or simpy where policy or latency need it",
           importance=3),
)  # fmt: skip
_COLUMN = ("AUC", "modelled", "offline", "DP", "ms/call")
_PAPER = ("AUC", "modelled", "offline", "change", "recovered", "vs hold", "p", "DP", "ms/call")
_REQUIRED = (
    "safe_ms_per_frame",
    "safe_frames_per_second",
    "auc_without_latency",
)  # of them in a column of a paper
_TERMINAL = ("n", "AUC", "modelled", "ranked by", "jitter", "offline", "recovered", "vs hold", "p",
             "vs best", "p (best)", "DP", "ms/call", "init ms", "skipped", "age ms",
             "J/frame", "AUC/W", "front")  # fmt: skip
_INTERVALS = ("AUC", "mAUC", "modelled", "jitter", "AUC of a - b", "mAUC of a - b")


def ranking(
    view: View,
    titles: Container[str] | None = None,
    standing_alone: bool = False,
    most: int | None = None,
) -> Table:
    """A row per trace, setting and forecaster, the best AUC of a setting first.

    Args:
        view: of a study.
        titles: of the columns beside names and settings; by default all.
        standing_alone: whether there are only rows of the settings that stand for all.
        most: rows that are shown, about: as many of each setting; by default all.
    """
    settings = several(view.rows)
    places = [(row.dataset, *(getattr(row, key) for key in settings)) for row in view.rows]
    order = {place: i for i, place in reversed([*enumerate(places)])}
    best_first = sorted(
        zip(places, view.rows), key=lambda pair: (order[pair[0]], -(pair[1].score("auc") or 0))
    )
    chosen = [pair for pair in best_first if view.stands(pair[1]) or not standing_alone]
    shown, left_out_rows = _best_of_each(chosen, most)
    rows = [{**_as_ranked(row), "tracker": view.names[run_of(row)]} for row in shown]
    left_out = set() if any("auc_jitter_low" in row for row in rows) else {"jitter"}
    if not any(row.modelled for row in shown):
        left_out |= {"modelled", "modelled DP", "lost"}
    if not any(row.energy for row in shown):
        left_out |= {"J/frame", "W", "AUC/W", "energy front"}
    if len({row.ranked_by for row in shown}) == 1:
        left_out.add("ranked by")
    columns = [
        *_names(["tracker", "forecaster", "dataset", *(() if standing_alone else settings)]),
        *(_named(column, shown) for column in _RANKING
          if (titles is None or column.title in titles) and column.title not in left_out),
    ]  # fmt: skip
    first = f"The best {score_name('AUC', shown)}"
    first += " first" if standing_alone else " of each setting first"
    table = Table.of(columns, rows, "ranking", f"{first}: {shared_setting(shown)}")
    return replace(table, note="; ".join([*left_out_rows, *view.results.ranked_by()]))


def _best_of_each(
    rows: Sequence[tuple[object, SummaryRow]], most: int | None
) -> tuple[list[SummaryRow], list[str]]:
    """As many rows of each place, and what to say of the others."""
    together: dict[object, list[SummaryRow]] = {}
    for place, row in rows:
        together.setdefault(place, []).append(row)
    if most is None or len(rows) <= most:
        return [row for _, row in rows], []
    each = max(1, most // len(together))
    some = [row for group in together.values() for row in group[:each]][:most]
    return some, [f"the best {each} of each setting: all {len(rows):,} rows are in summary.csv"]


def _named(column: Column, rows: Sequence[SummaryRow]) -> Column:
    """A column that calls the scores of some rows by their name; offline there is no sigma."""
    if str(column.value).startswith("offline"):
        return column

    def named(text: str) -> str:
        return re.sub(r"\b(AUC|DP)\b", lambda found: score_name(found[0], rows), text)

    key = column.key
    if score_name("AUC", rows) == "mAUC":
        key = re.sub(r"(?<![a-z])(?=(auc|dp20)(_|$))", "m", key)
    return replace(column, title=named(column.title), meaning=named(column.meaning), name=key)


def _as_ranked(row: SummaryRow) -> dict[str, Any]:
    """A row whose differences, shares and jitter are of the AUC that is ranked."""
    flat: dict[str, Any] = row.flat()
    if row.ranked_by == "modelled":
        for key in [key for key in flat if "_modelled_auc" in key]:
            flat[key.replace("_modelled_auc", "_auc")] = flat[key]
        for end in ("low", "high"):
            if f"modelled_auc_jitter_{end}" in flat:
                flat[f"auc_jitter_{end}"] = flat[f"modelled_auc_jitter_{end}"]
    return {**flat, "ranked_auc": row.score("auc")}


def table2(view: View) -> Table:
    """Trackers with and without forecasters (see :func:`.paper.with_and_without`); the best ones.

    The best have the highest mean AUC over the datasets that they were run on.
    """
    rows = view.standing
    aucs: dict[str, list[float]] = {}
    for row in rows:
        aucs.setdefault(view.names[run_of(row)], []).append(row.score("auc") or 0.0)
    best = sorted(aucs, key=lambda name: -sum(aucs[name]) / len(aucs[name]))[:MOST_TRACKERS]
    kept = {*best}
    rows = [row for row in rows if view.names[run_of(row)] in kept]
    titles = {"auc": score_name("AUC", rows), "dp20": score_name("DP", rows)}
    scores = [
        TrackerScores(
            view.names[run_of(row)],
            row.dataset,
            row.forecaster,
            {metric: row.score(metric) for metric in titles},
            row.offline,
        )
        for row in rows
    ]
    table = with_and_without(scores, view.forecasters, titles, shared_setting(rows))
    note = f"The best {len(kept)} of {len(aucs):,} trackers; all are in summary.csv."
    return replace(table, note=note) if len(kept) < len(aucs) else table


def attribute_table(view: View, pooled: bool = False) -> Table | None:
    """A row per attribute, tracker and forecaster; None if there are none.

    ``pooled`` keeps the rows of all trackers together, if there are any.
    """
    if view.attributes is None:
        return None
    keys = ("dataset", "attribute", "trace")
    offline, rows = {}, []
    for row in view.attributes.to_dict("records"):
        row |= {"auc": row["mean"], "auc_low": row["low"], "auc_high": row["high"]}
        if row["forecaster"] == "hold":
            row |= dict.fromkeys(("vs_hold", "vs_hold_p", "recovered"))
        if row["forecaster"] == "offline":
            offline[tuple(row[key] for key in keys)] = row["mean"]
        else:
            rows.append(row)
    together = [row for row in rows if row["trace"] == ALL_TRACES]
    columns = [
        *_names(["dataset", "attribute"]),
        Column("tracker", "trace", is_label=True),
        *_names(["forecaster"]),
        Column("n", "sequences", _COUNT),
        Column("AUC", "auc", SCORE),
        Column("offline", lambda row: offline.get(tuple(row[key] for key in keys)), SCORE),
        Column("vs hold", "vs_hold", SIGNED),
        Column("p", "vs_hold_p", p_label),
        Column("recovered", "recovered", _RECOVERED),
    ]
    return Table.of(
        columns,
        (pooled and together) or rows,
        "attributes",
        "AUC on the sequences of each attribute (n of them), at the first sigma; "
        + shared_setting(view.standing, but="sigma"),
    )


def comparison_table(view: View) -> Table:
    """A row per pair of traces; where there are many, of settings that stand for all."""
    rows, left_out = list(view.results.comparisons), ""
    if view.results.pairs > MOST_PAIRS:
        rows = [row for row in rows if view.chosen[row.a] == setting_of(row)]
        if len(rows) > MOST_PAIRS:
            rows = _nearest_to_the_best(rows)
            left_out = "; those nearest to the best of each setting"
        left_out += f"; {view.results.pairs:,} pairs of all settings are in comparisons.parquet"
    columns = [
        *_names([*_differing(rows, ("dataset", *SETTINGS)), "forecaster", "a", "b"]),
        Column("n", "sequences", _COUNT),
        Column(f"{score_name('AUC', rows)} of a - b", "difference", SIGNED),
        Column("p", "p", p_label),
        Column("p (Holm)", "p_holm", p_label),
        Column("a better here", "better_here", _RATIO),
        Column("a better", "better", _RATIO),
    ]
    if len({row.ranked_by for row in rows}) > 1:
        columns.append(Column("ranked by", "ranked_by"))
    named = [{**row.flat(), "a": view.names[row.a], "b": view.names[row.b]} for row in rows]
    modelled = {row.ranked_by for row in rows} == {"modelled"}
    whose = f", by the modelled {score_name('AUC', rows)}" if modelled else ""
    caption = f"Trackers against each other{whose}{left_out}"
    table = Table.of(columns, named, "comparisons", caption)
    note = (
        "a better here: probability that one run of a beats one of b on these sequences; "
        "a better: on others like them. p: Wilcoxon's signed-rank test; Holm: corrected for the "
        "number of pairs of a setting."
    )
    return replace(table, note=note)


def _nearest_to_the_best(rows: Sequence[Comparison]) -> list[Comparison]:
    """As many pairs of each setting and forecaster, those with its best trace, nearest first."""
    together: dict[tuple[object, ...], list[Comparison]] = {}
    for row in rows:
        place = row.dataset, *setting_of(row), row.forecaster
        together.setdefault(place, []).append(row)
    each = max(1, MOST_PAIRS // len(together))
    found: list[Comparison] = []
    for group in together.values():
        worse = {row.b if row.difference.value > 0 else row.a for row in group}
        best = {name for row in group for name in (row.a, row.b)} - worse
        with_best = [row for row in group if row.a in best or row.b in best]
        found += sorted(with_best, key=lambda row: abs(row.difference.value))[:each]
    return found[:MOST_PAIRS]


def some_of(lines: Sequence[str], where: str, most: int = MOST_LINES) -> list[str]:
    """The first lines of a list; where there are more, the last says how many, and where."""
    if len(lines) <= most:
        return list(lines)
    return [*lines[: most - 1], f"and {len(lines) - most + 1:,} more, in {where}"]


def required_table(view: View) -> Table:
    """A row per trace, setting, forecaster and AUC asked: how slow the tracker may be."""
    rows = view.results.required
    columns = [
        *_names(["tracker", *_differing(rows, [key for key in SETTINGS if key != "scale"])]),
        *_names(["forecaster"]),
        Column("AUC asked", "required_auc", Number(".3g")),
        Column("ms per frame", "safe_ms_per_frame", significant,
               "the slowest mean time of a call, the initialisations apart"),
        Column("fps", "safe_frames_per_second", significant,
               "frames that a tracker of this time processes per second"),
        Column("device", "device", meaning="against the times that are replayed",
               name="scale_at_most"),
        Column("AUC there", "safe_auc", FINE_SCORE),
        Column("then", "next_auc", FINE_SCORE, "AUC with all times a hundredth longer"),
        Column("offline", "auc_without_latency", SCORE, "AUC without latency"),
        Column("or world fps", "world", _MS, "how fast the world may move instead, with the "
               "recorded motion from frame to frame; unknown where a cost or a policy has a time "
               "of its own", name="world_fps_at_most"),
    ]  # fmt: skip
    if any(row.ranked_by == "modelled" for row in rows):
        columns.append(Column("AUC is", "ranked_by", meaning="as the ranking has it"))
    return Table.of(
        columns,
        [
            {
                **row.flat(),
                "tracker": view.names.get(row.run, row.run),
                "device": _device(row),
                "world": _world(row),
            }
            for row in rows
        ],
        "required",
        f"How slow a tracker may be for the required AUC at sigma {rows[0].sigma}",
    )


def _device(row: Requirement) -> Cell:
    """What is asked of the device, in words; its value is the scale of all times."""
    return Cell(device_in_words(row), None if row.safe_scale is None else float(row.safe_scale))


def _world(row: Requirement) -> float | None:
    """The rate of the world for which a tracker may be as slow as it is."""
    if not row.safe_scale or row.fps_at_most is None:
        return None
    return float(row.safe_scale * row.fps)


def _differing(rows: Sequence[Comparison | Requirement], keys: Iterable[str]) -> list[str]:
    """The keys whose values differ between rows."""
    return [key for key in keys if len({getattr(row, key) for row in rows}) > 1]


def paper_tables(view: View) -> list[PaperTable]:
    """The tables of a study, whole and for a paper: those of the settings that stand for all."""
    tables = [
        PaperTable(
            ranking(view),
            ranking(view, _PAPER, standing_alone=True, most=MOST_ROWS),
            ranking(view, _COLUMN, standing_alone=True, most=MOST_ROWS),
        ),
        in_two_forms(table2(view)),
    ]
    if whole := attribute_table(view):
        pooled = attribute_table(view, pooled=True) or whole
        short = pooled.only(lambda _, column: column.title not in ("offline", "p"))
        tables.append(PaperTable(whole, pooled, short))
    if view.results.comparisons:
        compared = comparison_table(view)
        short = compared.only(lambda _, column: not column.title.startswith("a better"))
        tables.append(PaperTable(compared, compared, short))
    if view.results.required:
        required = required_table(view).first(MOST_ROWS, "required.csv")
        short = required.only(lambda _, column: column.is_label or column.key in _REQUIRED)
        tables.append(PaperTable(required, required, short))
    return tables


def write_tables(results: StudyResults | View, folder: str | os.PathLike[str]) -> None:
    """Write every table as CSV and Parquet, with numbers in full, and as LaTeX for a paper.

    Of LaTeX there are two forms, ``NAME.tex`` for a column and ``NAME-long.tex`` for a page.

    Args:
        results: of a study, or a view of them, which the report may have in common.
        folder: where to; made if it is not there.

    Raises:
        LaeError: if a file cannot be written.

    Example:
        >>> import os, tempfile
        >>> import lae_sim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     results = lae_sim.run_study(
        ...         traces="traces/synthetic-slow.parquet", folder=folder, workers=1, report=False
        ...     )
        ...     lae_sim.write_tables(results, f"{folder}/paper")
        ...     sorted(name for name in os.listdir(f"{folder}/paper") if "table2" in name)
        ['table2-long.tex', 'table2.csv', 'table2.parquet', 'table2.tex']
    """
    view = results if isinstance(results, View) else View(results)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LaeError(f"cannot write to {folder}: {error.strerror}") from error
    for table in paper_tables(view):
        write_table(table, Path(folder))


def study_text(results: StudyResults | View, width: int | None = None) -> str:
    """The tables for a terminal, then what they rest on.

    Args:
        results: of a study, or a view of them.
        width: as of :func:`lae_sim.report.table.text_of`.
    """
    view = results if isinstance(results, View) else View(results)
    results, tables = view.results, [ranking(view, _TERMINAL, most=MOST_ROWS)]
    repeated = any(row.repetitions > 1 for row in view.rows)
    if results.comparisons and (repeated or len(results.comparisons) <= 30):
        tables.append(comparison_table(view))
    if results.required:
        tables.append(required_table(view).first(MOST_ROWS, "required.csv"))
    parts = ["\n".join(filled(line) for line in results.verdict())]
    for table in tables:
        text = text_of(table, intervals=_INTERVALS, width=width)
        text = text.replace("★", "*")  # not every terminal has stars
        parts.append("\n".join([table.caption, text, legend_of(table)]))
    parts += ["\n".join(map(filled, shortfalls(results.required, view.names)))]
    lines = [f"{len(results.plan.cells)} cells, {results.computed} of them computed now"]
    approximate = [row.approximate_share for row in view.rows if not row.exact]
    if approximate:
        lines.append(
            f"approximate: up to {100 * max(approximate):.3g}% of the outputs of a replay follow "
            "another frame than when recorded"
        )
    failed = [f"not computed: {each.of}: {each.reason}" for each in results.failures]
    lines += [*some_of(failed, "study.json"), *some_of(results.notes(), "study.json")]
    return "\n\n".join([*filter(None, parts), "\n".join(lines)])
