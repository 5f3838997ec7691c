"""What a required AUC asks of a device: how slow may the tracker be, how fast the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_groups
from lae_sim.evaluation.metrics import find_convention
from lae_sim.evaluation.modelled import Ranking
from lae_sim.files import text_digest
from lae_sim.forecast.base import AnyFactory, Hold
from lae_sim.study.cells import Cell, replayed
from lae_sim.study.records import Requirement
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
        return text_digest(f"{self.cell.key} {self.required} {STEP} {MOST}")


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


@dataclass(frozen=True)
class Slowest:
    """The answer to a search.

    Attributes:
        auc_without_latency: the mean AUC at scale 0.
        scale: the largest scale at which it is what is required, as text; None if there is none.
        auc: the mean AUC there.
        beyond: the hundredth after it, as text; None if the largest that is tried is enough.
        beyond_auc: the mean AUC there.
        modelled: whether these are modelled: wherever a replay is not exact, its reach is known.
    """

    auc_without_latency: float
    scale: str | None = None
    auc: float | None = None
    beyond: str | None = None
    beyond_auc: float | None = None
    modelled: bool = False


def slowest(search: Search) -> Slowest:
    """The largest scale of all times at which the mean AUC is what is required.

    By bisection over hundredths, as if the AUC fell with every step; the scale and the next one are
    both replayed, so that what is said of these two is exact.
    """
    known: dict[int, float] = {}
    modelled = False
    setting = search.cell.setting
    trace = held(read_trace(setting.trace.path, setting.sequences or None), HELD)

    def enough(step: int) -> bool:
        nonlocal modelled
        if step not in known:
            known[step], by_model = mean_auc(search, step * STEP, trace)
            modelled = modelled or by_model
        return known[step] >= search.required

    if not enough(0):
        return Slowest(known[0], beyond="0", beyond_auc=known[0], modelled=modelled)
    low, high = 0, 1
    while enough(high) and high < MOST:
        low, high = high, 2 * high
    if enough(high):
        return Slowest(known[0], str(high * STEP), known[high], modelled=modelled)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if enough(middle) else (low, middle)
    ends = str(low * STEP), known[low], str(high * STEP), known[high]
    return Slowest(known[0], *ends, modelled=modelled)


def mean_auc(search: Search, scale: Fraction, trace: Trace) -> tuple[float, bool]:
    """The mean AUC over sequences and repetitions at a scale of all times.

    It is the one by which the replay would be ranked (:class:`.modelled.Ranking`), and whether that
    is the modelled one.
    """
    cell = search.cell
    setting = replace(cell.setting, world=replace(cell.setting.world, scale=scale))
    groups = evaluate_groups(
        (run for _, run in replayed(setting, trace).runs),
        trace.metadata,
        {cell.forecaster: search.factory},
        setting.world.sigmas,
        find_convention(cell.convention),
        costs={cell.forecaster: cell.cost_ns},
    )
    parts = list(groups)
    modelled = Ranking.of(
        (part.modelled.known, not part.replay.departures.any()) for part in parts
    ).modelled
    scores = np.concatenate(
        [(part.modelled.mean if modelled else part.scores)["auc"][0, :, 0] for part in parts]
    )
    if np.isnan(scores).all():
        raise LaeError("no sequence counts in the mean AUC: its truth is nowhere valid")
    return float(np.nanmean(scores)), modelled


def requirement(search: Search, answer: Slowest) -> Requirement:
    """What the required AUC asks for.

    Where no time is absolute, as a cost or an expected time of a policy is, a schedule depends on
    processing times in frames alone: times scaled by f are a world that moves f times as fast, with
    the recorded motion from frame to frame (but for the rounding to whole ns).
    """
    setting = search.cell.setting
    scale, beyond = (None if x is None else Fraction(x) for x in (answer.scale, answer.beyond))
    relative = search.cell.cost_ns == 0 and setting.policy.split(":")[0] in _RELATIVE
    return Requirement(
        trace=setting.trace.label,
        times_from=(setting.timing or setting.trace).label,
        policy=setting.policy,
        fps=setting.fps,
        latency=setting.latency,
        search=setting.world.search,
        pre_forecaster=setting.pre_forecaster,
        convention=search.cell.convention,
        forecaster=search.cell.forecaster,
        sigma=setting.world.sigmas[0],
        required_auc=float(search.required),
        scale=scale,
        auc=answer.auc,
        beyond=beyond,
        beyond_auc=answer.beyond_auc,
        auc_without_latency=answer.auc_without_latency,
        speed_up=None if not scale else float(1 / scale),
        fps_at_most=float(scale * setting.fps) if scale is not None and relative else None,
        ranked_by="modelled" if answer.modelled else "recorded",
    )
