"""Frames that a camera dropped, as the numbers in the names of its images tell.

Images 1, 2, 3, 5, 6 of a sequence say that frame 4 never came, and that frame 5 came two intervals
after frame 3. Images that merely start at another number, or of which every third is kept, say
nothing of the kind: all their steps are equal.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import islice, pairwise
from statistics import median

import numpy as np

from lae_sim._arrays import Ints
from lae_sim.engine.clock import NS_PER_SECOND, fitting
from lae_sim.errors import LaeError, listed

FRAME_TIMES = ("numbers", "even")
"""When frames with numbers missing arrive: at their own times, or evenly."""

_DIGITS = re.compile("[0-9]+")
_MOST_STEPS = 10  # a typical step beyond which numbers count something else, such as milliseconds


def numbers_in(stems: Sequence[str]) -> list[int]:
    """The number of each image, from the names without their endings; -1 without any.

    It is the last number in the name that is not the same in all of them: in ``cam2_0007_640x480``
    it is 7.
    """
    found = [_DIGITS.findall(stem) for stem in stems]
    if len({len(each) for each in found}) == 1:
        changing = [at for at, column in enumerate(zip(*found)) if len(set(column)) > 1]
        found = [[each[at] for at in changing] or each for each in found]
    return [int("".join(each[-1:]) or -1) for each in found]


def step_of(numbers: Sequence[int]) -> int:
    """By how much the numbers of two frames after each other differ; 0 where nobody can tell.

    It is the greatest common divisor of all steps.
    """
    steps = [b - a for a, b in pairwise(numbers)]
    if not steps or min(steps) <= 0:
        return 0
    step = math.gcd(*steps)
    return step if median(steps) <= _MOST_STEPS * step else 0


def missing(numbers: Sequence[int]) -> list[int]:
    """The first numbers that are missing, up to four; none if all steps are equal."""
    step = step_of(numbers)
    if not step:
        return []
    gone = (n for a, b in pairwise(numbers) for n in range(a + step, b, step))
    return list(islice(gone, 4))


def arrivals(numbers: Sequence[int], fps: Fraction) -> Ints:
    """When frames arrive that the numbers place, ns after the first one, int64 [T].

    Each time is exactly rational, and rounded to the nearest ns, half to even. Where the numbers
    tell nothing, the frames arrive one after another.

    Raises:
        LaeError: if a time does not fit in 64 bits.
    """
    step = step_of(numbers)
    places = [(n - numbers[0]) // step for n in numbers] if step else range(len(numbers))
    interval = Fraction(NS_PER_SECOND) / fps
    fitting(round(places[-1] * interval), f"image number {numbers[-1]} at {fps} frames/s")
    return np.array([round(place * interval) for place in places], np.int64)


def check_frame_times(frame_times: str | None) -> str | None:
    """That value, if it is one.

    Raises:
        LaeError: if there is no such way.
    """
    if frame_times not in (None, *FRAME_TIMES):
        raise LaeError(f"frame times: no {frame_times!r}: there are {' and '.join(FRAME_TIMES)}")
    return frame_times


def ask(sequence: str, numbers: Sequence[int], fps: Fraction) -> LaeError:
    """The question that frames with numbers missing raise."""
    gone = missing(numbers)
    some = ", ".join(map(str, gone[:3])) + ", ..." * (len(gone) > 3)
    return LaeError(
        f"sequence {sequence!r}: no image number {some}: did the camera drop frames? "
        "--frame-times numbers (frame_times) lets each image come at the time of its number at "
        f"{fps} frames/s, --frame-times even one after another"
    )


def note(sequences: Iterable[str], frame_times: str) -> str:
    """What to say of sequences with numbers missing, once it is known when their frames come."""
    how = "each image comes at the time of its number"
    if frame_times == "even":
        how = "the images come evenly, as if none were missing"
    return (
        f"image numbers are missing in {listed(sequences, 3)}: {how} (--frame-times {frame_times})"
    )
