"""``python -m lae_sim.replay`` is ``lae-sim replay``."""

import sys

from lae_sim.cli.replay import main

sys.exit(main())
