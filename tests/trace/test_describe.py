"""Statistics of times: each number against one worked out by hand or made on purpose."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.trace import describe as timing
from lae_sim.trace.describe import SequenceTimes
from lae_sim.trace.recording import Recording

MS = 10**6


def times(name: str, ms: np.ndarray | list[float], init_ms: float = 100) -> SequenceTimes:
    ns = (np.asarray(ms, float) * MS).astype(np.int64)
    return SequenceTimes(name, int(init_ms * MS), np.arange(1, len(ns) + 1, dtype=np.int32), ns)


def test_a_recording_gives_its_initialisation_and_its_calls() -> None:
    boxes = np.zeros((5, 4))
    found = SequenceTimes.of(Recording.new("a", boxes, boxes, [90, -1, 20, -1, 30]))
    assert (found.name, found.init_ns) == ("a", 90)
    assert (found.frames.tolist(), found.elapsed_ns.tolist()) == ([2, 4], [20, 30])


def test_stages_of_the_calls_and_what_is_left() -> None:
    boxes = np.zeros((5, 4))
    stages = {
        "learn": [9, 0, 20, -1, 0],
        "decode": [9, 10, 10, 10, -1],
        "inference": [-1, 10, 30, -1, -1],
    }
    ns = {
        name: np.array(times) * np.where(np.array(times) < 0, 1, MS)
        for name, times in stages.items()
    }
    first = Recording.new("a", boxes, boxes, np.array([90, 40, 80, 10, 50]) * MS, stages=ns)
    other = Recording.new("b", boxes, boxes, np.array([90, 40, -1, -1, -1]))
    found = timing.stage_times([SequenceTimes.of(r) for r in (first, other)])
    shown = [(row["stage"], row["n"], row["median_ms"], row["share"]) for row in found]
    assert shown == [
        ("decode", 3, 10, pytest.approx(30 / 130)),
        ("inference", 2, 20, pytest.approx(40 / 120)),
        ("learn", 3, 0, pytest.approx(20 / 170)),
        (None, 4, 20, pytest.approx((20 + 20 + 0 + 50) / 180)),
    ]
    assert found[1]["p95_ms"] == pytest.approx(29)
    assert found[1]["mean_ms"] == 20
    assert timing.stage_times([SequenceTimes.of(other)]) == []


def test_the_summary() -> None:
    found = timing.summary(np.arange(1, 101) * MS)
    assert found["n"] == 100
    assert (found["mean_ms"], found["median_ms"], found["max_ms"]) == (50.5, 50.5, 100)
    assert (found["p90_ms"], found["p99_ms"]) == pytest.approx((90.1, 99.01))
    assert found["fps"] == pytest.approx(1000 / 50.5)
    assert timing.summary(np.zeros(0, np.int64)) == {"n": 0}
    assert "fps" not in timing.summary(np.zeros(3, np.int64))


def test_slower_than_the_frames_is_exact() -> None:
    ns = np.array([33_333_333, 33_333_334])  # 1/30 s lies between
    assert timing.share_slower(ns, Fraction(30)) == 0.5
    assert timing.share_slower(np.array([10**8]), Fraction(10)) == 0  # as long is not longer
    assert timing.share_slower(ns[:0], Fraction(30)) == 0


@given(
    st.lists(st.one_of(st.integers(1000, 10**11), st.integers(10**7, 2 * 10**7)), min_size=1),
    st.integers(40, 300),
)
def test_every_time_is_in_the_histogram_once(ns: list[int], copies: int) -> None:
    values = np.array(ns * copies, np.int64)
    found = timing.histogram(values)
    edges = np.array(found["edges_ms"])
    assert sum(found["counts"]) + found["below"] + found["above"] == len(values)
    assert (np.diff(edges) > 0).all()
    assert 1 <= len(found["counts"]) <= 20
    inside = (values / MS >= edges[0]) & (values / MS <= edges[-1])
    assert sum(found["counts"]) == inside.sum()
    assert inside.mean() >= 0.9


def test_histograms_leave_outliers_outside_of_round_bins() -> None:
    ms = np.concatenate([np.linspace(12, 18, 995), np.full(5, 14_000.0)])
    found = timing.histogram((ms * MS).astype(np.int64))
    assert found["edges_ms"] == np.arange(12, 18.5, 0.5).tolist()
    assert (found["below"], found["above"]) == (0, 5)


def test_histograms_of_wide_times_have_growing_bins() -> None:
    found = timing.histogram((np.geomspace(1, 100, 1000) * MS).astype(np.int64))
    assert found["edges_ms"][:4] == [1.0, 1.5, 2.1, 3.0]
    assert found["edges_ms"][-1] == 96


def test_constant_times_have_one_bin() -> None:
    found = timing.histogram(np.full(50, 47 * MS))
    assert (found["counts"], found["below"], found["above"]) == ([50], 0, 0)


def noisy(ms: float, calls: int, seed: int) -> np.ndarray:
    return ms * np.random.default_rng(seed).lognormal(0, 0.15, calls)


@pytest.mark.parametrize("count", [1, 3, 30])
def test_a_tracker_that_becomes_slower_is_found(count: int) -> None:
    growth = 1 + np.linspace(0, 0.4, 3000)
    run = np.array_split(noisy(20, 3000, count) * growth, count)
    found = timing.drift([times(str(i), part) for i, part in enumerate(run)])
    assert found["slower"]
    assert found["ratio"] == pytest.approx(1.333 / 1.067, rel=0.06)  # means of thirds
    assert found["tenths_ms"] == sorted(found["tenths_ms"])


@pytest.mark.parametrize("count", [1, 3, 30])
def test_a_steady_tracker_is_not_called_slower(count: int) -> None:
    for seed in range(20):
        run = np.array_split(noisy(20, 3000, seed), count)
        found = timing.drift([times(str(i), part) for i, part in enumerate(run)])
        assert not found["slower"]


def test_sequences_of_unlike_cost_are_no_drift_but_by_bad_luck() -> None:
    alarms = 0
    for seed in range(100):
        cost = np.random.default_rng(seed).lognormal(3, 1, 45)
        run = [times(str(i), noisy(ms, 40, i)) for i, ms in enumerate(cost)]
        alarms += timing.drift(run)["slower"]
    assert alarms <= 5  # 1 % is meant


def test_few_calls_say_nothing_of_drift() -> None:
    assert timing.drift([times("a", np.full(99, 5.0))]) == {}
    assert timing.drift([]) == {}


def test_first_calls() -> None:
    run = [
        times("a", [90, 5, 5, 5]),
        times("b", [60, 3, 3]),
        times("c", [40, 4, 4]),
        times("d", []),
    ]
    assert timing.first_calls(run) == {"median_ms": 60, "ratio": 18}
    assert timing.first_calls([times("a", [5])]) == {}


def test_stalls_are_named_longest_first() -> None:
    run = [times("a", [800, *[5] * 20]), times("b", [5] * 10 + [14_000] + [5] * 9)]
    assert timing.stalls(run) == [
        {"sequence": "b", "frame": 11, "ms": 14_000, "first_call": False},
        {"sequence": "a", "frame": 1, "ms": 800, "first_call": True},
    ]


def test_a_costly_sequence_is_no_stall() -> None:
    assert timing.stalls([times("a", [5] * 50), times("large", [80] * 20), times("e", [])]) == []
