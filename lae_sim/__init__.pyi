from .clock import Clock, parse_duration, parse_fps, parse_rational
from .engine import Call, Policy, Schedule, Service, simulate
from .errors import LaeError, TraceError
from .evaluation import Answers, Evaluation, answers, evaluate
from .events import Event, event_log
from .forecast import ConstantVelocity, Forecaster, ForecasterFactory, Hold
from .kalman import Kalman, KalmanLaePvt
from .latency import (
    LatencySource,
    by_call,
    by_frame,
    constant,
    lognormal,
    resampled,
    scaled,
)
from .metadata import Metadata
from .metrics import CONVENTIONS, Convention, precision_curve, success_curve
from .options import load_forecaster
from .pairing import SIGMA_GRID, Pairing, pair
from .policies import every, fifo, latest, shrinking_tail, vot_realtime
from .recording import Recording
from .run import Run, replay_sequence, replay_trace
from .trace import Trace, read_trace, validate, write_trace

__version__: str

__all__ = [
    "CONVENTIONS",
    "SIGMA_GRID",
    "Answers",
    "Call",
    "Clock",
    "ConstantVelocity",
    "Convention",
    "Evaluation",
    "Event",
    "Forecaster",
    "ForecasterFactory",
    "Hold",
    "Kalman",
    "KalmanLaePvt",
    "LaeError",
    "LatencySource",
    "Metadata",
    "Pairing",
    "Policy",
    "Recording",
    "Run",
    "Schedule",
    "Service",
    "Trace",
    "TraceError",
    "answers",
    "by_call",
    "by_frame",
    "constant",
    "evaluate",
    "event_log",
    "every",
    "fifo",
    "latest",
    "load_forecaster",
    "lognormal",
    "pair",
    "parse_duration",
    "parse_fps",
    "parse_rational",
    "precision_curve",
    "read_trace",
    "replay_sequence",
    "replay_trace",
    "resampled",
    "scaled",
    "shrinking_tail",
    "simulate",
    "success_curve",
    "validate",
    "vot_realtime",
    "write_trace",
]
