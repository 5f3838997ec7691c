"""``lae-sim fidelity``: how far replays of a tracker are from its closed loop."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from lae_sim.cli.options import add_search, check_outputs, exit_status, new_parser, print_json
from lae_sim.progress import print_text, screen_width

PROGRAM = "lae-sim fidelity"

DESCRIPTION = """\
Compare replays of traces of every frame with closed loops, in which the tracker really skipped
frames: same tracker, frames and times. Says how far the scores are apart, whether the intervals of
the search model hold, and which sequences a replay can be trusted on.
"""

EXAMPLES = """\
examples:
  lae-sim profile --stride 3/2 2 3 --closed-loop constant:47ms constant:100ms --out t.parquet
  lae-sim fidelity t.parquet --strided t.stride3-2.parquet t.stride2.parquet t.stride3.parquet \\
      --closed-loop t.closed-loop-47ms.parquet t.closed-loop-100ms.parquet --per-sequence
  lae-sim fidelity dtb70.parquet uavdt.parquet --strided *.stride*.parquet *.gaps.parquet \\
      --closed-loop *.closed-loop-*.parquet --plot fidelity.png    each closed loop goes with the
                                                                   trace of its tracker and dataset

closed loops of one trace whose times, policy and pre-forecaster are alike (mean times of a call
within 5 %, of an initialisation within 10 %) are repetitions, whose own spread is reported.
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(PROGRAM, DESCRIPTION, EXAMPLES)
    add = made.add_argument
    add("traces", nargs="+", metavar="TRACE", help="traces of every frame")
    several: Any = {"nargs": "+", "action": "extend", "default": [], "metavar": "TRACE"}
    add("--closed-loop", **several, required=True, help="real-time traces")
    add("--strided", **several, help="passes on every N-th frame, and gap passes")
    add("--forecaster", nargs="+", default=["hold"], metavar="NAME", help="default: hold")
    add("--convention", default="pysot", help="how frames count: as in replay (default: pysot)")
    add_search(made, pre_forecaster=False)
    add("--per-sequence", action="store_true", help="report each sequence")
    add("--json", action="store_true", help="print one JSON object instead of tables")
    add("--plot", metavar="FILE", help="draw replays over closed loops (.png, .svg, .pdf)")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _fidelity(arguments), PROGRAM, arguments.max_decoded)


def _fidelity(arguments: argparse.Namespace) -> None:

    from lae_sim import __version__
    from lae_sim.comparison.fidelity import (
        closed_loop_spreads,
        compare_closed_loops,
        summarise_closed_loops,
        summarise_replays,
    )
    from lae_sim.report.comparison import fidelity_table, fidelity_verdicts, spread_table

    if arguments.plot:
        from lae_sim.figures.style import check_format

        check_format(arguments.plot)
        check_outputs(arguments, [arguments.plot], arguments.traces)
    rows = compare_closed_loops(
        arguments.traces,
        arguments.closed_loop,
        passes=arguments.strided,
        forecasters=arguments.forecaster,
        convention=arguments.convention,
        search=arguments.search,
    )
    summary, spreads = summarise_closed_loops(rows), closed_loop_spreads(rows)
    overall, verdicts = summarise_replays(rows), fidelity_verdicts(rows, spreads)
    if arguments.plot:
        from lae_sim.figures.replay import fidelity_figure
        from lae_sim.figures.style import save

        save(fidelity_figure(rows, "Replays against closed loops"), arguments.plot)
    if arguments.json:
        first, *_ = arguments.traces
        head = {"format": "lae-fidelity", "version": "1.0", "lae_sim": __version__}
        settings = {"trace": first, "strided": arguments.strided}
        settings |= {"convention": arguments.convention, "search": arguments.search}
        records: dict[str, Sequence[Any]] = {
            "summary": summary,
            "sequences": rows,
            "overall": overall,
            "repeats": spreads,
        }
        parts = {name: [_plain(each) for each in of] for name, of in records.items()}
        document = {**head, **settings, "traces": arguments.traces, **parts, "verdicts": verdicts}
        print_json(document)
        return
    width = screen_width()
    if arguments.per_sequence:
        print_text(fidelity_table(rows, width), end="\n\n")
    print_text(fidelity_table(summary, width), end="\n\n")
    if len({each.closed_loop for each in summary}) > 1:
        print_text(fidelity_table(overall, width), end="\n\n")
    if spreads:
        print_text(spread_table(spreads, width), end="\n\n")
    print_text(
        f"AUC by convention {arguments.convention}; |d| is |replay - closed loop| of a sequence.\n"
        "every-frame: boxes of TRACE; strided: of the pass nearest to the frames skipped;\n"
        "modelled: what a tracker would have answered that finds its target only near its last "
        "answer."
    )
    print_text("\n".join(verdicts))


def _plain(record: Any) -> dict[str, Any]:
    """A record as JSON has it: a score that is not known is null."""
    return {key: None if value != value else value for key, value in asdict(record).items()}
