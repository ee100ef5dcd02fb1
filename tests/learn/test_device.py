"""Training, validation, resuming and rollouts on a device, where there is none: on one that is made up (``other_device``), with the CPU's numbers.

Kernels and replayed steps, which take a GPU, are those of ``test_fused.py``, ``test_replay.py`` and ``benchmarks/gns_cuda.py``, ``grid_cuda.py``.
"""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from bouncing import bounce
from other_device import OtherDevice

from learn.checkpoint import load_model
from learn.dataset import Dataset, DataSettings
from learn.grid_emulator import GridEmulator
from learn.train import Config, Trainer, TrainSettings, train
from sim.simulator import rollout, start_from

RELAXATION = {"loops": 1, "strength": 0.05, "density": 1.0}
MODELS = {
    "gns": {"latent": 8, "message_passing": 2, "history": 2, "unroll": [1, 2], "inputs": "acceleration", "relaxation": RELAXATION},
    "cconv": {"channels": [4, 6, 6], "unroll": [1, 2], "relaxation": RELAXATION},
    "grid_emulator": {"channels": [8, 8], "frames_per_call": 2, "unroll": [1, 2], "select": 1, "relaxation": RELAXATION},
}


@pytest.fixture
def device(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device: torch.get_rng_state())
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, device: torch.set_rng_state(state))
    monkeypatch.setattr(GridEmulator, "replayable", False)  # it has no graphs
    return OtherDevice()


@pytest.fixture(scope="session")
def mixed_dataset(write_dataset, tmp_path_factory):
    """Bouncing particles of two materials, a rigid body among them, beside kinematic ones, under a changing acceleration of the frame."""

    def mixed(seed):
        trajectory = bounce(seed)
        position, frames = trajectory.position.copy(), len(trajectory.position)
        position[:, :4] = position[:, :1] + np.array([[0.0, 0.0], [0.05, 0.0], [0.0, 0.05], [0.05, 0.05]], np.float32)
        position[:, 4:8] = np.linspace(0.2, 0.8, 4, dtype=np.float32)[:, None] * [1, 0] + [0, 0.15]
        kinds = np.repeat([0, 3, 5, 6], [4, 4, 8, 8]).astype(np.int8)
        context = np.sin(np.arange(frames, dtype=np.float32))[:, None]
        return dataclasses.replace(trajectory, position=position, particle_type=kinds, context=context)

    splits = {"train": {index: mixed(index) for index in range(3)}, "valid": {0: mixed(100)}}
    return write_dataset(tmp_path_factory.mktemp("mixed"), splits)


def losses(folder: Path) -> list[float]:
    with open(folder / "log.csv") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


def test_the_device_that_is_none(device):
    here = torch.ones(3)
    with device:
        there = here.to("cuda")
        assert there.device.type == "cuda" and here.device.type == "cpu" and (there + 1).is_cuda and not (here + 1).is_cuda
        assert (there * torch.tensor(2.0)).sum().item() == 6 and there.cpu().device.type == "cpu" and torch.zeros(2, device="cuda").is_cuda
        assert there[torch.tensor([0])].is_cuda and here.to(there).is_cuda and not there.to("cpu", torch.float64).is_cuda and there[:0].is_cuda
        weight = torch.nn.Linear(3, 1).to("cuda").weight
        (weight @ there).sum().backward()
        assert weight.is_cuda and weight.grad.is_cuda
        for mixed in (lambda: there + here, lambda: there.numpy(), lambda: here[there.long()], lambda: torch.cat([here, there])):
            with pytest.raises((RuntimeError, TypeError), match="cuda"):
                mixed()
        with pytest.raises(NotImplementedError):  # cuBLAS has no products of integers
            torch.ones((2, 2), dtype=torch.int64, device="cuda") @ torch.ones(2, dtype=torch.int64, device="cuda")


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("optimizer", ["adam", "muon"])
@pytest.mark.parametrize("dataset", ["bounce", "mixed"])
def test_training_and_rollouts_as_on_the_cpu(name, optimizer, dataset, device, tmp_path, request, monkeypatch):
    data = request.getfixturevalue(f"{dataset}_dataset")

    def configured(where: str) -> Config:
        settings = {"batch": 2, "log_every": 1, "validations": 2, "validation_frames": 6, "checkpoint_every": 3, "average_decay": 0.9}
        chosen = TrainSettings(steps=6, optimizer=optimizer, learning_rate=1e-3, warmup_steps=1, device=where, **settings)
        return Config(model=name, settings=MODELS[name], training=chosen, data=DataSettings(mirror=dataset == "bounce"))

    steps = Trainer._train_step

    def dies(trainer, progress):
        if trainer.step == 4:
            raise LookupError
        steps(trainer, progress)

    train(configured("cpu"), data, tmp_path / "cpu", "here")
    with device:
        with monkeypatch.context() as patch, pytest.raises(LookupError):
            patch.setattr(Trainer, "_train_step", dies)
            train(configured("cuda"), data, tmp_path / "cuda", "here")
        assert not (tmp_path / "cuda" / "done.json").exists()
        # On from the checkpoint of the third step.
        train(configured("cuda"), data, tmp_path / "cuda", "here")
        model = load_model(tmp_path / "cuda" / "best.pt").to("cuda")
        start = start_from(Dataset(data, "valid").trajectory(0), model.history)
        there = rollout(model, start, 8)
    here = rollout(load_model(tmp_path / "cuda" / "best.pt"), start, 8)
    assert losses(tmp_path / "cuda") == pytest.approx(losses(tmp_path / "cpu"), rel=1e-4)
    assert there.status == here.status == "ok"
    np.testing.assert_allclose(there.position, here.position, atol=1e-5)
