"""The discrete-event engine: exact time, scheduling policies, and who processes which frame when.

It knows no trace, no tracker and no metric: a service says how long a frame takes.
"""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
