"""Courant number against material: a column of each material collapses at an adaptive step, at every Courant number that a scene may ask for."""

import time

from sim.stability import BOUND, Cell
from sim.stability.driver import PBF, SPH, deep, follow, way
from sim.validation import scene

COURANT = (0.2, 0.4, 0.8, 1.2, 2.0, 2.8, 4.0)
#: In 3D, where a run takes longer.
COURANT_3D, FRAMES = (0.4, 1.2, 4.0), {2: 100, 3: 50}
MATERIALS: dict[str, dict] = {
    "water": {"model": "water", "sound_speed": 20.0},
    "sand": {"model": "sand", "young_modulus": 3e5, "friction_angle": 30.0},
    "goop": {"model": "goop", "young_modulus": 2e5, "yield_stress": 2e3},
    "elastic": {"model": "elastic", "young_modulus": 2e5},
    "snow": {"model": "snow"},
}
CELLS, G, HEIGHT, WIDTH, LIFT = 16, 9.8, 0.5, 0.25, 0.125
EXPECTED = "bounded energy, or failed and said so"


def run() -> list[Cell]:
    """Dropped from two cells above a rough floor, in 2D and 3D; energy at hand is what a fall to the floor would release."""
    return [
        _drop(name, material, courant, dim)
        for dim, numbers in ((2, COURANT), (3, COURANT_3D))
        for name, material in (MATERIALS | SPH | PBF).items()
        for courant in numbers
    ]


def _drop(name: str, material: dict, courant: float, dim: int) -> Cell:
    begun, cell = time.perf_counter(), f"{name}, C {courant:g}{', 3D' if dim == 3 else ''}"
    body = {"kind": "box", "lower": [0.375, LIFT], "upper": [0.375 + WIDTH, LIFT + HEIGHT], "velocity": [0.5, 0.0]}
    what = scene("courant", material, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 0.01, gravity=[0.0, -G], cfl=courant, **way(name))
    if dim == 3:
        what = deep(what, 0.375, 0.375 + WIDTH)
    run = follow(what, FRAMES[dim])
    mass = what.materials["stuff"].density * WIDTH ** (dim - 1) * HEIGHT
    scale = mass * G * (LIFT + HEIGHT / 2)
    growth = run.growth(scale)
    right = growth <= BOUND - 1 or not run.ok
    observed = f"energy at most {1 + growth:.3g} of the start's" if run.ok else run.status
    numbers: dict[str, float | str | None] = {
        "dim": dim,
        "courant": courant,
        "energy_growth": growth,
        "smallest_dt": float(run.dt.min(initial=1.0)),
        "status": run.status,
    }
    return Cell("courant", cell, right, EXPECTED, observed, numbers, time.perf_counter() - begun, {cell: run.energy_curve(scale)})
