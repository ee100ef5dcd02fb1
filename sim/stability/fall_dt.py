"""Speed against time step (DFSPH): a block thrown at the floor, at fixed steps in which it moves by 0.2 to 4 spacings and more."""

import numpy as np

from sim.stability import Cell
from sim.stability.maps import COURANT, STEPS_A_FRAME, adaptive_cell, map_cell
from sim.validation import scene

#: Speeds of the throw [m/s]: gravity, pressures and the throw bind in turn.
SPEEDS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
CELLS, G, SIDE, GAP = 16, 9.8, 0.25, 0.125
SPACING = 0.5 / CELLS


def _step(v: float, way: float) -> float:
    """dt of v dt + g dt^2 = way. A block that stands has pressures that add sqrt(g H / 2) to v."""
    return 2 * way / (v + np.sqrt(v**2 + 4 * G * way))


def run() -> list[Cell]:
    """Until it would have fallen through the box twice."""
    cells = []
    for v in SPEEDS:
        body = {"kind": "box", "lower": [0.375, GAP], "upper": [0.375 + SIDE, GAP + SIDE], "velocity": [0.0, -v]}
        common = {"gravity": [0.0, -G], "solver": {"method": "dfsph"}}
        (bound, unit), duration = (_step(v + np.sqrt(G * SIDE / 2), way * SPACING) for way in (0.4, 1.0)), 2 * _step(v, 1.0)
        for courant in COURANT:
            dt = courant * unit
            what = scene("fall-dt", {"model": "water"}, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, dt * STEPS_A_FRAME, time_step=dt, **common)
            cells.append(map_cell("fall_dt", f"v {v:g} m/s, C {courant:g}", what, bound, int(np.ceil(duration / what.frame_step)),
                                  {"speed": v, "courant": courant}))  # fmt: skip
        what = scene("fall-dt", {"model": "water"}, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, bound * STEPS_A_FRAME, **common)
        cells.append(adaptive_cell("fall_dt", f"v {v:g} m/s, adaptive", what, _step(v, 0.4 * SPACING),
                                   int(np.ceil(duration / what.frame_step)), {"speed": v}))  # fmt: skip
    return cells
