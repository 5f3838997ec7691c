"""The schedules of many sequences at once, equal to the scheduler's event for event.

A lane is one sequence under one configuration. Lanes know nothing of each other, so the k-th calls
of all of them are one step of array arithmetic, on the same integer ticks. What cannot be a lane
goes through the SimPy engine: a service that does not know its times beforehand, a policy that
looks at more than the last call, frames that arrive at times of their own, instants beyond 64 bits,
and whatever ends in an error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, repeat
from typing import cast

import numpy as np

from lae_sim._arrays import Ints
from lae_sim._compiled import compiled
from lae_sim.engine.clock import MAX_INT64, Clock
from lae_sim.engine.policies import CompiledPolicy, LanePolicy
from lae_sim.engine.scheduler import (
    Policy,
    Schedule,
    Schedules,
    Service,
    scores_latency,
    simulate,
)
from lae_sim.engine.times import Times

_CELLS = 1 << 20  # lanes x frames in memory at once, a few arrays of them
_STEPS = 32  # calls from one sorting-out of the lanes that have ended to the next
_FEWEST = 8  # lanes that are faster together than one by one
_FEWEST_TICKS = 2**12  # of an interval, so that no frame in 64-bit ticks has more than 51 bits


def batchable(services: Sequence[Service], policy: Policy) -> bool:
    """Whether sequences with these services can be scheduled at once.

    What a policy inherits does not count: its class may have changed the rule for one call.
    """
    return "next_lanes" in vars(type(policy)) and all(isinstance(s, Times) for s in services)


def simulate_lanes(
    lengths: Sequence[int],
    clock: Clock | Sequence[Clock],
    services: Sequence[Service],
    policy: Policy,
) -> Iterator[Schedule]:
    """Schedule sequences as :func:`.scheduler.simulate` does each, at once where possible.

    Args:
        lengths: number of world frames of each sequence.
        clock: of the world, or that of each sequence.
        services: one for each sequence, not yet asked for any time.
        policy: which frame is next.

    Yields:
        The schedules, in order.

    Raises:
        LaeError: what ``simulate`` raises, when that sequence's turn comes.
    """
    return chain.from_iterable(simulate_many(lengths, clock, services, policy))


def simulate_many(
    lengths: Sequence[int],
    clock: Clock | Sequence[Clock],
    services: Sequence[Service],
    policy: Policy,
) -> Iterator[Schedules]:
    """The same, the schedules of many sequences in one record.

    Yields:
        Those of some sequences, then of those after them; before one that raises an error those of
        all that come before it.
    """
    clocks = [clock] * len(lengths) if isinstance(clock, Clock) else clock
    found: Iterator[Schedules | None] = repeat(None, len(lengths))
    kinds = set(dict(zip(map(id, clocks), clocks)).values())  # to hash each takes long
    even = len(kinds) == 1 and clocks[0].is_even
    if even and len(lengths) >= _FEWEST and min(lengths) > 0 and batchable(services, policy):
        times, rule = cast("Sequence[Times]", services), cast(LanePolicy, policy)
        numbers = _in_numbers(rule, clocks[0], max(lengths))
        scored = scores_latency(policy)
        if numbers is not None and compiled():
            found = _by_kernel(lengths, clocks[0], times, numbers, scored)
        else:
            found = _in_step(lengths, clocks[0], times, rule, scored)
    done = 0
    for some in found:
        if some is None:
            some = Schedules.of([simulate(lengths[done], clocks[done], services[done], policy)])
        yield some
        done += len(some)


def _in_numbers(policy: LanePolicy, clock: Clock, longest: int) -> tuple[int, int] | None:
    """A policy's rule as kernels take it; None if it, or the clock, has no form for them."""
    fits = max(longest * clock.frame_ticks, clock.ticks_per_ns) <= MAX_INT64
    if "in_numbers" in vars(type(policy)) and fits and clock.frame_ticks >= _FEWEST_TICKS:
        return cast(CompiledPolicy, policy).in_numbers(clock)
    return None


def _by_kernel(
    lengths: Sequence[int],
    clock: Clock,
    times: Sequence[Times],
    numbers: tuple[int, int],
    scored: bool,
) -> Iterator[Schedules | None]:
    """The schedules of lanes, many after many; None for one that the SimPy engine is to have."""
    from lae_sim.engine.kernels import schedule_lanes

    begin = 0
    while begin < len(lengths):
        end = begin + 1
        frames = lengths[begin]
        while end < len(lengths) and frames + lengths[end] <= _CELLS:
            frames += lengths[end]
            end += 1
        own = [lane.ns for lane in times[begin:end]]
        calls = np.empty(len(own), np.int64)
        rows = np.empty((3, frames), np.int64)
        schedule_lanes(
            np.array(lengths[begin:end]),
            clock.frame_ticks,
            clock.ticks_per_ns,
            np.concatenate(own),
            np.cumsum([0, *map(len, own)]),
            np.array([lane.by_call for lane in times[begin:end]]),
            *numbers,
            rows,
            calls,
        )
        yield from _stretches(lengths[begin:end], clock, calls, rows, scored)
        begin = end


def _stretches(
    lengths: Sequence[int], clock: Clock, calls: Ints, rows: Ints, scored: bool
) -> Iterator[Schedules | None]:
    """The schedules of lanes up to the next one without calls, which is None, and so on.

    Args:
        lengths: of the lanes.
        clock: of them all.
        calls: how many each has, int64 [lanes]; none, or fewer, where SimPy is to have it.
        rows: frames, starts and ready of the calls, lane after lane, int64 [3, ...].
        scored: whether the policy scores latency.
    """
    offsets = np.concatenate([[0], np.cumsum(np.maximum(calls, 0))])
    begin = 0
    for end in [*np.flatnonzero(calls < 1).tolist(), len(calls)]:
        if begin < end:
            frames, starts, ready = rows[:, offsets[begin] : offsets[end]]
            yield Schedules(
                (clock,) * (end - begin),
                np.array(lengths[begin:end], np.int64),
                offsets[begin : end + 1] - offsets[begin],
                frames,
                starts,
                ready,
                np.full(end - begin, scored),
            )
        if end < len(calls):
            yield None
        begin = end + 1


def _in_step(
    lengths: Sequence[int],
    clock: Clock,
    times: Sequence[Times],
    policy: LanePolicy,
    scored: bool,
) -> Iterator[Schedules | None]:
    """The same by NumPy: the k-th calls of lanes of similar lengths at once."""
    calls = np.zeros(len(lengths), np.int64)
    rows: list[Ints] = [np.empty((3, 0), np.int64)] * len(lengths)
    for lanes in _chunks(lengths):
        sizes, some = np.array([lengths[i] for i in lanes]), [times[i] for i in lanes]
        done, calls[lanes] = _together(sizes, clock, some, policy)
        for k, i in enumerate(lanes):
            rows[i] = done[:, k, : calls[i]]
    yield from _stretches(lengths, clock, calls, np.concatenate(rows, axis=1), scored)


def _chunks(lengths: Sequence[int]) -> Iterator[list[int]]:
    """All lanes, in chunks of similar lengths, the shortest first."""
    chunk: list[int] = []
    for i in sorted(range(len(lengths)), key=lengths.__getitem__):
        if chunk and (len(chunk) + 1) * lengths[i] > _CELLS:
            yield chunk
            chunk = []
        chunk.append(i)
    yield chunk


def _together(
    lengths: Ints, clock: Clock, times: Sequence[Times], policy: LanePolicy
) -> tuple[Ints, Ints]:
    """Frames, starts and ready of the calls of lanes, shortest first, and how many calls each has.

    ``_STEPS`` calls of all lanes are worked out in ``rows``, of which ``frames``, ``starts`` and
    ``ready`` are views, and so is what the loop writes: row ``j + 1`` of frames and starts is the
    call after the one in row ``j``, so that the last row begins the next round::

        rows[0] = frames      rows[1] = starts      rows[2] = ready
                lane 0  1  2
        row 0      f  f  f       s  s  s               e  e  e     call k      e = s + time
        row 1      F  F  F       S  S  S               .  .  .     call k + 1  F = policy(f, e)
        ...                                                                    S = max(e, F's tick)
        row STEPS  F  F  F       S  S  S               (unused)    copied to row 0

    The rows of a round are then moved to ``done[:, lane, k : k + _STEPS]``, where the calls of one
    lane stand together. Lanes that have ended are cut off at the front, since the shortest come
    first; those among the rest work on, and what they write after their last call is left out by
    ``calls``.

    Returns:
        int64 [3, lanes, ...] and [lanes]; no calls where SimPy is to have a lane.
    """
    interval, width = clock.frame_ticks, len(lengths)
    taken = np.empty((width, int(lengths[-1]) + _STEPS), np.int64)
    for space, lane in zip(taken, times):
        known = lane.ns[: len(space)]
        space[: len(known)], space[len(known) :] = known, -1
    longest = max(int(taken.max()), 1) * clock.ticks_per_ns
    if int(lengths[-1]) * interval + longest > MAX_INT64:
        return np.empty((3, width, 0), np.int64), np.zeros(width, np.int64)
    taken *= clock.ticks_per_ns
    by_call = np.array([lane.by_call for lane in times])
    all_by_call = bool(by_call.all())
    ends = lengths * interval
    frames, starts, ready = rows = np.empty((3, _STEPS + 1, width), np.int64)
    frames[0] = starts[0] = 0
    done = np.empty((3, *taken.shape), np.int64)
    calls = np.zeros(width, np.int64)
    faulty = np.zeros(width, np.bool_)
    runs = np.ones(width, np.bool_)
    k = first = 0  # the lanes before the first have ended
    while first < width:
        rest, here = slice(first, None), slice(k, k + _STEPS)
        in_turn = taken[rest, here].T.copy() if all_by_call else None
        row = np.arange(first, width) * taken.shape[1]
        frame, start = frames[0, rest], starts[0, rest]
        steps = zip(frames[1:, rest], starts[1:, rest], ready[:-1, rest])
        for step, (following, begin, end) in enumerate(steps):
            if in_turn is None:
                at = np.where(by_call[rest], k + step, frame)
                np.add(start, taken.take(row + at, mode="clip"), out=end)
            else:
                np.add(start, in_turn[step], out=end)
            following[:] = policy.next_lanes(clock, frame, end)
            np.multiply(following, interval, out=begin)
            np.maximum(end, begin, out=begin)
            frame, start = following, begin
        done[:, rest, here] = rows[:, :-1, rest].transpose(0, 2, 1)
        wrong = ready[:-1, rest] < starts[:-1, rest]
        backwards = frames[1:, rest] <= frames[:-1, rest]
        last = runs[rest] & (frame < lengths[rest]) & (start < ends[rest])
        if last.all() and not wrong.any() and not backwards.any():
            calls[rest] += _STEPS  # both ascend, so that none has ended in between
        else:
            running = np.empty((_STEPS + 1, width - first), np.bool_)
            running[0] = runs[rest]
            running[1:] = (frames[1:, rest] < lengths[rest]) & (starts[1:, rest] < ends[rest])
            np.logical_and.accumulate(running, out=running)
            calls[rest] += running[:-1].sum(axis=0)
            wrong &= running[:-1]
            wrong |= running[1:] & backwards
            faulty[rest] |= wrong.any(axis=0)
            runs[rest] = running[-1] & ~faulty[rest]
        first = int(np.append(runs, True)[first:].argmax()) + first
        frames[0], starts[0] = frames[-1], starts[-1]
        k += _STEPS
    calls[faulty] = 0
    return done, calls
