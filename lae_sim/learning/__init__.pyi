from .folds import Examples, Trainer, assign_folds, cross_fitted
from .registry import find_camera, load_any, load_forecaster
from .trainers import CameraTrainer, KalmanTrainer, NetworkTrainer

__all__ = [
    "CameraTrainer",
    "Examples",
    "KalmanTrainer",
    "NetworkTrainer",
    "Trainer",
    "assign_folds",
    "cross_fitted",
    "find_camera",
    "load_any",
    "load_forecaster",
]
