"""How a script of a rule ends: a mistake or a failure is one line of the job's log, with the exit code of ``sluice-sim`` and ``sluice-learn``."""

from __future__ import annotations

import sys
from collections.abc import Callable

from sim.errors import InputError, RunError, reason


def run(main: Callable[..., None]) -> None:
    """Call ``main`` with the words of the command line; exit with 2 on ``InputError``, 1 on ``RunError`` and ``OSError`` (a full disk)."""
    try:
        main(*sys.argv[1:])
    except InputError as error:
        print(f"sluice: {error}", file=sys.stderr)
        sys.exit(2)
    except (RunError, OSError) as error:
        print(f"sluice: {reason(error) if isinstance(error, OSError) else error}", file=sys.stderr)
        sys.exit(1)
