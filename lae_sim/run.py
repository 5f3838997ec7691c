"""Replaying one recording: the engine fed with recorded times and boxes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations

import numpy as np

from lae_sim.boxes import PARTED_IOU, Floats, iou
from lae_sim.clock import Clock
from lae_sim.engine import Ints, Policy, Schedule, simulate
from lae_sim.errors import LaeError
from lae_sim.latency import LatencySource, by_frame
from lae_sim.policies import latest
from lae_sim.recording import Recording
from lae_sim.trace import Trace


@dataclass(frozen=True, eq=False)
class Run:
    """One sequence replayed.

    Attributes:
        recording: the sequence as recorded.
        schedule: what was processed, and when.
        boxes: the box of each processed frame, float64 [n, 4].
        departures: processed frames (the first left out) that did not follow the same frame, with
            the same box, when they were recorded. Above 0, the boxes of a stateful tracker are an
            approximation: it would have seen other motion.
        disagreement: share of processed frames where the boxes of two of the passes concerned
            overlap less than half, 0 if the replay is exact, NaN without strided passes. Where it
            is high the tracker's luck depends on the frames that it sees.
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
    stride: int = 1,
    strided: Mapping[int, Recording] | None = None,
) -> Run:
    """Replay a recording under a latency source and a policy.

    Args:
        recording: the boxes and the truth.
        clock: the world's frame rate.
        source: how to take processing times from a recording.
        policy: which frame is processed next.
        times: the same sequence recorded on another device, to take the times from.
        stride: that of the recording, if it holds every frame: frame f followed f - stride.
        strided: recordings of every frame at other strides. Each output is taken from the pass
            whose stride is nearest to the frames since the output before.

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
        return _from_passes({stride: recording, **strided}, recording, schedule)
    boxes = _boxes(recording, frames)
    followed = _followed(recording, frames, stride)
    return Run(recording, schedule, boxes, int(np.count_nonzero(followed != frames[:-1])))


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


def _followed(recording: Recording, frames: Ints, stride: int) -> Ints:
    """The frame that each but the first of some frames followed when it was recorded."""
    if stride > 1:
        return np.maximum(frames[1:] - stride, 0)
    recorded = np.flatnonzero(~np.isnan(recording.boxes[:, 0]))
    followed: Ints = recorded[np.searchsorted(recorded, frames[1:]) - 1]
    return followed


def _from_passes(passes: Mapping[int, Recording], recording: Recording, schedule: Schedule) -> Run:
    """The run whose outputs come from the passes that fit their steps best."""
    frames = schedule.frames
    steps = np.diff(frames, prepend=frames[0] - 1)
    strides = np.array(sorted(passes))
    chosen = np.abs(steps[:, None] - strides).argmin(axis=1)
    stacked = np.stack([_boxes(passes[stride], frames) for stride in strides.tolist()])
    boxes = stacked[chosen, np.arange(len(frames))]
    followed = np.stack([_followed(passes[s], frames, s) for s in strides.tolist()])
    rest = np.arange(len(frames) - 1)
    before = stacked[chosen[1:], rest]  # what the pass of an output answered for the one before
    same = (followed[chosen[1:], rest] == frames[:-1]) & (before == boxes[:-1]).all(axis=1)
    departures = int(np.count_nonzero(~same))
    concerned = stacked[: chosen.max() + 1] if departures else stacked[:1]
    apart = [iou(a, b) < PARTED_IOU for a, b in combinations(concerned, 2)]
    disagreement = float(np.mean(np.any(apart, axis=0))) if apart else 0.0
    return Run(recording, schedule, boxes, departures, disagreement)


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
