"""Forecasters by name, and the training of those that learn, across folds of the sequences."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
