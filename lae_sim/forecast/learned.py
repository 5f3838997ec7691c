"""A learned forecaster (extra ``torch``): a small network over the last outputs.

The network sees the last velocities of the centre, in target sizes per frame, and of the logarithms
of width and height, with the intervals between them and the frames to look ahead, and answers with
weights for these velocities and a correction. It starts as a mean of the last three velocities, is
mirrored in x and y so that no direction is preferred, and predicts at any horizon. A regression on
past motion is PVT++'s idea (Li et al., "PVT++: A Simple End-to-End Latency-Aware Visual Tracking
Framework", ICCV 2023, Sec. 4); weights over velocities, and training on the overlap, are new here.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.datasets.names import video_of
from lae_sim.errors import LaeError
from lae_sim.files import written_whole
from lae_sim.forecast.window import Window, Windowed

FORMAT = "lae-forecaster"
VERSION = 1
VELOCITIES = 8
HIDDEN = 128
_CORRECTION = 0.05  # target sizes per frame: what an output of 1 stands for
_MIRRORS = ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))
_CONTEXT = 4 * VELOCITIES + 2 * VELOCITIES + 3


@dataclass(frozen=True, eq=False)
class Learned:
    """The rule of a trained network.

    Attributes:
        network: a torch module, from [P, inputs] to [P, outputs].
        document: what it was trained on and how, as JSON; ``sequences`` names its sequences.
    """

    network: Any
    document: Mapping[str, Any]

    size = VELOCITIES + 1

    @property
    def trained_on(self) -> Sequence[str]:
        """Names of the sequences that it was trained on."""
        names: Sequence[str] = self.document["sequences"]
        return names

    def notes(self, sequences: Sequence[str]) -> list[str]:
        """Whether it was trained on some of these sequences, or on parts of the same videos."""
        known = {video_of(name) for name in self.trained_on}
        seen = sum(video_of(name) in known for name in sequences)
        return [f"trained on {seen} of these {len(sequences)} sequences"] if seen else []

    def __call__(self, window: Window, ahead: Floats) -> Floats:
        """Boxes, float64 [P, 4], so many frames [P] after the newest output of each window."""
        import torch

        count = len(ahead)
        signs = torch.tensor(_MIRRORS).repeat_interleave(count, dim=0)
        with one_thread(), torch.inference_mode():
            inputs = Inputs.of(window, ahead).rows(torch.arange(count).repeat(len(_MIRRORS)))
            change = inputs.stretched(signs).change(self.network)
            change[:, :2] *= signs
            mean = change.reshape(len(_MIRRORS), count, 4).mean(0)
        return _moved(window.boxes[:, 0], mean.numpy().astype(np.float64))


@dataclass(frozen=True, eq=False)
class Inputs:
    """What the network sees of P windows; torch tensors, float32.

    Attributes:
        velocities: of centre x and y in target sizes, and of the logarithms of width and height,
            per frame, newest first, [P, n, 4]; 0 where unknown.
        intervals: frame intervals between the outputs of each velocity, [P, n]; 0 where unknown.
        ahead: frames from the newest output to the query, [P].
        shape: logarithms of the target's size (over 50 px) and aspect, [P, 2].
    """

    velocities: Any
    intervals: Any
    ahead: Any
    shape: Any

    @classmethod
    def of(cls, window: Window, ahead: Floats) -> Inputs:
        """The inputs of some windows."""
        import torch

        sides = np.log(np.maximum(window.boxes[..., 2:], 1.0))
        centres = window.boxes[..., :2] + window.boxes[..., 2:] / 2
        scale = np.exp(sides[:, :1].mean(axis=2, keepdims=True))
        states = np.concatenate([centres / scale, sides], axis=2)
        intervals = (window.frames[:, :-1] - window.frames[:, 1:]) * window.known[:, 1:]
        velocities = (states[:, :-1] - states[:, 1:]) / np.where(intervals > 0, intervals, 1)[
            ..., None
        ]
        shape = [np.log(scale[:, 0, 0] / 50), sides[:, 0, 0] - sides[:, 0, 1]]
        parts = (velocities, intervals, np.maximum(ahead, 0), np.stack(shape, axis=1))
        return cls(*(torch.from_numpy(part.astype(np.float32)) for part in parts))

    def stretched(self, factors: Any) -> Inputs:
        """The same with the motion in x and y multiplied by factors, [P, 2]; -1 mirrors it."""
        import torch

        moved = self.velocities[..., :2] * factors[:, None]
        velocities = torch.cat([moved, self.velocities[..., 2:]], 2)
        return Inputs(velocities, self.intervals, self.ahead, self.shape)

    def flipped(self, which: Any) -> Inputs:
        """The same with x and y exchanged in some windows, bool [P]."""
        import torch

        exchanged = self.velocities[..., [1, 0, 3, 2]]
        velocities = torch.where(which[:, None, None], exchanged, self.velocities)
        shape = torch.where(which[:, None], self.shape * torch.tensor([1.0, -1.0]), self.shape)
        return Inputs(velocities, self.intervals, self.ahead, shape)

    def rows(self, which: Any) -> Inputs:
        """Some of the windows."""
        parts = (self.velocities, self.intervals, self.ahead, self.shape)
        return Inputs(*(part[which] for part in parts))

    def change(self, network: Any) -> Any:
        """Change of centre (target sizes) and log sides up to the query, [P, 4]."""
        import torch

        known = (self.intervals > 0).float()
        context = [
            torch.asinh(20 * self.velocities.flatten(1)) / 2,
            self.intervals / 5,
            known,
            torch.log(self.ahead[:, None] + 0.5),
            self.shape,
        ]
        output = network(torch.cat(context, 1))
        n = VELOCITIES
        weights = output[:, : 2 * n].reshape(-1, 2, n) * known[:, None]
        centre = (weights[:, 0, :, None] * self.velocities[..., :2]).sum(1)
        sides = (weights[:, 1, :, None] * self.velocities[..., 2:]).sum(1)
        correction = _CORRECTION * known[:, :1] * output[:, 2 * n :]
        return (torch.cat([centre, sides], 1) + correction) * self.ahead[:, None]


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread: sums in one order whatever the machine, and little is lost."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def new_network() -> Any:
    """An untrained network, from torch's random state."""
    import torch

    network: Any = torch.nn.Sequential(
        torch.nn.Linear(_CONTEXT, HIDDEN),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN, HIDDEN),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN, 2 * VELOCITIES + 4),
    )
    with torch.no_grad():
        network[-1].weight.mul_(0.1)
        network[-1].bias.zero_()
        network[-1].bias[:3] = network[-1].bias[VELOCITIES : VELOCITIES + 3] = 1 / 3
    return network


def sides_and_size(boxes: Floats) -> tuple[Floats, Floats]:
    """Width and height, at least 1 px, [..., 2], and their geometric mean, [..., 1]."""
    sides = np.maximum(boxes[..., 2:], 1.0)
    return sides, np.sqrt(sides[..., :1] * sides[..., 1:])


def _moved(boxes: Floats, change: Floats) -> Floats:
    """Boxes moved and resized by a change of centre (target sizes) and log sides."""
    _, scale = sides_and_size(boxes)
    centre = boxes[:, :2] + boxes[:, 2:] / 2 + change[:, :2] * scale
    new = boxes[:, 2:] * np.exp(np.clip(change[:, 2:], -1.0, 1.0))
    return np.concatenate([centre - new / 2, new], axis=1)


def write_learned(learned: Learned, path: str | os.PathLike[str]) -> None:
    """Write a trained network, whole or not at all.

    Raises:
        LaeError: if the file cannot be written.
    """
    import torch

    document = {"format": FORMAT, "version": VERSION, **learned.document}
    file = io.BytesIO()  # torch does not say that a disk is full as others do
    torch.save({**document, "network": learned.network.state_dict()}, file)
    with written_whole(path) as temporary:
        temporary.write_bytes(file.getvalue())


def read_learned(path: str | os.PathLike[str]) -> Windowed[Learned]:
    """Read a trained network; nothing in the file is executed.

    Raises:
        LaeError: if torch is missing, or the file is no network of this format.
    """
    torch = import_torch()
    try:
        document = torch.load(path, map_location="cpu", weights_only=True)
        if document.pop("format") != FORMAT or document.pop("version") != VERSION:
            raise ValueError(f"not {FORMAT} version {VERSION}")
        network = new_network()
        network.load_state_dict(document.pop("network"))
        if not all(parameter.isfinite().all() for parameter in network.parameters()):
            raise ValueError("its weights are not finite")
        names = document["sequences"]
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise ValueError("its sequences are no names")
    except FileNotFoundError as error:
        raise LaeError(f"{path}: no such file") from error
    except Exception as error:  # torch, pickle and zipfile raise all kinds on damaged files
        reason = re.split(r"\n|\. ", str(error))[0][:200]  # torch goes on with bad advice
        raise LaeError(f"{path}: not a forecaster that lae-sim train wrote: {reason}") from error
    return Windowed(Learned(network.eval(), document))


def import_torch() -> Any:
    """The torch module.

    Raises:
        LaeError: if it is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise LaeError(
            "the learned forecaster needs torch: pip install 'lae-sim[torch]'"
        ) from error
    return torch
