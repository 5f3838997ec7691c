"""The programs in docs/examples, on models of the same inputs and outputs, and on the real ones."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import onnx_models
import pytest
from moving import centre_error

from lae_sim.boxes import iou
from lae_sim.datasets.frames import read_image
from lae_sim.errors import LaeError
from lae_sim.profile.worker import Worker
from lae_sim.trackers.names import make_tracker

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
NAME = "fear_xs:FearXS"


@pytest.fixture(autouse=True)
def here(monkeypatch):
    pytest.importorskip("onnxruntime")
    monkeypatch.chdir(EXAMPLES)  # where modules of users are looked for
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield
    sys.modules.pop("fear_xs", None)


def bright(box):
    x, y, w, h = box
    frame = np.full((240, 320, 3), 20, np.uint8)
    frame[y : y + h, x : x + w] = 250
    return frame


def test_fear_xs_goes_where_its_network_says(tmp_path):
    tracker = make_tracker(NAME, {"weights": str(onnx_models.write_fear_xs(tmp_path))})
    tracker.init(bright((100, 100, 32, 32)), (100, 100, 32, 32))
    # its crop is 160 pixels, in 16 x 16 points: one is 10 pixels
    for place in (100, 100), (120, 90), (140, 110):
        box, score = tracker.track(bright((*place, 32, 32)))
        assert centre_error(box, (*place, 32, 32)) < 25
        assert 0.5 < score <= 1
        tracker.set_search(place[0] + 16, place[1] + 16, 32, 32)
    tracker.set_search(-500, 900, 5, 1e6)
    assert np.isfinite(tracker.track(bright((0, 0, 9, 9)))[0]).all()


def test_fear_xs_is_told_in_a_trace(tmp_path):
    weights = onnx_models.write_fear_xs(tmp_path)
    with Worker(NAME, {"weights": str(weights)}, threads=1) as worker:
        assert worker.sets_search
        worker.init(bright((100, 100, 32, 32)), (100, 100, 32, 32))
        assert worker.track(bright((100, 100, 32, 32))).box is not None
        found = worker.describe()
    assert [each["file"] for each in found["models"]] == [
        "fear_xs_init.onnx",
        "fear_xs_track.onnx",
    ]
    assert found["threads"]["onnxruntime"] == 1
    assert found["search"]["half_side"] == 1.25


def test_fear_xs_fails_at_set_up_where_its_models_are_wrong(tmp_path):
    weights = onnx_models.write_fear_xs(tmp_path)
    (weights / "fear_xs_track.onnx").write_bytes(b"<html>Not Found</html>")
    with pytest.raises(LaeError, match=r"setup: .*fear_xs_track\.onnx: ONNX Runtime .* cannot run"):
        Worker(NAME, {"weights": str(weights)})
    (weights / "fear_xs_track.onnx").unlink()
    with pytest.raises(LaeError, match=r"fear_xs_track\.onnx: no such file"):
        Worker(NAME, {"weights": str(weights)})
    with pytest.raises(LaeError, match="no provider 'abacus'"):
        Worker(NAME, {"weights": str(weights), "provider": "abacus"})


def test_fear_xs_follows_a_real_target(shared_data):
    folder = shared_data / "frames" / "OTB100" / "Couple"
    truth = np.loadtxt(folder / "groundtruth_rect.txt", delimiter=",")[:30]
    frames = [read_image(folder / "img" / f"{i + 1:05d}.jpg") for i in range(len(truth))]
    tracker = make_tracker(NAME, {"weights": str(shared_data / "weights" / "fear_xs")})
    tracker.init(frames[0], truth[0])
    found = np.array([tracker.track(frame)[0] for frame in frames[1:]])
    assert iou(found, truth[1:]).mean() > 0.6
