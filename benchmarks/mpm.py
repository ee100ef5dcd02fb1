"""How fast is the MPM solver, how far from a plain C program of the same scheme, and what does it need to begin? One core.

    python benchmarks/mpm.py [--quick]

Both run the same scenes with the same substeps in turn (Taichi, C, Taichi, C, ...), in one process and on one thread each;
figures are medians over the rounds, the ratio is the median of the rounds' ratios, times are CPU seconds of the process, so that
a busy machine disturbs less. The C program is built with -O3 -march=native -ffast-math (Taichi's fast_math is on as well);
without a C compiler its columns are left out. First calls are wall seconds of ``load`` and one frame in a fresh process, with an empty
kernel cache and with a filled one. Memory is what a fresh process grows by, and what ``plan`` says. Two processes against one: the
wall seconds of the same frames, alone and beside each other. Rows are printed and saved as ``benchmarks/results/mpm.json``.
"""

import argparse
import ctypes
import multiprocessing
import os
import platform
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numpy as np

from sim.scene import Scene, SceneFamily
from sim.trajectory import write_json

ROOT = Path(__file__).resolve().parent
FLAGS = ("-O3", "-march=native", "-ffast-math")
MATERIALS = {
    "water": {"model": "water", "density": 1000.0, "sound_speed": 30.0, "gamma": 7.0},
    "sand": {"model": "sand", "density": 1800.0, "young_modulus": 3.5e5, "poisson_ratio": 0.3, "friction_angle": 36.0},
}
#: (particles along an edge of the block, cells along an edge of the box): about 1k, 5k and 20k particles.
SIZES_2D = ((32, 64), (71, 128), (141, 256))
#: The same in 3D: 20k; and a million.
SIZE_3D, LARGE_3D = (27, 32), (100, 128)


def _setting(dim: int) -> type[ctypes.Structure]:
    """``Setting`` of the C programs: cells, dx, gravity, friction, mass, volume."""
    numbers = [(name, ctypes.c_float) for name in ("friction", "mass", "volume")]
    fields = [("cells", ctypes.c_int * dim), ("dx", ctypes.c_float), ("gravity", ctypes.c_float * dim), *numbers]
    return type(f"Setting{dim}D", (ctypes.Structure,), {"_fields_": fields})


def compiler() -> str | None:
    """Path of a C compiler, or None."""
    return next((path for path in map(shutil.which, ("cc", "gcc", "clang")) if path), None)


def build(folder: str | Path) -> ctypes.CDLL | None:
    """Compile ``mpm_loop.c`` and ``mpm_loop_3d.c`` into a folder and load them; None where there is no compiler."""
    cc = compiler()
    if cc is None:
        return None
    library = Path(folder) / "mpm_loop.so"
    subprocess.run([cc, *FLAGS, "-shared", "-fPIC", str(ROOT / "mpm_loop.c"), str(ROOT / "mpm_loop_3d.c"), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


class CLoop:
    """The C program on a scene of one material, 2D, or 3D water. ``frame(substeps)`` advances one frame; ``position()`` [n, dim]."""

    def __init__(self, library: ctypes.CDLL, scene: Scene):
        (material,) = scene.materials.values()
        particles, dim = scene.particles(), scene.dim
        self.scene, self.library, self.model = scene, library, material.model
        self.lower = np.array(scene.bounds)[:, 0]
        self.dx = scene.grid_spacing / scene.refine
        n, volume = len(particles.position), particles.spacing**dim
        self.setting = _setting(dim)(
            (ctypes.c_int * dim)(*(cells * scene.refine for cells in scene.cells)),
            self.dx,
            (ctypes.c_float * dim)(*scene.gravity),
            scene.walls.friction,
            material.density * volume,
            volume,
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
        run = getattr(self.library, f"run_{self.model}" + ("_3d" if self.scene.dim == 3 else ""))
        run(len(self.x), *arrays, substeps, ctypes.c_float(dt), ctypes.byref(self.setting), *map(ctypes.c_float, self.numbers))

    def run(self, substeps: list[int]) -> None:
        """Advance one frame for each entry, in that many substeps."""
        for k in substeps:
            self.frame(k)

    def position(self) -> np.ndarray:
        """[n, dim] float64, in the scene's units."""
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


def timed(action: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of a call, and what it returns."""
    begun = time.process_time()
    result = action()
    return time.process_time() - begun, result


def advance(simulator: Any, frames: int) -> list[int]:
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
    simulator.load(scene)
    simulator.frame()
    (material,) = scene.materials
    yardstick = CLoop(library, scene) if library and (scene.dim == 2 or material == "water") else None
    frames = max(1, int(np.ceil(target / max(timed(simulator.frame)[0], 1e-4))))
    count = len(scene.particles().position)
    ours, theirs = [], []
    for _ in range(rounds):
        spent, substeps = timed(partial(advance, simulator, frames))
        work = count * sum(substeps) / 1e6
        ours.append(work / spent)
        if yardstick:
            spent, _ = timed(partial(yardstick.run, substeps))
            theirs.append(work / spent)
    row = {"case": scene.name, "particles": count, "taichi_mps": float(np.median(ours))}
    if theirs:
        row |= {"c_mps": float(np.median(theirs)), "ratio": float(np.median(np.array(ours) / theirs))}
    return row


def waterdrop(frames: int) -> dict:
    """CPU seconds of a whole WATERDROP trajectory of about 1000 particles, warm, as the generator drives the solver."""
    from sim.mpm.solver import MPMSimulator

    scene = drop()
    simulator = MPMSimulator()
    simulator.load(scene)
    simulator.frame()
    simulator.load(scene)
    spent, substeps = timed(partial(advance, simulator, frames))
    count = len(scene.particles().position)
    return {"case": "waterdrop", "particles": count, "frames": frames, "substeps_per_frame": float(np.mean(substeps)), "seconds": spent,
            "taichi_mps": count * sum(substeps) / spent / 1e6}  # fmt: skip


def drop() -> Scene:
    """The scene of WATERDROP that is nearest to 1000 particles."""
    family = SceneFamily.load(ROOT.parent / "configs" / "scenes" / "waterdrop.yaml")
    return min((family.sample(seed) for seed in range(20)), key=lambda scene: abs(len(scene.particles().position) - 1000))


# -- in processes of their own


def _alone(function: Callable, *arguments: Any) -> Any:
    """What a function of this module returns in a fresh process, which then ends as programs do: Taichi saves its kernels at the end."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        result = pool.apply(function, arguments)
        pool.close()
        pool.join()
    return result


def _first_call(case: tuple) -> float:
    from sim.mpm.solver import MPMSimulator

    scene = block(*case)
    begun = time.perf_counter()
    simulator = MPMSimulator()
    simulator.load(scene)
    simulator.frame()
    return time.perf_counter() - begun


def first_calls(case: tuple) -> dict:
    """Wall seconds of the first call in a fresh process: kernels compiled, and kernels read from the cache that this leaves."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["SLUICE_TAICHI_CACHE"] = folder
        cold, warm = _alone(_first_call, case), _alone(_first_call, case)
    return {"case": f"first call, {block(*case).name}", "cold_seconds": cold, "warm_seconds": warm}


def _resident() -> float:
    """Bytes of this process in memory, less what the allocator keeps of what is freed."""
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _memory(material: str, dim: int, size: tuple, frames: int) -> dict:
    from sim.mpm.solver import MPMSimulator

    simulator, small, scene = MPMSimulator(), block(material, dim, 4, 4), block(material, dim, *size)
    simulator.load(small)  # what compiling takes is not the scene's
    advance(simulator, 1)
    before = _resident()
    begun = time.perf_counter()
    simulator.load(scene)
    loaded = time.perf_counter() - begun
    advance(simulator, 1)
    spent, substeps = timed(partial(advance, simulator, frames))
    grown, planned, count = _resident() - before, simulator.plan(scene), len(scene.particles().position)
    grid = int(np.multiply(*planned["fields"]["grid"]))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    return {"case": f"memory, {scene.name}", "particles": count, "grid_bytes": grid, "planned_bytes_a_particle": (planned["bytes"] - grid) / count,
            "resident_bytes_a_particle": (grown - grid) / count, "peak_bytes_a_particle": (peak - grid) / count, "load_seconds": loaded,
            "frames": frames, "substeps": sum(substeps), "taichi_mps": count * sum(substeps) / spent / 1e6}  # fmt: skip


def memory(material: str, dim: int, size: tuple, frames: int = 1) -> dict:
    """What a scene takes in a fresh process beside its grid, by ``plan`` and by the process's growth, then and at its peak; its speed over some
    frames."""
    return _alone(_memory, material, dim, size, frames)


def _pair(rank: int, frames: int, rounds: int, barrier: Barrier, times: Any) -> None:
    from sim.mpm.solver import MPMSimulator

    simulator = MPMSimulator()
    scene = drop()
    for number in range(rounds + 1):
        for both in (False, True):
            simulator.load(scene)
            simulator.frame()
            barrier.wait()
            if both or rank == 0:
                begun = time.perf_counter()
                advance(simulator, frames)
                # The first round warms up.
                if number:
                    times.put((both, rank, time.perf_counter() - begun))
            barrier.wait()


def two_processes(frames: int, rounds: int) -> dict | None:
    """Frames a second of two processes over those of one, each on its own WATERDROP; None on a machine of one core."""
    if len(os.sched_getaffinity(0)) < 2:
        return None
    context = multiprocessing.get_context("spawn")
    barrier, times = context.Barrier(2), context.Queue()
    processes = [context.Process(target=_pair, args=(rank, frames, rounds, barrier, times)) for rank in range(2)]
    for process in processes:
        process.start()
    found = [times.get() for _ in range(3 * rounds)]
    for process in processes:
        process.join()
    alone = [seconds for both, _, seconds in found if not both]
    beside = [max(pair) for pair in zip(*([s for both, rank, s in found if both and rank == r] for r in range(2)), strict=True)]
    return {"case": "two processes against one", "one_seconds": float(np.median(alone)), "two_seconds": float(np.median(beside)),
            "ratio": float(np.median(2 * np.array(alone) / beside))}  # fmt: skip


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def save(name: str, rows: list[dict], rounds: int) -> None:
    """``benchmarks/results/<name>.json``: rows, and what they were measured with."""
    results = ROOT / "results"
    results.mkdir(exist_ok=True)
    cc = compiler()
    compiled_by = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0] if cc else None
    environment = {"processor": _processor(), "compiler": compiled_by, "flags": " ".join(FLAGS), "taichi": version("taichi"), "rounds": rounds}
    write_json(results / f"{name}.json", {"environment": environment, "rows": rows})


def main() -> None:
    parser = argparse.ArgumentParser(description="MPM solver against a plain C program of the same scheme")
    parser.add_argument("--quick", action="store_true", help="five short rounds a case instead of nine of half a second")
    quick = parser.parse_args().quick
    rounds, target = (5, 0.1) if quick else (9, 0.5)
    rows = []
    for case in (("water", 2, *SIZES_2D[1]), ("sand", 2, *SIZES_2D[1]), ("water", 3, *SIZE_3D), ("sand", 3, *SIZE_3D)):
        rows.append(first_calls(case))
        print("{case}: {cold_seconds:.2f} s compiling, {warm_seconds:.2f} s from the cache".format(**rows[-1]), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["SLUICE_TAICHI_CACHE"] = f"{folder}/kernels"
        for material in ("water", "sand"):
            rows.append(memory(material, 3, LARGE_3D))
            print("{case}: {planned_bytes_a_particle:.0f} bytes a particle planned, {resident_bytes_a_particle:.0f} resident, "
                  "{peak_bytes_a_particle:.0f} at the peak, while it loads, beside the grid; "
                  "{taichi_mps:.2f} Mps".format(**rows[-1]), flush=True)  # fmt: skip
        pair = two_processes(400, rounds)
        if pair:
            rows.append(pair)
            print("two processes against one: {ratio:.2f}".format(**pair), flush=True)
        else:
            print("one core: two processes against one is left out")
        library = build(folder)
        if library is None:
            print("no C compiler (cc, gcc or clang) on PATH: the C columns are left out")
        print(f"{'case':18}{'particles':>10}{'Taichi Mps':>12}{'C Mps':>8}{'ratio':>7}")
        cases = [(material, 2, *size) for material in ("water", "sand") for size in SIZES_2D] + [("water", 3, *SIZE_3D), ("sand", 3, *SIZE_3D)]
        for case in cases:
            row = compare(block(*case), library, rounds, target)
            rows.append(row)
            c = f"{row['c_mps']:8.2f}{row['ratio']:7.2f}" if "ratio" in row else " " * 15
            print(f"{row['case']:18}{row['particles']:10}{row['taichi_mps']:12.2f}{c}", flush=True)
        row = min((waterdrop(1000) for _ in range(1 if quick else 3)), key=lambda row: row["seconds"])
        rows.append(row)
        print(f"waterdrop: {row['particles']} particles x {row['frames']} frames, {row['substeps_per_frame']:.1f} substeps a frame: "
              f"{row['seconds']:.2f} s warm, {row['taichi_mps']:.2f} Mps")  # fmt: skip
    save("mpm", rows, rounds)


if __name__ == "__main__":
    main()
