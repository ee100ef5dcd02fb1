"""One run a study at a time. Studies have folders of their own, so different ones may run side by side.

Snakemake's own lock (off, see ``profiles/default``) outlives a killed run, and ``--unlock`` takes it from every study of the checkout, also from
one that is at work; this one is dropped by the kernel with the process that holds it, however that dies.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from sim.errors import InputError


def hold(folder: Path) -> None:
    """Hold the results of a study until this process ends; ``InputError`` while another run holds them, and where nothing can be written."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder.parent / f".{folder.name}.lock", os.O_CREAT | os.O_RDWR)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(lock, 0)
        os.write(lock, str(os.getpid()).encode())
    except BlockingIOError:
        process = os.read(lock, 20).decode()
        known = f" (process {process}); wait for its end, or end it after its running jobs: kill {process}"
        remedy = "another run is at work on it" + (known if process else "; wait for its end")  # it may have just begun
        raise InputError(folder, "study", folder.name, remedy) from None
    except OSError as error:
        remedy = f"{folder.parent} cannot be written or locked ({error.strerror}); mend that and start again"
        raise InputError(folder, "study", folder.name, remedy) from None
