"""Rotation and free fall: a disc of water in free space keeps its angular and linear momentum; in a field of gravity all of it follows a parabola."""

import numpy as np

from sim.solvers import solver_class
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 1
METHODS = ("mpm", "wcsph", "dfsph", "pbf")
#: Cells a metre; the disc's diameter is 0.3 m.
RESOLUTIONS = (16, 32, 64)
RADIUS, WIDTH, OMEGA, GRAVITY, START = 0.15, 2.5, 2 * np.pi, np.array([0.0, -9.8]), np.array([0.5, 2.0])
#: Of a frame, and how many make a turn and a fall.
FRAME, TURN, FALL = 0.01, 100, 50


def disc(resolution: int, method: str, **changes):
    """The disc in a box whose walls nothing reaches. WCSPH without what is no force between two particles or takes pressures to be hydrostatic:
    shifting carries momentum along, and in free fall density diffusion moves a surface by a hundredth of a spacing. DFSPH without XSPH, which acts
    along velocities, not along the line between two particles: it took 0.2 to 0.9 % of the angular momentum."""
    settings = {"mpm": {}, "wcsph": {"shifting": False, "density_diffusion": 0.0}, "dfsph": {"xsph": 0.0}, "pbf": {"xsph": 0.0}}
    solver = {"method": method} | settings[method]
    ball = {"kind": "ball", "center": [0.0, 0.0], "radius": RADIUS}
    return scene("rotation", {"model": "water", "sound_speed": 5.0}, [ball], [[-WIDTH / 2, WIDTH / 2]] * 2, [round(WIDTH * resolution)] * 2, FRAME,
                 solver=solver, **changes)  # fmt: skip


def turn(solver, resolution: int, method: str) -> tuple[np.ndarray, np.ndarray, float]:
    """One turn: L / L0 - 1, momentum over sum |m v| after each frame, and wall seconds. Water does not hold together: the rim flies off along
    tangents, as it should.

    L = sum m (x - x0) x v, of MPM also m dx^2 / 4 (C10 - C01): dx^2 / 4 is the moment of inertia of a quadratic B-spline (Jiang et al. 2015).
    """
    what = disc(resolution, method)
    solver.load(what)
    x = what.particles().position
    solver.set_velocity(OMEGA * np.stack([-x[:, 1], x[:, 0]], 1))
    pace = np.linalg.norm(OMEGA * x, axis=1).sum()

    def observe(_=None):
        state = solver.state()
        x, v = state["position"], state["velocity"]
        spin = (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum()
        if method == "mpm":
            C = state["velocity gradient"]
            spin += (C[:, 1, 0] - C[:, 0, 1]).sum() * solver.dx**2 / 4
        return spin, *(v.sum(0) / pace)

    before = np.array(observe())
    found, seconds = timed(solver.frame, TURN, observe)
    seen = np.array(found)
    return seen[:, 0] / before[0] - 1, np.linalg.norm(seen[:, 1:] - before[1:], axis=1), seconds


def fall(solver, resolution: int, method: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Height of the centre, its exact value, the largest distance of a particle from its own parabola over the box's width, wall seconds.

    x0 + v0 t + g t^2 / 2 and, but for WCSPH, g dt t / 2 beyond it, which is symplectic Euler's own and exact; dt varies from frame to frame, of
    DFSPH also within one unless it is fixed.
    """
    what = disc(resolution, method, gravity=GRAVITY.tolist(), time_step=FRAME / 20 if method == "dfsph" else None)
    solver.load(what)
    x = what.particles().position
    solver.set_velocity(np.tile(START, (len(x), 1)))
    exact, v = x.copy(), START.copy()

    def observe(position):
        nonlocal exact, v
        ahead = 0.0 if method in ("wcsph", "pbf") else solver.diagnostics()["dt"]
        exact, v = exact + v * FRAME + GRAVITY * FRAME * (FRAME + ahead) / 2, v + GRAVITY * FRAME
        return position[:, 1].mean(), exact[:, 1].mean(), np.abs(position - exact).max()

    found, seconds = timed(solver.frame, FALL, observe)
    height, exactly, off = np.array(found).T
    return height, exactly, off / WIDTH, seconds


def run(resolution: int, method: str) -> Outcome:
    """A turn without gravity, then half a second of flight with it, thrown upwards.

    Rounding alone is left: of L, 7e-9 a substep and always of one sign; of positions, float32's of the box a substep, of either sign.

    DFSPH misses the angular momentum, by a hundredth, all in the first fifth of a turn: it holds the disc together, and corrects places, by
    densities and by shifting, without the velocities that go with them.
    """
    solver = solver_class(method)()
    drift, momentum, seconds = turn(solver, resolution, method)
    height, exact, off, more = fall(solver, resolution, method)
    turns, t = np.arange(1, TURN + 1) / TURN, FRAME * np.arange(1, FALL + 1)
    curves = {
        "angular momentum": Curve("largest drift of L in a turn, relative", ("turns", "L / L0 - 1"), turns, np.zeros(TURN), drift,
                                  float(np.abs(drift).max()), 1e-5),
        "linear momentum": Curve("largest momentum in a turn / sum |m v|", ("turns", "momentum / sum |m v|"), turns, np.zeros(TURN), momentum,
                                 float(momentum.max()), 1e-6),
        "free fall": Curve("largest distance of a particle from its parabola over the width of the box", ("time [s]", "height of the centre [m]"),
                           t, exact, height, float(off.max()), 1e-5),
    }  # fmt: skip
    return Outcome("rotation", resolution, len(disc(resolution, method).particles().position), curves, seconds + more)
