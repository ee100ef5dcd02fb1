"""The solver ladder: one teacher at many settings, compiled once for each grid.

Tracing the kernels for Taichi takes seconds, cached or not, and the rungs of a ladder mostly differ in numbers (time step, stiffness).
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from sim.errors import InputError
from sim.simulator import Kind, Start
from sim.solvers import solver_class


class Rung:
    """A solver under its own name and settings that may share compiled kernels, and so its state, with other rungs.

    Rungs that share must be run one after the other, as ``rollout`` does: to ``begin`` one is to end the others.
    """

    def __init__(self, solver, name: str, kind: Kind, settings: dict):
        self.solver, self.name, self.kind, self.settings = solver, name, kind, settings

    def begin(self, start: Start) -> None:
        self.solver.name, self.solver.settings = self.name, self.settings
        self.solver.begin(start)

    def advance(self) -> np.ndarray:
        if self.solver.settings is not self.settings:
            raise RuntimeError(f"{self.name}: another rung of the same grid has begun; begin again")
        return self.solver.advance()


def solver_ladder(rungs: list[tuple[str, Kind, dict]], method: str) -> list[Rung]:
    """Rungs (name, kind, overrides of the method's solver), in the given order; those on one grid share a solver. Raises ``InputError``."""
    solver, made = solver_class(method), []
    shared: dict[tuple, Any] = {}
    known = [name for name in inspect.signature(solver).parameters if name not in ("name", "kind", "serial", "unguarded_step")]
    for name, kind, overrides in rungs:
        for key, value in overrides.items():
            if key not in known:
                raise InputError(name, key, value, f"{method} has no such setting; its are {', '.join(known)}")
        settings = solver(name=name, kind=kind, **overrides).settings
        place = (settings["particles"], settings.get("coarsen"))
        shared[place] = shared.get(place) or solver()
        made.append(Rung(shared[place], name, kind, settings))
    return made
