"""Fixed time steps above the limit: plan and generate refuse them in one line that names the limit and what sets it."""

from __future__ import annotations

import copy
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from sim.stability import Cell
from sim.stability.command_line import command

EXPECTED = "exit code 2, one line with file, key, value, the limit and what sets it, nothing written; accepted at the limit"
FRAME, CELLS = 0.01, 16
FAMILY: dict = {
    "name": "refusal",
    "dim": 2,
    "bounds": [[0.0, 1.0], [0.0, 1.0]],
    "gravity": [0.0, 0.0],
    "frame_step": FRAME,
    "frames": 3,
    "radius": 0.1,
    "cells": [CELLS, CELLS],
    "bodies": [{"material": "stuff", "shape": {"kind": "box", "size": [0.25, 0.25]}}],
    "splits": {"train": 2, "valid": 0, "test": 0},
}
#: Half the support radius of WCSPH, 1.25 spacings.
H = 1.25 * 0.5 / CELLS
#: What binds -> (materials, cfl, velocity, limit by hand [s]); of MPM, then of the others.
BINDING = {
    "the Courant number": ({"model": "water", "sound_speed": 20.0}, 0.4, 5.0, 0.4 / CELLS / 25.0),
    "the viscosity of stuff": ({"model": "water", "sound_speed": 5.0, "viscosity": 2000.0}, 0.4, 0.0, 1 / CELLS**2 * 1000.0 / (2 * 2 * 2000.0)),
    "a particle alone on the grid": ({"model": "water", "sound_speed": 20.0}, 2.0, 0.0, 0.8 / CELLS / (np.sqrt(2) * 20.0)),
}
BINDING_OTHERS = {
    ("wcsph", "the Courant number"): ({"model": "water", "sound_speed": 20.0}, 0.4, 5.0, 0.4 * 0.5 / CELLS / 25.0),
    ("wcsph", "the speed of sound"): ({"model": "water", "sound_speed": 20.0}, 2.0, 0.0, 0.5 * H / 20.0),
    ("wcsph", "the viscosity"): ({"model": "water", "sound_speed": 5.0, "viscosity": 2000.0}, 0.4, 0.0, H**2 / 25 / 2.0),
    ("dfsph", "the Courant number"): ({"model": "water"}, 0.4, 5.0, 0.4 * 0.5 / CELLS / 5.0),
    ("pbf", "the Courant number"): ({"model": "water"}, 0.4, 5.0, 0.4 * 0.5 / CELLS / 5.0),
    ("pbf", "substeps 2"): ({"model": "water"}, 0.4, 0.0, FRAME / 2),
}


def run() -> list[Cell]:
    """Each limit, just above and just below; a radius in which no particle has a neighbour."""
    cells = [_radius()]
    for (method, what), (material, cfl, speed, limit) in ({("mpm", what): given for what, given in BINDING.items()} | BINDING_OTHERS).items():
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as place:
            path, out = Path(place) / "refusal.yaml", Path(place) / "out"
            steps = int(np.ceil(FRAME / limit))

            def write(count: int, path=path, material=material, cfl=cfl, speed=speed, method=method) -> None:
                content = copy.deepcopy(FAMILY) | {"materials": {"stuff": material}, "cfl": cfl, "time_step": FRAME / count}
                content["solver"] = {"method": method}
                content["bodies"][0]["velocity"] = [speed, 0.0]
                path.write_text(yaml.safe_dump(content))

            write(steps - 1)
            answers = [command("plan", path), command("generate", path, "--out", out)]
            parts = (str(path), "time_step = ", f"limit {limit:.4g} s, which {what} sets")
            refused = all(code == 2 and said.count("\n") == 1 and all(part in said for part in parts) for code, said in answers)
            left = sorted(each.name for each in Path(place).iterdir()) == ["refusal.yaml"]
            write(steps)
            accepted = command("plan", path)[0] == 0
        observed = f"above: exit {', '.join(str(code) for code, _ in answers)}, {'nothing' if left else 'something'} written; below: " + (
            "accepted" if accepted else "refused")  # fmt: skip
        numbers = {"limit": limit, "time_step": FRAME / (steps - 1), "said": answers[0][1].strip().replace(str(path), "refusal.yaml")}
        cell = what if method == "mpm" else f"{method}, {what}"
        cells.append(Cell("refusal", cell, refused and left and accepted, EXPECTED, observed, numbers, time.perf_counter() - begun))
    return cells


def _radius() -> Cell:
    """The kernel's support is counted in spacings; the radius of the scene is what learners connect."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        path, out = Path(place) / "refusal.yaml", Path(place) / "out"
        path.write_text(yaml.safe_dump(FAMILY | {"materials": {"stuff": {"model": "water"}}, "solver": {"method": "dfsph"}, "radius": 0.03}))
        code, said = command("generate", path, "--out", out)
        right = code == 2 and said.count("\n") == 1 and "radius = 0.03: below the particle spacing 0.03125" in said and not out.exists()
        said = said.strip().replace(str(path), "refusal.yaml")
    return Cell("refusal", "dfsph, radius below the spacing", right, "exit code 2, one line, nothing written", f"exit {code}: {said}", {},
                time.perf_counter() - begun)  # fmt: skip
