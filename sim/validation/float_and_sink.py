"""Float and sink: a rigid box floats with draft / height = rho_b / rho_w, rests on the floor if denser, and stays where it is if neutral."""

from __future__ import annotations

import time

import numpy as np

from sim.scene import Scene
from sim.solvers import solver_class
from sim.sph.kernel import kernel, lattice_scale
from sim.validation import Curve, Outcome

NUMBER = 16
METHODS = ("mpm", "wcsph", "dfsph", "pbf")
#: Cells along the pool; the box is a quarter of it long.
RESOLUTIONS = (16, 32, 64)
WIDTH, HEIGHT, DEPTH = 0.25, 0.125, 0.5
RATIOS = np.array([0.3, 0.5, 0.8])
SOUND_SPEED = 15.0


def run(resolution: int, method: str) -> Outcome:
    """Three boxes that float, started at their draft in a pool as deep as without them, and one as dense as water half way down.

    Their drafts are their buoyancy, which is their weight. A box as dense as water *at rest* would not stay: under d = 1/4 of water rho is
    rho0 (1 + 7 g d / c^2)^(1/7), 1.1 % more, which lifts it. The neutral box has the water's own density there. Its drift is what it moves
    more than the water that began beside it, for the pool settles under its own weight.

    By MPM and by both methods of SPH (``sim.sph.rigid``), whose floating boxes begin on the layer of particles nearest to their draft. MPM:

    A node is the box's or the water's, by half its volume (``sim.mpm.rigid``), so that a face that lies between nodes displaces up to 0.15 cells
    too little: drafts of faces that start on nodes (density ratio 1/2) are right on coarse grids, the others converge. The neutral box feels
    the same error as a hundredth of its weight, and nothing holds it: one as dense as water at rest, lifted by as much, stays within 8 % of
    its height on the finest grid.

    Tried instead (in the history: "Rigid bodies meet the grid at points of their faces"): no node is the body's, points of its faces are contacts
    with the grid's velocity there. Of a box held in still water this buoyancy is 3 to 7 % short on the middle grid and 9 to 18 % on the coarse one,
    by where its faces stand between nodes; that one was 1 to 4 % short, and its neutral box drifted a third of its height on the finest grid. But
    no water got under a body that had touched the floor, so that light ones stayed there.
    """
    solver, spacing = solver_class(method)(), 1 / (2 * resolution)
    starts = [DEPTH - ratio * HEIGHT for ratio in RATIOS]
    if method != "mpm":
        starts = [round(start / spacing) * spacing for start in starts]
    found = [float_and_sink(ratio, start, resolution, method=method, simulator=solver) for ratio, start in zip(RATIOS, starts, strict=True)]
    density = 1.0 if method in ("dfsph", "pbf") else (1 + 7 * 9.8 * (DEPTH / 2) / SOUND_SPEED**2) ** (1 / 7)
    neutral = float_and_sink(density, (DEPTH - HEIGHT) / 2, resolution, method=method, simulator=solver)
    ours, error = np.array([each["ours"] for each in found]), max(each["error"] for each in found)
    drift = neutral["drift"] / HEIGHT
    curves = {
        "draft": Curve("largest relative error of the draft", ("rho_b / rho_w", "draft / height"), RATIOS, RATIOS, ours, error, 0.05),
        "neutral": Curve("drift of a neutral box in 3 s over its height", ("", "drift / height"), np.array([0.0, 1.0]), np.zeros(2),
                         np.array([0.0, drift]), drift, 0.05),
    }  # fmt: skip
    seconds = sum(each["seconds"] for each in (*found, neutral))
    return Outcome("float_and_sink", resolution, len(pool_scene(1.0, 0.1875, resolution).particles().position), curves, seconds)


def pool_scene(ratio: float, bottom: float, cells: int = 32, sound_speed: float = SOUND_SPEED, method: str = "mpm") -> Scene:
    """A pool 1 wide and about 0.5 deep, a box 0.25 x 0.125 of ``ratio`` times water's density in its middle, its lower face at ``bottom``.

    Where the box is, there is no water: the pool is made of the rectangles around it.
    """
    left, right, top = 0.5 - WIDTH / 2, 0.5 + WIDTH / 2, bottom + HEIGHT
    water = [([0.0, 0.0], [left, DEPTH]), ([right, 0.0], [1.0, DEPTH]), ([left, 0.0], [right, min(bottom, DEPTH)]), ([left, top], [right, DEPTH])]
    bodies = [
        {"material": "water", "kind": "box", "lower": lower, "upper": upper, "velocity": [0.0, 0.0]}
        for lower, upper in water
        if lower[1] < upper[1] - 1e-9
    ]
    bodies.append({"material": "box", "kind": "box", "lower": [left, bottom], "upper": [right, top], "velocity": [0.0, 0.0]})
    return Scene.model_validate(
        {
            "name": "pool",
            "dim": 2,
            "bounds": [[0.0, 1.0], [0.0, 1.0]],
            "gravity": [0.0, -9.8],
            "frame_step": 0.01,
            "frames": 300,
            "radius": 0.1,
            "cells": [cells, cells],
            "seed": 0,
            "bodies": bodies,
            "solver": {"method": method},
            "materials": {"water": {"model": "water", "sound_speed": sound_speed}, "box": {"model": "rigid", "density": 1000.0 * ratio}},
        }
    )


def float_and_sink(ratio: float, bottom: float, cells: int = 32, seconds: float = 3.0, method: str = "mpm", simulator=None) -> dict:
    """Immersed share of the box's height, mean of the last second: ``ratio`` if it floats; the error is the relative difference.

    The surface: mean height, further than half a width from the box and two cells from the walls, up to which the kernels of the water's particles
    sum up to more than 1/2 (the highest particle of a column is above it where particles jostle: in DFSPH a tenth of a spacing). ``sunk``: height of
    the box's lower face over the floor at the end; ``drift``: how far its centre moved from the start, less the mean rise of the water that began at
    its height.
    """
    scene = pool_scene(ratio, bottom, cells, method=method)
    simulator = simulator or solver_class(method)()
    simulator.load(scene)
    particles = scene.particles()
    box, begun, shares = particles.material == 1, time.perf_counter(), []
    for frame in range(round(seconds / scene.frame_step)):
        position = simulator.frame().astype(float)
        if frame * scene.frame_step >= seconds - 1.0:
            water = position[~box]
            middle, columns = position[box].mean(0), (np.arange(2, cells - 2) + 0.5) * scene.grid_spacing
            surface = np.mean([level(water, x, scene.spacing) for x in columns[np.abs(columns - middle[0]) > WIDTH]])
            shares.append((surface - (middle[1] - HEIGHT / 2)) / HEIGHT)
    ours, moved = float(np.mean(shares)), position - particles.position
    low, high = particles.position[box, 1].min(), particles.position[box, 1].max()
    beside = ~box & (particles.position[:, 1] >= low) & (particles.position[:, 1] <= high)
    drift = moved[box].mean(0) - [0.0, moved[beside, 1].mean()]
    return {"reference": min(ratio, 1.0), "ours": ours, "error": abs(ours / ratio - 1), "seconds": time.perf_counter() - begun,
            "sunk": float(position[box][:, 1].min() - scene.spacing / 2),
            "drift": float(np.linalg.norm(drift))}  # fmt: skip


def level(water: np.ndarray, x: float, spacing: float, support: float = 2.5) -> float:
    """Height at x of the surface of 2D water [n, 2]: the highest at which kernels of ``support`` spacings sum up to 1/2."""
    reach = support * spacing
    near = water[np.abs(water[:, 0] - x) < reach]
    y = near[:, 1].max() + np.arange(-16, 2, 0.05) * spacing
    r = np.hypot(near[:, 0] - x, near[:, 1] - y[:, None]) / reach
    share = lattice_scale(2, 1 / support) / support**2 * kernel(2, r).sum(1)
    k = np.flatnonzero(share >= 0.5)[-1]
    return float(y[k] + 0.05 * spacing * (share[k] - 0.5) / (share[k] - share[k + 1]))
