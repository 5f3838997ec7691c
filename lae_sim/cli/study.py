"""``lae-sim study``: a folder of traces becomes the figures of a paper."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from lae_sim.cli.options import argument, exit_status, new_parser, print_json
from lae_sim.engine.clock import whole
from lae_sim.errors import LaeError, install
from lae_sim.progress import print_text, screen_width, tell

if TYPE_CHECKING:
    from lae_sim.study.records import Failure

PROGRAM = "lae-sim study"

EXAMPLES = f"""\
examples:
  lae-sim study study.toml                                everything, on all cores of this machine
  lae-sim study study.toml --out figures --workers 2
  lae-sim study study.toml --root ~/data/DTB70            frames in the report
  lae-sim study study.toml --scheduler tcp://head:8786    on a Dask cluster
  lae-sim study study.toml --json | jq '.summary[] | [.trace, .forecaster, .auc]'

a study file (TOML); only traces is required, and all worlds, latencies, scales, forecasters and
conventions are crossed:
  traces = ["traces/*.parquet"]   files, folders, globs, URLs (s3://... needs
                                  {install("remote")} s3fs)
  timing = ["jetson.parquet"]     other devices' times, for traces of their tracker and dataset
  forecasters = ["hold", "kalman"]       as in compare
  policies = ["latest"]                  as in replay
  [pipelines]                            besides these, each a table or a file, as --pipeline in
  drone = "drone.toml"                   replay; at the end of the file
  fps = ["trace", 60]                    world frame rates; "trace" is each trace's own
  forget_arrivals = false                whether frames arrive evenly also where a trace says when
                                         each of them did
  latencies = ["recorded", "bootstrap"]  also by-call, constant:47ms; bootstrap (in blocks),
                                         resample and lognormal are drawn anew in each repetition
  passes = ["nano.gaps.parquet"]         strided and gap passes, for traces of their tracker and
                                         dataset: as --strided in replay
  search = ["c=0.7"]                     the trackers' reach, for the search model, as in replay:
                                         "trace" (what the traces know) if left out, or "off"
  pre_forecaster = ["none", "kalman"]    what says where the trackers search, in the search model;
  keep_size = false                      whether it says the centre only
  init = ["300ms", "1s"]                 each with every latency: what the initialisation takes
  scales = [0.5, 1, 2]                   exact factors on all times; 2 is a device half as fast
  sigma = "grid"                         0, 0.02, ..., 1 (mAUC and mDP), or a list such as [0, 0.5]
  repetitions = 100                      of random latencies; seed = 0; block = 30 calls
  conventions = ["pysot"]                how frames and thresholds count
  costs = ["kalman=2ms"]                 what forecasting costs
  sequences = ["car1"]                   these only
  attributes = true                      in the report
  folds = 5                              of the training of forecasters that must be trained
  require_auc = 0.5                      how slow each tracker may be to have it; or a list of AUCs
modules of your own, as in forecasters = ["mine:Damped:a=0.3"], are first looked for beside the file
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(PROGRAM, "Replay and score traces in every way that a study names.", EXAMPLES)
    add = made.add_argument
    add("study", metavar="STUDY.toml", help="what to compute")
    add(
        "--out",
        metavar="FOLDER",
        help="where results go, and are looked for (default: STUDY-results)",
    )
    add("--workers", type=argument(lambda text: whole(text, 1)), help="processes (default: cores)")
    add("--scheduler", metavar="ADDRESS", help="a Dask cluster to compute on, tcp://host:8786")
    add("--no-report", action="store_true", help="write no report, figures and tables")
    add(
        "--root",
        metavar="PATH",
        help="folder of the dataset, for the report to show a few sequences with their frames",
    )
    add("--json", action="store_true", help="print what study.json holds instead of tables")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 1 if a part could not be computed, 2 for bad input."""
    arguments = parser().parse_args(argv)
    failed: list[Failure] = []
    status = exit_status(
        lambda: _study(arguments, failed), PROGRAM, arguments.max_decoded, prints_result=False
    )
    if status > 128:
        tell("what is finished is kept: the same command goes on from there")
    return status or int(bool(failed))


def _study(arguments: argparse.Namespace, failed: list[Failure]) -> None:
    """Run the study, and add the parts of it that failed."""
    from lae_sim.api.study import run_study

    if arguments.workers is not None and arguments.scheduler is not None:
        raise LaeError("--scheduler says where to compute: --workers is for this machine")
    results = run_study(
        arguments.study,
        arguments.out,
        workers=arguments.workers,
        scheduler=arguments.scheduler,
        report=not arguments.no_report,
        root=arguments.root,
    )
    failed += results.failures
    if arguments.json:
        print_json(results.document())
    else:
        from lae_sim.report.study_tables import study_text

        print_text(study_text(results, screen_width()), end="\n\n")
        left = sorted(path.name for path in results.folder.glob("[!.]*"))
        print_text(f"{results.folder}: {', '.join(left)}")
