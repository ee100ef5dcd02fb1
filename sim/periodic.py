"""Periodic boxes: which image of a particle is meant. Positions [..., dim] in any of their images.

A *period* is [dim] float64: the length of the box along an axis that repeats itself, 0 along one with walls; None where there are walls all
around, so that nothing is computed. It follows from the axes that a scene names as ``periodic`` and from the bounds. Files hold positions
within the bounds; whoever takes differences over time first lets the motion go on through the faces (``unwrapped``).

Decision: two particles meet once, by their nearest images, as in molecular dynamics (minimum image), even where a radius above half the
box would reach a second image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

AXES = "xyz"


def axes(scene: dict) -> tuple[str, ...]:
    """The periodic axes of a resolved scene, in their order."""
    return tuple(axis for axis in AXES if axis in scene.get("periodic", ()))


def period(scene: object, bounds: np.ndarray) -> np.ndarray | None:
    """The period of a resolved scene (a dict) within ``bounds`` [dim, 2]."""
    axes = scene.get("periodic") if isinstance(scene, dict) else None
    if not axes:
        return None
    bounds = np.asarray(bounds, float)
    return np.where([axis in axes for axis in AXES[: len(bounds)]], bounds[:, 1] - bounds[:, 0], 0.0)


def walls(bounds: np.ndarray, period: np.ndarray | None) -> np.ndarray:
    """[dim, 2]: the bounds where there are walls, infinitely far away along periodic axes."""
    bounds = np.asarray(bounds, float)
    return bounds if period is None else np.where(period[:, None] > 0, [-np.inf, np.inf], bounds)


def turns(offset: np.ndarray, period: np.ndarray) -> np.ndarray:
    """[..., dim]: how many periods an offset is away from its shortest image."""
    return np.round(np.divide(offset, period, out=np.zeros(np.shape(offset)), where=period > 0))


def shortest(offset: np.ndarray, period: np.ndarray | None) -> np.ndarray:
    """The shortest image of offsets [..., dim]: within half a period on every periodic axis."""
    return offset if period is None else offset - turns(offset, period) * period


def beside(position: np.ndarray, other: np.ndarray, period: np.ndarray | None) -> np.ndarray:
    """The images of positions [..., dim] that are nearest to ``other`` [..., dim], particle by particle."""
    return position if period is None else position - turns(np.asarray(position, float) - other, period) * period


def unwrapped(position: np.ndarray, period: np.ndarray | None, at: int = 0) -> np.ndarray:
    """[frames, particles, dim] without the jumps from face to face: no step of a frame is longer than half a period. Frame ``at`` stays as it is."""
    if period is None:
        return position
    moved = np.zeros(position.shape)
    np.cumsum(turns(np.diff(position.astype(float), axis=0), period), axis=0, out=moved[1:])
    return (position - (moved - moved[at]) * period).astype(position.dtype)


def wrapped(position: np.ndarray, bounds: np.ndarray, period: np.ndarray | None) -> np.ndarray:
    """The images of positions [..., dim] within the bounds [dim, 2], lower face included, for file and search."""
    if period is None:
        return position
    lower = np.asarray(bounds, float)[:, 0]
    inside = np.mod(position - lower, np.where(period > 0, period, 1.0)) + lower
    # A hair below the lower face is rounded to the upper one.
    return np.where(period > 0, np.where(inside >= lower + period, lower, inside), position).astype(position.dtype)


def tree(position: np.ndarray, period: np.ndarray | None) -> cKDTree:
    """A search tree of [particles, dim] by nearest images, in float64."""
    from scipy.spatial import cKDTree  # not above: the trajectory file needs NumPy and h5py alone

    position = np.asarray(position, float)
    # The tree wants 0 <= x < period; where the box begins does not matter to distances.
    return cKDTree(position) if period is None else cKDTree(wrapped(position, np.zeros((len(period), 2)), period), boxsize=period)
