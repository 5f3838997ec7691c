"""What ``lae-sim show`` says of a gap pass: the tracker's reach, in words and as a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.errors import visible
from lae_sim.figures.style import BLUE, SKY_BLUE, VERMILION, new_figure, styled
from lae_sim.replay.reach import (
    LAPSE,
    LEAST_RESTARTS,
    OwnJump,
    Reach,
    Restart,
    fit_reach,
    own_jumps,
    restarts_of,
)
from lae_sim.report.table import COUNT, PERCENT, Cell, Column, Table, text_of
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Search

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BIN_EDGES = (0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, math.inf)
"""Of the distances in tables, in units of ``search_side``."""

_Z95 = 1.959964  # normal quantile of a 95 % interval
_WAYS = {"at once": BLUE, "later": SKY_BLUE, "not": VERMILION}


@dataclass(frozen=True)
class Bin:
    """The restarts over some distances.

    Attributes:
        start, stop: the distances, in units of ``search_side``; ``start <= distance < stop``, and
            ``stop`` is None where they have no end.
        distance: their mean.
        restarts, found: how many there are, and in how many the target was found.
        share, share_low, share_high: of those found, and Wilson's 95 % interval of it.
    """

    start: float
    stop: float | None
    distance: float
    restarts: int
    found: int
    share: float
    share_low: float
    share_high: float


@dataclass(frozen=True, eq=False)
class ReachReport:
    """What a gap pass shows.

    Attributes:
        tracker: its name.
        search: where it says that it searches.
        reach: the fitted curve; None if the restarts do not tell one.
        restarts: those whose truth is known.
        jumps: the own jumps of each sequence.
    """

    tracker: str
    search: Search | None
    reach: Reach | None
    restarts: Sequence[Restart]
    jumps: Mapping[str, Sequence[OwnJump]]

    @classmethod
    def of(cls, trace: Trace) -> ReachReport:
        """What a gap pass shows; it is read twice.

        Raises:
            LaeError: if the trace is none, or damaged.
        """
        metadata, restarts = trace.metadata, restarts_of(trace)
        return cls(
            metadata.tracker, metadata.search, fit_reach(restarts), restarts, own_jumps(trace)
        )

    def bins(self) -> list[Bin]:
        """The restarts by distance, without bins that hold none."""
        distance = np.array([restart.distance for restart in self.restarts])
        found = np.array([restart.found for restart in self.restarts], bool)
        bins = []
        for start, stop in pairwise(BIN_EDGES):
            here = (distance >= start) & (distance < stop)
            n, hits = int(here.sum()), int(found[here].sum())
            if n:
                end = None if math.isinf(stop) else stop
                mean = float(distance[here].mean())
                bins.append(Bin(start, end, mean, n, hits, hits / n, *_wilson(hits, n)))
        return bins

    def document(self) -> dict[str, Any]:
        """The report as JSON values; the reach's own figures are null where it is not known."""
        unknown = dict.fromkeys(("centre", "spread", "centre_error", "spread_error"))
        return {
            **(unknown if self.reach is None else asdict(self.reach)),
            "restarts": len(self.restarts),
            "found": sum(restart.found for restart in self.restarts),
            "declared": None if self.search is None else asdict(self.search),
            "bins": [asdict(each) for each in self.bins()],
            "own_jumps": {
                name: [
                    {
                        "gap": jump.gap,
                        "distance": None if math.isnan(jump.distance) else jump.distance,
                        "found": _found(jump),
                        "found_after": _found_after(jump),
                    }
                    for jump in jumps
                ]
                for name, jumps in self.jumps.items()
            },
        }

    def text(self) -> str:
        """The report for people."""
        parts = [self._summary()]
        if bins := self.bins():
            parts.append(text_of(_bin_table(bins)))
        if self.jumps:
            parts.append(text_of(_jump_table(self.jumps)) + "\n" + _JUMP_LEGEND)
        return "\n\n".join(parts)

    def _summary(self) -> str:
        count = len(self.restarts)
        found = sum(restart.found for restart in self.restarts)
        if self.reach is not None:
            reach = self.reach
            centre = f"{reach.centre:.3f} (standard error {reach.centre_error:.3f})"
            spread = f"{reach.spread:.3f} ({reach.spread_error:.3f})"
            said = (
                f"reach        centre {centre}, logistic scale {spread}, of {count:,} restarts\n"
                f"             half of the targets are found {reach.centre:.2f} search sides away"
            )
        elif count < LEAST_RESTARTS:
            said = f"reach        unknown: {count:,} restarts, and {LEAST_RESTARTS} are needed"
        else:
            end = "least" if found else "most"
            distances = [restart.distance for restart in self.restarts]
            bound = max(distances) if found else min(distances)
            said = (
                f"reach        unknown: {found:,} of {count:,} restarts found their target, "
                f"so at {end} {bound:.2f}"
            )
        if self.search is not None:
            source = f" ({visible(self.search.source)})" if self.search.source else ""
            said += f"\n             declared: up to {self.search.half_side:.3g}{source}"
        return said


_JUMP_LEGEND = (
    "own jumps, from frame 0 straight to the one above: + found, +4 found 4 frames later,\n"
    "- not found in the frames followed, ? without truth"
)


def _bin_table(bins: Sequence[Bin]) -> Table:
    def between(each: Bin) -> str:
        return f"> {each.start:g}" if each.stop is None else f"{each.start:g} - {each.stop:g}"

    columns = [
        Column("distance", between, is_label=True),
        Column("restarts", "restarts", COUNT),
        Column("found", "found", COUNT),
        Column("share", "share", PERCENT),
    ]
    return Table.of(columns, bins)


def _jump_table(jumps: Mapping[str, Sequence[OwnJump]]) -> Table:
    gaps = sorted({jump.gap for each in jumps.values() for jump in each})

    def outcome(gap: int) -> Column:
        def cell(row: tuple[str, Sequence[OwnJump]]) -> Cell:
            sign = next((_sign(jump) for jump in row[1] if jump.gap == gap), "")
            return Cell(sign, sign)

        return Column(str(gap), cell, group="jump from frame 0 to")

    columns = [
        Column("sequence", lambda row: row[0], is_label=True),
        Column("outcome", lambda row: _outcome(row[1]), is_label=True),
        *map(outcome, gaps),
    ]
    return Table.of(columns, jumps.items())


def _outcome(jumps: Sequence[OwnJump]) -> str:
    """What a sequence's own jumps come to, such as ``found up to gap 10``."""
    known = [jump for jump in jumps if _found(jump) is not None]
    if not known:
        return "unknown"
    found = [bool(_found(jump)) for jump in known]
    if all(found):
        return f"found up to gap {known[-1].gap}, the largest"
    if not any(found):
        return f"lost from gap {known[0].gap} on"
    first_lost = found.index(False)
    if any(found[first_lost:]):
        return "found " + ", ".join(str(jump.gap) for jump, hit in zip(known, found) if hit)
    return f"found up to gap {known[first_lost - 1].gap}"


def _sign(jump: OwnJump) -> str:
    found, after = _found(jump), _found_after(jump)
    if found:
        return "+"
    if after is not None:
        return f"+{after}"
    return "?" if found is None else "-"


def _found(jump: OwnJump) -> bool | None:
    """Whether the target was found right after the jump; None if its truth is not known."""
    return None if np.isnan(jump.truth[0]).any() else bool(jump.found[0])


def _found_after(jump: OwnJump) -> int | None:
    """Frames from the jump to the first one with the target found; None if it never was."""
    hits = jump.frames[jump.found]
    return int(hits[0]) - jump.gap if len(hits) else None


def _wilson(found: int, n: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson, "Probable inference", JASA 1927)."""
    p, z2 = found / n, _Z95**2 / n
    middle = (p + z2 / 2) / (1 + z2)
    half = math.sqrt(p * (1 - p) * z2 + z2**2 / 4) / (1 + z2)
    return max(middle - half, 0.0), min(middle + half, 1.0)


@styled
def reach_figure(reports: Sequence[ReachReport]) -> Figure:
    """A row for each gap pass: the share found by distance, and what own jumps came to."""
    figure = new_figure(10, 3.9 * len(reports))
    rows = figure.subplots(len(reports), 2, squeeze=False, width_ratios=(5, 3))
    for (left, right), report in zip(rows, reports):
        _draw_curve(left, report)
        _draw_jumps(right, report.jumps)
    return figure


def _draw_curve(axes: Axes, report: ReachReport) -> None:
    bins, half_side = report.bins(), None if report.search is None else report.search.half_side
    farthest = max(1.6, 1.4 * (half_side or 0))
    reach = report.reach
    if reach is not None:
        at = np.linspace(0, farthest, 400)
        axes.fill_between(at, *_band(reach, at), color=SKY_BLUE, alpha=0.35, lw=0, label="95 %")
        label = f"reach {reach.centre:.2f} ± {reach.deviation:.2f}"
        axes.plot(at, reach.found(at), color=BLUE, label=label)
    if bins:
        x, y = [each.distance for each in bins], np.array([each.share for each in bins])
        below = y - [each.share_low for each in bins]
        above = [each.share_high for each in bins] - y
        label = f"{len(report.restarts):,} restarts"
        style: dict[str, Any] = {"fmt": "o", "ms": 4, "capsize": 2.5, "lw": 1, "color": "#222222"}
        axes.errorbar(x, y, (np.maximum(below, 0), np.maximum(above, 0)), label=label, **style)
    if half_side is not None:
        axes.axvline(half_side, color=VERMILION, ls="--", lw=1, label="half side declared")
    axes.set(xlabel="distance, max(|dx|, |dy|) / search side", ylabel="share of targets found")
    axes.set(xlim=(0, farthest), ylim=(-0.03, 1.03))
    axes.set_title(visible(report.tracker))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower left" if _is_free(bins) else "upper right", fontsize=8)


def _is_free(bins: Sequence[Bin]) -> bool:
    """Whether nothing is drawn at the lower left, where most of what is near is found."""
    near = [each for each in bins if each.distance < 0.4]
    return all(each.share_low > 0.5 for each in near)


def _band(reach: Reach, distance: Floats) -> tuple[Floats, Floats]:
    """95 % band of the curve, by the standard errors of centre and spread."""
    z = (distance - reach.centre) / reach.spread
    error = np.hypot(reach.centre_error, z * reach.spread_error) / reach.spread
    ends = [(1 - LAPSE) / (1 + np.exp(np.minimum(z + k * _Z95 * error, 700))) for k in (1, -1)]
    return ends[0], ends[1]


def _draw_jumps(axes: Axes, jumps: Mapping[str, Sequence[OwnJump]]) -> None:
    """How many sequences are found again, at once or later, by the first jump."""
    from matplotlib.ticker import MaxNLocator

    every = [jump for each in jumps.values() for jump in each if _found(jump) is not None]
    gaps = sorted({jump.gap for jump in every})
    counts = {way: np.zeros(len(gaps)) for way in _WAYS}
    for jump in every:
        counts[_way(jump)][gaps.index(jump.gap)] += 1
    base = np.zeros(len(gaps))
    for way, colour in _WAYS.items():
        axes.bar(range(len(gaps)), counts[way], 0.8, base, color=colour, label=way)
        base += counts[way]
    axes.set_xticks(range(len(gaps)), [str(gap) for gap in gaps])
    axes.grid(axis="x", visible=False)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="first frame after the initialisation", ylabel="sequences")
    axes.set_title("found again after their own jump")
    if every:
        axes.set_ylim(0, base.max() * 1.2)
        axes.legend(loc="upper center", ncols=len(_WAYS), fontsize=8)


def _way(jump: OwnJump) -> str:
    if _found(jump):
        return "at once"
    return "not" if _found_after(jump) is None else "later"
