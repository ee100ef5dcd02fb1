"""The parts of the MPM solver, each against a formula or NumPy in float64: decomposition, materials, walls, transfers, step control.

Tolerances are counted in eps = 1.2e-7, the spacing of float32 at 1, unless a comment says otherwise.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

sys.path.insert(0, str(Path(__file__).parent))

from experiments import Experiments  # noqa: E402

from sim.errors import InputError
from sim.generate import simulate  # noqa: E402
from sim.mpm import solver as solver_module  # noqa: E402
from sim.mpm.decomposition import assemble2, assemble3, decompose2, decompose3, expm1, log1p  # noqa: E402
from sim.mpm.materials.sand import SandModel  # noqa: E402
from sim.mpm.materials.water import WaterModel  # noqa: E402
from sim.mpm.solver import COURANT_GROWTH, MAX_HALVINGS, WALL, MPMSimulator  # noqa: E402
from sim.mpm.walls import wall  # noqa: E402
from sim.scene import Sand, Scene, Water  # noqa: E402
from sim.simulator import SimulationError  # noqa: E402
from sim.taichi_runtime import start_taichi, ti  # noqa: E402

EPS = float(np.finfo(np.float32).eps)
array1, array2, array3 = ti.types.ndarray(ti.f32, 1), ti.types.ndarray(ti.f32, 2), ti.types.ndarray(ti.f32, 3)

WATER = {"model": "water", "sound_speed": 10.0}
SAND = {"model": "sand", "young_modulus": 1e5, "friction_angle": 35.0}


@pytest.fixture(scope="module", autouse=True)
def taichi():
    start_taichi()


def scene(bodies, materials=None, **changes):
    """A resolved scene: unit box of 16 cells an axis; a body is (material, lower, upper[, velocity])."""
    dim = len(bodies[0][1])
    bodies = [
        {"material": name, "kind": "box", "lower": lower, "upper": upper, "velocity": (*velocity, [0.0] * dim)[0]}
        for name, lower, upper, *velocity in bodies
    ]
    content = {
        "name": "test",
        "dim": dim,
        "bounds": [[0.0, 1.0]] * dim,
        "gravity": [0.0] * (dim - 1) + [-9.8],
        "frame_step": 0.01,
        "frames": 30,
        "radius": 0.1,
        "cells": [16] * dim,
        "materials": materials or {"water": WATER},
        "seed": 3,
        "jitter": 0.2,
        "bodies": bodies,
    }
    return Scene.from_dict(content | changes)


DROP = scene([("water", [0.25, 0.125], [0.625, 0.5], [0.5, -1.0])])
SMALL = scene([("water", [0.5, 0.25], [0.75, 0.5])])
SANDPILE = scene([("sand", [0.25, 0.0], [0.5, 0.5], [1.0, 0.0])], {"sand": SAND}, walls={"friction": 0.4})


@pytest.fixture(scope="module")
def cube():
    """Water and sand in 3D."""
    return MPMSimulator()


def run(solver, what, frames):
    solver.load(what)
    return np.array([solver.frame() for _ in range(frames)])


# -- decomposition


def symmetric(dim, rng):
    """[n, dim, dim] float32-exact symmetric matrices: random at many scales, nearly and exactly repeated values, diagonal, zero, all off-diagonal."""
    random = rng.normal(size=(3000, dim, dim)) * 10.0 ** rng.uniform(-7, 1, (3000, 1, 1))
    Q = np.linalg.qr(rng.normal(size=(3000, dim, dim)))[0]
    values = rng.normal(size=(3000, 1)) + rng.choice([0, 1e-7, 1e-5, 1e-3], (3000, dim))  # repeated to rounding, nearly, hardly
    close = np.einsum("nij,nj,nkj->nik", Q, values, Q)
    diagonal = np.eye(dim) * rng.normal(size=(300, 1, dim)) * 10.0 ** rng.uniform(-7, 0, (300, 1, dim))
    off = rng.normal(size=(300, dim, dim)) * (1 - np.eye(dim)) * 100 + np.eye(dim) * 1e-3
    special = np.concatenate([np.zeros((1, dim, dim)), np.eye(dim)[None], -3 * np.eye(dim)[None], np.ones((1, dim, dim))])
    A = np.concatenate([random, close, diagonal, off, special])
    return ((A + A.transpose(0, 2, 1)) / 2).astype(np.float32)


PACKED = {2: ([0, 1, 0], [0, 1, 1]), 3: ([0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1])}


@ti.kernel
def spectral2(s: array2, values: array2, frames: array2, back: array2):
    for n in range(s.shape[0]):
        e, frame = decompose2(ti.Vector([s[n, 0], s[n, 1], s[n, 2]]))
        again = assemble2(e, frame)
        for k in ti.static(range(3)):
            back[n, k] = again[k]
        for k in ti.static(range(2)):
            values[n, k], frames[n, k] = e[k], frame[k]


@ti.kernel
def spectral3(s: array2, values: array2, frames: array3, back: array2):
    for n in range(s.shape[0]):
        e, Q = decompose3(ti.Vector([s[n, k] for k in ti.static(range(6))]))
        again = assemble3(e, Q)
        for k in ti.static(range(6)):
            back[n, k] = again[k]
        for i in ti.static(range(3)):
            values[n, i] = e[i]
            for j in ti.static(range(3)):
                frames[n, i, j] = Q[i, j]


@pytest.mark.parametrize("dim", [2, 3])
def test_spectral_decomposition_against_eigh(dim):
    A = symmetric(dim, np.random.default_rng(dim))
    rows, columns = PACKED[dim]
    s = np.ascontiguousarray(A[:, rows, columns])
    values, back = np.zeros((len(A), dim), np.float32), np.zeros_like(s)
    frames = np.zeros((len(A), 2) if dim == 2 else (len(A), 3, 3), np.float32)
    (spectral2 if dim == 2 else spectral3)(s, values, frames, back)
    exact = np.linalg.eigvalsh(A.astype(float))
    size = np.abs(exact).max(1, keepdims=True) + 1e-37
    # Jacobi is backward stable (Golub & Van Loan 2013, sec. 8.5): a few eps of the norm, 12 rotations of ~1 eps each in 3D.
    assert (np.abs(np.sort(values, 1) - exact) <= (4 if dim == 2 else 12) * EPS * size).all()
    assert (np.abs(back - s) <= (4 if dim == 2 else 20) * EPS * size).all()
    if dim == 2:
        assert np.abs((frames.astype(float) ** 2).sum(1) - 1).max() < 6 * EPS, "(cos 2t, sin 2t) is a unit vector"
    else:
        assert np.abs(np.einsum("nki,nkj->nij", frames.astype(float), frames) - np.eye(3)).max() < 12 * EPS


@ti.kernel
def functions(y: array1, log: array1, exp: array1):
    for n in range(y.shape[0]):
        log[n], exp[n] = log1p(y[n]), expm1(y[n])


def test_log1p_and_expm1_keep_the_digits_of_small_arguments():
    rng = np.random.default_rng(0)
    tiny = 10.0 ** rng.uniform(-30, 0, 20000) * rng.choice([-0.99, 1.0], 20000)
    y = np.concatenate([tiny, rng.uniform(-0.9999, 5, 20000), np.linspace(-0.26, 0.26, 5001)]).astype(np.float32)
    log, exp = np.zeros_like(y), np.zeros_like(y)
    functions(y, log, exp)
    true = y.astype(float)
    # Beyond |y| = 1/4, 1 + y and exp(y) are rounded once, half an eps, which log and the difference magnify by at most 1 / log(5/4)
    # = 4.5 and exp(1/4) / (exp(1/4) - 1) = 4.5; fast-math functions add an eps or two, magnified as much.
    assert np.abs(log - np.log1p(true)).max() <= 8 * EPS
    assert (np.abs(log - np.log1p(true)) <= 8 * EPS * np.abs(np.log1p(true))).all()
    assert (np.abs(exp - np.expm1(true)) <= 8 * EPS * np.abs(np.expm1(true))).all()


# -- materials: each particle is an experiment of its own


N = 4096


@pytest.fixture(scope="module", params=[2, 3])
def grains(request):
    return Experiments(SandModel, request.param, N, False)


def hencky(F):
    """Principal Hencky strains (ascending) and directions of b = F F^T, float64."""
    values, Q = np.linalg.eigh(F @ F.transpose(0, 2, 1))
    return 0.5 * np.log(values), Q


def lame(material):
    E, nu = material.young_modulus, material.poisson_ratio
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def cone(phi, dim):
    """-|dev tau| / tr tau on the yield surface: Mohr-Coulomb in 2D, its compression cone in 3D."""
    s = np.sin(np.radians(phi))
    return s / np.sqrt(2) if dim == 2 else np.sqrt(2 / 3) * 2 * s / (3 - s)


@pytest.mark.parametrize("phi", [20.0, 30.0, 36.0, 45.0, 60.0, 70.0])
def test_return_map(grains, phi):
    """Every trial strain, by a formula of its own in float64: tension is stress-free, the elastic cone is left alone, all else goes to the cone
    at the same volume and in the same deviatoric direction."""
    dim, rng = grains.dim, np.random.default_rng(int(phi))
    if dim == 3 and phi > 36.9:
        pytest.skip("a scene refuses it: in 3D the cone cannot yield in triaxial extension")
    material = Sand(model="sand", young_modulus=1e5, friction_angle=phi)
    lam, mu = lame(material)
    grains.set(material)
    grains.reset()
    pressed = rng.normal(size=(N, dim, dim)) * 0.03 - np.eye(dim) * rng.uniform(0, 0.15, (N, 1, 1))
    G = (pressed * 10.0 ** rng.uniform(-3, 0, (N, 1, 1))).astype(np.float32).astype(float)
    tau = grains.strain(G)
    e, Q = hencky(np.eye(dim) + G)
    trace = e.sum(1)
    dev = e - trace[:, None] / dim
    size, limit = np.linalg.norm(dev, axis=1), -cone(phi, dim) * (dim * lam + 2 * mu) / (2 * mu) * trace
    clear = np.abs(size - limit) > 1e-3 * size  # not within rounding of the surface
    tension, elastic, yields = trace > 1e-6, clear & (trace < -1e-6) & (size < limit), clear & (trace < -1e-6) & (size > limit)
    assert min(tension.sum(), elastic.sum(), yields.sum()) > 50, "all three branches are tried"

    expected = np.where(yields[:, None], dev * (limit / size)[:, None], dev) + trace[:, None] / dim
    expected = np.einsum("nij,nj,nkj->nik", Q, 2 * mu * expected + lam * expected.sum(1, keepdims=True), Q)
    scale = 2 * mu * np.abs(e).max(1) + lam * np.abs(trace)
    error = np.abs(tau - expected).max((1, 2)) / scale
    # b - I is rounded to eps of its largest entry, and a few eps more in the decomposition and the logarithm.
    assert error[elastic | yields].max() < 30 * EPS
    assert (tau[tension] == 0).all() and (grains.energy[tension] == 0).all()

    s = np.linalg.eigvalsh(tau)
    deviation, total = np.linalg.norm(s - s.mean(1, keepdims=True), axis=1), s.sum(1)
    inside = trace < -1e-6
    assert (deviation[inside] <= -cone(phi, dim) * total[inside] * (1 + 1e-4) + 30 * EPS * scale[inside]).all(), "on or inside the surface"
    if dim == 2:
        assert np.abs(s[yields, 0] - s[yields, 1]) == pytest.approx(np.sin(np.radians(phi)) * np.abs(total[yields]), rel=1e-4)

    b = np.einsum("nji,njk->nik", np.eye(dim) + G.transpose(0, 2, 1), np.eye(dim) + G.transpose(0, 2, 1)) - np.eye(dim)
    rows, columns = PACKED[dim]
    kept = grains.model.b.to_numpy()
    assert np.abs(kept - b[:, rows, columns])[elastic].max() < 4 * EPS * np.abs(b).max(), "elastic strains are unchanged"
    assert (kept[tension] == 0).all()
    # psi = mu e : e + lambda / 2 (tr e)^2, with the mapped strains
    mapped = np.where(yields[:, None], dev * (limit / size)[:, None], dev) + trace[:, None] / dim
    psi = mu * (mapped**2).sum(1) + lam / 2 * trace**2
    assert grains.energy[elastic | yields] == pytest.approx(psi[elastic | yields], rel=1e-3)
    assert grains.speed == pytest.approx(np.sqrt((lam + 2 * mu) / material.density), rel=4 * EPS)


def test_triaxial_compression_is_mohr_coulomb(grains):
    """Pressed along one axis with equal sides, sand yields at |s1 - s3| = sin(phi) |s1 + s3|, 3D like 2D."""
    dim, rng = grains.dim, np.random.default_rng(1)
    grains.set(Sand(model="sand", young_modulus=1e5, friction_angle=30.0))
    grains.reset()
    Q = np.linalg.qr(rng.normal(size=(N, dim, dim)))[0]
    stretch = np.tile([-0.1] + [0.02] * (dim - 1), (N, 1))
    s = np.linalg.eigvalsh(grains.strain(np.einsum("nij,nj,nkj->nik", Q, stretch, Q)))
    assert (s[:, -1] - s[:, 0]) == pytest.approx(0.5 * np.abs(s[:, -1] + s[:, 0]), rel=1e-4)


def test_volume_gained_in_tension_is_given_back_before_pressure_builds(grains):
    dim = grains.dim
    material = Sand(model="sand", young_modulus=1e5, friction_angle=30.0)
    lam, mu = lame(material)
    grains.set(material)
    grains.reset()

    def stretch(volume):
        """Isotropic, log of the volume ratio: [n] -> mean stress [n]."""
        return grains.strain(np.expm1(volume / dim)[:, None, None] * np.eye(dim)).trace(axis1=1, axis2=2) / dim

    gain = np.random.default_rng(0).uniform(0.001, 0.1, N)
    assert (stretch(gain) == 0).all()
    assert (stretch(-0.5 * gain) == 0).all(), "half of it is given back"
    assert grains.model.v.to_numpy() == pytest.approx(0.5 * gain, rel=1e-3)
    pressure = stretch(-0.5 * gain - 0.01)
    # rounding of the three volumes, of size 0.1
    assert pressure == pytest.approx(np.full(N, -(lam + 2 * mu / dim) * 0.01), rel=0.3 * EPS / 0.01 * 20)
    assert (grains.model.v.to_numpy() == 0).all()


@pytest.mark.parametrize("gamma", [7.0, 1.0, 1.4, 7.5])
def test_water(gamma):
    """p by hand, J = exp(tr G) to tr G^5 / 720, energy = the integral of p dV, wave speed^2 the larger of dp/drho and -d(J p)/dlog J / rho0."""
    material = Water(model="water", sound_speed=20.0, gamma=gamma)
    drops = Experiments(WaterModel, 2, 5, gamma == 7.0, False)
    drops.set(material)
    drops.reset()
    J = np.array([0.8, 0.99, 1.0, 1.001, 1.3], np.float32)
    G = np.zeros((5, 2, 2))
    trace = np.log(J.astype(float))
    G[:, 0, 0], G[:, 1, 1], G[:, 0, 1] = 2 * trace, -trace, 0.7  # only the trace counts, and shear does nothing
    tau = drops.strain(G)
    B = 1000 * 20.0**2 / gamma

    def p(V):
        return B * (V**-gamma - 1)

    assert drops.model.J.to_numpy() == pytest.approx(J, rel=2 * EPS + 0.27**5 / 720)
    J = drops.model.J.to_numpy()
    # J^(1 - gamma) - J cancels near 1, to eps of B; the exponent magnifies the rounding of J.
    for k in range(5):
        assert tau[k] == pytest.approx(-J[k] * p(float(J[k])) * np.eye(2), abs=10 * gamma * EPS * B * float(J[k]) ** -gamma)
    energy = [quad(p, float(V), 1)[0] for V in J]
    # Two terms of a series up to |1 - J| = 0.01, where the third is (gamma + 1) (gamma + 2) / 12 of 1e-4: 6e-4; beyond it float32 cancels 3e-4.
    assert drops.energy == pytest.approx(energy, rel=1e-3, abs=1e-9 * B)
    drho = 1e-4
    slope = [(p(1000 / (rho + drho)) - p(1000 / (rho - drho))) / (2 * drho) for rho in 1000 / J.astype(float)]
    h = 1e-5
    alone = [(V / (1 + h) * p(V / (1 + h)) - V * (1 + h) * p(V * (1 + h))) / (2 * np.log1p(h)) / 1000 for V in J.astype(float)]
    assert drops.speed == pytest.approx(np.sqrt(np.maximum(slope, alone)), rel=20 * EPS + 1e-6)


def test_water_pressure_by_hand():
    """c = 10, gamma = 7: B = 1e5 / 7; J = 1/2, from tr G = -log 2 in two steps, gives p = B (2^7 - 1) = 127 B."""
    drops = Experiments(WaterModel, 3, 1, True, False)
    drops.set(Water(model="water", sound_speed=10.0))
    drops.reset()
    drops.strain(-np.log(2) / 6 * np.eye(3)[None])
    assert drops.strain(-np.log(2) / 6 * np.eye(3)[None]) == pytest.approx(-0.5 * 127e5 / 7 * np.eye(3)[None], rel=7 * np.log(2) ** 5 / 720)


# -- walls


@ti.data_oriented
class Nodes:
    def __init__(self, friction):
        self.friction = friction

    @ti.kernel
    def contact(self, v: array2, node: ti.types.ndarray(ti.i32, 2), coefficient: ti.f32):
        for n in range(v.shape[0]):
            low, high, at = ti.Vector([1, 1]), ti.Vector([9, 9]), ti.Vector([node[n, 0], node[n, 1]])
            after = wall(ti.Vector([v[n, 0], v[n, 1]]), at, low, high, self.friction, coefficient)
            v[n, 0], v[n, 1] = after[0], after[1]


#: (node, velocity, after slip, after Coulomb friction 0.5); walls at 1 and 9
CONTACTS = {
    "inside": ((5, 5), (3, -4), (3, -4), (3, -4)),
    "into the floor": ((5, 1), (3, -4), (3, 0), (1, 0)),
    "into the ceiling": ((5, 9), (-3, 4), (-3, 0), (-1, 0)),
    "into the left wall": ((1, 5), (-2, 3), (0, 3), (0, 2)),
    "into the right wall": ((9, 5), (2, -3), (0, -3), (0, -2)),
    "along the floor": ((5, 1), (3, 0), (3, 0), (3, 0)),
    "off the floor": ((5, 1), (3, 2), (3, 2), (3, 2)),
    "friction stops and never pulls back": ((5, 1), (1, -4), (1, 0), (0, 0)),
    "into the corner": ((1, 1), (-3, -4), (0, 0), (0, 0)),
    "out of the corner": ((1, 1), (3, 4), (3, 4), (3, 4)),
    "into the floor, off the side": ((1, 1), (3, -2), (3, 0), (2, 0)),
    "ghost line behind the floor": ((5, 0), (3, -4), (3, -4), (3, -4)),
}


@pytest.mark.parametrize("friction", ["slip", "coulomb", "sticky"])
def test_walls(friction):
    nodes, before, slip, coulomb = (np.array(column) for column in zip(*CONTACTS.values(), strict=True))
    on_wall = ((nodes == 1) | (nodes == 9)).any(1, keepdims=True)
    expected = {"slip": slip, "coulomb": coulomb, "sticky": np.where(on_wall, 0, before)}[friction]
    after = before.astype(np.float32)
    Nodes(friction).contact(after, nodes.astype(np.int32), 0.5)
    for name, found, wanted in zip(CONTACTS, after, expected, strict=True):
        assert found == pytest.approx(wanted, abs=8 * EPS), name


# -- transfers


def put(solver, velocity, gradient=None):
    """Overwrite the velocities [n, dim] (and gradients) of a loaded solver: scenes know only bodies that move as one."""
    kernels, (n, dim) = solver._kernels, velocity.shape
    lanes = np.zeros((kernels.capacity, 4), np.float32)
    lanes[:n, :dim], lanes[:n, dim] = velocity, 1.0
    kernels.v.from_numpy(lanes)
    for axis in range(dim):
        column = np.zeros((kernels.capacity, 4), np.float32)
        if gradient is not None:
            column[:n, :dim] = gradient[:, :, axis]
        kernels.C[axis].from_numpy(column)
    solver._run(0, 0.0, keep=False)


def state(solver, n):
    """Positions, velocities, [n, dim] and velocity gradients [n, dim, dim] in float64."""
    kernels, dim = solver._kernels, solver._kernels.dim
    gradient = np.stack([column.to_numpy()[:n, :dim] for column in kernels.C], -1).astype(float)
    return (kernels.x.to_numpy()[:n].astype(float) - WALL) * solver.dx, kernels.v.to_numpy()[:n, :dim].astype(float), gradient


def test_a_linear_velocity_field_survives_the_transfers(water):
    """APIC carries linear fields exactly (Jiang et al. 2015), also at the surface of a body. The field has no divergence, so no pressure answers."""
    water.load(scene([("water", [0.25, 0.25], [0.75, 0.75])], gravity=[0.0, 0.0]))
    n = water._position.shape[1]
    x = state(water, n)[0]
    A = np.array([[1.0, 3.0], [-2.0, -1.0]])
    field = x @ A.T + [0.5, -0.25]
    put(water, field, np.tile(A, (n, 1, 1)))
    water._run(1, 1e-6, keep=False)
    _, v, C = state(water, n)
    assert np.abs(v - field).max() < 10 * EPS * np.abs(field).max()
    # C sums velocities times 4 / dx; 2 eps of 9 velocities each
    assert np.abs(C - A).max() < 20 * EPS * np.abs(field).max() * 4 / water.dx * 0.5


def test_momentum_and_angular_momentum_of_random_motion(water):
    """Pressure and transfers between particles change neither: what is left is rounding, far below 1e-6 of sum |m v|."""
    water.load(scene([("water", [0.25, 0.25], [0.75, 0.75])], gravity=[0.0, 0.0]))
    n = water._position.shape[1]
    put(water, np.random.default_rng(0).normal(size=(n, 2)) + [0.3, -0.2])

    def momenta():
        x, v, C = state(water, n)
        affine = (C[:, 1, 0] - C[:, 0, 1]).sum() * water.dx**2 / 4  # the moment of inertia of a quadratic B-spline is dx^2 / 4
        return v.sum(0), (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() + affine, np.abs(v).sum()

    p0, L0, size = momenta()
    for _ in range(10):
        water.frame()
    p1, L1, _ = momenta()
    x = state(water, n)[0]
    assert x.min() > 2 * water.dx and x.max() < 1 - 2 * water.dx, "nothing touched a wall"
    assert np.abs(p1 - p0).max() <= 1e-6 * size
    assert abs(L1 - L0) <= 1e-6 * size


def test_diagnostics_by_hand(water):
    """A block of 1/4 x 1/8 with its centre at 5/16: m |v|^2 / 2 and m g h."""
    water.load(scene([("water", [0.25, 0.25], [0.5, 0.375], [3.0, 4.0])], jitter=0.0))
    found = water.diagnostics()
    mass = 1000 * 0.25 * 0.125
    assert found["kinetic_energy"] == pytest.approx(mass * 25 / 2, rel=1e-5)
    assert found["potential_energy"] == pytest.approx(mass * 9.8 * 0.3125, rel=1e-5)
    assert found["elastic_energy"] == 0 and found["max_speed"] == pytest.approx(5, rel=1e-6) and found["wave_speed"] == pytest.approx(10, rel=1e-6)


# -- step control


def test_substeps_obey_the_courant_number_and_divide_the_frame(water):
    water.load(DROP)
    limit = DROP.cfl * water.dx
    fewest, most = 1 << 20, 0
    for _ in range(60):
        before = water.diagnostics()
        water.frame()
        after = water.diagnostics()
        assert after["substeps"] * after["dt"] == pytest.approx(DROP.frame_step, rel=1e-15) and after["substeps"] == int(after["substeps"])
        assert after["dt"] * (before["wave_speed"] + before["max_speed"]) <= limit
        assert after["dt"] * (after["wave_speed"] + after["max_speed"]) <= COURANT_GROWTH * limit
        fewest, most = min(fewest, after["substeps"]), max(most, after["substeps"])
    assert most > 1.5 * fewest, "the impact takes more substeps than the fall"


def believe(solver, substeps, what):
    """Make a solver expect the wave speed that asks for so many substeps in the next frame."""
    reach = np.linalg.norm(what.gravity) * what.frame_step
    solver._diagnostics |= {"max_speed": 0.0, "wave_speed": (substeps - 0.5) * solver._cfl * solver.dx / what.frame_step - reach}


def test_a_frame_that_outgrows_its_plan_is_repeated_from_its_start(water):
    run(water, DROP, 5)
    believe(water, 1, DROP)
    after = water.frame()
    used = water.diagnostics()["substeps"]
    assert used in (2, 4, 8), "the step was halved"
    run(water, DROP, 5)
    believe(water, used, DROP)
    straight = water.frame()
    assert water.diagnostics()["substeps"] == used
    assert (after == straight).all() and np.isfinite(after).all(), "nothing of the rejected attempts is left"


@pytest.mark.parametrize("field", ["velocity", "gradient", "material"])
@pytest.mark.parametrize("material", ["water", "sand"])
@pytest.mark.parametrize("value", [np.nan, -np.inf, -2.0])
def test_not_a_number_is_caught_within_its_frame(request, field, material, value):
    """Fast-math compiles ``x != x`` away and maxima drop NaN. A volume ratio below 0 is as broken; as a velocity -2 is sound."""
    if value == -2.0 and field != "material":
        pytest.skip("a sound value")
    solver, what = request.getfixturevalue(material), {"water": DROP, "sand": SANDPILE}[material]

    class Poisoned:
        """A teacher that goes wrong before frame 4."""

        name, kind, settings = "poisoned", "solver", {}
        diagnostics = solver.diagnostics

        def load(self, scene):
            solver.load(scene)
            self.frames = 0

        def frame(self):
            self.frames += 1
            if self.frames == 4:
                kernels = solver._kernels
                target = {"velocity": kernels.v, "gradient": kernels.C[0], "material": kernels.materials[0].fields()[0]}[field]
                content = target.to_numpy()
                content[17, ...] = value
                target.from_numpy(content)
            return solver.frame()

    trajectory = simulate(Poisoned(), what)
    known = {"velocity": "velocity", "gradient": "velocity gradient", "material": {"water": "water.J", "sand": "sand.b - I"}[material]}[field]
    why = "time step fell below" if np.isfinite(value) else f"{known} of particle 17 is not finite (frame 4)"
    assert trajectory.status.startswith(f"failed: {why}") and trajectory.status.endswith("(frame 4)")
    assert len(trajectory.position) == 4 and np.isfinite(trajectory.position).all(), "the frames before it are kept"


@pytest.mark.parametrize("growth", [-0.5, 0.5, 7.0])
def test_a_volume_changed_too_much_in_a_step_is_not_sound(growth):
    """Just below, it is exp of it: (12 + 6 g + g^2) / (12 - 6 g + g^2) is 61 / 37 at 1/2, exp(1/2) to 4e-5."""
    drops = Experiments(WaterModel, 2, 2, True, False)
    drops.set(Water(model="water", sound_speed=10.0))
    drops.reset()
    below = np.sign(growth) * 0.49
    drops.strain(np.array([np.diag([growth, 0.0]), np.diag([below, 0.0])]))
    assert drops.intact.tolist() == [0, 1] and drops.model.J.to_numpy()[1] == pytest.approx(np.exp(below), rel=5e-5)


def test_a_step_that_would_turn_a_volume_inside_out_is_repeated(water):
    """A lone droplet, torn to J = 16, whose gradient would take it to 16 (1 - 1.2) < 0 in one step. At |J| > 1 sound is slow, so the
    Courant number has no objection; such a droplet once ran to J = -33 and the trajectory failed."""
    what = scene([("water", [0.5, 0.5], [0.52, 0.52])], gravity=[0.0, 0.0], frame_step=0.001)
    water.load(what)
    J = water._kernels.materials[0].J
    J.from_numpy(np.full(J.shape, 16.0, np.float32))
    put(water, np.zeros((1, 2)), np.eye(2)[None] * -0.6 / what.frame_step)
    planned = what.frame_step * water.diagnostics()["wave_speed"] / (water._cfl * water.dx)
    assert planned < 1, "one step is planned"
    assert np.isfinite(water.frame()).all()
    assert water.diagnostics()["substeps"] > 1 and J.to_numpy()[0] > 0


@pytest.mark.parametrize("cfl", [0.4, 0.8, 2.0])
def test_the_volume_of_a_lone_particle_rings_within_bounds(cfl):
    """Alone it swings at 2 sqrt(dim) c / dx, which the Courant number of whole bodies does not see: J ran to 1e6 at cfl 0.8.

    Squeezed to J = 0.99, without friction of any kind: a nearly linear swing, which symplectic Euler keeps within
    1 / sqrt(1 - (w dt / 2)^2) = 1.7 of its size at the planned 0.8 of the limit, and steps that change from frame to frame pump a little.
    """
    solver = MPMSimulator(cfl=cfl)
    what = scene([("water", [0.5, 0.5], [0.52, 0.52])], {"water": WATER | {"sound_speed": 30.0}}, gravity=[0.0, 0.0])
    solver.load(what)
    J = solver._kernels.materials[0].J
    J.from_numpy(np.full(J.shape, 0.99, np.float32))
    solver._run(0, 0.0, keep=True)
    seen = []
    for _ in range(100):
        solver.frame()
        seen.append(J.to_numpy()[0])
        assert solver.diagnostics()["dt"] * solver.diagnostics()["wave_speed"] * np.sqrt(2) <= solver.dx
    assert 0.97 < min(seen) < 0.9925 and 1.0075 < max(seen) < 1.03


def test_only_materials_that_ring_bound_the_step_of_a_lone_particle():
    """Sand, slack when it is parted, takes the Courant number that was asked for; cohesive sand and water do not."""

    def courant(material):
        solver = MPMSimulator(cfl=1.2)
        solver.load(scene([("stuff", [0.25, 0.25], [0.5, 0.5])], {"stuff": material}, gravity=[0.0, 0.0], frame_step=0.05))
        solver.frame()
        found = solver.diagnostics()
        return found["dt"] * found["wave_speed"] / solver.dx

    sand = {"model": "sand", "young_modulus": 1e5, "friction_angle": 30.0}
    assert 1.1 < courant(sand) <= 1.2
    assert courant(sand | {"cohesion": 10.0}) < 0.9 / np.sqrt(2) * 1.001
    assert courant(WATER) < 0.9 / np.sqrt(2) * 1.001


def test_a_volume_turned_inside_out_twice_is_not_sound():
    """A step of 1 + tr G = -4 and another: J = 16 looked like a torn drop, and the frame was accepted."""
    drops = Experiments(WaterModel, 2, 2, True, False)
    drops.set(Water(model="water", sound_speed=10.0))
    drops.reset()
    once = np.array([np.diag([-5.0, 0.0]), np.diag([-0.25, 0.0])])
    drops.strain(once)
    assert drops.intact.tolist() == [0, 1]
    drops.strain(once)
    assert drops.intact.tolist() == [0, 1] and drops.model.J.to_numpy()[1] == pytest.approx(np.exp(-0.5), rel=1e-5)


@pytest.mark.parametrize("changes", [{}, {"container": {"sines": [{"amplitude": [3.0, 0.0], "frequency": 2.0, "phase": 30.0}]}}])
def test_frames_at_once_are_those_one_by_one(changes):
    """A fixed step: the same bits, and the diagnostics of the last. 16 frames of the 21 - 1 are left over twice."""
    what = Scene.from_dict(DROP.to_dict() | {"time_step": DROP.frame_step / 8, "frames": 21} | changes)
    one, many = MPMSimulator(), MPMSimulator(frames=8)
    expected = run(one, what, 16)
    many.load(what)
    assert (np.concatenate([many.advance(), many.advance()]) == expected).all()
    assert many.diagnostics() == one.diagnostics()


def test_frames_at_once_that_outgrow_their_step_are_run_one_by_one(water, monkeypatch):
    """All of a block is planned by its start. Two of the four frames are refused: it is taken back, and each plans for itself."""
    expected = run(water, DROP, 4)
    many, looked = MPMSimulator(frames=4), []
    many.load(DROP)
    original = many._acceptable
    monkeypatch.setattr(many, "_acceptable", lambda sums, dt: looked.append(1) or (len(looked) != 3 and original(sums, dt)))
    assert (many.advance() == expected).all() and len(looked) == 3 + 4


def test_less_than_a_frame_at_once_is_refused():
    with pytest.raises(InputError, match="frames = 0: must be at least 1"):
        MPMSimulator(frames=0)


def test_a_step_that_would_need_too_many_halvings_is_given_up(water, monkeypatch):
    run(water, DROP, 3)
    tried = []
    original = water._run

    def diverging(substeps, dt, keep):
        tried.append((substeps, keep))
        return original(substeps, dt, keep) * np.nan

    monkeypatch.setattr(water, "_run", diverging)
    with pytest.raises(SimulationError, match="without a finite, stable frame"):
        water.frame()
    assert [substeps for substeps, _ in tried] == [tried[0][0] * 2**k for k in range(MAX_HALVINGS + 1)]
    assert [keep for _, keep in tried] == [True] + [False] * MAX_HALVINGS


# -- same bits


def test_runs_are_bitwise_equal_fresh_reused_and_after_a_failure(water):
    fresh = run(MPMSimulator(), DROP, 40)
    first = run(water, DROP, 40)
    run(water, SMALL, 7)
    reused = run(water, DROP, 40)
    velocity = water._kernels.v.to_numpy()
    velocity[5] = np.nan
    water._kernels.v.from_numpy(velocity)
    with pytest.raises(SimulationError):
        water.frame()
    recovered = run(water, DROP, 40)
    assert (first == fresh).all() and (reused == fresh).all() and (recovered == fresh).all()


@pytest.mark.parametrize("material", ["water", "sand"])
def test_parallel_kernels_agree_with_serial_ones(request, material):
    """The kernels of a GPU on one thread: the same arithmetic but for the order that a compiler chooses, so rounding apart, before chaos grows it."""
    what = {"water": DROP, "sand": SANDPILE}[material]
    serial = run(request.getfixturevalue(material), what, 10)
    parallel = run(MPMSimulator(serial=False), what, 10)
    assert np.abs(parallel - serial).max() < 100 * EPS


# -- three dimensions

POND = scene(
    [
        ("water", [0.125, 0.125, 0.25], [0.375, 0.5, 0.625], [0.5, 0.0, -1.0]),
        ("sand", [0.6875, 0.25, 0.375], [0.9375, 0.5, 0.75], [-0.25, 0.25, 0.0]),
    ],
    {"water": WATER, "sand": SAND},
    walls={"friction": 0.3},
)


def test_3d_free_fall(cube):
    """x0 + v0 t + g t^2 / 2 + g dt t / 2: symplectic Euler's own error, known in closed form. dt varies from frame to frame."""
    start, frames = POND.particles(), run(cube, POND, 0)
    velocity, expected, gravity = start.velocity.copy(), start.position.copy(), np.array(POND.gravity)
    for _ in range(6):
        frames = cube.frame()
        n, dt = cube.diagnostics()["substeps"], cube.diagnostics()["dt"]
        expected += velocity * n * dt + gravity * dt**2 * n * (n + 1) / 2
        velocity += gravity * n * dt
    assert expected.min() > 0.1, "nothing reached the floor"
    # Positions are rounded to eps of 16 cells once a substep (30 of them).
    assert np.abs(frames - expected).max() < 30 * EPS


def test_3d_drop_stays_inside_and_piles_up(cube):
    frames = run(cube, POND, 20)
    assert np.isfinite(frames).all() and frames.min() >= 0 and frames.max() <= 1
    for _ in range(30):
        last = cube.frame()
    water_height, sand_height = (last[POND.particles().material == kind, 2] for kind in (0, 1))
    # 0.035 m^3 of water on 1 m^2 and a heap of sand: both end near the floor, neither is squeezed flat
    assert 0.02 < water_height.mean() < 0.2 and 0.02 < sand_height.mean() < 0.2


def test_3d_momentum(cube):
    """Two bodies of different density collide in free space: the momentum of mass x velocity stays."""
    what = scene(
        [("water", [0.25, 0.25, 0.25], [0.5, 0.5, 0.5], [0.5, 0.0, 0.0]), ("sand", [0.5625, 0.25, 0.25], [0.75, 0.5, 0.5], [-0.5, 0.25, 0.0])],
        {"water": WATER, "sand": SAND},
        walls={"friction": 0.3},
        gravity=[0.0, 0.0, 0.0],
    )
    cube.load(what)
    particles = what.particles()
    mass = np.array([1000.0, 1800.0])[particles.material][:, None]
    before = mass * particles.velocity
    for _ in range(12):
        last = cube.frame()
    after = mass * state(cube, len(mass))[1]
    assert np.abs(after - before)[particles.material == 1].mean() > 100, "they did collide"
    assert last.min() > 0.1 and last.max() < 0.9
    assert np.abs(after.sum(0) - before.sum(0)).max() <= 1e-6 * np.abs(before).sum()


# -- nothing is built that a scene does not need


def test_water_compiles_no_decomposition(monkeypatch):
    def refuse(*_):
        raise AssertionError("a decomposition in water")

    from sim.mpm.materials import strain

    for name in ("decompose", "assemble"):
        monkeypatch.setattr(strain, name, refuse)
    assert np.isfinite(run(MPMSimulator(), SMALL, 1)).all()
    with pytest.raises(Exception, match="a decomposition in water"):
        MPMSimulator().load(SANDPILE)


@pytest.mark.parametrize(("particles", "capacity"), [(1, 16), (17, 32), (16384, 16384), (16385, 18432), (20000, 20480), (1000000, 1048576)])
def test_room_for_particles(particles, capacity):
    assert solver_module._capacity(particles) == capacity


def test_two_materials_in_3d_allocate_what_the_plan_says(built):
    simulator = MPMSimulator()
    promised = simulator.plan(POND)
    kernels = solver_module._Kernels(simulator._structure(POND), solver_module._capacity(promised["particles"]), (19, 19, 19), 0, True)
    assert sorted(each for each in built["fields"] if each[1] > 8) == sorted(map(tuple, promised["fields"].values()))
    assert len(kernels.state) == len(kernels.saved) == 5 + 1 + 2, "x, v, three columns of C; J; b and volume gain"
