"""Speed of sound against time step (WCSPH): a block with noise in its velocities, at fixed steps of 0.2 to 4 spacings of sound a step."""

from sim.stability import Cell
from sim.stability.driver import noise
from sim.stability.maps import COURANT, STEPS_A_FRAME, adaptive_cell, map_cell
from sim.stability.young_dt import BLOCK, BOX, CELLS, SPEED, STEPS
from sim.validation import scene

#: Speeds of sound [m/s].
SOUND = tuple(10.0 ** (k / 2) for k in range(7))
SPACING = 0.5 / CELLS


def run() -> list[Cell]:
    """Noise of 0.1 m/s, as in ``young_dt``."""
    cells = []
    for c in SOUND:
        material, bound, solver = {"model": "water", "sound_speed": c}, 0.4 * SPACING / c, {"method": "wcsph"}
        for courant in COURANT:
            dt = courant * SPACING / c
            what = scene("sound-dt", material, [BLOCK], BOX, [CELLS] * 2, dt * STEPS_A_FRAME, time_step=dt, solver=solver)
            cells.append(map_cell("sound_dt", f"c {c:.3g} m/s, C {courant:g}", what, bound, STEPS // STEPS_A_FRAME,
                                  {"sound_speed": c, "courant": courant}, prepare=noise(SPEED)))  # fmt: skip
        what = scene("sound-dt", material, [BLOCK], BOX, [CELLS] * 2, bound * STEPS_A_FRAME, solver=solver)
        cells.append(adaptive_cell("sound_dt", f"c {c:.3g} m/s, adaptive", what, bound, STEPS // STEPS_A_FRAME, {"sound_speed": c},
                                   prepare=noise(SPEED)))  # fmt: skip
    return cells
