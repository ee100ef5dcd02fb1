"""Two elastic discs: they collide (Sulsky et al. 1994, sec. 4.2); contact at t = 1.586, momentum kept, total energy never grows."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 15
#: Cells along a unit of length.
RESOLUTIONS = (20, 40, 80)
RADIUS, CENTERS, SPEED = 0.2, ((0.2, 0.2), (0.8, 0.8)), 0.1
RHO, E, NU, END = 1000.0, 1000.0, 0.3, 3.2


def run(resolution: int) -> Outcome:
    """Discs meet when their surfaces do; on a grid they feel each other about a cell earlier. Contact is when a disc has lost a hundredth
    of its momentum.

    Errors: lead over the exact contact, in cells; largest momentum of the pair over the sum of |m v|, held to a random walk of
    rounding errors, eps sqrt(steps); largest rise of the total energy over any earlier low, over the initial one. A frame is one
    step, because the elastic energy belongs to the positions before it: the mean with the next one is that of the velocities' instant.
    """
    margin, c = 0.1, np.sqrt(E * (1 - NU) / ((1 + NU) * (1 - 2 * NU)) / RHO)
    step = 0.25 / resolution / (c + SPEED)
    frames = round(END / step)
    cells = [round((1 + 2 * margin) * resolution)] * 2
    bodies = [
        {"kind": "ball", "center": center, "radius": RADIUS, "velocity": [sign * SPEED] * 2} for center, sign in zip(CENTERS, (1, -1), strict=True)
    ]
    what = scene("elastic-discs", {"model": "elastic", "density": RHO, "young_modulus": E, "poisson_ratio": NU}, bodies,
                 [[-margin, 1 + margin]] * 2, cells, step)  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)
    first = what.particles().velocity[:, 0] > 0

    def observe(_):
        v, found = solver.state()["velocity"], solver.diagnostics()
        return v[first].mean(), v.sum(0), found["kinetic_energy"], found["elastic_energy"], found["substeps"]

    start = solver.diagnostics()["kinetic_energy"]
    found, seconds = timed(solver.frame, frames, observe)
    speed, momentum, kinetic, elastic, substeps = (np.array(series) for series in zip(*found, strict=True))
    if substeps.max() > 1:
        raise RuntimeError(f"{substeps.max():.0f} substeps in a frame: energies are not of one instant")
    t = step * np.arange(1, frames + 1)
    gap, closing = np.linalg.norm(np.subtract(*CENTERS)) - 2 * RADIUS, 2 * np.sqrt(2) * SPEED
    exact = gap / closing
    contact = float(t[np.argmax(speed < 0.99 * SPEED)])
    energy = np.concatenate([[start], kinetic[:-1] + (elastic[:-1] + elastic[1:]) / 2])
    rise = float((energy - np.minimum.accumulate(energy)).max() / start)
    total = np.abs(momentum).max(1) / (len(first) * SPEED)
    lead = (exact - contact) * closing * resolution
    curves = {
        "contact": Curve(f"contact at {contact:.3f}, exact {exact:.3f}: cells too early", ("time [s]", "velocity of a disc along x [m/s]"), t,
                         np.where(t < exact, SPEED, np.nan), speed, float(lead), 1.5),
        "momentum": Curve("momentum / sum |m v|", ("time [s]", "momentum / sum |m v|"), t, np.zeros_like(t), total, float(total.max()),
                          float(np.finfo(np.float32).eps * np.sqrt(frames))),
        "energy": Curve("rise of the energy / initial energy", ("time [s]", "energy / initial energy"), np.concatenate([[0.0], t[:-1]]),
                        np.ones(frames), energy / start, rise, 1e-4),
    }  # fmt: skip
    return Outcome("elastic_discs", resolution, len(first), curves, seconds)
