"""Training windows of a data set: read from HDF5 on demand, in a global shuffle that can be taken up again anywhere.

A *window* is ``frames`` frames of one trajectory, ``stride`` file frames apart. Every window of every trajectory is in the
shuffle (the original's buffer of 512 windows covers less than two trajectories). All velocities and accelerations are finite
differences with dt = 1, as in the released data of Sanchez-Gonzalez et al. (2020).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from learn.parallel import Processes
from sim import periodic
from sim.errors import InputError
from sim.trajectory import KINEMATIC_TYPE, ShardReader, Trajectory

#: A split whose positions fit in this many bytes is kept in memory after its first reading; a larger one stays on disk.
MEMORY_BUDGET = 1 << 30

#: Particle type ids lie in 0 .. TYPE_SLOTS - 1 (the original's embedding has nine slots).
TYPE_SLOTS = 9


class DataSettings(BaseModel):
    """How windows are drawn from a data set."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    stride: int = Field(1, ge=1)  # file frames from one frame of a window to the next
    mirror: bool = False  # flip half of the windows about the box centre, along every axis that gravity does not mark
    # Leave out windows at rest: after the first motion, no particle faster than this share of |velocity std|.
    skip_rest: float = Field(0.0, ge=0)


def _tuple(value: object) -> object:
    return tuple(_tuple(entry) for entry in value) if isinstance(value, (list, tuple)) else value


@dataclass(frozen=True)
class DataSpec:
    """What a model must know of its training data; it travels in every checkpoint.

    dim: 2 or 3; bounds (dim x (lower, upper)), radius, spacing: lengths; frame_step: seconds between *file* frames; stride: file frames
    a model frame spans; gravity [dim]: length / s^2; particle_types: sorted ids present. velocity_* [dim]: length / model frame;
    acceleration_* [dim]: length / model frame^2; both over the moving particles of the training split, std possibly 0 on an axis
    without motion. context_*: [c], or None where the data have no context. periodic: axes ("x", ...) along which the box repeats itself.
    Raises ``ValueError`` on impossible values.
    """

    dim: int
    bounds: tuple[tuple[float, float], ...]
    radius: float
    spacing: float
    frame_step: float
    stride: int
    gravity: tuple[float, ...]
    particle_types: tuple[int, ...]
    velocity_mean: tuple[float, ...]
    velocity_std: tuple[float, ...]
    acceleration_mean: tuple[float, ...]
    acceleration_std: tuple[float, ...]
    context_mean: tuple[float, ...] | None = None
    context_std: tuple[float, ...] | None = None
    periodic: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for entry in fields(self):
            object.__setattr__(self, entry.name, _tuple(getattr(self, entry.name)))

        def integer(value: object) -> bool:
            return isinstance(value, int) and not isinstance(value, bool)

        def number(value: object) -> bool:
            return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)

        def numbers(value: object, length: int | None = None) -> bool:
            return isinstance(value, tuple) and (length is None or len(value) == length) and all(number(entry) for entry in value)

        def check(good: bool, name: str, remedy: str) -> None:
            if not good:
                raise ValueError(f"{name} = {getattr(self, name)!r}: {remedy}")

        check(integer(self.dim) and self.dim in (2, 3), "dim", "must be 2 or 3")
        check(
            isinstance(self.bounds, tuple) and len(self.bounds) == self.dim and all(numbers(b, 2) and b[0] < b[1] for b in self.bounds),
            "bounds",
            "must be dim pairs, lower < upper",
        )
        for name in ("radius", "spacing", "frame_step"):
            check(number(getattr(self, name)) and getattr(self, name) > 0, name, "must be a positive number")
        check(integer(self.stride) and self.stride >= 1, "stride", "must be an integer >= 1")
        for name in ("gravity", "velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std"):
            check(numbers(getattr(self, name), self.dim), name, f"must be {self.dim} finite numbers")
        for name in ("velocity_std", "acceleration_std"):
            check(min(getattr(self, name)) >= 0, name, "must not be negative")
        kinds = self.particle_types
        ids = isinstance(kinds, tuple) and len(kinds) > 0 and all(integer(k) and 0 <= k < TYPE_SLOTS for k in kinds)
        check(ids and list(kinds) == sorted(set(kinds)), "particle_types", f"must be sorted distinct ids in 0..{TYPE_SLOTS - 1}")
        check((self.context_mean is None) == (self.context_std is None), "context_mean", "must be given with context_std or not at all")
        if self.context_mean is not None:
            check(numbers(self.context_mean), "context_mean", "must be finite numbers")
            check(numbers(self.context_std, len(self.context_mean)), "context_std", "must match context_mean")
            check(min(self.context_std or (), default=0) >= 0, "context_std", "must not be negative")
        axes = periodic.AXES[: self.dim]
        sorted_ = isinstance(self.periodic, tuple) and self.periodic == tuple(axis for axis in axes if axis in self.periodic)
        check(sorted_, "periodic", f"must be axes among {', '.join(axes)}, in this order")

    @property
    def period(self) -> np.ndarray | None:
        """[dim]: see ``sim.periodic``."""
        return periodic.period({"periodic": self.periodic}, np.array(self.bounds))

    def to_dict(self) -> dict:
        """JSON-able, without the periodic axes where there are none; ``from_dict`` inverts it exactly."""
        return {name: value for name, value in asdict(self).items() if name != "periodic" or value}

    @classmethod
    def from_dict(cls, content: object, where: object = "data spec") -> DataSpec:
        """Inverse of ``to_dict``; ``where`` names the file in the ``InputError`` that anything malformed raises."""
        names = {entry.name for entry in fields(cls)}
        if not isinstance(content, dict) or set(content) | {"periodic"} != names:
            found = sorted(map(str, content)) if isinstance(content, dict) else content
            raise InputError(where, "spec", found, f"must have exactly the keys {', '.join(sorted(names))}")
        try:
            return cls(**content)
        except (ValueError, TypeError) as error:
            raise InputError(where, "spec", str(error), "not a usable data spec; train the model again") from None


@dataclass
class Windows:
    """A batch of training windows, several trajectories side by side as one graph.

    position [frames, total, dim] float32; particle_type [total] int64; example [total] int64: which window a particle is of, ascending
    from 0; context [frames, examples, c] float32 or None. place: of a batch that several processes share, how many particles come before these, and
    how many there are in all. counted [total] bool: particles there are, where the rest of the rows fill up a fixed shape (``learn.replay``).
    """

    position: torch.Tensor
    particle_type: torch.Tensor
    example: torch.Tensor
    context: torch.Tensor | None = None
    place: tuple[int, int] | None = None
    counted: torch.Tensor | None = None

    @property
    def examples(self) -> int:
        """Graphs in the batch."""
        return int(self.example[-1]) + 1

    def to(self, device: torch.device | str) -> Windows:
        """The same windows on ``device``."""
        context = None if self.context is None else self.context.to(device)
        counted = None if self.counted is None else self.counted.to(device)
        return Windows(self.position.to(device), self.particle_type.to(device), self.example.to(device), context, self.place, counted)


class _Moments:
    """Streaming mean and standard deviation along the rows of [rows, columns] blocks, float64."""

    def __init__(self, columns: int):
        self.count, self.total, self.square = 0, np.zeros(columns), np.zeros(columns)

    def add(self, block: np.ndarray) -> None:
        rows = np.asarray(block, float).reshape(-1, block.shape[-1])
        self.count += len(rows)
        # As products, because NumPy's sum over the first axis of a narrow array is several times slower.
        self.total += np.ones(len(rows)) @ rows
        self.square += np.diag(rows.T @ rows)

    @property
    def mean(self) -> np.ndarray:
        return self.total / max(self.count, 1)

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.maximum(self.square / max(self.count, 1) - self.mean**2, 0))


@contextmanager
def _reading(reader: ShardReader, key: str) -> Iterator[None]:
    """What h5py raises on damaged metadata is open-ended (KeyError, RuntimeError, ...); all of it is a damaged shard."""
    try:
        yield
    except InputError:
        raise
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise InputError(reader.path, key, str(error), "damaged file; delete the shard and generate again") from None


class Dataset:
    """One split of a data set folder (see ``docs/architecture.md``). Every fault of the files is an ``InputError``.

    Trajectories are numbered 0 .. len - 1 in the order of their indices in the split. Trajectories that did not end "ok" are left out.
    """

    def __init__(self, folder: str | Path, split: str, memory: int = MEMORY_BUDGET):
        self.folder, self.split, self.memory = Path(folder), split, memory
        self.path = self.folder / "dataset.json"
        self.content = self._read_content()
        splits = self.content["splits"]
        if split not in splits:
            raise InputError(self.path, "split", split, f"the data set holds {', '.join(sorted(splits)) or 'no split'}")
        shards = splits[split].get("shards") if isinstance(splits[split], dict) else None
        if not isinstance(shards, list) or not all(isinstance(shard, str) for shard in shards):
            raise InputError(self.path, f"splits.{split}.shards", shards, "must be a list of file names; generate the data set again")
        entries = []
        for shard in shards:
            reader = ShardReader(self.folder / shard)
            with _reading(reader, "groups"):
                entries += [(index, reader) for index in reader.indices() if reader.meta(index)["status"] == "ok"]
        entries.sort(key=lambda entry: entry[0])
        if not entries:
            raise InputError(self.path, f"splits.{split}", "no usable trajectory", "generate some")
        self.entries: list[tuple[int, ShardReader]] = entries
        self.shapes = [reader.shape(index) for index, reader in entries]
        self._check_alike()
        self._keep = sum(4 * math.prod(shape) for shape in self.shapes) <= memory
        self._positions: dict[int, np.ndarray] = {}
        self._types: dict[int, np.ndarray] = {}
        self._contexts: dict[int, np.ndarray | None] = {}
        self._speeds: dict[int, np.ndarray] = {}

    def _read_content(self) -> dict:
        if not self.path.is_file():
            raise InputError(self.path, "file", str(self.path), "no such data set; generate it (sluice-sim generate) or correct the path")
        try:
            content = json.loads(self.path.read_text())
        except (ValueError, RecursionError) as error:
            raise InputError(self.path, "file", str(error), "not JSON; generate the data set again") from None
        version = content.get("format_version") if isinstance(content, dict) else None
        if version != 1:
            raise InputError(self.path, "format_version", version, "this version reads 1; generate the data set again")
        if not isinstance(content.get("splits"), dict):
            raise InputError(self.path, "splits", content.get("splits"), "must map split names to shards; generate the data set again")
        return content

    def _check_alike(self) -> None:
        """One model, one box: what ``DataSpec`` holds once must be the same in all trajectories."""
        first: dict[str, Any] | None = None
        for index, reader in self.entries:
            meta, dim = reader.meta(index), reader.shape(index)[2]
            try:
                scene = meta["scene"]
                values: dict[str, Any] = {
                    "dim": dim,
                    "radius": float(meta["radius"]),
                    "frame_step": float(meta["frame_step"]),
                    "bounds": _tuple(meta["bounds"]),
                    "spacing": float(scene["spacing"]),
                    "gravity": tuple(float(g) for g in scene["gravity"]),
                    "periodic": periodic.axes(scene),
                }
                if len(values["gravity"]) != dim:
                    raise ValueError(f"gravity has {len(values['gravity'])} entries")
            except (KeyError, TypeError, ValueError) as error:
                remedy = "must have spacing and gravity [dim]; generate the shard again"
                raise InputError(reader.path, f"{index:06d}/scene", str(error), remedy) from None
            first = first or values
            for name, value in values.items():
                if value != first[name]:
                    remedy = f"the first trajectory of the split has {first[name]}; one data set, one {name}"
                    raise InputError(reader.path, f"{index:06d}/{name}", value, remedy)
        assert first is not None  # there is a trajectory
        self.common, self.period = first, periodic.period(first, np.array(first["bounds"]))

    def __len__(self) -> int:
        return len(self.entries)

    def trajectory(self, number: int) -> Trajectory:
        """The whole trajectory ``number``."""
        index, reader = self.entries[number]
        with _reading(reader, f"{index:06d}"):
            trajectory = reader.read(index)
        self._check_finite(number, trajectory.position)
        return trajectory

    def _check_finite(self, number: int, block: np.ndarray) -> None:
        if not np.isfinite(block).all():
            index, reader = self.entries[number]
            raise InputError(reader.path, f"{index:06d}/position", "non-finite", "damaged data; delete the shard and generate again")

    def particle_type(self, number: int) -> np.ndarray:
        """[particles] int64 of trajectory ``number``."""
        if number not in self._types:
            index, reader = self.entries[number]
            with _reading(reader, f"{index:06d}/particle_type"):
                kinds = reader.particle_type(index).astype(np.int64)
            if kinds.size == 0 or kinds.min() < 0 or kinds.max() >= TYPE_SLOTS:
                found = sorted(set(kinds.tolist()))
                raise InputError(reader.path, f"{index:06d}/particle_type", found, f"must be ids in 0..{TYPE_SLOTS - 1}, one particle at least")
            self._types[number] = kinds
        return self._types[number]

    def context(self, number: int) -> np.ndarray | None:
        """[frames, c] float32 of trajectory ``number``, or None."""
        if number not in self._contexts:
            index, reader = self.entries[number]
            with _reading(reader, f"{index:06d}/context"):
                context = reader.context(index)
            if context is not None and (context.ndim != 2 or len(context) != self.shapes[number][0] or not np.isfinite(context).all()):
                raise InputError(reader.path, f"{index:06d}/context", context.shape, "must be finite, [frames, c]; generate the shard again")
            self._contexts[number] = context
        return self._contexts[number]

    def positions(self, number: int, start: int = 0, stop: int | None = None, step: int = 1) -> np.ndarray:
        """[frames, particles, dim] float32 of frames ``start:stop:step``, checked to be finite; not to be written to."""
        index, reader = self.entries[number]
        if number in self._positions:
            return self._positions[number][start:stop:step]
        with _reading(reader, f"{index:06d}/position"):
            # One contiguous piece: HDF5 reads a strided selection row by row, slower than the frames between.
            block = reader.positions(index) if self._keep else reader.positions(index, start, stop)[::step]
        self._check_finite(number, block)
        if self._keep:
            self._positions[number] = block
            return block[start:stop:step]
        return block

    def statistics(self, stride: int) -> dict[str, np.ndarray]:
        """Mean and std [dim] of v_t = p_t - p_(t-k) and a_t = p_(t+k) - 2 p_t + p_(t-k) over the moving particles of this split, k = ``stride``.

        Streams one trajectory at a time. Raises ``InputError`` where no trajectory has 2 k + 1 frames.
        """
        dim = self.common["dim"]
        velocity, acceleration = _Moments(dim), _Moments(dim)
        for number, (frames, _, _) in enumerate(self.shapes):
            if frames <= 2 * stride:
                continue
            position = periodic.unwrapped(self._moving(number).astype(float), self.period)
            step = position[stride:] - position[:-stride]
            velocity.add(step)
            acceleration.add(step[stride:] - step[:-stride])
        if acceleration.count == 0:
            remedy = f"no trajectory of the {self.split} split has {2 * stride + 1} frames and a moving particle"
            raise InputError(self.path, "data.stride", stride, remedy)
        return {
            "velocity_mean": velocity.mean,
            "velocity_std": velocity.std,
            "acceleration_mean": acceleration.mean,
            "acceleration_std": acceleration.std,
        }

    def _given(self, name: str) -> list[float]:
        """[dim]: a statistic that the generator wrote, at stride 1."""
        statistics, dim = self.content.get("statistics"), self.common["dim"]
        value = statistics.get(name) if isinstance(statistics, dict) else None
        if not isinstance(value, list) or len(value) != dim or not all(isinstance(v, (int, float)) and math.isfinite(v) for v in value):
            raise InputError(self.path, f"statistics.{name}", value, f"must be {dim} finite numbers; generate the data set again")
        return value

    def spec(self, stride: int = 1) -> DataSpec:
        """The data spec at ``stride``; its statistics are the *training* split's, whichever split this is.

        Stride 1 takes the generator's figures from ``dataset.json``; other strides stream the training split once.
        """
        train = self if self.split == "train" else Dataset(self.folder, "train", self.memory)
        if stride == 1:
            names = ("velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std")
            statistics = {name: self._given(name) for name in names}
        else:
            statistics = {name: value.tolist() for name, value in train.statistics(stride).items()}
        kinds, contexts = set(), []
        for number in range(len(train)):
            kinds |= set(train.particle_type(number).tolist())
            contexts.append(train.context(number))
        widths = {None if context is None else context.shape[1] for context in contexts}
        if len(widths) > 1:
            raise InputError(self.path, "context", sorted(map(str, widths)), "must be of one width in all trajectories; generate the data set again")
        context_mean = context_std = None
        if widths != {None}:
            present = [context for context in contexts if context is not None]
            moments = _Moments(present[0].shape[1])
            for context in present:
                moments.add(context)
            context_mean, context_std = moments.mean.tolist(), moments.std.tolist()
        try:
            found = train.common | statistics | {"context_mean": context_mean, "context_std": context_std}
            return DataSpec(stride=stride, particle_types=tuple(sorted(kinds)), **found)
        except ValueError as error:
            raise InputError(self.path, "statistics", str(error), "generate the data set again") from None

    def windows(self, frames: int, stride: int = 1, skip_rest: float = 0.0) -> np.ndarray:
        """[windows, 2] int32: trajectory and first file frame of every window of ``frames`` frames.

        ``skip_rest`` > 0 leaves out the windows in which the largest speed of a moving particle, from one file frame to the next, never
        reaches ``skip_rest`` |velocity std at stride 1|: half of a granular run is rest, which teaches copying. What comes before the
        first motion stays: a model that has not seen bodies start to fall from rest leaves them hanging. Raises ``InputError``
        where no window is left.
        """
        span = (frames - 1) * stride
        floor = skip_rest * float(np.linalg.norm(self._given("velocity_std"))) if skip_rest > 0 else 0.0
        rows = []
        for number, (length, _, _) in enumerate(self.shapes):
            first = np.arange(max(length - span, 0), dtype=np.int32)
            if skip_rest > 0 and span > 0 and len(first):
                moving = self._speed(number) >= floor
                if moving.any():
                    moving[: moving.argmax()] = True
                # A window is kept if any of its ``span`` file steps moves: difference of the running count.
                count = np.concatenate([[0], np.cumsum(moving)])
                first = first[count[first + span] > count[first]]
            rows.append(np.stack([np.full_like(first, number), first], axis=1))
        found = np.concatenate(rows)
        if len(found) == 0:
            longest = max(shape[0] for shape in self.shapes)
            remedy = f"the longest trajectory of the {self.split} split has {longest} frames and no such window: lower stride, history or skip_rest"
            raise InputError(self.path, "window", span + 1, remedy)
        return found

    def _moving(self, number: int) -> np.ndarray:
        """[frames, moving particles, dim] float32, C-contiguous (a mask on the second axis alone leaves the axes swapped in memory)."""
        position, moving = self.positions(number), self.particle_type(number) != KINEMATIC_TYPE
        return position if moving.all() else np.ascontiguousarray(position[:, moving])

    def _speed(self, number: int) -> np.ndarray:
        """[frames - 1]: largest displacement of a moving particle from one file frame to the next."""
        if number not in self._speeds:
            position = self._moving(number)
            step = periodic.shortest(position[1:] - position[:-1], self.period)
            self._speeds[number] = np.sqrt((step**2).sum(2).max(1, initial=0))
        return self._speeds[number]

    def batch(self, rows: np.ndarray, frames: int, stride: int = 1, mirror: np.ndarray | None = None) -> Windows:
        """The windows ``rows`` [examples, 2] (as ``windows`` returns them) as one ``Windows``.

        mirror [examples, dim] bool: flip the window along these axes about the box centre, x -> lower + upper - x. In a periodic box the motion
        goes on through the faces, so that a model may take differences over time as they are.
        """
        blocks, kinds, contexts = [], [], []
        for row, (number, first) in enumerate(np.asarray(rows).tolist()):
            frame = slice(first, first + (frames - 1) * stride + 1, stride)
            if self.period is None:
                block = self.positions(number, frame.start, frame.stop, frame.step)
            else:
                block = periodic.unwrapped(self.positions(number, frame.start, frame.stop), self.period)[:: frame.step]
            if mirror is not None and mirror[row].any():
                block = block.copy()  # never in place: the block may be the stored data
                for axis in np.flatnonzero(mirror[row]):
                    block[..., axis] = np.float32(sum(self.common["bounds"][axis])) - block[..., axis]
            blocks.append(block)
            kinds.append(self.particle_type(number))
            if (context := self.context(number)) is not None:
                contexts.append(context[frame])
        example = np.repeat(np.arange(len(blocks)), [len(kind) for kind in kinds])
        return Windows(
            position=torch.from_numpy(np.concatenate(blocks, axis=1)),
            particle_type=torch.from_numpy(np.concatenate(kinds)),
            example=torch.from_numpy(example),
            context=torch.from_numpy(np.stack(contexts, axis=1)) if contexts else None,
        )


class Sampler:
    """Endless batches in a global shuffle without replacement; its state is four integers.

    Epoch e of seed s is the permutation that ``default_rng([s, e])`` draws over all windows. A batch never spans two epochs: the few
    windows left at the end are dropped. A new window length (a model may lengthen its unrolling as training goes) begins a new epoch.

    A batch has ``batch`` windows, or those of at most so many ``edges``, estimated as particles times the data's mean neighbours; one at least for
    each of ``processes``, of which it then holds this one's share. Raises ``InputError`` for data that cannot be drawn from so.
    """

    def __init__(
        self, dataset: Dataset, settings: DataSettings, batch: int | None, seed: int, edges: int | None = None, processes: Processes | None = None
    ):
        self.dataset, self.settings, self.size, self.seed = dataset, settings, batch, seed
        self.processes, self.edges = processes, edges
        self.least = processes.size if processes else 1
        if edges is not None:
            neighbours = (dataset.content.get("statistics") or {}).get("neighbours")
            if not isinstance(neighbours, (int, float)) or not 0 < neighbours < math.inf:
                raise InputError(dataset.path, "statistics.neighbours", neighbours, "training.edges needs it; generate the data set again")
            self._edges = np.array([shape[1] for shape in dataset.shapes]) * neighbours
        common = dataset.common
        self._flips = np.array([settings.mirror and g == 0 for g in common["gravity"]])
        if settings.mirror and dataset.context(0) is not None:
            raise InputError(dataset.path, "data.mirror", True, "a context cannot be mirrored; switch mirror off")
        self.epoch, self.offset, self.frames = -1, 0, 0
        self._rows, self._order = np.zeros((0, 2), int), np.zeros(0, int)
        self._mirror: np.ndarray | None = None

    def _shuffle(self) -> None:
        generator = np.random.default_rng([self.seed, self.epoch])
        self._order = generator.permutation(len(self._rows))
        self._mirror = (generator.random((len(self._rows), len(self._flips))) < 0.5) & self._flips if self._flips.any() else None

    def _length(self, frames: int) -> None:
        self.frames = frames
        self._rows = self.dataset.windows(frames, self.settings.stride, self.settings.skip_rest)
        if len(self._rows) < (self.size or self.least):
            remedy = f"the {self.dataset.split} split has only {len(self._rows)} windows of {frames} frames"
            raise InputError(self.dataset.path, "training.batch", self.size or self.least, remedy)

    def _pick(self) -> np.ndarray:
        """Windows of the next batch; none where the epoch ends before it is full."""
        if self.size is not None:
            pick = self._order[self.offset : self.offset + self.size]
            return pick if len(pick) == self.size else pick[:0]
        assert self.edges is not None  # where there is no size
        edges = self._edges[self._rows[self._order[self.offset : self.offset + 1 + int(self.edges / self._edges.min()) + self.least], 0]].cumsum()
        count = max(int(np.searchsorted(edges, self.edges, side="right")), self.least)
        return self._order[self.offset : self.offset + count] if count < len(edges) else self._order[:0]

    def next(self, frames: int) -> Windows:
        """The next batch, windows of ``frames`` frames."""
        if frames != self.frames:
            self._length(frames)
            self._begin_epoch()
        pick = self._pick()
        if len(pick) == 0:
            self._begin_epoch()
            pick = self._pick()
            # An epoch that holds no full batch is one.
            pick = pick if len(pick) else self._order
        self.offset += len(pick)
        rows, mirror = self._rows[pick], None if self._mirror is None else self._mirror[pick]
        if self.processes is None or self.least == 1:
            return self.dataset.batch(rows, frames, self.settings.stride, mirror)
        mine, counts = self.processes.share(rows), [self.dataset.shapes[number][1] for number in rows[:, 0]]
        windows = self.dataset.batch(rows[mine], frames, self.settings.stride, None if mirror is None else mirror[mine])
        return replace(windows, place=(sum(counts[: mine.start]), sum(counts)))

    def _begin_epoch(self) -> None:
        self.epoch, self.offset = self.epoch + 1, 0
        self._shuffle()

    def state(self) -> dict[str, int]:
        """JSON-able; ``restore`` continues from it bitwise."""
        return {"seed": self.seed, "epoch": self.epoch, "offset": self.offset, "frames": self.frames}

    def restore(self, state: dict[str, int]) -> None:
        """Continue from ``state``."""
        self.seed, self.epoch, self.offset = state["seed"], state["epoch"], state["offset"]
        if state["frames"] > 0:
            self._length(state["frames"])
            self._shuffle()
