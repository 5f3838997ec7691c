"""Studies: many traces in many worlds, computed once per cell, on all cores or a cluster."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
