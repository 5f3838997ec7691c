from .boxes import iou
from .clock import Clock, parse_duration, parse_fps, parse_rational
from .comparison import World, compare
from .datasets import find_dataset
from .device import describe_device
from .drawing import draw_frame, film_strip
from .engine import Call, Policy, Schedule, Service, simulate
from .errors import LaeError, TraceError
from .evaluation import Answers, Evaluation, answers, evaluate
from .events import Event, event_log
from .forecast import ConstantVelocity, Forecaster, ForecasterFactory, Hold
from .frames import Dataset, ImageSequence
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
from .live import LiveRun, run_every_frame, run_real_time
from .metadata import Metadata
from .metrics import CONVENTIONS, Convention, precision_curve, success_curve
from .pairing import SIGMA_GRID, Pairing, pair
from .policies import every, fifo, latest, shrinking_tail, vot_realtime
from .recording import Recording
from .render import Scene
from .run import Run, replay_sequence, replay_trace
from .statistics import by_attribute, comparison_table, summarise
from .synthetic import synthetic_dataset
from .trace import Trace, read_trace, validate, write_trace
from .worker import InProcess, Worker
from .zoo import load_forecaster

__version__: str

__all__ = [
    "CONVENTIONS",
    "SIGMA_GRID",
    "Answers",
    "Call",
    "Clock",
    "ConstantVelocity",
    "Convention",
    "Dataset",
    "Evaluation",
    "Event",
    "Forecaster",
    "ForecasterFactory",
    "Hold",
    "ImageSequence",
    "InProcess",
    "Kalman",
    "KalmanLaePvt",
    "LaeError",
    "LatencySource",
    "LiveRun",
    "Metadata",
    "Pairing",
    "Policy",
    "Recording",
    "Run",
    "Scene",
    "Schedule",
    "Service",
    "Trace",
    "TraceError",
    "Worker",
    "World",
    "answers",
    "by_attribute",
    "by_call",
    "by_frame",
    "compare",
    "comparison_table",
    "constant",
    "describe_device",
    "draw_frame",
    "evaluate",
    "event_log",
    "every",
    "fifo",
    "film_strip",
    "find_dataset",
    "iou",
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
    "run_every_frame",
    "run_real_time",
    "scaled",
    "shrinking_tail",
    "simulate",
    "success_curve",
    "summarise",
    "synthetic_dataset",
    "validate",
    "vot_realtime",
    "write_trace",
]
