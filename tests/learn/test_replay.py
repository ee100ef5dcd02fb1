"""Captured training steps of a grid emulator (``learn.replay``), without a graph: beside plain steps, out of room, and that nothing in
them waits for a device.

Those of a GNS are in ``test_fused.py``; the graphs themselves take a GPU (``benchmarks/grid_cuda.py``).
"""

import copy

import numpy as np
import pytest
import torch
from replaying import assert_replayed_as_plain
from torch.utils._python_dispatch import TorchDispatchMode

from learn.dataset import DataSettings, DataSpec, Windows
from learn.grid_emulator import GridEmulator, NodeRoom, SparseGrid
from learn.model import build
from learn.replay import TrainingReplay
from learn.train import OPTIMIZERS, Config, Trainer, TrainSettings, train

SETTINGS = {"channels": [16, 16], "frames_per_call": 3, "unroll": [2], "noise": 0.1}
#: Water and sand beside kinematic particles, under a context; and in 3D.
CASES = {
    "one material": ({}, {}, (5,)),
    "all": ({"particle_types": (3, 5, 6), "context_mean": (0.1,), "context_std": (1.0,)}, {"preview": []}, (3, 5, 6, 5)),
    "3D": (
        {"dim": 3, "bounds": ((0, 1),) * 3, "gravity": (0, 0, -1e-3)}
        | {"velocity_mean": (0,) * 3, "velocity_std": (0.02,) * 3, "acceleration_mean": (0,) * 3, "acceleration_std": (0.004,) * 3},
        {},
        (5,),
    ),
    "selected": ({}, {"select": 2}, (5,)),
}


def spec_of(**changes) -> DataSpec:
    content = dict(
        dim=2, bounds=((0, 1), (0, 1)), radius=0.3, spacing=0.1, frame_step=0.01, stride=1, gravity=(0, -1e-3), particle_types=(5,),
        velocity_mean=(0, 0), velocity_std=(0.02, 0.02), acceleration_mean=(0, 0), acceleration_std=(0.004, 0.004),
    )  # fmt: skip
    return DataSpec(**content | changes)


def batch(frames: int, counts: tuple[int, ...], seed: int, dim: int = 2, kinds: tuple[int, ...] = (5,), context: int = 0) -> Windows:
    generator, total = torch.Generator().manual_seed(seed), sum(counts)
    steps = torch.randn((frames, total, dim), generator=generator).cumsum(0) * 0.003
    position = torch.rand((total, dim), generator=generator) * 0.9 + 0.05 + steps
    position[:, 0] = 2.0  # beyond the margin: on the grid nowhere
    values = torch.randn((frames, len(counts), context), generator=generator) if context else None
    kind = torch.tensor(kinds)[torch.arange(total) % len(kinds)]
    return Windows(position.float(), kind, torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)), values)


def test_packing_by_hand():
    """Six ids, three rows of room: nodes 1, 3, 4 get them, in a second mask the fourth of four does not."""
    room = NodeRoom([3], 1, torch.device("cpu"))
    active, row = room.pack(0, torch.tensor([False, True, False, True, True, False]))
    assert active.tolist() == [1, 3, 4, 6] and row.tolist() == [4, 0, 4, 1, 2, 4, 3] and room.most.tolist() == [3]
    active, row = room.pack(0, torch.tensor([True, True, False, True, True, False]))
    assert active.tolist() == [0, 1, 3, 6] and row.tolist() == [0, 1, 4, 2, 3, 4, 3] and room.most.tolist() == [4]


def test_coarse_levels_count_what_finer_ones_have_no_room_for():
    grid = SparseGrid([8, 8], 3)
    inner = (torch.arange(1, 9)[:, None] * grid.stride0[0] + torch.arange(1, 9)).flatten()
    room = NodeRoom([5, 3, 2], 1, torch.device("cpu"))
    grid.occupy(inner, 1, room)
    assert room.most.tolist() == [64, 16, 4]


def test_room_is_at_most_what_the_grid_has():
    model = build("grid_emulator", SETTINGS, spec_of())
    assert model.make_room([10**6, 10], 3).capacity == [3 * 10**2, 10]  # 5 cells, 2 beyond each wall


def test_tables_of_a_fixed_length_are_the_tables():
    grid = SparseGrid([7, 5], 2)
    inner = (torch.arange(1, 8)[:, None] * grid.stride0[0] + torch.arange(1, 6)).flatten()
    nodes = torch.cat([inner[torch.tensor([0, 3, 3, 18, 34])], inner[[7, 8]] + grid.sizes[0]])
    finest, rows, levels = grid.occupy(nodes, 2)
    room = NodeRoom([9, 6], 2, torch.device("cpu"))
    active, places, padded = grid.occupy(torch.cat([nodes, torch.tensor([2 * grid.sizes[0]])]), 2, room)
    counts = [len(level.neighbours) for level in levels]
    assert room.most.tolist() == counts and active[: counts[0]].tolist() == finest.tolist()
    assert set(active[counts[0] :].tolist()) == {2 * grid.sizes[0]}
    assert torch.equal(places[nodes], rows[nodes])
    for count, plain, full in zip(counts, levels, padded, strict=True):
        empty = torch.where(plain.neighbours == count, len(full.neighbours), plain.neighbours)
        assert torch.equal(full.neighbours[:count], empty)
    assert torch.equal(padded[0].child[: counts[0]], levels[0].child) and padded[0].coarse == 7


def test_selected_windows_are_those_of_the_batch():
    """Windows of different sizes and kinds, each with its context, in the batch's order; the one that leaves flight most is hardly ever left out."""
    model = build("grid_emulator", SETTINGS | {"select": 2}, spec_of(particle_types=(3, 5), context_mean=(0.1,), context_std=(1.0,)))
    windows = batch(6, (3, 5, 2, 4), 0, kinds=(3, 5), context=1)
    flight = torch.arange(6)[:, None, None] * 0.01 + torch.arange(14)[:, None] * 0.02
    windows.position[:] = flight
    windows.position[3:, 8:10] += 0.1  # the third
    generator, third = torch.Generator().manual_seed(0), 0
    ends = [0, 3, 8, 10, 14]
    for _ in range(50):
        found = model.pick(windows, generator)
        assert found.examples == 2 and found.example.diff().min() >= 0
        chosen = []
        for number in range(2):
            own = found.position[:, found.example == number]
            which = ends.index(round(float(own[0, 0, 0]) / 0.02))
            part = slice(ends[which], ends[which + 1])
            assert torch.equal(own, windows.position[:, part])
            assert torch.equal(found.particle_type[found.example == number], windows.particle_type[part])
            assert torch.equal(found.context[:, number], windows.context[:, which])
            chosen.append(which)
        assert chosen[0] < chosen[1]
        third += 2 in chosen
    assert third >= 45


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("case", CASES)
def test_replayed_training_is_training(case, optimizer):
    """Three steps on batches of different sizes: the same losses, weights and averages as plain steps."""
    changes, settings, kinds = CASES[case]
    torch.manual_seed(0)
    plain = build("grid_emulator", SETTINGS | settings, spec_of(**changes))
    torch.nn.init.normal_(plain.network.leave.weight, std=0.05)
    batches = [
        batch(plain.window(0.0), counts, seed, plain.spec.dim, kinds, int("context_mean" in changes))
        for seed, counts in enumerate([(18, 19, 14), (20, 20, 20), (14, 17, 2)])
    ]
    assert assert_replayed_as_plain(plain, batches, 20, optimizer, rel=1e-5) > 1e-3


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_step_that_is_none_changes_nothing_and_is_told(optimizer):
    model = build("grid_emulator", SETTINGS, spec_of())
    parameters = list(model.parameters())
    steps, average = OPTIMIZERS[optimizer](parameters, 0.1), {name: value.clone() for name, value in model.state_dict().items()}
    frames = model.window(0.0)
    good = batch(frames, (18, 18), 0)
    good.position.mul_(0.1)  # in a corner: few nodes
    bad = copy.deepcopy(good)
    bad.position[-1, 3] = torch.nan
    replay = TrainingReplay(model, parameters, steps, average, 1.0, good, 18)
    replay.step(good, torch.Generator().manual_seed(0), 1e-2, 0.5)
    assert replay.settle()[2:] == (0, 0)
    before, averaged = copy.deepcopy(model.state_dict()), copy.deepcopy(average)
    replay.step(bad, torch.Generator().manual_seed(0), 1e-2, 0.5)
    assert replay.settle()[2:] == (1, 0)
    wide, capacity = batch(frames, (18, 18), 3), replay.room.capacity[0]
    wide.position[:] = torch.from_numpy(np.stack(np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 6)), -1).reshape(-1, 2)).float()
    replay.step(wide, torch.Generator().manual_seed(0), 1e-2, 0.5)
    replay.step(bad, torch.Generator().manual_seed(0), 1e-2, 0.5)
    assert replay.settle()[2:] == (1, 1) and replay.room.capacity[0] > capacity
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]) and torch.equal(average[name], averaged[name])
    replay.step(good, torch.Generator().manual_seed(0), 1e-2, 0.5)
    assert replay.settle()[2:] == (0, 0) and not torch.equal(next(model.parameters()), next(iter(before.values())))


class Capturing(TorchDispatchMode):
    """Refuses what the capture of a CUDA graph refuses: results that the host waits for, or that a shape depends on, tensors made of the host's
    numbers, and ``prod``, whose gradient counts zeros on the host (not under a mode like this one)."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name
        indexing = name in ("aten::index", "aten::index_put", "aten::index_put_")
        masks = indexing and any(index is not None and index.dtype == torch.bool for index in args[1])
        waits = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::lift_fresh", "aten::prod", "aten::_unique2")
        if masks or name in waits:
            raise AssertionError(f"{name} in a captured step")
        return func(*args, **(kwargs or {}))


def test_what_a_capture_refuses_is_refused():
    values = torch.ones(3)
    forbidden = [lambda: values.sum().item(), lambda: values[values > 0], lambda: torch.tensor([1.0]), lambda: values.prod(), values.nonzero]
    for action in forbidden:
        with pytest.raises(AssertionError, match="captured"), Capturing():
            action()


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("case", CASES)
def test_nothing_in_a_step_waits_for_the_device(case, optimizer):
    changes, settings, kinds = CASES[case]
    model = build("grid_emulator", SETTINGS | settings, spec_of(**changes))
    parameters, first = list(model.parameters()), batch(model.window(0.0), (18, 19, 14), 0, model.spec.dim, kinds, int("context_mean" in changes))
    replay = TrainingReplay(model, parameters, OPTIMIZERS[optimizer](parameters, 0.1), model.state_dict(), 1.0, first, 20)
    # Nor does drawing wait for the step before, by reading something of it.
    held = dict(model.named_buffers()) | dict(model.named_parameters())

    def refuse(*arguments, **options):
        raise AssertionError("read back while drawing")

    for tensor in held.values():
        tensor.to = tensor.cpu = tensor.numpy = tensor.tolist = refuse
    model.noise(model.pick(first, torch.Generator().manual_seed(0)), torch.Generator().manual_seed(0))
    for tensor in held.values():
        del tensor.to, tensor.cpu, tensor.numpy, tensor.tolist
    captured, step = [], replay._step

    def capture():
        with Capturing():
            step()
        captured.append(True)

    replay._step = capture
    replay.step(first, torch.Generator().manual_seed(0), 1e-2, 0.5)
    assert captured and replay.settle()[2:] == (0, 0)


def test_trainings_end_where_plain_ones_do(bounce_dataset, tmp_path, monkeypatch):
    """From windows of one call to those of two, validated between, resumed from the third step's checkpoint."""
    settings = {"batch": 2, "log_every": 1, "validations": 2, "validation_frames": 6, "checkpoint_every": 3, "average_decay": 0.9}
    chosen = TrainSettings(steps=6, optimizer="muon", learning_rate=1e-3, warmup_steps=1, **settings)
    config = Config(model="grid_emulator", settings=SETTINGS | {"unroll": [1, 2], "select": 1}, training=chosen, data=DataSettings(mirror=True))
    train(config, bounce_dataset, tmp_path / "plain", "here")
    monkeypatch.setattr(GridEmulator, "replayable", True)
    steps = Trainer._train_step

    def dies(trainer, progress):
        if trainer.step == 4:
            raise LookupError
        steps(trainer, progress)

    with monkeypatch.context() as patch, pytest.raises(LookupError):
        patch.setattr(Trainer, "_train_step", dies)
        train(config, bounce_dataset, tmp_path / "replayed", "here")
    train(config, bounce_dataset, tmp_path / "replayed", "here")
    for name in ("log.csv", "validation.csv"):
        plain, replayed = (np.genfromtxt(tmp_path / run / name, delimiter=",", names=True) for run in ("plain", "replayed"))
        for column in set(plain.dtype.names) - {"seconds"}:
            np.testing.assert_allclose(replayed[column], plain[column], rtol=1e-4)
