"""Pictures of replays: success and precision, sweeps, timelines, and how true replays are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.comparison.fidelity import FidelityRow
from lae_sim.engine.scheduler import Schedule
from lae_sim.evaluation.evaluate import Evaluation
from lae_sim.evaluation.pairing import Pairing, pair
from lae_sim.evaluation.totals import CurveTotals
from lae_sim.figures.column import ColumnFigure, column_figure
from lae_sim.figures.lines import (
    Curve,
    Line,
    Panel,
    draw_curves,
    draw_sweep,
    panel_in_column,
    panels_of,
)
from lae_sim.figures.style import (
    BLUE,
    GREY,
    SKY_BLUE,
    VERMILION,
    forecaster_lines,
    forecaster_styles,
    new_figure,
    paper_styles,
    styled,
    tracker_styles,
)
from lae_sim.replay.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from lae_sim.engine.stages import PipelineSchedule


Report = dict[str, Any]
"""What a replay says of a trace (see :func:`lae_sim.report.replay.trace_report`)."""

Curves = dict[str, tuple[Floats, Floats]]
"""By name: success over IoU thresholds, and precision over 0..50 px, mean over sequences."""


def mean_curves(scored: Evaluation | CurveTotals, forecasters: Iterable[str]) -> Curves:
    """Mean curves by name; also of the offline boxes, where the trace holds every frame.

    Args:
        scored: sequences, or what they add up to, at their first permitted latency.
        forecasters: names of the forecasters that were scored.
    """
    totals = scored if isinstance(scored, CurveTotals) else CurveTotals()
    if isinstance(scored, Evaluation):
        totals.add(scored)
    means = {name: totals.curves(f) for f, name in enumerate(forecasters)}
    if totals.complete:
        means = {"offline": totals.offline, **means}
    return {name: (mean.success, mean.precision) for name, mean in means.items()}


def success_and_precision(named: Mapping[str, tuple[Floats, Floats]], title: str = "") -> Figure:
    """Success and precision plots side by side, AUC and DP at 20 px in the legend.

    Args:
        named: curves by name; for several traces the names are ``"trace: forecaster"``.
        title: above both plots.
    """
    return draw_curves(_styled_curves(named), title)


def curves_for_paper(named: Mapping[str, tuple[Floats, Floats]], of: str) -> Iterator[ColumnFigure]:
    """The same as two figures for a paper; of many curves, those of each trace by themselves.

    Args:
        named: see :func:`success_and_precision`.
        of: the setting, in words.
    """
    groups: dict[str, dict[str, tuple[Floats, Floats]]] = {}
    for name, curves in named.items():
        trace = name.rpartition(": ")[0] if len(named) > MOST_CURVES else ""
        groups.setdefault(trace, {})[name] = curves
    for trace, group in groups.items():
        success, precision = panels_of(_styled_curves(group, of_paper=True))
        end, caption = (f"-{trace}", f"{trace}: {of}") if trace else ("", of)
        yield ColumnFigure(
            f"success{end}",
            f"Success: {caption}. In brackets: AUC.",
            partial(panel_in_column, success),
        )
        yield ColumnFigure(
            f"precision{end}",
            f"Precision: {caption}. In brackets: precision at 20 px.",
            partial(panel_in_column, precision),
        )


def _styled_curves(
    named: Mapping[str, tuple[Floats, Floats]], of_paper: bool = False
) -> list[Curve]:
    """Curves, in which a paper has forecasters differ in their lines too."""
    parts = {name: name.rpartition(": ")[::2] for name in named}
    traces = tracker_styles(trace for trace, _ in parts.values())
    forecasters = dict.fromkeys(forecaster for _, forecaster in parts.values())
    styles = paper_styles(forecasters) if of_paper else forecaster_styles(forecasters)
    lines = forecaster_lines(forecasters)
    return [
        Curve(
            name,
            *named[name],
            {**traces[trace], "linestyle": lines[forecaster]}
            if len(traces) > 1
            else styles[forecaster],
        )
        for name, (trace, forecaster) in parts.items()
    ]


MOST_CURVES = 8
"""More curves are not drawn in one figure of a paper."""

_AXES = {"fps": "world frame rate (fps)", "latency_scale": "scale of the processing times"}
_SCORES = {"auc": "AUC", "dp20": "DP at 20 px"}


def sweep_figure(
    reports: Sequence[Report],
    labels: Sequence[str],
    sigma: float,
    swept: Sequence[str],
    title: str = "",
) -> Figure:
    """AUC and DP of each forecaster over what was swept.

    Args:
        reports: of traces, each in several worlds.
        labels: the trace's name for each report.
        sigma: the permitted latency to show.
        swept: ``"fps"``, ``"latency_scale"`` or both; the first is the horizontal axis, and there
            is a row of panels for each trace and value of the other.
        title: above all.
    """
    panels = sweep_panels(reports, labels, sigma, swept)
    return draw_sweep(panels, 2, title, sharex=True, sharey="col")


def sweep_panels(
    reports: Sequence[Report],
    labels: Sequence[str],
    sigma: float,
    swept: Sequence[str],
    of_paper: bool = False,
) -> list[Panel]:
    """AUC and DP of each forecaster over what was swept, by turns (see :func:`sweep_figure`).

    ``of_paper`` has forecasters differ in their lines too.
    """
    x, *others = swept
    rows: dict[str, list[Report]] = {}
    for label, report in zip(labels, reports):
        row = [label] if len(set(labels)) > 1 else []
        row += [f"times x {report[name]}" for name in others]
        rows.setdefault(", ".join(row), []).append(report)
    panels = []
    for row_name, members in rows.items():
        members.sort(key=lambda report: Fraction(report[x]))
        places = [float(Fraction(report[x])) for report in members]
        for metric, name in _SCORES.items():
            scores: dict[str, list[float | None]] = {}
            for report in members:
                for result in report["results"]:
                    if result["sigma"] == sigma:
                        scores.setdefault(result["forecaster"], []).append(result[metric])
            if members[0]["offline"] is not None:
                scores["offline"] = [members[0]["offline"][metric]] * len(places)
            styles = paper_styles(scores) if of_paper else forecaster_styles(scores)
            lines = [
                Line(forecaster, places, np.array(values, np.float64), styles[forecaster])
                for forecaster, values in scores.items()
            ]
            logarithmic = x == "latency_scale" and places[0] > 0
            panels.append(Panel(row_name, _AXES[x], name, lines, logarithmic))
    return panels


def sigma_panels(report: Report) -> list[Panel]:
    """AUC and DP of each forecaster over the permitted latency, in one world."""
    panels = []
    for metric, name in _SCORES.items():
        points: dict[str, list[tuple[float, float | None]]] = {}
        for result in report["results"]:
            points.setdefault(result["forecaster"], []).append((result["sigma"], result[metric]))
        if report["offline"] is not None:
            on = next(iter(points.values()))
            points["offline"] = [(sigma, report["offline"][metric]) for sigma, _ in on]
        styles = paper_styles(points)
        lines = []
        for forecaster, pairs in points.items():
            sigmas, scores = np.array(sorted(pairs), np.float64).T
            lines.append(Line(forecaster, sigmas, scores, styles[forecaster]))
        panels.append(Panel("", "permitted latency σ (frames)", name, lines))  # noqa: RUF001
    return panels


@styled
def timeline_figure(
    run: Run,
    sigma: Fraction = Fraction(0),
    first: int = 0,
    count: int = 20,
    pairing: Pairing | None = None,
) -> Figure:
    """When frames arrived and were processed or skipped, and which output answered each query.

    Args:
        run: one replayed sequence.
        sigma: permitted latency of the queries, frames.
        first: first world frame shown.
        count: number of world frames shown.
        pairing: of the run at that sigma, where it is known already.
    """
    figure = new_figure(12, 3.6)
    axes = figure.subplots()
    end = min(first + count, run.schedule.length)
    _draw_timeline(axes, run, sigma, range(first, end), pairing)
    axes.set_title(f"{run.recording.name}: who answers what")
    return figure


def timeline_for_paper(run: Run, sigma: Fraction = Fraction(0)) -> ColumnFigure:
    """The first calls of a run after its initialisation, as a figure for a paper."""
    schedule = run.schedule
    frames = schedule.frames.tolist()
    first = max(frames[min(1, len(frames) - 1)] - 2, 0)
    few = frames[min(4, len(frames) - 1)] - first
    shown = range(first, min(first + min(max(few, 8), 16), schedule.length))
    draw = partial(_draw_timeline, run=run, sigma=sigma, shown=shown, size=6)
    rows = len(getattr(schedule, "stages", " "))  # of a pipeline; else there is one, the tracker's
    name, works = run.recording.name, "the tracker at work on them"
    if schedule.visible is not None:
        works = "the stages at work (hollow: a frame is held up; crosses: frames are dropped)"
    return ColumnFigure(
        f"timeline-{name}",
        f"{name}: frames as they arrive (hollow: skipped), {works}, and the frame whose output "
        "answers the query for each",
        partial(column_figure, draw, 1.2 + 0.3 * rows),
    )


def _draw_timeline(
    axes: Axes,
    run: Run,
    sigma: Fraction,
    shown: range,
    pairing: Pairing | None = None,
    size: float = 7,
) -> None:
    """Frames, calls and queries, one above the other; letters of a size in points."""
    schedule = run.schedule
    clock = schedule.clock
    frame_ms = clock.milliseconds(1)
    processed = set(schedule.frames.tolist())
    left = clock.arrival_ms(shown.start) - frame_ms / 2
    right = clock.arrival_ms(shown.stop) + frame_ms / 2
    if schedule.visible is not None:  # only those of pipelines are later than they are ready
        rows = _draw_stages(axes, cast("PipelineSchedule", schedule), left, right, size)
    else:
        rows = ["tracker busy"]
        _draw_calls(axes, schedule, shown, left, right, size)
    top = len(rows) + 1
    for frame in shown:
        taken = frame in processed
        colour = BLUE if taken else VERMILION
        arrival_ms = clock.arrival_ms(frame)
        axes.plot(arrival_ms, top, "o", color=colour, fillstyle="full" if taken else "none")
        axes.annotate(str(frame), (arrival_ms, top + 0.18), ha="center", fontsize=size)
    known = pairing or pair([schedule], [sigma])
    _draw_queries(axes, run, sigma, known, shown, size)
    names = ["query and source", *rows, "world frame\n(hollow: skipped)"]
    axes.set_yticks(range(len(names)), names)
    axes.set(ylim=(-0.6, top + 0.5), xlabel="time (ms)")
    axes.set_xlim(left, right)


def _draw_calls(
    axes: Axes, schedule: Schedule, shown: range, left: float, right: float, size: float
) -> None:
    """What the tracker works on."""
    clock = schedule.clock
    ticks_per_ms = clock.ticks_per_ns * 1e6
    for frame, start, ready in zip(schedule.frames, schedule.start, schedule.ready):
        if ready >= clock.arrival(shown.start) and frame < shown.stop:
            begin, length = start / ticks_per_ms, (ready - start) / ticks_per_ms
            axes.barh(1, length, left=begin, height=0.42, color=BLUE, edgecolor="white")
            middle = (max(begin, left) + min(begin + length, right)) / 2
            axes.text(middle, 1, str(frame), ha="center", va="center", color="w", fontsize=size + 1)


def _draw_stages(
    axes: Axes, schedule: PipelineSchedule, left: float, right: float, size: float
) -> list[str]:
    """What each stage works on (hollow: waits with it), and what it drops; names of its rows."""
    from lae_sim.engine.stages import Drop  # with SimPy, which few replays need
    from lae_sim.evaluation.pipeline import shared_out

    ticks_per_ms = schedule.clock.ticks_per_ns * 1e6
    end = schedule.clock.end(schedule.length)
    pipeline = schedule.pipeline
    stages = [stage for stage in pipeline.stages if stage.name != pipeline.output][::-1]
    stages.insert(0, pipeline.way[-1])  # the lowest row, which answers the queries below it
    for row, stage in enumerate(stages, 1):
        log, height = schedule.stages[stage.name], 0.62 / stage.workers
        held = np.where(log.left >= 0, log.left, np.where(log.gone >= 0, log.gone, 2 * end))
        spans = [
            (int(log.taken[frame]), int(held[frame]), frame)
            for frame in np.flatnonzero(log.taken >= 0).tolist()
        ]
        for worker, frame in shared_out(spans):
            instants = [getattr(log, what)[frame] for what in ("taken", "started", "finished")]
            taken, started, finished = (tick / ticks_per_ms for tick in instants)
            until = held[frame] / ticks_per_ms
            if until < left or taken > right:
                continue
            place = row + 0.31 - height * (worker + 0.5)
            if started < 0:
                started = finished = until
            for begin, stop, colour in (
                (taken, started, "white"),
                (started, finished, BLUE),
                (finished, until, "white"),
            ):
                if stop > begin:
                    axes.barh(
                        place, stop - begin, left=begin, height=0.9 * height,
                        color=colour, edgecolor=BLUE, linewidth=0.7,
                    )  # fmt: skip
            if (width := min(finished, right) - max(started, left)) > 0.02 * (right - left):
                middle = max(started, left) + width / 2
                axes.text(
                    middle, place, str(frame), ha="center", va="center", color="w", fontsize=size
                )
        lost = log.gone[log.dropped == Drop.FULL] / ticks_per_ms
        lost = lost[(lost >= left) & (lost <= right)]
        axes.plot(lost, np.full(len(lost), row + 0.4), "x", color=VERMILION, markersize=4)
    return [stage.name for stage in stages]


def _draw_queries(
    axes: Axes, run: Run, sigma: Fraction, pairing: Pairing, shown: range, size: float
) -> None:
    """A mark for each query, joined to the moment when the output that answers it was ready."""
    schedule = run.schedule
    clock = schedule.clock
    seen = schedule.ready if schedule.visible is None else schedule.visible
    spans = zip(schedule.frames, seen, pairing.first[:, 0], pairing.end[:, 0])
    for source, ready, begin, stop in spans:
        for frame in range(max(begin, shown.start), min(stop, shown.stop)):
            query = clock.arrival_ms(frame, sigma)
            axes.plot(query, 0, "|", color="black", markersize=12)
            axes.annotate(f"{source}", (query, -0.4), ha="center", fontsize=size)
            if source:
                axes.plot(
                    [ready / clock.ticks_per_ns / 1e6, query], [0.78, 0.12], lw=0.6, color="grey"
                )


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
        label = f"{kind}{_off(of_kind[kind])}"
        _replay_points(recorded, of_kind[kind], label, colour, marker)
    _diagonal(recorded, "recorded boxes")
    inside = [row for row in of_kind["modelled"] if row.covered]
    outside = [row for row in of_kind["modelled"] if row.covered is False]
    for some, colour in ((inside, BLUE), (outside, VERMILION)):
        holds = "holds" if some is inside else "does not hold"
        label = f"the interval {holds} the closed loop"
        ends = np.array([[row.auc_low, row.auc_high] for row in some], float).reshape(-1, 2)
        at = [row.closed_auc for row in some]
        modelled.vlines(at, *ends.T, color=colour, alpha=0.45, linewidth=1.2)
        _replay_points(modelled, some, label, colour, "o")
    _diagonal(modelled, f"search model{_off(of_kind['modelled'])}")
    recorded.set_ylabel("AUC of the replay")
    return figure


def _off(rows: Sequence[FidelityRow]) -> str:
    """How far replays are from closed loops, in words."""
    if not rows:
        return ""
    return f": off by {np.mean([abs(row.d_auc) for row in rows]):.3f} on average"


def _replay_points(
    axes: Axes, rows: Sequence[FidelityRow], label: str, colour: str, marker: str
) -> None:
    if not rows:
        return
    axes.scatter(
        [row.closed_auc for row in rows],
        [row.auc for row in rows],
        s=18,
        color=colour,
        marker=marker,
        alpha=0.8,
        linewidths=0,
        label=f"{label} ({len(rows)})",
        zorder=3,
    )


def _diagonal(axes: Axes, title: str) -> None:
    axes.plot([0, 1], [0, 1], color="black", linewidth=0.8, zorder=1)
    axes.set(title=title, xlabel="AUC of the closed loop", xlim=(0, 1), ylim=(0, 1))
    axes.set_aspect("equal")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14))
