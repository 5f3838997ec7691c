"""Readings in the background, and means over the calls of a tracker."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from itertools import count
from time import perf_counter_ns

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.profile.sampler import Sampler, mean_over
from lae_sim.profile.sensors import Sensor

S = 10**9


def sensor(read: object = lambda: 1.0, **more: object) -> Sensor:
    return Sensor("it", "power", read, **more)  # type: ignore[arg-type]


def over(
    spans: list[tuple[float, float]],
    read: list[tuple[float, float]],
    of: Sensor = sensor(),  # noqa: B008
) -> float | None:
    """The mean over spans, s, of readings at times, s."""
    at, values = np.array(read, float).reshape(-1, 2).T
    spans_ns = np.array(np.array(spans) * S, np.int64)
    return mean_over(spans_ns, (at * S).astype(np.int64), values, of)


def test_of_few_readings_power_goes_straight_from_one_to_the_next() -> None:
    ramp = [(0.0, 0.0), (1.0, 10.0)]
    assert over([(0, 1)], ramp) == pytest.approx(5)
    assert over([(0, 0.5), (0.5, 1)], ramp) == pytest.approx(5)
    # the integral over a reading's interval counts evenly in it
    assert over([(0.0, 0.5)], [(0, 4), (1, 4), (1.5, 100)]) == pytest.approx(4)


def test_only_calls_count() -> None:
    steps = [(0, 2), (1, 2), (1.001, 20), (2, 20), (2.001, 2), (3, 2)]
    assert over([(1.1, 1.3), (1.5, 1.9)], steps) == pytest.approx(20)
    assert over([(0.1, 0.3), (2.5, 2.9)], steps) == pytest.approx(2)


def test_a_counter_that_starts_at_zero_again() -> None:
    counter = sensor(counts=True, wraps_at=100.0)
    assert over([(0, 3)], [(0, 90), (1, 97), (2, 4), (3, 11)], counter) == pytest.approx(7)
    forever = sensor(counts=True)
    assert over([(0, 3)], [(0, 90), (1, 97), (2, 4), (3, 11)], forever) == pytest.approx(7)


def test_a_sensor_that_failed_is_told_where_it_was_read_half_of_the_time() -> None:
    nan = float("nan")
    early = [(t / 10, 5.0 if t < 35 else nan) for t in range(60)]
    assert over([(0, 6)], early) == pytest.approx(5)
    late = [(t / 10, 5.0 if t > 35 else nan) for t in range(60)]
    assert over([(0, 6)], late) is None
    assert over([(0, 1)], [(0.0, nan), (1.0, nan)]) is None
    # a power says nothing of a long time, the counter of an energy does
    apart = [(0.0, 5.0), (60.0, 65.0)]
    assert over([(0, 60)], apart) is None
    assert over([(0, 60)], apart, sensor(counts=True)) == pytest.approx(1)


@given(
    st.lists(st.tuples(st.floats(0.002, 0.3), st.floats(0.002, 0.3)), min_size=8, max_size=30),
    st.floats(0, 50),
    st.floats(0, 50),
    st.integers(0, 2**32),
)
def test_what_is_taken_between_calls_is_told_apart(
    work: list[tuple[float, float]], during: float, between: float, seed: int
) -> None:
    """A device of two powers; that of calls is found whatever the other is."""
    edges = np.cumsum(np.array(work).ravel())  # pause, call, pause, call ...
    spans = edges.reshape(-1, 2)
    chance = np.random.default_rng(seed)
    at = np.concatenate([[0.0], np.sort(chance.uniform(0, edges[-1], 40)), edges[-1:]])
    in_call = np.searchsorted(edges, at, side="right") % 2 == 1
    called = [np.clip(t - spans[:, 0], 0, np.diff(spans)[:, 0]).sum() for t in at]
    joules = np.maximum.accumulate(between * at + (during - between) * np.array(called))
    wrapped = sensor(counts=True, wraps_at=2000.0)
    found = over(spans.tolist(), list(zip(at, joules % 2000)), wrapped)
    assert found == pytest.approx(during, abs=0.01 * abs(during - between) + 1e-6)
    if in_call.sum() >= 5:
        power = np.where(in_call, during, between)
        assert over(spans.tolist(), list(zip(at, power))) == pytest.approx(during)


def test_steps_that_are_alike_are_told_as_they_are() -> None:
    """Nothing says how calls and pauses share in them, but that both were there."""
    spans = [(t + 0.25, t + 0.75) for t in range(10)]
    steps = [(t, 8.0 * t) for t in range(11)]
    assert over(spans, steps, sensor(counts=True)) == pytest.approx(8)


def test_a_thread_reads_until_the_end() -> None:
    numbers = count()
    with Sampler([sensor(lambda: float(next(numbers)), counts=True)], interval_s=0.002) as sampler:
        sampler.clear()
        start = perf_counter_ns()
        time.sleep(0.1)
        (rate,) = sampler.means(np.array([[start, perf_counter_ns()]])).values()
        assert threading.active_count() > 1
    assert 20 < rate < 2000
    readings = sampler.readings
    time.sleep(0.02)
    assert sampler.readings == readings
    assert sampler.failures == {}


def test_no_sensors_no_thread() -> None:
    before = threading.active_count()
    with Sampler([]) as sampler:
        assert threading.active_count() == before
        sampler.clear()
        assert sampler.means(np.array([[0, S]])) == {}
        assert sampler.rest(60) == {}


def test_a_sensor_that_fails_midway_harms_no_other() -> None:
    def failing() -> Iterator[float]:
        yield from [7.0] * 3
        raise OSError("gone")

    words = failing()
    sensors = [Sensor("bad", "power", lambda: next(words)), Sensor("good", "power", lambda: 3.0)]
    with Sampler(sensors, interval_s=0.001) as sampler:
        sampler.clear()
        start = perf_counter_ns()
        while sampler.readings < 30:
            time.sleep(0.001)
        means = sampler.means(np.array([[start, perf_counter_ns()]]))
        unread = sampler.unread()
    assert means == {"good": pytest.approx(3)}
    assert set(unread) == set(sampler.failures) == {"bad"}
    assert unread["bad"] > 0.5
    assert sampler.failures["bad"] >= 27


def test_a_sensor_that_hangs_is_waited_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lae_sim.profile.sampler.PATIENCE_S", 0.05)
    released = threading.Event()

    def hanging() -> float:
        released.wait(20)
        return 1.0

    started = time.monotonic()
    with Sampler([sensor(hanging)]) as sampler:
        for _ in range(100):
            sampler.clear()
            assert sampler.means(np.array([[0, S]])) == {}
    assert time.monotonic() - started < 3
    assert sampler.failures == {"it": 1}
    released.set()


def test_slow_readings_are_fewer() -> None:
    def busy() -> float:
        until = time.thread_time() + 0.002
        while time.thread_time() < until:
            pass
        return 1.0

    with Sampler([sensor(busy)], interval_s=0.001) as sampler:
        time.sleep(0.5)
    assert sampler.readings <= 4  # 2 ms of CPU time each, a share of 0.5 %: 0.4 s apart
