from .arrivals import with_arrivals
from .clock import (
    Clock,
    Number,
    duration_ns,
    exact,
    parse_duration,
    parse_fps,
    parse_rational,
    split_init,
)
from .lanes import batchable, simulate_lanes
from .pipeline import Camera, Pipeline, Stage
from .policies import LanePolicy, every, fifo, latest, listed, shrinking_tail, vot_realtime
from .scheduler import Call, Policy, Schedule, Service, scores_latency, simulate
from .stages import Drop, PipelineSchedule, StageLog, simulate_pipeline
from .times import Times

__all__ = [
    "Call",
    "Camera",
    "Clock",
    "Drop",
    "LanePolicy",
    "Number",
    "Pipeline",
    "PipelineSchedule",
    "Policy",
    "Schedule",
    "Service",
    "Stage",
    "StageLog",
    "Times",
    "batchable",
    "duration_ns",
    "every",
    "exact",
    "fifo",
    "latest",
    "listed",
    "parse_duration",
    "parse_fps",
    "parse_rational",
    "scores_latency",
    "shrinking_tail",
    "simulate",
    "simulate_lanes",
    "simulate_pipeline",
    "split_init",
    "vot_realtime",
    "with_arrivals",
]
