"""Trackers, and the side of the worker process that runs them.

The modules of this folder run on the tracker's own interpreter: Python 3.8 or newer with NumPy, and
whatever the tracker itself needs. Of the package they import this folder and ``lae_sim.errors``
alone.

What users' own trackers call is here.
"""

from lae_sim.trackers.onnx import onnx_session
from lae_sim.trackers.protocol import box_of
from lae_sim.trackers.stages import stage

__all__ = ["box_of", "onnx_session", "stage"]
