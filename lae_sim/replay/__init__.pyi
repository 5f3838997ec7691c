from .latency import (
    LatencySource,
    RandomSource,
    bootstrap,
    by_call,
    by_frame,
    constant,
    initialised,
    lognormal,
    resampled,
    scaled,
)
from .run import Run, Runs, replay_repeated, replay_sequence
from .strides import followed, phases
from .world import (
    SIGMA_GRID,
    TraceLike,
    World,
    parse_latency,
    parse_policy,
    parse_sigmas,
    replay_trace,
)

__all__ = [
    "SIGMA_GRID",
    "LatencySource",
    "RandomSource",
    "Run",
    "Runs",
    "TraceLike",
    "World",
    "bootstrap",
    "by_call",
    "by_frame",
    "constant",
    "followed",
    "initialised",
    "lognormal",
    "parse_latency",
    "parse_policy",
    "parse_sigmas",
    "phases",
    "replay_repeated",
    "replay_sequence",
    "replay_trace",
    "resampled",
    "scaled",
]
