"""A tracker with made-up times, and frames in which everything is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from lae_sim.datasets.frames import Image, ImageSequence
from lae_sim.profile.timed import Answer


def bright_frame(x: float, y: float, w: int = 12, h: int = 10, size: tuple[int, int] = (96, 64)):
    """A dark frame with one bright target at whole pixels."""
    frame = np.zeros((size[1], size[0], 3), np.uint8)
    frame[max(round(y), 0) : max(round(y) + h, 0), max(round(x), 0) : max(round(x) + w, 0)] = 200
    return frame


def bright_sequence(path: Sequence[tuple[float, float]], name: str = "bright") -> ImageSequence:
    """A target of 12x10 pixels that goes along a path of top left corners."""
    truth = np.array([[x, y, 12, 10] for x, y in path], np.float64)
    return ImageSequence(name, truth, lambda frame: bright_frame(*path[frame]))


class FakeTimed:
    """Finds the bright target if it is within reach of where it searches; takes made-up times.

    Of its calls, one after another, it says the shares of ``stages``, in turns.

    It is stateful: what it answers depends on the frames that it has seen.
    """

    def __init__(
        self,
        times: Sequence[int] = (1_000_000,),
        reach: float = 1e9,
        sets_search: bool = True,
        stages: Sequence[Mapping[str, Fraction]] = ({},),
    ) -> None:
        self.sets_search = sets_search
        self.searches: list[Sequence[float] | None] = []
        self.frames: list[Image] = []
        self.closed = False
        self._times = list(times)
        self._shares = list(stages)
        self._calls = 0
        self._reach = reach
        self._seen = (0.0, 0.0, 0.0, 0.0)

    def _answer(self, box: Any, score: float | None) -> Answer:
        elapsed_ns = self._times[self._calls % len(self._times)]
        shares = self._shares[self._calls % len(self._shares)]
        self._calls += 1
        stages = {name: int(share * elapsed_ns) for name, share in shares.items()}
        return Answer(box, score, elapsed_ns, 5, stages)

    def init(self, frame: Image, box: Sequence[float]) -> Answer:
        self._calls = 0
        x, y, w, h = self._seen = tuple(float(value) for value in box)
        return self._answer((x, y, w, h), None)

    def track(self, frame: Image, search: Sequence[float] | None = None) -> Answer:
        self.searches.append(search)
        self.frames.append(frame)
        x, y, w, h = self._seen
        if search is not None:
            assert self.sets_search
            x, y = search[0] - w / 2, search[1] - h / 2
        rows, columns = np.nonzero(frame[:, :, 0])
        if len(rows) == 0 or np.hypot(columns.min() - x, rows.min() - y) > self._reach:
            return self._answer(None, None)
        found = 0.5 * (columns.min() + self._seen[0]) if self._reach == 1e9 else columns.min()
        self._seen = (float(found), float(rows.min()), w, h)
        return self._answer(self._seen, 0.25 + 0.5 * (len(self.frames) % 2))

    def describe(self) -> Mapping[str, Any]:
        return {"name": "fake"}

    def close(self) -> None:
        self.closed = True
