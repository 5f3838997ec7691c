"""``lae-sim replay``: replay traces and score them, latency counted."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
from fractions import Fraction
from itertools import product
from typing import TYPE_CHECKING

from lae_sim.cli.options import (
    add_forecasting,
    add_search,
    add_world,
    argument,
    check_folder,
    check_outputs,
    exit_status,
    new_parser,
    print_json,
    worlds_of,
)
from lae_sim.engine.clock import parse_rational
from lae_sim.errors import LaeError
from lae_sim.files import labels
from lae_sim.learning.registry import FORECASTERS
from lae_sim.progress import print_text, screen_width

if TYPE_CHECKING:
    from lae_sim.api.evaluation import Scenario
    from lae_sim.evaluation.evaluate import Observer
    from lae_sim.report.replay import Report


PROGRAM = "lae-sim replay"

_FILES = ("outputs", "schedule", "events", "timeline")  # each of one trace in one world

EXAMPLES = f"""\
examples:
  lae-sim replay trace.parquet
  lae-sim replay trace.parquet --latency constant:47ms --forecaster hold kalman --sigma-grid
  lae-sim replay desktop.parquet --timing jetson.parquet      boxes of one device, times of another
  lae-sim replay trace.parquet --fps 15 30 60 --latency-scale 1/2 1 2 --plot sweep.png
  lae-sim replay trace.parquet --latency constant:47ms,init=800ms --strided trace.gaps.parquet
  lae-sim replay trace.parquet --latency constant:47ms --search c=0.7 --pre-forecaster kalman
  lae-sim replay trace.parquet --pipeline drone.toml          from the camera to the command
  lae-sim replay trace.parquet --pipeline one.toml ten.toml --waterfall why.png
  lae-sim replay a.parquet b.parquet --latency-scale 2 --json | jq '.traces[].results[].auc'
  lae-sim replay a.parquet b.parquet --sigma-grid --out paper       figures and tables in a folder
  lae-sim replay trace.parquet --forecaster my_package.my_module:MyForecaster --per-sequence

{FORECASTERS}
policies, by which a free tracker takes a frame:
  latest                  the newest that has arrived, or the next to arrive
  fifo                    every frame in order; they queue
  every:N                 every N-th frame in order
  shrinking-tail:TIME     the newest, or the next if a call of that time, such as 47ms, then ends
                          closer after an arrival (Li et al. 2020)
  vot-realtime[:GRACE]    the VOT toolkit's rule: it skips frames, but never scores latency
  recorded                the frames that the trace holds, in order: a measured log as it was
  package.module:object   your own
latencies, each perhaps with ,init=TIME for the initialisation (constant:47ms,init=800ms):
  recorded                each frame's recorded time
  by-call                 the k-th call takes the k-th recorded time
  stage:NAME[+NAME]       the recorded times of a stage, or of several, alone (stage:inference)
  constant:TIME           the same for all calls
  resample:SEED           each call draws one of the recorded times
  lognormal:SEED          each call draws from the lognormal distribution fitted to them
  bootstrap:SEED[:BLOCK]  draws blocks of BLOCK (30) consecutive times: stalls stay together
  package.module:object   your own
conventions, by which toolkits count frames without a valid truth (AUC; DP) and thresholds:
  pysot                   w, h > 0 is valid; else a miss of AUC, a hit of DP (PVT++, LAE-PVT)
  elae                    as pysot, but x, y, w, h > 0 is valid
  otb                     as elae; frame 0 is the truth's, sequences of score 0 leave the mean
  lasot                   absent targets are left out of both, but divided by all frames
  got10k                  frames without truth are left out; got10k-101: AUC of 101 thresholds
  exclude                 frames without w, h > 0 are left out of both
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
    add(
        "--pipeline",
        nargs="+",
        default=[],
        metavar="FILE",
        help="replay the stages of a TOML file, from the camera to the command; or of several "
        "files, one after another",
    )
    add_search(made)
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
    add("--convention", default="pysot", help="how frames count: see below (default: pysot)")
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
    add(
        "--out",
        metavar="DIR",
        help="write what a paper needs: figures as PDF and SVG, tables as LaTeX, CSV and Parquet",
    )
    add("--plot", metavar="FILE", help="draw success and precision, or a sweep (.png, .svg, .pdf)")
    add(
        "--waterfall",
        metavar="FILE",
        help="draw where the time goes in pipelines, from capture to answer (.png, .svg, .pdf)",
    )
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _replay(arguments), PROGRAM, arguments.max_decoded)


def _replay(arguments: argparse.Namespace) -> None:
    from lae_sim.api.evaluation import (
        EvaluationResult,
        plot_evaluations,
        plot_waterfalls,
        scenario_bar,
        scenarios,
    )
    from lae_sim.engine.scheduler import scores_latency
    from lae_sim.replay.world import SIGMA_GRID
    from lae_sim.trace.file import read_trace
    from lae_sim.trace.locate import find_traces

    if arguments.eta is not None:
        arguments.sigma = [-eta for eta in arguments.eta]
    for name in ("sigma", "forecaster", "fps", "latency_scale"):
        setattr(arguments, name, list(dict.fromkeys(getattr(arguments, name))))
    arguments.traces = find_traces(arguments.traces)
    swept = [name for name in ("fps", "latency_scale") if len(getattr(arguments, name)) > 1]
    swept += ["policy"] if len(arguments.pipeline) > 1 else []
    _check_files(arguments, swept)
    worlds = worlds_of(
        arguments,
        sigma={*arguments.sigma, *(SIGMA_GRID if arguments.sigma_grid else ())},
        convention=arguments.convention,
        forecasters=["hold", *arguments.forecaster],
        costs=arguments.cost,
    )
    if arguments.timeline and not scores_latency(worlds[0].rule()):
        raise LaeError(f"{arguments.policy} never scores latency: it goes with no --timeline")
    traces = {}
    for path, label in zip(arguments.traces, labels(arguments.traces)):
        traces[label] = read_trace(path, arguments.sequence)
        if arguments.attributes and not traces[label].metadata.names_attributes:
            raise LaeError(f"{path}: the trace names no attributes of its sequences")
    asked = scenarios(
        traces,
        worlds,
        sequences=arguments.sequence,
        root=arguments.root,
        dataset=arguments.dataset,
        camera_lag=arguments.camera_lag,
    )
    pictures = {arguments.plot, arguments.waterfall} - {None}
    if pictures:
        from lae_sim.figures.style import check_format

        for picture in pictures:
            check_format(picture)
    observed = list(product(arguments.forecaster, arguments.sigma))
    with ExitStack() as files, scenario_bar(asked) as advance:  # a failure leaves no file behind
        scored = tuple(
            scenario.evaluate(
                attributes=arguments.attributes or arguments.out is not None,
                sequences=arguments.per_sequence or arguments.out is not None,
                curves_at=arguments.sigma[0],
                observers=_observers(scenario, arguments, files),
                observed=observed if arguments.outputs or arguments.export_txt else (),
                progress=advance,
            )
            for scenario in asked
        )
        if pictures:
            from lae_sim.figures.style import save
        if arguments.plot:
            save(plot_evaluations(scored, arguments.sigma[0]), arguments.plot)
        if arguments.waterfall:
            save(plot_waterfalls(scored), arguments.waterfall)
    result = EvaluationResult(scored)
    if arguments.out is not None:
        result.write(arguments.out)
    document = result.document(arguments.attributes, arguments.per_sequence)
    if arguments.json:
        print_json(document)
    else:
        trace_labels = [scenario.label for scenario in asked]
        _print_tables(document["traces"], trace_labels, swept, arguments)


def _check_files(arguments: argparse.Namespace, swept: Sequence[str]) -> None:
    """Check that the files asked for can hold what is asked for, and replace nothing that is."""
    asked = [name for name in _FILES if getattr(arguments, name)]
    if asked and len(arguments.traces) > 1:
        raise LaeError(f"--{asked[0]} takes one trace at a time")
    asked += ["export-txt"] if arguments.export_txt else []
    if asked and swept:
        raise LaeError(
            f"--{asked[0]} takes one frame rate, scale of the times and pipeline at a time"
        )
    if arguments.strided and len(arguments.traces) > 1:
        raise LaeError("--strided goes with one trace at a time")
    if arguments.waterfall and not arguments.pipeline:
        raise LaeError("--waterfall is of the stages of a --pipeline")
    pictures = [arguments.plot, arguments.waterfall]
    outputs = [*(getattr(arguments, name) for name in _FILES), *pictures, arguments.out]
    check_outputs(arguments, outputs, arguments.traces)
    if arguments.out is not None:
        check_folder(arguments.out)


def _observers(
    scenario: Scenario, arguments: argparse.Namespace, files: ExitStack
) -> list[Observer]:
    """Open the files that were asked for; what each does with a run."""
    if not any(getattr(arguments, name.replace("-", "_")) for name in (*_FILES, "export-txt")):
        return []
    from pathlib import Path

    from lae_sim.report import export
    from lae_sim.report.timeline import timeline_file

    observers: list[Observer] = []
    if arguments.schedule:
        schedule = export.schedule_file(arguments.schedule, scenario.runs.clock)
        observers.append(files.enter_context(schedule))
    if arguments.events:
        events = export.events_file(arguments.events, arguments.sigma[0])
        observers.append(files.enter_context(events))
    if arguments.timeline:
        costs = {name: scenario.costs.get(name, 0) for name in arguments.forecaster}
        timeline = timeline_file(arguments.timeline, arguments.sigma[0], costs)
        observers.append(files.enter_context(timeline))
    if arguments.outputs:
        outputs = export.outputs_file(
            arguments.outputs, list(product(arguments.forecaster, arguments.sigma))
        )
        observers.append(files.enter_context(outputs))
    if arguments.export_txt:
        stem = Path(scenario.label).with_suffix("").as_posix().strip("/.").replace("/", "-")
        names = export.result_names(stem, arguments.forecaster, arguments.sigma)
        folders = export.result_folders(arguments.export_txt, names)
        observers.append(files.enter_context(folders))
    return observers


def _print_tables(
    reports: Sequence[Report],
    trace_labels: Sequence[str],
    swept: Sequence[str],
    arguments: argparse.Namespace,
) -> None:
    from lae_sim.report.replay import (
        attribute_table,
        closing_text,
        pipeline_text,
        sequence_table,
        settings_text,
        summary_table,
    )

    shown, width = sorted({float(sigma) for sigma in arguments.sigma}), screen_width()
    for each in reports:
        if arguments.per_sequence:
            print_text(f"{each['trace']}\n\n{sequence_table(each, shown, swept, width)}\n")
        if arguments.attributes:
            print_text(f"{each['trace']}\n\n{attribute_table(each, shown, swept, width)}\n")
    print_text(summary_table(reports, trace_labels, shown, swept, width), end="\n\n")
    for each in reports:
        print_text(settings_text(each))
        if "pipeline" in each:
            print_text(f"\n{pipeline_text(each, width)}\n")
    if closing := closing_text(reports, trace_labels, swept):
        print_text(closing)
