"""The schedules of lanes, compiled (see :mod:`lae_sim._compiled`)."""

from __future__ import annotations

from lae_sim._arrays import Bools, Ints
from lae_sim._compiled import kernel
from lae_sim.engine.clock import MAX_INT64


@kernel
def _schedule(
    length: int,
    frame_ticks: int,
    ticks_per_ns: int,
    times: Ints,
    by_call: bool,
    stride: int,
    waits_from: int,
    rows: Ints,
) -> int:
    """Schedule one lane; see :func:`schedule_lanes`.

    Returns:
        How many calls; -1 if a time is missing, negative or too long.
    """
    frames, starts, readies = rows[0], rows[1], rows[2]
    frames_per_tick = 1.0 / frame_ticks
    end = length * frame_ticks
    longest = (MAX_INT64 - end) // ticks_per_ns
    n = 0
    frame = 0
    start = 0
    while start < end and frame < length:
        at = n if by_call else frame
        elapsed = times[at] if at < len(times) else -1
        if elapsed < 0 or elapsed > longest:
            return -1
        ready = start + elapsed * ticks_per_ns
        frames[n], starts[n], readies[n] = frame, start, ready
        n += 1
        if stride > 0:
            following = frame + stride
        else:
            # off by one at most, which integers put right: a division takes as long as all the rest
            newest = int(ready * frames_per_tick)
            late = ready - newest * frame_ticks
            if late < 0:
                newest -= 1
            elif late >= frame_ticks:
                newest += 1
            if waits_from > 0 and ready - newest * frame_ticks >= waits_from:
                newest += 1
            following = max(newest, frame + 1)
        frame = min(following, length)
        start = max(ready, frame * frame_ticks)
    return n


@kernel
def schedule_lanes(
    lengths: Ints,
    frame_ticks: int,
    ticks_per_ns: int,
    times: Ints,
    offsets: Ints,
    by_call: Bools,
    stride: int,
    waits_from: int,
    rows: Ints,
    calls: Ints,
) -> None:
    """Schedule lanes one after another, each as :func:`.scheduler.simulate` does.

    Args:
        lengths: world frames of each lane, int64 [lanes].
        frame_ticks, ticks_per_ns: of the clock; an interval is of at least 2**12 ticks.
        times: in ns, those of all lanes one lane after another, int64.
        offsets: first time of each lane, and the end: int64 [lanes + 1].
        by_call: whether the k-th time is the k-th call's, rather than frame k's, bool [lanes].
        stride, waits_from: the policy (see :meth:`.policies.CompiledPolicy.in_numbers`).
        rows: frames, starts and ready of the calls, lane after lane: written, int64 [3, n].
        calls: how many calls each lane has; -1 where the scheduler is to say what is wrong:
            written, int64 [lanes].
    """
    n = 0
    for lane in range(len(lengths)):
        length, own = lengths[lane], times[offsets[lane] : offsets[lane + 1]]
        if by_call[lane] and stride == 0 and waits_from == 0:
            # the usual case, three times as fast where the compiler sees that it is no other
            count = _schedule(length, frame_ticks, ticks_per_ns, own, True, 0, 0, rows[:, n:])
        else:
            count = _schedule(
                length,
                frame_ticks,
                ticks_per_ns,
                own,
                by_call[lane],
                stride,
                waits_from,
                rows[:, n:],
            )
        calls[lane] = count
        n += max(count, 0)
