"""The validation ladder's cases with rigid bodies, at the tolerances of the ladder."""

import numpy as np
import pytest

from sim.mpm.solver import MPMSimulator
from sim.scene import Scene
from sim.validation.block_on_plane import block_on_plane
from sim.validation.float_and_sink import HEIGHT, float_and_sink, pool_scene

pytestmark = pytest.mark.physics


@pytest.fixture(scope="module")
def block():
    return MPMSimulator()


@pytest.fixture(scope="module")
def pool():
    return MPMSimulator()


@pytest.mark.parametrize(("angle", "friction"), [(30, 0.3), (20, 0.0), (45, 0.5)])
def test_a_block_slides_as_coulomb_says(block, angle, friction):
    found = block_on_plane(angle, friction, simulator=block)
    assert abs(found["ours"] - found["reference"]) <= 0.02 * found["reference"], found


@pytest.mark.parametrize(("angle", "friction"), [(20, 0.5), (25, 0.6)])
def test_a_block_sticks_where_friction_is_enough(block, angle, friction):
    found = block_on_plane(angle, friction, simulator=block)
    assert abs(found["ours"]) <= 0.02 * 9.8 and found["way"] < 1e-3, found


def test_a_light_box_floats_at_its_draft(pool):
    found = float_and_sink(0.5, 0.4375, cells=32, seconds=2.5, simulator=pool)
    assert found["error"] <= 0.05, found


def test_a_neutral_box_stays(pool):
    """Half way down, for a second: less than half a cell of this grid, an eighth of its height."""
    found = float_and_sink(1.0, 0.25, cells=32, seconds=1.0, simulator=pool)
    assert found["drift"] < HEIGHT / 8, found


def test_a_dense_box_sinks_to_the_floor(pool):
    found = float_and_sink(2.0, 0.25, cells=32, seconds=2.0, simulator=pool)
    assert 0 <= found["sunk"] < pool_scene(2.0, 0.25).grid_spacing, "it lies on a film of less than a cell"


def test_a_light_cube_floats_at_its_draft_in_3d():
    """A cube of half of water's density, begun at its draft of 2 cells in a pool of 8: mean of the second second, to 10 per cent.

    On so coarse a grid it goes on sinking, by 0.2 cells in five seconds (sim.validation.float_and_sink has the reason).
    """
    width, depth, height, low, high, cell = 0.75, 0.5, 0.25, 0.25, 0.5, 0.0625
    bottom = depth - height / 2
    water = [([0, 0, 0], [width, bottom, width]), ([0, bottom, 0], [low, depth, width]), ([high, bottom, 0], [width, depth, width]),
             ([low, bottom, 0], [high, depth, low]), ([low, bottom, high], [high, depth, width])]  # fmt: skip
    bodies = [("water", *corners) for corners in water] + [("cube", [low, bottom, low], [high, bottom + height, high])]
    scene = Scene.model_validate(
        {
            "name": "pool",
            "dim": 3,
            "bounds": [[0.0, width], [0.0, 1.0], [0.0, width]],
            "gravity": [0.0, -9.8, 0.0],
            "frame_step": 0.01,
            "frames": 201,
            "radius": 0.1,
            "cells": [12, 16, 12],
            "seed": 3,
            "bodies": [{"material": name, "kind": "box", "lower": lower, "upper": upper, "velocity": [0.0] * 3} for name, lower, upper in bodies],
            "materials": {"water": {"model": "water", "sound_speed": 15.0}, "cube": {"model": "rigid", "density": 500.0}},
        }
    )
    simulator, shares, cube = MPMSimulator(), [], scene.particles().material == 1
    simulator.load(scene)
    for frame in range(200):
        position = simulator.frame().astype(float)
        middle, surface = position[cube].mean(0), position[~cube]
        if frame >= 100:
            # Columns of cells away from the cube and from the walls: the highest particle of each and half a spacing.
            column = np.floor(surface[:, [0, 2]] / cell).astype(int) @ [100, 1]
            across = np.array([[c // 100 + 0.5, c % 100 + 0.5] for c in np.unique(column)]) * cell
            aside = (np.abs(across - middle[[0, 2]]).max(1) > height / 2 + 1.5 * cell) & (across > cell).all(1) & (across < width - cell).all(1)
            tops = [surface[column == c, 1].max() for c in np.unique(column)[aside]]
            shares.append((np.mean(tops) + scene.spacing / 2 - middle[1] + height / 2) / height)
    assert abs(middle[[0, 2]] - width / 2).max() < 0.1 * cell, "it floats upright in the middle"
    assert np.mean(shares) == pytest.approx(0.5, rel=0.1)
