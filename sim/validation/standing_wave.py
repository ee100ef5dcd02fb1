"""Standing wave: a gravity wave in a tank swings at omega^2 = g k tanh(k H)."""

import numpy as np

from sim.solvers import solver_class
from sim.validation import Curve, Outcome, period, scene, timed

NUMBER = 10
METHODS = ("mpm", "wcsph", "dfsph")
#: Cells along the tank; it is half as deep.
RESOLUTIONS = (16, 32, 64)
LENGTH, DEPTH, C, G = 1.0, 0.5, 30.0, 9.8
PERIODS, FRAMES_A_PERIOD = 2, 60


def run(resolution: int, method: str) -> Outcome:
    """Half a wave along the tank, set going by the velocities of the linear mode, phi ~ cosh(k y) cos(k x); 1 % of the depth high.

    The particles' velocities are projected onto the mode where they started. SPH: a support of three spacings. The wave is lower than a spacing and
    particles keep their lattice, which resists being sheared under pressure the more, the fewer neighbours bear it: with 2.5 spacings WCSPH
    is 6 % fast and has lost half of the amplitude after two periods, with 3 it is 1 % fast and has lost a tenth.
    """
    k = np.pi / LENGTH
    omega = np.sqrt(G * k * np.tanh(k * DEPTH))
    exact = 2 * np.pi / omega
    what = scene(
        "standing-wave", {"model": "water", "sound_speed": C}, [{"kind": "box", "lower": [0.0, 0.0], "upper": [LENGTH, DEPTH]}],
        [[0.0, LENGTH], [0.0, 1.0]], [resolution, round(resolution / LENGTH)], exact / FRAMES_A_PERIOD, gravity=[0.0, -G],
        solver={"method": method} | ({} if method == "mpm" else {"support": 3.0}),
    )  # fmt: skip
    solver = solver_class(method)()
    solver.load(what)
    x, y = what.particles().position.T
    mode = np.stack([-np.sin(k * x) * np.cosh(k * y), np.cos(k * x) * np.sinh(k * y)], 1)
    size = 0.01 * DEPTH * omega / np.sinh(k * DEPTH)
    solver.set_velocity(size * mode)
    swing, seconds = timed(solver.frame, PERIODS * FRAMES_A_PERIOD, lambda _: (solver.state()["velocity"] * mode).sum() / (size * (mode**2).sum()))
    t = what.frame_step * np.arange(1, len(swing) + 1)
    found = period(t, np.array(swing), exact)
    curve = Curve(f"frequency; period {found:.4f} s, exact {exact:.4f} s", ("time / T", "amplitude of the mode"), t / exact, np.cos(omega * t),
                  np.array(swing), float(exact / found - 1), 0.03)  # fmt: skip
    return Outcome("standing_wave", resolution, len(x), {"frequency": curve}, seconds)
