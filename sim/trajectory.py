"""The trajectory file: the one thing that passes between solver, learned model, comparison and pictures.

HDF5, one file per *shard* of trajectories, groups named by the zero-padded trajectory index. Per group: ``position``
[frames, particles, dim] float32, contiguous (a 7-frame window reads in 0.06 ms; automatic chunks take 25 ms and float32
positions barely compress); ``particle_type`` [particles] int8; optional ``context`` [frames, c] float32; ``diagnostics/*``
[frames] float64. What describes the run is one JSON attribute ``meta``.

Decision: wall and compile time are *not* in the file but beside it (``<shard>.cost.json``), because a shard holds only
what the seed determines: a resumed run must give the same bytes as an unbroken one.
"""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sim import periodic
from sim.errors import InputError

FORMAT_VERSION = 1

#: Particle type ids as in DeepMind's released data (Sanchez-Gonzalez et al. 2020), whose nine slots 0 .. 8 leave some free:
#: elastic and snow are ours.
PARTICLE_TYPES = {"rigid": 0, "elastic": 1, "boundary": 3, "water": 5, "sand": 6, "goop": 7, "snow": 8}
KINEMATIC_TYPE = PARTICLE_TYPES["boundary"]
#: Float32 ends at 3e38: with larger numbers than this one nothing can be computed.
LARGEST = 1e30


@dataclass(frozen=True)
class Trajectory:
    """One run of one simulator (solver or learned model) on one scene.

    position [frames, particles, dim] float32; particle_type [particles] int8 (see ``PARTICLE_TYPES``); frame_step [s];
    radius: connectivity radius [length]; bounds [dim, 2]: inner faces of the container; context [frames, c] or None;
    seed: None where nobody knows it (imported data); diagnostics: name -> [frames] float64; status: "ok" or "failed: why" (a failed
    trajectory keeps its finite frames).
    """

    position: np.ndarray
    particle_type: np.ndarray
    frame_step: float
    radius: float
    bounds: np.ndarray
    scene: dict
    seed: int | None
    simulator: dict
    status: str = "ok"
    context: np.ndarray | None = None
    diagnostics: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether it ran to its end."""
        return self.status == "ok"

    @property
    def moving(self) -> np.ndarray:
        """[particles] bool: not kinematic."""
        return self.particle_type != KINEMATIC_TYPE

    @property
    def period(self) -> np.ndarray | None:
        """[dim]: see ``sim.periodic``."""
        return periodic.period(self.scene, self.bounds)


def flush(path: str | Path) -> None:
    """Wait until a file's bytes are on the disk."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name; on success flush to disk and rename to ``path``; on any error remove it. Complete or absent.

    A write that fails (a full disk) is an ``OSError`` that names ``path``, which the operating system's own does not.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        flush(temporary)
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None and str(error.filename) in ("None", str(temporary)):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        temporary.unlink(missing_ok=True)


def vacant(path: str | Path) -> Path:
    """The absolute path of a folder that is new or empty; ``InputError`` for any other."""
    path = Path(os.path.abspath(path))
    try:
        taken = path.exists() and (not path.is_dir() or any(path.iterdir()))
    except OSError as error:
        raise InputError(path, "out", str(path), f"cannot be looked into ({error.strerror}); give another folder") from None
    if taken:
        raise InputError(path, "out", str(path), "exists already; give a new folder")
    return path


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``path``; on success flush its files and rename it, on any error remove it. Complete or absent.

    A write in it that fails is an ``OSError`` that names ``path``, as by ``atomic_path``; a folder that cannot be made, an ``InputError``.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir(parents=True)
    except OSError as error:
        raise InputError(path, "out", str(path), f"cannot be written ({error.strerror}); give another folder") from None
    try:
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                flush(file)
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None and (error.filename is None or Path(error.filename).is_relative_to(temporary)):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


class Disk(io.FileIO):
    """A file for HDF5 to write to. What goes wrong below HDF5 (a full disk, Ctrl-C) would end the process with a segmentation fault;
    here it is kept for ``check``, and nothing more is written.
    """

    error: BaseException | None = None

    def write(self, data: Any) -> int:
        """As of any file; what is written after an error is dropped."""
        try:
            rest = memoryview(data).cast("B")
            while self.error is None and rest:
                rest = rest[super().write(rest) :]
        except BaseException as error:
            self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """As of any file; an error is kept."""
        try:
            return super().truncate(size)
        except BaseException as error:
            self.error = self.error or error
            return size or 0

    def check(self) -> None:
        """Raise what went wrong."""
        if self.error is not None:
            raise self.error


@contextmanager
def new_hdf5(path: Path) -> Iterator[tuple[h5py.File, Disk]]:
    """Yield a new HDF5 file and the disk below it, to be checked now and then; raises ``OSError`` where something could not be written."""
    with Disk(path, "w+") as disk:
        try:
            with h5py.File(disk, "w", libver=("v108", "v110")) as file:
                yield file, disk
        except (OSError, RuntimeError):
            disk.check()  # the cause, where there is one
            raise
        disk.check()


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text)


def write_json(path: str | Path, content: object) -> None:
    """Write JSON atomically, sorted keys; NaN is refused."""
    write_text(path, json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n")


def write_shard(path: str | Path, trajectories: dict[int, Trajectory] | Iterable[tuple[int, Trajectory]]) -> None:
    """Write a shard atomically: ``{index: trajectory}``, or pairs by ascending index that are made as they are written, one in memory at a time.

    The bytes depend on the trajectories alone. Raises ``OSError``.
    """
    if isinstance(trajectories, dict):
        trajectories = sorted(trajectories.items())
    with atomic_path(path) as temporary, new_hdf5(temporary) as (file, disk):
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["particle_types"] = json.dumps(PARTICLE_TYPES, sort_keys=True)
        for index, trajectory in trajectories:
            group = file.create_group(f"{index:06d}")
            group.create_dataset("position", data=np.ascontiguousarray(trajectory.position, np.float32))
            group.create_dataset("particle_type", data=np.asarray(trajectory.particle_type, np.int8))
            if trajectory.context is not None:
                group.create_dataset("context", data=np.asarray(trajectory.context, np.float32))
            for name in sorted(trajectory.diagnostics):
                group.create_dataset(f"diagnostics/{name}", data=np.asarray(trajectory.diagnostics[name], np.float64))
            meta = {
                "frame_step": float(trajectory.frame_step),
                "radius": float(trajectory.radius),
                "bounds": np.asarray(trajectory.bounds, float).tolist(),
                "scene": trajectory.scene,
                "seed": None if trajectory.seed is None else int(trajectory.seed),
                "simulator": trajectory.simulator,
                "status": trajectory.status,
            }
            # Keys in the scene's own order: particles lie in the order of its materials.
            group.attrs["meta"] = json.dumps(meta)
            disk.check()


def _check(condition: bool, path: Path, key: str, value: object, remedy: str) -> None:
    if not condition:
        raise InputError(path, key, value, remedy)


#: What h5py and NumPy raise on a damaged file, by experiment with flipped bytes.
_DAMAGE = (OSError, KeyError, RuntimeError, TypeError, ValueError, AttributeError, MemoryError, OverflowError)


#: Deflate packs at most 1032 to 1; a file that promises more would fill the memory before it turned out to be damaged.
MOST_PACKED = 1100


def stored(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """A data set that lies in this file and can hold what it promises; anything else is an ``InputError``.

    HDF5 could as well point to any other file of the machine.
    """
    parts = name.split("/")
    links = [file.get("/".join(parts[: k + 1]), getlink=True) for k in range(len(parts))]
    dataset = file.get(name) if all(isinstance(link, h5py.HardLink) for link in links) else None
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual or dataset.shape is None:
        raise InputError(path, name, str(dataset), "must be a data set within the file")
    if dataset.nbytes > MOST_PACKED * dataset.id.get_storage_size():
        raise InputError(path, name, f"{dataset.dtype} {list(dataset.shape)}", "promises more than it holds; copy the file again")
    return dataset


class ShardReader:
    """Lazy reader of one shard; windows are read from disk on demand. Safe on damaged files: every fault is an ``InputError``.

    The handle opens on first use, so a reader can be handed to a worker process.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._meta: dict[int, dict] = {}

    def __getstate__(self) -> dict:
        return {"path": self.path, "_file": None, "_meta": {}}

    @contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """Whatever goes wrong with a damaged file inside is an ``InputError``."""
        try:
            yield
        except InputError:
            raise
        except _DAMAGE as error:
            fault = str(error) or type(error).__name__
            raise InputError(self.path, what, fault, "damaged or incomplete; delete the shard and generate again") from None

    @property
    def file(self) -> h5py.File:
        """The open file. Raises ``InputError`` where it is absent, damaged or of another version."""
        if self._file is None:
            if not self.path.is_file():
                raise InputError(self.path, "file", str(self.path), "no such shard; generate it or correct the path")
            try:
                file = h5py.File(self.path, "r")
            except OSError as error:
                fault = str(error).split("(")[-1].rstrip(")")
                raise InputError(self.path, "file", fault, "not a readable HDF5 file (truncated?); delete it and generate again") from None
            with self._reading("format_version"):
                version = file.attrs.get("format_version")
                remedy = f"this version reads {FORMAT_VERSION}; generate the file again"
                _check(version is not None and int(version) == FORMAT_VERSION, self.path, "format_version", version, remedy)
            self._file = file
        return self._file

    def close(self) -> None:
        """Close the file; reading opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> ShardReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def indices(self) -> list[int]:
        """Trajectory indices in the shard, ascending."""
        with self._reading("groups"):
            names = list(self.file.keys())
        sound = all(name.isascii() and name.isdigit() and len(name) < 19 for name in names)
        _check(sound, self.path, "groups", names, "group names must be trajectory indices")
        return sorted(int(name) for name in names)

    def _group(self, index: int) -> h5py.Group:
        name = f"{index:06d}"
        with self._reading(name):
            if name in self.file:
                group = self.file[name] if isinstance(self.file.get(name, getlink=True), h5py.HardLink) else None
                _check(isinstance(group, h5py.Group), self.path, name, str(group), "must be a group within the file; generate the shard again")
                return group
        raise InputError(self.path, "trajectory", index, f"the shard holds {self.indices()}")

    def meta(self, index: int) -> dict:
        """Frame step, radius, bounds, resolved scene, seed, simulator and status of one trajectory, checked."""
        if index not in self._meta:
            group = self._group(index)
            with self._reading(f"{index:06d}"):
                meta = json.loads(group.attrs["meta"])
                position, kinds = (stored(self.path, self.file, f"{index:06d}/{name}") for name in ("position", "particle_type"))
                bounds = np.asarray(meta["bounds"], float)
                numbers = [float(meta["frame_step"]), float(meta["radius"])]
                meta["seed"] = None if meta["seed"] is None else int(meta["seed"])
                meta["simulator"], str(meta["status"])
                _check(isinstance(meta["scene"], dict), self.path, f"{index:06d}/scene", meta["scene"], "must be a mapping; generate the shard again")
                axes = meta["scene"].get("periodic", [])
                shape, form = position.shape, f"{kinds.dtype} {list(kinds.shape)}"
            sound = len(shape) == 3 and position.dtype == np.float32 and shape[2] in (2, 3) and min(shape) > 0
            _check(sound, self.path, f"{index:06d}/position", f"{position.dtype} {list(shape)}", "must be float32 [frames, particles, 2 or 3]")
            sound = kinds.shape == (shape[1],) and kinds.dtype.kind in "iu"
            _check(sound, self.path, f"{index:06d}/particle_type", form, "must have one integer per particle")
            sound = bounds.shape == (shape[2], 2) and bool((bounds[:, 0] < bounds[:, 1]).all()) and np.abs(bounds).max() < LARGEST
            _check(sound, self.path, f"{index:06d}/bounds", meta["bounds"], "must be finite, [dim][lower, upper] with lower < upper")
            sound = isinstance(axes, list) and all(axis in list(periodic.AXES[: shape[2]]) for axis in axes)
            _check(sound, self.path, f"{index:06d}/scene.periodic", axes, f"must be a list of axes among {', '.join(periodic.AXES[: shape[2]])}")
            sound = all(0 < number < LARGEST for number in numbers)
            _check(sound, self.path, f"{index:06d}/frame_step, radius", numbers, "must be positive and finite")
            self._meta[index] = meta
        return self._meta[index]

    def shape(self, index: int) -> tuple[int, int, int]:
        """(frames, particles, dim)."""
        self.meta(index)
        return self._group(index)["position"].shape

    def period(self, index: int) -> np.ndarray | None:
        """[dim]: see ``sim.periodic``."""
        meta = self.meta(index)
        return periodic.period(meta["scene"], meta["bounds"])

    def positions(self, index: int, start: int = 0, stop: int | None = None, step: int = 1) -> np.ndarray:
        """[frames, particles, dim] float32 of frames ``start:stop:step``."""
        self.meta(index)
        with self._reading(f"{index:06d}/position"):
            return self._group(index)["position"][start:stop:step]

    def particle_type(self, index: int) -> np.ndarray:
        """[particles] int8, ids of ``PARTICLE_TYPES``."""
        self.meta(index)
        with self._reading(f"{index:06d}/particle_type"):
            return self._group(index)["particle_type"][:]

    def context(self, index: int) -> np.ndarray | None:
        """[frames, c] float32, or None."""
        group = self._group(index)
        with self._reading(f"{index:06d}/context"):
            if "context" not in group:
                return None
            context = stored(self.path, self.file, f"{index:06d}/context")
            sound = context.ndim == 2 and len(context) == self.shape(index)[0] and context.shape[1] > 0 and context.dtype.kind == "f"
            _check(sound, self.path, f"{index:06d}/context", f"{context.dtype} {list(context.shape)}", "must be floats [frames, c]")
            return context[:]

    def diagnostics(self, index: int) -> dict[str, np.ndarray]:
        """Name -> [frames] float64."""
        group = self._group(index)
        with self._reading(f"{index:06d}/diagnostics"):
            found = {name: stored(self.path, self.file, f"{index:06d}/diagnostics/{name}") for name in group.get("diagnostics", ())}
            for name, values in found.items():
                sound = values.ndim == 1 and values.dtype.kind in "fiu"
                _check(sound, self.path, f"{index:06d}/diagnostics/{name}", f"{values.dtype} {list(values.shape)}", "must be numbers [frames]")
            return {name: values[:] for name, values in found.items()}

    def read(self, index: int) -> Trajectory:
        """The whole trajectory."""
        meta = self.meta(index)
        return Trajectory(
            position=self.positions(index),
            particle_type=self.particle_type(index),
            frame_step=float(meta["frame_step"]),
            radius=float(meta["radius"]),
            bounds=np.asarray(meta["bounds"], float),
            scene=meta["scene"],
            seed=meta["seed"],
            simulator=meta["simulator"],
            status=meta["status"],
            context=self.context(index),
            diagnostics=self.diagnostics(index),
        )
