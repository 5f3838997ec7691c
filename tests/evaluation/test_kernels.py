"""Pairing and counting compiled: the bits of NumPy's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from compiling import needs_numba, switched
from hypothesis import given, settings
from hypothesis import strategies as st

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, latest, vot_realtime
from lae_sim.evaluation.evaluate import Evaluation, evaluate_groups, evaluate_runs
from lae_sim.evaluation.metrics import CONVENTIONS
from lae_sim.evaluation.pairing import histories, pair, pairs
from lae_sim.evaluation.scoring import Scorer
from lae_sim.forecast.base import ConstantVelocity, Hold
from lae_sim.forecast.kalman import Kalman
from lae_sim.replay.latency import bootstrap
from lae_sim.replay.run import Repetitions, Run, replay_sequence
from lae_sim.replay.world import SIGMA_GRID, replay_trace
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

MS = 1_000_000
CLOCK = Clock.at(Fraction(30000, 1001))
FORECASTERS = {"kalman": Kalman, "hold": Hold, "velocity": ConstantVelocity}
COSTS = {"velocity": 21 * MS}
SIGMAS: list[Sequence[Fraction]] = [
    [Fraction(0)],
    [Fraction(-1, 3), Fraction(0), Fraction(5, 7), Fraction(9)],
    SIGMA_GRID,
]
POLICIES = [latest, every(2), vot_realtime()]

pytestmark = needs_numba


def recording(name: str, random: np.random.Generator, arrives: bool) -> Recording:
    """Truth and answers with all that conventions tell apart, and some that are just equal."""
    length = int(random.integers(1, 60))
    truth = np.cumsum(random.normal(0, 6, (length, 4)), axis=0) + [60, 40, 30, 20]
    truth[:, 2:] = random.choice([5.0, 10.0, 20.0, 40.0], (length, 2))
    boxes = truth + np.round(random.normal(0, 6, (length, 4)))
    truth[random.random(length) < 0.1] = np.nan
    truth[random.random(length) < 0.1, 2] = random.choice([0.0, -3.0, 1e-310])
    truth[random.random(length) < 0.1, 0] = -90.0
    boxes[random.random(length) < 0.1] += 500
    boxes[random.random(length) < 0.1, 3] = random.choice([0.0, -1.0])
    same = random.random(length) < 0.2
    boxes[same] = np.where(np.isnan(truth[same]), boxes[same], truth[same])
    elapsed = (random.choice([20, 33, 47, 90]) * MS * random.lognormal(0, 0.3, length)).astype(int)
    steps = random.integers(20, 50, length) * MS
    return Recording.new(
        name,
        truth,
        boxes,
        elapsed,
        arrival_ns=np.cumsum(steps) - steps[0] if arrives else None,
        visible=random.random(length) < 0.8 if random.random() < 0.5 else None,
    )


@st.composite
def runs(draw: st.DrawFn) -> list[Run]:
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    policy, arrives = draw(st.sampled_from(POLICIES)), draw(st.integers(0, 3)) == 0
    some = [recording(f"s{s}", random, arrives) for s in range(draw(st.integers(1, 5)))]
    return [replay_sequence(each, CLOCK, policy=policy) for each in some]


def flat(value: Any) -> Iterator[Any]:
    """All that a record of arrays holds, as bytes."""
    if isinstance(value, np.ndarray):
        yield value.dtype, value.shape, value.tobytes()
    elif isinstance(value, dict):
        for name, each in value.items():
            yield name
            yield from flat(each)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            yield from flat(getattr(value, name))
    else:
        yield value


@given(some=runs(), sigmas=st.sampled_from(SIGMAS), name=st.sampled_from(sorted(CONVENTIONS)))
@settings(max_examples=100, deadline=None)
def test_evaluations_are_the_same(some: list[Run], sigmas: Sequence[Fraction], name: str) -> None:
    def evaluated() -> Evaluation:
        metadata = Metadata.new("30", "every-frame")
        return evaluate_runs(some, metadata, FORECASTERS, sigmas, CONVENTIONS[name], COSTS)

    found = []
    for way in ("0", "1"):
        with switched(way):
            found.append(list(flat(evaluated())))
    assert found[0] == found[1]


@given(
    seed=st.integers(0, 2**32),
    sigmas=st.sampled_from(SIGMAS),
    name=st.sampled_from(sorted(CONVENTIONS)),
)
@settings(max_examples=30, deadline=None)
def test_repetitions_that_share_what_pairs_count_are_the_same(
    seed: int, sigmas: Sequence[Fraction], name: str
) -> None:
    random = np.random.default_rng(seed)
    some = [recording(f"s{s}", random, False) for s in range(4)]
    trace = Trace(Metadata.new("30", "every-frame"), some)
    drawn = Repetitions(replay_trace(trace, latency=bootstrap(1, block=3), search="off"), 5)
    assert all(batch.own.all() for batch in drawn.batches())

    found = []
    for way in ("0", "1"):
        with switched(way):
            groups = evaluate_groups(
                drawn, trace.metadata, {"hold": Hold}, sigmas, CONVENTIONS[name], frames=2000
            )
            found.append([list(flat(group)) for group in groups])
    assert found[0] == found[1]


def test_boxes_of_another_pass_are_not_taken_for_the_recordings_own() -> None:
    random = np.random.default_rng(7)
    own, other = (recording("a", random, False) for _ in range(2))
    other = replace(own, boxes=own.boxes + 3.0)
    metadata = Metadata.new("30", "every-frame")
    strided = Metadata.new("30", "every-frame", schedule={"stride": "2"})
    trace, second = Trace(metadata, [own]), Trace(strided, [other])
    found: list[bool] = []
    for latency in ("constant:1ms", "constant:60ms"):
        runs = replay_trace(trace, latency=latency, passes=[second], search="off")
        found += [bool(batch.own[0]) for batch in runs.batches()]
    assert found == [True, False]


@given(some=runs(), sigmas=st.sampled_from(SIGMAS))
@settings(max_examples=50, deadline=None)
def test_pairs_are_the_same(some: list[Run], sigmas: Sequence[Fraction]) -> None:
    found = []
    for way in ("0", "1"):
        with switched(way):
            pairing = pair([run.schedule for run in some], sigmas)
            fed = histories(pairing)
            found.append([*flat(fed), *flat(pairs(pairing, fed))])
    assert found[0] == found[1]


@given(
    numbers=st.lists(
        st.tuples(*[st.sampled_from([0.0, 1.0, 2.0, 7.0, -1.0, 1e-310, 1e200, np.nan])] * 8),
        min_size=1,
        max_size=30,
    ),
    name=st.sampled_from(sorted(CONVENTIONS)),
)
@settings(max_examples=150, deadline=None)
def test_odd_boxes_count_the_same(numbers: list[tuple[float, ...]], name: str) -> None:
    boxes = np.array(numbers)
    one = Recording.new("a", boxes[:, :4], boxes[:, 4:], np.full(len(boxes), MS))
    found = []
    for way in ("0", "1"):
        with switched(way), np.errstate(all="ignore"):
            found.append(list(flat(Scorer([one], CONVENTIONS[name]).offline())))
    assert found[0] == found[1]


def test_kernels_are_what_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    from lae_sim.evaluation import kernels

    random = np.random.default_rng(5)
    some = [replay_sequence(recording("a", random, False), CLOCK)]
    used = []
    counting = ("count_pairs", "count_held")
    names = ("sum_gaps", "changes", "used_outputs", "most_pairs", "list_pairs", *counting)
    both = {"hold": Hold, "kalman": Kalman}
    for name in names:
        kernel = getattr(kernels, name)

        def noted(*arguments: Any, name: str = name, kernel: Any = kernel) -> Any:
            used.append(name)
            return kernel(*arguments)

        monkeypatch.setattr(kernels, name, noted)
    for way, expected in (("0", 0), ("1", len(names))):
        with switched(way):
            evaluate_runs(some, Metadata.new("30", "every-frame"), both, SIGMA_GRID)
        assert len(set(used)) == expected
