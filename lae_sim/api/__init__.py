"""What notebooks and scripts call: paths, text and plain numbers in, pandas and pictures out.

The functions here hold no logic of replaying and scoring: they open traces, make a
:class:`lae_sim.replay.world.World` of their arguments, and hand both to the rooms below.
"""

from lae_sim._faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, __file__)
