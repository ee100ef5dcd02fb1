"""Exports: every format is read back by a reader that is not ours, bit for bit, and every way to go wrong leaves nothing behind."""

import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
import weakref
import zipfile
from dataclasses import replace
from pathlib import Path

import crc32c as reference_crc
import h5py
import meshio
import numpy as np
import pytest
import pyvista
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tfrecord.reader import sequence_loader
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline
from vtkmodules.vtkIOHDF import vtkHDFReader

import sim.export
import sim.trajectory
from sim.cli import main
from sim.errors import InputError, RunError
from sim.export import FORMATS, LEARNER_FORMATS, VIEWER_FORMATS, crc32c, export, velocities
from sim.generate import training_statistics
from sim.trajectory import ShardReader, Trajectory, write_json, write_shard

HERE = Path(__file__).parent


def trajectory(position, kinds=None, **changes):
    position = np.asarray(position, np.float32)
    frames, particles, dim = position.shape
    fields = {
        "position": position,
        "particle_type": np.full(particles, 5, np.int8) if kinds is None else np.asarray(kinds, np.int8),
        "frame_step": 0.0025,
        "radius": 0.1,
        "bounds": np.array([[0.1, 0.9]] * dim),
        "scene": {"name": "made up", "spacing": 0.05},
        "seed": 1,
        "simulator": {"name": "none"},
    }
    return Trajectory(**(fields | changes))


def some(seed, frames=8, **changes):
    rng = np.random.default_rng(seed)
    particles = int(rng.integers(3, 9))
    return replace(trajectory(rng.random((frames, particles, 2)), rng.permutation([0, 3, 5, 5, 6, 7, 5, 5])[:particles]), **changes)


def write_data(folder, splits, failed=(), shard_size=2):
    """A data set of {split: {index: trajectory}}; ``failed``: (split, index) that dataset.json lists."""
    entries = {}
    for split, made in splits.items():
        names = []
        for first in range(0, len(made), shard_size):
            names.append(f"{split}/shard-{first // shard_size:05d}.h5")
            write_shard(folder / names[-1], dict(list(made.items())[first : first + shard_size]))
        lost = [{"index": index, "seed": 2, "status": "failed: too fast (frame 3)"} for name, index in failed if name == split]
        cost = {"wall_seconds": 0.0, "compile_seconds": 0.0}
        entries[split] = {"trajectories": len(made) + len(lost), "ok": len(made), "failed": lost, "shards": names, "cost": cost}
    statistics = training_statistics([folder / name for name in entries["train"]["shards"]]) if "train" in entries else None
    header = {"format_version": 1, "scene": "made up", "family": {}, "seed": 4, "shard_size": shard_size, "version": "0"}
    write_json(folder / "dataset.json", header | {"splits": entries, "statistics": statistics})
    return folder


@pytest.fixture
def data(tmp_path):
    """Five, two and one trajectories of different sizes; the second of the training split has failed."""
    made = {"train": {index: some(index) for index in (0, 2, 3, 4, 5)}, "valid": {0: some(6), 1: some(7)}, "test": {0: some(8)}}
    return write_data(tmp_path / "data", made, failed=[("train", 1)])


def given_by(data, split):
    """[(position, particle_type, context)] of a split, in order."""
    found = []
    for path in sorted((data / split).glob("*.h5")):
        with ShardReader(path) as reader:
            found += [(reader.positions(index), reader.particle_type(index), reader.context(index)) for index in reader.indices()]
    return found


def change(data, *keys, value):
    content = json.loads((data / "dataset.json").read_text())
    target = content
    for key in keys[:-1]:
        target = target[key]
    target[keys[-1]] = value
    (data / "dataset.json").write_text(json.dumps(content))


def same_bits(found, wanted):
    assert found.dtype == wanted.dtype and found.shape == wanted.shape and found.tobytes() == wanted.tobytes()


def hidden(folder):
    return list(folder.rglob(".*"))


# --- readers that are not ours ---------------------------------------------------------------------------------------


def read_geoelements(folder, split):
    """As ``load_npz_data`` and ``TrajectoriesDataset`` of geoelements/gns do it: [(positions, types)], or [(positions, types, material property)]."""
    with np.load(folder / f"{split}.npz", allow_pickle=True) as file:
        data = [item for _, item in file.items()]
    if len(data[0]) >= 3:
        return [(position, kinds, np.full(position.shape[1], number, dtype=float)) for position, kinds, number in data]
    return [(position, kinds) for position, kinds in data]


def read_deepmind(folder, split):
    """By the package tfrecord, shaped as learning_to_simulate's ``parse_serialized_simulation_example`` does it; [(positions, types, contexts)]."""
    metadata, found = json.loads((folder / "metadata.json").read_text()), []
    for number, (context, features) in enumerate(sequence_loader(str(folder / f"{split}.tfrecord"), None)):
        assert context["key"].dtype == np.int64 and context["key"].tolist() == [number]
        length = metadata["sequence_length"] + 1
        position = np.frombuffer(b"".join(features["position"]), np.float32).reshape(length, -1, metadata["dim"])
        steps = np.frombuffer(b"".join(features["step_context"]), np.float32).reshape(length, -1) if "context_mean" in metadata else None
        found.append((position, np.frombuffer(context["particle_type"], np.int64), steps))
    return found


def read_lagrangebench(folder, split):
    """As LagrangeBench's ``H5Dataset`` does it."""
    with h5py.File(folder / f"{split}.h5") as file:
        assert list(file) == [f"{number:05d}" for number in range(len(file))]
        return [(group["position"][:], group["particle_type"][:]) for group in file.values()]


def read_vtkhdf(path):
    """(times, [(points, particle_type, velocity)]) by VTK's own reader, the steps read backwards. Of one step VTK tells no time."""
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    information = reader.GetOutputInformation(0)
    times = [information.Get(Pipeline.TIME_STEPS(), step) for step in range(information.Length(Pipeline.TIME_STEPS()))]
    assert reader.GetNumberOfSteps() == max(len(times), 1)
    found = []
    for moment in reversed(times or [0.0]):
        reader.UpdateTimeStep(moment)
        output = reader.GetOutputDataObject(0)
        points = vtk_to_numpy(output.GetPoints().GetData()).copy()
        assert output.IsA("vtkPolyData") and output.GetNumberOfCells() == output.GetNumberOfVerts() == len(points)
        np.testing.assert_array_equal(vtk_to_numpy(output.GetVerts().GetConnectivityArray()), np.arange(len(points)))
        values = [vtk_to_numpy(output.GetPointData().GetArray(name)).copy() for name in ("particle_type", "velocity")]
        found.insert(0, (points, *values))
    return times, found


def padded(row):
    return np.pad(row, ((0, 0), (0, 3 - row.shape[1])))


# --- round trips -----------------------------------------------------------------------------------------------------

NUMBERS = st.floats(-1e6, 1e6, width=32)
SHAPES = st.tuples(st.integers(1, 4), st.integers(1, 5), st.sampled_from([2, 3]))


@st.composite
def runs(draw):
    """One to three trajectories of a split: any float32 (-0 and subnormals too), one number of frames and axes, any number of particles."""
    frames, _, dim = draw(SHAPES)
    count = draw(st.integers(1, 3))
    sizes = [draw(st.integers(1, 5)) for _ in range(count)]
    with_context = draw(st.booleans())
    return [
        trajectory(
            draw(arrays(np.float32, (frames, size, dim), elements=NUMBERS)), draw(arrays(np.int8, size, elements=st.sampled_from([0, 3, 5, 6, 7]))),
            context=draw(arrays(np.float32, (frames, 2), elements=NUMBERS)) if with_context else None,
        )
        for size in sizes
    ]  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(runs())
def test_positions_keep_their_bits_in_every_format(made):
    moving = {index: run for index, run in enumerate(made)}
    with tempfile.TemporaryDirectory() as folder:
        data, folder = write_data(Path(folder) / "data", {"train": moving}), Path(folder)
        if json.loads((data / "dataset.json").read_text())["statistics"]["acceleration_mean"] is None:  # fewer than three frames
            for name in ("velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std"):
                change(data, "statistics", name, value=[0.0] * made[0].position.shape[2])
        for name in FORMATS:
            export(data, folder / name, name)
        learners = [
            read_geoelements(folder / "geoelements", "train"),
            read_deepmind(folder / "deepmind", "train"),
            read_lagrangebench(folder / "lagrangebench", "train"),
        ]
        for found, kinds_of in zip(learners, (np.int64, np.int64, np.int32), strict=True):
            assert len(found) == len(made)
            for (position, kinds, *context), run in zip(found, made, strict=True):
                same_bits(position, run.position)
                wanted = [{0: 3, 3: 1}.get(kind, kind) for kind in run.particle_type.tolist()] if kinds_of is np.int32 else run.particle_type
                same_bits(kinds, np.asarray(wanted, kinds_of))
                if context and run.context is not None:
                    same_bits(context[0], run.context)
        for index, run in moving.items():
            stem = f"train/{index:06d}"
            times, steps = read_vtkhdf(folder / f"vtkhdf/{stem}.vtkhdf")
            assert times == ([frame * 0.0025 for frame in range(len(run.position))] if len(run.position) > 1 else [])
            for (points, kinds, _), row in zip(steps, run.position, strict=True):
                same_bits(points, padded(row))
                np.testing.assert_array_equal(kinds, run.particle_type)
            for name in ("ply", "vtu"):
                for frame, row in enumerate(run.position):
                    mesh = meshio.read(folder / f"{name}/{stem}/frame-{frame:05d}.{name}")
                    same_bits(np.ascontiguousarray(mesh.points), padded(row))
                    np.testing.assert_array_equal(mesh.point_data["particle_type"], run.particle_type)


def test_vtk_reads_the_vtu_frames_as_vertices(data, tmp_path):
    export(data, tmp_path / "out", "vtu", split="test")
    run = given_by(data, "test")[0]
    grid = pyvista.read(tmp_path / "out/test/000000/frame-00003.vtu")
    same_bits(np.asarray(grid.points), padded(run[0][3]))
    assert set(grid.celltypes) == {pyvista.CellType.VERTEX} and grid.n_cells == grid.n_points
    same_bits(np.asarray(grid.point_data["velocity"]), padded(velocities(run[0], [3], 0.0025)[0]))


def test_a_long_trajectory_is_written_in_blocks(data, tmp_path, monkeypatch):
    export(data, tmp_path / "whole", "vtkhdf", split="test")
    monkeypatch.setattr(sim.export, "_BLOCK", 3 * given_by(data, "test")[0][0].shape[1])  # eight frames: 3 + 3 + 2
    export(data, tmp_path / "blocks", "vtkhdf", split="test")
    assert (tmp_path / "blocks/test/000000.vtkhdf").read_bytes() == (tmp_path / "whole/test/000000.vtkhdf").read_bytes()


@pytest.mark.parametrize("name", ["vtkhdf", *LEARNER_FORMATS])
def test_same_bytes_twice(data, tmp_path, name):
    export(data, tmp_path / "a", name)
    time.sleep(1.1)  # HDF5 would store times in seconds
    export(data, tmp_path / "b", name)
    first, second = ({str(path.relative_to(tmp_path / out)): path.read_bytes() for path in (tmp_path / out).rglob("*.*")} for out in ("a", "b"))
    assert first and first == second


@pytest.mark.parametrize("name", FORMATS)
def test_memory_holds_a_trajectory_not_a_data_set(tmp_path, monkeypatch, name):
    data = write_data(tmp_path / "data", {"train": {index: some(index) for index in range(9)}})
    read, alive, most = ShardReader.positions, [], 0

    def counted(*arguments):
        nonlocal most
        block = read(*arguments)
        alive.append(weakref.ref(block))
        most = max(most, sum(reference() is not None for reference in alive))
        return block

    monkeypatch.setattr(ShardReader, "positions", counted)
    export(data, tmp_path / "out", name)
    assert len(alive) == 9 and most <= 2


# --- values by hand --------------------------------------------------------------------------------------------------


def test_velocities_by_hand():
    position = np.array([0, 1, 4], np.float32).reshape(3, 1, 1)
    assert velocities(position, range(3), 0.5)[:, 0, 0].tolist() == [2.0, 2.0, 6.0]
    assert velocities(position, [2], 0.5).shape == (1, 1, 1)
    assert velocities(position[:1], [0], 0.5).tolist() == [[[0.0]]]


def test_metadata_by_hand(tmp_path):
    """x = 0, 1, 3: velocities 1 and 2 a frame, acceleration 1; an obstacle that moves does not count; no split but training does."""
    position = np.zeros((3, 2, 2))
    position[:, 0, 0], position[:, 1, 1] = [0, 1, 3], [0, 5, 50]
    wall = np.zeros((3, 1, 2))
    made = {"train": {0: trajectory(np.concatenate([position, wall], axis=1), [5, 3, 3])}, "test": {0: trajectory(100 * position, [5, 3])}}
    data = write_data(tmp_path / "data", made)
    common = {
        "bounds": [[0.1, 0.9], [0.1, 0.9]],
        "default_connectivity_radius": 0.1,
        "dim": 2,
        "dt": 0.0025,
        "vel_mean": [1.5, 0.0],
        "vel_std": [0.5, 0.0],
        "acc_mean": [1.0, 0.0],
        "acc_std": [0.0, 0.0],
    }
    additions = {
        "geoelements": {"sequence_length": 3},
        "deepmind": {"sequence_length": 2},
        "lagrangebench": {
            "sequence_length": 3,
            "sequence_length_train": 3,
            "sequence_length_test": 3,
            "num_trajs_train": 1,
            "num_trajs_test": 1,
            "dx": 0.05,
            "write_every": 1,
            "num_particles_max": 3,
            "periodic_boundary_conditions": [False, False, False],
        },
    }
    for name, special in additions.items():
        export(data, tmp_path / name, name)
        metadata = json.loads((tmp_path / name / "metadata.json").read_text())
        source = metadata.pop("source")
        assert metadata == common | special
        assert source["trajectories"] == {"train": 1, "test": 1} and source["scene"] == "made up" and source["seed"] == 4


def test_context_of_every_step_goes_to_deepmind(tmp_path):
    context = np.array([[1.0], [3.0], [5.0]], np.float32)
    made = {"train": {0: some(0, 3, context=context), 1: some(1, 3, context=context + 6)}, "test": {0: some(2, 3, context=100 * context)}}
    data = write_data(tmp_path / "data", made)
    export(data, tmp_path / "out", "deepmind")
    metadata = json.loads((tmp_path / "out/metadata.json").read_text())
    assert metadata["context_mean"] == [6.0]
    assert metadata["context_std"] == pytest.approx([np.sqrt(35 / 3)])  # of 1, 3, 5, 7, 9, 11
    same_bits(read_deepmind(tmp_path / "out", "test")[0][2], 100 * context)


CONTEXT = np.array([[1, 2, 45], [3, 4, 45], [5, 6, 45]], np.float32)
SHAKEN = {"name": "made up", "spacing": 0.05, "container": {"kind": "made up"}, "context": ["sand.friction_angle"]}


def shaken(scene, *columns):
    return {"context": CONTEXT[:, columns], "scene": SHAKEN | scene}


#: What a scene is told and what each format leaves of it; all others have it all.
CONTEXTS = {
    "acceleration": (shaken({"context": []}, 0, 1), ["container_acceleration"], ["container_acceleration"]),
    "number": (shaken({"container": None}, 2), [], ["sand.friction_angle"]),
    "both": (shaken({}, 0, 1, 2), ["container_acceleration"], ["container_acceleration", "sand.friction_angle"]),
    "two numbers": (shaken({"container": None, "context": ["a.b", "c.d"]}, 0, 1), ["a.b", "c.d"], ["a.b", "c.d"]),
    "not said": (shaken({}, 0), ["context"], ["context"]),
}


@pytest.mark.parametrize("case", CONTEXTS)
def test_context_that_has_no_place_is_named(tmp_path, case):
    changes, geoelements, others = CONTEXTS[case]
    data = write_data(tmp_path / "data", {"train": {0: some(0, 3, **changes), 1: some(1, 3)}})
    with ShardReader(data / "train/shard-00000.h5") as reader:
        assert reader.context(1) is None, "one that has it is enough"
    wanted = dict.fromkeys(FORMATS, others) | {"geoelements": geoelements, "vtkhdf": [], "deepmind": []}
    for name in VIEWER_FORMATS + ("lagrangebench",):
        assert export(data, tmp_path / name, name).left_out == wanted[name]
    data = write_data(tmp_path / "same", {"train": {0: some(0, 3, **changes)}})
    for name in LEARNER_FORMATS:
        assert export(data, tmp_path / "learners" / name, name).left_out == wanted[name]
        source = json.loads((tmp_path / "learners" / name / "metadata.json").read_text())["source"]
        assert source["left_out"] == wanted[name]


def test_a_material_number_goes_to_geoelements(tmp_path):
    """A friction angle of 45 degrees is 1; inputs of the network: 5 x 2 velocities, 4 walls, 16 of the type, 1 number; an edge's 2 + 1."""
    train, test = some(0, 3, **shaken({}, 0, 1, 2)), some(1, 3, **shaken({"context": ["sand.density"]}, 0, 1, 2))
    export(write_data(tmp_path / "data", {"train": {0: train}}), tmp_path / "out", "geoelements")
    assert read_geoelements(tmp_path / "out", "train")[0][2] == pytest.approx(np.ones(train.position.shape[1]))
    metadata = json.loads((tmp_path / "out/metadata.json").read_text())
    assert (metadata["nnode_in"], metadata["nedge_in"], metadata["source"]["material_property"]) == (31, 3, "sand.friction_angle")
    export(write_data(tmp_path / "plain", {"train": {0: test}}), tmp_path / "as it is", "geoelements")
    assert (read_geoelements(tmp_path / "as it is", "train")[0][2] == 45).all()
    with pytest.raises(InputError, match="material_property = 'sand.density': the first trajectory has sand.friction_angle"):
        export(write_data(tmp_path / "mixed", {"train": {0: train}, "test": {0: test}}), tmp_path / "none", "geoelements")


@pytest.mark.parametrize(("frames", "wanted"), [("::2", [0, 2]), ("1", [1])])
def test_context_is_field_data_in_paraview(tmp_path, frames, wanted):
    export(write_data(tmp_path / "data", {"train": {0: some(0, 3, **shaken({}, 0, 1, 2))}}), tmp_path / "out", "vtkhdf", frames=frames)
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "out/train/000000.vtkhdf"))
    reader.UpdateInformation()
    for frame in reversed(wanted):
        reader.UpdateTimeStep(frame * 0.0025)
        found = reader.GetOutputDataObject(0).GetFieldData()
        assert vtk_to_numpy(found.GetArray("container_acceleration")).tolist() == [[*CONTEXT[frame, :2].tolist(), 0.0]]
        assert vtk_to_numpy(found.GetArray("sand.friction_angle")).tolist() == [45.0]


def test_crc32c_by_published_vectors():
    """RFC 3720, B.4; the check value of the catalogue of CRCs; a record as TensorFlow 2.21's TFRecordWriter makes it."""
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(b"\xff" * 32) == 0x62A8AB43
    assert crc32c(bytes(range(32))) == 0x46DD794E
    assert crc32c(bytes(range(31, -1, -1))) == 0x113FDB5C
    assert crc32c(b"123456789") == 0xE3069283
    record = bytes.fromhex("090000000000000037f97139313233343536373839e5b08ac7")
    assert record[8:12] == sim.export.masked(crc32c(record[:8])).to_bytes(4, "little")
    assert record[-4:] == sim.export.masked(crc32c(record[12:-4])).to_bytes(4, "little")


@given(st.binary(min_size=4, max_size=3000))
def test_crc32c_of_anything(data):
    assert crc32c(data) == reference_crc.crc32c(data)


def test_every_record_is_framed_with_its_checksums(data, tmp_path):
    """tfrecord and protobuf check the messages, but not the checksums: another implementation of CRC-32C does."""
    export(data, tmp_path / "out", "deepmind")
    rest, count = (tmp_path / "out/train.tfrecord").read_bytes(), 0

    def masked(part):
        crc = reference_crc.crc32c(part)
        return ((((crc >> 15) | (crc << 17)) & 0xFFFFFFFF) + 0xA282EAD8 & 0xFFFFFFFF).to_bytes(4, "little")

    while rest:
        length = int.from_bytes(rest[:8], "little")
        assert rest[8:12] == masked(rest[:8]) and rest[12 + length : 16 + length] == masked(rest[12 : 12 + length])
        rest, count = rest[16 + length :], count + 1
    assert count == 5


def test_varint_by_hand():
    assert [sim.export._varint(number).hex() for number in (0, 1, 127, 128, 300, 2**32)] == ["00", "01", "7f", "8001", "ac02", "8080808010"]


def test_npz_names_public_numpy_only(data, tmp_path):
    """What NumPy pickles by itself names numpy._core, which NumPy 1 lacks; and a reader can allow two names and refuse all others."""
    export(data, tmp_path / "out", "geoelements")

    class Strict(pickle.Unpickler):
        def find_class(self, module, name):
            assert (module, name) in {("numpy", "ndarray"), ("numpy", "dtype")}
            return super().find_class(module, name)

    with zipfile.ZipFile(tmp_path / "out/train.npz") as archive:
        assert archive.testzip() is None and archive.namelist() == [f"simulation_{number}.npy" for number in range(5)]
        with archive.open("simulation_1.npy") as entry:
            np.lib.format.read_magic(entry)
            assert np.lib.format.read_array_header_1_0(entry) == ((2,), False, np.dtype(object))
            position, kinds = Strict(entry).load()
    same_bits(position, given_by(data, "train")[1][0])
    position += 1  # its own memory, as what NumPy wrote would have


def test_lagrangebench_keeps_obstacles_still(tmp_path):
    """Its kinematic types are 1 and 2; 3 is a rigid body there."""
    made = {"train": {0: trajectory(np.zeros((3, 5, 2)), [0, 3, 5, 6, 7])}}
    export(write_data(tmp_path / "data", made), tmp_path / "out", "lagrangebench")
    assert read_lagrangebench(tmp_path / "out", "train")[0][1].tolist() == [3, 1, 5, 6, 7]
    with h5py.File(tmp_path / "out/train.h5") as file:
        assert file["00000/position"].chunks is None and file["00000/position"].dtype == np.float32


# --- what is chosen --------------------------------------------------------------------------------------------------


def test_layout_of_a_data_set(data, tmp_path):
    done = export(data, tmp_path / "out", "vtkhdf")
    assert sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")) == [
        "test/000000.vtkhdf", *(f"train/{index:06d}.vtkhdf" for index in (0, 2, 3, 4, 5)), "valid/000000.vtkhdf", "valid/000001.vtkhdf",
    ]  # fmt: skip
    assert done.trajectories == {"train": 5, "valid": 2, "test": 1} and done.failed == [("train", 1, "failed: too fast (frame 3)")]


@pytest.mark.parametrize(("text", "wanted"), [("::3", [0, 3, 6]), ("2:4", [2, 3]), ("5", [5]), ("-1", [7]), ("6:", [6, 7]), ("0", [0])])
def test_frames(data, tmp_path, text, wanted):
    export(data, tmp_path / "ply", "ply", split="test", frames=text)
    assert sorted(path.name for path in (tmp_path / "ply/test/000000").iterdir()) == [f"frame-{frame:05d}.ply" for frame in wanted]
    position = given_by(data, "test")[0][0]
    export(data, tmp_path / "vtk", "vtkhdf", split="test", frames=text)
    times, steps = read_vtkhdf(tmp_path / "vtk/test/000000.vtkhdf")
    assert times == ([frame * 0.0025 for frame in wanted] if len(wanted) > 1 else [])
    for frame, (points, _, speed) in zip(wanted, steps, strict=True):
        same_bits(points, padded(position[frame]))
        same_bits(speed, padded(velocities(position, [frame], 0.0025)[0]))
    mesh = meshio.read(tmp_path / f"ply/test/000000/frame-{wanted[0]:05d}.ply")
    wanted_velocity = padded(velocities(position, wanted[:1], 0.0025)[0])
    for axis, name in enumerate(("velocity_x", "velocity_y", "velocity_z")):
        same_bits(np.ascontiguousarray(mesh.point_data[name]), np.ascontiguousarray(wanted_velocity[:, axis]))


def test_one_trajectory(data, tmp_path):
    assert export(data, tmp_path / "a", "vtkhdf", split="train", index=4).trajectories == {"train": 1}
    assert [path.name for path in (tmp_path / "a/train").iterdir()] == ["000004.vtkhdf"]
    done = export(data, tmp_path / "b", "vtkhdf", index=1)
    assert done.trajectories == {"valid": 1} and done.failed == [("train", 1, "failed: too fast (frame 3)")]


def test_a_lone_shard_and_its_failed_trajectory(tmp_path):
    write_shard(tmp_path / "a.h5", {0: some(0), 1: some(1, status="failed: why"), 3: some(3)})
    done = export(tmp_path / "a.h5", tmp_path / "out", "vtkhdf")
    assert done.trajectories == {"": 2} and done.failed == [("", 1, "failed: why")]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["000000.vtkhdf", "000003.vtkhdf"]


def test_failed_trajectories_leave_no_gap_and_are_named(data, tmp_path):
    for name in LEARNER_FORMATS:
        export(data, tmp_path / name, name)
        metadata = json.loads((tmp_path / name / "metadata.json").read_text())
        assert metadata["source"]["failed"] == {"train": [1], "valid": [], "test": []}
    for found in (read_deepmind(tmp_path / "deepmind", "train"), read_lagrangebench(tmp_path / "lagrangebench", "train")):
        for (position, *_), (wanted, *_) in zip(found, given_by(data, "train"), strict=True):
            same_bits(position, wanted)


def test_an_empty_folder_will_do(data, tmp_path):
    (tmp_path / "out").mkdir()
    export(data, tmp_path / "out", "lagrangebench")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["metadata.json", "test.h5", "train.h5", "valid.h5"]


# --- what goes wrong -------------------------------------------------------------------------------------------------


def put(name, **changes):
    """Make the trajectories of a shard again, with changes."""

    def prepare(data):
        with ShardReader(data / name) as reader:
            made = {index: some(index, **changes) for index in reader.indices()}
        write_shard(data / name, made)

    return prepare


def state(*keys, value):
    return lambda data: change(data, *keys, value=value)


TEST, TRAIN = "test/shard-00000.h5", "train/shard-00000.h5"
MISTAKES = {
    "absent": (None, {"source": "absent.h5", "format": "vtkhdf"}, "no such shard"),
    "not a shard": (lambda data: (data.parent / "text.h5").write_text("hello"), {"source": "text.h5", "format": "ply"}, "not a readable HDF5 file"),
    "no data set": (lambda data: (data / "dataset.json").unlink(), {"format": "vtkhdf"}, "give the folder of a data set"),
    "format": (None, {"format": "xyz"}, "format = 'xyz': give one of vtkhdf, ply"),
    "out is a file": (None, {"format": "ply", "out": "data/dataset.json"}, "exists already"),
    "out is full": (None, {"format": "geoelements", "out": "data"}, "exists already"),
    "out below a file": (None, {"format": "geoelements", "out": "data/dataset.json/x"}, "cannot be written (Not a directory)"),
    "shard for a learner": (None, {"source": f"data/{TRAIN}", "format": "deepmind"}, "needs a data set folder"),
    "split of a shard": (None, {"source": f"data/{TRAIN}", "format": "vtu", "split": "train"}, "a shard has no splits"),
    "index for a learner": (None, {"format": "geoelements", "index": 0}, "takes whole trajectories"),
    "frames for a learner": (None, {"format": "lagrangebench", "frames": "::2"}, "takes whole trajectories"),
    "frames": (None, {"format": "ply", "frames": "a:b"}, "give start:stop:step"),
    "frames, stride 0": (None, {"format": "ply", "frames": "::0"}, "step above 0"),
    "frames, backwards": (None, {"format": "vtkhdf", "frames": "::-1"}, "step above 0"),
    "frames, four parts": (None, {"format": "ply", "frames": "1:2:3:4"}, "give start:stop:step"),
    "frames, nothing": (None, {"format": "ply", "frames": ""}, "give start:stop:step"),
    "no frames": (None, {"format": "ply", "frames": "8:"}, "selection of frames is empty"),
    "index": (None, {"format": "vtkhdf", "index": 9}, "index = 9: no such trajectory"),
    "index of a failed one": (None, {"format": "vtkhdf", "index": 1, "split": "train"}, "index = 1: failed: too fast (frame 3)"),
    "split": (state("splits", value={}), {"format": "vtkhdf", "split": "test"}, "holds no finished split"),
    "no split": (state("splits", value={}), {"format": "vtkhdf"}, "holds no finished split"),
    "foreign split": (None, {"format": "vtkhdf", "split": "../x"}, "holds train, valid, test"),
    "name too long": (None, {"format": "vtkhdf", "out": "x" * 300}, "cannot be looked into (File name too long)"),
    "entry": (state("splits", "valid", "failed", value=3), {"format": "vtkhdf"}, "splits.valid.failed = 3"),
    "entry a number": (state("splits", "valid", value=3), {"format": "vtkhdf"}, "splits.valid = 3"),
    "empty split": (state("splits", "valid", "shards", value=[]), {"format": "deepmind"}, "splits.valid = 'no good trajectory'"),
    "missing shard": (lambda data: (data / TRAIN).unlink(), {"format": "deepmind"}, "no such shard"),
    "missing trajectories": (state("splits", "train", "ok", value=6), {"format": "vtkhdf"}, "the shards hold 5"),
    "no statistics": (state("statistics", value=None), {"format": "lagrangebench"}, "generate that split"),
    "statistics": (state("statistics", "velocity_std", value=[1.0]), {"format": "deepmind"}, "velocity_std = [1.0]: must be 2 finite"),
    "radius": (put(TEST, radius=0.2), {"format": "geoelements"}, "radius = 0.2: the first trajectory has 0.1"),
    "length": (put(TEST, frames=9), {"format": "deepmind"}, "frames = 9: the first trajectory has 8"),
    "context": (put(TEST, context=np.ones((8, 2))), {"format": "deepmind"}, "context = 2: the first trajectory has None"),
    "context length": (put(TRAIN, context=np.ones((3, 2))), {"format": "deepmind"}, "must be floats [frames, c]"),
    "types": (put(TEST, position=np.zeros((8, 1, 2), np.float32), particle_type=np.array([9])), {"format": "deepmind"}, "type = [9]"),
    "no particle": (put(TEST, position=np.zeros((8, 0, 2), np.float32), particle_type=np.array([])), {"format": "geoelements"},
                    "must be float32 [frames, particles, 2 or 3]"),
    "walls": (put(TEST, position=np.zeros((8, 2, 2), np.float32), particle_type=np.array([1, 5])), {"format": "lagrangebench"}, "type = [1]"),
    "no spacing": (put(TEST, scene={}), {"format": "lagrangebench"}, "spacing = None"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_one_line_and_write_nothing(data, tmp_path, case):
    prepare, request, message = MISTAKES[case]
    request = dict(request)
    if prepare:
        prepare(data)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as caught:
        export(tmp_path / request.pop("source", "data"), tmp_path / request.pop("out", "out"), **request)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", FORMATS)
def test_damage_met_half_way_leaves_nothing(data, tmp_path, monkeypatch, name):
    read = ShardReader.positions

    def damaged(reader, index, *arguments):
        if index == 3:
            raise InputError(reader.path, f"{index:06d}/position", "?", "damaged or incomplete; delete the shard and generate again")
        return read(reader, index, *arguments)

    monkeypatch.setattr(ShardReader, "positions", damaged)
    with pytest.raises(InputError, match="damaged"):
        export(data, tmp_path / "out", name)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def assert_runs(code, *arguments):
    environment = os.environ | {"PYTHONPATH": str(HERE.parents[1])}
    done = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_full_disk_is_a_run_error_and_leaves_nothing(tmp_path):
    """Real failing writes, in a process of its own: a limit on file sizes. HDF5 would end the process with a segmentation fault."""
    write_data(tmp_path / "data", {"train": {index: some(index, 300) for index in range(12)}}, shard_size=12)
    code = (
        "import resource, sys\nfrom sim.errors import RunError\nfrom sim.export import FORMATS, export\n"
        "for name in FORMATS:\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (100 if name in ('ply', 'vtu') else 20_000, resource.RLIM_INFINITY))\n"
        "    try:\n        export(sys.argv[1], sys.argv[2], name)\n"
        "    except RunError as error:\n        assert 'cannot be written: File too large' in str(error), error\n"
        "    else:\n        sys.exit(f'{name} was written')\n"
    )
    assert_runs(code, tmp_path / "data", tmp_path / "out")
    assert os.listdir(tmp_path) == ["data"]


def test_writes_that_fail_late_or_in_part_are_noticed(tmp_path):
    """A write that takes less than it was given; what HDF5 writes only when it closes the file."""
    code = (
        "import resource, sys\nfrom sim.trajectory import Disk, new_hdf5\nresource.setrlimit(resource.RLIMIT_FSIZE, (5, resource.RLIM_INFINITY))\n"
        "disk = Disk(sys.argv[1], 'w+')\ndisk.write(b'ten bytes.')\n"
        "try:\n    disk.check()\nexcept OSError:\n    pass\nelse:\n    sys.exit('in part')\n"
        "try:\n    with new_hdf5(sys.argv[1]) as (file, disk):\n        file.create_group('a')\n"
        "except OSError:\n    pass\nelse:\n    sys.exit('late')\n"
    )
    assert_runs(code, tmp_path / "a.h5")


def test_a_failed_flush_leaves_nothing(data, tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunError, match="No space left"):
        export(data, tmp_path / "out", "vtkhdf")
    assert os.listdir(tmp_path) == ["data"]


@pytest.mark.parametrize("name", ["vtkhdf", "lagrangebench"])
def test_ctrl_c_below_hdf5_leaves_nothing(data, tmp_path, monkeypatch, name):
    """An exception in HDF5's own calls to the disk would be a failed write to it."""
    monkeypatch.setattr(sim.trajectory, "memoryview", lambda _: (_ for _ in ()).throw(KeyboardInterrupt), raising=False)
    with pytest.raises(KeyboardInterrupt):
        export(data, tmp_path / "out", name)
    assert os.listdir(tmp_path) == ["data"]


# --- the command line ------------------------------------------------------------------------------------------------


def test_command(data, tmp_path, capsys):
    assert main(["export", str(data), "--format", "deepmind", "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "left out: train 000001: failed: too fast (frame 3)",
        f"{tmp_path}/out: trajectories as deepmind: train 5, valid 2, test 1; 1 failed left out",
    ]
    assert main(["export", str(data), "--format", "deepmind", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("sluice-sim: ") and "exists already" in error and error.count("\n") == 1
    shard = str(data / "test/shard-00000.h5")
    assert main(["export", shard, "--format", "ply", "--frames=-1", "--index", "0", "--out", str(tmp_path / "last")]) == 0
    assert [path.name for path in (tmp_path / "last/000000").iterdir()] == ["frame-00007.ply"]


def test_command_says_what_has_no_place(tmp_path, capsys):
    data = write_data(tmp_path / "data", {"train": {0: some(0, 3, **shaken({}, 0, 1, 2))}})
    for name, line in {
        "geoelements": "context = container_acceleration: left out, geoelements has no place for it; deepmind has",
        "ply": "context = container_acceleration, sand.friction_angle: left out, ply has no place for it; vtkhdf has",
    }.items():
        assert main(["export", str(data), "--format", name, "--out", str(tmp_path / name)]) == 0
        assert capsys.readouterr().err == f"sluice-sim: {tmp_path / name}: {line}\n"
    assert main(["export", str(data), "--format", "vtkhdf", "--out", str(tmp_path / "all")]) == 0
    assert capsys.readouterr().err == ""


def test_command_knows_the_formats(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["export", "a", "--format", "xyz", "--out", "b"])
    error = capsys.readouterr().err
    assert caught.value.code == 2 and all(name in error for name in FORMATS)
    assert set(VIEWER_FORMATS) | set(LEARNER_FORMATS) == set(FORMATS)
