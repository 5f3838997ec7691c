"""Outputs that forecasters are fed in tests, and what forecasters answer one box at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st

from lae_sim.forecast.base import Lanes, forecast
from lae_sim.trace.metadata import ImageSizes


@st.composite
def lanes_and_queries(
    draw: st.DrawFn, jumps: float = 0.15, least: float = 0.0
) -> tuple[Lanes, np.ndarray, np.ndarray]:
    """Some lanes of random walks, with queries as of their items."""
    lengths = draw(st.lists(st.integers(1, 12), min_size=1, max_size=6))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    frames, boxes = [], []
    for length in lengths:
        frames.append(np.concatenate([[0], np.cumsum(random.integers(1, 6, length - 1))]))
        walk = random.normal(0, 12, (length, 4)).cumsum(axis=0)
        walk += [300, 200, 40, 30]
        walk[:, 2:] = np.abs(walk[:, 2:]) + least
        far = random.random(length) < jumps
        walk[far, :2] += random.normal(0, 200, (far.sum(), 2))
        boxes.append(walk)
    sizes = np.where(
        random.random((len(lengths), 1)) < 0.3, np.inf, random.integers(200, 700, (len(lengths), 2))
    )
    offsets = np.cumsum([0, *lengths])
    resized = {}
    for lane in np.flatnonzero(np.isfinite(sizes[:, 0]) & (random.random(len(lengths)) < 0.3)):
        later = random.integers(100, 700, (random.integers(1, 4), 2)).tolist()
        starts = np.sort(random.choice(np.arange(1, 40), len(later), replace=False))
        resized[int(lane)] = ImageSizes.of([0, *starts], [sizes[lane], *later])
    fed = np.concatenate(frames).astype(np.int64)
    lanes = Lanes(offsets, fed, np.concatenate(boxes), sizes, None, resized)
    item = np.sort(random.integers(0, offsets[-1], 3 * offsets[-1]))
    ahead = random.integers(0, 9, len(item))
    return lanes, item, lanes.frames[item] + ahead


def one_lane(boxes: Sequence[Sequence[float]], frames: Sequence[int]) -> Lanes:
    """The outputs of one sequence of 640x360 pixels."""
    return Lanes(
        np.array([0, len(boxes)]),
        np.array(frames),
        np.array(boxes, float),
        np.array([[640.0, 360.0]]),
    )


def streaming(factory: Any, lanes: Lanes, item: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """The forecasts of forecasters that are fed one box after another."""
    return forecast(lambda box, size: factory(box, size), lanes, item, frame)
