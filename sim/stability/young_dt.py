"""Young's modulus against time step: an elastic block with noise in its velocities, at fixed steps of 0.2 to 4 cells of sound a step."""

import numpy as np

from sim.stability import Cell
from sim.stability.driver import ROUGH, noise
from sim.stability.maps import COURANT, STEPS_A_FRAME, adaptive_cell, limit, map_cell
from sim.validation import scene

#: Young's moduli [Pa].
YOUNG = tuple(10.0**k for k in range(3, 10))
RHO, NU, CELLS, SPEED, STEPS = 1000.0, 0.3, 16, 0.1, 1000
BOX = [[0.0, 1.0]] * 2
BLOCK = {"kind": "box", "lower": [0.3125, 0.3125], "upper": [0.6875, 0.6875]}


def wave_speed(E: float) -> float:
    """sqrt((lambda + 2 mu) / rho) [m/s]."""
    return float(np.sqrt(E * (1 - NU) / ((1 + NU) * (1 - 2 * NU)) / RHO))


def run() -> list[Cell]:
    """Noise of 0.1 m/s excites every mode of the grid; 1000 steps are enough for any growth a step of one in fifty."""
    cells = []
    for E in YOUNG:
        c = wave_speed(E)
        material, bound = {"model": "elastic", "density": RHO, "young_modulus": E, "poisson_ratio": NU}, limit(0.4, 1 / CELLS, c, 0.0)
        for courant in COURANT:
            dt = courant / CELLS / c
            what = scene("young-dt", material, [BLOCK], BOX, [CELLS] * 2, dt * STEPS_A_FRAME, time_step=dt, walls=ROUGH)
            cells.append(map_cell("young_dt", f"E {E:.0e} Pa, C {courant:g}", what, bound, STEPS // STEPS_A_FRAME,
                                  {"young_modulus": E, "courant": courant}, prepare=noise(SPEED)))  # fmt: skip
        what = scene("young-dt", material, [BLOCK], BOX, [CELLS] * 2, bound * STEPS_A_FRAME, walls=ROUGH)
        cells.append(adaptive_cell("young_dt", f"E {E:.0e} Pa, adaptive", what, bound, STEPS // STEPS_A_FRAME, {"young_modulus": E},
                                   prepare=noise(SPEED)))  # fmt: skip
    return cells
