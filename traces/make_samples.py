"""Make the sample traces: ``python traces/make_samples.py [FOLDER]``.

Nothing here was measured. A target and a camera move, a made-up tracker follows the target with an
error that grows with motion and occlusion, and processing times have the look of measured ones:
a slow first call, jitter with a heavy tail, a warm-up drift, rare stalls. The metadata says so.

- ``synthetic-slow.parquet``: every frame, about 47 ms a frame, as a deep tracker on a small board.
- ``synthetic-fast.parquet``: every frame, about 12 ms a frame, less accurate.
- ``synthetic-slow-realtime.parquet``: the slow tracker's real-time run: skipped frames are null.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lae_sim import Metadata, Recording, Trace, replay_trace, write_trace

IMAGE = (1280, 720)
FRAMES = 300
# name: speed of the target and of the camera (px/frame), scale change, occlusions
SCENES = {
    "boat-calm": (1.5, 0.5, 0.1, 0),
    "bike-pan": (3.0, 4.0, 0.2, 0),
    "car-chase": (7.0, 2.0, 0.4, 0),
    "car-occluded": (4.0, 1.0, 0.2, 2),
    "drone-fast": (9.0, 5.0, 0.5, 0),
    "person-crowd": (2.0, 1.0, 0.1, 3),
    "runner-zoom": (4.0, 2.0, 0.9, 1),
    "truck-far": (2.5, 3.0, 0.3, 0),
}


@dataclass(frozen=True)
class Tracker:
    """A made-up tracker.

    Attributes:
        name: its name in the metadata.
        error: standard deviation of its position error, in target sizes.
        elapsed_ms: typical processing time.
        jitter: standard deviation of the logarithm of the processing time.
    """

    name: str
    error: float
    elapsed_ms: float
    jitter: float


def smooth_walk(rng: np.random.Generator, speed: float, memory: float) -> np.ndarray:
    """A path whose velocity wanders around zero with the given typical speed, [FRAMES, 2]."""
    velocity = np.zeros((FRAMES, 2))
    velocity[0] = rng.normal(0, speed, 2)
    for i in range(1, FRAMES):
        push = rng.normal(0, speed * np.sqrt(1 - memory**2), 2)
        velocity[i] = memory * velocity[i - 1] + push
    return np.cumsum(velocity, axis=0) - velocity[0]


def reflect(path: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Fold a path back and forth between two bounds."""
    span = high - low
    folded = np.abs((path - low) % (2 * span) - span)
    return high - folded


def make_truth(rng: np.random.Generator, scene: tuple[float, float, float, int]) -> np.ndarray:
    """Ground truth boxes, [FRAMES, 4]."""
    speed, camera, zoom, _ = scene
    width = rng.uniform(40, 90)
    height = width * rng.uniform(0.6, 1.6)
    size = np.exp(zoom * np.sin(np.linspace(0, rng.uniform(2, 6), FRAMES)))
    sizes = size[:, None] * [width, height]
    path = rng.uniform([200, 150], [1000, 550])
    path = path + smooth_walk(rng, speed, 0.97) + smooth_walk(rng, camera, 0.9)
    centres = reflect(path, sizes / 2, np.array(IMAGE) - sizes / 2)
    return np.round(np.concatenate([centres - sizes / 2, sizes], axis=1), 2)


def make_boxes(
    rng: np.random.Generator, truth: np.ndarray, occlusions: int, tracker: Tracker
) -> tuple[np.ndarray, np.ndarray]:
    """The tracker's boxes, [FRAMES, 4], and scores, [FRAMES]."""
    occluded = np.zeros(FRAMES)
    for start in rng.integers(40, FRAMES - 60, occlusions):
        occluded[start : start + 25] = np.hanning(25)
    motion = np.linalg.norm(np.diff(truth[:, :2], axis=0, prepend=truth[:1, :2]), axis=1)
    scale = tracker.error * (1 + motion / 10 + 8 * occluded)
    error = np.zeros((FRAMES, 4))
    for i in range(1, FRAMES):
        error[i] = 0.8 * error[i - 1] + 0.6 * rng.normal(0, scale[i], 4)
    size = truth[:, 2:]
    boxes = truth.copy()
    boxes[:, 2:] = size * np.exp(0.5 * error[:, 2:])
    boxes[:, :2] += error[:, :2] * size - (boxes[:, 2:] - size) / 2
    score = np.clip(1 - 2 * scale, 0.05, 0.99) * rng.uniform(0.97, 1, FRAMES)
    return np.round(boxes, 2), np.round(score, 3)


def make_elapsed(rng: np.random.Generator, tracker: Tracker) -> np.ndarray:
    """Processing times in ns, [FRAMES]: whole microseconds."""
    warm = 1 - 0.1 * np.exp(-np.arange(FRAMES) / 100)  # the device clocks down as it warms up
    milliseconds = tracker.elapsed_ms * warm * np.exp(rng.normal(0, tracker.jitter, FRAMES))
    milliseconds[rng.random(FRAMES) < 0.01] *= 3  # stalls
    milliseconds[0] = 6 * tracker.elapsed_ms  # initialisation
    milliseconds[1] *= 2.5  # first call
    return np.round(milliseconds * 1000).astype(np.int64) * 1000


def attributes(scene: tuple[float, float, float, int]) -> list[str]:
    """Names as DTB70 has them."""
    speed, camera, zoom, occlusions = scene
    named = {
        "Fast camera motion": camera >= 3,
        "Motion blur": speed >= 7,
        "Occlusion": occlusions > 0,
        "Scale variation": zoom >= 0.4,
    }
    return [name for name, present in named.items() if present]


def make_trace(tracker: Tracker) -> Trace:
    """The every-frame trace of a tracker on all scenes."""
    recordings = []
    for index, (name, scene) in enumerate(sorted(SCENES.items())):
        truth = make_truth(np.random.default_rng([1, index]), scene)
        rng = np.random.default_rng([2, index, round(tracker.elapsed_ms)])
        boxes, score = make_boxes(rng, truth, scene[3], tracker)
        recordings.append(Recording.new(name, truth, boxes, make_elapsed(rng, tracker), score))
    metadata = Metadata.new(
        "30",
        "every-frame",
        tracker={"name": tracker.name, "version": "synthetic"},
        device={"model": "none"},
        timing={"source": "synthetic (made up, not measured)"},
        dataset={"name": "synthetic", "made_by": "traces/make_samples.py"},
        sequences={
            name: {"image_size": list(IMAGE), "attributes": attributes(scene)}
            for name, scene in SCENES.items()
        },
    )
    return Trace(metadata, recordings)


def real_time(trace: Trace) -> Trace:
    """The real-time run of an every-frame trace."""
    document = {**trace.metadata.document, "schedule": {"policy": "latest"}}
    for key in ("format", "version", "fps"):
        document.pop(key)
    recordings = [
        Recording.of_run(
            run.recording.name,
            run.schedule,
            run.boxes,
            run.recording.truth,
            run.recording.score[run.schedule.frames],
        )
        for run in replay_trace(trace)
    ]
    return Trace(Metadata.new("30", "real-time", **document), recordings)


def main() -> None:
    """Write the samples into a folder, by default the one that this file is in."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    slow = make_trace(Tracker("slow-and-accurate", error=0.04, elapsed_ms=47, jitter=0.08))
    fast = make_trace(Tracker("fast-and-rough", error=0.09, elapsed_ms=12, jitter=0.15))
    write_trace(slow, folder / "synthetic-slow.parquet")
    write_trace(fast, folder / "synthetic-fast.parquet")
    write_trace(real_time(slow), folder / "synthetic-slow-realtime.parquet")


if __name__ == "__main__":
    main()
