"""Lid-driven cavity: at Re = 100, the velocity on the vertical centre line, against Ghia, Ghia & Shin (1982)."""

from pathlib import Path

import numpy as np
from scipy.interpolate import griddata

from sim.solvers import solver_class
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 9
METHODS = ("wcsph", "dfsph")
#: Particles along the cavity.
RESOLUTIONS = (16, 24, 40)
RE, C, END, FRAMES = 100, 10.0, 15.0, 150
#: y, u of their multigrid solution on 129 x 129.
GHIA = np.loadtxt(Path(__file__).parent / "data" / "ghia_1982.csv", delimiter=",")


def run(resolution: int, method: str) -> Outcome:
    """A box and a lid of speed 1, from rest: the flow is steady after 10, and what is compared is the mean over the 5 after that, linear between
    particles and walls. Error: the largest, over the speed of the lid. A support of three spacings, as of the channel, and no other viscosity."""
    settings = {"support": 3.0} | ({"artificial_viscosity": 0.0} if method == "wcsph" else {"xsph": 0.0})
    what = scene(
        "cavity", {"model": "water", "sound_speed": C, "density": 1.0, "viscosity": 1 / RE},
        [{"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}], [[0.0, 1.0]] * 2, [resolution // 2] * 2, END / FRAMES,
        walls={"friction": "sticky", "velocity": {"y+": [1.0, 0.0]}}, solver={"method": method} | settings,
    )  # fmt: skip
    solver = solver_class(method)()
    solver.load(what)
    y, reference = GHIA[1:-1].T
    x = np.linspace(0, 1, 2 * resolution)
    walls = np.concatenate([np.stack([x, np.zeros_like(x)], 1), np.stack([x, np.ones_like(x)], 1)])

    def observe(_):
        state = solver.state()
        at, u = np.concatenate([state["position"], walls]), np.concatenate([state["velocity"][:, 0], walls[:, 1]])
        return griddata(at, u, np.stack([np.full_like(y, 0.5), y], 1))

    found, seconds = timed(solver.frame, FRAMES, observe)
    ours = np.mean(found[2 * FRAMES // 3 :], 0)
    error = float(np.abs(ours - reference).max())
    curve = Curve("largest error of u on the centre line over the speed of the lid", ("y", "u / U"), y, reference, ours, error, 0.05)
    return Outcome("lid_driven_cavity", resolution, len(what.particles().position), {"centre line": curve}, seconds)
