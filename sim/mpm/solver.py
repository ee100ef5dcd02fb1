"""MLS-MPM (Hu et al. 2018) with APIC transfers (Jiang et al. 2015) and quadratic B-splines, 2D and 3D from one source.

Decisions, measured on a CPU:
- one kernel a frame, serial, with the substep loop inside: five times faster than a kernel a substep, because atomics become
  plain additions and the launch is paid once a frame; one thread per trajectory is bitwise reproducible;
- numbers (sizes, materials, time step) are arguments and fields, structure (dimension, materials present, wall kind) is
  compiled in: scenes that differ in numbers share kernels;
- on a GPU the same functions run as parallel loops, two kernels a substep; what takes turns (obstacles' columns, contacts of bodies) on one thread.
"""

import time
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim.errors import InputError
from sim.mpm.decomposition import finite
from sim.mpm.materials import MODELS
from sim.mpm.rigid import RigidBodies
from sim.mpm.walls import solid, wall
from sim.obstacles import THINNEST, combine
from sim.rigid import body_table
from sim.scene import Particles, Scene, check_particles
from sim.signed_distance import between_nodes
from sim.simulator import Kind, SimulationError, Start
from sim.taichi_runtime import compiling, start_taichi, ti

#: Grid coordinate of the lower walls: they lie on a line of nodes, with one line of ghost nodes behind.
WALL = 1
#: A frame whose Courant number grew beyond this multiple of the requested one is taken back and repeated with half the step.
COURANT_GROWTH = 1.5
#: A particle alone on the grid is an oscillator: its stress turns its own velocity gradient about at w = 2 sqrt(dim) c / dx, and symplectic
#: Euler needs w dt < 2, that is sqrt(dim) c dt < dx. Planned between the strong resonances of large swings, w dt = sqrt(2) and sqrt(3).
#: Whole bodies bear more, so this binds at Courant numbers above 0.8 / sqrt(dim), where the volume of lone drops of water ran away.
#: It is necessary, not sufficient: nothing damps a lone particle, and swings of 5 % may still grow until the trajectory fails.
LONE_PARTICLE = 0.8
#: Largest c dt / dx whatever Courant number is asked for. Sand, which does not ring, kept its energy up to 1.4 and gained it, unnoticed, from 2
#: (``sim.stability``); what rings is held to less by ``LONE_PARTICLE``.
LARGEST_COURANT = 1.4
#: Halvings of the planned step before a trajectory is given up.
MAX_HALVINGS = 6


#: Distance from a wall, in cells, at which particles are stopped.
HAIR = 1e-4
#: What a frame adds up: kinetic, potential, elastic energy; the largest of squared speed, wave speed, squared speed within the frame;
#: particles that are not finite; particles that began it off the grid.
SUMS = 8
#: Friction coefficient that stands for ``sticky`` in the obstacles' fields.
STICKY = -1.0
#: Thickness in cells from which nodes in an obstacle are reached from one of its faces alone.
THICK = 3.0
#: Depth in cells of the nodes in an obstacle that a particle may reach: 1.5 along each of three axes.
REACH = 2.6
#: Of them, in line behind the one at the surface.
BEHIND = 3
#: Sweeps over the obstacles' contacts at most, and the change of an impulse, relative to the largest, at which they end.
SWEEPS, SETTLED = 12, 1e-3


@dataclass(frozen=True)
class Structure:
    """What is compiled in. models: (material, *options) each; friction: the walls' "slip", "coulomb" or "sticky"; obstacles: "none",
    "slip" or "coulomb" (which includes sticky ones); shaken: gravity changes from frame to frame; rigid: (bodies, faces of one) at most,
    or None."""

    dim: int
    models: tuple
    friction: str
    obstacles: str = "none"
    shaken: bool = False
    rigid: tuple[int, int] | None = None


def _power_of_two(n: int) -> int:
    return 1 << max(int(n) - 1, 15).bit_length()


def _capacity(particles: int) -> int:
    """Particles that fields are made for: few different numbers, for each compiles anew, yet of many particles no more than an eighth in vain."""
    step = _power_of_two(particles) >> (4 if particles > 1 << 14 else 0)
    return -(-max(particles, 1) // step) * step


@ti.data_oriented
class _Kernels:
    """Fields and compiled code for one ``Structure``; capacities in particles, nodes and obstacles' columns.

    Vectors that meet in the transfers have four equal lanes whatever the dimension: a node is (momentum, mass, 0), later (velocity, 1, 0);
    a particle's velocity carries the gathered 1 along. Uniform lanes are what the compiler turns into vector instructions; shorter
    vectors became shuffles and ran at 0.6 of the speed. The unit vectors ``E`` are data, lest constant folding break the lanes up; so are
    all numbers, since a vector among a kernel's arguments costs 90 us a launch.
    Positions are stored in cells, from the padded corner.
    """

    def __init__(self, structure: Structure, capacity: int, nodes: tuple[int, ...], columns: int, serial: bool):
        self.structure, self.capacity, self.nodes, self.columns_at_most = structure, capacity, nodes, columns
        dim, models = self.dim, self.models = structure.dim, structure.models
        self.friction = structure.friction
        self.x = ti.Vector.field(dim, ti.f32, capacity)
        self.v = ti.Vector.field(4, ti.f32, capacity)
        self.C = [ti.Vector.field(4, ti.f32, capacity) for _ in range(dim)]  # column a: derivative of the velocity along axis a
        #: Materials whose particles move with the grid.
        self.flowing = [m for m, (model, *_) in enumerate(models) if model != "rigid"]
        self.materials = [MODELS[model](dim, capacity, *options) for model, *options in models]
        self.grid = ti.Vector.field(4, ti.f32, nodes)
        self.range = ti.field(ti.i32, len(models) + 1)  # particles of material m: range[m] .. range[m + 1]
        self.mass_volume = ti.Vector.field(2, ti.f32, len(models))
        self.extent = ti.Vector.field(dim, ti.i32, 2)  # node indices of the walls
        self.dx, self.coefficient = ti.field(ti.f32, ()), ti.field(ti.f32, ())
        self.lower, self.gravity = ti.Vector.field(dim, ti.f32, ()), ti.Vector.field(dim, ti.f32, ())
        #: Gravity as the box feels it in the current frame.
        self.pull = ti.Vector.field(dim, ti.f32, ()) if structure.shaken else self.gravity
        if structure.obstacles != "none":
            self.solids = ti.Vector.field(dim + 2, ti.f32, nodes)  # normal, distance in cells, friction of the nearest obstacle
            self.columns = ti.field(ti.i32, ())
            self.foot = ti.Vector.field(2 * dim + 1, ti.i32, columns)  # node, step outwards, nodes behind it
            self.face = ti.Vector.field(dim + 2, ti.f32, columns)  # normal, friction, weight of the node
            self.impulse = ti.Vector.field(dim + 2, ti.f32, columns)  # and the momenta that a unit impulse gives to the two nodes
        self.E = ti.Vector.field(4, ti.f32, 3)
        self.state = [self.x, self.v, *self.C, *(field for material in self.materials for field in material.fields())]
        self.saved = [
            ti.field(ti.f32, capacity) if isinstance(field, ti.ScalarField) else ti.Vector.field(field.n, ti.f32, capacity) for field in self.state
        ]
        self.has_rigid = structure.rigid is not None
        self.rigid: Any = None if structure.rigid is None else RigidBodies(self, *structure.rigid)  # used where ``has_rigid`` is compiled in
        if self.has_rigid:
            self.touched = ti.Vector.field(dim, ti.i32, 2)  # lowest and highest first node of a particle
        self.frame = (self.frame_rigid if self.has_rigid else self.frame_serial) if serial else self.frame_parallel

    @ti.func
    def locate(self, x):
        """First of the three nodes along each axis, and the distance to it in cells, in [0.5, 1.5)."""
        base = ti.cast(x - 0.5, ti.i32)
        return base, x - ti.cast(base, ti.f32)

    @ti.func
    def weights(self, f):
        """Quadratic B-spline weights of three nodes."""
        return ti.Vector([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])

    @ti.func
    def p2g(self, m: ti.template(), p, base, fx, dt):
        """Particle to grid: m_i += w m, (mv)_i += w [m v + (m C - dt V0 4 / dx^2 tau)(x_i - x_p)] (Hu et al. 2018, eq. 29)."""
        mass, volume, dx = self.mass_volume[m][0], self.mass_volume[m][1], self.dx[None]
        E0, E1, E2 = self.E[0], self.E[1], self.E[2]
        factor = -4.0 * dt * volume / dx
        if ti.static(self.dim == 2):
            G = ti.Matrix.cols([ti.Vector([self.C[0][p][0], self.C[0][p][1]]), ti.Vector([self.C[1][p][0], self.C[1][p][1]])])
            tau = factor * self.materials[m].kirchhoff(p, dt * G, dt)
            P0 = (mass * dx) * self.C[0][p] + tau[0, 0] * E0 + tau[1, 0] * E1
            P1 = (mass * dx) * self.C[1][p] + tau[0, 1] * E0 + tau[1, 1] * E1
            Q = mass * self.v[p] - fx[0] * P0 - fx[1] * P1
            wx, wy = self.weights(fx[0]), self.weights(fx[1])
            for i in ti.static(range(3)):
                R, T = wx[i] * (Q + float(i) * P0), wx[i] * P1
                for j in ti.static(range(3)):
                    self.grid[base[0] + i, base[1] + j] += wy[j] * (R + float(j) * T)
        else:
            G = ti.Matrix.cols([ti.Vector([self.C[a][p][0], self.C[a][p][1], self.C[a][p][2]]) for a in ti.static(range(3))])
            tau = factor * self.materials[m].kirchhoff(p, dt * G, dt)
            P0 = (mass * dx) * self.C[0][p] + tau[0, 0] * E0 + tau[1, 0] * E1 + tau[2, 0] * E2
            P1 = (mass * dx) * self.C[1][p] + tau[0, 1] * E0 + tau[1, 1] * E1 + tau[2, 1] * E2
            P2 = (mass * dx) * self.C[2][p] + tau[0, 2] * E0 + tau[1, 2] * E1 + tau[2, 2] * E2
            Q = mass * self.v[p] - fx[0] * P0 - fx[1] * P1 - fx[2] * P2
            wx, wy, wz = self.weights(fx[0]), self.weights(fx[1]), self.weights(fx[2])
            # Rolled along two axes: fully unrolled, 27 nodes take half a minute to compile.
            for i in range(3):
                for j in range(3):
                    wij = wx[i] * wy[j]
                    R, T = wij * (Q + float(i) * P0 + float(j) * P1), wij * P2
                    for k in ti.static(range(3)):
                        self.grid[base[0] + i, base[1] + j, base[2] + k] += wz[k] * (R + float(k) * T)

    @ti.func
    def update_node(self, I, dt):
        """Momentum to velocity, gravity, walls."""
        cell = self.grid[I]
        if cell[self.dim] > 0.0:
            inverse = 1.0 / cell[self.dim]
            v = ti.Vector.zero(ti.f32, self.dim)
            for d in ti.static(range(self.dim)):
                v[d] = cell[d] * inverse + dt * self.pull[None][d]
            u = wall(v, I, self.extent[0], self.extent[1], self.friction, self.coefficient[None])
            for d in ti.static(range(self.dim)):
                cell[d] = u[d]
            cell[self.dim] = 1.0
            self.grid[I] = cell

    @ti.func
    def fold(self, held, inward, dt):
        """What particles gave to a ghost node goes to the two nodes that its velocity is made of, lest the wall's reaction be short.

        With v(-1) = 2 v(0) - v(1) the virtual power of the ghost's momentum p and mass m acts on v(0) and v(1):
        (m0 + 4 m) v0 - 2 m v1 = p0 + 2 p and (m1 + m) v1 - 2 m v0 = p1 - p. Linear velocity fields and momentum are kept. The wall
        then changes v0, and v1 follows by 2 m / (m1 + m) of that; where v0 is held at zero this is the method of images. Dropped
        instead, a column's pressure read 10 % high in the lowest cell. Velocities are written back as momenta of the nodes' own
        masses, for ``update_node``. m0 and m1 exceed zero wherever m does: a particle reaches all three nodes.
        """
        ghost, inner = held - inward, held + inward
        m, m0, m1 = self.grid[ghost][self.dim], self.grid[held][self.dim], self.grid[inner][self.dim]
        if m > 0.0:
            det = (m0 + 4.0 * m) * (m1 + m) - 4.0 * m * m
            free, fixed = ti.Vector.zero(ti.f32, self.dim), ti.Vector.zero(ti.f32, self.dim)
            for d in ti.static(range(self.dim)):
                r0, r1 = self.grid[held][d] + 2.0 * self.grid[ghost][d], self.grid[inner][d] - self.grid[ghost][d]
                free[d] = ((m1 + m) * r0 + 2.0 * m * r1) / det
                fixed[d] = ((m0 + 4.0 * m) * r1 + 2.0 * m * r0) / det
            fall = free + dt * self.pull[None]
            u = wall(fall, held, self.extent[0], self.extent[1], self.friction, self.coefficient[None])
            for d in ti.static(range(self.dim)):
                self.grid[held][d] = m0 * free[d]
                self.grid[inner][d] = m1 * (fixed[d] + 2.0 * m / (m1 + m) * (u[d] - fall[d]))

    @ti.func
    def extrapolate(self, held, inward):
        """Ghost node behind a wall: v(-1) = 2 v(0) - v(1). ``held``: the node on the wall; ``inward``: the step away from it.

        Any linear velocity field is then interpolated exactly up to the wall: nothing creeps into it, and tr C is the true
        compression there. With held nodes in place of ghosts, C underrates the compression in the last half cell, and particles
        gather on the floor at reference density.
        """
        value = self.grid[held]
        if self.grid[held + inward][self.dim] > 0.0:
            value = 2.0 * self.grid[held] - self.grid[held + inward]
        self.grid[held - inward] = value

    @ti.func
    def ghost(self, axis, side, I, dt, before: ti.template()):
        """``fold`` before the nodes' update, ``extrapolate`` after it, on the line of nodes through I along an axis, at its lower or upper end.

        The axis is data: fold's code once an axis took a fifth of the time to compile.
        """
        held, inward = I, ti.Vector.zero(ti.i32, self.dim)
        for d in ti.static(range(self.dim)):
            if d == axis:
                held[d], inward[d] = self.extent[side][d], 1 - 2 * side
        if ti.static(before):
            self.fold(held, inward, dt)
        else:
            self.extrapolate(held, inward)

    @ti.func
    def at_walls(self, low, high, dt, before: ti.template()):
        """``ghost`` on every line of nodes that ends behind a wall the particles touch."""
        for face in range(2 * self.dim):
            axis, side = face // 2, face % 2
            start, end, touched = low, high + 3, False
            for d in ti.static(range(self.dim)):
                if d == axis:
                    touched = low[d] < WALL if side == 0 else high[d] + 2 > self.extent[1][d]
                    end[d] = start[d] + 1
            if touched:
                if ti.static(self.dim == 2):
                    for i in range(start[0], end[0]):
                        for j in range(start[1], end[1]):
                            self.ghost(axis, side, ti.Vector([i, j]), dt, before)
                else:
                    for i in range(start[0], end[0]):
                        for j in range(start[1], end[1]):
                            for k in range(start[2], end[2]):
                                self.ghost(axis, side, ti.Vector([i, j, k]), dt, before)

    @ti.func
    def g2p(self, p, dt):
        """Grid to particle: v = sum w v_i, C = 4 / dx^2 sum w v_i (x_i - x_p)^T, x += dt v; a wall stops what would cross it.

        Returns the squared speed.
        """
        x, dx = self.x[p], self.dx[None]
        base, fx = self.locate(x)
        v = ti.Vector.zero(ti.f32, 4)
        k = 4.0 / dx
        if ti.static(self.dim == 2):
            wx, wy = self.weights(fx[0]), self.weights(fx[1])
            c0, c1 = ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4)
            for i in ti.static(range(3)):
                low = wy[0] * self.grid[base[0] + i, base[1]]
                high = wy[2] * self.grid[base[0] + i, base[1] + 2]
                S = low + wy[1] * self.grid[base[0] + i, base[1] + 1] + high
                v += wx[i] * S
                c1 += wx[i] * (high - low)
                if ti.static(i != 1):
                    c0 += (float(i - 1) * wx[i]) * S
            self.C[0][p], self.C[1][p] = k * (c0 + (1.0 - fx[0]) * v), k * (c1 + (1.0 - fx[1]) * v)
        else:
            wx, wy, wz = self.weights(fx[0]), self.weights(fx[1]), self.weights(fx[2])
            c0, c1, c2 = ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4)
            for i in range(3):
                for j in range(3):
                    wij = wx[i] * wy[j]
                    low = wz[0] * self.grid[base[0] + i, base[1] + j, base[2]]
                    high = wz[2] * self.grid[base[0] + i, base[1] + j, base[2] + 2]
                    S = wij * (low + wz[1] * self.grid[base[0] + i, base[1] + j, base[2] + 1] + high)
                    v += S
                    c0 += float(i - 1) * S
                    c1 += float(j - 1) * S
                    c2 += wij * (high - low)
            self.C[0][p] = k * (c0 + (1.0 - fx[0]) * v)
            self.C[1][p] = k * (c1 + (1.0 - fx[1]) * v)
            self.C[2][p] = k * (c2 + (1.0 - fx[2]) * v)
        # Keep particles a hair inside, so that what is recorded is inside in float32 too.
        speed2 = 0.0
        for d in ti.static(range(self.dim)):
            moved = x[d] + (dt / dx) * v[d]
            speed2 += v[d] * v[d]
            inside = ti.min(ti.max(moved, ti.cast(self.extent[0][d], ti.f32) + HAIR), ti.cast(self.extent[1][d], ti.f32) - HAIR)
            if inside != moved:
                v[d] = 0.0
            # What is not a number passes any comparison, and would be a node's index in the next substep.
            if finite(moved):
                x[d] = inside
        self.x[p], self.v[p] = x, v
        if ti.static(self.structure.obstacles != "none"):
            self.push_out(p)
        return speed2

    @ti.func
    def clearance(self, x):
        """Distance [cells] to the obstacles and unit normal at a place inside the box."""
        return between_nodes(self.solids, x, self.dim)

    @ti.func
    def push_out(self, p):
        """A particle inside an obstacle goes back along the normal, stopped and rubbed (``sim.mpm.walls.solid``): surfaces are straight
        for the grid only within a column. Twice, for a notch between two slopes.
        """
        for _ in ti.static(range(2)):
            x = self.x[p]
            distance, normal = self.clearance(x)
            if distance < HAIR:
                value, v = ti.Vector.zero(ti.f32, self.dim + 2), ti.Vector.zero(ti.f32, self.dim)
                for d in ti.static(range(self.dim)):
                    value[d], v[d] = normal[d], self.v[p][d]
                value[self.dim + 1] = self.solids[ti.cast(x + 0.5, ti.i32)][self.dim + 1]
                u = solid(v, value, self.structure.obstacles)
                for d in ti.static(range(self.dim)):
                    self.v[p][d] = u[d]
                    moved = x[d] + (HAIR - distance) * normal[d]
                    self.x[p][d] = ti.min(ti.max(moved, ti.cast(self.extent[0][d], ti.f32) + HAIR), ti.cast(self.extent[1][d], ti.f32) - HAIR)

    @ti.func
    def column(self, k):
        """Node at the surface of an obstacle, the step outwards, the nodes behind it; weights at the surface of the node and of the next one."""
        node, step = ti.Vector.zero(ti.i32, self.dim), ti.Vector.zero(ti.i32, self.dim)
        for d in ti.static(range(self.dim)):
            node[d], step[d] = self.foot[k][d], self.foot[k][self.dim + d]
        near = self.face[k][self.dim + 1]
        if self.grid[node + step][self.dim] <= 0.0:
            near = 1.0
        return node, step, near

    @ti.func
    def resist(self, dt):
        """Obstacles: across their surfaces velocities are linear along each column of nodes, and do not enter where they meet it.

        v_k = v0 + k (v0 - v1) for the k-th node behind node 0, that nearest to the surface; v1 is the next one outwards. As at the walls
        (``fold``) what particles gave to those nodes acts on v0 and v1 by virtual power, M v = r with M = sum m_k c_k c_k^T, r = sum p_k c_k,
        c_k = (1 + k, -k). The velocity at the surface is u = a v0 + (1 - a) v1; J >= 0 along the normal and |J_t| <= mu J_n (all of it
        where it is sticky) change v by M^-1 (a, 1 - a) J, which loses energy at most. Columns that share nodes take turns until they agree
        (projected Gauss-Seidel). Were the nodes inside held instead, the lowest layers of resting water read up to five times their
        pressure, as the surface lies between nodes.
        """
        for k in range(self.columns[None]):
            node, step, near = self.column(k)
            m0, m1 = self.grid[node][self.dim], self.grid[node + step][self.dim]
            self.impulse[k] = ti.Vector.zero(ti.f32, self.dim + 2)
            if m0 > 0.0:
                M00, M01, M11 = m0, 0.0, m1
                r0, r1 = self.grid[node], self.grid[node + step]
                for i in range(1, self.foot[k][2 * self.dim] + 1):
                    ghost = self.grid[node - i * step]
                    # Without a mass at node 1 they move with node 0.
                    c1 = ti.select(m1 > 0.0, -float(i), 0.0)
                    c0, m = 1.0 - c1, ghost[self.dim]
                    M00, M01, M11 = M00 + c0 * c0 * m, M01 + c0 * c1 * m, M11 + c1 * c1 * m
                    r0, r1 = r0 + c0 * ghost, r1 + c1 * ghost
                # Without it M is diagonal, and its second entry any number.
                M11 = ti.select(m1 > 0.0, M11, 1.0)
                det = M00 * M11 - M01 * M01
                v0, v1 = (M11 * r0 - M01 * r1) / det, (M00 * r1 - M01 * r0) / det
                for d in ti.static(range(self.dim)):
                    self.grid[node][d] = m0 * v0[d]
                    if m1 > 0.0:
                        self.grid[node + step][d] = m1 * v1[d]
                self.impulse[k][self.dim] = m0 * (M11 * near - M01 * (1.0 - near)) / det
                self.impulse[k][self.dim + 1] = m1 * (M00 * (1.0 - near) - M01 * near) / det
        sweep, change, largest = 0, 1.0, 0.0
        while sweep < SWEEPS and change > SETTLED * largest:
            sweep += 1
            change = 0.0
            for k in range(self.columns[None]):
                node, step, near = self.column(k)
                m0, m1 = self.grid[node][self.dim], self.grid[node + step][self.dim]
                if m0 > 0.0:
                    give0, give1 = self.impulse[k][self.dim], self.impulse[k][self.dim + 1]
                    a, b = near / m0, 0.0
                    if m1 > 0.0:
                        b = (1.0 - near) / m1
                    u, old, normal = ti.Vector.zero(ti.f32, self.dim), ti.Vector.zero(ti.f32, self.dim), ti.Vector.zero(ti.f32, self.dim)
                    for d in ti.static(range(self.dim)):
                        u[d] = a * self.grid[node][d] + b * self.grid[node + step][d] + dt * self.pull[None][d]
                        old[d], normal[d] = self.impulse[k][d], self.face[k][d]
                    if self.foot[k][2 * self.dim] < 0 and self.grid[node - step][self.dim] > m1:
                        normal = -normal
                    stuck = old - u / (a * give0 + b * give1)
                    pressed = stuck.dot(normal)
                    now = ti.max(pressed, 0.0) * normal
                    if ti.static(self.structure.obstacles == "coulomb"):
                        friction = self.face[k][self.dim]
                        along = stuck - pressed * normal
                        share = 0.0
                        if pressed > 0.0:
                            share = ti.min(1.0, friction * pressed / ti.max(along.norm(), 1e-30))
                        for d in ti.static(range(self.dim)):
                            now[d] = ti.select(friction < 0.0, stuck[d], now[d] + share * along[d])
                    for d in ti.static(range(self.dim)):
                        self.impulse[k][d] = now[d]
                        self.grid[node][d] += give0 * (now[d] - old[d])
                        if m1 > 0.0:
                            self.grid[node + step][d] += give1 * (now[d] - old[d])
                    change = ti.max(change, (now - old).norm())
                    largest = ti.max(largest, now.norm())

    @ti.func
    def stretch(self):
        """Velocities of the nodes behind the obstacles' surfaces (``resist``), after the nodes' update."""
        for k in range(self.columns[None]):
            node, step, near = self.column(k)
            v0 = self.grid[node]
            if v0[self.dim] > 0.0:
                slope = ti.Vector.zero(ti.f32, 4)
                if self.grid[node + step][self.dim] > 0.0:
                    slope = v0 - self.grid[node + step]
                for i in range(1, self.foot[k][2 * self.dim] + 1):
                    # Without mass none is read, nor cleared.
                    if self.grid[node - i * step][self.dim] > 0.0:
                        self.grid[node - i * step] = v0 + float(i) * slope

    @ti.func
    def shake(self, f, sums: ti.template()):
        """What bodies feel in a box of acceleration a is gravity - a; a stands behind the ``SUMS`` of frame f."""
        for _ in range(1):
            for d in ti.static(range(self.dim)):
                self.pull[None][d] = self.gravity[None][d] - ti.cast(sums[f, SUMS + d], ti.f32)

    @ti.func
    def report(self, m: ti.template(), p, f, position: ti.template(), sums: ti.template()):
        """Position of one particle [length] at the end of frame f, and its part in the frame's sums (see ``SUMS``)."""
        mass, volume = self.mass_volume[m][0], self.mass_volume[m][1]
        speed2, height = 0.0, 0.0
        for d in ti.static(range(self.dim)):
            x = self.lower[None][d] + (self.x[p][d] - WALL) * self.dx[None]
            position[f, p, d] = x
            speed2 += self.v[p][d] ** 2
            height -= self.gravity[None][d] * x
        if ti.static(self.models[m][0] == "rigid"):
            # A body's inertia includes the splines' own moments; its energy does too.
            for a in ti.static(range(self.dim)):
                speed2 += 0.25 * (self.dx[None] * self.C[a][p]).norm_sqr()
        sums[f, 0] += ti.cast(0.5 * mass * speed2, ti.f64)
        sums[f, 1] += ti.cast(mass * height, ti.f64)
        sums[f, 2] += ti.cast(volume * self.materials[m].energy_density(p), ti.f64)
        ti.atomic_max(sums[f, 3], ti.cast(speed2, ti.f64))
        ti.atomic_max(sums[f, 4], ti.cast(self.materials[m].wave_speed(p), ti.f64))
        broken = not (finite(self.x[p].sum() + speed2) and self.materials[m].intact(p))
        for a in ti.static(range(self.dim)):
            broken = broken or not finite(self.C[a][p].sum())
        sums[f, 6] += ti.cast(broken, ti.f64)

    @ti.func
    def spread(self, dt):
        """Particles to grid; returns the lowest and highest first node of a particle."""
        low, high = ti.Vector([1 << 20] * self.dim), ti.Vector([0] * self.dim)
        for m in ti.static(range(len(self.models))):
            for p in range(self.range[m], self.range[m + 1]):
                base, fx = self.locate(self.x[p])
                low, high = ti.min(low, base), ti.max(high, base)
                self.p2g(m, p, base, fx, dt)
        return low, high

    @ti.func
    def clear(self, I):
        self.grid[I] = ti.Vector.zero(ti.f32, 4)
        if ti.static(self.has_rigid):
            self.rigid.share[I] = ti.Vector.zero(ti.f32, 2)

    @ti.func
    def collect(self, low, high, dt):
        """Nodes, walls and ghosts, then grid to particles; leaves the grid empty. Returns the largest squared speed."""
        self.at_walls(low, high, dt, before=True)
        if ti.static(self.structure.obstacles != "none"):
            self.resist(dt)
        if ti.static(self.dim == 2):
            for i in range(low[0], high[0] + 3):
                for j in range(low[1], high[1] + 3):
                    self.update_node(ti.Vector([i, j]), dt)
        else:
            for i in range(low[0], high[0] + 3):
                for j in range(low[1], high[1] + 3):
                    for k in range(low[2], high[2] + 3):
                        self.update_node(ti.Vector([i, j, k]), dt)
        if ti.static(self.structure.obstacles != "none"):
            self.stretch()
        self.at_walls(low, high, dt, before=False)
        fastest = 0.0
        if ti.static(self.has_rigid):
            for m in ti.static(self.flowing):
                for p in range(self.range[m], self.range[m + 1]):
                    fastest = ti.max(fastest, self.g2p(p, dt))
        else:
            for p in range(self.range[ti.static(len(self.models))]):
                fastest = ti.max(fastest, self.g2p(p, dt))
        if ti.static(self.dim == 2):
            for i in range(low[0], high[0] + 3):
                for j in range(low[1], high[1] + 3):
                    self.clear(ti.Vector([i, j]))
        else:
            for i in range(low[0], high[0] + 3):
                for j in range(low[1], high[1] + 3):
                    for k in range(low[2], high[2] + 3):
                        self.clear(ti.Vector([i, j, k]))
        return fastest

    @ti.kernel
    def frame_serial(
        self, frames: ti.i32, substeps: ti.i32, dt: ti.f32, keep: ti.i32, position: ti.types.ndarray(ti.f32, 3), sums: ti.types.ndarray(ti.f64, 2)
    ):
        """Whole frames; ``keep`` saves the state first. Only the box of nodes that particles touch is swept."""
        ti.loop_config(serialize=True)
        for p in range(keep * self.range[ti.static(len(self.models))]):
            self.save_particle(p, sums)
        ti.loop_config(serialize=True)
        for f in range(ti.select(sums[0, 7] > 0.0, 0, frames)):
            if ti.static(self.structure.shaken):
                self.shake(f, sums)
            for _ in range(substeps):
                low, high = self.spread(dt)
                sums[f, 5] = ti.max(sums[f, 5], ti.cast(self.collect(low, high, dt), ti.f64))
            for m in ti.static(range(len(self.models))):
                for p in range(self.range[m], self.range[m + 1]):
                    self.report(m, p, f, position, sums)

    def frame_rigid(self, frames, substeps, dt, keep, position, sums) -> None:
        """The same with rigid bodies, in five kernels a substep: all in one took 18 s to compile."""
        if keep:
            self.save(sums)
            self.keep_rigid(False)
        for f in range(0 if sums[0, 7] else frames):
            row = sums[f : f + 1]
            for _ in range(substeps):
                self.spread_serial(dt, row)
                self.step_rigid(dt, row)
                self.collect_serial(dt, row)
            self.report_parallel(position[f : f + 1], row)

    @ti.kernel
    def spread_serial(self, dt: ti.f32, sums: ti.types.ndarray(ti.f64, 2)):
        if ti.static(self.structure.shaken):
            self.shake(0, sums)
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.touched[0], self.touched[1] = self.spread(dt)

    @ti.kernel
    def meet_rigid(self, dt: ti.f32):
        """Bodies read the grid before walls and obstacles change it: these act on the bodies themselves. One thread, here and below."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.rigid.meet(dt)

    @ti.kernel
    def solve_rigid(self):
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.rigid.solve()

    @ti.kernel
    def move_rigid(self, dt: ti.f32, sums: ti.types.ndarray(ti.f64, 2)):
        ti.loop_config(serialize=True)
        for _ in range(1):
            sums[0, 5] = ti.max(sums[0, 5], ti.cast(self.rigid.advance(dt), ti.f64))

    def step_rigid(self, dt, sums) -> None:
        self.meet_rigid(dt)
        self.solve_rigid()
        self.move_rigid(dt, sums)

    @ti.kernel
    def collect_serial(self, dt: ti.f32, sums: ti.types.ndarray(ti.f64, 2)):
        ti.loop_config(serialize=True)
        for _ in range(1):
            sums[0, 5] = ti.max(sums[0, 5], ti.cast(self.collect(self.touched[0], self.touched[1], dt), ti.f64))

    def frame_parallel(self, frames, substeps, dt, keep, position, sums) -> None:
        """The same, two kernels a substep (five with rigid bodies), loops over particles and nodes parallel (for a GPU)."""
        if keep:
            self.save(sums)
            if self.has_rigid:
                self.keep_rigid(False)
        for f in range(0 if sums[0, 7] else frames):
            row = sums[f : f + 1]
            for _ in range(substeps):
                self.spread_parallel(dt, row)
                if self.has_rigid:
                    self.step_rigid(dt, row)
                self.collect_parallel(dt, row)
            self.report_parallel(position[f : f + 1], row)

    @ti.kernel
    def spread_parallel(self, dt: ti.f32, sums: ti.types.ndarray(ti.f64, 2)):
        if ti.static(self.structure.shaken):
            self.shake(0, sums)
        for m in ti.static(range(len(self.models))):
            for p in range(self.range[m], self.range[m + 1]):
                base, fx = self.locate(self.x[p])
                self.p2g(m, p, base, fx, dt)

    @ti.kernel
    def collect_parallel(self, dt: ti.f32, sums: ti.types.ndarray(ti.f64, 2)):
        for axis in ti.static(range(self.dim)):
            for I in ti.grouped(self.grid):
                if I[axis] < 2:
                    self.ghost(axis, I[axis], I, dt, True)
        if ti.static(self.structure.obstacles != "none"):
            for _ in range(1):
                self.resist(dt)
        for I in ti.grouped(self.grid):
            self.update_node(I, dt)
        if ti.static(self.structure.obstacles != "none"):
            for _ in range(1):
                self.stretch()
        for axis in ti.static(range(self.dim)):
            for I in ti.grouped(self.grid):
                if I[axis] < 2:
                    self.ghost(axis, I[axis], I, dt, False)
        for m in ti.static(self.flowing):
            for p in range(self.range[m], self.range[m + 1]):
                ti.atomic_max(sums[0, 5], ti.cast(self.g2p(p, dt), ti.f64))
        for I in ti.grouped(self.grid):
            self.clear(I)

    @ti.kernel
    def report_parallel(self, position: ti.types.ndarray(ti.f32, 3), sums: ti.types.ndarray(ti.f64, 2)):
        for m in ti.static(range(len(self.models))):
            for p in range(self.range[m], self.range[m + 1]):
                self.report(m, p, 0, position, sums)

    @ti.kernel
    def load(self, data: ti.types.ndarray(ti.f32, 2), numbers: ti.types.ndarray(ti.f32, 2)):
        """Positions and velocities from [n, 2 dim], stress-free, no affine velocity; numbers as ``MPMSimulator._table`` writes them.

        One kernel for all: every transfer to a small field compiles a kernel of its own.
        """
        for _ in range(1):
            self.dx[None], self.coefficient[None] = numbers[0, 0], numbers[0, 1]
            for d in ti.static(range(self.dim)):
                self.lower[None][d], self.gravity[None][d] = numbers[1, d], numbers[2, d]
                for side in ti.static(range(2)):
                    self.extent[side][d] = ti.cast(numbers[3 + side, d], ti.i32)
            for a, lane in ti.static(ti.ndrange(3, 4)):
                self.E[a][lane] = ti.cast(numbers[5, 0], ti.f32) * float(a == lane)
            for m in ti.static(range(len(self.models))):
                self.range[m + 1] = ti.cast(numbers[6 + m, 0], ti.i32)
                self.mass_volume[m] = ti.Vector([numbers[6 + m, 1], numbers[6 + m, 2]])
                for k in ti.static(range(self.materials[m].parameters.shape[0])):
                    self.materials[m].parameters[k] = numbers[6 + m, 3 + k]
        for m in ti.static(range(len(self.models))):
            for p in range(self.range[m], self.range[m + 1]):
                self.v[p] = ti.Vector.zero(ti.f32, 4)
                for d in ti.static(range(self.dim)):
                    self.x[p][d] = data[p, d]
                    self.v[p][d] = data[p, self.dim + d]
                    self.C[d][p] = ti.Vector.zero(ti.f32, 4)
                self.v[p][self.dim] = 1.0
                self.materials[m].reset(p)
        for I in ti.grouped(self.grid):
            self.clear(I)

    @ti.kernel
    def load_rigid(self, table: ti.types.ndarray(ti.f64, 2)):
        for _ in range(1):
            self.rigid.load(table)
            for b in range(self.rigid.count[None]):
                self.rigid.write(b)

    @ti.kernel
    def keep_rigid(self, back: ti.template()):
        for _ in range(1):
            self.rigid.keep(back)

    @ti.kernel
    def load_solids(self, values: ti.types.ndarray(ti.f32, 2), table: ti.types.ndarray(ti.f32, 2)):
        """[nodes, dim + 2] in the order of the grid's indices; columns as ``column_table`` writes them."""
        for _ in range(1):
            self.columns[None] = table.shape[0]
        for k in range(table.shape[0]):
            for lane in ti.static(range(2 * self.dim + 1)):
                self.foot[k][lane] = ti.cast(table[k, lane], ti.i32)
            for lane in ti.static(range(self.dim + 2)):
                self.face[k][lane] = table[k, 2 * self.dim + 1 + lane]
        for I in ti.grouped(self.solids):
            row = 0
            for d in ti.static(range(self.dim)):
                row = row * ti.static(self.nodes[d]) + I[d]
            for lane in ti.static(range(self.dim + 2)):
                self.solids[I][lane] = values[row, lane]

    @ti.func
    def save_particle(self, p, sums: ti.template()):
        """Count it too if its nodes are not the grid's."""
        for f in ti.static(range(len(self.state))):
            self.saved[f][p] = self.state[f][p]
        astray = False
        for d in ti.static(range(self.dim)):
            x = self.x[p][d]
            astray = astray or not finite(x) or x < 0.5 or x >= float(ti.static(self.nodes[d])) - 1.5
        sums[0, 7] += ti.cast(astray, ti.f64)

    @ti.kernel
    def save(self, sums: ti.types.ndarray(ti.f64, 2)):
        for p in range(self.range[ti.static(len(self.models))]):
            self.save_particle(p, sums)

    @ti.kernel
    def restore(self):
        for p in range(self.range[ti.static(len(self.models))]):
            for f in ti.static(range(len(self.state))):
                self.state[f][p] = self.saved[f][p]
        for I in ti.grouped(self.grid):
            self.clear(I)


def _frictions(scene: Scene) -> list:
    """Of each obstacle; the walls' unless it has its own."""
    return [scene.walls.friction if obstacle.friction is None else obstacle.friction for obstacle in scene.obstacles]


def column_table(obstacles: list, frictions: list, lower: np.ndarray, dx: float, nodes: tuple[int, ...]) -> np.ndarray:
    """Where obstacles act on the grid (``_Kernels.resist``), [k, 3 dim + 3] float32: node, step, nodes behind, normal, friction, weight.

    A column starts at each node inside whose neighbour, along the main direction of its normal, is outside. Node 0 is the one of the two
    that is nearer to the surface, so that it never lacks mass where those behind have it; the column with the shallowest start has what
    several could claim. What is inside, within reach of particles, and in no column is held by itself (weight 1, step 0): corners, and all that
    is thinner than ``THICK``, lest particles beyond a plate be moved through the nodes they share. Of the latter there may be but one line, which
    serves both faces (-1 nodes behind): its normal is to the side, by the step, that has more mass on the next node.
    """
    dim, shape = len(nodes), np.array(nodes)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in nodes], indexing="ij"), -1).reshape(-1, dim)
    distance, normal, nearest = combine(obstacles, lower + (index - WALL) * dx)
    distance /= dx
    inside = distance <= 0
    friction = np.array([STICKY if kind == "sticky" else kind for kind in frictions])

    def flat(at):
        """Rows of ``index``, -1 off the grid."""
        return np.where(((at >= 0) & (at < shape)).all(-1), np.ravel_multi_index(tuple(np.moveaxis(at, -1, 0)), nodes, mode="clip"), -1)

    near = np.flatnonzero(inside & (distance > -REACH))
    near = near[np.argsort(-distance[near], kind="stable")]
    thin = np.zeros(len(index), bool)
    thin[near] = combine(obstacles, lower + (index[near] - (THICK + distance[near, None]) * normal[near] - WALL) * dx)[0] > 0
    step = (np.abs(normal[near]) == np.abs(normal[near]).max(1, keepdims=True)).cumsum(1).cumsum(1) == 1  # the first of equal ones
    step = ways = step * np.where(normal[near] > 0, 1, -1)
    out = flat(index[near] + step)
    with np.errstate(divide="ignore", invalid="ignore"):  # where the next node is as deep, or off the grid, no column starts
        depth = distance[near] / (distance[near] - distance[out])
    shallow = depth <= 0.5
    node = np.where(shallow, near, out)
    after = flat(index[node] + step)
    # A wall holds its own nodes along the step: a velocity drawn from one of them ran away, in the cell between a ramp's end and the wall.
    walled = (((index[after] <= WALL) | (index[after] >= shape - 1 - WALL)) & (step != 0)).any(1)
    starts = np.flatnonzero(~thin[near] & (out >= 0) & ~inside[out] & (after >= 0) & ~inside[after] & ~walled)
    starts = starts[np.sort(np.unique(node[starts], return_index=True)[1])]
    near_of, node, step, depth, shallow = near[starts], node[starts], step[starts], depth[starts], shallow[starts]

    claimed = np.zeros(len(index), bool)
    claimed[node] = True
    behind, growing = np.zeros(len(node), int), np.ones(len(node), bool)
    for k in range(1, BEHIND + 1):
        ghost = flat(index[node] - k * step)
        growing &= (ghost >= 0) & inside[ghost] & ~thin[ghost] & ~claimed[ghost]
        mine = np.zeros(len(node), bool)
        mine[np.flatnonzero(growing)[np.unique(ghost[growing], return_index=True)[1]]] = True
        growing &= mine
        behind[growing] = k
        claimed[ghost[growing]] = True
    _, facing, which = combine(obstacles, lower + (index[near_of] + depth[:, None] * step - WALL) * dx)
    # At an edge, or in a notch, the nearest surface may be another that faces elsewhere.
    facing = np.where((facing * step).sum(1, keepdims=True) > 0.5, facing, normal[near_of])
    weight = np.where(shallow, 1 - depth, 2 - depth)
    columns = np.column_stack([index[node], step, behind, facing, friction[which], weight])
    alone = ~claimed[near]
    held, aside = near[alone], ways[alone]
    faced = thin[held] & (flat(index[held] + aside) >= 0) & (flat(index[held] - aside) >= 0)
    rest = np.column_stack([index[held], aside * faced[:, None], -1 * faced, normal[held], friction[nearest[held]], np.ones(len(held))])
    return np.concatenate([columns, rest]).astype(np.float32)


class MPMSimulator:
    """The solver under the ``Simulator`` contract; also driven directly by ``load`` and ``frame``.

    Overrides make the rungs of a solver ladder: ``cfl`` (Courant number; default the scene's), ``stiffness`` (factor on the
    elastic moduli), ``coarsen`` (factor on the grid spacing of the recorded resolution; implies the recorded particles),
    ``particles`` ("teacher": refined as the scene says; "recorded": the tracked set alone, on the recorded grid; a number: so many times finer,
    grid and particles),
    ``perturbation`` (length: random displacement of the start, for the chaos floor), ``frames`` (that ``advance`` hands out at once, as a
    model that predicts so many does: one launch, and one plan of the time step, for all).

    A scene's ``time_step`` holds unless ``cfl`` is given. ``unguarded_step`` [s] is for ``sim.stability`` alone: a fixed step that nothing
    refuses or shortens, to see where the solver really becomes unstable. Raises ``InputError`` for overrides that cannot go together.
    """

    def __init__(
        self,
        *,
        name: str = "mpm",
        kind: Kind = "reference",
        cfl: float | None = None,
        stiffness: float = 1.0,
        coarsen: float = 1.0,
        particles: str | int = "teacher",
        perturbation: float = 0.0,
        frames: int = 1,
        serial: bool | None = None,
        unguarded_step: float | None = None,
    ):
        check_particles(name, particles)
        if frames < 1:
            raise InputError(name, "frames", frames, "must be at least 1")
        if particles != "recorded" and coarsen != 1.0:
            raise InputError(name, "coarsen", coarsen, "a coarser grid needs particles: recorded")
        self.name, self.kind = name, kind
        self.settings: dict[str, Any] = {
            "cfl": cfl,
            "stiffness": stiffness,
            "coarsen": coarsen,
            "particles": particles,
            "perturbation": perturbation,
            "frames": frames,
        }
        self.serial, self.unguarded_step = serial, unguarded_step
        self.compile_seconds = 0.0
        self._built: _Kernels | None = None

    # -- the state at frame 0
    def load(self, scene: Scene) -> None:
        """Set the state of frame 0; allocates and compiles on first use of a structure (``compile_seconds``).

        Raises ``InputError`` for a fixed time step above the limit at the start.
        """
        begun = time.perf_counter()
        if self.unguarded_step is None:
            self.check_time_step(scene, scene.name)
        arch = start_taichi()
        serial = arch == "cpu" if self.serial is None else self.serial
        particles = scene.particles(self._refine(scene))
        structure, nodes = self._structure(scene), tuple(int(c) + 2 * WALL + 1 for c in self._cells(scene))
        capacity = _capacity(len(particles.position))
        old, fresh, columns = self._built, False, self._columns(scene, nodes)
        if old is not None and (old.structure != structure or old.nodes != nodes):
            old = None
        if old is None or old.capacity < capacity or old.columns_at_most < len(columns):
            # Never less room than before, lest scenes with many particles and scenes with many columns compile anew in turns.
            room = (0, 0) if old is None else (old.capacity, old.columns_at_most)
            capacity, at_most = max(capacity, room[0]), max(_power_of_two(len(columns)), room[1])
            self._built = _Kernels(structure, capacity, nodes, at_most, serial)
            fresh = True
        assert self._built is not None
        kernels = self._kernels = self._built
        lower, upper = np.array(scene.bounds).T
        cells = self._cells(scene)
        self.dx = self._spacing(scene)
        self._scene, self._tracked = scene, particles.tracked
        position = particles.position
        if self.settings["perturbation"]:
            noise = np.random.default_rng(np.random.SeedSequence([scene.seed, 2])).normal(size=position.shape)
            for index, body in enumerate(scene.bodies):
                if scene.materials[body.material].model == "rigid":
                    noise[particles.body == index] = noise[particles.body == index][:1]
            position = position + self.settings["perturbation"] * noise
        # Where a wall stops particles during the run, it also holds the start.
        cell = np.clip((position - lower) / self.dx + WALL, WALL + HAIR, WALL + cells - HAIR)
        data = np.ascontiguousarray(np.concatenate([cell, particles.velocity], 1).astype(np.float32))
        self._acceleration, self._frame, self._boundary = scene.acceleration(), 0, scene.boundary.astype(np.float32)
        self._cfl = self._courant(scene)
        self._position = np.zeros((1, len(position), scene.dim), np.float32)
        with compiling(scene.dim) if fresh else nullcontext():
            kernels.load(data, self._table(scene, particles, cells))
            if structure.obstacles != "none":
                kernels.load_solids(self._solids(scene, nodes), columns)
            if structure.rigid:
                kernels.load_rigid(body_table(scene, particles, data[:, : scene.dim].astype(float), self.dx, WALL, structure.rigid[1], 0.25))
            if fresh:
                # Compiles all that a frame needs; the tiny step is taken back.
                self._run(int(kernels.has_rigid), 1e-9, keep=True)
                self._restore()
            self._run(0, 0.0, keep=True)
        if fresh:
            self.compile_seconds += time.perf_counter() - begun

    def _table(self, scene: Scene, particles: Particles, cells: np.ndarray) -> np.ndarray:
        """All numbers of a scene that kernels need, [6 + materials, 12] float32, a row a thing."""
        table = np.zeros((6 + len(scene.materials), 12))
        dim, friction, volume = scene.dim, scene.walls.friction, particles.spacing**scene.dim
        table[0, :2] = self.dx, 0.0 if friction == "sticky" else friction
        table[1, :dim], table[2, :dim] = np.array(scene.bounds)[:, 0], scene.gravity
        table[3, :dim], table[4, :dim] = WALL, WALL + cells
        table[5, 0] = 1.0
        ends = np.searchsorted(particles.material, np.arange(1, len(scene.materials) + 1))
        for row, (end, material) in enumerate(zip(ends, scene.materials.values(), strict=True), start=6):
            numbers = MODELS[material.model].numbers(material, dim, self.settings["stiffness"])
            table[row, : 3 + len(numbers)] = end, material.density * volume, volume, *numbers
        return table.astype(np.float32)

    def _solids(self, scene: Scene, nodes: tuple[int, ...]) -> np.ndarray:
        """Normal, distance [cells] and friction of the obstacles at each node, [nodes, dim + 2] float32."""
        lower = np.array(scene.bounds)[:, 0]
        at = lower + (np.stack(np.meshgrid(*[np.arange(n) for n in nodes], indexing="ij"), -1).reshape(-1, scene.dim) - WALL) * self.dx
        distance, normal, nearest = combine(scene.surfaces, at)
        friction = np.array([STICKY if kind == "sticky" else kind for kind in _frictions(scene)])[nearest]
        return np.concatenate([normal, distance[:, None] / self.dx, friction[:, None]], 1).astype(np.float32)

    def _columns(self, scene: Scene, nodes: tuple[int, ...]) -> np.ndarray:
        if not scene.obstacles:
            return np.zeros((0, 0), np.float32)
        return column_table(scene.surfaces, _frictions(scene), np.array(scene.bounds)[:, 0], self._spacing(scene), nodes)

    def _refine(self, scene: Scene) -> int:
        return scene.refinement(self.settings["particles"])

    def _cells(self, scene: Scene) -> np.ndarray:
        """[dim] grid cells along the box. A coarser grid whose cells would not be square is refused rather than stretched."""
        cells = np.maximum(np.rint(np.array(scene.cells) * self._refine(scene) / self.settings["coarsen"]).astype(int), 4)
        lower, upper = np.array(scene.bounds).T
        edges = (upper - lower) / cells
        if np.ptp(edges) > 1e-6 * edges[0]:
            raise InputError(scene.name, "coarsen", self.settings["coarsen"], f"does not divide the box's cells {scene.cells} alike")
        for index, obstacle in enumerate(scene.obstacles):
            thickness = getattr(obstacle, "thickness", np.inf)
            if thickness < THINNEST * edges[0] * (1 - 1e-9):
                remedy = f"thinner than {THINNEST:g} grid cells of {edges[0]:.4g}, so that particles leak through; thicken it or refine the grid"
                raise InputError(scene.name, f"obstacles[{index}].thickness", thickness, remedy)
        return cells

    def _structure(self, scene: Scene) -> Structure:
        models = tuple((material.model, *MODELS[material.model].options(material)) for material in scene.materials.values())
        friction = scene.walls.friction
        walls = "sticky" if friction == "sticky" else "coulomb" if friction > 0 else "slip"
        obstacles = "none" if not scene.obstacles else "slip" if all(kind == 0 for kind in _frictions(scene)) else "coulomb"
        rigid = [body for body in scene.bodies if scene.materials[body.material].model == "rigid"]
        faces = max((len(body.vertices) if body.vertices else 6 for body in rigid), default=0)
        # Rounded up, so that scenes of a family share their kernels.
        limits = (_power_of_two(len(rigid)), 6 if faces <= 6 else _power_of_two(faces)) if rigid else None
        return Structure(scene.dim, models, walls, obstacles, scene.container is not None, limits)

    def _courant(self, scene: Scene) -> float:
        return self.settings["cfl"] or scene.cfl

    def _rings(self, scene: Scene) -> bool:
        """Whether some material resists when it is parted, so that a particle alone on the grid is an oscillator (``LONE_PARTICLE``)."""
        return any(MODELS[material.model].rings(material) for material in scene.materials.values())

    def _spacing(self, scene: Scene) -> float:
        lower, upper = np.array(scene.bounds).T
        return float((upper[0] - lower[0]) / self._cells(scene)[0])

    def limits(self, scene: Scene, dx: float, wave_speed: float, speed: float) -> dict[str, float]:
        """Bounds on the time step [s] on a grid of spacing dx, at a wave speed and a speed of particles [m/s], by what sets them:

        cfl dx / (c + |v|); ``LARGEST_COURANT`` dx / c; dx^2 / (2 d nu), the viscosity of each viscous material;
        ``LONE_PARTICLE`` dx / (sqrt(d) c).
        """
        tiny = np.finfo(float).tiny
        found = {
            "the Courant number": self._courant(scene) * dx / max(wave_speed + speed, tiny),
            "sound across a cell": LARGEST_COURANT * dx / max(wave_speed, tiny),
        }
        for name, material in scene.materials.items():
            found[f"the viscosity of {name}"] = MODELS[material.model].largest_step(material, scene.dim, dx)
        if self._rings(scene):
            found["a particle alone on the grid"] = LONE_PARTICLE * dx / max(np.sqrt(scene.dim) * wave_speed, tiny)
        return found

    def _at_start(self, scene: Scene, speed: float) -> tuple[float, float]:
        """Wave speed of the unstrained materials, and ``speed`` with what gravity adds within the first frame."""
        wave_speed = max(MODELS[material.model].rest_wave_speed(material, self.settings["stiffness"]) for material in scene.materials.values())
        return wave_speed, speed + float(np.linalg.norm(np.array(scene.gravity) - scene.acceleration()[0])) * scene.frame_step

    def check_time_step(self, scene: Scene, where: object) -> None:
        """Refuse a fixed time step above the limit that the materials, at rest, and the bodies' own speeds set. Raises ``InputError``."""
        if scene.time_step is None or self.settings["cfl"]:
            return
        wave_speed, speed = self._at_start(scene, max(float(np.linalg.norm(body.velocity)) for body in scene.bodies))
        limits = self.limits(scene, self._spacing(scene), wave_speed, speed)
        what = min(limits, key=limits.__getitem__)
        if scene.time_step > limits[what] * (1 + 1e-6):
            steps = int(np.ceil(scene.frame_step / limits[what]))
            remedy = (
                f"above the limit {limits[what]:.4g} s, which {what} sets (cfl {self._courant(scene):g}, {scene.dim}D, "
                f"wave speed {wave_speed:.4g} m/s, speed {speed:.3g} m/s); use at most {scene.frame_step / steps:.8g}, "
                f"{steps} steps a frame, or leave it out: adaptive"
            )
            raise InputError(where, "time_step", scene.time_step, remedy)

    def plan(self, scene: Scene) -> dict:
        """What ``load`` would build for a scene, without building it.

        kernels: names; fields: name -> [bytes an entry, entries]; left_out: name -> reason; bytes; particles; recorded; cells;
        substeps_per_frame: (at rest, at the speed of a fall through the whole box).
        """
        structure = self._structure(scene)
        dim, models, friction = structure.dim, structure.models, structure.friction
        particles, cells = scene.particles(self._refine(scene)), self._cells(scene)
        lower, upper = np.array(scene.bounds).T
        dx = self._spacing(scene)
        n, nodes = _capacity(len(particles.position)), int(np.prod(cells + 2 * WALL + 1))
        particle_fields = {"x": dim, "v": 4, **{f"C{axis}": 4 for axis in range(dim)}}
        left_out = {"third dimension": "a 2D scene"} if dim == 2 else {}
        for name, material in scene.materials.items():
            model = MODELS[material.model]
            particle_fields |= {f"{name}.{field}": width for field, width in model.state(dim).items()}
            left_out |= {f"{what} of {name}": reason for what, reason in (model.left_out | model.omissions(material)).items()}
        if len(models) == 1:
            left_out["material of a particle"] = "one material"
        kernels = ["load", "restore", "frame_serial"]
        if structure.obstacles == "none":
            left_out["signed distance"] = "no obstacles"
        if not structure.shaken:
            left_out["changing gravity"] = "the container stands still"
        if structure.obstacles == "slip":
            left_out["obstacle friction"] = "slip obstacles"
        context = scene.context_values()
        if context is None:
            left_out["context"] = "no moving container, no varying parameter"
        if friction == "slip":
            left_out["wall friction"] = "slip walls"
        fields = {name: (4 * width, n) for name, width in particle_fields.items()}
        fields |= {f"saved {name}": entry for name, entry in fields.items()}
        fields["grid"] = (16, nodes)
        if structure.obstacles != "none":
            fields["signed distance"] = (4 * (dim + 2), nodes)
            columns = _power_of_two(len(self._columns(scene, tuple(int(c) + 2 * WALL + 1 for c in cells))))
            fields |= {
                "obstacle foot": (4 * (2 * dim + 1), columns),
                "obstacle face": (4 * (dim + 2), columns),
                "obstacle impulse": (4 * (dim + 2), columns),
            }
            kernels.append("load_solids")
        if structure.rigid is None:
            left_out["rigid bodies"] = "none in the scene"
        else:
            fields |= RigidBodies.sizes(dim, *structure.rigid, n, nodes)
            kernels.remove("frame_serial")
            kernels += [
                "save",
                "spread_serial",
                "meet_rigid",
                "solve_rigid",
                "move_rigid",
                "collect_serial",
                "report_parallel",
                "load_rigid",
                "keep_rigid",
            ]
        gravity = float(np.linalg.norm(np.array(scene.gravity) - scene.acceleration(), axis=1).max())
        start = float(np.sqrt((particles.velocity**2).sum(1).max()))
        fall = float(np.sqrt(start**2 + 2 * gravity * np.linalg.norm(upper - lower)))
        wave_speed, _ = self._at_start(scene, 0.0)
        substeps = [self._substeps(scene, dx, wave_speed, v + gravity * scene.frame_step) for v in (0.0, fall)]
        return {
            "title": "MLS-MPM",
            "dim": dim,
            "materials": [name for name, *_ in models],
            "rates": [name for name, *_ in models],
            "walls": friction,
            "obstacles": len(scene.obstacles),
            "context": 0 if context is None else context.shape[1],
            "kernels": kernels,
            "fields": fields,
            "left_out": left_out,
            "bytes": sum(size * count for size, count in fields.values()),
            "particles": len(particles.position),
            "recorded": len(particles.tracked) + len(scene.boundary),
            "kinematic": len(scene.boundary),
            "cells": cells.tolist(),
            "grid_spacing": dx,
            "wave_speed": wave_speed,
            "substeps_per_frame": substeps,
        }

    def _run(self, substeps: int, dt: float, keep: bool, frames: int = 1) -> np.ndarray:
        """Frames of as many steps; ``_position`` [frames, particles, dim] and what they add up to, [frames, SUMS + dim]."""
        number = np.minimum(self._frame + np.arange(frames), len(self._acceleration) - 1)
        sums = np.concatenate([np.zeros((frames, SUMS)), self._acceleration[number]], 1)
        if len(self._position) != frames:
            self._position = np.zeros((frames, *self._position.shape[1:]), np.float32)
        self._kernels.frame(frames, substeps, dt, int(keep), self._position, sums)
        kinetic, potential, elastic, speed, wave_speed = sums[-1, :5].tolist()
        self._diagnostics = {
            "kinetic_energy": kinetic,
            "potential_energy": potential,
            "elastic_energy": elastic,
            "max_speed": float(np.sqrt(speed)),
            "wave_speed": wave_speed,
            "substeps": float(substeps),
            "dt": dt,
        }
        return sums

    def _fixed(self, scene: Scene) -> float | None:
        """The fixed time step [s], None for an adaptive one."""
        return self.unguarded_step or (None if self.settings["cfl"] else scene.time_step)

    def _substeps(self, scene: Scene, dx: float, wave_speed: float, speed: float) -> int:
        """Of a frame: as many as the fixed step asks for, else the fewest that obey the ``limits``."""
        fixed = self._fixed(scene)
        if fixed is not None:
            return max(1, round(scene.frame_step / fixed))
        return max(1, int(np.ceil(scene.frame_step / min(self.limits(scene, dx, wave_speed, speed).values()))))

    def frame(self) -> np.ndarray:
        """Advance one frame; positions of the recorded particles, kinematic ones last, [n, dim] float32. Raises ``SimulationError``.

        dt obeys the ``limits`` at the current wave speed, the current speed and what gravity can add to it within the frame; substeps
        divide the frame exactly. A frame whose Courant number outgrew the plan is taken back and repeated with half the step; where the
        step is fixed, it ends the trajectory.
        """
        scene, fixed = self._scene, self._fixed(self._scene)
        substeps = self._planned(1)
        for attempt in range(1 if fixed else MAX_HALVINGS + 1):
            dt = scene.frame_step / substeps
            sums = self._run(substeps, dt, keep=attempt == 0)[0]
            if sums[7] > 0:
                raise SimulationError(self._sick() or "a particle is off the grid")
            if self._acceptable(sums, dt):
                self._frame += 1
                return self._recorded()[0]
            self._restore()
            substeps *= 2
        why = f"the fixed time step {dt:.3g} s gave no" if fixed else f"time step fell below {dt:.3g} s without a"
        raise SimulationError(self._sick() or f"{why} finite, stable frame")

    def _planned(self, frames: int) -> int:
        """Substeps a frame by what is known and what gravity can add to the speed within so many frames."""
        scene, known = self._scene, self._diagnostics
        number = np.minimum(self._frame + np.arange(frames), len(self._acceleration) - 1)
        reach = float(np.linalg.norm(scene.gravity - self._acceleration[number], axis=1).sum()) * scene.frame_step
        return self._substeps(scene, self.dx, known["wave_speed"], known["max_speed"] + reach)

    def _recorded(self) -> np.ndarray:
        """[frames, recorded particles, dim]: of what ran last, kinematic ones last."""
        moving = self._position[:, self._tracked]
        return np.concatenate([moving, np.broadcast_to(self._boundary, (len(moving), *self._boundary.shape))], 1)

    def _sick(self) -> str | None:
        """What of the state no frame can begin with: the first that is not finite, or particles off the grid. None if it is sound."""
        state = {name: values.reshape(len(values), -1) for name, values in self.state().items()}
        wrong = {name: np.flatnonzero(~np.isfinite(values).all(1)) for name, values in state.items()}
        for name, particles in wrong.items():
            if len(particles):
                return f"{name} of particle {particles[0]} is not finite" + (f", nor of {len(particles) - 1} others" if len(particles) > 1 else "")
        lower, upper = np.array(self._scene.bounds).T
        away = np.flatnonzero(((state["position"] < lower - self.dx / 2) | (state["position"] > upper + self.dx / 2)).any(1))
        if len(away):
            return f"particle {away[0]} is off the grid, at {state['position'][away[0]].round(3).tolist()}"
        return None

    def _acceptable(self, sums: np.ndarray, dt: float) -> bool:
        """Whether a frame's ``SUMS`` are finite and, unless nothing guards the step, within the limits that it was planned for."""
        if not np.isfinite(sums).all() or sums[6]:
            return False
        speed, wave_speed = float(np.sqrt(max(sums[3], sums[5]))), sums[4]
        steady = dt * (speed + wave_speed) <= COURANT_GROWTH * self._cfl * self.dx and dt * speed <= self.dx
        rings = self._rings(self._scene) and dt * wave_speed * np.sqrt(self._scene.dim) > self.dx
        return self.unguarded_step is not None or (steady and not rings)

    def _restore(self) -> None:
        self._kernels.restore()
        if self._kernels.has_rigid:
            self._kernels.keep_rigid(True)

    def state(self) -> dict[str, np.ndarray]:
        """All simulated particles, in float64: ``position`` [length], ``velocity`` [length/s], [n, dim] each, ``velocity gradient`` [1/s]
        [n, dim, dim], and what materials carry, named as in ``plan``: [particles of that material] or [particles of that material, floats]."""
        kernels, scene, n = self._kernels, self._scene, self._position.shape[1]
        lower, ends = np.array(scene.bounds)[:, 0], kernels.range.to_numpy()
        found = {"position": lower + (kernels.x.to_numpy()[:n].astype(float) - WALL) * self.dx}
        found["velocity"] = kernels.v.to_numpy()[:n, : scene.dim].astype(float)
        found["velocity gradient"] = np.stack([column.to_numpy()[:n, : scene.dim] for column in kernels.C], -1).astype(float)
        for m, ((name, material), model) in enumerate(zip(scene.materials.items(), kernels.materials, strict=True)):
            for key, field in zip(MODELS[material.model].state(scene.dim), model.fields(), strict=True):
                found[f"{name}.{key}"] = field.to_numpy()[ends[m] : ends[m + 1]].astype(float)
        return found

    def set_velocity(self, velocity: np.ndarray) -> None:
        """Replace the velocities [n, dim] of all particles; affine parts become zero. For starts that no scene describes."""
        kernels, (n, dim) = self._kernels, velocity.shape
        lanes = np.zeros((kernels.capacity, 4), np.float32)
        for column in kernels.C:
            column.from_numpy(lanes)
        lanes[:n, :dim], lanes[:n, dim] = velocity, 1.0
        kernels.v.from_numpy(lanes)
        self._run(0, 0.0, keep=True)

    def inject(self, name: str, particle: int | np.ndarray, value) -> None:
        """Overwrite what ``state`` gives for one particle under a name (a material's: counted within it), positions in cells. For studies of
        what happens then."""
        kernels, dim = self._kernels, self._scene.dim
        if name == "velocity gradient":
            fields: list[tuple] = [(kernels.C[axis], slice(dim), column) for axis, column in enumerate(np.broadcast_to(value, (dim, dim)).T)]
        elif name in ("position", "velocity"):
            fields = [({"position": kernels.x, "velocity": kernels.v}[name], slice(dim), value)]
        else:
            stuff, key = name.split(".")
            m = list(self._scene.materials).index(stuff)
            particle = particle + int(kernels.range.to_numpy()[m])
            state = list(MODELS[self._scene.materials[stuff].model].state(dim))
            fields = [(kernels.materials[m].fields()[state.index(key)], Ellipsis, value)]
        for field, lanes, content in fields:
            whole = field.to_numpy()
            whole[particle, lanes] = content
            field.from_numpy(whole)

    def diagnostics(self) -> dict[str, float]:
        """Energies [J per unit depth in 2D], max speed and wave speed [m/s], substeps and dt [s] of the current frame."""
        return dict(self._diagnostics)

    # -- the Simulator contract
    def begin(self, start: Start) -> None:
        """Run the known frames from the scene's own start, so that the solver stands where the history ends."""
        self.load(Scene.of(start))
        for _ in range(start.present):
            self.frame()

    def advance(self) -> np.ndarray:
        """The next ``frames`` frames, all of as many substeps; one by one where that does not do."""
        frames, known = self.settings["frames"], self._diagnostics
        if frames == 1:
            return self.frame()[None]
        substeps = self._planned(frames)
        dt = self._scene.frame_step / substeps
        sums = self._run(substeps, dt, keep=True, frames=frames)
        if not sums[0, 7] and all(self._acceptable(row, dt) for row in sums):
            self._frame += frames
            return self._recorded()
        if not sums[0, 7]:
            self._restore()
        self._diagnostics = known
        return np.stack([self.frame() for _ in range(frames)])
