from __future__ import annotations

import numpy as np
import pytest
from moving import cv2, moving, straight

from lae_sim.trackers.dcf import BINS, CELL, crop, features


@pytest.fixture
def frame():
    return next(moving(straight(1)))


def test_crop_of_a_box_of_its_own_size_is_the_frame_there(frame):
    found = crop(frame, np.array([100.0, 80.0]), (64, 64), 64)
    np.testing.assert_array_equal(found, frame[48:112, 68:132])


@pytest.mark.parametrize("size", [(96, 64), (32, 48), (300, 200)])
def test_crop_scales_a_box(frame, size):
    w, h = size
    found = crop(frame, np.array([160.0, 120.0]), size, 32)
    there = frame[120 - h // 2 : 120 + h // 2, 160 - w // 2 : 160 + w // 2]
    expected = cv2.resize(there, (32, 32), interpolation=cv2.INTER_AREA)
    assert np.abs(found.astype(int) - expected).mean() < 8
    shifted = cv2.resize(there, (32, 32), interpolation=cv2.INTER_AREA)[:, 1:]
    assert (
        np.abs(found.astype(int) - expected).mean()
        < np.abs(found[:, :-1].astype(int) - shifted).mean()
    )


def test_crop_repeats_the_edge_beyond_the_frame(frame):
    found = crop(frame, np.array([-500.0, -500.0]), (20, 20), 16)
    np.testing.assert_array_equal(found, np.broadcast_to(frame[0, 0], (16, 16, 3)))


@pytest.mark.parametrize("bin_", range(BINS))
def test_a_gradient_falls_into_the_bin_of_its_orientation(bin_):
    angle = bin_ * np.pi / BINS
    y, x = np.mgrid[:32, :32]
    for direction in (1, -1):  # opposite gradients are one orientation
        ramp = 128 + 3 * direction * (x * np.cos(angle) + y * np.sin(angle) - 16)
        patch = np.repeat(np.clip(ramp, 0, 255).astype(np.uint8)[..., None], 3, 2)
        histogram = features(patch)[:BINS, 1:-1, 1:-1]
        assert (histogram.mean((1, 2)).argmax()) == bin_


def test_features_of_the_cells(frame):
    found = features(frame[:64, :96])
    assert found.shape == (BINS + 3, 64 // CELL, 96 // CELL)
    assert found.dtype == np.float32
    assert np.isfinite(found).all()
    flat = features(np.full((8, 8, 3), 200, np.uint8))
    assert not flat[:BINS].any()
    assert np.ptp(flat[BINS:].reshape(3, -1), 1).max() == 0


def test_contrast_leaves_the_histograms_much_as_they_are(frame):
    plain = features(frame[80:120, 60:100])[:BINS]
    faint = features(frame[80:120, 60:100] // 2 + 60)[:BINS]
    assert np.corrcoef(plain.ravel(), faint.ravel())[0, 1] > 0.9
