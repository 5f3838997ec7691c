"""The batch engine: event for event the SimPy engine, whatever the lanes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from compiling import BOTH_WAYS
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED
from witness import RATES, times

from lae_sim._arrays import Ints
from lae_sim._compiled import SWITCH
from lae_sim.engine import lanes as batch
from lae_sim.engine.clock import Clock, parse_fps
from lae_sim.engine.lanes import batchable, simulate_lanes
from lae_sim.engine.policies import every, fifo, latest, listed, shrinking_tail, vot_realtime
from lae_sim.engine.scheduler import Call, Policy, Schedule, Service, simulate
from lae_sim.engine.times import Times
from lae_sim.errors import LaeError
from lae_sim.replay.latency import by_call, by_frame, constant, lognormal, resampled, scaled
from lae_sim.trace.recording import Recording

MS = 1_000_000
POLICIES: dict[str, Policy] = {
    "latest": latest,
    "fifo": fifo,
    "every 3": every(3),
    "every 10**18": every(10**18),
    "shrinking tail 0": shrinking_tail(ns=0),
    "shrinking tail 47 ms": shrinking_tail(ns=47 * MS),
    "shrinking tail of a century": shrinking_tail(ns=3 * 10**18),
}
Outcome = tuple[list[int], list[int], list[int]] | str


def outcome(schedule: Schedule) -> Outcome:
    columns = (schedule.frames, schedule.start, schedule.ready)
    assert all(column.dtype == np.int64 and column.flags.c_contiguous for column in columns)
    return tuple(column.tolist() for column in columns)  # type: ignore[return-value]


def in_simpy(length: int, clock: Clock, service: Service, policy: Policy) -> Outcome:
    try:
        return outcome(simulate(length, clock, service, policy))
    except LaeError as error:
        return str(error)


def at_once(
    lengths: Sequence[int], clock: Clock, services: Sequence[Service], policy: Policy
) -> list[Outcome]:
    """What becomes of each lane; those after an error are asked for anew."""
    found: list[Outcome] = []
    while len(found) < len(lengths):
        rest = slice(len(found), None)
        try:
            for schedule in simulate_lanes(lengths[rest], clock, services[rest], policy):
                found.append(outcome(schedule))
        except LaeError as error:
            found.append(str(error))
    return found


@pytest.fixture(autouse=True, params=BOTH_WAYS)
def even_one_lane(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, request.param)
    monkeypatch.setattr(batch, "_FEWEST", 1)


@pytest.fixture
def no_simpy(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("the SimPy engine was asked")

    monkeypatch.setattr(batch, "simulate", never)


@st.composite
def lanes(draw: st.DrawFn, fps: Fraction) -> tuple[list[int], list[Times]]:
    """Lanes of any length; some have gaps, too few times, or ends of the world."""
    lengths, services = [], []
    for name in range(draw(st.integers(1, 6))):
        length = draw(st.integers(1, 90))
        ns = np.array(draw(times(fps, length)))
        by_call = draw(st.booleans())
        if draw(st.integers(0, 3)) == 0:
            gaps = draw(st.lists(st.booleans(), min_size=length, max_size=length))
            ns = ns[gaps] if by_call else np.where(gaps, -1, ns)
        if len(ns) and draw(st.integers(0, 9)) == 0:
            ns[draw(st.integers(0, len(ns) - 1))] = draw(st.sampled_from([2**62, 2**63 - 1]))
        lengths.append(length)
        services.append(Times(str(name), ns, by_call))
    return lengths, services


@given(
    data=st.data(),
    fps=st.sampled_from([*RATES, "1/3", "1", "1000000", "1/99999999999"]),
    policy=st.sampled_from(sorted(POLICIES)).map(POLICIES.__getitem__),
)
@settings(max_examples=120)
def test_lanes_are_scheduled_as_in_simpy(data: st.DataObject, fps: str, policy: Policy) -> None:
    clock = Clock.at(Fraction(fps))
    lengths, services = data.draw(lanes(max(Fraction(fps), Fraction(1, 3))))
    expected = [in_simpy(n, clock, service, policy) for n, service in zip(lengths, services)]
    anew = [Times(service.name, service.ns, service.by_call) for service in services]
    assert at_once(lengths, clock, anew, policy) == expected


@pytest.mark.parametrize("policy", [*list(POLICIES.values())[:3], shrinking_tail(ns=47 * MS)])
@pytest.mark.usefixtures("no_simpy")
def test_lanes_need_no_simpy(policy: Policy) -> None:
    clock = Clock.at(Fraction(30000, 1001))
    random = np.random.default_rng(3)
    lengths = [1, 900, 33, 32, 31, 64, 400]
    for kind in (True, False):
        services = [Times("a", random.integers(0, 200 * MS, n), kind) for n in lengths]
        found = [outcome(s) for s in simulate_lanes(lengths, clock, services, policy)]
        expected = [in_simpy(n, clock, service, policy) for n, service in zip(lengths, services)]
        assert found == expected


@pytest.mark.usefixtures("no_simpy")
def test_a_gap_that_is_never_asked_for_is_none() -> None:
    services = [Times("a", np.array([100 * MS, -1, -1, 1, 1])), Times("b", np.array([0, 1]), True)]
    clock = Clock.at(Fraction(30))
    found = [outcome(s)[0] for s in simulate_lanes([5, 2], clock, services, latest)]
    assert found == [[0, 3, 4], [0, 1]]


@pytest.mark.parametrize("fps", ["30", "1/3"])
@pytest.mark.parametrize("factor", ["1", "2", "1/3", "1001/1000", "123456789/7"])
@pytest.mark.parametrize(
    "source", [by_frame, by_call, constant(ns=47 * MS), resampled(1), lognormal(1)]
)
def test_sources_of_the_package_are_batched(source, factor: str, fps: str) -> None:  # type: ignore[no-untyped-def]
    random = np.random.default_rng(0)
    box = np.ones((200, 4))
    recordings = [
        Recording.new(name, box, box, (47e6 * random.lognormal(0, 0.5, 200)).astype(np.int64))
        for name in "abc"
    ]
    clock = Clock.at(Fraction(fps))
    make = scaled(source, Fraction(factor))
    services = [make(recording) for recording in recordings]
    assert batchable(services, latest)
    expected = [in_simpy(200, clock, make(recording), latest) for recording in recordings]
    assert at_once([200] * 3, clock, services, latest) == expected


CASES = sorted((SHARED / "conformance").glob("*.json"))


@pytest.mark.parametrize("name", [path.stem for path in CASES] or ["absent"])
@pytest.mark.usefixtures("no_simpy")
def test_conformance(name: str, conformance: Path) -> None:
    case = json.loads((conformance / f"{name}.json").read_text())
    ns = np.array(case["elapsed_ns"])
    (found,) = simulate_lanes([len(ns)], Clock.at(parse_fps(case["fps"])), [Times("a", ns)], latest)
    assert list(map(list, zip(*outcome(found)))) == case["expected"]["processed"]


# --------------------------------------------------------------------------- what is no lane


@dataclass(frozen=True)
class Skip:
    """A user's own policy: so many frames after the last one, or as many as a lane may go back."""

    frames: int

    def __call__(self, clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        last, _, now = calls[-1]
        following = last + self.frames if last < 40 else last - 1
        return following, max(now, following * clock.frame_ticks)

    def next_lanes(self, clock: Clock, last: Ints, now: Ints) -> Ints:
        return np.where(last < 40, last + self.frames, last - 1)


class Stubborn(Skip):
    """It inherits what is not its own rule."""

    def __call__(self, clock: Clock, calls: Sequence[Call]) -> tuple[int, int]:
        return calls[-1][0] + 1, max(calls[-1][2], (calls[-1][0] + 1) * clock.frame_ticks)


TIMES = Times("a", np.full(50, 10 * MS))


def test_what_can_be_batched() -> None:
    assert batchable([TIMES], latest)
    assert batchable([TIMES], Skip(2))
    assert batchable([], every(2))
    assert not batchable([TIMES, lambda frame: 1], latest)
    assert not batchable([TIMES], Stubborn(2))
    assert not batchable([TIMES], vot_realtime())
    assert not batchable([TIMES], listed([0, 2]))


@pytest.mark.parametrize("policy", [Skip(2), Skip(0), Skip(-1), Stubborn(2), every(0), every(-2)])
@pytest.mark.parametrize("length", [1, 30, 41, 45, 50])
def test_a_users_own_policy(policy: Policy, length: int) -> None:
    clock = Clock.at(Fraction(30))
    expected = in_simpy(length, clock, TIMES, policy)
    assert at_once([length] * 3, clock, [TIMES] * 3, policy) == [expected] * 3


@pytest.mark.usefixtures("no_simpy")
def test_a_users_own_lane_policy_is_batched() -> None:
    (found,) = simulate_lanes([30], Clock.at(Fraction(30)), [TIMES], Skip(7))
    assert found.frames.tolist() == [0, 7, 14, 21, 28]


def test_a_users_own_service_is_asked_in_simpy() -> None:
    services = [TIMES, lambda frame: 100 * MS, TIMES]
    found = at_once([9] * 3, Clock.at(Fraction(30)), services, latest)
    assert [len(lane[0]) for lane in found] == [9, 3, 9]


def test_errors_come_in_turn() -> None:
    bad = Times("Gull2", np.array([100 * MS, -1, -1, -1]))
    schedules = simulate_lanes([4] * 3, Clock.at(Fraction(30)), [TIMES, bad, TIMES], latest)
    assert next(schedules).frames.tolist() == [0, 1, 2, 3]
    with pytest.raises(LaeError, match=r"sequence 'Gull2', frame 3"):
        next(schedules)


@pytest.mark.parametrize("lengths", [[], [0], [3, 0]])
def test_no_lanes_and_no_frames(lengths: list[int]) -> None:
    found = at_once(lengths, Clock.at(Fraction(30)), [TIMES] * len(lengths), latest)
    expected = [in_simpy(n, Clock.at(Fraction(30)), TIMES, latest) for n in lengths]
    assert found == expected
