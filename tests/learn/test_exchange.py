"""Exchange with the PyTorch port geoelements/gns: equal outputs in both directions, and what cannot be exchanged."""

import errno
import json
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from port_gns import ROOT, Port, state_dict

from learn.checkpoint import load_model, save_model
from learn.cli import main
from learn.dataset import DataSpec
from learn.exchange import export_model, import_model
from learn.gns import GNS
from learn.graph import radius_graph
from learn.model import build
from sim.errors import InputError, RunError

torch.set_num_threads(1)


def metadata(dim: int, **changes) -> dict:
    values = {
        "bounds": [[0.1, 0.9]] * dim,
        "sequence_length": 320,
        "default_connectivity_radius": 0.15,
        "dim": dim,
        "dt": 0.0025,
        "vel_mean": [1e-4, -3e-4, 2e-4][:dim],
        "vel_std": [2.2e-3, 2.7e-3, 1.9e-3][:dim],
        "acc_mean": [1e-6, -2e-5, 3e-6][:dim],
        "acc_std": [2.6e-4, 3.0e-4, 2.8e-4][:dim],
    }
    return values | changes


def write(folder: Path, weights: object, content: object) -> tuple[Path, Path]:
    torch.save(weights, folder / "model-100.pt")
    (folder / "metadata.json").write_text(json.dumps(content))
    return folder / "model-100.pt", folder / "metadata.json"


def scene(dim: int, types: tuple[int, ...], frames: int = 6):
    """Two examples in one batch, some particles beyond the walls: positions [particles, frames, dim], types, examples, a material number."""
    generator = torch.Generator().manual_seed(1)
    start = 0.02 + 0.96 * torch.rand((150, 1, dim), generator=generator)
    position = start + (3e-3 * torch.randn((150, frames, dim), generator=generator)).cumsum(1)
    kinds = torch.tensor(types)[torch.randint(len(types), (150,), generator=generator)]
    return position, kinds, torch.arange(150) // 90, torch.rand(150, generator=generator)


def ours(model: GNS, position: torch.Tensor, kinds: torch.Tensor, example: torch.Tensor, material: torch.Tensor | None = None) -> torch.Tensor:
    """The accelerations that the model predicts."""
    window = position.transpose(0, 1)
    graph = radius_graph(window[-1], model.radius, example)
    with torch.inference_mode():
        output = model._predict(window, graph, kinds, model.features.bounds, None if material is None else material[:, None])
        return model.features.acceleration(output, window, model.features.bounds)


def difference(found: torch.Tensor, wanted: torch.Tensor) -> float:
    """Of the worst component, in units of the largest of its axis."""
    return ((found - wanted).abs() / wanted.abs().amax(0)).max().item()


CASES = [
    (2, (5,), "updated", {}, {}),
    (2, (3, 5, 6), "updated", {}, {}),
    (2, (5,), "doubled", {}, {}),
    (3, (0, 5), "doubled", {"layers": 1, "velocities": 3}, {}),
    (2, (5,), "updated", {"material": True}, {"boundary_augment": 2.5}),
    (3, (3, 6), "doubled", {"material": True, "velocities": 1}, {"boundary_augment": 0.5}),
]


@pytest.mark.parametrize(("dim", "types", "edges", "sizes", "changes"), CASES)
def test_both_directions_give_equal_outputs(tmp_path, dim, types, edges, sizes, changes):
    weights = state_dict(dim, 16, 4, **sizes)
    content = metadata(dim, **changes)
    paths = write(tmp_path, weights, content)
    model = import_model(*paths, edges=edges, noise_std=4e-4, spacing=0.05, gravity=[0.0] * dim, particle_types=types)
    position, kinds, example, material = scene(dim, types, sizes.get("velocities", 5) + 1)
    rest = (kinds, example, material) if sizes.get("material") else (kinds, example)
    wanted = Port(weights, content, edges, 4e-4).accelerations(position, *rest)
    found = ours(model, position, *rest)
    assert difference(found, wanted) < 1e-5
    other = Port(weights, content, "doubled" if edges == "updated" else "updated", 4e-4).accelerations(position, *rest)
    assert difference(other, wanted) > 0.1  # the version of the port matters

    exported = export_model(model, tmp_path / "back")
    again = torch.load(tmp_path / "back" / "model-0.pt", weights_only=True)
    assert {name: value.shape for name, value in again.items()} == {name: value.shape for name, value in weights.items()}
    read = json.loads((tmp_path / "back" / "metadata.json").read_text())
    assert read == json.loads(json.dumps(exported)) and read["edges"] == edges
    assert difference(Port(again, read, read["edges"], read["noise_std"]).accelerations(position, *rest), wanted) < 1e-5
    # What was exported says all that its import needs.
    assert difference(ours(import_model(tmp_path / "back" / "model-0.pt", tmp_path / "back" / "metadata.json"), position, *rest), wanted) < 1e-5


def spec(**changes) -> DataSpec:
    values = dict(
        dim=2,
        bounds=((0.0, 1.0), (0.0, 1.0)),
        radius=0.15,
        spacing=0.05,
        frame_step=0.01,
        stride=1,
        gravity=(0.0, -9.81),
        particle_types=(5,),
        velocity_mean=(1e-4, 0.0),
        velocity_std=(3e-3, 2e-3),
        acceleration_mean=(0.0, -2e-4),
        acceleration_std=(3e-4, 0.0),
    )
    return DataSpec(**(values | changes))


@pytest.mark.parametrize(
    ("settings", "changes"),
    [
        ({"shared": True}, {}),
        ({"ballistic": True, "wall_distance": 5.0}, {"context_mean": (30.0,), "context_std": (7.0,)}),
        ({"edge_update": False, "noise": 0.0, "radius": 2.0, "history": 2}, {"particle_types": (3, 5)}),
    ],
)
def test_a_model_of_ours_goes_to_the_port(tmp_path, settings, changes):
    torch.manual_seed(0)
    model = build("gns", {"latent": 16, "message_passing": 3} | settings, spec(**changes))
    position, kinds, example, material = scene(2, model.spec.particle_types, model.velocities + 1)
    rest = (kinds, example, 40 * material) if model.features.context else (kinds, example)
    read = export_model(model, tmp_path / "out")
    weights = torch.load(tmp_path / "out" / "model-0.pt", weights_only=True)
    assert difference(Port(weights, read, read["edges"], read["noise_std"]).accelerations(position, *rest), ours(model, position, *rest)) < 1e-5


def test_the_commands(tmp_path, capsys):
    model, content = write(tmp_path, state_dict(2, 8, 2), {"train": metadata(2, dt=1.0), "rollout": metadata(2)})
    out = tmp_path / "best.pt"
    given = ["--spacing", "0.05", "--gravity", "0", "-9.81", "--types", "6", "5", "--out", str(out)]
    assert main(["import-model", str(model), "--metadata", str(content), *given]) == 2
    assert "edges = None: " in capsys.readouterr().err and not out.exists()
    assert main(["import-model", str(model), "--metadata", str(content), "--edges", "doubled", *given]) == 0
    loaded = load_model(out)
    assert loaded.spec.particle_types == (5, 6) and loaded.spec.gravity == (0.0, -9.81) and loaded.spec.frame_step == 0.0025
    assert (loaded.options.noise, loaded.options.noise_unit, loaded.options.edge_update) == (6.7e-4, "absolute", False)
    assert main(["import-model", str(model), "--metadata", str(content), "--edges", "doubled", *given]) == 2
    assert main(["export-model", str(out), "--out", str(tmp_path / "port")]) == 0
    assert "before 11 December 2024 with --noise_std=0.00067; latent_dim 8, nmlp_layers 2, nmessage_passing_steps 2" in capsys.readouterr().out
    assert main(["export-model", str(out), "--out", str(tmp_path / "port")]) == 2


@pytest.mark.parametrize(
    ("weights", "content", "message"),
    [
        ({}, {}, "model-100.pt: state_dict"),
        ({"optimizer_state": {}}, {}, "train_state"),
        ([1], {}, "state_dict = 'list'"),
        ({**state_dict(2, 8, 2), "more": torch.zeros(1)}, {}, "more = \\[1\\]: must be absent"),
        ({**state_dict(2, 8, 2), f"{ROOT}_decoder.node_fn.NN-2.bias": torch.zeros(3)}, {}, "NN-2.bias = \\[3\\]: must be \\[2\\]"),
        ({**state_dict(2, 8, 2), f"{ROOT}_encoder.node_fn.0.NN-0.weight": torch.zeros(8, 20)}, {}, "must have 16 \\+ 4 columns"),
        ({**state_dict(2, 8, 2), f"{ROOT}_decoder.node_fn.NN-2.bias": torch.zeros(2).double()}, {}, "dense float32"),
        ({**state_dict(2, 8, 2), f"{ROOT}_encoder.node_fn.0.NN-0.weight": torch.zeros(1).expand(10**6, 30)}, {}, "dense float32"),
        ({**state_dict(2, 8, 2), f"{ROOT}_decoder.node_fn.NN-2.bias": torch.full((2,), torch.nan)}, {}, "must be finite"),
        ({**state_dict(2, 8, 2), "_particle_type_embedding.weight": torch.zeros(1, 16)}, {}, "must be \\[9, 16\\]"),
        (state_dict(3, 8, 2), {}, "NN-2.bias = \\[3\\]: must be \\[2\\]"),
        (state_dict(2, 8, 2), {"dim": 4}, "metadata.json: dim = 4"),
        (state_dict(2, 8, 2), {"vel_std": [1.0]}, "metadata.json: metadata = .*velocity_std"),
        (state_dict(2, 8, 2), {"acc_std": ["a", 1]}, "metadata.json: acc_std.0 = 'a'"),
        (state_dict(2, 8, 2), {"default_connectivity_radius": None}, "default_connectivity_radius"),
        (state_dict(2, 8, 2), {"gravity": [0.0]}, "gravity"),
    ],
)
def test_faults_are_one_line(tmp_path, weights, content, message):
    paths = write(tmp_path, weights, metadata(2, edges="updated", spacing=0.1, gravity=[0, 0], particle_types=[5]) | content)
    with pytest.raises(InputError, match=message) as caught:
        import_model(*paths)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["edges", "spacing", "gravity", "particle_types"])
def test_what_metadata_do_not_say_must_be_given(tmp_path, key):
    content = metadata(2, edges="updated", spacing=0.1, gravity=[0, 0], particle_types=[5])
    paths = write(tmp_path, state_dict(2, 8, 2), {name: value for name, value in content.items() if name != key})
    with pytest.raises(InputError, match=f"{key} = None: .* give --{'types' if key == 'particle_types' else key}"):
        import_model(*paths)


def test_files_that_are_not_there_or_not_theirs(tmp_path):
    model, content = write(tmp_path, state_dict(2, 8, 2), metadata(2))
    with pytest.raises(InputError, match="no such file"):
        import_model(tmp_path / "none.pt", content, edges="updated", spacing=0.1, gravity=[0, 0], particle_types=[5])
    for text in ("{", "[1]"):
        content.write_text(text)
        with pytest.raises(InputError, match="metadata.json"):
            import_model(model, content)
    content.unlink()
    with pytest.raises(InputError, match="metadata.json"):
        import_model(model, content)


@pytest.mark.parametrize(
    ("settings", "changes", "key"),
    [
        ({"inputs": "last"}, {}, "inputs"),
        ({"relative_velocity": True}, {}, "relative_velocity"),
        ({"ballistic": True, "walls": True}, {}, "walls"),
        ({"self_edges": False}, {}, "self_edges"),
        ({"encoder": "absolute"}, {}, "encoder"),
        ({"ballistic": True, "flight_below": 2}, {}, "flight_below"),
        ({"relaxation": {}}, {}, "relaxation"),
        ({}, {"stride": 2}, "stride"),
        ({}, {"periodic": ("x",)}, "periodic"),
        ({}, {"context_mean": (0.0, 0.0), "context_std": (1.0, 1.0)}, "context"),
    ],
)
def test_what_the_port_cannot_be_is_refused(tmp_path, settings, changes, key):
    model = build("gns", {"latent": 8, "message_passing": 1} | settings, spec(**changes))
    with pytest.raises(InputError, match=key):
        export_model(model, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files(tmp_path, data):
    """Truncated or overwritten anywhere, a model of the port is read or is an error of one line."""
    options = {"edges": "updated", "spacing": 0.1, "gravity": [0.0, 0.0], "particle_types": [5]}
    model, content = write(tmp_path, state_dict(2, 4, 1), metadata(2))
    path = data.draw(st.sampled_from([model, content]))
    raw = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        raw = raw[: data.draw(st.integers(0, len(raw) - 1))]
    for place in data.draw(st.lists(st.integers(0, len(raw) - 1), max_size=8)) if raw else []:
        raw[place] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    try:
        import_model(model, content, **options)
    except InputError as error:
        assert "\n" not in str(error)


def test_only_a_gns_goes_to_the_port(tmp_path, capsys):
    save_model(tmp_path / "grid.pt", build("grid_emulator", {"channels": [8, 8]}, spec(velocity_std=(1e-2, 1e-2))))
    assert main(["export-model", str(tmp_path / "grid.pt"), "--out", str(tmp_path / "out")]) == 2
    assert "only a gns" in capsys.readouterr().err


def test_an_export_is_complete_or_absent(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    model = build("gns", {"latent": 8, "message_passing": 1}, spec())
    with monkeypatch.context() as patch:
        patch.setattr("learn.exchange.write_content", full)
        with pytest.raises(RunError, match="out: cannot be written: No space left"):
            export_model(model, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    export_model(model, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["metadata.json", "model-0.pt"]
    with pytest.raises(InputError, match="exists already"):
        export_model(model, tmp_path / "out")
