"""Training: the learned forecaster's network, and the numbers of a tuned Kalman filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import iou
from lae_sim.errors import LaeError
from lae_sim.forecast.base import ForecasterFactory
from lae_sim.forecast.camera import Camera, CameraCompensated
from lae_sim.forecast.kalman import PAPER
from lae_sim.forecast.learned import (
    Inputs,
    Learned,
    import_torch,
    new_network,
    one_thread,
    sides_and_size,
)
from lae_sim.forecast.window import Window, Windowed
from lae_sim.learning.folds import Examples, Trainer


@dataclass(frozen=True)
class NetworkTrainer:
    """Trains a network by gradient descent on the overlap with what came.

    Half of the loss is 1 - IoU with the truth and half with the tracker's own box of that frame (Yu
    et al., "UnitBox", 2016, minimise -ln IoU); a small term in the distance of the centres draws
    boxes that do not overlap. AdamW (Loshchilov and Hutter, 2019) with the one-cycle rate (Smith
    and Topin, 2019).

    Attributes:
        steps: steps of gradient descent.
        batch: queries of each.
        rate: largest learning rate.
        faster: motion is made faster or slower by a random factor; the standard deviation of its
            logarithm. It is mirrored, too, and x and y change places, since motion that is not in
            the traces may come as well.
        progress: called after each step with how many more are done.
    """

    steps: int = 1000
    batch: int = 2048
    rate: float = 3e-3
    faster: float = 0.3
    progress: Callable[[int], object] = lambda steps: None

    def fit(self, examples: Examples, seed: int = 0) -> Windowed[Learned]:
        """Train on all examples; the same seed and torch give the same network on like processors.

        Raises:
            LaeError: if torch is missing, or there is nothing to learn from.
        """
        torch = import_torch()
        ahead = (examples.frame - examples.lanes.frames[examples.item]).astype(np.float64)
        usable = (ahead > 0) & (_sized(examples.truth) | _sized(examples.boxes))
        if not usable.any():
            raise LaeError("there is nothing to learn from: no output answers a later frame")
        with one_thread():
            network = self._descend(torch, examples, np.flatnonzero(usable), ahead, seed)
        document = {"sequences": sorted(set(examples.sequences)), "seed": seed, "steps": self.steps}
        return Windowed(Learned(network.eval(), document))

    def _descend(
        self, torch: Any, examples: Examples, usable: Ints, ahead: Floats, seed: int
    ) -> Any:
        cumulative = np.cumsum(examples.weight[usable])
        generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = new_network()
        optimiser = torch.optim.AdamW(network.parameters(), lr=self.rate, weight_decay=1e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser,
            self.rate,
            total_steps=self.steps,
            pct_start=0.1 + 1e-9,  # torch divides by zero where this is exactly one step
        )
        for _ in range(self.steps):
            drawn = torch.rand(self.batch, generator=generator, dtype=torch.float64).numpy()
            drawn = np.searchsorted(cumulative, drawn * cumulative[-1])
            which = usable[np.minimum(drawn, len(usable) - 1)]
            window = Window.of(examples.lanes, examples.item[which], Learned.size)
            goal = torch.from_numpy(_goals(window.boxes[:, 0], examples, which))
            signs = 1.0 - 2.0 * torch.randint(2, (self.batch, 2), generator=generator)
            faster = torch.exp(self.faster * torch.randn(self.batch, 1, generator=generator))
            flipped = torch.rand(self.batch, generator=generator) < 0.5
            inputs = Inputs.of(window, ahead[which])
            shown = inputs.stretched(signs * faster).flipped(flipped)
            goal = goal * torch.cat([signs * faster, torch.ones(self.batch, 4)], 1)[:, None]
            goal = torch.where(flipped[:, None, None], goal[..., [1, 0, 3, 2, 5, 4]], goal)
            loss = _loss(shown.change(network), goal).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            self.progress(1)
        return network


def _sized(boxes: Floats) -> Bools:
    """Which boxes have a width and a height."""
    sized: Bools = np.logical_and.reduce(boxes[:, 2:] > 0, axis=1)
    return sized


def _goals(latest: Floats, examples: Examples, which: Ints) -> Any:
    """Truth and the tracker's later box as changes from the latest one, float32 [P, 2, 4].

    Where one of them is missing the other stands for both.
    """
    truth, boxes = examples.truth[which], examples.boxes[which]
    truth = np.where(_sized(truth)[:, None], truth, boxes)
    boxes = np.where(_sized(boxes)[:, None], boxes, truth)
    goals = np.stack([truth, boxes], axis=1)
    sides, scale = sides_and_size(latest[:, None])
    centre = goals[..., :2] + goals[..., 2:] / 2 - latest[:, None, :2] - latest[:, None, 2:] / 2
    logs = np.log(goals[..., 2:] / sides)
    aspect = np.broadcast_to(np.log(sides / scale), logs.shape)
    return np.concatenate([centre / scale, logs, aspect], axis=2).astype(np.float32)


def _loss(change: Any, goals: Any) -> Any:
    """1 - IoU, mean over both goals, and the distance of the centres, [P]."""
    import torch

    offset = goals[..., :2] - change[:, None, :2]
    aspect = goals[..., 4:]
    sides = torch.exp(change[:, None, 2:].clamp(-1, 1) + aspect)  # in target sizes
    goal_sides = torch.exp(goals[..., 2:4] + aspect)
    shared = (torch.minimum(sides / 2, offset + goal_sides / 2)).sub(
        torch.maximum(-sides / 2, offset - goal_sides / 2)
    )
    overlap = shared.clamp(min=0).prod(2)
    union = sides.prod(2) + goal_sides.prod(2) - overlap
    distance = torch.sqrt(offset.pow(2).sum(2) + 0.01).clamp(max=2)
    return (1 - overlap / union + 0.1 * distance).mean(1)


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

    def fit(self, examples: Examples, seed: int = 0) -> ForecasterFactory:
        """The filter that suits all examples best; the seed plays no part.

        Raises:
            LaeError: if there is no truth to learn from.
        """
        valid = np.flatnonzero(_sized(examples.truth))
        if not len(valid):
            raise LaeError("there is nothing to learn from: no frame has a truth")
        item, frame, truth = examples.item[valid], examples.frame[valid], examples.truth[valid]
        weight = examples.weight[valid]
        tried: dict[Any, float] = {}

        def score(settings: Any) -> float:
            if settings not in tried:
                boxes = settings.forecast_lanes(examples.lanes, item, frame)
                tried[settings] = float((iou(truth, boxes) * weight).sum())
            return tried[settings]

        best, before = PAPER, None
        while best != before:
            before = best
            for name in ("q", "decay", "state"):
                choices = [replace(best, **{name: value}) for value in getattr(self, name)]
                best = max([best, *choices], key=score)
        return best


@dataclass(frozen=True, eq=False)
class CameraTrainer:
    """Trains the base forecaster on boxes as they are seen, and runs it over the camera's motion.

    Attributes:
        base: trains the forecaster of the target's motion.
        camera: the camera's motion.
    """

    base: Trainer
    camera: Camera

    def fit(self, examples: Examples, seed: int) -> CameraCompensated:
        """The forecaster that these examples lead to."""
        return CameraCompensated(self.base.fit(examples, seed), self.camera)
