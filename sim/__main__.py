"""``python -m sim``: the same as ``sluice-sim``."""

from sim.cli import main

raise SystemExit(main())
