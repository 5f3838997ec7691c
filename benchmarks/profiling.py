"""What timing a tracker costs.

The tracker works for 1 or 5 ms and notes how long that took, so that what the stopwatch reads
beyond it is known for each frame, on a busy machine too. The rest of the round trip, in which
frames are handed over, is outside of what is measured.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import numpy as np
from targets import Line

from lae_sim.profile.device import text
from lae_sim.profile.sampler import Sampler
from lae_sim.profile.sensors import Sensor
from lae_sim.profile.timed import TimedTracker
from lae_sim.profile.worker import InProcess, Worker
from lae_sim.trackers.protocol import Image

WORKS_NS = {1_000_000: "stopwatch", 5_000_000: "stopwatch-5ms"}  # and what may be read beyond
SIZES = ((640, 480), (1920, 1080))
FILE = Path("/proc/loadavg")  # of the size of a sensor's
HEAD = ("tracker", "what", "median", "ratio to the work", "target")


class Busy:
    """A tracker that works for a time; its score is how many nanoseconds it really took."""

    def __init__(self, work_ns: int) -> None:
        self._work_ns = work_ns

    def init(self, frame: Image, box: Sequence[float]) -> None:
        """Remember nothing."""

    def track(self, frame: Image) -> tuple[Sequence[float], float]:
        """Work without rest."""
        start = now = time.perf_counter_ns()
        while now - start < self._work_ns:
            now = time.perf_counter_ns()
        return (1.0, 2.0, 3.0, 4.0), float(now - start)


def medians(tracker: TimedTracker, frame: Image, calls: int) -> tuple[float, float, float]:
    """Median ns of a round trip, of the work, and of what the stopwatch reads beyond the work."""
    tracker.init(frame, (1, 2, 3, 4))
    found = []
    for _ in range(calls):
        start = time.perf_counter_ns()
        answer = tracker.track(frame)
        end = time.perf_counter_ns()
        assert answer.score
        found.append((end - start, answer.score, answer.elapsed_ns - answer.score))
    trips, works, beyond = zip(*found)
    return statistics.median(trips), statistics.median(works), statistics.median(beyond)


def measured(quick: bool) -> list[Line]:
    """Lines for each frame size, in a worker process and in this one.

    Args:
        quick: with fewer calls of the tracker.
    """
    found = []
    kinds = {"worker process": Worker, "in this process": InProcess}
    for width, height in SIZES:
        frame = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
        copy = statistics.median(copy_ns(frame) for _ in range(21))
        for (work_ns, target), (name, kind) in product(WORKS_NS.items(), kinds.items()):
            with beside_this(), kind("profiling:Busy", {"work_ns": work_ns}) as tracker:
                trip, work, beyond = medians(tracker, frame, 100 if quick else 400)
            around = trip - work - beyond
            what = f"{work_ns // 10**6} ms, {width}x{height}, {name}"
            within = f"{beyond / 1e3:.1f} us", f"{beyond / work:.4f}"
            found += [
                Line([what, "round trip", f"{trip / 1e6:.3f} ms", f"{trip / work:.4f}"]),
                Line([what, "in the time measured", *within], {target: beyond / 1e3}),
                Line([what, "around it", f"{around / 1e3:.0f} us", f"{around / work:.4f}"]),
                Line([what, "(a copy of the frame)", f"{copy / 1e3:.0f} us", f"{copy / work:.4f}"]),
            ]
    return [*found, sampled(frame, 100 if quick else 400)]


def sampled(frame: Image, calls: int) -> Line:
    """The line of a 5 ms tracker while the device's power and clocks are read, from 8 files."""
    sensors = [Sensor(str(n), "power", lambda: float(len(text(FILE)))) for n in range(8)]
    with (
        beside_this(),
        Sampler(sensors) as sampler,
        Worker("profiling:Busy", {"work_ns": 5_000_000}) as tracker,
    ):
        _, work, beyond = medians(tracker, frame, calls)
    what = f"5 ms, {frame.shape[1]}x{frame.shape[0]}, worker process, sensors read"
    assert sampler.readings
    figures = f"{beyond / 1e3:.1f} us", f"{beyond / work:.4f}"
    return Line([what, "in the time measured", *figures], {"stopwatch-5ms": beyond / 1e3})


@contextmanager
def beside_this() -> Iterator[None]:
    """Work in this folder, where the worker finds this module."""
    before = os.getcwd()
    os.chdir(Path(__file__).parent)
    try:
        yield
    finally:
        os.chdir(before)


def copy_ns(frame: Image) -> int:
    """How long one copy of a frame takes, in ns."""
    start = time.perf_counter_ns()
    frame.copy()
    return time.perf_counter_ns() - start
