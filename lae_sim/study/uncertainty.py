"""How sure the means of a study are: resampled in batches, and kept for the next run.

An answer depends on scores alone, which the keys of their cells name, and on the resamples. So it
is kept under a digest of these, and what has changed in any of them is asked anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.comparison.statistics import (
    RESAMPLES,
    Bootstrap,
    Difference,
    Interval,
    Recovered,
    spread,
)
from lae_sim.files import text_digest
from lae_sim.study.records import Uncertainty

VERSION = 1
"""Of the answers; those of another version are asked again."""

_AT_ONCE = 64  # samples whose resamples are held


@dataclass(frozen=True)
class Resamples:
    """What a :class:`.statistics.Bootstrap` is made of: its seed, and how many it draws."""

    seed: int = 0
    count: int = RESAMPLES

    def key(self, *of: object) -> str:
        """Digest of all that an answer depends on: the resamples, and what they are of."""
        return text_digest(repr((VERSION, self.seed, self.count, of)))

    def bootstrap(self) -> Bootstrap:
        """One that draws them."""
        return Bootstrap(self.count, self.seed)


@dataclass(frozen=True, eq=False)
class Sample:
    """A score whose mean over S sequences is uncertain; all of them have a value.

    Attributes:
        values: by repetition and sequence, float64 [R, S].
        hold: the mean over the repetitions of hold, float64 [S]; None of hold itself.
        offline: without latency, float64 [S], NaN where the trace lacks boxes; None of hold itself.
    """

    values: Floats
    hold: Floats | None = None
    offline: Floats | None = None

    @property
    def rows(self) -> Floats:
        """What is resampled: the mean over the repetitions; and that of hold, and its loss."""
        mean: Floats = self.values.mean(axis=0)
        if self.hold is None or self.offline is None:
            return mean[None]
        return np.stack([mean, self.hold, self.offline - self.hold])


def uncertainties(samples: Sequence[Sample], resamples: Resamples) -> list[Uncertainty]:
    """How sure the mean of each sample is, and what is won over hold."""
    bootstrap = resamples.bootstrap()
    found: list[Uncertainty | None] = [None] * len(samples)
    for places in _alike([sample.values.shape[1] for sample in samples]):
        some = [samples[place] for place in places]
        for place, answer in zip(places, _uncertain(some, bootstrap)):
            found[place] = answer
    return [answer for answer in found if answer is not None]


def _uncertain(samples: Sequence[Sample], bootstrap: Bootstrap) -> Iterator[Uncertainty]:
    """Those of samples of as many sequences."""
    rows = [sample.rows for sample in samples]
    stops = np.cumsum([len(each) for each in rows])
    means = np.split(bootstrap.means(np.concatenate(rows)), stops[:-1])
    paired = [(row, mean) for row, mean in zip(rows, means) if len(row) > 1]
    against_hold = iter(
        bootstrap.differences(
            np.array([row[0] for row, _ in paired]),
            np.array([row[1] for row, _ in paired]),
            [mean[0] for _, mean in paired],
            [mean[1] for _, mean in paired],
        )
        if paired
        else ()
    )
    for sample, row, each in zip(samples, rows, means):
        repeated = len(sample.values) > 1
        jitter = bootstrap.interval(sample.values.mean(axis=1)) if repeated else None
        interval = bootstrap.interval(each[0], *spread(row[0]))
        if sample.hold is None or sample.offline is None:
            yield Uncertainty(interval, jitter)
            continue
        difference, share = next(against_hold), None
        if not np.isnan(sample.offline).any():
            lost = float(sample.offline.mean() - sample.hold.mean())
            share = bootstrap.recover(difference.value, lost, each[0] - each[1], each[2])
        yield Uncertainty(interval, jitter, difference, share)


def differences(samples: Sequence[Floats], resamples: Resamples) -> list[Difference]:
    """How far the means of paired differences, float64 [S] each, are from 0."""
    bootstrap = resamples.bootstrap()
    found: dict[int, Difference] = {}
    for places in _alike([len(sample) for sample in samples]):
        values = np.array([samples[place] for place in places])
        nothing, means = np.zeros_like(values), bootstrap.means(values)
        found |= zip(places, bootstrap.differences(values, nothing, means, [0.0] * len(means)))
    return [found[place] for place in range(len(samples))]


def _alike(sizes: Sequence[int]) -> Iterator[list[int]]:
    """The places of some samples of one size each, as many as can be held."""
    places: dict[int, list[int]] = {}
    for place, size in enumerate(sizes):
        places.setdefault(size, []).append(place)
    for some in places.values():
        for start in range(0, len(some), _AT_ONCE):
            yield some[start : start + _AT_ONCE]


class Answers:
    """Answers by their keys, as JSON has them; those that nobody asks for are not kept again.

    Args:
        kept: what was kept before (see :meth:`document`); None if nothing was.
    """

    def __init__(self, kept: Mapping[str, Any] | None = None) -> None:
        self._kept: Mapping[str, Any] = kept or {}
        self._asked: dict[str, Any] = {}

    def has(self, key: str) -> bool:
        """Whether an answer is known."""
        if key in self._kept:
            self._asked.setdefault(key, self._kept[key])
        return key in self._asked

    def put(self, key: str, answer: Any) -> None:
        """Keep an answer."""
        self._asked[key] = answer

    def __getitem__(self, key: str) -> Any:
        return self._asked[key]

    @property
    def differ(self) -> bool:
        """Whether there are others than those that were kept before."""
        return self._asked.keys() != self._kept.keys()

    def document(self) -> dict[str, Any]:
        """What is to be kept."""
        return self._asked


def plain(answer: Difference | Uncertainty) -> list[Any]:
    """An answer as JSON has it: its values in their order, and so those of its parts."""
    return list(astuple(answer))


def difference_of(answer: Sequence[Any]) -> Difference:
    """The difference that is plainly so."""
    value, interval, p, better, worse = answer
    return Difference(value, Interval(*interval), p, better, worse)


def uncertainty_of(answer: Sequence[Any]) -> Uncertainty:
    """The uncertainty that is plainly so."""
    interval, jitter, difference, share = answer
    return Uncertainty(
        Interval(*interval),
        None if jitter is None else Interval(*jitter),
        None if difference is None else difference_of(difference),
        None if share is None else Recovered(share[0], share[1] and Interval(*share[1])),
    )
