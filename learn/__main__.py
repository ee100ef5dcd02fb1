"""``python -m learn``: the same as ``sluice-learn``."""

from learn.cli import main

raise SystemExit(main())
