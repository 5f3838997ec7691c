"""``lae-sim compare``: which forecaster helps, by how much, and how sure that is."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.cli.options import (
    add_forecasting,
    add_worlds,
    argument,
    exit_status,
    new_parser,
    worlds_of,
)
from lae_sim.engine.clock import parse_rational, whole
from lae_sim.errors import LaeError
from lae_sim.files import check_distinct, check_folders, labels
from lae_sim.learning.registry import FORECASTERS, find_camera, load_any

if TYPE_CHECKING:
    from pandas import DataFrame

    from lae_sim.forecast.base import AnyFactory
    from lae_sim.learning.folds import Trainer
    from lae_sim.trace.file import Trace

PROGRAM = "lae-sim compare"

EXAMPLES = f"""\
examples:
  lae-sim compare traces/*.parquet
  lae-sim compare nano.parquet --latency constant:20ms constant:47ms --plot comparison.png
  lae-sim compare nano.parquet --latency-scale 1/2 1 2 4 --forecaster kalman learned --attributes
  lae-sim compare nano.parquet --forecaster kalman camera+kalman --root ~/data/DTB70 --out all.csv
  lae-sim compare nano.parquet --forecaster kalman mine:Midway --cost mine:Midway=2ms --json

{FORECASTERS}\
  learned, tuned-kalman   trained here, on other sequences than those they are scored on (k-fold)
  package.module:trainer  your own, with fit(examples, seed) -> factory: the same
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        PROGRAM, "Compare forecasters on traces: intervals, paired tests, loss recovered.", EXAMPLES
    )
    add = made.add_argument
    add("traces", nargs="+", metavar="TRACE", help="traces (see traces/FORMAT.md), folders, URLs")
    add(
        "--forecaster",
        nargs="+",
        default=["kalman", "least-squares", "tuned-kalman"],
        metavar="NAME",
        help="see below (default: kalman least-squares tuned-kalman); hold is always compared",
    )
    add("--sequence", nargs="+", metavar="NAME", help="these sequences only")
    add_forecasting(made)
    add_worlds(made, [Fraction(1)])
    scores = made.add_argument_group("scores")
    add = scores.add_argument
    sigma = scores.add_mutually_exclusive_group()
    sigma.add_argument(
        "--sigma",
        nargs="+",
        type=argument(parse_rational),
        default=[Fraction(0)],
        metavar="FRAMES",
        help="permitted latencies (default: 0)",
    )
    sigma.add_argument("--sigma-grid", action="store_true", help="sigma = 0, 0.02, ..., 1")
    add("--convention", default="pysot", help="how frames and thresholds count (default: pysot)")
    add("--attributes", action="store_true", help="compare each attribute of the dataset too")
    add("--folds", type=argument(whole), default=5, help="of the training (default: 5)")
    add("--seed", type=argument(whole), default=0, help="of training and bootstrap (default: 0)")
    output = made.add_argument_group("output")
    add = output.add_argument
    add("--json", action="store_true", help="print one JSON object instead of tables")
    add("--out", metavar="FILE", help="write every score of every sequence (.csv or .parquet)")
    add("--plot", metavar="FILE", help="draw the comparison (.png, .svg, .pdf)")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _compare(arguments), PROGRAM)


def _compare(arguments: argparse.Namespace) -> None:
    from lae_sim.trace.file import read_trace
    from lae_sim.trace.locate import find_traces

    arguments.traces = paths = find_traces(arguments.traces)
    _check(arguments)
    traces = {
        label: read_trace(path, arguments.sequence) for path, label in zip(paths, labels(paths))
    }
    forecasters = _forecasters(arguments, traces)
    table = _table(arguments, traces, forecasters)
    if arguments.out:
        _write(table, arguments.out)
    attributes = None
    if arguments.attributes:
        attributes = {
            (trace.metadata.dataset, name): trace.metadata.attributes(name)
            for trace in traces.values()
            for name in table.loc[table["dataset"] == trace.metadata.dataset, "sequence"].unique()
        }
    _tell(arguments, table, attributes)


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what would only fail after the work."""
    outputs = [path for path in (arguments.out, arguments.plot) if path]
    check_distinct(outputs, arguments.traces)
    check_folders(outputs)
    if arguments.out and Path(arguments.out).suffix not in (".csv", ".parquet"):
        raise LaeError(f"--out {arguments.out}: name a .csv or .parquet file")
    if arguments.plot:
        from lae_sim.report.style import check_format

        check_format(arguments.plot)
    from lae_sim.engine.scheduler import scores_latency
    from lae_sim.replay.world import parse_policy

    if not scores_latency(parse_policy(arguments.policy)):
        raise LaeError("vot-realtime never scores latency: there is nothing to forecast")
    if "offline" in arguments.forecaster:
        raise LaeError("offline is always in the table: the tracker's own boxes, without latency")


def _forecasters(
    arguments: argparse.Namespace, traces: Mapping[str, Trace]
) -> dict[str, AnyFactory | Trainer]:
    fps = arguments.fps or next(iter(traces.values())).metadata.fps
    camera = find_camera(
        arguments.root, arguments.dataset, arguments.sequence, fps, arguments.camera_lag
    )
    worlds = {(trace.metadata.dataset, trace.metadata.fps) for trace in traces.values()}
    if camera and len(worlds) > 1:
        raise LaeError("--root is the folder of one dataset: compare its traces by themselves")
    names = dict.fromkeys(["hold", *arguments.forecaster])
    return {name: load_any(name, camera) for name in names}


def _table(
    arguments: argparse.Namespace,
    traces: Mapping[str, Trace],
    forecasters: Mapping[str, AnyFactory | Trainer],
) -> DataFrame:
    """Compare, with a progress bar if the standard error stream is a terminal."""
    from tqdm import tqdm

    from lae_sim.comparison.forecasters import score_forecasters, steps

    worlds = worlds_of(
        arguments,
        sigma="grid" if arguments.sigma_grid else arguments.sigma,
        convention=arguments.convention,
        costs=arguments.cost,
    )
    total = steps(traces, forecasters, worlds, arguments.folds)
    with tqdm(total=total, unit=" steps", disable=None) as bar:

        def progress(what: str) -> None:
            bar.set_description(what, refresh=False)
            bar.update()

        return score_forecasters(
            traces, forecasters, worlds, arguments.folds, arguments.seed, progress
        )


def _write(table: DataFrame, path: str) -> None:
    """Write the table, whole or not at all."""
    from lae_sim.files import written_whole

    with written_whole(path) as temporary:
        if path.endswith(".csv"):
            table.to_csv(temporary, index=False)
        else:
            table.to_parquet(temporary, index=False)


def _tell(
    arguments: argparse.Namespace,
    table: DataFrame,
    attributes: Mapping[tuple[str, str], Sequence[str]] | None,
) -> None:
    import json

    from lae_sim import __version__
    from lae_sim.comparison.statistics import by_attribute, over_sigmas, summarise
    from lae_sim.report.comparison import comparison_table

    metrics, notes = ("auc", "dp20"), table.attrs["notes"]
    if arguments.sigma_grid:
        table, metrics = over_sigmas(table), ("mauc", "mdp20")
    settings: dict[str, Any] = {"metrics": metrics, "seed": arguments.seed}
    summary = summarise(table, **settings)
    divided = None if attributes is None else by_attribute(table, attributes, **settings)
    if arguments.plot:
        from lae_sim.report.forecaster_figures import overview
        from lae_sim.report.style import save

        save(overview(summary, metrics[0]), arguments.plot)
    if arguments.sigma_grid:
        for each in (summary, divided):
            if each is not None:
                each["sigma"] = "0, 0.02, ..., 1"
    if arguments.json:
        document: dict[str, Any] = {
            "format": "lae-compare",
            "version": "1.0",
            "lae_sim": __version__,
            "traces": arguments.traces,
            "convention": arguments.convention,
            "policy": arguments.policy,
            "seed": arguments.seed,
            "method": summary.attrs["method"],
            "notes": notes,
            "summary": _records(summary),
        }
        if divided is not None:
            document["attributes"] = _records(divided)
        print(json.dumps(document, indent=2, allow_nan=False))
        return
    if divided is not None:
        print(comparison_table(divided), end="\n\n")
    print(comparison_table(summary), end="\n\n")
    print("\n".join([f"convention {arguments.convention}, policy {arguments.policy}", *notes]))


def _records(summary: DataFrame) -> list[dict[str, Any]]:
    """The rows as JSON objects, NaN as null."""
    rows: list[dict[str, Any]] = summary.to_dict("records")
    return [{k: None if v != v else v for k, v in row.items()} for row in rows]
