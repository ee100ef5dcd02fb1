"""Rollout and training steps of the GNS on a CUDA device, beside its textbook form, one after the other: ``python benchmarks/gns_cuda.py``.

The textbook form (``tests/learn/textbook_gns.py``) runs in float32 with TF32 off and under bf16 autocast, on a graph that scipy makes on the host
(``search_on_host_ms``, part of its time; the most used port searches on the device, so subtract it to compare networks). Ours is
``learn.replay`` and ``learn.gns_replay``: search, network, update (rollout), loss, gradient, clipping, Adam and the average of weights (training)
in one CUDA graph.
Wall times of whole steps: of rollouts medians, each step with its frame handed to the host; of training means of steps that nobody waits
for until the last. Noise is drawn on the host in both. Errors are relative, 2-norm, against the textbook form in float64 on the same graph.
The roofline share is the floating-point operations of the network's products, counted, over the time and over what an 8192^3 bf16 product
reaches here.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from gns import ROOT, load_textbook, scene

from learn import fused
from learn.dataset import Windows
from learn.graph import Graph, radius_graph
from learn.model import build
from learn.replay import TrainingReplay
from learn.train import Adam
from sim.trajectory import write_json

DEVICE = torch.device("cuda")


def several(windows: Windows, count: int) -> Windows:
    """The same window so many times."""
    particles = windows.position.shape[1]
    example = torch.repeat_interleave(torch.arange(count), particles)
    return Windows(windows.position.repeat(1, count, 1), windows.particle_type.repeat(count), example)


def timed(step: Callable[[], object], seconds: float, least: int = 5) -> float:
    """Median milliseconds of a step that ends with the device idle."""
    step()
    step()
    torch.cuda.synchronize()
    times, begun = [], time.perf_counter()
    while len(times) < least or (time.perf_counter() - begun < seconds and len(times) < 500):
        at = time.perf_counter()
        step()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - at)
    return 1e3 * float(np.median(times))


def throughput(step: Callable[[], object], seconds: float) -> float:
    """Mean milliseconds of steps that nobody waits for, until the last."""
    step()
    step()
    torch.cuda.synchronize()
    begun, count = time.perf_counter(), 0
    while time.perf_counter() - begun < seconds:
        step()
        count += 1
    torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - begun) / count


def ceiling() -> float:
    """bf16 operations a second of a large matrix product."""
    a, b = (torch.randn(8192, 8192, device=DEVICE, dtype=torch.bfloat16) for _ in range(2))
    return 2 * 8192**3 / (timed(lambda: a @ b, 0.5) / 1e3)


def operations(particles: int, edges: int, latent: int, blocks: int) -> float:
    """Floating-point operations of the products of one forward pass, encoders and decoder left out."""
    return 2 * latent**2 * blocks * (3 * edges + (2 + 2 + 2) * particles)


def errors(model: torch.nn.Module, windows: Windows) -> dict[str, float]:
    """Output and gradient against float64, and whether the device's search finds the host's edges."""
    position = windows.position[:6]
    wanted = radius_graph(position[-1], model.radius, windows.example)
    search = fused.Search(np.asarray(model.spec.bounds), model.radius, windows.examples, wanted.edges, True, DEVICE)
    onto = windows.to(DEVICE)
    found = search(onto.position[5], onto.example, torch.tensor([position.shape[1]], dtype=torch.int32, device=DEVICE))
    count = int(found.count)
    pairs = torch.stack([found.receiver[:count], found.sender[:count]]).cpu().long()
    order = torch.argsort(pairs[0] * position.shape[1] + pairs[1])
    same = count == wanted.edges and torch.equal(pairs[:, order], torch.stack([wanted.receiver, wanted.sender]).long())
    graph = Graph(found.sender[:count], found.receiver[:count], found.offsets)
    with torch.no_grad():
        nodes = model.features.nodes(onto.position[:6], onto.particle_type, model.features.bounds)
        edges = model.features.edges(onto.position[:6], found)

    def run(network, nodes, edges, graph):
        output = network(nodes, edges, graph)
        gradients = torch.autograd.grad(output.square().sum(), list(network.parameters()))
        return output.detach().double(), torch.cat([gradient.flatten().double() for gradient in gradients])

    double = load_textbook()(copy.deepcopy(model.network).double())
    true = run(double, nodes.double(), edges[:count].double(), graph)
    model.network.shadow = fused.Shadow(model.network)
    model.network.shadow.refresh()
    found = run(model.network, nodes, edges, found)
    output, gradient = (float((a - b).norm() / b.norm()) for a, b in zip(found, true, strict=True))
    return {"edges": count, "search_agrees": bool(same), "output": output, "gradient": gradient}


def measure(particles: int, dim: int, batch: int, latent: int, blocks: int, seconds: float, most: float) -> dict:
    """One size: errors, milliseconds of each form."""
    spec, windows, start = scene(particles, dim)
    windows = several(windows, batch)
    torch.manual_seed(0)
    model = build("gns", {"latent": latent, "message_passing": blocks, "precision": "bf16"}, spec).to(DEVICE)
    found = {"particles": particles, "dim": dim, "batch": batch, "latent": latent, "message_passing": blocks, **errors(model, windows)}
    plain = build("gns", {"latent": latent, "message_passing": blocks}, spec).to(DEVICE)
    plain.load_state_dict(model.state_dict())
    plain.network = load_textbook()(plain.network)
    plain.network.low_precision = False  # not to be replayed
    onto, generator = windows.to(DEVICE), torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(plain.parameters(), 1e-6, fused=True)

    def roll(model):
        model.begin(start)
        return model.advance

    def train():
        optimizer.zero_grad(set_to_none=True)
        plain.loss(onto, generator, 0.0).backward()
        torch.nn.utils.clip_grad_norm_(plain.parameters(), 1.0)
        optimizer.step()

    def half(step):
        def run():
            with torch.autocast("cuda", torch.bfloat16):
                return step()

        return run

    parameters = list(model.parameters())
    ours = TrainingReplay(model, parameters, Adam(parameters, 0.0), {k: v.clone() for k, v in model.state_dict().items()}, 1.0, windows,
                          windows.position.shape[1] // batch)  # fmt: skip
    begun = time.perf_counter()
    for _ in range(5):
        radius_graph(windows.position[5], model.radius, windows.example)
    found["search_on_host_ms"] = 1e3 * (time.perf_counter() - begun) / 5
    found["training_step_ms"] = {
        "ours": throughput(lambda: ours.step(windows, generator, 1e-6, 0.999), seconds),
        "textbook f32": throughput(train, seconds),
        "textbook bf16": throughput(half(train), seconds),
    }
    settled = ours.settle()
    assert settled[2:] == (0, 0), settled
    found["rollout_step_ms"] = {
        "ours": timed(roll(model), seconds),
        "textbook f32": timed(roll(plain), seconds),
        "textbook bf16": timed(half(roll(plain)), seconds),
    }
    work = operations(particles, found["edges"] // batch, latent, blocks)
    found["roofline_share"] = {
        "rollout": work / (found["rollout_step_ms"]["ours"] / 1e3) / most,
        "training": 3 * batch * work / (found["training_step_ms"]["ours"] / 1e3) / most,
    }
    found["memory_gb"] = torch.cuda.max_memory_allocated() / 1e9
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "gns_cuda.json")
    parser.add_argument("--seconds", type=float, default=1.0, help="for each figure")
    parser.add_argument("--sizes", nargs="+", default=["1000:2:2", "2000:2:2", "5000:2:2", "20000:2:2", "5000:3:2"], help="particles:dim:batch")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("gns_cuda: left out, for this machine has no CUDA device that torch can use")
        return
    torch.backends.cuda.matmul.allow_tf32 = False
    most = ceiling()
    result = {"device": torch.cuda.get_device_name(), "torch": torch.__version__, "bf16_product_tflops": most / 1e12, "sizes": []}
    print(f"{result['device']}, torch {torch.__version__}, {most / 1e12:.0f} TFLOP/s")
    for size in arguments.sizes:
        found = measure(*map(int, size.split(":")), 128, 10, arguments.seconds, most)
        result["sizes"].append(found)
        print(f"{found['particles']} particles, {found['dim']}D, batch {found['batch']}: {found['edges']} edges in the batch, search agrees: "
              f"{found['search_agrees']}, error of the output {found['output']:.1e}, gradient {found['gradient']:.1e}")  # fmt: skip
        for kind in ("training_step_ms", "rollout_step_ms"):
            times = found[kind]
            print(f"  {kind:16} " + ", ".join(f"{name} {ms:.2f} ({1e3 / ms:.0f}/s)" for name, ms in times.items())
                  + f"; {times['textbook f32'] / times['ours']:.1f}x and {times['textbook bf16'] / times['ours']:.1f}x")  # fmt: skip
        print(f"  roofline share: {', '.join(f'{k} {v:.1%}' for k, v in found['roofline_share'].items())}", flush=True)
    write_json(arguments.out, result)


if __name__ == "__main__":
    main()
