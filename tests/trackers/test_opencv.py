from __future__ import annotations

import numpy as np
import pytest
from moving import HEIGHT, WIDTH, centre_error, cv2, moving, straight

from lae_sim.errors import LaeError
from lae_sim.trackers import opencv
from lae_sim.trackers.names import make_tracker

CONTRIB = hasattr(cv2, "TrackerCSRT_create")


def answers(tracker, frames, box):
    tracker.init(frames[0], box)
    return [tracker.track(frame) for frame in frames[1:]]


def contrib(name):
    reason = "needs opencv-contrib-python-headless"
    return pytest.param(name, marks=pytest.mark.skipif(not CONTRIB, reason=reason))


@pytest.mark.parametrize("name", ["mil", contrib("csrt"), contrib("kcf"), contrib("medianflow")])
def test_follows_a_target(name):
    truth = straight(12)
    found = answers(make_tracker(f"opencv:{name}", {}), list(moving(truth)), truth[0])
    assert all(len(box) == 4 for box in found)  # no score
    assert max(centre_error(a, b) for a, b in zip(found, truth[1:])) < 6


@pytest.mark.parametrize("name", ["mil", contrib("tld"), contrib("boosting")])
def test_repeats_itself(name):
    truth = straight(8)
    frames = list(moving(truth))
    tracker = make_tracker(f"opencv:{name}", {"seed": 3})
    first = answers(tracker, frames, truth[0])
    assert answers(tracker, frames, truth[0]) == first
    assert answers(make_tracker(f"opencv:{name}", {"seed": 3}), frames, truth[0]) == first


def test_the_seed_matters_to_mil():
    truth = straight(8)
    frames = list(moving(truth))
    found = [answers(make_tracker("opencv:mil", {"seed": s}), frames, truth[0]) for s in range(3)]
    assert found[0] != found[1] or found[0] != found[2]


def test_nano_has_a_score(shared_data):
    folder = shared_data / "weights" / "nanotrackv2"
    files = {part: str(next(folder.glob(f"*{part}*"))) for part in ("backbone", "head")}
    truth = straight(8)
    tracker = make_tracker("opencv:nano", files)
    for (box, score), expected in zip(answers(tracker, list(moving(truth)), truth[0]), truth[1:]):
        assert centre_error(box, expected) < 12
        assert 0.3 < score < 1
    told = tracker.describe()
    assert len(told["weights_digest"]) == 64
    assert told["settings"]["network_loaded_in_init"] in (False, True)
    assert told["version"] == cv2.__version__
    assert told["search"]["half_side"] == 1
    assert "search" not in make_tracker("opencv:mil", {}).describe()  # a number of pixels


@pytest.mark.parametrize(
    "box", [(-10, -10, 40, 40), (300.4, 220.6, 50.2, 40.7), (0.5, 0.5, 30.5, 30.5), (9, 9, 2, 13)]
)
def test_boxes_are_rounded_and_cut_off(box):
    frames = list(moving(straight(3)))
    for x, y, w, h in answers(make_tracker("opencv:mil", {}), frames, box):
        assert all(isinstance(v, int) for v in (x, y, w, h))
        assert x >= 0
        assert y >= 0
        assert x + w <= WIDTH + 1
        assert y + h <= HEIGHT + 1


@pytest.mark.parametrize(
    "box", [(9, 9, 4, 4), (9, 9, 1, 60), (-38, 9, 39, 39), (400, 9, 40, 40), (9, 9, 0, 0)]
)
def test_boxes_on_which_mil_would_hang_are_refused(box):
    tracker = make_tracker("opencv:mil", {})
    frame = next(moving(straight(1)))
    with pytest.raises(LaeError, match="opencv:mil needs a box with sides of 2 or more"):
        tracker.init(frame, box)
    with pytest.raises(LaeError, match="init must come before"):
        tracker.track(frame)


def test_a_box_that_opencv_refuses_is_told():
    frame = next(moving(straight(1)))
    with pytest.raises(
        LaeError, match=r"^opencv:mil refused to start on the box \[-9, -9, 999, 999\]"
    ):
        make_tracker("opencv:mil", {}).init(frame, (-9, -9, 999, 999))


def test_track_before_init_is_refused():
    with pytest.raises(LaeError, match="opencv:mil: init must come before track"):
        make_tracker("opencv:mil", {}).track(next(moving(straight(1))))


def test_a_tracker_that_cannot_go_on_where_frames_change_in_size(monkeypatch):
    class Stops:
        def update(self, frame):
            if frame.shape != (240, 320, 3):
                raise cv2.error("prevPyr[level * lvlStep1].size() == nextPyr[...].size()")
            return True, (60, 80, 40, 40)

    frame = next(moving(straight(1)))
    tracker = make_tracker("opencv:mil", {})
    tracker.init(frame, (60, 80, 40, 40))
    monkeypatch.setattr(tracker, "_tracker", Stops())
    assert tracker.track(frame) == (60, 80, 40, 40)
    with pytest.raises(LaeError, match="cannot go on where frames change from 320 x 240 to 300 x"):
        tracker.track(frame[:, :300])


def test_frames_may_change_in_size():
    frame = next(moving(straight(1)))
    tracker = make_tracker("opencv:mil", {})
    tracker.init(frame, (60, 80, 40, 40))
    for width in (300, 150, 320):
        x, y, _, _ = tracker.track(frame[:, :width])
        assert max(abs(x - 60), abs(y - 80)) < 5
    with pytest.raises(LaeError, match="uint8"):
        tracker.track(frame.astype(np.uint16))


def test_a_target_that_is_not_found_is_no_box(monkeypatch):
    class Lost:
        def init(self, frame, box):
            return True

        def update(self, frame):
            return False, (0, 0, 0, 0)

    monkeypatch.setattr(cv2, "TrackerMIL_create", Lost)
    assert answers(make_tracker("opencv:mil", {}), list(moving(straight(2))), (9, 9, 9, 9)) == [
        None
    ]


def test_a_refusal_to_start_is_an_error(monkeypatch):
    class Refuses:
        def init(self, frame, box):
            return False

    monkeypatch.setattr(cv2, "TrackerMIL_create", Refuses)
    with pytest.raises(LaeError, match="refused to start on the box"):
        make_tracker("opencv:mil", {}).init(next(moving(straight(1))), (9, 9, 9, 9))


def test_files_that_are_missing_or_unknown_are_named(tmp_path):
    with pytest.raises(LaeError, match=r"opencv:nano needs .* no backbone=FILE, head=nowhere"):
        make_tracker("opencv:nano", {"head": "nowhere"})
    with pytest.raises(LaeError, match="opencv:mil takes no model"):
        make_tracker("opencv:mil", {"model": "x"})
    (tmp_path / "a.onnx").write_bytes(b"nonsense")
    file = str(tmp_path / "a.onnx")
    with pytest.raises(LaeError, match=r"opencv:nano cannot be made of .*a.onnx"):
        make_tracker("opencv:nano", {"backbone": file, "head": file})


def test_trackers_that_this_build_lacks_are_named(monkeypatch):
    with pytest.raises(LaeError, match="no tracker 'sift', only mil, "):
        make_tracker("opencv:sift", {})
    monkeypatch.delattr(cv2, "TrackerCSRT_create", raising=False)
    with pytest.raises(LaeError, match=r"'csrt', only mil.*opencv-contrib-python-headless"):
        make_tracker("opencv:csrt", {})


def test_every_tracker_here_has_its_files_known():
    for name in ("nano", "vit", "dasiamrpn", "goturn"):
        params = getattr(cv2, f"Tracker{opencv._MAIN[name]}_Params", None)
        for attribute in opencv._FILES[name].values():
            assert params is None or hasattr(params, attribute)
