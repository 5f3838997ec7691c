from .folds import Examples, Trainer, assign_folds, cross_fitted
from .motion import made_up_motion, made_up_trace
from .registry import find_camera, load_any, load_forecaster
from .trainers import KalmanTrainer, NetworkTrainer, WrappedTrainer

__all__ = [
    "Examples",
    "KalmanTrainer",
    "NetworkTrainer",
    "Trainer",
    "WrappedTrainer",
    "assign_folds",
    "cross_fitted",
    "find_camera",
    "load_any",
    "load_forecaster",
    "made_up_motion",
    "made_up_trace",
]
