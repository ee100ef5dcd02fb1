"""Trajectories in other programs' formats, for viewers and for other learners.

==============  ======================================================================  ================================
format          what is written below ``out``                                           read by
==============  ======================================================================  ================================
vtkhdf          ``<split>/<index>.vtkhdf``, one moving PolyData a trajectory            ParaView, VTK 9.3 or later
ply, vtu        ``<split>/<index>/frame-<frame>.ply``, one file a frame (meshio)        most viewers of points
geoelements     ``<split>.npz``, ``metadata.json``                                      github.com/geoelements/gns
deepmind        ``<split>.tfrecord``, ``metadata.json``                                 learning_to_simulate (TensorFlow)
lagrangebench   ``<split>.h5``, ``metadata.json``                                       github.com/tumaer/lagrangebench
==============  ======================================================================  ================================

Positions keep their float32 bits everywhere; viewers get z = 0 in 2D, and velocities [length / s]. Failed trajectories are in no
export. Layouts are taken from what reads them: VTK's specification and ``vtkHDFReader``; ``gns/data_loader.py`` and ``gns/train.py`` of
geoelements; ``learning_to_simulate/reading_utils.py`` and the message definitions of TensorFlow (``example.proto``, ``feature.proto``);
``lagrangebench/data/data.py`` and that project's own converter of DeepMind's data (``tfrecord_to_h5.py``).

A context goes where its reader looks for one. deepmind: all of it (``step_context``). vtkhdf: all of it, as field data of each step.
geoelements: a lone material number (its ``material_property``, constant in time), but no container's acceleration. lagrangebench, ply and
vtu have no place: LagrangeBench's reader takes positions and types, and a force there is a function of place alone in the code of a data set.

Decision: what has no place is left out and named (``Exported.left_out``, ``source`` of ``metadata.json``, a line of the command), not
refused: the motion is as true without it, for viewers and for learners that are to do without.

Decision: the folder is made under a temporary name and renamed at the end, so that an export is complete or absent. Trajectories
pass one by one; memory is a few times the largest.
"""

from __future__ import annotations

import math
import pickle
import struct
import zipfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim import __version__, periodic
from sim.errors import InputError, RunError
from sim.generate import SPLITS, read_content
from sim.trajectory import ShardReader, atomic_folder, new_hdf5, vacant, write_json

VIEWER_FORMATS = ("vtkhdf", "ply", "vtu")
LEARNER_FORMATS = ("geoelements", "deepmind", "lagrangebench")
FORMATS = VIEWER_FORMATS + LEARNER_FORMATS

#: Particle types that other learners embed: DeepMind's nine slots, which the two others kept.
_TYPE_SLOTS = 9
#: LagrangeBench calls 1 and 2 walls and moves everything else: our boundary (3) becomes its solid wall (1), our rigid (0) its rigid
#: body (3); the others keep their numbers, as in its own copy of DeepMind's data.
_LAGRANGEBENCH_TYPES = {0: 3, 3: 1}
#: A protobuf message of 2 GiB cannot be parsed; the rest of a record is far below a MiB.
_MESSAGE_LIMIT = 2**31 - 2**20
#: Rows of a VTKHDF file that are written at once: some MiB, so that time goes into the disk and not into calls.
_BLOCK = 2**18


@dataclass
class Exported:
    """What an export holds: trajectories by split ("" for a lone shard), and what it leaves out: (split, index, status) of the failed ones,
    and the parts of the context that the format has no place for."""

    trajectories: dict[str, int] = field(default_factory=dict)
    failed: list[tuple[str, int, str]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Source:
    """A data set folder or a lone shard: content of ``dataset.json`` or None, shards by split."""

    path: Path
    content: dict | None
    shards: dict[str, list[Path]]


def export(
    source: str | Path, out: str | Path, format: str, *, split: str | None = None, index: int | None = None, frames: str | None = None
) -> Exported:
    """Write a data set folder (all its splits or one) or, for viewers, a shard into the new folder ``out`` (see the module's table).

    index: of one trajectory within its split or shard; frames: ``"start:stop:step"`` as in Python, or one number (default: all);
    both are for viewers only, since a learner's format takes whole trajectories and its metadata counts their frames.
    Raises ``InputError`` and ``RunError`` (disk full); there is then no ``out``.
    """
    if format not in FORMATS:
        raise InputError("sluice-sim export", "format", format, f"give one of {', '.join(FORMATS)}")
    out = vacant(out)
    viewer = format in VIEWER_FORMATS
    for key, value in {"index": index, "frames": frames}.items():
        if value is not None and not viewer:
            raise InputError("sluice-sim export", key, value, f"{format} takes whole trajectories of a split; leave it out")
    chosen = _slice(frames) if frames is not None else slice(None)
    found = _source(Path(source), split)
    if not viewer and found.content is None:
        raise InputError(source, "source", str(source), f"{format} needs a data set folder, with the statistics of its training split")
    exported = _survey(found, format, index, chosen)
    # Everything that can be wrong with the request is found before anything is written.
    metadata = None if viewer else _metadata(found, format, exported)
    try:
        with atomic_folder(out) as folder:
            if viewer:
                for name, reader, number in _trajectories(found, index):
                    _write_for_viewers(folder / name / f"{number:06d}", format, reader, number, chosen)
            else:
                for name in found.shards:
                    suffix, write = _LEARNERS[format]
                    write(folder / f"{name}{suffix}", _Split(found, name))
                write_json(folder / "metadata.json", metadata)
    except OSError as error:
        raise RunError(f"{out}: cannot be written: {error.strerror or ' '.join(str(error).split())}") from None
    return exported


def _slice(text: str) -> slice:
    """``"start:stop:step"`` (each part optional, forwards only: time runs so) or one frame number."""
    try:
        if ":" not in text:
            frame = int(text)
            return slice(frame, frame + 1 or None)
        parts = [int(part) if part.strip() else None for part in text.split(":")]
        chosen = slice(*parts)
        if chosen.step is None or chosen.step > 0:
            return chosen
    except (TypeError, ValueError):
        pass
    raise InputError("sluice-sim export", "frames", text, "give start:stop:step, each part optional, step above 0, or one frame number")


# --- what there is to export -----------------------------------------------------------------------------------------


def _source(path: Path, split: str | None) -> _Source:
    if not path.is_dir():
        if split is not None:
            raise InputError(path, "split", split, "a shard has no splits; leave it out or give the data set's folder")
        return _Source(path, None, {"": [path]})
    content = read_content(path)
    splits = content["splits"]
    finished = [name for name in SPLITS if name in splits]
    if not finished or split not in (None, *finished):
        remedy = f"the data set holds {', '.join(finished) or 'no finished split'}; generate what is missing"
        raise InputError(path / "dataset.json", "split", split, remedy)
    return _Source(path, content, {name: [path / shard for shard in splits[name]["shards"]] for name in ([split] if split else finished)})


def _trajectories(source: _Source, index: int | None = None, split: str | None = None) -> Iterator[tuple[str, ShardReader, int]]:
    """(split, reader, index) of every good trajectory, or of those numbered ``index``, in the order of the shards; one file is open at a time."""
    for name, shards in source.shards.items():
        for path in shards if split in (None, name) else []:
            with ShardReader(path) as reader:
                for number in reader.indices():
                    if index in (None, number) and reader.meta(number)["status"] == "ok":
                        yield name, reader, number


def _survey(source: _Source, format: str, index: int | None, chosen: slice) -> Exported:
    """Count what will be exported and list what will not; raises ``InputError`` where a split or a selection of frames would be empty."""
    exported = Exported(dict.fromkeys(source.shards, 0))
    for name, shards in source.shards.items():
        if source.content is not None:
            exported.failed += [(name, failure["index"], failure["status"]) for failure in source.content["splits"][name]["failed"]]
        for path in shards:
            with ShardReader(path) as reader:
                for number in reader.indices():
                    status, frames = reader.meta(number)["status"], reader.shape(number)[0]
                    if status != "ok":
                        exported.failed.append((name, number, status))
                    elif index in (None, number):
                        exported.trajectories[name] += 1
                        context = _context(reader, number)
                        exported.left_out += [part for part in context if part not in exported.left_out and not _carries(format, context, part)]
                        if not range(frames)[chosen]:
                            raise InputError(path, f"{number:06d}/frames", frames, "the selection of frames is empty; give another --frames")
    if index is not None:
        exported.failed = [failure for failure in exported.failed if failure[1] == index]
        exported.trajectories = {name: count for name, count in exported.trajectories.items() if count}
        if not exported.trajectories:
            why = exported.failed[0][2] if exported.failed else "no such trajectory"
            raise InputError(source.path, "index", index, f"{why}; give another")
        return exported
    for name, count in exported.trajectories.items():
        where, key = (source.path, "trajectories") if source.content is None else (source.path / "dataset.json", f"splits.{name}")
        if not count:
            raise InputError(where, key, "no good trajectory", "there is nothing to export; generate some")
        if source.content is not None and count != source.content["splits"][name]["ok"]:
            raise InputError(where, f"{key}.ok", source.content["splits"][name]["ok"], f"the shards hold {count}; see sluice-sim validate")
    return exported


# --- context ---------------------------------------------------------------------------------------------------------

#: What a context holds beside the material numbers: of a shaken box; of a scene that does not say what its context is.
_ACCELERATION, _UNKNOWN = "container_acceleration", "context"


def _context(reader: ShardReader, number: int) -> dict[str, np.ndarray]:
    """A trajectory's context by what it is, [frames, columns] float32: the container's acceleration, material numbers as their scene names them."""
    context = reader.context(number)
    if context is None:
        return {}
    dim, scene = reader.shape(number)[2], reader.meta(number)["scene"]
    columns = {_ACCELERATION: dim} if scene.get("container") else {}
    columns |= dict.fromkeys(scene.get("context") or [], 1)
    if sum(columns.values()) != context.shape[1]:
        columns = {_UNKNOWN: context.shape[1]}
    ends = np.cumsum(list(columns.values()))
    return {name: context[:, end - width : end] for (name, width), end in zip(columns.items(), ends, strict=True)}


def _carries(format: str, context: Collection[str], part: str) -> bool:
    """Whether a format has a place for this part of a context."""
    return format in ("vtkhdf", "deepmind") or (format == "geoelements" and part == _material_number(context))


def _material_number(context: Collection[str]) -> str | None:
    """The only material number of a context, if it has just one."""
    numbers = [name for name in context if name not in (_ACCELERATION, _UNKNOWN)]
    return numbers[0] if len(numbers) == 1 else None


# --- viewers ---------------------------------------------------------------------------------------------------------


def _write_for_viewers(stem: Path, format: str, reader: ShardReader, number: int, chosen: slice) -> None:
    """One trajectory: ``stem`` with the suffix, or a folder ``stem`` of frames."""
    position, kinds = reader.positions(number), reader.particle_type(number).astype(np.int32)
    period = reader.period(number)
    step = float(reader.meta(number)["frame_step"])
    frames = range(len(position))[chosen]
    if format == "vtkhdf":
        stem.parent.mkdir(exist_ok=True)
        _write_vtkhdf(stem.with_name(f"{stem.name}.vtkhdf"), position, kinds, _context(reader, number), step, frames, period)
    else:
        stem.mkdir(parents=True)
        _write_frames(stem, format, position, kinds, step, frames, period)


def _in_space(rows: np.ndarray) -> np.ndarray:
    """[..., dim] to [..., 3]: z = 0 in 2D."""
    return np.concatenate([rows, np.zeros((*rows.shape[:-1], 3 - rows.shape[-1]), rows.dtype)], axis=-1)


def velocities(position: np.ndarray, frames: Sequence[int], frame_step: float, period: np.ndarray | None = None) -> np.ndarray:
    """[len(frames), particles, dim] float32 [length / s] of ``position`` [frames, particles, dim]: backward differences, forward at frame 0,
    by nearest images in a periodic box."""
    if len(position) < 2:
        return np.zeros((len(frames), *position.shape[1:]), np.float32)
    later = np.maximum(frames, 1)
    return (periodic.shortest(position[later].astype(np.float64) - position[later - 1], period) / frame_step).astype(np.float32)


def _write_vtkhdf(
    path: Path, position: np.ndarray, kinds: np.ndarray, context: dict[str, np.ndarray], frame_step: float, frames: range, period: np.ndarray | None
) -> None:
    """A transient PolyData of vertices: points and velocities of all steps one after another, all else once. The context is field data.

    Offsets say where a step begins in each array (VTKHDF 2.0, "Temporal data"); zero where steps share it. They share even the one
    part: VTK 9.3 (ParaView 5.12) cannot read vertices that several parts share.
    """
    count, particles = len(frames), position.shape[1]
    moving, shared = np.arange(count) * particles, np.zeros(count, np.int64)
    with new_hdf5(path) as (file, disk):
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([2, 0], np.int64)
        root.attrs["Type"] = np.bytes_("PolyData")  # VTK reads ASCII of fixed length only
        arrays = {"NumberOfPoints": np.array([particles]), "PointData/particle_type": kinds}
        for name in ("Vertices", "Lines", "Polygons", "Strips"):
            cells = particles if name == "Vertices" else 0
            arrays |= {f"{name}/NumberOfCells": np.array([cells]), f"{name}/NumberOfConnectivityIds": np.array([cells])}
            arrays |= {f"{name}/Offsets": np.arange(cells + 1), f"{name}/Connectivity": np.arange(cells)}
        root.create_group("Steps").attrs["NSteps"] = count
        arrays |= {
            "Steps/Values": np.array([frame * frame_step for frame in frames]),
            "Steps/PartOffsets": shared,
            "Steps/NumberOfParts": np.ones(count, np.int64),
            "Steps/PointOffsets": moving,
            "Steps/PointDataOffsets/velocity": moving,
            "Steps/PointDataOffsets/particle_type": shared,
            "Steps/CellOffsets": np.zeros((count, 4), np.int64),
            "Steps/ConnectivityIdOffsets": np.zeros((count, 4), np.int64),
        }
        for name, rows in context.items():
            rows = _in_space(rows) if name == _ACCELERATION else rows
            arrays |= {f"FieldData/{name}": rows[np.asarray(frames)], f"Steps/FieldDataOffsets/{name}": np.arange(count)}
        for name, array in arrays.items():
            # Not ``root[name] = array``: HDF5 would write the time of day into groups on the way.
            root.create_dataset(name, data=array)
        points = root.create_dataset("Points", (count * particles, 3), np.float32)
        speeds = root.create_dataset("PointData/velocity", (count * particles, 3), np.float32)
        block = max(1, _BLOCK // max(particles, 1))
        for first in range(0, count, block):
            some = frames[first : first + block]
            block_rows = slice(first * particles, (first + len(some)) * particles)
            points[block_rows] = _in_space(position[some]).reshape(-1, 3)
            speeds[block_rows] = _in_space(velocities(position, some, frame_step, period)).reshape(-1, 3)
            disk.check()


def _write_frames(
    folder: Path, format: str, position: np.ndarray, kinds: np.ndarray, frame_step: float, frames: range, period: np.ndarray | None
) -> None:
    """``frame-00000.ply`` (or .vtu) and so on, numbered as in the trajectory. meshio's PLY holds scalars only: velocity_x, _y, _z."""
    import meshio

    vertices = [] if format == "ply" else [("vertex", np.arange(len(kinds))[:, None])]
    for frame in frames:
        speed = _in_space(velocities(position, [frame], frame_step, period)[0])
        data = dict(zip(("velocity_x", "velocity_y", "velocity_z"), speed.T, strict=True)) if format == "ply" else {"velocity": speed}
        mesh = meshio.Mesh(_in_space(position[frame]), vertices, point_data={"particle_type": kinds} | data)
        mesh.write(folder / f"frame-{frame:05d}.{format}", file_format=format)


# --- other learners --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Split:
    """The trajectories of one split, read from disk one by one: (position [frames, particles, dim] f32, types [particles], context)."""

    source: _Source
    name: str

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]]:
        for _, reader, number in _trajectories(self.source, split=self.name):
            yield reader.positions(number), reader.particle_type(number), _context(reader, number)


def _metadata(source: _Source, format: str, exported: Exported) -> dict:
    """``metadata.json``, whose figures hold for every trajectory of every split; raises ``InputError`` where there are no such figures.

    Statistics are those of ``dataset.json``: finite differences per frame (dt = 1) over the moving particles of the training
    split. ``source`` is ours, for the record: no reader asks for it.
    """
    first: dict = {}
    most, content = 0, source.content or {}
    for _, reader, number in _trajectories(source):
        values = _common(reader, number, format)
        first = first or values
        for key, value in values.items():
            if value != first[key]:
                raise InputError(reader.path, f"{number:06d}/{key}", value, f"the first trajectory has {first[key]}; metadata.json has one for all")
        most = max(most, reader.shape(number)[1])
    metadata = {
        "bounds": first["bounds"],
        # DeepMind's reader adds one to it; the other two call the number of frames so.
        "sequence_length": first["frames"] - 1 if format == "deepmind" else first["frames"],
        "default_connectivity_radius": first["radius"],
        "dim": first["dim"],
        "dt": first["frame_step"],
        "source": {
            "generator": f"sluice {__version__}",
            "scene": content["scene"],
            "seed": content["seed"],
            "trajectories": exported.trajectories,
            "failed": {name: [number for split, number, _ in exported.failed if split == name] for name in source.shards},
            "left_out": exported.left_out,
        },
    }
    statistics = content.get("statistics")
    if not isinstance(statistics, dict):
        remedy = "metadata.json holds the statistics of the training split; generate that split"
        raise InputError(source.path / "dataset.json", "statistics", statistics, remedy)
    kinds = {"vel": ("velocity", first["dim"]), "acc": ("acceleration", first["dim"])}
    if first.get("context") is not None:
        kinds["context"] = ("context", first["context"])
    for short, (long, size) in kinds.items():
        for moment in ("mean", "std"):
            value = statistics.get(f"{long}_{moment}")
            if not isinstance(value, list) or len(value) != size or not all(isinstance(x, int | float) and math.isfinite(x) for x in value):
                remedy = f"must be {size} finite numbers; generate the data set again"
                raise InputError(source.path / "dataset.json", f"statistics.{long}_{moment}", value, remedy)
            metadata[f"{short}_{moment}"] = value
    if first.get("material_property") is not None:
        # Inputs of its network: five velocities, distances to the walls, embedded type, material number; an edge's vector and length.
        metadata |= {"nnode_in": 7 * first["dim"] + 17, "nedge_in": first["dim"] + 1}
        metadata["source"]["material_property"] = first["material_property"]
    if format == "lagrangebench":
        counts = exported.trajectories
        metadata |= {
            "dx": first["spacing"],
            "write_every": 1,
            "num_particles_max": most,
            "sequence_length_train": first["frames"],
            "num_trajs_train": counts.get("train", 0),
            "sequence_length_test": first["frames"],
            "num_trajs_test": counts.get("test", 0),
            "periodic_boundary_conditions": first["periodic"],
        }
    return metadata


def _common(reader: ShardReader, number: int, format: str) -> dict:
    """What ``metadata.json`` says of one trajectory; raises ``InputError`` where the format has no room for it."""
    meta, (frames, particles, dim) = reader.meta(number), reader.shape(number)
    kinds = set(np.unique(reader.particle_type(number)).tolist())
    strange = sorted(kind for kind in kinds if not 0 <= kind < _TYPE_SLOTS or (format == "lagrangebench" and kind in (1, 2)))
    if strange or not kinds:
        raise InputError(reader.path, f"{number:06d}/particle_type", strange or None, f"not particle types that {format} knows; give another format")
    values = {"dim": dim, "bounds": meta["bounds"], "radius": float(meta["radius"]), "frame_step": float(meta["frame_step"]), "frames": frames}
    axes = meta["scene"].get("periodic", []) if isinstance(meta["scene"], dict) else []
    if format == "deepmind":
        if 4 * frames * particles * dim > _MESSAGE_LIMIT:
            raise InputError(reader.path, f"{number:06d}/position", (frames, particles, dim), "its records are below 2 GiB; give another format")
        values["context"] = sum(part.shape[1] for part in _context(reader, number).values()) or None
    if format == "geoelements":
        values["material_property"] = _material_number(_context(reader, number))
    if format == "lagrangebench":
        spacing = meta["scene"].get("spacing") if isinstance(meta["scene"], dict) else None
        if not isinstance(spacing, int | float) or not spacing > 0:
            raise InputError(reader.path, f"{number:06d}/scene.spacing", spacing, "must be the spacing of the particles; generate the shard again")
        values["spacing"] = spacing
        # Three in 2D as well: its neighbour search asks for so many.
        values["periodic"] = [axis in axes for axis in periodic.AXES]
    elif axes:
        remedy = f"{format} knows walls all around, and would read jumps through the box; give lagrangebench"
        raise InputError(reader.path, f"{number:06d}/scene.periodic", axes, remedy)
    return values


def _write_npz(path: Path, trajectories: _Split) -> None:
    """An archive of one object array (positions [T, N, d] float32, types [N] int64) a trajectory: the entries of ``np.savez``.

    A lone material number of the context is a third, [N] float32. Its reader feeds it to the network as it is; a friction angle is
    therefore given as its tangent, as that project gives it. The format has particle counts that vary and therefore pickles. These name
    ``numpy.ndarray`` and ``numpy.dtype`` only, where NumPy 2 by itself would name a private module that NumPy 1 lacks.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for number, (position, kinds, context) in enumerate(trajectories):
            arrays = [position, kinds.astype(np.int64)]
            if (name := _material_number(context)) is not None:
                value = context[name][0, 0]
                value = np.tan(np.radians(value)) if name.endswith(".friction_angle") else value
                arrays.append(np.full(len(kinds), value, np.float32))
            entries = np.empty(len(arrays), object)
            for slot, array in enumerate(arrays):
                entries[slot] = array
            # ZipInfo without a date: the same bytes each time.
            with archive.open(zipfile.ZipInfo(f"simulation_{number}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array_header_1_0(entry, {"descr": "|O", "fortran_order": False, "shape": entries.shape})
                _ArrayPickler(entry, protocol=4).dump(entries)


class _ArrayPickler(pickle.Pickler):
    def reducer_override(self, item: object) -> Any:
        if type(item) is np.ndarray:
            return np.ndarray, ((0,), "b"), item.__reduce__()[2]  # an empty array that takes on shape, type and contents
        return NotImplemented


def _write_tfrecord(path: Path, trajectories: _Split) -> None:
    """One ``SequenceExample`` a trajectory, framed as TFRecord: length (uint64), masked CRC of it, message, masked CRC of the message.

    Context ``key`` (number in the file) and ``particle_type`` (bytes of int64 [N]); a list of a feature a frame: ``position``
    (bytes of float32 [N, d]) and, where there is one, ``step_context`` (bytes of float32 [c]).
    """
    with path.open("wb") as file:
        for number, (position, kinds, context) in enumerate(trajectories):
            features = {"key": _field(3, _field(1, _varint(number))), "particle_type": _bytes_feature(kinds.astype("<i8"))}
            arrays = {"position": position} | ({"step_context": np.concatenate([*context.values()], axis=1)} if context else {})
            lists = {name: b"".join(_field(1, _bytes_feature(frame.astype("<f4"))) for frame in frames) for name, frames in arrays.items()}
            message = _field(1, _map(features)) + _field(2, _map(lists))
            length = struct.pack("<Q", len(message))
            file.write(length + struct.pack("<I", masked(crc32c(length))))
            file.write(message)
            file.write(struct.pack("<I", masked(crc32c(message))))


def _varint(number: int) -> bytes:
    """A natural number in groups of seven bits, the lowest first, the top bit set in all but the last (protobuf's encoding)."""
    groups = bytearray()
    while number > 0x7F:
        groups.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*groups, number])


def _field(number: int, content: bytes) -> bytes:
    """A protobuf field of bytes, of a message or of packed numbers: tag (wire type 2), length, content."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _bytes_feature(array: np.ndarray) -> bytes:
    """``Feature { bytes_list { value } }``"""
    return _field(1, _field(1, array.tobytes()))


def _map(entries: dict[str, bytes]) -> bytes:
    """``map<string, message>``: one message a pair, key in field 1 and value in field 2."""
    return b"".join(_field(1, _field(1, name.encode()) + _field(2, value)) for name, value in entries.items())


def masked(crc: int) -> int:
    """TFRecord's masked CRC: turned right by 15 bits, plus a constant."""
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _crc_tables() -> list[np.ndarray]:
    """Table k [256]: what a byte becomes after k further bytes of zeros."""
    register: np.ndarray = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        register = register >> 1 ^ np.where(register & 1, np.uint32(0x82F63B78), np.uint32(0))
    tables = [register]
    for _ in range(3):
        tables.append(tables[0][tables[-1] & 255] ^ tables[-1] >> 8)
    return tables


_TABLES = _crc_tables()


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli; RFC 3720) of at least four bytes.

    A CRC is linear over GF(2), so ``lanes`` pieces of equal length are run side by side and joined in pairs: the register of
    A followed by B is that of A after as many zeros as B is long, plus (xor) that of B. What zeros do is read off 32 more lanes that
    see nothing else and start from one bit each. A loop over bytes would take longer than the simulation did.
    """
    lanes = 1 << max(0, len(data).bit_length() // 2 - 1)
    words = -(-len(data) // (4 * lanes))
    # Zeros ahead leave a register of zero as it is; the usual start from all ones is to flip the first four bytes.
    padded = np.zeros(4 * lanes * words, np.uint8)
    start = len(padded) - len(data)
    padded[start:] = np.frombuffer(data, np.uint8)
    padded[start : start + 4] ^= 255
    bits = np.arange(32, dtype=np.uint32)
    register = np.concatenate([np.zeros(lanes, np.uint32), np.uint32(1) << bits])
    for word in np.ascontiguousarray(padded.view("<u4").reshape(lanes, words).T):
        register[:lanes] ^= word
        byte = register.view(np.uint8).reshape(-1, 4)
        register = _TABLES[3][byte[:, 0]] ^ _TABLES[2][byte[:, 1]] ^ _TABLES[1][byte[:, 2]] ^ _TABLES[0][byte[:, 3]]
    register, zeros = register[:lanes], register[lanes:]

    def after_zeros(values: np.ndarray) -> np.ndarray:
        return np.bitwise_xor.reduce((values[:, None] >> bits & 1) * zeros, axis=1)

    while len(register) > 1:
        register, zeros = after_zeros(register[::2]) ^ register[1::2], after_zeros(zeros)
    return int(register[0]) ^ 0xFFFFFFFF


def _write_lagrangebench(path: Path, trajectories: _Split) -> None:
    """Groups ``00000`` and so on without a gap, each ``position`` [T, N, d] float32 and ``particle_type`` [N] int32.

    Uncompressed and contiguous, since windows are read. The format has no place for a context.
    """
    with new_hdf5(path) as (file, disk):
        for number, (position, kinds, _) in enumerate(trajectories):
            group = file.create_group(f"{number:05d}")
            group.create_dataset("position", data=position)
            group.create_dataset("particle_type", data=[_LAGRANGEBENCH_TYPES.get(kind, kind) for kind in kinds.tolist()], dtype=np.int32)
            disk.check()


_LEARNERS: dict[str, tuple[str, Callable[[Path, _Split], None]]] = {
    "geoelements": (".npz", _write_npz),
    "deepmind": (".tfrecord", _write_tfrecord),
    "lagrangebench": (".h5", _write_lagrangebench),
}
