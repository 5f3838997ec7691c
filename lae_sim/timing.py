"""Statistics of the processing times in a trace: distribution, drift over the run, stalls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim.boxes import Floats
from lae_sim.engine import Ints
from lae_sim.recording import Recording

STALL = 10
"""A call is a stall if it takes more than so many times the median."""


@dataclass(frozen=True, eq=False)
class SequenceTimes:
    """What the calls of one sequence took.

    Attributes:
        name: the sequence's name.
        init_ns: time of the initialisation on frame 0, ns.
        frames: the other frames that were processed, int32 [n].
        elapsed_ns: their times in ns, int64 [n].
    """

    name: str
    init_ns: int
    frames: npt.NDArray[np.int32]
    elapsed_ns: Ints

    @classmethod
    def of(cls, recording: Recording) -> SequenceTimes:
        """The times of a recording."""
        frames = np.flatnonzero(recording.elapsed_ns >= 0)[1:].astype(np.int32)
        init = int(recording.elapsed_ns[0])
        return cls(recording.name, init, frames, recording.elapsed_ns[frames])


def summary(elapsed_ns: Ints) -> dict[str, float]:
    """Number, quantiles and mean of times, ms, and ``fps``, calls per second of computing."""
    if not len(elapsed_ns):
        return {"n": 0}
    p50, p90, p95, p99, top = (np.quantile(elapsed_ns, [0.5, 0.9, 0.95, 0.99, 1]) / 1e6).tolist()
    mean = float(elapsed_ns.mean()) / 1e6
    found = {"n": len(elapsed_ns), "mean_ms": mean, "median_ms": p50, "p90_ms": p90}
    found |= {"p95_ms": p95, "p99_ms": p99, "max_ms": top}
    return found | ({"fps": 1e3 / mean} if mean else {})


def share_slower(elapsed_ns: Ints, fps: Fraction) -> float:
    """Share of the calls that take longer than the interval between frames, exactly."""
    return float(np.mean(elapsed_ns > 10**9 // fps)) if len(elapsed_ns) else 0.0


def histogram(elapsed_ns: Ints) -> dict[str, Any]:
    """Counts of times between round ``edges_ms``, and of outliers ``below`` and ``above`` them.

    The edges hold 96 % of the times; where these are more than a factor of 8 apart, the bins grow
    with the time.

    Args:
        elapsed_ns: times in ns, int64 [n], n > 0.
    """
    ms = elapsed_ns / 1e6
    low, high = np.quantile(ms, [0.02, 0.98]).tolist()
    if high > 8 * low > 0:
        around = np.geomspace(0.95 * low, 1.05 * high, 14)
        edges = np.array([float(f"{edge:.2g}") for edge in around])
    else:
        step = float(f"{max(high - low, high / 50, 1e-6) / 12:.1g}")
        edges = np.round(step * np.arange(low // step, high // step + 2), 9)
    return {
        "edges_ms": edges.tolist(),
        "counts": np.histogram(ms, edges)[0].tolist(),
        "below": int((ms < edges[0]).sum()),
        "above": int((ms > edges[-1]).sum()),
    }


def drift(sequences: Sequence[SequenceTimes]) -> dict[str, Any]:
    """Whether the tracker became slower, from sequences in the order in which they were run.

    Compared are the medians of sequences, or of 30 parts of the run if there are fewer than 15
    sequences: the first third with the last, by the rank test of Mann and Whitney (1947).

    Returns:
        ``tenths_ms``, medians of the tenths of the run; ``ratio``, the last third to the first;
        ``slower``, where it exceeds 1.1 and not by chance (1 %, one-sided). Empty if there are
        fewer than 100 calls.
    """
    times = [sequence.elapsed_ns for sequence in sequences if len(sequence.elapsed_ns)]
    run = np.concatenate(times) if times else np.zeros(0)
    if len(run) < 100:
        return {}
    medians = _medians(times if len(times) >= 15 else np.array_split(run, 30))
    third = len(medians) // 3
    first, last = np.sort(medians[:third]), medians[-third:]
    # how often a value of the last third exceeds one of the first, ties counting half
    wins = sum(np.searchsorted(first, last, side).sum() / 2 for side in ("left", "right"))
    z = (wins - third**2 / 2) / math.sqrt(third**2 * (2 * third + 1) / 12)
    ratio = float(np.median(last) / max(np.median(first), 1e-6))
    return {
        "tenths_ms": _medians(np.array_split(run, 10)).tolist(),
        "ratio": ratio,
        "slower": bool(ratio > 1.1 and z > 2.33),
    }


def first_calls(sequences: Sequence[SequenceTimes]) -> dict[str, float]:
    """The first call after each initialisation: median, ms, and ratio to the sequence's others."""
    times = [sequence.elapsed_ns for sequence in sequences if len(sequence.elapsed_ns) > 1]
    if not times:
        return {}
    ratios = [part[0] / max(np.median(part[1:]), 1) for part in times]
    return {
        "median_ms": float(np.median([part[0] for part in times])) / 1e6,
        "ratio": float(np.median(ratios)),
    }


def stalls(sequences: Sequence[SequenceTimes]) -> list[dict[str, Any]]:
    """Calls that took over ten times the median of the run and of their sequence, longest first."""
    times = [sequence.elapsed_ns for sequence in sequences]
    middle = np.median(np.concatenate(times)) if sum(map(len, times)) else 0
    found = []
    for sequence in sequences:
        ns = sequence.elapsed_ns
        for call in np.flatnonzero(ns > STALL * max(middle, np.median(ns) if len(ns) else 0)):
            stall = {"sequence": sequence.name, "frame": int(sequence.frames[call])}
            found.append({**stall, "ms": int(ns[call]) / 1e6, "first_call": bool(call == 0)})
    return sorted(found, key=lambda stall: -stall["ms"])


def _medians(parts: Sequence[Any]) -> Floats:
    """Medians of arrays of ns, ms."""
    return np.array([np.median(part) for part in parts]) / 1e6
