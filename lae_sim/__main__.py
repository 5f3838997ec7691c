"""``python -m lae_sim`` is ``lae-sim``."""

import sys

from lae_sim.cli.main import main

sys.exit(main())
