"""The smoothing kernel and its integrals over half-spaces. Lengths are in support radii: W(r) = 0 for r >= 1.

Wendland C2 (Wendland 1995; Dehnen & Aly 2012, table 1), W = K (1 - r)^4 (1 + 4 r), K = 7 / pi in 2D, 21 / (2 pi) in 3D: one polynomial, a gradient
without 1 / r, and no pairing of particles at any number of neighbours.

A wall is the half-space behind a plane, filled with fluid at rest as far as sums over neighbours are concerned: its part in a sum is a function of
the distance s to the plane alone (Winchenbach, Akhunov & Kolb 2020, who integrate the kernel over the half-space). Decision: no boundary
particles. Akinci et al. (2012) and Adami et al. (2012) put a third of a small scene's particles into its walls and see a bumpy surface; here a
wall costs a table's entry, and slip on it is free of friction. The fluid behind is in layers, each smeared out along the wall, as far
apart as particles are, not a continuum: of the continuum a particle half a spacing off the wall sees 5 % too much (support of two spacings), and
a block that starts on the floor would be thrown up. For curved obstacles the plane is the tangent one.
"""

from __future__ import annotations

import numpy as np

#: Entries of the tables over s in [0, 1].
ENTRIES = 256
#: Distance to a wall or body in support radii from which on its drag grows no more.
CLOSEST = 0.1


def constant(dim: int) -> float:
    """K, of unit integral."""
    return {2: 7 / np.pi, 3: 21 / (2 * np.pi)}[dim]


def kernel(dim: int, r: np.ndarray | float) -> np.ndarray:
    """W at distances r [...]."""
    r = np.minimum(r, 1.0)
    return constant(dim) * (1 - r) ** 4 * (1 + 4 * r)


def slope(dim: int, r: np.ndarray) -> np.ndarray:
    """-W'(r) / r = 20 K (1 - r)^3 at distances r [...]; the gradient is -r times it."""
    return 20 * constant(dim) * (1 - np.minimum(r, 1.0)) ** 3


def _lattice(dim: int, spacing: float) -> np.ndarray:
    """Distances from a point of a cubic lattice to those within reach, itself included."""
    reach = int(1 / spacing) + 1
    axes = np.meshgrid(*[np.arange(-reach, reach + 1) * spacing] * dim, indexing="ij")
    r = np.sqrt(sum(axis**2 for axis in axes))
    return r[r < 1]


def lattice_scale(dim: int, spacing: float) -> float:
    """What the kernel is multiplied by, so that a cubic lattice of this spacing [support radii] has density 1 exactly: 1 / sum_j V W."""
    return float(1 / (spacing**dim * kernel(dim, _lattice(dim, spacing)).sum()))


def lattice_slope(dim: int, spacing: float) -> float:
    """What ``slope`` is multiplied by beyond ``lattice_scale``, so that on a cubic lattice the gradient of a linear function is exact: sum_j V q x^2
    is 1 then. Without, a kernel of two spacings finds 94 % of a gradient, and water at rest needs 106 % of its pressure."""
    r = _lattice(dim, spacing)
    return float(dim / (spacing**dim * lattice_scale(dim, spacing) * slope(dim, r) * r**2).sum())


def _neighbours(dim: int, spacing: float) -> np.ndarray:
    """[n, dim]: differences from a point of a cubic lattice to the others within reach."""
    reach = int(1 / spacing) + 1
    axes = np.meshgrid(*[np.arange(-reach, reach + 1) * spacing] * dim, indexing="ij")
    r = np.stack([axis.ravel() for axis in axes], 1)
    length = np.linalg.norm(r, axis=1)
    return r[(length > 0) & (length < 1)]


def _waves(dim: int, spacing: float) -> np.ndarray:
    """[n, dim]: wave vectors of a lattice."""
    return np.stack([axis.ravel() for axis in np.meshgrid(*[np.linspace(0, np.pi / spacing, 13)] * dim, indexing="ij")], 1)


def lattice_shift(dim: int, spacing: float) -> float:
    """A by which a particle of a lattice may be moved at most, -A sum_j V grad W, lest what is uneven grows: 0.9 over the largest eigenvalue of
    -sum_j V (1 - cos k . r_j) grad grad W over all waves k. (Twice its inverse is the limit of stability.)"""
    r = _neighbours(dim, spacing)
    length = np.linalg.norm(r, axis=1)
    across, bend = slope(dim, length), 60 * constant(dim) * length * (1 - length) ** 2
    hessian = bend[:, None, None] * r[:, :, None] * r[:, None, :] / (length**2)[:, None, None] - across[:, None, None] * np.eye(dim)
    sums = np.einsum("kn,nij->kij", 1 - np.cos(_waves(dim, spacing) @ r.T), hessian) * lattice_scale(dim, spacing) * spacing**dim
    return float(0.9 / np.linalg.eigvalsh(sums).max())


def lattice_relaxation(dim: int, spacing: float) -> float:
    """Inverse of the largest eigenvalue on a lattice of A / D, by which displacements -sum_j (k_i + k_j) grad W_ij change densities, D its diagonal:
    the step of a gradient method for k. Waves in k displace by the sines of k . r_j."""
    r = _neighbours(dim, spacing)
    gradient = slope(dim, np.linalg.norm(r, axis=1))[:, None] * r
    return float((gradient**2).sum() / ((np.sin(_waves(dim, spacing) @ r.T) @ gradient) ** 2).sum(1).max())


def _stretch(dim: int, spacing: float, s: np.ndarray) -> np.ndarray:
    """c at distances s [...] to a wall, so that with gradients of pairs times 1 + (c_i + c_j) / 2 along the wall that of a function which is linear
    along it is exact in every row of a lattice; linear between the rows."""
    r = _neighbours(dim, spacing)
    weight = slope(dim, np.linalg.norm(r, axis=1)) * r[:, 1] ** 2
    row, reach = np.rint(r[:, 0] / spacing).astype(int), int(1 / spacing) + 1
    share = np.bincount(row + reach, weight / weight.sum(), 2 * reach + 1)
    rows = np.arange(reach + 1)
    pairs = np.array([[share[j - i + reach] if abs(j - i) <= reach else 0.0 for j in rows] for i in rows])
    lost = np.array([share[: reach - i].sum() for i in rows])
    c = np.linalg.solve(pairs / 2 + np.diag(1 - lost) / 2, lost)
    return np.interp(s, (rows + 0.5) * spacing, c)


#: Columns of ``wall_table``.
SHARE, SLOPE, NORMAL, TANGENT, DRAG, SPREAD, STRETCH = range(7)


def viscous_weight(r: np.ndarray) -> np.ndarray:
    """f(r) = (1 - r)^(3/2) at distances r [...], by which viscosity weighs a pair, in place of the |W'| / r of Monaghan (2005, eq. 8.11).

    Any weight gives nu times the Laplacian if particles are many. Of few on a lattice |W'| / r is too steep: with a support of two
    spacings it makes shear along the lattice 0.54 and at 45 degrees 1.34 times as viscous as asked for; this one 0.97 and 1.03 (2.5
    spacings: 0.77 and 1.14; 0.95 and 1.05)."""
    return (1 - np.minimum(r, 1.0)) ** 1.5


def viscous_scale(dim: int, spacing: float) -> float:
    """A in du_i / dt = -nu A sum_j f (u_ij . r_ij) r_ij / r^2 on a lattice of this spacing, mean over its orientations:
    2 dim (dim + 2) / sum_j f r^2, for the mean of x^2 y^2 over a sphere is r^4 / (dim (dim + 2))."""
    r = _lattice(dim, spacing)
    return float(2 * dim * (dim + 2) / (viscous_weight(r) * r**2).sum())


def wall_table(dim: int, spacing: float) -> np.ndarray:
    """[ENTRIES + 1, 7] float64 over the distance s = 0 .. 1 to a wall: sums over the layers of fluid that stand for it, the planes at
    z = s + spacing / 2, s + 3 spacing / 2, ... behind the particle's own (t: along the wall; q = -W' / r; the kernel is scaled by ``lattice_scale``):

    SHARE G = sum W; SLOPE G'; NORMAL sum q z^2 and TANGENT sum q t^2 (of one axis), first moments of the gradient, which over all space are 1; DRAG
    A sum f (t / r)^2 z, what viscosity takes from a particle by a wall whose velocity continues the fluid's linearly (Takeda et al.
    1994), times s over its velocity; SPREAD sum q r^2, the wall's part in the divergence of position; STRETCH: see ``_stretch``.
    """
    s = np.linspace(0, 1, ENTRIES + 1)[:, None, None]
    z = np.minimum(s + spacing * (np.arange(int(1 / spacing) + 1) + 0.5)[:, None], 1.0)
    # Gauss-Legendre along the wall.
    nodes, weights = np.polynomial.legendre.leggauss(24)
    edge = np.sqrt(1 - z**2)
    t = edge * (nodes + 1) / 2
    area = spacing * edge * weights / 2 * (2.0 if dim == 2 else 2 * np.pi * t)
    r = np.hypot(z, t)
    scale = lattice_scale(dim, spacing)
    q, along = scale * slope(dim, r), t**2 / (dim - 1)
    drag = viscous_scale(dim, spacing) / spacing**dim * viscous_weight(r) * along * z / np.maximum(r, 1e-30) ** 2
    sums = (scale * kernel(dim, r), -q * z, q * z**2, q * along, drag, q * r**2)
    columns = [(f * area).sum((1, 2)) for f in sums]
    return np.stack([*columns, _stretch(dim, spacing, s.ravel())], 1)
