"""What people read: tables as text, CSV, LaTeX and HTML, pages, and files for other programs."""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
