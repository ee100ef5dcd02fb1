"""Rollout and training steps of the GNS against its textbook form on one core, and on two, interleaved in one run: ``python benchmarks/gns.py``.

The textbook form (``tests/learn/textbook_gns.py``: concatenate, index_add, autograd, float32) has the same parameters and the same graph.
A rollout step is graph, features, network and update; a training step is ``loss`` and ``backward``. Times are medians over interleaved
repetitions, wall and CPU seconds of the main thread (of one core the CPU time is the steadier on a shared machine); errors are relative, 2-norm,
against the textbook form in float64. ``bf16_units`` says whether the processor multiplies bfloat16 in hardware: without, bf16 is emulated.
"""

from __future__ import annotations

import argparse
import copy
import importlib.util
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from learn.dataset import DataSpec, Windows
from learn.gns import GNS
from learn.graph import radius_graph
from learn.model import build
from sim.simulator import Start
from sim.trajectory import write_json

ROOT = Path(__file__).resolve().parent.parent

#: name -> latent, blocks of message passing, particles, dimension.
SIZES = {"full": (128, 10, 1000, 2), "demo": (64, 5, 1000, 2), "3d": (128, 10, 5000, 3)}
RADIUS = 0.035
#: About 15 neighbours in 2D, 30 in 3D.
SPACING = {2: 0.0158, 3: 0.0184}


def load_textbook() -> type[torch.nn.Module]:
    """The oracle of the tests; the tests are no package, so it is loaded by its path."""
    path = ROOT / "tests" / "learn" / "textbook_gns.py"
    module_spec = importlib.util.spec_from_file_location("textbook_gns", path)
    module = importlib.util.module_from_spec(module_spec)
    module_spec.loader.exec_module(module)
    return module.TextbookNetwork


def scene(particles: int, dim: int = 2) -> tuple[DataSpec, Windows, Start]:
    """A jittered block of water-like particles, twice as wide as high, moving at about the paper's velocities."""
    rng = np.random.default_rng(0)
    spacing = SPACING[dim]
    across = int(np.ceil((2 * particles) ** (1 / dim))) if dim == 2 else int(np.ceil((particles / 2) ** (1 / 3) * 2**0.5))
    places = np.stack(np.unravel_index(np.arange(particles), (2 * particles // across, across) if dim == 2 else (particles, across, across)), 1)
    grid = places[:, ::-1] * spacing + 0.1 + rng.normal(0, 0.12 * spacing, (particles, dim))
    velocity = 1e-3 + np.cumsum(rng.normal(0, 1e-4, (7, particles, dim)), 0)
    position = (grid + np.cumsum(velocity, 0)).astype(np.float32)
    upper = float(np.ceil(position.max() + 0.1))
    gravity = (0,) * (dim - 1) + (-9.81,)
    spec = DataSpec(
        dim=dim,
        bounds=((0, upper),) * dim,
        radius=RADIUS,
        spacing=spacing,
        frame_step=0.0025,
        stride=1,
        gravity=gravity,
        particle_types=(5,),
        velocity_mean=(0,) * dim,
        velocity_std=(1.4e-3,) * dim,
        acceleration_mean=(0,) * dim,
        acceleration_std=(1e-4,) * dim,
    )
    windows = Windows(torch.from_numpy(position), torch.full((particles,), 5), torch.zeros(particles, dtype=torch.int64))
    start = Start(
        history=position[:6],
        particle_type=np.full(particles, 5, np.int8),
        present=5,
        frame_step=spec.frame_step,
        radius=RADIUS,
        bounds=np.array(spec.bounds),
        scene={"gravity": spec.gravity},
    )
    return spec, windows, start


def interleave(functions: dict[str, Callable[[], object]], repeats: int) -> dict[str, dict[str, float]]:
    """Median wall and CPU milliseconds of each function, called in turn; one warm-up call each."""
    for function in functions.values():
        function()
    wall, cpu = {name: [] for name in functions}, {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            begun, busy = time.perf_counter(), time.thread_time()
            function()
            wall[name].append(time.perf_counter() - begun)
            cpu[name].append(time.thread_time() - busy)
    return {name: {"wall_ms": 1e3 * float(np.median(wall[name])), "cpu_ms": 1e3 * float(np.median(cpu[name]))} for name in functions}


def bf16_units() -> list[str]:
    """Instruction sets of this processor that multiply bfloat16, by their names in /proc/cpuinfo."""
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        return []
    return [name for name in ("amx_bf16", "avx512_bf16", "bf16") if name in flags]


def errors(model: GNS, windows: Windows, textbook: type[torch.nn.Module]) -> tuple[float, float]:
    """Relative errors of output and gradient against the textbook form in float64, on one graph."""
    with torch.no_grad():
        position = windows.position[:6]
        graph = radius_graph(position[-1], model.radius)
        nodes = model.features.nodes(position, windows.particle_type, model.features.bounds)
        edges = model.features.edges(position, graph)

    def run(network, nodes, edges):
        output = network(nodes, edges, graph)
        gradients = torch.autograd.grad(output.square().sum(), list(network.parameters()))
        return output.detach().double(), torch.cat([gradient.flatten().double() for gradient in gradients])

    double = copy.deepcopy(model.network).double()
    double = double if isinstance(double, textbook) else textbook(double)
    wanted, found = run(double, nodes.double(), edges.double()), run(model.network, nodes, edges)
    return tuple(float((a - b).norm() / b.norm()) for a, b in zip(found, wanted, strict=True))


def steps(model: GNS, windows: Windows, start: Start, threads: int = 1) -> dict[str, Callable[[], object]]:
    """A rollout's step and a training's, on so many threads."""

    def roll():
        torch.set_num_threads(threads)
        model.begin(start)
        return model.advance()

    def train():
        torch.set_num_threads(threads)
        model.zero_grad(set_to_none=True)
        model.loss(windows, torch.Generator().manual_seed(0), 0.0).backward()

    return {"rollout_step": roll, "training_step": train}


def measure(size: str, repeats: int, precisions: list[str]) -> dict:
    """One size: times of textbook and ours in every precision, speed-ups over the textbook form, errors against float64; ours on two cores."""
    latent, blocks, particles, dim = SIZES[size]
    spec, windows, start = scene(particles, dim)
    models = {}
    for name in ["textbook", *precisions]:
        torch.manual_seed(0)
        models[name] = build("gns", {"latent": latent, "message_passing": blocks, "precision": "f32" if name == "textbook" else name}, spec)
    textbook = load_textbook()
    models["textbook"].network = textbook(models["textbook"].network)
    error = {name: dict(zip(("output", "gradient"), errors(model, windows, textbook), strict=True)) for name, model in models.items()}

    edges = radius_graph(windows.position[5], RADIUS).edges
    result = {"latent": latent, "message_passing": blocks, "particles": particles, "dim": dim, "edges": edges, "error": error}
    for kind in ("rollout_step", "training_step"):
        functions = {name: steps(model, windows, start)[kind] for name, model in models.items()}
        functions |= {f"{name}, two cores": steps(models[name], windows, start, 2)[kind] for name in precisions}
        times = interleave(functions, repeats)
        for name in precisions:
            times[name]["speed_up"] = times["textbook"]["wall_ms"] / times[name]["wall_ms"]
            times[name]["speed_up_cpu"] = times["textbook"]["cpu_ms"] / times[name]["cpu_ms"]
            times[f"{name}, two cores"]["over_one_core"] = times[name]["wall_ms"] / times[f"{name}, two cores"]["wall_ms"]
        result[kind] = times
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "gns.json")
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--precisions", nargs="+", choices=["f32", "bf16"], help="default: f32, and bf16 where the processor has units for it")
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    units = bf16_units()
    precisions = arguments.precisions or (["f32", "bf16"] if units else ["f32"])
    results = {
        "machine": platform.processor() or platform.machine(),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
        "bf16_units": units,
        "sizes": {},
    }
    print(f"capability {results['capability']}, bf16 units: {', '.join(units) or 'none, so bf16 is emulated and left out unless asked for'}")
    for size in arguments.sizes:
        found = results["sizes"][size] = measure(size, arguments.repeats, precisions)
        shape = f"{found['particles']} particles, {found['dim']}D, {found['edges']} edges"
        print(f"{size}: latent {found['latent']}, M {found['message_passing']}, {shape}")
        for kind in ("rollout_step", "training_step"):
            for name, row in found[kind].items():
                gain = f"  {row['speed_up']:.2f}x ({row['speed_up_cpu']:.2f}x by CPU time)" if "speed_up" in row else ""
                gain = f"  {row['over_one_core']:.2f}x one core" if "over_one_core" in row else gain
                print(f"  {kind:14} {name:15} {row['wall_ms']:8.1f} ms wall {row['cpu_ms']:8.1f} ms CPU{gain}")
        for name, row in found["error"].items():
            print(f"  {name}: relative error of the output {row['output']:.1e}, of the gradient {row['gradient']:.1e}")
    write_json(arguments.out, results)
    print(f"written: {arguments.out}")


if __name__ == "__main__":
    main()
