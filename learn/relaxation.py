"""Relaxation of a learned rollout: a few steps of repulsion between particles that have clumped (NeuralSPH, Toshev et al. 2024, arXiv 2402.06275).

Errors of a learned model let particles drift into clumps that no training window shows, and water loses volume. With the number
density rho_i = spacing^d sum_j W(|x_i - x_j|), about 1 on the lattice, and W the normalised (1 - r / h)^2 kernel, a step is

    p_i = max(rho_i - density, 0),    x_i += strength spacing sum_j (p_i + p_j) (1 - r_ij / h) e_ij

Decisions: only compression beyond ``density`` pushes (nothing pulls, so sprays and free flight are left exactly alone; soft water itself
reaches 1.5 to 2). Walls are mirrors, so the repulsion of a crowded floor points inward; nothing is clamped, and escapes stay visible.
One neighbour search serves all steps, since a step moves no particle by more than a quarter of a spacing. It belongs to the rollout
alone: training does not see it.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial import cKDTree

from sim import periodic

#: Support h of the kernel in particle spacings: 13 neighbours on a square lattice.
SUPPORT = 2.0
#: Farthest that one step moves a particle, in spacings.
LONGEST = 0.25


class Relaxation(BaseModel):
    """Options of ``relax``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    loops: int = Field(3, ge=1, le=1000)  # steps after every call of the model
    strength: float = Field(0.05, gt=0, le=1e6)  # displacement in spacings for unit pressure
    density: float = Field(2.0, ge=1, le=1e6)  # number density, 1 on the lattice, above which particles repel


def relax(
    position: np.ndarray, bounds: np.ndarray, spacing: float, settings: Relaxation, fixed: np.ndarray | None = None, period: np.ndarray | None = None
) -> np.ndarray:
    """Positions [particles, dim] float64 after ``settings.loops`` steps; bounds [dim, 2] and spacing in the same length.

    fixed [particles] bool: kinematic particles, which repel and do not move; period [dim] of a periodic box, whose positions may be any images.
    Positions of which one is not finite come back as they are: the rollout that they are of ends with them.
    """
    if not np.isfinite(position).all():
        return position
    outside = position - periodic.wrapped(position, bounds, period)
    position = position - outside
    count, dim = position.shape
    reach = SUPPORT * spacing
    weight = (6 / (math.pi * SUPPORT**2)) if dim == 2 else 15 / (2 * math.pi * SUPPORT**3)
    owner, sign, shift = images(position, bounds, reach, period)
    first, second = cKDTree(position[owner] * sign + shift).query_pairs(reach, output_type="ndarray").T
    # Both directions, towards particles only: an image moves with its owner.
    receiver, sender = np.concatenate([first, second]), np.concatenate([second, first])
    kept = receiver < count
    receiver, sender = receiver[kept], sender[kept]
    for _ in range(settings.loops):
        place = position[owner] * sign + shift
        offset = place[receiver] - place[sender]
        distance = np.sqrt((offset**2).sum(1))
        closeness = np.maximum(1 - distance / reach, 0)
        density = weight * (1 + np.bincount(receiver, closeness**2, minlength=count))
        pressure = np.maximum(density - settings.density, 0)
        if not pressure.any():
            break
        push = settings.strength * spacing * (pressure[receiver] + pressure[owner[sender]]) * closeness / np.maximum(distance, 1e-9 * spacing)
        step = np.stack([np.bincount(receiver, push * offset[:, axis], minlength=count) for axis in range(dim)], 1)
        if fixed is not None:
            step[fixed] = 0
        length = np.sqrt((step**2).sum(1, keepdims=True))
        position = position + step * np.minimum(1, LONGEST * spacing / np.maximum(length, 1e-300))
    return position + outside


def images(position: np.ndarray, bounds: np.ndarray, reach: float, period: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The particles, then their images within ``reach`` of the box, corners included: owner [k], sign and shift [k, dim] (x sign + shift).

    Images are mirrored in walls and a period away along periodic axes.
    """
    owner = np.arange(len(position))
    sign, shift = np.ones_like(position), np.zeros_like(position)
    for axis in range(position.shape[1]):
        place = position[owner, axis]
        for wall, inward in zip(bounds[axis], (1, -1), strict=True):
            near = np.flatnonzero(np.abs(place - wall) < reach)
            image_sign, image_shift = sign[near].copy(), shift[near].copy()
            if period is not None and period[axis] > 0:
                image_shift[:, axis] = inward * period[axis]
            else:
                image_sign[:, axis], image_shift[:, axis] = -1, 2 * wall
            owner, sign, shift = np.concatenate([owner, owner[near]]), np.concatenate([sign, image_sign]), np.concatenate([shift, image_shift])
    return owner, sign, shift
