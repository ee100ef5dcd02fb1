"""GNS: the published parameter count, the textbook form as oracle, loss and rollout against hand-made truth."""

import copy
import dataclasses
import json

import numpy as np
import pytest
import torch
from textbook_gns import TextbookNetwork
from torch import nn

from learn import graph as graph_module
from learn import tiles
from learn.dataset import DataSpec, Windows
from learn.features import random_walk_noise
from learn.gns import GNS
from learn.graph import radius_graph
from learn.model import build
from learn.relaxation import Relaxation
from sim.errors import InputError
from sim.simulator import Start, rollout, rollouts

torch.set_num_threads(1)


def spec(dim: int = 2, **changes) -> DataSpec:
    values = dict(
        dim=dim,
        bounds=((0.0, 1.0),) * dim,
        radius=0.2,
        spacing=0.1,
        frame_step=0.01,
        stride=1,
        gravity=(0.0,) * (dim - 1) + (-9.81,),
        particle_types=(5,),
        velocity_mean=(1e-3,) * dim,
        velocity_std=(1e-2,) * dim,
        acceleration_mean=(2e-4,) * dim,
        acceleration_std=(1e-3,) * dim,
    )
    return DataSpec(**(values | changes))


def small(data: DataSpec | None = None, **settings) -> GNS:
    torch.manual_seed(0)
    return build("gns", dict(latent=16, message_passing=2) | settings, data or spec())


def windows(frames: int, particles: int = 60, dim: int = 2, seed: int = 0, examples: int = 2) -> Windows:
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand((particles, dim), generator=generator)
    steps = 1e-2 * torch.randn((frames, particles, dim), generator=generator)
    label = torch.arange(particles) * examples // particles
    return Windows(start + steps.cumsum(0), torch.full((particles,), 5), label)


def parameters(model: nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize(("dim", "count"), [(2, 1_591_826), (3, 1_592_979)])
def test_parameters_of_the_full_model(dim, count):
    model = build("gns", {}, spec(dim, particle_types=(3, 5)))
    assert parameters(model) == count
    assert model.features.node_width == (30, 37)[dim - 2]
    # One type: neither the embedding (9 x 16) nor its sixteen columns of the first layer.
    assert parameters(build("gns", {}, spec(dim))) == count - 9 * 16 - 16 * 128


def test_shared_processor_has_one_block():
    assert parameters(small(message_passing=7, shared=True)) == parameters(small(message_passing=1))


def test_initialisation_is_truncated_normal():
    weight = build("gns", {}, spec()).network.processor[3].edge.linears[0].weight
    scale = 384**-0.5
    assert weight.abs().max() <= 2 * scale
    assert abs(weight.std().item() / scale - 0.88) < 0.01  # a normal cut at two standard deviations keeps .880 of its own


def textbook_case(dtype: torch.dtype, **settings):
    """Of a seed where no sum before a ReLU is so near zero that float32 may see it on the other side: one does change a gradient by 1e-3."""
    model = small(latent=32, message_passing=3, **settings).to(dtype)
    w = windows(6, particles=100, seed=1)
    position = w.position.to(dtype)
    graph = radius_graph(position[-1], model.radius, w.example)
    nodes, edges = model.features.nodes(position, w.particle_type, model.features.bounds), model.features.edges(position, graph)
    return model.network, nodes, edges, graph


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((found.double() - wanted.double()).norm() / wanted.double().norm()).item()


@pytest.mark.parametrize("settings", [{}, {"hidden_layers": 1}, {"hidden_layers": 3}, {"shared": True}, {"edge_update": False}])
@pytest.mark.parametrize("run", [50, 10**6])
def test_equals_the_textbook_form(settings, run, monkeypatch):
    monkeypatch.setattr(graph_module, "RUN", run)
    network, nodes, edges, graph = textbook_case(torch.float64, **settings)
    assert len(graph.runs) == 1 if run > graph.edges else len(graph.runs) > 5
    wanted = TextbookNetwork(network)(nodes, edges, graph)
    wanted_gradients = torch.autograd.grad(wanted.square().sum(), list(network.parameters()))
    found = network(nodes, edges, graph)
    gradients = torch.autograd.grad(found.square().sum(), list(network.parameters()))
    assert relative(found, wanted) < 1e-12
    assert max(relative(a, b) for a, b in zip(gradients, wanted_gradients, strict=True)) < 1e-10
    with torch.inference_mode():
        assert relative(network(nodes, edges, graph), wanted) < 1e-12

    single = copy.deepcopy(network).float()
    for _ in ("by tiles, where there is a compiler", "by plain operations"):
        found = single(nodes.float(), edges.float(), graph)
        assert relative(found, wanted) < 1e-5
        gradients = torch.autograd.grad(found.square().sum(), list(single.parameters()))
        assert max(relative(a, b) for a, b in zip(gradients, wanted_gradients, strict=True)) < 1e-5
        with torch.inference_mode():
            assert relative(single(nodes.float(), edges.float(), graph), wanted) < 1e-5
        monkeypatch.setattr(tiles, "build", lambda: None)


def test_gradient_reaches_the_features():
    """What an unrolled loss needs: derivatives with respect to positions."""
    network, nodes, edges, graph = textbook_case(torch.float64)
    nodes, edges = nodes.clone().requires_grad_(), edges.clone().requires_grad_()
    found = torch.autograd.grad(network(nodes, edges, graph).square().sum(), (nodes, edges))
    wanted = torch.autograd.grad(TextbookNetwork(network)(nodes, edges, graph).square().sum(), (nodes, edges))
    assert all(relative(a, b) < 1e-10 for a, b in zip(found, wanted, strict=True))


def test_bf16_is_near_f32():
    network, nodes, edges, graph = textbook_case(torch.float32)
    wanted = network(nodes, edges, graph)
    wanted_gradients = torch.autograd.grad(wanted.square().sum(), list(network.parameters()))
    network.low_precision = True
    found = network(nodes, edges, graph)
    gradients = torch.autograd.grad(found.square().sum(), list(network.parameters()))
    assert all(g.dtype == torch.float32 for g in gradients)
    assert 0 < relative(found, wanted) < 3e-2
    assert np.median([relative(a, b) for a, b in zip(gradients, wanted_gradients, strict=True)]) < 0.1
    with torch.inference_mode():
        assert relative(network(nodes, edges, graph), wanted) < 3e-2


class Truth(nn.Module):
    """Stands in for the network: returns the normalised accelerations of ``path`` [frames, particles, dim], in float32, one call after the other."""

    def __init__(self, model: GNS, path: np.ndarray, error: float = 0.0):
        super().__init__()
        path = torch.from_numpy(path.astype(np.float64))
        base, std = model.features.acceleration_base.double(), model.features.acceleration_std.double()
        self.outputs, self.call = ((path[2:] - 2 * path[1:-1] + path[:-2] - base) / std + error).float(), model.velocities - 1

    def forward(self, nodes, edges, graph):
        self.call += 1
        return self.outputs[self.call - 1]


def path(frames: int, particles: int = 8, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    velocity = np.cumsum(1e-3 * generator.normal(size=(frames, particles, 2)), 0)
    return (0.5 + np.cumsum(velocity, 0) * 0.1).astype(np.float32)


def start(positions: np.ndarray, frames: int, **changes) -> Start:
    values = dict(
        history=positions[:frames],
        particle_type=np.full(positions.shape[1], 5, np.int8),
        present=frames - 1,
        frame_step=0.01,
        radius=0.2,
        bounds=np.array([[0, 1], [0, 1]]),
        scene={"gravity": [0, -9.81]},
    )
    return Start(**(values | changes))


@pytest.mark.parametrize("settings", [{}, {"ballistic": True, "noise": 0.1}])
def test_true_accelerations_reproduce_the_truth(settings):
    truth = path(120)
    model = small(**settings)
    model.network = Truth(model, truth)
    result = rollout(model, start(truth, model.history), 114)
    assert result.status == "ok"
    np.testing.assert_allclose(result.position, truth[6:], rtol=0, atol=2e-7)


def test_a_stride_gives_every_frame_and_the_truth_at_each_prediction():
    truth = path(61)
    model = small(spec(stride=3), history=2)
    assert model.history == 7
    model.network = Truth(model, truth[::3])
    model.begin(start(truth, 7))
    first, second = model.advance(), model.advance()
    assert first.shape == (3, 8, 2) and first.dtype == np.float32
    np.testing.assert_allclose(first[2], truth[9], atol=1e-7)
    np.testing.assert_allclose(second[2], truth[12], atol=1e-7)
    # Between, a parabola whose acceleration is the predicted one, kept between 0 and gravity.
    fall = np.clip(truth[12] - 2 * truth[9] + truth[6], [0, -9.81 * (3 * model.spec.frame_step) ** 2], 0)
    np.testing.assert_allclose(second[0], truth[9] + (truth[12] - truth[9]) / 3 - fall / 9, atol=1e-7)


def test_free_flight_is_exact_between_strided_predictions():
    step, frames = 0.0025, np.arange(40)[:, None, None]
    truth = (0.5 + 0.002 * frames * np.array([1.0, 0.5]) - 0.5 * np.array([0, 9.81]) * (step * frames) ** 2 + np.zeros((1, 8, 1))).astype(np.float32)
    model = small(spec(stride=4, frame_step=step), history=2)
    model.network = Truth(model, truth[::4])
    model.begin(dataclasses.replace(start(truth, 9), frame_step=step))
    np.testing.assert_allclose(model.advance(), truth[9:13], atol=2e-7)


def test_kinematic_particles_follow_their_prescription():
    truth = path(30)
    kinds = np.array([3, 3, 5, 5, 5, 5, 5, 5], np.int8)
    model = small(spec(particle_types=(3, 5)))
    result = rollout(model, start(truth, model.history, particle_type=kinds, kinematic=truth[:, :2]), 10)
    np.testing.assert_array_equal(result.position[:, :2], truth[6:16, :2])
    assert not np.allclose(result.position[:, 2:], truth[6:16, 2:])


def test_context_of_the_present_frame_is_seen():
    truth, seen = path(30), []
    model = small(spec(context_mean=(0.0,), context_std=(1.0,)))
    nodes = model.features.nodes
    model.features.nodes = lambda *arguments: seen.append(arguments[3][0].item()) or nodes(*arguments)
    model.begin(start(truth, 6, context=np.arange(30, dtype=np.float32)[:, None]))
    model.advance()
    model.advance()
    assert seen == [5, 6]
    w = windows(8)
    w.context = torch.arange(8.0)[:, None, None].expand(8, 2, 1)
    model.loss(w, torch.Generator(), 0.0)
    assert seen == [5, 6, 5, 6]  # unrolled over two calls


class Collapse(nn.Module):
    """Stands in for the network: takes every particle to one point."""

    def __init__(self, model: GNS):
        super().__init__()
        self.of = (model,)

    def forward(self, nodes, edges, graph):
        (model,) = self.of
        return model.features.target(model._states[0].position, torch.full_like(model._states[0].position[-1], 0.5))


class CollapseFirst(nn.Module):
    """Takes the first of two starts to one point, while it is there; the other goes on as it is."""

    def __init__(self, model: GNS):
        super().__init__()
        self.of, self.calls = (model,), []

    def forward(self, nodes, edges, graph):
        (model,) = self.of
        self.calls.append(graph.particles)
        states = model._states if graph.particles == 49 else model._states[1:]
        position = torch.cat([state.position for state in states], 1)
        following = 2 * position[-1] - position[-2]
        if len(states) == 2:
            following[: states[0].position.shape[1]] = 0.5
        return model.features.target(position, following)


def test_rollouts_together_are_those_alone():
    """Of different lengths and numbers of particles, one of which clumps on its way."""
    model = small(spec(radius=0.2))
    paths = [path(30, particles=n, seed=n) for n in (9, 16, 5)]
    starts = [start(one, 6) for one in paths]
    alone = [rollout(model, one, frames) for one, frames in zip(starts, (4, 7, 2), strict=True)]
    together = rollouts(model, starts, (4, 7, 2))
    for one, other in zip(alone, together, strict=True):
        assert one.position.shape == other.position.shape and one.status == other.status == "ok"
        assert np.allclose(one.position, other.position, rtol=0, atol=1e-6)
    truth, model = path(30, particles=40), small(spec(radius=1e-3), edge_cap=2.0)
    model.network = CollapseFirst(model)
    first, second = rollouts(model, [start(truth, 6), start(paths[0], 6)], (3, 3))
    assert first.status.startswith("failed: particles clump: 1600 edges") and first.status.endswith("(frame 7)")
    assert np.isfinite(first.position[0]).all() and np.isnan(first.position[1:]).all()
    assert second.status == "ok" and model.network.calls == [49, 9, 9]


def test_clumping_ends_a_rollout():
    truth = path(30, particles=40)
    model = small(spec(radius=1e-3), edge_cap=2.0)
    model.network = Collapse(model)
    result = rollout(model, start(truth, 6), 3)
    assert result.status.startswith("failed: particles clump: 1600 edges") and result.status.endswith("(frame 7)")
    assert np.isfinite(result.position[0]).all() and np.isnan(result.position[1:]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"history": np.zeros((3, 8, 2), np.float32)}, "3 frames, the model needs 6"),
        ({"history": np.zeros((6, 8, 3), np.float32)}, "3 dimensions"),
        ({"frame_step": 0.02}, "frame step"),
        ({"particle_type": np.full(8, 6, np.int8)}, "types \\[6\\]"),
    ],
)
def test_a_start_of_another_kind_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        small().begin(start(path(30), 6, **changes))


def test_loss_is_zero_for_the_true_accelerations_and_counts_axes():
    truth = path(9)
    for unroll, frames in (((1,), 7), ((3,), 9)):
        model = small(noise=0.0, unroll=unroll)
        assert model.window(0.5) == frames
        w = Windows(torch.from_numpy(truth[:frames]), torch.full((8,), 5), torch.zeros(8, dtype=torch.int64))
        model.network = Truth(model, truth)
        # float32 positions near 0.5 know an acceleration to 1e-7, which is 1e-4 of its standard deviation here.
        assert model.loss(w, torch.Generator(), 0.5).item() < 1e-6
        if frames == 7:
            model.network = Truth(model, truth, error=2.0)
            assert abs(model.loss(w, torch.Generator(), 0.5).item() - 8.0) < 1e-2  # 2^2, summed over two axes


def test_huber_loss_grows_linearly():
    """2 h^2 (sqrt(1 + e^2 / h^2) - 1) with h = 1 and e^2 = 2^2 + 2^2: 2 (3 - 1) = 4 where the squared loss is 8."""
    truth = path(7)
    model = small(noise=0.0, huber=1.0)
    w = Windows(torch.from_numpy(truth), torch.full((8,), 5), torch.zeros(8, dtype=torch.int64))
    model.network = Truth(model, truth, error=2.0)
    assert abs(model.loss(w, torch.Generator(), 0.5).item() - 4.0) < 1e-2


def test_flight_that_stops_at_the_walls():
    """A network that answers zero: particles thrown at the floor come to lie on it and slip along; without ``walls`` they fall through."""
    truth = (np.array([0.2, 0.3]) + np.arange(6)[:, None, None] * np.array([5e-3, -1e-2]) + np.zeros((1, 8, 1))).astype(np.float32)
    for walls in (True, False):
        model = small(ballistic=True, walls=walls)
        torch.nn.init.zeros_(model.network.decode.linears[-1].weight)
        run = rollout(model, start(truth, model.history), 60)
        assert run.status == "ok"
        np.testing.assert_allclose(run.position[-1, :, 0], 0.2 + 65 * 5e-3, atol=1e-5)
        assert (run.position[-1, :, 1] == 0).all() if walls else (run.position[-1, :, 1] < 0).all()


def test_a_constant_error_of_the_acceleration_costs_the_same_at_every_call():
    truth = path(9)
    model = small(noise=0.0, unroll=(3,))
    w = Windows(torch.from_numpy(truth), torch.full((8,), 5), torch.zeros(8, dtype=torch.int64))
    model.network = Truth(model, truth, error=2.0)
    assert abs(model.loss(w, torch.Generator(), 0.0).item() - 8.0) < 1e-2


def test_noise_is_taken_back_by_the_target():
    """The right answer to a noisy input is the acceleration to the true next velocity: an oracle that knows the noise has no loss."""
    truth, model = path(7), small(noise=0.5)
    w = Windows(torch.from_numpy(truth), torch.full((8,), 5), torch.zeros(8, dtype=torch.int64))
    noise = random_walk_noise(w.position[:6], model.sigma, torch.Generator().manual_seed(3)).double().numpy()
    noisy = np.concatenate([truth[:6] + noise, truth[6:]])
    velocity = truth[6].astype(float) - truth[5]
    noisy[6] = noisy[5] + velocity
    model.network = Truth(model, noisy)
    assert model.loss(w, torch.Generator().manual_seed(3), 0.0).item() < 1e-4
    model.network.call -= 1
    assert model.loss(w, torch.Generator().manual_seed(4), 0.0).item() > 0.1


def test_kinematic_particles_are_not_in_the_loss():
    truth, kinds = path(8), torch.tensor([3, 5, 5, 5, 5, 5, 5, 5])
    model = small(spec(particle_types=(3, 5)), noise=0.0, unroll=(2,))
    w = Windows(torch.from_numpy(truth), kinds, torch.zeros(8, dtype=torch.int64))
    model.network = Truth(model, truth)
    model.network.outputs[:, 0] += 100
    assert model.loss(w, torch.Generator(), 0.0).item() < 1e-6


def test_unrolling_follows_the_progress():
    model = small(unroll=(1, 2, 4))
    assert [model.calls(p) for p in (0.0, 0.3, 0.34, 0.7, 1.0)] == [1, 1, 2, 4, 4]
    assert [model.window(p) for p in (0.0, 1.0)] == [7, 10]


def test_a_few_steps_lower_the_loss():
    options = dict(inputs="acceleration", relative_velocity=True, radius=1.5, wall_distance=4, ballistic=True, unroll=(2,))
    model = small(spec(particle_types=(3, 5)), **options)
    w = windows(8)
    losses = []
    for _ in range(30):
        model.zero_grad()
        loss = model.loss(w, torch.Generator().manual_seed(0), 0.0)
        loss.backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
        with torch.no_grad():
            for p in model.parameters():
                p -= 1e-3 * p.grad.sign()  # torch.optim would take ten seconds to import
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_lengths_in_spacings_and_noise_in_units():
    model = small(radius=1.5, wall_distance=4.0, noise=0.5)
    assert model.radius == pytest.approx(0.15) and model.features.wall_distance == pytest.approx(0.4) and model.sigma == pytest.approx(5e-3)
    assert small(noise=6.7e-4, noise_unit="absolute").sigma == 6.7e-4
    assert small().features.wall_distance == small().radius == 0.2


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("gsn", {}, "known models: .*gns, grid_emulator"),
        ("gns", {"lattent": 3}, "lattent = 3: unknown; gns has latent"),
        ("gns", {"latent": -3}, "latent = -3"),
        ("gns", {"inputs": "positions"}, "inputs"),
        ("gns", {"unroll": []}, "unroll"),
        ("gns", {"walls": True}, "ballistic"),
        ("gns", {"encoder": "absolute", "relative_velocity": True}, "encoder: relative"),
        ("gns", {"unroll": [1, 0]}, "unroll.1"),
    ],
)
def test_bad_settings_are_one_line(name, settings, message):
    with pytest.raises(InputError, match=message) as caught:
        build(name, settings, spec())
    assert "\n" not in str(caught.value)


def test_settings_are_complete_and_rebuild_the_model():
    model = small(unroll=(1, 2))
    again = build("gns", json.loads(json.dumps(model.settings)), spec())
    assert again.settings == model.settings and set(model.settings) == set(GNS.Settings.model_fields)
    again.load_state_dict(model.state_dict())


def test_relaxation_pushes_a_clump_apart_in_the_rollout_and_leaves_the_oracle_alone():
    crowd = 0.5 + 0.02 * np.random.default_rng(0).normal(size=(1, 40, 2))
    frames = np.repeat(crowd, 6, axis=0).astype(np.float32)
    given = start(frames, 6)
    model = small(edge_cap=50.0)
    with torch.no_grad():
        model.network.decode.linears[-1].weight.zero_()  # the mean acceleration, whatever happens
    plain = rollout(model, given, 5).position
    model.options = model.options.model_copy(update={"relaxation": Relaxation()})
    relaxed = rollout(model, given, 5).position
    assert np.std(relaxed[-1], axis=0).min() > 1.2 * np.std(plain[-1], axis=0).max()
    sparse = path(6, particles=4)
    model.options = model.options.model_copy(update={"relaxation": None})
    plain = rollout(model, start(sparse, 6), 3).position
    model.options = model.options.model_copy(update={"relaxation": Relaxation()})
    np.testing.assert_array_equal(rollout(model, start(sparse, 6), 3).position, plain)


def test_a_particle_with_too_few_neighbours_flies():
    """Whatever the network says of it; a pair within reach is still the network's."""
    frames = np.repeat(np.array([[[0.2, 0.9], [0.6, 0.5], [0.65, 0.5]]]), 6, axis=0).astype(np.float32)
    model = small(ballistic=True, flight_below=1)
    model.network.forward = lambda nodes, edges, graph: torch.full((3, 2), 5.0)
    moved = rollout(model, start(frames, 6), 1).position[0] - frames[-1]
    np.testing.assert_allclose(moved[0], [0, -9.81 * 0.01**2], atol=1e-7)
    assert (moved[1:, 0] > 1e-3).all()
    with pytest.raises(InputError, match="flight_below"):
        small(flight_below=1)
