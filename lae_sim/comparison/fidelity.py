"""How far replays are from closed loops."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

from lae_sim.errors import LaeError
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.world import parse_policy

if TYPE_CHECKING:
    from lae_sim.evaluation.evaluate import Evaluation
    from lae_sim.replay.run import Run
    from lae_sim.trace.file import Trace


Row = dict[str, Any]


GROUP = ("closed_loop", "forecaster", "replay")


def compared(path: str, arguments: argparse.Namespace) -> Iterator[Row]:
    """One closed loop against replays at its times: a row per forecaster, replay and sequence."""
    import numpy as np

    from lae_sim.evaluation.evaluate import evaluate
    from lae_sim.evaluation.metrics import find_convention
    from lae_sim.replay.run import replay_trace
    from lae_sim.trace.file import read_trace

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
    policy = parse_policy(schedule.get("policy", "latest"))
    forecasters = {name: load_forecaster(name) for name in arguments.forecaster}
    convention = find_convention(arguments.convention)

    def scored(runs: list[Run]) -> Evaluation:
        return evaluate(runs, closed.metadata, forecasters, (Fraction(0),), convention)

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


def summarised(rows: Sequence[Row]) -> Row:
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
