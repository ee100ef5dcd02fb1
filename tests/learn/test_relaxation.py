"""Relaxation of rollouts: hand-computed pairs, what must not move, mirrors, and both models with it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from learn.relaxation import LONGEST, SUPPORT, Relaxation, relax

SPACING = 0.1
BOX = np.array([[-5.0, 5.0], [-5.0, 5.0]])


def lattice(n: int, dim: int = 2, spacing: float = SPACING) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(n) * spacing] * dim, indexing="ij"), -1).reshape(-1, dim)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_for_the_rollout_to_name(bad):
    position = lattice(3)
    position[4, 1] = bad
    np.testing.assert_array_equal(relax(position, BOX, SPACING, Relaxation()), position)


def test_a_pair_by_hand():
    """Two particles r apart: rho = w (1 + c^2), c = 1 - r / h; each moves strength spacing 2 p c along the line between them."""
    r = 0.02
    closeness = 1 - r / (SUPPORT * SPACING)
    density = 6 / (math.pi * SUPPORT**2) * (1 + closeness**2)
    settings = Relaxation(loops=1, strength=0.1, density=1.0)
    assert density < 1  # a pair alone is no crowd
    position = np.array([[0.0, 0.0], [r, 0.0]])
    np.testing.assert_array_equal(relax(position, BOX, SPACING, settings), position)

    trio = np.array([[0.0, 0.0], [r, 0.0], [r / 2, 0.0]])
    near = 1 - r / 2 / (SUPPORT * SPACING)
    outer, middle = (6 / (math.pi * SUPPORT**2) * (1 + a) for a in (closeness**2 + near**2, 2 * near**2))
    move = 0.1 * SPACING * (2 * (outer - 1) * closeness + (outer + middle - 2) * near)
    assert move < LONGEST * SPACING
    np.testing.assert_allclose(relax(trio, BOX, SPACING, settings), trio + [[-move, 0], [move, 0], [0, 0]], atol=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_lattice_is_no_crowd_and_a_squeezed_one_is(dim):
    """The kernel is normalised: the lattice's density is about 1 in two and three dimensions, one squeezed to 0.6 has 0.6^-dim."""
    box = np.array([[-9.0, 9.0]] * dim)
    bulk = lattice(7, dim) + 1.0
    np.testing.assert_array_equal(relax(bulk, box, SPACING, Relaxation(density=1.3)), bulk)
    squeezed = lattice(7, dim, 0.6 * SPACING) + 1.0
    wider = relax(squeezed, box, SPACING, Relaxation(density=1.3))
    assert np.ptp(wider) > np.ptp(squeezed)


def test_a_spray_is_left_alone():
    position = np.random.default_rng(0).uniform(-4, 4, (100, 2))
    np.testing.assert_array_equal(relax(position, BOX, SPACING, Relaxation()), position)


@given(st.integers(0, 2**31), st.sampled_from([2, 3]))
def test_equivariance_and_momentum(seed, dim):
    """Order and place of the particles do not matter; away from walls the centre of mass stays while no step is cut short."""
    rng = np.random.default_rng(seed)
    position = rng.normal(0, 0.1, (40, dim))
    box = np.array([[-50.0, 50.0]] * dim)
    settings = Relaxation(loops=2, strength=1e-4, density=1.5)
    moved = relax(position, box, SPACING, settings)
    order = rng.permutation(40)
    np.testing.assert_allclose(relax(position[order], box, SPACING, settings), moved[order], atol=1e-12)
    np.testing.assert_allclose(relax(position + 3.0, box, SPACING, settings), moved + 3.0, atol=1e-9)
    np.testing.assert_allclose(moved.mean(0), position.mean(0), atol=1e-12)
    np.testing.assert_allclose(relax(position * [-1.0] + 0.0, box, SPACING, settings), -moved, atol=1e-12)


def test_a_wall_mirrors_and_a_corner_too():
    """Particles at a wall feel images as if the scene were doubled: relaxing the doubled scene in a wide box gives the same."""
    rng = np.random.default_rng(1)
    position = rng.uniform(0.0, 0.25, (40, 2))
    walls, wide = np.array([[0.0, 10.0], [0.0, 10.0]]), np.array([[-50.0, 50.0], [-50.0, 50.0]])
    doubled = np.concatenate([position * sign for sign in ([1, 1], [-1, 1], [1, -1], [-1, -1])])
    settings = Relaxation(loops=3, strength=0.05, density=1.2)
    moved = relax(position, walls, SPACING, settings)
    np.testing.assert_allclose(moved, relax(doubled, wide, SPACING, settings)[:40], atol=1e-12)
    assert not np.allclose(moved, relax(position, wide, SPACING, settings)[:40], atol=1e-4)


def test_kinematic_particles_push_and_stay():
    position = np.concatenate([np.zeros((1, 2)), np.random.default_rng(2).normal(0, 0.02, (20, 2))])
    fixed = np.arange(21) == 0
    moved = relax(position, BOX, SPACING, Relaxation(density=1.0), fixed)
    np.testing.assert_array_equal(moved[0], position[0])
    assert not np.allclose(moved[1:], relax(position[1:], BOX, SPACING, Relaxation(density=1.0)))


def test_no_step_is_longer_than_a_quarter_of_a_spacing():
    position = np.random.default_rng(3).normal(0, 0.01, (200, 2))
    moved = relax(position, BOX, SPACING, Relaxation(loops=1, strength=100.0))
    length = np.linalg.norm(moved - position, axis=1)
    assert length.max() <= LONGEST * SPACING * (1 + 1e-9) and length.max() > 0.9 * LONGEST * SPACING


@pytest.mark.parametrize("bad", [{"loops": 0}, {"strength": 0.0}, {"density": 0.5}, {"reach": 1}])
def test_settings_are_checked(bad):
    with pytest.raises(ValidationError):
        Relaxation(**bad)
