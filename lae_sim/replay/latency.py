"""Latency sources: where a replay takes its processing times from.

A source makes, for each recording, the service that the engine asks how long a frame takes. Those
made here know all times before the first call (:class:`Times`), so many sequences can be scheduled
at once (:mod:`lae_sim.engine.lanes`). Random sources draw from one stream per sequence, seeded by
the seed and the sequence's name, so the order and the number of sequences never change a result.
Streams are raw 64-bit words of PCG64 and the arithmetic on them is ours, so that they are the same
under every NumPy version; the lognormal one also rests on the platform's exp and log, whose last
bit may differ before rounding to ns. Initialisation is a call of its own kind: any source may be
given a time for it (:func:`initialised`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from operator import index
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Ints
from lae_sim.engine.clock import MAX_INT64, duration_ns
from lae_sim.engine.scheduler import Service
from lae_sim.engine.times import Times
from lae_sim.errors import LaeError
from lae_sim.trace.recording import Recording, in_order, stage_column

LatencySource = Callable[[Recording], Service]
"""``source(recording)`` returns the service that times that sequence."""

Words = npt.NDArray[np.uint64]


def by_frame(recording: Recording) -> Times:
    """The time recorded for the frame itself."""
    return Times(recording.name, recording.elapsed_ns)


def by_call(recording: Recording) -> Times:
    """The k-th call takes the k-th recorded time: warm-up stalls belong to the call."""
    return Times(recording.name, _recorded(recording), by_call=True)


@dataclass(frozen=True)
class StageTimes:
    """The times recorded for some stages of the frame itself, added up.

    Attributes:
        stages: their names, each once.

    Raises:
        LaeError: if there is none, one is there twice, or is no name of a stage; for a recording,
            if it lacks one. A frame of which it does not say all of them has no time.
    """

    stages: tuple[str, ...]

    def __post_init__(self) -> None:
        columns = [stage_column(name) for name in self.stages]
        if not columns or len(set(columns)) < len(columns):
            raise LaeError(f"{self.label!r:.80}: name one stage or several, each once")

    @property
    def label(self) -> str:
        """The name of the source in tables."""
        return f"stage:{'+'.join(self.stages)}"

    def __call__(self, recording: Recording) -> Times:
        """The times of a recording."""
        for name in self.stages:
            if name not in recording.stages:
                there = ", ".join(in_order(recording.stages))
                stages = f"it has those of {there}" if there else "it has those of whole calls only"
                raise LaeError(
                    f"sequence {recording.name!r}: the trace has no times of stage {name!r} "
                    f"(column {stage_column(name)}): {stages}"
                )
        parts = np.array([recording.stages[name] for name in self.stages])
        ns = np.where((parts < 0).any(0), -1, parts.sum(0))
        absent = f"the trace has no time of {' and '.join(self.stages)} for it"
        if len(ns) and ns[0] < 0:
            absent += "; that of frame 0 may be given, as ,init=TIME"
        elif len(ns):
            absent += ": the tracker skipped it, or marked no such stage"
        return Times(recording.name, ns, absent=absent)


def constant(
    elapsed: str | None = None,
    *,
    ns: int | None = None,
    init: str | None = None,
    init_ns: int | None = None,
) -> LatencySource:
    """Every call takes the same time; the initialisation too, unless it has one of its own.

    Args:
        elapsed: the time with its unit, such as ``"47ms"``.
        ns: the same in nanoseconds.
        init: what the initialisation takes, such as ``"800ms"``.
        init_ns: the same in nanoseconds.

    Raises:
        LaeError: if one is not a duration, or below zero.
    """
    source = Constant(duration_ns(elapsed, ns))
    if init is None and init_ns is None:
        return source
    return initialised(source, duration_ns(init, init_ns))


@dataclass(frozen=True)
class Constant:
    """One time for every call.

    Attributes:
        ns: the time.
    """

    ns: int

    @property
    def label(self) -> str:
        """The name of the source in tables."""
        return f"constant:{time_label(self.ns)}"

    def __call__(self, recording: Recording) -> Times:
        """The times of a recording."""
        time = np.array(min(self.ns, MAX_INT64), np.int64)
        return Times(recording.name, np.broadcast_to(time, len(recording)), by_call=True)


def time_label(ns: int) -> str:
    """A time as the names of sources have it."""
    ms = Fraction(ns, 10**6)
    return f"{ms}ms" if ms.denominator == 1 else f"{ns}ns"


@dataclass(frozen=True)
class RandomSource:
    """Draws the time of every call but the initialisation, which keeps its recorded one.

    Attributes:
        seed: of the streams.
        draw: makes times in ns, int64 [R, n], of the recorded ones (without the initialisation's,
            unless there is no other) and of uniform words, uint64 [R, n].
        repetition: which part of a sequence's stream is used: T words each, the last one idle.
        factors: exact factors on the times, one after another.
        init_ns: the time of the initialisation, if it does not keep its recorded one; the factors
            are in it.
    """

    seed: int
    draw: Callable[[Ints, Words], npt.ArrayLike]
    repetition: int = 0
    factors: tuple[Fraction, ...] = ()
    init_ns: int | None = None

    def __call__(self, recording: Recording) -> Times:
        """The times of this repetition."""
        times = self.repeated(recording, self.repetition, 1)[0]
        return Times(recording.name, times, by_call=True)

    def repeated(self, recording: Recording, first: int, count: int) -> Ints:
        """The times of all possible calls in some repetitions, ns, int64 [count, T]."""
        recorded, length = _recorded(recording), len(recording)
        words = stream(self.seed, recording.name, first * length, count * length)
        words = words.reshape(count, length)
        times = np.empty((count, length), np.int64)
        times[:, 0] = recorded[0]
        times[:, 1:] = self.draw(recorded[1:] if len(recorded) > 1 else recorded, words[:, :-1])
        for factor in self.factors:
            times = _times(factor, times)
        if self.init_ns is not None:
            times[:, 0] = self.init_ns
        return times


def stream(seed: int, name: str, begin: int, count: int) -> Words:
    """Some words of the random stream of a seed and a sequence, uint64 [count].

    Args:
        seed: any whole number.
        name: of the sequence.
        begin: how many words of the stream come before them.
        count: how many they are.
    """
    digest = hashlib.sha256(f"{seed}\0{name}".encode()).digest()
    words: Any = np.random.PCG64(int.from_bytes(digest, "big"))
    drawn: Words = words.advance(begin).random_raw(count)
    return drawn


@dataclass(frozen=True)
class Uniform:
    """Draws every call's time, the initialisation's too, evenly from a range of whole ns.

    Attributes:
        low_ns, high_ns: the least and the greatest.
        seed: of the streams.
        repetition: see :class:`RandomSource`.

    Raises:
        LaeError: if the range is empty, or wider than 2**32 ns.
    """

    low_ns: int
    high_ns: int
    seed: int
    repetition: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.high_ns - self.low_ns < 2**32:
            raise LaeError(
                f"a range of times goes from the lower to the higher, at most 4.2 s apart, not "
                f"from {time_label(self.low_ns)} to {time_label(self.high_ns)}"
            )

    @property
    def label(self) -> str:
        """The name of the source in tables."""
        return f"uniform:{time_label(self.low_ns)}-{time_label(self.high_ns)}:{self.seed}"

    def __call__(self, recording: Recording) -> Times:
        """The times of this repetition."""
        length = len(recording)
        words = stream(self.seed, recording.name, self.repetition * length, length)
        drawn = self.low_ns + _below(self.high_ns - self.low_ns + 1, words)
        return Times(recording.name, drawn, by_call=True)


def resampled(seed: int, repetition: int = 0) -> RandomSource:
    """Each call draws one of the sequence's recorded times, with replacement.

    Initialisation keeps its recorded time and is not drawn for the other calls. Another repetition
    draws from another part of the same stream.
    """
    return RandomSource(seed, _one_by_one, repetition)


def _one_by_one(times: Ints, words: Words) -> Ints:
    drawn: Ints = times[_below(len(times), words)]
    return drawn


def bootstrap(seed: int, block: int = 30, repetition: int = 0) -> RandomSource:
    """Blocks of consecutive recorded times, which keep stalls and autocorrelation.

    The circular block bootstrap: every block begins at a call that is drawn uniformly, and goes on
    from the last call to the first (Politis and Romano, "A circular block-resampling procedure for
    stationary data", 1992). Initialisation keeps its recorded time and is not drawn.

    Args:
        seed: of the streams.
        block: calls in a block.
        repetition: another one draws from another part of the same stream.

    Raises:
        LaeError: if a block has no calls.
    """
    if block < 1:
        raise LaeError(f"a block of times needs at least one call, not {block}")
    return RandomSource(seed, partial(_in_blocks, block), repetition)


def _in_blocks(block: int, times: Ints, words: Words) -> Ints:
    repetitions, calls = words.shape
    block = max(min(block, calls), 1)
    blocks = -(-calls // block)
    starts = _below(len(times), words[:, :blocks])
    circle = np.resize(times, len(times) + block - 1)
    drawn = np.lib.stride_tricks.sliding_window_view(circle, block)[starts]
    return drawn.reshape(repetitions, blocks * block)[:, :calls]


def lognormal(seed: int, repetition: int = 0) -> RandomSource:
    """Each call draws from the lognormal distribution fitted to the sequence's recorded times.

    The fit is by moments of the logarithm, times below 1 ns counting as 1 ns. Initialisation keeps
    its recorded time and is left out of the fit. Another repetition draws from another part of the
    same stream.
    """
    return RandomSource(seed, _from_fit, repetition)


def _from_fit(times: Ints, words: Words) -> list[list[int]]:
    logs = [math.log(max(ns, 1)) for ns in times.tolist()]
    mean = math.fsum(logs) / len(logs)
    deviation = math.sqrt(math.fsum((log - mean) ** 2 for log in logs) / len(logs))
    inverse = NormalDist().inv_cdf

    def draw(word: int) -> int:
        uniform = ((word >> 11) + 0.5) / 2**53
        return min(round(math.exp(mean + deviation * inverse(uniform))), MAX_INT64)

    return [[draw(word) for word in row] for row in words.tolist()]


def scaled(source: LatencySource, factor: Fraction) -> LatencySource:
    """The times of another source times an exact factor, rounded half to even to whole ns.

    Raises:
        LaeError: if the factor is below zero.
    """
    if factor < 0:
        raise LaeError(f"times cannot be scaled by {factor}, below zero")
    if factor == 1:
        return source
    if isinstance(source, RandomSource):
        init_ns = source.init_ns
        if init_ns is not None:
            init_ns = int(_times(factor, np.array([init_ns]))[0])
        return replace(source, factors=(*source.factors, factor), init_ns=init_ns)

    def scaled_source(recording: Recording) -> Service:
        service = source(recording)
        if isinstance(service, Times):
            return replace(service, ns=_times(factor, service.ns))
        return lambda frame: round(index(service(frame)) * factor)

    return scaled_source


def initialised(source: LatencySource, ns: int) -> LatencySource:
    """The times of another source, but for that of the initialisation, the call on frame 0.

    The other calls take what they would have taken: by call, the second takes the second time.

    Args:
        source: of all times. To scale it afterwards scales the initialisation too.
        ns: what the initialisation takes.

    Raises:
        LaeError: if the time is below zero.
    """
    ns = min(duration_ns(None, ns), MAX_INT64)
    if isinstance(source, RandomSource):
        return replace(source, init_ns=ns)
    return Initialised(source, ns)


@dataclass(frozen=True)
class Initialised:
    """A source whose initialisation has a time of its own.

    Attributes:
        source: of the other times.
        init_ns: the time.
    """

    source: LatencySource
    init_ns: int

    def __call__(self, recording: Recording) -> Service:
        """The times of a recording."""
        service = self.source(recording)
        if isinstance(service, Times):
            ns = service.ns.copy()
            ns[0] = self.init_ns
            return replace(service, ns=ns)

        def initialised_service(frame: int) -> int:
            ns = service(frame)  # asked for frame 0 too: it may count its calls
            return ns if frame else self.init_ns

        return initialised_service


def _times(factor: Fraction, ns: Ints) -> Ints:
    """Times by an exact factor, at most 2**63 - 1 ns, which no schedule holds; -1 stays."""
    p, q = factor.numerator, factor.denominator
    if max(int(ns.max()), 1) * p + 2 * q > MAX_INT64:
        exact = (n if n < 0 else min(round(n * factor), MAX_INT64) for n in ns.ravel().tolist())
        return np.fromiter(exact, np.int64, ns.size).reshape(ns.shape)
    whole, rest = np.divmod(ns * p, q)
    whole += 2 * rest + (whole & 1) > q  # half goes to the even neighbour
    whole[ns < 0] = -1
    return whole


def _recorded(recording: Recording) -> Ints:
    """The recorded times in the order of the calls, int64 [n]."""
    times: Ints = recording.elapsed_ns[recording.elapsed_ns >= 0]
    return times


def _below(limit: int, words: Words) -> Ints:
    """Whole numbers below a limit of at most 2**32: ``words * limit >> 64``."""
    half, n = np.uint64(32), np.uint64(limit)
    high, low = words >> half, words & np.uint64(2**32 - 1)
    return (high * n + (low * n >> half) >> half).astype(np.int64)
