"""Profiling: running a live tracker under the engine's virtual clock, on this device."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
