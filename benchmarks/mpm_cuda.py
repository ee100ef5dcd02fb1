"""Do the MPM solvers do on a CUDA device what they do on the CPU, and how fast? ``python benchmarks/mpm_cuda.py``

Every scene runs from one seed on the CPU, on the CPU from a start displaced by 1e-5 particle spacings (the yardstick of what rounding grows to) and
on the device, each in a process of its own. Differences of positions are in particle spacings; a device that adds in no fixed order differs
from itself as well, so it runs twice. Throughput: blocks of ``benchmarks/mpm.py``, a second each, after the first call.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from ctypes.util import find_library
from pathlib import Path

import numpy as np
from mpm import block

from sim.mpm.solver import MPMSimulator
from sim.scene import SceneFamily
from sim.taichi_runtime import start_taichi, ti
from sim.trajectory import write_json

ROOT = Path(__file__).resolve().parent.parent
SCENES = ("waterdrop", "sand", "goop", "multimaterial", "waterramps", "sandramps", "fluidshake", "water 3d", "sand 3d")
FRAMES, MARKS = 200, (5, 20, 40, 200)
#: material, dimension, particles along an edge of the block, cells along an edge of the box.
THROUGHPUT = {
    "water 2d 20k": ("water", 2, 141, 256), "water 2d 200k": ("water", 2, 447, 800), "water 3d 20k": ("water", 3, 27, 32),
    "water 3d 200k": ("water", 3, 58, 64), "sand 3d 200k": ("sand", 3, 58, 64),
}  # fmt: skip


def work(kind: str, name: str, out: str) -> None:
    """One row, in a process of its own: a scene's frames, or a throughput."""
    arch = start_taichi()
    if arch == "cuda" and "cuda" not in str(ti.lang.impl.current_cfg().arch):
        raise SystemExit("this machine has no CUDA device that Taichi can use")
    if name in THROUGHPUT:
        scene = block(*THROUGHPUT[name])
    else:
        in_3d = name.endswith(" 3d")
        scene = block(name.split()[0], 3, 14, 24) if in_3d else SceneFamily.load(ROOT / "configs" / "scenes" / f"{name}.yaml").sample(3)
    particles = scene.particles()
    simulator = MPMSimulator(perturbation=1e-5 * float(particles.spacing) if kind == "nudged" else 0.0)
    begun = time.perf_counter()
    simulator.load(scene)
    simulator.frame()
    row = {"particles": len(particles.position), "spacing": float(particles.spacing), "first_call_seconds": time.perf_counter() - begun}
    if name not in THROUGHPUT:
        simulator.load(scene)
    frames, substeps, begun = [], 0, time.perf_counter()
    while len(frames) < FRAMES if name not in THROUGHPUT else time.perf_counter() - begun < 1.0:
        frames.append(simulator.frame())
        substeps += int(simulator.diagnostics()["substeps"])
    seconds = time.perf_counter() - begun
    row |= {"frame_ms": 1e3 * seconds / len(frames), "substep_us": 1e6 * seconds / substeps}
    row["million_particle_substeps_a_second"] = row["particles"] * substeps / seconds / 1e6
    if name not in THROUGHPUT:
        np.save(out, np.stack(frames))
    print(json.dumps(row))


def run(kind: str, name: str, arch: str, out: Path) -> dict:
    environment = os.environ | {"SLUICE_ARCH": arch}
    command = [sys.executable, __file__, "--work", kind, name, str(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{name} on {arch}: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arch", choices=("cuda", "cpu"), default="cuda", help="cpu: to try the program where there is no device")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=SCENES)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "mpm_cuda.json")
    parser.add_argument("--work", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        return work(*arguments.work)
    if arguments.arch == "cuda" and find_library("cuda") is None:
        print("mpm_cuda: left out, for this machine has no CUDA driver")
        return None
    result = {"scenes": {}, "throughput": {}}
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.scenes:
            files = {key: Path(folder, f"{key}.npy") for key in ("cpu", "nudged", "device", "again")}
            rows = {key: run(key, name, arguments.arch if key in ("device", "again") else "cpu", file) for key, file in files.items()}
            frames = {key: np.load(file).astype(float) for key, file in files.items()}

            def difference(one: str, other: str, frames=frames, spacing=rows["cpu"]["spacing"]) -> dict:
                away = np.linalg.norm(frames[one] - frames[other], axis=2).max(1) / spacing
                return {mark: float(away[mark - 1]) for mark in MARKS}

            row = result["scenes"][name] = rows["device"] | {"cpu_frame_ms": rows["cpu"]["frame_ms"]}
            row |= {"from_cpu": difference("device", "cpu"), "from_itself": difference("again", "device"), "nudged": difference("nudged", "cpu")}
            shown = ", ".join(f"{key.replace('_', ' ')} {row[key][FRAMES]:.1e}" for key in ("from_cpu", "from_itself", "nudged"))
            print(f"{name}: {row['particles']} particles, first call {row['first_call_seconds']:.1f} s, {row['frame_ms']:.2f} ms a frame (CPU "
                  f"{row['cpu_frame_ms']:.2f}); spacings apart in frame {FRAMES}: {shown}", flush=True)  # fmt: skip
    for name in THROUGHPUT if set(arguments.scenes) == set(SCENES) else ():
        row = result["throughput"][name] = run("device", name, arguments.arch, Path(os.devnull))
        print(f"{name}: {row['million_particle_substeps_a_second']:.0f} million particle-substeps a second", flush=True)
    write_json(arguments.out, result)
    print(f"written: {arguments.out}")


if __name__ == "__main__":
    main()
