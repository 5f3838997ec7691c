"""``python -m lae_sim.replay``: replay traces and score them, latency counted."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

from lae_sim.cli import argument, exit_status, new_parser
from lae_sim.clock import parse_rational
from lae_sim.errors import LaeError
from lae_sim.files import check_distinct, labels
from lae_sim.options import add_forecasting, add_world, parse_latency, parse_policy
from lae_sim.zoo import FORECASTERS, find_camera, load_forecaster

if TYPE_CHECKING:
    from lae_sim.clock import Clock
    from lae_sim.forecast import AnyFactory
    from lae_sim.metrics import Convention
    from lae_sim.report import Report
    from lae_sim.run import Run
    from lae_sim.trace import Trace

PROGRAM = "lae-sim replay"

_SINGLE = ("outputs", "schedule", "events", "timeline")  # files of one trace in one world

EXAMPLES = f"""\
examples:
  lae-sim replay trace.parquet
  lae-sim replay trace.parquet --latency constant:47ms --forecaster hold kalman --sigma-grid
  lae-sim replay desktop.parquet --timing jetson.parquet      boxes of one device, times of another
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
    add("traces", nargs="+", metavar="TRACE", help="a trace (Parquet; see traces/FORMAT.md)")
    add_world(made)
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
    add("--plot", metavar="FILE", help="draw success and precision (.png, .svg, .pdf)")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _replay(arguments), PROGRAM)


def _replay(arguments: argparse.Namespace) -> None:
    import json

    from lae_sim import __version__
    from lae_sim.pairing import SIGMA_GRID

    single = [name for name in _SINGLE if getattr(arguments, name)]
    if single and len(arguments.traces) > 1:
        raise LaeError(f"--{single[0]} takes one trace at a time")
    if arguments.eta is not None:
        arguments.sigma = [-eta for eta in arguments.eta]
    arguments.sigma = list(dict.fromkeys(arguments.sigma))
    arguments.forecaster = list(dict.fromkeys(arguments.forecaster))
    arguments.traces = list(dict.fromkeys(arguments.traces))
    outputs = [*(getattr(arguments, name) for name in _SINGLE), arguments.plot]
    if arguments.strided and len(arguments.traces) > 1:
        raise LaeError("--strided goes with one trace at a time")
    timing = [arguments.timing] if arguments.timing else []
    inputs = [*arguments.traces, *timing, *arguments.strided]
    check_distinct([path for path in outputs if path], inputs)
    shown = sorted({float(sigma) for sigma in arguments.sigma})
    sigmas = sorted({*arguments.sigma, *(SIGMA_GRID if arguments.sigma_grid else ())})
    jobs = [
        _Job.of(path, label, arguments, sigmas)
        for path, label in zip(arguments.traces, labels(arguments.traces))
    ]
    if arguments.plot:
        from lae_sim.plots import check_format

        check_format(arguments.plot)
    with ExitStack() as files:  # whatever fails, no file is left behind
        reports = [_report(job, _sinks(job, arguments, files), arguments) for job in jobs]
        if arguments.plot:
            _plot(jobs, arguments.sigma[0], arguments.plot)
    if arguments.json:
        document = {"format": "lae-replay", "version": "1.0", "lae_sim": __version__}
        print(json.dumps({**document, "traces": reports}, indent=2, allow_nan=False))
    else:
        _print_tables(reports, shown, arguments)


@dataclass(frozen=True)
class _Job:
    """One trace and how it is replayed and scored.

    Attributes:
        path: the trace's file.
        label: its name in tables and pictures.
        trace: the trace.
        timing: the trace that the times come from, if it is another.
        clock: the world's clock.
        runs: replays the sequences, from the first, each time it is called.
        at_arrival: whether outputs count from their own frames' arrival.
        forecasters: factories by name; hold, the baseline of all comparisons, is always there.
        costs: what an answer of each forecaster costs, ns.
        sigmas: permitted latencies, ascending.
        convention: how frames and thresholds count.
    """

    path: str
    label: str
    trace: Trace
    timing: Trace | None
    clock: Clock
    runs: Callable[[], Iterator[Run]]
    at_arrival: bool
    forecasters: Mapping[str, AnyFactory]
    costs: Mapping[str, int]
    sigmas: Sequence[Fraction]
    convention: Convention

    @classmethod
    def of(
        cls, path: str, label: str, arguments: argparse.Namespace, sigmas: Sequence[Fraction]
    ) -> _Job:
        from lae_sim.clock import Clock
        from lae_sim.costs import resolve_costs
        from lae_sim.latency import scaled
        from lae_sim.metrics import find_convention
        from lae_sim.run import replay_trace
        from lae_sim.trace import read_trace

        policy, at_arrival = parse_policy(arguments.policy)
        if at_arrival and any(sigmas):
            raise LaeError("vot-realtime never scores latency: it goes with no permitted latency")
        if at_arrival and arguments.cost:
            raise LaeError("vot-realtime never scores latency: it goes with no --cost")
        if at_arrival and arguments.timeline:
            raise LaeError("vot-realtime never scores latency: it goes with no --timeline")
        source = scaled(parse_latency(arguments.latency), arguments.latency_scale)
        trace = read_trace(path, arguments.sequence)
        timing = read_trace(arguments.timing) if arguments.timing else None
        strided = [read_trace(pass_, arguments.sequence) for pass_ in arguments.strided]
        if arguments.attributes and not trace.metadata.names_attributes:
            raise LaeError(f"{path}: the trace names no attributes of its sequences")
        fps = arguments.fps or trace.metadata.fps
        camera = find_camera(
            arguments.root, arguments.dataset, arguments.sequence, fps, arguments.camera_lag
        )
        names = dict.fromkeys(["hold", *arguments.forecaster])
        forecasters = {name: load_forecaster(name, camera) for name in names}
        return cls(
            path=path,
            label=label,
            trace=trace,
            timing=timing,
            clock=Clock.at(fps),
            runs=lambda: replay_trace(trace, fps, source, policy, timing, strided),
            at_arrival=at_arrival,
            forecasters=forecasters,
            costs=resolve_costs(arguments.cost, forecasters, trace),
            sigmas=sigmas,
            convention=find_convention(arguments.convention),
        )


def _report(
    job: _Job, sinks: Sequence[Callable[[Run], None]], arguments: argparse.Namespace
) -> Report:
    """Replay and score one trace, giving each run to the sinks."""
    from lae_sim.costs import cost_notes
    from lae_sim.evaluation import evaluate
    from lae_sim.notes import SkippedStalls, notes_on
    from lae_sim.report import attribute_members, trace_report

    metadata = job.trace.metadata
    stalls = SkippedStalls()
    if arguments.latency == "recorded" and job.timing is None:
        sinks = [*sinks, stalls]
    runs = _written(_progress(job.runs(), job.path, job.trace.frames), sinks)
    evaluation = evaluate(
        runs, metadata, job.forecasters, job.sigmas, job.convention, job.at_arrival, job.costs
    )
    members = attribute_members(metadata, evaluation.sequences)
    notes = notes_on(evaluation, metadata, job.convention, job.forecasters, job.at_arrival)
    figures = trace_report(
        evaluation,
        job.clock,
        list(job.forecasters),
        job.sigmas,
        job.convention.name,
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
        "times_note": (job.timing or job.trace).metadata.timing_note,
        "fps": str(job.clock.fps),
        "policy": arguments.policy,
        "latency": arguments.latency,
        "latency_scale": str(arguments.latency_scale),
        "convention": job.convention.name,
        "forecaster_cost_ns": dict(job.costs),
        "notes": [*notes, *stalls.notes(), *cost_notes(job.costs)],
        **figures,
    }


def _sinks(
    job: _Job, arguments: argparse.Namespace, files: ExitStack
) -> list[Callable[[Run], None]]:
    """Open the files that were asked for; what each does with a run."""
    from pathlib import Path

    from lae_sim import export
    from lae_sim.evaluation import answers
    from lae_sim.timeline import timeline_file

    sinks: list[Callable[[Run], None]] = []
    answer_sinks: list[export.AnswerSink] = []
    if arguments.schedule:
        sinks.append(files.enter_context(export.schedule_file(arguments.schedule, job.clock)))
    if arguments.events:
        events = export.events_file(arguments.events, arguments.sigma[0], job.at_arrival)
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
                found = answers(
                    run, job.trace.metadata, name, factory, sigma, job.at_arrival, cost_ns
                )
                for sink in answer_sinks:
                    sink(run, name, sigma, found)

    return [*sinks, answer] if answer_sinks else sinks


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


def _plot(jobs: Sequence[_Job], sigma: Fraction, path: str) -> None:
    """Draw success and precision of all traces."""
    from pathlib import Path

    from lae_sim import plots
    from lae_sim.export import sigma_text

    named: plots.Curves = {}
    for job in jobs:
        found = plots.curves(
            job.runs(),
            job.trace.metadata,
            job.forecasters,
            sigma,
            job.convention,
            job.at_arrival,
            job.costs,
        )
        prefix = f"{Path(job.label).with_suffix('')}: " if len(jobs) > 1 else ""
        named.update({prefix + name: curve for name, curve in found.items()})
    title = "" if len(jobs) > 1 else f"{jobs[0].label}: "
    title += f"sigma {sigma_text(sigma)}, convention {jobs[0].convention.name}"
    plots.save(plots.success_and_precision(named, title), path)


def _print_tables(
    reports: Sequence[Report], shown: Sequence[float], arguments: argparse.Namespace
) -> None:
    from lae_sim.report import attribute_table, sequence_table, settings_text, summary_table

    for report in reports:
        if arguments.per_sequence:
            print(f"{report['trace']}\n\n{sequence_table(report, shown)}\n")
        if arguments.attributes:
            print(f"{report['trace']}\n\n{attribute_table(report, shown)}\n")
    print(summary_table(reports, labels(arguments.traces), shown), end="\n\n")
    for report in reports:
        print(settings_text(report))


if __name__ == "__main__":
    sys.exit(main())
