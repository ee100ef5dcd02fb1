"""Bodies where others are: overlapping each other, an obstacle or the walls at the start is refused at generation."""

import tempfile
import time
from pathlib import Path

import yaml

from sim.stability import Cell
from sim.stability.command_line import command
from sim.stability.refusal import FAMILY

BODY = {"material": "stuff", "shape": {"kind": "box", "size": [0.3, 0.3]}, "center": [0.5, 0.5]}
STARTS: dict[str, tuple[dict, str]] = {
    "two bodies in one place": ({"bodies": [BODY, BODY]}, "overlapping another body"),
    "two bodies that share a corner": ({"bodies": [BODY, BODY | {"center": [0.75, 0.75]}]}, "overlapping another body"),
    "a body in an obstacle": (
        {"bodies": [BODY], "obstacles": [{"kind": "ball", "radius": 0.2, "count": [1, 1], "center": [0.5, 0.3]}]}, "overlapping an obstacle"),
    "a body through a wall": ({"bodies": [BODY | {"center": [0.9, 0.5]}]}, "outside the box"),
}  # fmt: skip


def run() -> list[Cell]:
    """Families without any freedom to place their bodies elsewhere."""
    cells = []
    for cell, (changes, reason) in STARTS.items():
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as place:
            path, out = Path(place) / "seeding.yaml", Path(place) / "out"
            path.write_text(yaml.safe_dump(FAMILY | {"materials": {"stuff": {"model": "water", "sound_speed": 20.0}}} | changes))
            code, said = command("generate", path, "--out", out)
            right = code == 2 and said.count("\n") == 1 and reason in said and not out.exists()
            said = said.strip().replace(str(path), "seeding.yaml")
        cells.append(Cell("seeding", cell, right, "exit code 2, one line, nothing written", f"exit {code}: {said}", {}, time.perf_counter() - begun))
    return cells
