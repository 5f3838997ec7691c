"""``lae-sim show``: what a trace says of itself, and how its processing times are distributed."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lae_sim.cli import exit_status

if TYPE_CHECKING:
    from lae_sim.metadata import Metadata
    from lae_sim.timing import SequenceTimes
    from lae_sim.trace import Trace

Report = dict[str, Any]

_NOT_SHOWN = ("format", "version", "fps", "sequences", "failures")
_EXAMPLES = """\
examples:
  lae-sim show trace.parquet
  lae-sim show laptop.parquet jetson.parquet --plot times.png
  lae-sim show trace.parquet --json | jq '.traces[].times.calls.p99_ms'
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lae-sim show``; see ``--help``."""
    parser = argparse.ArgumentParser(
        prog="lae-sim show",
        description="Say what a trace holds, and how its processing times are distributed.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("traces", nargs="+", metavar="TRACE", help="traces (see traces/FORMAT.md), folders, URLs")
    add("--json", action="store_true", help="print one JSON object instead of text")
    add("--plot", metavar="FILE", help="draw the times (.png, .svg, .pdf)")
    arguments = parser.parse_args(argv)
    return exit_status(lambda: _show(arguments), "lae-sim show")


def _show(arguments: argparse.Namespace) -> None:
    from lae_sim import __version__
    from lae_sim.files import check_distinct
    from lae_sim.locate import find_traces
    from lae_sim.show_text import overview
    from lae_sim.trace import read_trace

    arguments.traces = find_traces(arguments.traces)
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="replace")  # a name may have what the terminal has not
    if arguments.plot:
        from lae_sim.plots import check_format

        check_distinct([arguments.plot], arguments.traces)
        check_format(arguments.plot)
    found = [describe(read_trace(path), path) for path in arguments.traces]
    reports = [report for report, _ in found]
    if arguments.json:
        document = {"format": "lae-show", "version": "1.0", "lae_sim": __version__}
        print(json.dumps({**document, "traces": reports}, indent=2, allow_nan=False))
    else:
        print("\n\n".join(map(overview, reports)))
    if arguments.plot:
        _plot(found, arguments.plot)


def describe(trace: Trace, path: str) -> tuple[Report, list[SequenceTimes]]:
    """What ``--json`` prints of a trace, and its times in the order in which they were taken.

    Args:
        trace: the trace; it is read once.
        path: the file that it is from.

    Raises:
        TraceError: if it is not a valid trace.
    """
    import numpy as np

    from lae_sim import timing

    metadata = trace.metadata
    entries = metadata.document.get("sequences", {})
    sequences, frames, with_truth, sizes = [], 0, 0, Counter[str]()
    for recording in trace:
        sequences.append(timing.SequenceTimes.of(recording))
        frames += len(recording)
        with_truth += int((~np.isnan(recording.truth[:, 0])).sum())
        size = metadata.image_size(recording.name)
        sizes[f"{size[0]}x{size[1]}" if size else "unknown"] += 1
    order = {s.name: entries.get(s.name, {}).get("order") for s in sequences}
    ordered = all(isinstance(place, int) for place in order.values())
    if ordered:
        sequences.sort(key=lambda s: order[s.name])
    calls = np.concatenate([s.elapsed_ns for s in sequences])
    failures = metadata.document.get("failures")
    lost = [entries.get(s.name, {}).get("lost") for s in sequences]
    report = {
        "trace": path,
        "fps": str(metadata.fps),
        "provenance": {k: v for k, v in metadata.document.items() if k not in _NOT_SHOWN},
        "sequences": len(sequences),
        "world_frames": frames,
        "processed": len(calls) + len(sequences),
        "with_truth": with_truth,
        "image_sizes": dict(sizes.most_common()),
        "lost": sum(lost) if all(isinstance(n, int) for n in lost) else None,
        "failures": failures if isinstance(failures, list) else [],
        "times": {
            "calls": timing.summary(calls),
            "initialisations": timing.summary(np.array([s.init_ns for s in sequences])),
            "frame_interval_ms": float(1000 / metadata.fps),
            "slower_than_frames": timing.share_slower(calls, metadata.fps),
            "histogram": timing.histogram(calls) if len(calls) else None,
            "first_calls": timing.first_calls(sequences),
            "order_known": ordered,
            "drift": timing.drift(sequences),
            "stalls": timing.stalls(sequences),
        },
    }
    return {**report, "warnings": list(_warnings(report, metadata))}, sequences


def _warnings(report: Report, metadata: Metadata) -> Iterator[str]:
    """What a user should know before trusting the times."""
    from lae_sim.sensors import gathered, throttling

    first, drift = report["times"]["first_calls"], report["times"]["drift"]
    if first and first["ratio"] > 1.5:
        took = f"{first['median_ms']:.3g} ms, {first['ratio']:.2g} x the median of the others"
        yield f"the first call after an initialisation takes {took}: warm up"
    if drift and drift["slower"]:
        longer = f"took {100 * drift['ratio'] - 100:.0f}% longer than the first third"
        yield f"the last third of the run {longer}: heat, throttling, or harder sequences"
    device = metadata.document.get("device", {})
    taken = device.get("readings", {})
    found = gathered(  # whatever another program wrote there
        busy=lambda: _busy(taken["before"]["load"][0], device["cpu"]),
        throttled=lambda: throttling(
            taken.get("before", {}), taken.get("during", []), taken.get("after", {})
        ),
    )
    yield from found.values()


def _busy(load: float, cpu: Mapping[str, Any]) -> str | None:
    """Whether other programs were running when the profile began."""
    cores = cpu.get("affinity") or cpu["cores"]
    if load <= cores / 2:
        return None
    return f"the load before the profile was {load:.1f} on {cores} cores: other programs were busy"


def _plot(found: Sequence[tuple[Report, Sequence[SequenceTimes]]], path: str) -> None:
    """Draw, for each trace, a histogram of its times, and the times over the run."""
    from matplotlib.figure import Figure

    from lae_sim import plots

    figure = Figure(figsize=(11, 3.6 * len(found)), layout="constrained")
    rows = figure.subplots(len(found), 2, squeeze=False, width_ratios=(1, 2))
    for (left, right), (report, sequences) in zip(rows, found):
        times = report["times"]
        if histogram := times["histogram"]:
            left.stairs(histogram["counts"], histogram["edges_ms"], fill=True)
            outside = histogram["below"] + histogram["above"]
            left.set_title(f"{outside:,} of {times['calls']['n']:,} calls are outside", fontsize=9)
            calls = times["calls"]
            right.set_yscale("log" if calls["max_ms"] > 5 * calls["median_ms"] else "linear")
        left.set(xlabel="time (ms)", ylabel="calls")
        start = 0
        for number, sequence in enumerate(sequences):
            places = range(start, start := start + len(sequence.elapsed_ns))
            ms, colour = sequence.elapsed_ns / 1e6, f"C{number % 2 * 9}"
            right.plot(places, ms, ".", ms=1.5, color=colour, rasterized=True)
        order = "as they were run" if times["order_known"] else "in order of their names"
        right.set(xlabel=f"calls, sequences {order}", ylabel="time (ms)")
        right.axhline(times["frame_interval_ms"], color="tab:red", ls="--", lw=1)
        right.set_title(f"{report['trace']} (dashed: the interval between frames)", fontsize=9)
    plots.save(figure, path)


if __name__ == "__main__":
    sys.exit(main())
