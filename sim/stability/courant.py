"""Courant number against material: a column of each material collapses at an adaptive step, at every Courant number that a scene may ask for."""

import time

from sim.stability import BOUND, Cell
from sim.stability.driver import ROUGH, follow
from sim.validation import scene

COURANT = (0.2, 0.4, 0.8, 1.2, 2.0, 2.8, 4.0)
MATERIALS = {
    "water": {"model": "water", "sound_speed": 20.0},
    "sand": {"model": "sand", "young_modulus": 3e5, "friction_angle": 30.0},
    "goop": {"model": "goop", "young_modulus": 2e5, "yield_stress": 2e3},
    "elastic": {"model": "elastic", "young_modulus": 2e5},
    "snow": {"model": "snow"},
}
CELLS, G, HEIGHT, WIDTH, LIFT = 16, 9.8, 0.5, 0.25, 0.125
EXPECTED = "bounded energy, or failed and said so"


def run() -> list[Cell]:
    """Dropped from two cells above a rough floor; energy at hand is what a fall to the floor would release."""
    cells = []
    for name, material in MATERIALS.items():
        for courant in COURANT:
            begun = time.perf_counter()
            body = {"kind": "box", "lower": [0.375, LIFT], "upper": [0.375 + WIDTH, LIFT + HEIGHT], "velocity": [0.5, 0.0]}
            what = scene("courant", material, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 0.01, gravity=[0.0, -G], cfl=courant, walls=ROUGH)
            run = follow(what, 100)
            mass = what.materials["stuff"].density * WIDTH * HEIGHT
            scale = mass * G * (LIFT + HEIGHT / 2)
            growth = run.growth(scale)
            right = growth <= BOUND - 1 or not run.ok
            observed = f"energy at most {1 + growth:.3g} of the start's" if run.ok else run.status
            numbers = {"courant": courant, "energy_growth": growth, "smallest_dt": float(run.dt.min(initial=1.0)), "status": run.status}
            cells.append(Cell("courant", f"{name}, C {courant:g}", right, EXPECTED, observed, numbers, time.perf_counter() - begun,
                              {f"{name}, C {courant:g}": run.energy_curve(scale)}))  # fmt: skip
    return cells
