"""The gap pass: restarts that measure a tracker's reach (see :mod:`lae_sim.replay.reach`).

There are two kinds. *Own jumps* start on a sequence's first frame, as every run of it does, go on
at a later one, and follow for some frames: they say what happens to this sequence after a slow
initialisation. *Sampled restarts* start on the truth of any other frame and jump once, over
distances that are spread evenly between none and beyond the search region: they give the curve.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import search_distance
from lae_sim.datasets.frames import Dataset, Image, ImageSequence
from lae_sim.engine.clock import NS_PER_SECOND
from lae_sim.errors import LaeError
from lae_sim.profile.journal import Journal
from lae_sim.profile.live import Live, LiveRun
from lae_sim.profile.passes import Failure
from lae_sim.trace.restarts import RestartName

OWN_GAPS = (3, 5, 7, 10, 14, 20, 28, 40, 56)
"""The frames, after frame 0, at which own jumps go on."""

FOLLOWED = tuple(range(0, 13, 2))
"""The frames of an own jump, from the one at which it goes on."""

SAMPLED_GAPS = (1, 2, *OWN_GAPS)
"""The jumps of sampled restarts, frames: a given distance is made of fast and of slow motion."""

SAMPLED = 1000
"""Restarts that are sampled over a dataset."""

STRATA = 12
"""Parts of equal width of the distances, each of which gets as many restarts."""

BEYOND = 1.25
"""The farthest distance that is sampled, in units of half the declared search region's side."""

UNDECLARED_FARTHEST = 1.5
"""The farthest distance, in units of ``search_side``, where no search region is declared."""

BUDGET_NS = 30 * 60 * NS_PER_SECOND
"""What a gap pass may take, if nothing else is said."""

_SEED = 20210304  # of which restarts are sampled
_MARGIN = 0.85  # of the budget is planned for; the rest is for what takes longer than it did
_PROBES = 3  # restarts that tell how long one takes


@dataclass(frozen=True)
class GapPlan:
    """How many restarts a gap pass makes.

    Attributes:
        own_gaps: the gaps of the own jumps of each sequence, ascending, out of ``OWN_GAPS``.
        sampled: number of sampled restarts over the dataset.
    """

    own_gaps: tuple[int, ...] = OWN_GAPS
    sampled: int = SAMPLED

    @classmethod
    def within(cls, budget_s: float, sequences: int, init_s: float, call_s: float) -> GapPlan:
        """As many as a budget allows: first own jumps, as many for each sequence, then the others.

        Args:
            budget_s: what they may take, s.
            sequences: how many there are.
            init_s, call_s: what an initialisation and another call take, s.
        """
        own_s = sequences * (init_s + len(FOLLOWED) * call_s)
        own = int(min(budget_s / own_s, len(OWN_GAPS))) if own_s else len(OWN_GAPS)
        left_s = budget_s - own * own_s
        one_s = init_s + call_s
        sampled = int(min(left_s / one_s, SAMPLED)) if one_s else SAMPLED
        middles = [(2 * k + 1) * len(OWN_GAPS) // (2 * own) for k in range(own)]
        return cls(tuple(OWN_GAPS[k] for k in middles), sampled)


@dataclass(frozen=True)
class Start:
    """A restart to be made.

    Attributes:
        name: which it is.
        frames: what is processed, from the start on: 0, the gap, and what follows, ascending.
    """

    name: RestartName
    frames: tuple[int, ...]

    @property
    def read(self) -> list[int]:
        """The frames of the sequence that are processed."""
        return [self.name.start + frame for frame in self.frames]


def own_starts(sequence: ImageSequence, gaps: Sequence[int]) -> list[Start]:
    """The own jumps of a sequence: those of whose frames one has a truth."""
    valid = _valid(sequence)
    starts = []
    for gap in gaps:
        frames = [gap + step for step in FOLLOWED if gap + step < len(sequence)]
        if valid[0] and valid[frames].any():
            starts.append(Start(RestartName(sequence.name, 0, gap), (0, *frames)))
    return starts


def sampled_starts(
    sequences: Sequence[ImageSequence], count: int, farthest: float
) -> dict[str, list[Start]]:
    """Restarts on the truth of frames other than the first, by sequence, in the order of starts.

    Their distances lie in :data:`STRATA` parts of 0 to ``farthest``, as evenly as the motion of the
    targets allows, and those of a part over the sequences. The same arguments give the same ones.

    Args:
        sequences: of which.
        count: how many; fewer if there are not that many.
        farthest: in units of the start's ``search_side``.
    """
    pairs = [_pairs(sequence) for sequence in sequences]
    parts = [(distance * STRATA / farthest).astype(int) for _, _, distance in pairs]
    available = np.array([np.bincount(p[p < STRATA], minlength=STRATA) for p in parts], np.int64)
    available = available.reshape(len(pairs), STRATA)
    wanted = np.array(
        [
            evenly(int(total), column)
            for total, column in zip(evenly(count, available.sum(0)), available.T)
        ]
    ).T
    found: dict[str, list[Start]] = {}
    for order, (sequence, (start, gap, _), part) in enumerate(zip(sequences, pairs, parts)):
        random = np.random.default_rng([_SEED, order])
        chosen = [
            random.choice(np.flatnonzero(part == k), wanted[order, k], replace=False)
            for k in range(STRATA)
            if wanted[order, k]
        ]
        rows = np.concatenate(chosen) if chosen else np.zeros(0, np.int64)
        each = sorted(zip(start[rows].tolist(), gap[rows].tolist()))
        found[sequence.name] = [
            Start(RestartName(sequence.name, first, then), (0, then)) for first, then in each
        ]
    return found


def evenly(total: int, available: Ints) -> Ints:
    """How much to take of each of several supplies, as evenly as they allow.

    Args:
        total: how much of all together, or what there is, if that is less.
        available: the supplies, int64 [n].

    Returns:
        int64 [n], none above its supply; of equals the first ones get what cannot be divided.
    """
    taken = np.zeros_like(available)
    left = min(total, int(available.sum()))
    while left:
        open_ones = np.flatnonzero(taken < available)
        share = left // len(open_ones)
        if not share:
            taken[open_ones[:left]] += 1
            break
        more = np.minimum(share, (available - taken)[open_ones])
        taken[open_ones] += more
        left -= int(more.sum())
    return taken


def _valid(sequence: ImageSequence) -> Bools:
    """Whether each truth is there and has a size, and the target is visible, bool [T]."""
    x, y, w, h = sequence.truth.T
    valid: Bools = np.isfinite(x + y + w + h) & (w > 0) & (h > 0)
    return valid if sequence.visible is None else valid & sequence.visible


def _pairs(sequence: ImageSequence) -> tuple[Ints, Ints, Floats]:
    """Start, gap and distance of every restart that may be sampled, [n] each."""
    truth, valid = sequence.truth, _valid(sequence)
    starts, gaps, distances = [], [], []
    for gap in SAMPLED_GAPS:
        start = 1 + np.flatnonzero(valid[1:-gap] & valid[1 + gap :])
        starts.append(start)
        gaps.append(np.full(len(start), gap))
        distances.append(search_distance(truth[start], truth[start + gap]))
    return np.concatenate(starts), np.concatenate(gaps), np.concatenate(distances)


class Gaps:
    """The restarts of one gap pass, planned for its budget and then made.

    Args:
        dataset: the sequences.
        options: of each restart, the tracker too (see :class:`lae_sim.profile.live.Live`).
        budget_ns: what the pass may take.
        half_side: half the side of the search region that the tracker declares, in units of
            ``search_side``; None if it declares none.
        notice: called with each line that a user should read.
    """

    def __init__(
        self,
        dataset: Dataset,
        options: Mapping[str, Any],
        budget_ns: int,
        half_side: float | None,
        notice: Callable[[str], object],
    ) -> None:
        self._sequences, self._options = dataset.sequences, options
        self._budget_s = budget_ns / NS_PER_SECOND
        self._farthest = UNDECLARED_FARTHEST if half_side is None else BEYOND * half_side
        self._notice = notice
        self._own = self._own_left = self._picked = 0
        self._own_s = 0.0
        self._sampled: dict[str, list[Start]] = {}
        self._use(GapPlan(), math.inf, 0.0)

    def prepare(self, journal: Journal) -> None:
        """Decide what is made within the budget, which runs from now on, or what was decided."""
        decided = journal.decided("gaps", self._decided)
        plan = GapPlan(tuple(decided["own_gaps"]), decided["sampled"])
        all_of_it = self._all()
        self._use(plan, time.monotonic() + self._budget_s, decided["own_s"])
        if not any(all_of_it):
            self._notice("gaps: no restarts, since too few frames have a truth with a size")
        elif (self._own, self._picked) != all_of_it:
            took = f"an initialisation takes {decided['init_s']:.2g} s here"
            self._notice(
                f"gaps: {took}, a call {decided['call_s']:.2g} s: within {self._budget_s:g} s "
                f"{self._own} of {all_of_it[0]:,} own jumps and {self._picked:,} of "
                f"{all_of_it[1]:,} restarts; a larger budget makes more"
            )

    def calls(self, sequence: ImageSequence) -> int:
        """The planned calls of the tracker in a sequence, initialisations too."""
        return sum(len(start.frames) for start in self._starts(sequence))

    def run(
        self, sequence: ImageSequence, progress: Callable[[int], object]
    ) -> list[LiveRun | Failure]:
        """Make the restarts of a sequence, as far as there is time.

        When it gets short, time is kept for the own jumps of the sequences to come.
        """
        own = own_starts(sequence, self._plan.own_gaps)
        began = time.monotonic()
        made: list[LiveRun | Failure] = []
        made += self._in_time(own, sequence, self._deadline, progress)
        if own:
            self._own_s = max(self._own_s, (time.monotonic() - began) / len(own))
        self._own_left -= len(own)
        deadline = self._deadline - self._own_left * self._own_s
        made += self._in_time(self._sampled[sequence.name], sequence, deadline, progress)
        return made

    def _in_time(
        self,
        starts: Sequence[Start],
        sequence: ImageSequence,
        deadline: float,
        progress: Callable[[int], object],
    ) -> Iterator[LiveRun | Failure]:
        """Those that can begin before a deadline, made."""
        ahead = _ReadAhead(sequence.read, starts)
        read = sequence.read if self._options.get("include_decode") else ahead
        for start in starts:
            if time.monotonic() < deadline:
                yield self._made(start, sequence, read)
            progress(len(start.frames))
            ahead.done(start)

    def schedule(self, names: Collection[str]) -> dict[str, Any]:
        """What the metadata says of the restarts that were made, by their names."""
        starts = [RestartName.parse(name).start for name in names]
        own, sampled = starts.count(0), len(starts) - starts.count(0)
        all_own, all_sampled = self._all()
        counts = {"own_jumps": own, "restarts": sampled}
        left_out = {"own_jumps": all_own - own, "restarts": all_sampled - sampled}
        more = {"left_out": left_out} if any(left_out.values()) else {}
        return {**counts, "budget": f"{self._budget_s:g} s", **more}

    def _use(self, plan: GapPlan, deadline: float, own_s: float) -> None:
        self._plan, self._deadline, self._own_s = plan, deadline, own_s
        self._sampled = sampled_starts(self._sequences, plan.sampled, self._farthest)
        self._own = sum(len(own_starts(each, plan.own_gaps)) for each in self._sequences)
        self._own_left = self._own
        self._picked = sum(map(len, self._sampled.values()))

    def _all(self) -> tuple[int, int]:
        """Own jumps and sampled restarts, if there were time for all."""
        sampled = sampled_starts(self._sequences, SAMPLED, self._farthest)
        own = sum(len(own_starts(each, OWN_GAPS)) for each in self._sequences)
        return own, sum(map(len, sampled.values()))

    def _starts(self, sequence: ImageSequence) -> list[Start]:
        return own_starts(sequence, self._plan.own_gaps) + self._sampled[sequence.name]

    def _decided(self) -> dict[str, Any]:
        """What the budget allows, after a few restarts that tell what one takes."""
        init_s, call_s = self._probed()
        sequences = sum(bool(own_starts(each, OWN_GAPS)) for each in self._sequences)
        plan = GapPlan.within(_MARGIN * self._budget_s, sequences, init_s, call_s)
        own_s = init_s + len(FOLLOWED) * call_s
        return {**asdict(plan), "init_s": init_s, "call_s": call_s, "own_s": own_s}

    def _probed(self) -> tuple[float, float]:
        """What an initialisation and another call take with all around them, s; 0 if unknown."""
        count = len(self._sequences)
        places = [k * (count - 1) // (_PROBES - 1) for k in range(_PROBES)]
        took = []
        for sequence in (self._sequences[place] for place in places):
            for start in own_starts(sequence, OWN_GAPS[:1]):
                live = self._live(start, sequence, sequence.read)
                with suppress(Exception):  # which is told when it comes again; this one too
                    sequence.read(0)  # the first time, a video is opened or a scene drawn
                began = time.monotonic()
                with suppress(LaeError):
                    live(0)
                    initialised = time.monotonic()
                    live(start.name.gap)
                    took.append((initialised - began, time.monotonic() - initialised))
        init_s, call_s = np.median(took, axis=0) if took else (0.0, 0.0)
        return float(init_s), float(call_s)

    def _live(self, start: Start, sequence: ImageSequence, read: Callable[[int], Image]) -> Live:
        first = start.name.start
        rows = slice(first, first + start.frames[-1] + 1)
        arrived = None if sequence.arrival_ns is None else sequence.arrival_ns[rows]
        part = ImageSequence(
            str(start.name),
            sequence.truth[rows],
            lambda frame: read(first + frame),
            visible=None if sequence.visible is None else sequence.visible[rows],
            arrival_ns=None if arrived is None else arrived - arrived[0],
        )
        return Live(part, **self._options)

    def _made(
        self, start: Start, sequence: ImageSequence, read: Callable[[int], Image]
    ) -> LiveRun | Failure:
        try:
            live = self._live(start, sequence, read)
            for frame in start.frames:
                live(frame)
        except LaeError as error:
            return Failure(str(start.name), str(error))
        return live.result(np.array(start.frames))


class _ReadAhead:
    """Reads the frames of restarts in ascending order, as videos need it, and each once.

    Args:
        read: decodes a frame.
        starts: the restarts, in the order in which they are made.
    """

    def __init__(self, read: Callable[[int], Image], starts: Sequence[Start]) -> None:
        self._read = read
        self._uses = Counter(frame for start in starts for frame in start.read)
        self._left = deque(sorted(self._uses))
        self._held: dict[int, Image | Exception] = {}

    def __call__(self, frame: int) -> Image:
        """The frame, uint8 [H, W, 3].

        Raises:
            Exception: what ``read`` raised for it.
        """
        while self._left and self._left[0] <= frame:
            each = self._left.popleft()
            try:
                self._held[each] = self._read(each)
            except Exception as error:  # raised when this frame is asked for
                self._held[each] = error
        image = self._held[frame] if frame in self._held else self._read(frame)
        if isinstance(image, Exception):
            raise image
        return image.copy()

    def done(self, start: Start) -> None:
        """Let go of what no other restart needs."""
        for frame in start.read:
            self._uses[frame] -= 1
            if not self._uses[frame]:
                self._held.pop(frame, None)
