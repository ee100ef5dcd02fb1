"""The solver ladder: one teacher at many settings, compiled once for each grid.

Tracing the kernels for Taichi takes seconds, cached or not, and the rungs of a ladder mostly differ in numbers (time step, stiffness).
"""

from __future__ import annotations

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.simulator import Kind, Start


class Rung:
    """A solver under its own name and settings that may share compiled kernels, and so its state, with other rungs.

    Rungs that share must be run one after the other, as ``rollout`` does: to ``begin`` one is to end the others.
    """

    def __init__(self, solver: MPMSimulator, name: str, kind: Kind, settings: dict):
        self.solver, self.name, self.kind, self.settings = solver, name, kind, settings

    def begin(self, start: Start) -> None:
        self.solver.name, self.solver.settings = self.name, self.settings
        self.solver.begin(start)

    def advance(self) -> np.ndarray:
        if self.solver.settings is not self.settings:
            raise RuntimeError(f"{self.name}: another rung of the same grid has begun; begin again")
        return self.solver.advance()


def mpm_ladder(rungs: list[tuple[str, Kind, dict]]) -> list[Rung]:
    """Rungs (name, kind, overrides of ``MPMSimulator``), in the given order; those on one grid share a solver. Raises ``InputError``."""
    solvers: dict[tuple, MPMSimulator] = {}
    made = []
    for name, kind, overrides in rungs:
        settings = MPMSimulator(name=name, kind=kind, **overrides).settings
        solver = solvers.setdefault((settings["particles"], settings["coarsen"]), MPMSimulator())
        made.append(Rung(solver, name, kind, settings))
    return made
