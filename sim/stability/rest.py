"""No gravity, no motion: a block of each material stays where it is for ten thousand steps."""

import time

import numpy as np

from sim.stability import Cell
from sim.stability.courant import MATERIALS
from sim.stability.driver import PBF, SPH, deep, follow, solver_for, way
from sim.validation import scene

STEPS, CELLS = 10_000, 16
#: In 3D too: what carries a volume, and what carries a tensor.
DEEP = ("water", "elastic", *SPH, *PBF)
#: Speed that is rounding alone: eps of the speed of sound a step, a random walk over all of them.
EPS = float(np.finfo(np.float32).eps)


def run() -> list[Cell]:
    """The lattice is jittered, so that nothing is symmetric; but not where density is held: there it would have to be evened out at once."""
    cells = []
    materials = MATERIALS | SPH | PBF
    for dim, name in [(2, name) for name in materials] + [(3, name) for name in DEEP]:
        begun, jitter = time.perf_counter(), 0.0 if name in ("dfsph", "pbf") else 0.2
        body = {"kind": "box", "lower": [0.375, 0.375], "upper": [0.625, 0.625]}
        what = scene("rest", materials[name], [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 0.01, jitter=jitter, **way(name))
        if dim == 3:
            what = deep(what, 0.375, 0.625)
        solver = solver_for(what)
        solver.load(what)
        # DFSPH and position-based water know no speed of sound: positions of up to 16 kernels' radii are rounded, a step of the frame's length.
        wave_speed = solver.plan(what)["wave_speed"] or 1.0 / what.frame_step
        tolerance = EPS * wave_speed * np.sqrt(STEPS)
        frames = int(np.ceil(STEPS / solver.plan(what)["substeps_per_frame"][0]))
        run = follow(what, frames)
        steps, fastest = float(run.substeps.sum()), float(run.speed.max(initial=0.0))
        moved = float(np.abs(run.position - what.start()).max())
        right = run.ok and steps >= STEPS and fastest <= tolerance
        observed = f"{steps:.0f} steps, at most {fastest:.2g} m/s, moved {moved:.2g} m" if run.ok else run.status
        numbers = {"steps": steps, "speed": fastest, "tolerance": float(tolerance), "moved": moved}
        cells.append(Cell("rest", f"{name}{', 3D' if dim == 3 else ''}", right, "speed at round-off", observed, numbers, time.perf_counter() - begun))
    return cells
