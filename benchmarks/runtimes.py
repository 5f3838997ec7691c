"""Trackers on ONNX Runtime beside OpenCV's: ``benchmarks/runtimes.py --frames F --weights W``.

``F`` holds a folder for each dataset, whose layout ``lae-sim profile --root`` knows; ``W`` the
folders ``nanotrackv3`` and ``fear_xs`` of ONNX files (see ``docs/howto/onnx.md``). Each tracker is
profiled on all sequences, on each number of threads, in the order 1, 2, 2, 1, so that what else the
machine does falls on all: the median time of a call, and the mean of its CPU time. Scores are means
over sequences, convention pysot; hold is replayed at 47 ms a frame.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

import lae_sim
from lae_sim.report.table import aligned

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
LATENCY = "constant:47ms"
FIGURES = {
    "offline_auc": "offline AUC",
    "offline_dp20": "offline DP",
    "auc": "hold AUC",
    "dp20": "hold DP",
}


def trackers(weights: Path, provider: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """What is measured: names and options, by the words for it."""
    nano: dict[str, Any] = {"weights": str(weights / "nanotrackv3")}
    fear: dict[str, Any] = {"weights": str(weights / "fear_xs"), "provider": provider}
    ort = {"runtime": "onnxruntime", "provider": provider}
    return {
        "NanoTrack v3, OpenCV": ("nanotrack", nano),
        "NanoTrack v3, ONNX Runtime": ("nanotrack", {**nano, **ort}),
        "FEAR-XS, ONNX Runtime": ("fear_xs:FearXS", fear),
    }


def measured(
    tracker: str, options: Mapping[str, Any], roots: Sequence[Path], threads: int
) -> tuple[pd.DataFrame, list[float], float]:
    """Scores by sequence, the times of all calls in ms, and their CPU time in ms per call."""
    scores, times, calls, cpu_ns = [], [], 0, 0
    with tempfile.TemporaryDirectory() as folder:
        for root in roots:
            path = Path(folder, f"{root.name}.parquet")
            lae_sim.profile_tracker(
                tracker, options=options, root=root, threads=threads, out=path, progress=False
            )
            trace = lae_sim.read_trace(path)
            for recording in trace:
                times += (recording.elapsed_ns[1:] / 1e6).tolist()  # without the initialisation
                calls += len(recording)
            entries = trace.metadata.document["sequences"].values()
            cpu_ns += sum(entry["cpu_ns"] for entry in entries)
            found = lae_sim.evaluate(path, forecasters="hold", latency=LATENCY)
            scores.append(found.to_frame())
    return pd.concat(scores, ignore_index=True), times, cpu_ns / calls / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=Path, required=True)
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--provider", default="CPU")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    arguments = parser.parse_args()
    roots = sorted(path for path in arguments.frames.iterdir() if path.is_dir())
    os.environ["PYTHONPATH"] = str(EXAMPLES)
    sys.path.append(str(EXAMPLES))
    order = [*arguments.threads, *reversed(arguments.threads)]
    rows, by_sequence = [], []
    for label, (tracker, options) in trackers(arguments.weights, arguments.provider).items():
        times: dict[int, list[float]] = {n: [] for n in order}
        cpu: dict[int, list[float]] = {n: [] for n in order}
        for threads in order:
            scores, calls, cpu_ms = measured(tracker, options, roots, threads)
            times[threads] += calls
            cpu[threads].append(cpu_ms)
        mean = scores[list(FIGURES)].mean()
        figures = [f"{mean[name]:.3f}" for name in FIGURES]
        for n in arguments.threads:
            median, cpu_ms = statistics.median(times[n]), statistics.mean(cpu[n])
            rows.append([label, str(n), *figures, f"{median:.1f}", f"{cpu_ms:.1f}"])
        by_sequence += [
            [label, row["sequence"], *(f"{row[name]:.3f}" for name in FIGURES)]
            for _, row in scores.iterrows()
        ]
    heads = list(FIGURES.values())
    print(aligned(["tracker", "threads", *heads, "ms", "CPU ms"], rows))
    print()
    print(aligned(["tracker", "sequence", *heads], by_sequence))


if __name__ == "__main__":
    main()
