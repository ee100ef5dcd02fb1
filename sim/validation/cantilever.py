"""Cantilever: clamped at a sticky wall, set swinging in its first mode, omega^2 = E H^2 k^4 / (12 rho (1 - nu^2)), k L = 1.875."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, period, scene, timed

NUMBER = 6
#: Cells across the beam.
RESOLUTIONS = (3, 4, 6)
L, H, RHO, E, NU = 0.2, 0.02, 1000.0, 2e6, 0.3975
K, AMPLITUDE = 1.8751040687 / L, 0.004
PERIODS, FRAMES_A_PERIOD = 1.5, 40


def run(resolution: int) -> Outcome:
    """Euler-Bernoulli in plane strain: T = 0.254 s. Shear and rotary inertia, left out, make it about 1 % longer at H / L = 1 / 10."""
    dx = H / resolution
    w = np.sqrt(E * H**2 * K**4 / (12 * RHO * (1 - NU**2)))
    exact = 2 * np.pi / w
    cells = [round(1.1 * L / dx), 3 * resolution]
    what = scene(
        "cantilever", {"model": "elastic", "density": RHO, "young_modulus": E, "poisson_ratio": NU},
        [{"kind": "box", "lower": [0.0, H], "upper": [L, 2 * H]}], [[0.0, cells[0] * dx], [0.0, cells[1] * dx]], cells, exact / FRAMES_A_PERIOD,
        walls={"friction": "sticky"},
    )  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    x, y = what.particles().position.T

    def mode(x):
        s = (np.sinh(K * L) - np.sin(K * L)) / (np.cosh(K * L) + np.cos(K * L))
        return (np.cosh(K * x) - np.cos(K * x) - s * (np.sinh(K * x) - np.sin(K * x))) / 2

    slope = (mode(x + 1e-6) - mode(x - 1e-6)) / 2e-6
    # Sections stay plane and normal: u = -(y - centre line) w'.
    solver.set_velocity(AMPLITUDE * w * np.stack([-(y - 1.5 * H) * slope, mode(x)], 1))
    tip = x > L - dx
    u, seconds = timed(solver.frame, round(PERIODS * FRAMES_A_PERIOD), lambda position: (position[:, 1] - y)[tip].mean())
    t = what.frame_step * np.arange(1, len(u) + 1)
    found = period(t, np.array(u), exact)
    curve = Curve(f"period {found:.4f} s, exact {exact:.4f} s", ("time [s]", "displacement of the tip [m]"), t,
                  AMPLITUDE * mode(x[tip].mean()) * np.sin(w * t), np.array(u), found / exact - 1, 0.1)  # fmt: skip
    return Outcome("cantilever", resolution, len(x), {"period": curve}, seconds)
