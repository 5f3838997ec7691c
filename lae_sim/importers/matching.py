"""Which results are of which sequence, and which of them are one tracker's, by their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lae_sim.datasets.annotations import GroundTruth
from lae_sim.datasets.names import ResultsName, SequenceNames
from lae_sim.errors import LaeError, hint, listed
from lae_sim.importers.results import Source


@dataclass(frozen=True)
class Matched:
    """Results and the sequences of the ground truth that they are of.

    Attributes:
        sources: by sequence.
        tracker: whose they are, if their names say it.
        without_truth: names of the tracker's results of no known sequence.
        others: the other trackers whose results lie there.
        unnamed: names of other results there that tell no tracker.
    """

    sources: Mapping[str, Source]
    tracker: str | None
    without_truth: list[str]
    others: list[str]
    unnamed: list[str]


def match_results(
    path: Path,
    sources: Sequence[Source],
    truth: GroundTruth,
    tracker: str | None = None,
    skip_missing: bool = False,
) -> Matched:
    """Match the results of one tracker with the sequences of the ground truth.

    Results whose names tell no tracker come before those whose names do, unless the tracker that is
    asked for is one of the latter.

    Args:
        path: where the results lie, for messages.
        sources: the results.
        truth: the ground truth.
        tracker: the one that is asked for, among those that names tell apart; where none of them is
            called so, a name for the one of the other results.
        skip_missing: whether results without ground truth are left out instead of refused.

    Raises:
        LaeError: if nothing fits or some do not, a name fits two sequences, a sequence has results
            twice, or there are several trackers and none of them is the one that is asked for.
    """
    by_tracker, missing = _by_tracker(sources, truth, tracker)
    plain = by_tracker.pop("", {})
    others: list[str] = []
    unnamed: list[str] = []
    apart = ""
    if plain and tracker not in by_tracker:  # what follows a sequence's name is part of it
        chosen, matched = None, plain
        missing += [source.name for found in by_tracker.values() for source in found.values()]
        if by_tracker:
            apart = f", --tracker {' or '.join(sorted(by_tracker)[:2])} takes its own alone"
    else:
        chosen, others = _one_tracker(path, sorted(by_tracker), tracker)
        matched = by_tracker.get(chosen or "", {})
        unnamed = sorted(source.name for source in plain.values())
        if others or plain:
            missing = [
                name
                for name in missing
                if name.startswith(f"{chosen}_") or name.endswith(f"_{chosen}")
            ]
    if not matched or (missing and not skip_missing):
        raise LaeError(
            f"{truth.root}: no ground truth for {listed(sorted(missing))}, of {len(sources)} "
            "results; " + (f"--skip-missing leaves them out{apart}" if matched else _known(truth))
        )
    return Matched(matched, chosen, sorted(missing), others, unnamed)


def _known(truth: GroundTruth) -> str:
    """What to check where no result is of a sequence of the ground truth."""
    return f"is it the right dataset? It has {listed(sorted(truth.files), 3)}: name files so"


def _by_tracker(
    sources: Sequence[Source], truth: GroundTruth, tracker: str | None
) -> tuple[dict[str, dict[str, Source]], list[str]]:
    """The results of each tracker by sequence, and the names of those of no known sequence.

    Results whose names tell no tracker are those of tracker "".
    """
    names = SequenceNames(truth.files)
    only_truth = next(iter(truth.files)) if truth.root.is_file() and len(sources) == 1 else None
    by_tracker: dict[str, dict[str, Source]] = {}
    missing = []
    for source in sources:
        try:
            reading = names.read(source.name, tracker)
        except LaeError as error:
            raise LaeError(f"{source.path}: {error}") from error
        if reading is None and only_truth:
            reading = ResultsName(only_truth)
        if reading is None:
            missing.append(source.name)
            continue
        results = by_tracker.setdefault(reading.tracker or "", {})
        other = results.setdefault(reading.sequence, source)
        if other is not source:
            raise LaeError(
                f"{source.path} and {other.path} are both results of sequence "
                f"{reading.sequence!r}; give the folder or file of one tracker"
            )
    return by_tracker, missing


def _one_tracker(
    path: Path, found: Sequence[str], wanted: str | None
) -> tuple[str | None, list[str]]:
    """The tracker whose results are taken, and the others that lie there.

    Raises:
        LaeError: if there are several, and none of them is the one that is wanted.
    """
    if len(found) < 2:
        return next(iter(found), None), []
    if wanted in found:
        return wanted, [tracker for tracker in found if tracker != wanted]
    raise LaeError(
        f"{path}: holds results of {len(found)} trackers ({listed(found, 20)}); "
        + (f"none is {wanted!r}{hint(wanted, found)}" if wanted else "choose one with --tracker")
    )
