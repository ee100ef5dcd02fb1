"""Poisson's ratio towards one half: the step follows lambda, and a nearly incompressible block still bounces."""

import time

import numpy as np

from sim.stability import BOUND, Cell
from sim.stability.driver import ROUGH, follow
from sim.validation import scene

RATIOS = (0.3, 0.45, 0.49, 0.499, 0.4999)
E, RHO, CELLS, G = 1e5, 1000.0, 16, 9.8
EXPECTED = "dt = 0.4 dx / (sqrt((lambda + 2 mu) / rho) + v) or less, energy bounded"


def run() -> list[Cell]:
    """Dropped two cells onto the floor, half a second."""
    cells = []
    for nu in RATIOS:
        begun = time.perf_counter()
        material = {"model": "elastic", "density": RHO, "young_modulus": E, "poisson_ratio": nu}
        body = {"kind": "box", "lower": [0.375, 0.125], "upper": [0.625, 0.375]}
        what = scene("poisson", material, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 0.01, gravity=[0.0, -G], walls=ROUGH)
        run = follow(what, 50)
        scale = RHO * 0.25**2 * G * 0.25
        c = np.sqrt(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / RHO)
        allowed = 0.4 / CELLS / c
        # The elastic wave slows as the block is stretched, so the step may grow a little during the bounce; at the start it may not.
        first = float(run.dt[0]) if len(run.dt) else np.nan
        follows = 0.5 <= first / allowed <= 1
        right = run.ok and follows and run.growth(scale) <= BOUND - 1
        observed = f"dt {first:.3g} s, limit {allowed:.3g} s, energy at most {1 + run.growth(scale):.3g} of the start's" if run.ok else run.status
        numbers = {"poisson_ratio": nu, "wave_speed": float(c), "first_dt": first, "limit": float(allowed), "energy_growth": run.growth(scale)}
        cells.append(Cell("poisson", f"nu {nu:g}", right, EXPECTED, observed, numbers, time.perf_counter() - begun,
                          {f"nu {nu:g}": run.energy_curve(scale)}))  # fmt: skip
    return cells
