"""Datasets as their publishers lay them out: frames, ground truth, attributes; and made-up ones."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
