"""Several forecasters of which the one answers that was lately closest.

Closeness is the distance of the centres of forecast and output, summed over the last ten outputs:
the follow-the-leader rule of prediction with expert advice (Cesa-Bianchi and Lugosi, "Prediction,
Learning, and Games", 2006, Sec. 3.2) over a sliding window.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lae_sim.boxes import Floats, centre
from lae_sim.engine import Ints
from lae_sim.forecast import Forecaster, ForecasterFactory, ImageSize, Lanes, forecast

RECENT = 10


@dataclass(frozen=True, eq=False)
class Closest:
    """A factory of several forecasters run side by side.

    Attributes:
        several: their factories. The first one answers until outputs tell them apart.
    """

    several: tuple[ForecasterFactory, ...]

    def __call__(self, box: Sequence[float], image_size: ImageSize = None) -> Forecaster:
        """The forecasters of one sequence."""
        return _Several([factory(box, image_size) for factory in self.several])

    def forecast_lanes(self, lanes: Lanes, item: Ints, frame: Ints) -> Floats:
        """The same for many lanes at once."""
        fed = np.setdiff1d(np.arange(len(lanes.frames)), lanes.offsets[:-1])
        first, errors, boxes = lanes.first(item), [], []
        for factory in self.several:
            missed = np.zeros(len(lanes.frames))
            foretold = forecast(factory, lanes, fed - 1, lanes.frames[fed])
            missed[fed] = _distance(foretold, lanes.boxes[fed])
            recent = item[:, None] - np.arange(RECENT)
            errors.append(missed[np.maximum(recent, first[:, None])].sum(axis=1))
            boxes.append(forecast(factory, lanes, item, frame))
        answers: Floats = np.stack(boxes)[np.argmin(errors, axis=0), np.arange(len(item))]
        return answers


class _Several:
    def __init__(self, several: Sequence[Forecaster]) -> None:
        self._several = several
        self._errors: deque[Floats] = deque(maxlen=RECENT)

    def update(self, frame: int, box: Sequence[float]) -> None:
        foretold = np.array([each.predict(frame) for each in self._several], np.float64)
        self._errors.append(_distance(foretold, np.array([box], np.float64)))
        for each in self._several:
            each.update(frame, box)

    def predict(self, frame: int) -> Sequence[float]:
        best = int(np.argmin(sum(self._errors))) if self._errors else 0
        return self._several[best].predict(frame)


def _distance(a: Floats, b: Floats) -> Floats:
    """Distance of centres, float64 [n]."""
    apart = centre(a) - centre(b)
    return np.hypot(apart[:, 0], apart[:, 1])
