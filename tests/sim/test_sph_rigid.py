"""Rigid bodies in SPH: flight, momenta, shape, contacts, what water does to them and they to it; both methods, two and three dimensions."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from taichi.lang.impl import get_runtime

from sim.errors import InputError
from sim.scene import Scene
from sim.sph.solver import SPHSimulator
from sim.validation.float_and_sink import HEIGHT, WIDTH, float_and_sink, pool_scene

EPS = float(np.finfo(np.float32).eps)
WATER, WOOD = {"model": "water", "sound_speed": 20.0}, {"model": "rigid", "density": 600.0}
METHODS = ("wcsph", "dfsph")
#: Without particle shifting and XSPH, which keep no angular momentum, and a diffusion of density towards that of water at rest.
STILL = {"wcsph": {"shifting": False, "density_diffusion": 0.0}, "dfsph": {"xsph": 0.0}}


@pytest.fixture(scope="module")
def solvers():
    """One solver a method and dimension: scenes share its kernels."""
    return {(method, dim): SPHSimulator() for method in METHODS for dim in (2, 3)}


def box(lower, upper, velocity=None):
    return {"kind": "box", "lower": lower, "upper": upper} | ({"velocity": velocity} if velocity else {})


def scene(method, bodies, wood=WOOD, water=WATER, solver=(), **changes):
    """A unit box of 16 cells; a body is (material, kind and geometry)."""
    dim = changes.get("dim", 2)
    content = {
        "name": "test",
        "dim": dim,
        "bounds": [[0.0, 1.0]] * dim,
        "gravity": [0.0] * (dim - 1) + [-9.8],
        "frame_step": 0.005,
        "frames": 200,
        "radius": 0.1,
        "cells": [16] * dim,
        "materials": {"wood": wood, "water": water},
        "seed": 3,
        "bodies": [{"material": name, "velocity": [0.0] * dim} | geometry for name, geometry in bodies],
        "solver": {"method": method} | dict(solver),
    }
    return Scene.from_dict(content | changes)


def motion(solver):
    """Of the first body: centre [length, from the lower corner], velocity, spin, mass over that of a particle of water, inertia [length^2] of it."""
    rigid, h = solver._kernels.rigid, solver._support
    mass = float(rigid.mass.to_numpy()[0]) * int(np.ptp(rigid.span.to_numpy()[0]))
    return (
        rigid.centre.to_numpy()[0] * h,
        rigid.velocity.to_numpy()[0] * h,
        rigid.spin.to_numpy()[0],
        mass,
        np.linalg.inv(rigid.inverse.to_numpy()[0].astype(float)) * h**2,
    )


def momenta(solver, water):
    """Linear and angular momentum [3] about the lower corner over the mass of a particle of water, sum |m v|. ``water`` [n] of bool."""
    state, dim = solver.state(), solver._kernels.dim
    x, v = (np.pad(state[key][water], ((0, 0), (0, 3 - dim))) for key in ("position", "velocity"))
    centre, velocity, spin, mass, inertia = motion(solver)
    turning = np.cross(x, v).sum(0) + mass * np.cross(centre, velocity) + inertia @ spin
    return v.sum(0) + mass * velocity, turning, np.abs(v).sum() + mass * np.abs(velocity).sum()


def energy(solver):
    found = solver.diagnostics()
    return found["kinetic_energy"] + found["potential_energy"]


@pytest.mark.parametrize("method", METHODS)
def test_a_body_and_the_water_on_it_fall_freely(solvers, method):
    """Touching: neither presses on the other. x0 + v0 t + g t^2 / 2 (WCSPH, velocity Verlet), g t (t + dt) / 2 (DFSPH, symplectic Euler)."""
    what = scene(
        method,
        [("wood", box([0.375, 0.5], [0.625, 0.625], [0.2, 0.3])), ("water", box([0.375, 0.625], [0.625, 0.75], [0.2, 0.3]))],
        solver=STILL[method],
    )
    solver = solvers[method, 2]
    solver.load(what)
    start, steps = what.particles().position, 0
    for _ in range(40):
        last = solver.frame()
        steps += solver.diagnostics()["substeps"]
    t = 0.2
    lag = t / steps if method == "dfsph" else 0.0
    shift = np.array([0.2 * t, 0.3 * t - 9.8 * t * (t + lag) / 2])
    # Steps of DFSPH are not all as long: the mean of their lags, weighed by time, is within a tenth of it.
    # Water's velocities, of up to 2 m/s, are rounded to half an eps of that in each of 360 steps.
    assert np.abs(last - start - shift).max() < 20 * EPS * 16 / 2 + 0.1 * 9.8 * t * lag / 2
    assert np.abs(pdist(last.astype(float)) - pdist(start)).max() < 360 * EPS / 2 * t * 2


@pytest.mark.parametrize("viscosity", [0.0, 20.0])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_momenta_of_a_body_struck_by_water(solvers, method, dim, viscosity):
    """In free space, off centre: what water loses the body gains; its shape stays."""
    low, high, cells = [0.375] * (dim - 1), [0.625] * (dim - 1), {"cells": [16 if dim == 2 else 12] * dim}
    struck = box([0.5, *[0.3125] * (dim - 1)], [0.625, *[0.5] * (dim - 1)])
    what = scene(method, [("water", box([0.25, *low], [0.5, *high], [1.0] + [0.2] * (dim - 1))), ("wood", struck)], dim=dim, gravity=[0.0] * dim,
                 water=WATER | {"viscosity": viscosity}, solver=STILL[method], **cells)  # fmt: skip
    solver = solvers[method, dim] if not viscosity else SPHSimulator()
    solver.load(what)
    water = what.particles().material == 1
    before = momenta(solver, water)
    for _ in range(12):
        last = solver.frame()
    after, (_, velocity, spin, _, _) = momenta(solver, water), motion(solver)
    assert velocity[0] > 0.1 and np.abs(spin).max() > 0.1, "it was hit, and turns"
    assert np.abs(after[0] - before[0]).max() < 1e-6 * before[2]
    # DFSPH corrects places without the velocities that go with them: to first order in what it corrects.
    assert np.abs(after[1] - before[1]).max() < (2e-6 if method == "wcsph" else 1e-3) * before[2]
    start = what.particles().position
    assert np.abs(pdist(last[~water].astype(float)) - pdist(start[~water])).max() < 1e-5 * 0.1


@pytest.mark.parametrize("density", [1.0, 1e6])
@pytest.mark.parametrize("method", METHODS)
def test_densities_1000_to_1(solvers, method, density):
    """Water at 2 m/s strikes a body a thousand times lighter or heavier: finite, momentum to rounding, no energy gained, no water in it."""
    what = scene(
        method,
        [("water", box([0.125, 0.375], [0.4375, 0.625], [2.0, 0.0])), ("wood", box([0.5, 0.4375], [0.625, 0.5625]))],
        wood=WOOD | {"density": density},
        gravity=[0.0, 0.0],
    )
    solver = solvers[method, 2]
    solver.load(what)
    water = what.particles().material == 1
    before, levels = momenta(solver, water), [solver.diagnostics()["kinetic_energy"]]
    for _ in range(16):
        last = solver.frame().astype(float)
        levels.append(solver.diagnostics()["kinetic_energy"])
        assert inside(solver, last[water]) < 1e-4
    after, (_, velocity, *_) = momenta(solver, water), motion(solver)
    assert velocity[0] > (1.5 if density == 1.0 else 0.0), "what is light goes at least with the water"
    assert np.abs(after[0] - before[0]).max() < 1e-6 * max(before[2], after[2])
    # A weakly compressible fluid stores some in its compression and gives it back.
    assert max(levels) <= levels[0] * (1 + 1e-4)


def inside(solver, water):
    """How deep water is in the first body, a box of half edges 0.125 x 0.0625 or smaller, in spacings."""
    rigid, h, lower = solver._kernels.rigid, solver._support, solver._lower
    w, x, y, z = rigid.turn.to_numpy()[0].astype(float)
    assert x == 0 and y == 0, "a 2D body turns about z"
    R = np.array([[1 - 2 * z * z, -2 * w * z], [2 * w * z, 1 - 2 * z * z]])
    places = (water - lower - rigid.centre.to_numpy()[0, :2] * h) @ R / h
    planes = rigid.planes.to_numpy()[0, : rigid.faces.to_numpy()[0]].astype(float)
    return -(places @ planes[:, :2].T - planes[:, 3]).max(1).min() * solver._scene.solver.support


@pytest.mark.parametrize("method", METHODS)
def test_a_body_rests_on_the_floor_and_a_stone_on_another(solvers, method):
    """Out of the water's reach: contacts are those of MPM. They fall, do not bounce, and lie on their faces."""
    what = scene(
        method,
        [
            ("water", box([0.0, 0.0], [0.0625, 0.0625])),
            ("wood", box([0.625, 0.0625], [0.875, 0.1875])),
            ("wood", box([0.6875, 0.25], [0.8125, 0.375])),
        ],
    )
    solver = solvers[method, 2]
    solver.load(what)
    for _ in range(80):
        last = solver.frame().astype(float)
    body = what.particles().body
    assert last[body == 1][:, 1].min() == pytest.approx(what.spacing / 2, abs=1e-5)
    assert last[body == 2][:, 1].min() == pytest.approx(0.125 + what.spacing / 2, abs=1e-3)
    rigid = solver._kernels.rigid
    assert np.abs(rigid.velocity.to_numpy()[:2]).max() * solver._support < 2e-3


def test_a_plate_drags_viscous_water_along():
    """Couette: a heavy plate across a periodic box slides over a layer of water on sticky walls; u = U y / H at 1.5 H^2 / nu. By DFSPH: WCSPH, with a
    wall in the plate's place too, gains a fifth of its density in so viscous a shear."""
    layer, speed, nu = 0.25, 0.5, 0.2
    what = scene(
        "dfsph",
        [("water", box([0.0, 0.0], [0.5, layer])), ("wood", box([0.0, layer], [0.5, 0.375], [speed, 0.0]))],
        wood=WOOD | {"density": 1e6},
        water=WATER | {"viscosity": 1000.0 * nu},
        gravity=[0.0, 0.0],
        bounds=[[0.0, 0.5], [0.0, 0.5]],
        periodic=["x"],
        walls={"friction": "sticky"},
        frame_step=0.01,
        solver={"iterations": 1000},
    )
    solver = SPHSimulator()
    solver.load(what)
    for _ in range(round(1.5 * layer**2 / nu / what.frame_step)):
        solver.frame()
    state, water = solver.state(), what.particles().material == 1
    y, u = state["position"][water, 1], state["velocity"][water, 0]
    assert np.abs(u / speed - y / layer).max() < 0.03


@pytest.mark.parametrize("method", METHODS)
def test_runs_are_bitwise_equal_and_frames_restored_whole(solvers, method):
    what = scene(method, [("water", box([0.0, 0.0], [1.0, 0.25])), ("wood", box([0.375, 0.25], [0.625, 0.375]))])
    solver, runs = solvers[method, 2], []
    for _ in range(2):
        solver.load(what)
        runs.append([solver.frame() for _ in range(12)])
    assert all((one == other).all() for one, other in zip(*runs, strict=True))
    rigid, k = solver._kernels.rigid, solver._kernels
    kept = [field.to_numpy() for field in rigid.state] + [solver.state()["position"]]
    frames = []
    for _ in range(2):
        solver._run(what.frame_step, what.frame_step, 0.0, keep=True)
        k.restore(solver._wet)
        assert all((field.to_numpy() == before).all() for field, before in zip(rigid.state, kept[:-1], strict=True))
        assert (solver.state()["position"] == kept[-1]).all()
        solver._run(what.frame_step, what.frame_step, 0.0, keep=True)
        frames.append(solver._position.copy())
        k.restore(solver._wet)
    assert (frames[0] == frames[1]).all()


@pytest.mark.parametrize("method", METHODS)
def test_rigid_bodies_are_built_only_where_they_are(built, method):
    from sim.sph import solver as module

    wet = SPHSimulator()
    without = wet.plan(scene(method, [("water", box([0.0, 0.0], [1.0, 0.25]))]))
    assert "rigid bodies" in without["left_out"] and not any("rigid" in name or "contact" in name for name in without["fields"])
    for viscosity in (0.0, 1.0):
        what = scene(
            method, [("water", box([0.0, 0.0], [1.0, 0.25])), ("wood", box([0.375, 0.25], [0.625, 0.375]))], water=WATER | {"viscosity": viscosity}
        )
        rigid = {name: entry for name, entry in wet.plan(what)["fields"].items() if "rigid" in name or "contact" in name}
        structure, particles = wet._structure(what), len(what.particles().position)
        sizes = wet._sizes(what, structure, particles, particles - wet._water_first(what, what.particles())[1])
        # Taichi puts what no kernel has used yet into one tree of fields, and a tree holds 1024.
        get_runtime().materialize()
        module._Kernels(module.replace(structure, rigid=None), *sizes)
        apart = sorted(built["fields"])
        built["fields"].clear()
        get_runtime().materialize()
        module._Kernels(structure, *sizes)
        more = sorted(built["fields"])
        for entry in apart:
            more.remove(entry)
        assert sorted(entry for entry in more if entry[1] > 2) == sorted(map(tuple, rigid.values()))
        built["fields"].clear()
    get_runtime().materialize()


@pytest.mark.physics
@pytest.mark.parametrize("ratio", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("method", METHODS)
def test_a_box_floats_at_its_draft(solvers, method, ratio):
    """Ladder case 16: draft / height = rho_b / rho_w to 5 per cent; begun on the nearest layer of particles. DFSPH on the ladder's finest grid: on
    32 cells its lightest box is 5.4 per cent off."""
    cells = {"wcsph": 32, "dfsph": 64}[method]
    found = float_and_sink(ratio, round((0.5 - ratio * HEIGHT) * 2 * cells) / (2 * cells), cells=cells, method=method, simulator=solvers[method, 2])
    assert found["error"] <= 0.05, found


@pytest.mark.physics
@pytest.mark.parametrize("method", METHODS)
def test_a_neutral_box_stays(solvers, method):
    """As dense as the water around it, for a second: less than an eighth of its height."""
    density = (1 + 7 * 9.8 * 0.25 / 15**2) ** (1 / 7) if method == "wcsph" else 1.0
    found = float_and_sink(density, 0.1875, cells=32, seconds=1.0, method=method, simulator=solvers[method, 2])
    assert found["drift"] < HEIGHT / 8, found


@pytest.mark.physics
@pytest.mark.parametrize("method", METHODS)
def test_a_dense_box_sinks_to_the_floor(solvers, method):
    """Twice as dense: it lies on the floor, or on one layer of particles."""
    found = float_and_sink(2.0, 0.1875, cells=32, seconds=2.0, method=method, simulator=solvers[method, 2])
    assert -1e-5 <= found["sunk"] < 1.5 / 64, found


@pytest.mark.physics
@pytest.mark.parametrize(("method", "ratio", "rises"), [
    pytest.param("wcsph", 0.1, True, marks=pytest.mark.xfail(reason="stays on its film, which is of few particles", strict=True)),
    ("wcsph", 1.5, False), ("dfsph", 0.3, True), ("dfsph", 0.5, True), ("dfsph", 1.5, False)])  # fmt: skip
def test_a_box_on_the_floor_rises_if_it_is_light(solvers, method, ratio, rises):
    """Begun on the floor, without water below: in three seconds a light one is at the surface, a dense one still there, all of it in shape."""
    what = pool_scene(ratio, 0.0, 32, method=method)
    solver = solvers[method, 2]
    solver.load(what)
    wood = what.particles().material == 1
    for _ in range(round(3 / what.frame_step)):
        last = solver.frame().astype(float)
        assert inside(solver, last[~wood]) < 0.2
    face = last[wood][:, 1].mean() - HEIGHT / 2
    assert face > 0.3 if rises else abs(face) < 1.5 * what.spacing
    assert np.abs(pdist(last[wood]) - pdist(what.particles().position[wood])).max() < 1e-5 * WIDTH


def wet_around(lower, upper, low, high):
    """Rectangles of water that fill [low, high] but for a body in [lower, upper]."""
    rooms = [(low, [lower[0], high[1]]), ([upper[0], low[1]], high), ([lower[0], low[1]], [upper[0], lower[1]]),
             ([lower[0], upper[1]], [upper[0], high[1]])]  # fmt: skip
    return [("water", box(a, b)) for a, b in rooms if a[0] < b[0] and a[1] < b[1]]


FLOOR = {"kind": "halfspace", "point": [0.5, 0.25], "normal": [0.0, 1.0]}


@pytest.mark.physics
@pytest.mark.parametrize("method", METHODS)
def test_boxes_over_an_obstacle(method):
    """Its plane surface is a floor like that of the box: half as dense as water a box stays at its draft, to half a spacing; twice as dense it
    comes to lie there, or on one layer of water."""
    solver = SPHSimulator()
    for density, lower in ((500.0, 0.5625), (2000.0, 0.5)):
        corners = [0.375, lower], [0.625, lower + 0.125]
        bodies = [*wet_around(*corners, [0.0, 0.25], [1.0, 0.625]), ("wood", box(*corners))]
        what = scene(method, bodies, WOOD | {"density": density}, obstacles=[FLOOR])
        solver.load(what)
        wood = what.particles().material == 0
        heights = [solver.frame()[: len(wood)][wood, 1].astype(float) for _ in range(200)]
        lowest = min(each.min() for each in heights) - 0.25
        assert lowest > 0.49 * what.spacing, "not in the obstacle"
        if density < 1000:
            assert abs(np.mean([each.mean() for each in heights[-50:]]) - lower - 0.0625) < what.spacing / 2
        else:
            assert heights[-1].min() - 0.25 < 1.6 * what.spacing


@pytest.mark.physics
@pytest.mark.parametrize("method", METHODS)
def test_a_box_adrift_in_a_periodic_pool(method):
    """Across the seam, at half a metre a second: it slows down, keeps its draft to a spacing, and by DFSPH momentum along the pool is kept to
    rounding. WCSPH's floor is not without friction: along it a particle's own forces are scaled up."""
    corners = [0.6875, 0.4375], [0.9375, 0.5625]
    bodies = [*wet_around(*corners, [0.0, 0.0], [1.0, 0.5]), ("wood", box(*corners, [0.5, 0.0]))]
    what = scene(method, bodies, WOOD | {"density": 500.0}, periodic=["x"], solver=STILL[method])
    solver = SPHSimulator()
    solver.load(what)
    mass = np.where(what.particles().material == 0, 0.5, 1.0)
    before, wood, heights = mass @ solver.state()["velocity"][:, 0], what.particles().material == 0, []
    for _ in range(200):
        heights.append(solver.frame()[wood, 1].astype(float).mean())
    velocity = solver.state()["velocity"][:, 0]
    assert before == pytest.approx(0.5 * mass[wood].sum())
    assert method == "wcsph" or abs(mass @ velocity - before) < 2e-5 * (mass @ np.abs(velocity))
    assert abs(velocity[wood].mean()) < 0.4
    assert abs(np.mean(heights[-100:]) - 0.5) < what.spacing


@pytest.mark.physics
def test_boxes_in_a_full_box():
    """By WCSPH: no free surface. A light box rises to the lid, a heavy one sinks; one as dense as water, which displaces its own weight, stays
    where it is in the box, though this is shaken at 1 g."""
    corners, solver = ([0.375, 0.375], [0.625, 0.5]), SPHSimulator()
    shake = {"container": {"sines": [{"amplitude": [9.8, 0.0], "frequency": 2.0, "phase": 0.0}]}}
    for density, shaken in ((300.0, {}), (2000.0, {}), (1000.0, shake)):
        what = scene("wcsph", [*wet_around(*corners, [0.0, 0.0], [1.0, 1.0]), ("wood", box(*corners))], WOOD | {"density": density},
                     WATER | {"sound_speed": 60.0}, frames=201, **shaken)  # fmt: skip
        solver.load(what)
        wood = what.particles().material == 0
        start, way = what.particles().position[wood].mean(0), []
        for _ in range(200):
            way.append(solver.frame()[wood].mean(0) - start)
        if shaken:
            assert np.abs(way).max() < 0.25 * 0.125
        else:
            assert way[-1][1] > 0.3 if density < 1000 else way[-1][1] < -0.3


def test_dfsph_refuses_bodies_in_a_full_box():
    corners = [0.375, 0.375], [0.625, 0.5]
    what = scene("dfsph", [*wet_around(*corners, [0.0, 0.0], [1.0, 1.0]), ("wood", box(*corners))])
    with pytest.raises(InputError, match=r"^test: bodies = 5: with the water they fill the box: [^\n]*; leave room or use wcsph$"):
        SPHSimulator().plan(what)


@pytest.mark.physics
@pytest.mark.parametrize("method", METHODS)
def test_a_box_in_a_shaken_pool_feels_gravity_that_leans(solvers, method):
    """A sine that stands at its crest: the same as gravity to the other side, bodies included, to rounding."""
    corners = [0.375, 0.4375], [0.625, 0.5625]
    bodies = [*wet_around(*corners, [0.0, 0.0], [1.0, 0.5]), ("wood", box(*corners))]
    solver, ways = solvers[method, 2], []
    for changes in ({"container": {"sines": [{"amplitude": [-3.0, 0.0], "frequency": 1e-6, "phase": 90.0}]}}, {"gravity": [3.0, -9.8]}):
        solver.load(scene(method, bodies, **changes))
        ways.append([solver.frame() for _ in range(20)])
    np.testing.assert_allclose(*ways, atol=1e-4)
    assert (ways[0][-1] - ways[0][0])[:, 0].mean() > 0.005
