"""Rigid bodies among the particles of the grid: exact shape, two-way coupling, contacts by impulses.

A body is not on the grid. Points of its faces, where its outermost particles project, are contacts with the grid's velocity there:

    v(q) = sum_i w_i v_i,  (V(q) - v(q)).n >= -gap / tau,

w_i the splines' weights, none above the node's share of a full cell's mass, and made to add up to 1. An impulse J on the body acts at
sum_i w_i x_i and is taken from the nodes as w_i J. So linear and angular momentum are what they were, exactly, and energy only falls: every step of
the solver is a projection. The nodes that carry water into the body are thus left to extrapolate its motion up to the face, as ghosts do
behind walls, wherever the face stands between nodes, and the pressure of water at rest, sum_i p w_i(q), meets J of its own form.
Formerly each node was the body's or the water's, by half its volume; a held box felt 3 to 7 % too little buoyancy, four cells high, and 9 to 18 %,
two cells high (``sim.validation.float_and_sink.buoyancy`` has today's). Weights above a node's share let nodes that water hardly
reaches take up the push: a neutral box on 64 cells drifted up to twelve times as far in still water.

Contact at a distance would hold water off, and sound rectify it: boxes floated a fifth of a cell too high. The gap is what half a cell's mass lacks
at the point, a half-space of water having exactly a half there, closed in 1 / ``CLOSE`` substeps. At outer corners, with three quarters of
the space water's, it is not seen. Drops weigh too little to be a contact; they and what slips through between points are put back on the
face, inelastically, before every substep (``expel``).

The moment of inertia is I = sum_p m (|r|^2 1 - r r^T) and that of the particles as cubes of edge h, h^2 / 12 along each axis: exact for a box.
Two and three dimensions share the code: a 2D body is a 3D one that turns about z.

Walls and obstacles act on the *body* too. Contacts are points: a particle, a ball half a spacing thick, against a wall, a signed distance or
the faces of another body, u.n >= -gap / dt (inelastic; no approach beyond the gap), |J_t| <= mu J_n, solved with those of the grid by projected
Gauss-Seidel (Catto 2005) with accumulated impulses. What rounding and rotation leave of a penetration into walls and obstacles is taken off by
shifting the body; bodies that got into one another are not parted.
Everywhere mu is the walls' coefficient, an obstacle's own on it.

Positions and r are in cells, velocities in m/s, spin in 1/s, moments of inertia in kg cells^2. All vectors have three lanes.
"""

import numpy as np
from scipy.spatial import ConvexHull

from sim.scene import Scene
from sim.taichi_runtime import ti

#: Sweeps of the contact solver at most, and the change of an impulse, relative to the largest, at which it is done. With 60 a stone on wood sank
#: half a cell into it in ten seconds.
SWEEPS, SETTLED = 300, 1e-3
#: Contacts are listed from this gap on [cells], in addition to a substep's way.
NEAR = 0.1
#: Distance from a wall, in cells, at which particles are stopped.
HAIR = 1e-4
#: Friction coefficient of sticky walls and obstacles.
NO_SLIP = 1e9
#: Stands for the second body of a contact with the grid.
GRID = -2
#: Over-relaxation of contacts with the grid, whose points overlap: half the sweeps. Energy falls with any below 2.
OVER = 1.4
#: A point of a face is a contact where the nodes around it have this share of a cell's mass.
PRESENT = 0.02
#: What that share loses a cell of gap, near 0.5 of no gap: the autocorrelation of the splines at 0.
SLOPE = 0.55
#: Share of a gap that water may close in a substep.
CLOSE = 0.05
#: Squared speed that stands for contacts beyond the list's end: its frame is taken back and repeated with half the step, whose gaps close
#: fewer, until the trajectory fails.
OVERFLOW = 1e30
#: Columns of the table that ``load`` takes, before the planes.
COLUMNS = 24


def contacts_at_most(capacity: int) -> int:
    """Entries of the list of contacts."""
    return max(capacity, 1 << 12)


@ti.func
def lift(v):
    """A vector of 2 or 3 entries as one of 3."""
    result = ti.Vector.zero(ti.f32, 3)
    for d in ti.static(range(v.n)):
        result[d] = v[d]
    return result


@ti.func
def rotation(q):
    """Matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ti.Matrix([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


@ti.func
def turned(q, angle):
    """Quaternion after a rotation by the vector ``angle`` [radians]; exact for any angle, renormalised."""
    half = 0.5 * angle.norm()
    # sin(h) / (2 h) with its limit at 0.
    s = 0.5 * (1.0 - half * half / 6.0)
    if half > 1e-2:
        s = 0.5 * ti.sin(half) / half
    a, b = ti.cos(half), s * angle
    w, v = q[0], ti.Vector([q[1], q[2], q[3]])
    u = a * v + w * b + b.cross(v)
    r = ti.Vector([a * w - b.dot(v), u[0], u[1], u[2]])
    return r / r.norm()


@ti.data_oriented
class RigidBodies:
    """State of up to ``capacity`` bodies; ``kernels``: the solver's fields and functions (particles, grid, walls, obstacles)."""

    def __init__(self, kernels, capacity: int, planes: int, contacts: int):
        self.kernels, self.dim = kernels, kernels.dim
        self.capacity, self.planes_at_most = capacity, planes
        self.water = ti.Vector.field(self.dim + 1, ti.f32, kernels.nodes)  # of a node at a face: velocity while contacts are solved, 1 / mass
        self.rest = ti.Vector.field(self.dim, ti.f32, kernels.capacity)  # a particle's place in its body
        self.count, self.touching = ti.field(ti.i32, ()), ti.field(ti.i32, ())
        self.half = ti.field(ti.f32, ())  # half a particle spacing, cells
        self.span = ti.Vector.field(2, ti.i32, capacity)  # particles span[0] .. span[1]
        self.mass, self.reach, self.radius = (ti.field(ti.f32, capacity) for _ in range(3))  # kg a particle; cells; cells, 0 without
        self.centre, self.velocity, self.spin = (ti.Vector.field(3, ti.f32, capacity) for _ in range(3))
        self.turn = ti.Vector.field(4, ti.f32, capacity)
        self.inertia, self.inverse = ti.Matrix.field(3, 3, ti.f32, capacity), ti.Matrix.field(3, 3, ti.f32, capacity)  # in the body; in space
        self.rest_inverse = ti.Matrix.field(3, 3, ti.f32, capacity)
        self.state = [self.centre, self.velocity, self.spin, self.turn]
        self.saved = [ti.Vector.field(field.n, ti.f32, capacity) for field in self.state]
        self.planes = ti.Vector.field(4, ti.f32, (capacity, planes))  # outward normal, offset from the centre; in the body
        self.faces = ti.field(ti.i32, capacity)
        self.pair = ti.Vector.field(2, ti.i32, contacts)  # bodies; the second is -1 for what does not move
        self.at, self.normal = ti.Vector.field(3, ti.f32, contacts), ti.Vector.field(4, ti.f32, contacts)  # normal and least approach
        self.impulse = ti.Vector.field(4, ti.f32, contacts)  # impulse on the first body, friction coefficient
        self.spot = ti.Vector.field(5, ti.f32, contacts)  # with the grid: place on the face, 1 / sum of the weights, softness

    def motion(self) -> dict[str, np.ndarray]:
        """Centres [cells], velocities [m/s], spins [1/s], each [bodies, 3], and unit quaternions "turn" [bodies, 4]."""
        return {name: getattr(self, name).to_numpy() for name in ("centre", "velocity", "spin", "turn")}

    def set_motion(self, motion: dict[str, np.ndarray]) -> None:
        """Replace what ``motion`` gives; particles of the bodies follow in the next substep. For studies of bodies that are held or driven."""
        for name, values in motion.items():
            getattr(self, name).from_numpy(values)

    @staticmethod
    def sizes(dim: int, bodies: int, planes: int, capacity: int, nodes: int) -> dict[str, tuple[int, int]]:
        """Fields with more than a few entries: name -> (bytes an entry, entries), as ``MPMSimulator.plan`` lists them."""
        rigid = {"span": 8, "mass": 4, "reach": 4, "radius": 4, "centre": 12, "velocity": 12, "spin": 12, "turn": 16, "inertia": 36, "inverse": 36,
                 "rest inverse": 36, "faces": 4, "saved centre": 12, "saved velocity": 12, "saved spin": 12, "saved turn": 16}
        contact = {"pair": 8, "at": 12, "normal": 16, "impulse": 16, "spot": 20}
        return ({f"rigid {name}": (size, bodies) for name, size in rigid.items()} | {"rigid planes": (16, bodies * planes)}
                | {"rigid rest": (4 * dim, capacity), "rigid water": (4 * dim + 4, nodes)}
                | {f"contact {name}": (size, contacts_at_most(capacity)) for name, size in contact.items()})

    # -- set-up
    @ti.func
    def load(self, table: ti.template()):
        """``table`` [1 + bodies, ...] as ``body_table`` writes it."""
        self.count[None], self.half[None] = ti.cast(table[0, 0], ti.i32), ti.cast(table[0, 1], ti.f32)
        for b in range(self.count[None]):
            self.span[b] = ti.Vector([ti.cast(table[b + 1, 0], ti.i32), ti.cast(table[b + 1, 1], ti.i32)])
            self.mass[b], self.reach[b], self.radius[b] = table[b + 1, 2], table[b + 1, 3], table[b + 1, 4]
            self.faces[b] = ti.cast(table[b + 1, 5], ti.i32)
            for d in ti.static(range(3)):
                self.centre[b][d], self.velocity[b][d], self.spin[b][d] = table[b + 1, 6 + d], table[b + 1, 9 + d], 0.0
                for e in ti.static(range(3)):
                    self.inertia[b][d, e] = table[b + 1, 12 + 3 * d + e]
            self.rest_inverse[b] = self.inertia[b].inverse()
            self.turn[b] = ti.Vector([1.0, 0.0, 0.0, 0.0])
            for k in range(self.faces[b]):
                for lane in ti.static(range(4)):
                    self.planes[b, k][lane] = table[b + 1, COLUMNS + 4 * k + lane]
            self.refresh(b)
            for p in range(self.span[b][0], self.span[b][1]):
                for d in ti.static(range(self.dim)):
                    self.rest[p][d] = self.kernels.x[p][d] - self.centre[b][d]

    @ti.func
    def keep(self, back: ti.template()):
        """Save the bodies' state, or take it ``back``."""
        for b in range(self.count[None]):
            for f in ti.static(range(len(self.state))):
                if ti.static(back):
                    self.state[f][b] = self.saved[f][b]
                else:
                    self.saved[f][b] = self.state[f][b]
            if ti.static(back):
                self.refresh(b)

    @ti.func
    def refresh(self, b):
        """Inverse inertia in space, R I^-1 R^T."""
        R = rotation(self.turn[b])
        self.inverse[b] = R @ self.rest_inverse[b] @ R.transpose()

    # -- one substep
    @ti.func
    def meet(self, dt):
        """Gravity, and the contacts that the motion makes. ``solve`` follows, then ``advance``; all on one thread."""
        for b in range(self.count[None]):
            for d in ti.static(range(self.dim)):
                self.velocity[b][d] += dt * self.kernels.pull[None][d]
        self.find_contacts(dt)
        self.find_water(dt)

    @ti.func
    def advance(self, dt):
        """To the bodies' new places; returns the largest squared speed of a particle, one that no frame passes if contacts were too many to list."""
        self.give()
        fastest = 0.0
        for b in range(self.count[None]):
            self.move(b, dt)
            self.shift_inside(b)
            fastest = ti.max(fastest, self.write(b))
        if self.touching[None] > self.pair.shape[0]:
            fastest = OVERFLOW
        return fastest

    @ti.func
    def node(self, base, fx, n):
        """The n-th of the nodes around a place, and its weight."""
        node, weight, rest = base, 1.0, n
        for d in ti.static(range(self.dim)):
            k = rest % 3
            rest = rest // 3
            node[d] = base[d] + k
            weight *= self.kernels.weights(fx[d])[k]
        return node, weight

    @ti.func
    def flat(self, at):
        """A place of three lanes as the grid takes it."""
        x = ti.Vector.zero(ti.f32, self.dim)
        for d in ti.static(range(self.dim)):
            x[d] = at[d]
        return x

    @ti.func
    def find_water(self, dt):
        """Contacts with the grid: the feet, on each face, of particles within a spacing of it. Where faces meet at an obtuse angle, feet beyond
        the edge are none: with 48 sides, a body of half a cell more floated a fifth of its radius too high."""
        cell = self.cell_mass()
        half = self.half[None]
        for b in range(self.count[None]):
            R = rotation(self.turn[b])
            round_ = self.radius[b] > 0.0
            for p in range(self.span[b][0], self.span[b][1]):
                X = lift(self.rest[p])
                for k in range(ti.select(round_, 1, self.faces[b])):
                    n, offset = ti.Vector([self.planes[b, k][0], self.planes[b, k][1], self.planes[b, k][2]]), self.planes[b, k][3]
                    if round_:
                        n = X / ti.max(X.norm(), 1e-6)
                        offset = self.radius[b]
                    beyond = X.dot(n) - offset
                    if beyond > -2.0 * half:
                        foot, on = X - beyond * n, True
                        for other in range(self.faces[b]):
                            plane = self.planes[b, other]
                            on = on and foot.dot(ti.Vector([plane[0], plane[1], plane[2]])) - plane[3] < 1e-3
                        if on:
                            self.wet(b, self.centre[b] + R @ foot, -(R @ n), cell, dt)

    @ti.func
    def wet(self, b, at, normal, cell, dt):
        """List a point of a face, ``normal`` into the body, as a contact with the grid, and note its nodes' velocities."""
        base, fx = self.kernels.locate(self.flat(at))
        total, mass, soft, moved = 0.0, 0.0, 0.0, ti.Vector.zero(ti.f32, 3)
        for n in range(3**self.dim):
            node, weight = self.node(base, fx, n)
            m = self.kernels.grid[node][self.dim]
            mass += weight * m
            w = ti.min(weight, m / cell)
            if m > 0.0:
                total += w
                soft += w * w / m
                moved += w * lift(ti.cast(node, ti.f32))
        if mass > PRESENT * cell:
            k = ti.atomic_add(self.touching[None], 1)
            if k < self.pair.shape[0]:
                rough = self.kernels.coefficient[None] if ti.static(self.kernels.friction != "sticky") else NO_SLIP
                self.pair[k] = ti.Vector([b, GRID])
                self.at[k] = moved / total
                gap = ti.max(0.5 - mass / cell, 0.0) / SLOPE
                self.normal[k] = ti.Vector([normal[0], normal[1], normal[2], -CLOSE * gap * self.kernels.dx[None] / dt])
                self.impulse[k] = ti.Vector([0.0, 0.0, 0.0, rough])
                self.spot[k] = ti.Vector([at[0], at[1], at[2], 1.0 / total, soft / (total * total)])
                for n in range(3**self.dim):
                    node, weight = self.node(base, fx, n)
                    value = self.kernels.grid[node]
                    m = value[self.dim]
                    if m > 0.0:
                        for d in ti.static(range(self.dim)):
                            self.water[node][d] = value[d] / m + dt * self.kernels.pull[None][d]
                        self.water[node][self.dim] = 1.0 / m

    @ti.func
    def share(self, k, n, cell):
        """The n-th node of a contact with the grid, and its part in it; 0 without mass."""
        base, fx = self.kernels.locate(self.flat(self.spot[k]))
        node, weight = self.node(base, fx, n)
        inverse = self.water[node][self.dim]
        part = 0.0
        if inverse > 0.0:
            part = ti.min(weight, 1.0 / (inverse * cell)) * self.spot[k][3]
        return node, part

    @ti.func
    def cell_mass(self):
        """Of a full cell of the lightest material [kg]."""
        cell = 1e30
        for m in ti.static(self.kernels.flowing):
            cell = ti.min(cell, self.kernels.mass_volume[m][0] / self.kernels.mass_volume[m][1])
        return cell * self.kernels.dx[None] ** self.dim

    @ti.func
    def give(self):
        """To the grid what its contacts took."""
        cell = self.cell_mass()
        for k in range(ti.min(self.touching[None], self.pair.shape[0])):
            if self.pair[k][1] == GRID:
                for n in range(3**self.dim):
                    node, part = self.share(k, n, cell)
                    for d in ti.static(range(self.dim)):
                        self.kernels.grid[node][d] -= part * self.impulse[k][d]

    @ti.func
    def touch(self, b, other, at, normal, gap, friction, dt):
        """List a contact if this substep's motion may close the gap."""
        dx = self.kernels.dx[None]
        speed = self.velocity[b].norm() + dx * self.spin[b].norm() * self.reach[b]
        if other >= 0:
            speed += self.velocity[other].norm() + dx * self.spin[other].norm() * self.reach[other]
        if gap < NEAR + dt / dx * speed:
            k = ti.atomic_add(self.touching[None], 1)
            if k < self.pair.shape[0]:
                self.pair[k] = ti.Vector([b, other])
                self.at[k] = at
                self.normal[k] = ti.Vector([normal[0], normal[1], normal[2], -ti.max(gap, 0.0) * dx / dt])
                self.impulse[k] = ti.Vector([0.0, 0.0, 0.0, friction])

    @ti.func
    def outside(self, b, at):
        """Signed distance [cells] of a place from a body's surface, and the outward normal there."""
        R = rotation(self.turn[b])
        X = R.transpose() @ (at - self.centre[b])
        length = X.norm()
        distance, normal = length - self.radius[b], X / ti.max(length, 1e-6)
        if self.radius[b] <= 0.0:
            distance = -1e9
            for k in range(self.faces[b]):
                n = ti.Vector([self.planes[b, k][0], self.planes[b, k][1], self.planes[b, k][2]])
                beyond = n.dot(X) - self.planes[b, k][3]
                if beyond > distance:
                    distance = beyond
                    normal = n
        return distance, R @ normal

    @ti.func
    def expel(self, p, mass):
        """A particle that got into a body goes to its surface and, inelastically, on with it; the body takes what that changes of its momentum."""
        x = self.kernels.x[p]
        at = lift(x)
        for b in range(self.count[None]):
            if (at - self.centre[b]).norm() < self.reach[b] + 1.0:
                distance, normal = self.outside(b, at)
                if distance < 0.0:
                    u = self.point_velocity(b, at)
                    approach = 0.0
                    for d in ti.static(range(self.dim)):
                        approach += normal[d] * (self.kernels.v[p][d] - u[d])
                        low, high = ti.cast(self.kernels.extent[0][d], ti.f32) + HAIR, ti.cast(self.kernels.extent[1][d], ti.f32) - HAIR
                        self.kernels.x[p][d] = ti.min(ti.max(x[d] - distance * normal[d], low), high)
                    if approach < 0.0:
                        arm, own = (at - self.centre[b]).cross(normal), 1.0 / self.weight(b)
                        J = approach / (1.0 / mass + own + arm.dot(self.inverse[b] @ arm)) * normal
                        self.velocity[b] += own * J
                        self.spin[b] += self.inverse[b] @ (at - self.centre[b]).cross(J) / self.kernels.dx[None]
                        for d in ti.static(range(self.dim)):
                            self.kernels.v[p][d] -= J[d] / mass

    @ti.func
    def weight(self, b):
        """Mass of a body [kg]."""
        return self.mass[b] * ti.cast(self.span[b][1] - self.span[b][0], ti.f32)

    @ti.func
    def find_contacts(self, dt):
        half = self.half[None]
        # Where there is something that flows, walls and obstacles stop bodies a particle's width off: room for it to get under, and push.
        film = half
        if ti.static(len(self.kernels.flowing) > 0):
            film = 3.0 * half
        self.touching[None] = 0
        for b in range(self.count[None]):
            for p in range(self.span[b][0], self.span[b][1]):
                x = self.kernels.x[p]
                at = lift(x)
                # A loop at run time, here and elsewhere: every copy of ``touch`` in the code costs a second of compilation.
                for face in range(2 * self.dim):
                    axis, side = face // 2, face % 2
                    inward = ti.Vector.zero(ti.f32, 3)
                    inward[axis] = 1.0 - 2.0 * side
                    gap = (x[axis] - ti.cast(self.kernels.extent[side][axis], ti.f32)) * inward[axis] - film
                    rough = self.kernels.coefficient[None] if ti.static(self.kernels.friction != "sticky") else NO_SLIP
                    self.touch(b, -1, at, inward, gap, rough, dt)
                if ti.static(self.kernels.structure.obstacles != "none"):
                    clear, out = self.kernels.clearance(x)
                    friction = self.kernels.solids[ti.cast(x + 0.5, ti.i32)][self.dim + 1]
                    self.touch(b, -1, at, lift(out), clear - film, friction if friction >= 0.0 else NO_SLIP, dt)
                rough = self.kernels.coefficient[None] if ti.static(self.kernels.friction != "sticky") else NO_SLIP
                for other in range(self.count[None]):
                    if other != b and (at - self.centre[other]).norm() < self.reach[other] + half + 1.0:
                        distance, normal = self.outside(other, at)
                        self.touch(b, other, at, normal, distance - half, rough, dt)

    @ti.func
    def point_velocity(self, b, at):
        return self.velocity[b] + self.kernels.dx[None] * self.spin[b].cross(at - self.centre[b])

    @ti.func
    def slip(self, k):
        """Velocity of the first body's contact point relative to the second's."""
        a, b = self.pair[k][0], self.pair[k][1]
        u = self.point_velocity(a, self.at[k])
        if b >= 0:
            u -= self.point_velocity(b, self.at[k])
        elif b == GRID:
            cell = self.cell_mass()
            for n in range(3**self.dim):
                node, part = self.share(k, n, cell)
                for d in ti.static(range(self.dim)):
                    u[d] -= part * self.water[node][d]
        return u

    @ti.func
    def softness(self, k, n):
        """Velocity along n that a unit impulse along n brings: sum of 1 / M + (r x n) I^-1 (r x n)."""
        total = 0.0
        for side in ti.static(range(2)):
            b = self.pair[k][side]
            if b >= 0:
                arm = (self.at[k] - self.centre[b]).cross(n)
                total += 1.0 / self.weight(b) + arm.dot(self.inverse[b] @ arm)
        if self.pair[k][1] == GRID:
            total += self.spot[k][4]
        return total

    @ti.func
    def push(self, k, J):
        """Impulse J on the first body of a contact, -J on the second."""
        for side in ti.static(range(2)):
            b, sign = self.pair[k][side], ti.static(1.0 - 2.0 * side)
            if b >= 0:
                self.velocity[b] += sign * J / self.weight(b)
                self.spin[b] += sign * (self.inverse[b] @ (self.at[k] - self.centre[b]).cross(J)) / self.kernels.dx[None]
        if self.pair[k][1] == GRID:
            cell = self.cell_mass()
            for n in range(3**self.dim):
                node, part = self.share(k, n, cell)
                for d in ti.static(range(self.dim)):
                    self.water[node][d] -= part * self.water[node][self.dim] * J[d]

    @ti.func
    def solve(self):
        """Projected Gauss-Seidel: each contact in turn, its total normal impulse kept >= 0, its friction within the cone."""
        sweep, change, largest = 0, 1.0, 0.0
        while sweep < SWEEPS and change > SETTLED * largest:
            sweep += 1
            change = 0.0
            for k in range(ti.min(self.touching[None], self.pair.shape[0])):
                n = ti.Vector([self.normal[k][0], self.normal[k][1], self.normal[k][2]])
                total = ti.Vector([self.impulse[k][0], self.impulse[k][1], self.impulse[k][2]])
                pressed = total.dot(n)
                u = self.slip(k)
                relax = OVER if self.pair[k][1] == GRID else 1.0
                now = ti.max(pressed + relax * (self.normal[k][3] - u.dot(n)) / self.softness(k, n), 0.0)
                self.push(k, (now - pressed) * n)
                held, friction = total - pressed * n, self.impulse[k][3]
                rubbed = held
                if friction > 0.0:
                    w = self.slip(k)
                    along = w - w.dot(n) * n
                    speed = along.norm()
                    t = along / ti.max(speed, 1e-12)
                    stuck = held - speed / self.softness(k, t) * t
                    cone = ti.min(1.0, friction * now / ti.max(stuck.norm(), 1e-30))
                    for d in ti.static(range(3)):
                        rubbed[d] = cone * stuck[d]
                    self.push(k, rubbed - held)
                for d in ti.static(range(3)):
                    self.impulse[k][d] = now * n[d] + rubbed[d]
                change = ti.max(change, ti.abs(now - pressed) + (rubbed - held).norm())
                largest = ti.max(largest, now)

    @ti.func
    def move(self, b, dt):
        """c += V dt; the angular momentum, not the spin, stays as the inertia turns with the body, which turns by the spin at the middle of the
        substep. By that at its start a tumbling brick gained 4 % of its energy in two turns of 100 steps.
        """
        self.centre[b] += dt / self.kernels.dx[None] * self.velocity[b]
        R = rotation(self.turn[b])
        L = R @ (self.inertia[b] @ (R.transpose() @ self.spin[b]))
        M = rotation(turned(self.turn[b], 0.5 * dt * self.spin[b]))
        q = turned(self.turn[b], dt * (M @ (self.rest_inverse[b] @ (M.transpose() @ L))))
        self.turn[b] = q
        self.refresh(b)
        self.spin[b] = self.inverse[b] @ L

    @ti.func
    def place(self, b, p, R):
        """[3] cells: where a particle of a body is."""
        return self.centre[b] + R @ lift(self.rest[p])

    @ti.func
    def shift_inside(self, b):
        """Shift a body by what its deepest particles stand in walls and obstacles; thrice, for a corner between slopes."""
        half, R = self.half[None], rotation(self.turn[b])
        depth, tries = 1.0, 0
        while depth > 1e-4 and tries < 3:
            tries += 1
            depth = 0.0
            low, high, deepest, out = ti.Vector.zero(ti.f32, 3), ti.Vector.zero(ti.f32, 3), 0.0, ti.Vector.zero(ti.f32, 3)
            for p in range(self.span[b][0], self.span[b][1]):
                at = self.place(b, p, R)
                x = ti.Vector.zero(ti.f32, self.dim)
                for d in ti.static(range(self.dim)):
                    bottom, top = ti.cast(self.kernels.extent[0][d], ti.f32) + half, ti.cast(self.kernels.extent[1][d], ti.f32) - half
                    low[d], high[d] = ti.max(low[d], bottom - at[d]), ti.max(high[d], at[d] - top)
                    x[d] = ti.min(ti.max(at[d], bottom), top)
                if ti.static(self.kernels.structure.obstacles != "none"):
                    distance, normal = self.kernels.clearance(x)
                    if half - distance > deepest:
                        deepest = half - distance
                        for d in ti.static(range(self.dim)):
                            out[d] = normal[d]
            shift = low - high + deepest * out
            self.centre[b] += shift
            depth = shift.norm()

    @ti.func
    def write(self, b):
        """Places, velocities and velocity gradients of a body's particles; returns the largest squared speed."""
        R, fastest = rotation(self.turn[b]), 0.0
        for p in range(self.span[b][0], self.span[b][1]):
            at = self.place(b, p, R)
            v = self.point_velocity(b, at)
            for d in ti.static(range(self.dim)):
                # The bounds only catch what is not a number, before it names a node.
                inside = ti.min(ti.max(at[d], ti.cast(self.kernels.extent[0][d], ti.f32)), ti.cast(self.kernels.extent[1][d], ti.f32))
                self.kernels.x[p][d], self.kernels.v[p][d] = inside, v[d]
                column = self.spin[b].cross(ti.Vector([float(d == e) for e in ti.static(range(3))]))
                for e in ti.static(range(self.dim)):
                    self.kernels.C[d][p][e] = column[e]
            fastest = ti.max(fastest, v.norm_sqr())
        return fastest


def body_table(scene: Scene, particles, cell: np.ndarray, dx: float, wall: int, planes: int) -> np.ndarray:
    """What ``RigidBodies.load`` needs, [1 + bodies, COLUMNS + 4 planes] float64: spans, masses, centres, velocities, inertia, faces.

    ``cell`` [n, dim]: particles' positions in cells. Raises nothing: the scene is valid.
    """
    lower, dim = np.array(scene.bounds)[:, 0], scene.dim
    rigid = [index for index, body in enumerate(scene.bodies) if scene.materials[body.material].model == "rigid"]
    table = np.zeros((1 + len(rigid), COLUMNS + 4 * planes))
    table[0, :2] = len(rigid), particles.spacing / dx / 2
    for row, index in zip(table[1:], rigid, strict=True):
        body, members = scene.bodies[index], np.flatnonzero(particles.body == index)
        mass = scene.materials[body.material].density * particles.spacing**dim
        centre = np.zeros(3)
        centre[:dim] = cell[members].mean(0)
        arm = np.zeros((len(members), 3))
        arm[:, :dim] = cell[members] - centre[:dim]
        second = mass * (arm.T @ arm + len(members) * np.diag([(particles.spacing / dx) ** 2 / 12] * dim + [0.0] * (3 - dim)))
        faces = np.zeros((0, dim + 1))
        if body.kind == "polygon":
            faces = ConvexHull(body.vertices).equations
        elif body.kind == "box":
            bottom, top = body.extent()
            faces = np.concatenate([np.c_[-np.eye(dim), bottom], np.c_[np.eye(dim), -top]])
        # n.x + e <= 0 in space becomes n.X <= offset in cells from the centre.
        offset = -faces[:, dim] / dx - faces[:, :dim] @ (lower / dx - wall + centre[:dim])
        row[:6] = members[0], members[-1] + 1, mass, np.linalg.norm(arm, axis=1).max(), body.radius / dx if body.kind == "ball" else 0.0, len(faces)
        row[6:9], row[9 : 9 + dim], row[12:21] = centre, body.velocity, (np.trace(second) * np.eye(3) - second).ravel()
        shape = row[COLUMNS : COLUMNS + 4 * len(faces)].reshape(-1, 4)
        shape[:, :dim], shape[:, 3] = faces[:, :dim], offset
    return table
