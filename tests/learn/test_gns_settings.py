"""What each setting of a GNS adds and does, by hand on four particles: 0 - 1 - 2 in a row, 0 and 2 out of each other's reach, 3 alone."""

import numpy as np
import pytest
import torch
from textbook_gns import TextbookNetwork, mlp

from learn.dataset import DataSpec, Windows
from learn.gns import GNS
from learn.graph import radius_graph
from learn.model import build
from sim.simulator import Start, rollout

torch.set_num_threads(1)

PLACE = torch.tensor([[0.30, 0.5], [0.35, 0.5], [0.45, 0.5], [0.80, 0.5]], dtype=torch.float64)
KINDS = torch.full((4,), 5)


def four(settings: dict | None = None, **changes) -> GNS:
    """A small GNS in float64; connectivity radius .11, spacing .1."""
    values = dict(
        dim=2,
        bounds=((0.0, 1.0), (0.0, 1.0)),
        radius=0.11,
        spacing=0.1,
        frame_step=0.01,
        stride=1,
        gravity=(0.0, -9.81),
        particle_types=(5,),
        velocity_mean=(0.0, 0.0),
        velocity_std=(1e-2, 1e-2),
        acceleration_mean=(0.0, 0.0),
        acceleration_std=(1e-3, 1e-3),
    )
    torch.manual_seed(0)
    small = {"latent": 16, "hidden_layers": 1, "message_passing": 1, "history": 2}
    return build("gns", small | (settings or {}), DataSpec(**(values | changes))).double()


def window(model: GNS, seed: int = 0) -> torch.Tensor:
    """[C + 1, 4, 2]: the four, each with velocities of its own."""
    steps = 1e-3 * torch.randn((model.velocities + 1, 4, 2), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    steps[-1] = 0
    return PLACE + steps


def outputs(model: GNS, position: torch.Tensor, kinds: torch.Tensor = KINDS, context: torch.Tensor | None = None) -> torch.Tensor:
    graph = radius_graph(position[-1], model.radius, self_edges=model.options.self_edges)
    return model._predict(position, graph, kinds, model.features.bounds, context)


def start(path: torch.Tensor) -> Start:
    return Start(
        history=path.numpy(),
        particle_type=np.full(4, 5, np.int8),
        present=len(path) - 1,
        frame_step=0.01,
        radius=0.11,
        bounds=np.array([[0, 1], [0, 1]]),
        scene={"gravity": [0, -9.81]},
    )


# Node features, edge features, edges, parameters. The plain one: 4 velocity and 4 wall columns; an MLP from n columns to a width of 4 has
# (n + 1) 4 + 5 * 4 + 8 parameters: 64 (nodes, 8), 44 (edges, 3), 80 (block, 12) and 64 (block, 8), the decoder 5 * 4 + 5 * 2: 282.
@pytest.mark.parametrize(
    ("settings", "changes", "wanted"),
    [
        ({}, {}, (8, 3, 8, 282)),
        ({"message_passing": 3}, {}, (8, 3, 8, 282 + 2 * 144)),
        ({"message_passing": 3, "shared": True}, {}, (8, 3, 8, 282)),
        ({"latent": 8}, {}, (8, 3, 8, 160 + 120 + 288 + 224 + 90)),
        ({"hidden_layers": 2}, {}, (8, 3, 8, 282 + 5 * 20)),
        ({"history": 4}, {}, (12, 3, 8, 282 + 4 * 4)),
        ({"inputs": "last"}, {}, (6, 3, 8, 282 - 2 * 4)),
        ({"inputs": "acceleration"}, {}, (8, 3, 8, 282)),
        ({"relative_velocity": True}, {}, (8, 5, 8, 282 + 2 * 4)),
        ({"encoder": "absolute"}, {}, (10, 0, 8, 282 + 2 * 4 - 44 + 4)),
        ({"self_edges": False}, {}, (8, 3, 4, 282)),
        ({"radius": 1.6}, {}, (8, 3, 10, 282)),
        (
            {"wall_distance": 4.0, "noise": 0.0, "noise_scheme": "last", "edge_update": False, "ballistic": True, "walls": True, "unroll": [1, 4]},
            {},
            (8, 3, 8, 282),
        ),
        ({}, {"particle_types": (3, 5)}, (24, 3, 8, 282 + 9 * 16 + 16 * 4)),
        ({}, {"context_mean": (0.0, 0.0), "context_std": (1.0, 1.0)}, (10, 3, 8, 282 + 2 * 4)),
    ],
)
def test_what_a_setting_adds(settings, changes, wanted):
    model = four({"latent": 4} | settings, **changes)
    position = window(model)
    graph = radius_graph(position[-1], model.radius, self_edges=model.options.self_edges)
    context = torch.zeros(4, 2) if model.features.context else None
    nodes, edges = model.features.nodes(position, KINDS, model.features.bounds, context), model.features.edges(position, graph)
    assert (nodes.shape[1], edges.shape[1]) == (model.features.node_width, model.features.edge_width)
    assert (*nodes.shape[1:], edges.shape[1], graph.edges, sum(p.numel() for p in model.parameters())) == wanted
    assert torch.allclose(model.network(nodes, edges, graph), TextbookNetwork(model.network)(nodes, edges, graph), rtol=0, atol=1e-12)


ROW, NEXT, ALONE = {0, 1, 2}, [{0, 1}, {0, 1, 2}, {1, 2}], {3}


@pytest.mark.parametrize(
    ("settings", "seen"),
    [
        ({}, [*NEXT, ALONE]),
        ({"self_edges": False}, [*NEXT, ALONE]),
        ({"encoder": "absolute"}, [*NEXT, ALONE]),
        ({"message_passing": 2}, [ROW, ROW, ROW, ALONE]),
        ({"message_passing": 2, "shared": True}, [ROW, ROW, ROW, ALONE]),
        ({"message_passing": 2, "edge_update": False}, [ROW, ROW, ROW, ALONE]),
        ({"radius": 1.6}, [ROW, ROW, ROW, ALONE]),
    ],
)
def test_whom_a_particle_sees(settings, seen):
    """The particles whose velocities its acceleration depends on: those within M steps of a radius."""
    model = four(settings)
    position = window(model)[:-1].requires_grad_()
    for particle, wanted in enumerate(seen):
        now = torch.cat([position, window(model)[-1:]])
        (gradient,) = torch.autograd.grad(outputs(model, now)[particle].square().sum(), position)
        assert set(gradient.abs().sum((0, 2)).nonzero().flatten().tolist()) == wanted


@pytest.mark.parametrize(
    ("settings", "seen"),
    [
        ({"history": 4}, [True] * 5),
        ({"history": 4, "inputs": "acceleration"}, [True] * 5),
        ({"history": 1}, [True] * 2),
        ({"history": 4, "inputs": "last"}, [False, False, False, True, True]),
    ],
)
def test_which_frames_are_seen(settings, seen):
    model = four(settings)
    position = window(model).requires_grad_()
    (gradient,) = torch.autograd.grad(outputs(model, position).square().sum(), position)
    assert (gradient.abs().sum((1, 2)) > 0).tolist() == seen


def test_a_shared_block_is_that_block_every_time():
    shared, plain = four({"message_passing": 3, "shared": True}), four({"message_passing": 3})
    weights = shared.state_dict()
    weights |= {name.replace("processor.0", f"processor.{k}"): value for name, value in weights.items() for k in (1, 2)}
    plain.load_state_dict(weights)
    assert torch.equal(outputs(plain, window(plain)), outputs(shared, window(shared)))


@pytest.mark.parametrize("self_edges", [True, False])
def test_a_lone_particle_hears_itself_by_its_self_edge(self_edges):
    model = four({"self_edges": self_edges})
    position, network = window(model), model.network
    node = mlp(network.encode_node, model.features.nodes(position, KINDS, model.features.bounds)[3])
    heard = torch.zeros(16, dtype=torch.float64)
    if self_edges:
        heard = mlp(network.processor[0].edge, torch.cat([mlp(network.encode_edge, torch.zeros(3, dtype=torch.float64)), node, node]))
    wanted = mlp(network.decode, node + mlp(network.processor[0].node, torch.cat([heard, node])))
    assert torch.allclose(outputs(model, position)[3], wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_a_graph_without_edges(precision):
    """Particles far apart and no self edges: every particle alone, with gradients, in training and in a rollout."""
    model = four({"self_edges": False, "radius": 0.1, "message_passing": 2, "precision": precision, "ballistic": True, "flight_below": 1}).float()
    position = window(model).float()
    graph = radius_graph(position[-1], model.radius, self_edges=False)
    assert graph.edges == 0
    nodes, edges = model.features.nodes(position, KINDS, model.features.bounds), model.features.edges(position, graph)
    found = model.network(nodes, edges, graph)
    with torch.inference_mode():
        assert torch.allclose(model.network(nodes, edges, graph), found, rtol=1e-2)
    tolerance = 1e-5 if precision == "f32" else 3e-2
    assert torch.allclose(found, TextbookNetwork(model.network)(nodes, edges, graph), atol=tolerance)
    found.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert not model._predict(position, graph, KINDS, model.features.bounds, None).any()  # without neighbours they fly


@pytest.mark.parametrize(("encoder", "same"), [("relative", True), ("absolute", False)])
def test_translation(encoder, same):
    """Out of reach of the walls, the relative encoder does not know where the particles are. The absolute one does, and its edges say nothing."""
    model = four({"encoder": encoder})
    position = window(model)
    moved = outputs(model, position + torch.tensor([0.04, -0.1]))
    assert torch.allclose(moved, outputs(model, position), rtol=0, atol=1e-12) == same
    if not same:
        nodes = model.features.nodes(position, KINDS, model.features.bounds)
        assert torch.allclose(nodes[:, -2:], 2 * PLACE - 1)  # the box is the unit square


def test_translation_with_the_box():
    model = four({"history": 3})
    position, shift = window(model) + torch.tensor([-0.25, 0.42]), torch.tensor([2.0, -3.0], dtype=torch.float64)
    graph = radius_graph(position[-1], model.radius)
    plain = model._predict(position, graph, KINDS, model.features.bounds, None)
    assert not torch.allclose(plain, outputs(model, window(model)))  # walls are felt
    moved = model._predict(position + shift, graph, KINDS, model.features.bounds + shift[:, None], None)
    assert torch.allclose(moved, plain, rtol=0, atol=1e-11)


def case(settings: dict, examples: int, seed: int = 0) -> tuple[GNS, Windows]:
    """A model of three types with context, and windows of 40 particles each, all different."""
    model = four({"message_passing": 2, "noise": 0.0} | settings, particle_types=(3, 5, 6), context_mean=(0.5,), context_std=(2.0,))
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand((1, 40 * examples, 2), generator=generator, dtype=torch.float64)
    steps = 1e-3 * torch.randn((5, 40 * examples, 2), generator=generator, dtype=torch.float64)
    kinds = torch.tensor([3, 5, 6])[torch.randint(3, (40 * examples,), generator=generator)]
    context = torch.randn((5, examples, 1), generator=generator, dtype=torch.float64)
    return model, Windows(start + steps.cumsum(0), kinds, torch.arange(40 * examples) // 40, context)


ALL = [{}, {"encoder": "absolute"}, {"self_edges": False, "relative_velocity": True, "unroll": [2]}, {"ballistic": True, "walls": True, "huber": 1.0}]


@pytest.mark.parametrize("settings", ALL)
def test_the_order_of_particles_is_nothing(settings):
    model, windows = case(settings, 1)
    frames = model.window(0.0)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    position = windows.position[:3]
    context = torch.ones(40, 1)
    assert torch.allclose(
        outputs(model, position[:, order], windows.particle_type[order], context),
        outputs(model, position, windows.particle_type, context)[order],
        rtol=0,
        atol=1e-12,
    )
    plain = model.loss(Windows(windows.position[:frames], windows.particle_type, windows.example, windows.context), torch.Generator(), 0.0)
    other = Windows(windows.position[:frames, order], windows.particle_type[order], windows.example, windows.context)
    assert torch.allclose(model.loss(other, torch.Generator(), 0.0), plain, rtol=1e-10)


@pytest.mark.parametrize("settings", ALL)
def test_the_company_in_a_batch_is_nothing(settings):
    """The loss of a batch is the mean over its moving particles: that of its windows alone, each by its share of them."""
    model, windows = case(settings, 3)
    frames = model.window(0.0)
    together = model.loss(Windows(windows.position[:frames], windows.particle_type, windows.example, windows.context), torch.Generator(), 0.0)
    alone = 0.0
    for example in range(3):
        mine = windows.example == example
        one = Windows(windows.position[:frames, mine], windows.particle_type[mine], torch.zeros(40, dtype=torch.int64), windows.context[:, [example]])
        share = (windows.particle_type[mine] != 3).sum() / (windows.particle_type != 3).sum()
        alone = alone + share * model.loss(one, torch.Generator(), 0.0)
    assert torch.allclose(together, alone, rtol=1e-6)
    if "unroll" not in settings:
        # Whatever the others are, to the last digit of a sum that is ordered by neighbours.
        context = windows.context[2][windows.example]
        graph = radius_graph(windows.position[2], model.radius, windows.example, self_edges=model.options.self_edges)
        batch = model._predict(windows.position[:3], graph, windows.particle_type, model.features.bounds, context)
        first = outputs(model, windows.position[:3, :40], windows.particle_type[:40], context[:40])
        assert torch.allclose(batch[:40], first, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "frames"), [({"noise": 0.0}, []), ({"noise_scheme": "last"}, [2]), ({"noise_scheme": "correlated"}, [1, 2]), ({}, [1, 2])]
)
def test_which_frames_are_noisy(settings, frames, monkeypatch):
    """What the network is given in training, beside the truth; kinematic particles are never moved."""
    model, windows = case({"noise": 0.3} | settings, 1)
    windows = Windows(windows.position[:4], windows.particle_type, windows.example, windows.context)
    seen = []
    nodes = model.features.nodes
    monkeypatch.setattr(model.features, "nodes", lambda position, *rest: seen.append(position) or nodes(position, *rest))
    model.loss(windows, torch.Generator().manual_seed(0), 0.0)
    noise = seen[0] - windows.position[:3]
    moving = windows.particle_type != 3
    assert not noise[:, ~moving].any()
    assert noise[:, moving].abs().sum((1, 2)).nonzero().flatten().tolist() == frames


@pytest.mark.parametrize(("name", "change"), [("types", {"kinds": torch.tensor([5, 6, 5, 5])}), ("context", {"context": torch.ones(4, 1)})])
def test_types_and_context_are_felt(name, change):
    model = four(particle_types=(5, 6), context_mean=(0.0,), context_std=(1.0,))
    position, plain = window(model), {"kinds": KINDS, "context": torch.zeros(4, 1)}
    moved = (outputs(model, position, **(plain | change)) - outputs(model, position, **plain)).abs().sum(1) > 1e-6
    assert moved.tolist() == ([True, True, True, False] if name == "types" else [True] * 4)


@pytest.mark.parametrize("self_edges", [True, False])
def test_the_graph_of_training_and_rollouts(self_edges, monkeypatch):
    """Four edges between the row's particles; with those to themselves, eight."""
    model = four({"self_edges": self_edges, "noise": 0.0})
    path, seen = window(model).float(), []
    forward = model.network.forward
    monkeypatch.setattr(model.network, "forward", lambda nodes, edges, graph: seen.append(graph.edges) or forward(nodes, edges, graph))
    model.loss(Windows(torch.cat([path, path[-1:]]).double(), KINDS, torch.zeros(4, dtype=torch.int64)), torch.Generator(), 0.0)
    rollout(model, start(path), 1)
    assert seen == [8, 8] if self_edges else seen == [4, 4]


@pytest.mark.parametrize("self_edges", [True, False])
@pytest.mark.parametrize(("least", "flying"), [(1, [False, False, False, True]), (2, [True, False, True, True])])
def test_an_edge_to_oneself_is_no_neighbour(self_edges, least, flying):
    model = four({"self_edges": self_edges, "ballistic": True, "flight_below": least})
    assert (outputs(model, window(model)) == 0).all(1).tolist() == flying


def test_a_start_without_edges_may_grow_some():
    """Four particles in flight meet at a point: none of the twelve edges at first, then two, then all, and that is no clump."""
    model = four({"self_edges": False, "radius": 0.4, "history": 1, "ballistic": True})
    torch.nn.init.zeros_(model.network.decode.linears[-1].weight)
    path = torch.tensor([[[0.30, 0.5], [0.35, 0.5], [0.42, 0.5], [0.50, 0.5]]])
    path = torch.cat([path, path + 0.1 * (torch.tensor([0.35, 0.5]) - path)])
    run = rollout(model, start(path), 9)
    assert run.status == "ok" and np.ptp(run.position[-1, :, 0]) < 1e-4
