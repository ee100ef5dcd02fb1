"""Position-based fluid (Macklin & Muller 2013) and rigid bodies (``sim.pbd.rigid``) in 2D and 3D, under the ``Simulator`` contract.

A step moves particles as they would fly; displacements then end what is compressed. With V = spacing^dim and the kernel of ``sim.sph.kernel``,
each particle, of water or of a body, is held to

    C_i = sum_j V W_ij + the walls' share - 1 <= 0                                  (eq. 1; the inequality: Bender's PositionBasedDynamics)
    k_i <- max(0, y_i + a C_i / D_i),  D_i = w_i |G_i|^2 + sum_j w_j |G_ij|^2       (eq. 11)
    y_i <- max(0, k_i + b (k_i - k_i before)),  b by Nesterov's rule                (accelerated projected gradient: Mazhar et al. 2015)
    x_i -= w_i (sum_j (dy_i + dy_j) G_ij + dy_i (walls' part)),  w = rho0 / rho     (eq. 12)

with neighbours and gradients G_ij = V grad W_ij, G_i = sum_j G_ij + the walls' part, anew in each iteration. Bodies take the rigid motion
nearest to their particles' displacements. Velocities change by the displacements over dt and share a little of their neighbours' mean (XSPH, eq.
17). Once a step s_corr (eq. 13) parts pairs that are closer than the spacing.

Decisions, with what PositionBasedDynamics, FleX (Macklin et al. 2014) and our DFSPH do in view:
- The multipliers k are *summed up* and never negative, as in XPBD (Macklin et al. 2016) and in contact solvers, where the paper starts each iteration
  from none: what one iteration pushed too far the next takes back, so that they converge to incompressible water. A fixed number of iterations
  (FleX: 4) leaves a spring as stiff as the number. These end when the mean residual (|C| under pressure, else C where positive) is below
  ``density_error``. A solve that does not get there ends the trajectory: shorter steps would be no remedy, for what is left of C becomes a velocity
  C spacing / dt.
- Momentum (Nesterov 1983; started anew where it leads uphill: O'Donoghue & Candes 2015) costs a sum over particles, keeps k >= 0 and asks for nothing
  linear: contacts of bodies, walls and gradients are as they are. a is ``lattice_relaxation``. Without momentum, as it was here, an iteration tells
  a particle's neighbours alone: with errors of 1e-3 a pool 32 layers deep took 32 of them a step, one of 64 layers did not end in 1000, BOXBATH took
  8; now 13, 28 and 6, or 19, 41 and 8 with 5e-4, which leave less energy to what was not solved: in the first frames, when a deep pool's lattice
  gives way, 0.3 % of it in place of 1 %. Others, measured with the gradients of such pools frozen: Chebyshev's semi-iteration (Wang 2015) takes 0.6
  to 1.3 times as many, by how its spectral radius is guessed; projected conjugate gradients (MPRGP: Dostal & Schoberl 2005) 0.7 to 2.5 times;
  conjugate gradients without the inequality, as in our DFSPH, a third to two thirds, but what they find is off by up to the tolerance again once it
  is clipped at k >= 0. Momentum from the first iteration on would save a quarter, and energies grow.
- Inequality: a bilateral C pulls what is at the surface together, into clumps that s_corr must then part. Ours is a refinement: it leaves the lattice
  alone (a block that falls freely must not expand), scales with dt^2, and evens out the spacing (``PositionBased.tensile``).
- Particles of a body are fluid that is frozen: the same V, k of their own. So the body displaces its volume, pressure passes its faces as it passes
  through water, and bodies meet each other by the same constraint. FleX has contacts there, and a buoyancy that users found hard to tune.
- Velocities are those of half a step before: the first kick of gravity is half of one. Free fall is then the parabola itself at frames, instead
  of one that is g dt t / 2 off.
- No vorticity confinement: it adds energy that nothing measures.

Known: a column at rest settles, but not because water packs more closely than the cubic lattice of its start: in periodic boxes squeezed by 0.25 to 3
% no arrangement with all C_i <= 0 was found, from lattices or at random, in 2D and 3D, and as W's Fourier transform is positive none can be denser
than 1 / ``lattice_scale`` (3D: 1.034, for a support of three spacings 1.003). It settles at its edges, which is of the method: a smooth wall takes
0.05 spacings of water, floor and surface together 0.1. So columns of 8 x 16 x 8 spacings lose 3 % of their height, of 24 x 16 x 24 1.6 %, of 32 x 16
in 2D 0.9 %, of 64 x 32 0.5 %. The water keeps off a body a little further than off itself, so that the 4^3 cube of BOXBATH floats up to 0.12 spacings
too high (density 300), and one of up to 1.2 times water's density comes to rest on the last two layers above the floor. k is no measure of pressure:
it balances weights exactly, but through gradients of water that packs unevenly, and was 1.2 to 1.5 times rho g h. Particles that start on each other
are thrown apart.

One kernel a frame on one thread, as in ``sim.sph.solver``; lengths in support radii, four lanes whatever the dimension.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim.errors import InputError
from sim.mpm.decomposition import finite
from sim.pbd.rigid import COLUMNS, Bodies, body_table
from sim.scene import PositionBased, Scene, check_particles
from sim.simulator import Kind, SimulationError, Start
from sim.sph.kernel import ENTRIES, constant, kernel, lattice_relaxation, lattice_scale, wall_table
from sim.sph.neighbours import ROOM, SKIN, Neighbours
from sim.sph.walls import HAIR, Walls
from sim.taichi_runtime import compiling, start_taichi, ti

#: Least D_i: of particles on top of each other gradients vanish, and displacements by 1 / gradient would throw them about (eq. 11 adds a constant).
LEAST_D = 0.05
#: Share of the multipliers of the step before that a solve starts from (as Bender & Koschier 2017). 0: 1.7 times the iterations; 0.8: three times
#: the kinetic energy of a column at rest; 1: two hundred times.
WARM = 0.5
#: Largest W / W(spacing) that s_corr raises to the fourth power: of particles on top of each other it would be 800.
MOST_RATIO = 2.0
#: Steps of a frame at most.
MOST_STEPS = 10_000


@dataclass(frozen=True)
class Structure:
    """What is compiled in. bodies: at most so many."""

    dim: int
    bodies: int
    xsph: bool
    tensile: bool


def _capacity(particles: int) -> int:
    """Particles that fields are made for: few different numbers, for each compiles anew."""
    return 1 << max(int(particles) - 1, 63).bit_length()


def _method(scene: Scene) -> PositionBased:
    assert isinstance(scene.solver, PositionBased)
    return scene.solver


@ti.data_oriented
class _Kernels(Walls):
    """Fields and compiled code for one ``Structure``."""

    #: Places in ``number``.
    COUNT, VOLUME, KERNEL, SPACING, CFL, ERROR_AT_MOST, ITERATIONS, XSPH, TENSILE, NEAREST, RELAXATION, NUMBERS = range(12)
    #: Places in a frame's report; gravity, that of the frame before, the frame's length, the longest step and that before the frame are read from it.
    (STEPS, STEP, SPEED, SOLVED, ERROR, UNSOLVED, KINETIC, POTENTIAL, DENSEST, BROKEN, FULL, LISTED, LAST, SPAN, CAP, GRAVITY, BEFORE, REPORT) = (
        *range(16), 18, 21)  # fmt: skip

    def __init__(self, structure: Structure, capacity: int, cells: int, pairs: int):
        super().__init__(structure.dim, (False,) * structure.dim)
        self.structure, self.capacity = structure, capacity
        self.number = ti.field(ti.f32, self.NUMBERS)
        self.x, self.v = (ti.Vector.field(4, ti.f32, capacity) for _ in range(2))  # x[3]: k; v[3]: w
        self.shift = ti.Vector.field(4, ti.f32, capacity)  # displacement in the step, of bodies' particles in an iteration; lane 3: y
        self.id, self.body = (ti.field(ti.i32, capacity) for _ in range(2))  # body -1: water
        self.state, self.labels = [self.x, self.v, self.shift], [self.id, self.body]
        self.moved = [ti.Vector.field(4, ti.f32, capacity) for _ in range(3)]
        self.moved_labels = [ti.field(ti.i32, capacity) for _ in range(2)]
        self.gradient = ti.Vector.field(4, ti.f32, pairs)  # G_ij; lane 3: V W
        self.sums = ti.Vector.field(4, ti.f32, capacity)  # sum_j G_ij; lane 3: sum_j w_j |G_ij|^2, then dk
        self.wall = ti.Vector.field(4, ti.f32, capacity)  # the walls' part of G_i; lane 3: density
        self.drift = ti.Vector.field(4, ti.f32, capacity)  # a change of x or v
        self.neighbours = Neighbours(self.dim, capacity, cells, pairs, self.periodic)
        if structure.bodies:
            self.slot = ti.field(ti.i32, capacity)
            self.bodies = Bodies(self, structure.bodies, capacity)

    # -- walls
    @ti.func
    def enclose(self, i):
        """Keep a particle inside the walls, as a displacement."""
        for d in ti.static(range(self.dim)):
            x = self.x[i][d]
            inside = ti.min(ti.max(x, self.extent[0][d] + HAIR), self.extent[1][d] - HAIR)
            if finite(x) and x != inside:
                self.x[i][d] = inside
                self.shift[i][d] += inside - x

    # -- pairs
    @ti.func
    def list_pairs(self, n, report: ti.template()):
        if self.neighbours.stale(self.x, n):
            self.neighbours.sort(self.x, n)
            for i in range(n):
                k = self.neighbours.to[i]
                for f in ti.static(range(3)):
                    self.moved[f][k] = self.state[f][i]
                for f in ti.static(range(2)):
                    self.moved_labels[f][k] = self.labels[f][i]
            for i in range(n):
                for f in ti.static(range(3)):
                    self.state[f][i] = self.moved[f][i]
                for f in ti.static(range(2)):
                    self.labels[f][i] = self.moved_labels[f][i]
            self.find_slots(n)
            self.neighbours.pair(self.x, n)
            report[self.LISTED] += 1.0

    @ti.func
    def find_slots(self, n):
        if ti.static(self.structure.bodies > 0):
            for i in range(n):
                self.slot[self.id[i]] = i

    # -- the constraint
    @ti.func
    def gather(self, n):
        """Densities, gradients of the pairs, D_i."""
        V, K = self.number[self.VOLUME], self.number[self.KERNEL]
        for i in range(n):
            self.sums[i] = ti.Vector.zero(ti.f32, 4)
            part = self.walls(self.x[i])
            part[3] += V * K
            self.wall[i] = part
        for i in range(n):
            xi, wi = self.x[i], self.v[i][3]
            S, rho = ti.Vector.zero(ti.f32, 4), 0.0
            for k in range(self.neighbours.first[i], self.neighbours.first[i + 1]):
                j = self.neighbours.other[k]
                r = xi - self.x[j]
                r[3] = 0.0
                t = 1.0 - ti.sqrt(ti.min(r.norm_sqr(), 1.0))
                t3 = t * t * t
                scale = -20.0 * K * V * t3
                if ti.static(self.structure.bodies > 0):
                    # What pushes within a body moves nothing.
                    scale = ti.select(self.body[i] >= 0 and self.body[i] == self.body[j], 0.0, scale)
                G = scale * r
                w = V * K * t3 * t * (5.0 - 4.0 * t)
                s = G.norm_sqr()
                H, back = G, -G
                H[3] = w
                self.gradient[k] = H
                G[3], back[3] = self.v[j][3] * s, wi * s
                S += G
                rho += w
                self.sums[j] += back
                self.wall[j][3] += w
            self.sums[i] += S
            self.wall[i][3] += rho
        for i in range(n):
            G = self.sums[i] + self.wall[i]
            D = self.v[i][3] * (G[0] * G[0] + G[1] * G[1] + G[2] * G[2]) + self.sums[i][3]
            self.sums[i][3] = ti.max(D, LEAST_D)

    @ti.func
    def multiply(self, n, age):
        """dy of an iteration into ``sums``; y and k changed. Returns the mean residual and the momentum's age, which is 0 at the start: dy is then y,
        from the step before."""
        error, uphill, beta, older = 0.0, ti.cast(0.0, ti.f64), 0.0, 1.0
        for i in range(n):
            C, D, y = self.wall[i][3] - 1.0, self.sums[i][3], self.shift[i][3]
            error += ti.select(y > 0.0, ti.abs(C), ti.max(C, 0.0))
            k = ti.max(y + self.number[self.RELAXATION] * C / D, 0.0)
            uphill += ti.cast(D * (y - k) * (k - self.x[i][3]), ti.f64)
            self.sums[i][3] = k
        if age > 0.0 and uphill <= 0.0:
            older = 0.5 * (1.0 + ti.sqrt(1.0 + 4.0 * age * age))
            beta = (age - 1.0) / older
        for i in range(n):
            k, y = self.sums[i][3], self.shift[i][3]
            ahead = ti.max(k + beta * (k - self.x[i][3]), 0.0)
            self.sums[i][3] = ti.select(age > 0.0, ahead - y, y)
            self.x[i][3] = ti.select(age > 0.0, k, y)
            self.shift[i][3] = ti.select(age > 0.0, ahead, y)
        return error / ti.cast(n, ti.f32), older

    @ti.func
    def push(self, n):
        """``drift`` = sum_j dy_j grad_i C_j."""
        for i in range(n):
            self.drift[i] = self.sums[i][3] * self.wall[i]
        for i in range(n):
            ki, total = self.sums[i][3], ti.Vector.zero(ti.f32, 4)
            for k in range(self.neighbours.first[i], self.neighbours.first[i + 1]):
                j = self.neighbours.other[k]
                f = (ki + self.sums[j][3]) * self.gradient[k]
                total += f
                self.drift[j] -= f
            self.drift[i] += total

    @ti.func
    def part(self, n, dt):
        """``drift`` of s_corr (eq. 13): what is closer than on the lattice is pushed apart. Once a step, as an acceleration."""
        near, strength = self.number[self.NEAREST], dt * dt * self.number[self.TENSILE]
        for i in range(n):
            self.drift[i] = ti.Vector.zero(ti.f32, 4)
        for i in range(n):
            total, D = ti.Vector.zero(ti.f32, 4), self.sums[i][3]
            for k in range(self.neighbours.first[i], self.neighbours.first[i + 1]):
                j = self.neighbours.other[k]
                G = self.gradient[k]
                q = ti.min(G[3] / near, MOST_RATIO)
                q *= q
                f = (strength * ti.max(q * q - 1.0, 0.0) / ti.max(D, self.sums[j][3])) * G
                total += f
                self.drift[j] -= f
            self.drift[i] += total

    @ti.func
    def displace(self, n):
        """x -= w drift; bodies as a whole; all off the walls."""
        for i in range(n):
            for d in ti.static(range(self.dim)):
                move = self.v[i][3] * self.drift[i][d]
                # Summed up by itself: as a difference of places it would be rounded like them, and momentum with it.
                self.shift[i][d] -= move
                self.x[i][d] -= move
            if self.body[i] < 0:
                self.enclose(i)
        if ti.static(self.structure.bodies > 0):
            for b in range(self.bodies.count[None]):
                self.bodies.match(b)

    @ti.func
    def smooth(self, n):
        """XSPH (eq. 17) between particles of water, in equal and opposite parts."""
        for i in range(n):
            self.drift[i] = ti.Vector.zero(ti.f32, 4)
        for i in range(n):
            vi, total = self.v[i], ti.Vector.zero(ti.f32, 4)
            for k in range(self.neighbours.first[i], self.neighbours.first[i + 1]):
                j = self.neighbours.other[k]
                share = self.number[self.XSPH] * self.gradient[k][3]
                if ti.static(self.structure.bodies > 0):
                    share = ti.select(self.body[i] >= 0 or self.body[j] >= 0, 0.0, share)
                f = share * (self.v[j] - vi)
                total += f
                self.drift[j] -= f
            self.drift[i] += total
        for i in range(n):
            for d in ti.static(range(self.dim)):
                self.v[i][d] += self.drift[i][d]

    # -- steps
    @ti.func
    def limit(self, n, g):
        """Largest step: a share of a spacing by the speed that gravity leaves; and the largest speed."""
        fast = 0.0
        for i in range(n):
            u = self.v[i]
            u[3] = 0.0
            fast = ti.max(fast, u.norm_sqr())
        fast = ti.sqrt(fast)
        way, pull = self.number[self.CFL] * self.number[self.SPACING], g.norm()
        # fast dt + pull dt^2 = way.
        return 2.0 * way / ti.max(fast + ti.sqrt(fast * fast + 4.0 * pull * way), 1e-12), fast

    @ti.func
    def moisten(self, n):
        """drift[3] of a body's particles: sum of k V W over those of water near it."""
        for i in range(n):
            self.drift[i][3] = 0.0
        for i in range(n):
            for k in range(self.neighbours.first[i], self.neighbours.first[i + 1]):
                j = self.neighbours.other[k]
                if self.body[i] >= 0 and self.body[j] < 0:
                    self.drift[i][3] += self.shift[j][3] * self.gradient[k][3]
                if self.body[j] >= 0 and self.body[i] < 0:
                    self.drift[j][3] += self.shift[i][3] * self.gradient[k][3]

    @ti.func
    def step(self, n, dt, last, g, before, report: ti.template()):
        """``last``, ``before``: length of the step before, 0 at the start, and gravity in it."""
        kick, ratio = 0.5 * (last * before + dt * g), ti.select(last > 0.0, dt / ti.max(last, 1e-12), 0.0)
        if ti.static(self.structure.bodies > 0):
            self.moisten(n)
            pull = ti.select(last > 0.0, dt / ti.max(last * last, 1e-12), 0.0)
            for b in range(self.bodies.count[None]):
                for f in range(2 * self.dim):
                    self.bodies.lubricate(b, f, self.drift, pull)
        for i in range(n):
            # Multipliers are impulses times dt.
            self.shift[i] = ti.Vector([0.0, 0.0, 0.0, WARM * ratio * ratio * self.shift[i][3]])
            if self.body[i] < 0:
                self.v[i] += kick
                move = dt * self.v[i]
                move[3] = 0.0
                self.x[i] += move
                self.enclose(i)
        if ti.static(self.structure.bodies > 0):
            for b in range(self.bodies.count[None]):
                self.bodies.fly(b, ti.cast(dt, ti.f64), ti.cast(ti.Vector([kick[0], kick[1], kick[2]]), ti.f64))
        tolerance, most = self.number[self.ERROR_AT_MOST], ti.cast(self.number[self.ITERATIONS], ti.i32)
        # Stages of one loop, as copies of the functions would each cost a second of compilation: s_corr, the multipliers of the step before, solve.
        stage, iterations, error, age = ti.static(0 if self.structure.tensile else 1), 0, 1e30, 0.0
        while error > tolerance and iterations <= most and self.neighbours.count[None] < self.neighbours.other.shape[0]:
            self.list_pairs(n, report)
            self.gather(n)
            if stage == 0:
                if ti.static(self.structure.tensile):
                    self.part(n, dt)
            else:
                left, age = self.multiply(n, age)
                if stage == 2:
                    error = left
                    iterations += 1
                self.push(n)
            if error > tolerance:
                self.displace(n)
            stage = ti.min(stage + 1, 2)
        report[self.SOLVED] += ti.cast(iterations, ti.f64)
        # Not a maximum, which loses NaN.
        report[self.ERROR] = ti.select(error <= report[self.ERROR], report[self.ERROR], ti.cast(error, ti.f64))
        report[self.UNSOLVED] += ti.cast(not error <= tolerance, ti.f64)
        for i in range(n):
            # The last iteration only looked.
            self.shift[i][3] -= self.sums[i][3]
            if self.body[i] < 0:
                for d in ti.static(range(self.dim)):
                    self.v[i][d] += self.shift[i][d] / dt
        if ti.static(self.structure.xsph):
            self.smooth(n)
        for i in range(n):
            if self.body[i] < 0:
                for d in ti.static(range(self.dim)):
                    # What came to a wall in this step has the velocity of its way there.
                    if self.x[i][d] < self.extent[0][d] + ti.static(1.01 * HAIR):
                        self.v[i][d] = ti.max(self.v[i][d], 0.0)
                    if self.x[i][d] > self.extent[1][d] - ti.static(1.01 * HAIR):
                        self.v[i][d] = ti.min(self.v[i][d], 0.0)
        if ti.static(self.structure.bodies > 0):
            for b in range(self.bodies.count[None]):
                self.bodies.conclude(b, ti.cast(dt, ti.f64))

    # -- kernels
    @ti.kernel
    def frame(self, steps: ti.i32, position: ti.types.ndarray(ti.f32, 2), report: ti.types.ndarray(ti.f64, 1)):
        """One frame of at most so many steps."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            n = ti.cast(self.number[self.COUNT], ti.i32)
            g, before = ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4)
            for d in ti.static(range(self.dim)):
                g[d], before[d] = ti.cast(report[self.GRAVITY + d], ti.f32), ti.cast(report[self.BEFORE + d], ti.f32)
            span, cap, last = ti.cast(report[self.SPAN], ti.f32), ti.cast(report[self.CAP], ti.f32), ti.cast(report[self.LAST], ti.f32)
            left, taken = span, 0
            while left > 1e-6 * span and taken < steps and self.neighbours.count[None] < self.neighbours.other.shape[0]:
                limit, fast = self.limit(n, g)
                dt = ti.min(limit, cap)
                # Steps divide what is left of the frame.
                dt = left / ti.max(ti.ceil(left / dt - 1e-4), 1.0)
                self.step(n, dt, last, g, before, report)
                left -= dt
                taken += 1
                last, before = dt, g
                report[self.STEP] = ti.min(report[self.STEP], ti.cast(dt, ti.f64))
                report[self.SPEED] = ti.max(report[self.SPEED], ti.cast(fast, ti.f64))
            if taken == 0:
                self.list_pairs(n, report)
                self.gather(n)
            report[self.STEPS], report[self.LAST] = ti.cast(taken, ti.f64), ti.cast(last, ti.f64)
            report[self.BROKEN] += ti.cast(left > 1e-6 * span, ti.f64)
            report[self.FULL] = ti.cast(self.neighbours.count[None] >= self.neighbours.other.shape[0], ti.f64)
            self.sum_up(n, position, report)

    @ti.func
    def sum_up(self, n, position: ti.template(), report: ti.template()):
        """Positions [support radii] in the order of the scene; energies per mass of a particle of water."""
        kinetic, height, fast, dense, broken = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), 0.0, 0.0, 0
        for i in range(n):
            x, u, place = self.x[i], self.v[i], 0.0
            for d in ti.static(range(self.dim)):
                position[self.id[i], d] = x[d]
                place -= ti.cast(report[self.GRAVITY + d], ti.f32) * x[d]
            speed2 = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
            kinetic += ti.cast(0.5 * speed2 / u[3], ti.f64)
            height += ti.cast(place / u[3], ti.f64)
            fast, dense = ti.max(fast, speed2), ti.max(dense, self.wall[i][3])
            broken += ti.cast(not finite(x[0] + x[1] + x[2] + speed2 + self.wall[i][3]), ti.i32)
        report[self.KINETIC], report[self.POTENTIAL], report[self.DENSEST] = kinetic, height, ti.cast(dense, ti.f64)
        report[self.SPEED] = ti.max(report[self.SPEED], ti.cast(ti.sqrt(fast), ti.f64))
        report[self.BROKEN] += ti.cast(broken, ti.f64)

    @ti.kernel
    def load(self, data: ti.types.ndarray(ti.f32, 2), labels: ti.types.ndarray(ti.i32, 1), numbers: ti.types.ndarray(ti.f32, 2),
             table: ti.types.ndarray(ti.f32, 2), bodies: ti.types.ndarray(ti.f64, 2), places: ti.types.ndarray(ti.f64, 2)):  # fmt: skip
        """Positions, velocities and w [n, 2 dim + 1]; bodies [n]; numbers [4, 12]: ``number``; extent (lower, upper); cells and 1 / their widths."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            for k in range(self.NUMBERS):
                self.number[k] = numbers[0, k]
            for d in ti.static(range(self.dim)):
                self.extent[0][d], self.extent[1][d] = numbers[1, d], numbers[2, d]
                self.neighbours.size[None][d], self.neighbours.edge[None][d] = ti.cast(numbers[3, d], ti.i32), numbers[3, 4 + d]
                self.neighbours.length[None][d] = numbers[2, d] - numbers[1, d]
            for k in range(ENTRIES + 2):
                for c in ti.static(range(6)):
                    self.table[k][c] = table[ti.min(k, ENTRIES), c]
            n = data.shape[0]
            for i in range(n):
                self.id[i], self.body[i] = i, labels[i]
                for f in ti.static(range(3)):
                    self.state[f][i] = ti.Vector.zero(ti.f32, 4)
                for d in ti.static(range(self.dim)):
                    self.x[i][d], self.v[i][d] = data[i, d], data[i, self.dim + d]
                self.v[i][3] = data[i, 2 * self.dim]
            self.forget(n)
            if ti.static(self.structure.bodies > 0):
                self.bodies.count[None] = bodies.shape[0]
                for i in range(n):
                    self.bodies.rest[i] = ti.Vector([places[i, 0], places[i, 1], places[i, 2]])
                    self.bodies.corner[i], self.bodies.own[i] = ti.cast(places[i, 3], ti.i32), ti.cast(places[i, 4], ti.f32)
                for b in range(bodies.shape[0]):
                    self.bodies.span[b] = ti.Vector([ti.cast(bodies[b, 0], ti.i32), ti.cast(bodies[b, 1], ti.i32)])
                    self.bodies.centre[b] = ti.Vector([bodies[b, 2], bodies[b, 3], bodies[b, 4]])
                    inertia = ti.Matrix([[bodies[b, 5 + 3 * row + column] for column in range(3)] for row in range(3)])
                    self.bodies.inertia[b], self.bodies.inverse[b] = inertia, inertia.inverse()
                    self.bodies.turn[b] = ti.Vector([1.0, 0.0, 0.0, 0.0])
                    self.bodies.take_velocity(b)

    @ti.func
    def forget(self, n):
        """The list of pairs is stale: it was made far from anywhere."""
        for i in range(n):
            self.neighbours.listed_at[i] = ti.Vector([-10.0, 0.0, 0.0, 0.0])
        self.neighbours.count[None] = 0
        self.find_slots(n)

    @ti.kernel
    def replace(self, velocity: ti.types.ndarray(ti.f32, 2)):
        """Velocities [n, dim] in the order of the scene; of bodies the rigid motion nearest to them."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            for i in range(velocity.shape[0]):
                for d in ti.static(range(self.dim)):
                    self.v[i][d] = velocity[self.id[i], d]
            if ti.static(self.structure.bodies > 0):
                for b in range(self.bodies.count[None]):
                    self.bodies.take_velocity(b)


class PBDSimulator:
    """The solver under the ``Simulator`` contract; also driven directly by ``load`` and ``frame``.

    Overrides make the rungs of a solver ladder: ``cfl`` (Courant number; default the scene's), ``particles`` ("teacher": refined as the scene
    says; "recorded": the tracked set alone; a number: so many times finer), ``tolerance`` (factor on the error at which a solve ends),
    ``perturbation`` (length: random displacement of the start, for the chaos floor). Raises ``InputError`` for ones that cannot be.
    """

    def __init__(
        self,
        *,
        name: str = "pbd",
        kind: Kind = "reference",
        cfl: float | None = None,
        particles: str | int = "teacher",
        tolerance: float = 1.0,
        perturbation: float = 0.0,
    ):
        check_particles(name, particles)
        self.name, self.kind = name, kind
        self.settings: dict[str, Any] = {"cfl": cfl, "particles": particles, "tolerance": tolerance, "perturbation": perturbation}
        self.compile_seconds = 0.0
        self._built: tuple | None = None

    # -- what a scene needs
    def _structure(self, scene: Scene) -> Structure:
        rigid = sum(scene.materials[body.material].model == "rigid" for body in scene.bodies)
        # Rounded up, so that scenes of a family share their kernels.
        solver = _method(scene)
        return Structure(scene.dim, 1 << (rigid - 1).bit_length() if rigid else 0, solver.xsph > 0, solver.tensile > 0)

    def _refine(self, scene: Scene) -> int:
        return scene.refinement(self.settings["particles"])

    def _layout(self, scene: Scene) -> tuple[float, float, np.ndarray]:
        """Spacing and support radius [length], cells along each axis."""
        spacing = scene.spacing / self._refine(scene)
        support = spacing * _method(scene).support
        cells = np.maximum(np.floor(np.ptp(scene.bounds, axis=1) / support / (1 + SKIN)).astype(int), 1)
        return spacing, support, cells

    def _sizes(self, scene: Scene, particles: int) -> tuple[int, int, int]:
        """Capacities in particles, cells and pairs."""
        capacity = _capacity(particles)
        neighbours = {2: np.pi, 3: 4 * np.pi / 3}[scene.dim] * (_method(scene).support * (1 + SKIN)) ** scene.dim / 2
        return capacity, int(np.prod(self._layout(scene)[2] + 2)), int(ROOM * neighbours * capacity) + 4096

    def _density(self, scene: Scene) -> float:
        """[kg/m^3] of the water; without water of the first material."""
        materials = list(scene.materials.values())
        return next((material.density for material in materials if material.model == "water"), materials[0].density)

    def _numbers(self, scene: Scene, particles: int) -> np.ndarray:
        """As ``_Kernels.load`` takes them."""
        k, dim, solver = _Kernels, scene.dim, _method(scene)
        spacing, support, cells = self._layout(scene)
        numbers, d, width = np.zeros((4, k.NUMBERS)), spacing / support, np.ptp(scene.bounds, axis=1) / support
        row = numbers[0]
        row[k.COUNT], row[k.VOLUME], row[k.KERNEL], row[k.SPACING] = particles, d**dim, constant(dim) * lattice_scale(dim, d), d
        row[k.CFL], row[k.ERROR_AT_MOST] = self.settings["cfl"] or scene.cfl, solver.density_error * self.settings["tolerance"]
        row[k.ITERATIONS], row[k.XSPH], row[k.TENSILE] = solver.iterations, solver.xsph, solver.tensile * (solver.substeps / scene.frame_step) ** 2
        # A hair below the spacing, lest rounding parts a lattice.
        row[k.NEAREST] = d**dim * lattice_scale(dim, d) * kernel(dim, 0.999 * d)
        row[k.RELAXATION] = lattice_relaxation(dim, d)
        numbers[2, :dim] = width
        numbers[3, :dim], numbers[3, 4 : 4 + dim] = cells + 2, cells / width
        return numbers

    def limits(self, scene: Scene, speed: float) -> dict[str, float]:
        """Bounds on the time step [s] at a speed of particles [m/s], by what sets them: ``substeps`` a frame at least, and |v| dt + |g| dt^2 <= cfl
        spacing."""
        gravity = float(np.linalg.norm(np.array(scene.gravity) - scene.acceleration(), axis=-1).max())
        way = (self.settings["cfl"] or scene.cfl) * self._layout(scene)[0]
        courant = 2 * way / max(speed + np.sqrt(speed**2 + 4 * gravity * way), np.finfo(float).tiny)
        substeps = _method(scene).substeps
        return {"the Courant number": courant, f"substeps {substeps}": scene.frame_step / substeps}

    def _fixed(self, scene: Scene) -> float | None:
        return None if self.settings["cfl"] else scene.time_step

    def check_time_step(self, scene: Scene, where: object) -> None:
        """Refuse a fixed time step in which, at the bodies' own speeds, particles would pass more than a share ``cfl`` of their spacing. Raises
        ``InputError``."""
        step, speed = self._fixed(scene), max(float(np.linalg.norm(body.velocity)) for body in scene.bodies)
        limits = self.limits(scene, speed)
        what = min(limits, key=limits.__getitem__)
        if step is not None and step > limits[what] * (1 + 1e-6):
            steps = int(np.ceil(scene.frame_step / limits[what]))
            remedy = (
                f"above the limit {limits[what]:.4g} s, which {what} sets (cfl {scene.cfl:g}, speed {speed:.3g} m/s); use at most "
                f"{scene.frame_step / steps:.8g}, {steps} steps a frame, or leave it out: adaptive"
            )
            raise InputError(where, "time_step", scene.time_step, remedy)

    def plan(self, scene: Scene) -> dict:
        """What ``load`` would build for a scene, without building it; see ``MPMSimulator.plan``."""
        structure, (_, support, cells), dim = self._structure(scene), self._layout(scene), scene.dim
        particles = scene.particles(self._refine(scene))
        n, boxes, pairs = self._sizes(scene, len(particles.position))
        state = {"x": 16, "v": 16, "shift": 16, "id": 4, "body": 4}
        fields = {f"{kept}{name}": (size, n) for kept in ("", "moved ") for name, size in state.items()}
        fields |= {"sums": (16, n), "wall": (16, n), "drift": (16, n), "cell": (4, n), "sorted place": (4, n), "first pair": (4, n + 1),
                   "place when listed": (16, n), "pairs": (4, pairs), "gradients": (16, pairs), "first of a cell": (4, boxes + 2),
                   "next of a cell": (4, boxes + 2), "walls": (28, ENTRIES + 2)}  # fmt: skip
        if structure.bodies:
            fields |= {"slot": (4, n)} | Bodies.sizes(dim, structure.bodies, n)
        context = scene.context_values()
        reasons = {
            "third dimension": "a 2D scene" if dim == 2 else None, "rigid bodies": None if structure.bodies else "none in the scene",
            "XSPH viscosity": None if structure.xsph else "xsph: 0", "tensile correction": None if structure.tensile else "tensile: 0",
            "context": "no moving container, no varying parameter" if context is None else None,
            "equation of state": "incompressible", "wall friction": "slip walls", "signed distance": "no obstacles",
            "grid": "particles meet in pairs",
        }  # fmt: skip
        gravity = float(np.linalg.norm(np.array(scene.gravity) - scene.acceleration(), axis=1).max())
        start = float(np.sqrt((particles.velocity**2).sum(1).max()))
        fall = float(np.sqrt(start**2 + 2 * gravity * np.linalg.norm(np.ptp(scene.bounds, axis=1))))
        steps = [self._fixed(scene) or min(self.limits(scene, speed).values()) for speed in (0.0, fall)]
        return {
            "title": "position-based dynamics", "dim": dim, "rates": ["pbf"], "materials": [each.model for each in scene.materials.values()],
            "walls": "slip", "obstacles": 0, "context": 0 if context is None else context.shape[1],
            "kernels": ["load", "frame"], "fields": fields, "left_out": {what: why for what, why in reasons.items() if why},
            "bytes": sum(size * count for size, count in fields.values()), "particles": len(particles.position),
            "recorded": len(particles.tracked), "kinematic": 0, "cells": cells.tolist(), "grid_spacing": support * (1 + SKIN), "wave_speed": 0.0,
            "substeps_per_frame": [max(1, int(np.ceil(scene.frame_step / step - 1e-6))) for step in steps],
        }  # fmt: skip

    # -- state
    def load(self, scene: Scene) -> None:
        """Set the state of frame 0, compiling on first use. Raises ``InputError``."""
        begun = time.perf_counter()
        self.check_time_step(scene, scene.name)
        start_taichi()
        structure, (spacing, support, _) = self._structure(scene), self._layout(scene)
        particles = scene.particles(self._refine(scene))
        n, dim = particles.position.shape
        sizes = self._sizes(scene, n)
        built = self._built
        fresh = not (built and built[0] == structure and all(have >= need for have, need in zip(built[1], sizes, strict=True)))
        if fresh:
            self._kernels, self._built = _Kernels(structure, *sizes), (structure, sizes)
        self._scene, self._support, self._tracked = scene, support, particles.tracked
        self._acceleration, self._frame, self._last = scene.acceleration(), 0, 0.0
        self._pull = self._felt()
        self._mass = self._density(scene) * spacing**dim
        self._position, position = np.zeros((n, dim), np.float32), particles.position
        if self.settings["perturbation"]:
            noise = np.random.default_rng(np.random.SeedSequence([scene.seed, 2])).normal(size=position.shape)
            for index, body in enumerate(scene.bodies):
                if scene.materials[body.material].model == "rigid":
                    noise[particles.body == index] = noise[particles.body == index][:1]
            position = position + self.settings["perturbation"] * noise
        self._lower, upper = np.array(scene.bounds).T
        inside = np.clip((position - self._lower) / support, HAIR, (upper - self._lower) / support - HAIR)
        table, places = body_table(scene, particles, inside, spacing / support)
        labels = np.full(n, -1, np.int32)
        for index, (first, last) in enumerate(table[:, :2].astype(int)):
            labels[first:last] = index
        ratio = self._density(scene) / np.array([material.density for material in scene.materials.values()])[particles.material]
        data = np.concatenate([inside, particles.velocity / support, ratio[:, None]], 1).astype(np.float32)
        walls = wall_table(dim, spacing / support).astype(np.float32)
        # As in 3D: at the higher level that 2D is compiled at elsewhere, bodies' float64 vectors crash.
        with compiling(3):
            self._kernels.load(data, labels, self._numbers(scene, n).astype(np.float32), walls, table.reshape(-1, COLUMNS), places)
            self._run(0.0, 1.0, 0)
        if fresh:
            self.compile_seconds += time.perf_counter() - begun

    def _felt(self) -> np.ndarray:
        """Gravity as the box feels it in the current frame [length / s^2]."""
        return np.array(self._scene.gravity) - self._acceleration[min(self._frame, len(self._acceleration) - 1)]

    def _run(self, span: float, cap: float, steps: int) -> np.ndarray:
        k, scene = _Kernels, self._scene
        report = np.zeros(k.REPORT)
        report[k.STEP] = report[k.SPAN] = span
        report[k.CAP], report[k.LAST] = cap, self._last
        felt = self._felt()
        report[k.GRAVITY : k.GRAVITY + scene.dim], report[k.BEFORE : k.BEFORE + scene.dim] = felt / self._support, self._pull / self._support
        self._kernels.frame(steps, self._position, report)
        joule = self._mass * self._support**2
        self._diagnostics = {
            "kinetic_energy": report[k.KINETIC] * joule,
            "potential_energy": report[k.POTENTIAL] * joule,
            "max_speed": report[k.SPEED] * self._support,
            "substeps": report[k.STEPS],
            "dt": report[k.STEP],
            "density": report[k.DENSEST],
            "iterations": report[k.SOLVED],
            "density_error": report[k.ERROR],
            "unsolved": report[k.UNSOLVED],
        }
        return report

    def frame(self) -> np.ndarray:
        """Advance one frame; positions of the recorded particles, [n, dim] float32. Raises ``SimulationError``: the state is then of no use."""
        k, scene, felt = _Kernels, self._scene, self._felt()
        report = self._run(scene.frame_step, self._fixed(scene) or scene.frame_step / _method(scene).substeps, MOST_STEPS)
        if not np.isfinite(report).all() or report[k.BROKEN] or report[k.UNSOLVED] or report[k.FULL]:
            raise SimulationError(self._why(report))
        self._frame += 1
        self._last, self._pull = report[k.LAST], felt
        return self._recorded()

    def _why(self, report: np.ndarray) -> str:
        k = _Kernels
        for name, values in self.state().items():
            wrong = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(1))
            if len(wrong):
                return f"{name} of particle {wrong[0]} is not finite" + (f", nor of {len(wrong) - 1} others" if len(wrong) > 1 else "")
        if report[k.FULL]:
            return "particles have gathered beyond the room for pairs"
        if report[k.UNSOLVED]:
            return (f"densities did not converge in {_method(self._scene).iterations} iterations (mean error {report[k.ERROR]:.2g}), at a step of "
                    f"{report[k.STEP]:.3g} s")  # fmt: skip
        return f"more than {MOST_STEPS} steps in a frame: speeds run away"

    def _recorded(self) -> np.ndarray:
        return (self._lower + self._position[self._tracked].astype(float) * self._support).astype(np.float32)

    def diagnostics(self) -> dict[str, float]:
        """Of the current frame: energies [J, per unit depth in 2D; kinetic: of half a step ago], max speed [m/s], substeps, shortest step dt [s],
        largest density over that at rest, iterations in all, the largest mean error of the constraints that a solve ended with, how many did not
        converge."""
        return dict(self._diagnostics)

    def state(self) -> dict[str, np.ndarray]:
        """All simulated particles in the order of the scene, float64: ``position`` [length], ``velocity`` [length / s] (half a step ago), [n, dim]
        each, ``density`` over that at rest [n]."""
        kernels, n, dim, h = self._kernels, *self._position.shape, self._support
        order = np.argsort(kernels.id.to_numpy()[:n])
        x, v, wall = (field.to_numpy()[:n][order].astype(float) for field in (kernels.x, kernels.v, kernels.wall))
        return {"position": self._lower + x[:, :dim] * h, "velocity": v[:, :dim] * h, "density": wall[:, 3]}

    def inject(self, name: str, particle: int | np.ndarray, value) -> None:
        """Overwrite ``position`` or ``velocity`` of a particle of water, or of several, as ``state`` gives them. For studies of what happens then."""
        kernels, h = self._kernels, self._support
        field, content = {"position": (kernels.x, (value - self._lower) / h), "velocity": (kernels.v, np.divide(value, h))}[name]
        whole = field.to_numpy()
        whole[np.flatnonzero(np.isin(kernels.id.to_numpy()[: len(self._position)], particle)), : self._scene.dim] = content
        field.from_numpy(whole)

    def set_velocity(self, velocity: np.ndarray) -> None:
        """Replace the velocities [n, dim] of all particles; bodies take the rigid motion nearest to theirs. For starts that no scene describes."""
        self._kernels.replace((velocity / self._support).astype(np.float32))
        self._last = 0.0

    # -- the Simulator contract
    def begin(self, start: Start) -> None:
        """Run the known frames from the scene's own start, so that the solver stands where the history ends."""
        self.load(Scene.of(start))
        for _ in range(start.present):
            self.frame()

    def advance(self) -> np.ndarray:
        """The next frame, [1, particles, dim]."""
        return self.frame()[None]
