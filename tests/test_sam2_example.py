"""The program docs/examples/sam2_camera.py, on a predictor of the same interface."""

from __future__ import annotations

import contextlib
import sys
from types import ModuleType

import cv2
import numpy as np
import pytest
from places import REPOSITORY

from lae_sim.trackers.names import make_tracker

EXAMPLES = REPOSITORY / "docs" / "examples"
HEIGHT, WIDTH = 90, 120


class Tensor(np.ndarray):
    """As much of a tensor as the example uses."""

    def cpu(self):
        return np.asarray(self)


class CameraPredictor:
    """Segments what is red, as ``sam2.sam2_camera_predictor.SAM2CameraPredictor`` is called.

    As that one does, it keeps the number of its frame when another first frame comes.
    """

    def __init__(self, fast):
        self._fast = fast
        self.frame_idx = 0

    def load_first_frame(self, img):
        self._take(img)
        self._tracked, self.corners = 0, None

    def add_new_prompt(
        self,
        frame_idx,
        obj_id,
        points=None,
        labels=None,
        bbox=None,
        clear_old_points=True,
        normalize_coords=True,
    ):
        assert frame_idx == 0
        self.corners = np.array(bbox, np.float32)
        assert self.corners.shape == (2, 2)
        return frame_idx, [obj_id], self._logits()

    def track(self, img):
        assert self.corners is not None
        self._take(img)
        self.frame_idx += 1
        self._tracked += 1
        assert self.frame_idx == self._tracked  # what it remembers is numbered so
        return [1], self._logits()

    def _take(self, img):
        assert self._fast.on
        self._image = cv2.resize(img, (WIDTH, HEIGHT))  # as it does, to its own size

    def _logits(self):
        red = self._image[:, :, 0] > 128
        return np.where(red, np.float32(9.5), np.float32(-11))[None, None].view(Tensor)


@pytest.fixture
def tracker(monkeypatch):
    class Autocast(contextlib.AbstractContextManager):
        on = False

        def __call__(self, device, dtype):
            assert (device, dtype) == ("cuda", "bfloat16")
            return self

        def __enter__(self):
            self.on = True

        def __exit__(self, *_):
            self.on = False

    torch, package, build = ModuleType("torch"), ModuleType("sam2"), ModuleType("sam2.build_sam")
    torch.autocast, torch.bfloat16 = Autocast(), "bfloat16"
    made = []

    def build_sam2_camera_predictor(config_file, ckpt_path=None, device="cuda", mode="eval"):
        made.append((config_file, ckpt_path))
        return CameraPredictor(torch.autocast)

    build.build_sam2_camera_predictor = build_sam2_camera_predictor
    for module in torch, package, build:
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    options = {"config": "sam2_hiera_s.yaml", "checkpoint": "sam2_hiera_small.pt"}
    yield make_tracker("sam2_camera:Sam2", options)
    assert made == [("sam2_hiera_s.yaml", "sam2_hiera_small.pt")]
    sys.modules.pop("sam2_camera")


def red_ellipse(x, y):
    """On a blue ground, one of 30 by 20 pixels, from x and y on."""
    frame = np.full((HEIGHT, WIDTH, 3), (250, 30, 20), np.uint8)
    cv2.ellipse(frame, (x + 15, y + 10), (15, 10), 0, 0, 360, (10, 20, 240), -1)
    return frame


def test_sam2_follows_a_mask_over_sequences(tracker):
    for start in 10, 25:
        tracker.init(red_ellipse(start, 20), (start, 20, 31, 21))
        np.testing.assert_array_equal(
            tracker.predictor.corners, [[start, 20], [start + 31, 41]]
        )  # not a size
        for step in range(1, 5):
            x, y = start + 7 * step, 20 + 5 * step
            assert tracker.track(red_ellipse(x, y)) == (x, y, 31, 21)


def test_sam2_that_loses_the_target_says_so(tracker):
    tracker.init(red_ellipse(10, 20), (10, 20, 31, 21))
    assert tracker.track(np.zeros((HEIGHT, WIDTH, 3), np.uint8)) is None
