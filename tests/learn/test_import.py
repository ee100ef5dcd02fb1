"""The command ``import``, and LagrangeBench's sample through the whole of it: imported, trained on, rolled out and compared, in a periodic 3D box."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from learn import compare as c
from learn.baselines import Oracle, trivial_baselines
from learn.checkpoint import load_model
from learn.cli import main
from learn.dataset import Dataset
from sim import periodic
from sim.trajectory import ShardReader

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "tests/data/lagrangebench_lj"
IMPORT = ["import", str(SAMPLE), "--format", "lagrangebench", "--gravity", "0", "0", "0", "--out"]
CONFIG = """
model: gns
settings: {latent: 16, message_passing: 2, noise: 0.01}
training: {steps: 150, batch: 16, learning_rate: 5.0e-3, warmup_steps: 5, validations: 1, validation_frames: 50, gradient_clip: null}
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("lagrangebench") / "lj"
    assert main([*IMPORT, str(out)]) == 0
    return out


def test_the_sample_trains_and_evaluates(data, tmp_path):
    (tmp_path / "gns.yaml").write_text(CONFIG)
    assert main(["train", str(tmp_path / "gns.yaml"), "--data", str(data), "--out", str(tmp_path / "run")]) == 0
    model, train = load_model(tmp_path / "run/best.pt"), Dataset(data, "train")
    with torch.inference_mode():  # a model that says nothing has 3, one for each axis
        loss = float(model.loss(train.batch(train.windows(7), 7), torch.Generator().manual_seed(1), 1.0))
    assert loss < 1
    assert main(["rollout", str(tmp_path / "run/best.pt"), "--data", str(data), "--out", str(tmp_path / "test.h5")]) == 0
    with ShardReader(tmp_path / "test.h5") as reader:
        predicted = reader.read(0)
    truth = Dataset(data, "test").trajectory(0)
    assert predicted.ok and predicted.position.shape == (405, 3, 3) and predicted.seed is None
    assert (predicted.position >= 0).all() and (predicted.position <= 5).all()
    for run in (truth, predicted):
        steps = np.diff(run.position.astype(float), axis=0)
        assert np.abs(steps).max() > 4.9 and np.abs(periodic.shortest(steps, run.period)).max() < 0.05  # through faces, and never thrown about

    assert model.features.node_width == 15 and model.spec.periodic == ("x", "y", "z")  # five velocities; neither walls nor types
    settings = c.CompareSettings(horizons=(1, 20))
    rows = {row["contender"]: row for row in c.compare([model, *trivial_baselines(), Oracle([truth])], [truth], settings)}
    assert all(row["failures"] == 0 and row["escaped_fraction"] == 0 for row in rows.values())
    assert rows["oracle"]["rollout_mse"]["all"] < 1e-6
    # A particle that were taken for one that jumps through the box would err by 25 / 9.
    assert rows["constant velocity"]["one_step_mse"] < 1e-8 < rows["frozen"]["one_step_mse"] < 1e-4
    assert rows["gns"]["one_step_mse"] < 1e-5 and rows["gns"]["rollout_mse"]["20"] < 1e-3
    assert rows["gns"]["pile_angle_error"]["1"] is None and rows["gns"]["emd"]["1"] < 2


def test_what_the_command_says(tmp_path, capsys):
    assert main([*IMPORT, str(tmp_path / "lj")]) == 0
    said = capsys.readouterr()
    lines = said.out.splitlines()
    assert lines[0] == f"{tmp_path}/lj: trajectories: train 1, valid 1, test 1; particle spacing 1.4 (dx)"
    assert lines[1] == "statistics of the training split, length per frame: found | stated by metadata.json"
    assert [line.split(":")[0].strip() for line in lines[2:]] == ["velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std"]
    assert lines[3] == "  velocity_std: 0.006637, 0.006098, 0.002329 | 0.006351, 0.005812, 0.003587"
    assert said.err.count("\n") == 1 and said.err.startswith("sluice-learn: ") and "velocity_std, acceleration_std: up to 0.54 standard" in said.err


def test_mistakes_are_one_line(data, tmp_path, capsys):
    for arguments, message in (
        ([*IMPORT, str(data)], "exists already"),
        (["import", str(tmp_path), "--format", "deepmind", "--gravity", "0", "-9.8", "--out", str(tmp_path / "out")], "metadata.json"),
        ([*IMPORT[:4], "--gravity", "0", "-9.8", "--out", str(tmp_path / "out")], "must be 3 finite numbers"),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert error.startswith("sluice-learn: ") and error.count("\n") == 1 and message in error
    with pytest.raises(SystemExit) as stop:
        main([*IMPORT[:4], "--out", str(tmp_path / "out")])
    assert stop.value.code == 2 and "--gravity" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_interrupted_import_leaves_nothing(tmp_path, number, code):
    """In the middle of a shard: the second trajectory waits."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in/metadata.json").write_text((SAMPLE / "metadata.json").read_text())
    (tmp_path / "in/train.h5").write_bytes((SAMPLE / "train.h5").read_bytes())
    program = (
        "import sys, time, sim.importing as importing\nfrom learn.cli import main\nsuffix, read = importing._READERS['lagrangebench']\n"
        "def slow(*arguments):\n    yield from read(*arguments)\n    print('half', flush=True)\n    time.sleep(60)\n"
        "importing._READERS['lagrangebench'] = suffix, slow\nsys.exit(main(sys.argv[1:]))\n"
    )
    arguments = ["import", str(tmp_path / "in"), *IMPORT[2:], str(tmp_path / "out")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", program, *arguments]
    # A shell ignores SIGINT in what it runs in the background, and children inherit that.
    heard = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, preexec_fn=heard) as process:
        assert process.stdout.readline() == "half\n"
        assert any(path.name.startswith(".out") for path in tmp_path.iterdir())
        process.send_signal(number)
        assert process.wait(60) == code
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_import_needs_no_torch():
    code = (
        "import sys\nfrom learn.cli import main\ncode = main(sys.argv[1:])\n"
        "print(code, [name for name in ('torch', 'taichi') if name in sys.modules])\n"
    )
    arguments = ["import", str(SAMPLE), "--format", "deepmind", *IMPORT[4:], "/nowhere"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True)
    assert done.stdout == "2 []\n" and "holds no train.tfrecord" in done.stderr
