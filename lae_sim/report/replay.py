"""What a replay says: one JSON object per trace, and the same as text tables."""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from fractions import Fraction
from functools import partial
from operator import itemgetter
from textwrap import fill
from typing import Any

import numpy as np

from lae_sim.engine.clock import Clock
from lae_sim.errors import visible
from lae_sim.evaluation.caveats import at_the_floor, floor_notes, left_search, search_notes
from lae_sim.evaluation.evaluate import Curves, Evaluation
from lae_sim.evaluation.metrics import METRICS
from lae_sim.evaluation.modelled import MODELLED
from lae_sim.evaluation.totals import RECOVERED, ModelledTotals, ScoreTotals, Totals, recovered
from lae_sim.figures.labels import bottleneck_text
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.report.paper import PaperTable, TrackerScores, in_two_forms, with_and_without
from lae_sim.report.table import (
    CHANGE,
    COUNT,
    FINE_SCORE,
    PERCENT,
    SCORE,
    Column,
    Number,
    Table,
    ends_text,
    relative_change,
    text_of_records,
)
from lae_sim.trace.describe import InitCost
from lae_sim.trace.metadata import Metadata

Report = dict[str, Any]


def trace_report(
    totals: Totals,
    clock: Clock,
    forecasters: Sequence[str],
    sigmas: Sequence[Fraction],
    convention: str,
    init: InitCost,
    per_sequence: SequenceRows | None = None,
    attributes: bool = True,
) -> Report:
    """The figures of one trace as a JSON object (described in docs/reference/json.md).

    Args:
        totals: scores, whose forecasters and sigmas are the ones named.
        clock: the world's clock.
        forecasters: names; ``"hold"`` must be among them.
        sigmas: permitted latencies in frames, ascending.
        convention: the convention's name.
        init: what initialisations cost.
        per_sequence: each sequence, if they are to be reported too.
        attributes: whether to report those attributes that the totals know.
    """
    replay, staleness = totals.replay, totals.staleness
    frames, processed = int(replay.frames.sum()), int(replay.processed.sum())
    calls = processed - len(replay.sequences)
    calls_ns = int(replay.calls_ns.sum())
    departures = int(replay.departures.sum())
    zero = sigmas.index(Fraction(0)) if 0 in sigmas else 0
    offline = {metric: _number(totals.scores.offline(metric)) for metric in METRICS}
    over_all = _scores(totals.scores, forecasters)
    by_attribute = {
        name: (scores.sequences, _scores(scores, forecasters))
        for name, scores in sorted(totals.by_attribute.items() if attributes else ())
    }
    modelled = _modelled(totals.modelled, forecasters, totals.scores.complete)
    results = []
    for f, forecaster in enumerate(forecasters):
        means = {}
        if set(SIGMA_GRID) <= set(sigmas):
            means["mauc"] = _grid_mean([scores["auc"] for scores in over_all[f]], sigmas)
            means["mdp"] = _grid_mean([scores["dp20"] for scores in over_all[f]], sigmas)
        for s, sigma in enumerate(sigmas):
            total = int(staleness.mismatch_sum[s])
            result = {
                "forecaster": forecaster,
                "sigma": float(sigma),
                "convention": convention,
                **over_all[f][s],
                **means,
                "mismatch_sum": total,
                "mismatch_mean": total / frames,
                "mismatch_max": int(staleness.mismatch_max[s]),
                # the query is sigma frames after the frame it is for
                "age_ms": clock.milliseconds(Fraction(staleness.age_sum[s]) / frames + sigma),
                "longest_stale_ms": clock.milliseconds(Fraction(staleness.longest_stale[s])),
            }
            if by_attribute:
                result["attributes"] = {
                    name: {"sequences": count, **scores[f][s]}
                    for name, (count, scores) in by_attribute.items()
                }
            result["modelled"] = modelled[f][s] if modelled else None
            if per_sequence is not None:
                result["per_sequence"] = per_sequence.of(f, s)
            results.append(result)
    return {
        "sequences": len(replay.sequences),
        "world_frames": frames,
        "frames_without_truth": int(replay.truthless.sum()),
        "processed": processed,
        "skip_rate": 1 - processed / frames,
        "mismatch_sum": int(staleness.mismatch_sum[zero]),
        "tracker_fps": calls / calls_ns * 1e9 if calls_ns else None,
        "tracker_fps_mean": _number(float(replay.calls_hz.sum()) / calls) if calls else None,
        "init_ms": init.mean_ms,
        "init": {**asdict(init), "left_search": left_search(replay)},
        "exact": departures == 0,
        "approximate_outputs": departures,
        "approximate_share": replay.approximate_share,
        "offline": None if offline["auc"] is None else offline,
        "results": results,
    }


def _scores(totals: ScoreTotals, forecasters: Sequence[str]) -> list[list[Report]]:
    """Mean scores, with the share of the latency loss recovered, by forecaster and sigma."""
    means = {metric: totals.mean(metric).tolist() for metric in METRICS}

    def one(f: int, s: int) -> Report:
        scores = {metric: _number(means[metric][f][s]) for metric in METRICS}
        comparable = totals.complete and forecasters[f] != "hold"
        for metric in RECOVERED:
            share = totals.changes(metric).recovered(f, s) if comparable else None
            scores[f"recovered_{metric}"] = share
        return scores

    count = len(means[METRICS[0]][0])
    return [[one(f, s) for s in range(count)] for f in range(len(forecasters))]


def _modelled(
    totals: ModelledTotals, forecasters: Sequence[str], complete: bool
) -> list[list[Report]] | None:
    """Scores under the search model by forecaster and sigma; None where it says nothing."""
    if totals.known is None:
        return None
    figures = totals.figures()

    def one(f: int, s: int) -> Report:
        scores: Report = {"c_known": totals.known}
        scores |= {name: _number(values[f, s]) for name, values in figures.items()}
        comparable = complete and forecasters[f] != "hold"
        for metric in MODELLED:
            share = totals.changes(metric).recovered(f, s) if comparable else None
            scores[f"recovered_{metric}"] = share
        return {**scores, "lost_share": totals.lost_share}

    count = figures[MODELLED[0]].shape[1]
    return [[one(f, s) for s in range(count)] for f in range(len(forecasters))]


def _grid_mean(scores: Sequence[float | None], sigmas: Sequence[Fraction]) -> float | None:
    """Plain mean over the 51 permitted latencies of PVT++ (2023)."""
    on_grid = [score for score, sigma in zip(scores, sigmas) if sigma in SIGMA_GRID]
    known = [score for score in on_grid if score is not None]
    return math.fsum(known) / len(known) if len(known) == len(on_grid) else None


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


class SequenceRows:
    """What is reported of each sequence, for every forecaster and sigma.

    Attributes:
        parts: the scores of all sequences, in groups, without their curves.
    """

    def __init__(self, forecasters: Sequence[str]) -> None:
        self._hold = forecasters.index("hold")
        self.parts: list[Evaluation] = []

    def add(self, part: Evaluation) -> None:
        """Take in a group of sequences; its curves are not kept."""
        none = Curves(np.empty(0), np.empty(0))
        self.parts.append(replace(part, curves=none, offline_curves=none))

    def of(self, f: int, s: int) -> list[Report]:
        """Those of one forecaster and sigma, by their indices."""
        return [row for part in self.parts for row in self._rows(part, f, s)]

    def _rows(self, part: Evaluation, f: int, s: int) -> Iterator[Report]:
        replay = part.replay
        scores = {metric: part.scores[metric][f, :, s].tolist() for metric in METRICS}
        hold = {metric: part.scores[metric][self._hold, :, s].tolist() for metric in RECOVERED}
        offline = {metric: part.offline[metric].tolist() for metric in RECOVERED}
        columns = zip(
            replay.sequences,
            replay.frames.tolist(),
            replay.processed.tolist(),
            part.staleness.mismatch_sum[:, s].tolist(),
            replay.departures.tolist(),
            replay.disagreement.tolist(),
            (replay.init_ns / 1e6).tolist(),
        )
        for i, (name, frames, processed, mismatch, departures, disagreement, init_ms) in enumerate(
            columns
        ):
            shares = {}
            for metric in RECOVERED:
                won = scores[metric][i] - hold[metric][i]
                lost = offline[metric][i] - hold[metric][i]
                share = None
                if f != self._hold and math.isfinite(won + lost):
                    share = recovered(won, lost)
                shares[f"recovered_{metric}"] = share
            yield {
                "sequence": name,
                "world_frames": frames,
                "processed": processed,
                "init_ms": init_ms,
                "mismatch_sum": mismatch,
                "approximate_outputs": departures,
                "disagreement": _number(disagreement),
                "offline_auc": _number(offline["auc"][i]),
                "offline_dp20": _number(offline["dp20"][i]),
                **{metric: _number(scores[metric][i]) for metric in METRICS},
                **shares,
                "modelled": self._modelled(part, f, i, s),
            }

    def _modelled(self, part: Evaluation, f: int, i: int, s: int) -> Report | None:
        """What the search model says of a sequence; None where its replay is exact."""
        modelled = part.modelled
        if not modelled.applies[i]:
            return None
        scores: Report = {"c_known": modelled.known}
        scores |= {name: _number(values[f, i, s]) for name, values in modelled.figures().items()}
        for metric in MODELLED:
            mean = modelled.mean[metric][:, i, s]
            won, lost = mean[f] - mean[self._hold], part.offline[metric][i] - mean[self._hold]
            comparable = f != self._hold and math.isfinite(won + lost)
            share = recovered(float(won), float(lost)) if comparable else None
            scores[f"recovered_{metric}"] = share
        return {**scores, "lost_share": float(modelled.lost_share[i])}


def attribute_members(metadata: Metadata, sequences: Iterable[str]) -> dict[str, list[int]]:
    """Indices of the sequences that have each attribute."""
    members: dict[str, list[int]] = {}
    for i, sequence in enumerate(sequences):
        for attribute in metadata.attributes(sequence):
            members.setdefault(attribute, []).append(i)
    return members


SWEPT = {"fps": "fps", "latency_scale": "scale", "policy": "pipeline"}
"""What a sweep can vary, by its name in reports, with the heading of its column."""


_FRAMES = Number(".3f", unit=" fr")
_SIGMA = Column("sigma", "sigma", Number("g"), importance=9)

Line = ChainMap[str, Any]
"""What a line of a table shows, then the result that it is from, and the report of the trace."""


def _lines(reports: Iterable[tuple[str, Report]], shown_sigmas: Sequence[float]) -> Iterator[Line]:
    """A line per label and report, forecaster and permitted latency."""
    for label, report in reports:
        offline = {
            f"offline_{metric}": score for metric, score in (report["offline"] or {}).items()
        }
        for result in report["results"]:
            if result["sigma"] in shown_sigmas:
                yield ChainMap({"label": label, **offline}, result, report)


def _text(
    columns: Iterable[Column],
    lines: Iterable[Line],
    title: str,
    swept: Sequence[str],
    width: int | None,
) -> str:
    labels = [
        Column(title, "label", is_label=True),
        Column("forecaster", "forecaster", is_label=True),
        *(Column(SWEPT[key], key, importance=9) for key in swept),
    ]
    return text_of_records([*labels, *columns], lines, width)


def summary_table(
    reports: Sequence[Report],
    labels: Sequence[str],
    shown_sigmas: Sequence[float],
    swept: Sequence[str] = (),
    width: int | None = None,
) -> str:
    """One line per report, forecaster and permitted latency.

    Args:
        reports: of traces, perhaps each in several worlds.
        labels: the trace's name for each report.
        shown_sigmas: permitted latencies to show.
        swept: those of ``SWEPT`` that get a column.
        width: letters that a line may have (see :func:`lae_sim.report.table.text_of`).
    """
    columns = [_SIGMA] if len(shown_sigmas) > 1 or shown_sigmas != [0.0] else []
    for title, metric, more in (("AUC", "auc", 3), ("DP@20", "dp20", 0)):
        columns += [
            Column(title, metric, FINE_SCORE, importance=9),
            Column("offline", f"offline_{metric}", FINE_SCORE, name=f"{title} offline",
                   importance=2 + more),
            Column("change", partial(_change, metric), CHANGE, name=f"{title} change",
                   importance=1 + more),
            Column("recov.", f"recovered_{metric}", PERCENT, name=f"{title} recov.",
                   importance=3 + more),
        ]  # fmt: skip
        if any(result["modelled"] for report in reports for result in report["results"]):
            columns.append(
                Column("modelled", partial(_modelled_of, metric), FINE_SCORE,
                       name=f"{title} modelled", importance=4 + more)
            )  # fmt: skip
            if metric == "auc":  # that of DP would make the line too long
                columns.append(Column("[low, high]", _interval_of, importance=3))
    if any("mauc" in result for report in reports for result in report["results"]):
        columns += [
            Column("mAUC", "mauc", FINE_SCORE, importance=8),
            Column("mDP", "mdp", FINE_SCORE, importance=8),
        ]
    columns += [
        Column("tracker", "tracker_fps", Number(".1f", unit=" fps"), importance=2),
        Column("skipped", "skip_rate", PERCENT, importance=3),
        Column("mismatch", "mismatch_mean", _FRAMES, importance=4),
    ]
    return _text(columns, _lines(zip(labels, reports), shown_sigmas), "trace", swept, width)


def _modelled_of(metric: str, line: Line) -> float | None:
    score: float | None = line["modelled"] and line["modelled"][metric]
    return score


def _interval_of(line: Line) -> str | None:
    """The interval of the modelled AUC."""
    modelled = line["modelled"]
    return ends_text(modelled["auc_low"], modelled["auc_high"]) if modelled else None


def _change(metric: str, line: Line) -> float | None:
    return relative_change(line[metric], line.get(f"offline_{metric}"))


def closing_text(reports: Sequence[Report], labels: Sequence[str], swept: Sequence[str]) -> str:
    """What there is to say of all traces together, in lines; empty if nothing."""
    notes = floor_notes(
        label
        for label, report in zip(labels, reports)
        for result in report["results"]
        if result["sigma"] == 0 and at_the_floor(report["skip_rate"], result["mismatch_mean"])
    )
    if "fps" in swept:
        notes.append(
            "a sweep of the rate is one of how fast the world moves: recorded frames arrive "
            "faster, with the same motion from one to the next"
        )
    return "\n".join(fill(note, 100, break_on_hyphens=False) for note in notes)


def settings_text(report: Report) -> str:
    """What the figures of a trace rest on, and how far they can be trusted."""
    scale = report["latency_scale"]
    lines = [
        f"{report['trace']}: {report['tracker']}, {report['dataset']}, device {report['device']}; "
        f"{report['sequences']} sequences, {report['world_frames']:,} world frames at "
        f"{report['fps']} fps, {report['processed']:,} processed",
        f"  convention {report['convention']}, policy {report['policy']}, "
        f"latency {report['latency']}"
        + (f" x {scale}" if scale != "1" else "")
        + (
            f", times from {report['times_from']}"
            if report["times_from"] != report["trace"]
            else ""
        ),
    ]
    if report["times_note"] is not None:
        lines.append(f"  times: {report['times_note']}")
    cost = {key: value for key, value in report["init"].items() if key != "left_search"}
    lines.append(f"  {InitCost(**cost)}")
    lines += [_wrapped(note) for note in report["notes"]]
    share = f"{report['approximate_outputs']:,} outputs ({100 * report['approximate_share']:.3g}%)"
    if report["search"] is not None:
        lines += [f"  {line}" for line in search_notes(report["search"])]
    if report["exact"]:
        lines.append("  exact: every output follows the same frame as when it was recorded")
    elif report["strided"]:
        lines.append(
            f"  approximate: boxes come from passes of {1 + len(report['strided'])} strides, each "
            f"sequence's\n  from the nearest; {share} follow another frame than in their pass"
        )
    else:
        lines.append(
            f"  approximate: {share} follow another frame than when recorded; "
            "a stateful\n  tracker would have seen larger motion there, so this is optimistic"
        )
    return "\n".join(lines)


def pipeline_text(report: Report, width: int | None = None) -> str:
    """What happened at the stages of a pipeline, and in words what the columns are."""
    pipeline = report["pipeline"]
    camera, result = pipeline["camera"], report["results"][0]
    lines = [
        f"{pipeline['name']}: the camera lost {camera['lost']:,} of {camera['frames']:,} frames "
        f"and delivered the others after {_MS(camera['delay_ms'])}",
        "",
        text_of_records(_pipeline_columns(pipeline["stages"]), pipeline["stages"], width),
        "",
    ]
    lines += [
        f"resource {each['resource']}: in use {PERCENT(each['utilisation'])} of the time"
        for each in pipeline["resources"]
    ]
    lines.append(
        f"{pipeline['outputs']:,} answers, {pipeline['overtaken']:,} of them after a newer one; "
        f"at sigma {result['sigma']:g} an answer is {_MS(result['age_ms'])} old, from its frame's "
        f"delivery on, and {_MS(result['capture_age_ms'])} from its capture on"
    )
    lines[-1:] = [fill(lines[-1], 100, break_on_hyphens=False)]
    lines.append(fill(bottleneck_text(pipeline), 100, break_on_hyphens=False))
    return "\n".join(lines)


def _pipeline_columns(stages: Sequence[Report]) -> list[Column]:
    """Those of which there is something to say."""
    rare = ("resource_wait_ms", "blocked_ms")
    said = [key for key in rare if any(stage[key] for stage in stages)]
    return [column for column in _PIPELINE if column.value not in rare or column.value in said]


def _drops(stage: Report) -> str:
    return ", ".join(f"{count:,} {why}" for why, count in stage["dropped"].items()) or "-"


_MS = Number(".1f", unit=" ms")
_PIPELINE = [
    Column("stage", "stage", is_label=True),
    Column("arrived", "arrived", COUNT, importance=7),
    Column("done", "done", COUNT, importance=8),
    Column("dropped", _drops, importance=6),
    Column("busy", "utilisation", PERCENT, importance=8),
    Column("waits", "wait_ms", _MS, importance=6),
    Column("for resource", "resource_wait_ms", _MS, importance=3),
    Column("works", "work_ms", _MS, importance=7),
    Column("blocked", "blocked_ms", _MS, importance=3),
    Column("age in", "age_in_ms", _MS, importance=5),
    Column("age out", "age_out_ms", _MS, importance=8),
]


def _wrapped(note: str) -> str:
    """A note that may name many sequences."""
    if len(note) < 180:
        return f"  {note}"
    return fill(note, 98, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False)


def attribute_table(
    report: Report,
    shown_sigmas: Sequence[float],
    swept: Sequence[str] = (),
    width: int | None = None,
) -> str:
    """One line per attribute and forecaster."""
    columns = [
        Column("sequences", "sequences"),
        _SIGMA,
        Column("AUC", "auc", FINE_SCORE),
        Column("recovered", "recovered_auc", PERCENT),
        Column("DP@20", "dp20", FINE_SCORE),
    ]
    lines = [
        line.new_child({**scores, "label": name})
        for line in _lines([("", report)], shown_sigmas)
        for name, scores in line.get("attributes", {}).items()
    ]
    return _text(columns, sorted(lines, key=itemgetter("label")), "attribute", swept, width)


def sequence_table(
    report: Report,
    shown_sigmas: Sequence[float],
    swept: Sequence[str] = (),
    width: int | None = None,
) -> str:
    """One line per sequence and forecaster."""
    columns = [
        _SIGMA,
        Column("AUC", "auc", FINE_SCORE, importance=9),
        Column("offline", "offline_auc", FINE_SCORE, name="AUC offline"),
        Column("DP@20", "dp20", FINE_SCORE, importance=8),
        Column("offline", "offline_dp20", FINE_SCORE, name="DP@20 offline"),
        Column("frames", "world_frames"),
        Column("processed", "processed"),
        Column("init", "init_ms", Number(".1f", unit=" ms")),
        Column("mismatch", lambda line: line["mismatch_sum"] / line["world_frames"], _FRAMES),
        Column("modelled AUC", partial(_modelled_of, "auc"), FINE_SCORE),
        Column("[low, high]", _interval_of),
        Column("approximate", "approximate_outputs"),
        Column("disagree", "disagreement", PERCENT),
    ]
    lines = list(_lines([("", report)], shown_sigmas))
    by_sequence = zip(*(line["per_sequence"] for line in lines))
    records = (
        ChainMap({"label": scores["sequence"]}, scores, *line.maps)
        for rows in by_sequence
        for line, scores in zip(lines, rows)
    )
    return _text(columns, records, "sequence", swept, width)


_SETTING = {
    "policy": "policy {}",
    "fps": "world {} fps",
    "latency": "latency {}",
    "latency_scale": "times x {}",
    "times_from": "times from {}",
    "convention": "convention {}",
}
"""What says how a trace was replayed, in words."""


def paper_tables(reports: Sequence[Report], labels: Sequence[str]) -> list[PaperTable]:
    """Trackers with and without forecasters at the first sigma, or over the grid; attributes.

    Args:
        reports: of traces, perhaps each in several worlds.
        labels: the trace's name for each report.
    """
    names = _tracker_names(reports, labels)
    over_grid = all("mauc" in report["results"][0] for report in reports)
    titles = {"auc": "mAUC", "dp20": "mDP"} if over_grid else {"auc": "AUC", "dp20": "DP"}
    keys = {"auc": "mauc", "dp20": "mdp"} if over_grid else {"auc": "auc", "dp20": "dp20"}
    scores, by_attribute = [], []
    for name, report in zip(names, reports):
        offline = report["offline"] or dict.fromkeys(METRICS)
        first = report["results"][0]["sigma"]
        for result in report["results"]:
            if result["sigma"] != first:
                continue
            forecaster = result["forecaster"]
            means = {metric: result[key] for metric, key in keys.items()}
            scores.append(TrackerScores(name, str(report["dataset"]), forecaster, means, offline))
            by_attribute += [
                {"tracker": name, "attribute": attribute, "forecaster": forecaster, **each}
                for attribute, each in result.get("attributes", {}).items()
            ]
    shared = _shared(reports, over_grid)
    forecasters = dict.fromkeys(row.forecaster for row in scores)
    tables = [in_two_forms(with_and_without(scores, forecasters, titles, shared))]
    if by_attribute:
        columns = [
            *(Column(key, key, is_label=True) for key in ("tracker", "attribute", "forecaster")),
            Column("n", "sequences", COUNT),
            Column("AUC", "auc", SCORE),
            Column("DP", "dp20", SCORE),
            Column("recovered", "recovered_auc", PERCENT),
        ]
        at_first = _shared(reports, False)
        caption = f"Scores on the sequences of each attribute (n of them); {at_first}"
        by_attribute.sort(key=itemgetter("tracker", "attribute"))
        table = Table.of(columns, by_attribute, "attributes", caption)
        tables.append(PaperTable(table, table, table))
    return tables


def _tracker_names(reports: Sequence[Report], labels: Sequence[str]) -> list[str]:
    """What rows are called: trackers or, where these are not told apart by them, traces.

    Of several worlds the name says which, too.
    """
    kinds = {(report["tracker"], report["dataset"]) for report in reports}
    alone = len(kinds) == len(set(labels)) and all(name != "unknown" for name, _ in kinds)
    differing = [
        key
        for key in _SETTING
        if key != "times_from" and len({report[key] for report in reports}) > 1
    ]
    return [
        ", ".join([
            visible(report["tracker"]) if alone else label.removesuffix(".parquet"),
            *(_SETTING[key].format(report[key]) for key in differing),
        ])
        for report, label in zip(reports, labels)
    ]  # fmt: skip


def _shared(reports: Sequence[Report], over_grid: bool) -> str:
    """What all reports have in common, in words."""
    parts = []
    for key, words in _SETTING.items():
        values = {report[key] for report in reports}
        own = key == "times_from" and all(r["times_from"] == r["trace"] for r in reports)
        if len(values) == 1 and not own:
            parts.append(words.format(visible(values.pop())))
    sigma = f"sigma {reports[0]['results'][0]['sigma']:g}"
    parts.append("mean over sigma = 0, 0.02, ..., 1" if over_grid else sigma)
    if any(result["modelled"] for report in reports for result in report["results"]):
        parts.append("of the recorded boxes")
    return ", ".join(parts)
