"""``lae-sim replay``: replay traces and score them, latency counted."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

from lae_sim.cli.options import (
    add_forecasting,
    add_world,
    argument,
    exit_status,
    new_parser,
    worlds_of,
)
from lae_sim.engine.clock import parse_rational
from lae_sim.errors import LaeError
from lae_sim.files import check_distinct, labels
from lae_sim.learning.registry import FORECASTERS, find_camera, load_forecaster

if TYPE_CHECKING:
    from lae_sim.forecast.base import AnyFactory
    from lae_sim.replay.run import Run, Runs
    from lae_sim.replay.world import World
    from lae_sim.report.replay import Report
    from lae_sim.trace.file import Trace


PROGRAM = "lae-sim replay"

_FILES = ("outputs", "schedule", "events", "timeline")  # each of one trace in one world

EXAMPLES = f"""\
examples:
  lae-sim replay trace.parquet
  lae-sim replay trace.parquet --latency constant:47ms --forecaster hold kalman --sigma-grid
  lae-sim replay desktop.parquet --timing jetson.parquet      boxes of one device, times of another
  lae-sim replay trace.parquet --fps 15 30 60 --latency-scale 1/2 1 2 --plot sweep.png
  lae-sim replay a.parquet b.parquet --latency-scale 2 --json | jq '.traces[].results[].auc'
  lae-sim replay trace.parquet --forecaster my_package.my_module:MyForecaster --per-sequence

{FORECASTERS}
policies:     latest, fifo, every:N, shrinking-tail:TIME (expected processing time, such as 47ms),
              vot-realtime[:GRACE] (the VOT toolkit's rule: it skips frames, never scores latency)
latencies:    recorded, by-call, constant:TIME, resample:SEED, lognormal:SEED
conventions:  pysot, elae, otb, got10k, got10k-101, exclude
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        PROGRAM,
        "Replay traces in a discrete-event simulation and score them, latency counted.",
        EXAMPLES,
    )
    add = made.add_argument
    add("traces", nargs="+", metavar="TRACE", help="traces (see traces/FORMAT.md), folders, URLs")
    add_world(made, sweeps=True)
    scores = made.add_argument_group("forecasting and scores")
    add = scores.add_argument
    add(
        "--forecaster",
        nargs="+",
        default=["hold", "kalman"],
        metavar="NAME",
        help="post-forecasters to compare (default: hold kalman)",
    )
    sigma = scores.add_mutually_exclusive_group()
    sigma.add_argument(
        "--sigma",
        nargs="+",
        type=argument(parse_rational),
        default=[Fraction(0)],
        metavar="FRAMES",
        help="permitted latencies: frame i is queried at (i + sigma) / fps (default: 0); "
        "a negative fraction is written --sigma=-1/2",
    )
    sigma.add_argument(
        "--eta",
        nargs="+",
        type=argument(parse_rational),
        metavar="FRAMES",
        help="the same with the sign of sAP: frame i is queried at (i - eta) / fps",
    )
    add("--sigma-grid", action="store_true", help="add mAUC and mDP over sigma = 0, 0.02, ..., 1")
    add("--convention", default="pysot", help="how frames and thresholds count (default: pysot)")
    add("--sequence", nargs="+", metavar="NAME", help="replay these sequences only")
    add_forecasting(made)
    output = made.add_argument_group("output")
    add = output.add_argument
    add("--per-sequence", action="store_true", help="report each sequence")
    add("--attributes", action="store_true", help="report each attribute of the dataset")
    add("--json", action="store_true", help="print one JSON object instead of tables")
    add("--outputs", metavar="FILE", help="write every answer to a Parquet file")
    add("--schedule", metavar="FILE", help="write every processed frame's ticks to a Parquet file")
    add("--events", metavar="FILE", help="write the event log of the first sigma as JSON lines")
    add(
        "--timeline",
        metavar="FILE",
        help="write the first sigma's timeline: .json for Perfetto, or a .png, .svg or .pdf "
        "picture of the first sequence",
    )
    add("--export-txt", metavar="DIR", help="write result text files for the pysot toolkit")
    add("--plot", metavar="FILE", help="draw success and precision, or a sweep (.png, .svg, .pdf)")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _replay(arguments), PROGRAM)


def _replay(arguments: argparse.Namespace) -> None:
    import json

    from lae_sim import __version__
    from lae_sim.engine.scheduler import scores_latency
    from lae_sim.replay.world import SIGMA_GRID
    from lae_sim.trace.locate import find_traces

    if arguments.eta is not None:
        arguments.sigma = [-eta for eta in arguments.eta]
    for name in ("sigma", "forecaster", "fps", "latency_scale"):
        setattr(arguments, name, list(dict.fromkeys(getattr(arguments, name))))
    arguments.traces = find_traces(arguments.traces)
    swept = [name for name in ("fps", "latency_scale") if len(getattr(arguments, name)) > 1]
    _check_files(arguments, swept)
    shown = sorted({float(sigma) for sigma in arguments.sigma})
    sigmas = sorted({*arguments.sigma, *(SIGMA_GRID if arguments.sigma_grid else ())})
    worlds = worlds_of(
        arguments,
        sigma=sigmas,
        convention=arguments.convention,
        forecasters=["hold", *arguments.forecaster],
        costs=arguments.cost,
    )
    if arguments.timeline and not scores_latency(worlds[0].rule()):
        raise LaeError(f"{arguments.policy} never scores latency: it goes with no --timeline")
    named = zip(arguments.traces, labels(arguments.traces))
    jobs = [job for path, label in named for job in jobs_of(path, label, worlds, arguments)]
    if arguments.plot:
        from lae_sim.report.style import check_format

        check_format(arguments.plot)
    with ExitStack() as files:  # whatever fails, no file is left behind
        reports = [report(job, _sinks(job, arguments, files), arguments) for job in jobs]
        if arguments.plot:
            _plot(jobs, reports, swept, arguments)
    if arguments.json:
        document = {"format": "lae-replay", "version": "1.0", "lae_sim": __version__}
        print(json.dumps({**document, "traces": reports}, indent=2, allow_nan=False))
    else:
        _print_tables(jobs, reports, shown, swept, arguments)


def _check_files(arguments: argparse.Namespace, swept: Sequence[str]) -> None:
    """Check that the files asked for can hold what is asked for, and replace nothing that is."""
    asked = [name for name in _FILES if getattr(arguments, name)]
    if asked and len(arguments.traces) > 1:
        raise LaeError(f"--{asked[0]} takes one trace at a time")
    asked += ["export-txt"] if arguments.export_txt else []
    if asked and swept:
        raise LaeError(f"--{asked[0]} takes one frame rate and one scale of the times at a time")
    if arguments.strided and len(arguments.traces) > 1:
        raise LaeError("--strided goes with one trace at a time")
    outputs = [*(getattr(arguments, name) for name in _FILES), arguments.plot]
    timing = [arguments.timing] if arguments.timing else []
    inputs = [*arguments.traces, *timing, *arguments.strided]
    check_distinct([path for path in outputs if path], inputs)


def _sinks(
    job: Job, arguments: argparse.Namespace, files: ExitStack
) -> list[Callable[[Run], None]]:
    """Open the files that were asked for; what each does with a run."""
    from pathlib import Path

    from lae_sim.evaluation.evaluate import answers
    from lae_sim.report import export
    from lae_sim.report.timeline import timeline_file

    sinks: list[Callable[[Run], None]] = []
    answer_sinks: list[export.AnswerSink] = []
    if arguments.schedule:
        sinks.append(files.enter_context(export.schedule_file(arguments.schedule, job.runs.clock)))
    if arguments.events:
        events = export.events_file(arguments.events, arguments.sigma[0])
        sinks.append(files.enter_context(events))
    if arguments.timeline:
        costs = {name: job.costs.get(name, 0) for name in arguments.forecaster}
        drawn = timeline_file(arguments.timeline, arguments.sigma[0], costs)
        sinks.append(files.enter_context(drawn))
    if arguments.outputs:
        answer_sinks.append(files.enter_context(export.outputs_file(arguments.outputs)))
    if arguments.export_txt:
        stem = Path(job.label).with_suffix("").as_posix().strip("/.").replace("/", "-")
        names = export.result_names(stem, arguments.forecaster, arguments.sigma)
        folders = export.result_folders(arguments.export_txt, names)
        answer_sinks.append(files.enter_context(folders))

    def answer(run: Run) -> None:
        for name in arguments.forecaster:
            factory = job.forecasters[name]
            for sigma in arguments.sigma:
                cost_ns = job.costs.get(name, 0)
                found = answers(run, job.trace.metadata, name, factory, sigma, cost_ns)
                for sink in answer_sinks:
                    sink(run, name, sigma, found)

    return [*sinks, answer] if answer_sinks else sinks


def _plot(
    jobs: Sequence[Job],
    reports: Sequence[Report],
    swept: Sequence[str],
    arguments: argparse.Namespace,
) -> None:
    """Draw success and precision of all traces, or how AUC and DP change over a sweep."""
    from pathlib import Path

    from lae_sim.evaluation.evaluate import evaluate
    from lae_sim.evaluation.metrics import find_convention
    from lae_sim.report import figures
    from lae_sim.report.export import sigma_text
    from lae_sim.report.style import save

    sigma, several = arguments.sigma[0], len(arguments.traces) > 1
    title = "" if several else f"{jobs[0].label}: "
    title += f"sigma {sigma_text(sigma)}, convention {jobs[0].world.convention}"
    if swept:
        names = [job.label for job in jobs]
        save(figures.sweep_figure(reports, names, float(sigma), swept, title), arguments.plot)
        return
    named: figures.Curves = {}
    for job in jobs:
        evaluation = evaluate(
            job.runs,
            job.trace.metadata,
            job.forecasters,
            [sigma],
            find_convention(job.world.convention),
            job.costs,
        )
        found = figures.mean_curves(evaluation, job.forecasters)
        prefix = f"{Path(job.label).with_suffix('')}: " if several else ""
        named.update({prefix + name: curve for name, curve in found.items()})
    save(figures.success_and_precision(named, title), arguments.plot)


def _print_tables(
    jobs: Sequence[Job],
    reports: Sequence[Report],
    shown: Sequence[float],
    swept: Sequence[str],
    arguments: argparse.Namespace,
) -> None:
    from lae_sim.report.replay import attribute_table, sequence_table, settings_text, summary_table

    for each in reports:
        if arguments.per_sequence:
            print(f"{each['trace']}\n\n{sequence_table(each, shown, swept)}\n")
        if arguments.attributes:
            print(f"{each['trace']}\n\n{attribute_table(each, shown, swept)}\n")
    print(summary_table(reports, [job.label for job in jobs], shown, swept), end="\n\n")
    for each in reports:
        print(settings_text(each))
    if "fps" in swept:
        print(
            "a sweep of the rate is one of how fast the world moves: recorded frames arrive "
            "faster, with the same motion from one to the next"
        )


@dataclass(frozen=True)
class Job:
    """One trace in one world.

    Attributes:
        path: the trace's file.
        label: its name in tables and pictures.
        trace: the trace.
        world: how it is replayed and scored.
        runs: the sequences, replayed from the first each time one goes through them.
        forecasters: factories by name; hold, the baseline of all comparisons, is always there.
        costs: what an answer of each forecaster costs, ns.
    """

    path: str
    label: str
    trace: Trace
    world: World
    runs: Runs
    forecasters: Mapping[str, AnyFactory]
    costs: Mapping[str, int]


def jobs_of(
    path: str, label: str, worlds: Sequence[World], arguments: argparse.Namespace
) -> Iterator[Job]:
    """The jobs of one trace, one for each world."""
    from lae_sim.evaluation.metrics import find_convention
    from lae_sim.forecast.costs import resolve_costs
    from lae_sim.trace.file import read_trace

    find_convention(arguments.convention)
    trace = read_trace(path, arguments.sequence)
    if arguments.attributes and not trace.metadata.names_attributes:
        raise LaeError(f"{path}: the trace names no attributes of its sequences")
    costs: dict[str, int] | None = None
    for world in worlds:
        runs = world.replay(trace, arguments.sequence)
        camera = find_camera(
            arguments.root,
            arguments.dataset,
            arguments.sequence,
            runs.clock.fps,
            arguments.camera_lag,
        )
        forecasters = {name: load_forecaster(name, camera) for name in world.forecasters}
        if costs is None:  # measured once: a sweep is of nothing else
            costs = resolve_costs(world.costs, forecasters, trace)
        yield Job(path, label, trace, world, runs, forecasters, costs)


def report(
    job: Job, sinks: Sequence[Callable[[Run], None]], arguments: argparse.Namespace
) -> Report:
    """Replay and score one trace, giving each run to the sinks."""
    from lae_sim.evaluation.caveats import SkippedStalls, notes_on
    from lae_sim.evaluation.evaluate import evaluate
    from lae_sim.evaluation.metrics import find_convention
    from lae_sim.forecast.costs import cost_notes
    from lae_sim.report.replay import attribute_members, trace_report

    metadata = job.trace.metadata
    stalls = SkippedStalls()
    if job.world.latency == "recorded" and job.world.timing is None:
        sinks = [*sinks, stalls]
    runs = _written(_progress(job.runs, job.path, job.trace.frames), sinks)
    convention = find_convention(job.world.convention)
    evaluation = evaluate(runs, metadata, job.forecasters, job.world.sigmas, convention, job.costs)
    members = attribute_members(metadata, evaluation.sequences)
    notes = notes_on(evaluation, metadata, convention, job.forecasters)
    figures = trace_report(
        evaluation,
        job.runs.clock,
        list(job.forecasters),
        job.world.sigmas,
        job.world.convention,
        members if arguments.attributes else None,
        arguments.per_sequence,
    )
    return {
        "trace": job.path,
        "tracker": metadata.tracker,
        "dataset": metadata.dataset,
        "device": metadata.device,
        "strided": arguments.strided,
        "times_from": arguments.timing or job.path,
        "times_note": (job.runs.timing or job.trace).metadata.timing_note,
        "fps": str(job.runs.clock.fps),
        "policy": arguments.policy,
        "latency": arguments.latency,
        "latency_scale": str(job.world.scale),
        "convention": job.world.convention,
        "forecaster_cost_ns": dict(job.costs),
        "notes": [*notes, *stalls.notes(), *cost_notes(job.costs)],
        **figures,
    }


def _written(runs: Iterable[Run], sinks: Sequence[Callable[[Run], None]]) -> Iterator[Run]:
    """The runs, each given to every sink as it passes."""
    for run in runs:
        for sink in sinks:
            sink(run)
        yield run


def _progress(runs: Iterable[Run], path: str, frames: int | None) -> Iterator[Run]:
    """The runs, with a progress bar if the standard error stream is a terminal."""
    from tqdm import tqdm

    with tqdm(total=frames, desc=path, unit=" frames", unit_scale=True, disable=None) as bar:
        for run in runs:
            yield run
            bar.update(len(run))
