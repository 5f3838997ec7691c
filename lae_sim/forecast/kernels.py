"""The Kalman filter over lanes, compiled (see :mod:`lae_sim._compiled`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim._compiled import kernel


@kernel
def overlap(a: Any, b: Any) -> float:
    """Intersection over union of two boxes, arrays or tuples, as :func:`lae_sim.boxes.iou`."""
    shared = np.maximum(np.minimum(a[0] + a[2], b[0] + b[2]) - np.maximum(a[0], b[0]), 0.0)
    shared *= np.maximum(np.minimum(a[1] + a[3], b[1] + b[3]) - np.maximum(a[1], b[1]), 0.0)
    union = a[2] * a[3] + b[2] * b[3] - shared
    ratio = shared / union if union > 0 else 0.0
    return float(np.minimum(np.maximum(ratio, 0.0), 1.0))


@kernel
def kalman_lanes(
    offsets: Ints,
    frames: Ints | Floats,
    measured: Floats,
    kept: Floats,
    reached: Floats,
    q: float,
    r: float,
    p0: float,
    restart_iou: float,
    item: Ints,
    frame: Ints | Floats,
    forecasts: Floats,
) -> None:
    """Filter lanes one after another, and forecast from each item what is asked.

    The equations are those of :class:`.kalman._Filter`, in the same order.

    Args:
        offsets, frames: see :class:`.base.Lanes`.
        measured: positions of the filter's state, float64 [N, 4].
        kept, reached: what is left of the velocity after 0, 1, 2, ... frames, and how many frames'
            worth it is; empty where it does not decay.
        q, r, p0: see :class:`.kalman.TunedKalman`.
        restart_iou: see :meth:`.kalman._Filter.update`; below 0 nothing restarts the filter.
        item, frame: see :func:`.base.forecast`.
        forecasts: positions: written, float64 [P, 4].
    """
    decays = len(reached) > 0
    position, velocity = np.empty(4), np.empty(4)
    p = 0
    for lane in range(len(offsets) - 1):
        a, b, c = p0, 0.0, p0
        for k in range(offsets[lane], offsets[lane + 1]):
            box = measured[k]
            restarts = k == offsets[lane]
            if not restarts:
                interval = float(frames[k] - frames[k - 1])
                keep, reach = 1.0, interval
                if decays:
                    keep, reach = kept[int(interval)], reached[int(interval)]
                noise = q * (interval * interval)
                a += 2.0 * reach * b
                a += reach * reach * c
                a += noise
                b += reach * c
                b *= keep
                c *= keep * keep
                c += noise
                variance = a + r
                position_gain, velocity_gain = a / variance, b / variance
                c -= velocity_gain * b
                b -= position_gain * b
                a -= position_gain * a
                for i in range(4):
                    position[i] += reach * velocity[i]
                restarts = restart_iou >= 0 and overlap(position, box) < restart_iou
                for i in range(4):
                    innovation = box[i] - position[i]
                    position[i] += position_gain * innovation
                    velocity[i] = velocity[i] * keep + innovation * velocity_gain
            if restarts:
                a, b, c = p0, 0.0, p0
                for i in range(4):
                    position[i], velocity[i] = box[i], 0.0
            while p < len(item) and item[p] == k:
                ahead = float(frame[p] - frames[k])
                if decays:
                    ahead = reached[int(ahead)]
                for i in range(4):
                    forecasts[p, i] = position[i] + ahead * velocity[i]
                p += 1
