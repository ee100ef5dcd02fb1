"""Baselines against their formulas; the oracle against the truth."""

import numpy as np
import pytest

from learn.baselines import Ballistic, ConstantVelocity, Frozen, Oracle, PersistentAcceleration, RigidDrop, trivial_baselines
from sim.simulator import rollout, start_from
from sim.trajectory import Trajectory

STEP, GRAVITY = 0.01, np.array([0.0, -9.81])
BOX = np.array([[0.0, 1.0], [0.0, 1.0]])


def trajectory(position, kind=None, seed=0):
    position = np.asarray(position, np.float32)
    scene = {"name": "hand", "gravity": GRAVITY.tolist(), "spacing": 0.05}
    kind = np.full(position.shape[1], 5, np.int8) if kind is None else np.asarray(kind, np.int8)
    return Trajectory(position, kind, STEP, 0.11, BOX, scene, seed, {"name": "hand"})


def free_fall(frames, start=(0.5, 0.9), velocity=(1.0, 0.5), substeps=7):
    """Symplectic Euler in substeps, as a solver falls."""
    p, v, path = np.array(start, float), np.array(velocity, float), []
    for _ in range(frames):
        path.append(p.copy())
        for _ in range(substeps):
            v = v + GRAVITY * STEP / substeps
            p = p + v * STEP / substeps
    return np.array(path)[:, None]


def run(simulator, truth, frames=None, known=3):
    return rollout(simulator, start_from(truth, known), frames or len(truth.position) - known).position


def test_kinematics_by_hand():
    truth = trajectory(np.array([0.10, 0.11, 0.14])[:, None, None] * np.ones((1, 1, 2)))
    assert run(Frozen(), truth, 2)[:, 0, 0] == pytest.approx([0.14, 0.14])
    assert run(ConstantVelocity(), truth, 2)[:, 0, 0] == pytest.approx([0.17, 0.20], abs=1e-6)
    # a = 0.02 a frame: v = 0.05, 0.07
    assert run(PersistentAcceleration(), truth, 2)[:, 0, 0] == pytest.approx([0.19, 0.26], abs=1e-6)


@pytest.mark.parametrize("simulator", [Ballistic(), RigidDrop()])
def test_free_fall_of_a_solver_is_continued_exactly(simulator):
    truth = trajectory(free_fall(20))
    np.testing.assert_allclose(run(simulator, truth), truth.position[3:], atol=2e-6)


def test_ballistic_stops_at_walls():
    truth = trajectory(free_fall(200, start=(0.8, 0.3), velocity=(2.0, 0.0)))
    path = run(Ballistic(), truth)
    assert path.min() == 0 and path.max() == 1
    np.testing.assert_array_equal(path[-1, 0], [1, 0])
    # The wall takes the normal velocity only: the particle slides down it, on the parabola it was on.
    at_wall = np.argmax(path[:, 0, 0] == 1)
    assert path[at_wall + 1, 0, 1] == pytest.approx(truth.position[3 + at_wall + 1, 0, 1], abs=1e-5)


def test_rigid_drop_keeps_shape_and_lands_half_a_spacing_above_the_floor():
    grid = np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2) * 0.05
    left, right = grid + [0.1, 0.2], grid + [0.6, 0.4]
    fall = free_fall(100, start=(0, 0), velocity=(0, 0))
    path = run(RigidDrop(), trajectory(np.concatenate([left, right])[None] + fall), 97)
    last = path[-1]
    assert last[:16, 1].min() == pytest.approx(0.025, abs=1e-6) and last[16:, 1].min() == pytest.approx(0.025, abs=1e-6)
    np.testing.assert_allclose(np.diff(last[:16], axis=0), np.diff(grid, axis=0), atol=1e-6)
    first_landing = np.argmax(np.abs(path[:, 0, 1] - last[0, 1]) < 1e-7)
    second_landing = np.argmax(np.abs(path[:, 16, 1] - last[16, 1]) < 1e-7)
    assert first_landing < second_landing  # every body for itself
    np.testing.assert_array_equal(path[second_landing:], np.broadcast_to(last, path[second_landing:].shape))


def test_rigid_drop_at_rest_on_the_floor_stays():
    rest = np.tile(np.array([[[0.5, 0.01], [0.55, 0.01]]]), (3, 1, 1))
    path = run(RigidDrop(), trajectory(rest), 5)
    np.testing.assert_array_equal(path, np.broadcast_to(rest[:1].astype(np.float32), path.shape))


def test_rigid_drop_slides_down_a_side_wall():
    truth = trajectory(free_fall(100, start=(0.9, 0.5), velocity=(3.0, 0.0)))
    path = run(RigidDrop(), truth)
    assert path[-1, 0] == pytest.approx([0.975, 0.025], abs=1e-6)
    at_wall = np.argmax(path[:, 0, 0] > 0.974)
    assert path[at_wall + 1, 0, 1] == pytest.approx(truth.position[3 + at_wall + 1, 0, 1], abs=1e-5)


def test_kinematic_particles_follow_their_prescription():
    path = np.concatenate([free_fall(12), np.linspace(0.2, 0.8, 12)[:, None, None] * np.ones((1, 1, 2))], axis=1)
    truth = trajectory(path, kind=[5, 3])
    for simulator in [*trivial_baselines(), Oracle([truth])]:
        np.testing.assert_array_equal(run(simulator, truth)[:, 1], truth.position[3:, 1], err_msg=simulator.name)


def test_too_short_a_history_is_refused():
    truth = trajectory(free_fall(5))
    with pytest.raises(ValueError, match="last 3 frames"):
        PersistentAcceleration().begin(start_from(truth, 2))


def test_oracle_reproduces_a_rough_truth():
    rng = np.random.default_rng(0)
    truths = [trajectory(0.5 + 0.01 * rng.normal(size=(60, 30, 2)).cumsum(axis=0), seed=seed) for seed in range(3)]
    oracle = Oracle(truths)
    for truth in truths:
        np.testing.assert_array_equal(run(oracle, truth, known=2), truth.position[2:])


def test_oracle_ends_with_the_truth_and_knows_only_its_own():
    truth = trajectory(free_fall(8))
    result = rollout(Oracle([truth]), start_from(truth, 2), 10)
    assert result.status == "failed: the truth ends here (frame 8)" and np.isfinite(result.position[:6]).all()
    with pytest.raises(ValueError, match="none of its 1 trajectories"):
        Oracle([truth]).begin(start_from(trajectory(free_fall(8, start=(0.1, 0.1))), 2))


def test_trivial_baselines_are_named_apart():
    names = [simulator.name for simulator in trivial_baselines()]
    assert len(set(names)) == 5 and {simulator.kind for simulator in trivial_baselines()} == {"trivial"}
