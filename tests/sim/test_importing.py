"""Imports: what others' own writers made is read bit for bit, our exports come back, and no damaged or hostile file does any harm."""

import json
import os
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from tfrecord.writer import TFRecordWriter

from sim.errors import InputError, RunError
from sim.export import LEARNER_FORMATS, crc32c, export, masked
from sim.generate import training_statistics
from sim.importing import import_data
from sim.info import faults, info_text
from sim.trajectory import ShardReader, Trajectory, write_json, write_shard

SAMPLE = Path(__file__).parents[1] / "data/lagrangebench_lj"
METADATA = {"dim": 2, "bounds": [[0.0, 1.0], [0.0, 2.0]], "sequence_length": 5, "default_connectivity_radius": 0.25, "dt": 0.5}
SUFFIXES = {"deepmind": "tfrecord", "geoelements": "npz", "lagrangebench": "h5"}


def motion(seed=0, frames=6, particles=4, dim=2):
    return np.random.default_rng(seed).uniform(0.1, 0.9, (frames, particles, dim)).astype(np.float32)


def describe(folder, **changes):
    folder.mkdir(exist_ok=True)
    (folder / "metadata.json").write_text(json.dumps(METADATA | changes))
    return folder


def read(out, split="train"):
    found = {}
    for path in sorted((out / split).glob("*.h5")):
        with ShardReader(path) as reader:
            found |= {index: reader.read(index) for index in reader.indices()}
    return [found[index] for index in range(len(found))]


def same_bits(found, wanted):
    assert found.dtype == wanted.dtype and found.shape == wanted.shape and found.tobytes() == wanted.tobytes()


def save_tfrecord(path, runs, contexts=()):
    """By the package tfrecord: its messages and its framing."""
    writer = TFRecordWriter(str(path))
    for number, (position, kinds) in enumerate(runs):
        lists = {"position": ([frame.tobytes() for frame in position], "byte")}
        if contexts:
            lists["step_context"] = ([row.tobytes() for row in contexts[number]], "byte")
        writer.write({"key": (number, "int"), "particle_type": (np.asarray(kinds, np.int64).tobytes(), "byte")}, lists)
    writer.close()


def save_npz(path, runs, compressed=False):
    """By NumPy: one object array a trajectory."""
    arrays = {}
    for number, run in enumerate(runs):
        arrays[f"trajectory_{number}"] = np.empty(len(run), object)
        arrays[f"trajectory_{number}"][:] = run
    (np.savez_compressed if compressed else np.savez)(path, **arrays)


def save_h5(path, runs, **options):
    with h5py.File(path, "w") as file:
        for number, (position, kinds) in enumerate(runs):
            file.create_dataset(f"{number:05d}/position", data=position, **options)
            file.create_dataset(f"{number:05d}/particle_type", data=np.asarray(kinds))


SAVERS = {"deepmind": save_tfrecord, "geoelements": save_npz, "lagrangebench": save_h5}


def take(folder, out, format, **options):
    return import_data(folder, out, format, **({"gravity": [0.0, -9.8], "spacing": 0.1, "trust_pickle": True} | options))


@pytest.fixture
def quick(monkeypatch):
    """Nothing waits for the disk."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


# --- files that are not ours -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", LEARNER_FORMATS)
def test_what_others_wrote(tmp_path, format):
    """Ten trajectories of several sizes in two shards, one in the test split, none to validate."""
    runs = [(motion(seed, particles=3 + seed % 3), np.random.default_rng(seed).permutation([5, 6, 7, 8, 4])[: 3 + seed % 3]) for seed in range(11)]
    folder = describe(tmp_path / "Water Drops")
    SAVERS[format](folder / f"train.{SUFFIXES[format]}", runs[:10])
    SAVERS[format](folder / f"test.{SUFFIXES[format]}", runs[10:])
    done = take(folder, tmp_path / "out", format)
    assert done.trajectories == {"train": 10, "test": 1} and done.spacing_from == "given"
    assert sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")) == [
        "dataset.json",
        "test/shard-00000.h5",
        "train/shard-00000.h5",
        "train/shard-00001.h5",
    ]
    for run, (position, kinds) in zip(read(tmp_path / "out") + read(tmp_path / "out", "test"), runs, strict=True):
        same_bits(run.position, position)
        same_bits(run.particle_type, kinds.astype(np.int8))
        assert (run.frame_step, run.radius, run.bounds.tolist(), run.seed, run.context) == (0.5, 0.25, METADATA["bounds"], None, None)
    assert run.simulator["imported"] == {"format": format, "file": f"test.{SUFFIXES[format]}", "number": 0, "spacing": "given"}
    assert run.scene == {
        "name": "Water Drops", "dim": 2, "bounds": METADATA["bounds"], "gravity": [0.0, -9.8], "frame_step": 0.5, "frames": 6, "radius": 0.25,
        "spacing": 0.1,
    }  # fmt: skip
    content = json.loads((tmp_path / "out/dataset.json").read_text())
    assert content["seed"] is None and content["splits"]["train"]["cost"] is None
    assert content["statistics"] == training_statistics([tmp_path / "out" / name for name in content["splits"]["train"]["shards"]])
    assert list(faults(tmp_path / "out")) == [] and "scene Water Drops, imported" in info_text(tmp_path / "out")


def test_the_sample_of_lagrangebench(tmp_path):
    """Periodic, 3D, packed by gzip. What its metadata state are means over training and validation, which ours confirm."""
    done = import_data(SAMPLE, tmp_path / "out", "lagrangebench", gravity=[0, 0, 0])
    assert done.trajectories == {"train": 1, "valid": 1, "test": 1} and (done.spacing, done.spacing_from) == (1.4, "dx")
    assert list(faults(tmp_path / "out")) == []
    for split, frames in (("train", 1214), ("valid", 405), ("test", 405)):
        (run,) = read(tmp_path / "out", split)
        with h5py.File(SAMPLE / f"{split}.h5") as file:
            same_bits(run.position, file["00000/position"][()])
        assert run.position.shape == (frames, 3, 3) and run.particle_type.tolist() == [5, 5, 5] and run.period.tolist() == [5.0, 5.0, 5.0]
        assert run.simulator["name"] == "JAXMD" and run.frame_step == 0.005
    assert [entry.name for entry in done.doubtful] == ["velocity_std", "acceleration_std"]
    valid = training_statistics([tmp_path / "out/valid/shard-00000.h5"])
    for entry in done.doubtful:
        np.testing.assert_allclose(np.sqrt((np.square(entry.found) + np.square(valid[entry.name])) / 2), entry.stated, rtol=2e-5)


def test_context_of_deepmind(tmp_path):
    folder = describe(tmp_path / "in", context_mean=[2.0, 0.0], context_std=[1.0, 0.0])
    context = np.float32([[1, 0], [3, 0], [1, 0], [3, 0], [1, 0], [3, 0]])
    save_tfrecord(folder / "train.tfrecord", [(motion(), [5, 5, 3, 6])], [context])
    done = take(folder, tmp_path / "out", "deepmind")
    (run,) = read(tmp_path / "out")
    same_bits(run.context, context)
    assert run.moving.tolist() == [True, True, False, True] and not done.doubtful and "context" not in run.scene
    assert {entry.name: entry.found for entry in done.statistics}["context_mean"] == [2.0, 0.0]


def test_a_position_in_one_piece(tmp_path):
    """DeepMind's reader also takes a trajectory whose frames are one value; protobuf allows fields that a reader does not know."""
    folder, position = describe(tmp_path / "in"), motion()
    writer = TFRecordWriter(str(folder / "train.tfrecord"))
    lists = {"position": ([position.tobytes()], "byte"), "other": ([1.5, 2.5], "float"), "numbers": ([3, 4], "int")}
    writer.write({"particle_type": (np.full(4, 5, np.int64).tobytes(), "byte"), "pi": (3.14, "float")}, lists)
    writer.close()
    take(folder, tmp_path / "out", "deepmind")
    same_bits(read(tmp_path / "out")[0].position, position)


def test_archives_of_geoelements(tmp_path):
    """One type for all particles; a list of all trajectories; float64; names of NumPy 1; numbers of NumPy; by columns; metadata for training."""
    position = motion()
    pairs = np.empty(2, object)
    pairs[:] = [(position, 6), (motion(1), np.int64(5))]
    table = np.empty((2, 2), object)
    table[0, 0], table[0, 1], table[1, 0], table[1, 1] = position, np.full(4, 6), motion(1), np.full(4, 5)
    for name, archive in {"pairs": {"gns_data": pairs}, "table": {"gns_data": table}}.items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / "metadata.json").write_text(json.dumps({"train": METADATA, "rollout": METADATA | {"dim": 3}}))
        np.savez(folder / "train.npz", **archive)
        take(folder, tmp_path / f"{name} out", "geoelements")
        first, second = read(tmp_path / f"{name} out")
        same_bits(first.position, position)
        same_bits(second.position, motion(1))
        assert first.particle_type.tolist() == [6] * 4 and second.particle_type.tolist() == [5] * 4
    folder = describe(tmp_path / "others")
    save_npz(folder / "train.npz", [(np.asfortranarray(position.astype(float)), np.int32(7)), (position.astype(">f4"), [5, 5, 5, 3])], True)
    with zipfile.ZipFile(folder / "train.npz") as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    assert all(b"numpy._core.multiarray" in entry for entry in entries.values())
    with zipfile.ZipFile(folder / "train.npz", "w") as archive:
        for name, entry in entries.items():
            # Of a framed pickle the name is a string of 22 letters; NumPy 1's has 21.
            archive.writestr(name, _unframed(entry).replace(b"\x8c\x16numpy._core.multiarray", b"\x8c\x15numpy.core.multiarray"))
    take(folder, tmp_path / "others out", "geoelements")
    for run in read(tmp_path / "others out"):
        same_bits(run.position, position)


def _unframed(entry):
    """An .npy entry whose pickle is without frames, which count bytes."""
    header, body = entry[: 10 + int.from_bytes(entry[8:10], "little")], entry[10 + int.from_bytes(entry[8:10], "little") :]
    assert body[:3] == b"\x80\x04\x95"
    return header + b"\x80\x04" + body[11:]


@pytest.mark.parametrize("value", [0.5, np.float64(0.5), np.full(4, 0.5), np.float32(0.5)])
def test_material_property(tmp_path, value):
    folder = describe(tmp_path / "in")
    save_npz(folder / "train.npz", [(motion(), 6, value)])
    take(folder, tmp_path / "out", "geoelements")
    (run,) = read(tmp_path / "out")
    assert run.context.tolist() == [[0.5]] * 6 and run.scene["context"] == ["material_property"]
    export(tmp_path / "out", tmp_path / "again", "geoelements")
    with np.load(tmp_path / "again/train.npz", allow_pickle=True) as archive:
        assert archive["simulation_0"][2].tolist() == [0.5] * 4


def test_walls_and_bodies_of_lagrangebench(tmp_path):
    """Its fluid, solid wall, moving wall, rigid body; 6 as in its copy of DeepMind's data. A frame is ``write_every`` steps of dt."""
    folder = describe(tmp_path / "in", write_every=10, dx=0.05, dt=0.25, solver="SPH", periodic_boundary_conditions=[False, True, True])
    save_h5(folder / "train.h5", [(motion(particles=5).astype(float), np.int32([0, 1, 2, 3, 6]))], chunks=True, compression="gzip")
    done = take(folder, tmp_path / "out", "lagrangebench", spacing=None)
    (run,) = read(tmp_path / "out")
    assert run.particle_type.tolist() == [5, 3, 3, 0, 6] and run.frame_step == 2.5 and run.scene["periodic"] == ["y"]
    assert (done.spacing, run.simulator["name"]) == (0.05, "SPH")


# --- our exports -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", LEARNER_FORMATS)
@pytest.mark.parametrize("dim", [2, 3])
def test_exports_come_back(tmp_path, format, dim):
    def run(seed):
        rng = np.random.default_rng(seed)
        kinds = rng.permutation([0, 3, 5, 6, 7, 8] if format != "lagrangebench" else [0, 3, 5, 6, 7, 7])
        scene = {"name": "ours", "spacing": 0.05, "gravity": [0.0] * dim, "context": ["sand.friction_angle"]}
        return Trajectory(
            position=motion(seed, 7, 6, dim), particle_type=kinds.astype(np.int8), frame_step=0.0025, radius=0.1, bounds=np.array([[0, 1]] * dim),
            scene=scene, seed=seed, simulator={"name": "none"}, context=np.full((7, 1), 20 + seed, np.float32),
        )  # fmt: skip

    runs = {"train": [run(seed) for seed in range(9)], "valid": [run(9)], "test": [run(10), run(11)]}
    data, entries = tmp_path / "data", {}
    for split, members in runs.items():
        write_shard(data / split / "shard-00000.h5", dict(enumerate(members)))
        entries[split] = {"trajectories": len(members), "ok": len(members), "failed": [], "shards": [f"{split}/shard-00000.h5"]}
    statistics = training_statistics([data / "train/shard-00000.h5"])
    write_json(
        data / "dataset.json",
        {"format_version": 1, "scene": "ours", "family": {}, "seed": 1, "shard_size": 9, "splits": entries, "statistics": statistics},
    )
    export(data, tmp_path / "exported", format)
    done = take(tmp_path / "exported", tmp_path / "out", format, gravity=[0.0] * dim)
    assert done.trajectories == {"train": 9, "valid": 1, "test": 2} and done.doubtful == []
    for split, members in runs.items():
        for found, wanted in zip(read(tmp_path / "out", split), members, strict=True):
            same_bits(found.position, wanted.position)
            same_bits(found.particle_type, wanted.particle_type)
            for name in ("frame_step", "radius"):
                assert getattr(found, name) == getattr(wanted, name)
            assert found.bounds.tolist() == wanted.bounds.tolist()
            if format == "lagrangebench":
                assert found.context is None  # it has no place for one
            else:
                np.testing.assert_allclose(found.context, wanted.context, rtol=1e-6 if format == "geoelements" else 0)
    again = json.loads((tmp_path / "out/dataset.json").read_text())["statistics"]
    for name, value in again.items():
        np.testing.assert_allclose(value, statistics[name], rtol=1e-6, err_msg=name)
    if format != "lagrangebench":  # what is exported again is the same, statistics and our own record apart
        export(tmp_path / "out", tmp_path / "twice", format)
        suffix = SUFFIXES[format]
        if format == "deepmind":
            assert (tmp_path / f"twice/train.{suffix}").read_bytes() == (tmp_path / f"exported/train.{suffix}").read_bytes()
        first, second = (json.loads((tmp_path / name / "metadata.json").read_text()) for name in ("exported", "twice"))
        assert all(second[name] == first[name] for name in METADATA)


# --- figures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dim", "edge"), [(2, 24), (3, 18)])
def test_spacing_is_measured_to_a_tenth(tmp_path, dim, edge, quick):
    """A lattice, a shaken one and a random cloud of 0.05 a particle, in radii of 2.2 to 3.1 spacings; obstacles do not count. Without surfaces, in
    a periodic box, the lattice is right to 3 %."""
    lattice = (np.stack(np.meshgrid(*[np.arange(edge)] * dim), -1).reshape(-1, dim) + 0.5) * 0.05
    rng = np.random.default_rng(0)
    random = rng.uniform(0, edge * 0.05, lattice.shape)
    clouds = {"lattice": lattice, "shaken": lattice + rng.uniform(-0.02, 0.02, lattice.shape), "random": random, "periodic": lattice}
    for name, cloud in clouds.items():
        for radius in (0.11, 0.125, 0.155):
            box = {"bounds": [[0, edge * 0.05]] * dim, "periodic_boundary_conditions": [name == "periodic"] * dim}
            folder = describe(tmp_path / f"{name} {radius}", dim=dim, default_connectivity_radius=radius, **box)
            position = np.concatenate([cloud, np.zeros((500, dim))]).astype(np.float32)
            save_h5(folder / "train.h5", [(np.stack([position] * 3), [5] * len(cloud) + [1] * 500)])
            done = take(folder, tmp_path / f"{name} {radius} out", "lagrangebench", spacing=None, gravity=[0] * dim)
            allowed = 0.03 if name == "periodic" else 0.1
            assert done.spacing_from == "measured" and done.spacing == pytest.approx(0.05, rel=allowed), (name, radius)


def test_statistics_beside_those_stated(tmp_path):
    """x = 0, 1, 3 and y at rest: velocity 1.5 +- 0.5, acceleration 1 +- 0, and a stated context that the file does not have."""
    position = np.zeros((3, 1, 2), np.float32)
    position[:, 0, 0] = [0, 1, 3]
    stated = {"vel_mean": [1.504, 0.0], "vel_std": [0.6, 0.0], "acc_mean": [1.0, 0.0], "acc_std": [0.0, 0.1]}
    folder = describe(tmp_path / "in", bounds=[[0, 4], [0, 4]], **stated)
    save_h5(folder / "train.h5", [(position, [5])])
    done = take(folder, tmp_path / "out", "lagrangebench")
    deviations = {entry.name: entry.deviation for entry in done.statistics}
    assert deviations == {
        "velocity_mean": pytest.approx(0.008),
        "velocity_std": pytest.approx(0.2),
        "acceleration_mean": 0.0,
        "acceleration_std": np.inf,
    }
    assert [entry.name for entry in done.doubtful] == ["velocity_std", "acceleration_std"]
    describe(folder)
    assert take(folder, tmp_path / "silent", "lagrangebench").doubtful == []


@pytest.mark.parametrize("format", LEARNER_FORMATS)
def test_memory_holds_a_trajectory_not_a_data_set(tmp_path, format, quick):
    folder = describe(tmp_path / "in")
    SAVERS[format](folder / f"train.{SUFFIXES[format]}", [(motion(seed, 100, 500), [5] * 500) for seed in range(20)])
    one = 100 * 500 * 2 * 4
    tracemalloc.start()
    try:
        take(folder, tmp_path / "out", format)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 10 * one, peak / one  # the statistics take eight, of which two are float64


# --- what goes wrong -------------------------------------------------------------------------------------------------


def good(folder, format="lagrangebench", **changes):
    describe(folder, **changes)
    SAVERS[format](folder / f"train.{SUFFIXES[format]}", [(motion(), [5] * 4)])


def with_runs(*runs, format="lagrangebench", **changes):
    def prepare(folder):
        describe(folder, **changes)
        SAVERS[format](folder / f"train.{SUFFIXES[format]}", runs)

    return prepare


def text(name, content):
    def prepare(folder):
        good(folder)
        (folder / name).write_text(content)

    return prepare


MISTAKES = {
    "no folder": (lambda folder: None, {}, "metadata.json: file = 'No such file or directory': give the folder"),
    "no file": (describe, {}, "holds no train.h5, valid.h5, test.h5; correct the folder or the format"),
    "another format": (good, {"format": "deepmind"}, "holds no train.tfrecord"),
    "format": (good, {"format": "xyz"}, "give one of geoelements, deepmind, lagrangebench"),
    "not JSON": (text("metadata.json", "{"), {}, "not JSON"),
    "deep JSON": (text("metadata.json", "[" * 100_000), {}, "not JSON"),
    "no mapping": (text("metadata.json", "[1]"), {}, "metadata.json: file = [1]"),
    "no radius": (text("metadata.json", json.dumps({name: value for name, value in METADATA.items() if "radius" not in name})), {},
                  "default_connectivity_radius = None: missing; add it"),
    "dim": (lambda folder: good(folder, dim=4), {}, "dim = 4"),
    "bounds": (lambda folder: good(folder, bounds=[[1, 0], [0, 1]]), {}, "must be 2 pairs, lower < upper"),
    "too few bounds": (lambda folder: good(folder, bounds=[[0, 1]]), {}, "must be 2 pairs"),
    "NaN": (lambda folder: good(folder, dt=float("nan")), {}, "dt = nan"),
    "statistics": (lambda folder: good(folder, vel_std=[1.0]), {}, "vel_std = [1.0]: must be 2 numbers"),
    "gravity": (good, {"gravity": [0.0]}, "gravity = [0.0]: must be 2 finite numbers"),
    "gravity, NaN": (good, {"gravity": [0.0, float("nan")]}, "must be 2 finite numbers"),
    "spacing": (good, {"spacing": -1.0}, "spacing = -1.0: must be a positive length"),
    "out is taken": (good, {"out": "in"}, "exists already"),
    "no trajectory": (with_runs(), {}, "trajectories = 0: an empty file"),
    "no trajectory, measured": (with_runs(format="geoelements"), {"format": "geoelements", "spacing": None}, "trajectories = 0: an empty file"),
    "two frames": (with_runs((motion(frames=2), [5] * 4)), {}, "statistics need a trajectory of three frames with a moving particle"),
    "nothing moves": (with_runs((motion(), [1] * 4)), {}, "statistics need a trajectory of three frames with a moving particle"),
    "dimension": (with_runs((motion(dim=3), [5] * 4)), {}, "0/position = 'float32 [6, 4, 3]': must be floating-point [frames, particles, 2]"),
    "no particle": (with_runs((motion(particles=0), [])), {}, "not empty"),
    "whole numbers": (with_runs((motion().astype(int), [5] * 4)), {}, "must be floating-point"),
    "NaN in a later one": (with_runs((motion(), [5] * 4), (motion() * np.nan, [5] * 4)), {}, "1/position = 'non-finite'"),
    "too large for float32": (with_runs((motion().astype(float) + 1e200, [5] * 4)), {}, "0/position = 'non-finite'"),
    "types": (with_runs((motion(), [5, 5, 5, 9])), {}, "particle_type = [9]: must be ids in 0..8"),
    "types, too few": (with_runs((motion(), [5] * 3)), {}, "particle_type = 'int64 [3]': must be whole numbers, one or 4"),
    "types, floats": (with_runs((motion(), [5.0] * 4)), {}, "particle_type = 'float64 [4]'"),
    "types, DeepMind": (with_runs((motion(), [5] * 3), format="deepmind"), {"format": "deepmind"}, "48 into shape (6,3,2)"),
    "context is missing": (lambda folder: good(folder, "deepmind", context_mean=[0.0]), {"format": "deepmind"}, "0 = \"'step_context'\""),
    "material properties": (with_runs((motion(), 5, np.arange(4.0)), format="geoelements"), {"format": "geoelements"}, "4 material properties"),
    "one item": (with_runs((motion(),), format="geoelements"), {"format": "geoelements"}, "must be (positions, types) or"),
    "no pickle without leave": (lambda folder: good(folder, "geoelements"), {"format": "geoelements", "trust_pickle": False}, "give --trust-pickle"),
    "plain arrays": (lambda folder: np.savez(describe(folder) / "train.npz", motion()), {"format": "geoelements"}, "must be an object array"),
    "not HDF5": (text("train.h5", "hello"), {}, "train.h5: file = "),
    "no groups": (lambda folder: h5py.File(describe(folder) / "train.h5", "w").create_dataset("a", data=1).file.close(), {}, "a/position"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_one_line_and_write_nothing(tmp_path, case):
    prepare, request, message = MISTAKES[case]
    prepare(tmp_path / "in")
    before = sorted(tmp_path.rglob("*"))
    request = {"format": "lagrangebench"} | request
    with pytest.raises(InputError) as caught:
        take(tmp_path / "in", tmp_path / request.pop("out", "out"), **request)
    assert message in str(caught.value) and "\n" not in str(caught.value), caught.value
    assert sorted(tmp_path.rglob("*")) == before


class Payload:
    def __init__(self, call, *arguments):
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


@pytest.mark.parametrize("where", ["item", "in an array", "state"])
def test_pickles_run_nothing(tmp_path, where):
    """Whatever is named but arrays is refused, before it is called."""
    folder, mark = describe(tmp_path / "in"), tmp_path / "mark"
    payload = Payload(os.mkdir, str(mark))
    inner = np.empty(2, object)
    inner[:] = [payload, 1]
    item = {"item": payload, "in an array": inner, "state": Payload(np.ndarray, (2,), payload)}[where]
    save_npz(folder / "train.npz", [(motion(), item)])
    with pytest.raises(InputError, match="names posix.mkdir, which is no array"):
        take(folder, tmp_path / "out", "geoelements")
    assert os.listdir(tmp_path) == ["in"]


#: Pickles that ask for memory, for names, or for a change of what stands for arrays.
HOSTILE = {
    "a name": b"cbuiltins\neval\n.", "an extension": b"\x82\x01.", "a persistent one": b"Px\n.", "memory": b"\x80\x04r\xff\xff\xff\x7f.",
    "a long string": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7fa.", "a class as it is": b"cnumpy\nndarray\n.",
    "a class made over": b"cnumpy\nndarray\n(dVvalue\nI1\nsb.", "an array without a state": b"cnumpy\nndarray\n)\x81.",
    "a type of objects": b"cnumpy\nndarray\n)R(I1\n(I1\ntcnumpy\ndtype\n(Vobject\ntRI00\nVx\ntb.", "itself": b"]q\x00h\x00a.", "a number": b"I1\n.",
    "nothing": b"", "a deep list": b"(" * 100_000 + b"." , "an ever longer one": b"]" + b"2" * 100_000 + b".",
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_pickles(tmp_path, case):
    folder = describe(tmp_path / "in")
    with zipfile.ZipFile(folder / "train.npz", "w") as archive, archive.open("a.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": "|O", "fortran_order": False, "shape": (2,)})
        entry.write(HOSTILE[case])
    with pytest.raises(InputError) as caught:
        take(folder, tmp_path / "out", "geoelements")
    assert "\n" not in str(caught.value) and os.listdir(tmp_path) == ["in"]


@pytest.mark.parametrize("case", ["external link", "soft link", "external storage", "virtual"])
def test_no_other_file_is_read(tmp_path, case):
    """HDF5 can point to other files: what lies there must not come into a data set."""
    folder, secret = describe(tmp_path / "in"), tmp_path / "secret.h5"
    save_h5(secret, [(motion(), [5] * 4)])
    (tmp_path / "secret").write_bytes(motion().tobytes())
    with h5py.File(folder / "train.h5", "w") as file:
        file["00000/particle_type"] = np.full(4, 5)
        if case == "external link":
            file["00000/position"] = h5py.ExternalLink(str(secret), "00000/position")
        elif case == "soft link":
            file["elsewhere"] = motion()
            file["00000/position"] = h5py.SoftLink("/elsewhere")
        elif case == "external storage":
            file.create_dataset("00000/position", (6, 4, 2), "f4", external=[(str(tmp_path / "secret"), 0, h5py.h5f.UNLIMITED)])
        else:
            layout = h5py.VirtualLayout((6, 4, 2), "f4")
            layout[:] = h5py.VirtualSource(str(secret), "00000/position", (6, 4, 2))
            file.create_virtual_dataset("00000/position", layout)
    with pytest.raises(InputError, match="must be a data set within the file"):
        take(folder, tmp_path / "out", "lagrangebench")


@pytest.mark.parametrize("format", ["lagrangebench", "geoelements"])
def test_what_is_packed_must_fit(tmp_path, format):
    """A file of some hundred bytes that promises 80 GB."""
    folder = describe(tmp_path / "in")
    if format == "lagrangebench":
        with h5py.File(folder / "train.h5", "w") as file:
            file.create_dataset("00000/position", (10**5, 10**5, 2), "f4", chunks=(10, 10, 2), compression="gzip")
            file["00000/particle_type"] = np.full(10**5, 5)
    else:
        good(folder, "geoelements")
        raw = bytearray((folder / "train.npz").read_bytes())
        at = raw.index(b"PK\x01\x02")
        raw[at + 20 : at + 28] = (100).to_bytes(4, "little") + (2**31).to_bytes(4, "little")
        (folder / "train.npz").write_bytes(raw)
    with pytest.raises(InputError, match="promises more than it"):
        take(folder, tmp_path / "out", format)


def test_checksums_are_checked(tmp_path):
    folder = describe(tmp_path / "in")
    save_tfrecord(folder / "train.tfrecord", [(motion(0), [5] * 4), (motion(1), [5] * 4)])
    whole = (folder / "train.tfrecord").read_bytes()
    first = 16 + int.from_bytes(whole[:8], "little")
    for at, message in {3: "1.*checksum of this length", first + 9: "checksum of this length", first + 30: "1 = .*checksum of a record",
                        len(whole) - 1: "1 = .*checksum of a record"}.items():  # fmt: skip
        changed = bytearray(whole)
        changed[at] ^= 1
        (folder / "train.tfrecord").write_bytes(changed)
        with pytest.raises(InputError, match=message):
            take(folder, tmp_path / "out", "deepmind")
    for size in (first + 5, first + 20, len(whole) - 2):
        (folder / "train.tfrecord").write_bytes(whole[:size])
        with pytest.raises(InputError, match="1 = .*ends within a record"):
            take(folder, tmp_path / "out", "deepmind")
    (folder / "train.tfrecord").write_bytes(whole[:first])
    assert take(folder, tmp_path / "out", "deepmind").trajectories == {"train": 1}


def test_messages_of_any_bytes_behind_good_checksums(tmp_path, quick):
    """A hostile record: its checksums are right, its message is not. Every flip and every cut is an import or one line."""
    folder = describe(tmp_path / "in")
    save_tfrecord(folder / "train.tfrecord", [(motion(frames=3, particles=2), [5, 5])])
    message = (folder / "train.tfrecord").read_bytes()[12:-4]
    rng, outcomes = np.random.default_rng(0), []
    for trial in range(300):
        changed = bytearray(message)
        for at in rng.integers(len(message), size=1 + trial % 3):
            changed[at] = rng.integers(256)
        changed = changed[: rng.integers(4, len(message))] if trial % 5 == 0 else changed
        length = len(changed).to_bytes(8, "little")
        frame = length + masked(crc32c(length)).to_bytes(4, "little") + changed + masked(crc32c(bytes(changed))).to_bytes(4, "little")
        (folder / "train.tfrecord").write_bytes(frame)
        outcomes.append(_outcome(folder, tmp_path / f"out {trial}", "deepmind"))
    assert 20 < sum(outcomes) < 280


@pytest.mark.parametrize("format", LEARNER_FORMATS)
def test_damaged_files(tmp_path, format, quick):
    """Every flip and every cut of data and metadata is an import or one line, and leaves nothing half made."""
    folder = describe(tmp_path / "in", dx=0.1)
    name = f"train.{SUFFIXES[format]}"
    runs = [(motion(seed, 3, 3), [5, 6, 3]) for seed in range(2)]
    SAVERS[format](folder / name, runs, **({"chunks": True, "compression": "gzip"} if format == "lagrangebench" else {}))
    wholes = {file: (folder / file).read_bytes() for file in (name, "metadata.json")}
    rng, outcomes = np.random.default_rng(1), []
    for trial in range(250):
        file = name if trial % 4 else "metadata.json"
        changed = bytearray(wholes[file])
        for at in rng.integers(len(changed), size=1 + trial % 3):
            changed[at] = rng.integers(256)
        changed = changed[: rng.integers(len(changed))] if trial % 5 == 0 else changed
        (folder / file).write_bytes(changed)
        outcomes.append(_outcome(folder, tmp_path / f"out {trial}", format))
        (folder / file).write_bytes(wholes[file])
    assert outcomes.count(False) > 30 and _outcome(folder, tmp_path / "whole", format)


def _outcome(folder, out, format):
    """Whether an import was made, and sound; anything but that and one line fails the test."""
    try:
        done = take(folder, out, format)
    except InputError as error:
        assert "\n" not in str(error) and str(error)
        assert not [path for path in folder.parent.iterdir() if path.name.startswith((out.name, "."))]
        return False
    assert sum(len(read(out, split)) for split in done.trajectories) == sum(done.trajectories.values())
    return True


def test_a_full_disk_is_a_run_error_and_leaves_nothing(tmp_path, monkeypatch):
    good(tmp_path / "in")

    def full(_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunError, match="No space left"):
        take(tmp_path / "in", tmp_path / "out", "lagrangebench")
    assert os.listdir(tmp_path) == ["in"]


def test_the_pickles_of_numpy_are_read_without_numpy_calling_anything(monkeypatch, tmp_path):
    """The C reader, which reserves memory by numbers in the file, is not asked."""
    monkeypatch.setattr(pickle, "loads", None)
    monkeypatch.setattr(pickle, "load", None)
    good(tmp_path / "in", "geoelements")
    take(tmp_path / "in", tmp_path / "out", "geoelements")
