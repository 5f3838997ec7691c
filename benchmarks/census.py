r"""How true replays are, over trackers, sequences and times: ``python benchmarks/census.py``.

    python benchmarks/census.py DATA/DTB70 DATA/UAVDT --out census \
        --tracker dcf --tracker nanotrack weights=nanotrackv3

Each tracker is profiled on each dataset as a user would: passes on every N-th frame, a gap pass,
and closed loops under constant times, long initialisations and random times; with a pre-forecaster
too where its search can be set. What ``lae-sim fidelity`` makes of it is summed up: mean |d AUC| of
replays by kind, over all runs and over those whose closed loops repeat within 0.02 (three of the
same setting, with 2 % of jitter on the times), how many closed loops the model's intervals cover,
and how wide they are.

What the model leaves unexplained (``UNEXPLAINED`` in :mod:`lae_sim.evaluation.modelled`) is fitted
here, for each sequence on all others: a quantile (.95, with a pre-forecaster .9) of how far closed
loops lie outside of what reaches and phases span. The values over all sequences are what the module
should have.

It takes some 50 runs of a tracker through all frames; what is finished is kept in ``--out``, and
gone on with where it was interrupted.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from lae_sim.comparison.fidelity import REPEATED_WITHIN, FidelityRow, compare_closed_loops
from lae_sim.datasets.frames import Dataset
from lae_sim.datasets.layouts import find_dataset
from lae_sim.engine.clock import parse_duration, split_init
from lae_sim.errors import LaeError
from lae_sim.evaluation.modelled import MODELLED, UNEXPLAINED, UNEXPLAINED_FORECAST
from lae_sim.files import text_digest
from lae_sim.plugins import key_and_value, parse_options
from lae_sim.profile.run import profile_tracker
from lae_sim.profile.worker import Worker
from lae_sim.report.table import PERCENT, SCORE, Column, Table, text_of
from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

STRIDES = ("3/2", "2", "3")
CONSTANT = tuple(f"constant:{ms}ms" for ms in (20, 34, 40, 47, 60, 80, 100, 167))
INIT = tuple(f"constant:47ms,init={init}" for init in ("300ms", "1s", "2s"))
RANDOM = {"jitter38": "constant:40ms", "jitter50": "constant:47ms"}
"""Lognormal times around these milliseconds, and the constant time whose repetitions are theirs."""
SEARCHED = (*CONSTANT[0::3], *INIT[:2])
"""The times of closed loops with a pre-forecaster: 20, 47 and 100 ms, and long initialisations."""
GROUPS = ("bare", "constant", "init", "random", "pre-forecaster", "pre-forecaster, size kept")
LEVELS = {"bare": 0.95, "pre-forecaster": 0.9}
"""How many of the closed loops that say what is unexplained are to be inside."""
KINDS = ("every-frame", "strided", "modelled")

_LOGNORMAL, _REPEATED, _SEEDS = 0.25, 0.02, 3


@dataclass(frozen=True)
class Loop:
    """A closed loop of the census.

    Attributes:
        group: ``"constant"``, ``"init"``, ``"random"`` or ``"pre-forecaster"``.
        timing: its times, as ``lae-sim profile --closed-loop`` takes them.
        setting: the constant times that were repeated with a little jitter.
        repeat: whether it is one of the repetitions.
    """

    group: str
    timing: str
    setting: str
    repeat: bool = False


def loops(times: Path, quick: bool) -> list[Loop]:
    """All closed loops without a pre-forecaster, whose random times are traces in a folder."""
    constant = CONSTANT[3:7:3] if quick else CONSTANT
    init = INIT[1:2] if quick else INIT
    groups = [("constant", each) for each in constant] + [("init", each) for each in init]
    found = [Loop(group, each, each) for group, each in groups]
    for name, setting in RANDOM.items():
        for seed in range(1 if quick else _SEEDS):
            found.append(Loop("random", str(times / f"{name}-{seed}.parquet"), setting))
    for group, each in groups:
        short = each.replace("constant:", "repeat").replace(",init=", "-init")
        for seed in range(_SEEDS):
            found.append(Loop(group, str(times / f"{short}-{seed}.parquet"), each, repeat=True))
    return found


def write_times(dataset: Dataset, loop: Loop) -> None:
    """Write the trace that a closed loop takes its times from, unless it takes constant ones."""
    path = Path(loop.timing)
    if path.suffix != ".parquet" or path.exists():
        return
    seed = int(path.stem.rpartition("-")[2])
    recordings = []
    for sequence in dataset.sequences:
        random = np.random.default_rng([seed, *sequence.name.encode()])
        normal = random.standard_normal(len(sequence))
        if loop.group == "random":
            mean = parse_duration(path.stem.partition("-")[0].removeprefix("jitter") + "ms")
            elapsed = mean * np.exp(_LOGNORMAL * normal)
        else:
            named, init_ns = split_init(loop.setting)
            call_ns = parse_duration(named.removeprefix("constant:"))
            elapsed = np.full(len(sequence), float(call_ns))
            elapsed[0] = call_ns if init_ns is None else init_ns
            elapsed *= 1 + _REPEATED * normal
        boxes = np.ones((len(sequence), 4))  # the times alone are wanted
        times = elapsed.astype(np.int64)
        recordings.append(Recording.new(sequence.name, sequence.truth, boxes, times))
    source = {"source": f"drawn: {path.stem}"}
    recordings.sort(key=lambda recording: recording.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_trace(Trace(Metadata.new(dataset.fps, "every-frame", timing=source), recordings), path)


@dataclass(frozen=True)
class Run:
    """One sequence of a closed loop with all its replays.

    Attributes:
        tracker: as it was asked for.
        loop: the closed loop.
        keep_size: whether it had a pre-forecaster that kept the size; None without one.
        rows: by kind of replay.
    """

    tracker: str
    loop: Loop
    keep_size: bool | None
    rows: Mapping[str, FidelityRow]

    @property
    def row(self) -> FidelityRow:
        """Of the modelled replay."""
        return self.rows["modelled"]

    @property
    def group(self) -> str:
        """The group of the closed loop, said more precisely."""
        return self.loop.group + (", size kept" if self.keep_size else "")

    @property
    def unexplained(self) -> Mapping[str, float]:
        """What its intervals hold for what the model does not explain."""
        return UNEXPLAINED if self.keep_size is None else UNEXPLAINED_FORECAST

    @property
    def approximate(self) -> bool:
        """Whether the replay is not exact."""
        return self.row.approximate_outputs > 0 or self.keep_size is not None


def profiled(
    tracker: str, options: Mapping[str, Any], root: str, arguments: argparse.Namespace
) -> tuple[str, list[str], dict[str, tuple[Loop, bool | None]]]:
    """Profile a tracker on a dataset: the trace, its passes, and the closed loops by their path."""
    names = [s.name for s in find_dataset(root=root).sequences if s.name not in arguments.leave_out]
    dataset = find_dataset(root=root, sequences=names)
    digest = text_digest(json.dumps(options, sort_keys=True, default=str))[:6]
    label = "".join(c if c.isalnum() else "-" for c in tracker)
    folder = arguments.out / f"{label}-{digest}{'-quick' * arguments.quick}"
    folder.mkdir(parents=True, exist_ok=True)
    asked = loops(arguments.out / "times" / dataset.name, arguments.quick)
    for loop in asked:
        write_times(dataset, loop)
    settings: dict[str, Any] = {"options": options, "root": root, "sequences": names}
    settings["resume"] = True

    def run(out: Path, closed: Sequence[Loop], **more: Any) -> dict[str, Loop]:
        profile_tracker(
            tracker, out=out, closed_loops=[loop.timing for loop in closed], **more, **settings
        )
        return {str(_closed_path(out, loop.timing)): loop for loop in closed}

    trace = folder / f"{dataset.name}.parquet"
    found: dict[str, tuple[Loop, bool | None]] = {
        path: (loop, None)
        for path, loop in run(trace, asked, strides=STRIDES, gaps=arguments.gaps).items()
    }
    passes = [trace.with_suffix(f".stride{s.replace('/', '-')}.parquet") for s in STRIDES]
    passes.append(trace.with_suffix(".gaps.parquet"))
    with Worker(tracker, options) as started:
        searches = started.sets_search
    searched = [Loop("pre-forecaster", each, each) for each in SEARCHED] if searches else []
    for keep_size in (False, True) if searched else ():
        out = folder / f"{dataset.name}.{'centre' if keep_size else 'searched'}.parquet"
        some = searched[1:2] if arguments.quick else searched
        done = run(out, some, pre_forecaster="kalman", keep_size=keep_size)
        found |= {path: (loop, keep_size) for path, loop in done.items()}
    return str(trace), list(map(str, passes)), found


def _closed_path(out: Path, timing: str) -> Path:
    """Where a profile leaves a closed loop."""
    name, _, init = timing.partition(",init=")
    short = name.removeprefix("constant:") if name.startswith("constant:") else Path(name).stem
    if init:
        short += f"-init-{parse_duration(init) // 10**6}ms"
    return out.with_suffix(f".closed-loop-{short}.parquet")


def census(tracker: str, options: Mapping[str, Any], arguments: argparse.Namespace) -> list[Run]:
    """All runs of a tracker, with ``hold`` and with ``kalman``."""
    traces, passes = [], []
    closed: dict[str, tuple[Loop, bool | None]] = {}
    for root in arguments.roots:
        trace, its_passes, its_closed = profiled(tracker, options, root, arguments)
        traces.append(trace)
        passes += its_passes
        closed |= its_closed
    rows = compare_closed_loops(traces, list(closed), passes=passes, forecasters=("hold", "kalman"))
    runs: dict[tuple[str, str, str], dict[str, FidelityRow]] = {}
    for row in rows:
        runs.setdefault((row.closed_loop, row.forecaster, row.sequence), {})[row.replay] = row
    return [Run(tracker, *closed[path], by_kind) for (path, *_), by_kind in runs.items()]


def spreads(runs: Iterable[Run]) -> dict[tuple[str, ...], float]:
    """How far repetitions are apart in AUC, by tracker, sequence, forecaster and setting."""
    scores: dict[tuple[str, ...], list[float]] = {}
    for run in runs:
        if run.loop.repeat:
            scores.setdefault(_place(run), []).append(run.row.closed_auc)
    return {place: max(each) - min(each) for place, each in scores.items()}


def _place(run: Run) -> tuple[str, ...]:
    return run.tracker, run.row.trace, run.row.sequence, run.row.forecaster, run.loop.setting


def outside(run: Run, metric: str) -> float:
    """How far a closed loop is outside of what reaches and phases span."""
    low, high = getattr(run.row, f"{metric}_low"), getattr(run.row, f"{metric}_high")
    closed, rest = getattr(run.row, f"closed_{metric}"), run.unexplained[metric]
    below = low + rest - closed if low > 0 else 0.0  # at 0 and 1 the interval was cut
    above = closed - high + rest if high < 1 else 0.0
    return max(below, above, 0.0)


def fitted(runs: Sequence[Run], metric: str, level: float) -> dict[str, float]:
    """What is unexplained of each sequence's score, fitted on the others; of ``""``, on all.

    Exact replays say nothing of it.
    """
    approximate = [run for run in runs if run.approximate]
    distance = np.array([outside(run, metric) for run in approximate])
    of = np.array([run.row.sequence for run in approximate])
    others = {name: of != name for name in dict.fromkeys(of.tolist())}
    others[""] = np.ones(len(of), bool)
    return {
        name: float(np.quantile(distance[which], level))
        for name, which in others.items()
        if which.any()
    }


def figures(
    runs: Sequence[Run], apart: Mapping[tuple[str, ...], float], rest: Mapping[str, float]
) -> dict[str, Any]:
    """Of some runs: mean |d AUC| by kind, of all and of those that repeat; coverage and width."""
    repeatable = [run for run in runs if apart.get(_place(run), 0.0) <= REPEATED_WITHIN]
    found: dict[str, Any] = {"runs": len(runs)}
    for kind in KINDS:
        found[kind] = _mean(abs(run.rows[kind].d_auc) for run in runs)
    found["repeatable"] = len(repeatable)
    for kind in KINDS:
        found[f"repeatable {kind}"] = _mean(abs(run.rows[kind].d_auc) for run in repeatable)
    approximate = [run for run in runs if run.approximate]
    found["covered"] = _mean(bool(run.row.covered) for run in runs)
    found["approximate"] = len(approximate)
    found["approximate covered"] = _mean(bool(run.row.covered) for run in approximate)
    found["width"] = _mean(_width(run, run.unexplained["auc"]) for run in approximate)
    known = [(run, rest[run.row.sequence]) for run in approximate if run.row.sequence in rest]
    found["fitted covered"] = _mean(outside(run, "auc") <= value for run, value in known)
    found["fitted width"] = _mean(_width(run, value) for run, value in known)
    return found


def _width(run: Run, rest: float) -> float:
    """The width of an interval with so much unexplained on either side."""
    more = rest - run.unexplained["auc"]
    low, high = run.row.auc_low or 0.0, run.row.auc_high or 0.0
    return min(high + more, 1.0) - max(low - more, 0.0)


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return fmean(known) if known else None


def summary(runs: Sequence[Run]) -> dict[str, Any]:
    """The figures by tracker, forecaster and group of closed loops, and what is unexplained."""
    apart = spreads(runs)
    rest: dict[str, dict[str, dict[str, float]]] = {}
    for name, level in LEVELS.items():
        some = [run for run in runs if (run.keep_size is None) == (name == "bare")]
        rest[name] = {metric: fitted(some, metric, level) for metric in MODELLED} if some else {}
    scored = [run for run in runs if not run.loop.repeat]
    trackers = list(dict.fromkeys(run.tracker for run in scored))
    lines = []
    for tracker, forecaster in [(t, f) for t in [*trackers, "all"] for f in ("hold", "kalman")]:
        for group in GROUPS:
            some = [
                run
                for run in scored
                if tracker in (run.tracker, "all")
                and run.row.forecaster == forecaster
                and (group == run.group or (group == "bare" and run.keep_size is None))
            ]
            if some and (tracker != "all" or len(trackers) > 1):
                head = {"tracker": tracker, "forecaster": forecaster, "closed loops": group}
                of = rest["pre-forecaster" if group.startswith("pre") else "bare"]
                lines.append({**head, **figures(some, apart, of["auc"])})
    worst: dict[str, float] = {}
    for (tracker, _, sequence, *_), value in apart.items():
        key = f"{tracker} {sequence}"
        worst[key] = max(worst.get(key, 0.0), value)
    return {"figures": lines, "unexplained": rest, "repeated within": worst}


def printed(found: Mapping[str, Any]) -> Iterator[str]:
    """The summary as text."""
    columns = [Column(name, name, is_label=True) for name in ("tracker", "forecaster")]
    columns += [Column("closed loops", "closed loops", is_label=True), Column("runs", "runs")]
    columns += [Column(kind, kind, _FINE) for kind in KINDS]
    columns += [Column("repeatable", "repeatable")]
    columns += [Column(kind, f"repeatable {kind}", _FINE) for kind in KINDS]
    columns += [
        Column("covered", "covered", PERCENT),
        Column("approximate", "approximate"),
        Column("covered", "approximate covered", PERCENT),
        Column("width", "width", SCORE),
        Column("covered, fitted", "fitted covered", PERCENT),
        Column("width", "fitted width", SCORE),
    ]
    yield text_of(Table.of(columns, found["figures"]))
    yield ""
    for name, by_metric in found["unexplained"].items():
        for metric, values in by_metric.items():
            others = ", ".join(f"{of} {value:.4f}" for of, value in values.items() if of)
            yield (
                f"unexplained of {metric}, {name}: {values.get('', 0.0):.4f} over all; "
                f"without {others}"
            )
    lucky = [f"{k} {v:.3f}" for k, v in found["repeated within"].items() if v > REPEATED_WITHIN]
    yield f"closed loops of one setting are up to so far apart: {', '.join(lucky) or 'none'}"


_FINE: Callable[..., str] = partial(lambda value: f"{value:.4f}")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    add = made.add_argument
    add("roots", nargs="+", metavar="DATASET", help="folders of datasets with frames")
    add(
        "--tracker",
        nargs="+",
        action="append",
        required=True,
        metavar=("NAME", "KEY=VALUE"),
        help="a tracker as of lae-sim profile, with its options; may be given several times",
    )
    add("--out", type=Path, default=Path("census"), help="where all traces go (default: census)")
    add("--leave-out", nargs="+", default=[], metavar="SEQUENCE", help="sequences not to run")
    add("--gaps", default="10m", metavar="BUDGET", help="of a gap pass (default: 10m)")
    add("--quick", action="store_true", help="a few closed loops only")
    add("--json", action="store_true", help="print one JSON object")
    return made


def main() -> None:
    """Run what is not finished, and print the tables."""
    arguments = parser().parse_args()
    runs = []
    try:
        for name, *options in arguments.tracker:
            given = parse_options(dict(map(key_and_value, options)))
            runs += census(name, given, arguments)
    except LaeError as error:
        sys.exit(f"census.py: error: {error}")
    found = summary(runs)
    print(json.dumps(found, indent=2) if arguments.json else "\n".join(printed(found)))


if __name__ == "__main__":
    main()
