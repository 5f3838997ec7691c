"""What notebooks and scripts call: paths, text and plain numbers in, pandas and pictures out.

The functions here hold no logic of replaying and scoring: they open traces, make a
:class:`lae_sim.replay.world.World` of their arguments, and hand both to the rooms below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
