"""DFSPH cut short: one iteration a solve, or viscosity beyond its iterations; what does not converge is said, never silent."""

import time

import numpy as np

from sim.stability import BOUND, Cell
from sim.stability.driver import deep, follow, noise
from sim.validation import scene

CELLS, G, FRAMES = 16, 9.8, 60
ERROR = 5e-4
#: Kinematic viscosities [m^2 / s], up to nu dt / h^2 of 1e6 at steps of a frame.
VISCOSITY = (1e-2, 1.0, 1e2, 1e4)


def run() -> list[Cell]:
    """A column collapses with one iteration a solve, at a fixed step and at steps as short as it takes; thick blocks fly and are stirred."""
    return [_column(dim, step) for dim in (2, 3) for step in (0.0025, None)] + [_thick(nu) for nu in VISCOSITY]


def _column(dim: int, step: float | None) -> Cell:
    begun = time.perf_counter()
    cell = f"one iteration, {'fixed' if step else 'adaptive'} steps{', 3D' if dim == 3 else ''}"
    body = {"kind": "box", "lower": [0.0, 0.0], "upper": [0.5, 0.5]}
    what = scene("unsolved", {"model": "water"}, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 0.005, gravity=[0.0, -G],
                 solver={"method": "dfsph", "iterations": 1, "density_error": ERROR}, **({"time_step": step} if step else {}))  # fmt: skip
    if dim == 3:
        what = deep(what, 0.0, 0.5)
    worst = []
    run = follow(what, FRAMES, observe=lambda solver: worst.append(_error(solver)))
    said = "pressures did not converge in 1 iterations" in run.status
    if step:
        right, expected = said, "failed for pressures that did not converge, since the step must not be shortened"
    else:
        # Shorter steps ask less of each: a frame that passes has to be as good as any.
        right, expected = said or (run.ok and max(worst) <= 10 * ERROR), "failed for pressures that did not converge, or density as it should be"
    observed = f"mean density error at most {max(worst):.2g} by the particles' places" if run.ok else run.status
    numbers: dict[str, float | str | None] = {"frames": len(run.time), "density_error": max(worst, default=np.nan), "status": run.status}
    return Cell("unsolved", cell, right, expected, observed, numbers, time.perf_counter() - begun)


def _error(solver) -> float:
    """Mean excess of the density over that at rest at the start of a frame's last step."""
    return float(np.maximum(solver.state()["density"] - 1, 0).mean())


def _thick(nu: float) -> Cell:
    begun = time.perf_counter()
    body = {"kind": "box", "lower": [0.3125, 0.3125], "upper": [0.6875, 0.6875]}
    what = scene("unsolved", {"model": "water", "viscosity": 1000.0 * nu}, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, 0.1,
                 solver={"method": "dfsph"})  # fmt: skip
    run = follow(what, FRAMES, noise(0.1))
    explicit = (1 / CELLS / 2) ** 2 / 16 / nu
    grew = run.growth(run.energy[0])
    right = (run.ok and grew <= BOUND - 1) or "did not converge" in run.status
    longest = float(run.dt.max(initial=0.0))
    observed = f"dt up to {longest:.2g} s, {longest / explicit:.2g} times what explicit viscosity bears; energy at most {1 + grew:.3g} of the start's"
    numbers = {"viscosity": nu, "largest_dt": longest, "energy_growth": grew}
    return Cell("unsolved", f"nu {nu:g} m2/s", right, "stable at any step, or failed for not converging", observed if run.ok else run.status, numbers,
                time.perf_counter() - begun, {f"nu {nu:g} m2/s": run.energy_curve(run.energy[0])})  # fmt: skip
