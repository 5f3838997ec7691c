"""Traces of public results by name.

A recipe names files of public repositories at fixed commits, and their digests. None of them is in
the package: they are downloaded, checked and converted where a trace is asked for.
"""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
