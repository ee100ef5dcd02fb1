"""Grid emulator: transfers by hand, sparse convolution against the dense one, oracles, loss, determinism."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from torch import nn

from learn.dataset import DataSpec, Windows
from learn.grid_emulator import GridEmulator, GridEmulatorSettings, SparseGrid, StencilConv
from sim.simulator import Start, rollout

GRAVITY, FRAME_STEP = (0.0, -9.8), 0.0025


def spec(**changes: object) -> DataSpec:
    """A unit box, particles 1/20 apart (cells of 1/10), statistics of order one spacing."""
    values = {
        "dim": 2,
        "bounds": ((0.0, 1.0), (0.0, 1.0)),
        "radius": 0.1,
        "spacing": 0.05,
        "frame_step": FRAME_STEP,
        "stride": 1,
        "gravity": GRAVITY,
        "particle_types": (5,),
        "velocity_mean": (0.0, 0.0),
        "velocity_std": (4e-3, 4e-3),
        "acceleration_mean": (0.0, 0.0),
        "acceleration_std": (2e-4, 2e-4),
    }
    return DataSpec(**{**values, **changes})


def emulator(settings: dict | None = None, **changes: object) -> GridEmulator:
    torch.manual_seed(0)
    return GridEmulator(GridEmulatorSettings(**{"channels": [8, 8], "frames_per_call": 4, **(settings or {})}), spec(**changes))


def awaken(model: GridEmulator, size: float = 0.1) -> GridEmulator:
    """Give the output layer, zero at the start, some weights."""
    with torch.no_grad():
        model.network.leave.weight.normal_(0, size, generator=torch.Generator().manual_seed(1))
    return model


def flight(particles: int, frames: int, dim: int = 2, seed: int = 0, gravity: tuple[float, ...] = GRAVITY) -> np.ndarray:
    """Ballistic frames x_t = x + v t + g t (t + 1) / 2 (symplectic Euler), dt = 1 frame, each particle with its own velocity."""
    generator = np.random.default_rng(seed)
    time = np.arange(frames)[:, None, None]
    drop = np.asarray(gravity) * FRAME_STEP**2 * time * (time + 1) / 2
    return (generator.uniform(0.3, 0.7, (particles, dim)) + generator.normal(0, 2e-3, (particles, dim)) * time + drop).astype(np.float32)


def start(position: np.ndarray, **changes: object) -> Start:
    dim = position.shape[2]
    values = {
        "history": position,
        "particle_type": np.full(position.shape[1], 5, np.int8),
        "present": len(position) - 1,
        "frame_step": FRAME_STEP,
        "radius": 0.1,
        "bounds": np.array([[0.0, 1.0]] * dim),
        "scene": {"gravity": list(GRAVITY)},
    }
    return Start(**{**values, **changes})


def windows(position: np.ndarray, examples: int = 1, kinds: int = 5) -> Windows:
    particles = position.shape[1]
    example = torch.arange(particles) * examples // particles
    return Windows(torch.from_numpy(position), torch.full((particles,), kinds), example)


def test_particles_to_grid_by_hand() -> None:
    """A particle a quarter of a cell right of and half a cell above a node: weights 3/8, 3/8, 1/8, 1/8."""
    model = emulator({"margin": 2})
    node, weight = model.weights(torch.tensor([[0.325, 0.45]]), torch.zeros(1, dtype=torch.long))
    assert torch.allclose(weight[0], torch.tensor([0.375, 0.375, 0.125, 0.125]), atol=1e-5)
    # Node (3, 4) of the box is (5, 6) with the margin and (6, 7) with the ring of the index tables, which are 17 wide.
    assert node[0].tolist() == [6 * 17 + 7, 6 * 17 + 8, 7 * 17 + 7, 7 * 17 + 8]


def test_transfer_conserves_and_interpolates_linear_fields() -> None:
    model = emulator()
    position = torch.rand(50, 2, generator=torch.Generator().manual_seed(0))
    example = torch.arange(50) // 25
    node, weight = model.weights(position, example)
    assert torch.allclose(weight.sum(1), torch.ones(50), atol=1e-5)  # partition of unity
    occupied, rows, _ = model.grid.occupy(node, 2)
    value = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
    grid = model.to_grid(value, rows[node], weight, len(occupied))
    assert torch.allclose(grid.sum(0), value.sum(0), atol=1e-4)  # mass and momentum conserved
    local = occupied % model.grid.sizes[0]
    place = torch.stack([local // 17, local % 17], 1) - 1.0
    place = model.origin + place * model.cell
    slope = torch.tensor([[2.0, -1.0], [0.5, 3.0]])
    read = model.to_particles(place @ slope + 0.3, rows[node], weight)
    assert torch.allclose(read, position @ slope + 0.3, atol=1e-5)


def test_a_particle_beyond_the_grid_has_no_weight() -> None:
    node, weight = emulator().weights(torch.tensor([[1.5, 0.5], [0.5, -3.0], [float("inf"), 0.5]]), torch.zeros(3, dtype=torch.long))
    assert weight.abs().sum() == 0
    assert node.min() >= 0 and node.max() < 17 * 17


@pytest.mark.parametrize("dim", [2, 3])
def test_sparse_convolution_is_the_dense_one_on_occupied_nodes(dim: int) -> None:
    generator = torch.Generator().manual_seed(0)
    grid = SparseGrid([5, 6, 4][:dim], 1)
    padded = [extent + 2 for extent in grid.shape]
    mask = torch.zeros(2, *padded, dtype=torch.bool)
    mask[(slice(None), *[slice(1, -1)] * dim)] = torch.rand(2, *grid.shape, generator=generator) < 0.5
    occupied, _, levels = grid.occupy(mask.flatten().nonzero().squeeze(1), 2)
    convolution = StencilConv(dim, 3, 4).double()
    x = torch.randn(len(occupied), 3, dtype=torch.float64, generator=generator, requires_grad=True)
    dense = torch.zeros(mask.numel(), 3, dtype=torch.float64).index_copy(0, occupied, x).view(2, *padded, 3).movedim(-1, 1)
    kernel = convolution.weight.view(*[3] * dim, 3, 4).movedim((-1, -2), (0, 1))
    full = [nn.functional.conv2d, nn.functional.conv3d][dim - 2](dense, kernel, convolution.bias, padding=1)
    expected = full.movedim(1, -1).reshape(-1, 4)[occupied]
    found = convolution(x, levels[0].neighbours)
    assert torch.allclose(found, expected, atol=1e-12)
    inputs = (x, convolution.weight, convolution.bias)
    weights = torch.randn(found.shape, dtype=torch.float64, generator=generator)
    for one, other in zip(torch.autograd.grad((found * weights).sum(), inputs), torch.autograd.grad((expected * weights).sum(), inputs), strict=True):
        assert torch.allclose(one, other, atol=1e-12)


def test_coarser_levels_hold_the_parents() -> None:
    grid = SparseGrid([6, 5], 2)
    # Nodes (2, 3), (3, 3) share the parent (1, 1), node (4, 0) has the parent (2, 0); ids in the ringed 8 x 7 table.
    _, _, levels = grid.occupy(torch.tensor([3 * 7 + 4, 4 * 7 + 4, 5 * 7 + 1]), 1)
    assert levels[0].coarse == 2
    assert levels[0].child.tolist() == [0 * 4 + 1, 0 * 4 + 3, 1 * 4 + 0]
    assert levels[1].neighbours[0].tolist() == [2, 2, 2, 2, 0, 2, 1, 2, 2]


@pytest.mark.parametrize("dim", [2, 3])
def test_untrained_model_flies_ballistically(dim: int) -> None:
    gravity = (*GRAVITY, 0.0)[:dim]
    model = emulator(
        {"history": 3, "preview": []},
        dim=dim,
        bounds=((0.0, 1.0),) * dim,
        gravity=gravity,
        **{name: (1e-3,) * dim for name in ("velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std")},
    )
    truth = flight(40, 23, dim, gravity=gravity)
    found = rollout(model, start(truth[:3]), 20)
    assert found.status == "ok"
    assert np.abs(found.position - truth[3:]).max() < 1e-5


def test_oracle_network_reproduces_a_turning_flow() -> None:
    """With the network replaced by the true velocity deviations on the grid, uniform but unsteady motion is exact."""
    model = emulator({"history": 2})
    frames = 2 + 5 * 4
    course = np.stack([0.05 * np.sin(0.3 * np.arange(frames)), 0.04 * np.cos(0.2 * np.arange(frames))], 1)
    truth = (flight(30, 1) + course[:, None]).astype(np.float32)

    class Oracle(nn.Module):
        call = 0

        def forward(self, x: torch.Tensor, levels: list) -> torch.Tensor:
            now = 1 + 4 * self.call
            self.call += 1
            step = torch.from_numpy(np.diff(course, axis=0)).float()
            deviation = step[now : now + 4] - step[now - 1] - model.gravity * model.frame
            output = (deviation / model.frame_scale[:, None]).flatten()
            return torch.cat([output, torch.zeros(1)]).expand(len(x), -1)

    model.network = Oracle()
    found = rollout(model, start(truth[:2]), 20)
    assert np.abs(found.position - truth[2:]).max() < 1e-5


def test_full_blend_gives_the_grid_velocity() -> None:
    """b = 1 and no deviation: two particles at one place leave it with their mean velocity (PIC)."""
    model = emulator({"history": 2})
    model.gravity.zero_()
    with torch.no_grad():
        model.network.leave.bias[-1] = 1.0
    velocity = np.array([[0.002, 0.0], [-0.001, 0.004]], np.float32)
    position = np.stack([np.full((2, 2), 0.42, np.float32) - velocity, np.full((2, 2), 0.42, np.float32)])
    model.begin(start(position))
    step = model.advance()[0] - position[1]
    assert np.allclose(step, velocity.mean(0), atol=1e-5)


def test_two_materials_at_one_place_keep_their_velocities() -> None:
    """b = 1: three particles at one place, two of water (5) and one of sand (6), each leave it with their own material's mean velocity; an obstacle
    (3) there has no part in it."""
    model = emulator({"history": 2}, particle_types=(3, 5, 6))
    model.gravity.zero_()
    with torch.no_grad():
        model.network.leave.bias.view(2, -1)[:, -1] = 1.0
    velocity = np.array([[0.002, 0.0], [-0.001, 0.004], [0.003, -0.002], [0.0, 0.0]], np.float32)
    position = np.stack([np.full((4, 2), 0.42, np.float32) - velocity, np.full((4, 2), 0.42, np.float32)])
    kinds = np.array([5, 5, 6, 3], np.int8)
    model.begin(start(position, particle_type=kinds, kinematic=position[:, 3:]))
    step = model.advance()[0] - position[1]
    water = velocity[:2].mean(0)
    # A lone particle's weights of 0.2 to 0.3 have 1e-3 added: 0.4 % of its velocity.
    assert np.allclose(step, [water, water, velocity[2], [0, 0]], rtol=5e-3, atol=1e-6)


def test_an_output_of_one_material_moves_that_alone() -> None:
    model = emulator({"history": 2}, particle_types=(5, 6))
    position = flight(6, 3)
    kinds = np.array([5, 6, 5, 6, 6, 5], np.int8)
    model.begin(start(position[:2], particle_type=kinds))
    free = model.advance()
    with torch.no_grad():
        model.network.leave.bias.view(2, -1)[1, 0] = 1.0  # sand's deviation along x in the first frame
    model.begin(start(position[:2], particle_type=kinds))
    moved = model.advance()[0] - free[0]
    expected = np.where((kinds == 6)[:, None], [float(model.frame_scale[0]), 0.0], 0.0)
    assert np.allclose(moved, expected, atol=1e-7)


def test_windows_grow_with_progress() -> None:
    model = emulator({"history": 3, "unroll": [1, 2, 4]})
    assert [model.window(progress) for progress in (0.0, 0.34, 0.67, 1.0)] == [7, 11, 19, 19]


def test_targets_move_with_the_noise() -> None:
    """The noise of the last input velocity alone makes the loss of free flight: shifted targets cancel the noise of the position."""
    model = emulator({"history": 2, "noise": 0.5, "unroll": [1]})
    position = flight(2000, model.window(0))
    loss = model.loss(windows(position), torch.Generator().manual_seed(0), 0.0)
    # After j frames a noisy velocity e has moved the particle by j e; e has std 0.5 x 4e-3; the scale is the floor, 0.03 x 0.05.
    expected = np.mean([(j * 0.5 * 4e-3 / (0.03 * 0.05)) ** 2 for j in range(1, 5)])
    assert abs(loss.item() / expected - 1) < 0.05


def test_loss_of_free_flight_without_noise_is_zero() -> None:
    model = emulator({"noise": 0.0})
    loss = model.loss(windows(flight(30, model.window(1.0))), torch.Generator(), 1.0)
    assert loss.item() < 1e-4


def test_one_example_does_not_see_another() -> None:
    model = awaken(emulator({"noise": 0.0}))
    position = torch.from_numpy(flight(40, 2))
    kind, example = torch.full((40,), 5), torch.arange(40) // 20
    together = model.call(position, kind, example, 2)
    apart = torch.cat([model.call(position[:, part], kind[part], torch.zeros(20, dtype=torch.long), 1) for part in (slice(20), slice(20, 40))], 1)
    assert torch.allclose(together, apart, atol=1e-6)


def test_gradients_reach_every_weight_and_repeat_bitwise() -> None:
    found = []
    for _ in range(2):
        model = awaken(emulator({"noise": 0.1}))
        model.loss(windows(flight(60, model.window(1.0)), examples=3), torch.Generator().manual_seed(3), 1.0).backward()
        found.append([parameter.grad for parameter in model.parameters()])
    assert all(gradient.abs().sum() > 0 for gradient in found[0])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


@pytest.mark.parametrize(("changes", "message"), [
    ({"frame_step": 0.5}, "frame step is 0.5 s"), ({"particle_type": np.full(4, 6, np.int8)}, r"types \[6\]"),
    ({"history": np.zeros((1, 4, 2), np.float32)}, "1 frames, the model needs 2"),
    ({"history": np.zeros((2, 4, 3), np.float32)}, "3 dimensions, the model 2"),
])  # fmt: skip
def test_a_start_of_another_kind_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        emulator().begin(start(flight(4, 2), **changes))


def test_stride_interpolates_between_model_frames() -> None:
    model = emulator({"history": 2}, stride=3, gravity=(0.0, 0.0))
    assert model.history == 4
    truth = flight(20, 16, gravity=(0.0, 0.0))
    model.begin(start(truth[:4]))
    block = model.advance()
    assert block.shape == (12, 20, 2) and block.dtype == np.float32
    assert np.abs(block - truth[4:]).max() < 1e-5


def test_kinematic_particles_follow_their_prescription() -> None:
    model = awaken(emulator({"history": 2}, particle_types=(3, 5)))
    truth = flight(20, 14)
    kinds = np.where(np.arange(20) < 5, 3, 5).astype(np.int8)
    found = rollout(model, start(truth[:2], particle_type=kinds, kinematic=truth[:, :5]), 12)
    assert np.array_equal(found.position[:, :5], truth[2:, :5])
    assert not np.allclose(found.position[:, 5:], truth[2:, 5:], atol=1e-5)
    # In training they are given, so a model without error elsewhere has none.
    still = emulator({"noise": 0.0}, particle_types=(3, 5))
    position = flight(20, still.window(0.0))
    position[:, :5] = position[0, :5]
    batch = Windows(torch.from_numpy(position), torch.from_numpy(kinds.astype(np.int64)), torch.zeros(20, dtype=torch.long))
    assert still.loss(batch, torch.Generator(), 0.0).item() < 1e-4


def test_context_reaches_the_network_only_where_there_is_one() -> None:
    plain = emulator()
    model = awaken(emulator({"history": 2}, context_mean=(0.0,), context_std=(2.0,)))
    assert model.network.enter.weight.shape[1] == emulator({"history": 2}).network.enter.weight.shape[1] + 1
    assert plain.context == 0
    truth = flight(20, 10)
    found = [rollout(model, start(truth[:2], context=np.full((10, 1), value, np.float32)), 4).position for value in (0.0, 1.0)]
    assert not np.allclose(*found, atol=1e-6)


def test_flight_stops_at_the_walls_and_need_not() -> None:
    truth = np.array([[[0.5, 0.011]], [[0.5, 0.001]]], np.float32)
    found = [rollout(emulator({"walls": walls}), start(truth), 4).position[:, 0, 1] for walls in (True, False)]
    assert np.allclose(found[0], 0.0) and (found[1] < -0.008).all()


def test_density_is_one_in_the_bulk() -> None:
    model = emulator()
    axis = torch.arange(20) * 0.05 + 0.025
    position = torch.cartesian_prod(axis, axis)
    density = model.density(torch.stack([position, position + 5]), torch.zeros(400, dtype=torch.long), 1)
    middle = (position - 0.5).abs().max(1).values < 0.3
    assert torch.allclose(density[middle, 0], torch.ones(1), atol=1e-3)
    assert density[:, 1].abs().max() == 0  # all beyond the grid


def test_selection_prefers_windows_far_from_flight() -> None:
    model = emulator({"select": 2, "noise": 0.0})
    position = np.concatenate([flight(10, model.window(0.0), seed=seed) for seed in range(8)], 1)
    position[-1, 30:40] += 0.1
    batch = windows(position, examples=8)
    generator, seen = torch.Generator().manual_seed(0), np.zeros(8)
    for _ in range(120):
        chosen = model._select(batch, 2, generator)
        assert chosen.examples == 2 and chosen.position.shape[1] == 20
        seen[[int(((batch.position[0] - place).abs().sum(1)).argmin()) // 10 for place in chosen.position[0, ::10]]] += 1
    assert seen[3] > 75 and seen.min() > 8
    assert model.loss(batch, generator, 0.0).item() >= 0


@pytest.mark.parametrize("fault", [{"colour": "blue"}, {"preview": [1.5]}, {"unroll": [2, 1]}, {"frames_per_call": 0}])
def test_faulty_options_are_refused(fault: dict) -> None:
    with pytest.raises(ValidationError):
        GridEmulatorSettings(**fault)


def test_parameter_count() -> None:
    """Inputs: density, two velocities of two components, four walls, two previews; 4 frames of two components and the blend come out."""
    model = emulator({"history": 3})
    enter, block, down, up, leave = 9 * 11 * 8 + 8, 9 * 64 + 8, 32 * 8 + 8, 8 * 32 + 32, 8 * 9 + 9
    assert sum(parameter.numel() for parameter in model.parameters()) == enter + 3 * block + down + up + leave


def test_relaxation_spreads_a_clump_over_the_frames_of_a_call_and_leaves_flight_alone():
    crowd = np.repeat(flight(60, 2)[:, :1], 60, axis=1) + np.random.default_rng(4).normal(0, 0.01, (60, 2)).astype(np.float32)
    plain, relaxed = (rollout(emulator({"relaxation": option}), start(crowd), 4).position for option in (None, {"loops": 2}))
    moved = relaxed - plain
    assert np.abs(moved[-1]).max() > 1e-3
    np.testing.assert_allclose(moved, moved[-1] * np.array([0.25, 0.5, 0.75, 1.0])[:, None, None], atol=1e-6)
    spray = flight(20, 2, seed=5)
    plain, relaxed = (rollout(emulator({"relaxation": option}), start(spray), 8).position for option in (None, {}))
    np.testing.assert_array_equal(plain, relaxed)
