"""Smoothed particle hydrodynamics in 2D and 3D: what WCSPH and DFSPH share, under the ``Simulator`` contract.

Lengths are in support radii of the kernel, densities relative to that at rest, time in seconds. All vectors have four lanes whatever the
dimension, as in ``sim.mpm.solver``: uniform lanes are what the compiler turns into vector instructions, and 2D and 3D share their code.

Decision: one kernel a frame, on one thread, with the adaptive steps inside. Particles interact with walls through a table over the distance
(``sim.sph.kernel``), so there are no boundary particles to search.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim.errors import InputError
from sim.mpm.decomposition import finite
from sim.obstacles import combine
from sim.rigid import NO_SLIP, body_table
from sim.scene import Incompressible, Particles, Scene, Water, WeaklyCompressible, check_particles
from sim.signed_distance import between_nodes
from sim.simulator import Kind, SimulationError, Start
from sim.sph.dfsph import DFSPH, VISCOUS_ERROR
from sim.sph.kernel import (
    CLOSEST,
    DRAG,
    ENTRIES,
    NORMAL,
    SHARE,
    SLOPE,
    SPREAD,
    TANGENT,
    constant,
    lattice_scale,
    lattice_shift,
    lattice_slope,
    viscous_scale,
    wall_table,
)
from sim.sph.neighbours import FEWEST, ROOM, SKIN, Neighbours
from sim.sph.rigid import RigidBodies, bare, corner_share, lightest
from sim.sph.walls import HAIR, Walls
from sim.sph.wcsph import INSIDE, LARGEST_COURANT, LARGEST_VISCOUS, WCSPH
from sim.taichi_runtime import compiling, start_taichi, ti

#: Halvings of the step planned at a frame's start before a trajectory is given up. A step that has to be shorter, for speeds that run away or for
#: solves that do not end, ends the frame too: no frame takes more than 2^6 times the steps planned.
MAX_HALVINGS = 6
#: A fixed time step ends a trajectory when it exceeds the limit at that moment by this factor, from which on energies grow (``sim.stability``:
#: sound_dt, fall_dt).
GROWTH = 2.0
#: Share of the box from which on water counts as filling it, without a free surface.
FULL = 0.999


@dataclass(frozen=True)
class Structure:
    """What is compiled in. rigid: (bodies, faces of one) at most, or None."""

    dim: int
    method: str
    periodic: tuple[bool, ...]
    no_slip: bool
    viscous: bool
    shifting: bool
    xsph: bool
    full: bool
    obstacles: bool
    rigid: tuple[int, int] | None


def _capacity(particles: int) -> int:
    """Particles that fields are made for: few different numbers, for each compiles anew."""
    step = 1 << max(int(particles).bit_length() - 3, 6)
    return -(-particles // step) * step


def _power_of_two(n: int) -> int:
    return 1 << max(n - 1, 7).bit_length()


def _method(scene: Scene) -> WeaklyCompressible | Incompressible:
    assert isinstance(scene.solver, (WeaklyCompressible, Incompressible))
    return scene.solver


def _sound(water: Water) -> float:
    """[m/s]: scenes of WCSPH have it (``sim.scene``)."""
    assert water.sound_speed is not None
    return water.sound_speed


@ti.data_oriented
class _Kernels(Walls):
    """Fields and compiled code for one ``Structure``."""

    #: Places in ``number``.
    (
        COUNT,
        VOLUME,
        KERNEL,
        SPACING,
        CFL,
        SOUND,
        GAMMA,
        VISCOSITY,
        ALPHA,
        DELTA,
        DENSITY_ERROR,
        DIVERGENCE_ERROR,
        ITERATIONS,
        THICKNESS,
        XSPH,
        ROUGH,
        LIGHT,
        CORNER,
        SHIFT,
        NUMBERS,
    ) = range(20)
    #: Places in a frame's report. Read from it are gravity, its change since the frame before, the frame's length, the longest step and whether
    #: all are to be so long, and the limit below which the frame ends.
    (
        STEPS,
        STEP,
        SPEED,
        SOLVED,
        ERROR,
        UNSOLVED,
        KINETIC,
        POTENTIAL,
        ELASTIC,
        DENSEST,
        BROKEN,
        FULL,
        LISTED,
        THICKENED,
        VISCOUS,
        OUTSIDE,
        LAST,
        LIMIT,
    ) = (0, 1, 2, 3, 5, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19)
    GRAVITY, CHANGE, SPAN, CAP, FIXED, FLOOR, REPORT = 20, 23, 26, 27, 28, 29, 30

    def __init__(self, structure: Structure, capacity: int, cells: int, pairs: int, wet: int, nodes: tuple[int, ...]):
        super().__init__(structure.dim, structure.periodic)
        self.structure, self.capacity = structure, capacity
        self.number = ti.field(ti.f32, self.NUMBERS)
        self.x, self.v = (ti.Vector.field(4, ti.f32, capacity) for _ in range(2))
        self.id = ti.field(ti.i32, capacity)
        # The obstacles are one more.
        self.faces += structure.obstacles
        if structure.obstacles:
            self.solids = ti.Vector.field(self.dim + 1, ti.f32, nodes)  # normal and distance [support radii], a spacing apart
        self.slide = ti.Vector.field(4, ti.f32, self.faces)
        self.neighbours = Neighbours(self.dim, capacity, cells, pairs, self.periodic)
        self.has_rigid = structure.rigid is not None
        self.rigid: Any = None if structure.rigid is None else RigidBodies(self, *structure.rigid, wet)  # used where ``has_rigid`` is compiled in
        self.scheme: Any = (DFSPH if structure.method == "dfsph" else WCSPH)(self, capacity, pairs)  # each has fields of its own
        self.state = [self.x, self.v, *self.scheme.state]
        self.moved, self.saved = ([ti.Vector.field(field.n, ti.f32, capacity) for field in self.state] for _ in range(2))
        self.moved_id, self.saved_id = (ti.field(ti.i32, capacity) for _ in range(2))

    # -- walls
    @ti.func
    def face(self, x, f: ti.template()):
        """Distance to a wall, or to the obstacles (the last), and the normal away from it; 2 for one that is not there."""
        s, n = 2.0, ti.Vector.zero(ti.f32, 4)
        if ti.static(f == 2 * self.dim):
            s, n = self.clearance(x)
        else:
            s, n = self.wall_face(x, f)
        return s, n

    @ti.func
    def clearance(self, x):
        """Distance to the obstacles and unit normal [support radii]."""
        u, n = ti.Vector.zero(ti.f32, self.dim), ti.Vector.zero(ti.f32, 4)
        for d in ti.static(range(self.dim)):
            # A hair short of the last node, beyond which there is none.
            u[d] = ti.min(ti.max(x[d] / self.number[self.SPACING], 0.0), ti.static(self.solids.shape[d] - 1 - 1e-4))
        s, normal = between_nodes(self.solids, u, self.dim)
        for d in ti.static(range(self.dim)):
            n[d] = normal[d]
        return s, n

    @ti.func
    def drag(self, x, u, walls: ti.template()):
        """What sticky walls take from a velocity u at x, over the viscosity; or (``walls``) what they give by their own velocities."""
        taken = ti.Vector.zero(ti.f32, 4)
        fluid = 1.0 - self.walls(x)[3]
        for f in ti.static(range(self.faces)):
            s, n = self.face(x, f)
            if s < 1.0:
                T = self.look(s)
                w = u
                if ti.static(walls):
                    w = self.slide[f]
                along = w - (w[0] * n[0] + w[1] * n[1] + w[2] * n[2]) * n
                along[3] = 0.0
                taken += (fluid / (1.0 - T[SHARE]) * T[DRAG] / ti.max(s, CLOSEST)) * along
        return taken

    @ti.func
    def enclose(self, i):
        """Keep a particle inside the walls, or bring it back through a periodic face."""
        x = self.x[i]
        for d in ti.static(range(self.dim)):
            if ti.static(self.periodic[d]):
                x[d] -= self.neighbours.length[None][d] * ti.floor(x[d] / self.neighbours.length[None][d])
            else:
                inside = ti.min(ti.max(x[d], self.extent[0][d] + HAIR), self.extent[1][d] - HAIR)
                # On a wall, where it was stopped before, no velocity into it is left either.
                low, high = self.extent[0][d] + ti.static(1.01 * HAIR), self.extent[1][d] - ti.static(1.01 * HAIR)
                if inside != x[d] or (x[d] < low and self.v[i][d] < 0.0) or (x[d] > high and self.v[i][d] > 0.0):
                    self.v[i][d] = 0.0
                if finite(x[d]):
                    x[d] = inside
        if ti.static(self.structure.obstacles):
            s, n = self.clearance(x)
            if s < HAIR:
                u = self.v[i]
                inward = ti.min(u[0] * n[0] + u[1] * n[1] + u[2] * n[2], 0.0)
                self.v[i] = u - inward * n
                for d in ti.static(range(self.dim)):
                    x[d] = ti.min(ti.max(x[d] + (HAIR - s) * n[d], self.extent[0][d] + HAIR), self.extent[1][d] - HAIR)
        self.x[i] = x

    @ti.func
    def stir(self, n):
        """Largest speed beyond the mean velocity: that of shifting, so that water in free flight is not shifted."""
        mean, fast = ti.Vector.zero(ti.f64, 4), 0.0
        for i in range(n):
            mean += ti.cast(self.v[i], ti.f64)
        drift = ti.cast(mean / n, ti.f32)
        for i in range(n):
            u = self.v[i] - drift
            u[3] = 0.0
            fast = ti.max(fast, u.norm_sqr())
        return ti.sqrt(fast)

    # -- pairs
    @ti.func
    def everything(self, n):
        """Particles of water and, behind them, of bodies."""
        total = n
        if ti.static(self.has_rigid):
            total += self.rigid.members[None]
        return total

    @ti.func
    def list_pairs(self, n, report: ti.template()):
        if self.neighbours.stale(self.x, self.everything(n)):
            self.neighbours.sort(self.x, n)
            for i in range(n):
                k = self.neighbours.to[i]
                for f in ti.static(range(len(self.state))):
                    self.moved[f][k] = self.state[f][i]
                self.moved_id[k] = self.id[i]
            for i in range(n):
                for f in ti.static(range(len(self.state))):
                    self.state[f][i] = self.moved[f][i]
                self.id[i] = self.moved_id[i]
            self.neighbours.pair(self.x, n)
            if ti.static(self.has_rigid):
                self.rigid.find_water(n)
            report[self.LISTED] += 1.0

    # -- kernels
    @ti.kernel
    def frame(self, keep: ti.i32, position: ti.types.ndarray(ti.f32, 2), report: ti.types.ndarray(ti.f64, 1)):
        """One frame, up to the first step that is not sound; of no span, what the start is like. ``keep`` saves the state first."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            n = ti.cast(self.number[self.COUNT], ti.i32)
            outside = 0
            for i in range(keep * n):
                for f in ti.static(range(len(self.state))):
                    self.saved[f][i] = self.state[f][i]
                self.saved_id[i] = self.id[i]
                x = self.x[i]
                for d in ti.static(range(self.dim)):
                    outside += ti.cast(x[d] < self.extent[0][d] - HAIR, ti.i32) + ti.cast(x[d] > self.extent[1][d] + HAIR, ti.i32)
            if ti.static(self.has_rigid):
                for _again in range(keep):
                    self.rigid.keep(False)
                    self.rigid.fastest[1] = self.rigid.fastest[0]
            g, change = ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4)
            for d in ti.static(range(self.dim)):
                g[d], change[d] = ti.cast(report[self.GRAVITY + d], ti.f32), ti.cast(report[self.CHANGE + d], ti.f32)
            if ti.static(self.structure.method == "wcsph"):
                self.scheme.lean(n, change)
            span, cap, floor = ti.cast(report[self.SPAN], ti.f32), ti.cast(report[self.CAP], ti.f32), ti.cast(report[self.FLOOR], ti.f32)
            fixed, least, fastest, limit, last = report[self.FIXED] > 0.0, span, 0.0, 0.0, 0.0
            left, taken, unsolved, sound, begun = span, 0, 0, outside == 0, False
            while sound and (left > 1e-6 * span or not begun):
                bound, fast, steady = self.scheme.limit(n, g)
                limit, begun = bound, True
                sound = steady and limit >= floor
                if sound:
                    dt = cap if fixed else ti.min(limit, cap)
                    # Steps divide what is left of the frame.
                    dt = left / ti.max(ti.ceil(left / dt - 1e-4), 1.0)
                    unsolved += self.scheme.step(n, dt, g, report)
                    left -= dt
                    taken += ti.cast(dt > 0.0, ti.i32)
                    last, least, fastest = dt, ti.min(least, dt), ti.max(fastest, fast)
                    sound = (unsolved == 0 or floor == 0.0) and self.neighbours.count[None] < self.neighbours.other.shape[0]
            report[self.STEPS], report[self.STEP], report[self.SPEED] = ti.cast(taken, ti.f64), ti.cast(least, ti.f64), ti.cast(fastest, ti.f64)
            report[self.LAST], report[self.LIMIT] = ti.cast(last, ti.f64), ti.cast(limit, ti.f64)
            report[self.UNSOLVED], report[self.OUTSIDE] = ti.cast(unsolved, ti.f64), ti.cast(outside, ti.f64)
            report[self.FULL] = ti.cast(self.neighbours.count[None] >= self.neighbours.other.shape[0], ti.f64)
            self.sum_up(n, not sound, position, report)

    @ti.func
    def sum_up(self, n, broken, position: ti.template(), report: ti.template()):
        """Positions [support radii] in the order of the scene; energies per mass of a particle."""
        kinetic, height, squeeze, fast, dense, wrong = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), 0.0, 0.0, 0
        for i in range(n):
            x, u = self.x[i], self.v[i]
            place = 0.0
            for d in ti.static(range(self.dim)):
                position[self.id[i], d] = x[d]
                place -= ti.cast(report[self.GRAVITY + d], ti.f32) * x[d]
            speed2 = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
            kinetic += ti.cast(0.5 * speed2, ti.f64)
            height += ti.cast(place, ti.f64)
            fast = ti.max(fast, speed2)
            rho = u[3]
            if ti.static(self.structure.method == "dfsph"):
                rho = self.scheme.wall[i][3]
            else:
                # Of p = c^2 / gamma (rho^gamma - 1): the integral of p / rho^2 from rest, which is small beside its terms.
                r, gamma, c = ti.cast(rho, ti.f64), ti.cast(self.number[self.GAMMA], ti.f64), ti.cast(self.number[self.SOUND], ti.f64)
                gain = ti.log(r) if gamma == 1.0 else (ti.pow(r, gamma - 1.0) - 1.0) / (gamma - 1.0)
                squeeze += c * c / gamma * (gain + 1.0 / r - 1.0)
            dense = ti.max(dense, rho)
            wrong += ti.cast(not finite(x[0] + x[1] + x[2] + speed2 + rho) or rho <= 0.0, ti.i32)
        if ti.static(self.has_rigid):
            more, higher = self.rigid.energies(ti.Vector([ti.cast(report[self.GRAVITY + d], ti.f32) for d in ti.static(range(3))]))
            kinetic += more
            height += higher
            fast = ti.max(fast, self.rigid.fastest[0])
            for p in range(n, self.everything(n)):
                place = 0.0
                for d in ti.static(range(self.dim)):
                    position[self.id[p], d] = self.x[p][d]
                    place += self.x[p][d]
                wrong += ti.cast(not finite(place), ti.i32)
            wrong += ti.cast(not finite(ti.cast(kinetic, ti.f32)), ti.i32)
        report[self.KINETIC], report[self.POTENTIAL], report[self.ELASTIC], report[self.DENSEST] = kinetic, height, squeeze, ti.cast(dense, ti.f64)
        report[self.SPEED] = ti.max(report[self.SPEED], ti.cast(ti.sqrt(fast), ti.f64))
        report[self.BROKEN] = ti.cast(wrong + ti.cast(broken, ti.i32), ti.f64)

    @ti.kernel
    def load(self, data: ti.types.ndarray(ti.f32, 2), numbers: ti.types.ndarray(ti.f32, 2), table: ti.types.ndarray(ti.f32, 2),
             order: ti.types.ndarray(ti.i32, 2), bodies: ti.types.ndarray(ti.f64, 2)):  # fmt: skip
        """Positions and velocities [n, 2 dim], water first; numbers [4 + faces, NUMBERS]: ``number``; extent (lower, upper); cells and 1 / their
        widths; slides; of each particle the place in the scene and which sides are bare; bodies as ``sim.rigid.body_table`` writes them."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            for k in range(self.NUMBERS):
                self.number[k] = numbers[0, k]
            for d in ti.static(range(self.dim)):
                self.extent[0][d], self.extent[1][d] = numbers[1, d], numbers[2, d]
                self.neighbours.size[None][d], self.neighbours.edge[None][d] = ti.cast(numbers[3, d], ti.i32), numbers[3, 4 + d]
                self.neighbours.length[None][d] = numbers[2, d] - numbers[1, d]
                for f in range(self.faces):
                    self.slide[f][d] = numbers[4 + f, d]
            for k in range(ENTRIES + 2):
                for c in ti.static(range(7)):
                    self.table[k][c] = table[ti.min(k, ENTRIES), c]
            n = data.shape[0]
            for i in range(n):
                self.id[i] = order[i, 0]
                for f in ti.static(range(len(self.state))):
                    self.state[f][i] *= 0.0
                for d in ti.static(range(self.dim)):
                    self.x[i][d], self.v[i][d] = data[i, d], data[i, self.dim + d]
                # Far from anywhere: the list of pairs is stale.
                self.neighbours.listed_at[i] = ti.Vector([-10.0, 0.0, 0.0, 0.0])
                if ti.static(self.structure.method == "wcsph"):
                    self.v[i][3] = numbers[1, 4]
                if ti.static(self.has_rigid):
                    self.rigid.bare[i] = order[i, 1]
            self.neighbours.count[None] = 0
            if ti.static(self.has_rigid):
                self.rigid.load(bodies)
                self.rigid.members[None] = n - ti.cast(self.number[self.COUNT], ti.i32)
                if ti.static(self.structure.method == "wcsph"):
                    for b in range(self.rigid.count[None]):
                        self.rigid.force[b], self.rigid.torque[b] = ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3)
                        self.rigid.felt[b] = ti.Vector.zero(ti.f64, 3)

    @ti.kernel
    def load_solids(self, values: ti.types.ndarray(ti.f32, 2)):
        """[nodes, dim + 1] in the order of the indices."""
        for I in ti.grouped(self.solids):
            row = 0
            for d in ti.static(range(self.dim)):
                row = row * ti.static(self.solids.shape[d]) + I[d]
            for lane in ti.static(range(self.dim + 1)):
                self.solids[I][lane] = values[row, lane]

    @ti.kernel
    def restore(self, n: ti.i32):
        """What ``frame`` saved of n particles; of none, bodies' particles to where the bodies are."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            for i in range(n):
                for f in ti.static(range(len(self.state))):
                    self.state[f][i] = self.saved[f][i]
                self.id[i] = self.saved_id[i]
                self.neighbours.listed_at[i] = ti.Vector([-10.0, 0.0, 0.0, 0.0])
            self.neighbours.count[None] = 0
            if ti.static(self.has_rigid):
                for _back in range(ti.min(n, 1)):
                    self.rigid.keep(True)
                fastest = 0.0
                for b in range(self.rigid.count[None]):
                    fastest = ti.max(fastest, self.rigid.write(b))
                    self.rigid.begin[b + 1] = 0
                self.rigid.fastest[0] = ti.select(n > 0, self.rigid.fastest[1], fastest)


class SPHSimulator:
    """The solver under the ``Simulator`` contract; also driven directly by ``load`` and ``frame``.

    Overrides make the rungs of a solver ladder: ``cfl`` (Courant number; default the scene's), ``particles`` ("teacher": refined as the scene
    says; "recorded": the tracked set alone; a number: so many times finer), ``tolerance`` (factor on the errors at which DFSPH's solves end),
    ``stiffness`` (factor on the square of WCSPH's speed of sound), ``perturbation`` (length: random displacement of the start, for the chaos floor).

    A scene's ``time_step`` holds unless ``cfl`` is given. ``unguarded_step`` [s] is for ``sim.stability`` alone: a fixed step that nothing
    refuses or shortens, pressures that did not converge included, to see where the solver really becomes unstable.
    Raises ``InputError`` for overrides that cannot be.
    """

    def __init__(
        self,
        *,
        name: str = "sph",
        kind: Kind = "reference",
        cfl: float | None = None,
        particles: str | int = "teacher",
        tolerance: float = 1.0,
        stiffness: float = 1.0,
        perturbation: float = 0.0,
        unguarded_step: float | None = None,
    ):
        check_particles(name, particles)
        self.name, self.kind = name, kind
        self.settings: dict[str, Any] = {
            "cfl": cfl,
            "particles": particles,
            "tolerance": tolerance,
            "stiffness": stiffness,
            "perturbation": perturbation,
        }
        self.unguarded_step = unguarded_step
        self.compile_seconds = 0.0
        self._built: tuple | None = None

    # -- what a scene needs
    def _structure(self, scene: Scene) -> Structure:
        periodic = tuple(axis in scene.periodic for axis in "xyz"[: scene.dim])
        solver, viscous = scene.solver, self._water(scene).viscosity > 0
        shifting, xsph = getattr(solver, "shifting", False), getattr(solver, "xsph", 0) > 0
        lower, upper = np.array(scene.bounds).T
        water = len(scene.particles(1).position) * scene.spacing**scene.dim
        full = solver.method == "dfsph" and water > FULL * np.prod(upper - lower)
        no_slip = viscous and scene.walls.friction == "sticky"
        # Rounded up, so that scenes of a family share their kernels.
        bodies = [body for body in scene.bodies if scene.materials[body.material].model == "rigid"]
        faces = max((len(body.vertices) if body.vertices else 6 for body in bodies), default=0)
        rigid = (_power_of_two(len(bodies)), _power_of_two(faces)) if bodies else None
        if rigid and full:
            remedy = "with the water they fill the box: without a free surface DFSPH cannot hold its density around bodies; leave room or use wcsph"
            raise InputError(scene.name, "bodies", len(scene.bodies), remedy)
        return Structure(scene.dim, solver.method, periodic, no_slip, viscous, shifting, xsph, full, bool(scene.obstacles), rigid)

    def _refine(self, scene: Scene) -> int:
        return scene.refinement(self.settings["particles"])

    def _layout(self, scene: Scene) -> tuple[float, float, np.ndarray]:
        """Spacing and support radius [length], cells along each axis."""
        spacing = scene.spacing / self._refine(scene)
        support = spacing * _method(scene).support
        lower, upper = np.array(scene.bounds).T
        cells = np.maximum(np.floor((upper - lower) / support / (1 + SKIN)).astype(int), 1)
        for axis, count in zip("xyz", cells, strict=False):
            if axis in scene.periodic and count < FEWEST:
                remedy = f"the box is too narrow there for its particles: {FEWEST} kernels must fit; use more cells"
                raise InputError(scene.name, "periodic", axis, remedy)
        for index, obstacle in enumerate(scene.obstacles):
            thickness = getattr(obstacle, "thickness", np.inf)
            if thickness < support:
                remedy = f"thinner than the kernel's radius {support:.4g}: water on its two sides would interact; thicken it or use more cells"
                raise InputError(scene.name, f"obstacles[{index}].thickness", thickness, remedy)
        return spacing, support, cells

    def _numbers(self, scene: Scene) -> np.ndarray:
        """As ``_Kernels.load`` takes them."""
        spacing, support, cells = self._layout(scene)
        lower, upper = np.array(scene.bounds).T
        dim, water, solver, k = scene.dim, self._water(scene), _method(scene), _Kernels
        numbers = np.zeros((5 + 2 * dim, k.NUMBERS))
        row = numbers[0]
        d = spacing / support
        row[k.VOLUME], row[k.KERNEL], row[k.SPACING] = d**dim, constant(dim) * lattice_scale(dim, d), d
        row[k.CFL] = self.settings["cfl"] or scene.cfl
        row[k.VISCOSITY], row[k.THICKNESS] = water.viscosity / water.density / support**2, viscous_scale(dim, d)
        if isinstance(solver, Incompressible):
            row[k.DENSITY_ERROR], row[k.DIVERGENCE_ERROR] = (self.settings["tolerance"] * e for e in (solver.density_error, solver.divergence_error))
            row[k.ITERATIONS], row[k.XSPH], row[k.SHIFT] = solver.iterations, solver.xsph, lattice_shift(dim, d)
        else:
            row[k.SOUND] = _sound(water) * np.sqrt(self.settings["stiffness"]) / support
            # Its density is not a sum: only gradients use the kernel.
            row[k.KERNEL] *= lattice_slope(dim, d)
            row[k.GAMMA], row[k.ALPHA], row[k.DELTA] = water.gamma, solver.artificial_viscosity, solver.density_diffusion
        row[k.CORNER] = corner_share(dim, d)
        row[k.ROUGH], row[k.LIGHT] = NO_SLIP if scene.walls.friction == "sticky" else 0.0, self._lightness(scene)
        numbers[2, :dim], numbers[1, 4] = (upper - lower) / support, 1.0
        numbers[3, :dim], numbers[3, 4 : 4 + dim] = cells + 2, cells / ((upper - lower) / support)
        for face, velocity in scene.walls.velocity.items():
            numbers[4 + 2 * "xyz".index(face[0]) + "-+".index(face[1]), :dim] = np.array(velocity) / support
        return numbers

    def _water(self, scene: Scene) -> Water:
        return next(material for material in scene.materials.values() if isinstance(material, Water))

    def _water_first(self, scene: Scene, particles: Particles) -> tuple[np.ndarray, int]:
        """Order in which particles are stored, bodies after water, and how many are water's."""
        rigid = np.array([material.model == "rigid" for material in scene.materials.values()])[particles.material]
        return np.argsort(rigid, kind="stable"), int((~rigid).sum())

    def _lightness(self, scene: Scene) -> float:
        """Largest c dt [support radii] of WCSPH with such bodies in the water (``sim.sph.rigid.lightest``): half of Verlet's limit, 2 / w."""
        particles, (spacing, support, _) = scene.particles(self._refine(scene)), self._layout(scene)
        order, water = self._water_first(scene, particles)
        if scene.solver.method == "dfsph" or water == len(order):
            return 1e30
        bodies, d = order[water:], spacing / support
        densities = np.array([material.density for material in scene.materials.values()]) / self._water(scene).density
        layers = np.interp((np.arange(int(1 / d) + 1) + 0.5) * d, np.linspace(0, 1, ENTRIES + 1), wall_table(scene.dim, d)[:, SLOPE], right=0.0)
        square = lightest(particles.position[bodies] / support, particles.body[bodies], densities[particles.material[bodies]], d, (layers**2).sum())
        return float(1 / np.sqrt(square))

    def _sizes(self, scene: Scene, structure: Structure, particles: int, bodies: int) -> tuple[int, int, int, int, tuple[int, ...]]:
        """Room for particles, cells, pairs and pairs of bodies with water; nodes of the signed distance."""
        spacing, _, cells = self._layout(scene)
        capacity = _capacity(particles)
        reach = _method(scene).support * (1 + SKIN)
        around = ROOM * {2: np.pi, 3: 4 * np.pi / 3}[scene.dim] * reach**scene.dim / 2
        pairs, wet = int(around * capacity) + 4096, int(around * _capacity(bodies)) if bodies else 0
        lower, upper = np.array(scene.bounds).T
        nodes = tuple(int(np.ceil(length - 1e-6)) + 1 for length in (upper - lower) / spacing) if structure.obstacles else ()
        return capacity, int(np.prod(cells + 2)), pairs, wet, nodes

    def limits(self, scene: Scene, speed: float) -> dict[str, float]:
        """Bounds on the time step [s] at a speed of particles [m/s], by what sets them (h: half the support radius).

        WCSPH: cfl spacing / (c + |v|), h / (2 c), h^2 / (25 nu), sqrt(h / |g|) / 4 (Monaghan 1992). DFSPH: (|v| + sqrt(|g| H / 2)) dt + |g| dt^2 =
        cfl spacing, H: height of the highest body; walls that slide count as particles.
        """
        spacing, support, _ = self._layout(scene)
        tiny, gravity = np.finfo(float).tiny, float(np.linalg.norm(np.array(scene.gravity) - scene.acceleration(), axis=-1).max())
        way, water = (self.settings["cfl"] or scene.cfl) * spacing, self._water(scene)
        if scene.solver.method == "dfsph":
            pull = np.abs(np.array(scene.gravity) - scene.acceleration()).max(0)
            speed = max(speed, *(float(np.linalg.norm(velocity)) for velocity in scene.walls.velocity.values()), 0.0)
            speed += float(np.sqrt(max(pull @ np.subtract(*body.extent()[::-1]) for body in scene.bodies) / 2))
            return {"the Courant number": 2 * way / max(speed + np.sqrt(speed**2 + 4 * gravity * way), tiny)}
        sound = _sound(water) * np.sqrt(self.settings["stiffness"])
        return {
            "the Courant number": way / (sound + speed), "the speed of sound": LARGEST_COURANT * support / 2 / sound,
            "the viscosity": LARGEST_VISCOUS * (support / 2) ** 2 / max(water.viscosity / water.density, tiny),
            "gravity": 0.25 * np.sqrt(support / 2 / max(gravity, tiny)),
        }  # fmt: skip

    def _fixed(self, scene: Scene) -> float | None:
        """The fixed time step [s], None for an adaptive one."""
        return self.unguarded_step or (None if self.settings["cfl"] else scene.time_step)

    def _substeps(self, scene: Scene, speed: float) -> int:
        step = self._fixed(scene) or min(self.limits(scene, speed).values())
        return max(1, int(np.ceil(scene.frame_step / step - 1e-6)))

    def check_time_step(self, scene: Scene, where: object) -> None:
        """Refuse a fixed time step above the limit at the bodies' own speeds. Raises ``InputError``."""
        if scene.time_step is None or self.settings["cfl"]:
            return
        speed = max(float(np.linalg.norm(body.velocity)) for body in scene.bodies)
        limits = self.limits(scene, speed)
        what = min(limits, key=limits.__getitem__)
        if scene.time_step > limits[what] * (1 + 1e-6):
            steps = int(np.ceil(scene.frame_step / limits[what]))
            remedy = (
                f"above the limit {limits[what]:.4g} s, which {what} sets (cfl {scene.cfl:g}, speed {speed:.3g} m/s); use at most "
                f"{scene.frame_step / steps:.8g}, {steps} steps a frame, or leave it out: adaptive"
            )
            raise InputError(where, "time_step", scene.time_step, remedy)

    def plan(self, scene: Scene) -> dict:
        """What ``load`` would build for a scene, without building it; see ``MPMSimulator.plan``."""
        structure, (_, support, cells) = self._structure(scene), self._layout(scene)
        dim, method, particles = scene.dim, scene.solver.method, scene.particles(self._refine(scene))
        _, water = self._water_first(scene, particles)
        n, boxes, pairs, wet, nodes = self._sizes(scene, structure, len(particles.position), len(particles.position) - water)
        state = {"x": 16, "v": 16} | ({"pressure": 8} if method == "dfsph" else {"rate": 16, "rate before": 16})
        state |= {"crowd": 16, "shift and density rate before": 16} if structure.shifting else {}
        state |= {"density rate before": 4} if method == "wcsph" and not structure.shifting else {}
        fields = {name: (size, n) for name, size in state.items()} | {f"moved {name}": (size, n) for name, size in state.items()}
        fields |= {f"saved {name}": (size, n) for name, size in state.items()} | {f"{name}id": (4, n) for name in ("", "moved ", "saved ")}
        fields |= {
            "cell": (4, n),
            "sorted place": (4, n),
            "first pair": (4, n + 1),
            "place when listed": (16, n),
            "pairs": (4, pairs),
            "cell starts": (4, boxes + 2),
            "cell cursors": (4, boxes + 2),
            "numbers": (4, _Kernels.NUMBERS),
            "wall table": (28, ENTRIES + 2),
        }
        if method == "dfsph":
            fields |= {"pairs within reach": (4, pairs), "gradients": (16, pairs), "first within reach": (4, n + 1)}
            fields |= {name: (16, n) for name in ("sums", "wall", "crowd", "stretch", "push", "move")} | {"alpha": (8, n)}
            fields |= {name: (4, n) for name in ("active", "source", "pressure search")}
            fields |= {"slant": (16, n)} if structure.obstacles else {}
        if structure.viscous and method == "dfsph":
            fields |= {"drag": (4, pairs), "residual": (16, n), "search": (16, n), "image": (16, n)}
        fields |= {"rub": (16, n)} if structure.no_slip and method == "wcsph" else {}
        fields |= {"signed distance": (4 * (dim + 1), int(np.prod(nodes)))} if structure.obstacles else {}
        fields |= RigidBodies.fields(dim, *structure.rigid, n, wet, method == "wcsph", structure.viscous) if structure.rigid else {}
        context = scene.context_values()
        reasons = {
            "third dimension": "a 2D scene" if dim == 2 else None,
            "viscosity": None if structure.viscous else "inviscid water",
            "wall friction": None if structure.no_slip else "inviscid water" if scene.walls.friction == "sticky" else "slip walls",
            "signed distance": None if structure.obstacles else "no obstacles",
            "rigid bodies": None if structure.rigid else "none in the scene",
            "periodic images": None if any(structure.periodic) else "walls all around",
            "context": "no moving container, no varying parameter" if context is None else None,
            "equation of state": "incompressible" if method == "dfsph" else None,
            "pressure solves": "weakly compressible" if method == "wcsph" else None,
            "particle shifting": None if structure.shifting or method == "dfsph" else "shifting: false",
            "density solve": "no free surface" if structure.full else "weakly compressible" if method == "wcsph" else None,
            "grid": "particles meet in pairs",
        }
        gravity = float(np.linalg.norm(np.array(scene.gravity) - scene.acceleration(), axis=1).max())
        start = float(np.sqrt((particles.velocity**2).sum(1).max()))
        fall = float(np.sqrt(start**2 + 2 * gravity * np.linalg.norm(np.ptp(scene.bounds, axis=1))))
        return {
            "title": {"wcsph": "weakly compressible SPH", "dfsph": "divergence-free SPH"}[method],
            "dim": dim,
            "rates": [method],
            "materials": [material.model for material in scene.materials.values()],
            "walls": "sticky" if structure.no_slip else "slip",
            "obstacles": len(scene.obstacles),
            "context": 0 if context is None else context.shape[1],
            "kernels": ["load", "frame", "restore"] + ["load_solids"] * structure.obstacles,
            "fields": fields,
            "left_out": {what: why for what, why in reasons.items() if why},
            "bytes": sum(size * count for size, count in fields.values()),
            "particles": len(particles.position),
            "recorded": len(particles.tracked) + len(scene.boundary),
            "kinematic": len(scene.boundary),
            "cells": cells.tolist(),
            "grid_spacing": support * (1 + SKIN),
            "wave_speed": _sound(self._water(scene)) if method == "wcsph" else 0.0,
            "substeps_per_frame": [self._substeps(scene, speed + gravity * scene.frame_step) for speed in (0.0, fall)],
        }

    # -- state
    def load(self, scene: Scene) -> None:
        """Set the state of frame 0, compiling on first use. Raises ``InputError``, for a fixed time step above the limit at the start too."""
        begun = time.perf_counter()
        if self.unguarded_step is None:
            self.check_time_step(scene, scene.name)
        start_taichi()
        structure, (spacing, support, _) = self._structure(scene), self._layout(scene)
        particles = scene.particles(self._refine(scene))
        n, dim = particles.position.shape
        order, self._wet = self._water_first(scene, particles)
        sizes = self._sizes(scene, structure, n, n - self._wet)
        built = self._built
        fits = built and built[0] == structure and built[5] == sizes[4] and all(have >= need for have, need in zip(built[1:5], sizes, strict=False))
        if not fits:
            self._kernels = _Kernels(structure, *sizes)
            self._built = (structure, *sizes)
        self._scene, self._support, self._tracked = scene, support, particles.tracked
        self._boundary = scene.boundary.astype(np.float32)
        self._acceleration, self._frame = scene.acceleration(), 0
        self._mass = self._water(scene).density * spacing**dim
        self._position = np.zeros((n, dim), np.float32)
        position = particles.position
        if self.settings["perturbation"]:
            rng = np.random.default_rng(np.random.SeedSequence([scene.seed, 2]))
            noise = rng.uniform(-1, 1, position.shape)
            for index in np.unique(particles.body[order[self._wet :]]):
                noise[particles.body == index] = noise[particles.body == index][:1]
            position = position + noise * self.settings["perturbation"]
        lower, upper = np.array(scene.bounds).T
        self._lower = lower
        inside = np.clip((position - lower) / support, HAIR, (upper - lower) / support - HAIR)
        data = np.concatenate([inside, particles.velocity / support], 1).astype(np.float32)[order]
        numbers = self._numbers(scene)
        numbers[0, _Kernels.COUNT] = self._wet
        table = wall_table(dim, spacing / support)
        if scene.solver.method == "wcsph":
            table[:, [SLOPE, NORMAL, TANGENT, SPREAD]] *= lattice_slope(dim, spacing / support)
        sides, bodies = np.zeros(n, np.int32), np.zeros((1, 1))
        if structure.rigid:
            sorted_ = replace(particles, body=particles.body[order])
            bodies = body_table(scene, sorted_, data[:, :dim].astype(float), support, 0.0, structure.rigid[1], (spacing / support) ** 2 / 12)
            bodies[1:, 2] /= self._mass
            bodies[1:, 9:12] /= support
            bodies[1:, 12:21] /= self._mass
            mine = order[self._wet :]
            sides[self._wet :] = bare(particles.position[mine], particles.body[mine], spacing) @ (1 << np.arange(2 * dim))
        # Common terms are worth a quarter of DFSPH's speed in 3D too, but with bodies there their search takes 1.5 s.
        with compiling(dim if structure.rigid else 2):
            self._kernels.load(data, numbers.astype(np.float32), table.astype(np.float32), np.stack([order, sides], 1).astype(np.int32), bodies)
            self._kernels.restore(0)
            if structure.obstacles:
                nodes = np.stack(np.meshgrid(*[np.arange(count) for count in sizes[4]], indexing="ij"), -1).reshape(-1, dim)
                distance, normal, _ = combine(scene.surfaces, lower + nodes * spacing)
                self._kernels.load_solids(np.column_stack([normal, distance / support]).astype(np.float32))
            self._settle()
        if not fits:
            self.compile_seconds += time.perf_counter() - begun

    def _felt(self) -> np.ndarray:
        """Gravity as the box feels it in the current frame [length / s^2]."""
        return np.array(self._scene.gravity) - self._acceleration[min(self._frame, len(self._acceleration) - 1)]

    def _settle(self) -> None:
        """Forces, densities and diagnostics of a start."""
        self._pull = self._felt()
        self._run(0.0, 1.0, 0.0, keep=True)

    def _run(self, span: float, cap: float, floor: float, keep: bool) -> np.ndarray:
        """A frame of so many seconds, in steps of at most ``cap``, or of just that where it is fixed; given up where the limit is below ``floor``."""
        k, scene = _Kernels, self._scene
        report, felt = np.zeros(k.REPORT), self._felt()
        report[k.GRAVITY : k.GRAVITY + scene.dim], report[k.CHANGE : k.CHANGE + scene.dim] = felt / self._support, (felt - self._pull) / self._support
        report[k.SPAN], report[k.CAP], report[k.FLOOR], report[k.FIXED] = span, cap, floor, self._fixed(scene) is not None
        self._kernels.frame(int(keep), self._position, report)
        joule = self._mass * self._support**2
        self._diagnostics = {
            "kinetic_energy": report[k.KINETIC] * joule,
            "potential_energy": report[k.POTENTIAL] * joule,
            "max_speed": report[k.SPEED] * self._support,
            "substeps": report[k.STEPS],
            "dt": report[k.STEP],
            "density": report[k.DENSEST],
        }
        if scene.solver.method == "wcsph":
            self._diagnostics["elastic_energy"] = report[k.ELASTIC] * joule
        else:
            self._diagnostics |= {
                "iterations_divergence": report[k.SOLVED],
                "iterations_density": report[k.SOLVED + 1],
                "divergence_error": report[k.ERROR],
                "density_error": report[k.ERROR + 1],
                "unsolved": report[k.UNSOLVED],
            }
            if self._kernels.structure.viscous:
                self._diagnostics["iterations_viscosity"] = report[k.THICKENED]
        return report

    def frame(self) -> np.ndarray:
        """Advance one frame; positions of the recorded particles, kinematic ones last, [n, dim] float32. Raises ``SimulationError``.

        Each step obeys the limits as they are at its start. A frame with a step that was not sound is taken back and repeated with steps of
        at most half of that one, down to the floor of ``MAX_HALVINGS``; where the step is fixed, it ends the trajectory.
        """
        k, scene, fixed = _Kernels, self._scene, self._fixed(self._scene)
        felt = self._felt()
        speed = self._diagnostics["max_speed"] + float(np.linalg.norm(felt)) * scene.frame_step
        planned = scene.frame_step / self._substeps(scene, speed)
        cap, floor = planned, planned / 2**MAX_HALVINGS
        if fixed:
            floor = 0.0 if self.unguarded_step else fixed / GROWTH
        for attempt in range(1 if fixed else MAX_HALVINGS + 1):
            report = self._run(scene.frame_step, fixed or (cap if attempt else scene.frame_step), floor, keep=attempt == 0)
            if np.isfinite(report).all() and not report[k.BROKEN]:
                self._frame, self._pull = self._frame + 1, felt
                return self._recorded()
            self._kernels.restore(self._wet)
            short = not report[k.LIMIT] >= floor
            cap = (cap if short else min(cap, report[k.LAST])) / 2
            if report[k.OUTSIDE] or report[k.FULL] or cap < floor * (1 - 1e-6):
                break
        raise SimulationError(self._sick() or self._why(report, fixed, floor))

    def _sick(self) -> str | None:
        """What of the state no frame can begin with: the first that is not finite, or particles off the box. None if it is sound."""
        state = {name: values.reshape(len(values), -1) for name, values in self._carried().items()}
        for name, values in state.items():
            wrong = np.flatnonzero(~np.isfinite(values).all(1))
            if len(wrong):
                return f"{name} of particle {wrong[0]} is not finite" + (f", nor of {len(wrong) - 1} others" if len(wrong) > 1 else "")
        hair = 2 * HAIR * self._support
        lower, upper = np.array(self._scene.bounds).T
        away = np.flatnonzero(((state["position"] < lower - hair) | (state["position"] > upper + hair)).any(1))
        return f"particle {away[0]} is off the box, at {state['position'][away[0]].round(3).tolist()}" if len(away) else None

    def _why(self, report: np.ndarray, fixed: float | None, floor: float) -> str:
        """Why a frame from a sound state was given up."""
        k, scene = _Kernels, self._scene
        speed = report[k.SPEED] * self._support
        if report[k.FULL]:
            return f"particles have gathered: they make more pairs than there is room for, {ROOM:g} times those of water at rest"
        if report[k.UNSOLVED] and not self.unguarded_step:
            what = ", ".join(f"{what} {report[k.ERROR + which]:.2g}" for which, what in enumerate(("divergence", "density")))
            what = f"viscosity did not converge in {{}} iterations ({report[k.VISCOUS]:.2g})" if report[k.VISCOUS] > VISCOUS_ERROR else (
                f"pressures did not converge in {{}} iterations ({what})")  # fmt: skip
            return f"{what.format(getattr(scene.solver, 'iterations', None))}, at a step of {report[k.LAST]:.3g} s"
        if fixed and report[k.LIMIT] < floor:
            return f"the fixed time step {fixed:.3g} s is far above the limit {report[k.LIMIT]:.3g} s at a speed of {speed:.3g} m/s"
        if fixed:
            return f"the fixed time step {fixed:.3g} s gave no finite, stable frame"
        return f"time step fell below {floor:.3g} s without a finite, stable frame, at a speed of {speed:.3g} m/s"

    def _recorded(self) -> np.ndarray:
        moving = (self._lower + self._position[self._tracked].astype(float) * self._support).astype(np.float32)
        return np.concatenate([moving, self._boundary])

    def diagnostics(self) -> dict[str, float]:
        """Of the current frame: energies [J, per unit depth in 2D; elastic: WCSPH], max speed [m/s], substeps, shortest step dt [s], largest density
        over that at rest; DFSPH: iterations of both solves, their largest mean errors, how many solves did not converge."""
        return dict(self._diagnostics)

    def _carried(self) -> dict[str, np.ndarray]:
        """What goes from step to step, as in ``state``."""
        kernels, n, dim, h = self._kernels, *self._position.shape, self._support
        order, v = np.argsort(kernels.id.to_numpy()[:n]), kernels.v.to_numpy()[:n].astype(float)
        for b in range(kernels.rigid.count[None] if kernels.rigid else 0):
            v[slice(*kernels.rigid.span.to_numpy()[b]), :3] = kernels.rigid.velocities(b)
        x, v = kernels.x.to_numpy()[:n][order].astype(float), v[order]
        found = {"position": self._lower + x[:, :dim] * h, "velocity": v[:, :dim] * h}
        return found | ({"density": v[:, 3]} if self._scene.solver.method == "wcsph" else {})

    def state(self) -> dict[str, np.ndarray]:
        """All simulated particles in the order of the scene, float64: ``position`` [length], ``velocity`` [length / s], [n, dim] each, ``density``
        over that at rest, ``pressure`` [Pa], [n] each."""
        kernels, n, water, h = self._kernels, len(self._position), self._water(self._scene), self._support
        order, found = np.argsort(kernels.id.to_numpy()[:n]), self._carried()
        if self._scene.solver.method == "wcsph":
            found["pressure"] = water.density * kernels.x.to_numpy()[:n, 3][order].astype(float) * found["density"] ** 2 * h**2
        else:
            found["density"] = kernels.scheme.wall.to_numpy()[:n, 3][order].astype(float)
            k = kernels.scheme.pressure.to_numpy()[:n][order].astype(float)
            # A kernel finds less than all of a gradient: the share of the divergence of position that it finds.
            spread = kernels.scheme.crowd.to_numpy()[:n, 3][order] / self._scene.dim
            found["pressure"] = k[:, 0] * np.maximum(spread, INSIDE) * water.density * h**2
        order, wet = self._water_first(self._scene, self._scene.particles(self._refine(self._scene)))
        found["density"][order[wet:]] = found["pressure"][order[wet:]] = np.nan
        return found

    def inject(self, name: str, particle: int | np.ndarray, value) -> None:
        """Overwrite ``position``, ``velocity`` or (WCSPH) ``density`` of a particle, or of several, as ``state`` gives them. For studies of what
        happens then."""
        kernels, h = self._kernels, self._support
        field, lanes, content = {
            "position": (kernels.x, slice(self._scene.dim), (value - self._lower) / h),
            "velocity": (kernels.v, slice(self._scene.dim), np.divide(value, h)), "density": (kernels.v, 3, value),
        }[name]  # fmt: skip
        whole = field.to_numpy()
        whole[np.flatnonzero(np.isin(kernels.id.to_numpy()[: len(self._position)], particle)), lanes] = content
        field.from_numpy(whole)

    def set_velocity(self, velocity: np.ndarray) -> None:
        """Replace the velocities [n, dim] of all particles; a body takes their momenta. For starts that no scene describes."""
        kernels, (n, dim) = self._kernels, velocity.shape
        values = kernels.v.to_numpy()
        values[:n, :dim] = (velocity / self._support)[kernels.id.to_numpy()[:n]]
        kernels.v.from_numpy(values)
        if kernels.rigid:
            kernels.rigid.set_velocity(values[:, :3].astype(float))
        self._settle()

    # -- the Simulator contract
    def begin(self, start: Start) -> None:
        """Run the known frames from the scene's own start, so that the solver stands where the history ends."""
        self.load(Scene.of(start))
        for _ in range(start.present):
            self.frame()

    def advance(self) -> np.ndarray:
        """The next frame, [1, particles, dim]."""
        return self.frame()[None]
