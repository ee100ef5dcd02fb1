"""Features by hand, and the statistics of the noise."""

import math

import torch

from learn.dataset import DataSpec
from learn.features import Features, random_walk_noise, velocity_noise
from learn.graph import radius_graph


def spec(**changes) -> DataSpec:
    values = dict(
        dim=2,
        bounds=((0.0, 1.0), (0.0, 2.0)),
        radius=0.5,
        spacing=0.25,
        frame_step=0.1,
        stride=2,
        gravity=(0.0, -10.0),
        particle_types=(5,),
        velocity_mean=(0.1, 0.0),
        velocity_std=(0.3, 0.4),
        acceleration_mean=(0.0, 0.5),
        acceleration_std=(0.6, 0.8),
    )
    return DataSpec(**(values | changes))


def features(data: DataSpec, **changes) -> Features:
    values = dict(sigma=0.0, velocities=2, radius=0.5, wall_distance=0.5, scaling="velocity", relative_velocity=False, ballistic=False)
    return Features(data, **(values | changes))


POSITION = torch.tensor([[[0.00, 1.0], [0.5, 1.0], [0.9, 1.9]], [[0.10, 1.0], [0.5, 1.4], [0.9, 1.9]], [[0.30, 1.0], [0.5, 1.0], [0.9, 1.9]]])
TYPE = torch.tensor([5, 5, 5])


def near(values: torch.Tensor, wanted: list) -> None:
    torch.testing.assert_close(values, torch.tensor(wanted, dtype=torch.float32), rtol=1e-5, atol=1e-5)


def test_hand_computed_nodes():
    made = features(spec())
    assert (made.node_width, made.edge_width) == (8, 3)
    near(
        made.nodes(POSITION, TYPE, made.bounds),
        [[0, 0, 1 / 3, 0, 0.6, 1, 1, 1], [-1 / 3, 1, -1 / 3, -1, 1, 1, 1, 1], [-1 / 3, 0, -1 / 3, 0, 1, 1, 0.2, 0.2]],
    )


def test_particles_outside_the_box_see_negative_distances():
    made = features(spec())
    near(made.nodes(POSITION - torch.tensor([0.4, 0.0]), TYPE, made.bounds)[0, 4:], [-0.2, 1, 1, 1])


def test_acceleration_scaling_and_last_velocity():
    near(
        features(spec(), scaling="acceleration").nodes(POSITION, TYPE, torch.tensor(spec().bounds))[:2, :4],
        [[0.1 / 0.6, -0.5 / 0.8, 1 / 3, 0], [0, (-0.8 - 0.5) / 0.8, -1 / 3, -1]],
    )
    last = features(spec(), scaling="last")
    assert last.node_width == 6
    near(last.nodes(POSITION, TYPE, last.bounds)[0, :2], [1 / 3, 0])


def test_hand_computed_edges():
    made = features(spec(), relative_velocity=True)
    graph = radius_graph(POSITION[-1], 0.5)
    assert list(zip(graph.receiver.tolist(), graph.sender.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 2)]
    near(
        made.edges(POSITION, graph), [[0, 0, 0, 0, 0], [0.4, 0, 0.4, -0.2 / 0.3, -1], [-0.4, 0, 0.4, 0.2 / 0.3, 1], [0, 0, 0, 0, 0], [0, 0, 0, 0, 0]]
    )
    assert features(spec()).edges(POSITION, graph).shape == (5, 3)


def test_self_edges_have_a_finite_gradient():
    position = POSITION.clone().requires_grad_()
    features(spec()).edges(position, radius_graph(POSITION[-1], 0.5)).sum().backward()
    assert position.grad.isfinite().all()


def test_noise_inflates_the_standard_deviations():
    made = features(spec(), sigma=0.4)
    near(made.velocity_std, [0.5, math.sqrt(0.32)])
    near(made.acceleration_std, [math.sqrt(0.36 + 0.16), math.sqrt(0.64 + 0.16)])


def test_an_axis_without_motion_gives_zeros():
    made = features(spec(velocity_std=(0.0, 0.4), velocity_mean=(0.0, 0.0)))
    assert made.nodes(POSITION * torch.tensor([0.0, 1.0]), TYPE, made.bounds).isfinite().all()


def test_target_inverts_acceleration():
    for ballistic, walls in ((False, False), (True, False), (True, True)):
        made = features(spec(), ballistic=ballistic, walls=walls)
        output = torch.tensor([[0.3, -1.0], [2.0, 0.0], [0.0, 0.0]])
        following = 2 * POSITION[-1] - POSITION[-2] + made.acceleration(output, POSITION, made.bounds)
        near(made.target(POSITION, following), output.tolist())
    made = features(spec(), ballistic=True)
    near(made.acceleration(torch.zeros(1, 2), POSITION, made.bounds), [[0.0, -0.4]])  # gravity * (2 frames of 0.1 s)^2


def test_flight_stops_at_the_walls():
    """Flight ends at (.5, .6), (.5, .2), (.9, 1.5); the box is x <= .45, y >= .9; without forces the three come to (.5, 1), (.5, .6), (.9, 1.9)."""
    made = features(spec(), ballistic=True, walls=True)
    box = torch.tensor([[0.0, 0.45], [0.9, 1.95]])
    near(made.acceleration(torch.zeros(3, 2), POSITION, box), [[-0.05, -0.1], [-0.05, 0.3], [-0.45, -0.4]])


def test_types_and_context_are_built_only_where_the_data_have_them():
    assert features(spec()).embedding is None
    made = features(spec(particle_types=(3, 5), context_mean=(1.0,), context_std=(2.0,)))
    assert made.node_width == 8 + 16 + 1
    kinds = torch.tensor([5, 3, 5])
    assert made.moving(kinds).tolist() == [True, False, True] and features(spec()).moving(kinds) is None
    nodes = made.nodes(POSITION, kinds, made.bounds, torch.tensor([[5.0], [1.0], [-1.0]]))
    near(nodes[:, -1], [2, 0, -1])
    assert torch.equal(nodes[0, 8:24], nodes[2, 8:24]) and not torch.equal(nodes[0, 8:24], nodes[1, 8:24])


def test_random_walk_noise_per_axis_leaves_the_fixed_alone():
    moving = torch.arange(20000) >= 100
    noise = random_walk_noise(torch.zeros(6, 20000, 2), torch.tensor([1e-3, 2e-3]), torch.Generator().manual_seed(0), moving)
    assert noise[0].abs().max() == 0 and noise[:, :100].abs().max() == 0
    assert torch.allclose((noise[-1] - noise[-2])[100:].std(0), torch.tensor([1e-3, 2e-3]), rtol=0.03)


def test_random_walk_noise_statistics():
    position, sigma = torch.zeros(6, 20000, 2), 0.3
    noise = random_walk_noise(position, sigma, torch.Generator().manual_seed(0))
    velocity = noise.diff(dim=0)
    assert not noise[0].any()
    # The walk: after k of the five steps the velocity noise has std sigma sqrt(k / 5), so sigma in the last; steps are independent.
    wanted = sigma * (torch.arange(1, 6) / 5).sqrt()
    torch.testing.assert_close(velocity.std((1, 2)), wanted, rtol=0.02, atol=0)
    assert velocity.mean((1, 2)).abs().max() < 4 * sigma / math.sqrt(40000)
    steps = velocity.diff(dim=0)
    torch.testing.assert_close(steps.std((1, 2)), torch.full((4,), sigma / math.sqrt(5)), rtol=0.02, atol=0)
    correlation = torch.corrcoef(steps.flatten(1))
    assert (correlation - torch.eye(4)).abs().max() < 0.03


def test_moments_of_the_other_schemes():
    """The last velocity as in the random walk; what the others have in common with it tells the schemes apart."""
    position, sigma = torch.zeros(6, 20000, 2), torch.tensor([0.3, 0.1])
    for scheme, std, correlation in (("uncorrelated", 1, 0), ("correlated", 1, 1), ("last", 0, 0)):
        noise = velocity_noise(scheme, position, sigma, torch.Generator().manual_seed(0), torch.arange(20000) > 0)
        assert not noise[0].any() and not noise[:, 0].any()
        velocity = noise.diff(dim=0)[:, 1:]
        torch.testing.assert_close(velocity[-1].std(0), sigma, rtol=0.03, atol=0)
        assert velocity[-1].mean(0).abs().max() < 4 * 0.3 / math.sqrt(20000)
        torch.testing.assert_close(velocity[:-1].std(1), std * sigma.expand(4, 2), rtol=0.03, atol=0)
        together = (velocity[:-1] * velocity[-1]).mean(1) / sigma**2
        torch.testing.assert_close(together, torch.full((4, 2), float(correlation)), rtol=0.03, atol=0.03)


def test_every_scheme_is_the_random_walk_where_there_is_one_velocity():
    position = torch.zeros(2, 50, 2)
    walk = random_walk_noise(position, 0.3, torch.Generator().manual_seed(0))
    for scheme in ("uncorrelated", "correlated", "last"):
        assert torch.equal(velocity_noise(scheme, position, 0.3, torch.Generator().manual_seed(0)), walk)


def test_noise_is_the_generators_and_spares_kinematic_particles():
    position, moving = torch.zeros(3, 4, 2), torch.tensor([True, False, True, True])
    first, again, other = (random_walk_noise(position, 1.0, torch.Generator().manual_seed(seed), moving) for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert not first[:, 1].any() and first[1:, 0].all()


def test_no_noise():
    assert not random_walk_noise(torch.zeros(3, 4, 2), 0.0, torch.Generator()).any()
