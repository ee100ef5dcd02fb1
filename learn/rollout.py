"""Rollouts of a model over the trajectories of a data set, written as a trajectory file like the solver's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import nn

from learn.checkpoint import file_hash, load_model
from learn.dataset import Dataset
from sim import __version__
from sim.errors import InputError, RunError
from sim.simulator import rollout, start_from
from sim.trajectory import Trajectory, write_json, write_shard


def rollout_trajectory(
    model: nn.Module, trajectory: Trajectory, frames: int | None, simulator: dict, known: int | None = None
) -> tuple[Trajectory, dict]:
    """The model's version of ``trajectory``, and its cost {"seconds", "begin_seconds", "frames"}.

    It begins with the ``model.history`` frames the model was given and goes on for ``frames`` frames (None: to the end of the true
    one). A rollout that fails keeps its finite frames and its status. simulator: what the file says made it.
    """
    known = model.history if known is None else known
    available = len(trajectory.position) - known
    wanted = available if frames is None else min(frames, available)
    with torch.no_grad():
        result = rollout(model, start_from(trajectory, known), wanted)
    finite = int(np.isfinite(result.position).all(axis=(1, 2)).sum())
    position = np.concatenate([trajectory.position[:known], result.position[:finite]])
    predicted = Trajectory(
        position=position, particle_type=trajectory.particle_type, frame_step=trajectory.frame_step, radius=trajectory.radius,
        bounds=trajectory.bounds, scene=trajectory.scene, seed=trajectory.seed, simulator=simulator, status=result.status,
        context=None if trajectory.context is None else trajectory.context[: len(position)],
    )
    return predicted, {"seconds": result.seconds, "begin_seconds": result.begin_seconds, "frames": finite}


def rollout_dataset(
    checkpoint: str | Path, data: str | Path, split: str, out: str | Path, count: int | None = None, frames: int | None = None,
    device: torch.device | str = "cpu", threads: int = 1,
) -> dict:
    """Roll a checkpoint out over the first ``count`` trajectories of a split (None: all) into the shard ``out``.

    Beside it, ``<out>.cost.json`` holds the run times; the returned dictionary is its content. Trajectories keep their indices. Raises
    ``InputError`` for faults of the input (nothing is written) and ``RunError`` if every rollout failed (after writing).
    """
    out = Path(out)
    if out.exists():
        raise InputError(out, "--out", str(out), "exists; give another name, or delete it")
    torch.set_num_threads(threads)
    model = load_model(checkpoint, device)
    dataset = Dataset(data, split)
    if count is not None and count > len(dataset):
        raise InputError(dataset.path, "--count", count, f"the {split} split has {len(dataset)} trajectories")
    check_fit(model, dataset, checkpoint)
    simulator = {"name": model.name, "kind": model.kind, "settings": model.settings, "checkpoint": file_hash(checkpoint), "version": __version__}
    predicted, costs = {}, {}
    for number in range(len(dataset) if count is None else count):
        index = dataset.entries[number][0]
        predicted[index], costs[f"{index:06d}"] = rollout_trajectory(model, dataset.trajectory(number), frames, simulator)
    write_shard(out, predicted)
    total = sum(cost["seconds"] for cost in costs.values())
    content = {"wall_seconds": total, "device": str(device), "threads": threads, "trajectories": costs}
    write_json(out.with_name(out.name + ".cost.json"), content)
    failed = [trajectory.status for trajectory in predicted.values() if not trajectory.ok]
    if len(failed) == len(predicted):
        raise RunError(f"{out}: all {len(failed)} rollouts failed: {failed[0]}")
    return content


def check_fit(model: nn.Module, dataset: Dataset, checkpoint: object) -> None:
    """A model predicts in frames of its training data and knows their types only: ``InputError`` where the data set differs."""
    for name in ("dim", "frame_step"):
        own, given = getattr(model.spec, name), dataset.common[name]
        if own != given:
            raise InputError(dataset.path, name, given, f"{checkpoint} was trained with {own}; use data of the same {name}")
    for number in range(len(dataset)):
        unknown = set(dataset.particle_type(number).tolist()) - set(model.spec.particle_types)
        if unknown:
            remedy = f"{checkpoint} was trained on the types {list(model.spec.particle_types)}"
            raise InputError(dataset.path, "particle_type", sorted(unknown), remedy)
    shortest = min(shape[0] for shape in dataset.shapes)
    if shortest <= model.history:
        raise InputError(dataset.path, "frames", shortest, f"{checkpoint} needs {model.history} frames to begin from and at least one to predict")
