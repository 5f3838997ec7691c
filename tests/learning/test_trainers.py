"""Training: the network learns and is repeatable; the tuned Kalman filter finds known numbers."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from witness import moving

from lae_sim.boxes import iou
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.forecast.base import Hold, forecast
from lae_sim.forecast.kalman import PAPER, TunedKalman
from lae_sim.forecast.learned import Learned
from lae_sim.learning.folds import Examples, Trainer, fit_folds
from lae_sim.learning.trainers import KalmanTrainer, NetworkTrainer, WrappedTrainer
from lae_sim.replay.latency import constant
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.recording import Recording


def examples_of(recordings: list[Recording], elapsed_ns: int = 90_000_000) -> Examples:
    clock, source = Clock.at(Fraction(30)), constant(ns=elapsed_ns)
    return Examples.of([replay_sequence(recording, clock, source) for recording in recordings])


def score(factory: Any, examples: Examples) -> float:
    """Mean IoU with the truth, every sequence the same."""
    valid = examples.truth[:, 2] > 0
    boxes = forecast(factory, examples.lanes, examples.item[valid], examples.frame[valid])
    ious = iou(examples.truth[valid], boxes)
    lanes = examples.lanes.lane(examples.item[valid])
    return float(np.mean([ious[lanes == lane].mean() for lane in np.unique(lanes)]))


def straight(seed: int, noise: float = 1.5, length: int = 90) -> Recording:
    """Constant velocity, measured with noise."""
    random = np.random.default_rng(seed)
    velocity = [*random.uniform(-6, 6, 2), 0, 0]
    truth = np.array([300, 200, 44, 32]) + np.arange(length)[:, None] * velocity
    boxes = truth + random.normal(0, noise, truth.shape)
    return Recording.new(f"s{seed:02}", truth, boxes, [1] * length)


# ------------------------------------------------------------------------------------- the network


def test_a_network_learns_to_average_noise_away(torch: Any) -> None:
    examples = examples_of([straight(k) for k in range(12)])
    trained = NetworkTrainer(steps=60, batch=256).fit(examples)
    untrained = NetworkTrainer(steps=1, rate=1e-9).fit(examples)
    others = examples_of([straight(k) for k in range(50, 58)])
    hold, start, end = (score(factory, others) for factory in (Hold, untrained, trained))
    assert hold + 0.1 < start < end - 0.01
    assert end > 0.8


def weights(trained: Learned) -> bytes:
    return b"".join(each.tobytes() for each in (*trained.network.weights, *trained.network.biases))


def test_the_same_seed_trains_the_same_network_whatever_was_done_before(torch: Any) -> None:
    examples = examples_of([moving(50, 1, "a"), moving(40, 2, "b")])
    told: list[int] = []
    first = NetworkTrainer(4, 32, progress=told.append).fit(examples, 5)
    assert told == [1] * 4
    state = torch.random.get_rng_state()
    torch.rand(7)
    assert weights(NetworkTrainer(4, 32).fit(examples, 5)) == weights(first)
    assert weights(NetworkTrainer(4, 32).fit(examples, 6)) != weights(first)
    torch.random.set_rng_state(state)
    before = torch.rand(3)
    torch.random.set_rng_state(state)
    NetworkTrainer(2, 8).fit(examples, 5)
    assert torch.equal(torch.rand(3), before)  # nor does it disturb what others draw
    assert first.document == {"sequences": ["a", "b"], "seed": 5, "steps": 4}
    assert isinstance(NetworkTrainer(), Trainer)


@pytest.mark.parametrize("steps", [1, 2, 9, 10, 11, 20])
def test_any_number_of_steps(torch: Any, steps: int) -> None:
    assert weights(NetworkTrainer(steps, 4).fit(examples_of([moving(12)])))


def test_only_what_is_asked_is_learnt_and_named(torch: Any) -> None:
    """A network trained without a sequence is the same whatever that sequence's answers are."""
    parts = [moving(40, 1, "a"), moving(40, 2, "b")]
    other = Recording.new("b", parts[1].truth + 99, parts[1].boxes, parts[1].elapsed_ns)
    trained = [
        NetworkTrainer(3, 32).fit(examples_of([parts[0], b]).without("b"))
        for b in (parts[1], other)
    ]
    assert weights(trained[0]) == weights(trained[1])
    assert trained[0].document["sequences"] == ["a"]


def test_missing_truth_and_missing_boxes_do_no_harm(torch: Any) -> None:
    whole = moving(60, 3)
    truth = whole.truth.copy()
    truth[::3], truth[1] = np.nan, [5, 5, 0, 0]
    frames = replay_sequence(whole, Clock.at(Fraction(30)), constant(ns=90_000_000)).schedule.frames
    boxes, elapsed = np.full((60, 4), np.nan), np.full(60, -1)
    boxes[frames], elapsed[frames] = whole.boxes[frames], 1
    for recording in (
        Recording.new("a", truth, boxes, elapsed),
        Recording.new("a", np.full((60, 4), np.nan), whole.boxes, whole.elapsed_ns),
    ):
        trained = NetworkTrainer(5, 32).fit(examples_of([recording]))
        assert np.isfinite(np.frombuffer(weights(trained))).all()


def test_nothing_to_learn_from(torch: Any) -> None:
    examples = examples_of([moving(9, 0, "a")])
    blind = Recording.new("a", np.full((9, 4), np.nan), np.full((9, 4), 5.0) * 0, [1] * 9)
    for nothing in (examples.without("a"), examples_of([blind])):
        with pytest.raises(LaeError, match="nothing to learn from"):
            NetworkTrainer().fit(nothing)


# ---------------------------------------------------------------------------- the Kalman filter


def simulated(q: float, decay: float, seed: int, length: int = 240) -> Recording:
    """Motion as the filter's model has it, frame by frame, on a target so large as to be seen."""
    random = np.random.default_rng(seed)
    position, velocity, path = np.zeros(2), random.normal(0, 10, 2), []
    for _ in range(length):
        path.append(position)
        position = position + velocity + random.normal(0, np.sqrt(q), 2)
        velocity = decay * velocity + random.normal(0, np.sqrt(q), 2)
    truth = np.column_stack([path, np.full((length, 2), 200 + 40 * np.sqrt(q))])
    boxes = truth + random.normal(0, np.sqrt(10), truth.shape) * [1, 1, 0, 0]
    return Recording.new(f"s{seed}", truth, boxes, [1] * length)


@pytest.mark.parametrize("q", [0.03, 1.0, 30.0])
def test_the_noise_that_data_have_is_found(q: float) -> None:
    examples = examples_of([simulated(q, 1.0, seed) for seed in range(5)], 30_000_000)
    found = KalmanTrainer(state=("corner",)).fit(examples)
    assert q / 4 < found.q < 4 * q  # the candidates stand three apart
    assert found.decay >= 0.98


def test_a_velocity_that_dies_is_found() -> None:
    examples = examples_of([simulated(30.0, 0.8, seed) for seed in range(5)])
    assert KalmanTrainer().fit(examples).decay <= 0.9


def test_no_other_value_of_one_parameter_is_better() -> None:
    trainer = KalmanTrainer(q=(0.1, 1.0, 10.0), decay=(0.9, 1.0))
    examples = examples_of([moving(60, 1, "a"), moving(200, 2, "b")])
    found = trainer.fit(examples, seed=1)
    assert found == trainer.fit(examples, seed=2)
    best = score(found, examples)
    assert best >= score(PAPER, examples)
    for q in trainer.q:
        assert score(TunedKalman(q, decay=found.decay, state=found.state), examples) <= best + 1e-12
    for decay in trainer.decay:
        assert score(TunedKalman(found.q, decay=decay, state=found.state), examples) <= best + 1e-12
    assert isinstance(trainer, Trainer)


def test_folds_at_once_find_what_each_fold_finds_alone_and_filter_once_for_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parts = [simulated(q, 0.9, seed, 60) for seed, q in enumerate((0.03, 30.0, 0.1, 10.0))]
    examples, held_out = examples_of(parts), [{"s0", "s2"}, {"s1"}, {"s3"}, set()]
    trainer = KalmanTrainer(q=(0.1, 1.0, 10.0))
    alone = [trainer.fit(examples.without(names), 0) for names in held_out]
    assert len(set(alone)) > 1
    asked: list[TunedKalman] = []
    forecast_lanes = TunedKalman.forecast_lanes

    def counted(self: TunedKalman, *arguments: Any) -> Any:
        asked.append(self)
        return forecast_lanes(self, *arguments)

    monkeypatch.setattr(TunedKalman, "forecast_lanes", counted)
    told: list[None] = []
    wrapped = WrappedTrainer(trainer, lambda base: [base])  # type: ignore[arg-type, return-value]
    found = fit_folds(wrapped, examples, held_out, 0, lambda: told.append(None))
    assert found == [[each] for each in alone]
    assert len(told) == len(held_out)
    assert len(asked) == len(set(asked))


def test_a_fold_without_a_truth_is_said() -> None:
    blind = Recording.new("b", np.full((60, 4), np.nan), moving(60, 1).boxes, [1] * 60)
    examples = examples_of([moving(60, 1, "a"), blind])
    assert KalmanTrainer().fit(examples) == KalmanTrainer().fit(examples.without("b"))
    with pytest.raises(LaeError, match="nothing to learn from"):
        fit_folds(KalmanTrainer(), examples, [{"b"}, {"a"}], 0)
