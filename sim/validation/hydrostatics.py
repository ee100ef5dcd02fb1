"""Hydrostatic pressure under water at rest."""

from __future__ import annotations

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation.case import Case, Clock, G, Result, box, scene


def run(resolution: int) -> Result:
    """Water over the full width of the box, H = 1/2, c = 40 m/s; mean pressure of each layer of cells over ten periods of its ringing, after ten.

    It starts at reference density and rings at 4 H / c, ten frames. Pressures are means over a cell, as forces come from the grid.
    """
    height, c, rho, clock, solver = 0.5, 40.0, 1000.0, Clock(), MPMSimulator()
    what = scene({"model": "water", "sound_speed": c}, [box([0.0, 0.0], [1.0, height])], resolution)
    solver.load(what)
    pressure, level = [], []
    for number, position in enumerate(clock.frames(solver, 200)):
        if number >= 100:
            J = solver._kernels.materials[0].J.to_numpy()[: len(position)].astype(float)
            pressure.append(rho * c**2 / 7 * (J**-7 - 1))
            level.append(position[:, 1].copy())
    layer = np.round(what.particles().position[:, 1] / what.spacing - 0.5).astype(int) // 2
    p, y = (np.bincount(layer, np.mean(values, 0)) / np.bincount(layer) for values in (pressure, level))
    exact = rho * G * (height - y)
    error = float(np.sqrt(((p - exact) ** 2).mean() / (exact**2).mean()))
    unit = rho * G * height
    return Result(resolution, error, f"pressure {error:.1%} off", (p / unit, y / height), (exact / unit, y / height), clock.seconds)


CASE = Case(
    3, "hydrostatics", "Hydrostatic pressure", "p = rho g (H - y)", "L2 of the pressure of layers of cells, relative", 0.03,
    ("p / rho g H", "y / H"), (16, 32, 64), "cells along the box (H = half of it)", run,
)
