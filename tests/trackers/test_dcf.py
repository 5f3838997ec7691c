from __future__ import annotations

from time import perf_counter_ns

import numpy as np
import pytest
from moving import HEIGHT, WIDTH, centre_error, moving, straight

from lae_sim.boxes import iou, search_side
from lae_sim.datasets.frames import read_image
from lae_sim.errors import LaeError
from lae_sim.trackers.names import make_tracker
from lae_sim.trackers.stages import listening


def dcf(**options):
    return make_tracker("dcf", options)


def boxes_of(tracker, frames, box):
    tracker.init(frames[0], box)
    return np.array([tracker.track(frame)[0] for frame in frames[1:]])


def test_follows_a_target_that_moves():
    truth = straight(50)
    found = boxes_of(dcf(), list(moving(truth)), truth[0])
    errors = [centre_error(a, b) for a, b in zip(found, truth[1:])]
    assert max(errors) < 3
    assert iou(found, truth[1:]).min() > 0.8


@pytest.mark.parametrize("growth", [0.6, -0.4])
def test_follows_a_change_of_size(growth):
    truth = straight(50, (100, 80, 44, 44), (0, 0, growth, growth))
    found = boxes_of(dcf(), list(moving(truth)), truth[0])
    assert np.abs(found[:, 2] / truth[1:, 2] - 1).max() < 0.08
    fixed = boxes_of(dcf(scales=1), list(moving(truth)), truth[0])
    assert np.ptp(fixed[:, 2]) == 0


def test_is_searched_where_it_is_told():
    here, there = (40, 60, 40, 40), (220, 140, 50, 50)
    frames = list(moving([here, here, there, there]))
    tracker = dcf()
    boxes_of(tracker, frames[:2], here)
    assert centre_error(tracker.track(frames[2])[0], there) > 100
    tracker.set_search(240, 160, 50, 50)  # 7 pixels off
    box, _ = tracker.track(frames[3])
    assert centre_error(box, there) < 2
    assert box[2] == pytest.approx(50, rel=0.06)


def test_what_is_told_lasts_for_one_frame():
    truth = straight(10)
    frames = list(moving(truth))
    told, bare = dcf(), dcf()
    boxes_of(told, frames[:5], truth[0])
    boxes_of(bare, frames[:5], truth[0])
    told.set_search(*(truth[5, :2] + truth[5, 2:] / 2), 40, 40)
    told.track(frames[5])
    bare.track(frames[5])
    assert told.track(frames[6])[0] == pytest.approx(bare.track(frames[6])[0], abs=1)


def test_score_falls_and_nothing_is_learnt_while_the_target_is_gone():
    truth = straight(40)
    shown = [None if 15 <= i < 27 else box for i, box in enumerate(truth)]
    frames = list(moving(shown))
    tracker = dcf()
    tracker.init(frames[0], truth[0])
    answers = [tracker.track(frame) for frame in frames[1:]]
    scores = np.array([score for _, score in answers])
    gone = slice(14, 26)
    assert scores[gone].max() < 0.3 * scores[:14].min()
    assert {answer[0] for answer in answers[gone]} == {answers[13][0]}
    assert centre_error(answers[-1][0], truth[-1]) < 3


def test_is_deterministic_and_forgets_the_sequence_before():
    truth = straight(15)
    frames = list(moving(truth))
    tracker = dcf()
    boxes_of(tracker, list(moving(straight(15, (150, 150, 30, 20)), seed=1)), (150, 150, 30, 20))
    again = boxes_of(tracker, frames, truth[0])
    np.testing.assert_array_equal(again, boxes_of(dcf(), frames, truth[0]))


def test_torch_answers_as_numpy():
    pytest.importorskip("torch", reason="needs torch")
    truth = straight(25, (60, 80, 40, 30), (3, 1.5, 0.4, 0.3))
    frames = list(moving(truth))
    tracker = dcf(device="torch:cpu")
    found = boxes_of(tracker, frames, truth[0])
    tracker.sync()
    np.testing.assert_allclose(found, boxes_of(dcf(), frames, truth[0]), atol=0.05)


@pytest.mark.parametrize(
    "box",
    [
        (100, 100, 1, 1),
        (100, 100, 0, 0),
        (100, 100, 1, 90),
        (-30, -20, 40, 40),
        (300, 220, 60, 60),
        (-500, -500, 40, 40),
        (900, 100, 40, 40),
        (0, 0, WIDTH, HEIGHT),
        (-2000, -2000, 5000, 5000),
    ],
)
def test_any_box_can_be_tracked(box):
    frames = list(moving(straight(6)))
    found = boxes_of(dcf(), frames, box)
    assert np.isfinite(found).all()
    assert (found[:, 2:] >= 1).all()


@pytest.mark.parametrize("shape", [(1, 1), (3, 500), (20, 20), (480, 640)])
@pytest.mark.parametrize("grey", [0, 77, 255])
def test_constant_frames_of_any_size(shape, grey):
    frames = [np.full((*shape, 3), grey, np.uint8)] * 4
    tracker = dcf()
    tracker.init(frames[0], (0, 0, 10, 10))
    for frame in frames:
        box, score = tracker.track(frame)
        assert np.isfinite([*box, score]).all()


def test_a_target_that_leaves_the_image():
    truth = straight(60, (200, 100, 40, 40), (6, 0, 0, 0))
    found = boxes_of(dcf(), list(moving(truth)), truth[0])
    assert np.isfinite(found).all()
    assert (found[:, 0] + found[:, 2] / 2 <= WIDTH).all()


def test_frames_may_change_in_size():
    frames = list(moving(straight(4)))
    tracker = dcf()
    boxes_of(tracker, frames, (60, 80, 40, 40))
    box, _ = tracker.track(frames[0][:60, :50].copy())
    assert np.isfinite(box).all()
    # a frame that is not contiguous in memory
    assert np.isfinite(tracker.track(frames[0][:, ::-1])[0]).all()


@pytest.mark.parametrize("side", [1e-9, 5000, 1e12])
def test_any_size_can_be_searched(side):
    frames = list(moving(straight(4)))
    tracker = dcf()
    boxes_of(tracker, frames[:2], (60, 80, 40, 40))
    tracker.set_search(-1e9, 1e9, side, side)
    for frame in frames[2:]:
        assert np.isfinite(tracker.track(frame)[0]).all()


def test_what_cannot_be_used_is_refused():
    frame = next(moving(straight(1)))
    tracker = dcf()
    with pytest.raises(LaeError, match="init must come before"):
        tracker.track(frame)
    with pytest.raises(LaeError, match=r"uint8 \[H, W, 3\], not uint16"):
        tracker.init(frame.astype(np.uint16), (1, 1, 9, 9))
    for bad in (frame[..., 0], frame[:0], np.zeros((9, 9, 4), np.uint8)):
        with pytest.raises(LaeError, match="must be uint8"):
            tracker.init(bad, (1, 1, 9, 9))
    for box in ((1, 1, np.nan, 9), (1, 1, -3, 9), (1, 1, np.inf, 9)):
        with pytest.raises(LaeError, match="not a box"):
            tracker.init(frame, box)
    with pytest.raises(LaeError, match="cannot search"):
        tracker.set_search(1, np.nan, 9, 9)
    with pytest.raises(LaeError, match="device 'gpu7' cannot be used"):
        dcf(device="gpu7")
    with pytest.raises(LaeError, match="scales be odd"):
        dcf(scales=4)
    with pytest.raises(LaeError, match="it takes device, padding"):
        dcf(speed=3)


def test_its_stages_are_most_of_a_call():
    tracker, boxes = dcf(), straight(4)
    frames = list(moving(boxes))
    with listening() as call:
        tracker.init(frames[0], boxes[0])
    assert set(call.ns) == {"preprocess", "learn"}
    before = perf_counter_ns()
    with listening() as call:
        for frame in frames[1:]:
            tracker.track(frame)
    elapsed = perf_counter_ns() - before
    assert set(call.ns) == {"preprocess", "inference", "learn"}
    assert 0.5 * elapsed < sum(call.ns.values()) <= elapsed


def test_describes_itself():
    told = dcf(padding=3.5).describe()
    assert told["name"] == "dcf"
    assert told["settings"]["padding"] == 3.5
    assert dcf().describe()["search"]["half_side"] == 1


def test_it_finds_nothing_beyond_the_search_region_that_it_declares():
    side = float(search_side(np.array([0.0, 0, 40, 40])))
    for share, hit in ((0.2, True), (1.1, False)):
        moved = [[100, 60, 40, 40], [100 + share * side, 60, 40, 40]]
        (found,) = boxes_of(dcf(), list(moving(moved)), moved[0])
        overlap = iou(np.array([found]), np.array(moved[1:]))[0]
        assert (overlap > 0.3) == hit


@pytest.mark.parametrize(
    ("sequence", "least"), [("DTB70/MountainBike6", 0.6), ("UAV123_10fps/wakeboard7", 0.5)]
)
def test_real_frames(shared_data, sequence, least):
    folder = shared_data / "frames" / sequence
    truth = np.loadtxt(folder / "groundtruth_rect.txt", delimiter=",")[:40]
    frames = [read_image(folder / "img" / f"{i:05d}.jpg") for i in range(1, 41)]
    overlap = iou(boxes_of(dcf(), frames, truth[0]), truth[1:])
    assert overlap.mean() > least
    assert overlap.min() > 0.05
