"""Pairing: which output answers each query, for any set of permitted latencies at once.

The query for world frame i happens at (i + sigma) / fps; its answer is the latest output that is
ready by then, equality counts (PVT 2021, Eq. 5; sigma is from PVT++ 2023). With every sigma a
multiple of 1/b frames, an output ready at tick t is visible at query (i, m/b) iff K <= b*i + m,
where K = ceil(b*t / frame_ticks) is its *step*: all is integer from there on. Where frames arrive
at times of their own, the query for frame i is m/b nominal intervals after its arrival a_i, and
sees the output iff a_i >= t - floor(m*frame_ticks / b), again in integers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import lcm
from typing import Any

import numpy as np

from lae_sim._arrays import Bools, Floats, Frames, Ints
from lae_sim._compiled import compiled
from lae_sim.engine.clock import MAX_INT64, Clock
from lae_sim.engine.scheduler import NEVER, Schedule, Schedules
from lae_sim.errors import LaeError

MOST_FRAMES = 2**29  # keeps sums of two frame numbers in 32 bits
_NEVER = 2**62
_WIDE = 8  # from so many sigmas on, reduceat is slower than a loop over the sequences
_CELLS = 1 << 17  # outputs x sigmas at once, so that they stay in the cache


@dataclass(frozen=True)
class _Gaps:
    """Distances of frames in each sequence at each sigma, int64 [S, M].

    Attributes:
        source_sum: sum of psi(i) over the world frames.
        mismatch: largest i - psi(i).
        hold: most frames that one output answered.
    """

    source_sum: Ints
    mismatch: Ints
    hold: Ints


@dataclass(frozen=True)
class Pairing:
    """Who answers whom in some sequences, for some permitted latencies.

    The n outputs of all sequences stand one after another; M is the number of sigmas.

    Attributes:
        lengths: world frames of each sequence, int64 [S].
        offsets: first output of each sequence, and n: int64 [S + 1].
        frames: source frame of each output, int64 [n].
        steps: step from which each output is visible, int64 [n]; hugely negative for the first
            of a sequence, since the initial box is always there. None where frames of some sequence
            arrive at times of their own.
        scale: b, steps per frame.
        sigmas: m for each permitted latency m/b, ascending, int64 [M].
        clocks: of each sequence, S of them.
        arrived: what ``first`` is where there are no steps.
    """

    lengths: Ints
    offsets: Ints
    frames: Ints
    steps: Ints | None
    scale: int
    sigmas: Ints
    clocks: tuple[Clock, ...]
    arrived: Frames | None = None

    def chosen(self, sequence: int, sigma: int) -> Pairing:
        """That of one sequence at one of the permitted latencies, by their indices."""
        outputs = slice(self.offsets[sequence], self.offsets[sequence + 1])
        sigmas = slice(sigma, sigma + 1)
        return Pairing(
            self.lengths[sequence : sequence + 1],
            self.offsets[sequence : sequence + 2] - self.offsets[sequence],
            self.frames[outputs],
            None if self.steps is None else self.steps[outputs],
            self.scale,
            self.sigmas[sigmas],
            self.clocks[sequence : sequence + 1],
            None if self.arrived is None else self.arrived[outputs, sigmas],
        )

    def of_sequences(self, which: Ints) -> Pairing:
        """That of some sequences, by their indices, perhaps of one several times."""
        sizes = np.diff(self.offsets)[which]
        outputs = ranges(self.offsets[which], sizes)
        return Pairing(
            self.lengths[which],
            np.concatenate([[0], np.cumsum(sizes)]),
            self.frames.take(outputs),
            None if self.steps is None else self.steps.take(outputs),
            self.scale,
            self.sigmas,
            tuple(self.clocks[s] for s in which.tolist()),
            None if self.arrived is None else self.arrived.take(outputs, axis=0),
        )

    @cached_property
    def next_steps(self) -> Ints | None:
        """Step of the output after each, int64 [n]; huge for the last of a sequence."""
        if self.steps is None:
            return None
        following = np.append(self.steps[1:], _NEVER)
        following[self.offsets[1:] - 1] = _NEVER
        return following

    @property
    def first(self) -> Frames:
        """First world frame that each output answers, int32 [n, M]."""
        return self._answered[0]

    @property
    def end(self) -> Frames:
        """The frame after the last one it answers, int32 [n, M]; ``first`` if it answers none."""
        return self._answered[1]

    @cached_property
    def _answered(self) -> tuple[Frames, Frames]:
        if self.steps is not None:
            grid = self.sigmas, self.scale
            return _first_visible(self.steps, *grid, self.offsets, self.lengths)
        assert self.arrived is not None, "without steps"
        return self.arrived, _ends(self.arrived, self.offsets, self.lengths)

    @cached_property
    def mismatch_sum(self) -> Ints:
        """Sum of i - psi(i) over the world frames of each sequence, frames, int64 [S, M]."""
        return (self.lengths * (self.lengths - 1) // 2)[:, None] - self._gaps.source_sum

    @cached_property
    def mismatch_max(self) -> Ints:
        """Largest i - psi(i) of each sequence, frames, int64 [S, M]."""
        return self._gaps.mismatch

    @cached_property
    def longest_hold(self) -> Ints:
        """Most queries in a row that one output answered, frames, int64 [S, M]."""
        return self._gaps.hold

    @cached_property
    def _gaps(self) -> _Gaps:
        gaps = _Gaps(*np.empty((3, len(self.lengths), len(self.sigmas)), np.int64))
        if self.steps is not None and compiled():
            from lae_sim.evaluation import kernels

            outputs = self.lengths, self.offsets, self.frames, self.steps
            grid = self.scale, *np.divmod(self.sigmas, self.scale)
            kernels.sum_gaps(*outputs, *grid, gaps.source_sum, gaps.mismatch, gaps.hold)
        elif len(self.sigmas) < _WIDE:
            answered = self.end - self.first
            begins = self.offsets[:-1]
            gaps.source_sum[:] = np.add.reduceat(answered * self.frames[:, None], begins)
            gaps.mismatch[:] = np.maximum.reduceat(self.end - self._nexts[:, None], begins)
            gaps.hold[:] = np.maximum.reduceat(answered, begins)
        else:
            spans = map(slice, self.offsets[:-1].tolist(), self.offsets[1:].tolist())
            for s, span in enumerate(spans):  # so few that what is made of them is in the cache
                answered = self.end[span] - self.first[span]
                gaps.source_sum[s] = self.frames[span] @ answered
                gaps.mismatch[s] = (self.end[span] - self._nexts[span, None]).max(axis=0)
                gaps.hold[s] = answered.max(axis=0)
        return gaps

    @property
    def _nexts(self) -> Frames:
        """The frame after each output's, int32 [n].

        An output that answers nothing cannot have the largest mismatch: the query before its turn
        was answered by an older one.
        """
        return (self.frames + 1).astype(np.int32)

    @property
    def age_sum(self) -> Floats:
        """Time from the arrival of each answer's frame to that of the frame it answers for.

        Summed over the world frames of each sequence, nominal frame intervals, float64 [S, M]; at a
        permitted latency of 0 that is how old the answers are. Where frames arrive evenly it is the
        mismatch.
        """
        ages = self.mismatch_sum.astype(np.float64)
        for s, clock in self._uneven():
            outputs = slice(self.offsets[s], self.offsets[s + 1])
            arrivals = clock.arrival(np.arange(self.lengths[s])) // clock.ticks_per_ns
            answered = self.end[outputs].astype(np.int64) - self.first[outputs]
            ns = arrivals.sum() - arrivals[self.frames[outputs]] @ answered
            ages[s] = ns * (clock.ticks_per_ns / clock.frame_ticks)
        return ages

    @property
    def age_max(self) -> Floats:
        """The largest such time, nominal frame intervals, float64 [S, M]."""

        def span(outputs: slice) -> tuple[Ints, Frames]:
            # see _nexts on outputs that answer nothing
            return self.frames[outputs, None], np.maximum(self.end[outputs] - 1, 0)

        return self._longest(self.mismatch_max, span)

    def ages_from(self, sequence: int, arrived: Ints) -> tuple[Floats, Floats]:
        """Sum and largest of the ages of a sequence whose frames arrive later than they show.

        Args:
            sequence: its place.
            arrived: when each of its frames did, int64 [T], ticks.

        Returns:
            As :attr:`age_sum` and :attr:`age_max`, float64 [M] each.
        """
        clock, outputs = self.clocks[sequence], self._outputs(sequence)
        asked = clock.arrival(np.arange(self.lengths[sequence])) // clock.ticks_per_ns
        since = (arrived // clock.ticks_per_ns)[self.frames[outputs]]
        since[0] = asked[0]  # the initial box is there from the start
        first, end = self.first[outputs].astype(np.int64), self.end[outputs].astype(np.int64)
        ages = np.where(end > first, asked[np.maximum(end - 1, 0)] - since[:, None], 0)
        per_ns = clock.ticks_per_ns / clock.frame_ticks
        return (asked.sum() - since @ (end - first)) * per_ns, ages.max(axis=0) * per_ns

    def _outputs(self, sequence: int) -> slice:
        return slice(int(self.offsets[sequence]), int(self.offsets[sequence + 1]))

    @property
    def longest_stale(self) -> Floats:
        """Longest time that one output answered, nominal frame intervals, float64 [S, M].

        It lasts until the query that another one answers, or until the end of the stream.
        """
        return self._longest(self.longest_hold, lambda o: (self.first[o], self.end[o]))

    def _longest(self, frames: Ints, span: Callable[[slice], tuple[Any, Any]]) -> Floats:
        """The longest span of frames, in nominal intervals, float64 [S, M].

        Args:
            frames: how many frames it has, int64 [S, M]: how long it is where they arrive evenly.
            span: the first frame and the one after the last, of each of some outputs.
        """
        longest = frames.astype(np.float64)
        for s, clock in self._uneven():
            ticks = self._instants(s)
            begin, end = span(slice(self.offsets[s], self.offsets[s + 1]))
            longest[s] = (ticks[end] - ticks[begin]).max(axis=0) / clock.frame_ticks
        return longest

    def frame_times(self, sequence: Ints, frame: Ints) -> Ints | Floats:
        """When frames of some sequences arrive, as forecasters count (see ``Clock.frame_time``).

        Args:
            sequence: by its place, int64 [P].
            frame: world frame, int64 [P]; the one after the last is the end of the stream.
        """
        if self.is_even:
            return frame
        table = np.concatenate([self._instants(s) for s in range(len(self.clocks))])
        starts = np.cumsum(self.lengths + 1) - self.lengths - 1
        times: Floats = table.take(starts.take(sequence) + frame) / self.clocks[0].frame_ticks
        return times

    @cached_property
    def is_even(self) -> bool:
        """Whether frames of all sequences arrive evenly."""
        return self.steps is not None

    def _instants(self, sequence: int) -> Ints:
        """The ticks at which the frames of a sequence arrive, and its end, int64 [T + 1]."""
        clock, length = self.clocks[sequence], int(self.lengths[sequence])
        return np.append(clock.arrival(np.arange(length)), clock.end(length))

    def _uneven(self) -> Iterator[tuple[int, Clock]]:
        """The sequences whose frames arrive at times of their own, by their places."""
        if self.is_even:
            return iter(())
        return ((s, clock) for s, clock in enumerate(self.clocks) if not clock.is_even)


def pair(
    schedules: Sequence[Schedule] | Schedules, sigmas: Sequence[Fraction], cost_ns: int = 0
) -> Pairing:
    """Pair the outputs of some sequences with their queries.

    Where the schedules' policy never scores latency, each output counts from its own frame's
    arrival.

    Args:
        schedules: one per sequence, all of one clock and one way to be scored.
        sigmas: distinct permitted latencies in frames, ascending.
        cost_ns: what an answer costs to make of an output; it delays all but the initial box.

    Raises:
        LaeError: if the clocks differ, calls overlap, the sigmas are not ascending, or they or the
            cost are too fine or too large for 64-bit integers.
    """
    if not all(isinstance(sigma, (Fraction, int)) for sigma in sigmas):
        raise LaeError("permitted latencies must be exact: Fraction(1, 2), not 0.5")
    if not sigmas or list(sigmas) != sorted(set(sigmas)):
        raise LaeError("permitted latencies must be ascending, each of them once")
    if not isinstance(schedules, Schedules):
        schedules = Schedules.of(schedules)
    clocks, lengths, offsets = schedules.clocks, schedules.lengths, schedules.offsets
    if len({(clock.ticks_per_ns, clock.frame_ticks) for clock in schedules.kinds}) != 1:
        raise LaeError("sequences of different frame rates cannot be paired together")
    at_once = not schedules.scores_latency[0]
    if (schedules.scores_latency == at_once).any():
        raise LaeError("sequences cannot be paired together if only some of them score latency")
    scale = lcm(*(sigma.denominator for sigma in sigmas))
    numerators = [int(sigma * scale) for sigma in sigmas]
    interval = clocks[0].frame_ticks
    if cost_ns < 0:
        raise LaeError(f"forecasting cannot cost {cost_ns} ns, less than nothing")
    cost = cost_ns * clocks[0].ticks_per_ns
    visible = schedules.visible
    seen = visible if schedules.whole is None else visible[visible < NEVER]
    last_ready = int(seen.max()) + cost
    if last_ready > MAX_INT64:
        raise LaeError(f"forecasting cannot cost {cost_ns:g} ns: the clock ends before")
    largest = max(last_ready // interval, int(lengths.max())) * scale
    most_sigma = max(map(abs, numerators))
    if max(scale * interval, largest + most_sigma) >= _NEVER or most_sigma > MOST_FRAMES * scale:
        raise LaeError(
            f"the permitted latencies {', '.join(map(str, sigmas[:3]))}... are too fine or too "
            "large for exact 64-bit arithmetic: use fewer digits"
        )
    frames = schedules.frames
    if not at_once and schedules.whole is None:
        overlaps = schedules.start[1:] < schedules.ready[:-1]
        overlaps[offsets[1:-1] - 1] = False
        if overlaps.any():
            raise LaeError(
                "calls overlap, as under the rule of VOT, which never scores latency: such a "
                "policy says so by an attribute, scores_latency = False"
            )
    m = np.array(numerators, np.int64)
    steps: Ints | None = None
    arrived: Frames | None = None
    if all(clock.is_even for clock in schedules.kinds):
        if at_once:
            steps = frames * scale
        else:
            steps = _steps(visible + cost, interval, scale)
            if len(seen) < len(visible):
                steps[visible == NEVER] = _NEVER
        steps[offsets[:-1]] = -_NEVER
    else:
        permitted = [each * interval // scale for each in numerators]
        if last_ready + max(map(abs, permitted)) > MAX_INT64:
            raise LaeError("the permitted latencies are too large for exact 64-bit arithmetic")
        since = np.array(permitted, np.int64)
        arrived = np.concatenate(
            [
                _first_arrived(s, s.clock.arrival(s.frames) if at_once else its + cost, since)
                for s, its in zip(schedules, np.split(visible, offsets[1:-1]))
            ]
        )
    return Pairing(lengths, offsets, frames, steps, scale, m, clocks, arrived)


def _first_arrived(schedule: Schedule, visible: Ints, permitted: Ints) -> Frames:
    """The first frame whose query sees each output, within 0..T, int32 [n, M].

    Args:
        schedule: of one sequence.
        visible: the tick from which each output is, int64 [n].
        permitted: permitted latencies, whole ticks, int64 [M].
    """
    arrivals = schedule.clock.arrival(np.arange(schedule.length))
    first = np.searchsorted(arrivals, visible[:, None] - permitted).astype(np.int32)
    first[0] = 0  # the initial box is always there
    return first


def _steps(ready: Ints, interval: int, scale: int) -> Ints:
    """The step from which each output is visible, without the rule for the initial box."""
    if compiled():
        from lae_sim.evaluation.kernels import first_steps

        steps = np.empty_like(ready)
        first_steps(ready, interval, scale, steps)
        return steps
    frame, rest = np.divmod(ready, interval)
    rounded_up: Ints = frame * scale - (-rest * scale // interval)
    return rounded_up


def _first_visible(
    steps: Ints, sigmas: Ints, scale: int, offsets: Ints, lengths: Ints
) -> tuple[Frames, Frames]:
    """ceil((K - m) / b), within 0..T, for each output and sigma, and where the next one's is.

    There is no division for each sigma.
    """
    whole, part = np.divmod(sigmas, scale)
    first = np.empty((len(steps), len(sigmas)), np.int32)
    if compiled():
        from lae_sim.evaluation.kernels import first_visible

        end = np.empty_like(first)
        first_visible(steps, offsets, lengths, scale, whole, part, first, end)
        return first, end
    frame, rest = np.divmod(steps, scale)
    frame = np.clip(frame, -MOST_FRAMES, MOST_FRAMES).astype(np.int32)[:, None]
    limit = np.repeat(lengths, np.diff(offsets)).astype(np.int32)[:, None]
    rest, whole = rest[:, None], whole.astype(np.int32)
    rows = max(_CELLS // len(sigmas), 1)
    for begin in range(0, len(steps), rows):
        now = slice(begin, begin + rows)
        some = np.subtract(frame[now], whole, out=first[now])
        some += rest[now] > part
        np.maximum(some, 0, out=some)
        np.minimum(some, limit[now], out=some)
    return first, _ends(first, offsets, lengths)


def _ends(first: Frames, offsets: Ints, lengths: Ints) -> Frames:
    """Where each output is no longer the latest: where the next one is first, or at the end."""
    end = np.empty_like(first)
    end[:-1] = first[1:]
    end[offsets[1:] - 1] = lengths[:, None]
    return end


@dataclass(frozen=True)
class Histories:
    """What forecasters were fed: the outputs answered with, where sigmas that agree share.

    Attributes:
        sequence: the sequence of each history, int64 [L].
        sigma_from, sigma_to: the range of sigmas that share it, int64 [L].
        offsets: first item of each history, and N: int64 [L + 1].
        output: the output of each item, int64 [N]; the first of a history is the initial box.
    """

    sequence: Ints
    sigma_from: Ints
    sigma_to: Ints
    offsets: Ints
    output: Ints

    def parts(self, items: int) -> Iterator[Histories]:
        """The same in parts of whole sequences, of at most so many items if one has no more.

        Sequences of similar size go together, and ascend in each part.
        """
        if self.offsets[-1] <= items:
            yield self
            return
        sequences, lanes = np.unique(self.sequence, return_counts=True)
        lane_sizes = np.diff(self.offsets)
        sizes = np.bincount(self.sequence, lane_sizes)[sequences].astype(np.int64)
        largest = np.argsort(-sizes // lanes, kind="stable")
        part: list[int] = []
        total = 0
        for s, size in zip(largest.tolist(), sizes[largest].tolist()):
            if part and total + size > items:
                yield self._part(np.isin(self.sequence, sequences[part]))
                part, total = [], 0
            part.append(s)
            total += size
        yield self._part(np.isin(self.sequence, sequences[part]))

    def _part(self, those: Bools) -> Histories:
        if those.all():
            return self
        sizes = np.diff(self.offsets)
        return Histories(
            self.sequence[those],
            self.sigma_from[those],
            self.sigma_to[those],
            np.concatenate([[0], np.cumsum(sizes[those])]),
            self.output[np.repeat(those, sizes)],
        )


def histories(pairing: Pairing, memoryless: bool = False) -> Histories:
    """The outputs that a forecaster is fed in each sequence, per sigma.

    An output overtaken between two queries is never used. With ``memoryless``, for forecasters that
    look at the latest output alone, one history of all outputs serves every sigma.
    """
    count = len(pairing.sigmas)
    if memoryless:
        every = np.arange(len(pairing.lengths))
        whole = np.full(len(every), count)
        output = np.arange(len(pairing.frames))
        return Histories(every, np.zeros_like(every), whole, pairing.offsets, output)
    if compiled():
        return _histories_by_kernel(pairing)
    used = pairing.end > pairing.first
    used[pairing.offsets[:-1]] = True  # every forecaster starts from the initial box
    begins = np.zeros((len(pairing.lengths), count), np.bool_)
    begins[:, 0] = True
    if count > 1:
        begins[:, 1:] = np.logical_or.reduceat(used[:, 1:] != used[:, :-1], pairing.offsets[:-1])
    sequence, sigma_from, sigma_to = _shared_ranges(begins)
    sizes = np.diff(pairing.offsets)[sequence]
    output = ranges(pairing.offsets[sequence], sizes)
    history = np.repeat(np.arange(len(sequence)), sizes)
    kept = used[output, sigma_from[history]]
    items = np.bincount(history[kept], minlength=len(sequence))
    offsets = np.concatenate([[0], np.cumsum(items)])
    return Histories(sequence, sigma_from, sigma_to, offsets, output[kept])


def _histories_by_kernel(pairing: Pairing) -> Histories:
    from lae_sim.evaluation import kernels

    outputs = pairing.offsets, pairing.first, pairing.end
    begins = np.zeros((len(pairing.lengths), len(pairing.sigmas)), np.bool_)
    begins[:, 0] = True
    kernels.changes(*outputs, begins)
    sequence, sigma_from, sigma_to = _shared_ranges(begins)
    sizes = np.diff(pairing.offsets)[sequence]
    items = np.empty(len(sequence), np.int64)
    output = np.empty(sizes.sum(), np.int64)
    kernels.used_outputs(*outputs, sequence, sigma_from, items, output)
    offsets = np.concatenate([[0], np.cumsum(items)])
    return Histories(sequence, sigma_from, sigma_to, offsets, output[: offsets[-1]])


def _shared_ranges(begins: Bools) -> tuple[Ints, Ints, Ints]:
    """The sequences of histories, and the ranges of sigmas that share one, int64 [L] each.

    Args:
        begins: whether one begins at a sigma, bool [S, M]; always at the first.
    """
    sequence, sigma_from = np.nonzero(begins)
    sigma_to = np.append(sigma_from[1:], 0)
    sigma_to[sigma_to == 0] = begins.shape[1]
    return sequence, sigma_from, sigma_to


@dataclass(frozen=True)
class Pairs:
    """Each (world frame, history item) that some sigma pairs, once.

    Attributes:
        item: index into the histories' items, int64 [P], not decreasing.
        frame: world frame i, int64 [P].
        sigma_from, sigma_to: the range of sigmas that pair them, int64 [P].
    """

    item: Ints
    frame: Ints
    sigma_from: Ints
    sigma_to: Ints

    def some(self, those: Any) -> Pairs:
        """Some of them."""
        columns = (self.item, self.frame, self.sigma_from, self.sigma_to)
        return Pairs(*(column[those] for column in columns))


def pairs(pairing: Pairing, fed: Histories) -> Pairs:
    """List the distinct pairs of frames and outputs, with the sigmas each is for."""
    if pairing.steps is not None and pairing.next_steps is not None and compiled():
        return _pairs_by_kernel(pairing, fed, pairing.steps, pairing.next_steps)
    sizes = np.diff(fed.offsets)
    low, high = np.repeat(fed.sigma_from, sizes), np.repeat(fed.sigma_to, sizes)
    count = len(pairing.sigmas)
    cell = fed.output * count
    begin = pairing.first.take(cell + high - 1).astype(np.int64)
    sizes = np.maximum(pairing.end.take(cell + low) - begin, 0)
    item = np.repeat(np.arange(len(low)), sizes)
    frame = ranges(begin, sizes)
    listed = Pairs(item, frame, low.take(item), high.take(item))
    # a history of one sigma has no other pairs
    several = np.flatnonzero(listed.sigma_to - listed.sigma_from > 1)
    if not len(several):
        return listed
    output = fed.output.take(item.take(several))
    query = pairing.scale * frame.take(several)
    for ends, steps, from_frame, limit in (
        (listed.sigma_from, pairing.steps, pairing.first, np.maximum),
        (listed.sigma_to, pairing.next_steps, pairing.end, np.minimum),
    ):
        if steps is None:
            seen = _count_above(from_frame, output, frame.take(several))
        else:
            seen = _place(pairing.sigmas, steps.take(output) - query)
        ends[several] = limit(seen, ends.take(several))
    kept = listed.sigma_from < listed.sigma_to
    return listed if kept.all() else listed.some(kept)


def _pairs_by_kernel(pairing: Pairing, fed: Histories, steps: Ints, next_steps: Ints) -> Pairs:
    from lae_sim.evaluation import kernels

    histories = fed.offsets, fed.output, fed.sigma_from, fed.sigma_to
    answered = pairing.first, pairing.end
    columns = np.empty((4, kernels.most_pairs(*histories, *answered)), np.int64)
    sees = steps, next_steps
    grid = pairing.scale, pairing.sigmas
    count = kernels.list_pairs(*histories, *answered, *sees, *grid, columns)
    return Pairs(*columns[:, :count])


def _count_above(rows: Frames, row: Ints, values: Ints) -> Ints:
    """How many columns of each row are above a value, int64 [P]."""
    count = np.zeros(len(row), np.int64)
    for column in rows.T:
        count += column.take(row) > values
    return count


def _place(sigmas: Ints, values: Ints) -> Ints:
    """How many sigmas are below each value."""
    if sigmas[-1] - sigmas[0] == len(sigmas) - 1:  # one after another, as on the usual grid
        place: Ints = np.clip(values - sigmas[0], 0, len(sigmas))
        return place
    return np.searchsorted(sigmas, values)


def ranges(starts: Ints, sizes: Ints) -> Ints:
    """``sizes[0]`` integers from ``starts[0]`` on, then ``sizes[1]`` from ``starts[1]``, ..."""
    ends = np.cumsum(sizes)
    joined: Ints = np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - ends + sizes, sizes)
    return joined
