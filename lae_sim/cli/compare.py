"""``lae-sim compare``: which forecaster helps, by how much, and how sure that is."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.cli.options import (
    add_forecasting,
    add_passes,
    add_search,
    add_worlds,
    argument,
    check_folder,
    check_outputs,
    exit_status,
    new_parser,
    policies_of,
    print_json,
)
from lae_sim.engine.clock import parse_rational, whole
from lae_sim.learning.registry import COMPARED, FORECASTERS
from lae_sim.progress import print_text, screen_width

if TYPE_CHECKING:
    from pandas import DataFrame


PROGRAM = "lae-sim compare"

EXAMPLES = f"""\
examples:
  lae-sim compare traces/*.parquet
  lae-sim compare nano.parquet --latency constant:20ms constant:47ms --plot comparison.png
  lae-sim compare nano.parquet --latency constant:47ms,init=800ms by-call,init=1s
  lae-sim compare nano.parquet --latency-scale 1/2 1 2 4 --forecaster learned kalman --attributes
  lae-sim compare nano.parquet --forecaster kalman camera+kalman --root ~/data/DTB70 --out all.csv
  lae-sim compare a.parquet b.parquet --sigma-grid --out paper      figures and tables in a folder
  lae-sim compare nano.parquet --latency constant:47ms --search c=0.7 --pre-forecaster kalman
  lae-sim compare nano.parquet dcf.parquet --strided nano.gaps.parquet dcf.gaps.parquet
  lae-sim compare nano.parquet --forecaster kalman mine:Midway --cost mine:Midway=2ms --json

{FORECASTERS}\
  trained, tuned-kalman   trained here, on other sequences than those they are scored on (k-fold)
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
        default=[*COMPARED],
        metavar="NAME",
        help=f"see below (default: {' '.join(COMPARED)}); hold is always compared",
    )
    add("--sequence", nargs="+", metavar="NAME", help="these sequences only")
    add_passes(add)
    add_forecasting(made)
    add_worlds(made, [Fraction(1)])
    add_search(made)
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
    add("--convention", default="pysot", help="how frames count: as in replay (default: pysot)")
    add("--attributes", action="store_true", help="compare each attribute of the dataset too")
    add("--folds", type=argument(whole), default=5, help="of the training (default: 5)")
    add("--seed", type=argument(whole), default=0, help="of training and bootstrap (default: 0)")
    output = made.add_argument_group("output")
    add = output.add_argument
    add("--json", action="store_true", help="print one JSON object instead of tables")
    add(
        "--out",
        metavar="DIR",
        help="write what a paper needs: figures as PDF and SVG, tables as LaTeX, CSV and Parquet; "
        "or, to a .csv or .parquet file, every score of every sequence",
    )
    add("--plot", metavar="FILE", help="draw the comparison (.png, .svg, .pdf)")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _compare(arguments), PROGRAM, arguments.max_decoded)


def _compare(arguments: argparse.Namespace) -> None:
    from lae_sim import __version__
    from lae_sim.api.comparison import compare_forecasters
    from lae_sim.report.comparison import comparison_table
    from lae_sim.trace.locate import find_traces

    paths = find_traces(arguments.traces)
    _check_files(arguments, paths)
    result = compare_forecasters(
        paths,
        forecasters=arguments.forecaster,
        sigma="grid" if arguments.sigma_grid else arguments.sigma,
        latency=arguments.latency,
        scale=arguments.latency_scale,
        fps=arguments.fps,
        policy=arguments.policy,
        passes=arguments.strided,
        search=arguments.search,
        pre_forecaster=arguments.pre_forecaster,
        keep_size=arguments.keep_size,
        forget_arrivals=arguments.forget_arrivals,
        convention=arguments.convention,
        costs=arguments.cost,
        sequences=arguments.sequence,
        root=arguments.root,
        dataset=arguments.dataset,
        camera_lag=arguments.camera_lag,
        folds=arguments.folds,
        seed=arguments.seed,
    )
    if arguments.out and not _is_folder(arguments.out):
        from lae_sim.report.paper import write_frame_file

        write_frame_file(result.scores, Path(arguments.out))
    tables = {"summary": result.summary}
    if arguments.attributes:
        tables["attributes"] = result.attributes
    if arguments.plot:
        from lae_sim.figures.style import save

        save(result.plot(), arguments.plot)
    if arguments.sigma_grid:
        tables = {name: table.assign(sigma="0, 0.02, ..., 1") for name, table in tables.items()}
    if arguments.json or (arguments.out and _is_folder(arguments.out)):
        document: dict[str, Any] = {
            "format": "lae-compare",
            "version": "1.0",
            "lae_sim": __version__,
            "traces": paths,
            "convention": arguments.convention,
            "policy": policies_of(arguments, result.traces.values()),
            "seed": arguments.seed,
            "method": result.summary.attrs["method"],
            "ranked_by": result.ranking.by,
            "search": result.search,
            "init": result.init,
            "notes": result.notes,
            **{name: _records(table) for name, table in tables.items()},
        }
        document["summary"] = [_with_modelled(row) for row in document["summary"]]
    if arguments.out and _is_folder(arguments.out):
        result.write(arguments.out, {"compare.json": document})
    if arguments.json:
        print_json(document)
        return
    for table in reversed(tables.values()):
        print_text(comparison_table(table, screen_width()), end="\n\n")
    policy = policies_of(arguments, result.traces.values())
    about = f"convention {arguments.convention}, policy {policy}"
    print_text("\n".join([about, *result.notes]))


def _check_files(arguments: argparse.Namespace, traces: Sequence[str]) -> None:
    """Refuse what would only fail after the work."""
    check_outputs(arguments, [arguments.out, arguments.plot], traces)
    if arguments.out and _is_folder(arguments.out):
        check_folder(arguments.out, ", or a .csv or .parquet file")
    if arguments.plot:
        from lae_sim.figures.style import check_format

        check_format(arguments.plot)


def _is_folder(out: str) -> bool:
    """Whether ``--out`` names a folder, and not a file of scores."""
    return Path(out).suffix not in (".csv", ".parquet")


def _records(table: DataFrame) -> list[dict[str, Any]]:
    """The rows as JSON objects, NaN as null."""
    rows: list[dict[str, Any]] = table.to_dict("records")
    return [{k: None if v != v else v for k, v in row.items()} for row in rows]


def _with_modelled(row: dict[str, Any]) -> dict[str, Any]:
    """A row of the summary, with what is modelled in an object of its own."""
    modelled = {
        key.removeprefix("modelled_"): row.pop(key)
        for key in [*row]
        if key.startswith("modelled_") or key in ("c_known", "lost_share")
    }
    return {**row, "modelled": modelled if modelled.get("c_known") is not None else None}
