"""The comparison of a data set with the published domains."""

from __future__ import annotations

import json

import pytest

from sim.cli import main
from sim.domains import DOMAINS
from sim.paper import against_paper
from sim.scene import SceneFamily


def dataset(path, scene="waterdrop", **statistics):
    found = {
        "velocity_std": [1.372e-3, 1.312e-3],
        "acceleration_std": [6.74e-5, 8.70e-5],
        "particles": [800, 1000.0, 1200],
        "frames": 1001,
        "neighbours": 12.0,
    }
    family = {"frame_step": 0.0025, "radius": 0.015}
    content = {"format_version": 1, "scene": scene, "family": family, "seed": 0, "shard_size": 8, "splits": {}, "statistics": found | statistics}
    path.mkdir(exist_ok=True)
    (path / "dataset.json").write_text(json.dumps(content))
    return path


def test_the_published_figures_miss_nothing(tmp_path):
    text = against_paper(dataset(tmp_path / "data"))
    assert "MISSED" not in text and "WATERDROP" in text and "within a factor 1.5" in text
    assert "MISSED" not in against_paper(dataset(tmp_path / "data", scene="waterdrop-stiff"))


@pytest.mark.parametrize(
    ("change", "label"),
    [
        ({"velocity_std": [1.372e-3 * 1.51, 1.312e-3]}, "velocity std x"),
        ({"acceleration_std": [6.74e-5, 8.70e-5 / 1.51]}, "acceleration std y"),
        ({"neighbours": 12 * 1.16}, "neighbours"),
        ({"neighbours": 12 * 0.84}, "neighbours"),
        ({"frames": 1000}, "steps"),
    ],
)
def test_what_is_off_is_said_in_its_row(tmp_path, change, label):
    missed = [line for line in against_paper(dataset(tmp_path / "data", **change)).splitlines() if "MISSED" in line]
    assert len(missed) == 1 and missed[0].startswith(label)


def test_unpublished_moments_are_shown_and_not_judged(tmp_path):
    text = against_paper(dataset(tmp_path / "data", scene="goop", frames=401, neighbours=10.0, velocity_std=[9.0, 9.0]))
    assert "not published" in text and "MISSED" not in text


def test_mistakes_are_one_line(tmp_path, capsys):
    assert main(["info", str(dataset(tmp_path / "data", scene="sand_demo")), "--against-paper"]) == 2
    assert "reproduces no domain" in capsys.readouterr().err
    path = dataset(tmp_path / "data")
    content = json.loads((path / "dataset.json").read_text()) | {"statistics": None}
    (path / "dataset.json").write_text(json.dumps(content))
    assert main(["info", str(path), "--against-paper"]) == 2
    assert "training split" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(DOMAINS))
def test_our_scenes_have_the_published_step_length_and_radius(name, request):
    path = request.config.rootpath / "configs" / "scenes" / f"{name}.yaml"
    model, domain = SceneFamily.load(path).model, DOMAINS[name]
    assert (model.frames - 1, model.frame_step, model.radius) == (domain.steps, domain.frame_step, domain.radius)
