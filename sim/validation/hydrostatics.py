"""Hydrostatics: the pressure p = rho g (H - y) under water at rest."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, l2, scene, timed

NUMBER = 3
#: Cells along the box; the water is half as deep.
RESOLUTIONS = (16, 32, 64)
H, C, RHO, G = 0.5, 40.0, 1000.0, 9.8


def run(resolution: int) -> Outcome:
    """Water over the full width of a unit box. It starts at reference density and rings at 4 H / c, ten frames: means over ten periods after
    the first ten, of the particles of a layer of cells, as forces come from the grid."""
    what = scene(
        "hydrostatics", {"model": "water", "sound_speed": C, "density": RHO}, [{"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, H]}],
        [[0.0, 1.0], [0.0, 1.0]], [resolution] * 2, 4 * H / C / 10, gravity=[0.0, -G],
    )  # fmt: skip
    solver = MPMSimulator()
    solver.load(what)

    def observe(_):
        state = solver.state()
        return RHO * C**2 / 7 * (state["stuff.J"] ** -7 - 1), state["position"][:, 1], solver.diagnostics()["kinetic_energy"]

    found, seconds = timed(solver.frame, 200, observe)
    pressure, level, kinetic = (np.mean(series[100:], 0) for series in zip(*found, strict=True))
    row = np.round(what.particles().position[:, 1] / what.spacing - 0.5).astype(int)
    p, y = (np.bincount(row // 2, values) / np.bincount(row // 2) for values in (pressure, level))
    exact, unit = RHO * G * (H - y), RHO * G * H
    loss = float(1 - (level[row == row.max()].mean() + what.spacing / 2) / H)
    still = float(kinetic / (unit * H))
    curves = {
        "pressure": Curve("relative L2 error of the pressure", ("height / H", "p / rho g H"), y / H, exact / unit, p / unit, l2(p, exact), 0.03),
        "surface": Curve("loss of the surface's height, relative", ("height / H at the start", "height / H"), np.array([0.0, 1.0]),
                         np.array([0.0, 1.0]), np.array([0.0, 1.0 - loss]), loss, 0.02),
        "rest": Curve("kinetic energy / rho g H V", ("", "kinetic energy / rho g H V"), np.array([0.0, 1.0]), np.zeros(2),
                      np.full(2, still), still, 1e-3),
    }  # fmt: skip
    return Outcome("hydrostatics", resolution, len(row), curves, seconds)
