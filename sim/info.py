"""What is in a data set folder, a shard or a scene file (``info_text``), and whether it is sound (``faults``)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.generate import SPLITS, read_content, training_statistics, trajectory_seed
from sim.scene import SceneFamily
from sim.trajectory import ShardReader, Trajectory

#: Scenes drawn to describe a family.
_SAMPLES = 8


def info_text(path: str | Path) -> str:
    """A summary for people of a data set folder, a shard (.h5) or a scene file (.yaml, .yml). Raises ``InputError``."""
    path = Path(path)
    if path.is_dir():
        return _dataset_text(path)
    if path.suffix == ".h5":
        return _shard_text(path)
    if path.suffix in (".yaml", ".yml"):
        return _scene_text(path)
    raise InputError("sluice-sim", "path", str(path), "give a data set folder, a shard (.h5) or a scene file (.yaml)")


def faults(path: str | Path) -> Iterator[str]:
    """One line for each fault of a shard, or of every shard of a data set folder and its ``dataset.json``."""
    path = Path(path)
    if path.is_dir():
        yield from _dataset_faults(path)
    else:
        yield from _shard_faults(path)


def _numbers(values: object) -> str:
    if isinstance(values, list):
        return ", ".join(_numbers(value) for value in values)
    return f"{values:.4g}" if isinstance(values, float) else str(values)


def _dataset_text(path: Path) -> str:
    content = read_content(path)
    seed = "imported" if content["seed"] is None else f"base seed {content['seed']}"
    lines = [f"data set {path}: scene {content['scene']}, {seed}"]
    for split, entry in content["splits"].items():
        size = sum((path / shard).stat().st_size for shard in entry["shards"] if (path / shard).is_file())
        cost = entry.get("cost")
        taken = f"; solver {cost['wall_seconds']:.1f} s, set-up and compilation {cost['compile_seconds']:.1f} s" if cost else ""
        lines.append(f"  {split}: {entry['ok']} of {entry['trajectories']} trajectories in {len(entry['shards'])} shards, {size / 1e6:.1f} MB{taken}")
        lines += [f"    failed: {failure['index']} (seed {failure['seed']}): {failure['status']}" for failure in entry["failed"]]
    missing = [split for split in SPLITS if split not in content["splits"]]
    if missing:
        lines.append(f"  not made, or not finished: {', '.join(missing)}")
    if content.get("statistics"):
        lines.append("  statistics of the training split, length per frame:")
        lines += [f"    {name}: {_numbers(value)}" for name, value in content["statistics"].items()]
    return "\n".join(lines)


def _shard_text(path: Path) -> str:
    lines = [f"shard {path}: {path.stat().st_size / 1e6:.1f} MB" if path.is_file() else f"shard {path}"]
    with ShardReader(path) as reader:
        for index in reader.indices():
            meta, (frames, particles, dim) = reader.meta(index), reader.shape(index)
            simulator = meta["simulator"].get("name") if isinstance(meta["simulator"], dict) else None
            lines.append(
                f"  {index:06d}: {frames} frames of {meta['frame_step']:.4g} s, {particles} particles, {dim}D, "
                f"scene {meta['scene'].get('name')}, by {simulator}, seed {meta['seed']}, {meta['status']}"
            )
    return "\n".join(lines)


def _scene_text(path: Path) -> str:
    family = SceneFamily.load(path)
    model = family.model
    counts = [len(family.sample(trajectory_seed(0, "train", index)).particle_type()) for index in range(_SAMPLES)]
    lines = [
        f"scene {model.name}: {model.dim}D, box {' x '.join(f'{lower:g}..{upper:g}' for lower, upper in model.bounds)}, gravity {model.gravity}",
        f"  {model.frames} frames of {model.frame_step:g} s ({(model.frames - 1) * model.frame_step:g} s)",
        f"  particle spacing {model.spacing:.4g}, radius {model.radius:g} ({model.radius / model.spacing:.2f} spacings), grid spacing "
        f"{model.grid_spacing:.4g}" + (f"; the teacher is {model.refine} times finer" if model.refine > 1 else ""),
        f"  particles in {_SAMPLES} draws: {min(counts)} to {max(counts)}, mean {np.mean(counts):.0f}",
    ]
    content = family.to_dict()
    lines += [f"  material {name}: {material}" for name, material in content["materials"].items()]
    lines += [f"  obstacles: {obstacle}" for obstacle in content.get("obstacles", [])]
    if model.container is not None:
        lines.append(f"  container: {content['container']}")
    if model.context:
        lines.append(f"  context: {', '.join(model.context)}")
    lines.append(f"  splits: {', '.join(f'{split} {getattr(model.splits, split)}' for split in SPLITS)}")
    if model.variants:
        lines.append(f"  variants: {', '.join(model.variants)}")
    return "\n".join(lines)


def _trajectory_fault(trajectory: Trajectory) -> str | None:
    """The first fault of the contents; the reader has checked the structure."""
    if not trajectory.ok:
        return f"status {trajectory.status!r}: does not belong in a shard"
    finite = np.isfinite(trajectory.position).all(axis=(1, 2))
    if not finite.all():
        return f"non-finite position in frame {np.argmin(finite)}"
    lower, upper = trajectory.bounds.astype(np.float32).T
    outside = ((trajectory.position < lower) | (trajectory.position > upper)).any(axis=(1, 2))
    if outside.any():
        return f"a particle outside the box in frame {np.argmax(outside)}"
    if trajectory.context is not None and not np.isfinite(trajectory.context).all():
        return "non-finite context"
    for name, values in trajectory.diagnostics.items():
        if values.shape != (len(trajectory.position),) or not np.isfinite(values).all():
            return f"diagnostics/{name} is not one finite number a frame"
    return None


def _shard_faults(path: Path) -> Iterator[str]:
    try:
        with ShardReader(path) as reader:
            for index in reader.indices():
                try:
                    fault = _trajectory_fault(reader.read(index))
                except InputError as error:
                    yield str(error)
                    continue
                if fault:
                    yield f"{path}: {index:06d}: {fault}"
    except InputError as error:
        yield str(error)


def _dataset_faults(path: Path) -> Iterator[str]:
    try:
        content = read_content(path)
    except InputError as error:
        yield str(error)
        return
    for split, entry in content["splits"].items():
        where = f"{path}/dataset.json: splits.{split}"
        shards = [path / shard for shard in entry["shards"]]
        failed, count = {failure["index"]: failure["seed"] for failure in entry["failed"]}, entry["trajectories"]
        sound = True
        seeds = dict(failed)
        for shard in shards:
            for fault in _shard_faults(shard):
                sound = False
                yield fault
            if sound:
                with ShardReader(shard) as reader:
                    seeds |= {index: reader.meta(index)["seed"] for index in reader.indices()}
        if not sound:
            continue
        if set(seeds) != set(range(count)) or entry.get("ok") != count - len(failed):
            yield f"{where}: {len(seeds)} trajectories found, {count} promised ({len(failed)} of them failed)"
        elif split in SPLITS and content["seed"] is not None:
            wrong = [index for index, seed in seeds.items() if seed != trajectory_seed(content["seed"], split, index)]
            if wrong:
                yield f"{where}: trajectory {wrong[0]} has seed {seeds[wrong[0]]}, not the one its index gives"
        if split == "train" and not _same(content.get("statistics"), training_statistics(shards)):
            yield f"{path}/dataset.json: statistics: do not match the training split; generate the data set again"


def _same(stated: dict | None, found: dict | None) -> bool:
    """Equal up to the order of summation."""
    if stated is None or found is None:
        return stated is found
    try:
        pairs = [(np.asarray(stated[key], float), np.asarray(value, float)) for key, value in found.items()]
        return stated.keys() == found.keys() and all(np.allclose(*pair, rtol=1e-6, atol=1e-12, equal_nan=True) for pair in pairs)
    except (KeyError, TypeError, ValueError):
        return False
