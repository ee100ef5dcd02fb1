"""Damaged scenes and data: a correct read, or one line and exit code 2, in bounded time and memory (``mutations.told``); nothing written or run."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent / "learn")]

from bouncing import bounce  # noqa: E402
from fake_teacher import FakeTeacher  # noqa: E402
from mutations import SHARDS, SOUND, change_shard, spoil_json, spoil_shard, spoil_yaml, told  # noqa: E402
from test_generate import run_here  # noqa: E402

import sim.generate  # noqa: E402
from sim import render  # noqa: E402
from sim.cli import main  # noqa: E402
from sim.export import FORMATS, VIEWER_FORMATS  # noqa: E402
from sim.generate import training_statistics  # noqa: E402
from sim.trajectory import write_shard  # noqa: E402

SCENES = sorted((HERE.parents[1] / "configs/scenes").glob("*.yaml"))


class Frozen(FakeTeacher):
    """Nothing moves, obstacles included."""

    def load(self, scene):
        self.position = scene.start()

    def frame(self):
        return self.position

    def diagnostics(self):
        return {}


@pytest.fixture
def quick(monkeypatch):
    """A generator that works in this process and simulates nothing, pictures that need no OpenGL, and nothing waits for the disk."""
    monkeypatch.setattr(sim.generate, "_run_workers", run_here)
    monkeypatch.setitem(sim.generate.generate.__kwdefaults__, "teacher", Frozen)
    monkeypatch.setattr("sim.scene._TRIES", 20)
    monkeypatch.setattr(render, "gl_works", lambda: False)
    monkeypatch.setattr(os, "fsync", lambda _: None)


def read_scene(folder, path):
    """Exit code and what was said of a scene file by the two commands that read one; they agree."""
    plan, generate = (told(main, *command) for command in (
        ("plan", path), ("generate", path, "--split", "test", "--count", "1", "--frames", "2", "--out", folder / "out"),
    ))  # fmt: skip
    assert generate == plan or plan[0] == 0 and generate[0] in (0, 2)  # within a budget, say
    assert generate[0] == 0 or not (folder / "out").exists()
    shutil.rmtree(folder / "out", ignore_errors=True)
    assert sorted(folder.iterdir()) == [path], "nothing else is left, and no tag of the file made a folder"
    return plan


def test_scenes(tmp_path, quick):
    """Four mutations of each scene file."""
    codes = []
    for trial in range(4 * len(SCENES)):
        source, rng = SCENES[trial % len(SCENES)], np.random.default_rng([1, trial])
        path = tmp_path / source.name
        path.write_bytes(spoil_yaml(source.read_text(), rng, tmp_path / "mark"))
        codes.append(read_scene(tmp_path, path)[0])
        path.unlink()
    assert codes.count(0) > 2 and codes.count(2) > 50


BOMB = "\n".join(["a0: &a0 [x, x, x, x, x, x, x, x, x]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12))])
SCENE = (HERE.parents[1] / "configs/scenes/water.yaml").read_text()
#: What once ended in a traceback, or did not end.
REGRESSIONS = {
    "aliases of aliases": (f"{SCENE}\n{BOMB}", "file = '3.57e+11 entries': aliases"), "an alias of itself": (f"{SCENE}\nx: &x [*x]", "'inf entries'"),
    "a tag without a value": (SCENE.replace("dim: 2", "dim: !!int"), "not valid YAML"), "a date": (f"{SCENE}\nmade: 2020-01-01", "unknown key"),
    "bytes": (f"{SCENE}\nx: !!binary /w==", "could not determine a constructor"),
    "speed beyond float32": (SCENE.replace("velocity: [", "velocity: [1.0e+308, 0.0] # ["), "less than or equal to 1"),
    "a novel": ("x: " + "word " * 100_000, "longer than 262144 characters"),
}  # fmt: skip


@pytest.mark.parametrize("case", REGRESSIONS)
def test_scenes_that_once_went_wrong(tmp_path, quick, case):
    text, said = REGRESSIONS[case]
    assert text != SCENE
    (tmp_path / "scene.yaml").write_text(text)
    code, error = read_scene(tmp_path, tmp_path / "scene.yaml")
    assert code == 2 and said in error, error


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A data set of two trajectories; beside its shard lies ``other.h5``, to which links point."""
    folder = tmp_path_factory.mktemp("data") / "good"
    name = "train/shard-00000.h5"
    write_shard(folder / name, {index: bounce(index, 12, 12) for index in range(2)})
    shutil.copy(folder / name, folder / "train/other.h5")
    entry = {"trajectories": 2, "ok": 2, "failed": [], "shards": [name], "cost": {"wall_seconds": 1.0, "compile_seconds": 0.0}}
    content = {"format_version": 1, "scene": "bounce", "family": {}, "seed": None, "shard_size": 2, "splits": {"train": entry}}
    (folder / "dataset.json").write_text(json.dumps(content | {"statistics": training_statistics([folder / name])}))
    assert told(main, "validate", folder)[0] == 0
    return folder


def read_data(data, trial):
    """Exit codes of the commands that read a data set and its shard: info of both, validate of both; render or an export, in turn."""
    shard, out, format = data / "train/shard-00000.h5", data.parent / "out", FORMATS[trial // 2 % len(FORMATS)]
    last = ("render", shard, "--out", out / "still.png") if trial % 4 == 0 else ("export", data, "--format", format, "--out", out)
    if trial % 4 == 2 and format in VIEWER_FORMATS:
        last = ("export", shard, "--format", format, "--out", out)
    codes = [told(main, *command)[0] for command in (("info", data), ("info", shard), ("validate", shard), ("validate", data), last)]
    assert codes[4] == 0 or not [path for path in out.rglob("*") if path.is_file()]
    shutil.rmtree(out, ignore_errors=True)
    return codes


@pytest.mark.filterwarnings("ignore:no OpenGL here:RuntimeWarning", "ignore::RuntimeWarning:numpy", "ignore::RuntimeWarning:sim")
def test_data(tmp_path, quick, good):
    """Every change of a shard that HDF5 allows; then bytes, ``meta`` and ``dataset.json`` at random."""
    codes, data = [], tmp_path / "data"
    for trial in range(len(SHARDS) + 45):
        shutil.copytree(good, data)
        shard, rng = data / "train/shard-00000.h5", np.random.default_rng([2, trial])
        case = list(SHARDS)[trial] if trial < len(SHARDS) else None
        if case:
            change_shard(shard, case)
        elif trial % 3:
            spoil_shard(shard, rng, trial // 3)
        else:
            (data / "dataset.json").write_bytes(spoil_json((data / "dataset.json").read_text(), rng, trial // 3))
        codes.append(read_data(data, trial))
        if case:
            assert (codes[-1][2] == 0) == (case in SOUND), (case, codes[-1])
        shutil.rmtree(data)
    assert sum(set(found) == {0} for found in codes) > 5 and sum(2 in found for found in codes) > 60
