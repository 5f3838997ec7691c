"""``lae-sim convert``: traces from results that other toolkits have written."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.cli import argument, exit_status
from lae_sim.clock import Clock, parse_fps
from lae_sim.errors import LaeError
from lae_sim.files import check_distinct

if TYPE_CHECKING:
    from lae_sim.annotations import GroundTruth
    from lae_sim.engine import Ints
    from lae_sim.importers import GivenTimes, Results, Source
    from lae_sim.recording import Recording

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
    from lae_sim.annotations import find_truth, read_attributes
    from lae_sim.importers import find_results, given_times, tracker_name
    from lae_sim.metadata import Metadata
    from lae_sim.trace import Trace, write_trace

    if arguments.repetition < 1:
        raise LaeError("--repetition counts from 1")
    check_distinct([arguments.out], [arguments.results, *(p for _, p in arguments.truth_file)])
    kind, sources = find_results(arguments.results, arguments.format, arguments.repetition)
    truth = find_truth(arguments.truth).with_files(dict(arguments.truth_file))
    matched, skipped = _matched(kind, sources, truth, arguments)
    dataset = arguments.dataset or truth.dataset
    fps = arguments.fps or ("10" if "10fps" in dataset.lower() else "30")
    clock = Clock.at(parse_fps(fps))
    tracker = arguments.tracker or tracker_name(kind, arguments.results, matched)
    given = given_times(arguments.time, tracker)
    if kind == "lae-pvt":
        if given:
            raise LaeError("--time does not go with lae-pvt, whose runs hold their own times")
        recordings, timing = _real_time(matched, truth, clock)
    else:
        recordings, timing = _every_frame(kind, matched, truth, given, arguments)
    about = {
        "tracker": {"name": tracker},
        "device": {"model": arguments.device} if arguments.device else {},
        "dataset": {"name": dataset},
        "timing": timing,
        "sequences": _sequences(matched, read_attributes(truth), arguments.image_size),
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
        **_figures(recordings),
        "without_truth": skipped,
        "without_results": [] if arguments.sequence else unmatched,
    }
    print(json.dumps(summary, indent=2) if arguments.json else _text(summary))


def _matched(
    kind: str, sources: list[Source], truth: GroundTruth, arguments: argparse.Namespace
) -> tuple[dict[str, Source], list[str]]:
    """The results of each sequence, sorted by name, and the names that have no ground truth."""
    matched: dict[str, Source] = {}
    missing = []
    only_truth = next(iter(truth.files)) if truth.root.is_file() and len(sources) == 1 else None
    for source in sources:
        name = truth.match(source.name, with_tracker=kind == "mat") or only_truth
        if name is None:
            missing.append(source.name)
        elif name in matched:
            raise LaeError(
                f"{source.path} and {matched[name].path} are both results of sequence {name!r}; "
                "give the folder or file of one tracker"
            )
        else:
            matched[name] = source
    if not matched or (missing and not arguments.skip_missing):
        raise LaeError(
            f"{arguments.truth}: no ground truth for {_listed(missing)}, of {len(sources)} results"
            + ("; --skip-missing leaves them out" if matched else "; is it the right dataset?")
        )
    named = {*arguments.sequence, *arguments.exclude, *dict(arguments.truth_file)}
    absent = sorted(named - set(matched))
    if absent:
        raise LaeError(f"{arguments.results}: no results of sequence {_listed(absent)}")
    kept = set(arguments.sequence or matched) - set(arguments.exclude)
    if not kept:
        raise LaeError("--exclude leaves no sequence")
    return {name: matched[name] for name in sorted(kept)}, missing


def _every_frame(
    kind: str,
    matched: Mapping[str, Source],
    truth: GroundTruth,
    given: GivenTimes | None,
    arguments: argparse.Namespace,
) -> tuple[list[Recording], dict[str, str]]:
    """The recordings of results on every frame, and what to say of their times."""
    from lae_sim.annotations import read_truth
    from lae_sim.importers import read_results
    from lae_sim.recording import Recording

    recordings = []
    measured = True
    for name, source in _progress(matched):
        results = read_results(
            kind, source, arguments.repetition, arguments.time_unit, measured=given is None
        )
        boxes = read_truth(truth.files[name])
        elapsed = _elapsed(name, source, results, given)
        if len(results.boxes) != len(boxes):
            raise LaeError(
                f"sequence {name!r}: {source.path} has {len(results.boxes)} boxes and "
                f"{truth.files[name]} has {len(boxes)} rows of ground truth; give that of the "
                f"same frames with --truth-file {name}=FILE, or leave it out with --exclude {name}"
            )
        measured = measured and results.elapsed_ns is not None
        recording = Recording.new(name, boxes, results.boxes, elapsed)
        _check(recording, source.path, truth.files[name])
        recordings.append(recording)
    if given:
        return recordings, {"source": given.source}
    if measured:
        return recordings, {"source": "measured"}
    return recordings, {
        "source": "mean fps of each sequence from the results, not measured per frame"
    }


def _elapsed(name: str, source: Source, results: Results, given: GivenTimes | None) -> Ints:
    """Processing time of each frame, int64 [n], ns."""
    import numpy as np

    from lae_sim.importers import NO_TIMES, frame_ns

    count = len(results.boxes)
    if given:
        return np.full(count, given.of(name, count), np.int64)
    if results.elapsed_ns is not None:
        if len(results.elapsed_ns) != count:
            raise LaeError(
                f"sequence {name!r}: {source.path} has {count} boxes and {source.times} has "
                f"{len(results.elapsed_ns)} times; each frame, the first too, needs one of each"
            )
        return results.elapsed_ns
    if results.mean_fps is not None:
        return np.full(count, frame_ns(results.mean_fps), np.int64)
    raise LaeError(f"{source.path}: the results hold no times; {NO_TIMES}")


def _real_time(
    matched: Mapping[str, Source], truth: GroundTruth, clock: Clock
) -> tuple[list[Recording], dict[str, str]]:
    """The recordings of released real-time runs, and what to say of their times."""
    from lae_sim.annotations import read_truth
    from lae_sim.lae_pvt import read_run

    runs = []
    for name, source in _progress(matched):
        run = read_run(source.path, name, read_truth(truth.files[name]), clock)
        _check(run.recording, source.path, truth.files[name])
        runs.append(run)
    outputs = sum(int((run.recording.elapsed_ns >= 0).sum()) for run in runs)
    prolonged = [ns for run in runs for ns in run.prolonged_ns]
    unknown = sum(not run.init_known for run in runs)
    notes = []
    if prolonged:
        notes.append(
            f"{len(prolonged)} of {outputs} times prolonged, by at most {max(prolonged) / 1e6:.3g} "
            "ms, to the arrival of the frame that the recording loop took next"
        )
    if unknown:
        notes.append(
            f"the time of the initialisation is not recorded in {unknown} of {len(runs)} sequences"
        )
    note = {"note": "; ".join(notes)} if notes else {}
    return [run.recording for run in runs], {"source": "measured", **note}


def _check(recording: Recording, results: Path, truth: Path) -> None:
    """Check one recording by the rules of the format, so that the message names its files."""
    from lae_sim.checks import RowChecker
    from lae_sim.rows import Rows

    RowChecker(f"{results} (ground truth {truth})")(Rows.of_recordings([recording]))


def _sequences(
    names: Iterable[str],
    attributes: Mapping[str, tuple[str, ...]],
    size: tuple[int, int] | None,
) -> dict[str, dict[str, list[Any]]]:
    """What the trace says of each sequence."""
    entries: dict[str, dict[str, list[Any]]] = {}
    for name in names:
        entry: dict[str, list[Any]] = {
            "attributes": list(attributes.get(name, ())),
            "image_size": list(size or ()),
        }
        entries[name] = {key: value for key, value in entry.items() if value}
    return entries


def _progress(matched: Mapping[str, Source]) -> Iterator[tuple[str, Source]]:
    from tqdm import tqdm

    with tqdm(matched.items(), desc="convert", unit=" sequences", disable=None) as bar:
        yield from bar


def _figures(recordings: Sequence[Recording]) -> dict[str, Any]:
    import numpy as np

    elapsed = np.concatenate([recording.elapsed_ns for recording in recordings])
    return {
        "sequences": len(recordings),
        "frames": len(elapsed),
        "processed": int((elapsed >= 0).sum()),
        "median_ms": float(np.median(elapsed[elapsed >= 0])) / 1e6,
    }


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
        lines.append(f"Left out, without ground truth: {_listed(summary['without_truth'])}.")
    if summary["without_results"]:
        lines.append(f"Without results: {_listed(summary['without_results'])}.")
    return "\n".join([*lines, f"Next: lae-sim replay {summary['trace']}"])


def _milliseconds(ms: float) -> str:
    return f"{ms:.3g} ms" if ms < 1000 else f"{ms:,.0f} ms"


def _listed(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


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


if __name__ == "__main__":
    sys.exit(main())
