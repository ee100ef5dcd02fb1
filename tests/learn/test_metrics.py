"""Metrics against values computed by hand, and the properties that a distance between clouds must have."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import linear_sum_assignment

from learn import metrics
from sim.errors import InputError
from sim.obstacles import Ball, Halfspace, Segment
from sim.scene import SceneFamily
from sim.trajectory import Trajectory

BOX = np.array([[0.0, 1.0], [0.0, 1.0]])
DOWN = np.array([0.0, -9.81])


def two_frames():
    """Two frames, two particles: errors (1, 0), (0, 0) and then (3, 4), (0, 0)."""
    true = np.zeros((2, 2, 2), np.float32)
    predicted = true.copy()
    predicted[0, 0] = (1, 0)
    predicted[1, 0] = (3, 4)
    return predicted, true


def test_mse_by_hand():
    predicted, true = two_frames()
    np.testing.assert_allclose(metrics.frame_mse(predicted, true), [1 / 4, 25 / 4])
    assert metrics.one_step_mse(predicted, true) == pytest.approx(26 / 8)
    assert metrics.rollout_mse(predicted, true, (1, 2, 3)) == {"1": 0.25, "2": 3.25, "3": None, "all": 3.25}
    np.testing.assert_allclose(metrics.rms_distance(predicted, true), [math.sqrt(1 / 2), math.sqrt(25 / 2)])


def test_float64_accumulation():
    true = np.zeros((1, 100_000, 1), np.float32)
    predicted = np.full_like(true, 1e-3)
    predicted[0, 0] = 1e4  # in float32 its square would swallow the rest
    assert metrics.rollout_mse(predicted, true)["all"] == pytest.approx(1e3 + 1e-6 * 0.99999, rel=1e-12)


def test_divergence_time_and_non_finite():
    predicted, true = two_frames()
    assert metrics.divergence_time(predicted, true, radius=1.0, frame_step=0.5) == 1.0
    assert metrics.divergence_time(predicted, true, radius=4.0, frame_step=0.5) == math.inf
    assert metrics.first_non_finite(predicted) == math.inf
    predicted[1, 1, 0] = np.nan
    assert metrics.first_non_finite(predicted) == 2
    assert metrics.divergence_time(predicted, true, radius=100.0, frame_step=0.5) == 1.0
    assert math.isnan(metrics.rollout_mse(predicted, true)["all"]) and metrics.rollout_mse(predicted, true)["1"] == 0.25


def test_escaped_fraction():
    position = np.array([[[0.5, 0.5], [1.0, 0.0]], [[1.1, 0.5], [0.5, 0.5]], [[np.nan, 0], [0, 0]]])
    escaped = metrics.escaped_fraction(position, BOX)
    np.testing.assert_array_equal(escaped[:2], [0.0, 0.5])
    assert math.isnan(escaped[2])


def test_penetrated_fraction():
    plate = Segment(kind="segment", start=[0.2, 0.5], end=[0.8, 0.5], thickness=0.2)  # its faces at heights 0.4 and 0.6
    ball = Ball(kind="ball", center=[0.5, 0.1], radius=0.05)
    position = np.array([[[0.5, 0.62], [0.5, 0.1]], [[0.5, 0.585], [0.5, 0.9]], [[0.5, 0.57], [0.5, 0.43]], [[np.nan, 0], [0, 0]]])
    inside = metrics.penetrated_fraction(position, [plate, ball], BOX, spacing=0.04)  # deeper than 0.02 counts
    np.testing.assert_array_equal(inside[:3], [0.5, 0, 1])
    assert math.isnan(inside[3])
    floor = Halfspace(kind="halfspace", point=[0.0, 0.2], normal=[0.0, 1.0])
    below = np.array([[[0.5, 0.1], [0.5, -0.1]]])  # the second has left the container, and is counted there
    np.testing.assert_array_equal(metrics.penetrated_fraction(below, [floor], BOX, spacing=0.04), [0.5])
    np.testing.assert_array_equal(metrics.escaped_fraction(below, BOX), [0.5])


def test_kinetic_energy_and_momentum():
    before = np.zeros((2, 2))
    position = np.array([[[0.3, 0.4], [0.0, 0.0]], [[0.3, 0.4], [0.0, 0.0]]])
    velocity = metrics.velocities(position, before, frame_step=0.1)
    np.testing.assert_allclose(velocity[0, 0], [3, 4])
    np.testing.assert_allclose(metrics.kinetic_energy(velocity), [25 / 4, 0])
    rest = np.zeros_like(velocity)
    assert metrics.kinetic_energy_mse(rest, velocity) == pytest.approx((25 / 4) ** 2 / 2)
    # |mean v| = 2.5; root mean square speed = sqrt(25 / 4) over 2 frames x 2 particles
    assert metrics.momentum_drift(rest, velocity) == pytest.approx(1.0)
    assert metrics.momentum_drift(velocity, rest) is None


def test_earth_movers_distance():
    p = np.array([[0.0, 0.0], [1.0, 0.0]])
    q = np.array([[1.0, 0.3], [0.0, 0.1]])  # matched crosswise: distances 0.1 and 0.3
    assert metrics.earth_movers_distance(p, q, spacing=0.1) == pytest.approx(2.0)


def test_subsample_is_fixed():
    np.testing.assert_array_equal(metrics.subsample(5, 9), np.arange(5))
    chosen = metrics.subsample(1000, 50)
    assert len(set(chosen)) == 50 and (np.diff(chosen) > 0).all()
    np.testing.assert_array_equal(chosen, metrics.subsample(1000, 50))


def test_sinkhorn_single_points():
    """One point each: there is one plan, so that OT is the squared distance whatever epsilon."""
    assert metrics.sinkhorn_divergence(np.array([[0.0, 0.0]]), np.array([[3.0, 4.0]]), epsilon=0.7) == pytest.approx(25.0)


def test_entropic_transport_two_points():
    """Two points a distance 1 apart against themselves: the symmetric 2 x 2 plan [[a, b], [b, a]], a / b = exp(1 / epsilon), by hand."""
    p, epsilon = np.array([[0.0], [1.0]]), 0.5
    b = 0.5 / (1 + math.exp(1 / epsilon))
    a = 0.5 - b
    value = 2 * b + epsilon * (2 * a * math.log(4 * a) + 2 * b * math.log(4 * b))
    assert metrics.entropic_transport(p, p, epsilon) == pytest.approx(value, rel=1e-6)
    assert metrics._self_transport(p, epsilon) == pytest.approx(value, rel=1e-5)


def test_sinkhorn_tends_to_the_exact_cost():
    rng = np.random.default_rng(0)
    p, q = rng.uniform(size=(30, 2)), rng.uniform(size=(30, 2)) + [1.0, 0]
    squared = ((p[:, None] - q) ** 2).sum(-1)
    exact = squared[linear_sum_assignment(squared)].mean()
    assert metrics.sinkhorn_divergence(p, q, epsilon=1e-3) == pytest.approx(exact, rel=1e-2)


def test_sinkhorn_of_clouds_of_different_size_and_far_apart():
    line = np.linspace(0, 1, 20)[:, None]
    assert metrics.sinkhorn_divergence(line, line[::2] + 100.0, epsilon=0.01) == pytest.approx(100.0**2, rel=1e-2)


def test_sinkhorn_of_droplets_that_nothing_joins():
    """Clumps of one and five coincident points, too far apart for plain Sinkhorn steps: moving mass 1/3 by 0.5 costs 0.25 / 3."""
    p, q = (np.array([[0.0, 0.5]] * n + [[0.5, 0.5]] * (6 - n)) for n in (1, 3))
    assert metrics.sinkhorn_divergence(p, p, epsilon=0.01) == pytest.approx(0, abs=1e-7)
    assert metrics.sinkhorn_divergence(p, q, epsilon=0.002) == pytest.approx(0.25 / 3, abs=0.002)


@pytest.mark.parametrize("seed", range(3))
def test_sinkhorn_of_splashes(seed):
    """A layer and fifty drops up to tens of sqrt(epsilon) apart: where undamped Newton steps ran away."""
    random, epsilon = np.random.default_rng(seed), 0.015**2
    p, q = (np.concatenate([random.random((250, 2)) * [0.8, 0.15], random.random((50, 2)) * 0.8]) for _ in range(2))
    assert metrics.sinkhorn_divergence(p, p, epsilon) == pytest.approx(0, abs=3e-6 * epsilon)
    value = metrics.sinkhorn_divergence(p, q, epsilon)
    exact = (metrics.cdist(p, q, "sqeuclidean")[metrics.linear_sum_assignment(metrics.cdist(p, q, "sqeuclidean"))]).mean()
    assert 0 < value < exact + 3e-6 * epsilon
    assert value == pytest.approx(metrics.sinkhorn_divergence(q, p, epsilon), abs=3e-6 * epsilon)


def test_sinkhorn_says_when_it_does_not_converge():
    p = np.random.default_rng(0).normal(size=(20, 2))
    assert math.isnan(metrics.sinkhorn_divergence(p, p * 1e12, epsilon=1e-3))


clouds = arrays(float, (6, 2), elements=st.floats(-1, 1, width=32))


@settings(max_examples=40, deadline=None)
@given(clouds, clouds, st.floats(0.02, 1.0))
def test_sinkhorn_is_not_negative_and_symmetric(p, q, epsilon):
    value = metrics.sinkhorn_divergence(p, q, epsilon)
    assert value >= -1e-5
    assert value == pytest.approx(metrics.sinkhorn_divergence(q, p, epsilon), abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(clouds, st.floats(0.02, 1.0), st.floats(-2, 2), st.floats(-2, 2))
def test_sinkhorn_of_a_moved_cloud_is_the_squared_distance(p, epsilon, x, y):
    assert metrics.sinkhorn_divergence(p, p, epsilon) == pytest.approx(0, abs=1e-5)
    assert metrics.sinkhorn_divergence(p + [x, y], p, epsilon) == pytest.approx(x * x + y * y, abs=1e-4)


@settings(max_examples=40, deadline=None)
@given(clouds, clouds)
def test_cloud_metrics_do_not_know_particle_order(p, q):
    other = q[::-1]
    assert metrics.earth_movers_distance(p, q, 0.1) == pytest.approx(metrics.earth_movers_distance(p, other, 0.1), abs=1e-9)
    assert metrics.earth_movers_distance(p, p[::-1], 0.1) == pytest.approx(0, abs=1e-9)
    assert metrics.centre_of_mass_error(p, q, 0.1) <= metrics.earth_movers_distance(p, q, 0.1) + 1e-9


def lattice(columns, rows, spacing=0.05, origin=(0.1, 0.1)):
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), -1).reshape(-1, 2) * spacing + origin


def test_density_conserves_mass_and_is_one_at_rest():
    cloud = lattice(16, 16, origin=(0.125, 0.125))
    grid = metrics.density(cloud, BOX, cell=0.1, spacing=0.05)
    assert grid.shape == (11, 11)
    assert grid.sum() * 0.1**2 == pytest.approx(len(cloud) * 0.05**2)
    np.testing.assert_allclose(grid[3:8, 3:8], 1.0)


def test_density_error_by_hand():
    at_node, at_other = np.array([[0.2, 0.2]]), np.array([[0.4, 0.2]])
    # One particle on a node of the grid of two spacings: (1/2)^2 there and nothing elsewhere; two nodes in the union.
    assert metrics.density_error(at_node, at_other, BOX, spacing=0.05) == (pytest.approx(0.25), pytest.approx(0.25))
    assert metrics.density_error(at_node, at_node, BOX, spacing=0.05) == (0, 0)
    outside = np.array([[2.0, 2.0]])
    assert metrics.density_error(outside, outside, BOX, spacing=0.05) == (0, 0)


def test_shape_of_a_cloud():
    cloud = lattice(5, 3)
    assert metrics.spacing_ratio(cloud * 0.5, cloud) == pytest.approx(0.5)
    assert metrics.spacing_ratio(cloud[:1], cloud) is None
    assert metrics.centre_of_mass_error(cloud + [0.03, 0.04], cloud, 0.05) == pytest.approx(1.0)
    many = np.linspace(0, 1, 101)
    flat = np.stack([many, 0.2 * many], 1)
    assert metrics.width(flat, DOWN) == pytest.approx(0.98)
    assert metrics.front(flat, DOWN) == pytest.approx(0.99)
    assert metrics.pile_height(flat, BOX, DOWN) == pytest.approx(0.2 * 0.99)
    # Gravity to the right: the floor is the face x = 1 and y is the horizontal axis.
    right = np.array([1.0, 0.0])
    assert metrics.pile_height(flat, BOX, right) == pytest.approx(0.99)
    assert metrics.width(flat, right) == pytest.approx(0.2 * 0.98)
    assert metrics.front(flat, right) == pytest.approx(0.2 * 0.99)
    assert metrics.pile_height(flat, BOX, np.zeros(2)) is None


@pytest.mark.parametrize("dim", [2, 3])
def test_pile_angle_of_a_cone(dim):
    axes = [np.arange(-20, 21) * 0.02] * (dim - 1)
    ground = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, dim - 1)
    height = np.clip(0.3 - 0.5 * np.linalg.norm(ground, axis=1), 0.0, None)
    kept = height > 0
    cone = np.concatenate([ground, height[:, None]], 1)[kept]
    bounds, gravity = np.array([[-1.0, 1.0]] * (dim - 1) + [[0.0, 1.0]]), np.array([0.0] * (dim - 1) + [-1.0])
    assert metrics.pile_angle(cone, bounds, gravity, spacing=0.02) == pytest.approx(math.degrees(math.atan(0.5)), abs=0.5)
    assert metrics.pile_angle(cone[:1], bounds, gravity, spacing=0.02) is None
    assert metrics.pile_angle(cone, bounds, 0 * gravity, spacing=0.02) is None


def falling(frames=10):
    cloud = lattice(4, 4, origin=(0.4, 0.4))
    time = np.arange(frames)[:, None, None]
    position = (cloud + time * np.array([0.0, -0.01])).astype(np.float32)
    kind = np.full(16, 5, np.int8)
    kind[0], position[:, 0] = 3, position[0, 0]
    scene = {"name": "falling", "gravity": [0, -1.0], "spacing": 0.05}
    return Trajectory(position, kind, 0.1, 0.1, BOX, scene, 7, {"name": "hand"})


def test_evaluate_perfect_and_shifted():
    trajectory = falling()
    truth = trajectory.position[4:]
    perfect = metrics.evaluate(truth, trajectory, present=3)
    assert perfect["rollout_mse"] == {"1": 0, "5": 0, "20": None, "100": None, "all": 0}
    assert perfect["emd"]["1"] == 0 and perfect["width_ratio"]["0.25"] == 1 and perfect["escaped_fraction_worst"] == 0
    assert perfect["divergence_time"] == math.inf and perfect["kinetic_energy_mse"] == 0 and perfect["momentum_drift"] == 0

    shifted = truth.copy()
    shifted[:, trajectory.moving, 0] += 0.05
    result = metrics.evaluate(shifted, trajectory, present=3)
    assert result["rollout_mse_moving"]["all"] == pytest.approx(0.05**2 / 2, rel=1e-5)
    assert result["rollout_mse"]["all"] == pytest.approx(0.05**2 / 2 * 15 / 16, rel=1e-5)
    assert result["rollout_mse_per_radius2"]["1"] == pytest.approx(0.05**2 / 2 * 15 / 16 / 0.1**2, rel=1e-5)
    assert result["rollout_mse_per_edge2"]["1"] == pytest.approx(result["rollout_mse"]["1"])
    assert result["emd"]["0.5"] == pytest.approx(1.0, rel=1e-5) and result["centre_of_mass_error"]["1"] == pytest.approx(1.0, rel=1e-5)
    assert result["sinkhorn"]["1"] == pytest.approx(0.05**2, rel=1e-3) and result["front_error"]["1"] == pytest.approx(1.0, rel=1e-5)


def test_evaluate_finds_what_sank_into_a_floor():
    scene = SceneFamily.load("configs/scenes/randomfloor.yaml").sample(seed=3)
    start, kind = scene.start(), scene.particle_type()
    frames = np.repeat(start[None], 150, axis=0)
    sinking, down = np.flatnonzero(kind != 3)[:10], np.linspace(0, 1, 150)[:, None]
    frames[:, sinking, 1] += down * (0.11 - start[sinking, 1])  # below the lowest floor, and still inside the box
    bounds, simulator = np.array(scene.bounds), {"name": "hand"}
    trajectory = Trajectory(frames.astype(np.float32), kind, scene.frame_step, scene.radius, bounds, scene.to_dict(), 3, simulator)
    moving = int((kind != 3).sum())
    result = metrics.evaluate(trajectory.position[6:], trajectory, present=5)
    assert result["escaped_fraction_worst"] == 0
    assert result["penetrated_fraction"] == result["penetrated_fraction_worst"] == pytest.approx(10 / moving)
    assert metrics.evaluate(trajectory.position[6:20], trajectory, present=5)["penetrated_fraction_worst"] == 0
    assert metrics.evaluate(falling().position[4:], falling(), present=3)["penetrated_fraction"] is None
    solid = replace(trajectory, position=np.concatenate([trajectory.position, trajectory.position[:, :, :1]], 2), bounds=np.array([[0.1, 0.9]] * 3))
    solid.scene["gravity"] = [0, -9.8]
    with pytest.raises(InputError, match="scene: dim = 2: positions have 3 coordinates"):
        metrics.evaluate(solid.position[6:20], solid, present=5)


def test_evaluate_a_failed_rollout():
    trajectory = falling()
    broken = trajectory.position[4:].copy()
    broken[3:] = np.nan
    result = metrics.evaluate(broken, trajectory, present=3)
    assert result["rollout_mse"]["1"] == 0 and math.isnan(result["rollout_mse"]["all"])
    assert result["emd"]["0.25"] == 0 and math.isnan(result["emd"]["1"]) and math.isnan(result["escaped_fraction"])
    assert result["first_non_finite"] == 4 and result["divergence_time"] == pytest.approx(0.4)
