"""Data sets: many scenes of a family, run by the teacher in parallel processes, written as shards with one ``dataset.json``.

A trajectory is a function of (base seed, split, index) alone and a shard of its trajectories, so the bytes of a data set
do not depend on the number of jobs, on the order in which shards finish or on how often the run was killed.

Decision: our own few lines around ``multiprocessing`` instead of ``ProcessPoolExecutor``: a killed worker must be noticed
and named, a killed parent must take its workers with it, and each worker keeps one compiled solver.
"""

from __future__ import annotations

import fcntl
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from tqdm import tqdm

from sim import __version__, periodic
from sim.errors import InputError, RunError
from sim.scene import SPLITS, Scene, SceneFamily
from sim.simulator import SimulationError
from sim.solvers import solver_class
from sim.trajectory import FORMAT_VERSION, ShardReader, Trajectory, write_json, write_shard

DEFAULT_SHARD_SIZE = 8

#: Frames of a trajectory, and trajectories of a split, on which neighbours are counted: a mean over 96 clouds is enough.
_NEIGHBOUR_FRAMES, _NEIGHBOUR_TRAJECTORIES = 3, 32
#: Seconds between progress lines where there is no terminal.
_LINE_INTERVAL = 10.0


class Teacher(Protocol):
    """What the generator needs of a solver (``sim.mpm.solver.MPMSimulator``)."""

    name: str
    kind: str
    settings: dict
    compile_seconds: float

    def load(self, scene: Scene) -> None:
        """Set the state of frame 0, compiling on first use."""

    def frame(self) -> np.ndarray:
        """Positions of the recorded particles one frame later, [particles, dim] float32; raises ``SimulationError``."""

    def diagnostics(self) -> dict[str, float]:
        """Energies, substeps, ... of the current frame."""


def scene_teacher(method: str) -> Teacher:
    """The solver of a scene's ``solver.method`` at the scene's own settings. Imports Taichi, so only a worker calls it."""
    return solver_class(method)()


def trajectory_seed(seed: int, split: str, index: int) -> int:
    """The seed of one trajectory, from the data set's base seed, its split and its index in the split.

    53 bits, so that it survives readers that keep JSON numbers as doubles.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(SPLITS.index(split), index))
    return int(sequence.generate_state(1, np.uint64)[0]) >> 11


def simulate(teacher: Teacher, scene: Scene) -> Trajectory:
    """Run one scene from frame 0 for ``scene.frames`` frames (the first included).

    A failure (``SimulationError``, a non-finite position) ends the run: the trajectory keeps its finite frames and its
    ``status`` says why and at which frame.
    """
    start, kinds = scene.start(), scene.particle_type()
    position = np.empty((scene.frames, *start.shape), np.float32)
    position[0] = start
    diagnostics: dict[str, list[float]] = {}
    status, done = "ok", 1
    try:
        teacher.load(scene)
        for frame in range(scene.frames):
            if frame:
                position[frame] = teacher.frame()
                if not np.isfinite(position[frame]).all():
                    raise SimulationError("non-finite position")
                done = frame + 1
            for name, value in teacher.diagnostics().items():
                diagnostics.setdefault(name, []).append(float(value))
    except SimulationError as error:
        status = f"failed: {error} (frame {done})"
    settings = {"name": teacher.name, "kind": teacher.kind, "settings": teacher.settings, "version": __version__}
    context = scene.context_values()
    return Trajectory(
        position=position[:done],
        particle_type=kinds,
        frame_step=scene.frame_step,
        radius=scene.radius,
        bounds=np.asarray(scene.bounds, float),
        scene=scene.to_dict(),
        seed=scene.seed,
        simulator=settings,
        status=status,
        context=None if context is None else context[:done],
        diagnostics={name: np.asarray(values[:done]) for name, values in diagnostics.items()},
    )


@dataclass(frozen=True)
class Shard:
    """One shard to be: ``split/shard-00000.h5`` and the scenes of its trajectories by index."""

    split: str
    number: int
    scenes: dict[int, Scene]

    @property
    def name(self) -> str:
        """The shard's file within the data set."""
        return f"{self.split}/shard-{self.number:05d}.h5"

    @property
    def cost_name(self) -> str:
        """What it cost and which trajectories failed, beside it."""
        return f"{self.split}/shard-{self.number:05d}.cost.json"


def generate(
    family: SceneFamily,
    counts: dict[str, int],
    out: str | Path,
    *,
    jobs: int = 1,
    seed: int = 0,
    shard_size: int = DEFAULT_SHARD_SIZE,
    teacher: Callable[[], Teacher] | None = None,
) -> dict:
    """Make trajectories 0 .. counts[split] - 1 of each split under ``out`` and return the content of ``dataset.json``.

    Finished shards of an earlier run with the same family and seed are checked and kept; a larger count extends a split.
    ``teacher`` (default: the scene's own solver) is called once in each of the ``jobs`` worker processes, so it must be
    importable. Raises ``InputError`` before anything is written (a scene that cannot be sampled, a folder made with other
    settings, an unwritable folder) and ``RunError`` where the run itself fails (a worker killed, disk full, every trajectory
    of a split failed); what is finished by then stays, and the same call continues from there.
    """
    out = Path(out)
    teacher = teacher or partial(scene_teacher, family.model.solver.method)
    settings = {"family": family.to_dict(), "seed": seed, "shard_size": shard_size}
    shards = {split: _plan_shards(family, split, count, seed, shard_size) for split, count in counts.items()}
    content = _existing(out, settings)
    for split in shards:
        _check_split_folder(out, split, shards[split], content is not None)
    for split, wanted in shards.items():
        try:
            (out / split).mkdir(parents=True, exist_ok=True)
            with _lock(out):
                _remove_temporaries(out)
                if not (out / "dataset.json").exists():
                    header = {"format_version": FORMAT_VERSION, "scene": family.model.name, "version": __version__}
                    write_json(out / "dataset.json", header | settings | {"splits": {}, "statistics": None})
        except OSError as error:
            raise InputError(out, "out", str(out), f"cannot be written ({os.strerror(error.errno or 0)}); give another folder") from None
        with _lock(out / split, wait_for_it=False):
            try:
                content = _make_split(out, settings, split, wanted, jobs, teacher)
            except OSError as error:
                why = os.strerror(error.errno) if error.errno else str(error)
                raise RunError(f"{out}: {why}; finished shards are kept, run the same command again to continue") from None
    assert content is not None, "no split was asked for"
    return content


def _plan_shards(family: SceneFamily, split: str, count: int, seed: int, shard_size: int) -> list[Shard]:
    """All scenes of the split, sampled, so that a scene that cannot be sampled stops the run before it starts."""
    scenes = {index: family.sample(trajectory_seed(seed, split, index), split) for index in range(count)}
    return [
        Shard(split, number, {index: scenes[index] for index in range(first, min(first + shard_size, count))})
        for number, first in enumerate(range(0, count, shard_size))
    ]


def read_content(out: str | Path) -> dict:
    """``dataset.json`` of a data set folder, checked for its outline; raises ``InputError``."""
    path = Path(out) / "dataset.json"
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        fault = getattr(error, "strerror", None) or "not JSON"
        raise InputError(path, "file", fault, "give the folder of a data set, or generate it again") from None
    version = content.get("format_version") if isinstance(content, dict) else None
    if version != FORMAT_VERSION:
        raise InputError(path, "format_version", version, f"this version reads {FORMAT_VERSION}; generate the data set again")
    outline = {"scene": str, "family": dict, "seed": int | None, "shard_size": int, "splits": dict}
    for key, kind in outline.items():
        if key not in content or not isinstance(content[key], kind):
            raise InputError(path, key, content.get(key), "missing or of the wrong kind; generate the data set again")
    for split, entry in content["splits"].items():
        if fault := _split_fault(entry):
            key, value = fault
            raise InputError(path, f"splits.{split}{key}", value, "missing or of the wrong kind; generate the data set again")
    if not isinstance(content.get("statistics"), dict | None):
        raise InputError(path, "statistics", content["statistics"], "must be a mapping or null; generate the data set again")
    return content


def _split_fault(entry: object) -> tuple[str, object] | None:
    """Key and value of the first fault in the outline of a split's entry in ``dataset.json``."""
    if not isinstance(entry, dict):
        return "", entry
    cost = entry.get("cost") or {}
    sound = {
        "trajectories": type(entry.get("trajectories")) is int,
        "ok": type(entry.get("ok")) is int,
        "shards": isinstance(entry.get("shards"), list) and all(isinstance(shard, str) and "\0" not in shard for shard in entry["shards"]),
        "failed": isinstance(entry.get("failed"), list)
        and all(isinstance(one, dict) and {"index", "seed", "status"} <= one.keys() and type(one["index"]) is int for one in entry["failed"]),
        "cost": cost == {} or isinstance(cost, dict) and all(isinstance(cost.get(key), int | float) for key in ("wall_seconds", "compile_seconds")),
    }
    return next(((f".{key}", entry.get(key)) for key, good in sound.items() if not good), None)


def _existing(out: Path, settings: dict) -> dict | None:
    """The content of a folder that this request may continue, None for a new one; anything else is an ``InputError``."""
    if not (out / "dataset.json").exists():
        if out.exists() and not out.is_dir():
            raise InputError(out, "out", str(out), "is not a folder; give another one")
        return None
    content = read_content(out)

    def differ(path: str, old: object, new: object) -> None:
        if isinstance(old, dict) and isinstance(new, dict):
            for key in sorted(old.keys() | new.keys()):
                # Neither changes a trajectory.
                if not (path == "family" and key in ("splits", "variants")):
                    differ(f"{path}.{key}" if path else key, old.get(key), new.get(key))
        elif old != new:
            raise InputError(out / "dataset.json", path, old, f"this request has {new!r}; give another --out or the same settings")

    differ("", {key: content[key] for key in settings}, settings)
    return content


def _check_split_folder(out: Path, split: str, shards: list[Shard], known: bool) -> None:
    """Refuse a split folder that is not ours, or that holds more than was asked for."""
    present = sorted((out / split).glob("shard-*.h5"))
    if present and not known:
        raise InputError(out, "dataset.json", None, f"missing beside the shards of {split}/; give another --out")
    names = {shard.name for shard in shards}
    surplus = [path for path in present if f"{split}/{path.name}" not in names]
    if surplus:
        count = sum(len(shard.scenes) for shard in shards)
        raise InputError(out / split, "count", count, f"the folder already holds more ({surplus[0].name}); ask for as many or give another --out")


@contextmanager
def _lock(folder: Path, wait_for_it: bool = True) -> Iterator[None]:
    """Hold a folder against other runs on this machine. The kernel drops the lock with the process, however that dies."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait_for_it else fcntl.LOCK_NB))
        except BlockingIOError:
            raise InputError(folder, "out", str(folder), "another run is writing here; wait for it or give another folder") from None
        yield
    finally:
        os.close(descriptor)


def _remove_temporaries(folder: Path) -> None:
    """Remove what a killed run left behind; only called under the folder's lock."""
    for path in folder.glob(".*.tmp*"):
        path.unlink(missing_ok=True)


def _make_split(out: Path, settings: dict, split: str, shards: list[Shard], jobs: int, teacher: Callable[[], Teacher]) -> dict:
    _remove_temporaries(out / split)
    missing = [shard for shard in shards if not _finished(out, shard)]
    content = read_content(out)
    count = sum(len(shard.scenes) for shard in shards)
    if missing or content["splits"].get(split, {}).get("trajectories") != count:
        # Until the split is complete again, dataset.json must not describe it.
        _update(out, lambda content: content["splits"].pop(split, None))
        if missing:
            kept = count - sum(len(shard.scenes) for shard in missing)
            with _Progress(split, count, kept) as progress:
                try:
                    _run_workers(out, missing, jobs, teacher, progress)
                finally:
                    _remove_temporaries(out / split)
        summary = _summary(out, shards)
        statistics = training_statistics([out / name for name in summary["shards"]], jobs) if split == "train" else None

        def complete(content: dict) -> None:
            content["splits"][split] = summary
            content["family"] = settings["family"]
            if split == "train":
                content["statistics"] = statistics

        content = _update(out, complete)
    summary = content["splits"][split]
    if count and not summary["ok"]:
        raise RunError(f"{out}: all {count} trajectories of {split} failed; the first: {summary['failed'][0]['status']}")
    return content


def _update(out: Path, change: Callable[[dict], object]) -> dict:
    """Read, change and write ``dataset.json`` under the folder's lock, so that splits may be made side by side."""
    with _lock(out):
        content = read_content(out)
        change(content)
        write_json(out / "dataset.json", content)
    return content


def _read_cost(out: Path, shard: Shard) -> dict | None:
    """What is beside a shard; None if it is missing or damaged (the shard is then made again)."""
    try:
        cost = json.loads((out / shard.cost_name).read_text())
        float(cost["wall_seconds"]), float(cost["compile_seconds"])
        return cost if all({"index", "seed", "status"} <= set(entry) for entry in cost["failed"]) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _finished(out: Path, shard: Shard) -> bool:
    """Whether a shard is on disk, complete and undamaged. One made from other settings is an ``InputError``."""
    cost = _read_cost(out, shard)
    path = out / shard.name
    if cost is None:
        return False
    failed = {entry["index"]: entry["seed"] for entry in cost["failed"]}
    found: set[int] = set()
    if path.exists():
        try:
            with ShardReader(path) as reader:
                found = set(reader.indices())
                for index in sorted(found & shard.scenes.keys()):
                    meta, scene = reader.meta(index), shard.scenes[index]
                    if meta["seed"] != scene.seed or meta["scene"] != scene.to_dict():
                        raise InputError(path, f"{index:06d}/seed", meta["seed"], "made from another scene or seed; give another --out")
                    if not isinstance(meta["simulator"], dict) or meta["simulator"].get("version") != __version__:
                        raise InputError(path, f"{index:06d}/simulator", meta["simulator"], f"not made by version {__version__}; give another --out")
                    if reader.shape(index)[0] != scene.frames or not np.isfinite(reader.positions(index)).all():
                        raise _Damaged
        except _Damaged:
            found = set()
        except InputError as error:
            if "give another --out" in str(error):
                raise
            print(f"{error}; making it again", file=sys.stderr)
            return False
    if not found | failed.keys() <= shard.scenes.keys():
        remedy = f"the folder already holds more ({sorted(found | failed.keys())}); ask for as many or give another --out"
        raise InputError(path, "count", len(shard.scenes), remedy)
    return found | failed.keys() == shard.scenes.keys() and not found & failed.keys()


class _Damaged(Exception):
    pass


def _summary(out: Path, shards: list[Shard]) -> dict:
    """The entry of a complete split in ``dataset.json``."""
    costs: list[Any] = [_read_cost(out, shard) for shard in shards]  # of finished shards, which have one
    failed = [entry for cost in costs for entry in cost["failed"]]
    count = sum(len(shard.scenes) for shard in shards)
    return {
        "trajectories": count,
        "ok": count - len(failed),
        "failed": failed,
        "shards": [shard.name for shard, cost in zip(shards, costs, strict=True) if len(cost["failed"]) < len(shard.scenes)],
        "cost": {key: sum(cost[key] for cost in costs) for key in ("wall_seconds", "compile_seconds")},
    }


# --- worker processes ------------------------------------------------------------------------------------------------


def _run_workers(out: Path, shards: list[Shard], jobs: int, teacher: Callable[[], Teacher], progress: _Progress) -> None:
    """Make ``shards`` in up to ``jobs`` processes; returns when all are on disk, raises ``RunError`` when one cannot be."""
    context = multiprocessing.get_context("spawn")
    pending = deque(shards)
    workers: dict[Connection, multiprocessing.process.BaseProcess] = {}
    try:
        for _ in range(min(jobs, len(shards))):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, out, teacher), daemon=True)
            process.start()
            # Only the worker may hold its end: its death then reads as the end of the pipe.
            theirs.close()
            workers[ours] = process
        scenes = [scene for shard in shards for scene in shard.scenes.values()]
        largest = max(scenes, key=lambda scene: len(scene.particles(refine=1).position))
        while workers:
            for connection in cast("list[Connection]", wait(list(workers))):
                try:
                    kind, detail = connection.recv()
                    if kind == "scene":
                        connection.send(largest)
                    elif kind == "shard":
                        connection.send(pending.popleft() if pending else None)
                except (EOFError, ConnectionError):
                    raise RunError(_epitaph(workers[connection])) from None
                if kind == "trajectory":
                    progress.trajectory(detail)
                elif kind == "last":
                    workers.pop(connection).join()
                    connection.close()
                elif kind == "error":
                    raise RunError(detail)
    finally:
        for worker in workers.values():
            worker.kill()
        for connection, worker in workers.items():
            worker.join()
            connection.close()


def _epitaph(process: multiprocessing.process.BaseProcess) -> str:
    process.join()
    code = process.exitcode or 0
    how = f"was killed by signal {-code} ({signal.Signals(-code).name}; out of memory?)" if code < 0 else f"ended with exit code {code}"
    return f"a worker process {how}; finished shards are kept, run the same command again to continue"


def _work(connection: Connection, out: Path, teacher: Callable[[], Teacher]) -> None:
    """A worker process: load the largest scene, so that fields are allocated and kernels compiled once, then ask for shards and
    make them until None arrives. Messages to the parent: (scene | shard | trajectory | last | error, detail).

    Signals to the whole group are the parent's to handle; it kills its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        simulator = teacher()
        connection.send(("scene", None))
        with suppress(SimulationError):
            simulator.load(connection.recv())
        accounted = 0.0
        connection.send(("shard", None))
        while (shard := connection.recv()) is not None:
            try:
                _make_shard(out, shard, simulator, accounted, lambda status: connection.send(("trajectory", status)))
                accounted = simulator.compile_seconds
            except OSError as error:
                why = os.strerror(error.errno) if error.errno else str(error)
                connection.send(("error", f"{out / shard.name}: cannot be written: {why}; finished shards are kept"))
                return
            connection.send(("shard", None))
        connection.send(("last", None))
    except (EOFError, BrokenPipeError):
        return
    except Exception as error:  # A fault of ours: the parent stops with one line, the traceback goes to the log.
        traceback.print_exc()
        connection.send(("error", f"a worker process failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"))


def _end_with_parent() -> None:
    """End this process when the parent dies, however it dies: an orphan would go on writing into a folder it no longer holds."""
    if (parent := multiprocessing.parent_process()) is not None:
        wait([parent.sentinel])
    os._exit(1)


def _make_shard(out: Path, shard: Shard, simulator: Teacher, accounted: float, report: Callable[[str], None]) -> None:
    """Run the trajectories of a shard, write the good ones, and write beside it what it cost and which failed.

    ``accounted``: compile seconds of this simulator that earlier shards have been charged with.
    """
    trajectories, failed, seconds = {}, [], 0.0
    compiled = simulator.compile_seconds
    for index, scene in shard.scenes.items():
        begun = time.perf_counter()
        trajectory = simulate(simulator, scene)
        seconds += time.perf_counter() - begun
        if trajectory.ok:
            trajectories[index] = trajectory
        else:
            failed.append({"index": index, "seed": scene.seed, "status": trajectory.status})
        report(trajectory.status)
    cost = {"wall_seconds": seconds - (simulator.compile_seconds - compiled), "compile_seconds": simulator.compile_seconds - accounted}
    if trajectories:
        write_shard(out / shard.name, trajectories)
    # Last, because a shard counts as finished only with its cost beside it.
    write_json(out / shard.cost_name, cost | {"failed": failed})


class _Progress:
    """A bar on a terminal, a plain line every few seconds elsewhere; both on standard error."""

    def __init__(self, split: str, total: int, kept: int):
        self.split, self.total, self.done, self.failed = split, total, kept, 0
        self.began = self.spoken = time.monotonic()
        terminal = sys.stderr.isatty()
        self.bar = tqdm(total=total, initial=kept, desc=split, unit="trajectory", file=sys.stderr) if terminal else None
        if kept:
            self.say(f"{split}: {kept} of {total} trajectories are finished, continuing")

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def say(self, line: str) -> None:
        if self.bar is not None:
            self.bar.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr, flush=True)

    def trajectory(self, status: str) -> None:
        self.done += 1
        if status != "ok":
            self.failed += 1
            self.say(f"{self.split}: a trajectory {status}; it is listed in dataset.json and left out")
        if self.bar is not None:
            self.bar.update()
        elif time.monotonic() - self.spoken >= _LINE_INTERVAL or self.done == self.total:
            self.spoken = time.monotonic()
            self.say(f"{self.split}: {self.done}/{self.total} trajectories, {self.failed} failed, {self.spoken - self.began:.0f} s")


# --- statistics ------------------------------------------------------------------------------------------------------


@dataclass
class _Moments:
    """Streaming sums over rows [n, dim] in float64. Means are small against deviations here, so plain sums of squares do."""

    count: int = 0
    total: np.ndarray = field(default_factory=lambda: np.zeros(()))
    squares: np.ndarray = field(default_factory=lambda: np.zeros(()))

    def add(self, rows: np.ndarray) -> None:
        rows = rows.reshape(-1, rows.shape[-1])
        self.merge(_Moments(len(rows), rows.sum(0), np.einsum("ij,ij->j", rows, rows)))

    def merge(self, other: _Moments) -> None:
        self.count += other.count
        self.total = self.total + other.total
        self.squares = self.squares + other.squares

    def result(self) -> tuple[list[float] | None, list[float] | None]:
        """Mean and standard deviation per axis, (None, None) without a row."""
        if not self.count:
            return None, None
        mean = self.total / self.count
        return mean.tolist(), np.sqrt(np.maximum(self.squares / self.count - mean**2, 0)).tolist()


@dataclass
class _ShardStatistics:
    velocity: _Moments = field(default_factory=_Moments)
    acceleration: _Moments = field(default_factory=_Moments)
    context: _Moments = field(default_factory=_Moments)
    particles: list[int] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    neighbours: list[float] = field(default_factory=list)


def _shard_statistics(path: Path, neighbour_stride: int) -> _ShardStatistics:
    result = _ShardStatistics()
    with ShardReader(path) as reader:
        for index in reader.indices():
            trajectory = reader.read(index)
            position = periodic.unwrapped(trajectory.position[:, trajectory.moving].astype(np.float64), trajectory.period)
            velocity = np.diff(position, axis=0)
            result.velocity.add(velocity)
            result.acceleration.add(np.diff(velocity, axis=0))
            if trajectory.context is not None:
                result.context.add(trajectory.context.astype(np.float64))
            result.particles.append(trajectory.position.shape[1])
            result.frames.append(len(position))
            if index % neighbour_stride == 0:
                for frame in np.linspace(0, len(position) - 1, _NEIGHBOUR_FRAMES).astype(int):
                    tree = periodic.tree(trajectory.position[frame], trajectory.period)
                    result.neighbours.append(tree.count_neighbors(tree, trajectory.radius) / tree.n)
    return result


def training_statistics(shards: list[Path], jobs: int = 1) -> dict | None:
    """Statistics of a training split, streamed over its shards, ``jobs`` at a time; None without a trajectory.

    velocity p_t - p_(t-1) and acceleration p_(t+1) - 2 p_t + p_(t-1), length per frame (squared), mean and std per axis in
    float64 over all frames and moving particles; context (where there is one), over all frames; particles [min, mean, max];
    frames (the most); neighbours: mean number of particles within the radius, self included, on a sample of frames.
    """
    indices: list[int] = []
    for path in shards:
        with ShardReader(path) as reader:
            indices += reader.indices()
    if not indices:
        return None
    stride = max(1, (max(indices) + 1) // _NEIGHBOUR_TRAJECTORIES)
    if not any(index % stride == 0 for index in indices):
        stride = 1
    velocity, acceleration, context = _Moments(), _Moments(), _Moments()
    particles: list[int] = []
    frames: list[int] = []
    neighbours: list[float] = []
    with ThreadPoolExecutor(jobs) as pool:
        # Merged in the order of the shards, so the last bit does not depend on the jobs.
        for part in pool.map(lambda path: _shard_statistics(path, stride), shards):
            velocity.merge(part.velocity)
            acceleration.merge(part.acceleration)
            context.merge(part.context)
            particles += part.particles
            frames += part.frames
            neighbours += part.neighbours
    statistics: dict = dict(zip(("velocity_mean", "velocity_std"), velocity.result(), strict=True))
    statistics |= dict(zip(("acceleration_mean", "acceleration_std"), acceleration.result(), strict=True))
    if context.count:
        statistics |= dict(zip(("context_mean", "context_std"), context.result(), strict=True))
    statistics |= {"particles": [min(particles), float(np.mean(particles)), max(particles)], "frames": max(frames)}
    return statistics | {"neighbours": float(np.mean(neighbours))}
