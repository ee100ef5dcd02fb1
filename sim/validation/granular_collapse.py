"""Run-out and height of collapsing columns of sand."""

from __future__ import annotations

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation.case import Case, Clock, Result, box, scene

#: Half-width of the columns.
HALF = 0.1
LOW, HIGH = (0.5, 1.0, 1.5, 2.0), (4.0, 6.0, 9.0)


def collapse(solver: MPMSimulator, resolution: int, aspect: float, friction: float, clock: Clock) -> tuple[float, float]:
    """(R - L0) / L0 and H / L0 of the heap that a free column, H0 = aspect L0, leaves on a rough floor, after 12 sqrt(H0 / g) or 1.2 s.

    R: 99 % of the grains lie within (single grains roll on); H: the mean height of the highest grain over the two cells at the middle.
    """
    size = (2.8, 1.2)
    material = {"model": "sand", "young_modulus": 1e6, "friction_angle": friction}
    body = box([size[0] / 2 - HALF, 0.0], [size[0] / 2 + HALF, aspect * HALF])
    solver.load(scene(material, [body], round(size[0] / HALF * resolution), size, walls={"friction": "sticky"}, frame_step=0.01))
    frames = int(max(1.2, 12 * np.sqrt(aspect * HALF / 9.8)) / 0.01)
    *_, last = clock.frames(solver, frames)
    x = np.abs(last[:, 0] - size[0] / 2)
    return float(np.quantile(x, 0.99) / HALF - 1), float(last[x < solver.dx, 1].max() / HALF)


def run(resolution: int) -> Result:
    """Low columns run out as a, tall ones as a^(2/3); phi = 30 degrees."""
    clock, solver = Clock(), MPMSimulator()
    runout = {a: collapse(solver, resolution, a, 30.0, clock)[0] for a in (*LOW, *HIGH)}
    slopes = [float(np.polyfit(np.log(group), np.log([runout[a] for a in group]), 1)[0]) for group in (LOW, HIGH)]
    error = max(abs(slopes[0] - 1), abs(slopes[1] - 2 / 3))
    a, ours = np.array(list(runout)), np.array(list(runout.values()))
    # The laws have a constant each, which depends on the grains: fitted.
    law = np.concatenate([
        np.array(group) ** power * np.exp(np.mean(np.log([runout[each] for each in group]) - power * np.log(group)))
        for group, power in ((LOW, 1.0), (HIGH, 2 / 3))
    ])
    return Result(resolution, error, f"exponents {slopes[0]:.2f} (1), {slopes[1]:.2f} (0.67)", (a, ours), (a, law), clock.seconds)


CASE = Case(
    13, "granular_collapse", "Collapse of columns of sand", "run-out ~ a (a < 2), a^(2/3) (a > 3) (Lajeunesse et al. 2005; Lube et al. 2005)",
    "exponents, absolute (the worse)", 0.1, ("a = H0 / L0", "(R - L0) / L0"), (4, 6, 8), "cells along the half-width", run,
)
