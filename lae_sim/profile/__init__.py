"""Profiling: running a live tracker under the engine's virtual clock, on this device."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
