"""Forecasters: from the outputs so far, where the target is at the time of a query."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
