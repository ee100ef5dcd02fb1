"""Data sets of other learners, turned into ours: the formats that ``sim.export`` writes, as their own projects publish them.

==============  ==================================================================  ==============================================
format          what is read in the source folder                                   published by
==============  ==================================================================  ==============================================
deepmind        ``metadata.json``, ``<split>.tfrecord``                             learning_to_simulate (Sanchez-Gonzalez 2020)
geoelements     ``metadata.json``, ``<split>.npz``                                  github.com/geoelements/gns
lagrangebench   ``metadata.json``, ``<split>.h5``                                   github.com/tumaer/lagrangebench
==============  ==================================================================  ==============================================

Positions keep their float32 bits (float64 is rounded), types and context are turned back as the export turns them. Statistics are ours, from
the training split; those of ``metadata.json`` are for comparison (``Imported.statistics``). Splits that have no file are not made.

Decision: what a source does not say is asked for or left unknown, not made up. *Gravity* is in none of the formats, and mirroring, ballistic
flight, trivial baselines and heights would be silently wrong without it: it must be given. *Spacing* is ``dx`` in LagrangeBench; elsewhere it is
given or measured (``_measured_spacing``), since it is the unit of errors and grids, not physics. *Seeds*, the cost of the data and bodies
stay unknown (null, none): ``simulator.imported`` of a trajectory says which one of which file it was. The scene is then enough for every learned
model and for no solver, which says so.

Decision: messages of TensorFlow are read by the few lines below. A record is a tree of three kinds of message; the package protobuf would
need their definitions compiled, be one more dependency, and copy every frame.

Files may be damaged or hostile: they run no code, whatever goes wrong with them is an ``InputError``, and the data set is complete or absent. One
trajectory is in memory at a time, and a few copies of it; geoelements' older archives, which are one pickle of all, are in memory whole.
"""

from __future__ import annotations

import json
import math
import pickle
import struct
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from pydantic import BaseModel, Field, ValidationError
from tqdm import tqdm

from sim import __version__, periodic
from sim.errors import InputError, RunError
from sim.export import LEARNER_FORMATS, crc32c, masked
from sim.fields import Finite, Positive
from sim.generate import DEFAULT_SHARD_SIZE, SPLITS, training_statistics
from sim.scene import explain_validation
from sim.trajectory import (
    FORMAT_VERSION,
    KINEMATIC_TYPE,
    MOST_PACKED,
    PARTICLE_TYPES,
    Trajectory,
    atomic_folder,
    stored,
    vacant,
    write_json,
    write_shard,
)  # fmt: skip

#: A statistic of the source that is farther than this from ours, as a share of our standard deviation, is told to the user.
TOLERANCE = 0.01
#: LagrangeBench's fluid, solid wall, moving wall and rigid body by our numbers; it moves neither wall by its model, so both are boundary.
#: Types above keep their numbers, as in its copy of DeepMind's data.
_LAGRANGEBENCH_TYPES = {0: PARTICLE_TYPES["water"], 1: KINEMATIC_TYPE, 2: KINEMATIC_TYPE, 3: PARTICLE_TYPES["rigid"]}
#: Particle types that a learner embeds.
_TYPE_SLOTS = 9


@dataclass(frozen=True)
class Comparison:
    """A statistic of the training split [axes]: as found, as stated by the source (None: it does not say)."""

    name: str
    found: list[float]
    stated: list[float] | None
    deviation: float  # largest |found - stated| over the axes, in standard deviations of the quantity (0 where nothing is stated)


@dataclass(frozen=True)
class Imported:
    """What an import made: trajectories by split, the particle spacing and where it is from, and the statistics side by side."""

    trajectories: dict[str, int]
    spacing: float
    spacing_from: str
    statistics: list[Comparison]

    @property
    def doubtful(self) -> list[Comparison]:
        """The statistics that deviate by more than ``TOLERANCE``."""
        return [entry for entry in self.statistics if not entry.deviation <= TOLERANCE]


class _Metadata(BaseModel):
    """What is read of ``metadata.json``; lengths and seconds of the source. Other keys are nobody's business here."""

    dim: Literal[2, 3]
    bounds: list[tuple[Finite, Finite]]
    default_connectivity_radius: Positive
    dt: Positive
    vel_mean: list[Finite] | None = None
    vel_std: list[Finite] | None = None
    acc_mean: list[Finite] | None = None
    acc_std: list[Finite] | None = None
    context_mean: list[Finite] | None = None
    context_std: list[Finite] | None = None
    # LagrangeBench: particle spacing, solver steps of ``dt`` from frame to frame, what made it.
    dx: Positive | None = None
    write_every: int = Field(1, ge=1)
    periodic_boundary_conditions: list[bool] = []
    solver: str | None = None
    source: object = None  # ours


@dataclass(frozen=True)
class _Source:
    """A folder that is imported: where it is, what its metadata say, what the user says."""

    path: Path
    format: str
    metadata: _Metadata
    gravity: list[float]
    trust_pickle: bool

    @property
    def axes(self) -> list[str]:
        """The periodic ones."""
        if self.format != "lagrangebench":
            return []
        stated = self.metadata.periodic_boundary_conditions
        return [axis for axis, turns in zip(periodic.AXES[: self.metadata.dim], stated, strict=False) if turns]

    @property
    def frame_step(self) -> float:
        steps = self.metadata.write_every if self.format == "lagrangebench" else 1
        return self.metadata.dt * steps

    @property
    def material_number(self) -> str:
        """What geoelements' material property is called: by our own export after what it was, else just so."""
        name = self.metadata.source.get("material_property") if isinstance(self.metadata.source, dict) else None
        return name if isinstance(name, str) else "material_property"


#: position [frames, particles, dim], particle types [particles] or one for all, context [frames, c] or None: as they are in the file.
_Raw = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def import_data(
    source: str | Path, out: str | Path, format: str, *, gravity: Sequence[float], spacing: float | None = None, trust_pickle: bool = False
) -> Imported:
    """Turn the data set in the folder ``source`` (see the module's table) into a data set folder ``out``, which must be new.

    gravity [dim]: length / s^2 of the source; spacing: of its particles, length (None: the source's, or measured); trust_pickle: read
    pickles as well, of which nothing but arrays and numbers is let through. Raises ``InputError`` and ``RunError`` (disk full); there is
    then no ``out``.
    """
    if format not in LEARNER_FORMATS:
        raise InputError("import", "format", format, f"give one of {', '.join(LEARNER_FORMATS)}")
    out, path = vacant(out), Path(source)
    metadata = _read_metadata(path / "metadata.json", format)
    gravity = [float(value) for value in gravity]
    if len(gravity) != metadata.dim or not all(map(math.isfinite, gravity)):
        raise InputError("import", "gravity", gravity, f"must be {metadata.dim} finite numbers, one per axis (length / s^2; zeros for none)")
    if spacing is not None and not (math.isfinite(spacing) and spacing > 0):
        raise InputError("import", "spacing", spacing, "must be a positive length")
    found = _Source(path, format, metadata, gravity, trust_pickle)
    suffix, read = _READERS[format]
    files = {split: path / f"{split}{suffix}" for split in SPLITS if (path / f"{split}{suffix}").exists()}
    if not files:
        raise InputError(path, "source", str(path), f"holds no {', '.join(f'{split}{suffix}' for split in SPLITS)}; correct the folder or the format")
    if spacing is not None:
        spacing_from = "given"
    elif format == "lagrangebench" and metadata.dx is not None:
        spacing_from, spacing = "dx", metadata.dx
    else:
        first = next(iter(files.values()))
        spacing_from, spacing = "measured", _measured_spacing(_first(read(first, found), first, found), found)
    try:
        with atomic_folder(out) as folder:
            splits = {}
            for split, file in files.items():
                runs = (_trajectory(found, file, number, raw, spacing, spacing_from) for number, raw in enumerate(read(file, found)))
                splits[split] = _write_split(folder, split, tqdm(runs, desc=split, unit=" trajectories", disable=None))
                if not splits[split]["ok"]:
                    raise InputError(file, "trajectories", 0, "an empty file; leave it out of the folder")
            train = [folder / name for name in splits["train"]["shards"]] if "train" in splits else []
            statistics = training_statistics(train)
            if statistics and statistics["acceleration_std"] is None:
                remedy = "statistics need a trajectory of three frames with a moving particle"
                raise InputError(files["train"], "frames", statistics["frames"], remedy)
            header = {"format_version": FORMAT_VERSION, "scene": _name(path), "family": {}, "seed": None, "version": __version__}
            content = header | {"shard_size": DEFAULT_SHARD_SIZE, "splits": splits, "statistics": statistics}
            write_json(folder / "dataset.json", content)
    except OSError as error:
        raise RunError(f"{out}: cannot be written: {error.strerror or ' '.join(str(error).split())}") from None
    compared = _comparisons(metadata, statistics) if statistics else []
    return Imported({split: entry["ok"] for split, entry in splits.items()}, spacing, spacing_from, compared)


def _name(path: Path) -> str:
    """The scene's name: that of the folder, which is all there is."""
    return path.resolve().name


def _read_metadata(path: Path, format: str) -> _Metadata:
    try:
        content = json.loads(path.read_text())
    except OSError as error:
        raise InputError(path, "file", error.strerror, "give the folder of a data set with its metadata.json") from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, "file", str(error) or type(error).__name__, "not JSON; copy the file again") from None
    # geoelements' newer sets describe training and rollouts apart.
    if format == "geoelements" and isinstance(content, dict) and isinstance(content.get("train"), dict):
        content = content["train"]
    try:
        metadata = _Metadata.model_validate(content)
    except ValidationError as error:
        raise explain_validation(error, path) from None
    if len(metadata.bounds) != metadata.dim or not all(lower < upper for lower, upper in metadata.bounds):
        raise InputError(path, "bounds", metadata.bounds, f"must be {metadata.dim} pairs, lower < upper")
    for name in ("vel_mean", "vel_std", "acc_mean", "acc_std"):
        value = getattr(metadata, name)
        if value is not None and len(value) != metadata.dim:
            raise InputError(path, name, value, f"must be {metadata.dim} numbers; correct it or leave it out")
    return metadata


def _write_split(folder: Path, split: str, runs: Iterable[Trajectory]) -> dict:
    """Write the shards of a split and return its entry of ``dataset.json``; nobody knows what the trajectories cost."""
    names: list[str] = []
    count = 0

    def numbered() -> Iterator[tuple[int, Trajectory]]:
        nonlocal count
        for run in runs:
            count += 1
            yield count - 1, run

    rest = numbered()
    for head in rest:
        shard = chain([head], islice(rest, DEFAULT_SHARD_SIZE - 1))
        del head  # the shard has it
        names.append(f"{split}/shard-{len(names):05d}.h5")
        write_shard(folder / names[-1], shard)
    return {"trajectories": count, "ok": count, "failed": [], "shards": names, "cost": None}


# --- a trajectory ----------------------------------------------------------------------------------------------------


def _trajectory(source: _Source, file: Path, number: int, raw: _Raw, spacing: float, spacing_from: str) -> Trajectory:
    """Trajectory ``number`` of ``file``, checked."""
    position, kinds, context = _checked(source, file, number, raw)
    metadata = source.metadata
    scene: dict[str, Any] = {
        "name": _name(source.path),
        "dim": metadata.dim,
        "bounds": [list(ends) for ends in metadata.bounds],
        "gravity": source.gravity,
        "frame_step": source.frame_step,
        "frames": len(position),
        "radius": metadata.default_connectivity_radius,
        "spacing": spacing,
    }
    scene |= {"periodic": source.axes} if source.axes else {}
    # Of DeepMind's context nobody says what it is.
    scene |= {"context": [source.material_number]} if context is not None and source.format == "geoelements" else {}
    imported = {"format": source.format, "file": file.name, "number": number, "spacing": spacing_from}
    maker = metadata.solver if source.format == "lagrangebench" and metadata.solver else "unknown"
    return Trajectory(
        position=position,
        particle_type=kinds,
        frame_step=source.frame_step,
        radius=metadata.default_connectivity_radius,
        bounds=np.array(metadata.bounds),
        scene=scene,
        seed=None,
        context=context,
        simulator={"name": maker, "kind": "reference", "settings": {}, "imported": imported, "version": __version__},
    )


def _checked(source: _Source, file: Path, number: int, raw: _Raw) -> _Raw:
    """position float32, types [particles] int8 by our numbers, context float32; raises ``InputError``."""
    position, kinds, context = raw
    dim = source.metadata.dim

    def check(good: bool, key: str, value: object, remedy: str) -> None:
        if not good:
            raise InputError(file, f"{number}/{key}", value, remedy)

    sound = position.ndim == 3 and position.shape[2] == dim and position.size > 0 and position.dtype.kind == "f"
    check(sound, "position", f"{position.dtype} {list(position.shape)}", f"must be floating-point [frames, particles, {dim}], not empty")
    with np.errstate(over="ignore"):
        position = position.astype(np.float32, copy=False)
    check(bool(np.isfinite(position).all()), "position", "non-finite", "a damaged or diverged trajectory; mend the source")
    particles = position.shape[1]
    sound = kinds.dtype.kind in "iu" and kinds.shape in ((), (particles,))
    check(sound, "particle_type", f"{kinds.dtype} {list(kinds.shape)}", f"must be whole numbers, one or {particles}")
    kinds = np.broadcast_to(kinds, particles)
    strange = sorted(set(kinds.tolist()) - set(range(_TYPE_SLOTS)))
    check(not strange, "particle_type", strange, f"must be ids in 0..{_TYPE_SLOTS - 1}")
    kinds = kinds.astype(np.int8)
    if source.format == "lagrangebench":
        kinds = np.array([_LAGRANGEBENCH_TYPES.get(kind, kind) for kind in kinds.tolist()], np.int8)
    if context is not None:
        with np.errstate(over="ignore"):
            context = context.astype(np.float32, copy=False)
        check(context.ndim == 2 and len(context) == len(position), "context", list(context.shape), f"must be [{len(position)}, c]")
        check(bool(np.isfinite(context).all()), "context", "non-finite", "a damaged trajectory; mend the source")
    return position, kinds, context


def _first(raws: Iterator[_Raw], file: Path, source: _Source) -> _Raw:
    """The first trajectory of a file, checked."""
    for raw in raws:
        return _checked(source, file, 0, raw)
    raise InputError(file, "trajectories", 0, "an empty file; leave it out of the folder")


def _measured_spacing(raw: _Raw, source: _Source) -> float:
    """Edge of the cube (square) that a particle fills in the first frame, length: (V / n)^(1 / dim) with n the median over the moving particles of
    sum_j 1 - (r_ij / R)^2, itself included, and V = 2 / (dim + 2) |ball of the connectivity radius R| the integral of that weight.

    Lattices read 3 % off, random clouds up to 10 %; surfaces make it too large, by a tenth in clouds of 500 particles in 2D and 5000 in 3D.
    """
    position, kinds, _ = raw
    dim, radius = source.metadata.dim, source.metadata.default_connectivity_radius
    bounds = np.array(source.metadata.bounds)
    cloud = position[0][kinds != KINEMATIC_TYPE] if (kinds != KINEMATIC_TYPE).any() else position[0]
    tree = periodic.tree(cloud, periodic.period({"periodic": source.axes}, bounds))
    pairs = tree.sparse_distance_matrix(tree, radius, output_type="ndarray")
    number = np.median(np.bincount(pairs["i"], 1 - (pairs["v"] / radius) ** 2))
    ball = math.pi * radius**2 if dim == 2 else 4 / 3 * math.pi * radius**3
    return float(2 / (dim + 2) * ball / number) ** (1 / dim)


# --- statistics ------------------------------------------------------------------------------------------------------


def _comparisons(metadata: _Metadata, statistics: dict) -> list[Comparison]:
    """What the training split has beside what the source states."""
    result = []
    for short, long in {"vel": "velocity", "acc": "acceleration", "context": "context"}.items():
        if f"{long}_std" not in statistics:
            continue
        deviation = np.array(statistics[f"{long}_std"])
        for moment in ("mean", "std"):
            found, stated = statistics[f"{long}_{moment}"], getattr(metadata, f"{short}_{moment}")
            if stated is not None and len(stated) == len(found):
                difference = np.abs(np.subtract(found, stated))
                # An axis without motion has no unit to measure a difference in.
                share = np.divide(difference, deviation, out=np.where(difference > 0, np.inf, 0.0), where=deviation > 0)
                result.append(Comparison(f"{long}_{moment}", found, stated, float(share.max())))
            else:
                result.append(Comparison(f"{long}_{moment}", found, stated, 0.0 if stated is None else math.inf))
    return result


# --- reading ---------------------------------------------------------------------------------------------------------


@contextmanager
def _reading(path: Path, what: object, remedy: str = "damaged, or not of this format; copy the file again or correct the format") -> Iterator[None]:
    """What the readers below, h5py and zipfile raise on damaged and hostile files is open-ended; all of it is an ``InputError``."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(path, str(what), reason, remedy) from None


def _read_tfrecord(path: Path, source: _Source) -> Iterator[_Raw]:
    """Trajectories of a file of TFRecords; layout as in ``sim.export``. A position may also be one value for all frames, as its reader allows."""
    for number, record in enumerate(_records(path)):
        with _reading(path, number):
            context: dict = {}
            lists: dict = {}
            for field, part in _fields(memoryview(record)):
                if field == 1:
                    context |= _entries(part)
                elif field == 2:
                    lists |= _entries(part)
            kinds = np.concatenate([np.frombuffer(value, "<i8") for value in _values(context["particle_type"])])
            shape = (-1, len(kinds), source.metadata.dim)
            position = _floats(lists["position"])
            position = position.reshape(shape if len(position) == 1 else (len(position), *shape[1:]))
            stated = "step_context" in lists or source.metadata.context_mean is not None
            step_context = _floats(lists["step_context"]) if stated else None
        yield position, kinds, step_context


def _records(path: Path) -> Iterator[bytes]:
    """Contents of the records of a TFRecord file: length (uint64), masked CRC-32C of it, content, masked CRC-32C of that. All are checked."""
    with _reading(path, "file"):
        size, number = path.stat().st_size, 0
        with path.open("rb") as file:
            while header := file.read(12):
                if len(header) < 12:
                    raise InputError(path, number, len(header), "the file ends within a record; copy it again")
                length, stated = struct.unpack("<QI", header)
                if masked(crc32c(header[:8])) != stated:
                    raise InputError(path, number, length, "the checksum of this length is wrong: damaged, or not a TFRecord file; copy it again")
                if length + 4 > size - file.tell():
                    raise InputError(path, number, length, "the file ends within a record; copy it again")
                content = file.read(length)
                # Not a message, and shorter than the checksum can be taken of.
                if length < 4 or masked(crc32c(content)) != struct.unpack("<I", file.read(4))[0]:
                    raise InputError(path, number, length, "the checksum of a record is wrong: damaged; copy the file again")
                yield content
                number += 1


def _number(message: memoryview, at: int) -> tuple[int, int]:
    """A varint at ``at`` and where it ends: seven bits a byte, the lowest first, the top bit set in all but the last (protobuf's encoding)."""
    value = 0
    for place in range(10):
        byte = message[at + place]
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value, at + place + 1
    raise ValueError("a number of more than ten bytes")


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(field, content) of every field that holds bytes or a message; numbers are passed over, since none is asked for here."""
    at = 0
    while at < len(message):
        tag, at = _number(message, at)
        field, kind = tag >> 3, tag & 7
        if kind == 0:
            _, at = _number(message, at)
            continue
        if kind == 2:
            length, at = _number(message, at)
        elif kind in (1, 5):
            length = 8 if kind == 1 else 4
        else:
            raise ValueError(f"a field of wire type {kind}")
        if length > len(message) - at:
            raise ValueError("a field runs past the end of its message")
        if kind == 2:
            yield field, message[at : at + length]
        at += length


def _parts(message: memoryview, wanted: int) -> list[memoryview]:
    return [part for field, part in _fields(message) if field == wanted]


def _entries(message: memoryview) -> dict[str, memoryview]:
    """``map<string, message>`` in field 1: key in field 1 and value in field 2 of each pair."""
    return {bytes(_parts(entry, 1)[-1]).decode(): _parts(entry, 2)[-1] for entry in _parts(message, 1)}


def _values(feature: memoryview) -> list[memoryview]:
    """``Feature { bytes_list { value ... } }``"""
    return [value for values in _parts(feature, 1) for value in _parts(values, 1)]


def _floats(feature_list: memoryview) -> np.ndarray:
    """[features, n]: the float32 of a ``FeatureList { feature ... }``."""
    return np.stack([np.frombuffer(value, "<f4") for feature in _parts(feature_list, 1) for value in _values(feature)])


def _read_npz(path: Path, source: _Source) -> Iterator[_Raw]:
    """Trajectories of an archive of pickled object arrays: one (positions, types[, material property]) an entry, or a list of such."""
    with _reading(path, "file"):
        archive = zipfile.ZipFile(path)
    with archive:
        for entry in archive.infolist():
            with _reading(path, entry.filename):
                items = _read_objects(path, archive, entry, source.trust_pickle)
                alone = bool(items) and isinstance(items[0], np.ndarray)
                runs = [items] if alone else items
            for number in range(len(runs)):
                with _reading(path, entry.filename, "must be (positions, types) or (positions, types, material property)"):
                    position, kinds, *rest = runs[number]
                    position, kinds = np.asarray(position), np.asarray(kinds)
                    context = _material_context(position, *rest, source=source) if rest else None
                yield position, kinds, context


def _read_objects(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, trusted: bool) -> list:
    """The items of an object array."""
    if entry.file_size > MOST_PACKED * max(entry.compress_size, 1):
        raise InputError(path, entry.filename, entry.file_size, "promises more than it can hold; copy the file again")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = header(file)
        if kind.kind != "O":
            raise InputError(path, entry.filename, f"{kind} {list(shape)}", "must be an object array of positions and types")
        if not trusted:
            remedy = "is a pickle; give --trust-pickle if you trust where it is from (only arrays and numbers will be let through)"
            raise InputError(path, entry.filename, "object array", remedy)
        return _plain(_ArrayUnpickler(file).load())


def _material_context(position: np.ndarray, value: object, *, source: _Source) -> np.ndarray:
    """[frames, 1]: a trajectory's material property. Our export gives an angle of friction as its tangent, as that project does."""
    values = np.unique(np.asarray(value, float))
    if len(values) != 1:
        raise ValueError(f"{len(values)} material properties in a trajectory, where a context has one for all particles")
    number = float(values[0])
    number = math.degrees(math.atan(number)) if source.material_number.endswith(".friction_angle") else number
    return np.full((len(position), 1), number)


class _Kind:
    """Stands for ``numpy.dtype`` in a pickle."""

    def __init__(self, code: object, *_: object):
        self.code, self.order = str(code), "="

    def __setstate__(self, state: Sequence) -> None:
        self.order = state[1]

    @property
    def dtype(self) -> np.dtype:
        if self.code[:1] not in "fiub" or self.order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"an array of {self.code[:20]}")
        return np.dtype(self.order + self.code)


class _Array:
    """Stands for ``numpy.ndarray`` in a pickle: an empty one, whose shape, type and contents come with its state."""

    value: np.ndarray | list

    def __init__(self, *_: object):
        self.value = []

    def __setstate__(self, state: Sequence) -> None:
        _, shape, kind, fortran, content = state
        if kind.code.startswith("O"):
            rows = int(np.prod(shape[:1])) if len(shape) == 2 else 0
            size = len(content) // rows if rows else 1
            self.value = [content[first : first + size] for first in range(0, len(content), size)] if rows else list(content)
            if fortran and rows > 1:
                raise pickle.UnpicklingError("a table of objects by columns")
        else:
            self.value = np.frombuffer(content, kind.dtype).reshape(shape, order="F" if fortran else "C")


class _Scalar(_Array):
    """Stands for a number of NumPy's in a pickle."""

    def __init__(self, kind: _Kind, content: bytes):
        self.value = np.frombuffer(content, kind.dtype).reshape(())


class _ArrayUnpickler(pickle._Unpickler):
    """Knows arrays of numbers and of objects, and no other name; of NumPy itself nothing is called with what a file says.

    Python's own reader in Python, not in C: that one reserves memory by numbers in the file, which a few hostile bytes would exhaust.
    """

    names = {("numpy", "ndarray"): _Array, ("numpy", "dtype"): _Kind}
    for core in ("numpy.core.multiarray", "numpy._core.multiarray"):
        names |= {(core, "_reconstruct"): _Array, (core, "scalar"): _Scalar}

    def find_class(self, module: str, name: str) -> object:
        if (module, name) in self.names:
            return self.names[module, name]
        raise pickle.UnpicklingError(f"names {module}.{name}, which is no array")


def _plain(item: object) -> Any:
    """Arrays of numbers as they are; of objects, tuples and lists as lists, two levels deep at most, which is all that is asked for."""

    def inner(item: object, depth: int) -> object:
        item = item.value if isinstance(item, _Array) else item
        return [inner(entry, depth - 1) for entry in item] if isinstance(item, list | tuple) and depth else item

    return inner(item, 2)


def _read_lagrangebench(path: Path, source: _Source) -> Iterator[_Raw]:
    """Trajectories of an HDF5 file: groups with ``position`` and ``particle_type``, in the order of their names."""
    with _reading(path, "file"):
        file = h5py.File(path, "r")
    with file:
        with _reading(path, "groups"):
            names = sorted(file)
        for name in names:
            with _reading(path, name):
                position, kinds = (stored(path, file, f"{name}/{key}")[()] for key in ("position", "particle_type"))
            yield position, kinds, None


_READERS = {"deepmind": (".tfrecord", _read_tfrecord), "geoelements": (".npz", _read_npz), "lagrangebench": (".h5", _read_lagrangebench)}
