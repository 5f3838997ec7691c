"""The live service: a tracker run on real frames under the engine's clock.

The clock is virtual. What the tracker took, or what another device would have taken, becomes the
event's delay; nothing waits in real time. With a pre-forecaster the loop is closed: before each
frame the predicted box sets the tracker's search region (Li et al., "Predictive Visual Tracking",
2021, Alg. 1).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from time import perf_counter_ns
from typing import Any

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.boxes import resized, search_region
from lae_sim.datasets.frames import Image, ImageSequence
from lae_sim.engine.arrivals import with_arrivals
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import latest, listed
from lae_sim.engine.scheduler import Policy, Service, simulate
from lae_sim.errors import LaeError, explained
from lae_sim.forecast.base import AnyFactory, Forecaster, Resizable, factory_for
from lae_sim.profile.timed import Answer, TimedTracker
from lae_sim.replay.strides import phases
from lae_sim.trace.recording import Recording
from lae_sim.trackers.protocol import checked_frame


@dataclass(frozen=True, eq=False)
class LiveRun:
    """One sequence as a live tracker went through it.

    Attributes:
        recording: truth, boxes, times and scores, by world frame. Where the tracker found nothing,
            the box before stands.
        frames: processed frames, int64 [n], increasing.
        measured_ns: what this machine took for each, int64 [n]; not the recording's times if those
            are another device's.
        cpu_ns: CPU time of all calls together, ns.
        lost: processed frames where the tracker found nothing, int64 [k].
        image_sizes: width and height of the image of each, pixels, int64 [n, 2].
        spans_ns: when each call after the initialisation began and ended, by ``perf_counter_ns``,
            int64 [m, 2]: of a run in phases, more than the processed frames.
    """

    recording: Recording
    frames: Ints
    measured_ns: Ints
    cpu_ns: int
    lost: Ints
    image_sizes: Ints
    spans_ns: Ints


def run_real_time(
    sequence: ImageSequence,
    tracker: TimedTracker,
    clock: Clock,
    policy: Policy = latest,
    **options: Any,
) -> LiveRun:
    """Run a tracker through one sequence, skipping the frames that its busy times make it skip.

    Args:
        sequence: frames, and the truth, whose first box initialises the tracker.
        tracker: a tracker with a stopwatch.
        clock: the world's clock; the sequence's own arrival times count, where it has some.
        policy: which frame is next.
        options: see :class:`Live`.

    Raises:
        LaeError: if the first box or a frame cannot be used, or the tracker fails.
    """
    live = Live(sequence, tracker, clock=clock, **options)
    schedule = simulate(len(sequence), live.clock, live, policy)
    return live.result(schedule.frames)


def run_every_frame(
    sequence: ImageSequence,
    tracker: TimedTracker,
    stride: Fraction = Fraction(1),
    **options: Any,
) -> LiveRun:
    """Run a tracker on every frame; the world waits for it.

    Args:
        sequence, tracker, options: as of :func:`run_real_time`.
        stride: above 1, the tracker goes through the sequence in several phases, each of which
            skips frames, until every frame has been processed (see :mod:`lae_sim.replay.strides`).

    Raises:
        LaeError: as :func:`run_real_time`.
    """
    length = len(sequence)
    runs = []
    for frames in phases(Fraction(stride), length):
        live = Live(sequence, tracker, **options)

        def instantly(frame: int, process: Service = live) -> int:
            process(frame)
            return 0

        simulate(length, Clock.at(Fraction(1)), instantly, listed(frames.tolist()))
        runs.append(live.result(frames))
    whole, measured = runs[-1], np.zeros(length, np.int64)
    sizes = np.zeros((length, 2), np.int64)
    names = {name for run in runs for name in run.recording.stages}
    stages = {name: np.full(length, -1, np.int64) for name in names}
    for run in reversed(runs):  # of the phases that hold a frame, the first stands
        measured[run.frames], sizes[run.frames] = run.measured_ns, run.image_sizes
        for name in ("boxes", "elapsed_ns", "score"):
            getattr(whole.recording, name)[run.frames] = getattr(run.recording, name)[run.frames]
        for name, ns in stages.items():
            marked = run.recording.stages.get(name)
            ns[run.frames] = -1 if marked is None else marked[run.frames]
    return replace(
        whole,
        recording=replace(whole.recording, stages=stages),
        frames=np.arange(length),
        measured_ns=measured,
        cpu_ns=sum(run.cpu_ns for run in runs),
        lost=np.unique(np.concatenate([run.lost for run in runs])),
        image_sizes=sizes,
        spans_ns=np.concatenate([run.spans_ns for run in runs]),
    )


_EVEN = Clock.at(Fraction(1))


class Live:
    """The service that runs a tracker through one sequence, and keeps its answers."""

    def __init__(
        self,
        sequence: ImageSequence,
        tracker: TimedTracker,
        pre_forecaster: AnyFactory | None = None,
        keep_size: bool = False,
        service: Service | None = None,
        include_decode: bool = False,
        forecaster_ns: int | None = 0,
        progress: Callable[[int], object] = lambda frames: None,
        clock: Clock = _EVEN,
    ) -> None:
        """Check that the tracker can start.

        Args:
            sequence: frames and truth.
            tracker: a tracker with a stopwatch.
            pre_forecaster: sets the search region before each frame; needs a tracker that
                ``sets_search``.
            keep_size: search for the size last found at the predicted centre; otherwise for the
                predicted size, as in Alg. 1.
            service: times of another device, by frame, instead of the measured ones.
            include_decode: count the decoding of a frame as part of its processing.
            forecaster_ns: what the pre-forecaster adds to a frame's time, ns; None to measure it.
            progress: told how many more world frames are done, after each processed one.
            clock: the world's, by which a pre-forecaster counts time where frames have arrival
                times; of frames that arrive evenly it counts the numbers.

        Raises:
            LaeError: if the sequence has no first box, or the tracker's search cannot be set.
        """
        box = sequence.truth[0]
        if not (np.isfinite(box).all() and (box[2:] > 0).all()):
            raise LaeError(
                f"sequence {sequence.name!r}: its first box is {_text(box)}, and a tracker needs "
                "one with a width and a height"
            )
        if pre_forecaster is not None and not tracker.sets_search:
            raise LaeError("a pre-forecaster needs a tracker whose search can be set: translate it")
        self.clock = with_arrivals(clock, sequence.arrival_ns)
        self._sequence = sequence
        self._tracker = tracker
        self._pre_forecaster = pre_forecaster
        self._keep_size = keep_size
        self._last_box: Sequence[float] = box.tolist()
        self._forecaster: Forecaster | None = None
        self._service = service
        self._include_decode = include_decode
        self._forecaster_ns = forecaster_ns
        self._forecasting_ns = 0
        self._progress = progress
        self._last = -1
        self._sizes: list[tuple[int, int]] = []
        self._answers: list[Answer] = []
        self._elapsed_ns: list[int] = []
        self._stages: list[Mapping[str, int]] = []
        self._spans_ns: list[tuple[int, int]] = []

    def __call__(self, frame: int) -> int:
        """Process a frame; the time it took, ns."""
        before = perf_counter_ns()
        image = self._sequence.read(frame)
        read = perf_counter_ns()
        decoding = read - before
        try:
            self._check(frame, image)
            answer = self._init(image) if frame == 0 else self._track(frame, image)
        except LaeError as error:
            name = self._sequence.name
            raise type(error)(f"sequence {name!r}, frame {frame}: {error}") from error
        if frame:
            self._spans_ns.append((read, perf_counter_ns()))
        self._answers.append(answer)
        self._progress(frame - self._last)
        self._last = frame
        elapsed_ns, stages = answer.elapsed_ns, Counter(answer.stages)
        if self._include_decode:
            elapsed_ns += decoding
            stages["decode"] += decoding
        if self._service:  # of whose times nothing is known but the sum
            elapsed_ns, stages = self._service(frame), Counter()
        elapsed_ns += self._forecasting_ns
        self._elapsed_ns.append(elapsed_ns)
        self._stages.append(stages)
        return elapsed_ns

    def _init(self, image: Image) -> Answer:
        box = self._sequence.truth[0].tolist()
        if self._pre_forecaster is not None:
            with explained("the pre-forecaster"):
                factory = factory_for(self._pre_forecaster, self._sequence)
                self._forecaster = factory(box, self._sizes[-1])
        return self._tracker.init(image, box)

    def _track(self, frame: int, image: Image) -> Answer:
        if self._forecaster is None:
            return self._tracker.track(image)
        with explained("the pre-forecaster"):
            if self._sizes[-1] != self._sizes[-2] and isinstance(self._forecaster, Resizable):
                self._forecaster.resize(self._sizes[-1])
            before = perf_counter_ns()
            predicted = self._forecaster.predict(self.clock.frame_time(frame))
            spent = perf_counter_ns() - before
            if self._keep_size:
                predicted = resized(predicted, self._last_box)
            search = search_region(predicted, self._sizes[-1])
        answer = self._tracker.track(image, search)
        if answer.box is not None:
            self._last_box = answer.box
            with explained("the pre-forecaster"):
                before = perf_counter_ns()
                self._forecaster.update(self.clock.frame_time(frame), answer.box)
                spent += perf_counter_ns() - before
        self._forecasting_ns = spent if self._forecaster_ns is None else self._forecaster_ns
        return answer

    def _check(self, frame: int, image: Image) -> None:
        checked_frame(image)
        size = image.shape[1], image.shape[0]
        self._sizes.append(size)
        if frame == 0:
            x, y, w, h = self._sequence.truth[0]
            if x >= size[0] or y >= size[1] or x + w <= 0 or y + h <= 0:
                raise LaeError(
                    f"the first box {_text(self._sequence.truth[0])} lies outside the "
                    f"{size[0]}x{size[1]} image"
                )

    def result(self, frames: Ints) -> LiveRun:
        """What was done, given the frames that were processed."""
        length = len(self._sequence)
        boxes, elapsed = np.full((length, 4), np.nan), np.full(length, -1, np.int64)
        scores = np.full(length, np.nan, np.float32)
        held: list[Sequence[float]] = []  # where nothing was found, the box before stands
        for answer in self._answers:
            held.append(held[-1] if answer.box is None else answer.box)
        boxes[frames] = held
        elapsed[frames] = self._elapsed_ns
        scores[frames] = [np.nan if a.score is None else a.score for a in self._answers]
        stages = {name: np.full(length, -1, np.int64) for each in self._stages for name in each}
        for name, ns in stages.items():
            ns[frames] = [each.get(name, -1) for each in self._stages]
        return LiveRun(
            Recording.new(
                self._sequence.name,
                self._sequence.truth,
                boxes,
                elapsed,
                scores,
                self._sequence.arrival_ns,
                self._sequence.visible,
                stages,
            ),
            frames,
            np.array([answer.elapsed_ns for answer in self._answers], np.int64),
            sum(answer.cpu_ns for answer in self._answers),
            frames[[answer.box is None for answer in self._answers]],
            np.array(self._sizes, np.int64),
            np.array(self._spans_ns, np.int64).reshape(-1, 2),
        )


def _text(box: Sequence[float] | Floats) -> str:
    return ", ".join(f"{value:g}" for value in box)
