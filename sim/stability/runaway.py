"""SPH beside itself: speeds that run away and particles that collapse end the frame in a bounded time, each with a line of its own."""

import time

import numpy as np

from sim.stability import Cell
from sim.stability.driver import SPH, deep, follow
from sim.stability.few_particles import G
from sim.validation import scene

CELLS, FRAME, WHEN = 16, 0.005, 3
#: What is done to the solver -> what its status must say.
FAULTS = {
    "a particle at 1e6 m/s": "time step fell below",
    "every particle in one place": "particles have gathered: they make more pairs than there is room for",
    "a particle outside the box": "particle 7 is off the box, at [",
}
#: Of a frame: all its halvings, each of as many steps as the floor allows.
LONGEST = 7 * 64


def _spoil(solver, fault: str) -> None:
    if fault == "a particle at 1e6 m/s":
        solver.inject("velocity", 7, np.eye(solver.state()["velocity"].shape[1])[0] * 1e6)
    elif fault == "every particle in one place":
        solver.inject("position", np.arange(len(solver.state()["position"])), 0.3)
    else:
        solver.inject("position", 7, -7.0)


def run() -> list[Cell]:
    """A pool at rest, spoilt before its third frame."""
    cells = []
    for dim, name in [(dim, name) for dim in (2, 3) for name in SPH]:
        for fault, said in FAULTS.items():
            begun = time.perf_counter()
            body = {"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, 0.75]}
            what = scene("runaway", SPH[name], [body], [[0.0, 1.0]] * 2, [CELLS] * 2, FRAME, gravity=[0.0, -G], solver={"method": name})
            what = deep(what, 0.0, 0.25) if dim == 3 else what
            follow(what, WHEN)
            spent: list[float] = []

            def watch(solver, spent=spent, fault=fault) -> None:
                spent.append(time.perf_counter())
                if len(spent) == WHEN - 1:
                    _spoil(solver, fault)
                    spent[-1] = time.perf_counter()

            run = follow(what, WHEN, observe=watch)
            last, before = time.perf_counter() - spent[-1], float(np.diff(spent).max(initial=1e-3))
            right = run.status.startswith(f"failed: {said}") and run.status.endswith(f"(frame {WHEN})") and last <= LONGEST * before
            cells.append(Cell("runaway", f"{name}, {fault}{', 3D' if dim == 3 else ''}", right, f"failed within the frame: {said} ...", run.status,
                              {"seconds_of_the_frame": last, "seconds_of_one_before": before}, time.perf_counter() - begun))  # fmt: skip
    return cells
