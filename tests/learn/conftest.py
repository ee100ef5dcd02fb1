"""A tiny data set (ballistic particles that bounce off the walls of the unit box) and a dummy model that only the trainer's tests use."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from learn.model import MODELS
from sim.trajectory import Trajectory, write_shard

torch.set_num_threads(1)

#: The dummy model is found as a child process of the tests finds it: by its module's name, in this folder.
sys.path.insert(0, str(Path(__file__).parent))
from bouncing import bounce  # noqa: E402 (found by the line above)

MODELS["dummy"] = ("dummy_model", "Dummy")


def _write_dataset(folder: Path, splits: dict[str, dict[int, Trajectory]], per_shard: int = 2) -> Path:
    """Write trajectories as a data set folder, ``per_shard`` in a shard, with the statistics of the training split."""
    content = {"format_version": 1, "scene": "bounce", "family": {}, "splits": {}}
    for split, trajectories in splits.items():
        names, indices = [], sorted(trajectories)
        for number, begin in enumerate(range(0, len(indices), per_shard)):
            names.append(f"{split}/shard-{number:05d}.h5")
            write_shard(folder / names[-1], {index: trajectories[index] for index in indices[begin : begin + per_shard]})
        content["splits"][split] = {"trajectories": len(indices), "ok": len(indices), "failed": [], "shards": names}
    moving = [trajectory.position[:, trajectory.moving].astype(float) for trajectory in splits["train"].values()]
    velocity = np.concatenate([(p[1:] - p[:-1]).reshape(-1, p.shape[2]) for p in moving])
    acceleration = np.concatenate([(p[2:] - 2 * p[1:-1] + p[:-2]).reshape(-1, p.shape[2]) for p in moving])
    content["statistics"] = {
        "velocity_mean": velocity.mean(0).tolist(),
        "velocity_std": velocity.std(0).tolist(),
        "acceleration_mean": acceleration.mean(0).tolist(),
        "acceleration_std": acceleration.std(0).tolist(),
        "particles": [24, 24.0, 24],
        "frames": moving[0].shape[0],
        "neighbours": 5.0,
    }
    (folder / "dataset.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="session")
def write_dataset() -> Callable[..., Path]:
    """``write_dataset(folder, {split: {index: trajectory}})``."""
    return _write_dataset


@pytest.fixture(scope="session")
def bounce_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of 5 training, 2 validation and 3 test trajectories; not to be changed by a test."""
    splits = {
        "train": {index: bounce(index) for index in range(5)},
        "valid": {index: bounce(100 + index) for index in range(2)},
        "test": {index: bounce(200 + index) for index in range(3)},
    }
    return _write_dataset(tmp_path_factory.mktemp("bounce"), splits)
