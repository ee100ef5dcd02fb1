"""Shape matching: motions come back exactly, distances stay, mirrors are no rotations, and a grid emulator's body stays one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from learn.rigidity import matched, rigid_bodies
from sim.simulator import rollout
from tests.learn.test_grid_emulator import awaken, emulator, start


def block(dim: int, origin: float = 0.0, spacing: float = 0.05) -> np.ndarray:
    axes = [np.arange(3), np.arange(4), np.arange(2)][:dim]
    return origin + spacing * np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, dim)


def motion(dim: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rotation = Rotation.random(random_state=seed).as_matrix()
    if dim == 2:
        angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rotation, np.random.default_rng(seed).normal(size=dim)


@pytest.mark.parametrize("dim", [2, 3])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_motion_comes_back_and_noise_leaves_the_shape_and_the_centroid(dim: int, seed: int) -> None:
    shape = block(dim)
    rotation, shift = motion(dim, seed)
    moved = shape @ rotation.T + shift
    np.testing.assert_allclose(matched(moved[None], shape)[0], moved, atol=1e-12)
    noisy = moved + np.random.default_rng(seed).normal(0, 0.02, moved.shape)
    found = matched(noisy[None], shape)[0]
    np.testing.assert_allclose(pdist(found), pdist(shape), atol=1e-12)
    np.testing.assert_allclose(found.mean(0), noisy.mean(0), atol=1e-12)
    nearby = moved - moved.mean(0) + noisy.mean(0)  # a motion too: it cannot be nearer
    assert ((found - noisy) ** 2).sum() <= ((nearby - noisy) ** 2).sum() + 1e-12


def test_a_quarter_turn_by_hand() -> None:
    shape = np.array([[0.0, 0.0], [2.0, 0.0]])
    frames = np.array([[[1.0, 0.0], [1.0, 3.0]]])  # stretched by half: the centroid (1, 1.5) stays, the length is 2 again
    np.testing.assert_allclose(matched(frames, shape), [[[1.0, 0.5], [1.0, 2.5]]], atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_mirror_image_is_no_motion(dim: int) -> None:
    shape = block(dim)
    found = matched((shape * np.array([-1.0] + [1.0] * (dim - 1)))[None], shape)[0]
    transform, *_ = np.linalg.lstsq(shape - shape.mean(0), found - found.mean(0), rcond=None)
    assert np.linalg.det(transform) == pytest.approx(1)


def test_frames_that_are_not_finite_stay_as_they_are() -> None:
    frames = np.stack([block(2), block(2)])
    frames[1, 0, 0] = np.nan
    found = matched(frames, block(2))
    np.testing.assert_allclose(found[0], block(2), atol=1e-12)
    np.testing.assert_array_equal(found[1], frames[1])


def test_bodies_are_told_apart_by_distance_and_kind() -> None:
    position = np.concatenate([block(2, 0.1), block(2, 0.5), block(2, 0.3)])
    kind = np.repeat([0, 0, 5], 12)
    first, second = rigid_bodies(position, kind, 0.05)
    np.testing.assert_array_equal(first, np.arange(12))
    np.testing.assert_array_equal(second, np.arange(12, 24))
    assert rigid_bodies(position, np.full(36, 5), 0.05) == []
    wide = position.copy()
    wide[:12, 0] *= 1.6  # neighbours may be so far apart where the teacher is refined twice
    assert len(rigid_bodies(wide, kind, 0.05)) == 2
    (alone,) = rigid_bodies(position[:1], np.array([0]), 0.05)
    assert alone.tolist() == [0]


@pytest.mark.parametrize("stride", [1, 3])
def test_a_body_stays_rigid_under_a_grid_emulator_and_water_is_left_alone(stride: int) -> None:
    model = awaken(emulator(particle_types=(0, 5), stride=stride), 1.0)
    rest = np.concatenate([block(2, 0.4), block(2, 0.6)])
    history = np.repeat(rest[None], model.history, axis=0).astype(np.float32)
    kind = np.repeat([0, 5], 12).astype(np.int8)
    frames = rollout(model, start(history, particle_type=kind), 20).position
    apart = np.array([pdist(frame[:12]) for frame in frames])
    np.testing.assert_allclose(apart, np.broadcast_to(pdist(history[-1, :12]), apart.shape), atol=1e-6)
    model.begin(start(history, particle_type=kind))
    model._bodies = []
    free = model.advance()
    assert np.abs(np.array([pdist(frame[:12]) for frame in free]) - apart[0]).max() > 1e-3  # the network alone deforms it
    np.testing.assert_array_equal(free[:, 12:], frames[: len(free), 12:])
