"""Angular momentum of a turning disc."""

from __future__ import annotations

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation.case import Case, Clock, Result, scene, set_motion, state


def run(resolution: int) -> Result:
    """One turn of a disc of water in free space, started as a rigid rotation. Water does not hold together: its rim flies off along tangents,
    as it should, and the box is wide enough for it.

    L = sum m (x - x0) x v + m dx^2 / 4 (C10 - C01): dx^2 / 4 is the moment of inertia of a quadratic B-spline (Jiang et al. 2015).
    """
    clock, solver = Clock(), MPMSimulator()
    disc = {"kind": "ball", "center": [1.25, 1.25], "radius": 0.15}
    solver.load(scene({"model": "water", "sound_speed": 10.0}, [disc], round(2.5 * resolution), (2.5, 2.5), gravity=[0.0, 0.0]))
    w, x = 2 * np.pi, state(solver)[0] - 1.25
    set_motion(solver, np.stack([-w * x[:, 1], w * x[:, 0]], 1), np.broadcast_to([[0.0, -w], [w, 0.0]], (len(x), 2, 2)))

    def spin() -> float:
        x, v, C = state(solver)
        x = x - 1.25
        return float((x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() + (C[:, 1, 0] - C[:, 0, 1]).sum() * solver.dx**2 / 4)

    drift, before = [0.0], spin()
    for number, _ in enumerate(clock.frames(solver, 200), start=1):
        if number % 10 == 0:
            drift.append(spin() / before - 1)
    turns = np.linspace(0, 1, len(drift))
    error = float(np.abs(drift).max())
    return Result(resolution, error, f"drift {error:.1e} in a turn", (turns, np.array(drift)), (turns, 0 * turns), clock.seconds)


CASE = Case(
    1, "rotation", "Angular momentum of a turning disc of water", "L = constant (Jiang et al. 2015)", "drift of L in a turn, relative", 1e-5,
    ("turns", "L / L0 - 1"), (16, 32, 64), "cells a metre (the disc's diameter is 0.3 m)", run,
)
