"""The command line: exit codes, one line for a user's mistake, and that it starts at once."""

import fcntl
import json
import os
import struct
import subprocess
import sys
import termios
from pathlib import Path

import h5py
import numpy as np
import pytest

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from fake_teacher import AlwaysFailing, FakeTeacher  # noqa: E402
from test_generate import FAMILY, run_here  # noqa: E402

import sim.generate  # noqa: E402
from sim.cli import main  # noqa: E402

ENVIRONMENT = os.environ | {"PYTHONPATH": str(HERE.parents[1])}


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A scene file, and a generator that works in this process with a teacher that costs nothing."""
    monkeypatch.setattr(sim.generate, "_run_workers", run_here)
    monkeypatch.setitem(sim.generate.generate.__kwdefaults__, "teacher", FakeTeacher)
    path = tmp_path / "tiny.yaml"
    path.write_text(json.dumps(FAMILY | {"variants": {"light": {"gravity": [0.0, -1.0]}}}))
    return path


@pytest.fixture
def data(scene, tmp_path):
    assert main(["generate", str(scene), "--out", str(tmp_path / "data"), "--shard-size", "4"]) == 0
    return tmp_path / "data"


def run(*arguments):
    return main([str(argument) for argument in arguments])


def one_line(capsys):
    captured = capsys.readouterr()
    assert captured.err.startswith("sluice-sim: ") and captured.err.count("\n") == 1, captured.err
    return captured.err


def test_help_is_quick_and_imports_nothing_heavy():
    code = (
        "import sys\nfrom sim.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit as error:\n    assert not error.code\n"
        "assert not {'numpy', 'taichi', 'torch', 'h5py', 'pydantic'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True, capture_output=True)


def test_python_m_sim():
    done = subprocess.run([sys.executable, "-m", "sim", "info", "absent.yaml"], env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith("sluice-sim: absent.yaml: ") and done.stderr.count("\n") == 1


def test_sim_never_imports_torch():
    code = (
        "import sys, pkgutil, sim\nfor module in pkgutil.iter_modules(sim.__path__):\n    if module.name != '__main__':\n"
        "        __import__(f'sim.{module.name}')\nassert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_generate_makes_the_splits_of_the_family(scene, tmp_path, capsys):
    assert run("generate", scene, "--out", tmp_path / "data") == 0
    content = json.loads((tmp_path / "data/dataset.json").read_text())
    assert {split: entry["trajectories"] for split, entry in content["splits"].items()} == {"train": 6, "valid": 2, "test": 2}
    assert "train: 6 trajectories, 0 failed (0.0%)" in capsys.readouterr().out


def test_generate_options(scene, tmp_path):
    out = tmp_path / "data"
    assert run("generate", scene, "--variant", "light", "--split", "valid", "--count", 3, "--frames", 5, "--seed", 9, "--jobs", 2, "--out", out) == 0
    content = json.loads((out / "dataset.json").read_text())
    assert content["scene"] == "tiny-light" and content["seed"] == 9 and content["statistics"] is None
    assert content["splits"]["valid"]["trajectories"] == 3
    with h5py.File(out / "valid/shard-00000.h5") as file:
        assert file["000000/position"].shape[0] == 5
        assert json.loads(file["000000"].attrs["meta"])["scene"]["gravity"] == [0.0, -1.0]


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"colour": 1}, [], "tiny.yaml: colour = 1: unknown key"),
        ({}, ["--variant", "heavy"], "variant = 'heavy'"),
        ({}, ["--count", "3"], "--split"),
        ({"radius": 0.01}, [], "radius = 0.01: below the particle spacing"),
    ],
)
def test_mistakes_exit_with_2_and_write_nothing(scene, tmp_path, capsys, change, options, message):
    scene.write_text(json.dumps(json.loads(scene.read_text()) | change))
    assert run("generate", scene, "--out", tmp_path / "data", *options) == 2
    assert message in one_line(capsys)
    assert not (tmp_path / "data").exists()


def test_what_exceeds_the_budget_is_refused_before_the_run(scene, tmp_path, capsys):
    content = json.loads(scene.read_text())
    name, material = next(iter(content["materials"].items()))
    scene.write_text(json.dumps(content | {"materials": {name: material | {"sound_speed": 1e7}}}))
    assert run("generate", scene, "--out", tmp_path / "data", "--budget", "0.5") == 2
    said = one_line(capsys)
    assert "hours of one core" in said and "wave speed 1e+07 m/s" in said and "raise --budget" in said
    assert not (tmp_path / "data").exists()
    assert run("generate", scene, "--out", tmp_path / "data", "--budget", "1e9") == 0


@pytest.mark.parametrize("arguments", ["", "generate", "generate a.yaml --out x --jobs 0", "paint", "plan a --frames 1"])
def test_usage_exits_with_2(arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments.split())
    assert caught.value.code == 2


def test_all_failing_exits_with_1(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sim.generate.generate.__kwdefaults__, "teacher", AlwaysFailing)
    assert run("generate", scene, "--split", "test", "--out", tmp_path / "data") == 1
    assert "all 2 trajectories of test failed" in capsys.readouterr().err.splitlines()[-1]


def test_interrupt_exits_with_130(scene, tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sim.generate, "_run_workers", interrupted)
    assert run("generate", scene, "--out", tmp_path / "data") == 130
    assert "the same command continues" in capsys.readouterr().err


def test_info(data, scene, capsys):
    assert run("info", data) == 0
    text = capsys.readouterr().out
    assert "train: 6 of 6 trajectories in 2 shards" in text and "velocity_std" in text and "neighbours" in text
    assert run("info", data / "train/shard-00001.h5") == 0
    assert "000004: 12 frames of 0.01 s" in capsys.readouterr().out
    assert run("info", scene) == 0
    assert "scene tiny: 2D" in capsys.readouterr().out
    for wrong in ("absent", "absent.h5", data / "train"):
        assert run("info", wrong) == 2
        one_line(capsys)


def test_validate_sound(data, capsys):
    assert run("validate", data) == 0
    assert run("validate", data / "train/shard-00000.h5") == 0
    assert capsys.readouterr().out.endswith("sound\n")


def change_position(data, value):
    with h5py.File(data / "train/shard-00000.h5", "r+") as file:
        file["000001/position"][3, 0, 0] = value


def set_in(data, *keys, value):
    content = json.loads((data / "dataset.json").read_text())
    target = content
    for key in keys[:-1]:
        target = target[key]
    target[keys[-1]] = value
    (data / "dataset.json").write_text(json.dumps(content))


def truncate(data):
    path = data / "train/shard-00001.h5"
    path.write_bytes(path.read_bytes()[:1000])


FAULTS = {
    "non-finite": (lambda data: change_position(data, np.nan), "shard-00000.h5: 000001: non-finite position in frame 3"),
    "outside": (lambda data: change_position(data, 1.5), "000001: a particle outside the box in frame 3"),
    "truncated": (truncate, "shard-00001.h5: file = "),
    "missing shard": (lambda data: (data / "train/shard-00001.h5").unlink(), "no such shard"),
    "statistics": (lambda data: set_in(data, "statistics", "neighbours", value=1.0), "statistics: do not match"),
    "counts": (lambda data: set_in(data, "splits", "valid", "trajectories", value=5), "2 trajectories found, 5 promised"),
    "seed": (lambda data: set_in(data, "seed", value=4), "not the one its index gives"),
    "entry": (lambda data: set_in(data, "splits", "test", "failed", value=None), "splits.test.failed = None: missing"),
    "version": (lambda data: set_in(data, "format_version", value=7), "format_version = 7"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_validate_names_each_fault(data, case, capsys):
    change, message = FAULTS[case]
    change(data)
    capsys.readouterr()
    assert run("validate", data) == 2
    captured = capsys.readouterr()
    assert message in captured.out and "Traceback" not in captured.err


def test_render(data, tmp_path, capsys):
    out = tmp_path / "still.png"
    assert run("render", data / "train/shard-00000.h5", "--index", 2, "--out", out) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    assert run("render", data / "train/shard-00000.h5", "--index", 5, "--out", out) == 2
    assert "the shard holds [0, 1, 2, 3]" in one_line(capsys)
    assert run("render", data / "train/shard-00000.h5", "--out", tmp_path / "film.doc") == 2
    one_line(capsys)


def test_a_terminal_gets_a_bar():
    """The bar goes to a terminal only; elsewhere plain lines without carriage returns."""
    code = (
        f"import sys; sys.path.insert(0, {str(HERE)!r})\nfrom sim.generate import _Progress\n"
        "with _Progress('train', 2, 0) as progress:\n    progress.trajectory('ok'); progress.trajectory('failed: why')\n"
    )
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, stderr=theirs, check=True)
    text = os.read(ours, 10_000).decode()
    os.close(ours), os.close(theirs)
    assert "\r" in text and "2/2" in text and "failed: why" in text
    plain = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True).stderr
    assert "\r" not in plain and "train: 2/2 trajectories, 1 failed" in plain
