"""The live service: what a tracker is given, and that a replay repeats what it did."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import numpy as np
import pytest
from fakes import FakeTimed, bright_frame, bright_sequence
from hypothesis import given
from hypothesis import strategies as st
from witness import same

from lae_sim.boxes import search_region
from lae_sim.datasets.frames import ImageSequence
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, fifo, latest, listed, shrinking_tail, vot_realtime
from lae_sim.engine.scheduler import Policy, simulate
from lae_sim.errors import LaeError
from lae_sim.forecast.base import ConstantVelocity, Oracle
from lae_sim.forecast.filters import GH
from lae_sim.forecast.kalman import Kalman, KalmanLaePvt
from lae_sim.forecast.window import LeastSquares, Windowed
from lae_sim.profile.live import LiveRun, run_every_frame, run_real_time
from lae_sim.profile.timed import Answer, TrackerError
from lae_sim.replay.latency import constant
from lae_sim.replay.run import Run, replay_sequence
from lae_sim.replay.world import replay_trace
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

CLOCK = Clock.at(Fraction(30))
FRAME_NS = 33_333_334  # a little more than an interval at 30 fps
PATH = [(5.0 + 2 * i, 8.0 + i) for i in range(30)]


def stored(run: LiveRun, policy: Policy, kind: str, fps: Fraction = Fraction(30)) -> Run:
    """The run written to a trace, read again and replayed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.parquet"
        metadata = Metadata.new(str(fps), kind, timing={"clock": "made up"})
        write_trace(Trace(metadata, [run.recording]), path)
        (found,) = replay_trace(read_trace(path), policy=policy)
    return found


def assert_equal(found: Run, run: LiveRun) -> None:
    """The same to the bit."""
    assert found.departures == 0
    np.testing.assert_array_equal(found.schedule.frames, run.frames)
    np.testing.assert_array_equal(found.schedule.elapsed_ns, run.recording.elapsed_ns[run.frames])
    assert same(found.recording, run.recording)
    np.testing.assert_array_equal(found.boxes, run.recording.boxes[run.frames])


POLICIES = st.one_of(
    st.sampled_from([latest, fifo, vot_realtime(), vot_realtime(0)]),
    st.integers(1, 5).map(every),
    st.integers(0, 4 * FRAME_NS).map(lambda ns: shrinking_tail(ns=ns)),
)


STAGES = st.lists(
    st.dictionaries(
        st.sampled_from(["preprocess", "inference", "learn"]),
        st.fractions(0, Fraction(1, 3), max_denominator=9),
    ),
    min_size=1,
    max_size=4,
)
"""Shares of the calls' times that are stages'."""


@given(
    times=st.lists(st.integers(1, 5 * FRAME_NS), min_size=1, max_size=9),
    policy=POLICIES,
    fps=st.sampled_from([Fraction(30), Fraction(30000, 1001), Fraction(7)]),
    pre_forecaster=st.sampled_from([None, Kalman, ConstantVelocity]),
    stages=STAGES,
)
def test_a_replay_equals_the_profile_to_the_bit(
    times: list[int],
    policy: Policy,
    fps: Fraction,
    pre_forecaster: type | None,
    stages: list[dict[str, Fraction]],
) -> None:
    run = run_real_time(
        bright_sequence(PATH),
        FakeTimed(times, stages=stages),
        Clock.at(fps),
        policy,
        pre_forecaster=pre_forecaster,
    )
    kind = "every-frame" if len(run.frames) == len(PATH) else "real-time"
    assert_equal(stored(run, policy, kind, fps), run)


@given(
    times=st.lists(st.integers(0, 3 * FRAME_NS), min_size=1, max_size=9),
    stride=st.integers(1, 6),
    stages=STAGES,
)
def test_a_strided_pass_sees_each_frame_after_the_one_a_stride_before(
    times: list[int], stride: int, stages: list[dict[str, Fraction]]
) -> None:
    sequence = bright_sequence(PATH)
    strided = run_every_frame(sequence, FakeTimed(times, stages=stages), Fraction(stride))
    assert not np.isnan(strided.recording.boxes).any()
    assert (strided.recording.elapsed_ns >= 0).all()
    for first in range(1, stride + 1):
        slow_world = Clock.at(Fraction(1, 9))
        alone = run_real_time(
            sequence,
            FakeTimed(times, stages=stages),
            slow_world,
            listed([0, *range(first, len(PATH), stride)]),
        )
        frames = alone.frames
        for name, ns in strided.recording.stages.items():
            known = alone.recording.stages.get(name, np.full(len(PATH), -1))
            np.testing.assert_array_equal(ns[frames[1:]], known[frames[1:]])
        assert alone.recording.stages.keys() <= strided.recording.stages.keys()
        np.testing.assert_array_equal(
            strided.recording.boxes[frames], alone.recording.boxes[frames]
        )
        np.testing.assert_array_equal(strided.measured_ns[frames[1:]], alone.measured_ns[1:])


def test_a_stride_longer_than_the_sequence() -> None:
    run = run_every_frame(bright_sequence(PATH[:3]), FakeTimed(), Fraction(9))
    assert not np.isnan(run.recording.boxes).any()
    one = run_every_frame(bright_sequence(PATH[:1]), FakeTimed(), Fraction(2))
    assert one.frames.tolist() == [0]


def test_a_busy_tracker_skips_frames_by_its_own_times() -> None:
    run = run_real_time(bright_sequence(PATH), FakeTimed([100_000_000]), CLOCK, latest)
    assert run.frames.tolist() == list(range(0, 30, 3))
    assert run.measured_ns.tolist() == [100_000_000] * 10
    assert run.image_sizes.tolist() == [[96, 64]] * 10


def test_another_devices_times_drive_the_schedule_and_fill_the_trace() -> None:
    run = run_real_time(
        bright_sequence(PATH), FakeTimed([7]), CLOCK, latest, service=lambda frame: 100_000_000
    )
    assert run.frames.tolist() == list(range(0, 30, 3))
    assert set(run.recording.elapsed_ns[run.frames].tolist()) == {100_000_000}
    assert set(run.measured_ns.tolist()) == {7}


def test_of_another_devices_times_no_parts_are_known() -> None:
    staged = FakeTimed([9], stages=[{"inference": Fraction(1, 3)}])
    for service, expected in ((None, {"inference", "decode"}), (lambda frame: 100_000_000, set())):
        run = run_real_time(
            bright_sequence(PATH), staged, CLOCK, latest, service=service, include_decode=True
        )
        assert run.recording.stages.keys() == expected


def test_the_pre_forecaster_sets_the_search_before_each_frame() -> None:
    """Alg. 1: predict at the frame to be processed, from the boxes of those before it."""
    tracker = FakeTimed([100_000_000], reach=1.0)
    run = run_real_time(bright_sequence(PATH), tracker, CLOCK, latest, pre_forecaster=Kalman)
    filtered = Kalman(PATH[0] + (12, 10))
    for frame, search in zip(run.frames[1:].tolist(), tracker.searches):
        predicted = filtered.predict(frame)
        assert search == pytest.approx(search_region(predicted, (96, 64)), abs=1e-12)
        if frame not in run.lost:
            filtered.update(frame, run.recording.boxes[frame].tolist())


SMALL_FROM = 14


def shrinking(path: Sequence[tuple[float, float]]) -> ImageSequence:
    """A sequence whose images are smaller from a frame on; the target goes on there."""

    def read(frame: int) -> np.ndarray:
        size = (96, 64) if frame < SMALL_FROM else (52, 40)
        return bright_frame(*path[frame], size=size)

    return ImageSequence("shrinking", bright_sequence(path).truth, read)


def test_images_that_change_size_are_followed() -> None:
    tracker = FakeTimed([70_000_000])
    run = run_real_time(shrinking(PATH), tracker, CLOCK, latest, pre_forecaster=KalmanLaePvt)
    small = run.frames >= SMALL_FROM
    assert 0 < small.sum() < len(small)
    assert run.image_sizes.tolist() == [[52, 40] if s else [96, 64] for s in small]
    assert len(tracker.frames) == len(run.frames) - 1
    filtered = KalmanLaePvt(PATH[0] + (12, 10), (96, 64))
    clipped = 0
    for frame, search in zip(run.frames[1:].tolist(), tracker.searches):
        size = (52, 40) if frame >= SMALL_FROM else (96, 64)
        filtered.resize(size)
        predicted = filtered.predict(frame)
        clipped += predicted[0] + predicted[2] == size[0]
        assert search == pytest.approx(search_region(predicted, size), abs=1e-12)
        if frame not in run.lost:
            filtered.update(frame, run.recording.boxes[frame].tolist())
    assert clipped


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_sizes_of_every_frame_at_any_stride(stride: int) -> None:
    run = run_every_frame(shrinking(PATH), FakeTimed(), Fraction(stride))
    expected = [[96, 64]] * SMALL_FROM + [[52, 40]] * (len(PATH) - SMALL_FROM)
    assert run.image_sizes.tolist() == expected


def test_the_size_of_the_search_may_be_left_to_the_tracker() -> None:
    class Growing(ConstantVelocity):
        def predict(self, frame: int) -> list[float]:
            x, y, w, h = super().predict(frame)
            return [x, y, 2 * w, 4 * h]

    for keep, size in ((False, (24, 40)), (True, (12, 10))):
        tracker = FakeTimed()
        options = {"pre_forecaster": Growing, "keep_size": keep}
        run_real_time(bright_sequence(PATH[:3]), tracker, CLOCK, latest, **options)
        first = tracker.searches[0]
        assert first is not None
        assert first == [PATH[0][0] + 12, PATH[0][1] + 20, *size]


def test_the_closed_loop_finds_what_the_plain_loop_loses() -> None:
    path = [(2.0 + 3 * i, 8.0) for i in range(27)]
    sequence, reach = bright_sequence(path), 7.0  # the target moves 9 pixels in 3 frames
    frames = slice(0, None, 3)
    slow = [20_000_000] * 4 + [100_000_000] * 40  # fast at first, so that the motion is learnt
    plain = run_real_time(sequence, FakeTimed(slow, reach), CLOCK, latest)
    closed = run_real_time(
        sequence, FakeTimed(slow, reach), CLOCK, latest, pre_forecaster=ConstantVelocity
    )
    assert len(plain.lost) > 3
    assert len(closed.lost) == 0
    last = closed.frames[-1]
    assert closed.recording.boxes[last].tolist() == sequence.truth[last].tolist()
    assert plain.recording.boxes[frames].shape == closed.recording.boxes[frames].shape


def test_where_nothing_is_found_the_box_before_stands() -> None:
    path = [*PATH[:4], (-50.0, -50.0), (-50.0, -50.0), *PATH[6:9]]
    run = run_real_time(bright_sequence(path), FakeTimed(), CLOCK)
    assert run.lost.tolist() == [4, 5]
    np.testing.assert_array_equal(run.recording.boxes[5], run.recording.boxes[3])
    assert np.isnan(run.recording.score[[0, 4, 5]]).all()
    assert run.recording.score[3] == np.float32(0.75)


def test_progress_adds_up() -> None:
    told: list[int] = []
    run_real_time(
        bright_sequence(PATH), FakeTimed([100_000_000]), CLOCK, latest, progress=told.append
    )
    assert told == [1] + [3] * 9


def test_decoding_counts_if_asked_for() -> None:
    sequence = bright_sequence(PATH)
    run = run_real_time(sequence, FakeTimed([5]), CLOCK, include_decode=True)
    assert (run.recording.elapsed_ns > 5).all()
    assert set(run.measured_ns.tolist()) == {5}
    assert (run.recording.stages["decode"] == run.recording.elapsed_ns - 5).all()


def test_what_a_tracker_decodes_itself_is_decoding_too() -> None:
    staged = FakeTimed([9], stages=[{"decode": Fraction(1, 3)}])
    run = run_real_time(bright_sequence(PATH), staged, CLOCK, include_decode=True)
    assert (run.recording.stages["decode"] == run.recording.elapsed_ns - 9 + 3).all()
    alone = run_real_time(bright_sequence(PATH), staged, CLOCK)
    assert set(alone.recording.stages["decode"].tolist()) == {3}


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ([np.nan] * 4, "first box"),
        ([5, 5, 0, 0], "width and a height"),
        ([5, 5, 3, 0], "width and a height"),
        ([96, 5, 3, 3], "outside the 96x64 image"),
        ([-9, 5, 9, 3], "outside the 96x64 image"),
    ],
)
def test_a_first_box_that_cannot_be_used(box: list[float], message: str) -> None:
    truth = np.array([box] * 3, np.float64)
    sequence = ImageSequence("odd", truth, lambda frame: bright_frame(5, 5))
    with pytest.raises(LaeError, match=message):
        run_real_time(sequence, FakeTimed(), CLOCK)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (np.zeros((64, 96), np.uint8), "uint8"),
        (np.zeros((64, 96, 3), np.uint16), "uint16"),
        (np.zeros((64, 96, 4), np.uint8), r"\[64, 96, 4\]"),
    ],
)
def test_a_frame_that_cannot_be_used(frame: np.ndarray, message: str) -> None:
    sequence = ImageSequence(
        "odd",
        np.array([[5, 5, 9, 9]] * 5, np.float64),
        lambda i: frame if i == 3 else bright_frame(5, 5),
    )
    with pytest.raises(LaeError, match=f"'odd', frame 3.*{message}"):
        run_real_time(sequence, FakeTimed(), CLOCK)


def test_a_failing_tracker_is_not_hidden() -> None:
    class Failing(FakeTimed):
        def track(self, frame: np.ndarray, search: object = None) -> Answer:
            raise TrackerError("no")

    with pytest.raises(TrackerError, match="no"):
        run_real_time(bright_sequence(PATH), Failing(), CLOCK)


def test_a_pre_forecaster_needs_search_control() -> None:
    with pytest.raises(LaeError, match="translate"):
        run_real_time(
            bright_sequence(PATH),
            FakeTimed(sets_search=False),
            CLOCK,
            latest,
            pre_forecaster=Kalman,
        )


@pytest.mark.parametrize(
    ("call", "answer", "message"),
    [
        ("predict", [np.nan] * 4, "'bright', frame 2: the pre-forecaster predicted nan"),
        ("predict", [1, 2, 3], "frame 2: the pre-forecaster: ValueError"),
        ("predict", None, "frame 2: the pre-forecaster: TypeError"),
        ("predict", ValueError("no\nidea"), r"frame 2: the pre-forecaster: ValueError: no idea \("),
        ("update", KeyError("u"), "frame 2: the pre-forecaster: KeyError"),
        ("__init__", RuntimeError("r"), "frame 0: the pre-forecaster: RuntimeError"),
    ],
)
def test_a_pre_forecaster_that_fails(call: str, answer: object, message: str) -> None:
    class Failing(ConstantVelocity):
        pass

    def fail(self: object, *arguments: object) -> object:
        if arguments[0] == 1:
            return getattr(ConstantVelocity, call)(self, *arguments)
        if isinstance(answer, Exception):
            raise answer
        return answer

    setattr(Failing, call, fail)
    with pytest.raises(LaeError, match=message):
        run_every_frame(bright_sequence(PATH), FakeTimed(), pre_forecaster=Failing)


@pytest.mark.parametrize("cost", [0, 1, 300_000, 50_000_000])
def test_what_a_pre_forecaster_is_declared_to_cost_is_added_to_all_frames_but_the_first(
    cost: int,
) -> None:
    def busy(frame: int) -> int:
        return FRAME_NS - 2 + (cost if frame else 0)

    expected = simulate(30, CLOCK, busy, latest)
    options: dict[str, Any] = {"pre_forecaster": Kalman, "forecaster_ns": cost}
    run = run_real_time(bright_sequence(PATH), FakeTimed([FRAME_NS - 2]), CLOCK, **options)
    assert run.frames.tolist() == expected.frames.tolist()
    assert run.recording.elapsed_ns[run.frames].tolist() == expected.elapsed_ns.tolist()
    assert set(run.measured_ns.tolist()) == {FRAME_NS - 2}
    assert (len(run.frames) < 30) == (cost > 1_000_000)
    assert_equal(stored(run, latest, "real-time" if cost > 1_000_000 else "every-frame"), run)
    times = run_every_frame(
        bright_sequence(PATH), FakeTimed(), service=lambda frame: 7, **options
    ).recording.elapsed_ns
    assert times.tolist() == [7] + [7 + cost] * 29
    del options["pre_forecaster"]  # then there is nothing to pay
    run = run_real_time(bright_sequence(PATH), FakeTimed([FRAME_NS - 2]), CLOCK, **options)
    assert run.recording.elapsed_ns.tolist() == [FRAME_NS - 2] * 30


def test_what_a_pre_forecaster_costs_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each prediction and each update is timed; where nothing is found there is no update."""
    path = [*PATH[:4], (-50.0, -50.0), *PATH[5:9]]
    now = iter(range(0, 10**12, 7_000))
    monkeypatch.setattr("lae_sim.profile.live.perf_counter_ns", lambda: next(now))
    run = run_every_frame(
        bright_sequence(path), FakeTimed([5]), pre_forecaster=Kalman, forecaster_ns=None
    )
    assert run.lost.tolist() == [4]
    expected = [5] + [5 + 14_000] * 8
    expected[4] = 5 + 7_000
    assert run.recording.elapsed_ns.tolist() == expected
    assert set(run.measured_ns.tolist()) == {5}


def test_a_measured_cost_moves_the_schedule() -> None:
    class Slow(ConstantVelocity):
        def predict(self, frame: int) -> Sequence[float]:
            end = perf_counter_ns() + 5_000_000
            while perf_counter_ns() < end:
                pass
            return super().predict(frame)

    options = {"pre_forecaster": Slow, "service": lambda frame: 33_000_000}
    for forecaster_ns, skips in ((0, False), (None, True)):
        run = run_real_time(
            bright_sequence(PATH), FakeTimed(), CLOCK, forecaster_ns=forecaster_ns, **options
        )
        assert (len(run.frames) < 30) == skips
        assert (run.recording.elapsed_ns[run.frames[1:]] > 38_000_000).all() == skips


@pytest.mark.parametrize("factory", [Oracle, GH(), Windowed(LeastSquares())], ids=str)
def test_any_forecaster_may_be_the_pre_forecaster_and_is_new_in_each_pass(factory: Any) -> None:
    tracker = FakeTimed(reach=3.0)
    closed = run_every_frame(bright_sequence(PATH), tracker, pre_forecaster=factory)
    assert closed.lost.tolist() == []
    again = run_every_frame(bright_sequence(PATH), tracker, pre_forecaster=factory)
    np.testing.assert_array_equal(again.recording.boxes, closed.recording.boxes)
    if factory is Oracle:
        truth = bright_sequence(PATH).truth[1:]
        searches = [search_region(box, (96, 64)) for box in truth]
        np.testing.assert_array_equal(tracker.searches, searches * 2)


def test_a_search_stays_within_the_image() -> None:
    assert search_region([10, 20, 4, 6], (96, 64)) == [12, 23, 4, 6]
    assert search_region([-50, 100, -3, 5000], (96, 64)) == [0, 64, 1, 64]
    assert search_region([1e200, 0, 1, 1e200], (96, 64)) == [96, 64, 1, 64]
    for box, size in (([np.nan, 0, 1, 1], (96, 64)), ([1e200, 0, 1, 1], None)):
        with pytest.raises(LaeError, match="pre-forecaster"):
            search_region(box, size)


@given(stride=st.sampled_from([2, 3]), at=st.integers(1, 3))
def test_strided_passes_make_a_replay_at_their_stride_exact(stride: int, at: int) -> None:
    """A tracker that always takes the stride, and starts in any of its phases, is repeated."""
    sequence = bright_sequence(PATH)
    times = [min(at, stride) * FRAME_NS] + [stride * FRAME_NS] * 40
    closed = run_real_time(sequence, FakeTimed(times), CLOCK, latest)
    kind = Metadata.new("30", "every-frame")
    whole = Trace(kind, [run_every_frame(sequence, FakeTimed()).recording])
    strided = [
        Trace(
            Metadata.new("30", "every-frame", schedule={"stride": str(k)}),
            [run_every_frame(sequence, FakeTimed(), Fraction(k)).recording],
        )
        for k in (2, 3)
    ]
    timing = Trace(Metadata.new("30", "real-time"), [closed.recording])
    (bare,) = replay_trace(whole, timing=timing)
    (found,) = replay_trace(whole, timing=timing, passes=strided)
    np.testing.assert_array_equal(found.schedule.frames, closed.frames)
    np.testing.assert_array_equal(found.boxes, closed.recording.boxes[closed.frames])
    assert found.departures == 0 < bare.departures
    assert found.disagreement == 0
    assert np.isnan(bare.disagreement)
    (itself,) = replay_trace(strided[stride - 2], timing=timing)
    np.testing.assert_array_equal(itself.boxes, found.boxes)
    assert itself.departures == 0


def test_each_stride_once() -> None:
    recording = Recording.new("a", [[1, 1, 1, 1]], [[1, 1, 1, 1]], [1])
    trace = Trace(Metadata.new("30", "every-frame"), [recording])
    with pytest.raises(LaeError, match="stride"):
        list(replay_trace(trace, passes=[trace]))


def test_passes_that_part_are_told() -> None:
    """Steps of 1 and 2 by turns are nearest to 3/2, whose pass parts from that of 2 at frame 8."""
    near, far = [[1.0, 1, 9, 9]] * 16, [[1.0, 1, 9, 9]] * 8 + [[50.0, 1, 9, 9]] * 8
    elapsed = [50_000_000] * 16
    every, half = (Recording.new("a", near, boxes, elapsed) for boxes in (near, far))
    run = replay_sequence(every, CLOCK, strided={Fraction(3, 2): every, Fraction(2): half})
    frames = run.schedule.frames
    assert frames.tolist() == [0, 1, 3, 4, 6, 7, 9, 10, 12, 13, 15]
    np.testing.assert_array_equal(run.boxes, np.array(near)[frames])
    assert run.departures == 0  # these are the frames of its first phase
    assert run.disagreement == 0
    run = replay_sequence(every, CLOCK, strided={Fraction(2): half})
    np.testing.assert_array_equal(run.boxes, np.array(near)[frames])  # 15/10 is halfway: the lower
    assert run.departures == 5
    assert run.disagreement == pytest.approx(5 / 11)
    run = replay_sequence(every, CLOCK, constant(ns=70_000_000), strided={Fraction(2): half})
    np.testing.assert_array_equal(run.boxes, np.array(far)[run.schedule.frames])
    assert run.recording is every  # what is scored offline
