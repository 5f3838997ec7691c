"""Made-up motion: repeatable, valid, and as wide as it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lae_sim.boxes import iou
from lae_sim.learning.motion import FRAMES, made_up_motion, made_up_trace
from lae_sim.trace.file import Trace, read_trace, write_trace


@pytest.fixture(scope="module")
def motion() -> tuple[np.ndarray, np.ndarray]:
    """Truth and boxes of 600 sequences."""
    return made_up_motion(600, np.random.default_rng(0))


def content(trace: Trace) -> list[bytes]:
    return [
        part.tobytes()
        for recording in trace
        for part in (recording.truth, recording.boxes, recording.elapsed_ns)
    ]


@pytest.mark.parametrize("dropped", [False, True])
def test_the_seed_decides_all(dropped: bool) -> None:
    made = [content(made_up_trace(5, seed, 60, dropped)) for seed in (3, 3, 4)]
    assert made[0] == made[1]
    assert not set(made[0]) & set(made[2])
    assert len(set(made[0])) == len(made[0])  # nor is a sequence like another
    assert made[0] != content(made_up_trace(5, 3, 60, not dropped))


def test_a_tracker_starts_at_the_truth_and_all_boxes_are_boxes(
    motion: tuple[np.ndarray, np.ndarray],
) -> None:
    truth, boxes = motion
    assert truth.shape == boxes.shape == (600, FRAMES, 4)
    assert truth[:, 0].tobytes() == boxes[:, 0].tobytes()
    for each in motion:
        assert each.dtype == np.float64
        assert np.isfinite(each).all()
        assert (each[..., 2:] >= 1).all()
        assert np.abs(each).max() < 1e6


@pytest.mark.parametrize(("sequences", "frames"), [(1, 200), (7, 11), (3, 500)])
def test_any_number_of_sequences_and_frames(sequences: int, frames: int) -> None:
    truth, boxes = made_up_motion(sequences, np.random.default_rng(1), frames)
    assert truth.shape == boxes.shape == (sequences, frames, 4)
    assert np.isfinite(truth).all()
    assert np.isfinite(boxes).all()


def quantiles(values: np.ndarray) -> list[float]:
    found: list[float] = np.quantile(values, [0.05, 0.5, 0.95]).tolist()
    return found


def test_targets_are_of_all_sizes_shapes_and_speeds(
    motion: tuple[np.ndarray, np.ndarray],
) -> None:
    """Wide ranges, around what aerial and other videos have (nothing is fitted to them)."""
    truth, _ = motion
    size = np.sqrt(truth[..., 2] * truth[..., 3])
    low, middle, high = quantiles(size)
    assert low < 20 < middle < 70 < high < 600
    low, middle, high = quantiles(truth[..., 2] / truth[..., 3])
    assert low < 0.6 < middle < 1.6 < high
    centre = truth[..., :2] + truth[..., 2:] / 2
    speed = np.hypot(*np.moveaxis(np.diff(centre, axis=1), -1, 0)) / size[:, 1:]
    low, middle, high = quantiles(speed.mean(axis=1))
    assert low < 0.03 < middle < 0.15 < high < 1
    low, _, high = quantiles(np.log(size[:, -1] / size[:, 0]))
    assert low < -0.3 < 0.3 < high  # they come nearer and go away
    whole = (np.round(truth) == truth).all(axis=(1, 2)).mean()
    assert 0.4 < whole < 0.8  # annotations in whole pixels, or not
    repeated = (np.diff(centre, axis=1) == 0).all(axis=2).mean(axis=1)
    assert 0.02 < (repeated > 0.4).mean() < 0.4  # some videos repeat frames
    outside = (centre < 0) | (centre > [1280, 720])
    assert 0.3 < outside.any(axis=(1, 2)).mean() < 0.9


def test_trackers_follow_and_sometimes_fail(motion: tuple[np.ndarray, np.ndarray]) -> None:
    truth, boxes = motion
    overlap = iou(truth.reshape(-1, 4), boxes.reshape(-1, 4)).reshape(truth.shape[:2])
    mean = overlap[:, 1:].mean(axis=1)
    assert 0.55 < np.median(mean) < 0.9
    assert 0.02 < (mean < 0.3).mean() < 0.3
    lost = (overlap == 0).any(axis=1)
    found_again = lost & (overlap[:, -10:].mean(axis=1) > 0.5)
    assert found_again.sum() > 10
    sides = np.log(boxes[:, 1:, 2:] / truth[:, 1:, 2:]).mean(axis=(1, 2))
    low, middle, high = quantiles(sides)
    assert low < -0.1 < middle < 0.1 < high  # habits in size, both ways


def test_some_boxes_are_early_and_some_late(motion: tuple[np.ndarray, np.ndarray]) -> None:
    """By which shift of the truth a tracker's boxes are fitted best."""
    truth, boxes = (each[..., :2] + each[..., 2:] / 2 for each in motion)
    kept = slice(3, -3)
    errors = [
        np.median(np.abs(boxes[:, kept] - np.roll(truth, -by, axis=1)[:, kept]).sum(-1), axis=1)
        for by in (-1, 0, 1)
    ]
    best = np.argmin(errors, axis=0)
    early, late = (best == 2).mean(), (best == 0).mean()
    assert 0.02 < early < 0.3
    assert 0.02 < late < 0.3


def test_a_camera_drops_frames_and_the_rest_arrive_in_order() -> None:
    trace = made_up_trace(60, 2, dropped=True)
    shares = []
    for recording in trace:
        times = recording.arrival_ns
        assert times is not None
        assert times[0] == 0
        assert (np.diff(times) > 0).all()
        shares.append(1 - len(times) / FRAMES)
    assert min(shares) < 0.1
    assert 0.35 < max(shares) < 0.6
    even = made_up_trace(3, 2)
    assert all(recording.arrival_ns is None for recording in even)
    assert [recording.name for recording in even] == ["even-00000", "even-00001", "even-00002"]


def test_times_are_of_fast_and_slow_devices() -> None:
    elapsed = np.stack([recording.elapsed_ns for recording in made_up_trace(300, 0)]) / 1e6
    assert (elapsed > 0).all()
    low, middle, high = quantiles(np.median(elapsed, axis=1))
    assert 5 < low < 15 < middle < 90 < high < 310
    steady = (elapsed[:, 1:].std(axis=1) < 1e-6).mean()
    assert 0.3 < steady < 0.7
    slow_start = (elapsed[:, 0] > 1.9 * np.median(elapsed, axis=1)).mean()
    assert 0.15 < slow_start < 0.5


def test_it_is_a_trace_as_any_other(tmp_path: Path) -> None:
    for dropped in (False, True):
        trace = made_up_trace(3, 1, 50, dropped)
        write_trace(trace, tmp_path / "made-up.parquet")
        assert content(read_trace(tmp_path / "made-up.parquet")) == content(trace)
