"""The discrete-event engine: exact time, scheduling policies, and who processes which frame when.

It knows no trace, no tracker and no metric: a service says how long a frame takes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
