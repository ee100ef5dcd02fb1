"""Shaking at 10 g: what flies in a shaken box flies straight outside; a steady push is gravity; a sloshing pool stays inside."""

import time

import numpy as np

from sim.scene import Scene
from sim.stability import Cell
from sim.stability.driver import PBF, SPH, follow, way
from sim.validation import scene

CELLS, G, FRAME, SHAKE = 16, 9.8, 0.002, 98.0
#: Five times the speed that the shaken box gives.
WATER: dict[str, dict] = {
    "water": {"model": "water", "sound_speed": 20.0},
    "wcsph": SPH["wcsph"] | {"sound_speed": 80.0},
    "dfsph": SPH["dfsph"],
} | PBF
#: Of positions in float32, as 33 cells in a random walk of some hundred steps round them.
ROUNDING = 1e-4


def _shaken(name: str, bodies: list[dict], frequency: float, phase: float, **changes) -> Scene:
    sines = [{"amplitude": [SHAKE, 0.0], "frequency": frequency, "phase": phase}]
    return scene("shaking", WATER[name], bodies, [[0.0, 1.0]] * 2, [CELLS] * 2, FRAME, gravity=[0.0, -G], container={"sines": sines},
                 **({"frames": 101} | way(name) | changes))  # fmt: skip


def run() -> list[Cell]:
    """A shaken box of every method."""
    return [cell for name in WATER for cell in _shake(name, "" if name == "water" else f"{name}, ")]


def _shake(name: str, of: str) -> list[Cell]:
    """Moving frame: with the box's displacement added, a body in free flight falls as if there were no box."""
    body = {"kind": "box", "lower": [0.375, 0.5], "upper": [0.625, 0.75]}
    # Density diffusion (Fourtakas et al. 2019) takes water to be at rest in what gravity it feels, and squeezes what flies by 1e-3 of its size.
    still = {"solver": {"method": "wcsph", "density_diffusion": 0.0}} if name == "wcsph" else {}
    begun, what = time.perf_counter(), _shaken(name, [body], 8.0, 90.0, **still)
    run, start = follow(what, 100), what.particles().position
    # The box starts at rest. Its velocity and place follow from the mean accelerations at the steps taken, as symplectic Euler adds them up;
    # velocity Verlet (WCSPH) and leapfrog (position-based) follow them exactly, whatever their steps.
    late, taken = (0, [(1, FRAME)] * len(run.dt)) if name in ("wcsph", "pbf") else (1, zip(run.substeps, run.dt, strict=True))
    v, box, fall, w = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    for a, (n, dt) in zip(what.acceleration(), taken, strict=False):
        box, v = box + v * n * dt + a * dt**2 * n * (n + late) / 2, v + a * n * dt
        fall, w = fall + w * n * dt + np.array([0.0, -G]) * dt**2 * n * (n + late) / 2, w + np.array([0.0, -G]) * n * dt
    error = float(np.abs(run.position + box - (start + fall)).max()) if run.ok else np.inf
    inside = bool(run.position.min() > 2 / CELLS and run.position.max() < 1 - 2 / CELLS)
    cells = [Cell("shaking", f"{of}free flight, 8 Hz", run.ok and inside and error <= ROUNDING, "box frame equals moving frame, to rounding",
                  f"at most {error:.2g} m off; the box moved {np.abs(box).max():.3g} m" if run.ok else run.status,
                  {"error": error, "tolerance": ROUNDING, "box_moved": float(np.abs(box).max())}, time.perf_counter() - begun)]  # fmt: skip

    # A sine so slow that its crest lasts all through the run is a steady acceleration.
    begun, pool = time.perf_counter(), {"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, 0.25]}
    pushed = follow(_shaken(name, [pool], 1e-4, 90.0), 50)
    tilted = follow(scene("shaking", WATER[name], [pool], [[0.0, 1.0]] * 2, [CELLS] * 2, FRAME, gravity=[-SHAKE, -G], **way(name)), 50)
    difference = float(np.abs(pushed.position - tilted.position).max()) if pushed.ok and tilted.ok else np.inf
    cells.append(Cell("shaking", f"{of}a pool under a steady 10 g", pushed.ok and tilted.ok and difference <= ROUNDING,
                      "the same as gravity leaned over by as much", f"at most {difference:.2g} m apart" if pushed.ok else pushed.status,
                      {"difference": difference, "tolerance": ROUNDING}, time.perf_counter() - begun))  # fmt: skip

    begun = time.perf_counter()
    what = _shaken(name, [pool], 3.0, 0.0, frames=501)
    run = follow(what, 500)
    inside = bool(run.position.min() >= 0 and run.position.max() <= 1)
    # Work: no faster than the box ever goes plus a fall through it, twice for a jet.
    most = 2 * (SHAKE / (2 * np.pi * 3.0) * 2 + np.sqrt(2 * SHAKE))
    fastest = float(run.speed.max(initial=0.0))
    right = run.ok and inside and fastest <= most
    cells.append(Cell("shaking", f"{of}a sloshing pool, 3 Hz", right, "all inside, no faster than the box can throw it",
                      f"{'inside' if inside else 'outside'}, at most {fastest:.3g} m/s (bound {most:.3g})" if run.ok else run.status,
                      {"speed": fastest, "bound": float(most)}, time.perf_counter() - begun,
                      {f"{of}sloshing at 10 g": run.energy_curve(1000 * 0.25 * SHAKE)}))  # fmt: skip
    return cells
