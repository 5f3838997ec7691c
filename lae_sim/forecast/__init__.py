"""Forecasters: from the outputs so far, where the target is at the time of a query."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
