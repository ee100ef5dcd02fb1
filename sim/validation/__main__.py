"""``python -m sim.validation``: see ``sim.validation.ladder``."""

import sys

from sim.validation.ladder import main

sys.exit(main())
