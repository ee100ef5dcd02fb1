"""How fast are the SPH solvers, and what do they need to begin? One core.

    python benchmarks/sph.py [--quick]

A column of water, 0.4 in each direction, breaks in a tank of 1.2 by 0.4 by 1: WCSPH (sound speed ten times the speed of a fall from the column's
top) and DFSPH at their default settings. Rates are over the first ``--seconds`` of it (default 0.5), in CPU seconds of the process, kernels
compiled. First calls are wall seconds of ``load`` and one frame in a fresh process, with an empty kernel cache and with a filled one. A trajectory
of WATER-3D is the family's draw nearest to 13,000 particles, to its end. Rows are printed and saved as ``benchmarks/results/sph.json``.
"""

import argparse
import os
import tempfile
import time

import numpy as np
from mpm import ROOT, _alone, save, timed

from sim.scene import Scene, SceneFamily

SCENES = ROOT.parent / "configs" / "scenes"
G, EDGE = 9.81, 0.4


def dam(method: str, edge: int, dim: int = 3, body: bool = False) -> Scene:
    """``edge**dim`` particles; ``body``: and a rigid cube at the far end of the tank."""
    size = [1.2, 1.0, 0.4][:dim]
    cells = [round(length / EDGE * edge) for length in size]
    water = {"material": "water", "kind": "box", "lower": [0.0] * dim, "upper": [EDGE] * dim, "velocity": [0.0] * dim}
    cube = water | {"material": "wood", "lower": [1.0, 0.0, 0.1][:dim], "upper": [1.1, 0.1, 0.2][:dim]}
    materials = {"water": {"model": "water", "sound_speed": 10 * float(np.sqrt(2 * G * EDGE))}}
    if body:
        materials["wood"] = {"model": "rigid", "density": 500.0}
    return Scene.from_dict({
        "name": f"{method}-{dim}d-{edge**dim}", "dim": dim, "bounds": [[0.0, count * EDGE / edge] for count in cells],
        "gravity": [0.0, -G, 0.0][:dim], "frame_step": 0.005, "frames": 1000, "radius": 1.5 * EDGE / edge, "cells": cells, "particles_per_cell": 1,
        "solver": {"method": method}, "materials": materials, "seed": 0, "bodies": [water, cube] if body else [water],
    })  # fmt: skip


def run(scene: Scene, frames: int) -> dict:
    """One row: the scene from its start, kernels compiled."""
    from sim.sph.solver import SPHSimulator

    simulator = SPHSimulator()
    simulator.load(scene)
    simulator.frame()
    simulator.load(scene)
    steps = iterations = 0.0

    def advance() -> None:
        nonlocal steps, iterations
        for _ in range(frames):
            simulator.frame()
            found = simulator.diagnostics()
            steps += found["substeps"]
            iterations += found.get("iterations_density", 0) + found.get("iterations_divergence", 0)

    spent, _ = timed(advance)
    count = len(scene.particles().position)
    simulated = frames * scene.frame_step
    return {"case": scene.name, "particles": count, "frames": frames, "seconds": spent, "simulated_over_cpu_seconds": simulated / spent,
            "mps": count * steps / spent / 1e6, "step_ms": simulated / steps * 1e3, "iterations_a_step": iterations / steps}  # fmt: skip


def water_3d() -> Scene:
    """The draw of WATER-3D that is nearest to 13,000 particles."""
    family = SceneFamily.load(SCENES / "water_3d.yaml")
    return min((family.sample(seed) for seed in range(20)), key=lambda scene: abs(len(scene.particles().position) - 13_000))


def _first_call(method: str, dim: int, body: bool) -> float:
    from sim.sph.solver import SPHSimulator

    scene = dam(method, {2: 64, 3: 17}[dim], dim, body)
    begun = time.perf_counter()
    simulator = SPHSimulator()
    simulator.load(scene)
    simulator.frame()
    return time.perf_counter() - begun


def first_calls(method: str, dim: int, body: bool) -> dict:
    """Wall seconds of the first call in a fresh process: kernels compiled, and kernels read from the cache that this leaves."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["SLUICE_TAICHI_CACHE"] = folder
        cold, warm = _alone(_first_call, method, dim, body), _alone(_first_call, method, dim, body)
    return {"case": f"first call, {method} {dim}D{', a rigid body' if body else ''}", "cold_seconds": cold, "warm_seconds": warm}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small scenes and few frames, to see that it runs")
    parser.add_argument("--seconds", type=float, default=0.5, help="of a dam break (default 0.5)")
    options = parser.parse_args()
    rows = []

    def show(row: dict) -> None:
        rows.append(row)
        print("  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()), flush=True)

    frames = 2 if options.quick else round(options.seconds / 0.005)
    for method in ("wcsph", "dfsph"):
        for dim in (2, 3):
            for body in (False, True):
                show(first_calls(method, dim, body))
    for method in ("wcsph", "dfsph"):
        for dim, edge in ((2, 32), (2, 100), (3, 17), (3, 37)):
            show(run(dam(method, 8 if options.quick else edge, dim), frames))
    scene = water_3d()
    show(run(scene, 2 if options.quick else scene.frames - 1) | {"case": "a trajectory of WATER-3D"})
    if not options.quick:
        save("sph", rows, 1)


if __name__ == "__main__":
    main()
