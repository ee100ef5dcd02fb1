"""Rollouts of a model over the trajectories of a data set, or from the first frames of a scene, written as a trajectory file like the solver's.

Decision: a scene's first frames are made by the solver in a process of its own, as a data set that is read like any other: nothing but the
trajectory file passes between the two, and no process holds Taichi and torch.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import nn

from learn.checkpoint import file_hash, load_model
from learn.dataset import Dataset
from sim import __version__, periodic
from sim.errors import InputError, RunError
from sim.generate import trajectory_seed
from sim.scene import SceneFamily
from sim.simulator import Rollout, rollout, rollouts, start_from
from sim.trajectory import Trajectory, write_json, write_shard


def rollout_trajectory(
    model: nn.Module, trajectory: Trajectory, frames: int | None, simulator: dict, known: int | None = None
) -> tuple[Trajectory, dict]:
    """The model's version of ``trajectory``, and its cost {"seconds", "begin_seconds", "frames", "escaped"} (see ``sim.simulator.Rollout``).

    It begins with the ``model.history`` frames the model was given and goes on for ``frames`` frames (None: to the end of the true
    one), or as far as the context is known. A rollout that fails keeps its finite frames and its status. simulator: what the file says made it.
    """
    known = model.history if known is None else known
    with torch.no_grad():
        result = rollout(model, start_from(trajectory, known), _wanted(trajectory, known, frames))
    return _predicted(trajectory, known, result, simulator)


def _wanted(trajectory: Trajectory, known: int, frames: int | None) -> int:
    """Frames to predict."""
    most = (len(trajectory.position) if trajectory.context is None else len(trajectory.context)) - known
    if frames is None:
        return len(trajectory.position) - known
    return frames if trajectory.context is None else min(frames, most)


def _predicted(trajectory: Trajectory, known: int, result: Rollout, simulator: dict) -> tuple[Trajectory, dict]:
    finite = int(np.isfinite(result.position).all(axis=(1, 2)).sum())
    position = np.concatenate([trajectory.position[:known], result.position[:finite]])
    predicted = Trajectory(
        position=position,
        particle_type=trajectory.particle_type,
        frame_step=trajectory.frame_step,
        radius=trajectory.radius,
        bounds=trajectory.bounds,
        scene=trajectory.scene,
        seed=trajectory.seed,
        simulator=simulator,
        status=result.status,
        context=None if trajectory.context is None else trajectory.context[: len(position)],
    )
    return predicted, {"seconds": result.seconds, "begin_seconds": result.begin_seconds, "frames": finite, "escaped": result.escaped}


def _free(out: Path) -> None:
    if out.exists():
        raise InputError(out, "--out", str(out), "exists; give another name, or delete it")


def rollout_dataset(
    checkpoint: str | Path,
    data: str | Path,
    split: str,
    out: str | Path,
    count: int | None = None,
    frames: int | None = None,
    device: torch.device | str = "cpu",
    threads: int = 1,
    batch: int = 1,
) -> dict:
    """Roll a checkpoint out over the first ``count`` trajectories of a split (None: all) into the shard ``out``.

    Beside it, ``<out>.cost.json`` holds the run times; the returned dictionary is its content. Trajectories keep their indices; more frames
    than the true ones have go on beyond their end. batch: trajectories that are rolled out together, where the model can (see
    ``sim.simulator.rollouts``); sums run in another order then, and the last digits differ. Raises ``InputError`` for faults of the
    input (nothing is written) and ``RunError`` if every rollout failed (after writing).
    """
    out = Path(out)
    _free(out)
    model, dataset = load_model(checkpoint, device), Dataset(data, split)
    if count is not None and count > len(dataset):
        raise InputError(dataset.path, "--count", count, f"the {split} split has {len(dataset)} trajectories")
    check_fit(model, dataset, checkpoint)
    numbers = range(len(dataset) if count is None else count)
    starts = ((dataset.entries[number][0], dataset.trajectory(number)) for number in numbers)
    return _write(model, checkpoint, starts, out, frames, device, threads, batch)


def rollout_scene(
    checkpoint: str | Path,
    scene: str | Path,
    out: str | Path,
    variant: str | None = None,
    seed: int = 0,
    count: int = 1,
    frames: int | None = None,
    device: torch.device | str = "cpu",
    threads: int = 1,
    batch: int = 1,
) -> dict:
    """Roll a checkpoint out from the first frames of ``count`` draws of a scene file, those of the test split of a data set with base seed ``seed``.

    The first frames come from the scene's solver, ``frames`` (None: to the scene's end) from the model; otherwise, with
    its ``InputError`` and ``RunError``, as ``rollout_dataset``.
    """
    out = Path(out)
    _free(out)
    model, family = load_model(checkpoint, device), SceneFamily.load(scene, variant)
    content = family.to_dict() | {"frames": model.history + frames if frames else family.model.frames}
    family = SceneFamily(content, scene)
    if family.model.frames <= model.history:
        remedy = f"{checkpoint} needs {model.history} frames to begin from and at least one to predict; give --frames"
        raise InputError(scene, "frames", family.model.frames, remedy)
    drawn = [family.sample(trajectory_seed(seed, "test", index), "test") for index in range(count)]
    for one in drawn:
        context = one.context_values()
        common = {"dim": one.dim, "frame_step": one.frame_step, "periodic": periodic.axes(one.to_dict())}
        _check_fit(model, scene, checkpoint, common, set(one.particle_type().tolist()),
                   0 if context is None else context.shape[1])  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sim", "generate", str(scene), "--split", "test", "--count", str(count), "--seed", str(seed),
                   "--frames", str(model.history), "--out", folder, *(["--variant", variant] if variant else [])]  # fmt: skip
        solver = subprocess.run(command, capture_output=True, text=True, check=False)
        if solver.returncode:
            last = (solver.stderr.strip() or solver.stdout.strip() or f"exit code {solver.returncode}").splitlines()[-1]
            kind = InputError(scene, "scene", str(scene), last) if solver.returncode == 2 else RunError(f"{scene}: the solver failed: {last}")
            raise kind
        dataset = Dataset(folder, "test")

        def starts() -> Iterator[tuple[int, Trajectory]]:
            for number, (index, _) in enumerate(dataset.entries):
                yield index, replace(dataset.trajectory(number), scene=drawn[index].to_dict(), context=drawn[index].context_values(), diagnostics={})

        return _write(model, checkpoint, starts(), out, family.model.frames - model.history, device, threads, batch)


def _write(
    model: nn.Module,
    checkpoint: str | Path,
    starts: Iterable[tuple[int, Trajectory]],
    out: Path,
    frames: int | None,
    device: torch.device | str,
    threads: int,
    batch: int,
) -> dict:
    torch.set_num_threads(threads)
    simulator = {"name": model.name, "kind": model.kind, "settings": model.settings, "checkpoint": file_hash(checkpoint), "version": __version__}
    predicted, costs = {}, {}
    starts, known = iter(starts), model.history
    while some := list(islice(starts, batch)):
        trajectories = [trajectory for _, trajectory in some]
        with torch.no_grad():
            results = rollouts(model, [start_from(one, known) for one in trajectories], [_wanted(one, known, frames) for one in trajectories])
        for (index, trajectory), result in zip(some, results, strict=True):
            predicted[index], costs[f"{index:06d}"] = _predicted(trajectory, known, result, simulator)
    total = sum(cost["seconds"] for cost in costs.values())
    failed = {f"{index:06d}": trajectory.status for index, trajectory in predicted.items() if not trajectory.ok}
    content = {"wall_seconds": total, "device": str(device), "threads": threads, "failed": failed, "trajectories": costs}
    try:
        write_shard(out, predicted)
        write_json(out.with_name(out.name + ".cost.json"), content)
    except OSError as error:
        out.unlink(missing_ok=True)  # without its cost it is not whole, and would stand in the way of the same command
        raise RunError(f"{out}: cannot be written: {error.strerror or error}") from None
    if len(failed) == len(predicted):
        raise RunError(f"{out}: all {len(failed)} rollouts failed: {next(iter(failed.values()))}")
    return content


def check_fit(model: nn.Module, dataset: Dataset, checkpoint: object) -> None:
    """A model predicts in frames of its training data and knows their types only: ``InputError`` where the data set differs."""
    contexts = {0 if context is None else context.shape[1] for context in map(dataset.context, range(len(dataset)))}
    types = set().union(*(dataset.particle_type(number).tolist() for number in range(len(dataset))))
    _check_fit(model, dataset.path, checkpoint, dataset.common, types, max(contexts))
    shortest = min(shape[0] for shape in dataset.shapes)
    if shortest <= model.history:
        raise InputError(dataset.path, "frames", shortest, f"{checkpoint} needs {model.history} frames to begin from and at least one to predict")


def _check_fit(model: nn.Module, where: object, checkpoint: object, common: dict, types: set[int], context: int) -> None:
    for name in ("dim", "frame_step", "periodic"):
        own = getattr(model.spec, name)
        if own != common[name]:
            raise InputError(where, name, common[name], f"{checkpoint} was trained with {own}; use data of the same {name}")
    unknown = types - set(model.spec.particle_types)
    if unknown:
        raise InputError(where, "particle_type", sorted(unknown), f"{checkpoint} was trained on the types {list(model.spec.particle_types)}")
    own = len(model.spec.context_mean or ())
    if own != context:
        raise InputError(where, "context", f"{context} columns", f"{checkpoint} was trained with {own}; use data of the same")
