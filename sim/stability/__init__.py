"""The stress matrix: what the solver must do when it is asked for too much, one small file a case or family of cases.

A case is a module of ``CASES`` with ``run() -> list[Cell]``; the first line of its docstring is its title. A cell says what reaction is right,
what was observed, and whether that is it. ``configs/studies/stability.yaml`` runs all; ``sim.stability.report`` writes summary and page.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sim.scene import Scene
from sim.simulator import SimulationError

CASES = (
    "young_dt", "speed_dt", "refusal", "courant", "stiff", "poisson", "density_ratio", "impact", "few_particles", "contact", "seeding", "rest",
    "friction_angle", "inverted", "shaking", "not_a_number", "resume",
)
#: Energy that counts as bounded, over the start's. Symplectic Euler swings about the true energy by up to 1 / (1 - (w dt / 2)^2); the fastest
#: oscillation of the grid, w = 2 sqrt(2) c / dx in 2D, makes that 1.47 at the default Courant number of 0.4. An instability knows no bound.
BOUND = 1.5


@dataclass(frozen=True)
class Series:
    """A curve for the report: axes (names and units of x and y), x and y [n]."""

    axes: tuple[str, str]
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class Cell:
    """One cell of the matrix. right: whether the reaction was the right one; expected: that reaction in words; observed: what happened, in
    words; numbers: what it is judged by; curves by name; seconds: wall time of the run, compilation apart where a case can tell."""

    case: str
    cell: str
    right: bool
    expected: str
    observed: str
    numbers: dict[str, float | str | None]
    seconds: float
    curves: dict[str, Series] = field(default_factory=dict)


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
        return self.status == "ok"

    def growth(self, scale: float) -> float:
        """Largest energy above the start's, over ``scale`` (what there is to release)."""
        return float((self.energy.max() - self.energy[0]) / scale)

    def energy_curve(self, scale: float) -> Series:
        return Series(("time [s]", "energy / energy at hand"), np.concatenate([[0.0], self.time]), (self.energy - self.energy[0]) / scale + 1)


def follow(solver, what: Scene, frames: int, prepare=None) -> Run:
    """Load a scene, let ``prepare(solver)`` change its start, and run; a failure of the solver ends the run with its status."""
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
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    energy = column["kinetic_energy"] + column["potential_energy"] + column["elastic_energy"]
    return Run(
        time=what.frame_step * np.arange(1, len(rows)), kinetic=column["kinetic_energy"][1:], energy=energy, speed=column["max_speed"][1:],
        substeps=column["substeps"][1:], dt=column["dt"][1:], position=position, status=status,
    )


def noise(speed: float, seed: int = 0):
    """A start for ``follow``: independent normal velocities of this standard deviation [m/s] an axis, on which every mode of the grid rides."""

    def prepare(solver) -> None:
        shape = solver.state()["velocity"].shape
        solver.set_velocity(np.random.default_rng(seed).normal(size=shape) * speed)

    return prepare
