"""``plan`` tells the truth: what it lists is what the solver allocates and compiles, no more and no less."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sim.generate import simulate
from sim.plan import plan, plan_text
from sim.scene import SceneFamily

FAMILY = {
    "name": "tiny",
    "dim": 2,
    "bounds": [[0.0, 1.0], [0.0, 1.0]],
    "gravity": [0.0, -9.8],
    "frame_step": 0.01,
    "frames": 30,
    "radius": 0.1,
    "cells": [16, 16],
    "splits": {"train": 10, "valid": 2, "test": 0},
}
# Water much stiffer than its flow is fast: softer water stiffens where it is squeezed, and then takes more substeps than planned.
MATERIALS = {"water": {"model": "water", "sound_speed": 25.0}, "sand": {"model": "sand", "young_modulus": 1e4, "friction_angle": 35}}


def family(material, **changes):
    body = {"material": material, "shape": {"kind": "box", "size": [0.4, 0.3]}, "velocity": [[-1, 1], 0]}
    return SceneFamily(FAMILY | {"materials": {material: MATERIALS[material]}, "bodies": [body]} | changes, "tiny.yaml")


@pytest.mark.parametrize("material", ["water", "sand"])
def test_a_run_builds_and_costs_what_the_plan_says(material, built):
    from sim.mpm.solver import MPMSimulator

    scene = family(material).sample(0)
    promised = MPMSimulator().plan(scene)
    assert built == {"fields": [], "kernels": set()}, "planning must build nothing"
    trajectory = simulate(MPMSimulator(), scene)
    assert trajectory.ok
    # A few numbers (box, masses, moduli) are fields too; they are not worth a line of the plan.
    large = Counter(field for field in built["fields"] if field[1] > 8)
    assert large == Counter(map(tuple, promised["fields"].values()))
    assert sum(size * entries for size, entries in built["fields"]) <= promised["bytes"] + 1000
    assert built["kernels"] == set(promised["kernels"])
    assert promised["recorded"] == promised["particles"] == len(scene.particle_type())
    substeps = trajectory.diagnostics["substeps"][1:]
    assert substeps.min() >= promised["substeps_per_frame"][0]
    assert substeps.mean() == pytest.approx(np.mean(promised["substeps_per_frame"]), rel=0.3)


PARTS = {
    "obstacles": {"obstacles": [{"kind": "ball", "radius": 0.1, "count": [1, 1], "center": [0.2, 0.2]}]},
    "container": {"container": {"amplitude": [[1.0, 2.0], 0.0], "frequency": 1.0}},
    "rigid": {
        "materials": {"water": MATERIALS["water"], "box": {"model": "rigid", "density": 500.0}},
        "bodies": [
            {"material": "water", "shape": {"kind": "box", "size": [0.4, 0.3]}},
            {"material": "box", "shape": {"kind": "box", "size": [0.2, 0.1]}},
        ],
    },
    "rigid among obstacles": {
        "obstacles": [{"kind": "ball", "radius": 0.1, "center": [0.2, 0.2]}],
        "materials": {"water": MATERIALS["water"], "box": {"model": "rigid", "density": 500.0}},
        "bodies": [
            {"material": "water", "shape": {"kind": "box", "size": [0.3, 0.2]}, "center": [0.3, 0.8]},
            {"material": "box", "shape": {"kind": "box", "size": [0.2, 0.1]}, "center": [0.7, 0.5]},
        ],
    },
    "material": {
        "materials": {"water": MATERIALS["water"], "brine": MATERIALS["water"]},
        "bodies": [{"material": name, "shape": {"kind": "box", "size": [0.3, 0.3]}} for name in ("water", "brine")],
    },
    "dimension": {
        "dim": 3,
        "bounds": [[0.0, 1.0]] * 3,
        "gravity": [0.0, -9.8, 0.0],
        "cells": [12, 12, 12],
        "bodies": [{"material": "water", "shape": {"kind": "box", "size": [0.3, 0.3, 0.3]}}],
    },
}


@pytest.mark.parametrize("part", PARTS)
def test_parts_of_a_scene_build_what_the_plan_says(part, built):
    from sim.mpm.solver import MPMSimulator

    scene = family("water", frames=3, **PARTS[part]).sample(0)
    promised = MPMSimulator().plan(scene)
    assert simulate(MPMSimulator(), scene).ok
    assert Counter(field for field in built["fields"] if field[1] > 8) == Counter(map(tuple, promised["fields"].values()))
    assert built["kernels"] == set(promised["kernels"])
    bare = MPMSimulator().plan(family("water", frames=3).sample(0))
    own = {
        "obstacles": "signed distance",
        "container": "changing gravity",
        "rigid": "rigid bodies",
        "material": "material of a particle",
        "dimension": "third dimension",
    }[part.split()[0]]
    assert own in bare["left_out"] and own not in promised["left_out"]
    of_the_new = {f"{what} of brine" for what in ("F", "decomposition", "viscosity")} if part == "material" else set()
    assert set(promised["left_out"]) - set(bare["left_out"]) <= {"obstacle friction", "deformation of rigid bodies of box"} | of_the_new


def test_what_a_scene_does_not_need_is_left_out():
    water, sand = plan(family("water")).solver, plan(family("sand", walls={"friction": 0.4})).solver
    assert "water.J" in water["fields"] and not any("sand" in name for name in water["fields"])
    assert not any("water" in name for name in sand["fields"])
    assert "wall friction" in water["left_out"] and "wall friction" not in sand["left_out"]
    assert "third dimension" in water["left_out"]
    both = family("water", materials=MATERIALS)
    assert "material of a particle" not in plan(both).solver["left_out"] or len(both.model.materials) == 1


def test_figures_follow_the_scene():
    plain, fine = plan(family("water")), plan(family("water", refine=2))
    assert fine.recorded == plain.recorded and fine.particles == 4 * plain.particles
    assert fine.particle_substeps > 6 * plain.particle_substeps
    assert plain.disk == 4 * 30 * plain.recorded * 2
    assert plain.seconds == plain.particle_substeps / plain.rate


def test_text():
    text = plan_text(family("water"), jobs=2)
    for part in ("compiled: ", "left out:", "wall friction: slip walls", "train: 10 trajectories", "million particle-substeps", "allocated: "):
        assert part in text


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "configs/scenes").glob("*.yaml")), ids=lambda path: path.stem)
def test_committed_scenes_have_a_plan(path):
    assert plan(SceneFamily.load(path)).seconds < 60
