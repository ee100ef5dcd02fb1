"""Faults of disks, files, processes and numbers: each is named in one line, finished shards are intact, and a resumed run gives the same bytes."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent / "learn")]  # worker processes inherit it

from bouncing import bounce  # noqa: E402
from disks import mounted, small_disk  # noqa: E402
from fake_teacher import POISON_FRAME, POISON_PARTICLE, POISONS, FakeTeacher, poisoned  # noqa: E402
from tiny import family, hidden, shards, without_cost  # noqa: E402

from sim import render  # noqa: E402
from sim.cli import main  # noqa: E402
from sim.errors import InputError, RunError  # noqa: E402
from sim.generate import generate  # noqa: E402
from sim.info import faults  # noqa: E402
from sim.scene import SceneFamily  # noqa: E402
from sim.trajectory import ShardReader, write_shard  # noqa: E402

#: Water and sand thrown at a ball on the floor.
MIXED = {
    "name": "mixed",
    "dim": 2,
    "bounds": [[0.0, 1.0], [0.0, 1.0]],
    "gravity": [0.0, -9.8],
    "frame_step": 0.005,
    "frames": 81,
    "radius": 0.08,
    "cells": [32, 32],
    "materials": {"water": {"model": "water", "sound_speed": 12.0}, "sand": {"model": "sand", "young_modulus": 1e5, "friction_angle": 35.0}},
    "bodies": [
        {"material": "water", "shape": {"kind": "box", "size": [[0.3, 0.4], [0.3, 0.4]]}, "velocity": [[-1.0, 1.0], [-1.0, 0.0]]},
        {"material": "sand", "shape": {"kind": "box", "size": [[0.2, 0.3], [0.2, 0.3]]}, "velocity": [[-1.0, 1.0], [-1.0, 0.0]]},
    ],
    "obstacles": [{"kind": "ball", "radius": 0.1, "count": [1, 1], "center": [[0.3, 0.7], 0.15]}],
    "splits": {"train": 16, "valid": 0, "test": 0},
}
#: The same without the ball, in a cube.
CUBE = {
    "dim": 3,
    "bounds": [[0.0, 1.0]] * 3,
    "gravity": [0.0, -9.8, 0.0],
    "frames": 9,
    "cells": [12, 12, 12],
    "radius": 0.2,
    "obstacles": [],
    "bodies": [
        {"material": "water", "shape": {"kind": "box", "size": [0.4, 0.3, 0.3]}, "velocity": [[-1.0, 1.0], [-1.0, 0.0], 0.0]},
        {"material": "sand", "shape": {"kind": "box", "size": [0.3, 0.3, 0.3]}, "velocity": [[-1.0, 1.0], [-1.0, 0.0], 0.0]},
    ],
}


# -- processes


def command(scene, out):
    return [sys.executable, "-m", "sim", "generate", str(scene), "--split", "train", "--shard-size", "1", "--out", str(out)]


def test_kill_9_at_twenty_instants(tmp_path):
    """Twenty kills of the real command at random instants, resumed each time, beside a run that nobody disturbed.

    A quarter of the instants lie before the first shard of a run, the others in what it has left to do. A run that ends before its
    instant is compared, and another one begins.
    """
    scene, unbroken, folder = tmp_path / "mixed.yaml", tmp_path / "unbroken", tmp_path / "broken"
    scene.write_text(yaml.safe_dump(MIXED))
    # A cache of its own: a kill may leave that of the other tests locked.
    environment = os.environ | {"PYTHONPATH": str(HERE.parent.parent), "SLUICE_TAICHI_CACHE": str(tmp_path / "cache")}

    def start(out):
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen(command(scene, out), env=environment, start_new_session=True, **silent)

    assert start(tmp_path / "warm").wait() == 0
    begun, first, process = time.monotonic(), None, start(unbroken)
    while process.poll() is None:
        time.sleep(0.01)
        first = first or (time.monotonic() - begun if shards(unbroken) else None)
    working = time.monotonic() - begun - first
    expected, content = shards(unbroken), without_cost(unbroken)
    assert process.returncode == 0 and len(expected) == 16 and shards(tmp_path / "warm") == expected
    rng, stages, chains, pace = np.random.default_rng(20), [], 1, 1.0
    while len(stages) < 20:
        before = len(shards(folder))
        left, early = 1 - before / 16, len(stages) % 4 == 0
        instant = pace * (rng.uniform(0, first) if early else first + rng.uniform(0, working) * left)
        process = start(folder)
        try:
            assert process.wait(timeout=instant) == 0
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            present = shards(folder)
            stages.append(len(present))
            if not early and len(present) == before:
                pace = min(1.3 * pace, 2.0)
            assert present.items() <= expected.items(), "what is there is finished, to the last byte"
        else:
            assert shards(folder) == expected and without_cost(folder) == content and not hidden(folder)
            chains, pace = chains + 1, 0.8 * pace  # the machine may be freer than it was when it was timed
            folder = tmp_path / f"broken-{chains}"
    assert start(folder).wait() == 0
    assert shards(folder) == expected and without_cost(folder) == content and not hidden(folder)
    assert len(set(stages)) >= 4, f"the kills met too few stages to mean much: {stages}"


# -- numbers


def status_of(field, value):
    """What the status of a trajectory must say of a poison."""
    if field == "position" and np.isfinite(value):
        return rf"particle {POISON_PARTICLE} is off the grid, at \[.*\]"
    return rf"{'sand.b - I' if field == 'strain' else field} of particle {POISON_PARTICLE} is not finite"


@pytest.mark.parametrize("changes", [{"frames": 21}, CUBE], ids=["2D", "3D"])
def test_spoilt_numbers_are_named_and_spoil_nothing_else(tmp_path, capfd, changes):
    """NaN in a velocity or in b - I, a particle thrown out of the grid: one line each, and the other trajectories as without them."""
    mixed = SceneFamily(MIXED | changes, "mixed.yaml")
    generate(mixed, {"train": 8}, tmp_path / "sound", shard_size=1)
    sound = shards(tmp_path / "sound")
    assert len(sound) == 8
    capfd.readouterr()
    content = generate(mixed, {"train": 8}, tmp_path / "spoilt", shard_size=1, teacher=poisoned)
    failed = {entry["index"]: entry["status"] for entry in content["splits"]["train"]["failed"]}
    lines = [line for line in capfd.readouterr().err.splitlines() if "failed:" in line]
    assert failed.keys() == POISONS.keys() and len(lines) == len(POISONS)
    for (index, poison), line in zip(POISONS.items(), lines, strict=True):
        assert re.fullmatch(rf"failed: {status_of(*poison)} \(frame {POISON_FRAME}\)", failed[index])
        assert line == f"train: a trajectory {failed[index]}; it is listed in dataset.json and left out"
    assert shards(tmp_path / "spoilt") == {f"train/shard-{index:05d}.h5": sound[f"train/shard-{index:05d}.h5"] for index in (0, 4)}


# -- disks


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Six trajectories in six shards."""
    folder = tmp_path_factory.mktemp("reference") / "tiny"
    generate(family(), {"train": 6}, folder, shard_size=1, teacher=FakeTeacher)
    return folder


def test_disk_full(tmp_path, reference):
    """It fills up under the shards, then under dataset.json; with room again, the run ends with the bytes of one that had room."""
    disk, folder = tmp_path / "disk", tmp_path / "disk/tiny"
    with mounted(disk, "-t", "tmpfs", "-o", "size=96k", "none"):
        with pytest.raises(RunError, match=r"shard-0000\d.h5: cannot be written: No space left on device; finished shards are kept") as caught:
            generate(family(), {"train": 6}, folder, shard_size=1, teacher=FakeTeacher)
        assert "\n" not in str(caught.value)
        before, expected = shards(folder), shards(reference)
        assert 0 < len(before) < 6 and before.items() <= expected.items() and not hidden(folder)
        with open(disk / "filler", "wb", buffering=0) as file, pytest.raises(OSError):
            while True:
                file.write(b"0" * 4096)
        with pytest.raises(RunError, match="tiny: No space left on device; finished shards are kept") as caught:
            generate(family(), {"train": 6}, folder, shard_size=1, teacher=FakeTeacher)
        assert "\n" not in str(caught.value)
        assert shards(folder) == before and not hidden(folder)
        subprocess.run(["mount", "-o", "remount,size=10m", str(disk)], check=True)
        generate(family(), {"train": 6}, folder, shard_size=1, teacher=FakeTeacher)
        assert shards(folder) == expected and without_cost(folder) == without_cost(reference)


@pytest.mark.parametrize("name", ["film.mp4", "still.png"])
@pytest.mark.filterwarnings("ignore:no OpenGL here:RuntimeWarning")
def test_pictures_on_a_full_disk(tmp_path, capfd, monkeypatch, name):
    """One line and no half picture, wherever the disk fills up; with room, the bytes of one that had room."""
    monkeypatch.setattr(render, "gl_works", lambda: False)
    disk, shard, whole = tmp_path / "disk", tmp_path / "shard.h5", tmp_path / name
    write_shard(shard, {0: bounce(0, 100, 8)})
    assert main(["render", str(shard), "--out", str(whole)]) == 0
    capfd.readouterr()
    with small_disk(disk) as leave:
        for free in (0, 4096, 8192, len(whole.read_bytes()) // 2):
            leave(free)
            assert main(["render", str(shard), "--out", str(disk / name)]) == 1
            said = capfd.readouterr().err
            assert said.startswith(f"sluice-sim: {disk / name}: ") and said.endswith("No space left on device\n") and said.count("\n") == 1, said
            assert os.listdir(disk) == ["filler"]
        leave(None)
        assert main(["render", str(shard), "--out", str(disk / name)]) == 0
        assert (disk / name).read_bytes() == whole.read_bytes()


def test_read_only_folder(tmp_path, reference):
    """A new data set is refused, one that is finished is found finished, one that is not keeps what it has."""
    disk = tmp_path / "disk"
    disk.mkdir()
    generate(family(), {"train": 2}, disk / "tiny", shard_size=1, teacher=FakeTeacher)
    before = shards(disk / "tiny")
    with mounted(disk, "--bind", str(disk)):
        subprocess.run(["mount", "-o", "remount,ro,bind", str(disk)], check=True)
        with pytest.raises(InputError, match=r"new: out = .*: cannot be written \(Read-only file system\); give another folder") as caught:
            generate(family(), {"train": 1}, disk / "new", teacher=FakeTeacher)
        assert "\n" not in str(caught.value) and not (disk / "new").exists()
        assert generate(family(), {"train": 2}, disk / "tiny", shard_size=1, teacher=FakeTeacher)["splits"]["train"]["ok"] == 2
        with pytest.raises(RunError, match="tiny: Read-only file system; finished shards are kept") as caught:
            generate(family(), {"train": 6}, disk / "tiny", shard_size=1, teacher=FakeTeacher)
        assert "\n" not in str(caught.value)
    assert shards(disk / "tiny") == before and before.items() <= shards(reference).items()


# -- files


def test_a_truncated_shard_is_named_wherever_it_ends(tmp_path, reference, capfd):
    """At twenty lengths: one line that names the file; the resumed run makes that shard again and touches no other."""
    folder = tmp_path / "tiny"
    (folder / "train").mkdir(parents=True)
    for path in (*reference.glob("*.json"), *reference.glob("train/*")):
        (folder / path.relative_to(reference)).write_bytes(path.read_bytes())
    shard, others = folder / "train/shard-00003.h5", [path for path in folder.glob("train/*.h5") if "00003" not in path.name]
    whole, stamps = shard.read_bytes(), [path.stat().st_mtime_ns for path in others]
    for length in np.random.default_rng(1).integers(0, len(whole), 20):
        shard.write_bytes(whole[:length])
        (fault,) = faults(folder)
        assert str(shard) in fault and "\n" not in fault
        with pytest.raises(InputError, match=str(shard)), ShardReader(shard) as reader:
            reader.read(3)
    capfd.readouterr()
    generate(family(), {"train": 6}, folder, shard_size=1, teacher=FakeTeacher)
    said = capfd.readouterr().err.splitlines()
    assert sum(str(shard) in line and line.endswith("making it again") for line in said) == 1
    assert shards(folder) == shards(reference) and [path.stat().st_mtime_ns for path in others] == stamps
