"""A column of Bingham goop slumps on a rough floor and stops where its weight no longer moves it: h^2 = 2 B (x_f - x), B = tau_y / (rho g)."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, scene, timed

#: Cells along a unit of length.
RESOLUTIONS = (40, 60, 80)
RHO, G, YIELD, ETA, E, NU = 1000.0, 9.8, 73.5, 20.0, 3e4, 0.4
HALF, HEIGHT, BOX = 0.6, 0.25, (1.8, 0.4)
SECONDS, FRAME = 6.0, 0.05


def slump(resolution: int, yield_stress: float = YIELD) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float]:
    """Run to the end: x of the cells, height there at the start and at the end (mass over density), particles, wall seconds."""
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
    start, end = (np.histogram(position[:, 0], edges)[0] * volume / dx for position in (what.particles().position, found[-1]))
    return (edges[1:] + edges[:-1]) / 2, start, end, len(found[-1]), seconds


def run(resolution: int) -> Outcome:
    """Shallow flow (Liu & Mei 1989, eq. 2.21): where it has stopped, rho g h dh/dx = -tau_y. Volume gives x_f.

    Errors: B from a straight line through h^2 over the middle half of the flanks; and the run-out x_f.
    """
    x, _, h, n, seconds = slump(resolution)
    B = YIELD / (RHO * G)
    area = HALF * HEIGHT
    front = (1.5 * area / np.sqrt(2 * B)) ** (2 / 3)
    h = (h + h[::-1]) / 2
    flank = (np.abs(x) > 0.25 * front) & (np.abs(x) < 0.75 * front)
    slope = np.polyfit(np.abs(x[flank]), h[flank] ** 2, 1)[0]
    reached = float(np.abs(x[h > 0]).max() + (x[1] - x[0]) / 2)
    exact = np.sqrt(np.maximum(2 * B * (front - np.abs(x)), 0))
    axes = ("x [m]", "height [m]")
    curves = {
        "yield stress": Curve(f"B = {-slope / 2:.5f} m from the slope of h^2, exact {B:.5f} m", axes, x, exact, h, float(-slope / 2 / B - 1), 0.1),
        "run-out": Curve(f"run-out {reached:.3f} m, exact {front:.3f} m", axes, x, exact, h, reached / front - 1, 0.1),
    }
    return Outcome("viscoplastic_slump", resolution, n, curves, seconds)
