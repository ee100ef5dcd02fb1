"""Cases with a known answer, one small file each, run at a chosen resolution.

A case is a module of ``CASES`` with ``NUMBER`` (in the ladder), ``RESOLUTIONS`` (three, coarse to fine; the comment above says of what) and
``run(resolution) -> Outcome``; one for other solvers than MPM names them in ``METHODS`` and has ``run(resolution, method)``. It starts the
solver, compares and times it; it judges nothing but hands over the tolerance beside the error. ``python -m sim.validation`` runs all and
writes docs/validation.md.
"""

import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import curve_fit

from sim.scene import Scene

CASES = (
    "rotation",
    "return_map",
    "hydrostatics",
    "elastic_column",
    "axial_bar",
    "cantilever",
    "taylor_green",
    "channel",
    "lid_driven_cavity",
    "standing_wave",
    "elliptical_drop",
    "dam_break",
    "dam_impact",
    "sloshing",
    "granular_collapse",
    "block_on_plane",
    "rotating_patch",
    "elastic_discs",
    "float_and_sink",
    "viscoplastic_slump",
)


@dataclass(frozen=True)
class Curve:
    """One comparison: ``ours`` and ``reference`` [n] over ``x`` [n], one number ``error`` and the ``tolerance`` it is held to.

    label: what is compared, what the error is; axes: names and units of x and y.
    """

    label: str
    axes: tuple[str, str]
    x: np.ndarray
    reference: np.ndarray
    ours: np.ndarray
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance."""
        return bool(abs(self.error) <= self.tolerance)


@dataclass(frozen=True)
class Outcome:
    """What a case found: resolution (see the case), particles, curves by name, wall seconds without compilation."""

    case: str
    resolution: int
    particles: int
    curves: dict[str, Curve]
    seconds: float


def scene(name: str, material: dict, bodies: list[dict], bounds: list, cells: list[int], frame_step: float, **changes) -> Scene:
    """A resolved scene of one material ``stuff`` on a plain lattice, in as many dimensions as ``bounds`` has; bodies as in
    ``sim.scene.Body``, at rest unless they say otherwise."""
    still = [0.0] * len(bounds)
    bodies = [{"material": "stuff", "velocity": still} | body for body in bodies]
    content = {
        "name": name,
        "dim": len(bounds),
        "bounds": bounds,
        "gravity": still,
        "frame_step": frame_step,
        "frames": 2,
        "cells": cells,
        "radius": (bounds[0][1] - bounds[0][0]) / cells[0],
        "materials": {"stuff": material},
        "seed": 0,
        "bodies": bodies,
    }
    return Scene.from_dict(content | changes)


def timed(advance, frames: int, observe) -> tuple[list, float]:
    """What ``observe(positions)`` returns after each of ``frames`` frames, and the wall seconds that the frames took."""
    found, seconds = [], 0.0
    for _ in range(frames):
        begun = time.perf_counter()
        positions = advance()
        seconds += time.perf_counter() - begun
        found.append(observe(positions))
    return found, seconds


def period(t: np.ndarray, u: np.ndarray, guess: float) -> float:
    """Period of a damped oscillation about a mean: least squares of u = a + exp(-k t) (b cos w t + c sin w t)."""

    def model(t, a, k, b, c, w):
        return a + np.exp(-k * t) * (b * np.cos(w * t) + c * np.sin(w * t))

    size = np.ptp(u) / 2
    (_, _, _, _, w), _ = curve_fit(model, t, u, (u.mean(), 0.0, size, size, 2 * np.pi / guess), maxfev=20000)
    return float(2 * np.pi / abs(w))


def l2(ours: np.ndarray, reference: np.ndarray) -> float:
    """Relative L2 error."""
    return float(np.sqrt(((ours - reference) ** 2).sum() / (reference**2).sum()))
