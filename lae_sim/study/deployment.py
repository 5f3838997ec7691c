"""What a required AUC asks of a device: how slow may the tracker be, how fast the world."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_groups
from lae_sim.evaluation.metrics import find_convention
from lae_sim.forecast.base import AnyFactory, Hold
from lae_sim.study.cells import Cell, replayed
from lae_sim.trace.file import Trace, held, read_trace

STEP = Fraction(1, 100)
MOST = 1 << 13
"""Scales are looked for in hundredths, up to 81.92: all times so much longer."""

_RELATIVE = ("latest", "fifo", "every")  # policies that know no absolute times

HELD = 1_000_000
"""World frames of a trace that is kept in memory for a search; a larger one is read each time."""


@dataclass(frozen=True)
class Search:
    """The search for the slowest device on which a tracker still has a mean AUC.

    Attributes:
        cell: what is replayed, at other scales than its own, at its first sigma.
        required: the mean AUC.
        factory: the cell's forecaster.
    """

    cell: Cell
    required: Fraction
    factory: AnyFactory = Hold

    @property
    def key(self) -> str:
        """Digest of all that the answer depends on."""
        told = f"{self.cell.key} {self.required} {STEP} {MOST}"
        return hashlib.sha256(told.encode()).hexdigest()[:32]


def searches(cells: Sequence[Cell], required: Fraction) -> list[Search]:
    """One search for all cells that differ in their scale or repetitions alone."""
    counts: dict[Cell, int] = {}
    for cell in cells:
        world = cell.setting.world
        world = replace(world, scale=Fraction(1), sigmas=world.sigmas[:1])
        setting = replace(cell.setting, world=world, first=0, count=1)
        alike = replace(cell, setting=setting)
        counts[alike] = max(counts.get(alike, 1), cell.setting.first + cell.setting.count)
    return [
        Search(replace(cell, setting=replace(cell.setting, count=count)), required)
        for cell, count in counts.items()
    ]


def slowest(search: Search) -> dict[str, Any]:
    """The largest scale of all times at which the mean AUC is what is required.

    Found by bisection over hundredths, as if the AUC fell with every step; the scale and the next
    one are both replayed, so that what is told of these two is exact.

    Returns:
        ``scale`` and ``beyond``, the hundredth after it, as text, with their ``auc`` and
        ``beyond_auc``; ``auc_without_latency``. ``scale`` is None if even without latency the AUC
        is too low, ``beyond`` if it is enough at the largest scale that is tried.
    """
    known: dict[int, float] = {}
    setting = search.cell.setting
    trace = held(read_trace(setting.trace.path, setting.sequences or None), HELD)

    def enough(step: int) -> bool:
        if step not in known:
            known[step] = mean_auc(search, step * STEP, trace)
        return known[step] >= search.required

    found: dict[str, Any] = dict.fromkeys(("scale", "auc", "beyond", "beyond_auc"))
    if not enough(0):
        found |= {"beyond": "0", "beyond_auc": known[0]}
    else:
        low, high = 0, 1
        while enough(high) and high < MOST:
            low, high = high, 2 * high
        if enough(high):
            low = high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if enough(middle) else (low, middle)
        found |= {"scale": str(low * STEP), "auc": known[low]}
        if high > low:
            found |= {"beyond": str(high * STEP), "beyond_auc": known[high]}
    return {**found, "auc_without_latency": known[0]}


def mean_auc(search: Search, scale: Fraction, trace: Trace) -> float:
    """The mean AUC over sequences and repetitions at a scale of all times."""
    cell = search.cell
    setting = replace(cell.setting, world=replace(cell.setting.world, scale=scale))
    parts = evaluate_groups(
        (run for _, run in replayed(setting, trace).runs),
        trace.metadata,
        {cell.forecaster: search.factory},
        setting.world.sigmas,
        find_convention(cell.setting.world.convention),
        costs={cell.forecaster: cell.cost_ns},
    )
    scores = np.concatenate([part.scores["auc"][0, :, 0] for part in parts])
    if np.isnan(scores).all():
        raise LaeError("no sequence counts in the mean AUC: its truth is nowhere valid")
    return float(np.nanmean(scores))


def requirement(search: Search, found: Mapping[str, Any]) -> dict[str, Any]:
    """The answer as a row.

    Where no time is absolute, as a cost or an expected time of a policy is, a schedule depends on
    processing times in frames alone: times scaled by f are a world that moves f times as fast, with
    the recorded motion from frame to frame (but for the rounding to whole ns).
    """
    setting = search.cell.setting
    scale = None if found["scale"] is None else Fraction(found["scale"])
    relative = search.cell.cost_ns == 0 and setting.policy.split(":")[0] in _RELATIVE
    return {
        "trace": setting.trace.label,
        "times_from": (setting.timing or setting.trace).label,
        "policy": setting.policy,
        "fps": str(setting.fps),
        "latency": setting.latency,
        "convention": search.cell.setting.world.convention,
        "forecaster": search.cell.forecaster,
        "sigma": str(setting.world.sigmas[0]),
        "required_auc": float(search.required),
        **found,
        "speed_up": None if not scale else float(1 / scale),
        "fps_at_most": float(scale * setting.fps) if scale is not None and relative else None,
    }
