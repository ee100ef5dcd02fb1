"""Is the published CConv water? A dam break by its weights beside our DFSPH, from the same two frames.

    python benchmarks/cconv.py pretrained_model_weights.pt [--quick]

The weights are those of isl-org/DeepLagrangianFluids (scripts/pretrained_model_weights.pt): particles of radius 0.025 m, 50 frames a second. A
column of water 0.79 m wide and 1.02 m high breaks in a tank 2 m long and 1.02 m deep: 8228 particles, 4 s. Its training data set two things. Their
solver (SPlisHSPlasH) gives a particle 0.8 of the cube of its diameter, so the spacing of water at rest is 0.0464 m. And their water rests 0.035 m
from the particles that sample a wall, ours half a spacing from the wall: CConv's wall particles lie 0.012 m outside the tank. (On its faces they
push so hard that the column explodes; one of spacing 0.05 m does not, and contracts until its density has grown by a factor of 1.24.)

Front, height, density and energy of both go into ``docs/images/cconv_dam_break.png``; their table is printed and saved as
``benchmarks/results/cconv.json``. Density is the sum of Wendland's C2 kernel (support two spacings) over a particle's neighbours and their images in
the walls, over that of the starting lattice. Times are CPU milliseconds on one thread, kernels compiled. Without weights there is nothing to do.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from mpm import ROOT, save
from scipy.spatial import cKDTree

from learn.cconv import CConv, load_published
from learn.figures import COLOURS
from learn.relaxation import images
from sim.scene import Scene
from sim.simulator import Start, rollout
from sim.sph.solver import SPHSimulator
from sim.trajectory import PARTICLE_TYPES, atomic_path

SPACING, FRAME_STEP, G, FRAMES = 0.05 * 0.8 ** (1 / 3), 0.02, 9.81, 200
TANK, WIDTH, HEIGHT = tuple(np.array((43, 43, 22)) * SPACING), 17 * SPACING, 22 * SPACING
#: Of CConv's wall particles from the tank's faces.
OUTSIDE = 0.035 - SPACING / 2
SHOWN = (0.2, 0.4, 0.8, 1.6, 4.0)
SUPPORT = 2 * SPACING


def dam() -> Scene:
    """The column in its tank; y is up."""
    column = {"material": "water", "kind": "box", "lower": [0.0] * 3, "upper": [WIDTH, HEIGHT, TANK[2]], "velocity": [0.0] * 3}
    return Scene.from_dict({
        "name": "dam", "dim": 3, "bounds": [[0.0, length] for length in TANK], "gravity": [0.0, -G, 0.0], "frame_step": FRAME_STEP,
        "frames": FRAMES + 2, "radius": 2.25 * SPACING, "cells": [round(length / SPACING) for length in TANK], "particles_per_cell": 1,
        "solver": {"method": "dfsph"}, "materials": {"water": {"model": "water"}}, "seed": 0, "bodies": [column],
    })  # fmt: skip


def density(position: np.ndarray) -> np.ndarray:
    """[particles], 1 in a lattice."""

    def kernel(r: np.ndarray) -> np.ndarray:
        return (1 - r / SUPPORT) ** 4 * (1 + 4 * r / SUPPORT)

    owner, sign, shift = images(position, np.array([[0.0, length] for length in TANK]), SUPPORT, None)
    found = cKDTree(position).sparse_distance_matrix(cKDTree(position[owner] * sign + shift), SUPPORT, output_type="ndarray")
    axis = np.arange(-2, 3) * SPACING
    lattice = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3), axis=1)
    return np.bincount(found["i"], kernel(found["v"]), minlength=len(position)) / kernel(np.minimum(lattice, SUPPORT)).sum()


def curves(position: np.ndarray) -> dict[str, np.ndarray]:
    """Of positions [frames + 1, particles, 3], a number for every frame but the first; lengths in m, energy in J/kg."""
    velocity = np.diff(position, axis=0) / FRAME_STEP
    now = position[1:]
    dense = np.array([density(frame) for frame in now])
    return {
        "front": now[:, :, 0].max(1),
        "height": now[:, :, 1].mean(1),
        "wall": np.array([np.percentile(frame[frame[:, 0] < 0.2, 1], 95) for frame in now]),
        "median": np.median(dense, 1),
        "crowded": np.percentile(dense, 99, axis=1),
        "energy": (velocity**2).sum(2).mean(1) / 2 + G * (now[:, :, 1] + position[:-1, :, 1]).mean(1) / 2,
    }


def timed(simulator: SPHSimulator | CConv, start: Start, frames: int) -> tuple[np.ndarray, float]:
    """The frames after the start's last, and CPU milliseconds a frame."""
    begun = time.process_time()
    found = rollout(simulator, start, frames)
    spent = time.process_time() - begun
    if found.status != "ok":
        raise SystemExit(f"{simulator.name}: {found.status}")
    return found.position.astype(float), spent / frames * 1e3


def fall(model: CConv) -> float:
    """Acceleration of a particle alone, over g."""
    history = np.full((2, 1, 3), 5.0, np.float32)
    position, _ = timed(model, Start(history, np.full(1, PARTICLE_TYPES["water"], np.int8), 1, FRAME_STEP, 0.1, np.array([[0.0, 10.0]] * 3), {}), 20)
    return float(np.diff(position[:, 0, 1], 2).mean() / (-G * FRAME_STEP**2))


def draw(path: Path, found: dict[str, dict], time_axis: np.ndarray) -> None:
    """Curves above, the water from the side at five moments below."""
    figure = plt.figure(figsize=(13, 8.6), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1, 1.35))
    axes = above.subplots(1, 4)
    panels = (
        ("front [m]", ("front",)),
        ("height: mean, by the left wall (95 %) [m]", ("height", "wall")),
        ("density: median, 99th percentile", ("median", "crowded")),
        ("energy [J/kg]", ("energy",)),
    )
    for axis, (title, names) in zip(axes, panels, strict=True):
        for label, entry in found.items():
            for name, dash in zip(names, ("-", "--"), strict=False):
                axis.plot(time_axis, entry["curves"][name], dash, color=entry["colour"], lw=1.4, label=label if dash == "-" else None)
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("time [s]", fontsize=9)
        axis.grid(color="#E4E4E4", lw=0.7)
        axis.spines[["top", "right"]].set_visible(False)
    rest = HEIGHT * WIDTH / TANK[0] / 2
    axes[1].axhline(rest, color="#7A7A7A", lw=0.9, ls=":", label="mean height of the water at rest")
    axes[1].legend(frameon=False, fontsize=8, loc="upper right")
    axes[2].set_ylim(0.8, 1.5)
    moments = [t for t in SHOWN if t <= time_axis[-1] + 1e-9]
    pictures = below.subplots(2, len(moments), squeeze=False)
    for row, (label, entry) in zip(pictures, found.items(), strict=True):
        for axis, moment in zip(row, moments, strict=True):
            frame = round(moment / FRAME_STEP)
            position, before = entry["position"][frame], entry["position"][frame - 1]
            speed = np.linalg.norm(position - before, axis=1) / FRAME_STEP
            order = np.argsort(-position[:, 2])
            axis.scatter(*position[order, :2].T, c=speed[order], s=2.5, cmap="viridis", vmin=0, vmax=4, lw=0)
            axis.set(xlim=(0, TANK[0]), ylim=(0, 1.3), aspect="equal", xticks=[], yticks=[], title=f"{label}, {moment:g} s")
            axis.title.set_fontsize(9)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", nargs="?", help="the published weights, pretrained_model_weights.pt")
    parser.add_argument("--quick", action="store_true", help="a second of it, nothing saved, to see that it runs")
    options = parser.parse_args()
    if options.weights is None:
        print("cconv: left out, for its published weights are no part of this project: python benchmarks/cconv.py WEIGHTS")
        return
    torch.set_num_threads(1)
    model, scene = load_published(options.weights), dam()
    frames = 50 if options.quick else FRAMES
    particles = scene.particles()
    kinds = np.full(len(particles.position), PARTICLE_TYPES["water"], np.int8)
    lattice = particles.position.astype(np.float32)
    solver = SPHSimulator()
    bounds = np.array(scene.bounds)
    first = Start(lattice[None], kinds, 0, FRAME_STEP, scene.radius, bounds, scene.to_dict())
    timed(solver, first, 1)
    truth, solver_ms = timed(solver, first, frames + 1)
    truth = np.concatenate([lattice[None], truth])
    box = bounds + np.array([-OUTSIDE, OUTSIDE])
    predicted, model_ms = timed(model, replace(first, history=truth[:2].astype(np.float32), present=1, bounds=box), frames)
    predicted = np.concatenate([truth[:2], predicted])
    found = {
        "DFSPH": {"position": truth, "ms": solver_ms, "colour": COLOURS["solver"], "falls": 1.0, "box": bounds},
        "CConv": {"position": predicted, "ms": model_ms, "colour": COLOURS["learned"], "falls": fall(model), "box": box},
    }
    time_axis = FRAME_STEP * np.arange(1, frames + 2)
    late = time_axis > time_axis[-1] - 1
    rows = []
    for label, entry in found.items():
        entry["curves"] = c = curves(entry["position"])
        inside = ((entry["position"] >= entry["box"][:, 0]) & (entry["position"] <= entry["box"][:, 1])).all(2)
        spread = (c["front"] > WIDTH * 1.25) & (c["front"] < TANK[0] - SPACING)
        rows.append({
            "case": label, "ms_a_frame": entry["ms"], "free_fall_over_g": entry["falls"],
            "front_speed": float(np.polyfit(time_axis[spread], c["front"][spread], 1)[0]),
            "mean_height_last_second": float(c["height"][late].mean()), "median_density_last_second": float(c["median"][late].mean()),
            "crowded_density_last_second": float(c["crowded"][late].mean()), "most_crowded": float(c["crowded"].max()),
            "energy_gain": float((c["energy"] / c["energy"][0] - 1).max()), "escaped": float(1 - inside.all(0).mean()),
        })  # fmt: skip
    names = list(rows[0])[1:]
    print(f"{len(kinds)} particles, {frames} frames; water at rest has mean height {HEIGHT * WIDTH / TANK[0] / 2:.3f} m")
    print("\n".join(["| | " + " | ".join(row["case"] for row in rows) + " |", "|---" * (len(rows) + 1) + "|"]))
    for name in names:
        print(f"| {name.replace('_', ' ')} | " + " | ".join(f"{row[name]:.3g}" for row in rows) + " |")
    if not options.quick:
        save("cconv", rows, 1)
        draw(ROOT.parent / "docs" / "images" / "cconv_dam_break.png", found, time_axis)


if __name__ == "__main__":
    main()
