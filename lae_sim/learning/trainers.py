"""Training: the learned forecaster's network, and the numbers of a tuned Kalman filter."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import iou
from lae_sim.errors import LaeError, install
from lae_sim.forecast.base import AnyFactory
from lae_sim.forecast.kalman import PAPER, TunedKalman
from lae_sim.forecast.learned import (
    CORRECTION,
    HORIZONS,
    INPUTS,
    MIXING,
    OFFSET,
    OUTPUTS,
    RATES,
    VELOCITIES,
    Learned,
    Past,
    mirrored,
    rows_of,
)
from lae_sim.forecast.network import ONE, Network
from lae_sim.learning.folds import Examples, Trainer, fit_folds


@dataclass(frozen=True)
class NetworkTrainer:
    """Trains a network by gradient descent on the overlap with what came.

    The loss is 1 - IoU, in part with the truth, in part with the tracker's own box of that frame
    (Yu et al., "UnitBox", 2016, minimise -ln IoU); a small term in the distance of the centres
    draws boxes that do not overlap. AdamW (Loshchilov and Hutter, 2019) with the one-cycle rate
    (Smith and Topin, 2019).

    Attributes:
        steps: steps of gradient descent.
        hidden: width of the two hidden layers.
        batch: queries of each step.
        rate: largest learning rate.
        truth: the truth's share of the loss: with more of it, more of what trackers do wrong by
            habit is mended, where they have habits.
        faster: motion is made faster or slower by a random factor; the standard deviation of its
            logarithm. x and y change places in half of the queries, too.
        progress: called after each step with how many more are done.
    """

    steps: int = 1000
    hidden: int = 48
    batch: int = 2048
    rate: float = 4e-3
    truth: float = 0.6
    faster: float = 0.3
    progress: Callable[[int], object] = lambda steps: None

    def fit(self, examples: Examples, seed: int = 0) -> Learned:
        """Train on all examples; the same seed and torch give the same network on like processors.

        Raises:
            LaeError: if torch is missing, or there is nothing to learn from.
        """
        torch = import_torch()
        ahead = (examples.frame - examples.lanes.frames[examples.item]).astype(np.float64)
        moved = examples.item > examples.lanes.first(examples.item)
        usable = (ahead > 0) & moved & (_sized(examples.truth) | _sized(examples.boxes))
        if not usable.any():
            raise LaeError("there is nothing to learn from: no output answers a later frame")
        with _one_thread(torch):
            layers = self._descend(torch, examples, np.flatnonzero(usable), ahead, seed)
        document = {"sequences": sorted(set(examples.sequences)), "seed": seed, "steps": self.steps}
        return Learned(
            Network.rounded(
                [layer.weight.detach().numpy().T.astype(np.float64) for layer in layers],
                [layer.bias.detach().numpy().astype(np.float64) for layer in layers],
                document,
            )
        )

    def _descend(
        self, torch: Any, examples: Examples, usable: Ints, ahead: Floats, seed: int
    ) -> list[Any]:
        """The linear layers of the trained network."""
        rng = np.random.default_rng(seed)
        past = Past.of(examples.lanes)
        cumulative = np.cumsum(examples.weight[usable])
        network = self._new(torch, seed)
        optimiser = torch.optim.AdamW(network.parameters(), lr=self.rate, weight_decay=1e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser,
            self.rate,
            total_steps=self.steps,
            pct_start=0.1 + 1e-9,  # torch divides by zero where this is exactly one step
        )
        for _ in range(self.steps):
            drawn = np.searchsorted(cumulative, rng.random(self.batch) * cumulative[-1])
            which = usable[np.minimum(drawn, len(usable) - 1)]
            batch = _Batch.of(examples, past, which).changed(
                np.exp(self.faster * rng.standard_normal(self.batch)), rng.random(self.batch) < 0.5
            )
            change = batch.change(torch, network, ahead[which])
            losses = _loss(torch, change, torch.from_numpy(batch.goals)).mean(0)
            loss = self.truth * losses[0] + (1 - self.truth) * losses[1]
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            self.progress(1)
        return [layer for layer in network if hasattr(layer, "weight")]

    def _new(self, torch: Any, seed: int) -> Any:
        """An untrained network: a mean of the last three velocities."""
        widths = [INPUTS, self.hidden, self.hidden, OUTPUTS]
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(seed)
            layers = [torch.nn.Linear(*pair) for pair in pairwise(widths)]
            layers[-1].weight.mul_(0.1)
            layers[-1].bias.zero_()
            weights = layers[-1].bias[:MIXING].view(2, RATES, VELOCITIES)
            weights[:, 0, :3] = 1 / 3  # of the rate near; the others are added to it further on
        first, second, last = layers
        return torch.nn.Sequential(first, torch.nn.ReLU(), second, torch.nn.ReLU(), last)


@contextmanager
def _one_thread(torch: Any) -> Iterator[None]:
    """Let torch use one thread: sums in one order whatever the machine, and little is lost."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def import_torch() -> Any:
    """The torch module.

    Raises:
        LaeError: if it is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise LaeError(f"training needs torch: {install('torch')}") from error
    return torch


@dataclass(frozen=True, eq=False)
class _Batch:
    """What is known at some queries, and what came.

    Attributes:
        motion: velocities that are seen, [P, VELOCITIES + STARTS, 4].
        interval: frames before each, [P, VELOCITIES + STARTS].
        shape: what else is seen, [P, 3].
        goals: truth and the tracker's later box, by changes of the centre from the latest box and
            sides in target sizes; and the latest box's sides, float32 [P, 2, 6].
    """

    motion: Floats
    interval: Floats
    shape: Floats
    goals: Any

    @classmethod
    def of(cls, examples: Examples, past: Past, which: Ints) -> _Batch:
        item = examples.item[which]
        window, place = past.window(item), past.place.chosen(item)
        shape = place.shape((item - past.first[item]).astype(np.float64))
        truth, boxes = examples.truth[which], examples.boxes[which]
        goals = np.stack(  # where one is missing the other stands for both
            [
                np.where(_sized(truth)[:, None], truth, boxes),
                np.where(_sized(boxes)[:, None], boxes, truth),
            ],
            axis=1,
        )
        centre = np.stack([place.x, place.y], axis=1)
        sides = np.broadcast_to(np.stack([place.w, place.h], axis=1)[:, None], (len(item), 2, 2))
        offset = goals[..., :2] + goals[..., 2:] / 2 - centre[:, None]
        parts = np.concatenate([offset, goals[..., 2:], sides], axis=2)
        return cls(
            past.velocity.T[window],
            past.interval[window],
            np.stack(shape, axis=1),
            (parts / place.size[:, None, None]).astype(np.float32),
        )

    def changed(self, faster: Floats, flipped: Bools) -> _Batch:
        """Motion faster by factors [P], and with x and y exchanged where flipped, [P]."""
        motion, goals, shape = self.motion.copy(), self.goals.copy(), self.shape.copy()
        motion[..., :2] *= faster[:, None, None]
        goals[..., :2] *= faster[:, None, None].astype(np.float32)
        motion[flipped] = motion[flipped][..., [1, 0, 3, 2]]
        goals[flipped] = goals[flipped][..., [1, 0, 3, 2, 5, 4]]
        shape[flipped, 1] = ONE - shape[flipped, 1]
        return _Batch(motion, self.interval, shape, goals)

    def change(self, torch: Any, network: Any, ahead: Floats) -> Any:
        """What the network says of each: change of centre and sides, [P, 4]."""
        mirror = mirrored(self.motion[:, :VELOCITIES].transpose(1, 2, 0)).T
        rows = np.moveaxis(rows_of(np.moveaxis(self.motion, -1, 0), self.interval), 0, -1)
        rows[..., :2] *= mirror[:, None]
        inputs = np.concatenate([rows.reshape(len(rows), -1), self.shape], axis=1) / ONE
        near, mirror, motion, inputs = (
            torch.from_numpy(each.astype(np.float32))
            for each in (ahead, mirror, self.motion[:, :VELOCITIES], inputs)
        )
        answers = network(inputs)
        mixed = answers[:, :MIXING].reshape(-1, 2 * RATES, VELOCITIES) @ motion
        mixed = torch.cat([mixed[:, :RATES, :2], mixed[:, RATES:, 2:]], 2)
        turned = torch.cat([mirror, torch.ones_like(mirror)], 1)
        more = CORRECTION * answers[:, MIXING:-4].reshape(-1, RATES, 4)
        rates = mixed + more * turned[:, None]
        shares = torch.stack([torch.ones_like(near), *(near / (near + h) for h in HORIZONS)], 1)
        change = (rates * shares[..., None]).sum(1) * near[:, None]
        return change + OFFSET * answers[:, -4:] * turned


def _sized(boxes: Floats) -> Bools:
    """Which boxes have a width and a height."""
    sized: Bools = np.logical_and.reduce(boxes[:, 2:] > 0, axis=1)
    return sized


def _loss(torch: Any, change: Any, goals: Any) -> Any:
    """1 - IoU with each goal, and the distance of the centres, [P, 2]."""
    offset = goals[..., :2] - change[:, None, :2]
    ratio = change[:, None, 2:].clamp(-1, 1)
    goal_sides, sides = goals[..., 2:4], goals[..., 4:] * (2 + ratio) / (2 - ratio)
    shared = torch.minimum(sides / 2, offset + goal_sides / 2).sub(
        torch.maximum(-sides / 2, offset - goal_sides / 2)
    )
    overlap = shared.clamp(min=0).prod(2)
    union = sides.prod(2) + goal_sides.prod(2) - overlap
    distance = torch.sqrt(offset.pow(2).sum(2) + 0.01).clamp(max=2)
    return 1 - overlap / union + 0.1 * distance


@dataclass(frozen=True)
class KalmanTrainer:
    """Chooses q, decay and state of a :class:`TunedKalman` for the highest mean IoU with the truth.

    One parameter after another takes its best value, until none changes; r and p0 stay the paper's,
    since the gains rest on ratios alone, q / r and p0 / r, of which the second fades after few
    outputs.

    Attributes:
        q, decay, state: the values to choose from.
    """

    q: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
    decay: tuple[float, ...] = (0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
    state: tuple[str, ...] = ("corner", "centre")

    def fit(self, examples: Examples, seed: int = 0) -> TunedKalman:
        """The filter that suits all examples best; the seed plays no part.

        Raises:
            LaeError: if there is no truth to learn from.
        """
        (best,) = self.fit_folds(examples, [()], seed)
        return best

    def fit_folds(
        self,
        examples: Examples,
        held_out: Sequence[Collection[str]],
        seed: int,
        progress: Callable[[], object] = lambda: None,
    ) -> list[TunedKalman]:
        """The filter that suits best all sequences but some, for each of several such sets.

        Sequences are filtered once with each value that some fold tries: what a filter makes of one
        does not depend on the others.

        Raises:
            LaeError: if there is no truth to learn from.
        """
        valid = np.flatnonzero(_sized(examples.truth))
        item, frame, truth = examples.item[valid], examples.frame[valid], examples.truth[valid]
        weight, sequence = examples.weight[valid], examples.lanes.lane(item)
        learnt = [
            np.array([name not in names for name in examples.sequences])[sequence]
            for names in held_out
        ]
        tried: dict[TunedKalman, list[float]] = {}

        def score(fold: int, settings: TunedKalman) -> float:
            if settings not in tried:
                boxes = settings.forecast_lanes(examples.lanes, item, frame)
                overlap = iou(truth, boxes) * weight
                tried[settings] = [float(overlap[those].sum()) for those in learnt]
            return tried[settings][fold]

        found = []
        for fold, those in enumerate(learnt):
            progress()
            if not those.any():
                raise LaeError("there is nothing to learn from: no frame has a truth")
            found.append(self._best(partial(score, fold)))
        return found

    def _best(self, score: Callable[[TunedKalman], float]) -> TunedKalman:
        """The filter of the highest score, one parameter after another."""
        best, before = PAPER, None
        while best != before:
            before = best
            for name in ("q", "decay", "state"):
                choices = [replace(best, **{name: value}) for value in getattr(self, name)]
                best = max([best, *choices], key=score)
        return best


@dataclass(frozen=True, eq=False)
class WrappedTrainer:
    """Trains a base forecaster on boxes as they are seen, and wraps it.

    Attributes:
        base: trains the forecaster.
        wrap: such as what runs it over the camera's motion, or guards it.
    """

    base: Trainer
    wrap: Callable[[AnyFactory], AnyFactory]

    def fit(self, examples: Examples, seed: int) -> AnyFactory:
        """The forecaster that these examples lead to."""
        return self.wrap(self.base.fit(examples, seed))

    def fit_folds(
        self,
        examples: Examples,
        held_out: Sequence[Collection[str]],
        seed: int,
        progress: Callable[[], object],
    ) -> list[AnyFactory]:
        """The forecaster of each of several folds."""
        return [
            self.wrap(base) for base in fit_folds(self.base, examples, held_out, seed, progress)
        ]
