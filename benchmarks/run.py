"""Speed and memory, side by side in one run: ``make bench`` or ``python benchmarks/run.py``.

Each figure stands beside its peer or its floor, measured in turn with it, and the medians of
several rounds are compared. The input has the size of UAV123: 123 sequences, 112,578 frames.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import simpy
from filterpy.kalman import KalmanFilter

from lae_sim import Metadata, Recording, Trace, replay_trace, simulate, write_trace
from lae_sim._compiled import SWITCH
from lae_sim.engine import Clock, latest
from lae_sim.evaluation import evaluate_groups
from lae_sim.evaluation.metrics import METRICS
from lae_sim.forecast.base import ForecasterFactory, Hold, Lanes, defines, forecast
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.report.table import aligned

SEQUENCES, FRAMES = 123, 112_578
ELAPSED_NS = 47_000_000
CLOCK = Clock(30, 10**9)
READ = """
import sys
import pyarrow.parquet as pq
pq.ParquetFile(sys.argv[1]).read()
"""
READ_BATCHES = """
import sys
import pyarrow.parquet as pq
for _ in pq.ParquetFile(sys.argv[1], pre_buffer=False).iter_batches(65536, use_threads=False):
    pass
"""
REPLAY = """
import contextlib, io, sys
from lae_sim.cli.replay import main
with contextlib.redirect_stdout(io.StringIO()):
    assert main([*sys.argv[1:], "--json"]) == 0
"""
# The high-water mark of this process alone: ru_maxrss would count the process that it forked from.
PRINT_PEAK = """
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


def lengths() -> np.ndarray:
    """Sequence lengths that add up to the frames of UAV123."""
    weights = np.random.default_rng(0).lognormal(0, 0.6, SEQUENCES)
    ends = np.round(np.cumsum(weights) / weights.sum() * FRAMES).astype(int)
    return np.diff(ends, prepend=0)


def recordings(sizes: np.ndarray) -> Iterator[Recording]:
    """Targets on random walks, tracked with noise, at 47 ms with jitter."""
    for index, size in enumerate(sizes):
        rng = np.random.default_rng([1, index])
        path = np.cumsum(np.cumsum(rng.normal(0, 0.3, (size, 2)), axis=0), axis=0) % 900
        truth = np.concatenate([path, np.full((size, 2), 60.0)], axis=1)
        elapsed = (ELAPSED_NS * rng.lognormal(0, 0.1, size)).astype(np.int64)
        yield Recording.new(f"s{index:06}", truth, truth + rng.normal(0, 3, (size, 4)), elapsed)


def seconds(work: Callable[[], object]) -> float:
    """How long a call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def medians(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each, measured in turn."""
    taken: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            taken[name].append(seconds(work))
    return {name: statistics.median(times) for name, times in taken.items()}


def plain_loop(length: int) -> list[tuple[int, int, int]]:
    """The schedule of `latest` as a bare loop: the floor of the engine."""
    interval, elapsed = CLOCK.frame_ticks, ELAPSED_NS * CLOCK.ticks_per_ns
    calls, frame, start, end = [], 0, 0, length * CLOCK.frame_ticks
    while True:
        ready = start + elapsed
        calls.append((frame, start, ready))
        newest = ready // interval
        frame = newest if newest > frame else frame + 1
        start = max(ready, frame * interval)
        if start >= end:
            return calls


def timeouts_alone(count: int) -> None:
    """SimPy's own cost: a process that does nothing but wait, as often as the engine does."""
    environment = simpy.Environment()

    def wait() -> Iterator[simpy.Event]:
        for _ in range(count):
            yield environment.timeout(1)

    environment.process(wait())
    environment.run()


def camera_and_queries(length: int) -> list[tuple[int, int]]:
    """The plain event-driven design: a camera, a tracker and a query process, an event each."""
    environment = simpy.Environment()
    interval, elapsed = CLOCK.frame_ticks, ELAPSED_NS * CLOCK.ticks_per_ns
    newest, answer, pairs = -1, 0, []
    arrival = environment.event()

    def camera() -> Iterator[simpy.Event]:
        nonlocal newest, arrival
        for frame in range(length):
            newest = frame
            arrived, arrival = arrival, environment.event()
            arrived.succeed()
            yield environment.timeout(interval)

    def tracker() -> Iterator[simpy.Event]:
        nonlocal answer
        last = -1
        while True:
            while newest == last:
                yield arrival
            last = newest
            yield environment.timeout(elapsed)
            answer = last

    def queries() -> Iterator[simpy.Event]:
        for frame in range(length):
            pairs.append((frame, answer))
            yield environment.timeout(interval)

    for process in (camera, tracker, queries):
        environment.process(process())
    environment.run(until=length * interval)
    return pairs


def engine_lines(rounds: int) -> list[list[str]]:
    """The engine against its floor and the plain event-driven design, per world frame."""
    sizes = lengths().tolist()
    service = lambda frame: ELAPSED_NS  # noqa: E731
    timeouts = [len(plain_loop(size)) for size in sizes]
    found = medians(
        {
            "engine": lambda: [simulate(size, CLOCK, service, latest) for size in sizes],
            "plain loop, no SimPy": lambda: [plain_loop(size) for size in sizes],
            "SimPy alone, as many timeouts": lambda: [timeouts_alone(n) for n in timeouts],
            "camera + query processes": lambda: [camera_and_queries(size) for size in sizes],
        },
        rounds,
    )
    return lines("schedule, constant 47 ms", found, "engine", FRAMES, "us per world frame", 1.0)


def dense_filter() -> KalmanFilter:
    """The paper's filter in filterpy (DESIGN: F, Q, R, H, P0)."""
    dense = KalmanFilter(dim_x=8, dim_z=4)
    dense.H = np.eye(4, 8)
    dense.R = 10 * np.eye(4)
    dense.P = 100 * np.eye(8)
    return dense


def forecaster_lines(rounds: int) -> list[list[str]]:
    """An update and a prediction of each forecaster, against filterpy and the paper's speed.

    One box after another, and over many lanes at once. The paper's 500 frames/s are 2,000 us.
    """
    count, many = 200, 1000
    rng = np.random.default_rng(2)
    boxes = rng.normal(100, 5, (many * (count + 1), 4))
    frames = np.tile(np.arange(count + 1) * 2, many)
    offsets = np.arange(many + 1) * (count + 1)
    lanes = Lanes(offsets, frames, boxes, np.full((many, 2), np.inf))
    one = boxes[: count + 1].tolist()
    named = ["constant-velocity", "kalman", "kalman-lae-pvt", "kalman:decay=0.99,state=centre"]
    named += ["least-squares", "g-h", "imm", "learned", "guarded+kalman"]
    factories = {name: load_forecaster(name) for name in named}

    def streaming(factory: ForecasterFactory) -> None:
        forecaster = factory(one[0], None)
        for k in range(1, count + 1):
            forecaster.update(2 * k, one[k])
            forecaster.predict(2 * k + 3)

    def filterpy() -> None:
        dense = dense_filter()
        transition, noise = np.eye(8), 4.0 * np.eye(8)
        transition[:4, 4:] = 2 * np.eye(4)
        ahead = np.eye(8)
        ahead[:4, 4:] = 3 * np.eye(4)
        for k in range(1, count + 1):
            dense.predict(F=transition, Q=noise)
            dense.update(boxes[k])
            ahead @ dense.x

    works = {"kalman in filterpy": filterpy}
    works |= {name: partial(streaming, factory) for name, factory in factories.items()}
    found = medians(works, rounds)
    unit = "us per update and prediction"
    what = "forecaster, one box at a time"
    rows = [
        [*row[:-1], "<= 40" if row[1] == "learned" else ""]
        for row in lines(what, found, "kalman in filterpy", count, unit)
    ]
    asked = np.arange(len(frames))
    together = {
        name: partial(forecast, factory, lanes, asked, frames + 3)
        for name, factory in factories.items()
        if defines(factory, "forecast_lanes")
    }
    for name, work in together.items():
        taken = medians({name: work}, min(rounds, 3))[name] / len(asked) * count
        rows += [
            [f"forecaster, {many:,} lanes at once", name, f"{taken / count * 1e6:.3f} {unit}"]
            + [f"{taken / found['kalman in filterpy']:.4f}"]
            + ["<= 1.5" if name == "learned" else ""]
        ]
    return rows


def switched(way: str, work: Callable[[], object]) -> Callable[[], object]:
    """The same work, without compiled kernels ("0") or with them ("1")."""

    def done() -> None:
        before = os.environ.get(SWITCH)
        os.environ[SWITCH] = way
        try:
            work()
        finally:
            os.environ.pop(SWITCH)
            if before is not None:
                os.environ[SWITCH] = before

    return done


def has_kernels() -> bool:
    """Whether numba is installed, and not switched off."""
    return importlib.util.find_spec("numba") is not None and os.environ.get(SWITCH) != "0"


def kernel_lines(trace: str, rounds: int) -> list[list[str]]:
    """Compiled kernels beside NumPy's lines, in one process that has them compiled.

    They load numba, which other lines must not: these are the last of their process.
    """
    if not has_kernels():
        return [["compiled kernels", "numba is not installed: the extra fast", "", "", ""]]
    rng = np.random.default_rng(3)
    many, count = 1000, 900
    offsets = np.arange(many + 1) * count
    frames = np.tile(np.arange(count) * 2, many)
    lanes = Lanes(
        offsets, frames, rng.normal(100, 5, (many * count, 4)), np.full((many, 2), np.inf)
    )
    asked = np.arange(len(frames))
    runs = list(replay_trace(trace, search="off"))
    metadata = Metadata.new("30", "every-frame")
    kalman = load_forecaster("kalman")

    def scored(**factories: ForecasterFactory) -> None:
        for _ in evaluate_groups(runs, metadata, factories, SIGMA_GRID):
            pass

    works: dict[str, tuple[Callable[[], object], float, str, str]] = {
        f"kalman, {many:,} lanes": (
            lambda: forecast(kalman, lanes, asked, frames + 3),
            len(asked),
            "us per update and prediction",
            "<= 0.02 us",
        ),
        "51 sigmas, hold": (lambda: scored(hold=Hold), FRAMES, "us per world frame", ""),
        "51 sigmas, hold + kalman": (
            lambda: scored(hold=Hold, kalman=kalman),
            FRAMES,
            "us per world frame",
            "",
        ),
    }
    rows = []
    for name, (work, size, unit, target) in works.items():
        switched("1", work)()  # compiles
        ways = {"NumPy": switched("0", work), "compiled": switched("1", work)}
        taken = medians(ways, rounds)
        rows += [
            [f"compiled kernels: {name}", way, f"{each / size * 1e6:.4f} {unit}"]
            + [f"{each / taken['NumPy']:.3f}", target if way == "compiled" else ""]
            for way, each in taken.items()
        ]
    return rows


def lines(
    what: str,
    found: dict[str, float],
    base: str,
    count: int,
    unit: str,
    target: float | None = None,
) -> list[list[str]]:
    """Table lines of seconds over a number of items, with ratios to the base."""
    return [
        [what, name, f"{taken / count * 1e6:.3f} {unit}", f"{taken / found[base]:.2f}"]
        + [f"<= {target:g}" if target and name == base else ""]
        for name, taken in found.items()
    ]


def process(*arguments: str) -> Callable[[], object]:
    """A whole Python process, its output thrown away."""
    command = [sys.executable, *arguments]
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def process_lines(trace: str, rounds: int) -> list[list[str]]:
    """Whole processes, imports included, against reading the file."""
    plain = ("-m", "lae_sim.replay", trace, "--search", "off", "--json")
    grid = (*plain, "--sigma-grid", "--forecaster")
    works = {
        "read the Parquet file": process("-c", READ, trace),
        "sigma = 0, hold": process(*plain, "--forecaster", "hold"),
        "51 sigmas, hold": process(*grid, "hold"),
        "51 sigmas, hold + kalman": process(*grid, "hold", "kalman"),
        "51 sigmas, hold + kalman-lae-pvt": process(*grid, "hold", "kalman-lae-pvt"),
        "--help": process("-m", "lae_sim.replay", "--help"),
    }
    targets = {"51 sigmas, hold": 2.5, "51 sigmas, hold + kalman": 3.0, "--help": 0.3}
    found = medians(works, rounds)
    return [
        ["whole process, UAV123 size", name, f"{taken:.2f} s"]
        + [f"{taken / found['read the Parquet file']:.2f}"]
        + [f"<= {targets[name]:g}" if name in targets else ""]
        for name, taken in found.items()
    ]


def hand_lines(trace: str, rounds: int) -> list[list[str]]:
    """Whole processes against the script that one would write instead, and the same scores."""
    found = []
    script = str(Path(__file__).with_name("by_hand.py"))
    for forecasters, times, target in ((["hold"], rounds, 6), (["hold", "kalman"], 1, 100)):
        taken = []
        for _ in range(times):
            by_hand, theirs = printed(script, trace, *forecasters[1:])
            report, ours = printed(
                *("-m", "lae_sim.replay", trace, "--search", "off", "--sigma-grid", "--json"),
                *("--forecaster", *forecasters),
            )
            for name in forecasters:
                results = [r for r in report["traces"][0]["results"] if r["forecaster"] == name]
                scores = [[result[metric] for metric in METRICS] for result in results]
                np.testing.assert_allclose(scores, by_hand[name], rtol=0, atol=1e-12)
            taken.append((theirs, ours))
        theirs, ours = (statistics.median(column) for column in zip(*taken))
        what = f"51 sigmas, {' + '.join(forecasters)}: ours against the script"
        found += [
            [what, "by hand (benchmarks/by_hand.py)", f"{theirs:.2f} s", "1.00", ""],
            [what, "ours", f"{ours:.2f} s", f"{theirs / ours:.1f} x as fast", f">= {target}"],
        ]
    return found


def printed(*arguments: str) -> tuple[dict[str, Any], float]:
    """What a whole Python process prints, JSON, and how long it takes."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout), time.perf_counter() - start


def gap_pass(count: int) -> Iterator[Recording]:
    """Restarts of a tracker that reaches .7 search sides, give or take a tenth."""
    random = np.random.default_rng(2)
    box = np.array([100.0, 100, 60, 60])  # whose search side is 120
    for k, distance in enumerate(random.uniform(0, 1.4, count)):
        then = box + [120 * distance, 0, 0, 0]
        answer = then if distance < random.logistic(0.7, 0.06) else then + 500
        elapsed = np.full(2, ELAPSED_NS)
        yield Recording.new(f"r{k:04}@1+1", np.array([box, then]), np.array([box, answer]), elapsed)


def search_lines(trace: str, folder: Path, rounds: int) -> list[list[str]]:
    """Whole processes with the search model, against one without."""
    gaps = str(folder / "gaps.parquet")
    write_trace(Trace(Metadata.new("30", "restarts"), gap_pass(1000)), gaps)
    grid = ("-m", "lae_sim.replay", trace, "--sigma-grid", "--json", "--search")
    works = {
        "no search model": process(*grid, "off"),
        "c = 0.7": process(*grid, "c=0.7"),
        "c unknown": process(*grid, "trace"),
        "c measured, 40 draws": process(*grid, "trace", "--strided", gaps),
    }
    targets = {"c = 0.7": "<= 2", "c measured, 40 draws": "<= 15"}
    found = medians(works, rounds)
    base = found["no search model"]
    return [
        ["51 sigmas, hold + kalman", name, f"{taken:.2f} s", f"{taken / base:.2f}"]
        + [targets.get(name, "")]
        for name, taken in found.items()
    ]


def peak(code: str, *arguments: str) -> tuple[float, float]:
    """Peak resident memory in MiB and seconds of a Python process (Linux)."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code + PRINT_PEAK, *arguments], check=True, stdout=subprocess.PIPE
    )
    return int(done.stdout.split()[-1]) / 1024, time.perf_counter() - start


def memory_lines(folder: Path, sequences: int) -> list[list[str]]:
    """Peak memory of a trace of very many sequences, against reading the file alone."""
    trace = str(folder / "many.parquet")
    write_trace(Trace(Metadata.new("30", "every-frame"), recordings(np.full(sequences, 30))), trace)
    found = {
        "read the file in batches": peak(READ_BATCHES, trace),
        "read the whole file": peak(READ, trace),
        "replay, hold + kalman": peak(REPLAY, trace),
        "the same, 51 sigmas": peak(REPLAY, trace, "--sigma-grid"),
    }
    base = found["read the file in batches"][0]
    targets = {"replay, hold + kalman": "< 150", "the same, 51 sigmas": "< 300"}
    return [
        [f"peak memory, {sequences:,} sequences", f"{name} ({taken:.1f} s)", f"{mib:.0f} MiB"]
        + [f"{mib / base:.2f}", targets.get(name, "")]
        for name, (mib, taken) in found.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each (default: 5)")
    parser.add_argument("--sequences", type=int, default=100_000, help="for the peak memory")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trace = folder / "uav123-sized.parquet"
        write_trace(Trace(Metadata.new("30", "every-frame"), recordings(lengths())), trace)
        found = engine_lines(arguments.rounds) + forecaster_lines(arguments.rounds)
        found += process_lines(str(trace), arguments.rounds)
        found += hand_lines(str(trace), arguments.rounds)
        found += search_lines(str(trace), folder, arguments.rounds)
        found += memory_lines(folder, arguments.sequences)
        found += kernel_lines(str(trace), arguments.rounds)
    print(aligned(["what", "how", "median", "ratio", "target"], found))


if __name__ == "__main__":
    main()
