"""What forecasters learn from: the questions that replays ask, with their answers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from hashlib import sha256
from typing import Protocol, runtime_checkable

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.datasets.names import video_of
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import lanes_of
from lae_sim.evaluation.pairing import histories, pair, pairs
from lae_sim.forecast.base import (
    AnyFactory,
    ForecasterFactory,
    Lanes,
    Sequenced,
    factory_for,
    notes_of,
)
from lae_sim.replay.run import Run, RunBatch
from lae_sim.replay.world import World
from lae_sim.trace.file import Trace


@dataclass(frozen=True, eq=False)
class Examples:
    """Queries of some replayed sequences at no permitted latency, with the boxes that came.

    Attributes:
        sequences: the sequence of each lane.
        lanes: the outputs that a forecaster is fed, a lane for each replayed sequence.
        item: the latest item known at each query, int64 [P], not decreasing.
        frame: the world frame of each query, int64 [P], or its time (see :class:`.base.Lanes`).
        truth: its ground truth, float64 [P, 4]; NaN where there is none.
        boxes: the tracker's box of that frame in the trace, offline, float64 [P, 4]; NaN where the
            trace has none.
    """

    sequences: tuple[str, ...]
    lanes: Lanes
    item: Ints
    frame: Ints | Floats
    truth: Floats
    boxes: Floats

    @classmethod
    def of(cls, runs: Sequence[Run]) -> Examples:
        """The examples of some runs of one trace."""
        batch = RunBatch.of(runs)
        pairing = pair(batch.schedules, [Fraction(0)])
        fed = histories(pairing)
        queries = pairs(pairing, fed)
        lanes = lanes_of(batch, pairing, fed, lambda recording: None)
        ends = np.cumsum(pairing.lengths)
        sequence = fed.sequence.take(lanes.lane(queries.item))
        row = (ends - pairing.lengths)[sequence] + queries.frame
        return cls(
            tuple(run.recording.name for run in runs),
            lanes,
            queries.item,
            pairing.frame_times(sequence, queries.frame),
            np.concatenate([run.recording.truth for run in runs])[row],
            np.concatenate([run.recording.boxes for run in runs])[row],
        )

    @classmethod
    def joined(cls, parts: Sequence[Examples]) -> Examples:
        """The examples of some replays as one."""
        starts = np.cumsum([0, *(part.lanes.offsets[-1] for part in parts)])
        offsets = [part.lanes.offsets[:-1] + start for part, start in zip(parts, starts)]
        frames, boxes, sizes = (
            np.concatenate([getattr(part.lanes, name) for part in parts])
            for name in ("frames", "boxes", "image_sizes")
        )
        lanes = Lanes(np.concatenate([*offsets, starts[-1:]]), frames, boxes, sizes)
        return cls(
            tuple(name for part in parts for name in part.sequences),
            lanes,
            np.concatenate([part.item + start for part, start in zip(parts, starts)]),
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("frame", "truth", "boxes")
            ),
        )

    @classmethod
    def of_traces(
        cls, traces: Iterable[Trace], worlds: Iterable[World], exclude: Collection[str] = ()
    ) -> Examples:
        """The examples of replays of each trace in each world.

        Args:
            traces: better of every frame.
            worlds: how to replay them.
            exclude: names of sequences to leave out.

        Raises:
            LaeError: if a sequence to leave out is not there, or a trace cannot be replayed.
        """
        worlds = list(worlds)
        examples = cls.joined(
            [cls.of(list(world.replay(trace))) for trace in traces for world in worlds]
        )
        absent = sorted(set(exclude) - set(examples.sequences))
        if absent:
            raise LaeError(f"--exclude {absent[0]}: there is no such sequence")
        return examples.without(exclude) if exclude else examples

    def without(self, sequences: Collection[str]) -> Examples:
        """All but some sequences: neither their outputs nor their truth is left."""
        kept = np.array([name not in sequences for name in self.sequences])
        lanes, asked, item = self.lanes.chosen(kept, self.item)
        return Examples(
            tuple(name for name, keep in zip(self.sequences, kept) if keep),
            lanes,
            item,
            *(getattr(self, name)[asked] for name in ("frame", "truth", "boxes")),
        )

    @property
    def weight(self) -> Floats:
        """What each query counts, float64 [P]: every lane the same in total, as in the scores."""
        lane = self.lanes.lane(self.item)
        counts = np.bincount(lane, minlength=len(self.sequences))
        weight: Floats = 1.0 / counts[lane]
        return weight


@runtime_checkable
class Trainer(Protocol):
    """What makes a forecaster from examples; named like a forecaster, and tried across folds."""

    def fit(self, examples: Examples, seed: int) -> AnyFactory:
        """The factory that these examples lead to."""


@runtime_checkable
class FoldTrainer(Protocol):
    """A trainer that is faster for all folds at once, since they share most of their examples."""

    def fit_folds(
        self,
        examples: Examples,
        held_out: Sequence[Collection[str]],
        seed: int,
        progress: Callable[[], object],
    ) -> list[AnyFactory]:
        """What :func:`fit_folds` returns, equal to one ``fit`` for each fold."""


@dataclass(frozen=True)
class CrossFitted:
    """A forecaster trained once per fold, which answers for the sequences that it has not seen.

    Attributes:
        folds: the fold of each sequence.
        factories: the factory trained without each fold.
    """

    folds: dict[str, int]
    factories: tuple[AnyFactory, ...]

    def for_sequence(self, sequence: Sequenced) -> ForecasterFactory:
        """The factory that was trained without this sequence."""
        return factory_for(self.factories[self.folds[sequence.name]], sequence)

    @property
    def sees_frames(self) -> bool:
        """Whether the factories look at frames."""
        return any(getattr(factory, "sees_frames", False) for factory in self.factories)

    def notes(self, sequences: Sequence[str]) -> list[str]:
        """What each fold's factory has to say of the sequences that it scores."""
        notes: dict[str, None] = {}
        for fold, factory in enumerate(self.factories):
            scored = [name for name in sequences if self.folds[name] == fold]
            notes.update(dict.fromkeys(notes_of(factory, scored)))
        return list(notes)


def cross_fitted(
    trainer: Trainer,
    examples: Examples,
    folds: dict[str, int],
    seed: int = 0,
    progress: Callable[[], object] = lambda: None,
) -> CrossFitted:
    """Train once per fold, without the fold's sequences.

    Args:
        trainer: makes a forecaster from examples.
        examples: of all sequences, those to be scored among them.
        folds: the fold of each sequence (see :func:`assign_folds`).
        seed: of the training.
        progress: called before each fold.
    """
    held_out: list[set[str]] = [set() for _ in range(max(folds.values()) + 1)]
    for name, fold in folds.items():
        held_out[fold].add(name)
    return CrossFitted(folds, tuple(fit_folds(trainer, examples, held_out, seed, progress)))


def fit_folds(
    trainer: Trainer,
    examples: Examples,
    held_out: Sequence[Collection[str]],
    seed: int,
    progress: Callable[[], object] = lambda: None,
) -> list[AnyFactory]:
    """The factory that a trainer makes without some sequences, for each of several such sets.

    Args:
        trainer, examples, seed: see :func:`cross_fitted`.
        held_out: the sequences to leave out, of each fold.
        progress: called before each fold.
    """
    if isinstance(trainer, FoldTrainer):
        return trainer.fit_folds(examples, held_out, seed, progress)
    factories = []
    for names in held_out:
        progress()
        factories.append(trainer.fit(examples.without(names), seed))
    return factories


def assign_folds(sequences: Iterable[str], folds: int = 5, seed: int = 0) -> dict[str, int]:
    """Deal sequences out to folds; the parts of one video stay together.

    The videos are dealt in the order of a hash of the seed and their names, the largest fold one
    video larger than the smallest.

    Raises:
        LaeError: if there is but one video, or fewer than two folds are asked for.
    """
    if folds < 2:
        raise LaeError("training on some sequences to score others needs at least two folds")
    videos: dict[str, list[str]] = {}
    for name in sorted(set(sequences)):
        videos.setdefault(video_of(name), []).append(name)
    if len(videos) < 2:
        raise LaeError(
            "there is only one video: nothing is left to train on if it is scored; leave out the "
            "forecasters that are trained: --forecaster kalman"
        )
    order = sorted(videos, key=lambda video: sha256(f"{seed}\0{video}".encode()).digest())
    return {name: k % folds for k, video in enumerate(order) for name in videos[video]}
