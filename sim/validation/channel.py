"""Channel: the start of Poiseuille's and of Couette's flow between sticky walls, by their series."""

import numpy as np

from sim.solvers import solver_class
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 8
METHODS = ("wcsph", "dfsph")
#: Particles from wall to wall.
RESOLUTIONS = (12, 20, 30)
#: Viscosity, largest speed, speed of sound; the channel is 1 wide.
NU, U, C = 1.0, 1.25, 20.0
#: nu t / d^2 of the comparisons, in frames of the first.
TIMES, FRAMES = (0.05, 0.1, 0.5), (1, 2, 10)


def run(resolution: int, method: str) -> Outcome:
    """A channel 1 wide, periodic along it. Poiseuille: a body force of 8 nu u_max / d^2; Couette: the upper wall moves with u_max = 1.25.

    Error: largest difference of a particle's velocity, along or across, at nu t / d^2 = 0.05, 0.1 and 0.5. Drawn are the means of the layers, one
    profile after the other: up the first, down the second, up the third. Viscosity does all, so there is none else: no artificial one, no XSPH.
    A support of three spacings: with fewer, layers that slide past each other on their lattice are not rubbed as those of a fluid are (30 particles,
    2.5 spacings: 0.1 off). The implicit viscosity of DFSPH is of first order in time: steps of an eighth of the usual length.

    With 60 particles from wall to wall DFSPH is 0.0073 and 0.0066 off.
    """
    curves, total = {}, 0.0
    for name, exact in (("Poiseuille", poiseuille), ("Couette", couette)):
        found, seconds, particles = _flow(resolution, method, name)
        y: list[np.ndarray] = []
        ours: list[np.ndarray] = []
        error = 0.0
        layers = (np.arange(resolution) + 0.5) / resolution
        for index, time in enumerate(TIMES):
            position, velocity = found[FRAMES[index] - 1]
            off = velocity - np.stack([exact(position[:, 1], time), np.zeros(particles)], 1)
            error = max(error, float(np.abs(off).max()))
            layer = np.minimum((position[:, 1] * resolution).astype(int), resolution - 1)
            mean = np.bincount(layer, velocity[:, 0], resolution) / np.maximum(np.bincount(layer, minlength=resolution), 1)
            turn = slice(None, None, -1 if index % 2 else 1)
            y, ours = [*y, layers[turn]], [*ours, mean[turn]]
        reference = np.concatenate([exact(each, time) for each, time in zip(y, TIMES, strict=True)])
        x = np.concatenate([index + (each if index % 2 == 0 else 1 - each) for index, each in enumerate(y)])
        curves[name] = Curve("largest error of a particle's velocity, the largest being 1.25", ("y / d, to and fro", "u"), x, reference,
                             np.concatenate(ours), error, 0.01)  # fmt: skip
        total += seconds
    return Outcome("channel", resolution, particles, curves, total)


def poiseuille(y: np.ndarray, t: float) -> np.ndarray:
    """u of the flow that a body force of 8 nu u_max / d^2 starts (Morris, Fox & Zhu 1997, eq. 21)."""
    odd = 2 * np.arange(100)[:, None] + 1
    return 4 * U * y * (1 - y) - (32 * U / (np.pi * odd) ** 3 * np.sin(np.pi * odd * y) * np.exp(-((np.pi * odd) ** 2) * NU * t)).sum(0)


def couette(y: np.ndarray, t: float) -> np.ndarray:
    """u of the flow that a wall at y = 1 starts (Morris, Fox & Zhu 1997, eq. 20)."""
    n = np.arange(1, 200)[:, None]
    return U * y + (2 * U / (np.pi * n) * (-1.0) ** n * np.sin(np.pi * n * y) * np.exp(-((np.pi * n) ** 2) * NU * t)).sum(0)


def _flow(resolution: int, method: str, name: str) -> tuple[list, float, int]:
    """Positions and velocities after each frame, seconds, particles."""
    settings = {"support": 3.0} | ({"artificial_viscosity": 0.0} if method == "wcsph" else {"xsph": 0.0})
    driven = {"gravity": [8 * NU * U, 0.0]} if name == "Poiseuille" else {}
    what = scene(
        name.lower(), {"model": "water", "sound_speed": C, "density": 1.0, "viscosity": NU},
        [{"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}], [[0.0, 1.0]] * 2, [resolution // 2] * 2, TIMES[0] / NU, periodic=["x"],
        cfl=0.4 if method == "wcsph" else 0.05, walls={"friction": "sticky", "velocity": {} if driven else {"y+": [U, 0.0]}},
        solver={"method": method} | settings, **driven,
    )  # fmt: skip
    solver = solver_class(method)()
    solver.load(what)

    def observe(_):
        state = solver.state()
        return state["position"], state["velocity"]

    return *timed(solver.frame, FRAMES[-1], observe), len(what.particles().position)
