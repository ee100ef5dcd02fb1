"""Granular collapse: columns of sand run out as a (a < 2) and as a^(2/3) (a > 3), a = H0 / L0 (Lajeunesse et al. 2005; Lube et al. 2005)."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 13
#: Cells along the half-width L0.
RESOLUTIONS = (4, 6, 8)
L0, PHI, FRAME_STEP, G = 0.1, 30.0, 0.01, 9.8
LOW, HIGH = np.array([0.75, 1.0, 1.5, 2.0]), np.array([4.0, 6.0, 9.0])


def collapse(solver: MPMSimulator, resolution: int, aspect: float, friction_angle: float) -> tuple[float, float]:
    """Run-out (R - L0) / L0 of a free column on a rough floor after 12 sqrt(H0 / g) or 1.2 s, and seconds of wall time.

    R: as far as columns of cells hold two grains or more without a gap; single grains roll on.
    """
    width, height = 2.8, 1.2
    what = scene(
        "granular-collapse", {"model": "sand", "young_modulus": 1e6, "friction_angle": friction_angle},
        [{"kind": "box", "lower": [-L0, 0.0], "upper": [L0, aspect * L0]}], [[-width / 2, width / 2], [0.0, height]],
        [round(width / L0 * resolution), round(height / L0 * resolution)], FRAME_STEP, gravity=[0.0, -G], walls={"friction": "sticky"},
    )  # fmt: skip
    solver.load(what)
    found, seconds = timed(solver.frame, round(max(1.2, 12 * np.sqrt(aspect * L0 / G)) / FRAME_STEP), lambda position: position)
    grains = np.bincount((np.abs(found[-1][:, 0]) / solver.dx).astype(int), minlength=1000)
    return float(np.argmax(grains < 4) * solver.dx / L0 - 1), seconds


def run(resolution: int) -> Outcome:
    """Exponents by least squares in log run-out over log a; the laws' constants, which depend on the grains, are fitted."""
    solver = MPMSimulator()
    aspects = np.concatenate([LOW, HIGH])
    runout, seconds = np.transpose([collapse(solver, resolution, a, PHI) for a in aspects])
    curves = {}
    for name, part, power in (("low", aspects < 3, 1.0), ("tall", aspects > 3, 2 / 3)):
        log_a, log_r = np.log(aspects[part]), np.log(np.maximum(runout[part], 1e-6))
        slope = float(np.polyfit(log_a, log_r, 1)[0])
        law = np.exp(power * log_a + (log_r - power * log_a).mean())
        curves[f"{name} columns"] = Curve(f"exponent of {name} columns {slope:.2f}, law {power:.2f}", ("a = H0 / L0", "(R - L0) / L0"), aspects[part],
                                          law, runout[part], slope - power, 0.1)  # fmt: skip
    return Outcome("granular_collapse", resolution, 8 * resolution**2 * int(aspects.max()), curves, float(seconds.sum()))
