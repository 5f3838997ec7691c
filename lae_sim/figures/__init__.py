"""Figures and films, drawn in one style: of replays, forecasters and studies."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
