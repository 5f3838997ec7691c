"""How far replays are from closed loops, in which the tracker really skipped frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.boxes import PARTED_IOU, iou
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.evaluation.metrics import Convention, find_convention
from lae_sim.forecast.base import AnyFactory
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.reach import split_passes
from lae_sim.replay.run import Run, Runs
from lae_sim.replay.world import parse_policy
from lae_sim.trace.file import Trace, read_trace


@dataclass(frozen=True)
class FidelityRow:
    """One sequence of a closed loop, and a replay of it.

    Attributes:
        closed_loop: path of the closed loop's trace.
        forecaster: its name.
        replay: which boxes were replayed: ``"every-frame"`` or ``"strided"``.
        sequence: its name.
        closed_auc, auc, d_auc: of the closed loop, of the replay, and replay - closed loop.
        closed_dp20, dp20, d_dp20: the same of the precision at 20 pixels.
        parted: the first processed frame whose boxes overlap less than half; None if none does.
        approximate_outputs: outputs of the replay after another number of skipped frames than
            in the traces.
        disagreement: of the strides (see :class:`lae_sim.replay.run.Run`); None where there is
            none.
    """

    closed_loop: str
    forecaster: str
    replay: str
    sequence: str
    closed_auc: float
    auc: float
    d_auc: float
    closed_dp20: float
    dp20: float
    d_dp20: float
    parted: int | None
    approximate_outputs: int
    disagreement: float | None


@dataclass(frozen=True)
class FidelitySummary:
    """All sequences of a closed loop, and a replay of them.

    Attributes:
        closed_loop, forecaster, replay: as of the rows.
        sequences: how many.
        closed_auc, auc, closed_dp20, dp20: means over the sequences that have a score.
        mean_abs_d_auc, median_abs_d_auc, max_abs_d_auc: of ``|d_auc|`` over these.
        mean_abs_d_dp20, median_abs_d_dp20, max_abs_d_dp20: of ``|d_dp20|`` over these.
    """

    closed_loop: str
    forecaster: str
    replay: str
    sequences: int
    closed_auc: float
    auc: float
    mean_abs_d_auc: float
    median_abs_d_auc: float
    max_abs_d_auc: float
    closed_dp20: float
    dp20: float
    mean_abs_d_dp20: float
    median_abs_d_dp20: float
    max_abs_d_dp20: float


def compare_closed_loops(
    trace: str,
    closed_loops: Sequence[str],
    *,
    passes: Sequence[str] = (),
    forecasters: Sequence[str] = ("hold",),
    convention: str = "pysot",
) -> list[FidelityRow]:
    """Compare closed loops with replays at their times.

    Args:
        trace: path of a trace of every frame.
        closed_loops: paths of real-time traces of the same tracker.
        passes: paths of traces of passes on every N-th frame.
        forecasters: names (see :func:`lae_sim.learning.registry.load_forecaster`).
        convention: how frames and thresholds count, by name.

    Returns:
        A row per closed loop, replay, forecaster and sequence; the replay ``"strided"`` is there
        if ``passes`` are given.

    Raises:
        LaeError: if a trace cannot be read, is not of the kind needed or of another tracker, or
            there is no such forecaster or convention.
    """
    factories = {name: load_forecaster(name) for name in forecasters}
    scoring = find_convention(convention)
    return [
        row
        for path in dict.fromkeys(closed_loops)
        for row in _rows(path, [trace, *passes], factories, scoring)
    ]


def summarise_closed_loops(rows: Sequence[FidelityRow]) -> list[FidelitySummary]:
    """The rows of each closed loop, forecaster and replay in short."""
    groups: dict[tuple[str, str, str], list[FidelityRow]] = {}
    for row in rows:
        groups.setdefault((row.closed_loop, row.forecaster, row.replay), []).append(row)
    return [_summary(*key, group) for key, group in groups.items()]


def _rows(
    path: str,
    replayed: Sequence[str],
    forecasters: Mapping[str, AnyFactory],
    convention: Convention,
) -> Iterator[FidelityRow]:
    closed = read_trace(path)
    if closed.metadata.kind != "real-time":
        raise LaeError(
            f"{path}: a trace of every frame is no closed loop: give one that "
            "'lae-sim profile --closed-loop' or '--mode real-time' left"
        )
    names = [recording.name for recording in closed]
    every, *others = map(read_trace, replayed)
    passes, gaps = split_passes(others)
    for trace in (every, *passes, *gaps):
        _check_same_tracker(closed, trace)
    if not all(trace.metadata.kind == "every-frame" for trace in (every, *passes)):
        raise LaeError("TRACE and --strided take traces of every frame, not real-time ones")
    every = every.chosen(names)
    passes = tuple(trace.chosen(names) for trace in passes)
    schedule = closed.metadata.document["schedule"]
    policy = parse_policy(schedule.get("policy", "latest"))

    def scores(runs: list[Run]) -> Mapping[str, Floats]:
        sigmas = (Fraction(0),)
        return evaluate_runs(runs, closed.metadata, forecasters, sigmas, convention).scores

    clock = Clock.at(closed.metadata.fps)
    closed_runs = list(Runs(closed, clock, policy=policy))
    replays = {"every-frame": list(Runs(every, clock, policy=policy, timing=closed))}
    if passes:
        strided = Runs(every, clock, policy=policy, timing=closed, passes=passes)
        replays["strided"] = list(strided)
    closed_scores = scores(closed_runs)
    for kind, runs in replays.items():
        replay_scores = scores(runs)
        for f, forecaster in enumerate(forecasters):
            for i, (run, closed_run) in enumerate(zip(runs, closed_runs)):
                auc, dp20 = (float(replay_scores[m][f, i, 0]) for m in ("auc", "dp20"))
                closed_auc, closed_dp20 = (
                    float(closed_scores[m][f, i, 0]) for m in ("auc", "dp20")
                )
                yield FidelityRow(
                    closed_loop=path,
                    forecaster=forecaster,
                    replay=kind,
                    sequence=run.recording.name,
                    closed_auc=closed_auc,
                    auc=auc,
                    d_auc=auc - closed_auc,
                    closed_dp20=closed_dp20,
                    dp20=dp20,
                    d_dp20=dp20 - closed_dp20,
                    parted=_parted(run, closed_run),
                    approximate_outputs=run.departures,
                    disagreement=None if np.isnan(run.disagreement) else run.disagreement,
                )


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
    apart = np.flatnonzero(iou(replay.boxes, closed.boxes) < PARTED_IOU)
    return int(closed.schedule.frames[apart[0]]) if len(apart) else None


def _summary(
    closed_loop: str, forecaster: str, replay: str, rows: Sequence[FidelityRow]
) -> FidelitySummary:
    d_auc = np.abs([row.d_auc for row in rows])
    d_dp20 = np.abs([row.d_dp20 for row in rows])
    return FidelitySummary(
        closed_loop=closed_loop,
        forecaster=forecaster,
        replay=replay,
        sequences=len(rows),
        closed_auc=float(np.nanmean([row.closed_auc for row in rows])),
        auc=float(np.nanmean([row.auc for row in rows])),
        mean_abs_d_auc=float(np.nanmean(d_auc)),
        median_abs_d_auc=float(np.nanmedian(d_auc)),
        max_abs_d_auc=float(np.nanmax(d_auc)),
        closed_dp20=float(np.nanmean([row.closed_dp20 for row in rows])),
        dp20=float(np.nanmean([row.dp20 for row in rows])),
        mean_abs_d_dp20=float(np.nanmean(d_dp20)),
        median_abs_d_dp20=float(np.nanmedian(d_dp20)),
        max_abs_d_dp20=float(np.nanmax(d_dp20)),
    )
