"""What people look at: tables as text, CSV, LaTeX and HTML; figures, pages, films, timelines."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
