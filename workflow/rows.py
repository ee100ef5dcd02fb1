"""Rows of a comparison as its two jobs leave them: errors and run times."""

from __future__ import annotations

import json
from pathlib import Path

from learn.compare import Timing, attach_timing


def timed_rows(errors: str | Path, timing: str | Path) -> list[dict]:
    """The rows with their interleaved run times."""
    rows = json.loads(Path(errors).read_text())
    timings = [Timing(**entry) for entry in json.loads(Path(timing).read_text())["timings"]]
    return attach_timing(rows, timings, rows[0]["scene"])
