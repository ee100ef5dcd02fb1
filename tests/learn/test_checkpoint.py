from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path

import dummy_model
import pytest
import torch

from learn.checkpoint import STATE_KEYS, file_hash, load_model, load_state, read_model_file, save_model, save_state
from learn.dataset import Dataset, DataSpec
from learn.model import build
from sim.errors import InputError


@pytest.fixture
def spec(bounce_dataset: Path) -> DataSpec:
    return Dataset(bounce_dataset, "train").spec(2)


@pytest.fixture
def saved(tmp_path: Path, spec: DataSpec) -> Path:
    torch.manual_seed(3)
    save_model(tmp_path / "best.pt", build("dummy", {"noise": 0.25}, spec), {"step": 7, "seconds": 1.5})
    return tmp_path / "best.pt"


def test_round_trip(saved: Path, spec: DataSpec) -> None:
    torch.manual_seed(3)
    original, model = build("dummy", {"noise": 0.25}, spec), load_model(saved)
    assert type(model) is dummy_model.Dummy and not model.training
    assert model.settings == original.settings and model.settings["noise"] == 0.25 and model.spec == spec
    for name, value in original.state_dict().items():
        assert torch.equal(model.state_dict()[name], value)
    assert read_model_file(saved)["provenance"] == {"step": 7, "seconds": 1.5}
    assert not [name for name in os.listdir(saved.parent) if name.endswith(".tmp.pt")]


def test_gns_round_trip(tmp_path: Path, spec: DataSpec) -> None:
    """A checkpoint is all a GNS needs: same settings, same weights."""
    model = build("gns", {"latent": 8, "message_passing": 1}, spec)
    save_model(tmp_path / "best.pt", model)
    loaded = load_model(tmp_path / "best.pt")
    assert loaded.settings == model.settings
    assert all(torch.equal(one, two) for one, two in zip(loaded.parameters(), model.parameters(), strict=True))


def test_unregistered_models_are_not_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not registered"):
        save_model(tmp_path / "best.pt", torch.nn.Linear(1, 1))
    assert not list(tmp_path.iterdir())


class Bomb:
    """Runs code when unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.mark.parametrize("load", [load_model, load_state])
@pytest.mark.parametrize("form", ["pickle", "torch", "torch-legacy", "inside"])
def test_pickle_bombs_do_not_go_off(tmp_path: Path, saved: Path, form: str, load) -> None:
    mark, path = tmp_path / "exploded", tmp_path / "bomb.pt"
    if form == "pickle":
        path.write_bytes(pickle.dumps(Bomb(mark)))
    elif form == "inside":
        torch.save({**read_model_file(saved), "provenance": {"note": Bomb(mark)}}, path)
    else:
        torch.save(Bomb(mark), path, _use_new_zipfile_serialization=form == "torch")
    with pytest.raises(InputError) as error:
        load(path)
    assert "\n" not in str(error.value) and not mark.exists()


def test_bomb_would_have_gone_off(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Bomb(tmp_path / "exploded")))
    assert (tmp_path / "exploded").exists()


def edited(saved: Path, **changes: object) -> Path:
    """The file with some keys replaced, or left out where the change is ``...``."""
    content = torch.load(saved, weights_only=True) | changes
    path = saved.with_name("edited.pt")
    torch.save({name: value for name, value in content.items() if value is not ...}, path)
    return path


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"format": "other"}, "format"),
        ({"format_version": 2}, "format_version"),
        ({"model": "nobody"}, "model"),
        ({"model": 3}, "model"),
        ({"settings": {"nose": 1}}, "nose"),
        ({"settings": {"noise": -1}}, "noise"),
        ({"settings": []}, "settings"),
        ({"spec": {}}, "spec"),
        ({"spec": ...}, "keys"),
        ({"more": 1}, "keys"),
        ({"state_dict": {}}, "state_dict"),
        ({"provenance": None}, "provenance"),
        ({"model": "gns", "settings": {"latent": 10**12}}, "settings"),
    ],
)
def test_wrong_contents(saved: Path, changes: dict, key: str) -> None:
    path = edited(saved, **changes)
    with pytest.raises(InputError, match=rf"edited\.pt: .*{key}"):
        load_model(path)


@pytest.mark.parametrize(
    "weight",
    [
        1.0,
        None,
        torch.zeros(3, 3),
        torch.zeros(2, 2, dtype=torch.float64),
        torch.full((2, 2), float("nan")),
        torch.zeros(2, 2).to_sparse(),
        torch.zeros(2, 2, device="meta"),
    ],
)
def test_wrong_weights(saved: Path, weight: object) -> None:
    weights = torch.load(saved, weights_only=True)["state_dict"] | {"linear.weight": weight}
    with pytest.raises(InputError, match=r"linear\.weight"):
        load_model(edited(saved, state_dict=weights))


def test_not_a_checkpoint(tmp_path: Path) -> None:
    for name, content in {"empty.pt": b"", "text.pt": b"hello", "zeros.pt": b"\0" * 1000}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="damaged"):
            load_model(tmp_path / name)
    with zipfile.ZipFile(tmp_path / "zip.pt", "w") as archive:
        archive.writestr("data.pkl", b"")
    torch.save([1, 2], tmp_path / "list.pt")
    for name in ("zip.pt", "list.pt", "none.pt", "."):
        with pytest.raises(InputError):
            load_model(tmp_path / name)


def test_a_model_file_is_not_a_training_state(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sluice-training-state"):
        load_state(saved)
    state = {key: (torch.zeros(1) if kind is torch.Tensor else kind()) for key, kind in STATE_KEYS.items()}
    save_state(tmp_path / "checkpoint.pt", state)
    assert set(load_state(tmp_path / "checkpoint.pt")) == {"format", "format_version", *STATE_KEYS}
    with pytest.raises(InputError, match="sluice-model"):
        load_model(tmp_path / "checkpoint.pt")


def test_hash_is_the_contents(saved: Path) -> None:
    assert file_hash(saved) == file_hash(saved) and len(file_hash(saved)) == 64
    assert file_hash(edited(saved, provenance={})) != file_hash(saved)
