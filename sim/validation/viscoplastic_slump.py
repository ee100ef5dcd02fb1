"""Viscoplastic slump: a column of Bingham goop on a rough floor stops where its weight no longer moves it, B = tau_y / (rho g)."""

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, l2, scene, timed

NUMBER = 17
#: Cells along a unit of length.
RESOLUTIONS = (40, 60, 80)
RHO, G, YIELD, ETA, E, NU = 1000.0, 9.8, 184.0, 20.0, 1e5, 0.4
HALF, HEIGHT, BOX = 0.25, 0.24, (0.8, 0.4)
SECONDS, FRAME = 4.0, 0.05


def slump(resolution: int, yield_stress: float = YIELD) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float]:
    """Run to the end: x of the cells, positions of all particles, height over the cells (volume over width), particles, wall seconds."""
    cells = [round(2 * BOX[0] * resolution), round(BOX[1] * resolution)]
    what = scene(
        "viscoplastic-slump",
        {"model": "goop", "density": RHO, "young_modulus": E, "poisson_ratio": NU, "yield_stress": yield_stress, "viscosity": ETA},
        [{"kind": "box", "lower": [-HALF, 0.0], "upper": [HALF, HEIGHT]}], [[-BOX[0], BOX[0]], [0.0, BOX[1]]], cells, FRAME,
        gravity=[0.0, -G], walls={"friction": "sticky"},
    )  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    found, seconds = timed(solver.frame, round(SECONDS / FRAME), lambda position: position)
    edges = np.linspace(-BOX[0], BOX[0], cells[0] + 1)
    volume, dx = what.spacing**2, edges[1] - edges[0]
    return (edges[1:] + edges[:-1]) / 2, found[-1], np.histogram(found[-1][:, 0], edges)[0] * volume / dx, len(found[-1]), seconds


def deposit(x: np.ndarray, B: float, area: float) -> tuple[np.ndarray, float]:
    """Height at x and run-out x_f of the arrested heap whose half holds ``area``: h^2 - pi B h = 2 B (x_f - |x|).

    Where goop has just stopped spreading, -rho g h h' + (pi / 2) tau_y h' = tau_y: weight against friction of the floor and the
    mean normal stress difference of plastic extension (Nye 1951; Dubash et al. 2009). Without that term, that is for pi B << h,
    it is h^2 = 2 B (x_f - x) (Liu & Mei 1989); the heap here is not as shallow.
    """

    def height(x, front):
        return np.where(np.abs(x) < front, np.pi * B / 2 + np.sqrt((np.pi * B / 2) ** 2 + 2 * B * np.maximum(front - np.abs(x), 0)), 0)

    front = brentq(lambda front: quad(height, 0, front, args=(front,))[0] - area, 1e-3, 100 * np.sqrt(area))
    return height(x, front), front


def run(resolution: int) -> Outcome:
    """Errors: relative L2 of the profile; run-out of all but half a per cent of the goop on either side."""
    x, position, h, n, seconds = slump(resolution)
    B = YIELD / (RHO * G)
    # Of what there is: a body is rounded to whole particles.
    exact, front = deposit(x, B, n / 2 * (0.5 / resolution) ** 2)
    reached = float(np.quantile(np.abs(position[:, 0]), 0.99))
    axes = ("x [m]", "height [m]")
    curves = {
        "profile": Curve("relative L2 error of the profile", axes, x, exact, h, l2(h, exact), 0.1),
        "run-out": Curve(f"run-out {reached:.3f} m, exact {front:.3f} m", axes, x, exact, h, reached / front - 1, 0.1),
    }
    return Outcome("viscoplastic_slump", resolution, n, curves, seconds)
