from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import dummy_model
import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from disks import small_disk

from learn.checkpoint import load_model
from learn.cli import main
from learn.dataset import Dataset, DataSettings
from learn.train import Config, TrainSettings, train
from sim.generate import generate
from sim.scene import SceneFamily
from sim.trajectory import ShardReader

ROOT = Path(__file__).parents[2]
MODEL, SCENE = ROOT / "pretrained" / "waterdrop_gns" / "best.pt", ROOT / "configs" / "scenes" / "waterdrop.yaml"


@pytest.fixture(scope="module")
def dummy(bounce_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("dummy") / "run"
    train(Config(model="dummy", training=TrainSettings(steps=4, validations=1, validation_frames=3), data=DataSettings()), bounce_dataset, run)
    return run / "best.pt"


def test_a_rollout_from_a_scene_begins_as_the_solver_does(tmp_path: Path) -> None:
    """Its first frames are those of the data set that the scene file makes; those after them the model's."""
    out = tmp_path / "out.h5"
    assert main(["rollout", str(MODEL), str(SCENE), "--seed", "4", "--count", "2", "--frames", "3", "--out", str(out)]) == 0
    history = load_model(MODEL).history
    generate(SceneFamily(SceneFamily.load(SCENE).to_dict() | {"frames": history + 3}, SCENE), {"test": 2}, tmp_path / "truth", seed=4)
    truth = Dataset(tmp_path / "truth", "test")
    with ShardReader(out) as reader:
        assert reader.indices() == [0, 1]
        for index in (0, 1):
            ours, theirs = reader.read(index), truth.trajectory(index)
            assert ours.ok and ours.seed == theirs.seed and ours.scene == theirs.scene
            assert ours.position.shape == theirs.position.shape and ours.simulator["name"] == "gns"
            assert np.array_equal(ours.position[:history], theirs.position[:history])
            assert np.abs(ours.position[history:] - theirs.position[history:]).max() < 1e-2
            assert not np.array_equal(ours.position[history], theirs.position[history])


def test_mistakes_of_a_rollout_from_a_scene(tmp_path: Path, dummy: Path, bounce_dataset: Path, capsys: pytest.CaptureFixture) -> None:
    out = ["--out", str(tmp_path / "out.h5")]
    for arguments, said in (
        ([str(MODEL), *out], "give a SCENE file or --data"),
        ([str(MODEL), str(SCENE), "--data", str(bounce_dataset), *out], "one of the two"),
        ([str(MODEL), str(SCENE), "--split", "valid", *out], "--split"),
        ([str(dummy), "--data", str(bounce_dataset), "--seed", "1", *out], "--seed"),
        ([str(dummy), "--data", str(bounce_dataset), "--variant", "x", *out], "--variant"),
        ([str(MODEL), str(tmp_path / "none.yaml"), *out], "none.yaml"),
        ([str(MODEL), str(SCENE), "--variant", "nowhere", *out], "nowhere"),
        ([str(MODEL), str(SCENE.with_name("sand.yaml")), "--frames", "2", *out], "sand.yaml"),
        ([str(MODEL), str(SCENE.with_name("fluidshake.yaml")), "--frames", "2", *out], "context"),
        ([str(MODEL), str(SCENE.with_name("water_3d_s.yaml")), "--frames", "2", *out], "dim"),
    ):
        assert main(["rollout", *arguments]) == 2
        error = capsys.readouterr().err
        assert said in error and error.startswith("sluice-learn: ") and len(error.splitlines()) == 1
    assert not (tmp_path / "out.h5").exists()


def test_rollouts_on_a_full_disk(dummy: Path, bounce_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """It fills up under the shard, then under what it cost: one line, nothing left, and with room the bytes of a rollout that had room."""
    command = ["rollout", str(dummy), "--data", str(bounce_dataset), "--out"]
    whole, disk = tmp_path / "whole.h5", tmp_path / "disk"
    assert main([*command, str(whole)]) == 0
    capsys.readouterr()
    with small_disk(disk) as leave:
        out = disk / "out.h5"
        # The disk gives room in pages of 4096 bytes: the last one is just too few for the shard and its cost.
        for free in (0, 4096, whole.stat().st_size // 2, -(-whole.stat().st_size // 4096) * 4096):
            leave(free)
            assert main([*command, str(out)]) == 1
            assert capsys.readouterr().err == f"sluice-learn: {out}: cannot be written: No space left on device\n"
            assert os.listdir(disk) == ["filler"]
        leave(None)
        assert main([*command, str(out)]) == 0
        assert out.read_bytes() == whole.read_bytes() and (disk / "out.h5.cost.json").is_file()


def test_a_rollout_goes_on_beyond_the_truth(dummy: Path, bounce_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.h5"
    assert main(["rollout", str(dummy), "--data", str(bounce_dataset), "--count", "1", "--frames", "400", "--out", str(out)]) == 0
    with ShardReader(out) as reader:
        assert len(reader.read(0).position) == 402 > 10 * 40


def test_what_leaves_the_box_is_said(dummy: Path, bounce_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch) -> None:
    """All particles go on at 0.04 a frame: those 0.3 or more from the wall at 0.9 need more than 7 frames to be a radius (0.1) beyond it."""

    def fly(self) -> np.ndarray:
        self.state = torch.stack([self.state[1], self.state[1] + torch.tensor([0.04, 0.0])])
        return self.state[1:].numpy().copy()

    monkeypatch.setattr(dummy_model.Dummy, "advance", fly)
    out = tmp_path / "out.h5"
    assert main(["rollout", str(dummy), "--data", str(bounce_dataset), "--count", "1", "--frames", "30", "--out", str(out)]) == 0
    rightmost = Dataset(bounce_dataset, "test").trajectory(0).position[1, :, 0].max()
    first = 1 + int(np.floor((1.0 - rightmost) / 0.04)) + 1
    assert f"1 left the box, the first at frame {first}" in capsys.readouterr().out
    assert json.loads(out.with_name("out.h5.cost.json").read_text())["trajectories"]["000000"]["escaped"] == first
