"""Elastic column: between slip walls, gravity switched on, sigma_yy = -rho0 g (H - Y) about which it swings at T = 4 H sqrt(rho0 / M)."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, l2, period, scene, timed

NUMBER = 4
#: Cells over the height of the column.
RESOLUTIONS = (8, 16, 32)
H, G, RHO, E, NU = 0.5, 9.8, 1000.0, 1e6, 0.3
M = E * (1 - NU) / ((1 + NU) * (1 - 2 * NU))
PERIODS, FRAMES_A_PERIOD = 6, 24


def run(resolution: int) -> Outcome:
    """Held sideways, so the modulus is M = lambda + 2 mu. Compression rho g H / M = 0.4 %: the linear answers hold as closely.

    The reference of the swing is the mean displacement of the column in linear elastodynamics, sum over odd n of
    (32 rho g H^2 / (M (pi n)^4)) (1 - cos(n pi c t / 2 H)); means over whole periods are the static answers.
    """
    dx, exact = H / resolution, 4 * H * np.sqrt(RHO / M)
    cells = [4, int(np.ceil(1.25 * resolution))]
    what = scene(
        "elastic-column", {"model": "elastic", "density": RHO, "young_modulus": E, "poisson_ratio": NU},
        [{"kind": "box", "lower": [0.0, 0.0], "upper": [4 * dx, H]}], [[0.0, 4 * dx], [0.0, cells[1] * dx]], cells, exact / FRAMES_A_PERIOD,
        gravity=[0.0, -G],
    )  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    Y = what.particles().position[:, 1]

    def observe(_):
        state = solver.state()
        b = 1 + state["stuff.b - I"]
        log_J = 0.5 * np.log(b[:, 0] * b[:, 1] - (b[:, 2] - 1) ** 2)
        lam, mu = M - E / (1 + NU), E / (2 * (1 + NU))
        return state["position"][:, 1] - Y, (mu * (b[:, 1] - 1) + lam * log_J) / np.exp(log_J)

    found, seconds = timed(solver.frame, PERIODS * FRAMES_A_PERIOD, observe)
    u, sigma = (np.array(series) for series in zip(*found, strict=True))
    t = what.frame_step * np.arange(1, len(u) + 1)
    n = np.arange(1, 40, 2)[:, None]
    swing = (32 * RHO * G * H**2 / (M * (np.pi * n) ** 4) * (1 - np.cos(n * np.pi * np.sqrt(M / RHO) * t / (2 * H)))).sum(0)
    # Forces come from the grid, which cannot tell the layers of a cell apart: stresses are means over a cell.
    cell = np.floor(Y / dx).astype(int)
    profile = np.bincount(cell, sigma.mean(0)) / np.bincount(cell)
    y = (np.arange(resolution) + 0.5) * dx
    weight, layers = -RHO * G * (H - y), np.unique(Y)
    settled = np.array([u.mean(0)[layer == Y].mean() for layer in layers])
    static = -RHO * G / M * (H * layers - layers**2 / 2)
    found_period = period(t, u.mean(1), exact)
    curves = {
        "period": Curve(f"period {found_period:.5f} s, exact {exact:.5f} s", ("time [s]", "mean displacement [m]"), t, -swing, u.mean(1),
                        found_period / exact - 1, 0.02),
        "settlement": Curve("settlement of the top layer", ("height [m]", "displacement [m]"), layers, static, settled,
                            float(settled[-1] / static[-1] - 1), 0.02),
        "stress": Curve("relative L2 error of the stress", ("height [m]", "sigma_yy [Pa]"), y, weight, profile, l2(profile, weight), 0.03),
    }  # fmt: skip
    return Outcome("elastic_column", resolution, len(Y), curves, seconds)
