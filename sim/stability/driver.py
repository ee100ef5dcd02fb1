"""Runs of scenes for the stress matrix: energies, steps and what became of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim.scene import Scene
from sim.simulator import SimulationError
from sim.solvers import solver_class
from sim.stability import Series

#: Walls of most scenes: one set of kernels a material.
ROUGH = {"friction": 0.5}
#: Water of the other methods, as a material of ``scene`` by name; SPH has slip walls.
SPH: dict[str, dict] = {"wcsph": {"model": "water", "sound_speed": 20.0}, "dfsph": {"model": "water"}}
PBF: dict[str, dict] = {"pbf": {"model": "water"}}
#: Any: cases ask a solver for what its method alone has.
_solvers: dict[str, Any] = {}


def way(name: str) -> dict:
    """What of a scene depends on its method: ``name`` is one of ``SPH`` or ``PBF``, or a material of MPM, whose walls are ``ROUGH``."""
    return {"solver": {"method": name}} if name in SPH | PBF else {"walls": ROUGH}


def deep(what: Scene, low: float, high: float) -> Scene:
    """The same in 3D: bodies from ``low`` to ``high`` along a third axis, in a box as deep as it is wide; plates across all of it."""
    content = what.to_dict()
    for body in content["bodies"]:
        body["lower"], body["upper"], body["velocity"] = [*body["lower"], low], [*body["upper"], high], [*body["velocity"], 0.0]
    solids = [
        {
            "kind": "box",
            "lower": [0.0, solid["start"][1] - solid["thickness"] / 2, 0.0],
            "upper": [1.0, solid["end"][1] + solid["thickness"] / 2, 1.0],
        }
        for solid in content.get("obstacles", [])
    ]
    bounds, cells = content["bounds"], content["cells"]
    return Scene.from_dict(
        content | {"dim": 3, "bounds": [*bounds, bounds[0]], "cells": [*cells, cells[0]], "gravity": [*content["gravity"], 0.0], "obstacles": solids}
    )


@dataclass(frozen=True)
class Run:
    """What ``follow`` saw after each frame it got: arrays [frames]; ``energy`` [frames + 1] kinetic + potential + elastic, the start first;
    position: the last frame's; status as in ``sim.trajectory``."""

    time: np.ndarray
    kinetic: np.ndarray
    energy: np.ndarray
    speed: np.ndarray
    substeps: np.ndarray
    dt: np.ndarray
    position: np.ndarray
    status: str

    @property
    def ok(self) -> bool:
        """Whether it ran to its end."""
        return self.status == "ok"

    def growth(self, scale: float) -> float:
        """Largest energy above the start's, over ``scale`` (what there is to release)."""
        return float((self.energy.max() - self.energy[0]) / scale)

    def energy_curve(self, scale: float) -> Series:
        """Energy over what there is to release, less what the start has beyond it."""
        return Series(("time [s]", "energy / energy at hand"), np.concatenate([[0.0], self.time]), (self.energy - self.energy[0]) / scale + 1)


def solver_for(what: Scene) -> Any:
    """The solver that all scenes of this structure and grid share in a process: compiling one takes longer than most cells."""
    solver = solver_class(what.solver.method)()
    key = repr((solver.plan(what)["cells"], solver._structure(what)))
    if key not in _solvers:
        # A box that is full but for a layer first: kernels are compiled again for more particles than they have seen.
        lower, upper = np.array(what.bounds).T.tolist()
        upper[1] -= what.spacing
        full = {"material": next(iter(what.materials)), "kind": "box", "lower": lower, "upper": upper, "velocity": [0.0] * what.dim}
        solver.load(Scene.from_dict({key: value for key, value in what.to_dict().items() if key != "time_step"} | {"bodies": [full]}))
        _solvers[key] = solver
    return _solvers[key]


def follow(what: Scene, frames: int, prepare=None, observe=None) -> Run:
    """Load a scene, let ``prepare(solver)`` change its start, and run, with ``observe(solver)`` after each frame; a failure of the solver ends
    the run with its status."""
    solver = solver_for(what)
    solver.load(what)
    if prepare is not None:
        prepare(solver)
    rows, status = [solver.diagnostics()], "ok"
    position = what.start()
    for number in range(1, frames + 1):
        try:
            position = solver.frame()
        except SimulationError as error:
            status = f"failed: {error} (frame {number})"
            break
        rows.append(solver.diagnostics())
        if observe is not None:
            observe(solver)
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    energy = column["kinetic_energy"] + column["potential_energy"] + column.get("elastic_energy", 0.0)
    return Run(
        time=what.frame_step * np.arange(1, len(rows)),
        kinetic=column["kinetic_energy"][1:],
        energy=energy,
        speed=column["max_speed"][1:],
        substeps=column["substeps"][1:],
        dt=column["dt"][1:],
        position=position,
        status=status,
    )


def noise(speed: float, seed: int = 0):
    """A ``prepare`` for ``follow``: independent normal velocities of this standard deviation [m/s] an axis, on which every mode of the grid rides."""

    def prepare(solver) -> None:
        shape = solver.state()["velocity"].shape
        solver.set_velocity(np.random.default_rng(seed).normal(size=shape) * speed)

    return prepare
