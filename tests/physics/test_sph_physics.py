"""What SPH must get right beside the ladder."""

from __future__ import annotations

import numpy as np
import pytest

from sim.solvers import solver_class
from sim.sph.kernel import lattice_scale, lattice_slope, slope
from sim.sph.solver import SPHSimulator
from sim.validation import dam_impact, scene


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("support", [1.5, 2.0, 2.5, 3.7])
def test_the_gradient_of_a_linear_function_is_exact_on_a_lattice(dim, support):
    d = 1 / support
    x = np.stack(np.meshgrid(*[np.arange(-4, 5) * d] * dim, indexing="ij"), -1).reshape(-1, dim)
    q = lattice_slope(dim, d) * lattice_scale(dim, d) * slope(dim, np.linalg.norm(x, axis=1)) * d**dim
    # a x_0, of each: sum_j V (f_j - f_i) grad W is minus this, r being x_i - x_j.
    np.testing.assert_allclose((q[:, None] * x[:, :1] * x).sum(0), [1.0] + [0.0] * (dim - 1), atol=1e-12)


@pytest.mark.physics
def test_pressure_in_a_corner():
    """All of the column of particles beside a vertical wall, the one in the corner among them, is under the pressure of its depth."""
    H, G, C = 0.5, 9.8, 20.0
    what = scene("corner", {"model": "water", "sound_speed": C}, [{"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, H]}], [[0.0, 1.0]] * 2,
                 [16] * 2, 4 * H / C / 10, gravity=[0.0, -G], solver={"method": "wcsph", "support": 2.0})  # fmt: skip
    solver = SPHSimulator()
    solver.load(what)
    edge = what.particles().position[:, 0] < what.spacing
    found = []
    for frame in range(200):
        solver.frame()
        if frame >= 100:
            state = solver.state()
            found.append((state["pressure"][edge] / (1000 * G * H), 1 - state["position"][edge, 1] / H))
    ours, exact = np.mean(found, 0)
    assert edge.sum() == 16
    np.testing.assert_allclose(ours, exact, atol=0.02)


@pytest.mark.physics
@pytest.mark.parametrize("method", ["wcsph", "dfsph"])
def test_nothing_hangs_from_a_ceiling(method):
    """A block that starts at the ceiling falls freely: no wall pulls."""
    g, t = 9.8, 0.1
    what = scene("ceiling", {"model": "water", "sound_speed": 20.0}, [{"kind": "box", "lower": [0.3, 0.75], "upper": [0.7, 1.0]}], [[0.0, 1.0]] * 2,
                 [16] * 2, t / 10, gravity=[0.0, -g], solver={"method": method})  # fmt: skip
    solver = SPHSimulator()
    solver.load(what)
    for _ in range(10):
        position = solver.frame()
    fallen = what.particles().position[:, 1] - position[:, 1]
    # Symplectic Euler is g dt t / 2 ahead.
    ahead = g * solver.diagnostics()["dt"] * t / 2 if method == "dfsph" else 0.0
    assert fallen.mean() == pytest.approx(g * t**2 / 2 + ahead, rel=0.01)


@pytest.mark.physics
@pytest.mark.parametrize("method", ["wcsph", "dfsph"])
def test_a_throw_is_a_parabola_from_its_first_step(method):
    """Also with shifting: what moves as one has nothing to be shifted by. Velocities are set after the scene was loaded. Without density diffusion,
    which takes pressures to be hydrostatic and moves a surface in flight by a fortieth of a spacing."""
    g, t = 9.8, 0.1
    what = scene("throw", {"model": "water", "sound_speed": 20.0}, [{"kind": "ball", "center": [0.4, 0.4], "radius": 0.15}], [[0.0, 1.0]] * 2,
                 [16] * 2, t / 10, gravity=[0.0, -g],
                 solver={"method": method} | ({"density_diffusion": 0.0} if method == "wcsph" else {}))  # fmt: skip
    solver = SPHSimulator()
    solver.load(what)
    start = what.particles().position
    solver.set_velocity(np.tile([1.0, 2.0], (len(start), 1)))
    for _ in range(10):
        solver.frame()
    state = solver.state()
    np.testing.assert_allclose(state["velocity"].mean(0), [1.0, 2.0 - g * t], atol=1e-5)
    moved = state["position"] - start
    ahead = -g * solver.diagnostics()["dt"] * t / 2 if method == "dfsph" else 0.0
    np.testing.assert_allclose(moved.mean(0), [t, 2 * t - g * t**2 / 2 + ahead], atol=1e-5)
    assert np.ptp(moved, axis=0).max() < 0.01 * what.spacing


@pytest.mark.physics
def test_viscosity_limits_the_step():
    """Between sticky walls thick water that moves along them does nothing else; with steps twice as long as they may be it boiled."""
    what = scene("thick", {"model": "water", "sound_speed": 20.0, "density": 1.0, "viscosity": 1.0},
                 [{"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}], [[0.0, 1.0]] * 2, [15] * 2, 0.05, periodic=["x"],
                 walls={"friction": "sticky"}, gravity=[10.0, 0.0], solver={"method": "wcsph"})  # fmt: skip
    solver = SPHSimulator()
    solver.load(what)
    solver.frame()
    along, across = solver.state()["velocity"].T
    assert 0.3 < along.max() < 1.25 and np.abs(across).max() < 0.01


@pytest.mark.physics
def test_a_closed_box_keeps_its_density():
    """Shifting evens out what the flow stirs up, again and again: under a moving lid the mean density stays what the box holds."""
    what = scene("cavity", {"model": "water", "sound_speed": 10.0, "density": 1.0, "viscosity": 0.01},
                 [{"kind": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}], [[0.0, 1.0]] * 2, [8, 8], 0.1,
                 walls={"friction": "sticky", "velocity": {"y+": [1.0, 0.0]}}, solver={"method": "wcsph", "artificial_viscosity": 0.0})  # fmt: skip
    solver = SPHSimulator()
    solver.load(what)
    mean = []
    for _ in range(100):
        solver.frame()
        mean.append(solver.state()["density"].mean() - 1)
    assert np.abs(mean).max() <= 0.01


@pytest.mark.physics
@pytest.mark.parametrize("method", ["mpm", "wcsph", "dfsph"])
def test_the_walls_force_is_the_rate_of_change_of_momentum(method):
    """Until the stream hits the far wall all of its momentum along the tank is the impulse of the wall that the column stood against."""
    what = dam_impact.tank(16, method)
    solver = solver_class(method)()
    solver.load(what)
    force, momentum = [0.0], 0.0
    for _ in range(150):
        solver.frame()
        state = solver.state()
        x = state["position"][:, 0]
        assert x.max() < what.bounds[0][1] - 3 * what.spacing
        force.append((dam_impact.pressing(x, what) * dam_impact.pressure(solver, method)).sum() * what.spacing**2)
        momentum = dam_impact.RHO * what.spacing**2 * state["velocity"][:, 0].sum()
    assert momentum > 100
    assert np.trapezoid(force, dx=what.frame_step) == pytest.approx(momentum, rel=0.02)
