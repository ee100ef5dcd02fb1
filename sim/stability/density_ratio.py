"""Densities 1000 : 1: balls collide, water strikes rigid boxes in free space and holds them in a pool; momentum is exact, energy bounded."""

import time

import numpy as np

from sim.scene import Scene
from sim.stability import BOUND, Cell
from sim.stability.driver import SPH, deep, follow, solver_for
from sim.validation import scene

EXPECTED = "momentum kept to rounding, energy bounded"
HEAVY, LIGHT, E, CELLS, SPEED, FRAMES = 1000.0, 1.0, 1e4, 24, 2.0, 100
#: Momentum is rounded some 25 times a substep, in the sums over nine nodes to and fro and over the particles around a node: a random walk.
EPS, ROUNDINGS = float(np.finfo(np.float32).eps), 25


#: Densities of rigid bodies in SPH over that of water.
RATIOS = (1e-3, 1.0, 1e3)
POOL = "no energy gained, in the box; at the surface if light, on the floor if heavy, still in the water if neither"


def run() -> list[Cell]:
    """The heavy ball strikes the light one, and the other way round; then rigid bodies in the water of SPH, in 2D and 3D."""
    cells = _balls()
    for name in SPH:
        for dim in (2, 3):
            for ratio in RATIOS:
                cells += [_struck(name, dim, ratio), _held(name, dim, ratio)]
    return cells


def _bodies(name: str, dim: int, ratio: float, gravity: float, water: list, body: dict):
    materials = {"water": SPH[name], "box": {"model": "rigid", "density": 1000.0 * ratio}}
    boxes = [{"material": "water", "kind": "box", "lower": lower, "upper": upper} | more for lower, upper, more in water]
    what = scene("density-ratio", {}, [*boxes, {"material": "box", "kind": "box"} | body], [[0.0, 1.0]] * 2, [16, 16], 0.005,
                 gravity=[0.0, -gravity], materials=materials, solver={"method": name})  # fmt: skip
    return deep(what, 0.375, 0.625) if dim == 3 else what


def _struck(name: str, dim: int, ratio: float) -> Cell:
    """Water at 2 m/s in free space."""
    begun, cell = time.perf_counter(), f"{name}, water strikes a box of {ratio:g} times its density{', 3D' if dim == 3 else ''}"
    thrown = [([0.125, 0.375], [0.4375, 0.625], {"velocity": [SPEED, 0.0]})]
    what = _bodies(name, dim, ratio, 0.0, thrown, {"lower": [0.5, 0.375], "upper": [0.625, 0.5], "velocity": [0.0, 0.0]})
    particles = what.particles()
    mass = np.array([material.density for material in what.materials.values()])[particles.material]
    run = follow(what, 16)
    end = solver_for(what).state()["velocity"]
    size = max(np.abs(mass[:, None] * velocity).sum() for velocity in (particles.velocity, end))
    drift, steps = float(np.abs(mass @ end - mass @ particles.velocity).max() / size), float(run.substeps.sum())
    speed, growth, tolerance = float(end[particles.material == 1, 0].mean()), run.growth(run.energy[0]), EPS * np.sqrt(ROUNDINGS * steps)
    right = run.ok and speed > 0 and drift <= tolerance and growth <= 1e-3
    observed = f"momentum off by {drift:.2g} of sum |m v| after {steps:.0f} steps, energy at most {1 + growth:.4g}" if run.ok else run.status
    numbers = {"momentum_drift": drift, "tolerance": tolerance, "energy_growth": growth, "speed_of_the_struck": speed}
    return Cell("density_ratio", cell, right, EXPECTED, observed, numbers, time.perf_counter() - begun, {cell: run.energy_curve(run.energy[0])})


def _held(name: str, dim: int, ratio: float) -> Cell:
    """A second in the middle of a pool half a metre deep, in 3D a quarter wide, with the box across all of it but for a cell at each side."""
    begun, cell = time.perf_counter(), f"{name}, a box of {ratio:g} times water's density in a pool{', 3D' if dim == 3 else ''}"
    low, high, still = 0.1875, 0.3125, {"velocity": [0.0, 0.0]}
    water = [([0.0, 0.0], [0.375, 0.5], still), ([0.625, 0.0], [1.0, 0.5], still), ([0.375, 0.0], [0.625, low], still),
             ([0.375, high], [0.625, 0.5], still)]  # fmt: skip
    what = _bodies(name, dim, ratio, 9.8, water, {"lower": [0.375, low], "upper": [0.625, high]} | still)
    if dim == 3:
        what = _narrow(what)
    box = what.particles().material == 1
    run = follow(what, 200)
    if not run.ok:
        return Cell("density_ratio", cell, False, POOL, run.status, {}, time.perf_counter() - begun)
    places = run.position[: len(box)]
    inside, middle = bool((places >= 0).all() and (places <= 1).all()), float(places[box, 1].mean())
    # At hand: what the box may release by rising or sinking through the pool, and the water that takes its place.
    volume, width = box.sum() * what.spacing**dim, 0.5
    scale = max(ratio, 1.0) * 1000.0 * 9.8 * volume * width
    growth = run.growth(scale)
    there = middle > 0.4375 if ratio < 0.5 else middle < 0.125 if ratio > 2 else 0.0625 < middle < 0.4375
    observed = f"centre at {middle:.3g} m, energy at most {growth:.2g} of what is at hand above the start's"
    numbers = {"height": middle, "energy_growth": growth, "fastest": float(run.speed.max())}
    return Cell("density_ratio", cell, inside and there and growth <= 0.01, POOL, observed, numbers, time.perf_counter() - begun,
                {cell: run.energy_curve(scale)})  # fmt: skip


def _narrow(what: Scene) -> Scene:
    """The pool from wall to wall along the third axis, the box in its middle."""
    content = what.to_dict()
    for body in content["bodies"]:
        water = body["material"] == "water"
        body["lower"], body["upper"] = [*body["lower"][:2], 0.0 if water else 0.0625], [*body["upper"][:2], 0.25 if water else 0.1875]
    low, high = [0.375, 0.1875], [0.625, 0.3125]
    water = next(body for body in content["bodies"] if body["material"] == "water")
    content["bodies"] += [water | {"lower": [*low, z], "upper": [*high, z + 0.0625]} for z in (0.0, 0.1875)]
    return Scene.from_dict(content | {"bounds": [*content["bounds"][:2], [0.0, 0.25]], "cells": [*content["cells"][:2], 4]})


def _balls() -> list[Cell]:
    cells = []
    materials = {name: {"model": "elastic", "density": rho, "young_modulus": E} for name, rho in (("heavy", HEAVY), ("light", LIGHT))}
    for striker in materials:
        begun = time.perf_counter()
        bodies = [
            {"material": name, "kind": "ball", "center": [at, 0.5], "radius": 0.125, "velocity": [SPEED if name == striker else 0.0, 0.0]}
            for name, at in zip(("heavy", "light") if striker == "heavy" else ("light", "heavy"), (0.35, 0.65), strict=True)
        ]
        what = scene("density-ratio", {}, bodies, [[0.0, 1.0]] * 2, [CELLS] * 2, 0.0005, materials=materials)
        mass = np.array([HEAVY, LIGHT])[what.particles().material]
        start = mass @ what.particles().velocity
        run = follow(what, FRAMES)
        end = solver_for(what).state()["velocity"]
        momentum, size = mass @ end, max(np.abs(mass[:, None] * velocity).sum() for velocity in (what.particles().velocity, end))
        drift, steps = float(np.abs(momentum - start).max() / size), float(run.substeps.sum())
        struck = float(np.abs(end[mass != (HEAVY if striker == "heavy" else LIGHT)]).max())
        growth = run.growth(run.energy[0])
        right = run.ok and struck > 0 and drift <= EPS * np.sqrt(ROUNDINGS * steps) and growth <= BOUND - 1
        observed = f"momentum off by {drift:.2g} of sum |m v| after {steps:.0f} steps, energy at most {1 + growth:.4g}" if run.ok else run.status
        numbers = {"momentum_drift": drift, "tolerance": EPS * np.sqrt(ROUNDINGS * steps), "energy_growth": growth, "speed_of_the_struck": struck}
        cells.append(Cell("density_ratio", f"{striker} strikes", right, EXPECTED, observed, numbers, time.perf_counter() - begun,
                          {f"{striker} strikes": run.energy_curve(run.energy[0])}))  # fmt: skip
    return cells
