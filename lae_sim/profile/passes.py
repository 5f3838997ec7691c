"""The passes of a profile: each runs every sequence in one way and becomes one trace."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim.datasets.frames import Buffered, Dataset, ImageSequence
from lae_sim.engine.arrivals import same_arrivals
from lae_sim.engine.clock import Clock, parse_duration, split_init
from lae_sim.engine.scheduler import Service
from lae_sim.errors import LaeError, TraceError
from lae_sim.profile.beside import Loads, in_all
from lae_sim.profile.device import describe_device, readings, source_version
from lae_sim.profile.energy import of_device, of_sequence
from lae_sim.profile.journal import Journal
from lae_sim.profile.live import Live, LiveRun
from lae_sim.profile.sampler import Sampler
from lae_sim.profile.timed import TimedTracker, TrackerError
from lae_sim.replay.latency import by_frame, initialised
from lae_sim.trace.describe import Facts
from lae_sim.trace.energy import Energy
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import FORMAT, ImageSizes, Metadata, version_of
from lae_sim.trace.recording import Recording, stage_of

READING_INTERVAL_S = 10.0

Timing = Callable[[ImageSequence], Service]
"""``timing(sequence)`` makes the service that times a sequence."""

Progress = Callable[[int], object]
"""``progress(frames)`` is called with how many more world frames are done."""


@dataclass(frozen=True)
class Failure:
    """A sequence that could not be profiled, and why."""

    sequence: str
    reason: str


@dataclass(frozen=True)
class PassSummary:
    """What a profiled trace holds, in short.

    Attributes:
        trace: its path.
        schedule: as in its metadata.
        timing: what the times are: ``"measured"``, or where they are from.
        sequences, world_frames, processed: how many.
        lost: processed frames where the tracker found nothing.
        init_ms: mean time of an initialisation, ms.
        median_ms, p95_ms: of the other calls, ms; None if there are none.
        joules_per_frame: energy of the device during one of them, J; None if not measured.
    """

    trace: str
    schedule: Mapping[str, Any]
    timing: str
    sequences: int
    world_frames: int
    processed: int
    lost: int
    init_ms: float
    median_ms: float | None
    p95_ms: float | None
    joules_per_frame: float | None


@dataclass(frozen=True)
class Pass:
    """One way to run every sequence.

    Attributes:
        name: of its part of the journal.
        path: where its trace goes.
        metadata: of the trace, but for what is known only after the sequences.
        run: ``run(sequence, progress=progress)`` runs the tracker through a sequence, in one run or
            in several restarts, of which some may fail.
        work: how many world frames ``run`` tells ``progress`` of.
        ahead: whether frames are decoded ahead of the measurement, a block at a time.
        prepare: called with the journal before the first sequence.
        schedule: further keys of the metadata's schedule, made from the names of what was run.
    """

    name: str
    path: Path
    metadata: Metadata
    run: Callable[..., Sequence[LiveRun | Failure]]
    work: Callable[[ImageSequence], int] = len
    ahead: bool = True
    prepare: Callable[[Journal], object] = lambda journal: None
    schedule: Callable[[Collection[str]], Mapping[str, Any]] = lambda names: {}


def parse_timing(text: str) -> tuple[str, Timing]:
    """Times of another device: ``constant:47ms``, or a trace's by frame.

    Both may end in ``,init=800ms``, what the initialisation takes.

    Returns:
        What a trace says of such times, and the times.

    Raises:
        LaeError: if the text is neither, or the trace cannot be read.
    """
    path, init_ns = split_timing(text)
    kind, _, value = path.partition(":")
    init = "" if init_ns is None else f", initialisation {init_ns / 1e6:g} ms"
    if kind == "constant":
        elapsed_ns = parse_duration(value)
        first_ns = elapsed_ns if init_ns is None else init_ns
        return (
            f"constant {value}{init}, not measured",
            lambda sequence: lambda frame: elapsed_ns if frame else first_ns,
        )
    trace = read_trace(path)
    source = by_frame if init_ns is None else initialised(by_frame, init_ns)
    recordings = {recording.name: recording for recording in trace}

    def timing(sequence: ImageSequence) -> Service:
        recording = recordings.get(sequence.name)
        if recording is None:
            raise LaeError(f"{path}: has no times of sequence {sequence.name!r}")
        if len(recording) != len(sequence):
            raise LaeError(
                f"{path}: has {len(recording)} frames of sequence {sequence.name!r}, which has "
                f"{len(sequence)} here"
            )
        if not same_arrivals(recording.arrival_ns, sequence.arrival_ns):
            raise LaeError(
                f"{path}: the frames of sequence {sequence.name!r} arrived at other times than "
                "they do here (--frame-times)"
            )
        return source(recording)

    return f"{Path(path).name} ({trace.metadata.device}){init}, not measured here", timing


def split_timing(text: str) -> tuple[str, int | None]:
    """Split times of another device into their name and the time of the initialisation, if any.

    Raises:
        LaeError: if that is not a duration.
    """
    return split_init(text, path=not text.startswith("constant:"))


def base_document(
    name: str,
    tracker: TimedTracker,
    dataset: str,
    clock: Clock,
    warmup: int,
    includes: str,
    at_rest: Facts,
) -> dict[str, Any]:
    """The metadata that all passes of a profile share.

    Args:
        name: the tracker, as the command line has it.
        tracker: the tracker, which says more of itself.
        dataset: the dataset's name.
        clock: the world's clock.
        warmup: calls before anything is measured.
        includes: what the times include.
        at_rest: what was found out about the device before the tracker was started.
    """
    described = dict(tracker.describe())
    measured = {k: described.pop(k) for k in ("synchronised", "threads") if k in described}
    try:
        Metadata.new(1, "every-frame", tracker=described)
    except TraceError as error:
        raise LaeError(f"{name}: what describe() says does not fit a trace: {error}") from error
    return {
        "format": FORMAT,
        "fps": str(clock.fps),
        "tracker": {"name": name, **described},
        "device": {**describe_device(), **at_rest, "readings": {"before": readings()}},
        "timing": {
            "clock": "perf_counter_ns",
            "warmup_calls": warmup,
            "includes": includes,
            **measured,
        },
        "schedule": {},
        "dataset": {"name": dataset},
        "lae_sim": source_version(),
    }


def scheduled(document: Mapping[str, Any], source: str = "measured", **schedule: Any) -> Metadata:
    """The metadata of one pass.

    Args:
        document: what all passes share.
        source: what the times are.
        schedule: keys of the metadata's schedule, ``kind`` among them.
    """
    timing = {"source": source, **document["timing"]}
    version = version_of(schedule["kind"])
    return Metadata.of(
        {
            **document,
            "version": version,
            "timing": timing,
            "schedule": {**schedule, **document["schedule"]},
        }
    )


def run_pass(
    task: Pass,
    dataset: Dataset,
    tracker: TimedTracker,
    journal: Journal,
    warmup: int,
    progress: Progress,
    sampler: Sampler | None = None,
    loads: Loads | None = None,
) -> list[Failure]:
    """Run the sequences that the journal lacks, and put each into it.

    Args:
        task: the pass.
        dataset: the sequences.
        tracker: the tracker that the pass runs, to warm it up.
        journal: where finished sequences are kept.
        warmup: calls before the first sequence, and after each failure of the tracker.
        progress: told of world frames done.
        sampler: reads power and clocks meanwhile.
        loads: what else runs meanwhile.

    Returns:
        What failed.

    Raises:
        LaeError: if a finished sequence cannot be written.
    """
    failures = []
    sampler, loads = sampler or Sampler(()), loads or Loads(())
    cold, read_at = True, -math.inf
    for order, sequence in enumerate(dataset.sequences):
        left = task.work(sequence)

        def advance(frames: int) -> None:
            nonlocal left
            left -= frames
            progress(frames)

        if journal.holds(task.name, sequence.name):
            advance(left)
            continue
        ready = replace(sequence, read=Buffered(sequence.read, len(sequence)))
        try:
            if cold:
                warm_up(tracker, ready, warmup)
                cold = False
            sampler.clear()
            made = task.run(ready if task.ahead else sequence, progress=advance)
        except LaeError as error:
            failures.append(Failure(sequence.name, str(error)))
            cold = cold or isinstance(error, TrackerError)
        else:
            failed = [each for each in made if isinstance(each, Failure)]
            failures += failed
            runs = [each for each in made if isinstance(each, LiveRun)]
            if not runs:
                advance(left)
                continue
            during = []
            if time.monotonic() - read_at > READING_INTERVAL_S:
                during = [{"sequence": sequence.name, **readings()}]
                read_at = time.monotonic()
            sampled = {} if task.metadata.kind == "restarts" else of_sequence(sampler, runs[0])
            around = {"beside": loads.entries()} if loads else {}
            metadata = _of_sequence(
                task.metadata, sequence, runs, order, during, failed, sampled, around
            )
            journal.add(task.name, sequence.name, [run.recording for run in runs], metadata)
        advance(left)
    return failures


def write_pass(task: Pass, journal: Journal, failures: Sequence[Failure]) -> bool:
    """Write the trace of a pass from its finished sequences; whether there are any.

    Raises:
        LaeError: if it cannot be written.
    """
    traces = journal.traces(task.name)
    kept = [trace.metadata.document for trace in traces]
    if not kept:
        return False
    document = dict(task.metadata.document)
    document["sequences"] = {name: entry for d in kept for name, entry in d["sequences"].items()}
    during = [reading for d in kept for reading in d["device"]["readings"]["during"]]
    during.sort(key=lambda reading: str(reading.get("time")))
    before = min(
        (d["device"]["readings"]["before"] for d in kept), key=lambda r: str(r.get("time"))
    )
    device = {key: value for key, value in document["device"].items() if key != "energy"}
    device["readings"] = {"before": before, "during": during, "after": readings()}
    besides = [d["device"]["beside"] for d in kept if "beside" in d["device"]]
    beside = {"beside": in_all(besides)} if besides else {}
    document["device"] = {**device, **of_device(kept), **beside}
    document["schedule"] = {**document["schedule"], **task.schedule(document["sequences"])}
    failed = [*(each for d in kept for each in d.get("failures", ())), *map(asdict, failures)]
    if failed:
        document["failures"] = list({each["sequence"]: each for each in failed}.values())
    entries = document["sequences"].values()
    measured = sum(entry["measured_ns"] for entry in entries)
    cpu = sum(entry["cpu_ns"] for entry in entries)
    document["timing"] = {**document["timing"], "cpu_share": round(cpu / max(measured, 1), 3)}
    recordings: Iterable[Recording] = chain.from_iterable(traces)
    if task.metadata.kind == "restarts":  # "a b" before "a", but "a@1+3" before "a b@1+3"
        recordings = sorted(recordings, key=lambda recording: recording.name)
    columns = frozenset(column for trace in traces for column in trace.columns)
    marked = [stage for column in columns if (stage := stage_of(column)) not in (None, "decode")]
    whole = (_with_stages(recording, marked) for recording in recordings)
    write_trace(Trace(Metadata.of(document), whole, columns=columns), task.path)
    return True


def _with_stages(recording: Recording, marked: Sequence[str]) -> Recording:
    """The recording with a time of each stage that is marked anywhere, where that is known.

    A call that enters some stages says that it spent no time in the others. One that enters none,
    as initialisations often do, says nothing.
    """
    if not marked:
        return recording
    unknown = np.full(len(recording), -1, np.int64)
    known = {stage: recording.stages.get(stage, unknown) for stage in marked}
    entered = np.any([ns >= 0 for ns in known.values()], 0)
    stages = {stage: np.where(entered & (ns < 0), 0, ns) for stage, ns in known.items()}
    return replace(recording, stages={**recording.stages, **stages})


def summary(path: Path) -> PassSummary:
    """What a profiled trace holds, in short."""
    trace = read_trace(path)
    document, energy = trace.metadata.document, Energy.of(trace.metadata.document)
    recordings = list(trace)
    calls = np.concatenate([r.elapsed_ns[1:][r.elapsed_ns[1:] >= 0] for r in recordings])
    return PassSummary(
        trace=str(path),
        schedule=document["schedule"],
        timing=document["timing"]["source"],
        sequences=len(recordings),
        world_frames=sum(map(len, recordings)),
        processed=len(recordings) + len(calls),
        lost=sum(entry["lost"] for entry in document["sequences"].values()),
        init_ms=float(np.mean([r.elapsed_ns[0] for r in recordings])) / 1e6,
        median_ms=float(np.median(calls)) / 1e6 if len(calls) else None,
        p95_ms=float(np.percentile(calls, 95)) / 1e6 if len(calls) else None,
        joules_per_frame=energy.joules_per_frame if energy else None,
    )


def warm_up(tracker: TimedTracker, sequence: ImageSequence, calls: int) -> None:
    """Initialise the tracker and let it track ``calls`` times, unmeasured.

    Raises:
        LaeError: if a frame cannot be read, or the tracker fails.
    """
    if calls:
        live = Live(sequence, tracker)
        live(0)
        for _ in range(calls):
            live(min(1, len(sequence) - 1))


def _of_sequence(
    metadata: Metadata,
    sequence: ImageSequence,
    runs: Sequence[LiveRun],
    order: int,
    during: list[dict[str, Any]],
    failures: Sequence[Failure],
    sampled: Facts,
    around: Facts,
) -> Metadata:
    """The metadata of a pass for one finished sequence.

    Args:
        metadata: of the pass.
        sequence, runs, order: what was run, and when.
        during: readings of the device.
        failures: of restarts.
        sampled: what the sensors said, for the entry of the sequence.
        around: what else ran, for the device.
    """
    document = dict(metadata.document)
    # of many restarts they would be most of the file
    attributes = () if metadata.kind == "restarts" else sequence.attributes
    document["sequences"] = {
        run.recording.name: {
            **ImageSizes.of(run.frames.tolist(), run.image_sizes.tolist()).entry(),
            **({"attributes": list(attributes)} if attributes else {}),
            "order": order,
            "lost": len(run.lost),
            "measured_ns": int(run.measured_ns.sum()),
            "cpu_ns": run.cpu_ns,
            **sampled,
        }
        for run in runs
    }
    if failures:
        document["failures"] = [asdict(failure) for failure in failures]
    device = dict(document["device"])
    device["readings"] = {**device["readings"], "during": during}
    document["device"] = {**device, **around}
    return Metadata.of(document)
