"""Search control for trackers that have none, by moving the frame under them.

The frame is shifted so that the search centre falls where the tracker last saw the target, and the
answer is shifted back. Only whole pixels are shifted, so no pixel is resampled; what comes in from
outside the frame repeats its border. The size of the search cannot be set so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lae_sim.datasets.frames import Image
from lae_sim.profile.timed import Answer, TimedTracker


class Translated:
    """A timed tracker whose search is set by translation; shifting is outside its stopwatch."""

    sets_search = True

    def __init__(self, tracker: TimedTracker) -> None:
        self._tracker = tracker
        self._offset = (0, 0)  # of the shifted frame's origin in the frame, pixels
        self._seen = (0.0, 0.0)  # where the tracker last saw the target, in shifted coordinates

    def init(self, frame: Image, box: Sequence[float]) -> Answer:
        """Start on a new sequence, unshifted."""
        self._offset = (0, 0)
        self._seen = (box[0] + box[2] / 2, box[1] + box[3] / 2)
        return self._tracker.init(frame, box)

    def track(self, frame: Image, search: Sequence[float] | None = None) -> Answer:
        """Find the target in the next frame; without ``search`` the last shift stands."""
        if search is not None:
            self._offset = (round(search[0] - self._seen[0]), round(search[1] - self._seen[1]))
        dx, dy = self._offset
        answer = self._tracker.track(shifted(frame, dx, dy))
        if answer.box is None:
            return answer
        x, y, w, h = answer.box
        self._seen = (x + w / 2, y + h / 2)
        return replace(answer, box=(x + dx, y + dy, w, h))

    def describe(self) -> Mapping[str, Any]:
        """What the tracker says of itself."""
        return self._tracker.describe()

    def close(self) -> None:
        """End the tracker."""
        self._tracker.close()


def shifted(frame: Image, dx: int, dy: int) -> Image:
    """The frame seen through a window moved by ``dx, dy`` pixels; its border is repeated."""
    import cv2

    if dx == dy == 0:
        return frame
    height, width = frame.shape[:2]
    matrix = np.array([[1, 0, dx], [0, 1, dy]], np.float64)
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(
        frame, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return moved.astype(np.uint8, copy=False)
