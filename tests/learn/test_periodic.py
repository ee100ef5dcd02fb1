"""Learning in periodic boxes: pairs by hand and by brute force; whatever is moved through a face is seen, predicted and judged as before."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learn import analysis as a
from learn import compare as c
from learn import metrics
from learn.baselines import ConstantVelocity, Oracle, RigidDrop, trivial_baselines
from learn.checkpoint import build_model
from learn.dataset import Dataset, DataSpec
from learn.features import Features
from learn.gns import GNS, GNSSettings
from learn.graph import radius_graph
from learn.model import build
from learn.relaxation import Relaxation, relax
from learn.rollout import rollout_trajectory
from learn.train import rollout_score
from sim import periodic
from sim.errors import InputError
from sim.simulator import rollout, rollouts, start_from
from sim.trajectory import Trajectory

BOUNDS = np.array([[1.0, 5.0], [0.0, 2.0]])
PERIOD = np.array([4.0, 0.0])
SCENE = {"name": "channel", "periodic": ["x"], "spacing": 0.4, "gravity": [0.0, 0.0]}


def spec(**changes) -> DataSpec:
    values = dict(
        dim=2,
        bounds=BOUNDS.tolist(),
        radius=0.5,
        spacing=0.4,
        frame_step=0.1,
        stride=1,
        gravity=(0.0, 0.0),
        particle_types=(5,),
        velocity_mean=(0.0, 0.0),
        velocity_std=(0.1, 0.1),
        acceleration_mean=(0.0, 0.0),
        acceleration_std=(0.01, 0.01),
        periodic=("x",),
    )
    return DataSpec(**(values | changes))


def flow(frames=30, particles=12, seed=0, shift=0.0, kinds=None, drift=0.3):
    """Particles that drift to the right through the face of the channel, each in its own wavy way; ``shift`` moves all of it along."""
    rng = np.random.default_rng(seed)
    start, time = rng.uniform([1, 0.3], [5, 1.7], (particles, 2)), np.arange(frames)[:, None, None]
    path = start + shift * np.array([1.0, 0.0]) + drift * time * np.array([1.0, 0.0]) + 0.05 * np.sin(0.2 * time + rng.uniform(0, 6, (particles, 2)))
    position = periodic.wrapped(path, BOUNDS, PERIOD).astype(np.float32)
    kinds = np.full(particles, 5, np.int8) if kinds is None else np.asarray(kinds, np.int8)
    return Trajectory(position, kinds, 0.1, 0.5, BOUNDS, SCENE, seed, {"name": "made up"})


def small(data=None, **options) -> GNS:
    torch.manual_seed(0)
    return GNS(GNSSettings(**(dict(latent=16, message_passing=2, history=3, noise=0.0) | options)), data or spec()).eval()


# --- graph and features ----------------------------------------------------------------------------------------------


def test_edges_by_hand():
    """0 and 1 meet through the face of the first axis; 2 and 3 face each other across walls."""
    position = torch.tensor([[1.1, 1.0], [4.8, 1.0], [3.0, 0.1], [3.0, 1.9]]).repeat(4, 1, 1)
    graph = radius_graph(position[-1], 0.5, period=PERIOD)
    assert list(zip(graph.receiver.tolist(), graph.sender.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 2), (3, 3)]
    edges = small().features.edges(position, graph, PERIOD)
    torch.testing.assert_close(edges[1:3], torch.tensor([[-0.6, 0.0, 0.6], [0.6, 0.0, 0.6]]), rtol=0, atol=2e-6)
    assert radius_graph(position[-1], 0.5).edges == 4


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 40),
    radius=st.floats(0.05, 4.0),
    examples=st.integers(1, 3),
    axes=st.sampled_from(["x", "y", "xy", "xyz", "xz"]),
)
def test_graph_against_brute_force(seed, count, radius, examples, axes):
    """Points in any of their images; radii above half the box as well: a pair joins once, by its nearest images."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-3, 6, (count, 3)).astype(np.float32)
    label = np.sort(generator.integers(0, examples, count))
    length = np.where([axis in axes for axis in "xyz"], [2.0, 3.0, 1.5], 0.0)
    graph = radius_graph(torch.from_numpy(points), radius, torch.from_numpy(label), period=length)
    shifts = np.stack(np.meshgrid(*[np.arange(-8, 9) if edge else [0] for edge in length]), -1).reshape(-1, 3) * length
    offset = points[:, None].astype(float) - points[None]
    distance = np.full((count, count), np.inf)
    for shift in shifts:
        distance = np.minimum(distance, np.linalg.norm(offset + shift, axis=2))
    wanted = (distance <= radius) & (label[:, None] == label[None])
    found = np.zeros_like(wanted)
    found[graph.receiver.numpy(), graph.sender.numpy()] = True
    assert graph.edges == found.sum()  # no edge twice
    assert ((found == wanted) | (np.abs(distance - radius) < 1e-9)).all()


def test_only_walls_have_distances():
    def width(axes):
        data = spec(periodic=axes)
        return Features(data, sigma=0, velocities=3, radius=0.5, wall_distance=0.5, scaling="velocity", relative_velocity=False, ballistic=False)

    assert [width(axes).node_width for axes in ((), ("x",), ("x", "y"))] == [10, 8, 6]
    channel = width(("x",))
    position = torch.tensor([[4.99, 0.1], [1.0, 1.8]]).repeat(4, 1, 1)
    walls = channel.nodes(position, torch.tensor([5, 5]), channel.bounds)[:, 6:]
    torch.testing.assert_close(walls, torch.tensor([[0.2, 1.0], [1.0, 0.4]]), rtol=0, atol=1e-6)
    full = width(("x", "y"))
    assert full.nodes(position, torch.tensor([5, 5]), full.bounds).shape == (2, 6)


def test_flight_stops_at_walls_only():
    made = Features(spec(), sigma=0, velocities=1, radius=0.5, wall_distance=0.5, scaling="last", relative_velocity=False, ballistic=True, walls=True)
    position = torch.tensor([[[4.8, 1.5]], [[4.95, 1.9]]])
    torch.testing.assert_close(made.base(position, made.bounds), torch.tensor([[0.0, -0.3]]), rtol=0, atol=1e-6)


# --- data ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stride", [1, 2])
def test_windows_and_statistics_know_no_faces(tmp_path, write_dataset, stride):
    truths = {index: flow(seed=index) for index in range(2)}
    data = Dataset(write_dataset(tmp_path, {"train": truths}), "train")
    smooth = [periodic.unwrapped(truth.position.astype(float), PERIOD) for truth in truths.values()]
    rows = data.windows(5, stride)
    crossing = 0
    for number, first in rows.tolist():
        window = data.batch(np.array([[number, first]]), 5, stride).position.numpy()
        wanted = smooth[number][first : first + 4 * stride + 1 : stride]
        np.testing.assert_allclose(window - window[0], wanted - wanted[0], atol=2e-6)
        np.testing.assert_array_equal(window[0], truths[number].position[first])
        crossing += bool(np.abs(np.diff(truths[number].position[first : first + 5], axis=0)).max() > 2)
    assert crossing > 10
    velocity = np.concatenate([(path[stride:] - path[:-stride]).reshape(-1, 2) for path in smooth])
    np.testing.assert_allclose(data.statistics(stride)["velocity_std"], velocity.std(0), rtol=1e-6)
    found = data.spec(2)
    assert found.periodic == ("x",) and found.period.tolist() == [4.0, 0.0] and DataSpec.from_dict(found.to_dict()) == found
    share = 1 / np.linalg.norm(data.content["statistics"]["velocity_std"])
    with pytest.raises(InputError, match="no such window"):  # nothing moves 1 a frame, though the faces are 4 apart
        data.windows(5, 1, skip_rest=share)


def test_a_spec_without_periodic_axes_reads_as_before():
    assert "periodic" not in spec(periodic=()).to_dict()
    for axes in (("z",), ("y", "x"), ("x", "x"), "x", (1,)):
        with pytest.raises(ValueError, match="periodic = "):
            spec(periodic=axes)


# --- models and baselines --------------------------------------------------------------------------------------------


def test_a_model_does_not_see_where_the_face_is():
    """Everything moved along the channel by 1.7, through the face for some: the same motion, moved. In a box with walls it is not."""
    for axes, same in ((["x"], True), ([], False)):
        model = small(spec(periodic=tuple(axes)))
        paths = []
        for shift in (0.0, 1.7):
            start = start_from(replace(flow(shift=shift), scene=SCENE | {"periodic": axes}), model.history)
            paths.append(rollout(model, start, 15).position.astype(float) - [shift, 0])
        difference = np.abs(periodic.shortest(paths[0] - paths[1], PERIOD)).max()
        assert (difference < 1e-4) == same, difference


def test_loss_does_not_see_where_the_face_is(tmp_path, write_dataset):
    losses = []
    for shift in (0.0, 1.7):
        data = Dataset(write_dataset(tmp_path / str(shift), {"train": {0: flow(shift=shift)}}), "train")
        losses.append(float(small(unroll=(3,)).loss(data.batch(data.windows(7), 7), torch.Generator(), 0.0).detach()))
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)


class Truth(torch.nn.Module):
    """The normalised accelerations of a path, one call after the other."""

    def __init__(self, model, path):
        super().__init__()
        path = torch.from_numpy(path)
        self.outputs, self.call = ((path[2:] - 2 * path[1:-1] + path[:-2]) / model.features.acceleration_std.double()).float(), model.velocities - 1

    def forward(self, nodes, edges, graph):
        self.call += 1
        return self.outputs[self.call - 1]


def test_true_accelerations_reproduce_the_truth_through_the_faces():
    truth, model = flow(60), small()
    model.network = Truth(model, periodic.unwrapped(truth.position.astype(float), PERIOD))
    predicted, _ = rollout_trajectory(model, truth, None, {})
    assert predicted.ok and (predicted.position[..., 0] >= 1).all() and (predicted.position[..., 0] <= 5).all()
    np.testing.assert_allclose(periodic.shortest(predicted.position - truth.position.astype(float), PERIOD), 0, atol=1e-5)
    model.network.call = model.velocities - 1
    assert rollout_score(model, truth, None)[0] < 1e-10


def test_moving_obstacles_pass_through_the_faces_with_their_speed():
    """Kinematic particles that move at 0.3 a frame, at starts before and after their crossing: no velocity is ever a jump."""
    truth = flow(40, kinds=[3, 3] + [5] * 10)
    model = small(spec(particle_types=(3, 5)))
    seen = []
    nodes = model.features.nodes

    def recorded(position, *arguments):
        seen.append(float(position.diff(dim=0).abs().max()))
        return nodes(position, *arguments)

    model.features.nodes = recorded
    for present in (4, 20):
        start = start_from(truth, model.history, present)
        np.testing.assert_array_equal(start.history[-1], truth.position[present])
        result = rollout(model, start, 12).position[:, :2].astype(float)
        np.testing.assert_allclose(periodic.shortest(result - truth.position[present + 1 : present + 13, :2], PERIOD), 0, atol=1e-5)
    assert len(seen) == 24 and max(seen) < 1


def test_rollouts_together_are_those_apart():
    model, truths = small(radius=2.0), [flow(30, particles=8 + seed, seed=seed) for seed in range(3)]
    starts = [start_from(truth, model.history) for truth in truths]
    for together, start in zip(rollouts(model, starts, [20] * 3), starts, strict=True):
        apart = rollout(model, start, 20).position
        np.testing.assert_allclose(periodic.shortest(together.position.astype(float) - apart, PERIOD), 0, atol=1e-5)
        assert together.escaped is None and np.abs(np.diff(apart, axis=0)).max() > 3


def test_a_box_of_another_kind_is_refused(tmp_path, write_dataset):
    with pytest.raises(ValueError, match=r"periodic along \['x'\], the model's along \[\]"):
        small(spec(periodic=())).begin(start_from(flow(), 4))
    with pytest.raises(InputError, match="periodic = .*: its grid ends at walls all around; train a gns"):
        build("grid_emulator", {}, spec())
    with pytest.raises(InputError, match="a periodic box has no absolute places; set encoder: relative"):
        build_model("gns", {"encoder": "absolute"}, spec(), "gns.yaml")


def test_baselines_and_the_oracle_go_through_the_faces():
    truth = flow(30, drift=0.7)
    steady = periodic.wrapped(truth.position[0] + np.arange(20)[:, None, None] * np.array([0.7, 0.0]), BOUNDS, PERIOD).astype(np.float32)
    straight = replace(truth, position=steady)
    for simulator in (ConstantVelocity(), RigidDrop()):
        predicted = rollout(simulator, start_from(straight, 3), 17).position
        np.testing.assert_allclose(periodic.shortest(predicted - steady[3:].astype(float), PERIOD), 0, atol=1e-5)
    for present in (2, 14):
        predicted = rollout(Oracle([truth]), start_from(truth, 3, present), 15).position
        np.testing.assert_allclose(periodic.shortest(predicted - truth.position[present + 1 : present + 16].astype(float), PERIOD), 0, atol=1e-5)
        assert (predicted[..., 0] >= 1).all() and (predicted[..., 0] <= 5).all()


# --- figures ---------------------------------------------------------------------------------------------------------


def test_metrics_by_hand():
    p, q = np.array([[1.1, 1.0], [3.0, 1.0]]), np.array([[4.9, 1.0], [3.1, 1.0]])
    assert metrics.earth_movers_distance(p, q, 0.1, PERIOD) == pytest.approx(1.5)  # 0.2 and 0.1
    assert metrics.sinkhorn_divergence(p[:1], q[:1], 0.5, PERIOD) == pytest.approx(0.04)
    assert metrics.spacing_ratio(np.array([[1.1, 1.0], [4.9, 1.0]]), p, PERIOD) == pytest.approx(0.2 / 1.9)
    assert metrics.velocities(q[None, :1], p[:1], 0.5, PERIOD).tolist() == [[[pytest.approx(-0.4), 0.0]]]


def test_density_runs_around():
    """Eight cells of 0.5 (0.6 asked) along the box; on the face half of a particle lies at the last node's side. Its volume stays."""
    grid = metrics.density(np.array([[4.75, 1.2]]), BOUNDS, 0.6, 0.3, PERIOD)
    assert grid.shape == (7, 5) and grid.sum() * (4 / 7) * 0.6 == pytest.approx(0.3**2)
    shifted = metrics.density(np.array([[4.75 + 4 / 7, 1.2]]), BOUNDS, 0.6, 0.3, PERIOD)
    np.testing.assert_allclose(np.roll(grid, 1, axis=0), shifted, atol=1e-12)
    assert grid[0].sum() > 0 and grid[6].sum() > 0


def test_evaluation_does_not_see_where_the_face_is():
    figures = []
    for shift in (0.0, 1.7):
        truth = flow(40, shift=shift)
        rng = np.random.default_rng(3)
        moved = truth.position[6:] + rng.normal(0, 0.02, truth.position[6:].shape) * [1, 1]
        figures.append(metrics.evaluate(periodic.wrapped(moved, BOUNDS, PERIOD), truth, 5, horizons=(1, 5, 20)))
    assert figures[0]["rollout_mse"]["all"] == pytest.approx(4e-4, rel=0.1) and figures[0]["escaped_fraction_worst"] == 0
    assert figures[0]["divergence_time"] == math.inf and figures[0]["front_error"]["1"] is None
    for key in ("rollout_mse", "kinetic_energy_mse", "momentum_drift", "emd", "sinkhorn", "spacing_ratio", "centre_of_mass_error"):
        assert figures[0][key] == pytest.approx(figures[1][key], rel=1e-3), key


def test_comparison():
    truths = [flow(30, seed=seed) for seed in range(2)]
    settings_ = c.CompareSettings(horizons=(1, 5))
    rows = {row["contender"]: row for row in c.compare([*trivial_baselines(), small(), Oracle(truths)], truths, settings_)}
    assert all(row["failures"] == 0 for row in rows.values())
    assert rows["oracle"]["rollout_mse"]["all"] < 1e-10 and rows["oracle"]["one_step_mse"] < 1e-10
    assert rows["constant velocity"]["one_step_mse"] < 1e-4 < rows["frozen"]["one_step_mse"] < 0.1
    assert a.verdict(list(rows.values())).startswith("On channel")


def test_relaxation_pushes_across_a_face():
    crowd = np.random.default_rng(0).uniform(-0.2, 0.2, (30, 2)) + [0, 1]
    options = Relaxation(strength=0.1, density=1.0)
    middle, face, image = (relax(crowd + [x, 0], BOUNDS, 0.2, options, None, PERIOD) - [x, 0] for x in (3.0, 1.0, 9.0))
    assert np.abs(middle - crowd).max() > 0.01
    np.testing.assert_allclose(face, middle, atol=1e-9)
    np.testing.assert_allclose(image, middle, atol=1e-9)
    assert np.abs(relax(crowd + [1, 0], BOUNDS, 0.2, options) - [1, 0] - middle).max() > 0.01, "mirrored in walls it is another crowd"
