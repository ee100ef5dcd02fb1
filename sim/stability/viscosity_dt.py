"""Viscosity against time step (WCSPH): a block in a sticky corner that noise stirs, at fixed steps of 1 / 100 to 1 h^2 / nu."""

from sim.stability import Cell
from sim.stability.driver import noise
from sim.stability.maps import STEPS_A_FRAME, adaptive_cell, map_cell
from sim.stability.young_dt import BOX, CELLS, SPEED, STEPS
from sim.validation import scene

#: Kinematic viscosities [m^2 / s] that bind at a speed of sound of 1 m/s.
VISCOSITY = (0.3, 1.0, 10.0, 100.0, 1000.0)
#: Steps in h^2 / nu, h: half the support radius, 1.25 spacings.
SHARES = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.1, 0.125, 0.15, 0.2, 0.3, 0.5, 1.0)
LIMIT = 0.04
C, H, BLOCK = 1.0, 1.25 * 0.5 / CELLS, {"kind": "box", "lower": [0.0, 0.0], "upper": [0.375, 0.375]}


def run() -> list[Cell]:
    """Noise of 0.1 m/s, as in ``young_dt``. DFSPH's viscosity is implicit: ``unsolved``."""
    cells = []
    for nu in VISCOSITY:
        material, bound = {"model": "water", "sound_speed": C, "viscosity": 1000.0 * nu}, LIMIT * H**2 / nu
        common = {"solver": {"method": "wcsph"}, "walls": {"friction": "sticky"}}
        for share in SHARES:
            dt = share * H**2 / nu
            what = scene("viscosity-dt", material, [BLOCK], BOX, [CELLS] * 2, dt * STEPS_A_FRAME, time_step=dt, **common)
            cells.append(map_cell("viscosity_dt", f"nu {nu:g} m2/s, {share:g} h2/nu", what, bound, STEPS // STEPS_A_FRAME,
                                  {"viscosity": nu, "courant": share}, prepare=noise(SPEED)))  # fmt: skip
        what = scene("viscosity-dt", material, [BLOCK], BOX, [CELLS] * 2, bound * STEPS_A_FRAME, **common)
        cells.append(adaptive_cell("viscosity_dt", f"nu {nu:g} m2/s, adaptive", what, bound, STEPS // STEPS_A_FRAME, {"viscosity": nu},
                                   prepare=noise(SPEED)))  # fmt: skip
    return cells
