"""Moving containers and varying material numbers: what is drawn, what the solver feels, what the context says."""

import copy

import numpy as np
import pytest
from scipy.integrate import quad

from sim.container import Container
from sim.errors import InputError
from sim.generate import generate, simulate
from sim.mpm.solver import MPMSimulator
from sim.scene import Scene, SceneFamily
from sim.simulator import start_from
from sim.trajectory import ShardReader

EPS = float(np.finfo(np.float32).eps)
BASE = {
    "name": "shaken",
    "dim": 2,
    "bounds": [[0.0, 1.0], [0.0, 1.0]],
    "gravity": [0.0, -9.8],
    "frame_step": 0.01,
    "frames": 12,
    "radius": 0.1,
    "cells": [16, 16],
    "materials": {"sand": {"model": "sand", "young_modulus": 1e5, "friction_angle": 35.0}},
    "bodies": [{"material": "sand", "shape": {"kind": "box", "size": [0.25, 0.25]}}],
    "splits": {"train": 6, "valid": 2, "test": 2},
}
SHAKE = {"sines": [1, 3], "amplitude": [[-8, 8], 0], "frequency": [0.5, 3]}


def family(**changes):
    return SceneFamily(copy.deepcopy(BASE) | changes, "shaken.yaml")


def sand(**changes):
    return {"sand": BASE["materials"]["sand"] | changes}


# -- the container


def test_acceleration_is_the_mean_over_each_frame():
    motion = Container(
        sines=[{"amplitude": [3.0, -1.0], "frequency": 1.7, "phase": 30.0}, {"amplitude": [0.5, 2.0], "frequency": 9.0, "phase": 200.0}]
    )
    found, step = motion.acceleration(20, 0.01), 0.01

    def a(t, axis):
        return sum(s.amplitude[axis] * np.sin(2 * np.pi * s.frequency * t + np.radians(s.phase)) for s in motion.sines)

    for frame in (0, 7, 19):
        for axis in (0, 1):
            exact = quad(a, frame * step, (frame + 1) * step, args=(axis,))[0] / step
            assert found[frame, axis] == pytest.approx(exact, abs=1e-10)


def test_context_is_what_the_solver_felt():
    scene = family(container=SHAKE).sample(3)
    context = scene.context_values()
    assert context.dtype == np.float32 and context.shape == (12, 2) and (context[:, 1] == 0).all() and np.ptp(context[:, 0]) > 0
    assert (context == scene.acceleration().astype(np.float32)).all()
    assert Scene.from_dict(scene.to_dict()) == scene
    plain = family().sample(3)
    assert plain.context_values() is None and plain.bodies == scene.bodies, "a container changes no body"
    assert scene.container != family(container=SHAKE).sample(4).container


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_shaken_at_10_g_equals_a_moving_frame(dim):
    """A lone particle: in the ground's frame it falls freely, X = X0 + V0 t + g t^2 / 2; the box is where its own acceleration took it.

    Both are integrated by the same rule (symplectic Euler in equal substeps), exactly: the difference is rounding, about one eps of
    the position in cells (18 of them) a substep.
    """
    directions = [[98.0, -30.0, 20.0][:dim], [-10.0, 70.0, 5.0][:dim]]
    motion = {"sines": [{"amplitude": directions[0], "frequency": 8.0, "phase": 90.0}, {"amplitude": directions[1], "frequency": 5.0, "phase": 10.0}]}
    scene = Scene.from_dict(
        {
            "name": "lone",
            "dim": dim,
            "bounds": [[0.0, 1.0]] * dim,
            "gravity": [0.0] * (dim - 1) + [-9.8],
            "frame_step": 0.005,
            "frames": 60,
            "radius": 0.1,
            "cells": [16] * dim,
            "materials": {"water": {"model": "water", "sound_speed": 10.0}},
            "seed": 3,
            "bodies": [{"material": "water", "kind": "box", "lower": [0.5] * dim, "upper": [0.52] * dim, "velocity": [0.3] * dim}],
            "container": motion,
        }
    )
    simulator = MPMSimulator()
    simulator.load(scene)
    acceleration, ground = scene.acceleration(), np.array(scene.gravity)
    assert np.linalg.norm(acceleration, axis=1).max() > 9 * 9.8
    particle, box = scene.particles().position[0], np.zeros(dim)
    fly, ride, steps = np.full(dim, 0.3), np.zeros(dim), 0
    for frame in range(25):
        found = simulator.frame()[0]
        n, dt = simulator.diagnostics()["substeps"], simulator.diagnostics()["dt"]
        for position, velocity, pull in ((particle, fly, ground), (box, ride, acceleration[frame])):
            position += velocity * n * dt + pull * dt**2 * n * (n + 1) / 2
            velocity += pull * n * dt
        steps += n
        assert (np.abs(particle - box - 0.5) < 0.45).all(), "it has not reached a wall"
        assert np.abs(found - (particle - box)).max() < EPS * 18 / 16 * steps
    assert np.abs(box).max() > 0.05, "the box did move"


def test_only_a_shaken_scene_has_changing_gravity():
    still, shaken = MPMSimulator(), MPMSimulator()
    assert "changing gravity" in still.plan(family().sample(0))["left_out"] and still.plan(family().sample(0))["context"] == 0
    assert "changing gravity" not in shaken.plan(family(container=SHAKE).sample(0))["left_out"]
    assert "context" not in shaken.plan(family(container=SHAKE).sample(0))["left_out"]
    assert shaken.plan(family(container=SHAKE).sample(0))["context"] == 2
    still.load(family().sample(0))
    assert still._kernels.pull is still._kernels.gravity


def test_parallel_kernels_agree_with_serial_ones_and_with_a_second_run():
    scene = family(container=SHAKE | {"amplitude": [[20, 30], 10]}).sample(1)
    runs = []
    for serial in (True, False, True):
        simulator = MPMSimulator(serial=serial)
        simulator.load(scene)
        runs.append([simulator.frame() for _ in range(8)][-1])
    assert (runs[0] == runs[2]).all() and np.abs(runs[0] - runs[1]).max() < 100 * EPS


# -- varying numbers

SPLIT_RANGES = {"train": [[0, 30], [55, 80]], "valid": [[0, 30], [55, 80]], "test": [30, 55]}


def test_numbers_are_drawn_by_split():
    some = family(materials=sand(friction_angle=SPLIT_RANGES), context=["sand.friction_angle"])
    drawn = {split: np.array([some.sample(seed, split).materials["sand"].friction_angle for seed in range(200)]) for split in SPLIT_RANGES}
    train = drawn["train"]
    assert (((train >= 0) & (train <= 30)) | ((train >= 55) & (train <= 80))).all()
    assert (train < 30).mean() == pytest.approx(30 / 55, abs=0.12), "in proportion to the widths"
    assert ((drawn["test"] >= 30) & (drawn["test"] <= 55)).all() and np.ptp(drawn["test"]) > 20
    assert (drawn["train"] == drawn["valid"]).all(), "the same ranges, the same draw"
    scene = some.sample(5, "test")
    assert scene.context_values() == pytest.approx(np.full((12, 1), drawn["test"][5]), rel=1e-6)
    assert scene.bodies == family().sample(5).bodies, "a range changes no body"
    again = SceneFamily(some.to_dict(), "again")
    assert again.to_dict() == some.to_dict() and again.sample(5, "test") == scene


def test_one_range_serves_all_splits():
    some = family(
        materials=sand(friction_angle=[20, 40], young_modulus=[[1e5, 2e5], [5e5, 6e5]]), context=["sand.young_modulus", "sand.friction_angle"]
    )
    scene = some.sample(1)
    assert some.sample(1, "test").materials == scene.materials
    numbers = scene.materials["sand"]
    assert scene.context_values()[0] == pytest.approx([numbers.young_modulus, numbers.friction_angle], rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"materials": sand(friction_angle=[40, 20])}, r"materials.sand.friction_angle = \[40, 20\]: low must not exceed high"),
        ({"materials": sand(friction_angle=[20, 95])}, r"materials.sand.friction_angle = 95"),
        ({"materials": sand(friction_angle={"train": [0, 30]})}, r"materials.sand.friction_angle = .*each of train, valid, test"),
        ({"materials": sand(friction_angle=SPLIT_RANGES | {"tset": [0, 1]})}, r"materials.sand.friction_angle = .*each of train, valid, test"),
        ({"materials": sand(friction_angle=[])}, r"materials.sand.friction_angle = \[\]: must be a number"),
        ({"materials": sand(friction_angle=["a", "b"])}, r"materials.sand.friction_angle = .*must be a number"),
        ({"materials": sand(model=["sand", "water"])}, r"materials.sand.model = .*must be a number"),
        ({"materials": sand(colour=[1, 2])}, r"materials.sand.colour = .*unknown key"),
        ({"context": ["sand.colour"]}, r"context\[0\] = 'sand.colour': must be material.key"),
        ({"context": ["sand.model"]}, r"context\[0\] = 'sand.model'"),
        ({"context": ["friction"]}, r"context\[0\] = 'friction'"),
        ({"container": SHAKE | {"amplitude": [1]}}, r"container.amplitude = \[1.0\]: needs 2 entries"),
        ({"container": SHAKE | {"frequency": 0}}, r"container.frequency = 0.0: must be positive"),
        ({"container": SHAKE | {"sines": [3, 1]}}, r"container.sines = \[3, 1\]: low must not exceed high"),
        ({"container": SHAKE | {"speed": 1}}, r"container.speed = 1: unknown key"),
    ],
)
def test_mistakes_name_file_key_value_and_remedy(changes, message):
    with pytest.raises(InputError, match=f"^shaken.yaml: {message}") as caught:
        family(**changes)
    assert "\n" not in str(caught.value)


def test_a_data_set_with_context(tmp_path):
    """Per frame in the trajectory, in the statistics, in a Start, and read by the learner."""
    some = family(materials=sand(friction_angle=SPLIT_RANGES), context=["sand.friction_angle"], container=SHAKE)
    content = generate(some, {"train": 3, "test": 1}, tmp_path)
    assert content["splits"]["train"]["ok"] == 3
    contexts = []
    with ShardReader(tmp_path / "train/shard-00000.h5") as reader:
        for index in range(3):
            trajectory = reader.read(index)
            scene = Scene.from_dict(trajectory.scene)
            assert (trajectory.context == scene.context_values()).all() and trajectory.context.shape == (12, 3)
            assert (start_from(trajectory).context == trajectory.context).all()
            contexts.append(trajectory.context)
    rows = np.concatenate(contexts).astype(float)
    assert content["statistics"]["context_mean"] == pytest.approx(rows.mean(0).tolist())
    assert content["statistics"]["context_std"] == pytest.approx(rows.std(0).tolist(), abs=1e-9)
    with ShardReader(tmp_path / "test/shard-00000.h5") as reader:
        assert 30 <= reader.context(0)[0, 2] <= 55
    from learn.dataset import Dataset

    spec = Dataset(tmp_path, "train").spec()
    assert spec.context_mean == pytest.approx(rows.mean(0).tolist(), rel=1e-5) and len(spec.context_std) == 3


def test_a_trajectory_without_context_has_none():
    trajectory = simulate(MPMSimulator(), family(frames=3).sample(0))
    assert trajectory.context is None and "context" not in trajectory.scene and "container" not in trajectory.scene
