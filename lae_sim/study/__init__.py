"""Studies: many traces in many worlds, computed once per cell, on all cores or a cluster."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
