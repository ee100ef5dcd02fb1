"""Granular collapse: columns of sand run out as a (a < 2) and as a^(2/3) (a > 3), a = H0 / L0 (Lajeunesse et al. 2005; Lube et al. 2005)."""

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 13
#: Cells along the half-width L0 of tall columns; three times as many along the height H0 of low ones.
RESOLUTIONS = (3, 4, 6)
L0, PHI, RHO, G = 0.1, 30.0, 1800.0, 9.8
LOW, TALL = np.array([0.75, 1.0, 1.5, 2.0]), np.array([4.0, 6.0, 9.0, 14.0])
ANGLES = np.array([20.0, 30.0, 40.0])
#: Young's modulus over rho g H0, frames a unit of time sqrt(H0 / g), and units until all columns lie still.
STIFFNESS, FRAMES, UNITS = 50.0, 10, 5


def collapse(solver: MPMSimulator, resolution: int, aspect: float, friction_angle: float) -> dict:
    """Final heap of a free column on a rough floor: ``runout`` (R - L0) / L0, ``height`` / L0 and slope [degrees] of its ``flank``; ``particles``,
    wall ``seconds``.

    R: 99 % of the sand lie within; single grains roll on. Height: of the highest grain within L0 / 2 of the middle. Flank: a line through the
    highest grains of the cells' columns where those are between a fifth and four fifths of it. The box has as many cells for every column, all
    that the tallest needs: one grid, one compilation.
    """
    dx, unit = L0 / (resolution if aspect > 3 else 3 * resolution / aspect), np.sqrt(aspect * L0 / G)
    half, up = int(np.ceil((1.5 + 2.5 * TALL.max()) * resolution)), int(TALL.max() * resolution) + 3
    what = scene(
        "granular-collapse", {"model": "sand", "density": RHO, "young_modulus": STIFFNESS * RHO * G * aspect * L0, "friction_angle": friction_angle},
        [{"kind": "box", "lower": [-L0, 0.0], "upper": [L0, aspect * L0]}], [[-half * dx, half * dx], [0.0, up * dx]], [2 * half, up],
        float(unit / FRAMES), gravity=[0.0, -G], walls={"friction": "sticky"},
    )  # fmt: skip
    solver.load(what)
    found, seconds = timed(solver.frame, FRAMES * UNITS, lambda position: position)
    x, y = np.abs(found[-1][:, 0].astype(float)), found[-1][:, 1].astype(float)
    front, level, middle = np.quantile(x, 0.99), np.zeros(half + 1), (np.arange(half + 1) + 0.5) * dx
    np.maximum.at(level, (x / dx).astype(int), y + what.spacing / 2)
    height = level[middle < max(L0 / 2, dx)].max()
    on = (middle < front) & (level > 0.2 * height) & (level < 0.8 * height)
    return {"runout": front / L0 - 1, "height": height / L0, "flank": np.degrees(np.arctan(-np.polyfit(middle[on], level[on], 1)[0])),
            "particles": len(x), "seconds": seconds}  # fmt: skip


def power_law(name: str, what: str, aspects: np.ndarray, ours: np.ndarray, power: float) -> Curve:
    """Exponents by least squares in the logarithms; the law's constant, which depends on the grains, is fitted."""
    log_a, log_u = np.log(aspects), np.log(ours)
    slope = float(np.polyfit(log_a, log_u, 1)[0])
    law = np.exp(power * log_a + (log_u - power * log_a).mean())
    return Curve(f"exponent of {name} {slope:.2f}, law {power:.2f}", ("a = H0 / L0", what), aspects, law, ours, slope - power, 0.1)


def run(resolution: int) -> Outcome:
    """Run-outs and heights over a, run-out and slope over the friction angle.

    As long as a plateau stands, a column knows no length but H0, and its run-out is a multiple of it: low columns are resolved along H0, so that
    those of 1.5 and 2, without a plateau, are what is compared. Resolved along L0, as tall ones are, they would be a few cells high, and thin
    layers are held by the floor's nodes.

    What keeps the sand short of its run-out is what the transfers dissipate in every substep, as a viscosity of about dx^2 / dt = dx c would. At
    a = 1 and E = 300 rho g H0, 24 cells high, run-outs of 99 % of the sand were 1.17, 1.30 and 1.36 L0 for Courant numbers 0.25, 0.5 and 0.9;
    0.89 and 1.16 L0 with 12 and 24 cells at E = 1000, 1.33 with 24 at E = 100. So E, too, is in units of rho g H0, and low.

    Of tall columns the law is not what a continuum of constant friction is known to do: without collisions to dissipate the fall it runs out in
    proportion to a for longer than grains do (Kumar 2015, ch. 4: MPM and discrete elements side by side), as it does here. Finer grids bring
    the exponent down.
    """
    solver = MPMSimulator()
    # The largest first: the solver's fields then hold all others.
    tall, low = ([collapse(solver, resolution, a, PHI) for a in aspects[::-1]][::-1] for aspects in (TALL, LOW))
    angles = [collapse(solver, resolution, 2.0, phi) for phi in ANGLES]
    every = np.concatenate([LOW, TALL])
    fallen = every > 1.2

    def column(heaps, key):
        return np.array([heap[key] for heap in heaps])

    runout, flank = column(angles, "runout"), column(angles, "flank")
    curves = {
        "low columns": power_law("low columns", "(R - L0) / L0", LOW, column(low, "runout"), 1.0),
        "tall columns": power_law("tall columns", "(R - L0) / L0", TALL, column(tall, "runout"), 2 / 3),
        "height": power_law("the final height", "height / L0", every[fallen], column(low + tall, "height")[fallen], 2 / 5),
        "friction": Curve("largest growth of the run-out from one friction angle to the next, a = 2", ("friction angle [degrees]", "(R - L0) / L0"),
                          ANGLES, np.full(len(ANGLES), np.nan), runout, float(max(np.diff(runout).max(), 0)), 0.0),
        "slope": Curve("largest excess of a flank's slope over the friction angle [degrees], a = 2",
                       ("friction angle [degrees]", "slope [degrees]"), ANGLES, ANGLES, flank, float(max((flank - ANGLES).max(), 0)), 0.0),
    }  # fmt: skip
    heaps = low + tall + angles
    return Outcome("granular_collapse", resolution, int(column(heaps, "particles").max()), curves, float(column(heaps, "seconds").sum()))
