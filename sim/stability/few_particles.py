"""Hardly anything in the box: a film one particle thick, one particle, no particle."""

import time

import numpy as np

from sim.errors import InputError
from sim.scene import Scene, SceneFamily
from sim.stability import Cell
from sim.stability.driver import PBF, SPH, deep, follow, solver_for, way
from sim.stability.refusal import FAMILY
from sim.validation import scene

CELLS, G, FRAME = 16, 9.8, 0.005
WATER: dict[str, dict] = {"water": {"model": "water", "sound_speed": 20.0}} | SPH | PBF
#: Of positions, as 33 cells in float32 round them, some hundred steps.
ROUNDING = 1e-4


def run() -> list[Cell]:
    """The parabola is exact of velocity Verlet (WCSPH) and leapfrog (position-based). Of symplectic Euler (MPM, DFSPH) it is that at the steps taken,
    x0 + v0 t + g t^2 / 2 + g dt t / 2 a frame."""
    film = [{"kind": "box", "lower": [0.25, 0.75], "upper": [0.75, 0.75 + 0.5 / CELLS], "velocity": [0.5, 0.0]}]
    one = [{"kind": "box", "lower": [0.5, 0.5], "upper": [0.5 + 0.5 / CELLS] * 2, "velocity": [0.5, 1.0]}]
    cells = []
    for name in WATER:
        of = "" if name == "water" else f"{name}, "
        deep_film, deep_one = deep(_scene(film, name), 0.25, 0.75), deep(_scene(one, name), 0.5, 0.5 + 0.5 / CELLS)
        cells += [
            _flies(f"{of}a film one particle thick", _scene(film, name)), _flies(f"{of}a film one particle thick, 3D", deep_film),
            _flies(f"{of}one particle", _scene(one, name)), _flies(f"{of}one particle, 3D", deep_one),
            _rests(f"{of}one particle, two seconds on", _scene(one, name)), _rests(f"{of}one particle, two seconds on, 3D", deep_one),
        ]  # fmt: skip
    return [*cells, _empty()]


def _scene(bodies: list[dict], name: str = "water") -> Scene:
    return scene("few-particles", WATER[name], bodies, [[0.0, 1.0]] * 2, [CELLS] * 2, FRAME, gravity=[0.0, -G], **way(name))


def _flies(cell: str, what: Scene) -> Cell:
    begun = time.perf_counter()
    run, start = follow(what, 50), what.particles()
    exact, velocity, g = start.position.copy(), start.velocity.copy(), np.array(what.gravity)
    late = 0 if what.solver.method in ("wcsph", "pbf") else 1
    for n, dt in zip(run.substeps, run.dt, strict=True):
        exact += velocity * n * dt + g * dt**2 * n * (n + late) / 2
        velocity += g * n * dt
    error = float(np.abs(run.position - exact).max()) if run.ok else np.inf
    inside = bool(exact.min() > 2 / CELLS)
    return Cell("few_particles", cell, run.ok and inside and error <= ROUNDING, "ballistic: the exact parabola to rounding",
                f"{len(exact)} particles, at most {error:.2g} m off" if run.ok else run.status,
                {"particles": len(exact), "error": error, "tolerance": ROUNDING}, time.perf_counter() - begun)  # fmt: skip


def _rests(cell: str, what: Scene) -> Cell:
    begun = time.perf_counter()
    run = follow(what, 400)
    # Along the floor nothing stops it where walls slip.
    x, speed = run.position[0], float(abs(solver_for(what).state()["velocity"][0, 1])) if run.ok else np.nan
    inside, expected = ((x >= 0) & (x <= 1)).all(), "rests on the floor, inside the walls"
    # Within what gravity adds in a frame.
    right = run.ok and 0 <= x[1] <= 1 / CELLS and inside and speed <= G * FRAME
    if what.solver.method == "wcsph":
        # Weakly compressible, it is a spring between floor and gravity, and its density knows nothing of free surfaces.
        expected = "thrown back by a floor that is a spring, never with more energy than at the start; inside the walls"
        right = run.ok and inside and run.growth(run.energy[0]) <= 1e-3
    return Cell("few_particles", cell, bool(right), expected,
                f"at height {x[1]:.3g} m, speed {speed:.3g} m/s" if run.ok else run.status, {"height": float(x[1]), "speed": speed},
                time.perf_counter() - begun, {cell: run.energy_curve(run.energy[0])})  # fmt: skip


def _empty() -> Cell:
    begun, said = time.perf_counter(), []
    for make in (lambda: _scene([]), lambda: SceneFamily(FAMILY | {"materials": {"stuff": WATER["water"]}, "bodies": []}, "empty.yaml")):
        try:
            make()
            said.append("accepted")
        except InputError as error:
            said.append(str(error))
    right = all("bodies = []: an empty scene: add at least one body" in line for line in said)
    return Cell("few_particles", "no particle", right, "refused in one line that says what is missing", said[0], {"said": said[1]},
                time.perf_counter() - begun)  # fmt: skip
