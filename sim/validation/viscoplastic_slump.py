"""Viscoplastic slump: a column of Bingham goop on a rough floor stops where its weight no longer moves it, B = tau_y / (rho g)."""

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, l2, scene, timed

NUMBER = 17
#: Cells along a unit of length.
RESOLUTIONS = (40, 60, 80)
RHO, G, YIELD, ETA, E, NU = 1000.0, 9.8, 184.0, 100.0, 1e5, 0.4
#: BIN: width over which heights are taken, the same at every resolution.
HALF, HEIGHT, BOX, BIN = 0.25, 0.24, (0.8, 0.4), 0.05
SECONDS, FRAME = 6.0, 0.05
#: Bulk modulus in the plane, lambda + mu; seconds of the two limits.
K, FLOWING, STANDING = E / (2 * (1 + NU) * (1 - 2 * NU)), 0.5, 1.0


def slump(resolution: int, seconds: float = SECONDS, **material) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float]:
    """Run to the end: x of the bins, [frames, n, 2] positions of all particles, height over the bins (volume over width), particles, wall
    seconds. ``material`` changes the goop, or stands for it if it names a model."""
    goop = {"model": "goop", "young_modulus": E, "poisson_ratio": NU, "yield_stress": YIELD, "viscosity": ETA}
    material = {"density": RHO} | (material if "model" in material else goop | material)
    cells = [round(2 * BOX[0] * resolution), round(BOX[1] * resolution)]
    what = scene("viscoplastic-slump", material, [{"kind": "box", "lower": [-HALF, 0.0], "upper": [HALF, HEIGHT]}],
                 [[-BOX[0], BOX[0]], [0.0, BOX[1]]], cells, FRAME, gravity=[0.0, -G], walls={"friction": "sticky"})  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    found, wall = timed(solver.frame, round(seconds / FRAME), lambda position: position)
    edges = np.linspace(-BOX[0], BOX[0], round(2 * BOX[0] / BIN) + 1)
    return (edges[1:] + edges[:-1]) / 2, np.array(found), np.histogram(found[-1][:, 0], edges)[0] * what.spacing**2 / BIN, len(found[-1]), wall


def deposit(x: np.ndarray, B: float, area: float) -> tuple[np.ndarray, float]:
    """Height at x and run-out x_f of the arrested heap whose half holds ``area``: h^2 - pi B h = 2 B (x_f - |x|).

    A thin layer at yield throughout, spreading to x > 0 (Nye 1951; Dubash et al. 2009): its shear stress falls from tau_y at the floor to
    zero at the surface, so that yield leaves (sigma_x - sigma_z) / 2 = tau_y sqrt(1 - (1 - z / h)^2), whose integral over the depth is
    pi tau_y h / 4. With sigma_z = -rho g (h - z) the force along the layer is -rho g h^2 / 2 + pi tau_y h / 2, and its slope balances the
    floor's tau_y: -rho g h h' + (pi / 2) tau_y h' = tau_y. The front is a face of height pi B. For pi B << h this is
    h^2 = 2 B (x_f - x) (Liu & Mei 1989); the heap here is not as shallow. No inertia: of the column's, rho sqrt(g H) H / eta = 4 is left.
    """

    def height(x, front):
        return np.where(np.abs(x) < front, np.pi * B / 2 + np.sqrt((np.pi * B / 2) ** 2 + 2 * B * np.maximum(front - np.abs(x), 0)), 0)

    front = brentq(lambda front: quad(height, 0, front, args=(front,))[0] - area, 1e-3, 100 * np.sqrt(area))
    return height(x, front), front


def limits(resolution: int) -> tuple[dict[str, Curve], float]:
    """Goop without yield stress and with an infinite one against other materials of the same solver, and wall seconds.

    The first is a fluid: the profile of ``water`` with the same viscosity and bulk modulus, on its way. The second is an elastic solid: how
    far the top of an ``elastic`` column sinks, mean over its oscillations.
    """
    x, _, fluid, _, first = slump(resolution, FLOWING, yield_stress=0.0)
    _, _, water, _, second = slump(resolution, FLOWING, model="water", sound_speed=float(np.sqrt(K / RHO)), viscosity=ETA)
    _, firm, _, _, third = slump(resolution, STANDING, yield_stress=1e9)
    _, rubber, _, _, fourth = slump(resolution, STANDING, model="elastic", young_modulus=E, poisson_ratio=NU)
    top = firm[0][:, 1] > firm[0][:, 1].max() - 0.4 / resolution
    sunk, sank = ((each.mean(0) - each[0])[top, 1] for each in (firm, rubber))
    return {
        "no yield stress": Curve("relative L2 difference of the profile from viscous water's", ("x [m]", "height [m]"), x, water, fluid,
                                 l2(fluid, water), 0.05),
        "infinite yield stress": Curve("relative L2 difference of the top's displacement from the elastic column's", ("x [m]", "displacement [m]"),
                                       firm[0][top, 0], sank, sunk, l2(sunk, sank), 0.05),
    }, first + second + third + fourth  # fmt: skip


def run(resolution: int) -> Outcome:
    """Errors: relative L2 of the profile; run-out of all but half a per cent of the goop on either side; then the limits of the yield stress.

    The reference comes without inertia: goop of 20 Pa s overshot it by 6 % on the finest grid. That of 100 Pa s stops short of it where the
    front's face, pi B high, is only two to four cells.
    """
    x, path, h, n, seconds = slump(resolution)
    B = YIELD / (RHO * G)
    # Of what there is: a body is rounded to whole particles.
    exact, front = deposit(x, B, n / 2 * (0.5 / resolution) ** 2)
    reached = np.quantile(np.abs(path[:, :, 0]), 0.99, axis=1)
    t = FRAME * np.arange(1, len(path) + 1)
    curves = {
        "profile": Curve("relative L2 error of the profile", ("x [m]", "height [m]"), x, exact, h, l2(h, exact), 0.1),
        "run-out": Curve(f"run-out {reached[-1]:.3f} m, exact {front:.3f} m", ("time [s]", "front [m]"), t, np.full(len(t), front), reached,
                         float(reached[-1] / front - 1), 0.1),
    }  # fmt: skip
    extremes, more = limits(resolution)
    return Outcome("viscoplastic_slump", resolution, n, curves | extremes, seconds + more)
