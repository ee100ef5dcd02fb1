from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from bouncing import bounce
from parallel_child import gradient

from learn.checkpoint import load_state
from learn.dataset import Dataset, DataSettings, Sampler
from learn.parallel import Processes
from learn.train import Trainer, load_config, train
from sim.errors import InputError

CHILD = Path(__file__).parent / "parallel_child.py"
TRAINING = {"batch": 5, "learning_rate": 1e-3, "warmup_steps": 2, "log_every": 1, "checkpoint_every": 1, "validations": 1, "validation_frames": 3,
            "validation_trajectories": 1, "device": "cpu"}  # fmt: skip
GNS = {"latent": 16, "message_passing": 2, "history": 3, "noise": 0.3}


def together(task: str, config: Path, data: Path, out: Path, processes: int = 2) -> subprocess.CompletedProcess:
    """``parallel_child.py`` in so many processes."""
    out.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), str(CHILD), task, config, data, out]
    root = Path(__file__).parents[2]
    return subprocess.run(list(map(str, command)), cwd=root, env=_environment(root), capture_output=True, text=True, timeout=120)


def _environment(root: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{root / 'tests' / 'learn'}", "OMP_NUM_THREADS": "1"}


def write_config(path: Path, settings: dict, **training: object) -> Path:
    path.write_text(yaml.safe_dump({"model": "gns", "settings": settings, "training": TRAINING | training}))
    return path


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory, write_dataset) -> Path:
    """Trajectories of different numbers of particles, a third of them kinematic in some."""

    def draw(seed: int):
        found = bounce(seed, particles=12 + 5 * (seed % 3), frames=12)
        found.particle_type[: 4 * (seed % 2)] = 3
        return found

    splits = {"train": {k: draw(k) for k in range(6)}, "valid": {0: draw(6)}}
    return write_dataset(tmp_path_factory.mktemp("uneven"), splits)


def test_two_processes_have_the_gradient_of_one_on_the_joint_batch(uneven: Path, tmp_path: Path) -> None:
    """Noise included; windows have different numbers of particles that move."""
    config = write_config(tmp_path / "gns.yaml", GNS, steps=3)
    done = together("gradient", config, uneven, tmp_path)
    assert done.returncode == 0, done.stderr
    torch.manual_seed(0)
    alone = gradient(Trainer(load_config(config), uneven, tmp_path / "alone"))
    both = torch.load(tmp_path / "gradient.pt", weights_only=True)
    largest = max(float(value.abs().max()) for value in alone[:-1])
    assert largest > 1e-2
    for one, two in zip(alone, both, strict=True):
        assert float((one - two).abs().max()) < 1e-6 * largest
    assert float(alone[-1]) == pytest.approx(float(both[-1]), rel=1e-6)


def test_a_run_of_two_processes_is_that_of_one(uneven: Path, tmp_path: Path) -> None:
    config = write_config(tmp_path / "gns.yaml", GNS, steps=6)
    done = together("run", config, uneven, tmp_path / "two")
    assert done.returncode == 0, done.stderr
    train(load_config(config), uneven, tmp_path / "one")
    one, two = (load_state(folder / "checkpoint.pt") for folder in (tmp_path / "one", tmp_path / "two" / "run"))
    assert one["sampler"] == two["sampler"] and torch.equal(one["generator"], two["generator"])
    start = Trainer(load_config(config), uneven, tmp_path / "start").model.state_dict()
    for name, weight in one["model"].items():
        moved = float((weight - start[name]).abs().max())
        # Adam divides a gradient by its own size: where that is rounding, so is the step.
        assert float((weight - two["model"][name]).abs().max()) <= 2e-2 * moved + 1e-7, name
    assert json.loads((tmp_path / "two" / "run" / "done.json").read_text())["processes"] == 2


def test_a_killed_process_ends_the_run_and_another_number_resumes_it(uneven: Path, tmp_path: Path) -> None:
    config = write_config(tmp_path / "gns.yaml", GNS, steps=12)
    done = together("killed", config, uneven, tmp_path)
    assert done.returncode != 0
    assert not (tmp_path / "run" / "done.json").exists()
    kept = load_state(tmp_path / "run" / "checkpoint.pt")["progress"]["step"]
    assert 6 <= kept <= 7
    train(load_config(config), uneven, tmp_path / "run")
    train(load_config(config), uneven, tmp_path / "unbroken")
    one, two = ((tmp_path / name / "log.csv").read_text().splitlines() for name in ("run", "unbroken"))
    assert len(one) == len(two) == 13
    losses = np.array([[float(row.split(",")[2]) for row in rows[1:]] for rows in (one, two)])
    assert np.allclose(*losses, rtol=1e-3)


def test_fewer_windows_than_processes_are_refused(uneven: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(write_config(tmp_path / "gns.yaml", GNS, steps=3, batch=1))

    class Two(Processes):
        def __init__(self, device, where):
            super().__init__(device, where)
            self.size = 2

    monkeypatch.setattr("learn.train.Processes", Two)
    with pytest.raises(InputError, match=r"training\.batch = 1.*1 a process"):
        Trainer(config, uneven, tmp_path / "run")


@pytest.mark.parametrize(("windows", "processes"), [(5, 2), (7, 3), (4, 4)])
def test_shares_are_a_partition(windows: int, processes: int) -> None:
    rows, taken = np.arange(windows), []
    for rank in range(processes):
        group = Processes(torch.device("cpu"), "test")
        group.rank, group.size = rank, processes
        taken.append(rows[group.share(rows)])
    assert np.concatenate(taken).tolist() == rows.tolist()
    assert max(map(len, taken)) - min(map(len, taken)) <= 1


def test_a_budget_of_edges(uneven: Path) -> None:
    """5 neighbours a particle: 12, 17 or 22 particles make 60, 85 or 110 edges. Batches fill the budget, and every window is met once an epoch."""
    dataset = Dataset(uneven, "train")
    sampler, seen, budget = Sampler(dataset, DataSettings(), None, 3, edges=300), [], 300
    rows = dataset.windows(4)
    sampler.next(4)
    while sampler.epoch == 0:
        before = sampler.offset
        windows = sampler.next(4)
        if sampler.epoch > 0:
            break
        pick = sampler._order[before : sampler.offset]
        edges = 5.0 * len(windows.example)
        following = 5.0 * dataset.shapes[rows[sampler._order[sampler.offset]][0]][1]
        assert edges <= budget < edges + following
        assert windows.examples == len(pick)
        seen += pick.tolist()
    assert len(set(seen)) == len(seen) > 0.8 * len(rows) - 5
    # One window at least, however small the budget.
    assert Sampler(dataset, DataSettings(), None, 3, edges=1).next(4).examples == 1
