"""How fast is the MPM solver, and how far from a plain C program of the same scheme? One core.

    python benchmarks/mpm.py [--quick]

Both run the same scenes with the same substeps in turn (Taichi, C, Taichi, C, ...), in one process and on one thread each;
figures are medians over the rounds, the ratio is the median of the rounds' ratios, times are CPU seconds of the process, so that
a busy machine disturbs less. The C program is built with -O3 -march=native -ffast-math (Taichi's fast_math is on as well);
without a C compiler its columns are left out. Rows are printed and saved as ``benchmarks/results/mpm.json``.
"""

import argparse
import ctypes
import os
import platform
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sim.scene import Scene, SceneFamily
from sim.trajectory import write_json

ROOT = Path(__file__).resolve().parent
FLAGS = ("-O3", "-march=native", "-ffast-math")
MATERIALS = {
    "water": {"model": "water", "density": 1000.0, "sound_speed": 30.0, "gamma": 7.0},
    "sand": {"model": "sand", "density": 1800.0, "young_modulus": 3.5e5, "poisson_ratio": 0.3, "friction_angle": 37.0},
}
#: (particles along an edge of the block, cells along an edge of the box): about 1k, 5k and 20k particles.
SIZES_2D = ((32, 64), (71, 128), (141, 256))


class _Setting(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int) for name in ("rows", "columns")] + [("dx", ctypes.c_float), ("gravity", ctypes.c_float * 2)] + [
        (name, ctypes.c_float) for name in ("friction", "mass", "volume")
    ]


def compiler() -> str | None:
    """Path of a C compiler, or None."""
    return next((path for path in map(shutil.which, ("cc", "gcc", "clang")) if path), None)


def build(folder: str | Path) -> ctypes.CDLL | None:
    """Compile ``mpm_loop.c`` into a folder and load it; None where there is no compiler."""
    cc = compiler()
    if cc is None:
        return None
    library = Path(folder) / "mpm_loop.so"
    subprocess.run([cc, *FLAGS, "-shared", "-fPIC", str(ROOT / "mpm_loop.c"), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


class CLoop:
    """The C program on a 2D scene of one material. ``frame(substeps)`` advances one frame; ``position()`` [n, 2]."""

    def __init__(self, library: ctypes.CDLL, scene: Scene):
        (material,) = scene.materials.values()
        particles, dim = scene.particles(), scene.dim
        self.scene, self.library, self.model = scene, library, material.model
        self.lower = np.array(scene.bounds)[:, 0]
        self.dx = scene.grid_spacing / scene.refine
        n, volume = len(particles.position), particles.spacing**dim
        self.setting = _Setting(
            *(cells * scene.refine for cells in scene.cells), self.dx, (ctypes.c_float * 2)(*scene.gravity), scene.walls.friction,
            material.density * volume, volume,
        )
        self.x = np.ascontiguousarray((particles.position - self.lower) / self.dx + 1, np.float32)
        self.v = np.ascontiguousarray(particles.velocity, np.float32)
        self.C = np.zeros((n, dim, dim), np.float32)
        if self.model == "water":
            if material.gamma != 7.0:
                raise ValueError(f"gamma = {material.gamma}: the C program has gamma = 7 built in")
            self.state = [np.ones(n, np.float32)]
            self.numbers = [material.density * material.sound_speed**2 / material.gamma]
        else:
            E, nu = material.young_modulus, material.poisson_ratio
            lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
            self.state = [np.zeros((n, 3), np.float32), np.zeros(n, np.float32)]
            self.numbers = [lam, mu, np.sin(np.radians(material.friction_angle)) / np.sqrt(2) * (lam + mu) / mu]

    def frame(self, substeps: int) -> None:
        """Advance one frame of the scene in equal substeps."""
        dt = self.scene.frame_step / substeps
        arrays = [array.ctypes.data_as(ctypes.c_void_p) for array in (self.x, self.v, self.C, *self.state)]
        run = self.library.run_water if self.model == "water" else self.library.run_sand
        run(len(self.x), *arrays, substeps, ctypes.c_float(dt), ctypes.byref(self.setting), *map(ctypes.c_float, self.numbers))

    def run(self, substeps: list[int]) -> None:
        """Advance one frame for each entry, in that many substeps."""
        for k in substeps:
            self.frame(k)

    def position(self) -> np.ndarray:
        """[n, 2] float64, in the scene's units."""
        return (self.x.astype(np.float64) - 1) * self.dx + self.lower


def block(material: str, dim: int, edge: int, cells: int, friction: float = 0.0) -> Scene:
    """A dam break in a unit box: a block of ``edge**dim`` particles in the corner on the floor, two per cell and axis."""
    size = edge / (2 * cells)
    gravity = [0.0] * dim
    gravity[1] = -9.8
    return Scene.from_dict({
        "name": f"{material}-{dim}d-{edge**dim}", "dim": dim, "bounds": [[0.0, 1.0]] * dim, "gravity": gravity, "frame_step": 0.0025, "frames": 1000,
        "radius": 2.0 / cells, "cells": [cells] * dim, "jitter": 0.2, "walls": {"friction": friction}, "materials": {material: MATERIALS[material]},
        "seed": 0, "bodies": [{"material": material, "kind": "box", "lower": [0.0] * dim, "upper": [size] * dim, "velocity": [0.0] * dim}],
    })  # fmt: skip


def _timed(action: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of a call, and what it returns."""
    begun = time.process_time()
    result = action()
    return time.process_time() - begun, result


def _advance(simulator: Any, frames: int) -> list[int]:
    """Run frames of a loaded ``MPMSimulator``; substeps of each."""
    substeps = []
    for _ in range(frames):
        simulator.frame()
        substeps.append(int(simulator.diagnostics()["substeps"]))
    return substeps


def compare(scene: Scene, library: ctypes.CDLL | None, rounds: int, target: float) -> dict:
    """Million particle-substeps per CPU second of both, in turn; a round lasts about ``target`` seconds a side."""
    from sim.mpm.solver import MPMSimulator

    simulator = MPMSimulator()
    first = time.perf_counter()
    simulator.load(scene)
    simulator.frame()
    first = time.perf_counter() - first
    yardstick = CLoop(library, scene) if library and scene.dim == 2 else None
    frames = max(1, int(np.ceil(target / max(_timed(simulator.frame)[0], 1e-4))))
    count = len(scene.particles().position)
    ours, theirs = [], []
    for _ in range(rounds):
        spent, substeps = _timed(partial(_advance, simulator, frames))
        work = count * sum(substeps) / 1e6
        ours.append(work / spent)
        if yardstick:
            spent, _ = _timed(partial(yardstick.run, substeps))
            theirs.append(work / spent)
    row = {"case": scene.name, "particles": count, "taichi_mps": float(np.median(ours)), "first_call_seconds": first}
    if theirs:
        row |= {"c_mps": float(np.median(theirs)), "ratio": float(np.median(np.array(ours) / theirs))}
    return row


def waterdrop(frames: int) -> dict:
    """CPU seconds of a whole WATERDROP trajectory of about 1000 particles, warm, as the generator drives the solver."""
    from sim.mpm.solver import MPMSimulator

    family = SceneFamily.load(ROOT.parent / "configs" / "scenes" / "waterdrop.yaml")
    scene = min((family.sample(seed) for seed in range(20)), key=lambda scene: abs(len(scene.particles().position) - 1000))
    simulator = MPMSimulator()
    simulator.load(scene)
    simulator.frame()
    simulator.load(scene)
    spent, substeps = _timed(partial(_advance, simulator, frames))
    count = len(scene.particles().position)
    return {"case": "waterdrop", "particles": count, "frames": frames, "substeps_per_frame": float(np.mean(substeps)), "seconds": spent,
            "taichi_mps": count * sum(substeps) / spent / 1e6}  # fmt: skip


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def main() -> None:
    parser = argparse.ArgumentParser(description="MPM solver against a plain C program of the same scheme")
    parser.add_argument("--quick", action="store_true", help="five short rounds a case instead of nine of half a second")
    quick = parser.parse_args().quick
    rounds, target = (5, 0.1) if quick else (9, 0.5)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        # An empty kernel cache, so that the first calls show what compiling costs.
        os.environ["SLUICE_TAICHI_CACHE"] = f"{folder}/kernels"
        library = build(folder)
        if library is None:
            print("no C compiler (cc, gcc or clang) on PATH: the C columns are left out")
        print(f"{'case':18}{'particles':>10}{'Taichi Mps':>12}{'C Mps':>8}{'ratio':>7}{'first call s':>14}")
        cases = [("water", 2, *size) for size in SIZES_2D] + [("sand", 2, *size) for size in SIZES_2D] + [("water", 3, 27, 32)]
        for case in cases:
            row = compare(block(*case), library, rounds, target)
            rows.append(row)
            c = f"{row['c_mps']:8.2f}{row['ratio']:7.2f}" if "ratio" in row else " " * 15
            print(f"{row['case']:18}{row['particles']:10}{row['taichi_mps']:12.2f}{c}{row['first_call_seconds']:14.2f}", flush=True)
        row = min((waterdrop(1000) for _ in range(1 if quick else 3)), key=lambda row: row["seconds"])
        rows.append(row)
        print(f"waterdrop: {row['particles']} particles x {row['frames']} frames, {row['substeps_per_frame']:.1f} substeps a frame: "
              f"{row['seconds']:.2f} s warm, {row['taichi_mps']:.2f} Mps")  # fmt: skip
    results = ROOT / "results"
    results.mkdir(exist_ok=True)
    cc = compiler()
    compiled_by = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0] if cc else None
    environment = {"processor": _processor(), "compiler": compiled_by, "flags": " ".join(FLAGS), "taichi": version("taichi"), "rounds": rounds}
    write_json(results / "mpm.json", {"environment": environment, "rows": rows})


if __name__ == "__main__":
    main()
