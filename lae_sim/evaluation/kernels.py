"""Pairing outputs with queries and counting what they are worth, compiled.

See :mod:`lae_sim._compiled`. S is the number of sequences, n that of their outputs, M that of the
permitted latencies, and P that of pairs.
"""

from __future__ import annotations

import numpy as np

from lae_sim._arrays import Bools, Floats, Frames, Ints
from lae_sim._compiled import kernel
from lae_sim.forecast.kernels import overlap

_AT_ONCE = 256  # pairs whose boxes stay in the first cache


@kernel
def _quotient(value: int, divisor: int, inverse: float) -> int:
    """``value // divisor``: a division of integers takes as long as all that is around it.

    Args:
        value: a whole number.
        divisor: above zero.
        inverse: 1 / divisor.
    """
    if divisor == 1:
        return value
    quotient = int(value * inverse)  # off by one, or by a few where it has more than 52 bits
    while quotient * divisor > value:
        quotient -= 1
    while value - quotient * divisor >= divisor:
        quotient += 1
    return quotient


@kernel
def first_steps(ready: Ints, interval: int, scale: int, steps: Ints) -> None:
    """The step from which each output is visible: ceil(scale * ready / interval).

    Args:
        ready: ticks, int64 [n].
        interval: ticks of a frame.
        scale: see :class:`.pairing.Pairing`.
        steps: written, int64 [n].
    """
    inverse = 1.0 / interval
    for o in range(len(ready)):
        frame = _quotient(ready[o], interval, inverse)
        late = ready[o] - frame * interval
        steps[o] = frame * scale - _quotient(-late * scale, interval, inverse)


@kernel
def first_visible(
    steps: Ints,
    offsets: Ints,
    lengths: Ints,
    scale: int,
    whole: Ints,
    part: Ints,
    first: Frames,
    end: Frames,
) -> None:
    """Where each output answers first, and no longer; see :func:`.pairing._first_visible`.

    Args:
        steps, offsets, lengths, scale: see :class:`.pairing.Pairing`.
        whole, part: the permitted latencies in whole frames, and the steps beyond, int64 [M].
        first, end: see :class:`.pairing.Pairing`: written, int32 [n, M].
    """
    inverse = 1.0 / scale
    for s in range(len(lengths)):
        length = lengths[s]
        for o in range(offsets[s], offsets[s + 1]):
            frame = _quotient(steps[o], scale, inverse)
            rest = steps[o] - frame * scale
            for m in range(len(whole)):
                since = min(max(frame - whole[m] + (rest > part[m]), 0), length)
                first[o, m] = since
                end[o, m] = length
                if o > offsets[s]:
                    end[o - 1, m] = since


@kernel
def sum_gaps(
    lengths: Ints,
    offsets: Ints,
    frames: Ints,
    steps: Ints,
    scale: int,
    whole: Ints,
    part: Ints,
    source_sum: Ints,
    mismatch: Ints,
    hold: Ints,
) -> None:
    """Sums and largest distances of frames in each sequence at each permitted latency.

    Args:
        lengths, offsets, frames, steps, scale: see :class:`.pairing.Pairing`.
        whole, part: see :func:`first_visible`.
        source_sum, mismatch, hold: see :class:`.pairing._Gaps`: written, int64 [S, M].
    """
    source_sum[:] = 0
    mismatch[:] = 0
    hold[:] = 0
    inverse = 1.0 / scale
    first = np.empty(len(whole), np.int64)
    for s in range(len(lengths)):
        length = lengths[s]
        first[:] = 0
        for o in range(offsets[s], offsets[s + 1]):
            is_last = o + 1 == offsets[s + 1]
            following = 0 if is_last else steps[o + 1]
            frame = _quotient(following, scale, inverse)
            rest = following - frame * scale
            for m in range(len(whole)):
                end = length
                if not is_last:
                    end = min(max(frame - whole[m] + (rest > part[m]), 0), length)
                answered = end - first[m]
                source_sum[s, m] += answered * frames[o]
                mismatch[s, m] = max(mismatch[s, m], end - frames[o] - 1)
                hold[s, m] = max(hold[s, m], answered)
                first[m] = end


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
def _place(sigmas: Ints, value: int) -> int:
    """How many sigmas are below a value; where they are dense it may be out of range."""
    if sigmas[-1] - sigmas[0] == len(sigmas) - 1:
        return value - int(sigmas[0])
    return int(np.searchsorted(sigmas, value))


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
    n = 0
    for h in range(len(offsets) - 1):
        low, high = sigma_from[h], sigma_to[h]
        for item in range(offsets[h], offsets[h + 1]):
            o = output[item]
            for frame in range(first[o, high - 1], end[o, low]):
                from_, to = low, high
                if high - low > 1:
                    since, until = steps[o] - scale * frame, next_steps[o] - scale * frame
                    from_, to = max(_place(sigmas, since), low), min(_place(sigmas, until), high)
                if from_ < to:
                    items[n], frames[n], froms[n], tos[n] = item, frame, from_, to
                    n += 1
    return n


@kernel
def _within(value: float, most: float) -> float:
    """A number as one from 0 to the most, which NaN becomes."""
    value = value if value < most else most
    return value if value > 0.0 else 0.0


@kernel
def _below(value: float, steps: int) -> float:
    """See :func:`.metrics._below`."""
    whole = float(np.floor(value * steps))
    return whole + 1.0 if whole / steps < value else whole


@kernel
def _measure(
    truth: Floats,
    boxes: Floats,
    count: int,
    valid: int,
    leaves_out: bool,
    by_centre: bool,
    steps: int,
    worth: Frames,
) -> None:
    """What pairs count, in a loop that compilers turn to vector instructions.

    Args:
        truth, boxes: columns, float64 [4, ...].
        count: how many pairs.
        valid, leaves_out, by_centre, steps: see :func:`count_pairs`.
        worth: written, int32 [...], none of them 0::

            bit   24      23     22  21         15        8           0
                   1 | apart | norm_dp | norm (6) | precision (6) | success (9)

            They are those of :class:`.metrics.FrameCounts`.
    """
    # by rows, which the compiler can see not to overlap
    x_, y_, w_, h_ = truth[0], truth[1], truth[2], truth[3]
    x1_, y1_, w1_, h1_ = boxes[0], boxes[1], boxes[2], boxes[3]
    missed = np.inf if leaves_out else -1.0
    for k in range(count):
        x, y, w, h = x_[k], y_[k], w_[k], h_[k]
        x1, y1, w1, h1 = x1_[k], y1_[k], w1_[k], h1_[k]
        counts = (w > 0) & (h > 0)
        if valid == 1:
            counts &= (x > 0) & (y > 0)
        elif valid == 2:
            counts = (x == x) & (y == y) & (w == w) & (h == h)
        shared = overlap((x, y, w, h), (x1, y1, w1, h1))
        shared = shared if counts else 0.0

        centre_x, centre_y = x + (w - 1.0) / 2.0, y + (h - 1.0) / 2.0
        off_x, off_y = x1 + (w1 - 1.0) / 2.0 - centre_x, y1 + (h1 - 1.0) / 2.0 - centre_y
        counts_centre = counts
        if by_centre and not leaves_out:
            counts_centre = (centre_x > 0) & (centre_y > 0)
        error = np.sqrt(off_x * off_x + off_y * off_y)
        off_x = off_x / w if w > 0 else np.nan
        off_y = off_y / h if h > 0 else np.nan
        norm_error = np.sqrt(off_x * off_x + off_y * off_y)
        error = _within(error if counts_centre else missed, 51.0)
        norm_error = _within(norm_error if counts_centre else missed, 1.0)
        above = _below(norm_error, 100)

        # whole numbers in a float, so that only one is converted
        packed = 2.0**23 if counts & (shared == 0) else 0.0
        packed += 2.0**22 if norm_error <= 0.20 else 0.0
        packed += (51.0 - (above if above < 51.0 else 51.0)) * 2.0**15
        packed += (51.0 - np.ceil(error)) * 2.0**9
        worth[k] = np.int32(packed + _below(shared, steps) + 2.0**24)


@kernel
def _add(
    sums: Ints, s: int, m: int, auc: int, dp20: int, norm_dp20: int, norm_auc: int, within50: int
) -> None:
    sums[s, m, 0] += auc
    sums[s, m, 1] += dp20
    sums[s, m, 2] += norm_dp20
    sums[s, m, 3] += norm_auc
    sums[s, m, 4] += within50


@kernel
def _tally(
    worth: Frames,
    sequence: Ints,
    frame: Ints,
    sigma_from: Ints,
    sigma_to: Ints,
    curves_at: int,
    sums: Ints,
    success: Ints,
    precision: Ints,
    failure: Ints,
) -> None:
    """Add what some pairs count; see :func:`_measure` and :func:`count_pairs`."""
    s = low = high = 0
    shown = False
    auc = dp20 = norm_dp20 = norm_auc = within50 = 0  # of pairs in a row of the same sigmas
    for k in range(len(sequence)):
        if sequence[k] != s or sigma_from[k] != low or sigma_to[k] != high:
            _add(sums, s, low, auc, dp20, norm_dp20, norm_auc, within50)
            _add(sums, s, high, -auc, -dp20, -norm_dp20, -norm_auc, -within50)
            auc = dp20 = norm_dp20 = norm_auc = within50 = 0
            s, low, high = sequence[k], sigma_from[k], sigma_to[k]
            shown = low <= curves_at < high
        packed = int(worth[k])
        passed, within = packed & 511, packed >> 9 & 63
        auc += passed
        dp20 += within > 30
        norm_dp20 += packed >> 22 & 1
        norm_auc += packed >> 15 & 63
        within50 += within > 0
        if shown:
            success[s, passed] += 1
            precision[s, within] += 1
        if packed >> 23 & 1:
            for m in range(low, high):
                failure[s, m] = min(failure[s, m], frame[k])
    _add(sums, s, low, auc, dp20, norm_dp20, norm_auc, within50)
    _add(sums, s, high, -auc, -dp20, -norm_dp20, -norm_auc, -within50)


@kernel
def _gather(
    truth: Floats,
    at: int,
    answer: Floats,
    is_truth: bool,
    known: Floats,
    answered: Floats,
    k: int,
) -> None:
    """Put a pair's truth and answer, or the truth as such, in column k of two tables."""
    for i in range(4):
        known[i, k] = truth[i, at]
        answered[i, k] = truth[i, at] if is_truth else answer[i]


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
    known, answered = np.empty((4, _AT_ONCE)), np.empty((4, _AT_ONCE))
    worth = np.empty(_AT_ONCE, np.int32)
    for begin in range(0, len(frame), _AT_ONCE):
        end = min(begin + _AT_ONCE, len(frame))
        for p in range(begin, end):
            at = bases[sequence[p]] + frame[p]
            is_truth = first_frame_is_truth and frame[p] == 0
            _gather(truth, at, boxes[p], is_truth, known, answered, p - begin)
        _measure(known, answered, end - begin, valid, leaves_out, by_centre, steps, worth)
        _tally(
            worth,
            sequence[begin:end],
            frame[begin:end],
            sigma_from[begin:end],
            sigma_to[begin:end],
            curves_at,
            sums,
            success,
            precision,
            failure,
        )


@kernel
def _learn(
    fresh: Frames,
    new: Ints,
    lags: Ints,
    bases: Ints,
    sequence: Ints,
    frame: Ints,
    worth: Frames,
    found: Frames,
) -> None:
    """Put what is measured of some pairs in its places; see :func:`count_held`."""
    for u in range(len(new)):
        k = new[u]
        worth[k] = fresh[u]
        if lags[u] >= 0:
            found[bases[sequence[k]] + frame[k], lags[u]] = fresh[u]


@kernel
def count_held(
    bases: Ints,
    truth: Floats,
    lengths: Ints,
    offsets: Ints,
    frames: Ints,
    own_steps: Ints,
    scale: int,
    sigmas: Ints,
    table: Floats,
    row: Ints,
    own: Bools,
    found: Frames,
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
    """The same for pairs with the latest output of a history of all outputs, none of them listed.

    Args:
        bases, truth, and all from ``valid`` on: see :func:`count_pairs`.
        lengths, offsets, frames, own_steps, scale, sigmas: see :class:`.pairing.Pairing`.
        table, row: boxes, float64 [N, 4], and the row of each output's, int64 [n].
        own: whether a sequence's boxes are those of the recording that its truth is of, bool [S].
        found: what the box of the frame 0, 1, 2, ... frames before counts, of such a recording, 0
            where that is not known yet: read and written, int32 [..., lags].
    """
    known, answered = np.empty((4, _AT_ONCE)), np.empty((4, _AT_ONCE))
    worth, fresh = np.empty((2, _AT_ONCE), np.int32)
    block = np.empty((6, _AT_ONCE), np.int64)
    sequence, frame, sigma_from, sigma_to, new, lags = block
    count, most = len(sigmas), found.shape[1]
    inverse = 1.0 / scale
    n = unknown = 0
    for s in range(len(lengths)):
        length, base, last = lengths[s], bases[s], offsets[s + 1] - 1
        begin = 0
        for o in range(offsets[s], last + 1):
            end = following = length
            if o < last:
                step = own_steps[o + 1]
                end = min(max(-_quotient(sigmas[0] - step, scale, inverse), 0), length)
                following = end
                if count > 1:
                    following = -_quotient(sigmas[-1] - step, scale, inverse)
                    following = min(max(following, 0), length)
            for i in range(begin, end):
                low, high = 0, count
                if count > 1:
                    if o > offsets[s]:
                        low = max(_place(sigmas, own_steps[o] - scale * i), 0)
                    if o < last:
                        high = min(_place(sigmas, own_steps[o + 1] - scale * i), count)
                    if low >= high:
                        continue
                lag = i - frames[o]
                if not (own[s] and 0 <= lag < most):
                    lag = -1
                packed = found[base + i, lag] if lag >= 0 else 0
                worth[n] = packed
                sequence[n], frame[n], sigma_from[n], sigma_to[n] = s, i, low, high
                if packed == 0:
                    is_truth = first_frame_is_truth and i == 0
                    _gather(truth, base + i, table[row[o]], is_truth, known, answered, unknown)
                    new[unknown], lags[unknown] = n, lag
                    unknown += 1
                n += 1
                if n == _AT_ONCE:
                    _measure(known, answered, unknown, valid, leaves_out, by_centre, steps, fresh)
                    _learn(fresh, new[:unknown], lags, bases, sequence, frame, worth, found)
                    _tally(
                        worth,
                        sequence,
                        frame,
                        sigma_from,
                        sigma_to,
                        curves_at,
                        sums,
                        success,
                        precision,
                        failure,
                    )
                    n = unknown = 0
            begin = following
    _measure(known, answered, unknown, valid, leaves_out, by_centre, steps, fresh)
    _learn(fresh, new[:unknown], lags, bases, sequence, frame, worth, found)
    _tally(
        worth,
        sequence[:n],
        frame[:n],
        sigma_from[:n],
        sigma_to[:n],
        curves_at,
        sums,
        success,
        precision,
        failure,
    )
