"""Which solver runs a scene: ``solver.method`` names it. All obey the ``Simulator`` contract and ``sim.generate.Teacher``."""

from __future__ import annotations


def solver_class(method: str) -> type:
    """The class for scenes of a method. Imports Taichi."""
    if method in ("wcsph", "dfsph"):
        from sim.sph.solver import SPHSimulator

        return SPHSimulator
    from sim.mpm.solver import MPMSimulator

    return MPMSimulator
