"""The search model against plain loops, and against a tracker that obeys it by construction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import DenseKalman

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import latest
from lae_sim.engine.scheduler import simulate
from lae_sim.errors import LaeError
from lae_sim.forecast.base import ConstantVelocity
from lae_sim.forecast.kalman import Kalman
from lae_sim.replay.latency import constant
from lae_sim.replay.reach import OwnJump, Reach
from lae_sim.replay.run import Runs, replay_sequence
from lae_sim.replay.search import (
    RecordedAnswers,
    SearchModel,
    find_search,
    parse_search,
    phase_answers,
)
from lae_sim.replay.strides import phases
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import ImageSizes, Metadata
from lae_sim.trace.recording import Recording

CLOCK = Clock.at(Fraction(30))
EVERY = Metadata.new("30", "every-frame")


def near(box, search, c):
    """Whether a box is in reach, in plain arithmetic."""
    x, y, w, h = search
    side = np.sqrt((w + (w + h) / 2) * (h + (w + h) / 2))
    dx, dy = box[0] + box[2] / 2 - x - w / 2, box[1] + box[3] / 2 - y - h / 2
    return max(abs(dx), abs(dy)) < c * side or c == inf


def plain(frames, boxes, c):
    """DESIGN 9 for a trace of every frame, as a loop."""
    answers, lost = [boxes[0]], False
    for k in range(1, len(frames)):
        if lost or frames[k] - frames[k - 1] > 1:
            lost = not near(boxes[k], answers[-1], c)
        answers.append(answers[-1] if lost else boxes[k])
    return np.array(answers)


def plain_forecast(frames, boxes, c, keep_size):
    """The same where the paper's filter says where to search."""
    answers, filtered = [boxes[0]], DenseKalman(boxes[0])
    for frame, box in zip(frames[1:], boxes[1:]):
        x, y, w, h = np.asarray(filtered.predict(int(frame)))[:4]
        if keep_size:
            w_last, h_last = answers[-1][2:]
            x, y, w, h = x + (w - w_last) / 2, y + (h - h_last) / 2, w_last, h_last
        at = (x + w / 2, y + h / 2)
        w, h = max(w, 1.0), max(h, 1.0)  # a search region has a size
        x, y = at[0] - w / 2, at[1] - h / 2
        answers.append(box if near(box, (x, y, w, h), c) else np.array([x, y, w, h]))
        filtered.update(int(frame), answers[-1])
    return np.array(answers)


@st.composite
def walks(draw, longest=40):
    """A recording of every frame, whose target sometimes leaps, and frames that are processed."""
    seed = draw(st.integers(0, 2**32 - 1))
    random = np.random.default_rng(seed)
    length = draw(st.integers(1, longest))
    steps = random.normal(0, draw(st.sampled_from([2.0, 15.0, 60.0])), (length, 2))
    sizes = np.exp(random.normal(3, 0.3, (length, 2)))
    boxes = np.hstack([300 + np.cumsum(steps, axis=0), sizes])
    gaps = 1 + random.integers(0, draw(st.integers(1, 8)), length)
    frames = np.append(0, np.cumsum(gaps))
    return Recording.new("a", boxes, boxes, np.full(length, 10**6)), frames[frames < length]


def model(*reaches, known=True, **settings):
    return SearchModel(np.array(reaches, float), known, "a test", **settings)


def recorded(recording, frames):
    farther = np.diff(frames, prepend=0) > 1
    return [RecordedAnswers(recording.boxes[frames], farther)]


REACHES = st.lists(st.one_of(st.floats(0, 4), st.just(inf)), min_size=1, max_size=8)


@settings(max_examples=300, deadline=None)
@given(walks(), REACHES)
def test_all_reaches_at_once_are_the_plain_loop_of_each(walk, reaches):
    recording, frames = walk
    reaches = sorted(reaches)
    found = model(*reaches).outcomes(recording, frames, recorded(recording, frames))
    assert found.weights.sum() == pytest.approx(1)
    assert len({boxes.tobytes() for boxes in found.boxes}) == len(found.boxes)
    expected = [plain(frames, recording.boxes[frames], c).tobytes() for c in reaches]
    shares = {boxes.tobytes(): w for boxes, w in zip(found.boxes, found.weights[0])}
    assert set(shares) == set(expected)
    for boxes, share in shares.items():
        assert share == pytest.approx(expected.count(boxes) / len(reaches))


@settings(max_examples=60, deadline=None)
@given(walks(25), st.floats(0, 3), st.booleans())
def test_a_pre_forecaster_says_where_to_search(walk, c, keep_size):
    recording, frames = walk
    ahead = model(c, pre_forecaster=Kalman, keep_size=keep_size)
    found = ahead.outcomes(recording, frames, recorded(recording, frames))
    expected = plain_forecast(frames, recording.boxes[frames], c, keep_size)
    np.testing.assert_allclose(found.boxes[0], expected, rtol=1e-9, atol=1e-9)


def test_search_regions_follow_images_that_change_size():
    boxes = np.column_stack([100 + 8.0 * np.arange(20), *np.full((3, 20), 40.0)])
    recording, frames = Recording.new("a", boxes, boxes, np.full(20, 10**6)), np.arange(0, 20, 2)
    ahead = model(0, pre_forecaster=ConstantVelocity)  # never found: it answers where it searches
    sizes = ImageSizes((0, 8), ((640, 360), (90, 50)))
    (free,) = ahead.outcomes(recording, frames, recorded(recording, frames)).boxes
    (found,) = ahead.outcomes(recording, frames, recorded(recording, frames), sizes).boxes
    small = frames >= 8
    assert free.tolist() == [[100, 40, 40, 40]] * 10
    assert found[~small].tolist() == free[~small].tolist()
    assert found[small][0].tolist() == [70, 30, 40, 40]  # the centre at the new image's corner
    run = replay_sequence(recording, CLOCK, constant(ns=47_000_000), search=ahead, image_size=sizes)
    first_small = int(np.argmax(run.schedule.frames >= 8))
    assert run.modelled.likeliest[first_small - 1].tolist() == [100, 40, 40, 40]
    assert run.modelled.likeliest[first_small].tolist() == [70, 30, 40, 40]


def test_a_pre_forecaster_that_fails_is_named():
    def broken(box, image_size):
        raise ZeroDivisionError("no motion")

    recording, frames = straight(), np.array([0, 2])
    with pytest.raises(LaeError, match="the pre-forecaster: ZeroDivisionError: no motion"):
        model(1, pre_forecaster=broken).outcomes(recording, frames, recorded(recording, frames))


@settings(max_examples=100, deadline=None)
@given(walks())
def test_the_ends_of_what_a_reach_can_be(walk):
    recording, frames = walk
    boxes = recording.boxes[frames]
    everywhere, nowhere = (
        model(c).outcomes(recording, frames, recorded(recording, frames)) for c in (inf, 0)
    )
    assert np.array_equal(everywhere.boxes[0], boxes)
    assert everywhere.lost_share[0] == 0
    jumps = np.flatnonzero(np.diff(frames) > 1) + 1
    last = int(jumps[0]) - 1 if len(jumps) else len(frames) - 1
    for_ever = np.minimum(np.arange(len(frames)), last)
    assert np.array_equal(nowhere.boxes[0], boxes[for_ever])


@settings(max_examples=100, deadline=None)
@given(walks(), st.floats(0, 3))
def test_the_truth_has_no_say(walk, c):
    recording, frames = walk
    blind = replace(recording, truth=np.full_like(recording.truth, np.nan))
    jumps = {"a": [jump(recording, 5, 0)]} if len(recording) > 17 else {}
    seen, unseen = (
        model(c, jumps=jumps).outcomes(each, frames, recorded(each, frames))
        for each in (recording, blind)
    )
    assert [b.tobytes() for b in seen.boxes] == [b.tobytes() for b in unseen.boxes]


@settings(max_examples=100, deadline=None)
@given(walks(), st.floats(0, 3))
def test_a_lost_tracker_answers_what_it_answered_last(walk, c):
    recording, frames = walk
    boxes = recording.boxes[frames]
    found = model(c).outcomes(recording, frames, recorded(recording, frames))
    answers = found.boxes[0]
    lost = ~(answers == boxes).all(axis=1)
    assert found.lost_share[0] == pytest.approx(lost.mean())
    assert np.array_equal(answers[1:][lost[1:]], answers[:-1][lost[1:]])
    for k in np.flatnonzero(lost):
        assert not near(boxes[k], answers[k - 1], c)


@settings(max_examples=100, deadline=None)
@given(walks(), st.floats(0, 3))
def test_a_measured_reach_leaves_room_for_a_target_that_is_never_found_again(walk, c):
    recording, frames = walk
    boxes = recording.boxes[frames]
    measured = model(c, reach=Reach(c, 0.1, 0.01, 0.01, 100))
    found = measured.outcomes(recording, frames, recorded(recording, frames))
    usual = plain(frames, boxes, c)
    lost = np.flatnonzero(~(usual == boxes).all(axis=1))
    first = int(lost[0]) - 1 if len(lost) else len(frames) - 1
    never = boxes[np.minimum(np.arange(len(frames)), first)]
    shares = {each.tobytes(): share for each, share in zip(found.boxes, found.weights[0])}
    if never.tobytes() == usual.tobytes():
        assert list(shares) == [usual.tobytes()]
    else:
        assert shares == {
            usual.tobytes(): pytest.approx(0.9),
            never.tobytes(): pytest.approx(0.1),
        }
    ahead = replace(measured, pre_forecaster=Kalman, keep_size=True)
    for answers in ahead.outcomes(recording, frames, recorded(recording, frames)).boxes[1:]:
        apart = np.flatnonzero(~(answers == boxes).all(axis=1))
        assert (np.diff(apart) == 1).all()  # once lost it stays so
        assert apart[-1] == len(frames) - 1


# ------------------------------------------------------------- a tracker that obeys by construction


@dataclass
class Obedient:
    """Finds the box of a frame if it is within reach of its last answer; no image is needed."""

    targets: np.ndarray
    reach: float

    def run(self, frames, start=0):
        answers = [self.targets[start]]
        for frame in frames[1:]:
            found = near(self.targets[frame], answers[-1], self.reach)
            answers.append(self.targets[frame] if found else answers[-1])
        return np.array(answers)


def obedient_traces(reach, seed, sequences=6, length=200):
    """The trackers' trace of every frame, passes at strides 3/2, 2 and 3, and a gap pass."""
    random = np.random.default_rng(seed)
    made = {}
    for s in range(sequences):
        steps = random.normal(0, 6 + 2 * s, (length, 2)).clip(-25, 25)  # each within reach
        boxes = np.hstack([500 + np.cumsum(steps, axis=0), np.full((length, 2), 40.0)])
        made[f"s{s}"] = Obedient(boxes, reach)
    times = np.full(length, 10**6)

    def trace(stride):
        recordings = []
        for name, tracker in made.items():
            boxes = np.full((length, 4), np.nan)
            for frames in reversed(phases(stride, length)):
                boxes[frames] = tracker.run(frames)
            recordings.append(Recording.new(name, tracker.targets, boxes, times))
        metadata = Metadata.new("30", "every-frame", schedule={"stride": str(stride)})
        return Trace(metadata, recordings)

    restarts = []
    for name, tracker in made.items():
        for _ in range(200):
            start, gap = int(random.integers(length - 60)), int(random.integers(1, 60))
            boxes, elapsed = np.full((gap + 1, 4), np.nan), np.full(gap + 1, -1)
            boxes[[0, gap]] = tracker.run([start, start + gap], start)
            elapsed[[0, gap]] = 10**6
            truth = tracker.targets[start : start + gap + 1]
            if start:
                restarts.append(Recording.new(f"{name}@{start}+{gap}", truth, boxes, elapsed))
    unique = {each.name: each for each in restarts}
    gaps = Trace(Metadata.new("30", "restarts"), [unique[name] for name in sorted(unique)])
    return made, trace(Fraction(1)), [trace(Fraction(s)) for s in ("3/2", "2", "3")], gaps


@pytest.mark.parametrize("latency", ["40ms", "80ms", "170ms"])
def test_a_tracker_that_obeys_the_model_is_reproduced_to_the_bit(latency):
    reach = 0.7
    made, every, _, _ = obedient_traces(reach, 3)
    source, lost = constant(latency, init="600ms"), 0
    for run in Runs(every, CLOCK, source, search=find_search(f"c={reach}", EVERY)):
        name = run.recording.name
        closed = made[name].run(run.schedule.frames)
        assert np.array_equal(run.modelled.boxes[0], closed)
        lost += run.modelled.lost_share[0] > 0
    assert lost > 0  # or nothing was asked of the model


def test_its_reach_is_recovered_from_its_gap_pass():
    for reach in (0.5, 0.9):
        *_, gaps = obedient_traces(reach, 5)
        found = find_search("trace", EVERY, [gaps])
        assert found.known
        assert found.reach.centre == pytest.approx(reach, abs=0.05)
        assert found.reach.spread < 0.05
        assert found.reaches.mean() == pytest.approx(reach, abs=0.05)


def test_passes_widen_what_is_likely_and_the_replayed_boxes_keep_half_the_weight():
    made, every, passes, gaps = obedient_traces(0.7, 11)
    strided = {trace.metadata.stride: trace for trace in passes}
    search = find_search("trace", EVERY, [gaps])
    for recording in every:
        name = recording.name
        run = replay_sequence(
            recording, CLOCK, constant("55ms"), latest,
            strided={stride: trace[name] for stride, trace in strided.items()}, search=search,
        )  # fmt: skip
        found = run.modelled
        assert found.weights.sum() == pytest.approx(1)
        closed = made[name].run(run.schedule.frames)
        offs = [np.abs(boxes - closed).max() for boxes in found.boxes]
        assert min(offs) < np.abs(run.boxes - closed).max() + 1e-9


class Raising(Kalman):
    def predict(self, frame):
        raise ValueError("no idea")


class Short(Kalman):
    def predict(self, frame):
        return [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("factory", "words"), [(Raising, "ValueError: no idea"), (Short, "ValueError.*4")]
)
def test_a_pre_forecaster_that_fails_is_told_with_its_sequence(factory, words):
    recording, frames = straight(), np.array([0, 5, 6])
    ahead = model(0.5, pre_forecaster=factory)
    with pytest.raises(LaeError, match=f"sequence 'a': the pre-forecaster: {words}"):
        ahead.outcomes(recording, frames, recorded(recording, frames))


# ---------------------------------------------------------------------------------- own jumps


def straight(length=60, step=4.0):
    boxes = np.column_stack([100 + step * np.arange(length), np.full(length, 50.0),
                             np.full(length, 40.0), np.full(length, 40.0)])  # fmt: skip
    return Recording.new("a", boxes, boxes, np.full(length, 10**6))


def jump(recording, gap, found_after):
    """An own jump that finds the recorded box some frames after its gap; None: never."""
    frames = np.arange(gap, gap + 13, 2)
    answers = np.repeat(recording.boxes[:1], len(frames), axis=0)
    if found_after is not None:
        late = frames >= gap + found_after
        answers[late] = recording.boxes[frames[late]]
    return OwnJump("a", gap, 0.0, frames, answers, recording.truth[frames], answers[:, 0] > 0)


@pytest.mark.parametrize("after", [0, 4, None])
def test_a_sequences_own_jump_outranks_the_curve(after):
    recording = straight()
    frames = np.array([0, 21, 23, 25, 27, 30, 40])  # the first 2.1 half sides away
    for reach in (0.01, 50):
        found = model(reach, jumps={"a": [jump(recording, 20, after)]}).outcomes(
            recording, frames, recorded(recording, frames)
        )
        answered = found.boxes[0][:, 0] > 100
        if after == 0:
            assert answered[1]
        elif after == 4:
            assert answered[:4].tolist() == [False, False, False, True]
        else:  # not within the 12 frames that it was followed
            assert not answered[: np.searchsorted(frames, 21 + 12, "right")].any()


def test_an_own_jump_bounds_the_reach_of_its_sequence():
    recording = straight()
    frames = np.array([0, 1, 2, 3, 20, 21])
    at = float(4 * 17 / 80)  # the jump from 3 to 20, in search sides of a 40 px target
    near_by = [jump(recording, gap, 0) for gap in (3, 20)]  # found at 20 frames: 1.0 sides
    far = [jump(recording, gap, None) for gap in (10, 14)]  # lost at 10 frames: .5 sides
    for jumps, expected in ((near_by, True), (far, False)):
        found = model(at - 0.1 if expected else at + 0.1, jumps={"a": jumps}).outcomes(
            recording, frames, recorded(recording, frames)
        )
        assert (found.boxes[0][4, 0] == recording.boxes[20, 0]) == expected


def test_jumps_to_frames_without_a_recorded_box_say_nothing():
    recording = straight()
    recording.boxes[20] = np.nan
    frames = np.array([0, 21, 22])
    jumps = {"a": [jump(straight(), 20, None)]}
    found = model(50, jumps=jumps).outcomes(recording, frames, recorded(recording, frames))
    assert np.array_equal(found.boxes[0], recording.boxes[frames])


def test_jumps_beyond_the_end_of_a_shorter_recording_say_nothing():
    recording = straight(30)
    frames = np.array([0, 21, 22])
    jumps = {"a": [jump(straight(), gap, None) for gap in (20, 40)]}
    found = model(50, jumps=jumps).outcomes(recording, frames, recorded(recording, frames))
    assert np.array_equal(found.boxes[0], recording.boxes[frames])


def test_boxes_without_a_size_are_in_reach_of_nothing():
    recording = straight()
    recording.boxes[:, 2:] = 0
    frames = np.array([0, 5, 6])
    found = model(0.5, 50).outcomes(recording, frames, recorded(recording, frames))
    assert np.array_equal(found.boxes[0], recording.boxes[[0, 0, 0]])


# ----------------------------------------------------------------------------------- gap passes


def restarts(tracker, dataset, count=40, start=1):
    """A gap pass in which targets that moved by less than .5 search sides are found."""
    made = []
    for k, distance in enumerate(np.linspace(0, 1, count)):
        box = np.array([100.0, 100, 40, 40])
        then = box + [80 * distance, 0, 0, 0]
        answers = np.array([box, then if distance < 0.5 else then + 500])
        made.append(Recording.new(f"s{k:03}@{start}+1", [box, then], answers, [10**6] * 2))
    about = {"tracker": {"name": tracker}, "dataset": {"name": dataset}}
    return Trace(Metadata.new("30", "restarts", **about), made)


def test_gap_passes_of_another_tracker_or_dataset_are_said_to_be():
    about = {"tracker": {"name": "mine"}, "dataset": {"name": "here"}}
    metadata = Metadata.new("30", "every-frame", **about)
    assert find_search("trace", metadata, [restarts("mine", "here")]).source.endswith("40 restarts")
    for tracker, dataset in (("other", "here"), ("mine", "there")):
        found = find_search("trace", metadata, [restarts(tracker, dataset)])
        assert found.source.endswith(f"40 restarts of {tracker} on {dataset}")
    both = [restarts("mine", "here"), restarts("mine", "there")]
    assert find_search("trace", metadata, both).source.endswith(
        "80 restarts, some of mine on there"
    )


def test_a_sequence_of_another_dataset_is_another_sequence():
    about = {"tracker": {"name": "mine"}, "dataset": {"name": "here"}}
    metadata = Metadata.new("30", "every-frame", **about)
    for dataset, own in (("here", 40), ("there", 0), ("unknown", 40)):
        found = find_search("trace", metadata, [restarts("mine", dataset, start=0)])
        assert (found.reach.restarts, len(found.jumps)) == (40, own)


def test_a_restart_that_two_passes_made_counts_once():
    one = restarts("mine", "here")
    found = find_search("trace", one.metadata, [one, restarts("mine", "here")])
    assert found.reach == find_search("trace", one.metadata, [one]).reach


def test_gap_passes_that_show_no_reach_are_said_to_show_none():
    few = restarts("mine", "here", count=5)
    found = find_search("trace", few.metadata, [few])
    assert not found.known
    assert found.source == "c is unknown (not shown by 5 restarts), 0.6 to 1 assumed"
    assert find_search("trace", EVERY).source == "c is unknown, 0.6 to 1 assumed"


@pytest.mark.parametrize("size", [(0, 0), (-10, 10), (-10, -10)])
def test_around_an_answer_without_a_size_nothing_is_found(size):
    recording = straight()
    recording.boxes[2, 2:] = size
    frames = np.array([0, 2, 4, 6])
    narrow, boundless = (
        model(0.5, inf).outcomes(recording, frames, recorded(recording, frames)).boxes
    )
    assert np.array_equal(narrow, recording.boxes[[0, 2, 2, 2]])
    assert np.array_equal(boundless, recording.boxes[frames])


def test_the_phases_of_a_real_time_trace_are_of_the_frames_that_it_has():
    recording = straight()
    recording.boxes[1::2] = np.nan
    frames = np.arange(0, 40)
    (answers,) = phase_answers(Fraction(1), recording, frames, weight=1.0)
    np.testing.assert_allclose(answers.boxes, straight().boxes[frames])


# ------------------------------------------------------------------------------- what is asked for


def test_exact_replays_are_not_modelled():
    recording = straight()
    search = model(0.1)
    assert replay_sequence(recording, CLOCK, constant("10ms"), search=search).modelled is None
    assert replay_sequence(recording, CLOCK, constant("47ms")).modelled is None
    ahead = model(0.1, pre_forecaster=Kalman)
    assert replay_sequence(recording, CLOCK, constant("10s"), search=ahead).modelled is None
    assert replay_sequence(recording, CLOCK, constant("47ms"), search=search).modelled is not None
    real_time = simulate(len(recording), CLOCK, lambda frame: 47_000_000, latest)
    left = Recording.of_run("a", real_time, recording.boxes[real_time.frames], recording.truth)
    assert replay_sequence(left, CLOCK, search=search).modelled is None


def test_where_the_reach_is_unknown_three_are_kept_apart():
    recording = straight()
    frames = np.array([0, 5, 10, 21, 30, 59])
    asked = find_search("c=0.1-2", EVERY)
    assert (asked.known, asked.reaches.tolist()) == (False, [0.1, 1.05, 2.0])
    found = asked.outcomes(recording, frames, recorded(recording, frames))
    assert found.weights.shape[0] == 3
    assert np.allclose(found.weights.sum(axis=1), 1)
    for row, reach in zip(found.weights, asked.reaches):
        (which,) = np.flatnonzero(row)
        assert np.array_equal(
            found.boxes[which], plain(frames, recording.boxes[frames], float(reach))
        )


def test_what_a_trace_declares_scales_the_range():
    declared = {"search": {"half_side": 1.25, "window": False, "source": "its code"}}
    found = find_search("trace", Metadata.new("30", "every-frame", tracker=declared))
    assert found.reaches.tolist() == pytest.approx([0.75, 1.0, 1.25])
    assert not found.known
    assert find_search("trace", EVERY).reaches.tolist() == pytest.approx([0.6, 0.8, 1.0])
    assert find_search("off", EVERY) is None


def test_a_trace_that_was_recorded_with_a_pre_forecaster():
    metadata = Metadata.new("30", "every-frame", schedule={"pre_forecaster": "kalman"})
    assert find_search("c=0.7", metadata) is None
    with pytest.raises(LaeError, match="recorded with the pre-forecaster 'kalman'"):
        find_search("c=0.7", metadata, pre_forecaster=Kalman)


@pytest.mark.parametrize(
    "text", ["c", "c=", "c=x", "c=-1", "c=nan", "c=2-1", "d=1", "on", "", "c=0_7", "c= 1", "c=٣"]
)
def test_what_is_no_search(text):
    with pytest.raises(LaeError, match=r"no search .*there are off, trace, c=0\.7"):
        parse_search(text)
