from .batch import simulate_lanes
from .boxes import iou
from .clock import Clock, parse_duration, parse_fps, parse_rational
from .comparison import World, compare_forecasters
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
    RandomSource,
    Times,
    bootstrap,
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
from .policies import LanePolicy, every, fifo, latest, shrinking_tail, vot_realtime
from .recording import Recording
from .render import Scene
from .run import Run, replay_repeated, replay_sequence, replay_trace
from .statistics import by_attribute, comparison_table, summarise
from .study_file import Study, read_study
from .study_report import write_report
from .study_run import StudyResults, run_study
from .study_tables import write_tables
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
    "LanePolicy",
    "LatencySource",
    "LiveRun",
    "Metadata",
    "Pairing",
    "Policy",
    "RandomSource",
    "Recording",
    "Run",
    "Scene",
    "Schedule",
    "Service",
    "Study",
    "StudyResults",
    "Times",
    "Trace",
    "TraceError",
    "Worker",
    "World",
    "answers",
    "bootstrap",
    "by_attribute",
    "by_call",
    "by_frame",
    "compare_forecasters",
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
    "read_study",
    "read_trace",
    "replay_repeated",
    "replay_sequence",
    "replay_trace",
    "resampled",
    "run_every_frame",
    "run_real_time",
    "run_study",
    "scaled",
    "shrinking_tail",
    "simulate",
    "simulate_lanes",
    "success_curve",
    "summarise",
    "synthetic_dataset",
    "validate",
    "vot_realtime",
    "write_report",
    "write_tables",
    "write_trace",
]
