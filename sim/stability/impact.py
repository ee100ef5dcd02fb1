"""Impact at 50 sqrt(g H): the step falls, nothing goes through walls or a thin plate, kinetic energy never exceeds what was brought in."""

import time

import numpy as np

from sim.obstacles import combine
from sim.scene import Scene
from sim.stability import Cell
from sim.stability.driver import ROUGH, follow, solver_for
from sim.validation import scene

MATERIALS = {
    "water": {"model": "water", "sound_speed": 20.0},
    "sand": {"model": "sand", "young_modulus": 3e5, "friction_angle": 30.0},
    "elastic": {"model": "elastic", "young_modulus": 1e7},
}
#: Rubber that such an impact would crush to 1 / 10 000 of its volume, more than float32 can tell from nothing.
SOFT = {"model": "elastic", "young_modulus": 1e5}
EXPECTED = "dt falls below that at rest, every particle stays inside, kinetic + potential energy never above the start's"
CELLS, G, H = 16, 9.8, 0.5
SPEED = 50 * np.sqrt(G * H)
PLATE = {"kind": "segment", "start": [0.0, 0.25], "end": [1.0, 0.25], "thickness": 2.0 / CELLS}


def run() -> list[Cell]:
    """Each material thrown at the floor, and at a plate two cells thick; and one that cannot bear it."""
    cells = []
    for name, material in MATERIALS.items():
        for target, obstacles in (("floor", []), ("plate", [PLATE])):
            begun = time.perf_counter()
            body = {"kind": "box", "lower": [0.375, 0.5], "upper": [0.625, 0.75], "velocity": [0.0, -SPEED]}
            what = scene("impact", material, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 5e-4, gravity=[0.0, -G],
                         obstacles=obstacles, walls=ROUGH)  # fmt: skip
            run = follow(what, 60)
            rest = 0.4 / CELLS / (float(solver_for(what).plan(what)["wave_speed"]) + G * what.frame_step)
            x = run.position[: len(what.particles().position)]
            held = bool((x >= 0).all() and (x <= 1).all())
            if obstacles:
                held = held and float(combine(what.obstacles, x)[0].min()) > -1e-3 / CELLS and bool((x[:, 1] > 0.25).all())
            brought = run.energy[0]
            top = float((run.kinetic / brought).max(initial=0.0))
            smallest = float(run.dt.min(initial=np.inf))
            right = run.ok and held and top <= 1 and smallest < rest
            where = "all inside" if held else "some outside"
            observed = f"dt {rest:.2g} s at rest, {smallest:.2g} s here; {where}; kinetic energy at most {top:.4g} of the start's"
            observed = observed if run.ok else run.status
            numbers = {"speed": SPEED, "rest_dt": rest, "smallest_dt": smallest, "kinetic_over_start": top, "energy_growth": run.growth(brought)}
            cell = f"{name} on a {target}"
            cells.append(Cell("impact", cell, right, EXPECTED, observed, numbers, time.perf_counter() - begun,
                              {cell: run.energy_curve(brought)}))  # fmt: skip
    begun = time.perf_counter()
    run = follow(Scene.from_dict(what.to_dict() | {"materials": {"stuff": SOFT}}), 60)
    cells.append(Cell("impact", "elastic, far too soft, on a plate", run.status.startswith("failed: time step fell below"),
                      "failed and said so", run.status, {"kinetic_over_start": float((run.kinetic / run.energy[0]).max(initial=0.0))},
                      time.perf_counter() - begun))  # fmt: skip
    return cells
