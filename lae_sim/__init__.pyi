from .boxes import iou
from .comparison.forecasters import score_forecasters
from .comparison.statistics import by_attribute, summarise
from .datasets.frames import Dataset, ImageSequence
from .datasets.layouts import find_dataset
from .datasets.synthetic import synthetic_dataset
from .engine.clock import Clock, parse_duration, parse_fps, parse_rational
from .engine.lanes import simulate_lanes
from .engine.policies import LanePolicy, every, fifo, latest, shrinking_tail, vot_realtime
from .engine.scheduler import Call, Policy, Schedule, Service, simulate
from .engine.times import Times
from .errors import LaeError, TraceError
from .evaluation.evaluate import Answers, Evaluation, answers, evaluate
from .evaluation.events import Event, event_log
from .evaluation.metrics import CONVENTIONS, Convention, precision_curve, success_curve
from .evaluation.pairing import Pairing, pair
from .forecast.base import ConstantVelocity, Forecaster, ForecasterFactory, Hold
from .forecast.kalman import Kalman, KalmanLaePvt
from .learning.registry import load_forecaster
from .profile.device import describe_device
from .profile.live import LiveRun, run_every_frame, run_real_time
from .profile.worker import InProcess, Worker
from .replay.latency import (
    LatencySource,
    RandomSource,
    bootstrap,
    by_call,
    by_frame,
    constant,
    lognormal,
    resampled,
    scaled,
)
from .replay.run import Run, replay_repeated, replay_sequence
from .replay.world import SIGMA_GRID, World, replay_trace
from .report.comparison import comparison_table
from .report.film import Scene, draw_frame, film_strip
from .report.page import write_report
from .report.study_tables import write_tables
from .study.run import StudyResults, run_study
from .study.spec import Study, read_study
from .trace.file import Trace, read_trace, validate, write_trace
from .trace.metadata import Metadata
from .trace.recording import Recording

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
    "score_forecasters",
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
