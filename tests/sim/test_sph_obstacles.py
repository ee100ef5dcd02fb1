"""Obstacles under SPH: nothing leaks, nothing sticks, and water over an obstacle is water over a floor."""

import numpy as np
import pytest

from sim.errors import InputError
from sim.obstacles import combine
from sim.scene import Scene
from sim.sph.solver import HAIR, SPHSimulator

#: One solver for all tests of a method: scenes that differ in numbers share its kernels.
SOLVERS = {method: SPHSimulator() for method in ("wcsph", "dfsph")}


def scene(method, obstacles, lower, upper, cells=(40, 40), **changes):
    dim = len(cells)
    content = {
        "name": "solids", "dim": dim, "bounds": [[0.0, 1.0]] * dim, "gravity": [0.0, -9.8, 0.0][:dim], "frame_step": 0.01, "frames": 100,
        "radius": 0.05, "cells": list(cells), "particles_per_cell": 1, "seed": 0, "solver": {"method": method},
        "materials": {"water": {"model": "water", "sound_speed": 30.0}}, "obstacles": obstacles,
        "bodies": [{"material": "water", "kind": "box", "lower": lower, "upper": upper, "velocity": [0.0] * dim}],
    }  # fmt: skip
    return Scene.from_dict(content | changes)


def clearance(what, position):
    return combine(what.surfaces, position.astype(float))[0]


CUP = [{"kind": "segment", "start": start, "end": end, "thickness": 0.08}
       for start, end in (([0.2, 0.3], [0.8, 0.3]), ([0.2, 0.3], [0.2, 1.0]), ([0.8, 0.3], [0.8, 1.0]))]  # fmt: skip


@pytest.mark.physics
@pytest.mark.parametrize("method", ["wcsph", "dfsph"])
def test_a_cup_holds_water(method):
    """Two seconds of sloshing between plates a kernel's radius thick, in corners of plates that overlap and reach the ceiling (spray flies
    over a rim): not one particle leaves, and they spread over the whole cup."""
    what = scene(method, CUP, [0.25, 0.4], [0.5, 0.65])
    solver = SOLVERS[method]
    solver.load(what)
    for _ in range(200):
        position = solver.frame()[: len(what.particles().position)]
    assert (position[:, 0] > 0.2).all() and (position[:, 0] < 0.8).all() and (position[:, 1] > 0.3).all(), "through a plate"
    assert clearance(what, position).min() > -0.05 * what.spacing, "into a plate"
    assert position[:, 0].min() < 0.27 and position[:, 0].max() > 0.73, "water stuck to one side"
    low = position[position[:, 1] < 0.37]
    assert abs(np.diff(np.sort(low[:, 0])).max()) < 4 * what.spacing, "a hole in the lowest layer"


@pytest.mark.physics
@pytest.mark.parametrize("method", ["wcsph", "dfsph"])
def test_water_over_an_obstacle_is_water_over_a_floor(method):
    """The same pool on the floor, and on a half-space 0.2 above it: heights of all particles after a second, to a tenth of a spacing."""
    heights = []
    for obstacles, floor in (([], 0.0), ([{"kind": "halfspace", "point": [0.5, 0.2], "normal": [0.0, 1.0]}], 0.2)):
        what = scene(method, obstacles, [0.0, floor], [1.0, floor + 0.25])
        solver = SPHSimulator()
        solver.load(what)
        for _ in range(100):
            position = solver.frame()[: len(what.particles().position)]
        heights.append(np.sort(position[:, 1]) - floor)
    on_floor, over = heights
    assert np.abs(on_floor - over).max() < 0.5 * what.spacing
    assert np.abs(on_floor - over).mean() < 0.1 * what.spacing


@pytest.mark.physics
def test_spheres_and_meshes_in_three_dimensions():
    """Water falls on a ball and on a box that is a mesh: it ends beside them, never in them, but for what the distance is off by where it is
    interpolated between nodes a spacing apart: most at an edge of the box, 0.15 spacings at a right angle halfway between nodes."""
    corners = np.stack(np.meshgrid([0.6, 0.9], [0.2, 0.5], [0.3, 0.7], indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [list(each) for a, b, c, d in quads for each in ((a, b, c), (a, c, d))]
    obstacles = [{"kind": "ball", "center": [0.3, 0.25, 0.5], "radius": 0.2}, {"kind": "mesh", "vertices": corners.tolist(), "faces": triangles}]
    what = scene("dfsph", obstacles, [0.1, 0.6, 0.2], [0.9, 0.9, 0.8], cells=(20, 20, 20))
    solver = SPHSimulator()
    solver.load(what)
    n = len(what.particles().position)
    for _ in range(150):
        position = solver.frame()[:n]
        assert clearance(what, position).min() > -0.2 * what.spacing
    assert np.isfinite(position).all() and np.median(position[:, 1]) < 0.3, "most of it has fallen past"


def test_what_lies_inside_is_put_on_the_surface():
    """A particle that starts a hair inside a slope of 45 degrees comes out along its normal."""
    s = 2**-0.5
    what = scene("dfsph", [{"kind": "halfspace", "point": [0.5, 0.5], "normal": [-s, s]}], [0.1, 0.8], [0.125, 0.825], gravity=[0.0, 0.0])
    solver = SOLVERS["dfsph"]
    solver.load(what)
    kernels, support = solver._kernels, solver._support
    x = kernels.x.to_numpy()
    x[0, :2] = np.array([0.5, 0.5 - 0.01]) / support
    kernels.x.from_numpy(x)
    end = solver.frame()[0]
    assert end == pytest.approx([0.5 - 0.005, 0.5 - 0.005], abs=2 * HAIR * support)


def test_plates_thinner_than_the_kernel_are_refused():
    with pytest.raises(InputError, match=r"obstacles\[0\].thickness = 0.04.*thinner than the kernel's radius 0.0625"):
        SPHSimulator().load(scene("wcsph", [CUP[0] | {"thickness": 0.04}], [0.25, 0.4], [0.5, 0.65]))


def test_obstacles_rub_as_walls_do():
    with pytest.raises(InputError, match=r"obstacles\[0\].friction = 0.3.*leave it out"):
        scene("dfsph", [CUP[0] | {"friction": 0.3}], [0.25, 0.4], [0.5, 0.65])
