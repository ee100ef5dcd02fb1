"""Friction angles 0, 80 and 90 degrees: sand as a liquid, as a steep pile, as a mistake."""

import time

import numpy as np

from sim.errors import InputError
from sim.stability import Cell
from sim.stability.driver import follow, solver_for
from sim.validation import scene

CELLS, G, HALF, HEIGHT = 16, 9.8, 0.125, 0.375


def _collapse(angle: float) -> tuple[np.ndarray, float, float]:
    """Final positions, final kinetic energy over what the fall released, slope of the flanks [degrees] of a column after two seconds."""
    material = {"model": "sand", "young_modulus": 3.5e5, "friction_angle": angle}
    body = {"kind": "box", "lower": [1 - HALF, 0.0], "upper": [1 + HALF, HEIGHT]}
    what = scene("friction-angle", material, [body], [[0.0, 2.0], [0.0, 1.0]], [2 * CELLS, CELLS], 0.01, gravity=[0.0, -G],
                 walls={"friction": 0.7})  # fmt: skip
    run = follow(what, 200)
    if not run.ok:
        raise RuntimeError(run.status)
    found = solver_for(what).diagnostics()
    released = 1800.0 * 2 * HALF * HEIGHT * G * HEIGHT / 2
    x, dx = run.position, 1 / CELLS
    column = np.floor(x[:, 0] / dx).astype(int)
    at = np.unique(column)
    top = np.array([x[column == each, 1].max() for each in at])
    steepest = float(np.degrees(np.arctan(np.abs(np.diff(top) / (np.diff(at) * dx)).max(initial=0.0))))
    return x, found["kinetic_energy"] / released, steepest


def run() -> list[Cell]:
    """A column three times as high as its half width, on a rough floor."""
    cells, reach, height = [], {}, {}
    seconds = {}
    for angle in (0.0, 35.0, 80.0):
        begun = time.perf_counter()
        x, kinetic, steepest = _collapse(angle)
        reach[angle], height[angle] = float(np.quantile(np.abs(x[:, 0] - 1), 0.9)), float(np.quantile(x[:, 1], 0.98))
        seconds[angle] = (time.perf_counter() - begun, kinetic, steepest)
    level = 2 * HALF * HEIGHT / 2
    took, kinetic, _ = seconds[0.0]
    # Level: as deep as its volume over the whole floor, to a cell and a half.
    right = height[0.0] <= level + 1.5 / CELLS and reach[0.0] >= 0.75
    cells.append(Cell("friction_angle", "0 degrees", right, "levels out like a liquid",
                      f"{height[0.0]:.3g} m deep (level {level:.3g} m), reaches {reach[0.0]:.3g} m of 1 m each way",
                      {"height": height[0.0], "level": level, "reach": reach[0.0]}, took))  # fmt: skip
    took, kinetic, steepest = seconds[80.0]
    right = kinetic <= 1e-4 and steepest > 35 and height[80.0] > height[35.0] and reach[80.0] < reach[35.0]
    cells.append(Cell("friction_angle", "80 degrees", right, "a stable pile, steeper than sand of 35 degrees makes",
                      f"flanks up to {steepest:.0f} degrees, {height[80.0]:.3g} m high ({height[35.0]:.3g} m at 35 degrees)",
                      {"steepest": steepest, "height": height[80.0], "height_35": height[35.0], "kinetic_over_released": kinetic}, took))  # fmt: skip
    for angle in (90.0, 120.0):
        begun = time.perf_counter()
        try:
            _collapse(angle)
            said = "accepted"
        except InputError as error:
            said = str(error)
        right = f"materials.stuff.friction_angle = {angle}: must lie in 0 .. 89 degrees" in said
        cells.append(Cell("friction_angle", f"{angle:g} degrees", right, "refused in one line", said, {}, time.perf_counter() - begun))
    return cells
