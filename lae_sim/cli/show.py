"""``lae-sim show``: what a trace says of itself, how its times are distributed, a reach."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from lae_sim.cli.options import check_outputs, exit_status, new_parser, print_json
from lae_sim.progress import print_text

_EXAMPLES = """\
examples:
  lae-sim show trace.parquet
  lae-sim show laptop.parquet jetson.parquet --plot times.png
  lae-sim show trace.gaps.parquet --plot reach.png     how far the tracker finds a target again
  lae-sim show trace.parquet --json | jq '.traces[].times.calls.p99_ms'
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        "lae-sim show",
        "Say what a trace holds, and how its processing times are distributed; of a gap pass\n"
        "(lae-sim profile --gaps), what the tracker's reach is.",
        _EXAMPLES,
    )
    add = made.add_argument
    add("traces", nargs="+", metavar="TRACE", help="traces (see traces/FORMAT.md), folders, URLs")
    add("--json", action="store_true", help="print one JSON object instead of text")
    add(
        "--plot",
        metavar="FILE",
        help="draw the times, or of gap passes the reach (.png, .svg, .pdf)",
    )
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _show(arguments), "lae-sim show", arguments.max_decoded)


def _show(arguments: argparse.Namespace) -> None:
    from lae_sim import __version__
    from lae_sim.errors import LaeError
    from lae_sim.report.reach import ReachReport, reach_figure
    from lae_sim.report.trace import overview, plot_times
    from lae_sim.trace.describe import describe
    from lae_sim.trace.file import read_trace
    from lae_sim.trace.locate import find_traces

    paths = find_traces(arguments.traces)
    if arguments.plot:
        from lae_sim.figures.style import check_format

        check_outputs(arguments, [arguments.plot], paths)
        check_format(arguments.plot)
    traces = [read_trace(path) for path in paths]
    are_gaps = [trace.metadata.kind == "restarts" for trace in traces]
    if arguments.plot and len(set(are_gaps)) > 1:
        raise LaeError("a picture shows times or reaches: draw gap passes and others one by one")
    described = [describe(trace, path) for trace, path in zip(traces, paths)]
    reports = [report for report, _ in described]
    reaches = [ReachReport.of(trace) if gaps else None for trace, gaps in zip(traces, are_gaps)]
    if arguments.plot and all(are_gaps):
        from lae_sim.figures.style import save

        save(reach_figure([reach for reach in reaches if reach is not None]), arguments.plot)
    elif arguments.plot:
        plot_times(described, arguments.plot)
    if arguments.json:
        document = {"format": "lae-show", "version": "1.0", "lae_sim": __version__}
        shown = [
            report if reach is None else {**report, "reach": reach.document()}
            for report, reach in zip(reports, reaches)
        ]
        print_json({**document, "traces": shown})
    else:
        texts = [
            overview(report) + ("" if reach is None else "\n\n" + reach.text())
            for report, reach in zip(reports, reaches)
        ]
        print_text("\n\n".join(texts))
