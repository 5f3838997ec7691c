"""``lae-sim convert``: traces from results that other toolkits have written."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lae_sim.cli.options import argument, exit_status
from lae_sim.engine.clock import Clock, parse_fps
from lae_sim.errors import LaeError
from lae_sim.files import check_distinct
from lae_sim.importers.convert import (
    every_frame,
    figures,
    listed,
    matched_results,
    real_time,
    sequence_entries,
)

_FORMATS = ("auto", "got10k", "pytracking", "ope", "mat", "npz", "lae-pvt")
_EXAMPLES = """\
formats (auto tells them apart):
  got10k       <seq>.txt with <seq>_time.txt or times/<seq>_time.txt (s);
               <seq>/<seq>_001.txt with <seq>/<seq>_time.txt
  pytracking   <seq>.txt with <seq>_time.txt (s), separated by tabs
  ope          <seq>.txt (comma, tab or space), no times: needs --time
  mat          <seq>.mat or <seq>_<tracker>.mat with res and fps (OTB, UAV123 benchmarks)
  npz          one file, an array [frames, 4] per sequence: needs --time
  lae-pvt      <seq>.pkl of LAE-PVT and PVT++, recorded in real time

examples:
  lae-sim convert results/kcf --truth OTB100 --out kcf.parquet
  lae-sim convert NanoTrackV3.npz --truth DTB70 --time constant:47ms --out nano.parquet
  lae-sim convert results/ECO --truth UAV123_10fps --fps 10 --time mean-fps:13.5 --out eco.parquet
  lae-sim convert results_rt_raw/siamrpn --truth UAVDT --device 'AGX Xavier' --out rt.parquet
  lae-sim convert results/kcf --truth OTB100 --truth-file Tiger1=Tiger1_354.txt --out kcf.parquet
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lae-sim convert``; see ``--help``."""
    arguments = _parser().parse_args(argv)
    return exit_status(lambda: _convert(arguments), "lae-sim convert")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lae-sim convert",
        description="Make a trace from a tracker's results and the dataset's ground truth.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("results", type=Path, metavar="RESULTS", help="folder of one tracker's results, or a file")
    add("--truth", type=Path, required=True, metavar="ROOT", help="the dataset's folder")
    add("--out", type=Path, required=True, metavar="TRACE", help="the trace to write (.parquet)")
    add("--format", choices=_FORMATS, default="auto", help="format of RESULTS (default: auto)")
    add(
        "--fps",
        help="world frames per second, such as 29.97 or 30000/1001 (default: 30, or 10 if the "
        "dataset's name says 10fps)",
    )
    add(
        "--time",
        default="measured",
        help="measured (default), constant:47ms, mean-fps:120, or mean-fps:FILE.csv with columns "
        "sequence, fps and perhaps tracker, frames",
    )
    add("--time-unit", choices=("s", "ms", "us", "ns"), help="unit of measured times (default: s)")
    add("--repetition", type=int, default=1, metavar="K", help="take the K-th run (default: 1)")
    add("--tracker", metavar="NAME", help="the tracker's name (default: that of RESULTS)")
    add("--device", metavar="TEXT", help="the device that the times were taken on")
    add("--dataset", metavar="NAME", help="the dataset's name (default: that of its folder)")
    add("--sequence", nargs="+", default=[], metavar="NAME", help="only these sequences")
    add("--exclude", nargs="+", default=[], metavar="NAME", help="all but these sequences")
    add(
        "--truth-file",
        action="append",
        default=[],
        type=argument(_truth_file),
        metavar="SEQ=FILE",
        help="other ground truth for one sequence",
    )
    add("--skip-missing", action="store_true", help="leave out results without ground truth")
    add("--image-size", type=argument(_size), metavar="WxH", help="image size, such as 1280x720")
    add("--json", action="store_true", help="print the summary as JSON")
    return parser


def _convert(arguments: argparse.Namespace) -> None:
    from lae_sim.datasets.annotations import find_truth, read_attributes
    from lae_sim.importers.results import find_results, given_times, tracker_name
    from lae_sim.trace.file import Trace, write_trace
    from lae_sim.trace.metadata import Metadata

    if arguments.repetition < 1:
        raise LaeError("--repetition counts from 1")
    check_distinct([arguments.out], [arguments.results, *(p for _, p in arguments.truth_file)])
    kind, sources = find_results(arguments.results, arguments.format, arguments.repetition)
    truth = find_truth(arguments.truth).with_files(dict(arguments.truth_file))
    matched, skipped = matched_results(kind, sources, truth, arguments)
    dataset = arguments.dataset or truth.dataset
    fps = arguments.fps or ("10" if "10fps" in dataset.lower() else "30")
    clock = Clock.at(parse_fps(fps))
    tracker = arguments.tracker or tracker_name(kind, arguments.results, matched)
    given = given_times(arguments.time, tracker)
    if kind == "lae-pvt":
        if given:
            raise LaeError("--time does not go with lae-pvt, whose runs hold their own times")
        recordings, timing = real_time(matched, truth, clock)
    else:
        recordings, timing = every_frame(kind, matched, truth, given, arguments)
    about = {
        "tracker": {"name": tracker},
        "device": {"model": arguments.device} if arguments.device else {},
        "dataset": {"name": dataset},
        "timing": timing,
        "sequences": sequence_entries(matched, read_attributes(truth), arguments.image_size),
    }
    if kind == "lae-pvt":
        metadata = Metadata.new(fps, "real-time", schedule={"policy": "latest"}, **about)
    else:
        metadata = Metadata.new(fps, "every-frame", **about)
    read = [file for source in matched.values() for file in (source.path, source.times) if file]
    check_distinct([arguments.out], [*read, *truth.files.values()])
    write_trace(Trace(metadata, recordings), arguments.out)
    left_out = {*matched, *arguments.exclude}
    unmatched = [name for name in truth.files if name not in left_out]
    summary = {
        "trace": str(arguments.out),
        "format": kind,
        "schedule": metadata.kind,
        "fps": fps,
        "tracker": tracker,
        "dataset": dataset,
        "timing": timing,
        **figures(recordings),
        "without_truth": skipped,
        "without_results": [] if arguments.sequence else unmatched,
    }
    print(json.dumps(summary, indent=2) if arguments.json else _text(summary))


def _text(summary: Mapping[str, Any]) -> str:
    """The summary for people."""
    timing = summary["timing"]
    processed = "every frame"
    if summary["schedule"] == "real-time":
        processed = f"in real time, {summary['processed']:,} processed"
    lines = [
        f"{summary['trace']}: {summary['tracker']} on {summary['dataset']}, "
        f"{summary['sequences']} sequences, {summary['frames']:,} frames at {summary['fps']} fps, "
        f"{processed}; median {_milliseconds(summary['median_ms'])} a frame. "
        f"Read as {summary['format']}; times: {timing['source']}."
    ]
    if "note" in timing:
        lines.append(f"Note: {timing['note']}.")
    if summary["without_truth"]:
        lines.append(f"Left out, without ground truth: {listed(summary['without_truth'])}.")
    if summary["without_results"]:
        lines.append(f"Without results: {listed(summary['without_results'])}.")
    return "\n".join([*lines, f"Next: lae-sim replay {summary['trace']}"])


def _milliseconds(ms: float) -> str:
    return f"{ms:.3g} ms" if ms < 1000 else f"{ms:,.0f} ms"


def _truth_file(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise LaeError(f"{text!r} is not SEQ=FILE")
    return name, Path(path)


def _size(text: str) -> tuple[int, int]:
    match = re.match(r"([1-9][0-9]{0,5})x([1-9][0-9]{0,5})\Z", text)
    if match is None:
        raise LaeError(f"{text!r} is not an image size: write it as 1280x720")
    return int(match[1]), int(match[2])
