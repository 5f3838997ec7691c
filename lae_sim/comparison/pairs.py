"""Pairs of traces: how far one is above the other, and how sure that is.

The means of a trace in each resample are taken once; those of a difference are their difference. So
a pair costs a subtraction and two quantiles, and its interval may differ in the last bits from one
of resampled differences: its ends are rounded to 12 decimals, as scores are wherever ties count.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.comparison.statistics import (
    RESAMPLES,
    Bootstrap,
    holm,
    quantiles,
    signed_rank_ps,
)

DECIMALS = 12
_TIE = 0.5 * 10.0**-DECIMALS  # what is no larger is rounded to 0
_MEMBERS = 256  # whose resamples are held at once, twice


@dataclass(frozen=True, eq=False)
class Member:
    """One trace of those that are compared.

    Attributes:
        sequences: names, sorted, S of them.
        scores: AUCs by repetition and sequence, float64 [R, S]; NaN where a sequence has none.
    """

    sequences: tuple[str, ...]
    scores: Floats

    @property
    def kind(self) -> tuple[object, ...]:
        """What members share whose pairs are of the same sequences and repetitions."""
        return self.sequences, self.counts.tobytes(), len(self.scores)

    @property
    def counts(self) -> Bools:
        """Which sequences have an AUC in every repetition, bool [S]."""
        counts: Bools = ~np.isnan(self.scores.mean(axis=0))
        return counts


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of some traces that have sequences in common, P of them.

    Attributes:
        a, b: the places of the traces, int [P], in the order of :func:`itertools.combinations`.
        sequences: how many both have a score of, int [P].
        difference: of the mean AUC, a - b, paired over the sequences, float64 [P].
        low, high: its 95 % interval over sequences.
        p: of no difference.
        p_holm: corrected for the number of pairs.
        better_here: how probable it is that one run of a beats one of b on these sequences; NaN
            without jitter.
        better: the same on other sequences like these.
        above, below: on how many sequences a is better, and worse, int [P].
    """

    a: Ints
    b: Ints
    sequences: Ints
    difference: Floats
    low: Floats
    high: Floats
    p: Floats
    p_holm: Floats
    better_here: Floats
    better: Floats
    above: Ints
    below: Ints

    def __len__(self) -> int:
        return len(self.a)


_WHOLE = ("sequences", "above", "below")
_REAL = ("difference", "low", "high", "p", "better_here", "better")


def pairs_of(members: Sequence[Member], seed: int = 0, resamples: int = RESAMPLES) -> Pairs:
    """Compare each of some traces with each that comes after it.

    Args:
        members: the traces.
        seed: of the resamples.
        resamples: of the bootstrap.
    """
    bootstrap, count = Bootstrap(resamples, seed), len(members)
    a, b = np.triu_indices(count, 1)
    found: dict[str, npt.NDArray[Any]] = {
        **{name: np.zeros(len(a), np.int64) for name in _WHOLE},
        **{name: np.full(len(a), np.nan) for name in _REAL},
    }
    first = np.array([place * (2 * count - place - 1) // 2 for place in range(count)])
    for left, right in _blocks(members):
        block = _Block.of([members[i] for i in left], [members[i] for i in right], bootstrap)
        if block is None:
            continue
        for row, i in enumerate(left):
            later = np.flatnonzero(right > i)
            if len(later):
                places = first[i] + right[later] - i - 1
                for name, values in block.compared(row, later).items():
                    found[name][places] = values
    common = np.flatnonzero(found["sequences"])
    kept = {name: values[common] for name, values in found.items()}
    return Pairs(a=a[common], b=b[common], p_holm=np.array(holm(kept["p"].tolist())), **kept)


def _blocks(members: Sequence[Member]) -> Iterator[tuple[Ints, Ints]]:
    """The places of traces of one kind, and of another or the same, as many as can be held."""
    kinds: dict[tuple[object, ...], list[int]] = {}
    for place, member in enumerate(members):
        kinds.setdefault(member.kind, []).append(place)
    parts = [
        np.array(places[start : start + _MEMBERS])
        for places in kinds.values()
        for start in range(0, len(places), _MEMBERS)
    ]
    for left in parts:
        for right in parts:
            if right[-1] > left[0]:
                yield left, right


@dataclass(frozen=True, eq=False)
class _Block:
    """Traces of one kind (left), and of another or the same (right), on their common sequences.

    Each pair of arrays is of these two.

    Attributes:
        scores: means over the repetitions, float64 [traces, S].
        means: of these in each resample, float64 [traces, resamples].
        drawn: the same with a repetition drawn for each sequence; None without repetitions.
        runs: means over the sequences of each repetition, float64 [traces, R].
    """

    scores: tuple[Floats, Floats]
    means: tuple[Floats, Floats]
    drawn: tuple[Floats, Floats] | None
    runs: tuple[Floats, Floats]
    tails: tuple[float, float]

    @classmethod
    def of(
        cls, left: Sequence[Member], right: Sequence[Member], bootstrap: Bootstrap
    ) -> _Block | None:
        """A block; None if there are no sequences that all have a score of."""
        a, b = left[0], right[0]
        places = (
            [
                (s, b.sequences.index(name))
                for s, name in enumerate(a.sequences)
                if name in b.sequences
            ]
            if a.sequences != b.sequences
            else [(s, s) for s in range(len(a.sequences))]
        )
        places = [(s, t) for s, t in places if a.counts[s] and b.counts[t]]
        if not places:
            return None
        columns = [list(some) for some in zip(*places)]
        # [R, S] of each: means over repetitions are of the same order of sums wherever they are
        values = [
            [member.scores[:, of_side] for member in side]
            for side, of_side in zip((left, right), columns)
        ]
        scores = [np.stack([each.mean(axis=0) for each in side]) for side in values]
        repetitions = len(a.scores), len(b.scores)
        drawn = None
        if max(repetitions) > 1:
            drawn = _drawn(np.stack(values[0]), np.stack(values[1]), bootstrap)
        return cls(
            scores=(scores[0], scores[1]),
            means=(bootstrap.means(scores[0]), bootstrap.means(scores[1])),
            drawn=drawn,
            runs=(
                np.stack([each.mean(axis=1) for each in values[0]]),
                np.stack([each.mean(axis=1) for each in values[1]]),
            ),
            tails=bootstrap.tails,
        )

    def compared(self, left: int, right: Ints) -> dict[str, npt.NDArray[Any]]:
        """What there is to say of one trace on the left against some on the right."""
        differences = self.scores[0][left] - self.scores[1][right]
        rounded = np.round(differences, DECIMALS)
        margins = np.empty(self.means[0].shape[1])
        mine, theirs = self.means[0][left], self.means[1]
        difference = differences.mean(axis=1)
        spread = differences.std(axis=1) / np.sqrt(differences.shape[1])  # of the margins
        ends, better, better_here = [], [], []
        for place, *about in zip(right.tolist(), difference.tolist(), spread.tolist()):
            np.subtract(mine, theirs[place], out=margins)
            ends.append(quantiles(margins, self.tails, *about))
            if self.drawn is not None:
                np.subtract(self.drawn[0][left], self.drawn[1][place], out=margins)
                here = self.runs[0][left][:, None] - self.runs[1][place]
                better_here.append(superiority(here))
            better.append(superiority(margins))
        low, high = np.round(ends, DECIMALS).T
        return {
            "sequences": np.full(len(right), differences.shape[1]),
            "difference": difference,
            "low": low,
            "high": high,
            "p": np.array(signed_rank_ps(rounded)),
            "better": np.array(better),
            "better_here": np.array(better_here or [np.nan] * len(right)),
            "above": (rounded > 0).sum(axis=1),
            "below": (rounded < 0).sum(axis=1),
        }


def superiority(margins: Floats) -> float:
    """How probable a margin above 0 is; one of 0, to 12 decimals, counts half."""
    above, below = np.count_nonzero(margins > _TIE), np.count_nonzero(margins < -_TIE)
    return ((above - below) / margins.size + 1) / 2


def _drawn(first: Floats, second: Floats, bootstrap: Bootstrap) -> tuple[Floats, Floats]:
    """Means in resamples of the sequences, each with a repetition drawn for each sequence.

    Args:
        first, second: scores of the traces on two sides, float64 [traces, R, S].
        bootstrap: whose resamples; all pairs share what is drawn for a side.

    Returns:
        Of each side, float64 [traces, resamples].
    """
    counts = bootstrap.counts(first.shape[2])
    resamples, count = counts.shape
    seed = [bootstrap.seed, count, first.shape[1], second.shape[1]]
    random = np.random.Generator(np.random.PCG64(seed))
    sides = [np.ascontiguousarray(side.transpose(2, 1, 0)) for side in (first, second)]
    means = [np.zeros((resamples, side.shape[2])) for side in sides]
    for s in range(count):  # one sequence after another: resamples x sequences would be large
        share = (counts[:, s] / count)[:, None]
        for side, mean in zip(sides, means):
            mean += share * side[s][random.integers(0, side.shape[1], resamples)]
    return np.ascontiguousarray(means[0].T), np.ascontiguousarray(means[1].T)
