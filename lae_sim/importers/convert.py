"""Results that a tracker left, as traces."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError

if TYPE_CHECKING:
    from lae_sim._arrays import Ints
    from lae_sim.datasets.annotations import GroundTruth
    from lae_sim.importers.results import GivenTimes, Results, Source
    from lae_sim.trace.recording import Recording


def matched_results(
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
            f"{arguments.truth}: no ground truth for {listed(missing)}, of {len(sources)} results"
            + ("; --skip-missing leaves them out" if matched else "; is it the right dataset?")
        )
    named = {*arguments.sequence, *arguments.exclude, *dict(arguments.truth_file)}
    absent = sorted(named - set(matched))
    if absent:
        raise LaeError(f"{arguments.results}: no results of sequence {listed(absent)}")
    kept = set(arguments.sequence or matched) - set(arguments.exclude)
    if not kept:
        raise LaeError("--exclude leaves no sequence")
    return {name: matched[name] for name in sorted(kept)}, missing


def every_frame(
    kind: str,
    matched: Mapping[str, Source],
    truth: GroundTruth,
    given: GivenTimes | None,
    arguments: argparse.Namespace,
) -> tuple[list[Recording], dict[str, str]]:
    """The recordings of results on every frame, and what to say of their times."""
    from lae_sim.datasets.annotations import read_truth
    from lae_sim.importers.results import read_results
    from lae_sim.trace.recording import Recording

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

    from lae_sim.importers.results import NO_TIMES, frame_ns

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


def real_time(
    matched: Mapping[str, Source], truth: GroundTruth, clock: Clock
) -> tuple[list[Recording], dict[str, str]]:
    """The recordings of released real-time runs, and what to say of their times."""
    from lae_sim.datasets.annotations import read_truth
    from lae_sim.importers.lae_pvt import read_run

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
    from lae_sim.trace.checks import RowChecker
    from lae_sim.trace.columns import Rows

    RowChecker(f"{results} (ground truth {truth})")(Rows.of_recordings([recording]))


def sequence_entries(
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


def figures(recordings: Sequence[Recording]) -> dict[str, Any]:
    """How much there is, and what a frame takes."""
    import numpy as np

    elapsed = np.concatenate([recording.elapsed_ns for recording in recordings])
    return {
        "sequences": len(recordings),
        "frames": len(elapsed),
        "processed": int((elapsed >= 0).sum()),
        "median_ms": float(np.median(elapsed[elapsed >= 0])) / 1e6,
    }


def listed(names: Sequence[str], most: int = 5) -> str:
    """Some names, at most so many of them, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
