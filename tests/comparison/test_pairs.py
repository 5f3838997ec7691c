"""Pairs of traces: what is taken once for each trace gives what each pair gives alone."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from lae_sim.comparison import pairs
from lae_sim.comparison.pairs import Member, pairs_of, superiority
from lae_sim.comparison.statistics import Bootstrap, holm

RNG = np.random.default_rng(7)
RESAMPLES = 500


def member(sequences: int, repetitions: int = 1, absent: float = 0, nan: float = 0) -> Member:
    """A trace with scores of some sequences."""
    names = [f"s{i:02}" for i in range(sequences) if RNG.random() >= absent]
    scores = np.round(RNG.random((1, len(names))) + RNG.random((repetitions, len(names))) / 5, 3)
    scores[:, RNG.random(len(names)) < nan] = np.nan
    return Member(tuple(names), scores)


def drawn_margins(a, b, bootstrap):
    """Differences in resamples of the sequences, each with a repetition drawn for each."""
    counts = bootstrap.counts(a.shape[1])
    seed = [bootstrap.seed, a.shape[1], len(a), len(b)]
    random, margins = np.random.Generator(np.random.PCG64(seed)), np.zeros(RESAMPLES)
    for s in range(a.shape[1]):
        mine = a[random.integers(0, len(a), RESAMPLES), s]
        theirs = b[random.integers(0, len(b), RESAMPLES), s]
        margins += counts[:, s] / a.shape[1] * (mine - theirs)
    return margins


def pair(a: Member, b: Member, seed: int):
    """What there is to say of two traces, from the resamples of their differences."""
    bootstrap = Bootstrap(RESAMPLES, seed)
    both = sorted({*a.sequences} & {*b.sequences})
    one, other = (m.scores[:, [m.sequences.index(name) for name in both]] for m in (a, b))
    kept = ~np.isnan(one.mean(axis=0) + other.mean(axis=0))
    one, other = one[:, kept], other[:, kept]
    if not one.size:
        return None
    differences = one.mean(axis=0) - other.mean(axis=0)
    [margins] = bootstrap.means(differences[None])
    [found] = bootstrap.differences(differences[None], 0 * differences[None], [margins], [0.0])
    here = np.nan
    if len(one) > 1 or len(other) > 1:
        margins = drawn_margins(one, other, bootstrap)
        here = superiority(one.mean(axis=1)[:, None] - other.mean(axis=1))
    ends = round(found.interval.low, 12), round(found.interval.high, 12)
    return (len(differences), found.value, *ends, found.p, here, superiority(margins),
            found.better, found.worse)  # fmt: skip


FIELDS = (
    "sequences", "difference", "low", "high", "p", "better_here", "better", "above", "below"
)  # fmt: skip


@pytest.mark.parametrize(
    "members",
    [
        [member(8) for _ in range(7)],
        [member(60) for _ in range(4)],
        [member(20, absent=0.2, nan=0.1) for _ in range(6)],
        [member(9, absent=0.3), *(member(9, 4) for _ in range(3)), member(9, 2), member(9, 4)],
        [member(3, absent=0.7) for _ in range(7)],
        [member(1) for _ in range(3)],
    ],
)
@pytest.mark.parametrize("held", [2, 256])
def test_pairs_are_what_each_is_alone(
    members: list[Member], held: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pairs, "_MEMBERS", held)
    found = pairs_of(members, 3, RESAMPLES)
    expected = [
        (i, j, values)
        for (i, a), (j, b) in combinations(enumerate(members), 2)
        if (values := pair(a, b, 3)) is not None
    ]
    assert [*zip(found.a, found.b)] == [(i, j) for i, j, _ in expected]
    for place, (_, _, values) in enumerate(expected):
        for name, value in zip(FIELDS, values):
            np.testing.assert_equal(getattr(found, name)[place], value, name)
    assert found.p_holm.tolist() == holm(found.p.tolist())


def test_a_margin_that_is_rounded_to_none_counts_half() -> None:
    assert superiority(np.array([0.1, -0.1, 1e-13, -4e-13])) == 0.5
    assert superiority(np.array([0.1, 0.1, 0.1, -6e-13])) == 0.75
