"""Results that other toolkits have written, and logs of running trackers, as recordings."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
