"""Hydrostatics: the pressure p = rho g (H - y) under water at rest."""

from dataclasses import replace

import numpy as np

from sim.solvers import solver_class
from sim.validation import Curve, Outcome, l2, scene, timed

NUMBER = 3
METHODS = ("mpm", "wcsph", "dfsph", "pbf")
#: Cells along the box; the water is half as deep.
RESOLUTIONS = (16, 32, 64)
H, C, RHO, G = 0.5, 40.0, 1000.0, 9.8
OFFSETS = (0.25, 0.5, 0.75)


def run(resolution: int, method: str) -> Outcome:
    """Water over the full width of a unit box. It starts at reference density and rings at 4 H / c, ten frames: means over ten periods after
    the first ten, of the particles of a layer of cells, as MPM's forces come from the grid. The same on the plane surface of an obstacle, which
    lies a quarter, half and three quarters of a cell above a line of nodes: the worst of the three. DFSPH has no c and does not ring, but its
    particles never come to rest; it gets the same time. The position-based solver has neither: its surface and rest alone, as its multipliers are
    no measure of pressure and it knows no obstacles."""
    solver = solver_class(method)()
    curves, seconds, particles = _pool(resolution, method, solver)
    if method == "pbf":
        del curves["pressure"]
        return Outcome("hydrostatics", resolution, particles, curves, seconds)
    worst = max((_pool(resolution, method, solver, offset) for offset in OFFSETS), key=lambda found: found[0]["pressure"].error)
    curves["over an obstacle"] = replace(worst[0]["pressure"], label="relative L2 error of the pressure over an obstacle")
    return Outcome("hydrostatics", resolution, particles, curves, seconds + 3 * worst[1])


def _pool(resolution: int, method: str, solver, offset: float | None = None) -> tuple[dict[str, Curve], float, int]:
    """Curves, seconds and particles, on the box's floor or on an obstacle's surface ``offset`` cells above a line of nodes."""
    floor = 0.0 if offset is None else (3 + offset) / resolution
    what = scene(
        "hydrostatics", {"model": "water", "sound_speed": C, "density": RHO},
        [{"kind": "box", "lower": [0.0, floor], "upper": [1.0, floor + H]}], [[0.0, 1.0], [0.0, 1.0]], [resolution] * 2, 4 * H / C / 10,
        gravity=[0.0, -G], obstacles=[] if offset is None else [{"kind": "halfspace", "point": [0.5, floor], "normal": [0.0, 1.0]}],
        solver={"method": method},
    )  # fmt: skip
    solver.load(what)

    def observe(_):
        state = solver.state()
        if method == "mpm":
            pressure = RHO * C**2 / 7 * (state["stuff.J"] ** -7 - 1)
        else:
            pressure = np.full(len(state["density"]), np.nan) if method == "pbf" else state["pressure"]
        return pressure, state["position"][:, 1] - floor, solver.diagnostics()["kinetic_energy"]

    found, seconds = timed(solver.frame, 200, observe)
    pressure, level, kinetic = (np.mean(series[100:], 0) for series in zip(*found, strict=True))
    row = np.round((what.particles().position[:, 1] - floor) / what.spacing - 0.5).astype(int)
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
    return curves, seconds, len(row)
