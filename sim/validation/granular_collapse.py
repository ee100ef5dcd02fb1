"""Granular collapse: columns of sand run out as a (a < 2) and as a^(2/3) (a > 3), a = H0 / L0 (Lajeunesse et al. 2005; Lube et al. 2005)."""

import numpy as np

from sim.mpm.solver import WALL, MPMSimulator
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 13
#: Cells along the width L0 of tall columns; three times as many along the height H0 of low ones.
RESOLUTIONS = (4, 6, 10)
L0, PHI, RHO, G = 0.1, 30.0, 1800.0, 9.8
LOW, TALL = np.array([0.75, 1.0, 1.5, 2.0]), np.array([4.0, 7.0, 12.0, 20.0])
ANGLES = np.array([20.0, 30.0, 40.0])
#: Young's modulus over rho g H0, frames a unit of time sqrt(H0 / g), and units until all columns lie still.
STIFFNESS, FRAMES, UNITS = 50.0, 10, 5
#: Courant number: every substep's transfers dissipate (see ``run``), so the fewer the better.
CFL = 0.8


def packed(particles: int, width: float, height: float) -> np.ndarray:
    """[particles, 2]: a Fibonacci lattice over a box from the origin. Squeezed along the box's axes however far, it stays evenly spaced."""
    i = np.arange(particles) + 0.5
    return np.stack([width * (i * (np.sqrt(5) - 1) / 2 % 1), height * i / particles], 1)


def collapse(solver: MPMSimulator, resolution: int, aspect: float, friction_angle: float) -> dict:
    """Final heap of a column against an end wall, floor and wall as rough as the sand: ``runout`` (R - L0) / L0, ``height`` / L0 and slope
    [degrees] of its ``flank``; ``particles``, wall ``seconds``.

    R: 99.9 % of the sand lie within; a last grain may roll on. Height: of the highest grain within L0 / 2 of the wall. Flank: a line through the
    highest grains of the cells' columns where those are between a fifth and four fifths of it. The box has as many cells for every column, all
    that the tallest needs: one grid, one compilation.
    """
    dx, unit = L0 / (resolution if aspect > 3 else 3 * resolution / aspect), np.sqrt(aspect * L0 / G)
    along, up = int(np.ceil((1.5 + 1.5 * TALL.max()) * resolution)), int(TALL.max() * resolution) + 3
    what = scene(
        "granular-collapse", {"model": "sand", "density": RHO, "young_modulus": STIFFNESS * RHO * G * aspect * L0, "friction_angle": friction_angle},
        [{"kind": "box", "lower": [0.0, 0.0], "upper": [L0, aspect * L0]}], [[0.0, along * dx], [0.0, up * dx]], [along, up],
        float(unit / FRAMES), gravity=[0.0, -G], walls={"friction": float(np.tan(np.radians(friction_angle)))}, cfl=CFL,
    )  # fmt: skip
    solver.load(what)
    particles = len(what.particles().position)
    solver.inject("position", np.arange(particles), packed(particles, L0, aspect * L0) / dx + WALL)
    found, seconds = timed(solver.frame, FRAMES * UNITS, lambda position: position)
    x, y = found[-1].astype(float).T
    front, level, middle = np.quantile(x, 0.999), np.zeros(along + 1), (np.arange(along + 1) + 0.5) * dx
    np.maximum.at(level, (x / dx).astype(int), y + what.spacing / 2)
    height = level[middle < max(L0 / 2, dx)].max()
    on = (middle < front) & (level > 0.2 * height) & (level < 0.8 * height)
    return {"runout": front / L0 - 1, "height": height / L0, "flank": np.degrees(np.arctan(-np.polyfit(middle[on], level[on], 1)[0])),
            "particles": particles, "seconds": seconds}  # fmt: skip


def power_law(name: str, what: str, aspects: np.ndarray, ours: np.ndarray, power: float) -> Curve:
    """Exponents by least squares in the logarithms; the law's constant, which depends on the grains, is fitted."""
    log_a, log_u = np.log(aspects), np.log(ours)
    slope = float(np.polyfit(log_a, log_u, 1)[0])
    law = np.exp(power * log_a + (log_u - power * log_a).mean())
    return Curve(f"exponent of {name} {slope:.2f}, law {power:.2f}", ("a = H0 / L0", what), aspects, law, ours, slope - power, 0.1)


def run(resolution: int) -> Outcome:
    """Run-outs and heights over a, run-out and slope over the friction angle.

    As long as a plateau stands, a column knows no length but H0, and its run-out is a multiple of it: low columns are resolved along H0, so that
    those of 1.5 and 2, without a plateau, are what is compared. Resolved along L0, as tall ones are, they would be a few cells high.

    Of tall columns the law is a mean: in two dimensions the run-out bends, here from a slope of 0.8 at a = 5 to 0.6 at 16. So the fit goes up to
    a = 20; to 12 alone it would be 0.77. Experiments are in channels, whose side walls count: Balmforth & Kerswell 2005 measured
    a^(0.9 +- 0.1) in wide ones, a^(0.65 +- 0.05) in narrow ones. Constant friction is enough for the law (as in Rousseau et al. 2023, up to a of
    about 10): with mu(I) instead, tall columns ran a quarter less far, all alike, and 8 cells along L0 gave the exponent 0.76 as before.

    Three things had to be so:

    - Floor and end wall are as rough as the sand, by Coulomb's law. A sticky floor does not stop at what friction can hold: of a slab of sand,
      8 cells thick, sliding on it, it took 11, 15, 20 % of the momentum at once for Courant numbers 0.8, 0.2, 0.05. On a Coulomb floor the slab
      slowed down by mu g to 1 %, whatever the steps, the cells and E.
    - Particles do not lie in rows along the stretching. Those of a plain lattice part by more than the splines' width, and what is left of a
      row, held by nothing at its sides, packs: at a = 20, 10 cells along L0, to four times the column's density in places, in a heap little
      more than half as high.
    - What the transfers dissipate is small. They are exact for linear velocities and damp a wave of wave number k by (k dx)^4 / 40 in every
      substep: in n of them one of 2 pi (n / 40)^(1/4) cells, 18 for n = 3000, falls to 1 / e. At fixed dx run-outs therefore fall without end
      as steps shrink: a = 4, 6 cells along L0: 6.3, 6.0, 5.1, 4.3 L0 for Courant numbers 0.8, 0.4, 0.1, 0.05. They did not (6.2, 6.2, 6.2, 6.2)
      where particles kept 99 % of what the grid cannot hold (FLIP); then 6 cells already gave 0.73. Finer grids go there. So E, too, is low.
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
