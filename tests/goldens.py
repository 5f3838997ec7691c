"""Freezes what one version of lae_sim answers, and holds another version against it.

    python tests/goldens.py freeze FOLDER                        # of this interpreter's lae_sim
    python tests/goldens.py freeze FOLDER --python old/.venv/bin/python
    python tests/goldens.py compare FOLDER                       # exit status 1 if anything differs
    python tests/goldens.py compare FOLDER --only 'replay-*' study-samples --ignore-added
    python tests/goldens.py list

It knows a version by its command line only (``PYTHON -m lae_sim COMMAND ...``), so that code may
move as it likes. Each case of the table below runs in a folder of its own, where ``traces`` is the
samples' folder and ``data`` that of ``--data``; its answers (exit status, both streams, the files
that it names) become ``FOLDER/CASE.json``. Cases of real data are skipped where that is absent.

Integers, texts (with the numbers in them), booleans, nulls, keys and the order of columns must be
the same, floats to 1e-12 (absolute up to 1, relative above). What may differ is made neutral
before it is kept:

- values under the key ``lae_sim`` and versions in texts, such as ``lae-sim 0.1.0``;
- paths of temporary folders, of this repository, of the data and of the interpreter;
- the readings of the device, the shares and sums of CPU time, and in a case that really measures
  times the names in its ``measured``;
- the usage before an argparse error, since every new option changes it, and the frames of a
  traceback;
- names of the files of a study's results: digests of versions and code;
- drawings, of which only the kind is kept.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import json
import math
import os
import pickle
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "traces"
TOLERANCE = 1e-12
TIMEOUT_S = 900


@dataclass(frozen=True)
class Case:
    """Some command lines, and what is kept of what they leave.

    Attributes:
        name: of the golden file.
        commands: without ``lae-sim``, run one after another.
        files: globs of the files to keep; ``folder/`` is a data set of Parquet files.
        needs: cases whose files are there too.
        writes: files that are there before, by name.
        make: makes more such files.
        data: whether it needs the real data.
        measured: names of JSON values and columns that are measured, or follow from it.
    """

    name: str
    commands: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    writes: Mapping[str, str] = field(default_factory=dict)
    make: Callable[[Path], None] | None = None
    data: bool = False
    measured: tuple[str, ...] = ()


# ------------------------------------------------------------------------------- files of cases

OWN = """
class Midway:
    def __init__(self, box, image_size=None):
        self.box = self.last = tuple(box)

    def update(self, frame, box):
        self.last, self.box = self.box, tuple(box)

    def predict(self, frame):
        return tuple((a + b) / 2 for a, b in zip(self.last, self.box))


class Broken(Midway):
    def predict(self, frame):
        raise ZeroDivisionError("of my own")


class EveryOther:
    def __call__(self, clock, calls):
        last, _, now = calls[-1]
        frame = last + 2
        return frame, max(now, frame * clock.frame_ticks)


class Tracker:
    def __init__(self, fail=0):
        self.fail, self.count = fail, 0

    def init(self, frame, box):
        self.box, self.count = list(box), 0

    def track(self, frame):
        self.count += 1
        if self.count == self.fail:
            raise RuntimeError("gives up on purpose")
        if self.count % 10 == 0:
            return None
        x, y, w, h = self.box
        return [x + self.count / 4, y, w, h], 0.5
"""

STUDY_SAMPLES = """
traces = ["traces/synthetic-slow.parquet", "traces/synthetic-fast.parquet"]
forecasters = ["hold", "kalman", "constant-velocity"]
latencies = ["recorded", "bootstrap"]
repetitions = 4
seed = 3
block = 20
scales = [0.5, 1, 2]
sigma = [0, 0.5, 1]
conventions = ["pysot", "got10k"]
attributes = true
require_auc = 0.5
"""

STUDY_GRID = """
traces = ["traces/synthetic-*.parquet"]
forecasters = ["hold", "kalman"]
sigma = "grid"
require_auc = 0.45
costs = ["kalman=2ms"]
"""

STUDY_WIDE = """
traces = ["traces/synthetic-slow.parquet"]
forecasters = ["hold", "kalman-lae-pvt", "least-squares", "g-h", "tuned-kalman", "oracle"]
policies = ["latest", "fifo", "every:2", "shrinking-tail:40ms"]
fps = ["trace", 60]
latencies = ["recorded", "by-call", "constant:47ms", "resample", "lognormal"]
repetitions = 2
sequences = ["bike-pan", "car-chase", "person-crowd"]
folds = 3
"""

STUDY_TIMING = """
traces = ["made.parquet"]
timing = ["board.parquet"]
latencies = ["recorded", "resample"]
repetitions = 2
attributes = true
"""

STUDY_OWN = """
traces = ["traces/synthetic-slow.parquet"]
forecasters = ["own:Midway", "own:Broken"]
policies = ["latest", "own:EveryOther"]
sequences = ["bike-pan"]
"""

STUDY_REAL = """
traces = ["nano.parquet", "kcf.parquet"]
forecasters = ["hold", "kalman"]
latencies = ["recorded", "constant:20ms"]
scales = [1, 2, 4]
sigma = [0, 0.5]
attributes = true
require_auc = 0.4
"""

STUDY_STALLS = """
traces = ["ortrack.parquet"]
forecasters = ["hold", "kalman"]
latencies = ["recorded", "by-call", "bootstrap"]
repetitions = 3
scales = [1, 4]
sigma = "grid"
require_auc = 0.45
"""


# What is wrong, and the file where it is.
STUDY_FAULTS = {
    "empty": "",
    "absent": 'traces = ["nowhere.parquet"]',
    "syntax": 'traces = ["traces"',
    **{
        name: f'traces = ["traces/synthetic-slow.parquet"]\n{line}'
        for name, line in {
            "key": 'forecaster = ["hold"]',
            "forecaster": 'forecasters = ["nothing"]',
            "latency": 'latencies = ["steady"]',
            "random": 'latencies = ["bootstrap:1"]',
            "policy": 'policies = ["vot-realtime"]',
            "convention": 'conventions = ["own"]',
            "sigma": 'sigma = ["0.1.1"]',
            "scale": "scales = [-1]",
            "auc": "require_auc = 1.5",
            "cost": 'costs = ["measured"]',
            "sequence": 'sequences = ["nowhere"]',
            "repetitions": "repetitions = 0",
            "offline": 'forecasters = ["offline"]',
            "timing": 'timing = ["traces/synthetic-fast.parquet"]',
        }.items()
    },
}


def _study_files(folder: str) -> tuple[str, ...]:
    names = ("summary.csv", "comparisons.csv", "required.csv", "study.json", "results/")
    return tuple(f"{folder}/{name}" for name in (*names, "tables/*.csv", "tables/*.tex"))


def make_results(folder: Path) -> None:
    """A small dataset with gaps in its truth, and results on it as several toolkits leave them."""
    lengths = {"drift": 60, "swing": 90, "vanish": 80, "Wave-1": 75}
    truth_folder = folder / "Made" / "anno"
    for name in ("eager", "times/eager", "tabs", "bare", "again", "pickled"):
        (folder / "results" / name).mkdir(parents=True)
    truth_folder.mkdir(parents=True)
    flags = ["sequence,Fast motion,Occlusion", "drift,0,0", "swing,1,1", "vanish,0,1", "Wave-1,1,0"]
    (folder / "Made" / "attributes.csv").write_text("\n".join(flags) + "\n")
    arrays, rates = {}, ["tracker,sequence,frames,fps"]
    for order, (name, length) in enumerate(lengths.items()):
        truth, boxes, seconds = _walk(order, length)
        if name == "swing":
            truth[40:50] = np.nan
        if name == "vanish":
            truth[60:] = 0
        _save(truth_folder / f"{name}.txt", truth, ",")
        # names as toolkits change them
        written = {"drift": "uav_drift", "Wave-1": "Wave.1"}.get(name, name)
        _save(folder / "results" / "eager" / f"{written}.txt", boxes, ",")
        _save(folder / "results" / "eager" / f"{written}_time.txt", seconds[:, None], ",", 6)
        _save(folder / "results" / "tabs" / f"{written}.txt", np.rint(boxes), "\t", 0)
        _save(folder / "results" / "tabs" / f"{written}_time.txt", seconds[:, None] * 1e3, "\t", 3)
        _save(folder / "results" / "bare" / f"{written}.txt", boxes, " ")
        repeated = folder / "results" / "again" / name
        repeated.mkdir()
        _save(repeated / f"{name}_001.txt", boxes, ",")
        _save(repeated / f"{name}_002.txt", boxes + 1, ",")
        both = np.stack([seconds, seconds * 2], axis=1)
        _save(repeated / f"{name}_time.txt", both, ",", 6)
        arrays[name] = boxes.astype(np.float32)
        rates.append(f"made,{name},{length},{20 + 7 * order}")
        run = _real_time(boxes, seconds)
        (folder / "results" / "pickled" / f"{name}.pkl").write_bytes(pickle.dumps(run, 2))
    np.savez(folder / "results" / "made.npz", **arrays)
    (folder / "results" / "fps.csv").write_text("\n".join(rates) + "\n")


def _walk(order: int, length: int) -> tuple[Any, Any, Any]:
    """Truth, boxes and seconds of a sequence: waves, since random numbers may change some day."""
    frames = np.arange(length)
    sway = np.sin(frames / (6 + 3 * order))
    size = 40 + 6 * np.cos(frames / 17)
    truth = np.stack([200 + 60 * sway + frames, 150 + 25 * sway, size, 0.75 * size], axis=1)
    error = np.stack([np.sin(frames * (1.3 + column)) for column in range(4)], axis=1)
    boxes = truth + error * (1 + 2 * order)
    boxes[0] = truth[0]
    seconds = 0.021 + 0.012 * order + 0.004 * np.sin(frames * 2.1)
    seconds[0] = 0.09
    return np.round(truth, 2), np.round(boxes, 2), np.round(seconds, 6)


def _real_time(boxes: Any, seconds: Any) -> dict[str, Any]:
    """What the released LAE-PVT code keeps of a run that skips frames while busy, at 30 fps."""
    ready, frame = 0.0, 0
    raw, stamps, indices = [], [], []
    while frame < len(boxes):
        ready = max(ready, frame / 30) + float(seconds[frame])
        raw.append([float(value) for value in boxes[frame]])
        stamps.append(ready)
        indices.append(frame)
        frame = max(frame + 1, math.floor(ready * 30))
    return {"results_raw": raw, "timestamps": stamps, "input_fidx": indices}


def _save(path: Path, table: Any, separator: str, decimals: int = 2) -> None:
    lines = (separator.join(f"{value:.{decimals}f}" for value in row) for row in table.tolist())
    path.write_text("\n".join(line.replace("nan", "NaN") for line in lines) + "\n")


def _samples(folder: str) -> list[Path]:
    return sorted((SAMPLES / folder).glob("*.parquet"))


# ------------------------------------------------------------------------------------ the cases

SLOW = "traces/synthetic-slow.parquet"
FAST = "traces/synthetic-fast.parquet"
REAL_TIME = "traces/synthetic-slow-realtime.parquet"
BOTH = f"{SLOW} {FAST}"
FEW = "--sequence bike-pan car-chase"
CONVENTIONS = ("pysot", "elae", "otb", "got10k", "got10k-101", "exclude")
POLICIES = ("latest", "fifo", "every:2", "shrinking-tail:40ms", "vot-realtime", "vot-realtime:2")
LATENCIES = (
    "recorded",
    "by-call",
    "constant:47ms",
    "resample:1",
    "lognormal:1",
    "bootstrap:1",
    "bootstrap:1:30",
)
BUILT_IN = "hold kalman kalman-lae-pvt constant-velocity least-squares g-h oracle"
MEASURED_CALLS = ("elapsed_ns", "init_ms", "median_ms", "p95_ms")

REPLAYS = (
    Case("replay-text", (f"replay {BOTH}", f"replay {SLOW} --per-sequence --attributes")),
    Case(
        "replay-forecasters",
        (
            f"replay {BOTH} --forecaster {BUILT_IN} --json",
            f"replay {BOTH} --forecaster {BUILT_IN}",
            f"replay {SLOW} {FEW} --forecaster imm imm:quiet=2,agile=20 --json",
            f"replay {SLOW} --forecaster kalman:q=3,decay=0.99 kalman:state=centre,r=2,p0=50 "
            "g-h:g=0.9,h=0.5 least-squares:n=5,forgetting=0.9 least-squares:huber=2 --json",
        ),
    ),
    Case(
        "replay-sigma",
        (
            f"replay {SLOW} --forecaster hold kalman oracle --sigma-grid --json",
            f"replay {BOTH} --forecaster {BUILT_IN} --sigma-grid",
            f"replay {SLOW} --sigma 0 1/3 0.5 1 --json",
            f"replay {SLOW} --sigma=-1/2 --json",
            f"replay {SLOW} --eta 0 1/2 1 --json",
            f"replay {SLOW} --eta 0 1/2 1",
        ),
    ),
    Case(
        "replay-detail",
        (
            f"replay {BOTH} --attributes --per-sequence --forecaster hold kalman oracle --json",
            f"replay {SLOW} --attributes --per-sequence --sigma-grid --json",
            f"replay {FAST} --per-sequence --sequence truck-far car-chase",
            "replay traces/*.parquet --json",
            *(f"replay traces/cases/valid/{path.name} --json" for path in _samples("cases/valid")),
        ),
    ),
    Case(
        "replay-sweeps",
        (
            f"replay {BOTH} --latency-scale 1/2 1 2 4 --json",
            f"replay {SLOW} --fps 15 30 60 30000/1001 --json",
            f"replay {SLOW} --fps 15 30 60 --latency-scale 1/3 1 2",
            f"replay {SLOW} --latency-scale 0 --json",
            f"replay {SLOW} --fps 25 --latency-scale 3/2 --sigma 1/4 --attributes",
        ),
    ),
    Case(
        "replay-conventions",
        tuple(
            f"replay made.parquet {SLOW} --convention {each} --sigma-grid --per-sequence --json"
            for each in CONVENTIONS
        )
        + tuple(f"replay made.parquet --convention {each}" for each in CONVENTIONS),
        needs=("convert-made",),
    ),
    Case(
        "replay-policies",
        tuple(f"replay {SLOW} --policy {each} --json" for each in POLICIES)
        + tuple(f"replay {BOTH} --policy {each}" for each in POLICIES)
        + tuple(f"replay {REAL_TIME} --policy {each} --json" for each in ("latest", "fifo")),
    ),
    Case(
        "replay-latencies",
        tuple(f"replay {BOTH} --latency {each} --latency-scale 2 --json" for each in LATENCIES)
        + tuple(f"replay {SLOW} --latency {each}" for each in LATENCIES)
        + (
            f"replay {SLOW} --timing {FAST} --json",
            f"replay {FAST} --timing {SLOW} --latency by-call --latency-scale 1/2",
            f"replay {REAL_TIME} --json",
            f"replay {REAL_TIME} --sigma-grid",
            f"replay {REAL_TIME} --timing {REAL_TIME}",
        ),
    ),
    Case(
        "replay-costs",
        (
            f"replay {SLOW} --cost 2ms --json",
            f"replay {SLOW} --forecaster hold kalman g-h --cost kalman=40ms g-h=500us --sigma-grid",
            f"replay {SLOW} --forecaster hold kalman --cost 2ms --policy fifo --json",
        ),
    ),
    Case(
        "replay-own",
        (
            f"replay {SLOW} {FEW} --forecaster hold own:Midway --policy own:EveryOther --json",
            f"replay {SLOW} {FEW} --forecaster own:Broken",
            f"replay {SLOW} {FEW} --forecaster own:Missing",
        ),
        writes={"own.py": OWN},
    ),
    Case(
        "replay-strided",
        (
            "replay dcf.parquet --strided dcf.stride3-2.parquet dcf.stride2.parquet "
            "--latency constant:47ms --per-sequence --json",
            "replay dcf.parquet --strided dcf.stride2.parquet --latency constant:70ms "
            "--forecaster hold kalman",
            "replay dcf.closed-loop-47ms.parquet --json",
            "replay dcf.parquet --latency constant:47ms --json",
        ),
        needs=("profile-dcf",),
    ),
    Case(
        "replay-files",
        (
            f"replay {SLOW} {FEW} --forecaster hold kalman --sigma 0 1/2 --outputs outputs.parquet "
            "--schedule schedule.parquet --events events.jsonl --timeline timeline.json "
            "--export-txt exported",
            f"replay {REAL_TIME} --sequence drone-fast bike-pan --schedule again.parquet "
            "--events again.jsonl --cost 2ms",
            f"replay {SLOW} --sequence bike-pan --policy vot-realtime --events vot.jsonl "
            "--plot curves.png",
            f"replay {SLOW} --policy vot-realtime --timeline vot.json",
            f"replay {SLOW} --timeline picture.svg --plot curves.svg",
            f"replay {SLOW} --latency-scale 1 2 --plot sweep.pdf",
            f"replay {SLOW} --export-txt exported",
        ),
        files=("*.parquet", "*.jsonl", "*.json", "*.png", "*.svg", "*.pdf", "exported/**/*"),
    ),
)

COMPARISONS = (
    Case(
        "compare-samples",
        (
            f"compare {BOTH} --json",
            f"compare {SLOW}",
            f"compare {BOTH} --attributes --out scores.csv "
            "--forecaster kalman tuned-kalman constant-velocity",
            f"compare {BOTH} --attributes --forecaster kalman oracle --json",
        ),
        files=("scores.csv",),
    ),
    Case(
        "compare-settings",
        (
            f"compare {SLOW} --latency recorded constant:20ms constant:47ms --json",
            f"compare {SLOW} --latency recorded bootstrap:2:10 --latency-scale 1/2 1 2 "
            "--forecaster kalman g-h",
            f"compare {SLOW} --sigma-grid --forecaster kalman kalman-lae-pvt --out grid.parquet",
            f"compare {SLOW} --sigma 0 1/2 1 --forecaster kalman tuned-kalman --json",
            f"compare {BOTH} --fps 60 --policy shrinking-tail:40ms --convention otb "
            "--forecaster kalman --cost kalman=2ms --json",
            f"compare {SLOW} --folds 3 --seed 7 --forecaster tuned-kalman --json",
            f"compare {REAL_TIME} --forecaster kalman",
            f"compare {SLOW} --sequence bike-pan --forecaster kalman --json",
        ),
        files=("grid.parquet",),
    ),
    Case(
        "fidelity",
        (
            "fidelity dcf.parquet --strided dcf.stride3-2.parquet dcf.stride2.parquet "
            "--closed-loop dcf.closed-loop-47ms.parquet dcf.closed-loop-100ms.parquet "
            "--forecaster hold kalman --json",
            "fidelity dcf.parquet --strided dcf.stride3-2.parquet dcf.stride2.parquet "
            "--closed-loop dcf.closed-loop-47ms.parquet --per-sequence",
            "fidelity dcf.parquet --closed-loop dcf.closed-loop-100ms.parquet --convention otb "
            "--per-sequence --json",
            f"fidelity {SLOW} --closed-loop {REAL_TIME} --json",
            f"fidelity {SLOW} --closed-loop {REAL_TIME} --forecaster hold kalman --per-sequence",
        ),
        needs=("profile-dcf",),
    ),
)

STUDIES = (
    Case(
        "study-samples",
        (
            "study study.toml --out out --workers 2",
            "study study.toml --out out --workers 1",
        ),
        files=_study_files("out"),
        writes={"study.toml": STUDY_SAMPLES},
    ),
    Case("study-html", files=("out/report.html",), needs=("study-samples",)),
    Case(
        "study-grid",
        ("study study.toml --out out --workers 2 --json",),
        files=_study_files("out"),
        writes={"study.toml": STUDY_GRID},
    ),
    Case(
        "study-wide",
        ("study study.toml --out out --workers 2 --no-report",),
        files=_study_files("out"),
        writes={"study.toml": STUDY_WIDE},
    ),
    Case(
        "study-timing",
        ("study study.toml --out out --workers 2 --json",),
        files=_study_files("out"),
        needs=("convert-made",),
        writes={"study.toml": STUDY_TIMING},
    ),
    Case(
        "study-own",
        ("study study.toml --out out --workers 1", "study study.toml --out out --workers 1"),
        files=_study_files("out"),
        writes={"study.toml": STUDY_OWN, "own.py": OWN},
    ),
)

TRACES = (
    Case(
        "show-samples",
        (
            f"show {SLOW}",
            f"show {BOTH} {REAL_TIME}",
            "show traces/*.parquet traces/cases/valid --json",
            "show traces/cases/valid/full-metadata.parquet",
            f"show {SLOW} --plot times.png",
        ),
        files=("times.png",),
    ),
    Case(
        "convert-made",
        (
            "convert results/eager --truth Made --out made.parquet",
            "convert results/tabs --truth Made --time-unit ms --out tabs.parquet --json",
            "convert results/bare --truth Made --time constant:47ms --image-size 640x360 "
            "--tracker bare-bones --device 'my board' --dataset Other --out bare.parquet --json",
            "convert results/eager --truth Made --time constant:61ms --device 'my board' "
            "--out board.parquet",
            "replay made.parquet --timing board.parquet --json",
            "convert results/made.npz --truth Made --time mean-fps:results/fps.csv "
            "--fps 30000/1001 --exclude drift --out rates.parquet",
            "convert results/made.npz --truth Made --time mean-fps:120 --sequence swing "
            "--out one.parquet --json",
            "convert results/again --truth Made --repetition 2 --out again.parquet --json",
            "convert results/pickled --truth Made --out real-time.parquet",
            "convert results/pickled --truth Made --format lae-pvt --fps 20 --out slower.parquet",
            "show made.parquet tabs.parquet bare.parquet rates.parquet real-time.parquet",
            "replay made.parquet real-time.parquet --attributes --per-sequence --json",
            "compare made.parquet --forecaster kalman --attributes",
            "convert results/bare --truth Made --out none.parquet",
            "convert results --truth Made --out none.parquet",
            "convert results/eager --truth Made --time-unit ms --out none.parquet",
            "convert results/eager --truth Made/anno/swing.txt --out none.parquet",
            "convert results/eager --truth absent --out none.parquet",
            "convert absent --truth Made --out none.parquet",
            "convert results/eager --truth Made --truth-file swing=Made/anno/drift.txt "
            "--out none.parquet",
            "convert results/made.npz --truth Made --time constant:47 --out none.parquet",
            "convert results/made.npz --truth Made --tracker other --time mean-fps:results/fps.csv "
            "--out none.parquet",
        ),
        files=("*.parquet",),
        make=make_results,
    ),
    Case(
        "profile-dcf",
        (
            "profile --sequence drone van --stride 3/2 2 --closed-loop constant:47ms "
            "constant:100ms --out dcf.parquet --json",
        ),
        files=("dcf*.parquet",),
        measured=MEASURED_CALLS,
    ),
    Case(
        "profile-real-time",
        (
            "profile --sequence race --timing constant:47ms --out plain.parquet",
            "profile --sequence race --mode real-time --timing constant:47ms --out pre.parquet "
            "--pre-forecaster kalman --pre-forecaster-cost 2ms --policy shrinking-tail:47ms",
            "profile --sequence race --timing constant:47ms --pre-forecaster kalman --translate "
            "--keep-size --out shifted.parquet --json",
            "show plain.parquet --json",
            "replay plain.parquet shifted.parquet --json",
            "replay pre.parquet --policy shrinking-tail:47ms --json",
            "replay pre.parquet --policy every:3",
        ),
        files=("*.parquet",),
        measured=("warnings",),  # of the load while it ran
    ),
    Case(
        "profile-own",
        (
            "profile --tracker own:Tracker --sequence drone van --timing constant:40ms "
            "--in-process --out steady.parquet --json",
            "profile --tracker own:Tracker --option fail=100 --sequence drone race "
            "--timing constant:40ms --out failed.parquet",
            "profile --tracker own:Absent --out none.parquet",
            "profile --tracker nowhere --out none.parquet",
            "profile --sequence nowhere --out none.parquet",
            "profile --mode every-frame --timing constant:40ms --out none.parquet",
            "profile --stride 1 --out none.parquet",
            "profile --out none.csv",
            "profile --timing constant:40ms --stride 2 --out none.parquet",
            "profile --translate --out none.parquet",
            "profile --root nowhere --out none.parquet",
        ),
        files=("*.parquet",),
        writes={"own.py": OWN},
    ),
)

FAULTS = (
    Case(
        "errors-replay",
        (
            "replay nowhere.parquet",
            "replay",
            "replay nowhere/*.parquet",
            f"replay {SLOW} nowhere.parquet",
            "replay own.py",
            f"replay {SLOW} --policy newest",
            f"replay {SLOW} --policy every:0",
            f"replay {SLOW} --policy shrinking-tail:47",
            f"replay {SLOW} --latency steady",
            f"replay {SLOW} --latency constant:47",
            f"replay {SLOW} --latency constant:-1ms",
            f"replay {SLOW} --latency resample:x",
            f"replay {SLOW} --latency bootstrap:1:0",
            f"replay {SLOW} --sigma 0.1.1",
            f"replay {SLOW} --sigma 1e-3",
            f"replay {SLOW} --sigma 0 --eta 1",
            f"replay {SLOW} --policy vot-realtime --sigma 1/2",
            f"replay {SLOW} --policy vot-realtime --sigma-grid",
            f"replay {SLOW} --forecaster nothing",
            f"replay {SLOW} --forecaster nowhere:Thing",
            f"replay {SLOW} --forecaster tuned-kalman",
            f"replay {SLOW} --forecaster trained",
            f"replay {SLOW} --forecaster learned:nowhere.pt",
            f"replay {SLOW} --forecaster kalman:q=big",
            f"replay {SLOW} --forecaster kalman:speed=1",
            f"replay {SLOW} --forecaster hold:n=1",
            f"replay {SLOW} --forecaster camera+kalman",
            f"replay {SLOW} --convention own",
            f"replay {SLOW} --fps 0",
            f"replay {SLOW} --fps 30fps",
            f"replay {SLOW} --latency-scale -1",
            f"replay {SLOW} --latency-scale half",
            f"replay {SLOW} --cost 2",
            f"replay {SLOW} --cost g-h=2ms",
            f"replay {SLOW} --sequence nowhere",
            f"replay {SLOW} --timing nowhere.parquet",
            f"replay {SLOW} --timing traces/cases/valid/minimal.parquet",
            f"replay {SLOW} --strided {FAST}",
            f"replay {BOTH} --strided {FAST}",
            f"replay {BOTH} --outputs outputs.parquet",
            f"replay {SLOW} --latency-scale 1 2 --schedule schedule.parquet",
            f"replay {SLOW} --plot curves.txt",
            f"replay {SLOW} --timeline run.txt",
            f"replay {SLOW} --events nowhere/events.jsonl",
            f"replay {REAL_TIME} --latency constant:10ms",
            f"replay {REAL_TIME} --policy every:3",
            "replay traces/cases/valid/no-truth-columns.parquet",
            "replay traces/cases/valid/minimal.parquet --attributes",
            f"replay {SLOW} --json --unknown",
        ),
        files=("*.parquet", "*.jsonl"),
        writes={"own.py": OWN},
    ),
    Case(
        "errors-others",
        (
            "",
            "--version",
            "nothing",
            f"compare {SLOW} --policy vot-realtime",
            f"compare {SLOW} --forecaster offline",
            f"compare {SLOW} --out scores.txt",
            f"compare {SLOW} --plot scores.txt",
            f"compare {SLOW} --folds 1",
            f"compare {SLOW} --folds 99 --forecaster tuned-kalman",
            f"compare {SLOW} --sequence bike-pan --forecaster tuned-kalman",
            f"compare {SLOW} --latency steady",
            "compare nowhere.parquet",
            f"fidelity {SLOW}",
            f"fidelity {SLOW} --closed-loop {FAST}",
            f"fidelity {REAL_TIME} --closed-loop {REAL_TIME}",
            f"fidelity {SLOW} --closed-loop {REAL_TIME} --strided {REAL_TIME}",
            f"fidelity {FAST} --closed-loop {REAL_TIME}",
            "show nowhere.parquet",
            f"show {SLOW} --plot times.txt",
        ),
    ),
    Case(
        "errors-study",
        (
            "study nowhere.toml",
            *(f"study {name}.toml --out out --workers 1" for name in STUDY_FAULTS),
            "study good.toml --workers 1 --scheduler tcp://nowhere:1",
            "study good.toml --workers 0",
        ),
        writes={
            "good.toml": f'traces = ["{SLOW}"]',
            **{f"{name}.toml": text for name, text in STUDY_FAULTS.items()},
        },
    ),
    Case(
        "errors-traces",
        tuple(f"show traces/cases/invalid/{path.name}" for path in _samples("cases/invalid")),
    ),
)

BOXES = "data/results_boxes"
TIMED = "data/results_with_times"

REAL = (
    Case(
        "real-nano",
        (
            f"convert {BOXES}/DTB70/NanoTrackV3.npz --truth data/DTB70 --time constant:47ms "
            "--out nano.parquet",
        ),
        files=("nano.parquet",),
        data=True,
    ),
    Case(
        "real-kcf",
        (
            f"convert {BOXES}/DTB70/KCF_GaussHog.npz --truth data/DTB70 "
            f"--time mean-fps:{BOXES}/DTB70/fps.csv --out kcf.parquet --json",
        ),
        files=("kcf.parquet",),
        data=True,
    ),
    Case(
        "real-ortrack",
        (
            f"convert {TIMED}/VisDrone-SOT-test-dev/ORTrack-DeiT-tiny "
            "--truth data/VisDrone-SOT-test-dev --out ortrack.parquet --json",
        ),
        files=("ortrack.parquet",),
        data=True,
    ),
    Case(
        "real-eco",
        (
            f"convert {BOXES}/UAV123/ECO_gpu.npz --truth data/UAV123 "
            f"--time mean-fps:{BOXES}/UAV123/fps.csv --out eco.parquet --json",
        ),
        files=("eco.parquet",),
        data=True,
    ),
    Case(
        "real-otb",
        (
            f"convert {TIMED}/OTB100/SiamFC_ytb_e48 --truth data/OTB100 --out siamfc.parquet",
            f"convert {TIMED}/OTB100/SiamFC_ytb_e48 --truth data/OTB100 "
            "--truth-file Tiger1=data/OTB100/anno_alt/Tiger1_354.txt --out siamfc.parquet",
            "show siamfc.parquet --json",
            "replay siamfc.parquet --convention otb --forecaster hold kalman --json",
        ),
        data=True,
    ),
    Case(
        "real-replay-nano",
        (
            "replay nano.parquet --sigma-grid --attributes --per-sequence --json",
            "replay nano.parquet --latency-scale 1 2 4 --sigma-grid --attributes",
            f"replay nano.parquet --forecaster {BUILT_IN} --json",
            "replay nano.parquet --latency lognormal:1 --fps 15 60 --convention got10k --json",
            "replay nano.parquet --latency constant:20ms --policy shrinking-tail:20ms --json",
            "replay nano.parquet --sequence Gull2 --root data/frames/DTB70 --camera-lag 1 "
            "--forecaster hold camera+kalman --json",
            "show nano.parquet",
        ),
        needs=("real-nano",),
        data=True,
    ),
    Case(
        "real-replay-ortrack",
        (
            "replay ortrack.parquet --latency-scale 1 2 4 --sigma-grid --per-sequence --json",
            "replay ortrack.parquet --latency-scale 1 2 4 --attributes",
            *(f"replay ortrack.parquet --latency {each} --latency-scale 2" for each in LATENCIES),
            "replay ortrack.parquet --policy fifo --sigma-grid",
            "show ortrack.parquet",
            "show ortrack.parquet --json",
        ),
        needs=("real-ortrack",),
        data=True,
    ),
    Case(
        "real-replay-eco",
        (
            "replay eco.parquet --sigma-grid --per-sequence --json",
            "replay eco.parquet --forecaster hold kalman kalman-lae-pvt least-squares --attributes "
            "--latency-scale 1/2 2",
        ),
        needs=("real-eco",),
        data=True,
    ),
    Case(
        "real-compare",
        (
            "compare nano.parquet kcf.parquet --attributes --out scores.csv --json",
            "compare nano.parquet --latency constant:20ms constant:47ms "
            "--forecaster kalman tuned-kalman --attributes",
            "compare ortrack.parquet --latency-scale 1 2 4 --sigma-grid --forecaster kalman g-h",
        ),
        files=("scores.csv",),
        needs=("real-nano", "real-kcf", "real-ortrack"),
        data=True,
    ),
    Case(
        "real-study",
        ("study study.toml --out out --workers 2",),
        files=_study_files("out"),
        needs=("real-nano", "real-kcf"),
        writes={"study.toml": STUDY_REAL},
        data=True,
    ),
    Case(
        "real-study-stalls",
        ("study study.toml --out out --workers 2",),
        files=_study_files("out"),
        needs=("real-ortrack",),
        writes={"study.toml": STUDY_STALLS},
        data=True,
    ),
    Case(
        "real-profile",
        (
            "profile --root data/frames/DTB70 --sequence Gull2 --timing constant:47ms "
            "--out gull.parquet",
            "replay gull.parquet --json",
        ),
        files=("gull.parquet",),
        data=True,
    ),
)

# What others need comes before them: it is started first, so that waiting for it ends.
CASES = sorted(
    (*TRACES, *REPLAYS, *COMPARISONS, *STUDIES, *FAULTS, *REAL),
    key=lambda case: (case.data, bool(case.needs)),
)


# ------------------------------------------------------------------------------ running a case


@dataclass(frozen=True)
class Bench:
    """Where cases run.

    Attributes:
        python: the interpreter whose lae_sim is asked.
        work: the folder of the cases' folders.
        data: the folder of real data, if it is there.
    """

    python: str
    work: Path
    data: Path | None

    def neutral_text(self, text: str) -> str:
        """A text without what differs from run to run."""
        places = {str(self.work): "<work>", str(ROOT): "<repository>", self.python: "<python>"}
        if self.data:
            places[str(self.data)] = "<data>"
        for place in sorted(places, key=len, reverse=True):
            text = text.replace(place, places[place])
        text = re.sub(r"(?ms)^usage: .*?(?=^lae-sim[^\n]*: error: )", "", text)
        text = re.sub(r"(?m)^(Traceback .*\n)(?:[ \t].*\n)+", r"\1", text)
        text = re.sub(r"(?m)^lae sim  .*$", "lae sim  <version>", text)
        return re.sub(r"\b(lae[-_ ]sim),? (?:version )?\d+\.\d+[\w.+]*", r"\1 <version>", text)


def run_case(case: Case, bench: Bench) -> dict[str, Any]:
    """Run the commands of a case; its answers."""
    folder = bench.work / case.name
    folder.mkdir()
    (folder / "traces").symlink_to(SAMPLES)
    if bench.data:
        (folder / "data").symlink_to(bench.data)
    for need in case.needs:
        for path in (bench.work / need).iterdir():
            if not (folder / path.name).exists():
                (folder / path.name).symlink_to(path)
    given = {path.name for path in folder.iterdir()} - {"out"}
    for name, text in case.writes.items():
        (folder / name).write_text(text)
    if case.make:
        case.make(folder)
    commands = {}
    for command in case.commands:
        key = command if command not in commands else f"{command} (again)"
        commands[key] = _run(command, folder, bench, case.measured)
    files: dict[str, Any] = {}
    for pattern in case.files:
        if pattern.endswith("/"):
            files[pattern] = _data_set(folder / pattern)
            continue
        paths = sorted(path for path in folder.glob(pattern) if path.is_file())
        paths = [path for path in paths if path.relative_to(folder).parts[0] not in given]
        if not paths:
            files[pattern] = "nothing there"
        for path in paths:
            files[str(path.relative_to(folder))] = _content(path, bench, case.measured)
    return {"commands": commands, "files": files}


def _run(command: str, folder: Path, bench: Bench, measured: Sequence[str]) -> dict[str, Any]:
    arguments: list[str] = []
    for word in shlex.split(command):  # globs as a shell gives them to a command
        matching = folder.glob(word) if "*" in word else ()
        arguments += sorted(str(path.relative_to(folder)) for path in matching) or [word]
    # as on a terminal of one width, in one language; never another checkout's package
    environment = {**os.environ, "COLUMNS": "100", "LC_ALL": "C.UTF-8", "TZ": "UTC"}
    environment.pop("PYTHONPATH", None)
    done = subprocess.run(
        [bench.python, "-m", "lae_sim", *arguments],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    return {
        "status": done.returncode,
        "stdout": _parsed(done.stdout, bench, measured),
        "stderr": bench.neutral_text(done.stderr).splitlines(),
    }


def _parsed(text: str, bench: Bench, measured: Sequence[str]) -> Any:
    """JSON as its value, any other text as its lines."""
    if text.startswith(("{", "[")):
        try:
            return _neutral(json.loads(text), bench, measured)
        except json.JSONDecodeError:
            pass
    return bench.neutral_text(text).splitlines()


_ALWAYS_MEASURED = frozenset({"readings", "cpu_share", "measured_ns", "cpu_ns"})


def _neutral(value: Any, bench: Bench, measured: Sequence[str] = ()) -> Any:
    """A value without what differs from run to run."""
    if isinstance(value, dict):
        kept = {}
        for key, each in value.items():
            if key == "lae_sim":
                kept[key] = "<version>"
            elif key in measured or key in _ALWAYS_MEASURED:
                kept[key] = "<measured>"
            else:
                kept[key] = _neutral(each, bench, measured)
        return kept
    if isinstance(value, list):
        return [_neutral(each, bench, measured) for each in value]
    return bench.neutral_text(value) if isinstance(value, str) else value


def _content(path: Path, bench: Bench, measured: Sequence[str]) -> Any:
    """What is kept of a file."""
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        return _parquet(path, bench, measured)
    if suffix in (".png", ".pdf"):  # drawings may change
        return path.read_bytes()[:4].decode("latin-1")
    text = path.read_text(encoding="utf-8")
    if suffix == ".svg":
        return "an <svg>" if "<svg" in text else "no <svg>"
    if suffix == ".csv":
        return _csv_table(text)
    if suffix == ".html":
        return bench.neutral_text(_visible(text)).splitlines()
    if suffix == ".jsonl":
        return [_neutral(json.loads(line), bench, measured) for line in text.splitlines()]
    return _parsed(text, bench, measured)


def _parquet(path: Path, bench: Bench, measured: Sequence[str]) -> dict[str, Any]:
    table = pq.read_table(path)
    metadata: dict[str, Any] = {}
    for key, value in (table.schema.metadata or {}).items():
        if key == b"lae_sim":
            metadata["lae_sim"] = _neutral(json.loads(value), bench, measured)
        elif key != b"pandas":  # tells versions of libraries
            metadata[key.decode()] = value.decode()
    columns = _arrow_table(table)
    masked = {name: "<measured>" for name in columns["columns"] if name in measured}
    return {"metadata": metadata, **columns, "columns": {**columns["columns"], **masked}}


def _data_set(folder: Path) -> Any:
    """All rows of a folder of Parquet files, sorted, since the files' names are digests."""
    paths = sorted(folder.glob("*.parquet"))
    if not paths:
        return "nothing there"
    table = pa.concat_tables([pq.read_table(path).replace_schema_metadata() for path in paths])
    names = [each.name for each in table.schema if pa.types.is_string(each.type)]
    names += [name for name in ("repetition", "sigma") if name in table.column_names]
    return _arrow_table(table.sort_by([(name, "ascending") for name in names]))


def _arrow_table(table: Any) -> dict[str, Any]:
    return {
        "header": table.column_names,
        "types": {each.name: str(each.type) for each in table.schema},
        "rows": table.num_rows,
        "columns": {name: table.column(name).to_pylist() for name in table.column_names},
    }


def _csv_table(text: str) -> dict[str, Any]:
    header, *rows = list(csv.reader(text.splitlines()))
    columns = [[_number(row[place]) for row in rows] for place in range(len(header))]
    return {"header": header, "rows": len(rows), "columns": dict(zip(header, columns))}


def _number(text: str) -> int | float | str:
    if re.fullmatch(r"[-+]?\d+", text):
        return int(text)
    if re.fullmatch(r"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?", text):
        return float(text)
    return text


class _Page(HTMLParser):
    """Collects the text that a browser shows: a line for each block, cells side by side."""

    hidden = ("style", "script", "svg", "title")
    inline = ("a", "abbr", "b", "code", "em", "i", "small", "span", "strong", "sub", "sup", "var")

    def __init__(self) -> None:
        super().__init__()
        self.depth = 0
        self.parts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.depth += tag in self.hidden
        self._separate(tag, " | ")

    def handle_endtag(self, tag: str) -> None:
        self.depth -= tag in self.hidden
        self._separate(tag, "")

    def handle_data(self, data: str) -> None:
        if not self.depth:
            self.parts.append(data.replace("\n", " "))

    def _separate(self, tag: str, cell: str) -> None:
        if tag not in self.inline:
            self.parts.append(cell if tag in ("td", "th") else "\n")


def _visible(text: str) -> str:
    page = _Page()
    page.feed(text)
    lines = (" ".join(line.split()).strip(" |") for line in "".join(page.parts).splitlines())
    return "\n".join(line for line in lines if line)


# ------------------------------------------------------------------------------- differences


@dataclass(frozen=True)
class Difference:
    """One value that is not what it was."""

    path: str
    old: str
    new: str


def differences(
    old: Any, new: Any, path: str = "", ignore_added: bool = False
) -> Iterator[Difference]:
    """Everything in which two kept answers differ.

    Args:
        old, new: plain values.
        path: where they are.
        ignore_added: whether keys and columns may be added.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        for key in old:
            if key not in new:
                yield Difference(f"{path}{_step(key)}", _short(old[key]), "missing")
            elif key == "header" and ignore_added:
                kept = [name for name in new[key] if name in old[key]]
                yield from differences(old[key], kept, f"{path}.{key}")
            else:
                yield from differences(old[key], new[key], f"{path}{_step(key)}", ignore_added)
        if not ignore_added:
            for key in new:
                if key not in old:
                    yield Difference(f"{path}{_step(key)}", "missing", _short(new[key]))
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield Difference(f"{path}.length", str(len(old)), str(len(new)))
        for place, (before, after) in enumerate(zip(old, new)):
            yield from differences(before, after, f"{path}[{place}]", ignore_added)
        longer = old if len(old) > len(new) else new
        for place in range(min(len(old), len(new)), len(longer)):
            here, side = _short(longer[place]), f"{path}[{place}]"
            yield Difference(side, *((here, "missing") if longer is old else ("missing", here)))
    elif not _same(old, new):
        yield Difference(path, _short(old), _short(new))


def _same(old: Any, new: Any) -> bool:
    if type(old) is not type(new):
        return False
    if not isinstance(old, float) or old == new:
        return bool(old == new)
    if math.isnan(old) or math.isnan(new):
        return math.isnan(old) and math.isnan(new)
    return abs(old - new) <= TOLERANCE * max(1.0, abs(old)) and math.isfinite(new)


def _step(key: str) -> str:
    return f".{key}" if re.fullmatch(r"\w+", key) else f"[{key!r}]"


def _short(value: Any, most: int = 160) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= most else f"{text[:most]}..."


# ---------------------------------------------------------------------------------- goldens


def layout(value: Any, indent: str = "") -> str:
    """JSON with numbers side by side, so that long columns stay readable."""
    inner = indent + " "
    if isinstance(value, dict) and any(isinstance(each, (dict, list)) for each in value.values()):
        items = (f"{inner}{_dumped(key)}: {layout(each, inner)}" for key, each in value.items())
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list) and value:
        if all(isinstance(each, (int, float, type(None))) for each in value):
            rows = (value[place : place + 16] for place in range(0, len(value), 16))
            lines = (", ".join(map(_dumped, row)) for row in rows)
        else:
            lines = (layout(each, inner) for each in value)
        return "[\n" + ",\n".join(inner + line for line in lines) + f"\n{indent}]"
    return _dumped(value)


def _dumped(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _chosen(arguments: argparse.Namespace, data: Path | None) -> list[Case]:
    """The cases asked for; says which cannot be run."""
    chosen = [
        case
        for case in CASES
        if any(fnmatch.fnmatchcase(case.name, pattern) for pattern in arguments.only)
    ]
    if not chosen:
        sys.exit(f"no case is called {' or '.join(arguments.only)}")
    if data is None or arguments.quick:
        skipped = [case.name for case in chosen if case.data]
        chosen = [case for case in chosen if not case.data]
        if skipped:
            why = "--quick" if arguments.quick else f"no real data at {arguments.data}"
            print(f"skipped, {why}: {', '.join(skipped)}")
    return chosen


def _run_all(
    chosen: Sequence[Case], bench: Bench, jobs: int
) -> Iterator[tuple[Case, dict[str, Any], float]]:
    """Run cases, and those that they need; what the chosen ones answer, in order."""
    named = {case.name: case for case in CASES}
    wanted = {case.name for case in chosen}
    needed = {*wanted, *(need for case in chosen for need in case.needs)}
    running: dict[str, Future[tuple[dict[str, Any], float]]] = {}

    def work(case: Case) -> tuple[dict[str, Any], float]:
        for need in case.needs:
            running[need].result()
        started = time.monotonic()
        return run_case(case, bench), time.monotonic() - started

    with ThreadPoolExecutor(jobs) as pool:
        for name in (name for name in named if name in needed):
            running[name] = pool.submit(work, named[name])
        for name, future in running.items():
            answers, seconds = future.result()
            if name in wanted:
                yield named[name], answers, seconds


def main() -> int:
    """Run the command line; the exit status is 1 if something differs."""
    arguments = _parser().parse_args()
    if arguments.command == "list":
        for case in CASES:
            print(f"{case.name:22}{len(case.commands):4} commands{'  real data' * case.data}")
        return 0
    folder = Path(arguments.folder)
    data = arguments.data.resolve()
    given = data if data.is_dir() and not arguments.quick else None
    chosen = _chosen(arguments, given)
    started, found = time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="goldens-") as work:
        # not resolved: an environment's interpreter is a link to one outside of it
        python = os.path.abspath(shutil.which(arguments.python) or arguments.python)
        bench = Bench(python, Path(work).resolve(), given)
        version = _version(bench)
        print(f"{version}: {len(chosen)} cases")
        for case, answers, seconds in _run_all(chosen, bench, arguments.jobs):
            path = folder / f"{case.name}.json"
            told = f"{case.name:22}{seconds:6.1f} s"
            if arguments.command == "freeze":
                folder.mkdir(parents=True, exist_ok=True)
                document = {"case": case.name, "version": version, **answers}
                path.write_text(layout(document) + "\n", encoding="utf-8")
                print(told, flush=True)
                continue
            found += _compare(path, answers, arguments, told)
    print(f"{len(chosen)} cases in {time.monotonic() - started:.0f} s")
    if arguments.command == "compare":
        print(f"{found} differences" if found else "no difference")
    return 1 if found else 0


def _compare(path: Path, answers: Any, arguments: argparse.Namespace, told: str) -> int:
    """Print in what the answers differ from a golden file; their number."""
    if not path.is_file():
        print(f"{told}  not frozen: {path}", flush=True)
        return 1
    golden = json.loads(path.read_text(encoding="utf-8"))
    del golden["case"], golden["version"]
    # through JSON, as the golden went: tuples and the like are alike then
    answers = json.loads(json.dumps(answers))
    found = list(differences(golden, answers, ignore_added=arguments.ignore_added))
    print(f"{told}  {f'{len(found)} DIFFERENCES' if found else 'same'}", flush=True)
    shown = found if not arguments.limit else found[: arguments.limit]
    for each in shown:
        print(f"  {path.stem} {each.path.removeprefix('.')}\n    - {each.old}\n    + {each.new}")
    if len(shown) < len(found):
        print(f"  and {len(found) - len(shown)} more (--limit 0 lists all)")
    return len(found)


def _version(bench: Bench) -> str:
    command = [bench.python, "-m", "lae_sim", "--version"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, cwd=bench.work)
    except OSError as error:
        sys.exit(f"--python {bench.python}: {error.strerror}")
    if done.returncode:
        sys.exit(f"--python {bench.python}: no lae_sim is there: {done.stderr.strip()}")
    return done.stdout.strip()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description="Freeze what a version of lae_sim answers; hold another against it."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name, text in {
        "freeze": "keep the answers in FOLDER",
        "compare": "run the same again, and list each difference from what FOLDER keeps",
    }.items():
        command = commands.add_parser(name, help=text, description=text)
        add = command.add_argument
        add("folder", metavar="FOLDER")
        add("--python", default=sys.executable, help="interpreter with lae_sim (default: this one)")
        add("--data", type=Path, default=ROOT.parent / "shared" / "data", help="real data")
        add("--only", nargs="+", default=["*"], metavar="NAME", help="these cases (default: *)")
        add("--quick", action="store_true", help="no real data")
        add("--jobs", type=int, default=2, help="cases at a time (default: 2)")
        if name == "compare":
            add("--ignore-added", action="store_true", help="keys and columns may be added")
            add("--limit", type=int, default=0, help="differences shown per case (default: all)")
    commands.add_parser("list", help="name the cases")
    return parser


if __name__ == "__main__":
    sys.exit(main())
