"""``sluice-sim`` for cases that ask what a user would be told."""

import contextlib
import io
import signal

from sim.cli import main


def command(*arguments: object) -> tuple[int, str]:
    """Exit code and standard error of ``sluice-sim``, run in this process."""
    errors, handler = io.StringIO(), signal.getsignal(signal.SIGTERM)
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
            code = main([str(argument) for argument in arguments])
    finally:
        signal.signal(signal.SIGTERM, handler)
    return code, errors.getvalue()
