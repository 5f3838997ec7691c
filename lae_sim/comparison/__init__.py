"""Comparing forecasters and replays: intervals, paired tests, distances to closed loops."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
