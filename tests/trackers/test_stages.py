"""Marks of stages: what is heard adds up, whatever a tracker does."""

from __future__ import annotations

import asyncio
import contextvars
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.errors import LaeError
from lae_sim.trackers import stage, stages
from lae_sim.trackers.stages import listening


class Clock:
    """A clock that moves when it is told to."""

    now = 0

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(stages, "perf_counter_ns", made)
    return made


def test_what_a_name_marks_adds_up(clock: Clock) -> None:
    with listening() as call:
        clock.now += 1000
        for _ in range(3):
            with stage("preprocess"):
                clock.now += 5
            clock.now += 70
        with stage("inference"):
            clock.now += 40
    assert call.ns == {"preprocess": 15, "inference": 40}


def test_a_stage_within_another_is_no_part_of_it(clock: Clock) -> None:
    with listening() as call, stage("outer"):
        clock.now += 1
        with stage("inner"):
            clock.now += 10
            with stage("outer"):
                clock.now += 100
        clock.now += 1000
    assert call.ns == {"outer": 1101, "inner": 10}


def test_the_same_mark_may_be_kept_and_used_again(clock: Clock) -> None:
    mark = stage("warp")
    with listening() as call:
        for _ in range(2):
            with mark:
                clock.now += 3
                with mark:
                    clock.now += 4
    assert call.ns == {"warp": 14}


def test_calls_are_apart_and_nobody_listens_between_them(clock: Clock) -> None:
    with stage("before"):
        clock.now += 1
    with listening() as first, stage("one"):
        clock.now += 2
    with stage("between"):
        clock.now += 3
    with listening() as second:
        pass
    assert (first.ns, second.ns) == ({"one": 2}, {})


def test_what_a_tracker_raises_ends_its_stages(clock: Clock) -> None:
    def track() -> None:
        with stage("a"), stage("b"):
            clock.now += 2
            raise ZeroDivisionError

    with listening() as call:
        with pytest.raises(ZeroDivisionError):
            track()
        clock.now += 50
        with stage("a"):
            clock.now += 1
    assert call.ns == {"a": 1, "b": 2}
    with pytest.raises(ZeroDivisionError), listening(), stage("c"):
        raise ZeroDivisionError
    assert stages._LISTENING.get() is None


def test_a_stage_may_begin_in_one_call_and_end_in_another(clock: Clock) -> None:
    mark = stage("long")
    with listening() as first:
        mark.__enter__()
        clock.now += 5
        with stage("short"):
            clock.now += 1
        clock.now += 7
    with listening() as second:
        mark.__exit__(None, None, None)
        with stage("short"):
            clock.now += 2
    assert first.ns == {"long": 5, "short": 1}  # up to the last mark
    assert second.ns == {"short": 2}


def test_stages_of_generators_may_end_out_of_turn(clock: Clock) -> None:
    def part(name: str) -> Iterator[None]:
        with stage(name):
            yield

    with listening() as call:
        one, two = part("one"), part("two")
        next(one)
        clock.now += 1
        next(two)
        clock.now += 10
        next(one, None)  # ends before "two", which began within it
        clock.now += 100
        next(two, None)
        clock.now += 1000
    assert call.ns == {"one": 1, "two": 110}


def test_other_threads_are_not_heard(clock: Clock) -> None:
    def beside() -> None:
        with stage("beside"):
            clock.now += 10

    with listening() as call, stage("here"):
        clock.now += 1
        context = contextvars.copy_context()  # as asyncio.to_thread does
        for target in (beside, lambda: context.run(beside)):
            thread = threading.Thread(target=target)
            thread.start()
            thread.join()
        clock.now += 100
    assert call.ns == {"here": 121}


def test_tasks_in_the_thread_are_heard() -> None:
    async def part(name: str, rounds: int) -> None:
        for _ in range(rounds):
            with stage(name):
                await asyncio.sleep(0.001)

    async def both() -> None:
        await asyncio.gather(part("one", 5), part("two", 9))

    before = time.perf_counter_ns()
    with listening() as call:
        asyncio.run(both())
    elapsed = time.perf_counter_ns() - before
    assert call.ns.keys() == {"one", "two"}
    assert 9e6 <= sum(call.ns.values()) <= elapsed


TREES = st.recursive(
    st.just([]),
    lambda inner: st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 9), inner), max_size=3),
    max_leaves=12,
)


@given(tree=TREES)
def test_any_nesting_adds_up_to_the_time_within_marks(tree: list[Any]) -> None:
    clock, expected = Clock(), dict.fromkeys("abc", 0)

    def run(parts: list[Any]) -> None:
        for name, ns, inner in parts:
            with stage(name):
                clock.now += ns
                run(inner)
                clock.now += ns
                expected[name] += 2 * ns

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "perf_counter_ns", clock)
        with listening() as call:
            run(tree)
    assert {name: ns for name, ns in expected.items() if ns or name in call.ns} == call.ns
    assert sum(call.ns.values()) == clock.now


@pytest.mark.parametrize(
    "name", ["", "Pre", "pre-process", "pre process", "1st", "é", "a+b", None, "a" * 41, "a\n"]
)
def test_a_stage_has_a_name(name: Any) -> None:
    with pytest.raises(LaeError, match=r"is no name of a stage: small letters.*'preprocess'"):
        stage(name)


def test_where_nobody_listens_a_mark_costs_next_to_nothing() -> None:
    def cost(rounds: int = 2000) -> float:
        before = time.process_time_ns()
        for _ in range(rounds):
            with stage("preprocess"):
                pass
        return (time.process_time_ns() - before) / rounds

    assert min(cost() for _ in range(20)) < 5_000  # ns; about 500 where nothing else runs
