"""Measured logs of a running tracker, as traces that replay as they were recorded."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as fields_of
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from statistics import median_low
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats, Ints
from lae_sim.datasets.annotations import read_truth
from lae_sim.engine.arrivals import with_arrivals
from lae_sim.engine.clock import NS_PER_SECOND, Clock, Number, parse_fps
from lae_sim.errors import LaeError, shown
from lae_sim.importers.convert import ConversionSummary
from lae_sim.importers.log_table import read_table
from lae_sim.importers.logs import Box, Log, LoggedOutput, clock_offset, in_seconds, seconds
from lae_sim.importers.rosbag import SUFFIXES, BagOptions, read_bag
from lae_sim.replay.recorded import RECORDED_POLICY, AsRecorded
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.checks import RowChecker
from lae_sim.trace.columns import Rows
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import ImageSizes, Metadata
from lae_sim.trace.recording import Recording

LOG_FORMATS = ("ros", "csv")
ARRIVALS = ("received", "captured")
GAPS = ("dropped", "skipped")

_LONGEST_NS = 10**17  # three years
_MOST_SCORE = float(np.finfo(np.float32).max)


def log_format(path: Path, wanted: str = "auto") -> str | None:
    """The format of a log, of :data:`LOG_FORMATS`; None where it looks like results.

    Args:
        path: a file or folder.
        wanted: a format by name, or ``"auto"``.
    """
    if wanted != "auto":
        return wanted if wanted in LOG_FORMATS else None
    if path.is_dir():
        bags = (path.glob(f"*{suffix}*") for suffix in (".db3", ".mcap"))
        return "ros" if any(map(any, bags)) or _of_bag(path / "metadata.yaml") else None
    suffix = path.suffix.lower()
    return "ros" if suffix in SUFFIXES else "csv" if suffix == ".csv" else None


def _of_bag(path: Path) -> bool:
    """Whether a file is the metadata of a bag."""
    try:
        with path.open("rb") as file:
            return file.read(64).startswith(b"rosbag2_bagfile_information")
    except OSError:
        return False


def convert_log(
    log: str | Path,
    *,
    format: str = "auto",
    truth: str | Path | None = None,
    fps: Number | None = None,
    init_box: Box | None = None,
    arrivals: str | None = None,
    clock_offset: str | None = None,
    image_topic: str | None = None,
    box_topic: str | None = None,
    truth_topic: str | None = None,
    fields: Mapping[str, str] | None = None,
    target: str | None = None,
    match: str | None = None,
    gaps: str | None = None,
    skip_missing: bool = False,
    tracker: str | None = None,
    device: str | None = None,
    dataset: str | None = None,
    image_size: tuple[int, int] | None = None,
) -> tuple[Trace, ConversionSummary]:
    """Make a trace from the log of a tracker that ran: a ROS bag, or a table.

    Under the policy ``recorded`` the trace replays as the log says: each output of each frame is
    ready at the very instant that it has there. A processing time reaches from when the frame had
    arrived, and the output before was ready, to its own output. Outputs that no query can see, of
    frames older than one whose output was ready, or begun when the stream had ended, are left out.

    Args:
        log: a bag's folder or file (see :func:`lae_sim.importers.rosbag.read_bag`), or a table
            (:func:`lae_sim.importers.log_table.read_table`).
        format: ``"ros"``, ``"csv"``, or ``"auto"``.
        truth: a file of ground truth, a row for each frame of the log.
        fps: nominal frames per second; by default estimated from the median interval.
        init_box: ``x, y, w, h`` that the tracker was given on the log's first frame. By default the
            trace begins at the first frame with an output, whose box stands for it.
        arrivals: when frames arrived: ``"received"``, when the log has received them (default,
            where it says so), or ``"captured"``, at their capture times.
        clock_offset: what to add to capture times to have the log's clock, such as ``"-3600s"``, or
            ``"estimate"``: so much that the quickest frame takes no time. By default the clocks are
            one.
        image_topic, box_topic, truth_topic, fields, target, match: of a bag (see
            :class:`lae_sim.importers.rosbag.BagOptions`).
        gaps: of a table: what frame numbers that are missing mean, ``"dropped"`` or ``"skipped"``.
        skip_missing: leave out boxes that belong to no frame.
        tracker, device, dataset: names in the trace; those of the tracker and the dataset are by
            default those of the topic and the log.
        image_size: width and height in pixels, if the log does not say.

    Returns:
        The trace, and what is to be said of it.

    Raises:
        LaeError: if something of the log is missing or impossible; it names the file, and the
            message of a topic or the line.

    Example:
        >>> import lae_sim, tempfile
        >>> from pathlib import Path
        >>> from lae_sim.importers import convert_log
        >>> text = '''frame,arrived_ms,ready_ms,x,y,w,h
        ... 0,0,40,10,20,30,40
        ... 1,33,,,,,
        ... 2,67,95.5,12,20,30,40'''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "flight.csv").write_text(text)
        ...     trace, summary = convert_log(f"{folder}/flight.csv", fps=30)
        >>> trace["flight"].elapsed_ns.tolist(), trace["flight"].arrival_ns.tolist()
        ([40000000, -1, 28500000], [0, 33000000, 67000000])
        >>> run = lae_sim.replay_sequence(
        ...     trace["flight"], lae_sim.engine.Clock.at(30), policy=lae_sim.replay.AsRecorded()
        ... )
        >>> (run.schedule.ready // run.schedule.clock.ticks_per_ns).tolist()
        [40000000, 95500000]
    """
    if not isinstance(log, (str, os.PathLike)):
        raise LaeError(f"log: a path, not {shown(log)}")
    path = Path(log)
    if not path.exists():
        raise LaeError(f"{path}: no such file or folder")
    kind = log_format(path, format)
    if kind is None:
        raise LaeError(f"{path}: neither a ROS bag nor a .csv file: say which with --format")
    for name, value, known in (("arrivals", arrivals, ARRIVALS), ("gaps", gaps, GAPS)):
        if value is not None and value not in known:
            raise LaeError(f"{name}: no {shown(value)}: there are {' and '.join(known)}")
    given = BagOptions(
        image_topic, box_topic, truth_topic, fields, target, match, clock_offset, skip_missing
    )
    found = _read(path, kind, given, gaps)
    facts, notes = {**found.facts}, [*found.notes]
    arrived, how, said = _arrived(path, found, arrivals, clock_offset)
    facts |= how
    notes += said
    known_truth = _truth(found, truth)
    tracker, name = tracker or found.tracker, path.stem
    rate = str(fps) if fps is not None else _estimated_rate(path, found, arrived)
    if fps is None:
        notes.append(f"{rate} frames/s is estimated, from the median time between frames (--fps)")
    begin = 0 if init_box else _first(path, found.outputs)
    if begin:
        notes.append(f"{begin:,} frames before the first output are left out")
    clock = Clock.at(parse_fps(rate))
    own = with_arrivals(clock, [at - arrived[begin] for at in arrived[begin:]])
    timeline = _Timeline.of(found.outputs, arrived, begin, own, init_box)
    recording = Recording.new(
        name,
        known_truth[begin:],
        timeline.boxes,
        timeline.elapsed_ns,
        timeline.score,
        np.array(arrived[begin:]) - arrived[begin],
        None,
        timeline.stages,
    )
    RowChecker(str(path), profiled=True)(Rows.of_recordings([recording]))
    if _differs(recording, clock, timeline):
        raise LaeError(f"{path}: a replay does not repeat the log")
    facts["initial_box"] = "given" if init_box else "first output"
    notes += timeline.notes
    if not np.isfinite(known_truth[begin:]).any():
        notes.append("no ground truth: a replay tells of ages and skipped frames, not of scores")
    timing = {
        "source": "measured",
        "clock": "receive times of the bag" if kind == "ros" else "times of the log",
        "includes": "from when a frame had arrived and the output before was ready to its output",
        "note": timeline.init_note,
    }
    if found.interpolated:
        timing["note"] += (
            f"; {found.interpolated:,} frames that the log left out arrive at even steps"
        )
    sizes = found.image_sizes
    if image_size is not None:
        entry: dict[str, Any] = {"image_size": list(image_size)}
    else:
        entry = _later(sizes, begin).entry() if sizes is not None else {}
    if timeline.lost:
        entry["lost"] = timeline.lost
    metadata = Metadata.new(
        rate,
        "real-time",
        schedule={"policy": RECORDED_POLICY},
        tracker={"name": tracker},
        device={"model": device} if device else {},
        dataset={"name": dataset or name},
        timing=timing,
        log=facts,
        sequences={name: entry},
    )
    processed = recording.elapsed_ns[recording.elapsed_ns >= 0]
    files = (
        [*sorted(each for each in path.iterdir() if each.is_file())] if path.is_dir() else [path]
    )
    summary = ConversionSummary(
        format=kind,
        schedule="real-time",
        fps=rate,
        tracker=tracker,
        dataset=dataset or name,
        timing={name: timing[name] for name in ("source", "note")},
        sequences=1,
        frames=len(recording),
        processed=len(processed),
        median_ms=float(np.median(processed)) / 1e6,
        times_read_as=None,
        held={name: timeline.lost} if timeline.lost else {},
        frame_times=None,
        numbers_missing=[],
        row_0_from_truth=[],
        other_trackers=[],
        without_truth=[],
        without_results=[],
        notes=notes,
        files=[*files, *([Path(truth)] if truth is not None else [])],
    )
    return Trace(metadata, [recording]), summary


def _read(path: Path, kind: str, options: BagOptions, gaps: str | None) -> Log:
    """A log of either format; what is said of the other one is refused."""
    if kind == "ros":
        if gaps is not None:
            raise LaeError("gaps: of tables, whose frames have numbers, and this is a bag")
        log = read_bag(path, options)
    else:
        names = {each.name for each in fields_of(options)} - {"clock_offset"}
        if others := sorted(name for name in names if getattr(options, name)):
            raise LaeError(f"{', '.join(others)}: of bags, and {path} is a table")
        log = read_table(path, gaps)
    if not log.frames or not log.outputs:
        raise LaeError(f"{path}: no {'outputs' if log.frames else 'frames'}")
    return log


def _arrived(
    path: Path, log: Log, asked: str | None, offset: str | None
) -> tuple[list[int], dict[str, Any], list[str]]:
    """When each frame arrived, on the log's clock; how one knows, as facts and as sentences."""
    captured = [frame.captured_ns for frame in log.frames]
    received = [frame.arrived_ns for frame in log.frames]
    if asked is None:
        asked = "captured" if all(at is None for at in received) else "received"
    known: list[int] = []
    for frame, at in zip(log.frames, captured if asked == "captured" else received):
        if at is None:
            raise LaeError(f"{frame.where}: no time when the frame was {asked}")
        known.append(at)
    delays = [to - at for to, at in zip(received, captured) if to is not None and at is not None]
    to = "arrival"
    if asked == "captured" and not delays:  # a frame arrives before its output is ready
        delays, to = [each.ready_ns - known[each.frame] for each in log.outputs], "output"
    facts, notes = _clocks(path, delays, to, offset, needed=asked == "captured")
    if asked == "captured":
        known = [at + facts["clock_offset_ns"] for at in known]
        notes.append("frames arrive when they were captured: ages hold the camera's delay")
    elif delays:
        notes.append("frames arrive when the log received them: ages hold no delay of the camera")
    times, together = known[:1], 0
    for frame, before, at in zip(log.frames[1:], known, known[1:]):
        if at < before:
            raise LaeError(
                f"{frame.where}: {asked} {seconds(before - at)} before the frame ahead of it: "
                "frames come one after another"
            )
        together += at <= times[-1]
        times.append(max(at, times[-1] + 1))
    if together:
        notes.append(f"{together:,} frames {asked} at the instant of another arrive 1 ns after it")
    return times, {"arrivals": asked, **facts}, notes


def _clocks(
    path: Path, delays: Sequence[int], to: str, offset: str | None, needed: bool
) -> tuple[dict[str, Any], list[str]]:
    """What is known of the camera's clock, by how long frames took from capture to another time."""
    if not delays:
        return {}, []
    try:
        found = clock_offset(path, delays, offset)
    except LaeError:
        if needed or offset is not None:
            raise
        unknown = "the camera's clock is another than the log's, so its delay is unknown"
        return {"clock_offset_source": "unknown"}, [f"{unknown} (--clock-offset)"]
    own = sorted(delay - found.ns for delay in delays)
    facts: dict[str, Any] = {"clock_offset_ns": found.ns, "clock_offset_source": found.source}
    notes = []
    if found.source == "estimated":
        notes.append(
            f"{in_seconds(found.ns)} s are added to capture times, to have the log's clock: an "
            f"estimate, by which the quickest frame takes no time from capture to {to}"
        )
    if to == "arrival":
        facts["camera_delay_ns"] = {"least": own[0], "median": median_low(own), "most": own[-1]}
        notes.append(
            f"from capture to arrival frames take {seconds(median_low(own))} (median), at most "
            f"{seconds(own[-1])}"
        )
    return facts, notes


def _truth(log: Log, path: str | Path | None) -> Floats:
    """Ground truth of every frame, float64 [T, 4]; NaN = none."""
    if path is None:
        truth = np.full((len(log.frames), 4), np.nan)
        for place, box in log.truth.items():
            truth[place] = box
        return truth
    truth = read_truth(Path(path), len(log.frames))
    if len(truth) != len(log.frames):
        raise LaeError(
            f"{path}: {len(truth)} rows of ground truth, and the log has {len(log.frames)} frames"
        )
    return truth


def _estimated_rate(path: Path, log: Log, arrived: Sequence[int]) -> str:
    """Frames per second to two decimals, as text, from the median interval."""
    captured = [frame.captured_ns for frame in log.frames]
    times = [at for at in captured if at is not None]
    if len(times) < len(arrived):
        times = list(arrived)
    intervals = [to - at for at, to in pairwise(times)]
    hundredths = (
        round(Fraction(100 * NS_PER_SECOND, max(median_low(intervals), 1))) if intervals else 0
    )
    if not hundredths:
        raise LaeError(f"{path}: too few frames to tell their rate: give it by --fps")
    return f"{hundredths // 100}.{hundredths % 100:02}".rstrip("0").rstrip(".")


def _first(path: Path, outputs: Sequence[LoggedOutput]) -> int:
    """The frame of the first output that has a box."""
    found = [(output.ready_ns, output.frame) for output in outputs if output.box is not None]
    if not found:
        raise LaeError(f"{path}: no output has a box: the tracker found no target")
    return min(found)[1]


def _later(sizes: ImageSizes, begin: int) -> ImageSizes:
    """The sizes of the images from one frame on."""
    frames = [begin, *(int(at) for at in sizes.starts if at > begin)]
    return ImageSizes.of((at - begin for at in frames), map(sizes.at, frames))


@dataclass(frozen=True)
class _Timeline:
    """A sequence's outputs by frame, as a recording has them.

    Attributes:
        boxes, elapsed_ns, score, stages: of T frames (see :class:`.recording.Recording`).
        ready_ns: of each processed frame, after the first arrival.
        lost: outputs without a box, in whose place the one before stands.
        init_note: what the time of the initialisation is.
        notes: what is to be said, a sentence each.
    """

    boxes: Floats
    elapsed_ns: Ints
    score: npt.NDArray[np.float32]
    stages: dict[str, Ints]
    ready_ns: list[int]
    lost: int
    init_note: str
    notes: list[str]

    @classmethod
    def of(
        cls,
        outputs: Sequence[LoggedOutput],
        arrived: Sequence[int],
        begin: int,
        clock: Clock,
        init_box: Box | None,
    ) -> _Timeline:
        """That of a log.

        Args:
            outputs: of frames by their places in ``arrived``, in any order.
            arrived: when each frame arrived, ns.
            begin: the first frame of the sequence, from whose arrival its times count.
            clock: of the sequence.
            init_box: the box of its first frame, unless it is the first output.

        Raises:
            LaeError: if an output is ready before its frame arrived, or two are of one frame.
        """
        length, zero = len(arrived) - begin, arrived[begin]
        boxes = np.full((length, 4), np.nan)
        elapsed_ns, queue, call = (np.full(length, -1, np.int64) for _ in range(3))
        score = np.full(length, np.nan, np.float32)
        ready_ns: list[int] = []
        of_frame: dict[int, LoggedOutput] = {}
        free = lost = overtaken = late = early = overlapping = 0
        last, box = -1, init_box
        init_note = "the first output's time stands for that of the initialisation"
        for output in sorted(outputs, key=lambda output: (output.ready_ns, output.frame)):
            frame = output.frame - begin
            if frame < 0 or (frame > 0 and last < 0 and box is None):
                early += 1
                continue
            if (other := of_frame.setdefault(output.frame, output)) is not output:
                raise LaeError(f"{output.where}: a second output of the frame of {other.where}")
            _check_output(output, arrived[output.frame])
            here, ready = arrived[output.frame] - zero, output.ready_ns - zero
            if frame > 0 and last < 0:  # of the initialisation the log does not tell
                boxes[0], elapsed_ns[0], last = init_box, 0, 0
                ready_ns.append(0)
                init_note = "the log does not tell of the initialisation, which takes no time here"
            if frame < last:
                overtaken += 1
                continue
            start = max(free, here)
            if last >= 0 and start * clock.ticks_per_ns >= clock.end(length):
                late += 1
                continue
            if frame == 0 and init_box is not None:
                box = init_box
            else:
                lost += output.box is None
                box = output.box or box
            boxes[frame], elapsed_ns[frame] = box, ready - start
            score[frame] = math.nan if output.score is None else output.score
            if output.started_ns is not None:
                begun = output.started_ns - zero
                if begun < free:
                    overlapping += 1
                else:
                    queue[frame], call[frame] = begun - start, ready - begun
            free, last = ready, frame
            ready_ns.append(ready)
        counted = {
            "outputs from before the first frame are left out": early,
            "outputs of frames older than one whose output was ready are left out": overtaken,
            "outputs that began after the stream had ended are left out": late,
            "calls began before the one before was ready: their times reach from output to "
            "output": overlapping,
        }
        notes = [f"{count:,} {what}" for what, count in counted.items() if count]
        stages = {"queue": queue, "tracker": call} if (call >= 0).any() else {}
        return cls(boxes, elapsed_ns, score, stages, ready_ns, lost, init_note, notes)


def _check_output(output: LoggedOutput, arrived_ns: int) -> None:
    """Check that a frame arrives, its call begins and its output is ready, in this order."""
    if output.score is not None and not abs(output.score) <= _MOST_SCORE:
        raise LaeError(f"{output.where}: the score {output.score} is no possible one")
    started_ns = output.ready_ns if output.started_ns is None else output.started_ns
    for what, at in (("ready", output.ready_ns), ("started", started_ns)):
        if at < arrived_ns:
            raise LaeError(
                f"{output.where}: {what} {seconds(arrived_ns - at)} before its frame arrived; if "
                "the log received the frame later than the tracker did, --arrivals captured takes "
                "the time of its capture"
            )
    if started_ns > output.ready_ns:
        late = seconds(started_ns - output.ready_ns)
        raise LaeError(f"{output.where}: started {late} after it was ready")
    if output.ready_ns - arrived_ns > _LONGEST_NS:
        late = seconds(output.ready_ns - arrived_ns)
        raise LaeError(f"{output.where}: ready {late} after its frame arrived: are the clocks one?")


def _differs(recording: Recording, clock: Clock, timeline: _Timeline) -> bool:
    """Whether a replay has other outputs, or at other times, than the log."""
    schedule = replay_sequence(recording, clock, policy=AsRecorded()).schedule
    frames = np.flatnonzero(recording.elapsed_ns >= 0).tolist()
    ready = [at * schedule.clock.ticks_per_ns for at in timeline.ready_ns]
    return bool(schedule.frames.tolist() != frames or schedule.ready.tolist() != ready)
