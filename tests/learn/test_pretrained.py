"""The shipped checkpoints: each loads, predicts, and has its recipe's settings but for what ``done.json`` says was changed after training."""

import json
from pathlib import Path

import numpy as np
import pytest

from learn.checkpoint import load_model
from learn.train import Config, load_config
from sim.simulator import Start, rollout

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = sorted((ROOT / "pretrained").glob("*/best.pt"))


@pytest.mark.parametrize("checkpoint", SHIPPED, ids=lambda path: path.parent.name)
def test_shipped_checkpoint(checkpoint: Path) -> None:
    model = load_model(checkpoint)
    done = json.loads((checkpoint.parent / "done.json").read_text())
    config = load_config(ROOT / "configs" / "models" / f"{checkpoint.parent.name}.yaml")
    # Options younger than a checkpoint had their defaults.
    recipe, trained = (json.loads(json.dumps(each.model_dump(mode="json"))) for each in (config, Config.model_validate(done["config"])))
    later = {name: new for name, (_, new) in done.get("changed", {}).get("after training", {}).items()}
    assert {**trained, "settings": trained["settings"] | later} == recipe and done["model"] == config.model
    assert all(model.settings[name] == value for name, value in recipe["settings"].items())
    assert done["parameters"] == sum(parameter.numel() for parameter in model.parameters())
    # A block high above the floor falls freely, near enough.
    spec = model.spec
    lattice = np.stack(np.meshgrid(*[np.arange(8) * spec.spacing] * 2), -1).reshape(-1, 2) + 0.45
    fall = np.arange(model.history)[:, None, None] ** 2 * spec.frame_step**2 / 2 * np.array(spec.gravity)
    kinds = np.full(len(lattice), spec.particle_types[0], np.int8)
    known = (lattice + fall).astype(np.float32)
    start = Start(known, kinds, model.history - 1, spec.frame_step, spec.radius, np.array(spec.bounds), {"gravity": list(spec.gravity)})
    run = rollout(model, start, 16)
    last = model.history + 15
    exact = lattice + last**2 * spec.frame_step**2 / 2 * np.array(spec.gravity)
    assert run.status == "ok" and np.abs(run.position[-1] - exact).max() < spec.spacing / 2


def test_something_is_shipped() -> None:
    assert SHIPPED
