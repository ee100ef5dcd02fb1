"""Two elastic discs collide (Sulsky et al. 1994, sec. 4.2): contact at t = 1.586, momentum kept, total energy never grows."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, scene, timed

#: Cells along a unit of length.
RESOLUTIONS = (20, 40, 80)
RADIUS, CENTERS, SPEED = 0.2, ((0.2, 0.2), (0.8, 0.8)), 0.1
END, FRAMES = 3.2, 320


def run(resolution: int) -> Outcome:
    """Discs meet when their surfaces do; on a grid they feel each other about a cell earlier, hence the contact's tolerance: one cell's way.

    Contact is when a disc has lost a hundredth of its momentum. Errors: lead over the exact contact, in cells; largest momentum of
    the pair over the sum of |m v|; largest rise of the total energy over any earlier low, over the initial one. The elastic energy
    that the solver reports is a step older than the kinetic one, so the sum is off by dt times the power: hence the small steps.
    """
    margin = 0.1
    cells = [round((1 + 2 * margin) * resolution)] * 2
    bodies = [{"kind": "ball", "center": center, "radius": RADIUS, "velocity": [sign * SPEED] * 2}
              for center, sign in zip(CENTERS, (1, -1), strict=True)]
    what = scene("elastic-discs", {"model": "elastic", "density": 1000.0, "young_modulus": 1000.0, "poisson_ratio": 0.3}, bodies,
                 [[-margin, 1 + margin]] * 2, cells, END / FRAMES, cfl=0.05)  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    first = what.particles().velocity[:, 0] > 0

    def observe(_):
        v, found = solver.state()["velocity"], solver.diagnostics()
        return v[first].mean(), v.sum(0), found["kinetic_energy"] + found["elastic_energy"]

    start = solver.diagnostics()["kinetic_energy"]
    found, seconds = timed(solver.frame, FRAMES, observe)
    speed, momentum, energy = (np.array(series) for series in zip(*found, strict=True))
    t = what.frame_step * np.arange(1, FRAMES + 1)
    gap, closing = np.linalg.norm(np.subtract(*CENTERS)) - 2 * RADIUS, 2 * np.sqrt(2) * SPEED
    exact = gap / closing
    contact = float(t[np.argmax(speed < 0.99 * SPEED)])
    energy = np.concatenate([[start], energy])
    rise = float((energy - np.minimum.accumulate(energy)).max() / start)
    total = np.abs(momentum).max(1) / (len(first) * SPEED)
    lead = (exact - contact) * closing * resolution
    curves = {
        "contact": Curve(f"contact at {contact:.3f}, exact {exact:.3f}: cells too early", ("time [s]", "velocity of a disc along x [m/s]"), t,
                         np.where(t < exact, SPEED, np.nan), speed, float(lead), 1.5),
        "momentum": Curve("momentum / sum |m v|", ("time [s]", "momentum / sum |m v|"), t, np.zeros_like(t), total, float(total.max()), 1e-6),
        "energy": Curve("rise of the energy / initial energy", ("time [s]", "energy / initial energy"), np.concatenate([[0.0], t]),
                        np.ones(len(t) + 1), energy / start, rise, 1e-3),
    }  # fmt: skip
    return Outcome("elastic_discs", resolution, len(first), curves, seconds)
