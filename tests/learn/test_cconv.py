"""CConv: the convolution against its definition written out, the published layout, walls, loss, rollout by hand."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from learn.cconv import CConv, ContinuousConv, Pairs, Walls, ball_to_cube, load_published, wall_particles
from learn.dataset import DataSpec, Windows
from learn.model import build
from learn.relaxation import Relaxation
from sim.errors import InputError
from sim.simulator import Start, rollout

torch.set_num_threads(1)

GRAVITY = -9.81
#: The published network at a twelfth of its width, and its name for every tensor.
PUBLISHED = {"conv0_fluid": (4, 4), "conv0_obstacle": (3, 4), "conv1": (12, 6), "conv2": (6, 6), "conv3": (6, 3)}


def spec(dim: int = 3, **changes: object) -> DataSpec:
    values = {
        "dim": dim,
        "bounds": ((0.0, 1.0),) * dim,
        "radius": 0.2,
        "spacing": 0.1,
        "frame_step": 0.01,
        "stride": 1,
        "gravity": (0.0, GRAVITY, 0.0)[:dim],
        "particle_types": (5,),
        "velocity_mean": (0.0,) * dim,
        "velocity_std": (1e-2,) * dim,
        "acceleration_mean": (0.0,) * dim,
        "acceleration_std": (1e-3,) * dim,
    }
    return DataSpec(**{**values, **changes})


def small(dim: int = 3, data: dict | None = None, **settings: object) -> CConv:
    torch.manual_seed(0)
    return build("cconv", {"channels": [4, 6, 6], **settings}, spec(dim, **(data or {})))


def awaken(model: CConv) -> CConv:
    """Biases, which begin at zero, would hide a mistake."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("bias"):
                parameter.uniform_(-0.2, 0.2, generator=generator)
    return model


def cloud(particles: int, dim: int = 3, seed: int = 0, low: float = 0.3, high: float = 0.7) -> Tensor:
    return torch.rand((particles, dim), generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * (high - low) + low


def windows(frames: int, particles: int = 40, dim: int = 3, seed: int = 0, examples: int = 2, kinds: int | list[int] = 5) -> Windows:
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand((particles, dim), generator=generator) * 0.5 + 0.25
    steps = 5e-3 * torch.randn((frames, particles, dim), generator=generator)
    kind = torch.full((particles,), kinds) if isinstance(kinds, int) else torch.tensor(kinds)
    return Windows(start + steps.cumsum(0), kind, torch.arange(particles) * examples // particles)


def start(position: np.ndarray, **changes: object) -> Start:
    dim = position.shape[2]
    values = {
        "history": position.astype(np.float32),
        "particle_type": np.full(position.shape[1], 5, np.int8),
        "present": len(position) - 1,
        "frame_step": 0.01,
        "radius": 0.2,
        "bounds": np.array([[0.0, 1.0]] * dim),
        "scene": {"gravity": [0.0, GRAVITY, 0.0][:dim]},
    }
    return Start(**{**values, **changes})


# The definition (Ummenhofer et al. 2020, eq. 2-5), a particle, a pair, a cell at a time ---------------------------------------------


def to_cube(x: np.ndarray) -> np.ndarray:
    """Ball to cylinder along z, cylinder to cube (Griepentrog et al. 2008, as the original's appendix gives it)."""

    def square(x: float, y: float) -> tuple[float, float]:
        r = math.hypot(x, y)
        if r == 0:
            return 0.0, 0.0
        if abs(y) <= abs(x):
            return math.copysign(r, x), math.copysign(r, x) * 4 / math.pi * math.atan(y / x)
        return math.copysign(r, y) * 4 / math.pi * math.atan(x / y), math.copysign(r, y)

    if len(x) == 2:
        return np.array(square(*x))
    r = math.sqrt(sum(x * x))
    if r == 0:
        return np.zeros(3)
    if 5 / 4 * x[2] ** 2 > x[0] ** 2 + x[1] ** 2:
        widen, z = math.sqrt(3 * r / (r + abs(x[2]))), math.copysign(r, x[2])
    else:
        widen, z = r / math.hypot(x[0], x[1]), 1.5 * x[2]
    return np.array([*square(widen * x[0], widen * x[1]), z])


def direct(
    features: np.ndarray, senders: np.ndarray, receivers: np.ndarray, weight: np.ndarray, kernel: int, radius: float, same: bool
) -> np.ndarray:
    """[receivers, C_out] of weight [C_in, K^d, C_out], without bias."""
    dim = senders.shape[1]
    out = np.zeros((len(receivers), weight.shape[2]))
    for i, x in enumerate(receivers):
        for j, y in enumerate(senders):
            r = np.linalg.norm(y - x) / radius
            if r > 1 or (same and i == j):
                continue
            place = (to_cube((y - x) / radius) * 0.5 + 0.5) * (kernel - 1)
            filtered = np.zeros(weight.shape[::2])
            for cell in itertools.product(range(kernel), repeat=dim):
                share = np.prod(np.maximum(0, 1 - np.abs(place - cell)))
                filtered += share * weight[:, sum(c * kernel**axis for axis, c in enumerate(cell))]
            out[i] += (1 - r**2) ** 3 * features[j] @ filtered
    return out


@pytest.mark.parametrize("dim", [2, 3])
def test_the_convolution_is_its_definition(dim):
    kernel, radius, generator = 4, 0.3, torch.Generator().manual_seed(1)
    position = cloud(9, dim)
    position[1, :-1] = position[0, :-1]  # straight above another
    position[2] = position[0] + torch.tensor([0.0, 0.1, 0.1][:dim])
    conv = ContinuousConv(3, 5, kernel**dim).double()
    features = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    offset = (position[None] - position[:, None]) / radius  # [receiver, sender]
    receiver, sender = torch.nonzero((offset.norm(dim=2) <= 1) & ~torch.eye(9, dtype=torch.bool), as_tuple=True)
    assert 20 < len(receiver) < 72
    pairs = Pairs.between(offset[receiver, sender], receiver, sender, (9, 9), kernel)
    expected = direct(features.numpy(), position.numpy(), position.numpy(), conv.weight.detach().numpy(), kernel, radius, same=True)
    assert np.abs(expected).max() > 1e-2
    np.testing.assert_allclose(conv(features, pairs).detach().numpy(), expected, atol=1e-12)
    # The same sums, with the senders outside.
    swapped = Pairs.between(offset[receiver, sender], sender, receiver, (9, 9), kernel)
    np.testing.assert_allclose(conv.from_boundary(features, swapped).detach().numpy(), expected, atol=1e-12)


def test_a_particle_in_a_cell_centre_reads_that_cell():
    """3^3 cells, so one in the middle of the face z = +R: straight above at R / 2, a quarter of the way out from the filter's centre to it."""
    offset = torch.tensor([[0.0, 0.0, 0.5]])
    pairs = Pairs.between(offset, torch.zeros(1), torch.zeros(1), (1, 1), 3)
    weight = torch.zeros(27).index_add(0, pairs.place[0], pairs.weight[0])
    window = (1 - 0.25) ** 3
    # 5/4 z^2 > x^2 + y^2: z stays r = 1/2, so half from the centre (1, 1, 1), half from (1, 1, 2).
    assert weight.nonzero().flatten().tolist() == [1 + 3 + 9, 1 + 3 + 18]
    assert torch.allclose(weight[[13, 22]], torch.tensor(0.5 * window))


@pytest.mark.parametrize("dim", [2, 3])
def test_the_mapping_fills_the_cube_evenly(dim):
    generator = torch.Generator().manual_seed(0)
    ball = torch.rand((400_000, dim), generator=generator) * 2 - 1
    ball = ball[ball.norm(dim=1) <= 1]
    cube = ball_to_cube(ball)
    share = np.histogramdd(cube.numpy(), bins=4, range=[(-1, 1)] * dim)[0] * 4**dim / len(ball)
    assert cube.abs().max() <= 1 + 1e-6 and np.abs(share - 1).max() < 0.06  # three standard deviations of a cell's count
    assert torch.allclose(ball_to_cube(-ball), -cube)
    sphere = ball / ball.norm(dim=1, keepdim=True)
    assert torch.allclose(ball_to_cube(sphere).abs().max(1).values, torch.ones(len(sphere)), atol=1e-5)
    assert torch.equal(ball_to_cube(torch.zeros(1, dim)), torch.zeros(1, dim))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("fixed", [0, 3])
def test_a_call_is_the_networks_definition(dim, fixed):
    """Ten particles in a corner of the box, the last ``fixed`` kinematic: a whole call, written out."""
    kinds = (3, 5, 6) if fixed else (5,)
    model = awaken(small(dim, {"particle_types": kinds})).double()
    now = cloud(10, dim, low=0.02, high=0.35)
    before, following = now - cloud(10, dim, seed=1, low=-0.01, high=0.01), now + 0.01
    kind = torch.tensor([5, 6, 5, 6, 5, 5, 6, 5, 5, 5] if fixed else [5] * 10)
    moving = torch.arange(10) < 10 - fixed
    kind[~moving] = 3
    found, neighbours = model.call(torch.stack([before, now]), following, kind, None, model.walls)

    network, radius, kernel = model.network, model.radius, model.options.kernel
    gravity = np.array([0.0, GRAVITY * 0.01**2, 0.0][:dim])
    velocity = (now - before).numpy() + gravity
    place = now.numpy() + velocity - gravity / 2
    fluid, count = place[: 10 - fixed], 10 - fixed
    walls, normals = wall_particles(model.walls.bounds, 0.5 * math.sqrt(math.pi / 1.9) * 0.1)
    boundary = np.concatenate([following.numpy()[count:], walls])
    shown = normals
    if fixed:
        shown = np.concatenate([np.zeros((fixed, dim + 1)), np.concatenate([normals, np.zeros((len(normals), 1))], 1)])
        shown[:fixed, dim] = 1
    columns = [np.ones((count, 1)), velocity[:count] / float(model.velocity_scale)]
    if fixed:
        columns.append(kind[:count, None].numpy() == np.array([5, 6]))
    features = np.concatenate(columns, 1)

    def convolve(conv: ContinuousConv, values: np.ndarray, senders: np.ndarray, same: bool = True) -> np.ndarray:
        return direct(values, senders, fluid, conv.weight.detach().numpy(), kernel, radius, same) + conv.bias.detach().numpy()

    def linear(dense: nn.Linear, values: np.ndarray) -> np.ndarray:
        return values @ dense.weight.detach().numpy().T + dense.bias.detach().numpy()

    x = np.concatenate([convolve(network.boundary, shown, boundary, same=False), convolve(network.fluid, features, fluid),
                        linear(network.dense, features)], 1)  # fmt: skip
    for layer in network.layers:
        y = np.maximum(x, 0)
        out = convolve(layer.conv, y, fluid) + linear(layer.dense, y)
        x = out + x if out.shape == x.shape else out
    expected = np.concatenate([fluid + float(model.scale) * x, following.numpy()[count:]])
    assert np.abs(expected[:count] - fluid).max() > 1e-4
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=1e-10)
    distance = np.linalg.norm(fluid[:, None] - fluid, axis=2)
    np.testing.assert_array_equal(neighbours[:count].numpy(), (distance < radius).sum(1) - 1)


def test_gradients_are_those_of_finite_differences():
    position = cloud(12)
    offset = (position[None] - position[:, None]) / 0.3
    receiver, sender = torch.nonzero((offset.norm(dim=2) <= 1) & ~torch.eye(12, dtype=torch.bool), as_tuple=True)
    conv = ContinuousConv(2, 3, 27).double()
    features = torch.randn(12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)

    def value(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        pairs = Pairs.between(offset[receiver, sender], receiver, sender, (12, 12), 3)
        return torch.func.functional_call(conv, {"weight": weight, "bias": bias}, (features, pairs))

    assert torch.autograd.gradcheck(value, (features, conv.weight, conv.bias))


# Walls -----------------------------------------------------------------------------------------------------------------------------


def test_walls_by_hand():
    position, normal = wall_particles(np.array([[0.0, 1.0], [2.0, 2.5]]), 0.3)
    # Three particles along the long side, two along the short one.
    expected = [(0, 2.125, 1, 0), (0, 2.375, 1, 0), (1, 2.125, -1, 0), (1, 2.375, -1, 0)]
    expected += [(x, 2, 0, 1) for x in (1 / 6, 0.5, 5 / 6)] + [(x, 2.5, 0, -1) for x in (1 / 6, 0.5, 5 / 6)]
    np.testing.assert_allclose(np.concatenate([position, normal], 1), np.array(expected), atol=1e-12)


def test_walls_are_as_dense_as_the_originals():
    """1.9 particles per disc of radius 0.025 on the faces of the original's box, 2 x 4 x 2."""
    walls = Walls(np.array([[-1.0, 1.0], [0.0, 4.0], [-1.0, 1.0]]), 0.05, 0.1125)
    assert abs(len(walls.position) / (1.9 * 40 / (math.pi * 0.025**2)) - 1) < 0.02
    wall, seen = walls.pairs(np.array([[0.0, 2.0, 0.0], [-0.95, 2.0, 0.0], [0.3, -0.01, 0.2]]))
    assert set(seen.tolist()) == {1, 2}
    assert (walls.normal[wall[seen == 1]] == [1, 0, 0]).all() and (walls.normal[wall[seen == 2]] == [0, 1, 0]).all()
    near = np.linalg.norm(walls.position - [-0.95, 2.0, 0.0], axis=1) <= 0.1125
    assert sorted(wall[seen == 1].tolist()) == np.flatnonzero(near).tolist()


# Symmetries ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_order_translation_and_company_do_not_matter(dim):
    model = awaken(small(dim)).double()
    position, kind = torch.stack([cloud(20, dim, seed) * 0.01 + cloud(20, dim, 5, 0.1, 0.5) for seed in (0, 1)]), torch.full((20,), 5)
    found, _ = model.call(position, position[1], kind, None, model.walls)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    shuffled, _ = model.call(position[:, order], position[1], kind, None, model.walls)
    assert torch.allclose(shuffled, found[order], atol=1e-12)
    shift = torch.tensor([3.0, -1.0, 0.4][:dim], dtype=torch.float64)
    walls = Walls(model.walls.bounds + shift.numpy()[:, None], 0.1, model.radius)
    moved, _ = model.call(position + shift, position[1], kind, None, walls)
    assert torch.allclose(moved, found + shift, atol=1e-10)
    both, _ = model.call(torch.cat([position, position], 1), position[1], torch.cat([kind, kind]), torch.arange(40) // 20, model.walls)
    assert torch.allclose(both, torch.cat([found, found]), atol=1e-12)
    # And neighbours, walls and velocities do.
    apart, _ = model.call(position[:, :1], position[1, :1], kind[:1], None, model.walls)
    lone, _ = model.call(position + shift, position[1], kind, None, model.walls)
    pushed, _ = model.call(torch.stack([position[0] - 0.01, position[1]]), position[1], kind, None, model.walls)
    pushed = pushed - torch.tensor(0.01, dtype=torch.float64)  # that much faster, that much farther
    assert all((one - other).abs().max() > 1e-6 for one, other in ((apart, found[:1]), (lone, moved), (pushed, found)))


@pytest.mark.parametrize("axes", [("x",), ("x", "y")])
def test_a_periodic_box_has_no_seam(axes):
    """Shifted along periodic axes, across the faces, a cloud behaves alike; walls remain across the others."""
    model = awaken(small(2, {"periodic": axes})).double()
    assert len(model.walls.position) == (2 - len(axes)) * 2 * round(1 / (0.05 * math.sqrt(math.pi / 1.9)))
    position, kind = torch.stack([cloud(30, 2, seed) * 0.01 + cloud(30, 2, 5, 0.05, 0.6) for seed in (0, 1)]), torch.full((30,), 5)
    found, neighbours = model.call(position, position[1], kind, None, model.walls)
    shift = torch.tensor([0.8, 0.7 if "y" in axes else 0.0], dtype=torch.float64)
    across, count = model.call(position + shift, position[1], kind, None, model.walls)
    assert torch.allclose(across, found + shift, atol=1e-12) and torch.equal(count, neighbours)
    # A step later, from places wrapped into the box.
    scene = {"gravity": [0.0, GRAVITY], "periodic": list(axes)}
    runs = [rollout(model, start(start_at.numpy(), scene=scene), 3).position for start_at in (position, position + shift)]
    moved = runs[1] - runs[0] - shift.numpy()
    np.testing.assert_allclose(moved, np.round(moved), atol=1e-5)
    assert (np.abs(moved).max((0, 1)) > 0.5).tolist() == ["x" in axes, "y" in axes]
    assert all(((run >= 0) & (run < 1))[..., : len(axes)].all() for run in runs)


# Published weights -----------------------------------------------------------------------------------------------------------------


def published(seed: int = 0) -> dict[str, Tensor]:
    """A state dict of the original's layout: [z, y, x, C_in, C_out]."""
    generator = torch.Generator().manual_seed(seed)
    weights = {"gravity": torch.tensor([0.0, GRAVITY, 0.0])}
    for name, (inputs, outputs) in PUBLISHED.items():
        weights |= {f"{name}.kernel": torch.randn(4, 4, 4, inputs, outputs, generator=generator) * 0.1,
                    f"{name}.bias": torch.randn(outputs, generator=generator) * 0.1, f"{name}.offset": torch.zeros(3)}  # fmt: skip
        if name != "conv0_obstacle":
            dense = name.replace("conv", "dense")
            weights[f"{dense}.weight"] = torch.randn(outputs, inputs, generator=generator)
            weights[f"{dense}.bias"] = torch.randn(outputs, generator=generator)
    return weights


@pytest.mark.parametrize("wrapped", [False, True])
def test_published_weights_go_where_they_belong(tmp_path, wrapped):
    weights = published()
    torch.save({"model": weights} if wrapped else weights, tmp_path / "weights.pt")
    model = load_published(tmp_path / "weights.pt")
    assert model.options.channels == (4, 6, 6) and model.options.kernel == 4 and model.spec.gravity[1] == pytest.approx(GRAVITY)
    network = model.network
    later = list(enumerate(network.layers, 1))
    for conv, name in [(network.fluid, "conv0_fluid"), (network.boundary, "conv0_obstacle"), *((layer.conv, f"conv{k}") for k, layer in later)]:
        for x, y, z in ((0, 0, 0), (1, 2, 3), (3, 0, 1)):
            assert torch.equal(conv.weight[:, x + 4 * y + 16 * z], weights[f"{name}.kernel"][z, y, x])
        assert torch.equal(conv.bias, weights[f"{name}.bias"])
    for dense, name in [(network.dense, "dense0_fluid"), *((layer.dense, f"dense{k}") for k, layer in later)]:
        assert torch.equal(dense.weight, weights[f"{name}.weight"]) and torch.equal(dense.bias, weights[f"{name}.bias"])
    # The units are the original's: metres, seconds; steps of 1/50 s; corrections times 1/128 m.
    position = np.array([[[5.0, 4.998, 5.0]], [[5.0, 5.0, 5.0]]])
    model.begin(start(position, bounds=np.array([[0.0, 10.0]] * 3), frame_step=0.02))
    velocity = np.array([0.0, 0.1 + 0.02 * GRAVITY, 0.0])
    with torch.no_grad():
        x = torch.cat([network.boundary.bias, network.fluid.bias, network.dense(torch.tensor([1.0, *velocity]).float())])
        for layer in network.layers:
            out = layer.conv.bias + layer.dense(x.relu())
            x = out + x if out.shape == x.shape else out
    expected = position[1, 0] + 0.02 * (velocity + [0.0, 0.1, 0.0]) / 2 + x.numpy() / 128
    np.testing.assert_allclose(model.advance()[0, 0], expected, atol=1e-6)


def _set(weights: dict, name: str, value: object) -> dict:
    return weights | {name: value}


@pytest.mark.parametrize(("fault", "named"), [
    (lambda w: [1, 2], "state_dict"),
    (lambda w: _set(w, "conv1.bias", "text"), "state_dict"),
    (lambda w: {name: value for name, value in w.items() if name != "conv0_fluid.kernel"}, "conv0_fluid.kernel"),
    (lambda w: {name: value for name, value in w.items() if name != "conv2.kernel"}, "conv2"),
    (lambda w: {name: value for name, value in w.items() if name != "dense3.bias"}, "dense"),
    (lambda w: {name: value for name, value in w.items() if name != "gravity"}, "gravity"),
    (lambda w: _set(w, "gravity", torch.tensor([0.0, math.nan, 0.0])), "gravity"),
    (lambda w: _set(w, "conv2.kernel", torch.zeros(3, 3)), "conv2.kernel"),
    (lambda w: _set(w, "conv2.kernel", w["conv2.kernel"][:2]), "layers.1.conv.weight"),
    (lambda w: _set(w, "conv0_fluid.kernel", torch.zeros(4, 4, 2, 4, 4)), "conv0_fluid.kernel"),
    (lambda w: _set(w, "conv0_fluid.kernel", torch.zeros(4, 4, 4, 9, 4)), "conv0_fluid.kernel"),
    (lambda w: _set(w, "conv0_fluid.kernel", torch.zeros(1, 1, 1, 4, 4)), "state_dict"),
    (lambda w: _set(w, "conv1.kernel", torch.full_like(w["conv1.kernel"], math.inf)), "layers.0.conv.weight"),
    (lambda w: _set(w, "conv1.kernel", w["conv1.kernel"].double()), "layers.0.conv.weight"),
    (lambda w: _set(w, "dense2.weight", torch.zeros(6, 7)), "layers.1.dense.weight"),
    (lambda w: _set(w, "conv9.bias", torch.zeros(3)), "conv9"),
])  # fmt: skip
def test_a_faulty_weights_file_is_one_line(tmp_path, fault, named):
    torch.save(fault(published()), tmp_path / "weights.pt")
    with pytest.raises(InputError) as caught:
        load_published(tmp_path / "weights.pt")
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(tmp_path / "weights.pt")) and named in str(caught.value)


class _Evil:
    def __reduce__(self):
        return (Path.touch, (Path("ran"),))


def test_damaged_and_hostile_weights_run_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        load_published("weights.pt")
    torch.save(published(), "whole.pt")
    whole, generator = Path("whole.pt").read_bytes(), np.random.default_rng(0)
    reference = {name: value.clone() for name, value in load_published("whole.pt").state_dict().items()}
    for _ in range(40):
        damaged = bytearray(whole)
        for place in generator.integers(0, len(whole), 8):
            damaged[place] = generator.integers(256)
        Path("weights.pt").write_bytes(damaged[: generator.integers(1, len(whole))] if generator.random() < 0.3 else damaged)
        try:
            found = load_published("weights.pt").state_dict()
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert all(value.shape == reference[name].shape and torch.isfinite(value).all() for name, value in found.items())
    torch.save({"conv0_fluid.kernel": _Evil()}, "weights.pt")
    with pytest.raises(InputError, match="published CConv file"):
        load_published("weights.pt")
    assert not Path("ran").exists()


# Training --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.5, 2.0])
def test_loss_by_hand(exponent):
    """Two particles far apart from anything, no network: flight alone, without its last g / 2 (``v`` is a difference of positions)."""
    model = small(2, {"bounds": ((0.0, 9.0),) * 2}, exponent=exponent)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    velocity, g = torch.tensor([[0.01, 0.0], [0.0, 0.02]]), torch.tensor([0.0, GRAVITY * 1e-4])
    time = torch.arange(4.0)[:, None, None]
    # Of the second particle three neighbours are near by, so its error weighs less.
    base = torch.tensor([[2.0, 5.0], [7.0, 5.0], [7.1, 5.0], [7.0, 5.1], [7.05, 5.05]])
    velocity = torch.cat([velocity, velocity[1:].expand(3, 2)])
    position = base + velocity * time + g * time * (time + 1) / 2
    batch = Windows(position, torch.full((5,), 5), torch.zeros(5, dtype=torch.long))
    expected, state = 0.0, position[:2].clone()
    weight = torch.exp(-torch.tensor([0.0, 3, 3, 3, 3]) / (40 / (4 / 3 * math.pi * 2.25**3) * math.pi * 2.25**2))
    for call in range(2):
        following = 2 * state[1] - state[0] + g / 2
        distance = (following - position[2 + call]).norm(dim=1) / 1e-3
        expected += 0.5 * (weight * (distance**2 + 1e-9 * 128**2) ** (exponent / 2)).mean().item()
        state = torch.stack([state[1], following])
    assert model.window(0.0) == 4
    assert model.loss(batch, torch.Generator(), 0.0).item() == pytest.approx(expected, rel=2e-3)  # float32 positions
    assert expected > 0.2


def test_kinematic_particles_are_not_in_the_loss():
    kinds = [3] * 10 + [5] * 30
    model = small(2, {"particle_types": (3, 5)})
    batch = windows(4, 40, 2, examples=1, kinds=kinds)
    batch.position[:, :10] = batch.position[0, :10]
    loss = model.loss(batch, torch.Generator(), 0.0)
    far = dataclasses.replace(batch, position=batch.position.clone())
    far.position[:, :10] += 5.0  # out of reach
    other = model.loss(far, torch.Generator(), 0.0)
    alone = Windows(batch.position[:, 10:], batch.particle_type[10:], batch.example[10:])
    assert other.item() == pytest.approx(model.loss(alone, torch.Generator(), 0.0).item(), rel=1e-5)
    assert abs(loss.item() / other.item() - 1) > 1e-4


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_reach_every_weight_and_repeat_bitwise(dim):
    found = []
    for _ in range(2):
        model = awaken(small(dim, {"particle_types": (3, 5, 6), "context_mean": (0.0,), "context_std": (1.0,)}, unroll=[2]))
        batch = windows(4, 60, dim, examples=3, kinds=[3, 5, 6, 5] * 15)
        batch.position -= 0.2
        batch.context = torch.randn((4, 3, 1), generator=torch.Generator().manual_seed(0))
        model.loss(batch, torch.Generator(), 0.0).backward()
        found.append([parameter.grad for parameter in model.parameters()])
    assert all(gradient.abs().sum() > 0 for gradient in found[0])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_the_first_call_learns_from_the_second():
    """Unrolled, the gradient of the second call's error passes through its velocity to the first call."""
    model = awaken(small(2))
    batch = windows(4, 40, 2)
    state = batch.position[:2]
    first, _ = model.call(state, state[1], batch.particle_type, batch.example, model.walls)
    first.retain_grad()
    second, _ = model.call(torch.stack([state[1], first]), state[1], batch.particle_type, batch.example, model.walls)
    second.square().sum().backward()
    direct = 2 * 2 * second.detach()  # x'' = 2 x' - x + g / 2 + s F: without F's part twice the gradient of x''
    assert first.grad.abs().sum() > 0 and not torch.allclose(first.grad, direct, rtol=1e-5)
    assert torch.allclose(first.grad, direct, atol=0.2 * direct.abs().max())


def test_a_few_steps_lower_the_loss():
    """A drift of all particles that flight does not have, and an attraction to the middle of the box that only the walls tell of."""
    model = small(2, channels=[8, 8])
    generator = torch.Generator().manual_seed(0)
    base = torch.rand((80, 2), generator=generator)
    time = torch.arange(4.0)[:, None, None]
    g = torch.tensor([0.0, GRAVITY * 1e-4])
    position = base + (g + 4e-4 * torch.sign(0.5 - base) * (torch.minimum(base, 1 - base) < 0.15)) * time**2 / 2
    batch = Windows(position, torch.full((80,), 5), torch.zeros(80, dtype=torch.long))
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    losses = []
    for _ in range(120):
        loss = model.loss(batch, generator, 0.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert np.mean(losses[-5:]) < 0.6 * losses[0]


def test_unrolling_follows_the_progress():
    model = small(unroll=[1, 2, 4])
    assert [model.window(progress) for progress in (0.0, 0.5, 1.0)] == [3, 4, 6]


# Rollout ---------------------------------------------------------------------------------------------------------------------------


def flying(model: CConv) -> CConv:
    """A network that gives back the g / 2 by which flight falls short when the velocity is a difference of positions."""

    class Flight(nn.Module):
        def forward(self, features: Tensor, pairs: Pairs, boundary: Tensor, boundary_pairs: Pairs) -> Tensor:
            return (model.gravity / 2 / model.scale).expand(len(features), -1)

    model.network = Flight()
    return model


def falling(frames: int, particles: int = 6, dim: int = 2) -> np.ndarray:
    time = np.arange(frames)[:, None, None]
    drop = np.array([0.0, GRAVITY * 1e-4, 0.0][:dim]) * time * (time + 1) / 2
    return cloud(particles, dim).numpy() + np.array([2e-3, 1e-2, 0.0][:dim]) * time + drop


@pytest.mark.parametrize("stride", [1, 3])
def test_true_corrections_reproduce_flight(stride):
    coarse = falling(10)
    share = np.arange(stride)[:, None, None] / stride
    fine = (coarse[:-1, None] + share * np.diff(coarse, axis=0)[:, None]).reshape(-1, 6, 2)
    model = flying(small(2, {"stride": stride, "gravity": (0.0, GRAVITY / stride**2)}))
    assert model.history == stride + 1
    found = rollout(model, start(fine[: stride + 1]), len(fine) - stride - 1)
    assert found.status == "ok"
    np.testing.assert_allclose(found.position, fine[stride + 1 :], atol=1e-6)


def test_kinematic_particles_follow_their_prescription():
    model = awaken(small(2, {"particle_types": (3, 5)}))
    truth = falling(12, 20)
    kinds = np.where(np.arange(20) < 5, 3, 5).astype(np.int8)
    found = rollout(model, start(truth[:2], particle_type=kinds, kinematic=truth[:, :5]), 10)
    np.testing.assert_allclose(found.position[:, :5], truth[2:, :5], atol=1e-7)
    assert not np.allclose(found.position[:, 5:], truth[2:, 5:], atol=1e-4)


def test_the_box_and_the_context_of_the_start_are_seen():
    model = awaken(small(2, {"context_mean": (0.0,), "context_std": (1.0,)}))
    truth = falling(2, 12)
    near, far = np.array([[0.0, 1.0]] * 2), np.array([[-5.0, 5.0]] * 2)
    contexts = [np.zeros((9, 1), np.float32), np.zeros((9, 1), np.float32)]
    contexts[1][2] = 2.0  # of the second step alone
    found = [rollout(model, start(truth + 0.2, bounds=bounds, context=context), 2).position for bounds, context in
             ((near, contexts[0]), (far, contexts[0]), (near, contexts[1]))]  # fmt: skip
    assert not np.allclose(found[0], found[1], atol=1e-7)
    assert np.array_equal(found[0][0], found[2][0]) and not np.allclose(found[0][1], found[2][1], atol=1e-7)


@pytest.mark.parametrize(("changes", "message"), [
    ({"frame_step": 0.02}, "frame step is 0.02 s"), ({"particle_type": np.full(6, 6, np.int8)}, r"types \[6\]"),
    ({"history": np.zeros((1, 6, 2), np.float32)}, "1 frames, the model needs 2"),
    ({"history": np.zeros((2, 6, 3), np.float32)}, "3 dimensions, the model 2"),
])  # fmt: skip
def test_a_start_of_another_kind_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        small(2).begin(dataclasses.replace(start(falling(2)), **changes))


def test_clumping_ends_a_rollout():
    class Inward(nn.Module):
        def forward(self, features: Tensor, pairs: Pairs, boundary: Tensor, boundary_pairs: Pairs) -> Tensor:
            before, now = model._state
            return (0.5 - (2 * now - before)).float() / model.scale

    model = small(2)
    model.network = Inward()
    found = rollout(model, start(np.repeat(cloud(80, 2, low=0.0, high=1.0)[None].numpy(), 2, 0)), 10)
    assert found.status.startswith("failed: particles clump:") and np.isfinite(found.position[0]).all()


def test_relaxation_pushes_a_clump_apart():
    crowd = np.repeat(cloud(60, 2, low=0.48, high=0.52)[None].numpy(), 2, 0)
    plain, relaxed = (rollout(flying(small(2, relaxation=option)), start(crowd), 1).position[0] for option in (None, Relaxation().model_dump()))
    assert relaxed.std() > 1.05 * plain.std()


@pytest.mark.parametrize(("settings", "message"), [
    ({"channels": []}, "channels"), ({"kernel": 1}, "kernel"), ({"radius": 0}, "radius"), ({"colour": 1}, "unknown; cconv has channels, kernel"),
])  # fmt: skip
def test_bad_settings_are_one_line(settings, message):
    with pytest.raises(InputError, match=message) as caught:
        build("cconv", settings, spec())
    assert "\n" not in str(caught.value)


def test_parameters_of_the_full_model():
    """As many as the published file has, its gravity and offsets (18 numbers) aside."""
    wide = {"conv0_fluid": (4, 32), "conv0_obstacle": (3, 32), "conv1": (96, 64), "conv2": (64, 64), "conv3": (64, 3)}
    count = sum(64 * a * b + b for a, b in wide.values()) + sum(a * b + b for name, (a, b) in wide.items() if name != "conv0_obstacle")
    assert sum(parameter.numel() for parameter in build("cconv", {}, spec()).parameters()) == count
