"""Speed against time step: an elastic block thrown at a wall, from a tenth to ten times its speed of sound, at fixed steps."""

import numpy as np

from sim.stability import Cell
from sim.stability.driver import ROUGH
from sim.stability.maps import COURANT, STEPS_A_FRAME, adaptive_cell, limit, map_cell
from sim.stability.young_dt import BOX, CELLS, NU, RHO, wave_speed
from sim.validation import scene

#: Speeds of the block over that of sound.
MACH = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
E, SIDE, GAP = 1e5, 0.25, 0.125
#: All the energy of the throw, rho v^2 / 2, as compression, lambda / 2 (log J)^2, leaves J = exp(-v sqrt(rho / lambda)). Of J = 1e-3 float32's
#: b - I keeps one digit.
LAMBDA = E * NU / ((1 + NU) * (1 - 2 * NU))
MATERIAL = {"model": "elastic", "density": RHO, "young_modulus": E, "poisson_ratio": NU}


def run() -> list[Cell]:
    """From two cells off the wall until it would have bounced back to the middle of the box, twice over."""
    cells, c = [], wave_speed(E)
    body = {"kind": "box", "lower": [GAP, 0.375], "upper": [GAP + SIDE, 0.375 + SIDE]}
    for mach in MACH:
        v = mach * c
        bound, duration, thrown = limit(0.4, 1 / CELLS, c, v), 2 * (GAP + 0.5) / v + 4 * SIDE / c, [body | {"velocity": [-v, 0.0]}]
        for courant in COURANT:
            dt = courant / CELLS / (c + v)
            what = scene("speed-dt", MATERIAL, thrown, BOX, [CELLS] * 2, dt * STEPS_A_FRAME, time_step=dt, walls=ROUGH)
            cells.append(map_cell("speed_dt", f"v {mach:g} c, C {courant:g}", what, bound,
                                  int(np.ceil(duration / what.frame_step)), {"speed": v, "mach": mach, "courant": courant}))  # fmt: skip
        what = scene("speed-dt", MATERIAL, thrown, BOX, [CELLS] * 2, bound * STEPS_A_FRAME, walls=ROUGH)
        cells.append(adaptive_cell("speed_dt", f"v {mach:g} c, adaptive", what, bound, int(np.ceil(duration / what.frame_step)),
                                   {"speed": v, "mach": mach}, may_fail=RHO * v**2 / LAMBDA > np.log(1e-3) ** 2))  # fmt: skip
    return cells
