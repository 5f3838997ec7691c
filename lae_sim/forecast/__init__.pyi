from .base import ConstantVelocity, Forecaster, ForecasterFactory, Hold, Lanes, Oracle
from .camera import Camera, CameraCompensated, estimate_camera
from .costs import measure_cost, resolve_costs
from .filters import GH, IMM
from .guard import Guarded, guarded
from .kalman import Kalman, KalmanLaePvt, TunedKalman
from .learned import Learned, read_learned, shipped, write_learned
from .network import Network
from .window import LeastSquares, Windowed

__all__ = [
    "GH",
    "IMM",
    "Camera",
    "CameraCompensated",
    "ConstantVelocity",
    "Forecaster",
    "ForecasterFactory",
    "Guarded",
    "Hold",
    "Kalman",
    "KalmanLaePvt",
    "Lanes",
    "Learned",
    "LeastSquares",
    "Network",
    "Oracle",
    "TunedKalman",
    "Windowed",
    "estimate_camera",
    "guarded",
    "measure_cost",
    "read_learned",
    "resolve_costs",
    "shipped",
    "write_learned",
]
