"""``python -m lae_sim.fidelity``: how far replays of a tracker are from its closed loop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

from lae_sim.cli import exit_status, new_parser
from lae_sim.errors import LaeError
from lae_sim.options import parse_policy
from lae_sim.zoo import load_forecaster

if TYPE_CHECKING:
    from lae_sim.evaluation import Evaluation
    from lae_sim.run import Run
    from lae_sim.trace import Trace

PROGRAM = "lae-sim fidelity"
Row = dict[str, Any]

GROUP = ("closed_loop", "forecaster", "replay")
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

    closed_loops = dict.fromkeys(arguments.closed_loop)
    rows = [row for path in closed_loops for row in _compared(path, arguments)]
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in GROUP), []).append(row)
    summary = [dict(zip(GROUP, key)) | _summary(group) for key, group in groups.items()]
    if arguments.json:
        head = {"format": "lae-fidelity", "version": "1.0", "lae_sim": __version__}
        settings = {"trace": arguments.trace, "strided": arguments.strided}
        settings["convention"] = arguments.convention
        print(json.dumps({**head, **settings, "summary": summary, "sequences": rows}, indent=2))
        return
    if arguments.per_sequence:
        print(_table(rows, SEQUENCE_COLUMNS, left=4), end="\n\n")
    print(_table(summary, SUMMARY_COLUMNS, left=3), end="\n\n")
    print(
        f"AUC by convention {arguments.convention}; |d| is |replay - closed loop| of a sequence.\n"
        "every-frame: boxes of TRACE; strided: of the pass nearest to the frames skipped."
    )


def _compared(path: str, arguments: argparse.Namespace) -> Iterator[Row]:
    """One closed loop against replays at its times: a row per forecaster, replay and sequence."""
    import numpy as np

    from lae_sim.evaluation import evaluate
    from lae_sim.metrics import find_convention
    from lae_sim.run import replay_trace
    from lae_sim.trace import read_trace

    closed = read_trace(path)
    if closed.metadata.kind != "real-time":
        raise LaeError(
            f"{path}: a trace of every frame is no closed loop: give one that "
            "'lae-sim profile --closed-loop' or '--mode real-time' left"
        )
    names = [recording.name for recording in closed]
    every, *strided = (read_trace(other, names) for other in [arguments.trace, *arguments.strided])
    for trace in (every, *strided):
        _check_same_tracker(closed, trace)
        if trace.metadata.kind != "every-frame":
            raise LaeError("TRACE and --strided take traces of every frame, not real-time ones")
    schedule = closed.metadata.document["schedule"]
    policy, at_arrival = parse_policy(schedule.get("policy", "latest"))
    forecasters = {name: load_forecaster(name) for name in arguments.forecaster}
    convention = find_convention(arguments.convention)

    def scored(runs: list[Run]) -> Evaluation:
        return evaluate(runs, closed.metadata, forecasters, (Fraction(0),), convention, at_arrival)

    replay = partial(replay_trace, every, closed.metadata.fps, policy=policy, timing=closed)
    truth = list(replay_trace(closed, policy=policy))
    replays = {"every-frame": list(replay())}
    if strided:
        replays["strided"] = list(replay(strided=strided))
    reference = scored(truth)
    for kind, runs in replays.items():
        found = scored(runs)
        for f, forecaster in enumerate(forecasters):
            for i, (run, closed_run) in enumerate(zip(runs, truth)):
                auc, dp = (found.scores[m][f, i, 0] for m in ("auc", "dp20"))
                closed_auc, closed_dp = (reference.scores[m][f, i, 0] for m in ("auc", "dp20"))
                yield {
                    "closed_loop": path,
                    "forecaster": forecaster,
                    "replay": kind,
                    "sequence": run.recording.name,
                    "closed_auc": float(closed_auc),
                    "auc": float(auc),
                    "d_auc": float(auc - closed_auc),
                    "closed_dp20": float(closed_dp),
                    "dp20": float(dp),
                    "d_dp20": float(dp - closed_dp),
                    "parted": _parted(run, closed_run),
                    "approximate_outputs": run.departures,
                    "disagreement": None if np.isnan(run.disagreement) else run.disagreement,
                }


def _check_same_tracker(closed: Trace, other: Trace) -> None:
    """Check that two traces are of one tracker, searching in one way.

    Raises:
        LaeError: if they are not.
    """
    documents = closed.metadata.document, other.metadata.document
    for section, key in (
        ("tracker", "name"),
        ("tracker", "settings"),
        ("tracker", "weights_digest"),
        ("schedule", "pre_forecaster"),
        ("schedule", "search"),
    ):
        here, there = (document.get(section, {}).get(key) for document in documents)
        if here != there:
            raise LaeError(
                f"the closed loop's {section}.{key} is {here!r:.60}, and the other trace's "
                f"{there!r:.60}: they must be of the same tracker"
            )


def _parted(replay: Run, closed: Run) -> int | None:
    """The first processed frame whose boxes in replay and closed loop overlap less than half."""
    import numpy as np

    from lae_sim.boxes import PARTED_IOU, iou

    apart = np.flatnonzero(iou(replay.boxes, closed.boxes) < PARTED_IOU)
    return int(closed.schedule.frames[apart[0]]) if len(apart) else None


def _summary(rows: Sequence[Row]) -> Row:
    """Means over the sequences that count."""
    import numpy as np

    found: Row = {"sequences": len(rows)}
    for metric in ("auc", "dp20"):
        for key in (f"closed_{metric}", metric):
            found[key] = float(np.nanmean([row[key] for row in rows]))
        apart = np.abs([row[f"d_{metric}"] for row in rows])
        for name in ("mean", "median", "max"):
            found[f"{name}_abs_d_{metric}"] = float(getattr(np, f"nan{name}")(apart))
    return found


def _table(rows: Sequence[Row], columns: Mapping[str, str], left: int) -> str:
    """Rows as aligned text."""
    from lae_sim.report import table

    lines = [[_text(row[key], key.startswith("d_")) for key in columns] for row in rows]
    return table(list(columns.values()), lines, left=left)


def _text(value: object, signed: bool) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:+.3f}" if signed else f"{value:.3f}"
    return str(value)


if __name__ == "__main__":
    sys.exit(main())
