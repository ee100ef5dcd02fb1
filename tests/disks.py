"""Small disks that fill up."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def mounted(folder: Path, *options: str) -> Iterator[None]:
    """What ``mount`` makes of a folder; skipped where it may not."""
    folder.mkdir(exist_ok=True)
    done = subprocess.run(["mount", *options, str(folder)], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"mounting is not possible here: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@contextmanager
def small_disk(folder: Path) -> Iterator[Callable[[int | None], None]]:
    """Make ``folder`` a disk of 4 MB; yields ``leave``, which fills it (a file ``filler``) to so many free bytes, None for all of them."""
    with mounted(folder, "-t", "tmpfs", "-o", "size=4m", "none"):

        def leave(free: int | None) -> None:
            filler = folder / "filler"
            filler.unlink(missing_ok=True)
            if free is not None:
                disk = os.statvfs(folder)
                filler.write_bytes(bytes(disk.f_bavail * disk.f_frsize - free))

        yield leave
