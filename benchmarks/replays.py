"""Speed and memory of the engine, of forecasters and of commands on one trace.

Each figure stands beside its peer or its floor, measured in turn with it, and the medians of
several rounds are compared. The input has the size of UAV123: 123 sequences, 112,578 frames.
"""

from __future__ import annotations

import importlib.util
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import simpy
from filterpy.kalman import KalmanFilter
from targets import Line

from lae_sim import Metadata, Recording, Trace, replay_trace, simulate, write_trace
from lae_sim._compiled import SWITCH
from lae_sim.engine import Clock, latest
from lae_sim.evaluation import evaluate_groups
from lae_sim.evaluation.metrics import METRICS
from lae_sim.forecast.base import ForecasterFactory, Hold, Lanes, defines, forecast
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.world import SIGMA_GRID

SEQUENCES, FRAMES = 123, 112_578
DTB70 = 70, 15_777  # its sequences and frames
MANY = 100_000  # sequences of the trace that tells how memory grows
HEAD = ("what", "how", "median", "ratio", "target")
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


def lengths(sequences: int = SEQUENCES, frames: int = FRAMES) -> np.ndarray:
    """Sequence lengths that add up to the frames of a dataset: UAV123."""
    weights = np.random.default_rng(0).lognormal(0, 0.6, sequences)
    ends = np.round(np.cumsum(weights) / weights.sum() * frames).astype(int)
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


def engine_lines(rounds: int) -> list[Line]:
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
    unit = "us per world frame"
    return lines("schedule, constant 47 ms", found, "engine", FRAMES, unit, {"engine": "engine"})


def dense_filter() -> KalmanFilter:
    """The paper's filter in filterpy (DESIGN: F, Q, R, H, P0)."""
    dense = KalmanFilter(dim_x=8, dim_z=4)
    dense.H = np.eye(4, 8)
    dense.R = 10 * np.eye(4)
    dense.P = 100 * np.eye(8)
    return dense


def forecaster_lines(rounds: int) -> list[Line]:
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
    rows = lines(what, found, "kalman in filterpy", count, unit, {"learned": "learned"})
    asked = np.arange(len(frames))
    together = {
        name: partial(forecast, factory, lanes, asked, frames + 3)
        for name, factory in factories.items()
        if defines(factory, "forecast_lanes")
    }
    for name, work in together.items():
        taken = medians({name: work}, min(rounds, 3))[name] / len(asked)
        ratio = f"{taken * count / found['kalman in filterpy']:.4f}"
        cells = [f"forecaster, {many:,} lanes at once", name, f"{taken * 1e6:.3f} {unit}", ratio]
        rows.append(Line(cells, {"learned-lanes": taken * 1e6} if name == "learned" else {}))
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


def kernel_lines(trace: str, rounds: int) -> list[Line]:
    """Compiled kernels beside NumPy's lines, in one process that has them compiled.

    They load numba, which other lines must not: these come after them.
    """
    if not has_kernels():
        return [Line(["compiled kernels: numba is not installed, the extra fast", "", "", ""])]
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

    update, frame = "us per update and prediction", "us per world frame"
    works: dict[str, tuple[Callable[[], object], int, str]] = {
        f"kalman, {many:,} lanes": (
            lambda: forecast(kalman, lanes, asked, frames + 3),
            len(asked),
            update,
        ),
        "51 sigmas, hold": (lambda: scored(hold=Hold), FRAMES, frame),
        "51 sigmas, hold + kalman": (lambda: scored(hold=Hold, kalman=kalman), FRAMES, frame),
    }
    rows = []
    for name, (work, size, unit) in works.items():
        switched("1", work)()  # compiles
        ways = {"NumPy": switched("0", work), "compiled": switched("1", work)}
        targets = {"compiled": "kalman-lanes"} if unit == update else {}
        rows += lines(
            f"compiled kernels: {name}", medians(ways, rounds), "NumPy", size, unit, targets
        )
    return rows


def lines(
    what: str,
    found: Mapping[str, float],
    base: str,
    count: int,
    unit: str,
    targets: Mapping[str, str],
) -> list[Line]:
    """Lines of seconds over a number of items, with ratios to the base, and targets of some."""
    return [
        Line(
            [what, name, f"{taken / count * 1e6:.4g} {unit}", f"{taken / found[base]:.2f}"],
            {targets[name]: taken / count * 1e6} if name in targets else {},
        )
        for name, taken in found.items()
    ]


def ratio_lines(
    what: str, found: Mapping[str, float], base: str, targets: Mapping[str, str]
) -> list[Line]:
    """Lines of seconds, with ratios to the base, and the targets of some ratios."""
    return [
        Line(
            [what, name, f"{taken:.2f} s", f"{taken / found[base]:.2f}"],
            {targets[name]: taken / found[base]} if name in targets else {},
        )
        for name, taken in found.items()
    ]


def process(*arguments: str) -> Callable[[], object]:
    """A whole Python process, its output thrown away."""
    command = [sys.executable, *arguments]
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def process_lines(trace: str, rounds: int) -> list[Line]:
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
    targets = {
        "51 sigmas, hold": "trace-hold",
        "51 sigmas, hold + kalman": "trace-kalman",
        "--help": "help",
    }
    found = medians(works, rounds)
    return ratio_lines("whole process, UAV123 size", found, "read the Parquet file", targets)


def compare_lines(folder: Path, rounds: int) -> list[Line]:
    """Whole processes that compare forecasters, one of them trained in folds."""
    trace = str(folder / "dtb70-sized.parquet")
    sizes = lengths(*DTB70)
    write_trace(Trace(Metadata.new("30", "every-frame"), recordings(sizes)), trace)
    plain = ("-m", "lae_sim", "compare", trace, "--search", "off", "--json", "--forecaster")
    works = {name: process(*plain, name) for name in ("kalman", "tuned-kalman")}
    taken = medians(works, rounds)
    found = ratio_lines("compare, DTB70 size", taken, "kalman", {})
    return [found[0], replace(found[1], figures={"compare": taken["tuned-kalman"]})]


def hand_lines(trace: str, rounds: int, forecasters: Sequence[str], target: str) -> list[Line]:
    """Whole processes against the script that one would write instead, and the same scores."""
    script = str(Path(__file__).with_name("by_hand.py"))
    taken = []
    for _ in range(rounds):
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
    return [
        Line([what, "by hand (benchmarks/by_hand.py)", f"{theirs:.2f} s", "1.00"]),
        Line(
            [what, "ours", f"{ours:.2f} s", f"{theirs / ours:.1f} x as fast"],
            {target: theirs / ours},
        ),
    ]


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


def search_lines(trace: str, folder: Path, rounds: int) -> list[Line]:
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
    found = medians(works, rounds)
    targets = {"c = 0.7": "search", "c measured, 40 draws": "search-draws"}
    return ratio_lines("51 sigmas, hold + kalman", found, "no search model", targets)


def peak(code: str, *arguments: str) -> tuple[float, float]:
    """Peak resident memory in MiB and seconds of a Python process (Linux)."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code + PRINT_PEAK, *arguments], check=True, stdout=subprocess.PIPE
    )
    return int(done.stdout.split()[-1]) / 1024, time.perf_counter() - start


def memory_lines(folder: Path, sequences: int) -> list[Line]:
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
    targets = {"replay, hold + kalman": "memory", "the same, 51 sigmas": "memory-grid"}
    return [
        Line(
            [f"peak memory, {sequences:,} sequences", f"{name} ({taken:.1f} s)"]
            + [f"{mib:.0f} MiB", f"{mib / base:.2f}"],
            {targets[name]: mib} if name in targets and sequences == MANY else {},
        )
        for name, (mib, taken) in found.items()
    ]


def write_one(folder: Path) -> str:
    """Write the trace that most lines are about."""
    trace = folder / "uav123-sized.parquet"
    write_trace(Trace(Metadata.new("30", "every-frame"), recordings(lengths())), trace)
    return str(trace)


def measured(folder: Path, quick: bool) -> Iterator[list[Line]]:
    """All of these lines, but for those of compiled kernels.

    Args:
        folder: for what is written.
        quick: each once, and without what takes long.
    """
    rounds = 1 if quick else 5
    trace = write_one(folder)
    yield engine_lines(rounds)
    yield forecaster_lines(rounds)
    yield process_lines(trace, rounds)
    yield hand_lines(trace, rounds, ["hold"], "script-hold")
    if not quick:
        yield hand_lines(trace, 1, ["hold", "kalman"], "script-kalman")
    yield compare_lines(folder, rounds)
    yield search_lines(trace, folder, rounds)
    yield memory_lines(folder, MANY // 10 if quick else MANY)
