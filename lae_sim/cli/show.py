"""``lae-sim show``: what a trace says of itself, and how its processing times are distributed."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from lae_sim.cli.options import exit_status, new_parser

_EXAMPLES = """\
examples:
  lae-sim show trace.parquet
  lae-sim show laptop.parquet jetson.parquet --plot times.png
  lae-sim show trace.parquet --json | jq '.traces[].times.calls.p99_ms'
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lae-sim show``; see ``--help``."""
    parser = new_parser(
        "lae-sim show",
        "Say what a trace holds, and how its processing times are distributed.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add("traces", nargs="+", metavar="TRACE", help="traces (see traces/FORMAT.md), folders, URLs")
    add("--json", action="store_true", help="print one JSON object instead of text")
    add("--plot", metavar="FILE", help="draw the times (.png, .svg, .pdf)")
    arguments = parser.parse_args(argv)
    return exit_status(lambda: _show(arguments), "lae-sim show")


def _show(arguments: argparse.Namespace) -> None:
    from lae_sim import __version__
    from lae_sim.files import check_distinct
    from lae_sim.report.trace import overview, plot_times
    from lae_sim.trace.describe import describe
    from lae_sim.trace.file import read_trace
    from lae_sim.trace.locate import find_traces

    paths = find_traces(arguments.traces)
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="replace")  # a name may have what the terminal has not
    if arguments.plot:
        from lae_sim.report.style import check_format

        check_distinct([arguments.plot], paths)
        check_format(arguments.plot)
    described = [describe(read_trace(path), path) for path in paths]
    reports = [report for report, _ in described]
    if arguments.json:
        document = {"format": "lae-show", "version": "1.0", "lae_sim": __version__}
        print(json.dumps({**document, "traces": reports}, indent=2, allow_nan=False))
    else:
        print("\n\n".join(map(overview, reports)))
    if arguments.plot:
        plot_times(described, arguments.plot)
