"""What a replay says: one JSON object per trace, and the same as text tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.comparison.statistics import recovered
from lae_sim.engine.clock import Clock
from lae_sim.evaluation.evaluate import Evaluation
from lae_sim.evaluation.metrics import METRICS
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.report.table import (
    CHANGE,
    PERCENT,
    Column,
    Number,
    Table,
    relative_change,
    text_of,
)
from lae_sim.trace.metadata import Metadata

Report = dict[str, Any]


def trace_report(
    evaluation: Evaluation,
    clock: Clock,
    forecasters: Sequence[str],
    sigmas: Sequence[Fraction],
    convention: str,
    attributes: Mapping[str, list[int]] | None = None,
    per_sequence: bool = False,
) -> Report:
    """The figures of one trace as a JSON object (documented in the README).

    Args:
        evaluation: scores, whose forecasters and sigmas are the ones named.
        clock: the world's clock.
        forecasters: names; ``"hold"`` must be among them.
        sigmas: permitted latencies in frames, ascending.
        convention: the convention's name.
        attributes: for each attribute the indices of the sequences that have it, to report apart.
        per_sequence: whether to report each sequence.
    """
    frames, processed = int(evaluation.frames.sum()), int(evaluation.processed.sum())
    calls = processed - len(evaluation.sequences)
    calls_ns = int(evaluation.calls_ns.sum())
    departures = int(evaluation.departures.sum())
    zero = sigmas.index(Fraction(0)) if 0 in sigmas else 0
    offline = {metric: _offline(evaluation, metric, slice(None)) for metric in METRICS}
    grid = set(SIGMA_GRID) <= set(sigmas)
    results = []
    for f, forecaster in enumerate(forecasters):
        means = {}
        if grid:
            means["mauc"] = _grid_mean(evaluation, "auc", f, sigmas)
            means["mdp"] = _grid_mean(evaluation, "dp20", f, sigmas)
        for s, sigma in enumerate(sigmas):
            result = {
                "forecaster": forecaster,
                "sigma": float(sigma),
                "convention": convention,
                **_scores(evaluation, forecasters, f, s, slice(None)),
                **means,
                **_staleness(evaluation, s, sigma, clock),
            }
            if attributes:
                result["attributes"] = {
                    name: {
                        "sequences": len(members),
                        **_scores(evaluation, forecasters, f, s, members),
                    }
                    for name, members in attributes.items()
                }
            if per_sequence:
                result["per_sequence"] = [
                    {
                        "sequence": name,
                        "world_frames": int(evaluation.frames[i]),
                        "processed": int(evaluation.processed[i]),
                        "mismatch_sum": int(evaluation.mismatch_sum[i, s]),
                        "approximate_outputs": int(evaluation.departures[i]),
                        "disagreement": _number(evaluation.disagreement[i]),
                        "offline_auc": _number(evaluation.offline["auc"][i]),
                        "offline_dp20": _number(evaluation.offline["dp20"][i]),
                        **_scores(evaluation, forecasters, f, s, slice(i, i + 1)),
                    }
                    for i, name in enumerate(evaluation.sequences)
                ]
            results.append(result)
    return {
        "sequences": len(evaluation.sequences),
        "world_frames": frames,
        "frames_without_truth": int(evaluation.truthless.sum()),
        "processed": processed,
        "skip_rate": 1 - processed / frames,
        "mismatch_sum": int(evaluation.mismatch_sum[:, zero].sum()),
        "tracker_fps": calls / calls_ns * 1e9 if calls_ns else None,
        "tracker_fps_mean": _number(float(evaluation.calls_hz.sum()) / calls) if calls else None,
        "init_ms": float(np.mean(evaluation.init_ns)) / 1e6,
        "exact": departures == 0,
        "approximate_outputs": departures,
        "approximate_share": departures / calls if calls else 0.0,
        "offline": None if offline["auc"] is None else offline,
        "results": results,
    }


def _scores(
    evaluation: Evaluation, forecasters: Sequence[str], f: int, s: int, which: slice | list[int]
) -> Report:
    """Mean scores over some sequences, with the share of the latency loss recovered."""
    means: Report = {m: _mean(evaluation.scores[m][f, which, s]) for m in METRICS}
    hold = forecasters.index("hold")
    for metric in ("auc", "dp20"):
        share = None
        if f != hold and not evaluation.missing[which].any():
            scores = evaluation.scores[metric]
            share = _recovered(
                evaluation.offline[metric][which], scores[hold, which, s], scores[f, which, s]
            )
        means[f"recovered_{metric}"] = share
    return means


def _recovered(offline: Floats, hold: Floats, forecast: Floats) -> float | None:
    """Share of the latency loss recovered, over sequences that count in all; none if no loss."""
    counted = ~np.isnan(offline + hold + forecast)
    won, lost = (float((scores - hold)[counted].sum()) for scores in (forecast, offline))
    return recovered(won, lost)


def _offline(evaluation: Evaluation, metric: str, which: slice | list[int]) -> float | None:
    """Mean offline score over some sequences; none unless the trace has every frame of all."""
    if evaluation.missing[which].any():
        return None
    return _mean(evaluation.offline[metric][which])


def _staleness(evaluation: Evaluation, s: int, sigma: Fraction, clock: Clock) -> Report:
    """How old the answers are: the query is sigma frames after the frame it is for."""
    total, frames = int(evaluation.mismatch_sum[:, s].sum()), int(evaluation.frames.sum())
    return {
        "mismatch_sum": total,
        "mismatch_mean": total / frames,
        "mismatch_max": int(evaluation.mismatch_max[:, s].max()),
        "age_ms": clock.milliseconds(Fraction(total, frames) + sigma),
        "longest_stale_ms": clock.milliseconds(int(evaluation.longest_hold[:, s].max())),
    }


def _grid_mean(
    evaluation: Evaluation, metric: str, f: int, sigmas: Sequence[Fraction]
) -> float | None:
    """Plain mean over the 51 permitted latencies of PVT++ (2023)."""
    on_grid = [s for s, sigma in enumerate(sigmas) if sigma in SIGMA_GRID]
    means = [_mean(evaluation.scores[metric][f, :, s]) for s in on_grid]
    known = [mean for mean in means if mean is not None]
    return math.fsum(known) / len(known) if len(known) == len(on_grid) else None


def _mean(values: Any) -> float | None:
    """Mean of the sequences that have a value."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def attribute_members(metadata: Metadata, sequences: Iterable[str]) -> dict[str, list[int]]:
    """Indices of the sequences that have each attribute, attributes in order of their names."""
    members: dict[str, list[int]] = {}
    for i, sequence in enumerate(sequences):
        for attribute in metadata.attributes(sequence):
            members.setdefault(attribute, []).append(i)
    return dict(sorted(members.items()))


SWEPT = {"fps": "fps", "latency_scale": "scale"}
"""What a sweep can vary, by its name in reports, with the heading of its column."""


@dataclass(frozen=True)
class _Line:
    """A line of a table.

    Attributes:
        label: what it is about.
        report: of its trace.
        result: of its forecaster and permitted latency.
        scores: the result, or a part of it.
    """

    label: str
    report: Report
    result: Report
    scores: Report


_SCORE, _FRAMES = Number(".4f"), Number(".3f", unit=" fr")
_SIGMA = Column("sigma", lambda line: line.result["sigma"], Number("g"))


def _labels(title: str, swept: Sequence[str]) -> list[Column]:
    return [
        Column(title, lambda line: line.label, is_label=True),
        Column("forecaster", lambda line: line.result["forecaster"], is_label=True),
        *(_of_report(SWEPT[key], key) for key in swept),
    ]


def _of_report(title: str, key: str, form: Callable[..., str] = str) -> Column:
    return Column(title, lambda line: line.report[key], form)


def _of_scores(title: str, key: str, form: Callable[..., str] = _SCORE) -> Column:
    return Column(title, lambda line: line.scores[key], form)


def _shown(reports: Iterable[tuple[str, Report]], shown_sigmas: Sequence[float]) -> Iterator[_Line]:
    """A line per label and report, forecaster and permitted latency."""
    for label, report in reports:
        for result in report["results"]:
            if result["sigma"] in shown_sigmas:
                yield _Line(label, report, result, result)


def summary_table(
    reports: Sequence[Report],
    labels: Sequence[str],
    shown_sigmas: Sequence[float],
    swept: Sequence[str] = (),
) -> str:
    """One line per report, forecaster and permitted latency.

    Args:
        reports: of traces, perhaps each in several worlds.
        labels: the trace's name for each report.
        shown_sigmas: permitted latencies to show.
        swept: those of ``SWEPT`` that get a column.
    """
    columns = _labels("trace", swept)
    if len(shown_sigmas) > 1 or shown_sigmas != [0.0]:
        columns.append(_SIGMA)
    for title, metric in (("AUC", "auc"), ("DP@20", "dp20")):
        columns += [
            _of_scores(title, metric),
            *_offline_columns(metric),
            _of_scores("recov.", f"recovered_{metric}", PERCENT),
        ]
    if any("mauc" in result for report in reports for result in report["results"]):
        columns += [_of_scores("mAUC", "mauc"), _of_scores("mDP", "mdp")]
    columns += [
        _of_report("tracker", "tracker_fps", Number(".1f", unit=" fps")),
        _of_report("skipped", "skip_rate", PERCENT),
        _of_scores("mismatch", "mismatch_mean", _FRAMES),
    ]
    return text_of(Table.of(columns, _shown(zip(labels, reports), shown_sigmas)))


def _offline_columns(metric: str) -> list[Column]:
    """The offline score, and how far the score is from it."""

    def offline(line: _Line) -> float | None:
        scores = line.report["offline"]
        return None if scores is None else scores[metric]

    def change(line: _Line) -> float | None:
        return relative_change(line.scores[metric], offline(line))

    return [Column("offline", offline, _SCORE), Column("change", change, CHANGE)]


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
        )
        + f" (initialisation {report['init_ms']:.1f} ms on average)",
    ]
    if report["times_note"] is not None:
        lines.append(f"  times: {report['times_note']}")
    lines += [f"  {note}" for note in report["notes"]]
    share = f"{report['approximate_outputs']:,} outputs ({100 * report['approximate_share']:.3g}%)"
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


def attribute_table(
    report: Report, shown_sigmas: Sequence[float], swept: Sequence[str] = ()
) -> str:
    """One line per attribute and forecaster."""
    columns = [
        *_labels("attribute", swept),
        _of_scores("sequences", "sequences", str),
        _SIGMA,
        _of_scores("AUC", "auc"),
        _of_scores("recovered", "recovered_auc", PERCENT),
        _of_scores("DP@20", "dp20"),
    ]
    lines = [
        replace(line, label=name, scores=scores)
        for line in _shown([("", report)], shown_sigmas)
        for name, scores in line.result["attributes"].items()
    ]
    return text_of(Table.of(columns, sorted(lines, key=lambda line: line.label)))


def sequence_table(report: Report, shown_sigmas: Sequence[float], swept: Sequence[str] = ()) -> str:
    """One line per sequence and forecaster."""
    columns = [
        *_labels("sequence", swept),
        _SIGMA,
        _of_scores("AUC", "auc"),
        _of_scores("offline", "offline_auc"),
        _of_scores("DP@20", "dp20"),
        _of_scores("offline", "offline_dp20"),
        _of_scores("frames", "world_frames", str),
        _of_scores("processed", "processed", str),
        Column(
            "mismatch",
            lambda line: line.scores["mismatch_sum"] / line.scores["world_frames"],
            _FRAMES,
        ),
        _of_scores("approximate", "approximate_outputs", str),
        _of_scores("disagree", "disagreement", PERCENT),
    ]
    lines = [
        replace(line, label=scores["sequence"], scores=scores)
        for line in _shown([("", report)], shown_sigmas)
        for scores in line.result["per_sequence"]
    ]
    return text_of(Table.of(columns, sorted(lines, key=lambda line: line.label)))
