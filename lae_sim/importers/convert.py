"""Results that a tracker left, as traces."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.datasets.absence import absence_files, read_flags
from lae_sim.datasets.annotations import GroundTruth, find_truth, read_truth
from lae_sim.datasets.attributes import read_attributes
from lae_sim.datasets.dropped import arrivals, ask, check_frame_times, missing
from lae_sim.datasets.layouts import image_numbers
from lae_sim.engine.clock import Clock, Number, parse_fps
from lae_sim.errors import LaeError, listed, shown
from lae_sim.importers.coordinates import other_reading, row_0_is_off
from lae_sim.importers.given import NO_TIMES, GivenTimes, frame_ns, given_times
from lae_sim.importers.lae_pvt import read_run
from lae_sim.importers.matching import match_results
from lae_sim.importers.results import Results, Source, find_results, read_results
from lae_sim.importers.times import (
    MeasuredTimes,
    ascending_note,
    check_seconds,
    parse_unit,
    understood,
)
from lae_sim.trace.checks import RowChecker
from lae_sim.trace.columns import Rows
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

Progress = Callable[[int, int], object]
"""``progress(done, total)`` is called after each sequence."""

_VOT_EXPERIMENTS = ("baseline", "longterm", "realtime", "supervised", "unsupervised")


@dataclass(frozen=True)
class ConversionSummary:
    """What results became.

    Attributes:
        format: of the results, a name of :data:`lae_sim.importers.results.FORMATS`.
        schedule: ``"every-frame"`` or ``"real-time"``.
        fps: world frame rate as exact text.
        tracker, dataset: their names in the trace.
        timing: where the times come from: ``source``, and a ``note`` if some were changed.
        sequences, frames, processed: how many; a frame is processed where it has a time.
        median_ms: median time of a processed frame, ms.
        times_read_as: the unit of measured times, in words; None where none were read.
        held: frames of each sequence in which the tracker had no box, and its last one stands.
        frame_times: how frames come where image numbers are missing: ``"numbers"`` or ``"even"``;
            None where none is, or no images are at hand.
        numbers_missing: the sequences where some are.
        row_0_from_truth: sequences whose row 0 was more than 3 px off the initial box, from which
            the tracker started; in the trace it is that box.
        other_trackers: trackers whose results lie there too, and were left out.
        without_truth: results that were left out, since they have no ground truth.
        without_results: sequences of the ground truth that have no results.
        notes: what else is to be said, a sentence each.
        files: what was read.
    """

    format: str
    schedule: str
    fps: str
    tracker: str
    dataset: str
    timing: Mapping[str, str]
    sequences: int
    frames: int
    processed: int
    median_ms: float
    times_read_as: str | None
    held: Mapping[str, int]
    frame_times: str | None
    numbers_missing: list[str]
    row_0_from_truth: list[str]
    other_trackers: list[str]
    without_truth: list[str]
    without_results: list[str]
    notes: list[str]
    files: list[Path]

    def document(self, path: str | Path) -> dict[str, Any]:
        """The summary as JSON values, of the trace written to ``path``."""
        document = {"trace": str(path), **asdict(self)}
        del document["files"]
        return document


def convert_results(
    results: str | Path,
    truth: str | Path,
    *,
    format: str = "auto",
    fps: Number | None = None,
    time: str = "measured",
    time_unit: str | None = None,
    repetition: int = 1,
    tracker: str | None = None,
    device: str | None = None,
    dataset: str | None = None,
    sequences: Collection[str] = (),
    exclude: Collection[str] = (),
    truth_files: Mapping[str, str | Path] | None = None,
    skip_missing: bool = False,
    image_size: tuple[int, int] | None = None,
    frame_times: str | None = None,
    progress: Progress = lambda done, total: None,
) -> tuple[Trace, ConversionSummary]:
    """Make a trace from a tracker's results and the dataset's ground truth.

    Args:
        results: folder of one tracker's results, or a file.
        truth: the dataset's folder (see :mod:`lae_sim.datasets.annotations`).
        format: a name of :data:`lae_sim.importers.results.FORMATS`, or ``"auto"``.
        fps: world frames per second, such as ``30`` or ``"30000/1001"``; by default 30, or 10 if
            the dataset's name says ``10fps``. Of NfS it chooses the set, of 30 or 240.
        time: where times come from (see :func:`lae_sim.importers.given.given_times`).
        time_unit: of measured times: ``"s"``, ``"ms"``, ``"us"``, ``"ns"``, or ``"fps"`` for rates;
            ``"cumulative-s"`` and so on for times since the start. By default seconds, if no header
            says otherwise and their median is from 0.5 to 250 ms.
        repetition: which run to take where the toolkit repeats them, from 1.
        tracker: its name; by default that of the results. Where results of several trackers lie
            together, as ``<seq>_<tracker>``, it says which to take.
        device: what the times were taken on.
        dataset: its name; by default that of its folder.
        sequences: names to keep; all by default.
        exclude: names to leave out.
        truth_files: other ground truth for some sequences, by name.
        skip_missing: whether results without ground truth are left out instead of refused.
        image_size: width and height of the images, pixels.
        frame_times: where images are beside the ground truth and numbers are missing among them
            (see :func:`lae_sim.datasets.layouts.find_dataset`).
        progress: called after each sequence.

    Returns:
        The trace, in memory, and its summary.

    Raises:
        LaeError: if the results or the ground truth are missing or damaged, or do not fit each
            other: in length, or since boxes look to be other than ``x, y, w, h`` in pixels, or a
            frame early or late.

    Example:
        >>> import pathlib, tempfile
        >>> import lae_sim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("results", "anno"):
        ...         pathlib.Path(folder, name).mkdir()
        ...         boxes = "1,2,30,40" if name == "anno" else "3,2,30,40"
        ...         _ = pathlib.Path(folder, name, "car.txt").write_text(boxes, "utf-8")
        ...     trace, summary = lae_sim.convert_results(
        ...         f"{folder}/results", f"{folder}/anno", time="constant:47ms"
        ...     )
        >>> trace["car"].boxes.tolist(), summary.median_ms
        ([[3.0, 2.0, 30.0, 40.0]], 47.0)
    """
    for name, path in (("results", results), ("truth", truth)):
        if not isinstance(path, (str, os.PathLike)):
            raise LaeError(f"{name}: a path, not {shown(path)}")
    check_frame_times(frame_times)
    if repetition < 1:
        raise LaeError("--repetition counts from 1")
    parse_unit(time_unit)
    results = Path(results)
    kind, sources = find_results(results, format, repetition)
    other = {name: Path(path) for name, path in (truth_files or {}).items()}
    asked = None if fps is None else parse_fps(fps)
    annotations = find_truth(Path(truth), asked).with_files(other)
    found = match_results(results, sources, annotations, tracker, skip_missing)
    known = found.sources
    absent = sorted({*sequences, *exclude, *other} - set(known))
    if absent:
        raise LaeError(f"{results}: no results of sequence {listed(absent)}")
    matched = {name: known[name] for name in sorted({*(sequences or known)} - {*exclude})}
    if not matched:
        raise LaeError("--exclude leaves no sequence")
    dataset = dataset or annotations.dataset
    rate = str(fps or annotations.fps or ("10" if "10fps" in dataset.lower() else 30))
    clock = Clock.at(parse_fps(rate))
    tracker = tracker or found.tracker or _folder_name(kind, results)
    given = given_times(time, tracker)
    schedule: dict[str, Any] = {"kind": "every-frame"}
    if kind == "lae-pvt":
        if given or time_unit:
            raise LaeError(
                "--time and --time-unit do not go with lae-pvt: its runs hold times in s"
            )
        schedule = {"kind": "real-time", "schedule": {"policy": "latest"}}
        converted = _real_time(matched, annotations, clock, progress)
    else:

        def read(source: Source) -> Results:
            return read_results(kind, source, repetition, time_unit, measured=given is None)

        converted = _every_frame(matched, annotations, read, given, progress)
        if time_unit and converted.times_read_as is None:
            raise LaeError("--time-unit is that of measured times, and none are read here")
    as_published = converted.recordings
    recordings = [_started(recording, matched[recording.name].path) for recording in as_published]
    attributes = read_attributes(annotations)
    row_0_from_truth = [
        new.name for new, old in zip(recordings, as_published) if new.boxes is not old.boxes
    ]
    recordings, notes = _flagged(recordings, annotations)
    if found.unnamed:
        notes.append(
            f"results whose names tell no tracker are left out beside those of {found.tracker}: "
            f"{listed(found.unnamed)}"
        )
    incomplete: list[str] = []
    if kind != "lae-pvt":  # whose recorded loop took the frames evenly, whatever their numbers
        recordings, incomplete = _arrived(recordings, annotations, clock.fps, frame_times)
    elif frame_times == "numbers":
        raise LaeError(
            "--frame-times numbers does not go with lae-pvt: its runs took frames evenly"
        )
    frame_times = frame_times if incomplete else None
    metadata = Metadata.new(
        rate,
        **schedule,
        tracker={"name": tracker},
        device={"model": device} if device else {},
        dataset={"name": dataset, **({"frame_times": frame_times} if frame_times else {})},
        timing=converted.timing,
        sequences=_sequence_entries(
            matched, attributes.of, image_size, converted.held, row_0_from_truth
        ),
    )
    left_out = {*matched, *exclude}
    elapsed = np.concatenate([recording.elapsed_ns for recording in recordings])
    summary = ConversionSummary(
        format=kind,
        schedule=metadata.kind,
        fps=rate,
        tracker=tracker,
        dataset=dataset,
        timing=converted.timing,
        sequences=len(recordings),
        frames=len(elapsed),
        processed=int((elapsed >= 0).sum()),
        median_ms=float(np.median(elapsed[elapsed >= 0])) / 1e6,
        times_read_as=converted.times_read_as,
        held=converted.held,
        frame_times=frame_times,
        numbers_missing=incomplete,
        row_0_from_truth=row_0_from_truth,
        other_trackers=found.others,
        without_truth=found.without_truth,
        without_results=[n for n in annotations.files if not sequences and n not in left_out],
        notes=[*attributes.notes, *notes],
        files=[
            *(file for source in matched.values() for file in (source.path, source.times) if file),
            *annotations.files.values(),
            *(file for truth in annotations.files.values() for file in absence_files(truth)),
            *((given.file,) if given and given.file else ()),
        ],
    )
    return Trace(metadata, recordings), summary


@dataclass(frozen=True)
class _Converted:
    """Results as recordings.

    Attributes:
        recordings: of the matched sequences.
        timing: what the trace says of their times.
        times_read_as: what measured times were read as, in words.
        held: frames of each sequence in which the tracker had no box.
    """

    recordings: list[Recording]
    timing: dict[str, str]
    times_read_as: str | None = None
    held: Mapping[str, int] = field(default_factory=dict)


def _every_frame(
    matched: Mapping[str, Source],
    truth: GroundTruth,
    read: Callable[[Source], Results],
    given: GivenTimes | None,
    progress: Progress,
) -> _Converted:
    """The recordings of results on every frame."""
    recordings = []
    held = {}
    times: list[MeasuredTimes] = []
    for name, source in matched.items():
        results = read(source)
        boxes = read_truth(truth.files[name], len(results.boxes))
        elapsed = _elapsed(name, source, results, given)
        if len(results.boxes) != len(boxes):
            first = "if the first frame's box is missing, write the initial box above the others; "
            raise LaeError(
                f"sequence {name!r}: {source.path} has {len(results.boxes)} boxes and "
                f"{truth.files[name]} has {len(boxes)} rows of ground truth; "
                f"{first if len(results.boxes) == len(boxes) - 1 else ''}give that of the "
                f"same frames with --truth-file {name}=FILE, or leave it out with --exclude {name}"
            )
        if not given and results.elapsed_ns is not None:
            path = source.times or source.path
            times.append(MeasuredTimes(name, path, elapsed, results.unit))
        try:
            answers, count = _held(results.boxes, boxes)
        except LaeError as error:
            raise LaeError(f"{source.path}: {error}") from error
        if count:
            held[name] = count
        recordings.append(Recording.new(name, boxes, answers, elapsed))
        _check(recordings[-1], source.path, truth.files[name])
        progress(len(recordings), len(matched))
    if given:
        return _Converted(recordings, {"source": given.source}, held=held)
    check_seconds(times)
    timing = {"source": "mean fps of each sequence from the results, not measured per frame"}
    if len(times) == len(matched):
        timing = {"source": "measured"}
    if note := ascending_note(times):
        timing["note"] = note
    return _Converted(recordings, timing, understood(times) or None, held)


def _held(boxes: Floats, truth: Floats) -> tuple[Floats, int]:
    """The boxes with the last one in place of none, as the OTB toolkit has it.

    In row 0 that is the initial box.

    Args:
        boxes: of the tracker, float64 [n, 4]; NaN = it has none.
        truth: ground truth, float64 [n, 4].

    Returns:
        The boxes, and in how many frames after the first there was none.

    Raises:
        LaeError: if neither has a box in row 0.
    """
    lost = np.isnan(boxes[:, 0])
    if not lost.any():
        return boxes, 0
    if lost[0]:
        if np.isnan(truth[0]).any():
            raise LaeError("row 1 has no box, and neither has the ground truth")
        boxes = np.concatenate([truth[:1], boxes[1:]])
        lost[0] = False
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(boxes))))
    return boxes[last], int(lost.sum())


def _elapsed(name: str, source: Source, results: Results, given: GivenTimes | None) -> Ints:
    """Processing time of each frame, int64 [n], ns."""
    count = len(results.boxes)
    if given:
        times = np.full(count, given.of(name, count), np.int64)
        if given.init_ns is not None:
            times[:1] = given.init_ns
        return times
    if results.elapsed_ns is not None:
        if len(results.elapsed_ns) != count:
            raise LaeError(
                f"sequence {name!r}: {source.path} has {count} boxes and {source.times} has "
                f"{len(results.elapsed_ns)} times; each frame, the first too, needs one of each"
            )
        return results.elapsed_ns
    if results.mean_fps is not None:
        try:
            return np.full(count, frame_ns(results.mean_fps), np.int64)
        except LaeError as error:
            raise LaeError(f"{source.path}: {error}") from error
    raise LaeError(f"{source.path}: the results hold no times; {NO_TIMES}")


def _real_time(
    matched: Mapping[str, Source], truth: GroundTruth, clock: Clock, progress: Progress
) -> _Converted:
    """The recordings of released real-time runs."""
    runs = []
    for name, source in matched.items():
        runs.append(read_run(source.path, name, read_truth(truth.files[name]), clock))
        _check(runs[-1].recording, source.path, truth.files[name])
        progress(len(runs), len(matched))
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
    return _Converted(
        [run.recording for run in runs], {"source": "measured", **note}, "seconds since the start"
    )


def _check(recording: Recording, results: Path, truth: Path) -> None:
    """Check one recording by the rules of the format, so that the message names its files."""
    RowChecker(f"{results} (ground truth {truth})")(Rows.of_recordings([recording]))


def _started(recording: Recording, results: Path) -> Recording:
    """The recording with the initial box in row 0, where results have another there.

    The tracker was given the truth of frame 0, whatever its results say.

    Raises:
        LaeError: if the boxes look to be something else than a box of each frame in pixels.
    """
    truth, boxes = recording.truth, recording.boxes
    other = other_reading(truth, boxes)
    if other is not None:
        evidence = f"mean IoU {other.iou_as_is:.2f} as x, y, w, h"
        if other.iou is not None:
            evidence += f", {other.iou:.2f} so read"
        raise LaeError(
            f"sequence {recording.name!r}: {results} looks like {other.looks_like}: {evidence}; "
            f"{other.remedy}, in all sequences, or --exclude {recording.name}"
        )
    if not row_0_is_off(truth, boxes):
        return recording
    return replace(recording, boxes=np.concatenate([truth[:1], boxes[1:]]))


def _flagged(
    recordings: Sequence[Recording], truth: GroundTruth
) -> tuple[list[Recording], list[str]]:
    """The recordings with the dataset's flags of absence, and what is to be said of these."""
    files = {recording.name: truth.files[recording.name] for recording in recordings}
    flags = read_flags(files, {recording.name: len(recording) for recording in recordings})
    absent = [np.count_nonzero(~visible) for visible in flags.visible.values()]
    notes = [*flags.notes]
    if any(absent):
        notes.append(
            f"the target is said to be absent in {sum(absent):,} frames, in "
            f"{np.count_nonzero(absent)} of {len(files)} sequences; --convention lasot leaves "
            "them out"
        )
    return [replace(each, visible=flags.visible.get(each.name)) for each in recordings], notes


def _arrived(
    recordings: list[Recording], truth: GroundTruth, fps: Fraction, frame_times: str | None
) -> tuple[list[Recording], list[str]]:
    """The recordings with the times of their frames, and in which image numbers are missing.

    Raises:
        LaeError: if some are, and it is not said how the frames come.
    """
    numbers = {
        each.name: image_numbers(truth.root, each.name, truth.files[each.name], len(each))
        for each in recordings
    }
    incomplete = [name for name, known in numbers.items() if missing(known)]
    if incomplete and frame_times is None:
        raise ask(incomplete[0], numbers[incomplete[0]], fps)
    if not incomplete or frame_times == "even":
        return recordings, incomplete
    placed = [  # all of them: a trace has the times of every frame, or of none
        replace(each, arrival_ns=arrivals(numbers[each.name] or range(len(each)), fps))
        for each in recordings
    ]
    return placed, incomplete


def _sequence_entries(
    names: Iterable[str],
    attributes: Mapping[str, tuple[str, ...]],
    size: tuple[int, int] | None,
    held: Mapping[str, int],
    row_0_from_truth: Collection[str],
) -> dict[str, dict[str, Any]]:
    """What the trace says of each sequence."""
    entries: dict[str, dict[str, Any]] = {}
    for name in names:
        entry = {
            "attributes": list(attributes.get(name, ())),
            "image_size": list(size or ()),
            "row_0_from_truth": name in row_0_from_truth,
        }
        entries[name] = {key: value for key, value in entry.items() if value}
        if held:  # a tracker that never says so may have lost its target all the same
            entries[name]["lost"] = held.get(name, 0)
    return entries


def _folder_name(kind: str, path: Path) -> str:
    """The tracker's name where only its file of all sequences or its folder has it."""
    if kind == "npz":
        return path.stem
    folder = path.resolve().parent if path.is_file() else path.resolve()
    return folder.parent.name if folder.name in _VOT_EXPERIMENTS else folder.name
