"""Particles where none should be: all in one place, exactly on a wall, in a corner."""

import time

import numpy as np

from sim.stability import Cell
from sim.stability.courant import MATERIALS
from sim.stability.driver import PBF, SPH, deep, follow, solver_for, way
from sim.validation import scene

CELLS, G = 16, 9.8
EXPECTED = "finite, inside the box, no velocity into a wall that is touched, to rounding"
PIECE = 0.5 / CELLS


def _square(x: float, y: float, side: float, velocity: tuple[float, float]) -> dict:
    return {"kind": "box", "lower": [x, y], "upper": [x + side, y + side], "velocity": list(velocity)}


#: Resolved scenes may hold what a family refuses: the same body twice, particles on walls.
STARTS = {
    "coincident bodies": [_square(0.375, 0.25, 0.25, (0.0, 0.0))] * 2,
    "eight particles in one place": [_square(0.5, 0.5, PIECE, (0.0, 0.0))] * 8,
    "particles on the floor": [{"kind": "box", "lower": [0.25, -PIECE / 2], "upper": [0.75, PIECE / 2], "velocity": [0.0, -1.0]}],
    "particles in a corner": [_square(-PIECE / 2, -PIECE / 2, 2 * PIECE, (-1.0, -1.0))],
}


def run() -> list[Cell]:
    """Water and rubber, half a second, in 2D and 3D."""
    cells, materials = [], {name: MATERIALS[name] for name in ("water", "elastic")} | SPH | PBF
    for dim, name in [(dim, name) for dim in (2, 3) for name in materials]:
        for start, bodies in STARTS.items():
            begun, into, expected = time.perf_counter(), [], EXPECTED
            what = scene("contact", materials[name], bodies, [[0.0, 1.0]] * 2, [CELLS] * 2, 0.01, gravity=[0.0, -G], **way(name))
            if dim == 3:
                what = deep(what, *bodies[0]["lower"][:1], *bodies[0]["upper"][:1])
            run = follow(what, 1)
            for frames in (1, 49):
                if frames > 1:
                    run = follow(what, 50)
                state = solver_for(what).state()
                x, v = state["position"], state["velocity"]
                # Walls stop particles a hair off, 1e-4 cells; a little farther off they may still come nearer.
                near = 1.01e-4 / CELLS
                into.append(max(float(np.max(-v[x < near], initial=0.0)), float(np.max(v[x > 1 - near], initial=0.0))))
            inside = bool(np.isfinite(run.position).all() and run.position.min() >= 0 and run.position.max() <= 1)
            # A node's velocity and its mirror image cancel to the last digits of the speeds they are made of.
            sound = run.ok
            if name in ("dfsph", "pbf") and len(np.unique(what.particles().position, axis=0)) < len(what.particles().position):
                # Between particles in one place no pressure acts, and nothing holds water at its density.
                expected, sound = f"{EXPECTED}; or failed for pressures that did not converge", run.ok or "did not converge" in run.status
            right = sound and inside and max(into) <= np.finfo(np.float32).eps * max(run.speed.max(initial=0.0), 1.0)
            observed = f"{'inside' if inside else 'outside'}, at most {max(into):.2g} m/s into a wall" if run.ok else run.status
            numbers = {"particles": len(run.position), "speed_into_wall": max(into), "fastest": float(run.speed.max(initial=0.0))}
            cell = f"{name}, {start}{', 3D' if dim == 3 else ''}"
            cells.append(Cell("contact", cell, right, expected, observed, numbers, time.perf_counter() - begun))
    return cells
