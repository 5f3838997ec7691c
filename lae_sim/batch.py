"""The schedules of many sequences at once, equal to those of :mod:`lae_sim.engine` event for event.

A lane is one sequence under one configuration. Lanes know nothing of each other, so the k-th calls
of all of them are one step of array arithmetic, on the same integer ticks. What cannot be a lane
goes through the SimPy engine: a service that does not know its times beforehand, a policy that
looks at more than the last call, instants beyond 64 bits, and whatever ends in an error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import cast

import numpy as np

from lae_sim.clock import MAX_INT64, Clock
from lae_sim.engine import Ints, Policy, Schedule, Service, simulate
from lae_sim.latency import Times
from lae_sim.policies import LanePolicy

_STEPS = 32  # calls from one sorting-out of the lanes that have ended to the next
_FEWEST = 8  # lanes that are faster together than one by one


def batchable(services: Sequence[Service], policy: Policy) -> bool:
    """Whether sequences with these services can be scheduled at once.

    What a policy inherits does not count: its class may have changed the rule for one call.
    """
    return "next_lanes" in vars(type(policy)) and all(isinstance(s, Times) for s in services)


def simulate_lanes(
    lengths: Sequence[int], clock: Clock, services: Sequence[Service], policy: Policy
) -> Iterator[Schedule]:
    """Schedule sequences as :func:`lae_sim.engine.simulate` does each, at once where possible.

    Args:
        lengths: number of world frames of each sequence.
        clock: of the world.
        services: one for each sequence, not yet asked for any time.
        policy: which frame is next.

    Yields:
        The schedules, in order.

    Raises:
        LaeError: what ``simulate`` raises, when that sequence's turn comes.
    """
    schedules: list[Schedule | None] = [None] * len(lengths)
    if batchable(services, policy) and min(lengths, default=0) > 0:
        times, rule = cast("Sequence[Times]", services), cast(LanePolicy, policy)
        for by_call in (True, False):
            lanes = [i for i, lane in enumerate(times) if lane.by_call == by_call]
            if len(lanes) >= _FEWEST:
                sizes = np.array([lengths[i] for i in lanes])
                found = _schedules(sizes, clock, [times[i].ns for i in lanes], by_call, rule)
                for i, schedule in zip(lanes, found):
                    schedules[i] = schedule
    for length, service, schedule in zip(lengths, services, schedules):
        yield schedule or simulate(length, clock, service, policy)


def _schedules(
    lengths: Ints, clock: Clock, times: Sequence[Ints], by_call: bool, policy: LanePolicy
) -> list[Schedule | None]:
    """The schedules of lanes, None for those that the SimPy engine is to have."""
    interval, ticks_per_ns = clock.frame_ticks, clock.ticks_per_ns
    # every lane has its place in flat arrays, with room for the steps after its end
    offsets = np.concatenate([[0], np.cumsum(lengths + _STEPS)])
    none = np.full(lengths.max() + _STEPS, -1, np.int64)
    parts = (
        (ns[:n], none[: _STEPS + max(n - len(ns), 0)]) for ns, n in zip(times, lengths.tolist())
    )
    flat = np.concatenate([*chain.from_iterable(parts)])
    longest = max(int(flat.max()), 1)
    if int(lengths.max()) * interval + longest * ticks_per_ns > MAX_INT64:
        return [None] * len(times)

    upcoming = np.lib.stride_tricks.sliding_window_view(flat, _STEPS)
    done = np.empty((3, len(flat)), np.int64)
    slots = np.lib.stride_tricks.sliding_window_view(done, _STEPS, axis=1, writeable=True)
    calls = np.zeros(len(times), np.int64)
    faulty = np.zeros(len(times), np.bool_)
    lane = np.arange(len(times))
    frame = start = np.zeros(len(times), np.int64)
    k = 0
    while len(lane):
        place, length = offsets[lane], lengths[lane]
        end = length * interval
        block = np.empty((3, _STEPS, len(lane)), np.int64)
        running = np.empty((_STEPS, len(lane)), np.bool_)
        drawn = np.ascontiguousarray(upcoming[place + k].T) if by_call else None
        runs = np.ones(len(lane), np.bool_)
        for step in range(_STEPS):
            running[step] = runs
            block[0, step], block[1, step] = frame, start
            ready = block[2, step]
            ns = flat.take(place + frame, mode="clip") if drawn is None else drawn[step]
            np.multiply(ns, ticks_per_ns, out=ready)
            ready += start
            frame = policy.next_lanes(clock, frame, ready)
            start = np.maximum(ready, frame * interval)
            runs &= (frame < length) & (start < end)
        backward = block[0, 1:] <= block[0, :-1]
        slots[:, place + k] = block.transpose(0, 2, 1)
        calls[lane] += running.sum(axis=0)
        wrong = (block[2] < block[1]) & running
        wrong[1:] |= backward & running[1:]
        faulty[lane] |= wrong.any(axis=0) | (runs & (frame <= block[0, -1]))
        runs &= ~faulty[lane]
        lane, frame, start = lane[runs], frame[runs], start[runs]
        k += _STEPS
    return [
        None if bad else Schedule(clock, length, *done[:, first : first + n])
        for bad, length, first, n in zip(
            faulty.tolist(), lengths.tolist(), offsets.tolist(), calls.tolist()
        )
    ]
