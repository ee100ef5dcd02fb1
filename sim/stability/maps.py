"""Maps over the time step: below the limit the guarded solver must keep the energy bounded or say that it cannot; above, the scene is refused.

Every step that is refused is run all the same, by the unguarded solver, so that the map shows how far the limit is from what it guards against.
"""

import time

import numpy as np

from sim.errors import InputError
from sim.mpm.solver import LONE_PARTICLE
from sim.scene import Scene
from sim.stability import BOUND, Cell
from sim.stability.driver import Run, follow, solver_for

#: Courant numbers of a map, dt (c + |v|) / dx.
COURANT = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.7, 2.0, 2.8, 4.0)
EXPECTED = "below the limit: bounded energy, or failed and said so; above: refused before the run"
#: Steps in a frame of a map: the guards look at the end of a frame.
STEPS_A_FRAME = 10


ADAPTIVE = "the first step below the limit, the steps follow, energy bounded"


def limit(cfl: float, dx: float, wave_speed: float, speed: float) -> float:
    """The limit in 2D by hand: min of cfl dx / (c + |v|) and 0.8 dx / (sqrt(2) c)."""
    return min(cfl * dx / (wave_speed + speed), LONE_PARTICLE * dx / (np.sqrt(2) * wave_speed))


def outcome(run: Run, scale: float) -> str:
    """In a word: "bounded", "grew" or "not finite"."""
    return "not finite" if not run.ok else "bounded" if run.growth(scale) <= BOUND - 1 else "grew"


def map_cell(case: str, cell: str, what: Scene, bound: float, frames: int, numbers: dict, prepare=None) -> Cell:
    """One cell: ``what`` has a fixed ``time_step``; ``bound``: the limit by hand [s]."""
    begun, solver, step = time.perf_counter(), solver_for(what), what.time_step
    assert step is not None
    try:
        solver.load(what)
        refused = ""
    except InputError as error:
        refused = str(error)
    if refused:
        solver.unguarded_step = step
        run = follow(what, frames, prepare)
        solver.unguarded_step = None
        free = outcome(run, run.energy[0])
        right = step > bound and f"{bound:.4g} s" in refused
        observed = f"refused; run all the same, its energy was {free}" if free != "not finite" else "refused; run all the same, it was not finite"
    else:
        run = follow(what, frames, prepare)
        free = outcome(run, run.energy[0])
        right = step <= bound * (1 + 1e-6) and free != "grew"
        observed = {"bounded": "bounded", "grew": "accepted, and its energy grew", "not finite": run.status}[free]
    growth = run.growth(run.energy[0])
    numbers = numbers | {"time_step": step, "limit": bound, "refused": bool(refused), "outcome": free, "energy_growth": growth}
    return Cell(case, cell, right, EXPECTED, observed, numbers, time.perf_counter() - begun)


def adaptive_cell(case: str, cell: str, what: Scene, bound: float, frames: int, numbers: dict, prepare=None, may_fail: bool = False) -> Cell:
    """The same start without a fixed step. may_fail: whether the start asks for more than float32 can hold."""
    begun = time.perf_counter()
    run = follow(what, frames, prepare)
    first, largest, smallest = float(run.dt[:1].max(initial=0.0)), float(run.dt.max(initial=0.0)), float(run.dt.min(initial=np.inf))
    right = (run.ok or may_fail) and first <= bound * (1 + 1e-6) and run.growth(run.energy[0]) <= BOUND - 1
    observed = f"dt {first:.3g} s at first, {smallest:.3g} to {largest:.3g} s later, energy {outcome(run, run.energy[0])}" if run.ok else run.status
    numbers = numbers | {"limit": bound, "first_dt": first, "largest_dt": largest, "smallest_dt": smallest}
    numbers["energy_growth"] = run.growth(run.energy[0])
    expected = ADAPTIVE + ("; or failed and said so, for it would be crushed to 1 / 1000" if may_fail else "")
    return Cell(case, cell, right, expected, observed, numbers, time.perf_counter() - begun, {cell: run.energy_curve(run.energy[0])})
