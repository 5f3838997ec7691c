from .api.comparison import ComparisonResult, compare_forecasters
from .api.evaluation import EvaluationResult, evaluate
from .api.study import run_study
from .datasets.layouts import find_dataset
from .datasets.synthetic import synthetic_dataset
from .decoding import max_decoded
from .engine.pipeline import Camera, Pipeline, Stage
from .engine.scheduler import simulate
from .errors import LaeError, TraceError
from .evaluation.evaluate import evaluate_runs
from .evaluation.events import event_log
from .evaluation.metrics import CONVENTIONS
from .figures.film import Scene
from .forecast.base import Forecaster, Hold
from .forecast.kalman import Kalman
from .importers.convert import convert_results
from .learning.registry import load_forecaster
from .profile.run import profile_tracker
from .recipes.catalogue import list_recipes
from .recipes.make import get_trace
from .replay.run import Run, Runs, replay_sequence
from .replay.world import SIGMA_GRID, World, replay_trace
from .report.page import write_report
from .report.study_tables import write_tables
from .study.run import StudyResults
from .study.spec import Study, read_study
from .trace.file import Trace, read_trace, validate, write_trace
from .trace.metadata import Metadata
from .trace.recording import Recording

__version__: str

__all__ = [
    "CONVENTIONS",
    "SIGMA_GRID",
    "Camera",
    "ComparisonResult",
    "EvaluationResult",
    "Forecaster",
    "Hold",
    "Kalman",
    "LaeError",
    "Metadata",
    "Pipeline",
    "Recording",
    "Run",
    "Runs",
    "Scene",
    "Stage",
    "Study",
    "StudyResults",
    "Trace",
    "TraceError",
    "World",
    "compare_forecasters",
    "convert_results",
    "evaluate",
    "evaluate_runs",
    "event_log",
    "find_dataset",
    "get_trace",
    "list_recipes",
    "load_forecaster",
    "max_decoded",
    "profile_tracker",
    "read_study",
    "read_trace",
    "replay_sequence",
    "replay_trace",
    "run_study",
    "simulate",
    "synthetic_dataset",
    "validate",
    "write_report",
    "write_tables",
    "write_trace",
]
