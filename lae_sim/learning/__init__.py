"""Forecasters by name, and the training of those that learn, across folds of the sequences."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
