"""Replaying recordings: under which world, with which processing times and boxes."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
