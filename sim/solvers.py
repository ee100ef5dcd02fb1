"""Which solver runs a scene: ``solver.method`` names it. All obey the ``Simulator`` contract and ``sim.generate.Teacher``."""

from __future__ import annotations


def solver_class(method: str) -> type:
    """The class for scenes of a method. Imports Taichi."""
    if method in ("wcsph", "dfsph"):
        from sim.sph.solver import SPHSimulator

        return SPHSimulator
    if method == "pbf":
        from sim.pbd.solver import PBDSimulator

        return PBDSimulator
    from sim.mpm.solver import MPMSimulator

    return MPMSimulator
