"""``lae-sim fidelity``: how far replays of a tracker are from its closed loop."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from lae_sim.cli.options import exit_status, new_parser

PROGRAM = "lae-sim fidelity"

DESCRIPTION = """\
Compare replays of a trace of every frame with closed loops, in which the tracker really skipped
frames: same tracker, frames and times. Says how far the scores are apart, and which sequences a
replay can be trusted on.
"""

EXAMPLES = """\
examples:
  lae-sim profile --stride 3/2 2 3 --closed-loop constant:47ms constant:100ms --out t.parquet
  lae-sim fidelity t.parquet --strided t.stride3-2.parquet t.stride2.parquet t.stride3.parquet \\
      --closed-loop t.closed-loop-47ms.parquet t.closed-loop-100ms.parquet --per-sequence
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(PROGRAM, DESCRIPTION, EXAMPLES)
    add = made.add_argument
    add("trace", metavar="TRACE", help="a trace of every frame")
    several: Any = {"nargs": "+", "action": "extend", "default": [], "metavar": "TRACE"}
    add("--closed-loop", **several, required=True, help="real-time traces")
    add("--strided", **several, help="passes on every N-th frame, and gap passes")
    add("--forecaster", nargs="+", default=["hold"], metavar="NAME", help="default: hold")
    add("--convention", default="pysot", help="how frames and thresholds count (default: pysot)")
    add("--per-sequence", action="store_true", help="report each sequence")
    add("--json", action="store_true", help="print one JSON object instead of tables")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _fidelity(arguments), PROGRAM)


def _fidelity(arguments: argparse.Namespace) -> None:
    import json

    from lae_sim import __version__
    from lae_sim.comparison.fidelity import compare_closed_loops, summarise_closed_loops

    rows = compare_closed_loops(
        arguments.trace,
        arguments.closed_loop,
        passes=arguments.strided,
        forecasters=arguments.forecaster,
        convention=arguments.convention,
    )
    summary = summarise_closed_loops(rows)
    if arguments.json:
        head = {"format": "lae-fidelity", "version": "1.0", "lae_sim": __version__}
        settings = {"trace": arguments.trace, "strided": arguments.strided}
        settings["convention"] = arguments.convention
        parts = {"summary": list(map(asdict, summary)), "sequences": list(map(asdict, rows))}
        print(json.dumps({**head, **settings, **parts}, indent=2))
        return
    from lae_sim.report.comparison import fidelity_table

    if arguments.per_sequence:
        print(fidelity_table(rows), end="\n\n")
    print(fidelity_table(summary), end="\n\n")
    print(
        f"AUC by convention {arguments.convention}; |d| is |replay - closed loop| of a sequence.\n"
        "every-frame: boxes of TRACE; strided: of the pass nearest to the frames skipped."
    )
