"""Traces of public results by name: recipes that say where the files lie and what their digests are.

Nothing of others is in the package: a recipe names files of public repositories at fixed commits.
They are downloaded, checked and converted where a trace is asked for.
"""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
