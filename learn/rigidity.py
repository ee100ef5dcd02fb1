"""Rigid bodies of a learned rollout keep their shape: shape matching after every call (Mueller et al. 2005, "Meshless deformations based on shape
matching", equations 3 to 7, without their linear and quadratic modes).

A body's predicted places x_i are replaced by the nearest that are a motion of its known ones q_i, in least squares:

    x_i <- c + R (q_i - qc),    c, qc: centroids,    R = argmin sum_i |x_i - c - R (q_i - qc)|^2 over rotations

R from the singular value decomposition of sum_i (x_i - c) (q_i - qc)^T, its last direction turned where that is a reflection (Kabsch 1976). The
centroid stays, and with it the momentum that the model predicts.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sim.trajectory import PARTICLE_TYPES

#: Particles of a body are chains with links of at most so many spacings. Neighbours along an axis are up to 1.67 apart where a teacher, refined
#: an even number of times, records one of the central particles at random.
LINK = 1.75


def rigid_bodies(position: np.ndarray, particle_type: np.ndarray, spacing: float) -> list[np.ndarray]:
    """Indices [k] of the particles of each rigid body, from one frame [particles, dim].

    A data set need not say which body a particle belongs to, so rigid particles within ``LINK`` spacings are of one: two that touch are one.
    """
    rigid = np.flatnonzero(particle_type == PARTICLE_TYPES["rigid"])
    if not len(rigid):
        return []
    first, second = cKDTree(position[rigid]).query_pairs(LINK * spacing, output_type="ndarray").T
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(len(rigid), len(rigid)))
    count, label = connected_components(graph, directed=False)
    return [rigid[label == number] for number in range(count)]


def matched(frames: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """The motions of ``shape`` [particles, dim] nearest to each of ``frames`` [frames, particles, dim]; frames that are not finite stay."""
    frames = np.asarray(frames, np.float64)
    finite = np.isfinite(frames).all(axis=(1, 2))
    centre = frames[finite].mean(axis=1, keepdims=True)
    rest = np.asarray(shape, np.float64) - np.mean(shape, axis=0, dtype=np.float64)
    left, _, right = np.linalg.svd((frames[finite] - centre).transpose(0, 2, 1) @ rest)
    left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    result = frames.copy()
    result[finite] = centre + rest @ (left @ right).transpose(0, 2, 1)
    return result
