"""Scenes: sampling, the recorded set, and that every mistake in a file is one line and never a traceback."""

import copy
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from sim.errors import InputError
from sim.scene import Scene, SceneFamily
from sim.simulator import start_from
from sim.trajectory import PARTICLE_TYPES, ShardReader, Trajectory, write_shard

SCENES = sorted((Path(__file__).parents[2] / "configs/scenes").glob("*.yaml"))

BASE = {
    "name": "tiny",
    "dim": 2,
    "bounds": [[0.0, 1.0], [0.0, 1.0]],
    "gravity": [0.0, -9.8],
    "frame_step": 0.01,
    "frames": 12,
    "radius": 0.1,
    "cells": [16, 16],
    "jitter": 0.3,
    "materials": {"water": {"model": "water", "sound_speed": 5.0}, "sand": {"model": "sand", "young_modulus": 1e5, "friction_angle": 35}},
    "bodies": [
        {"material": "sand", "shape": {"kind": "polygon", "radius": [0.1, 0.15]}, "count": [1, 2], "velocity": [[-1, 1], 0.0]},
        {"material": "water", "shape": {"kind": "box", "size": [[0.2, 0.3], 0.25]}, "count": [1, 1]},
        {"material": "water", "shape": {"kind": "ball", "radius": [0.08, 0.12]}, "count": [0, 1]},
    ],
    "splits": {"train": 6, "valid": 2, "test": 2},
}


def family(**changes):
    return SceneFamily(copy.deepcopy(BASE) | changes, "tiny.yaml")


def cube():
    """A 3D family with both materials."""
    content = copy.deepcopy(BASE) | {"dim": 3, "bounds": [[0, 1]] * 3, "gravity": [0, 0, -9.8], "cells": [12] * 3}
    content["bodies"] = [
        {"material": "water", "shape": {"kind": "box", "size": [0.3, 0.3, 0.3]}},
        {"material": "sand", "shape": {"kind": "ball", "radius": 0.15}, "velocity": [0, 0, [-1, 0]]},
    ]
    return SceneFamily(content, "cube.yaml")


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_committed_scenes_sample(path):
    variants = [None, *yaml.safe_load(path.read_text()).get("variants", {})]
    for variant in variants:
        scene = SceneFamily.load(path, variant).sample(0)
        particles = scene.particles()
        lower, upper = np.array(scene.bounds).T
        assert (particles.position >= lower).all() and (particles.position <= upper).all()
        assert scene.name == path.stem + (f"-{variant}" if variant else "")


@pytest.mark.parametrize("make", [family, cube])
@pytest.mark.parametrize("seed", range(5))
def test_bodies_are_in_the_box_and_apart(make, seed):
    scene = make().sample(seed)
    lower, upper = np.array(scene.bounds).T
    clouds = []
    for body in scene.bodies:
        alone = Scene.from_dict(scene.to_dict() | {"bodies": [body.model_dump(mode="json")], "jitter": 0.0})
        clouds.append(alone.particles(refine=1).position)
        assert (clouds[-1] > lower).all() and (clouds[-1] < upper).all()
    for first in range(len(clouds)):
        for second in range(first):
            assert cKDTree(clouds[first]).query(clouds[second])[0].min() >= 1.5 * scene.spacing
    assert sum(map(len, clouds)) == len(scene.particles(refine=1).position)


def test_the_seed_determines_the_scene():
    assert family().sample(3).to_dict() == family().sample(3).to_dict()
    assert family().sample(3).to_dict() != family().sample(4).to_dict()
    np.testing.assert_array_equal(family().sample(3).particles().position, family().sample(3).particles().position)


def test_dict_is_json_and_inverts():
    scene = family().sample(1)
    content = json.loads(json.dumps(scene.to_dict()))
    assert Scene.from_dict(content) == scene
    assert content["spacing"] == scene.spacing and content["grid_spacing"] == scene.grid_spacing == 1 / 16
    with pytest.raises(InputError, match="meta: colour = 'blue': unknown key"):
        Scene.from_dict(content | {"colour": "blue"}, "meta")


def test_a_scene_read_back_has_its_particles_in_their_order(tmp_path):
    """They lie in the order of its materials, here water and then sand, which a file must not change."""
    scene = family().sample(3)
    position, kinds = scene.start(), scene.particle_type()
    run = Trajectory(position[None].astype(np.float32), kinds, 0.01, 0.1, np.array(scene.bounds), scene.to_dict(), 3, {})
    write_shard(tmp_path / "one.h5", {0: run})
    with ShardReader(tmp_path / "one.h5") as reader:
        again = Scene.from_dict(reader.read(0).scene)
    assert len(set(kinds)) == 2
    assert np.array_equal(again.particle_type(), kinds) and np.array_equal(again.start(), position)
    assert Scene.of(start_from(run, 1)).start().shape == position.shape
    # A file of an earlier version, which sorted the keys: a solver must not begin with other particles than the file's.
    old = dataclasses.replace(run, scene=json.loads(json.dumps(run.scene, sort_keys=True)))
    with pytest.raises(InputError, match="in another order than the scene's: written by an earlier version; generate the data set again"):
        Scene.of(start_from(old, 1))


@pytest.mark.parametrize("make", [family, cube])
@pytest.mark.parametrize("refine", [1, 2, 3])
def test_the_recorded_set_is_the_same_in_every_rung(make, refine):
    """refine=1 of a refined scene gives the tracked particles of the refined one, bit for bit, each in its own cube."""
    scene = Scene.from_dict(make().sample(2).to_dict() | {"refine": refine})
    fine, coarse = scene.particles(), scene.particles(refine=1)
    assert len(fine.position) == refine**scene.dim * len(coarse.position)
    np.testing.assert_array_equal(fine.position[fine.tracked], coarse.position)
    np.testing.assert_array_equal(fine.velocity[fine.tracked], coarse.velocity)
    np.testing.assert_array_equal(fine.material[fine.tracked], coarse.material)
    assert fine.spacing == scene.spacing / refine and coarse.spacing == scene.spacing
    assert (np.diff(fine.material) >= 0).all()
    lattice = Scene.from_dict(scene.to_dict() | {"refine": 1, "jitter": 0.0}).particles().position
    offset = 0.25 if refine == 2 else 0.0
    reach = (offset + scene.jitter / 2 / refine) * scene.spacing
    assert np.abs(coarse.position - lattice).max() <= reach + 1e-12


@pytest.mark.parametrize("make", [family, cube])
@pytest.mark.parametrize("refine", [2, 3])
def test_a_rung_between_starts_its_recorded_particles_where_the_teacher_does(make, refine):
    scene = Scene.from_dict(make().sample(2).to_dict() | {"refine": 4})
    between, coarse = scene.particles(refine), scene.particles(refine=1)
    assert len(between.position) == refine**scene.dim * len(coarse.position) and between.spacing == scene.spacing / refine
    np.testing.assert_array_equal(between.position[between.tracked], coarse.position)
    np.testing.assert_array_equal(between.velocity[between.tracked], coarse.velocity)
    np.testing.assert_array_equal(between.material[between.tracked], coarse.material)
    np.testing.assert_array_equal(between.body[between.tracked], coarse.body)
    # The one that was put elsewhere was one of its cube's central particles.
    own = Scene.from_dict(scene.to_dict() | {"refine": refine}).particles()
    moved = np.abs(between.position - own.position).max(1)
    assert (np.delete(moved, between.tracked) == 0).all() and 0 < moved.max() < 0.75 * scene.spacing
    assert scene.refinement(refine) == refine and scene.refinement("teacher") == 4 and scene.refinement("recorded") == 1
    with pytest.raises(InputError, match="particles = 5: finer than the teacher's, which are refined 4 times; use teacher"):
        scene.refinement(5)


@pytest.mark.parametrize("make", [family, cube])
def test_mass_is_the_same_at_every_refinement(make):
    scene = make().sample(5)
    names = list(scene.materials)
    densities = np.array([material.density for material in scene.materials.values()])

    def masses(refine):
        particles = scene.particles(refine)
        mass = densities[particles.material] * particles.spacing**scene.dim
        return [mass[particles.material == index].sum() for index in range(len(names))]

    np.testing.assert_allclose(masses(2), masses(1), rtol=1e-12)
    np.testing.assert_allclose(masses(3), masses(1), rtol=1e-12)


def test_a_box_has_exactly_its_mass():
    scene = family(bodies=[{"material": "water", "shape": {"kind": "box", "size": [0.25, 0.125]}}]).sample(0)
    assert len(scene.particles().position) == 8 * 4
    assert len(scene.particles().position) * scene.spacing**2 == pytest.approx(0.25 * 0.125, rel=1e-12)


def test_jitter_is_bounded_and_unbiased():
    scene = family(bodies=[{"material": "water", "shape": {"kind": "box", "size": [0.75, 0.75]}, "center": [0.5, 0.5]}]).sample(0)
    plain = Scene.from_dict(scene.to_dict() | {"jitter": 0.0}).particles().position
    shift = (scene.particles().position - plain) / scene.spacing
    assert 0.14 < np.abs(shift).max() <= 0.15
    assert np.abs(shift.mean(0)).max() < 0.02
    spacing = cKDTree(plain).query(plain, 2)[0][:, 1]
    np.testing.assert_allclose(spacing, scene.spacing, rtol=1e-9)


def test_types_and_velocities_follow_the_bodies():
    scene = cube().sample(0)
    particles, kinds = scene.particles(refine=1), scene.particle_type()
    assert set(kinds) == {PARTICLE_TYPES["water"], PARTICLE_TYPES["sand"]}
    moving = particles.velocity[:, 2] != 0
    assert (kinds[moving] == PARTICLE_TYPES["sand"]).all() and (particles.velocity[~moving] == 0).all()


SAND = {"model": "sand", "young_modulus": 1e5, "friction_angle": 30}
GOOP = {"model": "goop", "young_modulus": 1e5, "yield_stress": 10}
MISTAKES = {
    "unknown key": ({"colour": "blue"}, "colour = 'blue': unknown key"),
    "wrong type": ({"frames": "many"}, "frames = 'many'"),
    "missing": ({"gravity": None}, "gravity"),
    "negative step": ({"frame_step": -0.1}, "frame_step = -0.1"),
    "infinite": ({"gravity": [0.0, float("inf")]}, "gravity"),
    "one axis too few": ({"gravity": [0.0]}, "gravity = \\[0.0\\]: needs 2 entries"),
    "empty box": ({"bounds": [[0, 1], [1, 1]]}, "bounds\\[1\\]"),
    "oblong cells": ({"cells": [16, 20]}, "cells = .*try \\[16, 16\\]"),
    "radius": ({"radius": 0.03}, "radius = 0.03: below the particle spacing"),
    "no body": ({"bodies": []}, "bodies = \\[\\]: an empty scene"),
    "unknown material": ({"bodies": [{"material": "lava", "shape": {"kind": "ball", "radius": 0.1}}]}, "bodies\\[0\\].material = 'lava': not among"),
    "negative size": ({"bodies": [{"material": "water", "shape": {"kind": "ball", "radius": -0.1}}]}, "bodies\\[0\\].shape.radius = -0.1"),
    "reversed range": ({"bodies": [{"material": "water", "shape": {"kind": "ball", "radius": [0.2, 0.1]}}]}, "bodies\\[0\\].shape.radius"),
    "unknown shape": ({"bodies": [{"material": "water", "shape": {"kind": "torus"}}]}, "bodies\\[0\\].shape"),
    "liquid sand": ({"materials": {"sand": {"model": "sand", "young_modulus": 1e5, "friction_angle": 90}}}, "materials.sand.friction_angle = 90"),
    "steep sand": ({"materials": {"sand": SAND | {"friction_angle": 90}}}, "materials.sand.friction_angle = 90.0: must lie"),
    "sticky liquid": ({"materials": {"sand": SAND | {"friction_angle": 0, "cohesion": 10}}}, "materials.sand.cohesion = 10.0: needs"),
    "incompressible": ({"materials": {"goop": GOOP | {"poisson_ratio": 0.5}}}, "materials.goop.poisson_ratio = 0.5: must lie in 0 .. 0.4999"),
    "negative yield": ({"materials": {"goop": GOOP | {"yield_stress": -1}}}, "materials.goop.yield_stress = -1.0: must not"),
    "infinite yield": ({"materials": {"goop": GOOP | {"yield_stress": float("inf")}}}, "materials.goop.yield_stress = inf"),
    "negative viscosity": ({"materials": {"water": {"model": "water", "sound_speed": 5, "viscosity": -0.1}}}, "materials.water.viscosity = -0.1"),
    "no stretch": ({"materials": {"snow": {"model": "snow", "critical_stretch": 0}}}, "materials.snow.critical_stretch = 0"),
    "soft rubber": ({"materials": {"rubber": {"model": "elastic", "young_modulus": 0}}}, "materials.rubber.young_modulus = 0"),
    "huge grid": ({"cells": [10**6, 10**6]}, "cells\\[0\\] = 1000000"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_name_file_key_value_and_remedy(case):
    changes, message = MISTAKES[case]
    with pytest.raises(InputError, match=f"^tiny.yaml: {message}") as caught:
        family(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("bodies", "message"),
    [
        ([{"material": "water", "shape": {"kind": "box", "size": [0.2, 0.2]}, "center": [0.05, 0.5]}], "outside the box"),
        ([{"material": "water", "shape": {"kind": "ball", "radius": 0.1}, "center": [0.5, 0.5], "count": [2, 2]}], "overlapping another body"),
    ],
)
def test_impossible_places(bodies, message, monkeypatch):
    monkeypatch.setattr("sim.scene._TRIES", 5)
    with pytest.raises(InputError, match=rf"tiny.yaml: bodies\[0\] = 'seed 7': {message}"):
        family(bodies=bodies).sample(7)


def test_absurd_sizes_are_refused_before_memory_is():
    content = copy.deepcopy(BASE) | {"dim": 3, "bounds": [[0, 1]] * 3, "gravity": [0, 0, 0], "cells": [4096] * 3}
    content["bodies"] = [{"material": "water", "shape": {"kind": "box", "size": [0.5, 0.5, 0.5]}}]
    with pytest.raises(InputError, match="tiny.yaml: cells = .*particles; use fewer"):
        SceneFamily(content, "tiny.yaml").sample(0)


def test_variants():
    content = BASE | {"variants": {"stiff": {"materials": {"water": {"sound_speed": 50.0}}}, "typo": {"radiu": 1}}}
    stiff = SceneFamily(content, "tiny.yaml", "stiff")
    assert stiff.model.materials["water"].sound_speed == 50.0 and stiff.model.materials["water"].density == 1000.0
    assert stiff.model.name == "tiny-stiff"
    with pytest.raises(InputError, match="variant = 'soft': not among the variants"):
        SceneFamily(content, "tiny.yaml", "soft")
    with pytest.raises(InputError, match="radiu"):
        SceneFamily(content, "tiny.yaml", "typo")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1", "not valid YAML"),
        ("a: 1\na: 2", "line 2 = \"duplicate key 'a'\""),
        ("- 1", "must be a mapping"),
        ("", "must be a mapping"),
        ("1: 2", "not text"),
        ("a: !!python/object/apply:os.system [id]", "not valid YAML"),
        ("a: &x [*x, *x]", "scene.yaml"),
        ("? [1, 2]\n: 3", "not text"),
    ],
)
def test_files_that_are_not_scenes(tmp_path, text, message):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        SceneFamily.load(path)
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    for path in (tmp_path / "absent.yaml", tmp_path):
        with pytest.raises(InputError):
            SceneFamily.load(path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError):
        SceneFamily.load(tmp_path / "binary.yaml")


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(text=st.text(alphabet=st.sampled_from("ab:-[]{}#&*!|>'\"%@`,? \n\t01.e\x00é"), max_size=40))
def test_arbitrary_text_raises_only_input_errors(text, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "text.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError):
        SceneFamily.load(path)
