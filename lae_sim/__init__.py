"""Latency-aware evaluation of visual trackers."""

__version__ = "0.1.0"
