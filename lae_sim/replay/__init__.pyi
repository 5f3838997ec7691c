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
from .names import parse_latency, parse_policy
from .pipeline import parse_pipeline, parse_time, read_pipeline
from .reach import OwnJump, Reach, Restart, fit_reach, own_jumps, restarts_of
from .recorded import AsRecorded
from .run import Repetitions, Run, RunBatch, Runs, replay_repeated, replay_sequence
from .search import Outcomes, SearchModel, find_search
from .strides import followed, phases
from .world import (
    SIGMA_GRID,
    TraceLike,
    World,
    parse_sigmas,
    replay_trace,
)

__all__ = [
    "SIGMA_GRID",
    "AsRecorded",
    "LatencySource",
    "Outcomes",
    "OwnJump",
    "RandomSource",
    "Reach",
    "Repetitions",
    "Restart",
    "Run",
    "RunBatch",
    "Runs",
    "SearchModel",
    "TraceLike",
    "World",
    "bootstrap",
    "by_call",
    "by_frame",
    "constant",
    "find_search",
    "fit_reach",
    "followed",
    "initialised",
    "lognormal",
    "own_jumps",
    "parse_latency",
    "parse_pipeline",
    "parse_policy",
    "parse_sigmas",
    "parse_time",
    "phases",
    "read_pipeline",
    "replay_repeated",
    "replay_sequence",
    "replay_trace",
    "resampled",
    "restarts_of",
    "scaled",
]
