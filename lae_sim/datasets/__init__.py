"""Datasets as their publishers lay them out: frames, ground truth, attributes; and made-up ones."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
