"""Gap passes of trackers whose reach is known, for those that need one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording


def gap_pass(
    of: Metadata, path: Path, centre: float = 0.3, spread: float = 0.05, count: int = 400
) -> Path:
    """Write restarts on a target that moved, of the tracker and the dataset of another trace."""
    random = np.random.default_rng(1)
    box = np.array([100.0, 100, 40, 40])  # whose search side is 80
    recordings = []
    for k, distance in enumerate(random.uniform(0, 1.2, count)):
        then = box + [80 * distance, 0, 0, 0]
        found = distance < random.logistic(centre, spread)
        boxes = np.array([box, then if found else then + 500])
        truth, elapsed = np.array([box, then]), np.full(2, 10**6)
        recordings.append(Recording.new(f"made{k:04}@1+1", truth, boxes, elapsed))
    about = {"tracker": of.document["tracker"], "dataset": of.document["dataset"]}
    write_trace(Trace(Metadata.new("30", "restarts", **about), recordings), path)
    return path
