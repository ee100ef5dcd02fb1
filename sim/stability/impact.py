"""Impact at 50 sqrt(g H): the step falls, nothing goes through walls or a thin plate, kinetic energy never exceeds what was brought in."""

import time

import numpy as np

from sim.obstacles import combine
from sim.stability import Cell
from sim.stability.driver import PBF, SPH, deep, follow, solver_for, way
from sim.validation import scene

MATERIALS: dict[str, dict] = {
    "water": {"model": "water", "sound_speed": 20.0},
    "sand": {"model": "sand", "young_modulus": 3e5, "friction_angle": 30.0},
    "elastic": {"model": "elastic", "young_modulus": 1e7},
}
#: Rubber that such an impact crushes to less of its volume than float32 can tell from nothing, were all its energy to go there.
SOFT = {"model": "elastic", "young_modulus": 1e5}
EXPECTED = "dt falls below that at rest, every particle stays inside, kinetic + potential energy never above the start's"
CELLS, G, H = 16, 9.8, 0.5
SPEED = 50 * np.sqrt(G * H)
PLATE = {"kind": "segment", "start": [0.0, 0.25], "end": [1.0, 0.25], "thickness": 2.0 / CELLS}
TARGETS = {"floor": [], "plate": [PLATE]}


def run() -> list[Cell]:
    """Each material thrown at the floor, and at a plate two cells thick, in 2D and 3D; and one that may not bear it. PBF has no plates."""
    materials, fast = MATERIALS | SPH | PBF, SPH["wcsph"] | {"sound_speed": 10 * SPEED}
    return (
        [
            _thrown(name, materials[name], target, dim)
            for dim in (2, 3)
            for name in materials
            for target in TARGETS
            if name not in PBF or target == "floor"
        ]
        + [
            # Sound as fast as weakly compressible water should have it.
            _thrown("wcsph", fast, target, dim, ", sound ten times as fast,")
            for dim in (2, 3)
            for target in TARGETS
        ]
        + [_thrown("elastic", SOFT, "plate", 2, ", far too soft,", may_fail=True)]
    )


def _thrown(name: str, material: dict, target: str, dim: int, more: str = "", may_fail: bool = False) -> Cell:
    begun, cell = time.perf_counter(), f"{name}{more} on a {target}{', 3D' if dim == 3 else ''}"
    body = {"kind": "box", "lower": [0.375, 0.5], "upper": [0.625, 0.75], "velocity": [0.0, -SPEED]}
    what = scene("impact", material, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 5e-4, gravity=[0.0, -G], obstacles=TARGETS[target], **way(name))
    if dim == 3:
        what = deep(what, 0.375, 0.625)
    run = follow(what, 60)
    if name in SPH | PBF:
        rest = min(solver_for(what).limits(what, G * what.frame_step).values())
    else:
        rest = 0.4 / CELLS / (float(solver_for(what).plan(what)["wave_speed"]) + G * what.frame_step)
    x = run.position[: len(what.particles().position)]
    held = bool((x >= 0).all() and (x <= 1).all())
    if what.obstacles:
        held = held and float(combine(what.obstacles, x)[0].min()) > -1e-3 / CELLS and bool((x[:, 1] > 0.25).all())
    top, smallest = float((run.kinetic / run.energy[0]).max(initial=0.0)), float(run.dt.min(initial=np.inf))
    right = (run.ok or may_fail) and held and top <= 1 and smallest < rest
    where = "all inside" if held else "some outside"
    observed = f"dt {rest:.2g} s at rest, {smallest:.2g} s here; {where}; kinetic energy at most {top:.4g} of the start's"
    expected = EXPECTED + ("; or failed and said so" if may_fail else "")
    numbers = {"speed": SPEED, "rest_dt": rest, "smallest_dt": smallest, "kinetic_over_start": top, "energy_growth": run.growth(run.energy[0])}
    return Cell("impact", cell, right, expected, observed if run.ok else f"{run.status}; until then: {observed}", numbers,
                time.perf_counter() - begun, {cell: run.energy_curve(run.energy[0])})  # fmt: skip
