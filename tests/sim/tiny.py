"""A family small enough for tests of the generator, and what is on disk of a data set."""

import json

from sim.scene import SceneFamily

FAMILY = {
    "name": "tiny",
    "dim": 2,
    "bounds": [[0.0, 1.0], [0.0, 1.0]],
    "gravity": [0.0, -9.8],
    "frame_step": 0.01,
    "frames": 12,
    "radius": 0.1,
    "cells": [16, 16],
    "materials": {"water": {"model": "water", "sound_speed": 5.0}},
    "bodies": [{"material": "water", "shape": {"kind": "box", "size": [[0.2, 0.4], [0.2, 0.4]]}, "velocity": [[-1, 1], [-1, 1]]}],
    "splits": {"train": 6, "valid": 2, "test": 2},
}


def family(**changes):
    return SceneFamily(FAMILY | changes, "tiny.yaml")


def shards(folder):
    """Bytes of every finished shard by name: a kill may leave a temporary one, whose name begins with a dot."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.glob("*/[!.]*.h5"))}


def without_cost(folder):
    content = json.loads((folder / "dataset.json").read_text())
    for split in content["splits"].values():
        del split["cost"]
    return content


def hidden(folder):
    return [path for path in folder.rglob(".*")]
