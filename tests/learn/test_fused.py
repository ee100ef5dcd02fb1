"""The kernels of ``learn.fused`` and the steps of ``learn.replay``, on a CPU by Triton's interpreter, against the textbook form and the plain steps.

What a CPU cannot show (that a capture holds, bf16 tensor cores) is checked by ``benchmarks/gns_cuda.py`` on a GPU.
"""

import os

os.environ["TRITON_INTERPRET"] = "1"  # read where the kernels are defined

import copy
import gc
import weakref

import numpy as np
import pytest
import torch
from replaying import assert_replayed_as_plain
from textbook_gns import TextbookNetwork

from learn import fused
from learn.dataset import DataSpec, Windows
from learn.gns import GNSSettings, Network
from learn.gns_replay import RolloutReplay
from learn.graph import Graph, radius_graph
from learn.model import build
from learn.replay import TrainingReplay
from learn.train import OPTIMIZERS, Adam
from sim.simulator import SimulationError, Start, rollout, rollouts


def padded(position: torch.Tensor, example: torch.Tensor, radius: float, self_edges: bool, capacity: int, spare: int = 3):
    """The search's graph of these particles and ``spare`` rows that are none."""
    dim = position.shape[1]
    search = fused.Search(np.array([[0.0, 1.0]] * dim), radius, int(example.max()) + 1, capacity, self_edges, position.device)
    rows = torch.cat([position, torch.full((spare, dim), 0.5)])
    return search, search(rows, torch.cat([example, torch.zeros(spare, dtype=torch.int64)]), torch.tensor([len(position)], dtype=torch.int32))


@pytest.mark.parametrize(("dim", "self_edges"), [(2, True), (3, False)])
def test_search_is_the_radius_graph(dim, self_edges):
    position = torch.rand((40, dim), generator=torch.Generator().manual_seed(dim)) * 1.5 - 0.25  # some out of the box
    example = torch.arange(40) // 20
    wanted = radius_graph(position, 0.3, example, self_edges)
    search, found = padded(position, example, 0.3, self_edges, wanted.edges + 5)
    count = int(found.count)
    assert count == wanted.edges == int(found.found[-1]) == int(search.most) and found.edges == search.capacity >= wanted.edges
    assert torch.equal(found.offsets[:41], wanted.offsets) and (found.offsets[41:] == count).all()
    pairs = {(int(r), int(s)) for r, s in zip(found.receiver[:count], found.sender[:count], strict=True)}
    assert pairs == {(int(r), int(s)) for r, s in zip(wanted.receiver, wanted.sender, strict=True)}
    reverse = found.reverse[:count].long()
    assert torch.equal(found.sender[reverse], found.receiver[:count]) and torch.equal(found.receiver[reverse], found.sender[:count])


def test_search_counts_what_it_has_no_room_for():
    position = torch.rand((30, 2), generator=torch.Generator().manual_seed(0))
    search, found = padded(position, torch.zeros(30, dtype=torch.int64), 1.5, True, 10)
    assert found.found[:31].tolist() == [30 * i for i in range(31)] and int(search.most) == 900 and int(found.count) == search.capacity < 900
    assert (found.offsets <= search.capacity).all() and torch.equal(found.receiver[:30], torch.zeros(30, dtype=torch.int32))


def test_particles_a_radius_apart_are_neighbours():
    position = torch.tensor([[0.25, 0.5], [0.5, 0.5], [0.75, 0.5], [0.75, 0.75]])
    _, found = padded(position, torch.zeros(4, dtype=torch.int64), 0.25, False, 20, spare=0)
    assert found.offsets.tolist() == [0, 1, 3, 5, 6]


@pytest.mark.parametrize(("dim", "latent", "edge_update"), [(2, 16, True), (3, 32, False)])
def test_network_and_gradient_against_the_textbook(dim, latent, edge_update, monkeypatch):
    """Memory that nothing was written to holds NaN here, which no product with zero hides."""
    torch.manual_seed(dim)
    position, example = torch.rand(24, dim), torch.arange(24) // 12
    _, graph = padded(position, example, 0.4, True, 300)
    count = int(graph.count)
    network = Network(GNSSettings(latent=latent, message_passing=2, edge_update=edge_update), 7, dim + 1, dim)
    for parameter in network.parameters():
        if parameter.ndim == 1:
            torch.nn.init.normal_(parameter, std=0.3)  # biases and LayerNorms start at values that hide what is left out
    network.shadow = fused.Shadow(network)
    network.shadow.refresh()
    nodes, edges = torch.randn(27, 7, requires_grad=True), torch.randn(graph.edges, dim + 1)
    weight = torch.randn(27, dim)
    weight[24:] = 0  # rows that are no particles
    edges[count:] = 1e3  # rows that are no edges
    edges.requires_grad_()
    monkeypatch.setattr(fused.torch, "empty", lambda *shape, **kind: torch.full(shape, torch.nan, **kind))
    monkeypatch.setattr(fused.torch, "empty_like", lambda value, **kind: torch.full_like(value, torch.nan, **kind))
    output = network(nodes, edges, graph)
    (output * weight).sum().backward()
    monkeypatch.undo()

    double = TextbookNetwork(copy.deepcopy(network)).double()
    true_nodes, true_edges = nodes.detach().double().requires_grad_(), edges.detach()[:count].double().requires_grad_()
    wanted = double(true_nodes, true_edges, Graph(graph.sender[:count], graph.receiver[:count], graph.offsets))
    (wanted * weight).sum().backward()
    torch.testing.assert_close(output.double(), wanted, rtol=1e-5, atol=1e-5)
    found = [*(p.grad for p in network.parameters()), nodes.grad, edges.grad[:count]]
    true = [*(p.grad for p in double.parameters()), true_nodes.grad, true_edges.grad]
    for own, other in zip(found, true, strict=True):
        assert (own - other).norm() <= 3e-6 * other.norm()


def spec_of(**changes) -> DataSpec:
    content = dict(
        dim=2, bounds=((0, 1), (0, 1)), radius=0.3, spacing=0.2, frame_step=0.01, stride=1, gravity=(0, -1.0), particle_types=(5,),
        velocity_mean=(0, 0), velocity_std=(0.02, 0.02), acceleration_mean=(0, 0), acceleration_std=(0.004, 0.004),
    )  # fmt: skip
    return DataSpec(**content | changes)


SETTINGS = {"latent": 16, "message_passing": 2, "history": 2, "noise": 0.1}


def paths(frames: int, particles: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn((frames, particles, 2), generator=generator).cumsum(0) * 0.003
    return (torch.rand((particles, 2), generator=generator) * 0.8 + 0.1 + steps).float()


def batch(frames: int, counts: tuple[int, ...], seed: int, kinds: tuple[int, ...] = (5,), context: int = 0) -> Windows:
    total = sum(counts)
    values = torch.randn((frames, len(counts), context), generator=torch.Generator().manual_seed(seed)) if context else None
    return Windows(
        paths(frames, total, seed),
        torch.tensor(kinds)[torch.arange(total) % len(kinds)],
        torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)),
        values,
    )


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize(
    ("changes", "settings", "kinds", "context"),
    [({}, {}, (5,), 0), ({"particle_types": (3, 5), "context_mean": (0.1,), "context_std": (1.0,)}, {"unroll": (2,)}, (3, 5), 1)],
)
def test_replayed_training_is_training(changes, settings, kinds, context, optimizer):
    """Three steps on batches of different sizes: the same losses, weights and averages as plain steps."""
    torch.manual_seed(0)
    plain = build("gns", SETTINGS | settings, spec_of(**changes))
    frames = plain.window(0.0)
    batches = [batch(frames, counts, seed, kinds, context) for seed, counts in enumerate([(8, 9), (10, 10), (4, 7)])]
    assert_replayed_as_plain(plain, batches, 10, optimizer, rel=1e-4)


def test_a_batch_without_edges_trains():
    model = build("gns", SETTINGS | {"self_edges": False}, spec_of(radius=1e-4))
    parameters, apart = list(model.parameters()), batch(4, (8, 8), 0)
    wanted = model.loss(apart, torch.Generator().manual_seed(7), 0.0).item()
    replay = TrainingReplay(model, parameters, Adam(parameters, 0.0), model.state_dict(), 1.0, apart, 8)
    replay.step(apart, torch.Generator().manual_seed(7), 1e-2, 0.5)
    loss, _, *none = replay.settle()
    assert none == [0, 0] and loss == pytest.approx(wanted, rel=1e-4)


def test_a_step_that_is_none_changes_nothing_and_is_told():
    model = build("gns", SETTINGS, spec_of())
    parameters = list(model.parameters())
    optimizer, average = Adam(parameters, 0.0), {name: value.clone() for name, value in model.state_dict().items()}
    good, bad = batch(4, (8, 8), 0), batch(4, (8, 8), 1)
    bad.position[-1, 3] = torch.nan
    replay = TrainingReplay(model, parameters, optimizer, average, 1.0, good, 8)
    before = copy.deepcopy(model.state_dict())
    replay.step(bad, torch.Generator(), 1e-2, 0.5)
    assert replay.settle()[2:] == (1, 0)
    dense, capacity = batch(4, (8, 8), 0), replay.room.search.capacity
    dense.position[:] = 0.5
    dense.example[:] = 0  # 256 edges
    assert capacity < 256
    replay.step(dense, torch.Generator(), 1e-2, 0.5)
    replay.step(bad, torch.Generator(), 1e-2, 0.5)
    assert replay.settle()[2:] == (1, 1) and replay.room.search.capacity > 256
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]) and torch.equal(average[name], before[name])
    assert all(int(step) == 0 for step in optimizer.steps)
    replay.step(good, torch.Generator(), 1e-2, 0.5)
    assert replay.settle()[2:] == (0, 0) and not torch.equal(next(model.parameters()), next(iter(before.values())))


def test_a_dense_batch_costs_its_own_step_alone():
    model = build("gns", SETTINGS, spec_of())
    parameters, good = list(model.parameters()), batch(4, (8, 8), 0)
    replay = TrainingReplay(model, parameters, Adam(parameters, 0.0), model.state_dict(), 1.0, good, 8)
    dense = batch(4, (8, 8), 0)
    dense.position[:], dense.example[:] = 0.5, 0
    for windows in (dense, good, good):
        replay.step(windows, torch.Generator(), 1e-2, 0.5)
    loss, norm, *none = replay.settle()
    assert none == [0, 1] and loss > 0 and norm > 0 and int(replay.optimizer.steps[0]) == 2


def start_of(spec: DataSpec, seed: int, particles: int, kinds: tuple[int, ...] = (5,), context: int = 0) -> Start:
    kinds = np.array(kinds, np.int8)[np.arange(particles) % len(kinds)]
    position = paths(30, particles, seed).numpy()
    return Start(
        history=position[:10],
        particle_type=kinds,
        present=9,
        frame_step=spec.frame_step,
        radius=spec.radius,
        bounds=np.array(spec.bounds, float),
        scene={"gravity": spec.gravity},
        context=np.random.default_rng(seed).normal(size=(25, context)) if context else None,
        kinematic=position[:, kinds == 3] if 3 in kinds else None,
    )


@pytest.fixture
def replaying(monkeypatch):
    monkeypatch.setattr("learn.gns.GNS.replayable", True)


@pytest.mark.parametrize("stride", [1, 2])
def test_replayed_rollouts_are_rollouts(stride, monkeypatch):
    """Two starts together, with kinematic particles and a context, of different lengths: frames to float32's rounding."""
    spec = spec_of(particle_types=(3, 5), context_mean=(0.1,), context_std=(1.0,), stride=stride)
    torch.manual_seed(1)
    model = build("gns", SETTINGS, spec)
    starts = [start_of(spec, 0, 9, (3, 5, 5), 1), start_of(spec, 1, 12, (3, 5, 5), 1)]
    wanted = rollouts(model, starts, [3, 6])
    monkeypatch.setattr("learn.gns.GNS.replayable", True)
    found = rollouts(model, starts, [3, 6])
    for own, other in zip(found, wanted, strict=True):
        assert own.status == other.status == "ok"
        np.testing.assert_allclose(own.position, other.position, rtol=0, atol=2e-6)
    assert model.search is model.network.shadow is None and isinstance(model._replay, RolloutReplay)


def test_rollouts_between_training_steps_leave_them_alone(replaying):
    """As validation does: the training goes on, makes room anew, and ends at the weights that it has without rollouts."""
    spec, found = spec_of(), []
    torch.manual_seed(0)
    first, good = build("gns", SETTINGS, spec), batch(4, (8, 8), 0)
    for validated in (False, True):
        model = copy.deepcopy(first)
        parameters, generator = list(model.parameters()), torch.Generator().manual_seed(7)
        average = {name: value.clone() for name, value in model.state_dict().items()}
        replay = TrainingReplay(model, parameters, Adam(parameters, 0.0), average, 1.0, good, 8)
        for _ in range(2):
            replay.step(good, generator, 1e-2, 0.5)
            if validated:
                assert rollout(model, start_of(spec, 2, 12), 2).status == "ok"
        assert replay.settle()[2:] == (0, 0)
        found.append(model.state_dict())
    for name, value in found[0].items():
        assert torch.equal(found[1][name], value)


def test_what_replays_is_freed_with_its_last_user(replaying):
    """Without the garbage collector: on a GPU it holds a graph's memory, and a validation makes several."""
    model = build("gns", SETTINGS, spec_of())
    parameters, good = list(model.parameters()), batch(4, (8, 8), 0)
    training = TrainingReplay(model, parameters, Adam(parameters, 0.0), model.state_dict(), 1.0, good, 8)
    gc.collect()
    gc.disable()
    try:
        training.step(good, torch.Generator(), 1e-2, 0.5)
        rollout(model, start_of(model.spec, 2, 12), 2)
        users = weakref.ref(training), weakref.ref(model._replay)
        model.begin(start_of(model.spec, 2, 12))
        del training
        assert [user() for user in users] == [None, None]
    finally:
        gc.enable()


def test_what_clumps_ends_and_the_others_go_on(replaying):
    """One start collapses into a point in the next frame, far beyond all room: the other's frames are as they are alone."""
    spec = spec_of()
    model = build("gns", SETTINGS | {"edge_cap": 1.5}, spec)
    model.features.acceleration_std.zero_()
    calm, clump = start_of(spec, 2, 12), start_of(spec, 3, 16)
    grid = np.stack(np.meshgrid([0.1, 0.5, 0.9, 1.3], [0.1, 0.5, 0.9, 1.3]), -1).reshape(-1, 2)
    clump.history[-1] = grid
    clump.history[-2] = 2 * grid - 0.5  # the next step ends in the middle
    calm.history[:] = calm.history[-1]
    alone = rollout(model, calm, 4)
    found = rollouts(model, [clump, calm], [4, 4])
    assert "particles clump: 256 edges" in found[0].status and found[1].status == "ok"
    np.testing.assert_allclose(found[1].position, alone.position, rtol=0, atol=1e-6)
    model.begin(clump)
    model.advance()
    with pytest.raises(SimulationError, match="clump"):
        model.advance()


def test_what_the_kernels_are_made_for():
    assert fused.supports(Network(GNSSettings(latent=64), 7, 3, 2))
    for changes in ({"latent": 48}, {"hidden_layers": 3}, {"encoder": "absolute"}):
        assert not fused.supports(Network(GNSSettings(**{"latent": 64} | changes), 7, 3, 2))
    assert not build("gns", SETTINGS | {"precision": "bf16"}, spec_of()).replayable  # on a CPU
