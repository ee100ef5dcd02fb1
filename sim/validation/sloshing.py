"""Sloshing: ten seconds after a dam broke, incompressible SPH has its volume, and its density stayed what it is at rest."""

import numpy as np
from scipy.spatial import cKDTree

from sim.scene import Incompressible
from sim.sph.kernel import kernel, lattice_scale, wall_table
from sim.sph.solver import SPHSimulator
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 12
METHODS = ("dfsph",)
#: Particles along the column of water, which is as high as wide and a third of the tank's width.
RESOLUTIONS = (20, 40, 80)
L, G, SECONDS = 0.4, 9.81, 10.0


def run(resolution: int, method: str) -> Outcome:
    """A column of water, 0.4 by 0.4, in a tank 1.2 wide and 1 high, by DFSPH at its default tolerances.

    volume: where the kernels of particles and walls sum up to more than 1/2, sampled at a quarter of the spacing once a second. Particles at the
    surface lack neighbours above, and settle about a sixth of a spacing closer to those below than in the lattice that they start from: a loss
    of first order, over the 7, 13 or 27 layers of the pool. density: of the places where particles are, not as a solve predicts
    it: mean excess over that at rest, in every frame. That solves end below their tolerance is no result: one that does not ends the run.
    """
    what = scene(
        "sloshing", {"model": "water"}, [{"kind": "box", "lower": [0.0, 0.0], "upper": [L, L]}], [[0.0, 3 * L], [0.0, 1.0]],
        [3 * resolution, round(1.0 / L * resolution)], 0.01, gravity=[0.0, -G], particles_per_cell=1, solver={"method": method},
    )  # fmt: skip
    assert isinstance(what.solver, Incompressible)
    solver = SPHSimulator()
    solver.load(what)
    found, seconds = timed(
        solver.frame, round(SECONDS / what.frame_step), lambda x: (x.astype(float), np.maximum(solver.state()["density"] - 1, 0).mean())
    )
    frames = np.arange(0, len(found), 100) + 99
    volume = np.array([water_area(found[frame][0], what) for frame in frames]) / L**2
    excess = np.array([each for _, each in found])
    t = (np.arange(len(found)) + 1) * what.frame_step
    curves = {
        "volume": Curve("loss of volume after ten seconds, relative", ("t [s]", "volume / start"), t[frames], np.ones(len(frames)), volume,
                        float(1 - volume[-1]), 0.01),
        "density": Curve("largest mean excess of density in a frame, relative", ("t [s]", "mean excess of density"), t, np.zeros(len(t)), excess,
                         float(excess.max()), what.solver.density_error),
    }  # fmt: skip
    return Outcome("sloshing", resolution, len(what.particles().position), curves, seconds)


def water_area(position: np.ndarray, what) -> float:
    """Area of a 2D box where the kernels of the particles and the share of the walls sum up to more than 1/2."""
    spacing, support = what.spacing, what.spacing * what.solver.support
    lower, upper = np.array(what.bounds).T
    counts = np.rint((upper - lower) / spacing * 4).astype(int)
    index = np.stack(np.meshgrid(*[np.arange(count) for count in counts], indexing="ij"), -1).reshape(-1, 2)
    points = lower + (index + 0.5) * spacing / 4
    table = wall_table(2, spacing / support)[:, 0]
    to_walls = np.concatenate([points - lower, upper - points], 1) / support
    fluid = np.prod(1 - np.interp(to_walls, np.linspace(0, 1, len(table)), table, right=0.0), 1)
    scale = lattice_scale(2, spacing / support) * (spacing / support) ** 2
    pairs = cKDTree(points).sparse_distance_matrix(cKDTree(position), support, output_type="coo_matrix")
    near = kernel(2, pairs.data / support) * scale
    share = np.bincount(pairs.row, near, len(points)) + 1 - fluid
    return float((share > 0.5).sum() * (spacing / 4) ** 2)
