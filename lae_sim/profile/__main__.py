"""``python -m lae_sim.profile`` is ``lae-sim profile``."""

import sys

from lae_sim.cli.profile import main

sys.exit(main())
