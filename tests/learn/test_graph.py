"""The radius graph: hand-computed edges, brute force, the invariants that message passing relies on."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learn import graph as graph_module
from learn.graph import Graph, radius_graph


def pairs(graph: Graph) -> list[tuple[int, int]]:
    return list(zip(graph.receiver.tolist(), graph.sender.tolist(), strict=True))


def test_hand_computed_edges():
    position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [5.0, 5.0]])
    graph = radius_graph(position, 1.0)  # 0-1 and 0-2 at exactly the radius, 1-2 at sqrt(2)
    assert pairs(graph) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0), (2, 2), (3, 3)]
    assert graph.offsets.tolist() == [0, 3, 5, 7, 8]
    assert graph.reverse.tolist() == [0, 3, 5, 1, 4, 2, 6, 7]
    assert (graph.edges, graph.particles) == (8, 4)


def test_without_self_edges():
    position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [5.0, 5.0]])
    graph = radius_graph(position, 1.0, self_edges=False)
    assert pairs(graph) == [(0, 1), (0, 2), (1, 0), (2, 0)]
    assert graph.offsets.tolist() == [0, 2, 3, 4, 4] and graph.reverse.tolist() == [2, 3, 0, 1]
    assert radius_graph(position, 0.5, self_edges=False).edges == 0


def test_examples_do_not_join():
    position = torch.zeros(4, 2)
    assert pairs(radius_graph(position, 1.0, torch.tensor([0, 0, 1, 1]))) == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 2), (2, 3), (3, 2), (3, 3)]


def test_no_cap_on_neighbours():
    assert radius_graph(torch.zeros(300, 3), 0.1).edges == 300 * 300


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_position_that_is_not_finite_is_refused(value):
    with pytest.raises(FloatingPointError, match="not finite"):
        radius_graph(torch.tensor([[0.0, 0.0], [value, 0.0]]), 1.0)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 60), dim=st.sampled_from([2, 3]), radius=st.floats(0.01, 2.0), examples=st.integers(1, 3))
def test_against_brute_force(seed, count, dim, radius, examples):
    generator = np.random.default_rng(seed)
    points = generator.random((count, dim)).astype(np.float32)
    label = np.sort(generator.integers(0, examples, count))
    graph = radius_graph(torch.from_numpy(points), radius, torch.from_numpy(label))
    distance = np.linalg.norm(points[:, None].astype(float) - points[None].astype(float), axis=2)
    doubtful = np.abs(distance - radius) < 1e-12
    wanted = (distance <= radius) & (label[:, None] == label[None])
    found = np.zeros_like(wanted)
    found[graph.receiver.numpy(), graph.sender.numpy()] = True
    assert graph.edges == found.sum()  # no edge twice
    assert ((found == wanted) | doubtful).all()
    order = graph.receiver.long() * count + graph.sender
    assert (order.diff() > 0).all()
    assert torch.equal(graph.receiver[graph.reverse], graph.sender) and torch.equal(graph.sender[graph.reverse], graph.receiver)


def test_runs_cover_every_edge_once(monkeypatch):
    monkeypatch.setattr(graph_module, "RUN", 7)
    position = torch.cat([torch.rand(40, 2, generator=torch.Generator().manual_seed(0)), torch.full((9, 2), 3.0)])  # nine exceed a run
    graph = radius_graph(position, 0.2)
    receivers = [i for run in graph.runs for i in range(49)[run.receivers]]
    edges = [e for run in graph.runs for e in range(graph.edges)[run.edges]]
    assert receivers == list(range(49)) and edges == list(range(graph.edges))
    for run in graph.runs:
        count = len(run.order)
        assert count <= 7 or len(range(49)[run.receivers]) == 1
        assert run.offsets[0] == 0 and run.offsets[-1] == count
        assert torch.equal(run.pairs.view(-1, 2), torch.stack([2 * graph.receiver[run.edges], 2 * graph.sender[run.edges] + 1], 1))
