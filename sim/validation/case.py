"""What a validation case is, and what the cases share: scenes by a few words, and the solver's state in float64."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sim.mpm.solver import WALL, MPMSimulator
from sim.scene import Scene

G = 9.8
Curve = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Result:
    """One run of a case. error: in the unit of the tolerance; found: the same in words, ours beside the reference; ours, reference: curves
    (x, y); seconds: wall time of the frames, set-up and compilation apart."""

    resolution: int
    error: float
    found: str
    ours: Curve
    reference: Curve
    seconds: float


@dataclass(frozen=True)
class Case:
    """number: in the ladder; reference: formula or experiment and source; quantity: what ``error`` is; axes: labels of the curves;
    resolutions: coarse to fine, what one counts is ``unit``; run: resolution -> ``Result``."""

    number: int
    name: str
    title: str
    reference: str
    quantity: str
    tolerance: float
    axes: tuple[str, str]
    resolutions: tuple[int, int, int]
    unit: str
    run: Callable[[int], Result]


def order(results: list[Result]) -> float:
    """Observed order of convergence: slope of log error over log resolution, by least squares."""
    return float(-np.polyfit(np.log([each.resolution for each in results]), np.log([max(each.error, 1e-12) for each in results]), 1)[0])


def scene(material: dict, bodies: list[dict], cells: int, size: tuple[float, ...] = (1.0, 1.0), **changes) -> Scene:
    """A resolved scene in a box from the origin, ``cells`` along its first edge, one material, four particles (eight in 3D) a cell on a lattice."""
    dim = len(size)
    bodies = [{"material": "stuff", "velocity": [0.0] * dim} | body for body in bodies]
    content = {
        "name": "validation", "dim": dim, "bounds": [[0.0, edge] for edge in size], "gravity": [0.0, -G, 0.0][:dim], "frame_step": 0.005,
        "frames": 2, "radius": 2 * size[0] / cells, "cells": [round(cells * edge / size[0]) for edge in size], "materials": {"stuff": material},
        "seed": 1, "bodies": bodies,
    }
    return Scene.from_dict(content | changes)


def box(lower: list[float], upper: list[float], **more) -> dict:
    return {"kind": "box", "lower": lower, "upper": upper} | more


def state(solver: MPMSimulator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities [n, dim] and velocity gradients [n, dim, dim] of all particles, in float64 and length units from the lower corner."""
    kernels, n = solver._kernels, len(solver._position)
    dim = kernels.dim
    gradient = np.stack([column.to_numpy()[:n, :dim] for column in kernels.C], -1).astype(float)
    return (kernels.x.to_numpy()[:n].astype(float) - WALL) * solver.dx, kernels.v.to_numpy()[:n, :dim].astype(float), gradient


def set_motion(solver: MPMSimulator, velocity: np.ndarray, gradient: np.ndarray) -> None:
    """Overwrite velocities [n, dim] and their gradients [n, dim, dim]: scene files know only bodies that move as a whole."""
    kernels, n = solver._kernels, len(velocity)
    dim = velocity.shape[1]
    for field, values in ((kernels.v, velocity), *((kernels.C[axis], gradient[:, :, axis]) for axis in range(dim))):
        lanes = np.zeros((kernels.capacity, 4), np.float32)
        lanes[:n, :dim] = values
        if field is kernels.v:
            lanes[:n, dim] = 1.0
        field.from_numpy(lanes)
    solver._run(0, 0.0, keep=False)


class Clock:
    """Counts the seconds spent in frames."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def frames(self, solver: MPMSimulator, count: int) -> Iterator[np.ndarray]:
        """``count`` frames of the solver, timed."""
        for _ in range(count):
            begun = time.perf_counter()
            position = solver.frame()
            self.seconds += time.perf_counter() - begun
            yield position
