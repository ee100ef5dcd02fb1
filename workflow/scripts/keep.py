"""Run a command that continues its own earlier work in a folder: ``python -m workflow.scripts.keep FOLDER RECIPE -- COMMAND ...``

The folder is emptied first if it holds the work of another recipe (hash of everything that determines it), and kept otherwise, so that a
killed job resumes and an edited solver never serves old data. Two jobs never write at once: after kill -9 of Snakemake its children go on,
and the rerun waits here until they end.
"""

import fcntl
import os
import shutil
import sys
from pathlib import Path

from sim.trajectory import write_text


def main(folder: Path, recipe: str, command: list[str]) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    lock = os.open(folder.parent / f".{folder.name}.lock", os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print(f"{folder}: waiting for an earlier job that is still at work here", file=sys.stderr, flush=True)
        fcntl.flock(lock, fcntl.LOCK_EX)
    note = folder.parent / f".{folder.name}.recipe"
    if not note.is_file() or note.read_text() != recipe:
        shutil.rmtree(folder, ignore_errors=True)
        write_text(note, recipe)
    # The lock is inherited by the command and ends with it, however it ends.
    os.set_inheritable(lock, True)
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[sys.argv.index("--") + 1 :])
