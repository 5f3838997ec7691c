"""What people look at: tables as text, CSV, LaTeX and HTML; figures, pages, films, timelines."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
