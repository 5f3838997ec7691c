"""``lae-sim fidelity``: how far replays of a tracker are from its closed loop."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from lae_sim.cli.options import exit_status, new_parser

PROGRAM = "lae-sim fidelity"

SUMMARY_COLUMNS = {
    "closed_loop": "closed loop",
    "forecaster": "forecaster",
    "replay": "replay",
    "sequences": "sequences",
    "closed_auc": "closed AUC",
    "auc": "AUC",
    "mean_abs_d_auc": "mean |d|",
    "median_abs_d_auc": "median",
    "max_abs_d_auc": "max",
    "closed_dp20": "closed DP",
    "dp20": "DP",
    "mean_abs_d_dp20": "mean |d|",
}
SEQUENCE_COLUMNS = {
    "closed_loop": "closed loop",
    "forecaster": "forecaster",
    "replay": "replay",
    "sequence": "sequence",
    "closed_auc": "closed AUC",
    "auc": "AUC",
    "d_auc": "d",
    "closed_dp20": "closed DP",
    "dp20": "DP",
    "d_dp20": "d",
    "parted": "parted at",
    "disagreement": "disagree",
}

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
    add("--strided", **several, help="passes on every N-th frame")
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
    summary = [asdict(each) for each in summarise_closed_loops(rows)]
    sequences = [asdict(row) for row in rows]
    if arguments.json:
        head = {"format": "lae-fidelity", "version": "1.0", "lae_sim": __version__}
        settings = {"trace": arguments.trace, "strided": arguments.strided}
        settings["convention"] = arguments.convention
        document = {**head, **settings, "summary": summary, "sequences": sequences}
        print(json.dumps(document, indent=2))
        return
    if arguments.per_sequence:
        print(_table(sequences, SEQUENCE_COLUMNS, left=4), end="\n\n")
    print(_table(summary, SUMMARY_COLUMNS, left=3), end="\n\n")
    print(
        f"AUC by convention {arguments.convention}; |d| is |replay - closed loop| of a sequence.\n"
        "every-frame: boxes of TRACE; strided: of the pass nearest to the frames skipped."
    )


def _table(rows: Sequence[Mapping[str, object]], columns: Mapping[str, str], left: int) -> str:
    """Rows as aligned text."""
    from lae_sim.report.table import table

    lines = [[_text(row[key], key.startswith("d_")) for key in columns] for row in rows]
    return table(list(columns.values()), lines, left=left)


def _text(value: object, signed: bool) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:+.3f}" if signed else f"{value:.3f}"
    return str(value)
