"""What keeps the figures of a replay from being what their names promise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from lae_sim.errors import listed
from lae_sim.evaluation.evaluate import ReplayStatistics, ScoredRun
from lae_sim.evaluation.metrics import Convention
from lae_sim.forecast.base import AnyFactory, notes_of
from lae_sim.trace.describe import STALL, in_ms
from lae_sim.trace.metadata import Metadata

TRUSTED_DISAGREEMENT = 0.05


def at_the_floor(skip_rate: float, mismatch_mean: float) -> bool:
    """Whether a tracker keeps up with the world, so that its answers are a frame old, no more."""
    return skip_rate <= 0.05 and 0.9 <= mismatch_mean < 1.5


def floor_notes(names: Iterable[str]) -> list[str]:
    """Why trackers that keep up with the world lose all the same, in a sentence.

    By the rule of pairing: at sigma 0 the query for frame i comes at its arrival, and an output is
    of use from t_r = start + elapsed on, which is later if it is frame i's own.

    Args:
        names: of those :func:`at_the_floor` at sigma 0.
    """
    fast = listed(dict.fromkeys(names))
    if not fast:
        return []
    return [
        f"a floor of one frame for {fast}, though almost no frame is skipped: at sigma 0 an answer "
        "is due as its frame arrives, before any tracker has processed it, so the best there is "
        "comes from the frame before; at sigma 1 it is due a frame later"
    ]


class SkippedStalls:
    """Counts recorded stalls that no call met, since the frame was skipped."""

    def __init__(self) -> None:
        self._count = self._longest_ns = 0

    def __call__(self, scored: ScoredRun) -> None:
        """Take in a run."""
        run = scored.run
        skipped = run.recording.elapsed_ns.copy()
        typical = np.median(skipped[skipped >= 0])
        skipped[run.schedule.frames] = -1
        stalls = skipped[skipped > STALL * typical]
        self._count += len(stalls)
        self._longest_ns = max([self._longest_ns, *stalls.tolist()])

    def notes(self) -> list[str]:
        """A note, if there were any."""
        if not self._count:
            return []
        return [
            f"{self._count} recorded times above {STALL} times the median (the longest "
            f"{self._longest_ns / 1e9:.3g} s) are of skipped frames; --latency by-call meets them"
        ]


def left_search(replay: ReplayStatistics) -> list[str]:
    """The sequences whose target leaves the search region during the initialisation."""
    return [name for name, left in zip(replay.sequences, replay.left_search) if left]


def search_notes(search: Mapping[str, Any]) -> list[str]:
    """What modelled figures rest on, in lines.

    Args:
        search: what :func:`lae_sim.evaluation.totals.search_report` gives.
    """
    interval = "the ends of that range"
    if search["c_known"]:  # what is unexplained is measured so: see modelled.UNEXPLAINED_FORECAST
        share = "95 %" if search["pre_forecaster"] is None else "about 90 %"
        given = ", if that is c" if search["reach"] is None else ""
        interval = f"an interval of {share}{given}"
    lines = [
        "modelled: a target is found within c search sides of where the tracker searches; "
        f"{search['source']};",
        f"lost for {100 * search['lost_share']:.3g}% of the outputs; [low, high]: {interval}",
    ]
    if search["pre_forecaster"] is not None:
        kept = ", the size is kept" if search["keep_size"] else ""
        lines.append(
            f"pre-forecaster {search['pre_forecaster']} says where the tracker searches{kept}: "
            "the model's figures alone"
        )
    if not search["c_known"]:
        lines.append(
            "measure c: lae-sim profile --gaps, then --strided TRACE.gaps.parquet; or name it: "
            "--search c=0.7"
        )
    return lines


def _notes_on_absence(replay: ReplayStatistics, convention: Convention) -> list[str]:
    """What becomes of frames whose target is said to be absent."""
    sequences, silent = len(replay.sequences), int((replay.absent < 0).sum())
    if convention.by_visible and silent:
        where = "" if silent == sequences else f" in {silent} of {sequences} sequences"
        return [
            f"nothing says{where} where the target is absent: {convention.name} counts every frame "
            "with a truth there"
        ]
    scored = np.where(replay.scored, np.maximum(replay.absent, 0), 0)
    if convention.by_visible or not scored.any():
        return []
    return [
        f"{scored.sum():,} frames in {int((scored > 0).sum())} of {sequences} sequences are scored "
        f"by {convention.name} although their target is said to be absent; --convention lasot "
        "leaves them out"
    ]


def notes_on(
    replay: ReplayStatistics,
    metadata: Metadata,
    convention: Convention,
    forecasters: Mapping[str, AnyFactory],
) -> list[str]:
    """What to say of the scores of a trace, a sentence each."""
    notes = []
    sequences = replay.sequences
    bare = [name for name, scored in zip(sequences, replay.scored) if not scored]
    if bare:
        notes.append(
            f"{len(bare)} of {len(sequences)} sequences have no ground truth after the first frame "
            f"and are not scored, such as {bare[0]!r}"
        )
    if truthless := replay.truthless[replay.scored].sum():
        counted = "leaves them out" if convention.leaves_out else "counts them as missed by AUC"
        counted += "" if convention.leaves_out else " and hit by DP"
        counted += ", but divides by all frames" if convention.of_all else ""
        notes.append(f"{truthless:,} frames have no ground truth; {convention.name} {counted}")
    notes += _notes_on_absence(replay, convention)
    if replay.missing.any():
        which = "the trace lacks" if replay.missing.all() else "some sequences lack"
        notes.append(f"no offline score, nothing recovered: {which} the boxes of skipped frames")
    if not replay.scores_latency.all():
        notes.append("vot-realtime skips frames but never scores latency")
    parted = np.flatnonzero(replay.disagreement > TRUSTED_DISAGREEMENT)
    if len(parted):
        worst = sequences[int(np.nanargmax(replay.disagreement))]
        notes.append(
            f"do not trust the replay of {len(parted)} of {len(sequences)} sequences, such as "
            f"{worst!r}: the passes disagree on more than {TRUSTED_DISAGREEMENT:.0%} of its frames"
        )
    if left := left_search(replay):
        notes.append(
            f"initialisation ({in_ms(replay.init_ns.mean() / 1e6)}) ends so late in {len(left)} of "
            f"{len(sequences)} sequences that by the next frame the target has left the region "
            f"which a tracker such as SiamFC searches around the initial box: {', '.join(left)}"
        )
    never = [n for n, i, p in zip(sequences, replay.frames, replay.processed) if p == 1 < i]
    if never:
        notes.append(
            f"no frame after the initialisation ({in_ms(replay.init_ns.mean() / 1e6)}) is "
            f"processed in {len(never)} of {len(sequences)} sequences, such as {never[0]!r}"
        )
    forecaster = metadata.pre_forecaster
    if forecaster is not None and replay.departures.any():
        notes.append(
            f"recorded with the pre-forecaster {forecaster!r}, so the search model says nothing"
        )
    unknown = sum(metadata.image_size(name) is None for name in sequences)
    if unknown and "kalman-lae-pvt" in forecasters:
        notes.append(
            f"kalman-lae-pvt does not clip forecasts where the image size is unknown, as it is of "
            f"{unknown} of {len(sequences)} sequences"
        )
    resized = [name for name in metadata.resized if name in set(sequences)]
    if resized:
        notes.append(
            f"the images of {len(resized)} of {len(sequences)} sequences change size, such as "
            f"those of {resized[0]!r}: clipping and search regions follow"
        )
    for name, factory in forecasters.items():
        notes += [f"{name}: {note}" for note in notes_of(factory, sequences)]
    return notes
