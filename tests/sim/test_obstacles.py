"""Obstacles: distances against formulas, sampling, kinematic particles, and that nothing in the solver passes through them."""

import copy
from pathlib import Path

import meshio
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from pydantic import TypeAdapter
from scipy.spatial import cKDTree

from sim.cli import main
from sim.errors import InputError
from sim.generate import simulate
from sim.mpm.solver import REACH, MPMSimulator, column_table
from sim.obstacles import THINNEST, Obstacle, boundary_particles, combine
from sim.scene import Scene, SceneFamily
from sim.trajectory import KINEMATIC_TYPE

L_SHAPE = [[0.2, 0.2], [0.8, 0.2], [0.8, 0.4], [0.4, 0.4], [0.4, 0.9], [0.2, 0.9]]
SOLIDS = {
    2: [
        {"kind": "segment", "start": [0.2, 0.3], "end": [0.7, 0.6], "thickness": 0.1},
        {"kind": "polygon", "vertices": L_SHAPE},
        {"kind": "polygon", "vertices": L_SHAPE[::-1]},
        {"kind": "floor", "vertices": [[0.0, 0.2], [0.4, 0.5], [0.7, 0.1], [1.0, 0.3]]},
        {"kind": "ball", "center": [0.4, 0.6], "radius": 0.2},
        {"kind": "box", "lower": [0.2, 0.3], "upper": [0.5, 0.9]},
        {"kind": "halfspace", "point": [0.5, 0.2], "normal": [-1.0, 2.0]},
    ],
    3: [
        {"kind": "ball", "center": [0.4, 0.6, 0.5], "radius": 0.2},
        {"kind": "box", "lower": [0.2, 0.3, 0.4], "upper": [0.5, 0.9, 0.7]},
        {"kind": "halfspace", "point": [0.5, 0.2, 0.5], "normal": [-1.0, 2.0, 0.5]},
    ],
}


def solid(content):
    return TypeAdapter(Obstacle).validate_python(content)


EVERY = [(dim, index) for dim in (2, 3) for index in range(len(SOLIDS[dim]))]
coordinate = st.floats(-0.5, 1.5)


@pytest.mark.parametrize(("dim", "index"), EVERY)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_distance_is_1_lipschitz_with_unit_gradient(dim, index, data):
    one = solid(SOLIDS[dim][index])
    points = np.array(data.draw(st.lists(st.tuples(*[coordinate] * dim), min_size=2, max_size=20)))
    distance, normal = one.distance(points)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert (np.abs(distance[:, None] - distance[None]) <= apart + 1e-12).all()
    assert np.linalg.norm(normal, axis=1) == pytest.approx(np.ones(len(points)), abs=1e-12)
    # The nearest point of the surface is where the gradient says it is.
    feet = points - distance[:, None] * normal
    assert np.abs(one.distance(feet)[0]).max() < 1e-9
    # And the sign does not change on the way there.
    near = one.distance(feet + np.sign(distance)[:, None] * 1e-6 * normal)[0]
    assert (near * np.sign(distance) >= 0).all()


def test_sign_of_a_polygon_that_is_not_convex():
    points = np.random.default_rng(0).uniform(0, 1, (5000, 2))
    distance, _ = solid(SOLIDS[2][1]).distance(points)
    assert ((distance < 0) == Outline(L_SHAPE).contains_points(points)).all()


@pytest.mark.parametrize(
    ("content", "point", "distance", "normal"),
    [
        (SOLIDS[2][4], [0.4, 0.9], 0.1, [0, 1]),
        (SOLIDS[2][4], [0.3, 0.6], -0.1, [-1, 0]),
        (SOLIDS[2][5], [0.1, 0.5], 0.1, [-1, 0]),
        (SOLIDS[2][5], [0.45, 0.6], -0.05, [1, 0]),
        (SOLIDS[2][5], [0.8, 1.3], 0.5, [0.6, 0.8]),
        (SOLIDS[2][1], [0.6, 0.5], 0.1, [0, 1]),
        (SOLIDS[2][1], [0.3, 0.8], -0.1, [0, 1]),
        (SOLIDS[2][1], [0.7, 0.25], -0.05, [0, -1]),
        (SOLIDS[2][3], [-0.3, 0.3], 0.1, [0, 1]),
        (SOLIDS[2][3], [1.2, 0.2], -0.1, [0, 1]),
        ({"kind": "segment", "start": [0, 0], "end": [1, 0], "thickness": 0.2}, [0.5, -0.3], 0.2, [0, -1]),
        ({"kind": "segment", "start": [0, 0], "end": [1, 0], "thickness": 0.2}, [1.3, 0.4], 0.4, [0.6, 0.8]),
        ({"kind": "segment", "start": [0, 0], "end": [1, 0], "thickness": 0.2}, [0.5, 0.0], -0.1, [0, 1]),
        ({"kind": "halfspace", "point": [0, 0, 0], "normal": [0, 3, 4]}, [7, 3, 4], 5, [0, 0.6, 0.8]),
        (SOLIDS[3][1], [0.1, 0.2, 0.5], np.sqrt(0.02), [-np.sqrt(0.5), -np.sqrt(0.5), 0]),
    ],
)
def test_distances_by_hand(content, point, distance, normal):
    found, its_normal = solid(content).distance(np.array([point], float))
    assert found[0] == pytest.approx(distance, abs=1e-12)
    if content is not SOLIDS[2][1] or point != [0.3, 0.8]:  # there, three sides are equally near
        assert its_normal[0] == pytest.approx(normal, abs=1e-12)


def test_union_is_the_nearest():
    both = [solid(SOLIDS[2][4]), solid(SOLIDS[2][5])]
    points = np.random.default_rng(0).uniform(0, 1, (500, 2))
    distance, normal, nearest = combine(both, points)
    each = np.array([one.distance(points)[0] for one in both])
    assert (distance == each.min(0)).all() and (nearest == each.argmin(0)).all()
    assert np.linalg.norm(normal, axis=1) == pytest.approx(np.ones(500))


# -- meshes


@pytest.fixture
def shapes(tmp_path):
    """A ball, a cube and a ring as STL, OBJ and PLY, one of them with its triangles turned inside out."""
    import pyvista

    made = {}
    ball, cube = pyvista.Icosphere(radius=0.5, nsub=4), pyvista.Cube().triangulate().clean()
    ring = pyvista.ParametricTorus(ringradius=0.4, crosssectionradius=0.15).triangulate().clean(tolerance=1e-6)
    for name, surface, kind, flip in (("ball", ball, "stl", False), ("cube", cube, "obj", True), ("ring", ring, "ply", False)):
        faces = np.asarray(surface.regular_faces)
        made[name] = tmp_path / f"{name}.{kind}"
        meshio.Mesh(np.asarray(surface.points, float), [("triangle", faces[:, ::-1] if flip else faces)]).write(made[name])
    return made


def mesh_family(file, **changes):
    content = {
        "name": "mesh",
        "dim": 3,
        "bounds": [[0, 1]] * 3,
        "gravity": [0, 0, -9.8],
        "frame_step": 0.01,
        "frames": 5,
        "radius": 0.2,
        "cells": [12] * 3,
        "materials": {"water": {"model": "water", "sound_speed": 5.0}},
        "splits": {"train": 1, "valid": 0, "test": 0},
        "bodies": [{"material": "water", "shape": {"kind": "box", "size": [0.3, 0.3, 0.2]}, "center": [0.5, 0.5, 0.85]}],
        "obstacles": [{"kind": "mesh", "file": file, "scale": 0.5, "center": [0.5, 0.5, 0.4]}],
    }
    return content | changes


@pytest.mark.parametrize("name", ["ball", "cube", "ring"])
def test_meshes_against_formulas(shapes, name):
    scene = SceneFamily(mesh_family(shapes[name].name), shapes[name].parent / "scene.yaml").sample(0)
    points = np.random.default_rng(0).uniform(0, 1, (3000, 3))
    x = (points - [0.5, 0.5, 0.4]) / 0.5
    if name == "ball":
        exact = np.linalg.norm(x, axis=1) - 0.5
    elif name == "cube":
        q = np.abs(x) - 0.5
        exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)
    else:
        exact = np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.4, x[:, 2]) - 0.15
    distance, normal, _ = combine(scene.obstacles, points)
    # Facets lie inside the round shapes by up to edge^2 / 8 r: edges of 0.04 on r = 0.15 and 0.5.
    assert np.abs(distance - 0.5 * exact).max() < (1e-7 if name == "cube" else 2e-3)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(np.ones(3000), abs=1e-9)
    feet = points - distance[:, None] * normal
    assert np.abs(combine(scene.obstacles, feet)[0]).max() < 1e-6
    assert Scene.from_dict(scene.to_dict()) == scene, "the trajectory carries its mesh"


@pytest.mark.parametrize("damage", ["absent", "open", "garbage", "empty"])
def test_meshes_that_cannot_be_used(shapes, damage, tmp_path):
    path = tmp_path / "bad.stl"
    if damage == "open":
        meshio.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], [("triangle", [[0, 1, 2], [0, 1, 3]])]).write(path)
    elif damage != "absent":
        path.write_bytes(b"\x00\x01garbage" if damage == "garbage" else b"")
    with pytest.raises(InputError, match=r"scene.yaml: obstacles\[0\].file = 'bad.stl': cannot be used") as caught:
        SceneFamily(mesh_family("bad.stl"), tmp_path / "scene.yaml")
    assert "\n" not in str(caught.value)


# -- families

BASE = {
    "name": "ramps",
    "dim": 2,
    "bounds": [[0.0, 1.0], [0.0, 1.0]],
    "gravity": [0.0, -9.8],
    "frame_step": 0.01,
    "frames": 12,
    "radius": 0.1,
    "cells": [20, 20],
    "materials": {"water": {"model": "water", "sound_speed": 5.0}},
    "bodies": [{"material": "water", "shape": {"kind": "box", "size": [0.25, 0.25]}}],
    "obstacles": [{"kind": "segment", "count": [1, 3], "length": [0.2, 0.5], "angle": [-45, 45], "thickness": 0.08}],
    "splits": {"train": 6, "valid": 2, "test": 2},
}
FAMILIES = {
    "segment": BASE["obstacles"][0],
    "polygon": {"kind": "polygon", "radius": [0.15, 0.2], "corners": [3, 6]},
    "ball": {"kind": "ball", "radius": [0.05, 0.2], "count": [0, 2]},
    "box": {"kind": "box", "size": [[0.1, 0.3], 0.1], "center": [[0.2, 0.8], 0.1]},
    "halfspace": {"kind": "halfspace", "point": [0.5, 0.1], "normal": [[-0.3, 0.3], 1.0]},
    "floor": {"kind": "floor", "pieces": [3, 6], "height": [0.05, 0.3]},
}


def family(*obstacles, **changes):
    return SceneFamily(copy.deepcopy(BASE) | {"obstacles": list(obstacles)} | changes, "ramps.yaml")


@pytest.mark.parametrize("kind", FAMILIES)
@pytest.mark.parametrize("seed", range(4))
def test_bodies_start_clear_of_obstacles(kind, seed):
    scene = family(FAMILIES[kind]).sample(seed)
    assert Scene.from_dict(scene.to_dict()) == scene == family(FAMILIES[kind]).sample(seed)
    assert family().sample(seed).to_dict().keys() & {"obstacles", "container", "context"} == set(), "what is absent is not written"
    if scene.obstacles:
        assert combine(scene.obstacles, scene.particles(refine=1).position)[0].min() > 0.3 * scene.spacing
        assert scene.obstacles[0].kind == kind
        for obstacle in scene.obstacles:
            extent = obstacle.extent()
            if extent and "center" not in FAMILIES[kind]:
                assert extent[0].min() >= 0 and extent[1].max() <= 1


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        ({"kind": "ball", "center": [0.5, 0.5, 0.5], "radius": 0.1}, r"obstacles\[0\].center = .*: needs 2 entries"),
        ({"kind": "segment", "start": [], "end": [0.5, 0.5], "thickness": 0.1}, r"obstacles\[0\].start = \[\]: needs 2 entries"),
        ({"kind": "floor", "vertices": [[0, 0.1], [1, 0.1, 3]]}, r"obstacles\[0\].vertices = .*: needs 2 entries"),
        ({"kind": "halfspace", "point": [0.5, 0.1], "normal": [0, 0]}, r"obstacles\[0\].normal = .*: has no direction"),
        ({"kind": "mesh", "vertices": [[0, 0, 0]], "faces": [[0, 0, 0]]}, r"obstacles\[0\].kind = 'mesh': meshes are 3D"),
    ],
)
def test_resolved_obstacles_of_another_dimension_are_refused(obstacle, message):
    content = family().sample(0).to_dict()
    with pytest.raises(InputError, match=message):
        Scene.from_dict(content | {"obstacles": [obstacle]})


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], [[0, 1, 2], [0, 1, 4]], "indices of vertices"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], [[0, 1, 2], [0, 1, -1]], "indices of vertices"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], [[0, 1, 2], [0, 1]], "needs 3 entries"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], [[0, 1, 2], [0, 1, 3]], "not a closed surface"),
        ([], [], "indices of vertices|needs 3 entries"),
    ],
)
def test_resolved_meshes_that_are_none_are_refused(shapes, vertices, faces, message):
    content = SceneFamily(mesh_family("cube.obj"), shapes["cube"].with_name("scene.yaml")).sample(0).to_dict()
    with pytest.raises(InputError, match=rf"obstacles\[0\]\..*({message})"):
        Scene.from_dict(content | {"obstacles": [{"kind": "mesh", "vertices": vertices, "faces": faces}]})


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (FAMILIES["segment"] | {"thickness": 0.07}, r"obstacles\[0\].thickness = 0.07: thinner than 1.5 grid cells"),
        (FAMILIES["segment"] | {"colour": 1}, r"obstacles\[0\].colour = 1: unknown key"),
        (FAMILIES["segment"] | {"length": [0.5, 0.2]}, r"obstacles\[0\].length = .*low must not exceed high"),
        (FAMILIES["segment"] | {"count": [3, 1]}, r"obstacles\[0\].count"),
        (FAMILIES["segment"] | {"friction": -1}, r"obstacles\[0\].friction"),
        ({"kind": "segment", "length": 0.3, "thickness": 0.1}, r"obstacles\[0\].angle = None: missing"),
        ({"kind": "ramp"}, r"obstacles\[0\]"),
        ({"kind": "ball", "radius": 0.03}, r"obstacles\[0\].radius = 0.03: thinner than"),
        ({"kind": "ball", "radius": 0.1, "center": [0.5]}, r"obstacles\[0\].center = \[0.5\]: needs 2 entries"),
        ({"kind": "box", "size": [0.05, 0.3]}, r"obstacles\[0\].size\[0\] = 0.05: thinner"),
        ({"kind": "polygon"}, r"obstacles\[0\].vertices = None: give either"),
        ({"kind": "polygon", "vertices": [[0, 0], [0.5, 0.5], [1, 1]]}, r"obstacles\[0\].vertices = .*one line"),
        ({"kind": "halfspace", "point": [0, 0], "normal": [0, [-1, 1]]}, r"obstacles\[0\].normal = .*zero"),
        ({"kind": "floor", "pieces": [5, 2], "height": 0.1}, r"obstacles\[0\].pieces"),
        ({"kind": "mesh", "file": "a.stl"}, r"obstacles\[0\].kind = 'mesh': meshes are 3D"),
    ],
)
def test_mistakes_name_file_key_value_and_remedy(obstacle, message):
    with pytest.raises(InputError, match=f"^ramps.yaml: {message}") as caught:
        family(obstacle)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        ({"kind": "ball", "radius": 0.1, "center": [0.5, 1.2]}, r"obstacles\[0\] = 'seed 7': outside the box"),
        ({"kind": "ball", "radius": 0.6}, r"obstacles\[0\] = 'seed 7': outside the box"),
        ({"kind": "floor", "pieces": [2, 2], "height": 1.5}, r"obstacles\[0\] = 'seed 7': outside the box"),
        ({"kind": "halfspace", "point": [0, -1], "normal": [0, 1]}, r"obstacles\[0\] = 'seed 7': outside the box"),
        ({"kind": "floor", "pieces": [2, 2], "height": 0.85}, r"bodies\[0\] = 'seed 7': overlapping an obstacle"),
    ],
)
def test_impossible_places_stop_with_one_line_and_nothing_written(obstacle, message, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("sim.scene._TRIES", 5)
    with pytest.raises(InputError, match=message):
        family(obstacle).sample(7)
    path = tmp_path / "ramps.yaml"
    path.write_text(yaml.safe_dump(BASE | {"obstacles": [obstacle]}))
    assert main(["generate", str(path), "--out", str(tmp_path / "out"), "--split", "train"]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1 and "ramps.yaml: " in errors
    assert not (tmp_path / "out").exists()


# -- kinematic particles


@pytest.mark.parametrize(("dim", "index"), EVERY)
def test_boundary_particles_cover_the_surface(dim, index):
    one, s = solid(SOLIDS[dim][index]), 1 / (64 if dim == 2 else 32)
    bounds = np.array([[0.0, 1.0]] * dim)
    found = boundary_particles([one], bounds, s)
    assert (found >= 0).all() and (found <= 1).all()
    assert one.distance(found)[0] == pytest.approx(np.full(len(found), -s / 2), abs=2e-3 * s)
    assert cKDTree(found).query(found, 2)[0][:, 1].min() >= 0.9 * s * (1 - 1e-9)
    # Every place of the surface in the box has a particle near it: half a spacing below (a diagonal of that at a
    # corner) and at most the least distance beside, or another particle would have been put there.
    probes = np.random.default_rng(0).uniform(0, 1, (4000, dim))
    distance, normal = one.distance(probes)
    feet = (probes - distance[:, None] * normal)[np.abs(distance) < 4 * s]
    feet = feet[((feet > s) & (feet < 1 - s)).all(1)]
    assert cKDTree(found).query(feet)[0].max() < (0.94 + np.sqrt(dim) / 2) * s
    np.testing.assert_array_equal(found, boundary_particles([one], bounds, s))


def test_number_of_boundary_particles_is_area_over_spacing():
    s = 1 / 64
    ball = boundary_particles([solid(SOLIDS[2][4])], np.array([[0.0, 1.0]] * 2), s)
    assert len(ball) == pytest.approx(2 * np.pi * (0.2 - s / 2) / s, rel=0.06)


# -- in the solver


def scene(obstacles, bodies=None, **changes):
    """A unit box of 16 cells."""
    dim = changes.get("dim", 2)
    bodies = bodies or [{"material": "water", "kind": "box", "lower": [0.25] * (dim - 1) + [0.6], "upper": [0.75] * (dim - 1) + [0.9]}]
    content = {
        "name": "test",
        "dim": dim,
        "bounds": [[0.0, 1.0]] * dim,
        "gravity": [0.0] * (dim - 1) + [-9.8],
        "frame_step": 0.01,
        "frames": 30,
        "radius": 0.1,
        "cells": [16] * dim,
        "materials": {"water": {"model": "water", "sound_speed": 10.0}},
        "seed": 3,
        "jitter": 0.2,
        "bodies": [{"velocity": [0.0] * dim} | body for body in bodies],
        "obstacles": obstacles,
    }
    return Scene.from_dict(content | changes)


def columns(*obstacles, friction=0.25, cells=8):
    """[k, dim, ...] rows of the table on cells of length 1, walls' lines at node 1, as a dictionary node -> rest."""
    solids = [solid(content) for content in obstacles]
    dim = len(solids[0].extent()[0]) if solids[0].extent() else 2
    table = column_table(solids, [friction] * len(solids), np.zeros(dim), 1.0, (cells + 3,) * dim)
    return {tuple(row[:dim].astype(int)): row[dim:].tolist() for row in table}


@pytest.mark.parametrize(("level", "node", "weight"), [(3.0, 4, 1.0), (3.25, 4, 0.75), (3.5, 4, 0.5), (3.75, 5, 1.25)])
def test_columns_over_a_level_floor_by_hand(level, node, weight):
    """The surface lies between nodes 4 and 5, which are at 3 and 4: u = w v0 + (1 - w) v1, node 0 within half a cell of it."""
    found = columns({"kind": "halfspace", "point": [0.0, level], "normal": [0.0, 1.0]})
    behind = {(i, node): [0, 1, min(3, node), 0, 1, 0.25, pytest.approx(weight)] for i in range(11)}
    assert {key: found[key] for key in behind} == behind
    # Those deeper, within reach: none on this side of three behind.
    assert set(found) - set(behind) <= {(i, j) for i in range(11) for j in range(node - 3)}


def test_columns_of_a_slope_take_turns():
    """Under 45 degrees the first of two equal axes; no node twice, and each inside within reach in one column or held."""
    slope = {"kind": "halfspace", "point": [4.25, 4.0], "normal": [1.0, 1.0]}
    table = column_table([solid(slope)], [0.0], np.zeros(2), 1.0, (11, 11)).astype(int)
    taken = [tuple(row[:2] - k * row[2:4]) for row in table for k in range(row[4] + 1)]
    assert len(set(taken)) == len(taken)
    node = np.stack(np.meshgrid(*[np.arange(11)] * 2, indexing="ij"), -1).reshape(-1, 2)
    depth = -combine([solid(slope)], node - 1.0)[0]
    assert set(map(tuple, node[(depth >= 0) & (depth < REACH)])) <= set(taken)
    assert (table[table[:, 4] > 0, 2:4] == [1, 0]).all()


@pytest.mark.parametrize("content", [
    {"kind": "halfspace", "point": [5.0, 2.5], "normal": [1.0, -1.0]},
    {"kind": "floor", "vertices": [[0, 6], [3.6, 5.4], [4, 1.2], [4.4, 5.4], [8, 6]]},
])  # fmt: skip
def test_columns_face_outwards(content):
    """In a notch too, whose nearest surface may be the other side's; and the arithmetic warns of nothing."""
    with np.errstate(all="raise"):
        found = columns(content, cells=12)
    across = [np.dot(row[:2], row[3:5]) for row in found.values() if any(row[:2]) and row[2] >= 0]
    assert len(across) > 6 and min(across) > 0.5


def test_thin_plates_hold_their_nodes():
    found = columns({"kind": "segment", "start": [-5.0, 3.0], "end": [15.0, 3.0], "thickness": 1.6})
    # One line for both faces.
    assert found == {(i, 4): [0, 1, -1, 0, 1, 0.25, 1] for i in range(11)}
    thick = columns({"kind": "segment", "start": [-5.0, 5.0], "end": [15.0, 5.0], "thickness": 3.2}, cells=12)
    # Faces between nodes 4 and 5, 7 and 8: 0.4 cells beyond the outer ones. The node in the middle is out of reach, either's.
    up, down = thick[4, 8], thick[4, 4]
    assert up[:2] == [0, 1] and down[:2] == [0, -1] and up[2] + down[2] == 3
    assert up[3:] == [0, 1, 0.25, pytest.approx(1.4)] and down[3:] == [0, -1, 0.25, pytest.approx(1.4)]
    assert set(thick) == {(i, j) for i in range(15) for j in (4, 8)}


def test_no_column_takes_its_velocity_from_a_wall():
    """A face 0.7 cells from a wall: its column's next node would be the wall's own, so the one at the face is held. Farther off it is not."""
    near = columns({"kind": "halfspace", "point": [7.3, 0.0], "normal": [1.0, 0.0]})
    far = columns({"kind": "halfspace", "point": [6.3, 0.0], "normal": [1.0, 0.0]})
    assert all(near[8, j][:3] == [0, 0, 0] for j in range(11)) and all(far[7, j][:3] == [1, 0, 3] for j in range(11))


PLATE = {"kind": "segment", "start": [-0.2, 0.5], "end": [1.2, 0.4], "thickness": THINNEST / 16}


@pytest.fixture(scope="module")
def wet():
    return MPMSimulator()


@pytest.mark.parametrize("speed", [0.0, -60.0])
def test_nothing_leaks_through_the_thinnest_plate(wet, speed):
    """From wall to wall: poured on it, and shot at it at 20 sqrt(g H)."""
    what = scene([PLATE], [{"material": "water", "kind": "box", "lower": [0.25, 0.6], "upper": [0.75, 0.9], "velocity": [0.0, speed]}])
    wet.load(what)
    moving = len(what.particles().position)
    for _ in range(150):
        last = wet.frame()[:moving].astype(float)
        distance, normal, _ = combine(what.obstacles, last)
        # A straight face is exact between nodes, but for the nodes beyond the plate's middle: 0.04 cells along an axis.
        assert distance.min() > -0.1 * wet.dx
        assert (last[:, 1] > np.interp(last[:, 0], [-0.2, 1.2], [0.5, 0.4])).all()
    assert distance.min() < wet.dx, "it did reach the plate"


def test_a_plate_works_on_both_faces(wet):
    """Without gravity, shot at from below."""
    what = scene(
        [PLATE], [{"material": "water", "kind": "box", "lower": [0.25, 0.05], "upper": [0.75, 0.3], "velocity": [0.0, 20.0]}], gravity=[0.0, 0.0]
    )
    wet.load(what)
    for _ in range(40):
        last = wet.frame()[: len(what.particles().position)]
        assert (last[:, 1] < np.interp(last[:, 0], [-0.2, 1.2], [0.5, 0.4])).all()


@pytest.mark.parametrize("thickness", [1.5, 1.7])
@pytest.mark.parametrize("offset", [0.0, 0.1, -0.1])
@pytest.mark.parametrize("down", [-1.0, 1.0])
def test_a_pool_rests_on_either_face_of_a_plate(wet, down, offset, thickness):
    """However its middle lies beside the one line of nodes in it. Held to one side only, a third of the pool lay in the other face."""
    middle = 0.5 + offset / 16
    plate = {"kind": "segment", "start": [-0.2, middle], "end": [1.2, middle], "thickness": thickness / 16}
    far = middle - down * (thickness / 32 + 0.25)
    near = middle - down * thickness / 32
    what = scene(
        [plate],
        [{"material": "water", "kind": "box", "lower": [0.0, min(near, far)], "upper": [1.0, max(near, far)]}],
        gravity=[0.0, 9.8 * down],
        jitter=0.0,
    )
    wet.load(what)
    for _ in range(100):
        last = wet.frame()[: len(what.particles().position)].astype(float)
    height = (middle - last[:, 1]) * down * 16 - thickness / 2
    # Eight layers half a cell apart.
    assert (height < 0.3).sum() <= len(height) / 8 and np.median(height) == pytest.approx(2, abs=0.3)


def test_particles_stay_out_of_curved_and_notched_solids(wet):
    """Between nodes the distance is interpolated: off by dx^2 / 8 r on curves, more at the end of a plate, whose r is 3/4 dx."""
    what = scene(
        [
            {"kind": "floor", "vertices": [[0, 0.3], [0.3, 0.1], [0.6, 0.35], [1, 0.15]]},
            {"kind": "ball", "center": [0.5, 0.5], "radius": 0.1},
            {"kind": "segment", "start": [0.1, 0.55], "end": [0.3, 0.5], "thickness": 0.1},
        ]
    )
    wet.load(what)
    for _ in range(150):
        last = wet.frame()[: len(what.particles().position)].astype(float)
        assert combine(what.obstacles, last)[0].min() > -0.25 * wet.dx


@pytest.mark.parametrize("angle", [0.0, 20.0])
def test_a_frozen_shower_slides_as_friction_says(wet, angle):
    """Lone particles on a slope: a = g (sin t - mu cos t), mu = 0 and sticky exactly. One particle a body, apart: no pressure."""
    t = np.radians(angle)
    along, up = np.array([np.cos(t), -np.sin(t)]), np.array([np.sin(t), np.cos(t)])
    foot = np.array([0.2, 0.5])
    drops = [foot + along * s + 0.002 * up for s in (0.0, 0.15)]
    bodies = [{"material": "water", "kind": "box", "lower": (x - 0.005).tolist(), "upper": (x + 0.005).tolist()} for x in drops]
    plane = {"kind": "halfspace", "point": foot.tolist(), "normal": up.tolist()}
    for friction, expected in ((0.0, 9.8 * np.sin(t)), ("sticky", 0.0)):
        what = scene([plane | {"friction": friction}], bodies, jitter=0.0)
        wet.load(what)
        start = what.particles().position
        for _ in range(20):
            last = wet.frame()[:2].astype(float)
        assert (last - start) @ along == pytest.approx(np.full(2, expected * 0.2**2 / 2), rel=0.1, abs=2e-3)


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("fall", [0.0, 0.18, 0.36])
def test_a_pool_rests_on_a_slope_with_its_own_pressure(wet, fall, friction):
    """rho g (H - y) of the particles within a cell of the surface, in the mean over them and 200 frames. Held nodes gave 1.04 to 1.34 of it."""
    vertices, top, c = [[0.0, 0.25 + fall / 2], [1.0, 0.25 - fall / 2]], 0.75, 30.0
    what = scene(
        [{"kind": "floor", "vertices": vertices, "friction": friction}],
        cells=[24, 24],
        frame_step=0.005,
        jitter=0.0,
        materials={"water": {"model": "water", "sound_speed": c}},
        bodies=[{"material": "water", "kind": "polygon", "vertices": [*vertices, [1.0, top], [0.0, top]]}],
    )
    wet.load(what)
    seen = []
    for frame in range(300):
        wet.frame()
        if frame >= 100:
            state = wet.state()
            seen.append([1000 * c**2 / 7 * (state["water.J"] ** -7 - 1), state["position"][:, 1], combine(what.obstacles, state["position"])[0]])
    pressure, height, distance = np.mean(seen, 0)
    near = distance < wet.dx
    level = np.sort(height)[-12:].mean() + what.spacing / 2
    assert pressure[near].sum() == pytest.approx((1000 * 9.8 * (level - height[near])).sum(), rel=0.05)


def test_trajectories_hold_kinematic_particles_last_and_still(wet):
    what = scene([PLATE], frames=4)
    trajectory = simulate(wet, what)
    assert trajectory.ok
    count = len(what.boundary)
    assert (trajectory.particle_type[-count:] == KINEMATIC_TYPE).all() and trajectory.moving.sum() == len(trajectory.particle_type) - count
    assert (trajectory.position[:, -count:] == what.boundary.astype(np.float32)).all()
    np.testing.assert_array_equal(trajectory.position[0], what.start().astype(np.float32))
    promised = wet.plan(what)
    assert promised["recorded"] == trajectory.position.shape[1] and promised["kinematic"] == count


def test_a_grid_too_coarse_for_a_plate_is_refused():
    with pytest.raises(InputError, match=r"obstacles\[0\].thickness = 0.09375: thinner than 1.5 grid cells of 0.125"):
        MPMSimulator(particles="recorded", coarsen=2.0).load(scene([PLATE]))


def test_what_has_no_obstacle_builds_none(wet):
    bare, full = MPMSimulator().plan(scene([])), MPMSimulator().plan(scene([PLATE]))
    assert "signed distance" in bare["left_out"] and "signed distance" not in bare["fields"] and "load_solids" not in bare["kernels"]
    assert full["fields"]["signed distance"] == (16, 19 * 19) and "signed distance" not in full["left_out"]
    assert "obstacle friction" in full["left_out"]
    assert "obstacle friction" not in MPMSimulator().plan(scene([PLATE | {"friction": "sticky"}]))["left_out"]
    simulator = MPMSimulator()
    simulator.load(scene([]))
    assert not hasattr(simulator._kernels, "solids")


def test_many_particles_and_many_columns_do_not_compile_in_turns():
    """The first outgrows the second's fields in columns, the second the first's in particles."""
    floor = {"kind": "floor", "vertices": [[0.0, 0.1], [1.0, 0.3]]}
    few = scene([floor], [{"material": "water", "kind": "box", "lower": [0.4, 0.6], "upper": [0.6, 0.8]}])
    many = scene(
        [{"kind": "ball", "center": [0.5, 0.2], "radius": 0.05}],
        [{"material": "water", "kind": "box", "lower": [0.0, 0.5], "upper": [1.0, 1.0]}],
        particles_per_cell=3,
    )
    simulator, rooms = MPMSimulator(), []
    for what in (few, many, few, many):
        simulator.load(what)
        rooms.append((simulator._kernels.capacity, simulator._kernels.columns_at_most))
    assert rooms[0][0] < rooms[1][0] and rooms[0][1] == rooms[1][1] and rooms[1:] == rooms[1:2] * 3
    assert simulator.plan(many)["fields"]["obstacle foot"][1] < rooms[0][1], "alone it needs fewer columns"


def test_parallel_kernels_agree_with_serial_ones(wet):
    what = scene([PLATE | {"friction": 0.3}, {"kind": "ball", "center": [0.4, 0.2], "radius": 0.1}], cells=[16, 16])
    serial, parallel = MPMSimulator(), MPMSimulator(serial=False)
    serial.load(what)
    parallel.load(what)
    for _ in range(12):
        one, other = serial.frame(), parallel.frame()
    # Rounding apart, as without obstacles.
    assert np.abs(one - other).max() < 100 * np.finfo(np.float32).eps
    serial.load(what)
    again = [serial.frame() for _ in range(12)][-1]
    assert (again == one).all(), "the same bits"


def test_3d_pool_on_a_slope_with_a_mesh(shapes):
    """A ball from a file and a half-space: water poured over them stays outside both."""
    content = mesh_family(shapes["ball"].name)
    content["obstacles"].append({"kind": "halfspace", "point": [0.5, 0.5, 0.15], "normal": [0.3, 0.0, 1.0]})
    what = SceneFamily(content, Path(shapes["ball"].parent) / "scene.yaml").sample(1)
    simulator = MPMSimulator()
    simulator.load(what)
    for _ in range(60):
        last = simulator.frame()[: len(what.particles(refine=1).position)].astype(float)
    distance = combine(what.obstacles, last)[0]
    assert distance.min() > -0.15 * simulator.dx
    assert (distance < simulator.dx).mean() > 0.3, "it lies on them"
