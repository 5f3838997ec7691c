"""Replaying recordings: the engine fed with recorded times and boxes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import groupby

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.boxes import PARTED_IOU, iou
from lae_sim.engine.arrivals import same_arrivals, with_arrivals
from lae_sim.engine.clock import Clock
from lae_sim.engine.lanes import batchable, simulate_lanes
from lae_sim.engine.policies import latest
from lae_sim.engine.scheduler import Policy, Schedule, Service, simulate
from lae_sim.engine.times import Times
from lae_sim.errors import LaeError, explained, shown
from lae_sim.replay.latency import LatencySource, RandomSource, by_frame
from lae_sim.replay.passes import split_passes
from lae_sim.replay.search import Outcomes, RecordedAnswers, SearchModel, phase_answers
from lae_sim.replay.strides import followed
from lae_sim.trace.file import HELD_FRAMES, Trace
from lae_sim.trace.metadata import ImageSizes
from lae_sim.trace.recording import BESIDE, Recording, batched

_GROUP_FRAMES = 1 << 16  # world frames of the sequences that are in memory at once
_LEAST = 0.2  # weight of the farther of two strides beside a step
_LANE_FRAMES = 1 << 21  # and of their repetitions


@dataclass(frozen=True, eq=False, repr=False)
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
        modelled: what the search model makes of the run; None where it is off, or the replay exact.

    Example:
        >>> import lae_sim
        >>> runs = lae_sim.replay_trace("traces/synthetic-slow.parquet", latency="constant:47ms")
        >>> run = next(iter(runs))
        >>> run
        <Run of 'bike-pan' at 30 fps: ... of 300 frames processed>
        >>> run.recording.name, len(run), len(run.schedule.frames), run.departures
        ('bike-pan', 300, 213, 86)
    """

    recording: Recording
    schedule: Schedule
    boxes: Floats
    departures: int
    disagreement: float = np.nan
    modelled: Outcomes | None = None

    def __len__(self) -> int:
        """Number of world frames T."""
        return self.schedule.length

    def __repr__(self) -> str:
        processed = f"{len(self.schedule.frames):,} of {len(self):,} frames processed"
        return f"<Run of {self.recording.name!r} at {self.schedule.clock.fps} fps: {processed}>"


def replay_sequence(
    recording: Recording,
    clock: Clock,
    source: LatencySource = by_frame,
    policy: Policy = latest,
    times: Recording | None = None,
    stride: Fraction = Fraction(1),
    strided: Mapping[Fraction, Recording] | None = None,
    search: SearchModel | None = None,
    image_size: tuple[int, int] | ImageSizes | None = None,
) -> Run:
    """Replay a recording under a latency source and a policy.

    Args:
        recording: the boxes and the truth.
        clock: the world's frame rate. Where the recording says when its frames arrived, they arrive
            then, and the rate is the nominal one.
        source: how to take processing times from a recording.
        policy: which frame is processed next.
        times: the same sequence recorded on another device, to take the times from.
        stride: that of the recording, if it holds every frame (see :mod:`lae_sim.replay.strides`).
        strided: recordings of every frame at other strides. The boxes are taken from the pass whose
            stride is nearest to the mean number of frames from one output to the next.
        search: the model of where the tracker finds its target; None for none.
        image_size: width and height in pixels, if known, for the model's pre-forecaster; or all of
            them, where images change size.

    Raises:
        LaeError: if a frame is asked for that the recording lacks, or the recordings differ in
            length or in when frames arrived; it names the sequence and the frame.

    Example:
        >>> import lae_sim
        >>> from lae_sim.engine import Clock
        >>> trace = lae_sim.read_trace("traces/synthetic-slow.parquet")
        >>> run = lae_sim.replay_sequence(trace["boat-calm"], Clock.at(trace.metadata.fps))
        >>> run.schedule.frames[:5].tolist(), run.boxes.shape == (len(run.schedule.frames), 4)
        ([0, 8, 9, 10, 12], True)
    """
    if not isinstance(recording, Recording):
        raise LaeError(f"recording: one sequence, such as trace['car'], not {shown(recording)}")
    if not isinstance(clock, Clock):
        raise LaeError(f"clock: such as Clock.at(trace.metadata.fps), not {shown(clock)}")
    times = recording if times is None else times
    if isinstance(image_size, tuple):
        image_size = ImageSizes.constant(image_size)
    job = _Job(recording, times, strided or {}, clock, stride, search, image_size)
    return job.run(simulate(len(recording), job.clock, source(job.times), policy))


@dataclass(frozen=True, eq=False)
class _Job:
    """A recording with what its replay needs besides: times, passes at other strides, its own."""

    recording: Recording
    times: Recording
    passes: Mapping[Fraction, Recording]
    nominal: Clock
    stride: Fraction
    search: SearchModel | None = None
    image_sizes: ImageSizes | None = None

    def __post_init__(self) -> None:
        for other in (self.times, *self.passes.values()):
            if len(other) != len(self.recording):
                raise LaeError(
                    f"sequence {self.recording.name!r} has {len(self.recording)} frames in one "
                    f"trace and {len(other)} in another"
                )
            if not same_arrivals(other.arrival_ns, self.recording.arrival_ns):
                raise LaeError(
                    f"sequence {self.recording.name!r}: its frames arrived at other times in one "
                    "trace than in another: --forget-arrivals (forget_arrivals) spaces them evenly"
                )

    @cached_property
    def clock(self) -> Clock:
        """That of the sequence, which knows when its frames arrive."""
        try:
            return with_arrivals(self.nominal, self.recording.arrival_ns)
        except LaeError as error:
            raise LaeError(f"sequence {self.recording.name!r}: {error}") from error

    def __len__(self) -> int:
        return len(self.recording)

    def run(self, schedule: Schedule) -> Run:
        frames = schedule.frames
        passes = {self.stride: self.recording, **self.passes}
        strides = sorted(passes)
        nearest = _nearest(strides, frames)
        stride = strides[nearest]
        boxes = _boxes(passes[stride], frames)
        before = self.before if stride == self.stride else _before(passes[stride], stride)
        departures = _departures(before, frames)
        disagreement = np.nan
        if self.passes:
            parted = np.zeros(len(frames), bool)
            for other in strides[max(nearest - 1, 0) : nearest + 2] if departures else ():
                parted |= iou(_boxes(passes[other], frames), boxes) < PARTED_IOU
            disagreement = float(parted.mean())
        run = Run(self.recording, schedule, boxes, departures, disagreement)
        if self.search is None or len(frames) == 1:
            return run
        if not departures and self.search.pre_forecaster is None:
            return run
        farther = np.append(False, np.diff(frames) > (frames - before.take(frames))[1:])
        recorded = [RecordedAnswers(boxes, farther)]
        if self.passes:
            for other, weight in _beside(strides, frames).items():
                recorded += phase_answers(other, passes[other], frames, weight)
        sizes, times = self.image_sizes, None
        if not self.clock.is_even:
            times = [self.clock.frame_time(frame) for frame in frames.tolist()]
        modelled = self.search.outcomes(self.recording, frames, recorded, sizes, times)
        return replace(run, modelled=modelled)

    @cached_property
    def before(self) -> Ints:
        return _before(self.recording, self.stride)


def _boxes(recording: Recording, frames: Ints) -> Floats:
    """The boxes of some frames, float64 [n, 4]."""
    boxes: Floats = recording.boxes.take(frames, axis=0)
    absent = np.isnan(boxes[:, 0])
    if absent.any():
        raise LaeError(
            f"sequence {recording.name!r}, frame {frames[absent][0]}: the trace has no "
            "box for it, since the tracker skipped it; replay a trace of every frame instead"
        )
    return boxes


def _before(recording: Recording, stride: Fraction) -> Ints:
    """The frame that each one followed when it was recorded, or would have, int64 [T]; 0: -1."""
    if stride > 1:
        return followed(stride, len(recording))
    processed = ~np.isnan(recording.boxes[:, 0])
    if processed.all():
        return np.arange(-1, len(processed) - 1)
    latest_one = np.maximum.accumulate(np.where(processed, np.arange(len(processed)), -1))
    return np.concatenate([[-1], latest_one[:-1]])


def _departures(before: Ints, frames: Ints) -> int:
    """How many of some frames followed another one when they were recorded."""
    return int(np.count_nonzero(before.take(frames[1:]) != frames[:-1]))


def _nearest(strides: Sequence[Fraction], frames: Ints) -> int:
    """The stride nearest to the mean step of some processed frames, by its place."""
    step = Fraction(int(frames[-1]), max(len(frames) - 1, 1))
    return min(range(len(strides)), key=lambda k: abs(strides[k] - step))


def _beside(strides: Sequence[Fraction], frames: Ints) -> dict[Fraction, float]:
    """The strides next below and above the mean step of some processed frames, with weights.

    The nearer one weighs more; both weigh something, since steps differ from each other. The step
    from the initialisation does not count: a long one says nothing of those after it.
    """
    after = frames[1:] if len(frames) > 2 else frames
    step = Fraction(int(after[-1] - after[0]), max(len(after) - 1, 1))
    below = max((stride for stride in strides if stride <= step), default=strides[0])
    above = min((stride for stride in strides if stride >= step), default=strides[-1])
    if below == above:
        return {below: 1.0}
    share = float((step - below) / (above - below))
    share = min(max(share, _LEAST), 1 - _LEAST)
    return {below: 1 - share, above: share}


@dataclass(frozen=True, eq=False, repr=False)
class Runs:
    """The runs of a trace, one per sequence, made anew each time one goes through them.

    Attributes:
        trace: the boxes and the truth.
        clock: the world's; that of a sequence whose frames arrived at times of their own is of the
            same, then nominal, rate.
        source: how to take processing times from a recording.
        policy: which frame is processed next.
        timing: another device's trace to take the times from; it must have the same sequences.
        passes: further traces of the same tracker: at other strides (see
            :func:`replay_sequence`), and gap passes.
        search: the model of where the tracker finds its target; None for none.
        forget_arrivals: let all frames arrive evenly, whatever the traces say of it.

    Raises:
        LaeError: if two passes have the same stride or one is a real-time trace, or the trace or
            that of the times is a gap pass, or it says when its frames arrived and the clock is of
            another rate; while one goes through the runs, if a sequence or frame that is asked for
            is not there, traces differ in when frames arrived, or policy or source raise something.

    Example:
        >>> import lae_sim
        >>> runs = lae_sim.replay_trace("traces/synthetic-slow.parquet", latency="constant:47ms")
        >>> runs
        <Runs of <Trace of 'slow-and-accurate' on 'synthetic': 8 sequences, ...> at 30 fps>
        >>> sum(len(run.schedule.frames) for run in runs) / runs.trace.frames
        0.71
    """

    trace: Trace
    clock: Clock
    source: LatencySource = by_frame
    policy: Policy = latest
    timing: Trace | None = None
    passes: tuple[Trace, ...] = ()
    search: SearchModel | None = None
    forget_arrivals: bool = False

    def __post_init__(self) -> None:
        if self.trace.metadata.kind == "restarts":
            name = getattr(self.trace.recordings, "path", self.trace)
            raise LaeError(
                f"{name}: a gap pass, which measures a tracker's reach: "
                "give it to --strided (passes) of a trace of every frame"
            )
        if self.times.metadata.kind == "restarts":
            raise LaeError("a gap pass has no times for a replay: take those of another trace")
        if any(trace.metadata.kind == "real-time" for trace in self.strided):
            raise LaeError("a real-time trace is no pass: it lacks the frames that were skipped")
        strides = [trace.metadata.stride for trace in (self.trace, *self.strided)]
        if self.strided and len(set(strides)) != len(strides):
            raise LaeError("two of the passes have the same stride: give each stride once")
        if not self.forget_arrivals:
            check_rate(self.trace, self.clock.fps)

    @property
    def arrivals(self) -> str | None:
        """Whether the trace's arrival times are ``"recorded"`` or ``"forgotten"``; None without."""
        if not self.trace.has_arrivals:
            return None
        return "forgotten" if self.forget_arrivals else "recorded"

    def notes(self) -> list[str]:
        """A note on when frames arrive, if the trace says so."""
        if self.arrivals is None:
            return []
        if self.forget_arrivals:
            return ["the trace's arrival times are forgotten: frames arrive evenly"]
        return ["frames arrive when the trace says that they did, not evenly"]

    @property
    def strided(self) -> tuple[Trace, ...]:
        """The passes at other strides."""
        return split_passes(self.passes)[0]

    @property
    def gap_passes(self) -> tuple[Trace, ...]:
        """The passes that measure how far the tracker reaches."""
        return split_passes(self.passes)[1]

    @property
    def times(self) -> Trace:
        """The trace that the times are taken from."""
        return self.trace if self.timing is None else self.timing

    def __iter__(self) -> Iterator[Run]:
        return (run for _, run in replay_together([self], _GROUP_FRAMES))

    def _jobs(self) -> Iterator[_Job]:
        """Each recording of the trace with those of the same name in the other traces."""
        forget = self.forget_arrivals
        times = None
        if self.timing is not None:
            times = _finder(self.timing, "the trace of the times", forget)
        passes = {
            other.metadata.stride: _finder(
                other, f"the pass of stride {other.metadata.stride}", forget
            )
            for other in self.strided
        }
        for recording in _recordings(self.trace, forget):
            yield _Job(
                recording,
                recording if times is None else times(recording.name),
                {other: find(recording.name) for other, find in passes.items()},
                self.clock,
                self.trace.metadata.stride,
                self.search,
                self.trace.metadata.image_sizes(recording.name),
            )

    def __repr__(self) -> str:
        return f"<Runs of {self.trace!r} at {self.clock.fps} fps>"


def check_rate(trace: Trace, fps: Fraction) -> None:
    """Check that a trace can be replayed at a frame rate.

    Raises:
        LaeError: if it says when each frame arrived, and is of another rate.
    """
    if trace.has_arrivals and fps != trace.metadata.fps:
        raise LaeError(
            f"the trace says when each of its frames arrived, at a nominal {trace.metadata.fps} "
            f"frames/s: for {fps} frames/s forget the arrivals, and space the frames evenly: "
            "--forget-arrivals (forget_arrivals = true)"
        )


def replay_together(
    replays: Sequence[Runs], frames: int = HELD_FRAMES
) -> Iterator[tuple[int, Run]]:
    """The runs of some replays, one after another; those of the same rules are scheduled at once.

    Args:
        replays: any of them.
        frames: about how many world frames are in memory, and scheduled, at once.

    Yields:
        The place of the replay, and the run.

    Raises:
        LaeError: as iterating over each of them.
    """

    def rules(placed: tuple[int, Runs]) -> tuple[Policy, Clock, bool]:
        runs = placed[1]
        return runs.policy, runs.clock, runs.arrivals == "recorded"

    for (policy, *_), alike in groupby(enumerate(replays), rules):
        for places, jobs, services in _groups(alike, policy, frames):
            yield from zip(places, _replayed(jobs, services, policy))


def _groups(
    replays: Iterable[tuple[int, Runs]], policy: Policy, frames: int
) -> Iterator[tuple[list[int], list[_Job], list[Service]]]:
    """Jobs with the places of their replays and with their services.

    They are as many as can be scheduled at once and be in memory. A user's own policy or source
    sees one sequence after another: each is replayed before the source is asked for the next.
    """
    places: list[int] = []
    jobs: list[_Job] = []
    services: list[Service] = []
    pending = 0
    for place, runs in replays:
        for job in runs._jobs():
            with explained("latency"):
                service = runs.source(job.times)
            places.append(place)
            jobs.append(job)
            services.append(service)
            pending += len(job) + BESIDE
            if pending >= frames or not batchable([service], policy):
                yield places, jobs, services
                places, jobs, services, pending = [], [], [], 0
    if jobs:
        yield places, jobs, services


def replay_repeated(runs: Runs, count: int, first: int = 0) -> Iterator[tuple[int, Run]]:
    """Replay a trace again and again, under other random times in each repetition.

    Args:
        runs: of a trace with random times; the repetition of their source does not count.
        count: number of repetitions.
        first: the first repetition.

    Yields:
        The repetition and the run, which is that of ``runs`` with the source in that repetition.
        Sequences come in groups; in a group, repetition after repetition, and in a repetition
        sequence after sequence.

    Raises:
        LaeError: if the times are not random, or a sequence or frame that is asked for is not
            there.
    """
    source = runs.source
    if not isinstance(source, RandomSource):
        raise LaeError("only random times can be drawn again: bootstrap, resample or lognormal")
    for jobs in batched(runs._jobs(), _GROUP_FRAMES, BESIDE):
        size = max(_LANE_FRAMES // sum(map(len, jobs)), 1)
        for begin in range(first, first + count, size):
            some = range(begin, min(begin + size, first + count))
            drawn = [source.repeated(job.times, begin, len(some)) for job in jobs]
            times = [
                Times(job.recording.name, rows[k], by_call=True)
                for k in range(len(some))
                for job, rows in zip(jobs, drawn)
            ]
            replayed = _replayed(jobs * len(some), times, runs.policy)
            yield from ((r, next(replayed)) for r in some for _ in jobs)


def _replayed(jobs: Sequence[_Job], services: Sequence[Service], policy: Policy) -> Iterator[Run]:
    clocks = [job.clock for job in jobs]
    schedules = simulate_lanes([len(job) for job in jobs], clocks, services, policy)
    for job in jobs:
        with explained(f"sequence {job.recording.name!r}: policy or latency"):
            schedule = next(schedules)
        yield job.run(schedule)


def _recordings(trace: Trace, forget_arrivals: bool) -> Iterator[Recording]:
    """The recordings of a trace, perhaps as if their frames had arrived evenly."""
    for recording in trace:
        forget = forget_arrivals and recording.arrival_ns is not None
        yield replace(recording, arrival_ns=None) if forget else recording


def _finder(trace: Trace, what: str, forget_arrivals: bool) -> Callable[[str], Recording]:
    """Finds recordings by names that are asked for in the order of the trace, sorted."""
    recordings = _recordings(trace, forget_arrivals)

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
