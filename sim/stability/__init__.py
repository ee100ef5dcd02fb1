"""The stress matrix: what the solvers must do when it is asked for too much, one small file a case or family of cases.

A case is a module of ``CASES`` with ``run() -> list[Cell]``; the first line of its docstring is its title. A cell says what reaction is right,
what was observed, and whether that is it. ``configs/studies/stability.yaml`` runs all; ``sim.stability.report`` writes summary and page.
Cases run their scenes by ``sim.stability.driver``, on 16 x 16 cells with rough walls wherever it does not matter, and so share compiled kernels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

CASES = (
    "young_dt",
    "speed_dt",
    "sound_dt",
    "viscosity_dt",
    "fall_dt",
    "refusal",
    "courant",
    "stiff",
    "poisson",
    "density_ratio",
    "impact",
    "few_particles",
    "contact",
    "seeding",
    "rest",
    "friction_angle",
    "inverted",
    "unsolved",
    "runaway",
    "shaking",
    "not_a_number",
    "resume",
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
    numbers: Mapping[str, float | str | None]
    seconds: float
    curves: dict[str, Series] = field(default_factory=dict)
