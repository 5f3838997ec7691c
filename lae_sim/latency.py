"""Latency sources: where a replay takes its processing times from.

A source makes, for each recording, the service that the engine asks how long a frame takes. Random
sources draw from one stream per sequence, seeded by the seed and the sequence's name, so the order
and the number of sequences never change a result. Streams are raw 64-bit words of PCG64 and the
arithmetic on them is ours, so that they are the same under every NumPy version; the lognormal one
also rests on the platform's exp and log, whose last bit may differ before rounding to ns.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from statistics import NormalDist

import numpy as np

from lae_sim.engine import Service
from lae_sim.errors import LaeError
from lae_sim.recording import Recording

LatencySource = Callable[[Recording], Service]
"""``source(recording)`` returns the service that times that sequence."""


def by_frame(recording: Recording) -> Service:
    """The time recorded for the frame itself."""
    elapsed = recording.elapsed_ns.tolist()

    def look_up(frame: int) -> int:
        ns: int = elapsed[frame]
        if ns < 0:
            raise LaeError(
                f"sequence {recording.name!r}, frame {frame}: the trace has no time for it, since "
                "the tracker skipped it; use the times by call, or a trace of every frame"
            )
        return ns

    return look_up


def by_call(recording: Recording) -> Service:
    """The k-th call takes the k-th recorded time: warm-up stalls belong to the call."""
    elapsed = recording.elapsed_ns[recording.elapsed_ns >= 0].tolist()
    times = iter(elapsed)

    def next_time(frame: int) -> int:
        for ns in times:
            return int(ns)
        raise LaeError(
            f"sequence {recording.name!r}, frame {frame}: call {len(elapsed) + 1} is asked for, "
            f"and the trace holds the times of {len(elapsed)} calls"
        )

    return next_time


def constant(elapsed_ns: int) -> LatencySource:
    """Every call takes ``elapsed_ns``, the initialisation too."""

    def source(recording: Recording) -> Service:
        return lambda frame: elapsed_ns

    return source


def resampled(seed: int) -> LatencySource:
    """Each call draws one of the sequence's recorded times, with replacement.

    Initialisation keeps its recorded time and is not drawn for the other calls.
    """

    def source(recording: Recording) -> Service:
        init, times = _init_and_times(recording)
        words = _random_words(seed, recording.name)
        return lambda frame: times[next(words) * len(times) >> 64] if frame else init

    return source


def lognormal(seed: int) -> LatencySource:
    """Each call draws from the lognormal distribution fitted to the sequence's recorded times.

    The fit is by moments of the logarithm, times below 1 ns counting as 1 ns. Initialisation keeps
    its recorded time and is left out of the fit.
    """

    def source(recording: Recording) -> Service:
        init, times = _init_and_times(recording)
        logs = [math.log(max(ns, 1)) for ns in times]
        mean = math.fsum(logs) / len(logs)
        deviation = math.sqrt(math.fsum((log - mean) ** 2 for log in logs) / len(logs))
        words = _random_words(seed, recording.name)
        inverse = NormalDist().inv_cdf

        def draw(frame: int) -> int:
            if frame == 0:
                return init
            uniform = ((next(words) >> 11) + 0.5) / 2**53
            return round(math.exp(mean + deviation * inverse(uniform)))

        return draw

    return source


def scaled(source: LatencySource, factor: Fraction) -> LatencySource:
    """The times of another source times an exact factor, rounded half to even to whole ns."""
    if factor < 0:
        raise LaeError(f"times cannot be scaled by {factor}, below zero")

    if factor == 1:
        return source

    def scaled_source(recording: Recording) -> Service:
        service = source(recording)
        if factor.denominator == 1:
            return lambda frame: service(frame) * factor.numerator
        return lambda frame: round(service(frame) * factor)

    return scaled_source


def _init_and_times(recording: Recording) -> tuple[int, list[int]]:
    """The time of the initialisation and those of the other calls (or itself, if there is none)."""
    init, *times = recording.elapsed_ns[recording.elapsed_ns >= 0].tolist()
    return init, times or [init]


def _random_words(seed: int, name: str) -> Iterator[int]:
    """Uniform 64-bit words of the stream that belongs to one sequence under one seed."""
    digest = hashlib.sha256(f"{seed}\0{name}".encode()).digest()
    generator = np.random.PCG64(int.from_bytes(digest, "big"))
    while True:
        yield from generator.random_raw(64).tolist()
