"""``lae-sim convert``: traces from results of other toolkits, and from logs of running trackers."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from lae_sim.cli.options import (
    add_force,
    add_frame_times,
    argument,
    exit_status,
    new_parser,
    print_json,
)
from lae_sim.errors import LaeError, install, listed
from lae_sim.files import check_distinct, check_places
from lae_sim.progress import ProgressBar, print_text

if TYPE_CHECKING:
    from lae_sim.importers.convert import ConversionSummary
    from lae_sim.trace.file import Trace

_FORMATS = ("auto", "got10k", "pytracking", "ope", "mat", "json", "npz", "lae-pvt", "ros", "csv")
_RESULTS_ONLY = (
    "time_unit",
    "repetition",
    "time",
    "sequence",
    "exclude",
    "truth_file",
    "frame_times",
)
_LOGS_ONLY = (
    "image_topic", "box_topic", "truth_topic", "field", "target", "match", "clock_offset",
    "arrivals", "gaps", "init_box",
)  # fmt: skip
_EXAMPLES = f"""\
formats (auto tells them apart):
  got10k       <seq>.txt with <seq>_time.txt or times/<seq>_time.txt (s);
               <seq>/<seq>_001.txt with <seq>/<seq>_time.txt
  pytracking   <seq>.txt with <seq>_time.txt (s), separated by tabs
  ope          <seq>.txt (comma, tab or space), no times: needs --time
  mat          <seq>.mat with res and fps, boxes or another motion model (OTB, UAV123 benchmarks)
  json         <seq>.json with res and fps (jwlim's tracker_benchmark)
  npz          one file, an array [frames, 4] per sequence: needs --time
  lae-pvt      <seq>.pkl of LAE-PVT and PVT++, recorded in real time
  ros          a log: a bag of ROS 2 (folder, .mcap, .db3) or ROS 1 ({install("ros")})
  csv          a log with a row a frame: frame, arrived_ms, ready_ms, x, y, w, h; perhaps
               captured_ms, started_ms, score, truth_x, ...; times in _s, _ms, _us or _ns
Names may be <dataset>_<seq> (nfs_, uav_, ...), <seq>_<tracker> and <tracker>_<seq> in any format;
of several trackers in a folder --tracker chooses one. A .mat of version 7.3 needs h5py
({install("mat73")}).

examples:
  lae-sim convert results/kcf --truth OTB100 --out kcf.parquet
  lae-sim convert NanoTrackV3.npz --truth DTB70 --time constant:47ms,init=800ms --out n.parquet
  lae-sim convert results/ECO --truth UAV123_10fps --fps 10 --time mean-fps:13.5 --out eco.parquet
  lae-sim convert results_rt_raw/siamrpn --truth UAVDT --device 'AGX Xavier' --out rt.parquet
  lae-sim convert results/kcf --truth OTB100 --truth-file Tiger1=Tiger1_354.txt --out kcf.parquet
  lae-sim convert flight/ --out flight.parquet
  lae-sim convert flight.mcap --box-topic /track --field x=roi.x_offset --field y=roi.y_offset
      --field w=roi.width --field h=roi.height --out flight.parquet
  lae-sim convert flight.csv --fps 30 --out flight.parquet
  lae-sim convert results/OPE_OTB --tracker ECO-HC --truth OTB100 --out eco-hc.parquet
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        "lae-sim convert",
        "Make a trace from a tracker's results and the dataset's ground truth, or from the log of\n"
        "a tracker that ran: a ROS bag, or a table.",
        _EXAMPLES,
    )
    add = made.add_argument
    add(
        "results",
        type=Path,
        metavar="RESULTS",
        help="folder of one tracker's results, or a file; or a log: a bag, a .csv",
    )
    add(
        "--truth",
        type=Path,
        metavar="ROOT",
        help="the dataset's folder; of a log, if there is one, a file with a row for each frame",
    )
    add("--out", type=Path, required=True, metavar="TRACE", help="the trace to write (.parquet)")
    add(
        "--format",
        choices=_FORMATS,
        default="auto",
        metavar="FORMAT",
        help="format of RESULTS, of those below (default: auto)",
    )
    add(
        "--fps",
        help="world frames per second, such as 29.97 or 30000/1001 (default: 30, or 10 if the "
        "dataset's name says 10fps); of NfS, the set: 30 or 240; of a log by default estimated",
    )
    add(
        "--time",
        default="measured",
        help="measured (default), constant:47ms, mean-fps:120, or mean-fps:FILE.csv with columns "
        "sequence, fps and perhaps tracker, frames, or tracker, fps; ,init=800ms at the end of one "
        "that is not measured says what the initialisation takes (default: as a frame)",
    )
    add(
        "--time-unit",
        metavar="UNIT",
        help="unit of measured times: s, ms, us, ns, fps, or cumulative-s (-ms, ...) for times "
        "since the start (default: s, where the median is then from 0.5 to 250 ms)",
    )
    add("--repetition", type=int, default=1, metavar="K", help="take the K-th run (default: 1)")
    add(
        "--tracker",
        metavar="NAME",
        help="the tracker's name (default: that of RESULTS), or which of several in one folder",
    )
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
    add(
        "--skip-missing",
        action="store_true",
        help="leave out results without ground truth, and boxes of a log that belong to no frame",
    )
    add_frame_times(add)
    add("--image-size", type=argument(_size), metavar="WxH", help="image size, such as 1280x720")
    add_force(add)
    add("--json", action="store_true", help="print the summary as JSON")
    _add_logs(made)
    return made


def _add_logs(made: argparse.ArgumentParser) -> None:
    """Add what is asked of logs only."""
    add = made.add_argument_group("logs").add_argument
    add("--image-topic", metavar="TOPIC", help="of a bag: the frames (default: the one of images)")
    add("--box-topic", metavar="TOPIC", help="of a bag: the outputs (default: the one of boxes)")
    add("--truth-topic", metavar="TOPIC", help="of a bag: boxes of ground truth")
    add(
        "--field",
        action="append",
        default=[],
        type=argument(_field),
        metavar="NAME=PATH",
        help="of a bag: where a message of any type has its box: x, y, w, h, or cx, cy for its "
        "centre, or x2, y2 for its other corner; perhaps score, stamp, started, ready",
    )
    add("--target", metavar="ID", help="of a bag: one of several targets (default: the best score)")
    add(
        "--match",
        metavar="TIME",
        help="of a bag: a box is of the nearest earlier frame, within this time, such as 20ms "
        "(default: of the frame of the same stamp)",
    )
    add(
        "--clock-offset",
        metavar="TIME",
        help="what to add to capture times to have the log's clock: --clock-offset=-3600s, or "
        "estimate, from the least delay (default: the clocks are one)",
    )
    add(
        "--arrivals",
        choices=("received", "captured"),
        help="when frames arrive: when the log received them (default, where it says so), or when "
        "they were captured",
    )
    add(
        "--gaps",
        choices=("dropped", "skipped"),
        help="of a table whose frame numbers jump: frames that the camera never sent, or that came "
        "and the log left out (default: refused)",
    )
    add(
        "--init-box",
        type=argument(_init_box),
        metavar="X,Y,W,H",
        help="the box that the tracker was given on the log's first frame (default: the first "
        "output's, on its frame)",
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(
        lambda: _convert(arguments),
        "lae-sim convert",
        arguments.max_decoded,
        prints_result=False,
    )


def _convert(arguments: argparse.Namespace) -> None:
    from lae_sim.importers.measured import log_format
    from lae_sim.trace.file import check_replaces, trace_at, write_trace

    check_places([arguments.out])
    # of a folder those files count that are read (below), and no file is replaced but a trace
    read = [arguments.results, *dict(arguments.truth_file).values()]
    read += [arguments.truth] if arguments.truth is not None else []
    check_distinct([arguments.out], [path for path in read if path.is_file()])
    is_log = log_format(arguments.results, arguments.format) is not None
    trace, summary = (_read_log if is_log else _read_results)(arguments)
    check_distinct([arguments.out], summary.files)
    if not arguments.force:
        check_replaces(arguments.out, summary.tracker, summary.dataset)
    elif trace_at(arguments.out) is None:  # and none of the dataset's files, read or not
        check_distinct([arguments.out], read)
    write_trace(trace, arguments.out)
    if arguments.json:
        print_json(summary.document(arguments.out))
    else:
        next_step = f"Next: lae-sim replay {arguments.out}"
        print_text("\n".join([*lines_of(summary, arguments.out), next_step]))


def _read_results(arguments: argparse.Namespace) -> tuple[Trace, ConversionSummary]:
    from lae_sim.importers.convert import convert_results

    _check_not_given(arguments, _LOGS_ONLY, "is of logs, and these are results")
    if arguments.truth is None:
        raise LaeError("--truth: results need the dataset's folder")
    with closing(ProgressBar("convert", "sequences")) as bar:
        return convert_results(
            arguments.results,
            arguments.truth,
            format=arguments.format,
            fps=arguments.fps,
            time=arguments.time,
            time_unit=arguments.time_unit,
            repetition=arguments.repetition,
            tracker=arguments.tracker,
            device=arguments.device,
            dataset=arguments.dataset,
            sequences=arguments.sequence,
            exclude=arguments.exclude,
            truth_files=dict(arguments.truth_file),
            skip_missing=arguments.skip_missing,
            image_size=arguments.image_size,
            frame_times=arguments.frame_times,
            progress=bar,
        )


def _read_log(arguments: argparse.Namespace) -> tuple[Trace, ConversionSummary]:
    from lae_sim.importers.measured import convert_log

    _check_not_given(arguments, _RESULTS_ONLY, "is of results, and this is a log")
    return convert_log(
        arguments.results,
        format=arguments.format,
        truth=arguments.truth,
        fps=arguments.fps,
        init_box=arguments.init_box,
        arrivals=arguments.arrivals,
        clock_offset=arguments.clock_offset,
        image_topic=arguments.image_topic,
        box_topic=arguments.box_topic,
        truth_topic=arguments.truth_topic,
        fields=dict(arguments.field),
        target=arguments.target,
        match=arguments.match,
        gaps=arguments.gaps,
        skip_missing=arguments.skip_missing,
        tracker=arguments.tracker,
        device=arguments.device,
        dataset=arguments.dataset,
        image_size=arguments.image_size,
    )


def _check_not_given(arguments: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Refuse options that mean nothing here."""
    defaults = parser()
    for name in names:
        if getattr(arguments, name) != defaults.get_default(name):
            raise LaeError(f"--{name.replace('_', '-')} {why}")


def lines_of(summary: ConversionSummary, out: Path) -> list[str]:
    """The summary of the conversion to a trace, for people."""
    from lae_sim.datasets.dropped import note

    processed = "every frame"
    if summary.schedule == "real-time":
        processed = f"in real time, {summary.processed:,} processed"
    lines = [
        f"{out}: {summary.tracker} on {summary.dataset}, {summary.sequences} sequences, "
        f"{summary.frames:,} frames at {summary.fps} fps, {processed}; "
        f"median {_milliseconds(summary.median_ms)} a frame. "
        f"Read as {summary.format}; times: {summary.timing['source']}."
    ]
    if summary.times_read_as:
        lines.append(f"Times read as {summary.times_read_as}.")
    if "note" in summary.timing:
        lines.append(f"Note: {summary.timing['note']}.")
    if summary.held:
        lines.append(
            f"The tracker had no box in {sum(summary.held.values()):,} frames of "
            f"{len(summary.held)} sequences ({listed(list(summary.held))}); there its last one "
            "stands."
        )
    if summary.frame_times:
        said = note(summary.numbers_missing, summary.frame_times)
        lines.append(f"{said[0].upper()}{said[1:]}.")
    if summary.row_0_from_truth:
        lines.append(
            f"Row 0 is not the initial box in {len(summary.row_0_from_truth)} of "
            f"{summary.sequences} sequences ({listed(summary.row_0_from_truth)}); there the trace "
            "starts from the truth, as the tracker did."
        )
    if summary.other_trackers:
        lines.append(f"Left out, of other trackers: {listed(summary.other_trackers)}.")
    lines += [f"Note: {each}." for each in summary.notes]
    if summary.without_truth:
        lines.append(f"Left out, without ground truth: {listed(summary.without_truth)}.")
    if summary.without_results:
        lines.append(f"Without results: {listed(summary.without_results)}.")
    return lines


def _milliseconds(ms: float) -> str:
    return f"{ms:.3g} ms" if ms < 1000 else f"{ms:,.0f} ms"


def _truth_file(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise LaeError(f"{text!r} is not SEQ=FILE")
    return name, Path(path)


def _field(text: str) -> tuple[str, str]:
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise LaeError(f"{text!r} is not NAME=PATH, such as x=bbox.center.position.x")
    return name, path


def _init_box(text: str) -> tuple[float, float, float, float]:
    from lae_sim.datasets.numbers import NUMBER

    sides = [side.strip() for side in text.split(",")]
    if len(sides) != 4 or not all(map(NUMBER.match, sides)):
        raise LaeError(f"{text!r} is not a box: write X,Y,W,H")
    x, y, w, h = map(float, sides)
    return x, y, w, h


def _size(text: str) -> tuple[int, int]:
    match = re.match(r"([1-9][0-9]{0,5})x([1-9][0-9]{0,5})\Z", text)
    if match is None:
        raise LaeError(f"{text!r} is not an image size: write it as 1280x720")
    return int(match[1]), int(match[2])
