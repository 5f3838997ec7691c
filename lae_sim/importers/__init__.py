"""Results that other toolkits have written, as recordings of a trace."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
