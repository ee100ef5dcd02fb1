"""Block on a plane: a rigid block slides down a slope at g (sin t - mu cos t), and sticks where tan t < mu."""

from __future__ import annotations

import time

import numpy as np

from sim.mpm.solver import MPMSimulator
from sim.scene import Scene
from sim.validation import Curve, Outcome

NUMBER = 13
#: Cells along the box; the block is a quarter of it long.
RESOLUTIONS = (32, 48, 64)
G = 9.8
#: Slope [degrees] and coefficient of friction.
SLIDES, STICKS = ((20.0, 0.1), (30.0, 0.3), (40.0, 0.5)), ((10.0, 0.3), (20.0, 0.5), (30.0, 0.7))


def run(resolution: int) -> Outcome:
    """Accelerations at three slopes that slide and three that stick; errors are relative to g."""
    solver, curves, seconds = MPMSimulator(), {}, 0.0
    for name, pairs in (("slides", SLIDES), ("sticks", STICKS)):
        found = [block_on_plane(*pair, resolution, solver) for pair in pairs]
        seconds += sum(each["seconds"] for each in found)
        error = max(each["error"] for each in found)
        exact, ours = (np.array([each[key] / G for each in found]) for key in ("reference", "ours"))
        curves[name] = Curve(f"{name}: largest error of the acceleration over g", ("slope [degrees]", "acceleration / g"), np.array(pairs)[:, 0],
                             exact, ours, error, 0.02)  # fmt: skip
    return Outcome("block_on_plane", resolution, len(block_scene(20.0, 0.0, resolution).particles().position), curves, seconds)


def block_scene(angle: float, friction: float, cells: int = 32) -> Scene:
    """A rigid block, 0.25 x 0.1, laid on a half-space of slope ``angle`` [degrees] near its upper end; unit box."""
    t = np.radians(angle)
    along, up = np.array([np.cos(t), -np.sin(t)]), np.array([np.sin(t), np.cos(t)])
    point = np.array([0.5, 0.35])
    foot = point + along * (0.12 - 0.5) / np.cos(t)
    corners = [foot + along * s + up * h for s, h in ((0, 0), (0.25, 0), (0.25, 0.1), (0, 0.1))]
    return Scene.model_validate(
        {
            "name": "block",
            "dim": 2,
            "bounds": [[0.0, 1.0], [0.0, 1.0]],
            "gravity": [0.0, -G],
            "frame_step": 0.005,
            "frames": 100,
            "radius": 0.1,
            "cells": [cells, cells],
            "materials": {"block": {"model": "rigid", "density": 1000.0}},
            "seed": 0,
            "bodies": [{"material": "block", "kind": "polygon", "vertices": [corner.tolist() for corner in corners], "velocity": [0.0, 0.0]}],
            "obstacles": [{"kind": "halfspace", "point": point.tolist(), "normal": up.tolist(), "friction": friction}],
        }
    )


def block_on_plane(angle: float, friction: float, cells: int = 32, simulator: MPMSimulator | None = None) -> dict:
    """Acceleration down the slope [m/s^2] of a block at rest on it; the error is relative to g, for a stuck block's reference is 0.

    The particles of a block that is turned against their lattice have a ragged face, so it settles first: a parabola is fitted to the
    centre's way down the slope after 0.1 s, up to 0.4 s.
    """
    scene = block_scene(angle, friction, cells)
    simulator = simulator or MPMSimulator()
    simulator.load(scene)
    t = np.radians(angle)
    begun, count, way = time.perf_counter(), len(scene.particles().position), []
    for _ in range(80):
        way.append(simulator.frame()[:count].astype(float).mean(0) @ [np.cos(t), -np.sin(t)])
    times = scene.frame_step * np.arange(1, 81)
    late = times > 0.1
    ours = 2 * np.polyfit(times[late], np.array(way)[late], 2)[0]
    reference = G * max(np.sin(t) - friction * np.cos(t), 0.0)
    return {
        "reference": reference,
        "ours": float(ours),
        "error": float(abs(ours - reference) / G),
        "seconds": time.perf_counter() - begun,
        "way": way[-1] - way[19],
    }
