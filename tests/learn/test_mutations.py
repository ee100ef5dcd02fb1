"""Damaged configurations, data and checkpoints: a correct read, or one line and exit code 2, in bounded time and memory (``mutations.told``)."""

from __future__ import annotations

import copy
import datetime
import os
import pickle
import shutil
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from bouncing import bounce

sys.path.insert(0, str(Path(__file__).parents[1]))

from mutations import FACTORS, SHARDS, change_shard, junk, places, spoil_bytes, spoil_json, spoil_shard, spoil_yaml, told  # noqa: E402

from learn.baselines import trivial_baselines  # noqa: E402
from learn.cli import main  # noqa: E402
from learn.compare import CompareSettings, compare  # noqa: E402
from learn.dataset import Dataset  # noqa: E402
from sim.errors import InputError  # noqa: E402

CONFIGS = sorted((Path(__file__).parents[2] / "configs/models").glob("*.yaml"))
#: The smallest model of each kind.
SMALLEST = {
    "gns": {"latent": 4, "message_passing": 1, "history": 2}, "grid_emulator": {"frames_per_call": 2, "channels": [4, 4], "unroll": [1]},
    "cconv": {"channels": [4, 4], "kernel": 2, "unroll": [1]},
}  # fmt: skip


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing waits for the disk."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory, write_dataset) -> Path:
    """A data set of two trajectories a split; beside each shard lies ``other.h5``, to which links point."""
    splits = {split: {index: bounce(10 * place + index, 12, 12) for index in range(2)} for place, split in enumerate(("train", "valid", "test"))}
    folder = write_dataset(tmp_path_factory.mktemp("data") / "good", splits)
    for split in splits:
        shutil.copy(folder / split / "shard-00000.h5", folder / split / "other.h5")
    return folder


def write_config(path: Path, kind: str) -> Path:
    training = {"steps": 2, "batch": 1, "validation_frames": 2, "checkpoint_every": 1}
    path.write_text(yaml.safe_dump({"model": kind, "settings": SMALLEST[kind], "training": training}))
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, good: Path) -> dict[str, Path]:
    """A run of each kind of model, which its command would go on with: ``done.json`` is missing."""
    folder, made = tmp_path_factory.mktemp("runs"), {}
    for kind in SMALLEST:
        made[kind] = folder / kind
        assert told(main, "train", write_config(folder / f"{kind}.yaml", kind), "--data", good, "--out", made[kind])[0] == 0
        (made[kind] / "done.json").unlink()
    return made


def test_model_configurations(tmp_path: Path, good: Path, quick: None) -> None:
    """Five mutations of each file of ``configs/models``, their sizes made small."""
    codes, small = [], {"channels": [4, 4], "unroll": [1], "frames_per_call": 2, "latent": 4, "message_passing": 1, "kernel": 2}
    for trial in range(5 * len(CONFIGS)):
        source, rng = CONFIGS[trial % len(CONFIGS)], np.random.default_rng([3, trial])
        content = yaml.safe_load(source.read_text())
        content["settings"] = SMALLEST[content["model"]] | {key: small.get(key, value) for key, value in content["settings"].items()}
        content["training"] |= {"batch": 1, "validation_frames": 2}
        path, out = tmp_path / source.name, tmp_path / "run"
        path.write_bytes(spoil_yaml(yaml.safe_dump(content, sort_keys=False), rng, tmp_path / "mark"))
        codes.append(told(main, "train", path, "--data", good, "--out", out, "--steps", "1", "--threads", "1")[0])
        assert codes[-1] != 2 or not out.exists()
        shutil.rmtree(out, ignore_errors=True)
        path.unlink()
        assert not list(tmp_path.iterdir())
    assert codes.count(0) > 1 and codes.count(2) > 50 and codes.count(1) < 3


#: What once took all memory, all time, or ended in a traceback.
SIZES = [
    ("gns", "message_passing", 10**6, "more than 20000 tensors"), ("gns", "latent", 40_000, "no gns can be built"),
    ("gns", "noise", float("inf"), "finite number"), ("gns", "noise", 1e300, "less than or equal to"),
    ("gns", "history", 10**9, "no gns can be built"),
    ("gns", "relaxation", {"loops": 10**9}, "less than or equal to"), ("grid_emulator", "blocks", 10**6, "more than 20000 tensors"),
    ("grid_emulator", "channels", [0], "greater than 0"),
    ("grid_emulator", "channels", [20_000_000, 4], "no grid_emulator can be built"),
    ("grid_emulator", "margin", 10**9, "nodes; enlarge cell"), ("grid_emulator", "cell", 1e-9, "nodes; enlarge cell"),
    ("grid_emulator", "frames_per_call", 10**9, "less than or equal to"), ("grid_emulator", "floor", 1e300, "less than or equal to"),
    ("cconv", "kernel", 10**5, "no cconv can be built"), ("cconv", "radius", float("inf"), "finite number"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "key", "value", "said"), SIZES, ids=lambda value: str(value)[:20])
def test_sizes_that_no_machine_holds(tmp_path: Path, good: Path, kind: str, key: str, value: object, said: str) -> None:
    path = write_config(tmp_path / "model.yaml", kind)
    content = yaml.safe_load(path.read_text())
    content["settings"][key] = value
    path.write_text(yaml.safe_dump(content))
    code, error = told(main, "train", path, "--data", good, "--out", tmp_path / "run")
    assert code == 2 and said in error and key in error and not (tmp_path / "run").exists(), error


def compared(data: Path) -> int:
    """What a comparison says to a data set, as an exit code."""
    try:
        tests = Dataset(data, "test")
        compare(trivial_baselines(), [tests.trajectory(number) for number in range(len(tests))], CompareSettings(horizons=(1,)))
    except InputError as error:
        assert "\n" not in str(error)
        return 2
    return 0


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_data(tmp_path: Path, good: Path, runs: dict[str, Path], quick: None) -> None:
    """What can be wrong in all shards of a data set or in its ``dataset.json``: to a training, a rollout and a comparison."""
    codes, data, out = [], tmp_path / "data", tmp_path / "out"
    config = write_config(tmp_path / "model.yaml", "gns")
    for trial in range(len(SHARDS) + 45):
        shutil.copytree(good, data)
        shard, rng = data / "train/shard-00000.h5", np.random.default_rng([4, trial])
        if trial < len(SHARDS):
            change_shard(shard, list(SHARDS)[trial])
        elif trial % 3:
            spoil_shard(shard, rng, trial // 3)
        else:
            (data / "dataset.json").write_bytes(spoil_json((data / "dataset.json").read_text(), rng, trial // 3))
        for split in ("valid", "test"):
            shutil.copy(shard, data / split / shard.name)
        trained = told(main, "train", config, "--data", data, "--out", out, "--steps", "1")[0]
        assert trained == 0 or not {path.name for path in out.glob("*")} - {"log.csv", "validation.csv"}  # of a run that met damage on its way
        shutil.rmtree(out, ignore_errors=True)
        rolled = told(main, "rollout", runs["gns"] / "best.pt", "--data", data, "--out", out / "rollouts.h5")[0]
        assert rolled < 2 or not out.exists()
        codes.append((trained, rolled, compared(data)))
        shutil.rmtree(out, ignore_errors=True)
        shutil.rmtree(data)
    assert sum(set(found) == {0} for found in codes) > 5 and sum(set(found) == {2} for found in codes) > 60


# -- checkpoints


#: What may stand where a tensor of weights should.
TENSORS = [
    lambda old: old.double() * float("nan"), lambda old: torch.where(torch.arange(old.numel()).view(old.shape) == 0, float("nan"), old.float()),
    lambda old: old.float() + float("inf"), lambda old: old.double(), lambda old: old.half(), lambda old: old.byte(),
    lambda old: old.to(torch.complex64), lambda old: old.reshape(-1), lambda old: old[None], lambda old: old.reshape(-1)[1:],
    lambda old: old.reshape(-1)[:0], lambda old: torch.tensor(1.0), lambda old: old.reshape(1, -1).to_sparse(),
    lambda old: torch.empty(old.shape, device="meta"), lambda old: torch.zeros(1).expand(10**12), lambda old: [old], lambda old: 1.0,
    lambda old: torch.nn.Parameter(old.float()), lambda old: torch.quantize_per_tensor(old.float(), 0.1, 0, torch.qint8),
    lambda old: old.t() if old.ndim == 2 else old.flip(0), lambda old: torch.zeros(1).expand(old.shape) + 1e38,
]  # fmt: skip


def at(content: object, where: tuple) -> object:
    for key in where:
        content = content[key]
    return content


def spoil_checkpoint(content: dict, rng: np.random.Generator, trial: int) -> dict:
    """A copy of a model file's or a training state's content in which a tensor, or something beside the tensors, is spoilt."""
    content = copy.deepcopy(content)
    tensor = trial % 3 == 0
    found = [where for where in places(content) if isinstance(at(content, where), torch.Tensor) == tensor]
    *where, last = found[rng.integers(len(found))]
    target = at(content, where)
    if tensor:
        target[last] = TENSORS[trial // 3 % len(TENSORS)](target[last])
    elif trial % 3 == 1 and type(target[last]) in (int, float):
        target[last] *= FACTORS[rng.integers(len(FACTORS))]
    elif rng.random() < 0.2:
        del target[last]
    else:
        value = junk(rng)
        target[last] = torch.ones(2) if isinstance(value, (datetime.date, bytes)) else value
    return content


def read_checkpoint(run: Path, name: str, config: Path, data: Path) -> list[int]:
    """Exit codes of the commands that read ``best.pt`` or ``checkpoint.pt``; what is refused changes nothing."""
    path, out, before = run / name, run.parent / "out", {file: file.read_bytes() for file in run.iterdir()}
    commands = [("train", config, "--data", data, "--out", run)]
    if name == "best.pt":
        commands = [("info", path), ("rollout", path, "--data", data, "--out", out / "a.h5"), ("export-model", path, "--out", out / "port")]
    codes = []
    for command in commands:
        codes.append(told(main, *command)[0])
        assert codes[-1] < 2 or not out.exists() and {file: file.read_bytes() for file in run.iterdir()} == before
        shutil.rmtree(out, ignore_errors=True)
    return codes


def test_checkpoints(tmp_path: Path, good: Path, runs: dict[str, Path], quick: None) -> None:
    """Model files and training states of every kind of model, a third of them spoilt as bytes."""
    codes, run = [], tmp_path / "run"
    for trial in range(120):
        kind, name, rng = list(SMALLEST)[trial % 3], ("best.pt", "checkpoint.pt")[trial % 2], np.random.default_rng([5, trial])
        shutil.copytree(runs[kind], run)
        path = run / name
        if trial // 6 % 3 == 0:
            path.write_bytes(spoil_bytes(path.read_bytes(), rng, trial // 18))
        else:
            torch.save(spoil_checkpoint(torch.load(path, weights_only=True), rng, trial // 6), path)
        codes += read_checkpoint(run, name, runs[kind].with_suffix(".yaml"), good)
        shutil.rmtree(run)
    assert codes.count(0) > 10 and codes.count(2) > 60 and codes.count(1) == 0


class Payload:
    def __init__(self, call, *arguments: object):
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> tuple:
        return self.call, self.arguments


def bomb() -> list:
    found: list = []
    for _ in range(40):
        found = [found] * 9
    return found


def settings(**changes: object):
    def change(content: dict) -> dict:
        return content | {"settings": content["settings"] | changes}

    return change


def spec(**changes: object):
    def change(content: dict) -> dict:
        return content | {"spec": content["spec"] | changes}

    return change


#: Hostile model files: how the content of a good one is changed, and what is said. ``mark`` is a folder that code in it would make.
HOSTILE = {
    "code": ("gns", lambda content, mark: content | {"provenance": Payload(os.mkdir, str(mark))}, "damaged"),
    "code among weights": ("gns", lambda content, mark: content | {"state_dict": OrderedDict(a=Payload(os.system, f"mkdir {mark}"))}, "damaged"),
    "memory": ("gns", lambda content, mark: content | {"provenance": {"a": Payload(bytearray, 10**13)}}, "damaged"),
    "references of references": ("gns", lambda content, mark: content | {"provenance": {"a": bomb()}}, "refer to each other"),
    "references as the format": ("gns", lambda content, mark: content | {"format": bomb()}, "refer to each other"),
    "a tensor beside the weights": ("gns", lambda content, mark: content | {"provenance": {"a": torch.ones(2)}}, "must be numbers and texts"),
    "wider": ("gns", lambda content, mark: settings(latent=40_000)(content), "no gns can be built"),
    "deeper": ("gns", lambda content, mark: settings(message_passing=10**6)(content), "no gns can be built"),
    "finer": ("grid_emulator", lambda content, mark: settings(cell=1e-6)(content), "nodes; enlarge cell"),
    "wider in two": ("grid_emulator", lambda content, mark: settings(channels=[4_000_000, 4])(content), "no grid_emulator can be built"),
    "of a finer scene": ("cconv", lambda content, mark: spec(spacing=1e-12)(content), "particles along the walls"),
    "of another world": ("gns", lambda content, mark: spec(dim=4)(content), "dim = 4"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_model_files(tmp_path: Path, runs: dict[str, Path], case: str) -> None:
    kind, change, said = HOSTILE[case]
    content = torch.load(runs[kind] / "best.pt", weights_only=True)
    torch.save(change(content, tmp_path / "mark"), tmp_path / "best.pt")
    code, error = told(main, "info", tmp_path / "best.pt")
    assert code == 2 and said in error and os.listdir(tmp_path) == ["best.pt"], error


def test_a_packed_bomb(tmp_path: Path, runs: dict[str, Path]) -> None:
    """torch reads archives that are deflated: a gigabyte of zeros is a megabyte then."""
    with zipfile.ZipFile(runs["gns"] / "best.pt") as whole, zipfile.ZipFile(tmp_path / "best.pt", "w", zipfile.ZIP_DEFLATED) as packed:
        for entry in whole.namelist():
            packed.writestr(entry, bytes(10**7) if "/data/" in entry else whole.read(entry))
    code, error = told(main, "info", tmp_path / "best.pt")
    assert code == 2 and "promises more than it holds" in error


def test_a_flipped_bit_among_the_weights(tmp_path: Path, runs: dict[str, Path]) -> None:
    """One weight is another number, finite as before: the checksum of its tensor tells."""
    path = runs["gns"] / "best.pt"
    weights = torch.load(path, weights_only=True)["state_dict"]
    bytes_of_one = next(value for value in weights.values() if value.numel() > 10).numpy().tobytes()
    raw = bytearray(path.read_bytes())
    raw[raw.index(bytes_of_one) + 5] ^= 1
    (tmp_path / "best.pt").write_bytes(raw)
    code, error = told(main, "info", tmp_path / "best.pt")
    assert code == 2 and "has not the checksum" in error, error


def test_a_plain_pickle(tmp_path: Path) -> None:
    (tmp_path / "best.pt").write_bytes(pickle.dumps(Payload(os.mkdir, str(tmp_path / "mark"))))
    assert told(main, "info", tmp_path / "best.pt")[0] == 2 and os.listdir(tmp_path) == ["best.pt"]
