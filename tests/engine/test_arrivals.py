"""Frames that arrive at times of their own: schedules against an independent loop in Fractions."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest
from arriving import Arriving, arriving
from hypothesis import given, settings
from hypothesis import strategies as st

from lae_sim.engine.arrivals import FrameTime, with_arrivals
from lae_sim.engine.clock import MAX_INT64, Clock
from lae_sim.engine.lanes import simulate_lanes
from lae_sim.engine.policies import every, fifo, latest, listed, shrinking_tail, vot_realtime
from lae_sim.engine.scheduler import Call, Policy, simulate
from lae_sim.engine.times import Times
from lae_sim.errors import LaeError

POLICIES: dict[str, Policy] = {
    "latest": latest,
    "every1": fifo,
    "every3": every(3),
    "tail9": shrinking_tail(ns=9),
    "tail23": shrinking_tail(ns=23),
    "vot": vot_realtime(1),
}
EVEN = Clock.at(Fraction(25))  # 40 ms a frame, whole ns
MS = 1_000_000


@given(arriving(), st.sampled_from(sorted(POLICIES)))
@settings(max_examples=150)
def test_schedules_agree_with_the_fractions(world: Arriving, policy: str) -> None:
    clock = with_arrivals(Clock.at(world.fps), world.arrival_ns)
    length = len(world.arrival_ns)
    schedule = simulate(length, clock, world.elapsed_ns.__getitem__, POLICIES[policy])
    second = clock.ticks_per_ns * 10**9
    starts = [Fraction(tick, second) for tick in schedule.start.tolist()]
    readies = [Fraction(tick, second) for tick in schedule.ready.tolist()]
    assert list(zip(schedule.frames.tolist(), starts, readies)) == world.calls(policy)
    assert Fraction(clock.end(length), second) == world.end


@given(arriving(), st.integers(0, 200))
def test_a_clock_knows_each_arrival_and_the_newest_frame(world: Arriving, tick: int) -> None:
    clock = with_arrivals(Clock.at(world.fps), world.arrival_ns)
    length = len(world.arrival_ns)
    second = clock.ticks_per_ns * 10**9
    beyond = [clock.arrival(frame) for frame in range(length + 3)]
    assert [Fraction(each, second) for each in beyond] == [
        world.arrival(frame) for frame in range(length + 3)
    ]
    assert clock.newest(tick) == world.newest(Fraction(tick, second))
    assert clock.arrival(np.arange(length)).tolist() == beyond[:length]
    assert [clock.frame_time(frame) for frame in range(length)] == [
        float(world.arrival(frame) / world.interval) for frame in range(length)
    ]


@given(st.lists(arriving(fps=Fraction(10**9, 7)), min_size=8, max_size=10), st.booleans())
@settings(max_examples=15)
def test_lanes_are_the_schedules_one_by_one(worlds: list[Arriving], some_even: bool) -> None:
    nominal = Clock.at(worlds[0].fps)
    clocks = [with_arrivals(nominal, world.arrival_ns) for world in worlds]
    if some_even:
        clocks[::2] = [nominal] * len(clocks[::2])
    times = [Times("a", np.array(world.elapsed_ns)) for world in worlds]
    lengths = [len(world.arrival_ns) for world in worlds]
    found = list(simulate_lanes(lengths, clocks, times, latest))
    for length, clock, service, schedule in zip(lengths, clocks, times, found):
        alone = simulate(length, clock, service, latest)
        assert schedule.clock == clock
        for name in ("frames", "start", "ready"):
            assert getattr(schedule, name).tolist() == getattr(alone, name).tolist()


def test_even_arrivals_make_the_even_clock() -> None:
    assert with_arrivals(EVEN, [40 * MS * i for i in range(100)]) is not None
    assert with_arrivals(EVEN, [40 * MS * i for i in range(100)]) == EVEN
    assert with_arrivals(EVEN, None) is EVEN
    third = Clock.at(Fraction(30))  # 33 333 333 1/3 ns: none but multiples of 3 are exact
    assert with_arrivals(third, [0, 33_333_333]) != third
    assert with_arrivals(third, [0]) == third


def test_clocks_of_other_arrivals_differ() -> None:
    one, other = (with_arrivals(EVEN, [0, ns]) for ns in (50 * MS, 60 * MS))
    assert len({one, other, EVEN}) == 3
    assert not one.is_even
    assert EVEN.is_even
    assert repr(one) == "<Clock at 25 fps, 2 arrival times>"


@pytest.mark.parametrize(
    ("arrivals", "said"),
    [
        ([5, 6], "ascend from 0"),
        ([0, 7, 7], "ascend from 0"),
        ([0, 9, 8], "ascend from 0"),
        ([], "whole nanoseconds, one a frame"),
        ([0.0, 0.1], "whole nanoseconds, one a frame"),
        ([[0, 1]], "whole nanoseconds, one a frame"),
        ([0, MAX_INT64 // 25], "beyond 64-bit ticks"),
    ],
)
def test_arrivals_that_cannot_be(arrivals: list[int], said: str) -> None:
    with pytest.raises(LaeError, match=said):
        with_arrivals(EVEN, arrivals)


def test_the_last_instant_that_fits() -> None:
    clock = with_arrivals(Clock(25, 10**9), [0, (MAX_INT64 - 10**9) // 25])
    assert clock.end(2) <= MAX_INT64


def test_a_clock_is_of_one_sequence() -> None:
    clock = with_arrivals(EVEN, [0, 80 * MS])
    with pytest.raises(LaeError, match="3 frames, but arrival times of 2"):
        simulate(3, clock, lambda frame: 0, latest)


def test_a_policy_that_counts_intervals_is_told_whom_to_ask() -> None:
    def mine(clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        last, _, now = calls[-1]
        return last + 1, max(now, (last + 1) * clock.frame_ticks)

    assert len(simulate(3, EVEN, lambda frame: 0, mine).frames) == 3
    with pytest.raises(LaeError, match=r"cannot start a frame before clock\.arrival\(frame\)"):
        simulate(3, with_arrivals(EVEN, [0, 40 * MS, 160 * MS]), lambda frame: 0, mine)


def test_a_frames_time_is_its_number_as_an_index() -> None:
    frame = FrameTime(2.5, 1)
    assert (frame - 2, frame * 2) == (0.5, 5.0)
    for same in (frame, copy.deepcopy(frame), pickle.loads(pickle.dumps(frame))):
        assert ["a", "b"][same] == "b"
        assert np.array([[1, 2], [3, 4]])[same].tolist() == [3, 4]
        assert same == 2.5


def test_listed_frames_wait_for_their_arrival() -> None:
    clock = with_arrivals(EVEN, [0, 40 * MS, 160 * MS])
    schedule = simulate(3, clock, lambda frame: 0, listed([0, 2]))
    assert (schedule.start // clock.ticks_per_ns).tolist() == [0, 160 * MS]
