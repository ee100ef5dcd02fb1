"""The validation ladder's cases with rigid bodies, at the tolerances of the ladder."""

import pytest

from sim.mpm.solver import MPMSimulator
from sim.validation.block_on_plane import block_on_plane
from sim.validation.float_and_sink import HEIGHT, buoyancy, float_and_sink, pool_scene

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


@pytest.mark.parametrize("phase", [0.0, 1 / 4, 1 / 2, 3 / 4])
def test_buoyancy_wherever_the_faces_are_between_nodes(pool, phase):
    """On a box two cells high."""
    found = buoyancy(phase, cells=16, simulator=pool)
    assert abs(found["error"]) <= 0.05, found


def test_a_neutral_box_stays(pool):
    """Half way down, for a second: less than half a cell of this grid, an eighth of its height."""
    found = float_and_sink(1.0, 0.25, cells=32, seconds=1.0, simulator=pool)
    assert found["drift"] < HEIGHT / 8, found


def test_a_dense_box_sinks_to_the_floor(pool):
    found = float_and_sink(2.0, 0.25, cells=32, seconds=2.0, simulator=pool)
    assert 0 <= found["sunk"] < pool_scene(2.0, 0.25).grid_spacing, "it lies on a film of less than a cell"
