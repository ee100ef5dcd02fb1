"""Rotation: a disc of water turning in free space keeps its angular momentum."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 1
#: Cells a metre; the disc's diameter is 0.3 m.
RESOLUTIONS = (16, 32, 64)
RADIUS, OMEGA = 0.15, 2 * np.pi


def run(resolution: int) -> Outcome:
    """One turn. Water does not hold together: the rim flies off along tangents, as it should, and the box is wide enough for it.

    L = sum m (x - x0) x v + m dx^2 / 4 (C10 - C01): dx^2 / 4 is the moment of inertia of a quadratic B-spline (Jiang et al. 2015).
    """
    cells, half = round(2.5 * resolution), 1.25
    what = scene(
        "rotation", {"model": "water", "sound_speed": 5.0}, [{"kind": "ball", "center": [0.0, 0.0], "radius": RADIUS}], [[-half, half]] * 2,
        [cells] * 2, 0.01,
    )  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    x = what.particles().position
    solver.set_velocity(OMEGA * np.stack([-x[:, 1], x[:, 0]], 1))

    def spin(_=None):
        state = solver.state()
        x, v, C = state["position"], state["velocity"], state["velocity gradient"]
        return (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() + (C[:, 1, 0] - C[:, 0, 1]).sum() * solver.dx**2 / 4

    before = spin()
    found, seconds = timed(solver.frame, 100, spin)
    drift, turns = np.array(found) / before - 1, np.arange(1, 101) / 100
    curve = Curve("largest drift of L in a turn, relative", ("turns", "L / L0 - 1"), turns, np.zeros(100), drift, float(np.abs(drift).max()), 1e-5)
    return Outcome("rotation", resolution, len(x), {"angular momentum": curve}, seconds)
