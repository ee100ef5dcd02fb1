"""The trajectory file: what goes in comes out, the same bytes each time, complete or absent, and damage is an ``InputError``."""

import errno
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from sim.errors import InputError
from sim.trajectory import ShardReader, Trajectory, atomic_path, write_json, write_shard


def trajectory(frames=20, particles=30, dim=2, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "position": rng.random((frames, particles, dim)).astype(np.float32),
        "particle_type": rng.choice([3, 5, 6], particles).astype(np.int8),
        "frame_step": 0.0025,
        "radius": 0.015,
        "bounds": np.array([[0.1, 0.9]] * dim),
        "scene": {"name": "made up", "gravity": [0.0, -9.8]},
        "seed": 2**53 - 1,
        "simulator": {"name": "none"},
        "context": rng.random((frames, 2)).astype(np.float32),
        "diagnostics": {"kinetic_energy": rng.random(frames), "substeps": np.ones(frames)},
    }
    return Trajectory(**(fields | changes))


@pytest.fixture
def shard(tmp_path):
    path = tmp_path / "shard-00000.h5"
    write_shard(path, {3: trajectory(seed=3), 7: trajectory(seed=7, particles=5, context=None, diagnostics={})})
    return path


def test_round_trip_is_exact(shard):
    with ShardReader(shard) as reader:
        assert reader.indices() == [3, 7]
        assert reader.shape(7) == (20, 5, 2)
        found, given = reader.read(3), trajectory(seed=3)
        last = reader.read(7)
    for name in ("position", "particle_type", "bounds", "context"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))
        assert getattr(found, name).dtype == getattr(given, name).dtype
    for name in ("frame_step", "radius", "scene", "seed", "simulator", "status"):
        assert getattr(found, name) == getattr(given, name)
    assert set(found.diagnostics) == {"kinetic_energy", "substeps"}
    np.testing.assert_array_equal(found.diagnostics["kinetic_energy"], given.diagnostics["kinetic_energy"])
    assert last.context is None and last.diagnostics == {}
    np.testing.assert_array_equal(found.moving, given.particle_type != 3)


def test_three_dimensions_and_failed_status(tmp_path):
    write_shard(tmp_path / "a.h5", {0: trajectory(dim=3, status="failed: why (frame 4)")})
    found = ShardReader(tmp_path / "a.h5").read(0)
    assert found.position.shape == (20, 30, 3) and not found.ok and found.status == "failed: why (frame 4)"


def test_windows(shard):
    with ShardReader(shard) as reader:
        whole = reader.positions(3)
        np.testing.assert_array_equal(reader.positions(3, 2, 12, 3), whole[2:12:3])
        np.testing.assert_array_equal(reader.positions(3, 15), whole[15:])
        assert reader.file["000003/position"].chunks is None, "contiguous: see the module's docstring"


def test_same_bytes_twice(shard, tmp_path):
    time.sleep(1.1)  # HDF5 would store times in seconds
    other = tmp_path / "other-name.h5"
    with ShardReader(shard) as reader:
        write_shard(other, {index: reader.read(index) for index in reversed(reader.indices())})
    assert other.read_bytes() == shard.read_bytes()


def test_a_reader_can_be_pickled_with_its_file_open(shard):
    reader = ShardReader(shard)
    reader.read(3)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(reader)).positions(7), reader.positions(7))


def test_missing_trajectory(shard):
    with pytest.raises(InputError, match=r"trajectory = 5: the shard holds \[3, 7\]"):
        ShardReader(shard).read(5)


@pytest.mark.parametrize("keep", [0, 1, 100, 0.3, 0.9, -1])
def test_truncated_files(shard, keep):
    data = shard.read_bytes()
    shard.write_bytes(data[: int(keep * len(data)) if 0 < keep < 1 else keep])
    with pytest.raises(InputError) as caught:
        ShardReader(shard).read(3)
    assert str(shard) in str(caught.value) and "\n" not in str(caught.value)


def test_flipped_bytes_never_end_in_a_traceback(shard):
    """One damaged byte: the reader reads something, or says in one line what is wrong."""
    data = bytearray(shard.read_bytes())
    rng = np.random.default_rng(0)
    structural = np.flatnonzero(np.frombuffer(bytes(data), np.uint8)[:3000])
    for place in [*rng.integers(len(data), size=100), *rng.choice(structural, 200)]:
        broken = bytearray(data)
        broken[place] ^= int(rng.integers(1, 256))
        shard.write_bytes(broken)
        try:
            with ShardReader(shard) as reader:
                for index in reader.indices():
                    reader.read(index)
        except InputError as error:
            assert "\n" not in str(error)


def damage(path, change):
    with h5py.File(path, "r+") as file:
        change(file)


DAMAGES = {
    "no meta": lambda file: file["000003"].attrs.pop("meta"),
    "meta not JSON": lambda file: file["000003"].attrs.modify("meta", "{"),
    "meta a number": lambda file: file["000003"].attrs.modify("meta", "3"),
    "meta incomplete": lambda file: file["000003"].attrs.modify("meta", '{"seed": 1}'),
    "no position": lambda file: file["000003"].pop("position"),
    "no types": lambda file: file["000003"].pop("particle_type"),
    "position a group": lambda file: (file["000003"].pop("position"), file["000003"].create_group("position")),
    "types too short": lambda file: (file["000003"].pop("particle_type"), file["000003"].create_dataset("particle_type", data=np.zeros(3, np.int8))),
    "doubles": lambda file: (file["000003"].pop("position"), file["000003"].create_dataset("position", data=np.zeros((20, 30, 2)))),
    "a dataset for a group": lambda file: (file.pop("000003"), file.create_dataset("000003", data=[1.0])),
    "foreign group": lambda file: file.create_group("hello"),
    "version": lambda file: file.attrs.modify("format_version", 99),
    "version a word": lambda file: file.attrs.create("format_version", "two"),
    "context a group": lambda file: (file["000003"].pop("context"), file["000003"].create_group("context")),
    "diagnostics a dataset": lambda file: (file["000003"].pop("diagnostics"), file["000003"].create_dataset("diagnostics", data=[1.0])),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_contents(shard, case):
    damage(shard, DAMAGES[case])
    with pytest.raises(InputError) as caught, ShardReader(shard) as reader:
        reader.indices()
        reader.read(3)
    assert str(shard) in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_no_shards(tmp_path):
    (tmp_path / "text.h5").write_text("hello")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["x"] = 1.0
    for name in ("absent.h5", "text.h5", "foreign.h5", "."):
        with pytest.raises(InputError):
            ShardReader(tmp_path / name).indices()


def test_disk_full_leaves_the_old_file_and_no_other(shard, monkeypatch):
    before = shard.read_bytes()

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_shard(shard, {0: trajectory()})
    assert os.listdir(shard.parent) == [shard.name] and shard.read_bytes() == before


def test_a_file_that_outgrows_its_limit_is_an_os_error(tmp_path):
    """A real failing write, in a process of its own: HDF5 itself would raise RuntimeError, or worse when closing."""
    code = (
        "import errno, resource, sys\nsys.path.insert(0, sys.argv[2])\nfrom test_trajectory import trajectory, write_shard\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))\n"
        "try:\n    write_shard(sys.argv[1], {0: trajectory()})\n"
        "except OSError as error:\n    sys.exit(0 if error.errno == errno.EFBIG else 1)\nsys.exit(2)\n"
    )
    here = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": str(here.parents[1])}
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.h5"), str(here)], env=environment).returncode == 0
    assert os.listdir(tmp_path) == []


def test_an_error_while_writing_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), atomic_path(tmp_path / "below/file.bin") as temporary:
        temporary.write_bytes(b"half")
        assert not (tmp_path / "below/file.bin").exists()
        raise RuntimeError("stop")
    assert os.listdir(tmp_path / "below") == []
    with pytest.raises(ValueError):
        write_json(tmp_path / "nan.json", {"x": float("nan")})
    assert not (tmp_path / "nan.json").exists()
