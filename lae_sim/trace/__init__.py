"""The trace format: a sequence's recording, and reading, checking and writing of files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
