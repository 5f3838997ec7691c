"""Runs recorded in real time by the released LAE-PVT and PVT++ code, as recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.decoding import Budget
from lae_sim.engine.clock import NS_PER_SECOND, Clock
from lae_sim.errors import LaeError, listed, shown
from lae_sim.importers.pickles import load_plain
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.recording import Recording

_ROUNDING_NS = 2
_OUTPUT_BYTES = 128  # of one number of an array as objects of Python


@dataclass(frozen=True)
class ReleasedRun:
    """One sequence of a released run.

    Attributes:
        recording: the real-time recording.
        prolonged_ns: by how much processing times were prolonged, where by more than rounding.
        init_known: whether the time of the initialisation was recorded.
    """

    recording: Recording
    prolonged_ns: tuple[int, ...]
    init_known: bool


def read_run(path: Path, name: str, truth: Floats, clock: Clock) -> ReleasedRun:
    """The real-time recording of one released pickle.

    The pickle is a dict of ``results_raw`` (boxes ``x, y, w, h``), ``timestamps`` (when each output
    was ready, s since the start), ``input_fidx`` (its frame) and, if there, ``runtime`` (s). PVT++
    with a predictor adds ``_t`` to the keys of the tracker.

    A processing time runs from when the tracker was free and the frame had arrived until the
    recorded timestamp. The released loop looks at its clock again after an output; where a frame
    arrived in between, the time is prolonged up to that arrival, at most by one frame interval, so
    that a replay under ``latest`` processes exactly the recorded frames.

    Args:
        path: the pickle.
        name: the sequence's name.
        truth: ground truth of every world frame, float64 [T, 4].
        clock: of the recorded run.

    Raises:
        LaeError: if the pickle is not such a run, or the scheduler cannot repeat it; the message
            names the file and the output.
    """
    content = load_plain(path)
    if not isinstance(content, dict):
        raise LaeError(f"{path}: not a dict of results_raw, timestamps and input_fidx")
    tail = "_t" if "timestamps_t" in content else ""
    frames = [_frame(path, k, f) for k, f in _column(path, content, "input_fidx" + tail)]
    seconds = [_second(path, k, t) for k, t in _column(path, content, "timestamps" + tail)]
    boxes = [_box(path, k, box) for k, box in _column(path, content, "results_raw" + tail)]
    if not len(frames) == len(seconds) == len(boxes):
        raise LaeError(
            f"{path}: {len(boxes)} results_raw, {len(seconds)} timestamps and {len(frames)} "
            "input_fidx; each output needs one of each"
        )
    _check_frames(path, frames, len(truth))
    runtimes = next((key for key in ("runtime", "runtime_all") if key in content), None)
    if not seconds[0] and runtimes:  # the released scoring scripts set the first one to 0
        recorded = _column(path, content, runtimes)[:1]
        seconds[: len(recorded)] = [_second(path, k, runtime) for k, runtime in recorded]
    init_known = seconds[0] > 0
    elapsed, prolonged_ns = _elapsed(path, frames, seconds, len(truth), clock, init_known)
    all_boxes = np.full((len(truth), 4), np.nan)
    all_times = np.full(len(truth), -1, np.int64)
    all_boxes[frames], all_times[frames] = boxes, elapsed
    recording = Recording.new(name, truth, all_boxes, all_times)
    if replay_sequence(recording, clock).schedule.frames.tolist() != frames:
        raise LaeError(f"{path}: a replay does not repeat the recorded frames")
    return ReleasedRun(recording, tuple(prolonged_ns), init_known)


def _elapsed(
    path: Path,
    frames: list[int],
    seconds: list[Fraction],
    length: int,
    clock: Clock,
    init_known: bool,
) -> tuple[list[int], list[int]]:
    """Processing times in ns that repeat ``frames``, and by how much some were prolonged."""
    per_ns, interval = clock.ticks_per_ns, clock.frame_ticks
    elapsed: list[int] = []
    prolonged_ns: list[int] = []
    ready = 0
    for k, (frame, following) in enumerate(zip(frames, [*frames[1:], length])):
        start = max(ready, frame * interval)
        recorded = round(seconds[k] * NS_PER_SECOND) * per_ns
        nearest = round(Fraction(recorded - start, per_ns))
        if nearest < -_ROUNDING_NS:
            _cannot(path, k, frame, "is ready before the tracker was free and the frame there")
        # When the output is ready, `following` must be the newest frame, or the next to arrive.
        waits = following == frame + 1
        least = 0 if waits else max(0, -((start - following * interval) // per_ns))
        most = ((following + 1) * interval - 1 - start) // per_ns
        if following < length and nearest > most + _ROUNDING_NS:
            _cannot(path, k, frame, f"is ready when frame {following}, the next, is out of date")
        longer = least - nearest
        if longer * per_ns > interval and (init_known or k):
            then = "the run ends" if following == length else f"frame {following} is next"
            _cannot(path, k, frame, f"leaves the tracker free, yet {then} and some are skipped")
        if longer > _ROUNDING_NS and (init_known or k):
            prolonged_ns.append(longer)
        elapsed.append(max(least, nearest if following == length else min(nearest, most)))
        ready = start + elapsed[-1] * per_ns
    return elapsed, prolonged_ns


def _cannot(path: Path, k: int, frame: int, problem: str) -> NoReturn:
    raise LaeError(
        f"{path}: output {k} (frame {frame}) {problem}; are the timestamps in seconds, is --fps "
        "the rate of the run, and is the ground truth that of the same frames?"
    )


def _check_frames(path: Path, frames: list[int], length: int) -> None:
    if not frames or frames[0] != 0:
        raise LaeError(f"{path}: input_fidx must start with frame 0, the initialisation")
    for k, (before, frame) in enumerate(pairwise(frames), 1):
        if frame <= before:
            raise LaeError(f"{path}: input_fidx[{k}] is {frame}, after frame {before}")
    if frames[-1] >= length:
        raise LaeError(
            f"{path}: input_fidx[{len(frames) - 1}] is frame {frames[-1]}, and the ground truth "
            f"has {length} frames; is it that of this sequence?"
        )


def _column(path: Path, content: Mapping[Any, Any], key: str) -> list[tuple[int, Any]]:
    column = content.get(key)
    if isinstance(column, (np.ndarray, list, tuple)):
        Budget(path).take(
            _OUTPUT_BYTES * (column.size if isinstance(column, np.ndarray) else len(column))
        )
    if isinstance(column, np.ndarray) and column.ndim:
        column = column.tolist()
    if not isinstance(column, (list, tuple)):
        present = listed(key if isinstance(key, str) else shown(key) for key in content)
        raise LaeError(f"{path}: no list {key!r} (it has {present or 'nothing'})")
    return list(enumerate(column))


def _numbers(value: Any) -> list[int | float]:
    """The up to four numbers in a number, list, tuple or array; none if it is anything else."""
    values = value if isinstance(value, (list, tuple)) else [value]
    if isinstance(value, np.ndarray) and value.size <= 4:
        values = value.ravel().tolist()
    known = len(values) <= 4 and all(
        type(number) in (int, float) and abs(number) < 1e15 for number in values
    )
    return list(values) if known else []


def _second(path: Path, k: int, value: Any) -> Fraction:
    numbers = _numbers(value)
    if len(numbers) != 1 or not 0 <= numbers[0] < 1e9:
        raise LaeError(f"{path}: time {k} is not a number of seconds")
    return Fraction(numbers[0])


def _frame(path: Path, k: int, value: Any) -> int:
    numbers = _numbers(value)
    if len(numbers) != 1 or numbers[0] != int(numbers[0]):
        raise LaeError(f"{path}: input_fidx[{k}] is not a frame number")
    return int(numbers[0])


def _box(path: Path, k: int, value: Any) -> list[float]:
    numbers = _numbers(value)
    if len(numbers) != 4:
        raise LaeError(f"{path}: results_raw[{k}] is not a box of four numbers x, y, w, h")
    return [float(number) for number in numbers]
