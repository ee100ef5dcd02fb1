"""Taylor-Green vortices: in a periodic box their kinetic energy decays as exp(-16 pi^2 t / Re)."""

import numpy as np
from scipy.spatial import cKDTree

from sim.scene import WeaklyCompressible
from sim.solvers import solver_class
from sim.sph.kernel import kernel, lattice_scale
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 7
METHODS = ("wcsph", "dfsph")
#: Particles along the box.
RESOLUTIONS = (30, 50, 100)
RE, C, END, FRAMES = 100, 10.0, 1.0, 50


def run(resolution: int, method: str) -> Outcome:
    """A box and a speed of 1, c = 10: u = -cos(2 pi x) sin(2 pi y), v = sin(2 pi x) cos(2 pi y). Viscosity decides the decay, so there is
    none else: no artificial one, no XSPH. The rate is that of a line through the logarithm of the energy, until it is down to a fifth.

    A support of 3.5 spacings and a lattice jittered by 0.3 of one. A plain lattice shears as a crystal does until it breaks up in a burst
    of sound that takes a tenth of the energy (50 particles: 13 % too fast); jittered, the decay is 2.3 % too slow with 2.5 spacings, 1.8 % too fast
    with 3, 0.5 % too slow with 3.5.
    DFSPH starts from the same; its steps are as long as the lattice bears, and its error of first order in them.
    """
    settings = {"support": 3.5} | ({"artificial_viscosity": 0.0} if method == "wcsph" else {"xsph": 0.0})
    what = scene(
        "taylor-green", {"model": "water", "sound_speed": C, "density": 1.0, "viscosity": 1 / RE},
        [{"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}], [[0.0, 1.0]] * 2, [resolution // 2] * 2, END / FRAMES,
        jitter=0.3, periodic=["x", "y"], solver={"method": method} | settings,
    )  # fmt: skip
    solver = solver_class(method)()
    solver.load(what)
    x, y = 2 * np.pi * what.particles().position.T
    velocity = np.stack([-np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)], 1)
    if method == "wcsph":
        # Shifting evens the lattice out and takes what the sum over the kernel loses by it from the density, which is to end at one.
        assert isinstance(what.solver, WeaklyCompressible)
        support, tree = what.solver.support * what.spacing, cKDTree(what.particles().position, boxsize=1.0)
        near = tree.sparse_distance_matrix(tree, support, output_type="coo_matrix").data / support
        uneven = kernel(2, near).sum() * lattice_scale(2, 1 / what.solver.support) / what.solver.support**2 / len(x)
        solver.inject("density", np.arange(len(x)), uneven)
    solver.set_velocity(velocity)
    energy, seconds = timed(solver.frame, FRAMES, lambda _: solver.diagnostics()["kinetic_energy"])
    ours, t = np.array(energy) / ((velocity**2).sum() / 2 * what.spacing**2), what.frame_step * np.arange(1, FRAMES + 1)
    rate = -16 * np.pi**2 / RE
    found = float(np.polyfit(t, np.log(ours), 1)[0])
    curve = Curve(f"rate of decay {found:.3f}, exact {rate:.3f}", ("time", "kinetic energy / that of the start"), t, np.exp(rate * t), ours,
                  found / rate - 1, 0.05)  # fmt: skip
    return Outcome("taylor_green", resolution, len(x), {"decay": curve}, seconds)
