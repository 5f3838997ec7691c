"""What a required AUC asks of a device: how slow may the tracker be, how fast the world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import pairwise

import numpy as np

from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_groups
from lae_sim.evaluation.metrics import find_convention
from lae_sim.evaluation.modelled import Ranking
from lae_sim.files import text_digest
from lae_sim.forecast.base import AnyFactory, Hold
from lae_sim.study.cells import Cell, replayed
from lae_sim.study.records import Requirement
from lae_sim.trace.file import Trace, read_held

STEP = Fraction(1, 100)
MOST = 1 << 13
"""Scales are tried in hundredths, up to 81.92: all times so much longer."""

FINE = 10
"""Scales that are tried between two coarse ones, at most, where only one of them is enough."""

_GROWTH = 1.15  # of the coarse scales
_RELATIVE = ("latest", "fifo", "every")  # policies that know no absolute times

HELD = 1_000_000
"""World frames of a trace that is kept in memory for a search; a larger one is read each time."""


@dataclass(frozen=True)
class Search:
    """The search for how slow a device may be for a tracker still to have some mean AUCs.

    Attributes:
        cell: what is replayed, at other scales than its own, at its first sigma.
        required: the mean AUCs, ascending.
        factory: the cell's forecaster.
    """

    cell: Cell
    required: tuple[Fraction, ...]
    factory: AnyFactory = Hold

    @property
    def key(self) -> str:
        """Digest of all that the answer depends on."""
        asked = " ".join(map(str, self.required))
        return text_digest(f"{self.cell.key} {asked} {STEP} {MOST} {FINE} {_GROWTH}")


def searches(cells: Sequence[Cell], required: Sequence[Fraction]) -> list[Search]:
    """One search for all cells that differ in their scale or repetitions alone."""
    counts: dict[Cell, int] = {}
    for cell in cells:
        world = cell.setting.world
        world = replace(world, scale=Fraction(1), sigmas=world.sigmas[:1])
        setting = replace(cell.setting, world=world, first=0, count=1)
        alike = replace(cell, setting=setting)
        counts[alike] = max(counts.get(alike, 1), cell.setting.first + cell.setting.count)
    return [
        Search(replace(cell, setting=replace(cell.setting, count=count)), tuple(sorted(required)))
        for cell, count in counts.items()
    ]


@dataclass(frozen=True)
class Curve:
    """The mean AUC at the scales that were tried.

    Attributes:
        steps: the scales in hundredths, ascending, from 0 on.
        auc: the mean AUC at each.
        elapsed_ms: the mean time of a call but the initialisation at each; None without a call.
        modelled: whether these are modelled: wherever a replay is not exact, its reach is known.
    """

    steps: Sequence[int]
    auc: Sequence[float]
    elapsed_ms: Sequence[float | None]
    modelled: bool = False

    def stretches(self, required: Fraction) -> list[tuple[int, int]]:
        """The first and last place of each row of scales at which the AUC is what is required."""
        enough = [auc >= required for auc in self.auc]
        first = [i for i, here in enumerate(enough) if here and not (i and enough[i - 1])]
        last = [i for i, here in enumerate(enough) if here and not any(enough[i + 1 : i + 2])]
        return list(zip(first, last))


def measured(search: Search) -> Curve:
    """The mean AUC at as many scales as it takes to say where it is what is required."""
    setting = search.cell.setting
    trace = read_held(setting.trace.path, setting.sequences or None, frames=HELD)
    found: dict[int, tuple[float, float | None, bool]] = {}

    def auc(step: int) -> float:
        found[step] = mean_auc(search, step * STEP, trace)
        return found[step][0]

    tried = scan(auc, search.required)
    elapsed = [found[step][1] for step in tried]
    return Curve([*tried], [*tried.values()], elapsed, any(by for _, _, by in found.values()))


def scan(auc: Callable[[int], float], required: Sequence[Fraction]) -> dict[int, float]:
    """The AUC at scales in hundredths, by scale, ascending; dense where it crosses what is asked.

    No order is assumed: stalls, and calls that come into step with the camera, make the AUC rise
    with slower times. Those are tried that bisection would (:func:`bisected`); coarse scales, each
    some 15 % above the one before, up to twice the last that is enough; between two of which one
    only is enough, `FINE` in an even distance; and each change between these is followed to the
    hundredth. (What comes and goes between two coarse scales is not seen.)
    """
    known: dict[int, float] = {}

    def enough(step: int, least: Fraction) -> bool:
        if step not in known:
            known[step] = auc(step)
        return known[step] >= least

    for least in required:
        bisected(partial(enough, least=least))
    last = round(1 / STEP)
    for step in _coarse():
        if enough(step, min(required)):
            last = max(last, step)
        if step >= 2 * last:
            break

    def changes() -> list[tuple[int, int]]:
        """Neighbours of which one only is enough for something."""
        pairs = list(pairwise(sorted(known)))
        return [
            (low, high)
            for least in required
            for low, high in pairs
            if high - low > 1 and enough(low, least) != enough(high, least)
        ]

    for low, high in changes():
        for step in range(low, high, -((low - high) // FINE)):
            enough(step, required[0])
    while crossings := changes():  # halved until they are neighbouring hundredths
        for low, high in crossings:
            enough((low + high) // 2, required[0])
    return dict(sorted(known.items()))


def bisected(enough: Callable[[int], bool]) -> tuple[int | None, int | None]:
    """The last scale that is enough and the hundredth after, as if none after it were.

    None for the first where no latency at all is not enough, for the second where the largest is.
    """
    if not enough(0):
        return None, 0
    low, high = 0, 1
    while enough(high) and high < MOST:
        low, high = high, 2 * high
    if enough(high):
        return high, None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if enough(middle) else (low, middle)
    return low, high


def _coarse() -> list[int]:
    """0, and scales in hundredths from 0.01 to the largest, 1 among them."""
    steps = [round(100 * _GROWTH**k) for k in range(-16, 32)]
    return [0, 1, *(step for step in steps if step < MOST), MOST]


def mean_auc(search: Search, scale: Fraction, trace: Trace) -> tuple[float, float | None, bool]:
    """The mean AUC over sequences and repetitions at a scale of all times.

    It is the one by which the replay would be ranked (:class:`.modelled.Ranking`). With it: the
    mean time of a call but the initialisation, in ms, and whether the AUC is the modelled one.
    """
    cell = search.cell
    setting = replace(cell.setting, world=replace(cell.setting.world, scale=scale))
    groups = evaluate_groups(
        replayed(setting, trace),
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
    calls = np.concatenate([part.replay.processed - 1 for part in parts])
    elapsed = np.concatenate([part.replay.calls_ns for part in parts])[calls > 0]
    mean_ms = float((elapsed / calls[calls > 0]).mean()) / 1e6 if len(elapsed) else None
    return float(np.nanmean(scores)), mean_ms, modelled


def requirement(search: Search, curve: Curve, required: Fraction) -> Requirement:
    """What a required AUC asks for.

    Where no time is absolute, as a cost or an expected time of a policy is, a schedule depends on
    processing times in frames alone: times scaled by f are a world that moves f times as fast, with
    the recorded motion from frame to frame (but for the rounding to whole ns).
    """
    setting = search.cell.setting
    scales, auc = [step * STEP for step in curve.steps], dict(zip(curve.steps, curve.auc))
    stretches = curve.stretches(required)
    last, beyond = bisected(lambda step: auc[step] >= required)
    scale = None if last is None else last * STEP
    safe = _nearest(stretches, scales)
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
        required_auc=float(required),
        scale=scale,
        auc=None if last is None else auc[last],
        beyond=None if beyond is None else beyond * STEP,
        beyond_auc=None if beyond is None else auc[beyond],
        auc_without_latency=curve.auc[0],
        speed_up=None if not scale else float(1 / scale),
        fps_at_most=float(scale * setting.fps) if scale is not None and relative else None,
        ranked_by="modelled" if curve.modelled else "recorded",
        safe_scale=None if safe is None else scales[safe],
        safe_auc=None if safe is None else curve.auc[safe],
        safe_ms_per_frame=None if safe is None else curve.elapsed_ms[safe] or None,
        next_auc=None if safe is None or safe + 1 == len(scales) else curve.auc[safe + 1],
        stretches=tuple((scales[a], scales[b]) for a, b in stretches),
    )


def _nearest(stretches: Sequence[tuple[int, int]], scales: Sequence[Fraction]) -> int | None:
    """The place of the slowest scale in the stretch that scale 1 is in.

    Else in the last below it that is more than no latency at all, else in the first above.
    """
    timed = [(a, b) for a, b in stretches if scales[b] > 0] or stretches
    before = [b for a, b in timed if scales[a] <= 1]
    return before[-1] if before else timed[0][1] if timed else None
