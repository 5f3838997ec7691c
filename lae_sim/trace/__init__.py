"""The trace format: a sequence's recording, and reading, checking and writing of files."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
