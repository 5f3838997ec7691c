"""Speed and memory of studies.

Whole processes stand beside a process that reads the same Parquet files, random latencies beside
the SimPy engine on the same times. Seconds are those of the clock, and of all cores together (user
and system). The input has the size of UAV123: 123 sequences, 112,578 frames for each tracker.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import count
from pathlib import Path
from statistics import median

import numpy as np
from replays import CLOCK, FRAMES, has_kernels, lengths, medians, recordings, switched
from targets import Line

from lae_sim import Metadata, Recording, Trace, replay_trace, simulate, write_trace
from lae_sim._compiled import SWITCH
from lae_sim.comparison.pairs import Member, pairs_of
from lae_sim.engine import Times, latest, simulate_lanes
from lae_sim.evaluation import evaluate_groups
from lae_sim.forecast import Hold
from lae_sim.replay import Repetitions, Runs, bootstrap

RATES = (15, 20, 25, 30, 40, 50, 60, 90)  # frames/s of the trackers
REPETITIONS = 81  # 9,963 lanes
HEAD = ("what", "how", "median", "all cores", "MiB: worker, parent", "ratio", "target")
READ = """
import sys
import pyarrow.parquet as pq
for path in sys.argv[1:]:
    pq.ParquetFile(path).read()
"""


@dataclass(frozen=True)
class Cost:
    """What a process took: seconds, and peak memory in MiB of it and of its largest worker."""

    wall: float
    cpu: float
    parent: float
    worker: float


def process(*arguments: str, **environment: str) -> Cost:
    """Run Python to its end (memory: Linux)."""
    start = time.perf_counter()
    command = [sys.executable, *arguments]
    nothing = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    running = subprocess.Popen(command, env={**os.environ, **environment}, **nothing)
    peaks: dict[int, float] = {}
    while not (ended := os.wait4(running.pid, os.WNOHANG))[0]:
        for pid in (running.pid, *_children(running.pid)):
            peaks[pid] = max(_peak(pid), peaks.get(pid, 0.0))
        time.sleep(0.005)
    wall, used = time.perf_counter() - start, ended[2]
    running.returncode = os.waitstatus_to_exitcode(ended[1])
    if running.returncode:
        raise SystemExit(f"{' '.join(command)}: status {running.returncode}")
    parent = peaks.pop(running.pid, 0.0)
    return Cost(wall, used.ru_utime + used.ru_stime, parent, max(peaks.values(), default=0.0))


def _children(pid: int) -> list[int]:
    try:
        return [int(n) for n in Path(f"/proc/{pid}/task/{pid}/children").read_text("utf-8").split()]
    except OSError:
        return []


def _peak(pid: int) -> float:
    """The high-water mark of one process, MiB."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) / 1024 for line in status.splitlines() if "VmHWM" in line)


def line(what: str, how: str, cost: Cost, ratio: str, **figures: float) -> Line:
    """A line of what a process took, with those of its figures that have targets."""
    taken = f"{cost.wall:.2f} s", f"{cost.cpu:.2f} s"
    return Line([what, how, *taken, f"{cost.worker:.0f}, {cost.parent:.0f}", ratio], figures)


def in_turn(works: dict[str, Callable[[], Cost]], rounds: int) -> dict[str, Cost]:
    """The medians of each, measured in turn."""
    taken: dict[str, list[Cost]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            taken[name].append(work())
    return {
        name: Cost(*(median(column) for column in zip(*(vars(c).values() for c in costs))))
        for name, costs in taken.items()
    }


def write_tracker(path: Path, rate: int, jitter: float, times: int = 1) -> str:
    """Write the trace of a tracker of so many frames/s on a multiple of UAV123's sequences."""
    rng = np.random.default_rng(rate)

    def tracked(recording: Recording) -> Recording:
        factors = rng.lognormal(0, jitter, len(recording)) if jitter else np.ones(len(recording))
        return replace(recording, elapsed_ns=(1e9 / rate * factors).astype(np.int64))

    sizes = np.tile(lengths(), times)
    metadata = Metadata.new("30", "every-frame", tracker={"name": f"tracker-{rate}"})
    write_trace(Trace(metadata, map(tracked, recordings(sizes))), path)
    return str(path)


def study(
    folder: Path,
    traces: Sequence[str],
    forecasters: Sequence[str],
    *options: str,
    **environment: str,
) -> Callable[[], Cost]:
    """A whole study of traces over the grid of permitted latencies, from nothing."""
    number = count()
    file = folder / f"{len(list(folder.glob('*.toml')))}.toml"
    text = f'traces = {list(traces)}\nforecasters = {list(forecasters)}\nsigma = "grid"\n'
    file.write_text(text.replace("'", '"'))

    def work() -> Cost:
        with tempfile.TemporaryDirectory(dir=folder) as out:
            where = str(Path(out) / str(next(number)))
            command = ("-m", "lae_sim", "study", str(file), "--no-report", "--out", where)
            return process(*command, *options, **environment)

    return work


def whole_lines(folder: Path, rounds: int) -> list[Line]:
    """Eight traces, 51 sigmas: the floor, hold, and hold and kalman."""
    found = []
    for kind, jitter in (("constant", 0.0), ("jitter", 0.1)):
        traces = [write_tracker(path, rate, jitter) for rate, path in eight(folder, kind).items()]
        works = {
            "read the Parquet files": partial(process, "-c", READ, *traces),
            "hold": study(folder, traces, ["hold"]),
            "hold + kalman": study(folder, traces, ["hold", "kalman"]),
        }
        if has_kernels():
            works["hold + kalman"]()  # compiles
            works["the same, no compiled kernels"] = study(
                folder, traces, ["hold", "kalman"], **{SWITCH: "0"}
            )
        targets = {"hold": f"{kind}-hold", "hold + kalman": f"{kind}-kalman"}
        taken = in_turn(works, rounds)
        floor = taken["read the Parquet files"].wall
        for name, cost in taken.items():
            ratio = cost.wall / floor
            figures = {targets[name]: ratio} if name in targets else {}
            what = f"8 traces, 51 sigmas, {kind} times"
            found.append(line(what, name, cost, f"{ratio:.1f} x floor", **figures))
    return found


def eight(folder: Path, kind: str) -> dict[int, Path]:
    """Where the traces of eight trackers are, by their frames/s."""
    return {rate: folder / f"{kind}-{rate}.parquet" for rate in RATES}


def worker_lines(folder: Path, rounds: int) -> list[Line]:
    """The same study with 1, 2, 4, ... workers; its traces are there already."""
    traces = [*map(str, eight(folder, "jitter").values())]
    cores = len(os.sched_getaffinity(0))
    counts = [*(2**k for k in range(10) if 2**k < cores), cores]
    works = {n: study(folder, traces, ["hold", "kalman"], "--workers", str(n)) for n in counts}
    taken = in_turn({str(n): work for n, work in works.items()}, rounds)
    first = taken["1"].wall
    return [
        line(
            "8 traces, 51 sigmas, jitter times, hold + kalman",
            f"{name} workers",
            cost,
            f"{first / cost.wall:.2f} x as fast",
            **({"workers": first / cost.wall} if name == "2" else {}),
        )
        for name, cost in taken.items()
    ]


def size_lines(folder: Path, rounds: int, largest: int) -> list[Line]:
    """One trace of 1, 10, ... times as many sequences."""
    found = []
    base = Cost(1, 1, 1, 1)
    times = 1
    while times <= largest:
        trace = write_tracker(folder / f"x{times}.parquet", 20, 0.1, times)
        work = study(folder, [trace], ["hold", "kalman"], "--workers", "2")
        cost = in_turn({"": work}, rounds if times == 1 else 1)[""]
        base = cost if times == 1 else base
        largest_process = max(cost.worker, cost.parent) / max(base.worker, base.parent)
        ratios = f"{largest_process:.2f} x memory"
        found.append(line(f"one trace, {123 * times:,} sequences", "hold + kalman", cost, ratios))
        os.unlink(trace)
        times *= 10
    return found


def write_small(folder: Path, trackers: int, datasets: int = 20) -> None:
    """Write a trace of each tracker on each dataset: 8 sequences of 60 frames."""
    folder.mkdir()
    for tracker in range(trackers):
        for number in range(datasets):
            truths, rng = np.random.default_rng(number), np.random.default_rng([number, tracker])
            ns = 1e6 * rng.uniform(25, 85)
            recordings = []
            for name in "abcdefgh":
                truth = np.full((60, 4), 60.0)
                truth[:, :2] = 400 + truths.normal(0, 6, (60, 2)).cumsum(0)
                boxes = truth + rng.normal(0, 3, truth.shape)
                times = (ns * rng.lognormal(0, 0.1, 60)).astype(np.int64)
                recordings.append(Recording.new(name, truth, boxes, times))
            metadata = Metadata.new(
                "30",
                "every-frame",
                tracker={"name": f"tracker-{tracker}"},
                dataset={"name": f"dataset-{number}"},
            )
            path = folder / f"{tracker}-{number}.parquet"
            write_trace(Trace(metadata, recordings), path)


def many_lines(folder: Path, traces: int) -> list[Line]:
    """A study of many small traces of 20 datasets, all pairs and the report, and once more."""
    name = f"small-{traces}"
    write_small(folder / name, traces // 20)
    file, out = folder / f"{name}.toml", folder / f"{name}-results"
    file.write_text(f'traces = ["{folder / name}/*.parquet"]\n', encoding="utf-8")
    first, again = (
        process("-m", "lae_sim", "study", str(file), "--out", str(out)) for _ in range(2)
    )
    left = [path.stat().st_size / 1e6 for path in out.rglob("*") if path.is_file()]
    report = (out / "report.html").stat().st_size / 1e6
    if traces == 1000:
        figures, again_figures = {"small": first.wall}, {"small-again": again.wall}
    else:
        peak = max(first.parent, again.parent)
        figures = {"large": first.wall, "large-parent": peak, "large-report": report}
        again_figures = {}
    what = f"{traces:,} traces of 8 x 60 frames, 20 datasets"
    size = f"{len(left)} files of {sum(left):.0f} MB, report {report:.1f} MB"
    return [
        line(what, "all", first, size, **figures),
        line(what, "nothing to do", again, "", **again_figures),
    ]


def pair_lines(rounds: int) -> list[Line]:
    """Pairs of 100 traces of 123 sequences: as studies compare them, in one process."""
    rng = np.random.default_rng(0)
    found = []
    for repetitions in (1, 100):
        names = tuple(f"{s:03}" for s in range(123))
        members = [Member(names, rng.random((repetitions, 123))) for _ in range(100)]
        taken = medians({"": lambda members=members: pairs_of(members)}, rounds)[""] / 4950 * 1e3
        what = f"4,950 pairs, 123 sequences, {repetitions} repetitions"
        cells = [what, "one process", f"{taken:.3f} ms each", ""]
        found.append(Line(cells, {"pairs": taken}))
    return found


def lane_lines(rounds: int) -> list[Line]:
    """Random latencies: million world frames a second."""
    metadata = Metadata.new("30", "every-frame")
    trace = Trace(metadata, list(recordings(lengths())))
    source = bootstrap(0)
    drawn = replay_trace(trace, latency=source, search="off")
    modelled = replay_trace(trace, latency=source, search="c=0.7")
    every = [
        Times(recording.name, ns, by_call=True)
        for recording in trace
        for ns in source.repeated(recording, 0, REPETITIONS)
    ]
    sizes = [len(times.ns) for times in every]
    one = slice(None, None, REPETITIONS)

    def simpy() -> None:
        for size, times in zip(sizes[one], every[one]):
            # fresh: it remembers how many it has handed out
            simulate(size, CLOCK, replace(times), latest)

    def runs() -> Iterator[object]:
        return Repetitions(drawn, REPETITIONS).batches()

    def scored(replays: Runs) -> None:
        those = Repetitions(replays, REPETITIONS)
        for _ in evaluate_groups(those, metadata, {"hold": Hold}, (Fraction(0),), frames=1 << 17):
            pass

    def exhaust(make: Callable[[], Iterator[object]]) -> None:
        for _ in make():
            pass

    plain = {
        "SimPy, schedule alone": simpy,
        "schedule alone": lambda: exhaust(lambda: simulate_lanes(sizes, CLOCK, every, latest)),
        "and bootstrap's draws, boxes": lambda: exhaust(runs),
        "and scores, hold": lambda: scored(drawn),
        "and the search model, c = 0.7": lambda: scored(modelled),
    }
    works = {name: switched("0", work) for name, work in plain.items()}
    if has_kernels():
        for name in [*works][1:4]:
            works[f"{name}, compiled"] = switched("1", plain[name])
            works[f"{name}, compiled"]()
    taken = medians(works, rounds)
    speed = {
        name: FRAMES * (1 if "SimPy" in name else REPETITIONS) / seconds / 1e6
        for name, seconds in taken.items()
    }
    targets = {
        "schedule alone, compiled": "schedule",
        "and scores, hold, compiled": "scores",
    }
    return [
        Line(
            [f"random latencies, {len(every):,} lanes", name, f"{rate:.2f} M frames/s"]
            + [f"{rate / speed['SimPy, schedule alone']:.1f} x SimPy"],
            {targets[name]: rate} if name in targets else {},
        )
        for name, rate in speed.items()
    ]


def measured(folder: Path, quick: bool) -> Iterator[list[Line]]:
    """All of these lines, but for those of parts of studies, some of which are compiled.

    Args:
        folder: for what is written.
        quick: each once, and without what takes long.
    """
    rounds = 1 if quick else 3
    yield whole_lines(folder, rounds)
    yield worker_lines(folder, rounds)
    yield size_lines(folder, rounds, 1 if quick else 10)
    yield many_lines(folder, 1000)
    if not quick:
        yield many_lines(folder, 10_000)
