from .device import describe_device
from .live import LiveRun, run_every_frame, run_real_time
from .run import Profile, ProfilePlan, profile_tracker
from .timed import Answer, TimedTracker, TrackerError
from .worker import InProcess, Worker

__all__ = [
    "Answer",
    "InProcess",
    "LiveRun",
    "Profile",
    "ProfilePlan",
    "TimedTracker",
    "TrackerError",
    "Worker",
    "describe_device",
    "profile_tracker",
    "run_every_frame",
    "run_real_time",
]
