"""Axial bar: free, stretched by v = v0 sin(pi x / 2 L), its ends swing at T = 4 L sqrt(rho / E')."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, period, scene, timed

NUMBER = 5
#: Cells across the bar.
RESOLUTIONS = (2, 4, 8)
L, THICKNESS, RHO, E, NU, V0 = 0.4, 0.08, 1000.0, 1e6, 0.3, 0.05
PERIODS, FRAMES_A_PERIOD = 3, 40


def run(resolution: int) -> Outcome:
    """The bar reaches from -L to L and touches nothing; its middle stays, so that each half is a bar clamped at one end.

    Sideways it is free, out of the plane it is held: E' = E / (1 - nu^2). Lateral inertia makes T longer by
    (nu / (1 - nu) pi / 2 L)^2 THICKNESS^2 / 24 = 0.08 % (Rayleigh), which the reference leaves out.
    """
    dx, stiffness = THICKNESS / resolution, E / (1 - NU**2)
    exact = 4 * L * np.sqrt(RHO / stiffness)
    cells = [round(2.5 * L / dx), round(4 * THICKNESS / dx)]
    lower = np.array([-cells[0] * dx / 2, -cells[1] * dx / 2])
    what = scene(
        "axial-bar", {"model": "elastic", "density": RHO, "young_modulus": E, "poisson_ratio": NU},
        [{"kind": "box", "lower": [-L, -THICKNESS / 2], "upper": [L, THICKNESS / 2]}], np.stack([lower, -lower], 1).tolist(), cells,
        exact / FRAMES_A_PERIOD,
    )  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    x = what.particles().position[:, 0]
    solver.set_velocity(np.stack([V0 * np.sin(np.pi * x / (2 * L)), np.zeros_like(x)], 1))
    right, left = x > x.max() - dx, x < x.min() + dx

    def observe(position):
        moved = position[:, 0] - x
        return (moved[right].mean() - moved[left].mean()) / 2

    u, seconds = timed(solver.frame, PERIODS * FRAMES_A_PERIOD, observe)
    t, w = what.frame_step * np.arange(1, len(u) + 1), 2 * np.pi / exact
    found = period(t, np.array(u), exact)
    curve = Curve(f"period {found:.5f} s, exact {exact:.5f} s", ("time [s]", "displacement of the ends [m]"), t,
                  V0 * np.sin(np.pi * x[right].mean() / (2 * L)) / w * np.sin(w * t), np.array(u), found / exact - 1, 0.02)  # fmt: skip
    return Outcome("axial_bar", resolution, len(x), {"period": curve}, seconds)
