"""Pairing outputs with queries and counting what they are worth, compiled.

See :mod:`lae_sim._compiled`. S is the number of sequences, n that of their outputs, M that of the
permitted latencies, and P that of pairs.
"""

from __future__ import annotations

import numpy as np

from lae_sim._arrays import Bools, Floats, Frames, Ints
from lae_sim._compiled import kernel
from lae_sim.forecast.kernels import overlap


@kernel
def sum_gaps(
    offsets: Ints,
    frames: Ints,
    first: Frames,
    end: Frames,
    source_sum: Ints,
    mismatch: Ints,
    hold: Ints,
) -> None:
    """Sums and largest distances of frames in each sequence at each permitted latency.

    Args:
        offsets, frames, first, end: see :class:`.pairing.Pairing`.
        source_sum, mismatch, hold: see :class:`.pairing._Gaps`: written, int64 [S, M].
    """
    source_sum[:] = 0
    mismatch[:] = 0
    hold[:] = 0
    for s in range(len(offsets) - 1):
        for o in range(offsets[s], offsets[s + 1]):
            frame = frames[o]
            for m in range(first.shape[1]):
                answered = end[o, m] - first[o, m]
                source_sum[s, m] += answered * frame
                mismatch[s, m] = max(mismatch[s, m], end[o, m] - frame - 1)
                hold[s, m] = max(hold[s, m], answered)


@kernel
def changes(offsets: Ints, first: Frames, end: Frames, begins: Bools) -> None:
    """Mark each permitted latency at which other outputs are used than at the one before.

    Args:
        offsets, first, end: see :class:`.pairing.Pairing`.
        begins: bool [S, M]; only what is to be True is written.
    """
    for s in range(len(offsets) - 1):
        for o in range(offsets[s] + 1, offsets[s + 1]):
            before = end[o, 0] > first[o, 0]
            for m in range(1, first.shape[1]):
                used = end[o, m] > first[o, m]
                begins[s, m] |= used != before
                before = used


@kernel
def used_outputs(
    offsets: Ints,
    first: Frames,
    end: Frames,
    sequence: Ints,
    sigma: Ints,
    items: Ints,
    output: Ints,
) -> None:
    """List the outputs that are used in each history, and the initial box.

    Args:
        offsets, first, end: see :class:`.pairing.Pairing`.
        sequence, sigma: of each history, int64 [L].
        items: how many each history has: written, int64 [L].
        output: one history after another: written, as far as there are any, int64.
    """
    n = 0
    for h in range(len(sequence)):
        begin, m, before = offsets[sequence[h]], sigma[h], n
        for o in range(begin, offsets[sequence[h] + 1]):
            if o == begin or end[o, m] > first[o, m]:
                output[n] = o
                n += 1
        items[h] = n - before


@kernel
def most_pairs(
    offsets: Ints, output: Ints, sigma_from: Ints, sigma_to: Ints, first: Frames, end: Frames
) -> int:
    """No fewer than there are for :func:`list_pairs`, whose arguments these are."""
    most = 0
    for h in range(len(offsets) - 1):
        for item in range(offsets[h], offsets[h + 1]):
            o = output[item]
            most += max(end[o, sigma_from[h]] - first[o, sigma_to[h] - 1], 0)
    return most


@kernel
def list_pairs(
    offsets: Ints,
    output: Ints,
    sigma_from: Ints,
    sigma_to: Ints,
    first: Frames,
    end: Frames,
    steps: Ints,
    next_steps: Ints,
    scale: int,
    sigmas: Ints,
    pairs: Ints,
) -> int:
    """List the pairs of :func:`.pairing.pairs`, where frames arrive evenly.

    Args:
        offsets, output, sigma_from, sigma_to: see :class:`.pairing.Histories`.
        first, end, steps, next_steps, scale, sigmas: see :class:`.pairing.Pairing`.
        pairs: item, frame, sigma_from and sigma_to: written, int64 [4, ...].

    Returns:
        How many there are.
    """
    items, frames, froms, tos = pairs[0], pairs[1], pairs[2], pairs[3]
    count = len(sigmas)
    dense = sigmas[-1] - sigmas[0] == count - 1
    n = 0
    for h in range(len(offsets) - 1):
        low, high = sigma_from[h], sigma_to[h]
        for item in range(offsets[h], offsets[h + 1]):
            o = output[item]
            for frame in range(first[o, high - 1], end[o, low]):
                from_, to = low, high
                if high - low > 1:
                    since, until = steps[o] - scale * frame, next_steps[o] - scale * frame
                    if dense:
                        since, until = since - sigmas[0], until - sigmas[0]
                    else:
                        since = np.searchsorted(sigmas, since)
                        until = np.searchsorted(sigmas, until)
                    from_, to = max(since, low), min(until, high)
                if from_ < to:
                    items[n], frames[n], froms[n], tos[n] = item, frame, from_, to
                    n += 1
    return n


@kernel
def _within(value: float, most: float) -> float:
    """A number as one from 0 to the most, which NaN becomes."""
    return max(value, 0.0) if value < most else most


@kernel
def _below(value: float, steps: int) -> float:
    """See :func:`.metrics._below`."""
    whole = float(np.floor(value * steps))
    return whole + 1.0 if whole / steps < value else whole


@kernel
def count_pairs(
    bases: Ints,
    truth: Floats,
    sequence: Ints,
    frame: Ints,
    sigma_from: Ints,
    sigma_to: Ints,
    boxes: Floats,
    valid: int,
    leaves_out: bool,
    by_centre: bool,
    first_frame_is_truth: bool,
    steps: int,
    curves_at: int,
    sums: Ints,
    success: Ints,
    precision: Ints,
    failure: Ints,
) -> None:
    """Add what pairs count, as :func:`.metrics.frame_counts` has it, to the sums of a tally.

    Args:
        bases: place of each sequence's first frame in the truth, int64 [S].
        truth: columns of boxes, float64 [4, ...].
        sequence, frame, sigma_from, sigma_to: of each pair, int64 [P].
        boxes: answers, float64 [P, 4].
        valid: 0, 1, 2 for the convention's "size", "positive", "finite".
        leaves_out, by_centre, first_frame_is_truth: of the convention.
        steps: its number of thresholds but one.
        curves_at: index of a permitted latency.
        sums, success, precision, failure: see :class:`.scoring._Tally`.
    """
    for p in range(len(frame)):
        s, i = sequence[p], frame[p]
        at = bases[s] + i
        x, y, w, h = truth[0, at], truth[1, at], truth[2, at], truth[3, at]
        x1, y1, w1, h1 = boxes[p, 0], boxes[p, 1], boxes[p, 2], boxes[p, 3]
        if first_frame_is_truth and i == 0:
            x1, y1, w1, h1 = x, y, w, h
        if valid == 0:
            counts = w > 0 and h > 0
        elif valid == 1:
            counts = x > 0 and y > 0 and w > 0 and h > 0
        else:
            counts = not (np.isnan(x) or np.isnan(y) or np.isnan(w) or np.isnan(h))
        shared = overlap((x, y, w, h), (x1, y1, w1, h1)) if counts else 0.0
        auc = int(_below(shared, steps))

        centre_x, centre_y = x + (w - 1.0) / 2.0, y + (h - 1.0) / 2.0
        off_x, off_y = x1 + (w1 - 1.0) / 2.0 - centre_x, y1 + (h1 - 1.0) / 2.0 - centre_y
        counts_centre = counts
        if by_centre and not leaves_out:
            counts_centre = centre_x > 0 and centre_y > 0
        if counts_centre:
            error = np.sqrt(off_x * off_x + off_y * off_y)
            off_x = off_x / w if w > 0 else np.nan
            off_y = off_y / h if h > 0 else np.nan
            norm_error = np.sqrt(off_x * off_x + off_y * off_y)
        else:
            error = norm_error = np.inf if leaves_out else -1.0
        norm_error = _within(norm_error, 1.0)
        within = 51 - int(np.ceil(_within(error, 51.0)))

        begin, end = sums[s, sigma_from[p]], sums[s, sigma_to[p]]
        norm_auc = 51 - min(int(_below(norm_error, 100)), 51)
        dp20, norm_dp20, within50 = int(within > 30), int(norm_error <= 0.20), int(within > 0)
        begin[0] += auc
        begin[1] += dp20
        begin[2] += norm_dp20
        begin[3] += norm_auc
        begin[4] += within50
        end[0] -= auc
        end[1] -= dp20
        end[2] -= norm_dp20
        end[3] -= norm_auc
        end[4] -= within50
        if sigma_from[p] <= curves_at < sigma_to[p]:
            success[s, auc] += 1
            precision[s, within] += 1
        if counts and shared == 0:
            for m in range(sigma_from[p], sigma_to[p]):
                failure[s, m] = min(failure[s, m], i)
