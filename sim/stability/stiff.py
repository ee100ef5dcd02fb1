"""Young's modulus times a million: a spinning block flies as it did, at a cost that grows with the root; or the cost is refused beforehand."""

import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from sim.stability import Cell
from sim.stability.command_line import command
from sim.stability.driver import ROUGH, follow
from sim.stability.refusal import FAMILY
from sim.validation import scene

FACTORS = (1.0, 1e2, 1e4, 1e6)
E, NU, RHO, OMEGA, CELLS, DURATION, FRAMES = 1e6, 0.3, 1000.0, 10.0, 16, 0.1, 10
EXPECTED = "the same answer at a cost that grows as the root"
#: Stretch of the softest block, rho (w R)^2 / E at its corners, R its half diagonal: answers may differ by that much of R.
RADIUS = 0.125 * np.sqrt(2)
EPS = float(np.finfo(np.float32).eps)
TOLERANCE = RHO * (OMEGA * RADIUS) ** 2 / E * RADIUS


def run() -> list[Cell]:
    """A tenth of a second at 10 rad/s, thrown up at 0.5 m/s; compared with the exact motion of a rigid block.

    The start has no affine velocities, so the first transfer spreads its angular momentum over them as well: a particle's moment of inertia
    on the grid is r^2 + dx^2 / 2 (Jiang et al. 2015), and the block turns at w sum r^2 / sum (r^2 + dx^2 / 2).
    """
    cells, first = [], None
    for factor in FACTORS:
        begun = time.perf_counter()
        material = {"model": "elastic", "density": RHO, "young_modulus": E * factor, "poisson_ratio": NU}
        body = {"kind": "box", "lower": [0.375, 0.375], "upper": [0.625, 0.625]}
        what = scene("stiff", material, [body], [[0.0, 1.0]] * 2, [CELLS] * 2, DURATION / FRAMES, gravity=[0.0, -9.8], walls=ROUGH)
        x = what.particles().position - 0.5

        def spin(solver, x=x) -> None:
            solver.set_velocity(OMEGA * np.stack([-x[:, 1], x[:, 0]], 1) + [0.0, 0.5])

        run = follow(what, FRAMES, spin)
        inertia = (x**2).sum()
        steps, angle = float(run.substeps.sum()), OMEGA * DURATION * inertia / (inertia + len(x) / CELLS**2 / 2)
        first = first or steps
        turned = x @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        exact = turned + 0.5 + [0.0, 0.5 * DURATION - 9.8 / 2 * DURATION**2]
        error = float(np.abs(run.position - exact).max()) if run.ok else np.inf
        cost = steps / first / np.sqrt(factor)
        # Each step rounds every velocity to eps, for a body that turns always with the same sign.
        tolerance = TOLERANCE + steps * EPS * angle * RADIUS
        right = run.ok and error <= tolerance and 0.5 <= cost <= 1.1
        observed = f"{steps:.0f} steps, at most {error:.2g} m from a rigid block" if run.ok else run.status
        numbers = {"factor": factor, "steps": steps, "steps_over_root": cost, "error": error, "tolerance": tolerance}
        curve = {f"E x {factor:g}": run.energy_curve(run.energy[0])} if run.ok else {}
        cells.append(Cell("stiff", f"E x {factor:g}", right, EXPECTED, observed, numbers, time.perf_counter() - begun, curve))
    return [*cells, _budget()]


def _budget() -> Cell:
    """A scene a million times stiffer than it should be is refused with the estimate."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        path, out = Path(place) / "stiff.yaml", Path(place) / "out"
        material = {"model": "elastic", "young_modulus": 1e6 * E, "density": RHO}
        changes = {"materials": {"stuff": material}, "frames": 1000, "splits": {"train": 10000, "valid": 0, "test": 0}}
        path.write_text(yaml.safe_dump(FAMILY | changes))
        code, said = command("generate", path, "--out", out)
        right = code == 2 and said.count("\n") == 1 and "substeps" in said and "hours" in said and not out.exists()
        said = said.strip().replace(str(path), "stiff.yaml")
    return Cell("stiff", "E x 1e6, ten thousand trajectories", right, "refused with the estimated number of steps", f"exit {code}",
                {"said": said}, time.perf_counter() - begun)  # fmt: skip
