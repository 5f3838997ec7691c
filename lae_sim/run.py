"""Replaying one recording: the engine fed with recorded times and boxes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from lae_sim.boxes import PARTED_IOU, Floats, iou
from lae_sim.clock import Clock
from lae_sim.engine import Ints, Policy, Schedule, simulate
from lae_sim.errors import LaeError
from lae_sim.latency import LatencySource, by_frame
from lae_sim.policies import latest
from lae_sim.recording import Recording
from lae_sim.strides import followed
from lae_sim.trace import Trace


@dataclass(frozen=True, eq=False)
class Run:
    """One sequence replayed.

    Attributes:
        recording: the sequence as recorded.
        schedule: what was processed, and when.
        boxes: the box of each processed frame, float64 [n, 4]; with strided passes perhaps of
            another pass than the recording.
        departures: processed frames (the first left out) whose preceding processed frame is not
            the one they followed when they were recorded. Above 0, the boxes of a stateful tracker
            are an approximation: it would have seen other motion.
        disagreement: share of processed frames where the box of the next lower or next higher
            stride overlaps less than half, 0 if the replay is exact, NaN without strided passes.
            Where it is high the tracker's luck depends on the frames that it sees.
    """

    recording: Recording
    schedule: Schedule
    boxes: Floats
    departures: int
    disagreement: float = np.nan

    def __len__(self) -> int:
        """Number of world frames T."""
        return self.schedule.length


def replay_sequence(
    recording: Recording,
    clock: Clock,
    source: LatencySource = by_frame,
    policy: Policy = latest,
    times: Recording | None = None,
    stride: Fraction = Fraction(1),
    strided: Mapping[Fraction, Recording] | None = None,
) -> Run:
    """Replay a recording under a latency source and a policy.

    Args:
        recording: the boxes and the truth.
        clock: the world's frame rate.
        source: how to take processing times from a recording.
        policy: which frame is processed next.
        times: the same sequence recorded on another device, to take the times from.
        stride: that of the recording, if it holds every frame (see :mod:`lae_sim.strides`).
        strided: recordings of every frame at other strides. The boxes are taken from the pass whose
            stride is nearest to the mean number of frames from one output to the next.

    Raises:
        LaeError: if a frame is asked for that the recording lacks, or the recordings differ in
            length; it names the sequence and the frame.
    """
    for other in [*([] if times is None else [times]), *(strided or {}).values()]:
        if len(other) != len(recording):
            raise LaeError(
                f"sequence {recording.name!r} has {len(recording)} frames in one trace and "
                f"{len(other)} in another"
            )
    schedule = simulate(
        len(recording), clock, source(recording if times is None else times), policy
    )
    frames = schedule.frames
    if strided:
        return _from_passes(recording, {stride: recording, **strided}, schedule)
    boxes = _boxes(recording, frames)
    return Run(recording, schedule, boxes, _departures(recording, frames, stride))


def _boxes(recording: Recording, frames: Ints) -> Floats:
    """The boxes of some frames, float64 [n, 4]."""
    boxes: Floats = recording.boxes[frames]
    absent = np.flatnonzero(np.isnan(boxes[:, 0]))
    if len(absent):
        raise LaeError(
            f"sequence {recording.name!r}, frame {frames[absent[0]]}: the trace has no "
            "box for it, since the tracker skipped it; replay a trace of every frame instead"
        )
    return boxes


def _departures(recording: Recording, frames: Ints, stride: Fraction) -> int:
    """How many of some frames followed another one when they were recorded."""
    if stride > 1:
        before = followed(stride, len(recording))[frames[1:]]
    else:
        recorded = np.flatnonzero(~np.isnan(recording.boxes[:, 0]))
        before = recorded[np.searchsorted(recorded, frames[1:]) - 1]
    return int(np.count_nonzero(before != frames[:-1]))


def _from_passes(
    recording: Recording, passes: Mapping[Fraction, Recording], schedule: Schedule
) -> Run:
    """The run whose boxes come from the pass that is nearest to its mean step."""
    frames = schedule.frames
    step = Fraction(int(frames[-1]), max(len(frames) - 1, 1))
    strides = sorted(passes)
    nearest = min(range(len(strides)), key=lambda k: abs(strides[k] - step))
    source = passes[strides[nearest]]
    boxes = _boxes(source, frames)
    departures = _departures(source, frames, strides[nearest])
    parted = np.zeros(len(frames), bool)
    for stride in strides[max(nearest - 1, 0) : nearest + 2] if departures else ():
        parted |= iou(_boxes(passes[stride], frames), boxes) < PARTED_IOU
    return Run(recording, schedule, boxes, departures, float(parted.mean()))


def replay_trace(
    trace: Trace,
    fps: Fraction | None = None,
    source: LatencySource = by_frame,
    policy: Policy = latest,
    timing: Trace | None = None,
    strided: Sequence[Trace] = (),
) -> Iterator[Run]:
    """Replay every sequence of a trace, one after another.

    Args:
        trace: the boxes and the truth.
        fps: world frame rate; the trace's own by default.
        source: how to take processing times from a recording.
        policy: which frame is processed next.
        timing: another device's trace to take the times from; it must have the same sequences.
        strided: traces of the same tracker at other strides (see :func:`replay_sequence`).

    Raises:
        LaeError: if a sequence or frame that is asked for is not there.
    """
    clock = Clock.at(trace.metadata.fps if fps is None else fps)
    times = None if timing is None else _finder(timing, "the trace of the times")
    passes = {
        other.metadata.stride: _finder(other, f"the pass of stride {other.metadata.stride}")
        for other in strided
    }
    stride = trace.metadata.stride
    if stride in passes or len(passes) != len(strided):
        raise LaeError("two of the passes have the same stride: give each stride once")
    for recording in trace:
        yield replay_sequence(
            recording,
            clock,
            source,
            policy,
            None if times is None else times(recording.name),
            stride,
            {other: find(recording.name) for other, find in passes.items()},
        )


def _finder(trace: Trace, what: str) -> Callable[[str], Recording]:
    """Finds recordings by names that are asked for in the order of the trace, sorted."""
    recordings = iter(trace)

    def find(name: str) -> Recording:
        for recording in recordings:
            if recording.name >= name:
                break
        else:
            recording = None
        if recording is None or recording.name != name:
            raise LaeError(f"{what} has no sequence {name!r}")
        return recording

    return find
