"""Networks of random weights, for tests that need one but no training."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from lae_sim.forecast.learned import INPUTS, OUTPUTS, Learned
from lae_sim.forecast.network import Network


def random_network(widths: list[int], seed: int = 0, document: Any = None) -> Network:
    """A network whose answers are of the order of 1 where its inputs are."""
    rng = np.random.default_rng(seed)
    shapes = list(pairwise(widths))
    return Network.rounded(
        [rng.normal(0, 1.5 / np.sqrt(shape[0]), shape) for shape in shapes],
        [rng.normal(0, 0.3, shape[1]) for shape in shapes],
        {} if document is None else document,
    )


def random_learned(seed: int = 0, hidden: int = 16) -> Learned:
    """A forecaster by such a network."""
    document = {"sequences": ["s0", "s1"], "seed": seed}
    return Learned(random_network([INPUTS, hidden, hidden, OUTPUTS], seed, document))
