"""Scheduling policies: exact schedules, and independent statements of two of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import RATES, SECOND, times

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import (
    LanePolicy,
    every,
    fifo,
    latest,
    shrinking_tail,
    vot_realtime,
)
from lae_sim.engine.scheduler import Policy, simulate
from lae_sim.errors import LaeError

MS = 1_000_000
CLOCK = Clock.at(Fraction(25))  # 40 ms a frame
TICKS_PER_MS = 25 * MS


def run(elapsed_ms: Sequence[int], policy: Policy) -> list[tuple[int, float, float]]:
    """(frame, start, ready) in ms of a world with one frame each 40 ms."""
    schedule = simulate(len(elapsed_ms), CLOCK, lambda i: elapsed_ms[i] * MS, policy)
    rows = zip(schedule.frames.tolist(), schedule.start.tolist(), schedule.ready.tolist())
    return [(f, start / TICKS_PER_MS, ready / TICKS_PER_MS) for f, start, ready in rows]


@pytest.mark.parametrize(
    ("policy", "elapsed_ms", "expected"),
    [
        (latest, [10] * 4, [(0, 0, 10), (1, 40, 50), (2, 80, 90), (3, 120, 130)]),
        # free exactly as frame 1 arrives: it starts at once
        (latest, [40] * 3, [(0, 0, 40), (1, 40, 80), (2, 80, 120)]),
        (latest, [50, 50, 50, 10, 10], [(0, 0, 50), (1, 50, 100), (2, 100, 150), (3, 150, 160)]
         + [(4, 160, 170)]),
        (latest, [130, 0, 0, 39, 10], [(0, 0, 130), (3, 130, 169), (4, 169, 179)]),
        (latest, [200, 10, 10, 10, 10], [(0, 0, 200)]),
        (latest, [199, 10, 10, 10, 10], [(0, 0, 199), (4, 199, 209)]),
        (fifo, [100, 10, 10, 10], [(0, 0, 100), (1, 100, 110), (2, 110, 120), (3, 120, 130)]),
        (fifo, [70] * 4, [(0, 0, 70), (1, 70, 140), (2, 140, 210)]),
        (fifo, [10] * 2, [(0, 0, 10), (1, 40, 50)]),
        (every(2), [10] * 5, [(0, 0, 10), (2, 80, 90), (4, 160, 170)]),
        (every(2), [100] * 5, [(0, 0, 100), (2, 100, 200)]),
        (every(3), [10] * 5, [(0, 0, 10), (3, 120, 130)]),
        (every(9), [10] * 5, [(0, 0, 10)]),
        # r = 60: free at 70, tail 30 of 40; 70 + 60 = 130, tail 10 < 30: wait for frame 2 at 80
        (shrinking_tail(ns=60 * MS), [70] + [60] * 4, [(0, 0, 70), (2, 80, 140), (4, 160, 220)]),
        # r = 60: free at 50, tail 10; 110 has tail 30: start frame 1 at once
        (shrinking_tail(ns=60 * MS), [50] + [60] * 3, [(0, 0, 50), (1, 50, 110), (3, 120, 180)]),
        # equal tails do not wait: r = 80
        (shrinking_tail(ns=80 * MS), [50] + [80] * 3, [(0, 0, 50), (1, 50, 130), (3, 130, 210)]),
        # a tracker as fast as the camera never waits
        (shrinking_tail(ns=40 * MS), [50] + [30] * 3,
         [(0, 0, 50), (1, 50, 80), (2, 80, 110), (3, 120, 150)]),
        # 60 over the interval of 40 owes 20, less than one interval: no frame is skipped
        (vot_realtime(0), [60] * 3, [(0, 0, 60), (1, 40, 100), (2, 80, 140)]),
        # owes exactly one interval: still none; one ms more skips one
        (vot_realtime(0), [80] * 3, [(0, 0, 80), (1, 40, 120), (2, 80, 160)]),
        (vot_realtime(0), [81] * 4, [(0, 0, 81), (2, 80, 161)]),
        (vot_realtime(1), [81] * 5, [(0, 0, 81), (1, 40, 121), (3, 120, 201)]),
    ],
)  # fmt: skip
def test_exact_schedules(
    policy: Policy, elapsed_ms: list[int], expected: list[tuple[int, float, float]]
) -> None:
    assert run(elapsed_ms, policy) == expected


def test_every_0_cannot_move_forward() -> None:
    with pytest.raises(LaeError, match="must move forward"):
        run([10] * 3, every(0))


def test_every_1_is_fifo() -> None:
    elapsed = [10, 90, 15, 3, 60, 10, 10, 200, 1]
    assert run(elapsed, every(1)) == run(elapsed, fifo)


@given(
    data=st.data(),
    fps=st.sampled_from(RATES).map(Fraction),
    policy=st.sampled_from(
        [
            latest,
            fifo,
            every(3),
            every(10**18),
            *(shrinking_tail(ns=r * MS) for r in (0, 47, 10**9)),
        ]
    ),
)
def test_a_policy_answers_for_lanes_as_for_each(
    data: st.DataObject, fps: Fraction, policy: LanePolicy
) -> None:
    clock = Clock.at(fps)
    last = data.draw(st.lists(st.integers(0, 500), min_size=1, max_size=9))
    # as it becomes free no sooner than the frame that it processed has arrived
    now = [i * clock.frame_ticks + data.draw(st.integers(0, 5 * clock.frame_ticks)) for i in last]
    found = policy.next_lanes(clock, np.array(last), np.array(now))
    alone = [policy(clock, [(i, i * clock.frame_ticks, t)]) for i, t in zip(last, now)]
    assert found.tolist() == [frame for frame, _ in alone]
    assert [start for _, start in alone] == [
        max(t, frame * clock.frame_ticks) for (frame, _), t in zip(alone, now)
    ]


# ------------------------------------------------------------------------------ shrinking tail


def tail(t: Fraction) -> Fraction:
    """Of an instant in frames: what has passed since the last arrival."""
    return t - math.floor(t)


@given(st.data(), st.sampled_from(RATES).map(Fraction))
@settings(max_examples=150)
def test_shrinking_tail_waits_iff_the_tail_shrinks(data: st.DataObject, fps: Fraction) -> None:
    ready_ns, expected_ns = data.draw(times(fps, 2))
    clock = Clock.at(fps)
    call = (0, 0, ready_ns * clock.ticks_per_ns)
    frame, start = shrinking_tail(ns=expected_ns)(clock, [call])
    s, r = ready_ns * fps / SECOND, expected_ns * fps / SECOND  # in frames
    waits = r > 1 and tail(s + r) < tail(s)
    expected = math.floor(s) + 1 if waits else max(math.floor(s), 1)
    assert frame == expected
    assert Fraction(start, clock.frame_ticks) == max(s, Fraction(expected))


@given(st.data(), st.sampled_from(RATES).map(Fraction), st.integers(1, 30))
def test_a_tracker_within_one_interval_never_waits(
    data: st.DataObject, fps: Fraction, length: int
) -> None:
    elapsed = data.draw(times(fps, length))
    interval = int(SECOND / fps)
    clock = Clock.at(fps)
    eager = simulate(length, clock, elapsed.__getitem__, latest)
    patient = simulate(length, clock, elapsed.__getitem__, shrinking_tail(ns=interval))
    assert patient.start.tolist() == eager.start.tolist()


# ------------------------------------------------------------------------- the VOT toolkit's rule


class VotTracker:
    """The real-time wrapper of the VOT toolkit, restated: what it owes, and the grace left."""

    def __init__(self, interval: Fraction, grace: int) -> None:
        self.interval, self.countdown = interval, grace
        self.owed = Fraction(0)

    def _account(self, time: int) -> None:
        self.owed = Fraction(0)
        if time > self.interval:
            if self.countdown > 0:
                self.countdown -= 1
            else:
                self.owed = time - self.interval

    def initialize(self, time: int) -> None:
        self._account(time)

    def update(self, time: int) -> bool:
        """Whether the frame is processed; otherwise the previous answer is repeated."""
        if self.owed > self.interval:
            self.owed -= self.interval
            return False
        self._account(time)
        return True


@given(st.data(), st.sampled_from(RATES).map(Fraction), st.integers(1, 30), st.integers(0, 3))
@settings(max_examples=200)
def test_vot_realtime_processes_the_frames_of_the_toolkit(
    data: st.DataObject, fps: Fraction, length: int, grace: int
) -> None:
    elapsed = data.draw(times(fps, length))
    tracker = VotTracker(SECOND / fps, grace)
    tracker.initialize(elapsed[0])
    processed = [0] + [i for i in range(1, length) if tracker.update(elapsed[i])]
    clock = Clock.at(fps)
    schedule = simulate(length, clock, elapsed.__getitem__, vot_realtime(grace))
    assert schedule.frames.tolist() == processed
    assert schedule.start.tolist() == [i * clock.frame_ticks for i in processed]


def test_the_grace_of_vot_is_3_by_default() -> None:
    assert run([100] * 12, vot_realtime()) == run([100] * 12, vot_realtime(3))
    assert [f for f, _, _ in run([100] * 12, vot_realtime())] == [0, 1, 2, 3, 5, 7, 9, 11]
