"""Densities 1000 : 1: balls collide in free space; momentum is exact, energy bounded."""

import time

import numpy as np

from sim.stability import BOUND, Cell
from sim.stability.driver import follow, solver_for
from sim.validation import scene

EXPECTED = "momentum kept to rounding, energy bounded"
HEAVY, LIGHT, E, CELLS, SPEED, FRAMES = 1000.0, 1.0, 1e4, 24, 2.0, 100
#: Momentum is rounded some 25 times a substep, in the sums over nine nodes to and fro and over the particles around a node: a random walk.
EPS, ROUNDINGS = float(np.finfo(np.float32).eps), 25


def run() -> list[Cell]:
    """The heavy ball strikes the light one, and the other way round."""
    cells = []
    materials = {name: {"model": "elastic", "density": rho, "young_modulus": E} for name, rho in (("heavy", HEAVY), ("light", LIGHT))}
    for striker in materials:
        begun = time.perf_counter()
        bodies = [
            {"material": name, "kind": "ball", "center": [at, 0.5], "radius": 0.125, "velocity": [SPEED if name == striker else 0.0, 0.0]}
            for name, at in zip(("heavy", "light") if striker == "heavy" else ("light", "heavy"), (0.35, 0.65), strict=True)
        ]
        what = scene("density-ratio", {}, bodies, [[0.0, 1.0]] * 2, [CELLS] * 2, 0.0005, materials=materials)
        mass = np.array([HEAVY, LIGHT])[what.particles().material]
        start = mass @ what.particles().velocity
        run = follow(what, FRAMES)
        end = solver_for(what).state()["velocity"]
        momentum, size = mass @ end, max(np.abs(mass[:, None] * velocity).sum() for velocity in (what.particles().velocity, end))
        drift, steps = float(np.abs(momentum - start).max() / size), float(run.substeps.sum())
        struck = float(np.abs(end[mass != (HEAVY if striker == "heavy" else LIGHT)]).max())
        growth = run.growth(run.energy[0])
        right = run.ok and struck > 0 and drift <= EPS * np.sqrt(ROUNDINGS * steps) and growth <= BOUND - 1
        observed = f"momentum off by {drift:.2g} of sum |m v| after {steps:.0f} steps, energy at most {1 + growth:.4g}" if run.ok else run.status
        numbers = {"momentum_drift": drift, "tolerance": EPS * np.sqrt(ROUNDINGS * steps), "energy_growth": growth, "speed_of_the_struck": struck}
        cells.append(Cell("density_ratio", f"{striker} strikes", right, EXPECTED, observed, numbers, time.perf_counter() - begun,
                          {f"{striker} strikes": run.energy_curve(run.energy[0])}))  # fmt: skip
    return cells
