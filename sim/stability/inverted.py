"""det F <= 0 forced: a step that would turn a particle inside out is taken back and shortened; where no step is short enough, the run ends.

b = F F^T, which all solids here carry, cannot be inside out: it is the step, det(I + dt grad v) <= 0, that has to be caught.
"""

import time

import numpy as np

from sim.stability import Cell
from sim.stability.courant import MATERIALS
from sim.stability.driver import ROUGH, follow, solver_for
from sim.validation import scene

CELLS, FRAME = 16, 0.001
#: How far a step squeezes the particle along each axis, at the planned step: 1 + dt grad v is 1 less this. The shortest step is 1 / 64 of it.
SQUEEZE = {"a step through zero": 1.2, "a step through zero however short": 1000.0}


def run() -> list[Cell]:
    """A lone particle, whose gradient is forced before the first frame."""
    cells = []
    for name, material in MATERIALS.items():
        body = {"kind": "box", "lower": [0.5, 0.5], "upper": [0.5 + 0.5 / CELLS] * 2}
        what = scene("inverted", material, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, FRAME, walls=ROUGH)
        for cell, squeeze in SQUEEZE.items():
            begun = time.perf_counter()
            planned = solver_for(what).plan(what)["substeps_per_frame"][0]
            forced = -squeeze * planned / FRAME
            # Along one axis alone: were both turned over, the determinant would be positive again.
            run = follow(what, 3, lambda solver, forced=forced: solver.inject("velocity gradient", 0, [[forced, 0.0], [0.0, 0.0]]))
            taken = float(run.substeps[0]) if len(run.substeps) else np.nan
            if squeeze < 64:
                right, expected = run.ok and taken > planned, "step rejected: shortened until it is sound"
            else:
                right = run.status.startswith("failed: time step fell below") and run.status.endswith("(frame 1)")
                expected = "step rejected at every length: failed within the frame, and said so"
            observed = f"{planned} steps planned, {taken:.0f} taken, finite" if run.ok else run.status
            cells.append(Cell("inverted", f"{name}, {cell}", right, expected, observed, {"planned": planned, "taken": taken},
                              time.perf_counter() - begun))  # fmt: skip
    return cells
