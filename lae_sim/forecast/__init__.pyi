from .base import ConstantVelocity, Forecaster, ForecasterFactory, Hold, Lanes, Oracle
from .camera import Camera, CameraCompensated, estimate_camera
from .costs import measure_cost, resolve_costs
from .filters import GH, IMM
from .kalman import Kalman, KalmanLaePvt, TunedKalman
from .learned import Learned, read_learned, write_learned
from .window import LeastSquares, Windowed

__all__ = [
    "GH",
    "IMM",
    "Camera",
    "CameraCompensated",
    "ConstantVelocity",
    "Forecaster",
    "ForecasterFactory",
    "Hold",
    "Kalman",
    "KalmanLaePvt",
    "Lanes",
    "Learned",
    "LeastSquares",
    "Oracle",
    "TunedKalman",
    "Windowed",
    "estimate_camera",
    "measure_cost",
    "read_learned",
    "resolve_costs",
    "write_learned",
]
