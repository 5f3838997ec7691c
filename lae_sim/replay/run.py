"""Replaying recordings: the engine fed with recorded times and boxes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import chain, groupby, pairwise
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import PARTED_IOU, iou
from lae_sim.engine.arrivals import same_arrivals, with_arrivals
from lae_sim.engine.clock import Clock
from lae_sim.engine.lanes import batchable, simulate_many
from lae_sim.engine.policies import latest
from lae_sim.engine.scheduler import Policy, Schedule, Schedules, Service, simulate
from lae_sim.engine.times import Times
from lae_sim.errors import LaeError, explained, shown
from lae_sim.replay.latency import LatencySource, RandomSource, by_frame
from lae_sim.replay.passes import split_passes
from lae_sim.replay.pipeline import PipelineTimes
from lae_sim.replay.recorded import AsRecorded, is_log
from lae_sim.replay.search import Outcomes, RecordedAnswers, SearchModel, phase_answers
from lae_sim.replay.strides import followed
from lae_sim.trace.file import HELD_FRAMES, Trace
from lae_sim.trace.metadata import ImageSizes
from lae_sim.trace.recording import BESIDE, Recording, batched

Item = TypeVar("Item")

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
    schedule = simulate(len(recording), job.clock, source(job.times), _rule(policy, job))
    return _run([job], Schedules.of([schedule]), np.zeros(1, np.int64))[0]


@dataclass(frozen=True, eq=False, repr=False)
class RunBatch:
    """R runs in arrays, one after another: what is done with each takes a fraction of the time.

    Attributes:
        recordings: of each run.
        schedules: of the runs, with n processed frames.
        table: boxes, those that the runs have and perhaps others, float64 [N, 4].
        row: the row of each processed frame's box in it, int64 [n].
        departures, disagreement: see :class:`Run`, int64 [R] and float64 [R].
        modelled: see :class:`Run`.
        repetition: of each, int64 [R]; 0 where times are not drawn again and again.
        own: whether a run's boxes are known to be those of its recording, bool [R].
    """

    recordings: tuple[Recording, ...]
    schedules: Schedules
    table: Floats
    row: Ints
    departures: Ints
    disagreement: Floats
    modelled: tuple[Outcomes | None, ...]
    repetition: Ints
    own: Bools

    def __len__(self) -> int:
        """Number of runs R."""
        return len(self.recordings)

    def __getitem__(self, r: int) -> Run:
        """One of them."""
        return Run(
            self.recordings[r],
            self.schedules[r],
            self.table.take(self.row[slice(*self.schedules.offsets[r : r + 2])], axis=0),
            int(self.departures[r]),
            float(self.disagreement[r]),
            self.modelled[r],
        )

    def __iter__(self) -> Iterator[Run]:
        """Each, in order."""
        return map(self.__getitem__, range(len(self)))

    def part(self, begin: int, end: int) -> RunBatch:
        """Some of them, one after another."""
        some, offsets = slice(begin, end), self.schedules.offsets
        return RunBatch(
            self.recordings[some],
            self.schedules.part(begin, end),
            self.table,
            self.row[offsets[begin] : offsets[end]],
            self.departures[some],
            self.disagreement[some],
            self.modelled[some],
            self.repetition[some],
            self.own[some],
        )

    def answering(self, which: Ints, boxes: Sequence[Floats]) -> RunBatch:
        """Some of them, perhaps one several times, with other boxes than theirs.

        Args:
            which: places of runs, int64 [R].
            boxes: of each the boxes, float64 [n, 4].
        """
        return RunBatch(
            tuple(self.recordings[r] for r in which.tolist()),
            Schedules.of([self.schedules[r] for r in which.tolist()]),
            table := np.concatenate(boxes),
            np.arange(len(table)),
            self.departures[which],
            self.disagreement[which],
            (None,) * len(which),
            self.repetition[which],
            np.zeros(len(which), np.bool_),
        )

    @classmethod
    def of(cls, runs: Sequence[Run]) -> RunBatch:
        """Some runs, at least one, as a batch."""
        return cls(
            tuple(run.recording for run in runs),
            Schedules.of([run.schedule for run in runs]),
            boxes := np.concatenate([run.boxes for run in runs]),
            np.arange(len(boxes)),
            np.array([run.departures for run in runs], np.int64),
            np.array([run.disagreement for run in runs]),
            tuple(run.modelled for run in runs),
            np.zeros(len(runs), np.int64),
            np.zeros(len(runs), np.bool_),
        )

    @classmethod
    def joined(cls, parts: Sequence[RunBatch]) -> RunBatch:
        """Several batches as one."""
        if len(parts) == 1:
            return parts[0]
        tables, which = distinct(part.table for part in parts)
        sizes = [len(table) for table in tables]
        begins = (np.cumsum(sizes) - sizes)[which].tolist()
        return cls(
            tuple(chain.from_iterable(part.recordings for part in parts)),
            Schedules.joined([part.schedules for part in parts]),
            np.concatenate(tables) if len(tables) > 1 else tables[0],
            np.concatenate([part.row + begin for part, begin in zip(parts, begins)]),
            np.concatenate([part.departures for part in parts]),
            np.concatenate([part.disagreement for part in parts]),
            tuple(chain.from_iterable(part.modelled for part in parts)),
            np.concatenate([part.repetition for part in parts]),
            np.concatenate([part.own for part in parts]),
        )

    @cached_property
    def boxes(self) -> Floats:
        """The box of each processed frame, float64 [n, 4]."""
        boxes: Floats = self.table.take(self.row, axis=0)
        return boxes

    @cached_property
    def distinct(self) -> tuple[list[Recording], Ints]:
        """The recordings, each once, and the place of each run's among them, int64 [R]."""
        return distinct(self.recordings)


def distinct(items: Iterable[Item]) -> tuple[list[Item], Ints]:
    """Objects, each once, in the order of their first places, and where each stands, int64 [n]."""
    items = list(items)
    names = list(map(id, items))
    found = dict(zip(names, items))
    places = dict(zip(found, range(len(found))))
    return list(found.values()), np.fromiter(map(places.__getitem__, names), np.int64, len(items))


@runtime_checkable
class Batched(Protocol):
    """Runs that come in batches, if one asks for that."""

    def batches(self) -> Iterator[RunBatch]:
        """All of them."""


def grouped(runs: Iterable[Run], frames: int) -> Iterator[RunBatch]:
    """Runs in groups of about so many world frames, as :func:`.recording.batched` counts them."""
    if isinstance(runs, Batched):
        return regrouped(runs.batches(), frames)
    return map(RunBatch.of, batched(runs, frames, BESIDE))


def regrouped(batches: Iterable[RunBatch], frames: int) -> Iterator[RunBatch]:
    """The same of runs in batches of any size."""
    parts: list[RunBatch] = []
    pending = 0
    for batch in batches:
        sizes = np.cumsum(batch.schedules.lengths + BESIDE)
        begin = before = 0
        while begin < len(batch):
            end = int(np.searchsorted(sizes, before + frames - pending)) + 1
            part = batch.part(begin, min(end, len(batch)))
            begin += len(part)
            parts.append(part)
            pending += int(sizes[begin - 1]) - before
            before = int(sizes[begin - 1])
            if pending >= frames:
                yield RunBatch.joined(parts)
                parts, pending = [], 0
    if parts:
        yield RunBatch.joined(parts)


@dataclass(frozen=True, eq=False)
class _Pass:
    """A recording, with the stride it has if it holds every frame."""

    recording: Recording
    stride: Fraction

    @cached_property
    def before(self) -> Ints:
        """The frame that each one followed when recorded, or would have, int64 [T]; 0: -1."""
        if self.stride > 1:
            return followed(self.stride, len(self.recording))
        processed = ~np.isnan(self.recording.boxes[:, 0])
        if processed.all():
            return np.arange(-1, len(processed) - 1)
        latest_one = np.maximum.accumulate(np.where(processed, np.arange(len(processed)), -1))
        return np.concatenate([[-1], latest_one[:-1]])


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

    @cached_property
    def own(self) -> _Pass:
        """Its own recording."""
        return _Pass(self.recording, self.stride)

    @cached_property
    def all_passes(self) -> list[_Pass]:
        """That and the other passes, by stride."""
        others = {stride: _Pass(recording, stride) for stride, recording in self.passes.items()}
        return sorted({self.stride: self.own, **others}.values(), key=lambda each: each.stride)

    def nearest(self, frames: Ints) -> _Pass:
        """The pass whose stride is nearest to the mean step of some processed frames."""
        step = Fraction(int(frames[-1]), max(len(frames) - 1, 1))
        return min(self.all_passes, key=lambda each: abs(each.stride - step))

    def disagreement(self, used: _Pass, frames: Ints, boxes: Floats, departures: int) -> float:
        """The share of frames where a pass beside the one that is used has another box."""
        parted = np.zeros(len(frames), bool)
        nearest = self.all_passes.index(used)
        for other in self.all_passes[max(nearest - 1, 0) : nearest + 2] if departures else ():
            parted |= iou(_boxes(other.recording, frames), boxes) < PARTED_IOU
        return float(parted.mean())

    def modelled(
        self, used: _Pass, frames: Ints, boxes: Floats, departures: int
    ) -> Outcomes | None:
        """What the search model makes of a run; None where it is off, or the replay exact."""
        if self.search is None or len(frames) == 1:
            return None
        if not departures and self.search.pre_forecaster is None:
            return None
        recorded_steps = frames - used.before.take(frames)
        farther = np.append(False, np.diff(frames) > recorded_steps[1:])
        recorded = [RecordedAnswers(boxes, farther)]
        if self.passes:
            passes = {each.stride: each.recording for each in self.all_passes}
            for other, weight in _beside(list(passes), frames).items():
                recorded += phase_answers(other, passes[other], frames, weight)
        sizes, times = self.image_sizes, None
        if not self.clock.is_even:
            times = [self.clock.frame_time(frame) for frame in frames.tolist()]
        return self.search.outcomes(self.recording, frames, recorded, sizes, times)


def _run(jobs: Sequence[_Job], schedules: Schedules, repetition: Ints) -> RunBatch:
    """The runs of some jobs, by their schedules."""
    ends = schedules.offsets[1:]
    of_run = [slice(*span) for span in pairwise(schedules.offsets.tolist())]
    used = [
        job.nearest(schedules.frames[calls]) if job.passes else job.own
        for job, calls in zip(jobs, of_run)
    ]
    tables, which = distinct(used)
    lengths = np.array([len(each.recording) for each in tables], np.int64)
    row: Ints = np.repeat((np.cumsum(lengths) - lengths)[which], np.diff(schedules.offsets))
    row += schedules.frames
    table = np.concatenate([each.recording.boxes for each in tables])
    absent = np.isnan(table[:, 0])
    if absent.any() and (absent := absent.take(row)).any():
        r = int(np.searchsorted(ends, absent.argmax(), "right"))
        _boxes(used[r].recording, schedules.frames[of_run[r]])
    departs = np.concatenate([each.before for each in tables]).take(row)
    departs[1:] -= schedules.frames[:-1]
    departs[schedules.offsets[:-1]] = 0
    departures = np.add.reduceat(departs != 0, schedules.offsets[:-1], dtype=np.int64)
    disagreement = np.full(len(jobs), np.nan)
    modelled: list[Outcomes | None] = [None] * len(jobs)
    for r, job in enumerate(jobs):
        if not job.passes and job.search is None:
            continue
        boxes = table.take(row[of_run[r]], axis=0)
        own = used[r], schedules.frames[of_run[r]], boxes, int(departures[r])
        if job.passes:
            disagreement[r] = job.disagreement(*own)
        modelled[r] = job.modelled(*own)
    return RunBatch(
        tuple(job.recording for job in jobs),
        schedules,
        table,
        row,
        departures,
        disagreement,
        tuple(modelled),
        repetition,
        np.array([each is job.own for each, job in zip(used, jobs)]),
    )


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
        pipeline: stages around the tracker, by whose queues it takes frames rather than by the
            policy; ``source`` is that of the tracker's times. None for the tracker alone.

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
    pipeline: PipelineTimes | None = None

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
        """Notes on a log's own schedule, and on when frames arrive, if the trace says so."""
        notes = []
        if is_log(self.times.metadata) and not isinstance(self.policy, AsRecorded):
            notes.append(
                "the times are those of a log, whose own schedule policy 'recorded' repeats"
            )
        if self.arrivals is None:
            return notes
        if self.forget_arrivals:
            return [*notes, "the trace's arrival times are forgotten: frames arrive evenly"]
        return [*notes, "frames arrive when the trace says that they did, not evenly"]

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
        return chain.from_iterable(self.batches())

    def batches(self) -> Iterator[RunBatch]:
        """The runs in batches, as many as are scheduled at once."""
        return (batch for _, batch in replay_together([self], _GROUP_FRAMES))

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

    def of_tracker(self, times: Recording) -> Recording:
        """The times that are the tracker's, if it is one of a pipeline's stages."""
        return times if self.pipeline is None else self.pipeline.of_tracker(times)

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
) -> Iterator[tuple[int, RunBatch]]:
    """The runs of some replays, one after another; those of the same rules are scheduled at once.

    Args:
        replays: any of them.
        frames: about how many world frames are in memory, and scheduled, at once.

    Yields:
        The place of a replay, and some of its runs.

    Raises:
        LaeError: as iterating over each of them.
    """

    def rules(placed: tuple[int, Runs]) -> tuple[Policy, PipelineTimes | None, Clock, bool]:
        runs = placed[1]
        return runs.policy, runs.pipeline, runs.clock, runs.arrivals == "recorded"

    for (policy, pipeline, *_), alike in groupby(enumerate(replays), rules):
        for places, jobs, services in _groups(alike, policy, frames):
            none = np.zeros(len(jobs), np.int64)
            for batch in _replayed(jobs, services, policy, none, pipeline):
                begin = 0
                for place, some in groupby(places[: len(batch)]):
                    end = begin + sum(1 for _ in some)
                    yield place, batch.part(begin, end)
                    begin = end
                del places[: len(batch)]


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
                service = runs.source(runs.of_tracker(job.times))
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
    for batch in Repetitions(runs, count, first).batches():
        yield from zip(batch.repetition.tolist(), batch)


@dataclass(frozen=True, eq=False)
class Repetitions:
    """The runs of :func:`replay_repeated`, for those who can do with many at once.

    Attributes:
        runs: of a trace with random times; the repetition of their source does not count.
        count: number of repetitions.
        first: the first repetition.
    """

    runs: Runs
    count: int
    first: int = 0

    def __iter__(self) -> Iterator[Run]:
        return chain.from_iterable(self.batches())

    def batches(self) -> Iterator[RunBatch]:
        """The runs in batches, as many as are scheduled at once.

        Raises:
            LaeError: as :func:`replay_repeated`.
        """
        source, first, count = self.runs.source, self.first, self.count
        if not isinstance(source, RandomSource):
            raise LaeError("only random times can be drawn again: bootstrap, resample or lognormal")
        for jobs in batched(self.runs._jobs(), _GROUP_FRAMES, BESIDE):
            size = max(_LANE_FRAMES // sum(map(len, jobs)), 1)
            for begin in range(first, first + count, size):
                some = range(begin, min(begin + size, first + count))
                recorded = [self.runs.of_tracker(job.times) for job in jobs]
                drawn = [source.repeated(each, begin, len(some)) for each in recorded]
                times = [
                    Times(job.recording.name, rows[k], by_call=True)
                    for k in range(len(some))
                    for job, rows in zip(jobs, drawn)
                ]
                repetition = np.repeat(np.array(some), len(jobs))
                yield from _replayed(
                    jobs * len(some), times, self.runs.policy, repetition, self.runs.pipeline
                )


def _replayed(
    jobs: Sequence[_Job],
    services: Sequence[Service],
    policy: Policy,
    repetition: Ints,
    pipeline: PipelineTimes | None = None,
) -> Iterator[RunBatch]:
    """The runs of some jobs, which have a service and a repetition each."""
    if pipeline is not None:
        for job, service, number in zip(jobs, services, repetition.tolist()):
            with explained(f"sequence {job.recording.name!r}: pipeline"):
                schedule = pipeline.schedule(job.times, job.clock, service, number)
            yield _run([job], Schedules.of([schedule]), np.array([number]))
        return
    clocks, lengths = [job.clock for job in jobs], [len(job) for job in jobs]
    if isinstance(policy, AsRecorded):
        schedules = _as_recorded(jobs, services, policy)
    else:
        schedules = simulate_many(lengths, clocks, services, policy)
    begin = 0
    while begin < len(jobs):
        with explained(f"sequence {jobs[begin].recording.name!r}: policy or latency"):
            some = next(schedules)
        those = slice(begin, begin + len(some))
        yield _run(jobs[those], some, repetition[those])
        begin += len(some)


def _as_recorded(
    jobs: Sequence[_Job], services: Sequence[Service], policy: Policy
) -> Iterator[Schedules]:
    """The schedules of sequences that have rules of their own, one by one."""
    for job, service in zip(jobs, services):
        yield Schedules.of([simulate(len(job), job.clock, service, _rule(policy, job))])


def _rule(policy: Policy, job: _Job) -> Policy:
    """The policy of one sequence."""
    return policy.of(job.times) if isinstance(policy, AsRecorded) else policy


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
