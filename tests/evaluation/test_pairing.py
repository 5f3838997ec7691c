"""Pairing of outputs and queries, for one sigma and for many at once."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import SIGMAS, psi, schedule_latest, worlds

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, latest, vot_realtime
from lae_sim.engine.scheduler import Schedule, simulate
from lae_sim.errors import LaeError
from lae_sim.evaluation.pairing import Pairing, histories, pair, pairs, ranges
from lae_sim.replay.world import SIGMA_GRID

World = tuple[Fraction, list[int], list[list[float]]]
CLOCK = Clock.at(Fraction(25))  # 40 ms a frame
ZERO = [Fraction(0)]


def schedule_of(world: World) -> Schedule:
    fps, elapsed, _ = world
    return simulate(len(elapsed), Clock.at(fps), elapsed.__getitem__, latest)


def psis(pairing: Pairing, sequence: int, m: int) -> list[int]:
    """psi of each world frame, from the ranges that the outputs answer."""
    span = slice(*pairing.offsets[sequence : sequence + 2])
    sizes = (pairing.end - pairing.first)[span, m]
    assert (sizes >= 0).all()
    found = np.repeat(pairing.frames[span], sizes)
    assert len(found) == pairing.lengths[sequence]
    return found.tolist()


@st.composite
def several_worlds(draw: st.DrawFn) -> list[World]:
    """One to three sequences of one frame rate."""
    first = draw(worlds())
    others = draw(st.lists(worlds(), max_size=2))
    return [first] + [(first[0], elapsed, boxes) for _, elapsed, boxes in others]


@given(several_worlds(), SIGMAS)
@settings(max_examples=50)
def test_pairing_agrees_with_the_fractions(group: list[World], sigmas: list[Fraction]) -> None:
    pairing = pair([schedule_of(world) for world in group], sigmas)
    for s, (fps, elapsed, _) in enumerate(group):
        done = schedule_latest(fps, elapsed)
        for m, sigma in enumerate(sigmas):
            expected = psi(done, fps, len(elapsed), sigma)
            assert psis(pairing, s, m) == expected
            lags = [i - source for i, source in enumerate(expected)]
            runs = [expected.count(source) for source in set(expected)]
            assert pairing.mismatch_sum[s, m] == sum(lags)
            assert pairing.mismatch_max[s, m] == max(lags)
            assert pairing.longest_hold[s, m] == max(runs)


@given(several_worlds(), SIGMAS, st.booleans())
@settings(max_examples=40)
def test_histories_and_pairs_list_each_fed_output_and_each_pair(
    group: list[World], sigmas: list[Fraction], memoryless: bool
) -> None:
    pairing = pair([schedule_of(world) for world in group], sigmas)
    fed = histories(pairing, memoryless)
    found = pairs(pairing, fed)
    for s, (fps, elapsed, _) in enumerate(group):
        done = schedule_latest(fps, elapsed)
        for m, sigma in enumerate(sigmas):
            of_sigma = [
                h
                for h in range(len(fed.sequence))
                if fed.sequence[h] == s and fed.sigma_from[h] <= m < fed.sigma_to[h]
            ]
            assert len(of_sigma) == 1
            span = range(*fed.offsets[of_sigma[0] : of_sigma[0] + 2])
            expected = psi(done, fps, len(elapsed), sigma)
            outputs = pairing.frames[fed.output[span]].tolist()
            if memoryless:
                assert outputs == [frame for frame, _, _ in done]
            else:
                assert outputs == sorted({0, *expected})
            told = {
                int(frame): int(pairing.frames[fed.output[item]])
                for item, frame, low, high in zip(
                    found.item, found.frame, found.sigma_from, found.sigma_to
                )
                if item in span and low <= m < high
            }
            assert [told[i] for i in range(len(elapsed))] == expected
    assert (np.diff(found.item) >= 0).all()
    keys = list(zip(found.item.tolist(), found.frame.tolist()))
    assert len(set(keys)) == len(keys)


@given(worlds(), SIGMAS)
@settings(max_examples=30)
def test_at_arrival_latency_plays_no_part(world: World, sigmas: list[Fraction]) -> None:
    schedule = schedule_of(world)
    pairing = pair([replace(schedule, scores_latency=False)], sigmas)
    for m, sigma in enumerate(sigmas):
        expected = [
            max([0, *(int(f) for f in schedule.frames if f <= i + sigma)])
            for i in range(schedule.length)
        ]
        assert psis(pairing, 0, m) == expected


COSTS = st.one_of(
    st.sampled_from([0, 1, 33_333_333, 33_333_334, 40_000_000]), st.integers(0, 200_000_000)
)


@given(several_worlds(), SIGMAS, COSTS)
@settings(max_examples=25)
def test_what_an_answer_costs_delays_it(
    group: list[World], sigmas: list[Fraction], cost_ns: int
) -> None:
    schedules = [schedule_of(world) for world in group]
    found = pair(schedules, sigmas, cost_ns=cost_ns)
    for s, (fps, elapsed, _) in enumerate(group):
        cost = Fraction(cost_ns, 10**9)
        done = [
            (frame, start, ready + cost) for frame, start, ready in schedule_latest(fps, elapsed)
        ]
        for m, sigma in enumerate(sigmas):
            assert psis(found, s, m) == psi(done, fps, len(elapsed), sigma)
    ticks = cost_ns * schedules[0].clock.ticks_per_ns
    later = [replace(s, start=s.start + ticks, ready=s.ready + ticks) for s in schedules]
    for name, expected in vars(pair(later, sigmas)).items():
        np.testing.assert_array_equal(getattr(found, name), expected)


def test_a_cost_beyond_the_clock_is_refused() -> None:
    schedule = simulate(4, CLOCK, lambda frame: 47_000_000, latest)
    assert psis(pair([schedule], ZERO, cost_ns=10**17), 0, 0) == [0] * 4
    with pytest.raises(LaeError, match="cannot cost 1e\\+21 ns"):
        pair([schedule], ZERO, cost_ns=10**21)


def test_where_latency_is_not_scored_a_cost_is_not_either() -> None:
    schedule = simulate(9, CLOCK, lambda frame: 47_000_000, latest)
    schedule = replace(schedule, scores_latency=False)
    free, dear = (pair([schedule], ZERO, cost) for cost in (0, 10**9))
    np.testing.assert_array_equal(free.first, dear.first)


def test_equality_counts() -> None:
    exactly = simulate(4, CLOCK, lambda frame: 40_000_000, latest)
    assert psis(pair([exactly], ZERO), 0, 0) == [0, 0, 1, 2]
    late = simulate(4, CLOCK, lambda frame: 40_000_001, latest)
    assert psis(pair([late], ZERO), 0, 0) == [0, 0, 0, 1]


def test_before_any_output_frame_0_answers() -> None:
    slow = simulate(4, CLOCK, lambda frame: 10**12, latest)
    pairing = pair([slow], [Fraction(-1), Fraction(0), Fraction(1)])
    assert [psis(pairing, 0, m) for m in range(3)] == [[0, 0, 0, 0]] * 3


def test_eta_is_minus_sigma() -> None:
    schedule = simulate(6, CLOCK, lambda frame: 40_000_000, latest)
    pairing = pair([schedule], [Fraction(-1), Fraction(0), Fraction(1, 2), Fraction(1)])
    assert psis(pairing, 0, 0) == [0, 0, 0, 1, 2, 3]
    assert psis(pairing, 0, 1) == [0, 0, 1, 2, 3, 4]
    assert psis(pairing, 0, 2) == [0, 0, 1, 2, 3, 4]
    assert psis(pairing, 0, 3) == [0, 1, 2, 3, 4, 5]


def test_an_output_overtaken_between_two_queries_is_never_fed() -> None:
    # queries are at 0, 40, 80, 120 ms; the middle sequence's frame 1 is ready at 45 and overtaken
    # at 50; the sequences beside it show that histories do not mix
    schedule = simulate(4, CLOCK, lambda frame: 10_000_000, latest)
    dense = Schedule(
        CLOCK,
        4,
        np.array([0, 1, 2]),
        np.array([0, 41, 45]) * 25_000_000,
        np.array([40, 45, 50]) * 25_000_000,
    )
    pairing = pair([schedule, dense, schedule], ZERO)
    fed = histories(pairing)
    fed_frames = [
        pairing.frames[fed.output[a:b]].tolist() for a, b in zip(fed.offsets, fed.offsets[1:])
    ]
    assert fed_frames == [[0, 1, 2], [0, 2], [0, 1, 2]]


def test_sigmas_that_see_the_same_outputs_share_a_history() -> None:
    schedule = simulate(30, CLOCK, lambda frame: 47_000_000, latest)
    fed = histories(pair([schedule], SIGMA_GRID))
    assert len(fed.sequence) < len(SIGMA_GRID)
    assert (fed.sigma_from[0], fed.sigma_to[-1]) == (0, 51)
    assert (fed.sigma_from[1:] == fed.sigma_to[:-1]).all()


def test_the_grid_of_pvt_plus_plus() -> None:
    assert SIGMA_GRID[:2] == (0, Fraction(2, 100))
    assert SIGMA_GRID[-1] == 1
    assert len(SIGMA_GRID) == 51


@pytest.mark.parametrize("years", [1, 9, 69, 200])
@pytest.mark.parametrize("sigma", [Fraction(-5), Fraction(0), Fraction(1, 50), Fraction(1000)])
def test_an_output_that_is_ready_years_later_answers_nothing(years: int, sigma: Fraction) -> None:
    clock = Clock.at(Fraction(1))
    late = simulate(9, clock, lambda frame: years * 31_536_000 * 10**9 if frame else 0, latest)
    assert psis(pair([late], [sigma]), 0, 0) == [0] * 9


@pytest.mark.parametrize(
    "sigmas",
    [
        [Fraction(1, 10**12), Fraction(1, 10**12 + 1)],
        [Fraction(10**12 + 1, 10**11), Fraction(10**15)],
        [Fraction(2**63)],
        [Fraction(-(2**63))],
    ],
)
def test_sigmas_beyond_64_bits_are_refused(sigmas: list[Fraction]) -> None:
    schedule = simulate(4, CLOCK, lambda frame: 47_000_000, latest)
    with pytest.raises(LaeError, match="64-bit"):
        pair([schedule], sorted(sigmas))


def test_the_finest_sigma_that_fits_is_exact() -> None:
    # one tick of the clock is 1 / frame_ticks of a frame
    schedule = simulate(3, CLOCK, lambda frame: 40_000_001, latest)
    late = Fraction(50, CLOCK.frame_ticks)  # frame 1 is ready 2 ns after frame 2 arrives
    pairing = pair([schedule], [late - Fraction(1, CLOCK.frame_ticks), late])
    assert psis(pairing, 0, 0) == [0, 0, 0]
    assert psis(pairing, 0, 1) == [0, 0, 1]


def test_a_vot_schedule_is_scored_at_arrival() -> None:
    schedule = simulate(6, CLOCK, lambda frame: 100_000_000, vot_realtime(0))
    assert schedule.frames.tolist() == [0, 2, 4]
    assert psis(pair([schedule], ZERO), 0, 0) == [0, 0, 2, 2, 4, 4]


def test_overlapping_calls_are_scored_by_the_newest_frame_that_is_ready_or_refused() -> None:
    # Frame 1 is ready at 540 ms, long after frame 2 at 90 ms: vot_realtime lets calls overlap.
    stall = [0, 500_000_000, 10_000_000, 10_000_000, 10_000_000, 10_000_000]
    schedule = simulate(6, CLOCK, stall.__getitem__, vot_realtime(3))
    schedule = replace(schedule, scores_latency=True)
    assert schedule.frames.tolist() == [0, 1, 2, 3, 4, 5]
    try:
        pairing = pair([schedule], ZERO)
    except LaeError:
        return
    assert psis(pairing, 0, 0) == [0, 0, 0, 2, 3, 4]
    assert pairing.mismatch_sum.tolist() == [[0 + 1 + 2 + 1 + 1 + 1]]


def test_a_stride_ages_between_its_outputs() -> None:
    schedule = simulate(7, CLOCK, lambda frame: 10_000_000, every(3))
    pairing = pair([schedule], ZERO)
    assert psis(pairing, 0, 0) == [0, 0, 0, 0, 3, 3, 3]
    assert (pairing.mismatch_max.item(), pairing.longest_hold.item()) == (3, 4)


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 5)), max_size=8))
@settings(max_examples=40)
def test_ranges(parts: list[tuple[int, int]]) -> None:
    starts = np.array([start for start, _ in parts], np.int64)
    sizes = np.array([size for _, size in parts], np.int64)
    expected = [start + i for start, size in parts for i in range(size)]
    assert ranges(starts, sizes).tolist() == expected
