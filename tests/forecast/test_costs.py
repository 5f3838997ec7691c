"""What forecasting costs: told, measured, and counted in the scores."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest
from witness import moving

from lae_sim.comparison.forecasters import score_forecasters
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import answers, evaluate_runs
from lae_sim.forecast.base import ConstantVelocity, Hold, Oracle
from lae_sim.forecast.costs import cost_notes, measure_cost, parse_cost, resolve_costs
from lae_sim.forecast.kalman import Kalman
from lae_sim.replay.run import replay_sequence
from lae_sim.replay.world import World
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

EVERY = Metadata.new("30", "every-frame")
RECORDINGS = [moving(40, 1, "a"), moving(60, 2, "b")]
RUNS = [replay_sequence(recording, Clock.at(Fraction(30))) for recording in RECORDINGS]
FACTORIES = {"hold": Hold, "kalman": Kalman, "kalman:q=3": Kalman}
SIGMAS = [Fraction(0), Fraction(1, 2)]


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ([], {}),
        (["2ms"], {"kalman": 2_000_000, "kalman:q=3": 2_000_000}),
        (["hold=1us"], {"hold": 1000}),
        (["0ns"], {"kalman": 0, "kalman:q=3": 0}),
        (["2ms", "kalman=5us"], {"kalman": 5000, "kalman:q=3": 2_000_000}),
        (["kalman=5us", "2ms"], {"kalman": 2_000_000, "kalman:q=3": 2_000_000}),
        (["kalman:q=3=7ns"], {"kalman:q=3": 7}),
    ],
)
def test_costs_as_declared(told: list[str], expected: dict[str, int]) -> None:
    assert resolve_costs(told, FACTORIES, RECORDINGS) == expected


@pytest.mark.parametrize(
    ("told", "problem"),
    [
        ("imm=2ms", "the cost 'imm=2ms': there is no forecaster 'imm' here"),
        ("kalman:q=3", "there is no forecaster 'kalman:q'"),
        ("2", "'2' is not a duration: write it with its unit"),
        ("kalman=", "'' is not a duration"),
        ("kalman=-2ms", "not a duration"),
        ("", "not a duration"),
    ],
)
def test_costs_that_are_none(told: str, problem: str) -> None:
    with pytest.raises(LaeError, match=problem):
        resolve_costs([told], FACTORIES, RECORDINGS)


def test_a_cost_is_measured_on_the_first_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[tuple[int, Sequence[float]]] = []
    passing = iter([0, 100, 0, 900, 0, 300])
    monkeypatch.setattr("lae_sim.forecast.costs.perf_counter_ns", lambda: next(passing))

    class Scribe(Hold):
        def update(self, frame: int, box: Sequence[float]) -> None:
            log.append((frame, box))

    boxes = [[1, 1, 9, 9], [2, 1, 9, 9], [np.nan] * 4, [4, 1, 9, 9], [5, 1, 9, 9]]
    recording = Recording.new("a", boxes, boxes, [1, 1, -1, 1, 1])
    assert parse_cost("measured") is None
    found = resolve_costs(["measured", "hold=3ns"], {"hold": Hold, "it": Scribe}, [recording])
    assert found == {"it": 300, "hold": 3}  # the median
    assert log == [(frame, boxes[frame]) for frame in (1, 3, 4)]


def test_a_measured_cost_is_that_of_one_answer() -> None:
    assert 0 < measure_cost(Kalman, RECORDINGS[0]) < 10**8
    assert measure_cost(Oracle, RECORDINGS[0]) > 0
    assert measure_cost(Kalman, Recording.new("a", [[1] * 4], [[1] * 4], [1])) == 0

    class Failing(Hold):
        def predict(self, frame: int) -> Sequence[float]:
            raise RuntimeError("no")

    with pytest.raises(LaeError, match="mine: RuntimeError: no"):
        measure_cost(Failing, RECORDINGS[0], "mine")


def test_a_cost_lowers_the_scores_of_those_who_pay_it_alone() -> None:
    free = evaluate_runs(RUNS, EVERY, FACTORIES, SIGMAS)
    zero = evaluate_runs(RUNS, EVERY, FACTORIES, SIGMAS, costs=dict.fromkeys(FACTORIES, 0))
    paid = evaluate_runs(RUNS, EVERY, FACTORIES, SIGMAS, costs={"kalman": 20_000_000, "absent": 9})
    for metric, scores in free.scores.items():
        np.testing.assert_array_equal(zero.scores[metric], scores)
        np.testing.assert_array_equal(paid.scores[metric][[0, 2]], scores[[0, 2]])
    assert (paid.scores["auc"][1] < free.scores["auc"][1]).all()
    for name in ("mismatch_sum", "mismatch_max", "longest_hold"):
        stale = getattr(paid.staleness, name), getattr(free.staleness, name)  # of the tracker
        np.testing.assert_array_equal(*stale)


def test_an_answer_that_costs_a_frame_is_the_answer_for_the_frame_before_told_later() -> None:
    interval = 40_000_000  # at 25 frames/s exactly
    run = replay_sequence(RECORDINGS[1], Clock.at(Fraction(25)))
    for cost in (0, interval, 3 * interval):
        late = answers(run, EVERY, "velocity", ConstantVelocity, cost_ns=cost)
        same = answers(run, EVERY, "velocity", ConstantVelocity, Fraction(-cost, interval))
        assert late.source_frame.tolist() == same.source_frame.tolist()
        np.testing.assert_array_equal(late.boxes, same.boxes)
    assert late.source_frame[:5].tolist() == [0] * 5


def test_a_comparison_counts_and_tells_costs() -> None:
    traces = {"t": Trace(EVERY, RECORDINGS)}
    factories = {"kalman": Kalman}
    free, paid = (
        score_forecasters(traces, factories, [World(costs=costs)]) for costs in ((), ("20ms",))
    )
    changed = (free["value"] != paid["value"]) & free["value"].notna()
    assert set(free["forecaster"][changed]) == {"kalman"}
    assert any("kalman 20000 us" in note for note in paid.attrs["notes"])
    assert not any(" us" in note for note in free.attrs["notes"])
    assert cost_notes({}) == []
