"""Scores: which output answers which query, and how far the answers are from the truth."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
