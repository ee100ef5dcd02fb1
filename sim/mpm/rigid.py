"""Rigid bodies among the particles of the grid: exact shape, two-way coupling, contacts by impulses.

A body gives its particles' mass and momentum to the grid (v = V + w x r, C = [w]x, no stress). Nodes that it fills to ``SOLID`` or
more (``share``) are the body's: whatever else gave them mass moves with it. Before walls and obstacles act on the grid, each body takes
the rigid motion nearest to its nodes' velocities,

    minimise sum_i mu_i |A + w x (x_i - c) - v_i|^2,  mu_i = sum_p w_ip m (times the node's mass over the rigid mass there, if it is filled),

and filled nodes get that motion. Linear and angular momentum are what they were, exactly (the normal equations), and energy can only
fall (a projection). Were filled nodes left to themselves, nothing would hold the water out: each substep a node takes up the
pressure's push, the body averages it away, and water flows in at about g dt H / dx, ten times too deep a draft. c and the rotation
(a quaternion) then move the particles, whose places in the body never change. The moment of inertia of a lone body is
I = sum_p m (|r|^2 1 - r r^T) and that of the quadratic B-splines, dx^2 / 4 along each axis. Two and three dimensions share the
code: a 2D body is a 3D one that turns about z.

Decision: walls, obstacles and other bodies act on the *body*, not on its share of the grid. On the grid only the nodes behind a wall
would be held, a tenth of a body's mass; each substep it would regain the weight that they took off, and creep down any slope
at g dt times ten. Contacts are points: a particle, a ball half a spacing thick, against a wall, a signed distance or the
faces of another body, u.n >= -gap / dt (inelastic; no approach beyond the gap), |J_t| <= mu J_n, solved by projected Gauss-Seidel
(Catto 2005) with accumulated impulses. What rounding and rotation leave of a penetration is taken off by shifting the body.
Between bodies contact is without friction: the grid, which they share within two cells of each other, already lets none slip.

Positions and r are in cells, velocities in m/s, spin in 1/s, moments of inertia in kg cells^2. All vectors have three lanes.
"""

import numpy as np
from scipy.spatial import ConvexHull

from sim.scene import Scene
from sim.taichi_runtime import ti

#: Sweeps of the contact solver at most, and the change of an impulse, relative to the largest, at which it is done. With 60 a stone on wood sank
#: half a cell into it in ten seconds.
SWEEPS, SETTLED = 300, 1e-4
#: Contacts are listed from this gap on [cells], in addition to a substep's way.
NEAR = 0.1
#: Friction coefficient of sticky walls and obstacles.
NO_SLIP = 1e9
#: Nodes filled by bodies to this share of a cell are theirs: 1/2 is a body's face.
SOLID = 0.5 - 1e-3
#: Squared speed that stands for contacts beyond the list's end: its frame is taken back and repeated with half the step, whose gaps close
#: fewer, until the trajectory fails.
OVERFLOW = 1e30
#: Columns of the table that ``load`` takes, before the planes.
COLUMNS = 24


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
        self.share = ti.Vector.field(2, ti.f32, kernels.nodes)  # of a node: rigid mass, filled share of a cell
        self.rest = ti.Vector.field(self.dim, ti.f32, kernels.capacity)  # a particle's place in its body
        self.count, self.touching = ti.field(ti.i32, ()), ti.field(ti.i32, ())
        self.half = ti.field(ti.f32, ())  # half a particle spacing, cells
        self.span = ti.Vector.field(2, ti.i32, capacity)  # particles span[0] .. span[1]
        self.mass, self.reach, self.radius = (ti.field(ti.f32, capacity) for _ in range(3))  # kg a particle; cells; cells, 0 without
        self.centre = ti.Vector.field(3, ti.f32, capacity)
        # In float64: a collision adds up hundreds of impulses, which in float32 cost 3e-5 of the momentum.
        self.velocity, self.spin = (ti.Vector.field(3, ti.f64, capacity) for _ in range(2))
        self.turn = ti.Vector.field(4, ti.f32, capacity)
        self.inertia, self.inverse = ti.Matrix.field(3, 3, ti.f32, capacity), ti.Matrix.field(3, 3, ti.f32, capacity)  # in the body; in space
        self.rest_inverse = ti.Matrix.field(3, 3, ti.f32, capacity)
        self.state = [self.centre, self.velocity, self.spin, self.turn]
        self.saved = [ti.Vector.field(field.n, field.dtype, capacity) for field in self.state]
        self.planes = ti.Vector.field(4, ti.f32, (capacity, planes))  # outward normal, offset from the centre; in the body
        self.faces = ti.field(ti.i32, capacity)
        self.pair = ti.Vector.field(2, ti.i32, contacts)  # bodies; the second is -1 for what does not move
        self.at, self.normal = ti.Vector.field(3, ti.f32, contacts), ti.Vector.field(4, ti.f32, contacts)  # normal and least approach
        self.impulse = ti.Vector.field(4, ti.f32, contacts)  # impulse on the first body, friction coefficient

    @staticmethod
    def sizes(dim: int, bodies: int, planes: int, capacity: int, nodes: int) -> dict[str, tuple[int, int]]:
        """Fields with more than a few entries: name -> (bytes an entry, entries), as ``MPMSimulator.plan`` lists them."""
        rigid = {"span": 8, "mass": 4, "reach": 4, "radius": 4, "centre": 12, "velocity": 24, "spin": 24, "turn": 16, "inertia": 36, "inverse": 36,
                 "rest inverse": 36, "faces": 4, "saved centre": 12, "saved velocity": 24, "saved spin": 24, "saved turn": 16}
        contact = {"pair": 8, "at": 12, "normal": 16, "impulse": 16}
        return ({f"rigid {name}": (size, bodies) for name, size in rigid.items()} | {"rigid planes": (16, bodies * planes)}
                | {"rigid rest": (4 * dim, capacity), "rigid share": (8, nodes)}
                | {f"contact {name}": (size, capacity) for name, size in contact.items()})

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
        """Motion from the grid's momenta, and the contacts that it makes. ``solve`` follows, then ``advance``; all on one thread."""
        for b in range(self.count[None]):
            self.fill(b)
        for b in range(self.count[None]):
            self.gather(b, dt)
        self.find_contacts(dt)

    @ti.func
    def advance(self, dt):
        """To the bodies' new places; returns the largest squared speed of a particle, one that no frame passes if contacts were too many to list."""
        for clear in ti.static((True, False)):
            for b in range(self.count[None]):
                self.carry(b, dt, clear)
        fastest = 0.0
        for b in range(self.count[None]):
            self.move(b, dt)
            self.shift_inside(b)
            fastest = ti.max(fastest, self.write(b))
        if self.touching[None] > self.pair.shape[0]:
            fastest = OVERFLOW
        return fastest

    @ti.func
    def fill(self, b):
        """Add a body's mass and volume to the nodes."""
        volume = (2.0 * self.half[None]) ** self.dim
        for p in range(self.span[b][0], self.span[b][1]):
            base, fx = self.kernels.locate(self.kernels.x[p])
            for n in range(3**self.dim):
                node, weight, arm = self.node(b, base, fx, n)
                self.share[node] += weight * ti.Vector([self.mass[b], volume])

    @ti.func
    def node(self, b, base, fx, n):
        """The n-th of the nodes that a particle reaches, its weight, and its place from the body's centre [3]."""
        node, weight, rest, arm = base, 1.0, n, -self.centre[b]
        for d in ti.static(range(self.dim)):
            k = rest % 3
            rest = rest // 3
            node[d] = base[d] + k
            weight *= self.kernels.weights(fx[d])[k]
            arm[d] += ti.cast(node[d], ti.f32)
        return node, weight, arm

    @ti.func
    def gather(self, b, dt):
        """The nearest rigid motion. Sums are of differences from the old V, in float64: thousands of terms a body would cost momentum 5e-8
        of itself a substep."""
        old = self.velocity[b]
        pull = ti.Vector.zero(ti.f32, 3)
        for d in ti.static(range(self.dim)):
            pull[d] = dt * self.kernels.pull[None][d]
        M, P, L, S = ti.cast(0.0, ti.f64), ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3)
        second = ti.Matrix.zero(ti.f64, 3, 3)
        for p in range(self.span[b][0], self.span[b][1]):
            base, fx = self.kernels.locate(self.kernels.x[p])
            for n in range(3**self.dim):
                node, weight, arm = self.node(b, base, fx, n)
                cell, share = self.kernels.grid[node], self.share[node]
                mass, mu = ti.max(cell[self.dim], 1e-30), weight * self.mass[b]
                if share[1] >= SOLID:
                    mu *= ti.max(mass / share[0], 1.0)
                v = pull - old
                for d in ti.static(range(self.dim)):
                    v[d] += cell[d] / mass
                M += mu
                P += mu * v
                S += mu * arm
                L += mu * arm.cross(v)
                second += mu * arm.outer_product(arm)
        # About the centroid of mu, the two sums part.
        middle, mean = S / M, P / M
        second -= M * middle.outer_product(middle)
        inertia = second.trace() * ti.Matrix.identity(ti.f64, 3) - second
        spin = inertia.inverse() @ (L - M * middle.cross(mean))
        self.velocity[b] = ti.cast(old + mean - spin.cross(middle), ti.f32)
        self.spin[b] = ti.cast(spin / self.kernels.dx[None], ti.f32)

    @ti.func
    def carry(self, b, dt, clear: ti.template()):
        """Filled nodes move with the body: ``clear`` them of momentum, then give them the body's, in its share of their rigid mass.

        Gravity, which the nodes' update will add, is taken off first.
        """
        pull, dx = dt * self.kernels.pull[None], self.kernels.dx[None]
        for p in range(self.span[b][0], self.span[b][1]):
            base, fx = self.kernels.locate(self.kernels.x[p])
            for n in range(3**self.dim):
                node, weight, arm = self.node(b, base, fx, n)
                share = self.share[node]
                if share[1] >= SOLID:
                    if ti.static(clear):
                        for d in ti.static(range(self.dim)):
                            self.kernels.grid[node][d] = 0.0
                    else:
                        mu = weight * self.mass[b] * self.kernels.grid[node][self.dim] / share[0]
                        u = self.velocity[b] + dx * self.spin[b].cross(arm)
                        for d in ti.static(range(self.dim)):
                            self.kernels.grid[node][d] += mu * (u[d] - pull[d])

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
    def find_contacts(self, dt):
        half = self.half[None]
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
                    gap = (x[axis] - ti.cast(self.kernels.extent[side][axis], ti.f32)) * inward[axis] - half
                    rough = self.kernels.coefficient[None] if ti.static(self.kernels.friction != "sticky") else NO_SLIP
                    self.touch(b, -1, at, inward, gap, rough, dt)
                if ti.static(self.kernels.structure.obstacles != "none"):
                    clear, out = self.kernels.clearance(x)
                    friction = self.kernels.solids[ti.cast(x + 0.5, ti.i32)][self.dim + 1]
                    self.touch(b, -1, at, lift(out), clear - half, friction if friction >= 0.0 else NO_SLIP, dt)
                for other in range(self.count[None]):
                    if other != b and (at - self.centre[other]).norm() < self.reach[other] + half + 1.0:
                        R = rotation(self.turn[other])
                        inside = R.transpose() @ (at - self.centre[other])
                        distance, normal = -1e9, ti.Vector([0.0, 1.0, 0.0])
                        for k in range(self.faces[other]):
                            plane = self.planes[other, k]
                            beyond = plane[0] * inside[0] + plane[1] * inside[1] + plane[2] * inside[2] - plane[3]
                            if beyond > distance:
                                distance = beyond
                                normal = ti.Vector([plane[0], plane[1], plane[2]])
                        length = inside.norm()
                        radial = inside / ti.max(length, 1e-6)
                        if self.radius[other] > 0.0:
                            distance = length - self.radius[other]
                            normal = radial
                        self.touch(b, other, at, R @ normal, distance - half, 0.0, dt)

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
        return u

    @ti.func
    def softness(self, k, n):
        """Velocity along n that a unit impulse along n brings: sum of 1 / M + (r x n) I^-1 (r x n)."""
        total = 0.0
        for side in ti.static(range(2)):
            b = self.pair[k][side]
            if b >= 0:
                arm = (self.at[k] - self.centre[b]).cross(n)
                total += 1.0 / (self.mass[b] * ti.cast(self.span[b][1] - self.span[b][0], ti.f32)) + arm.dot(self.inverse[b] @ arm)
        return total

    @ti.func
    def push(self, k, J):
        """Impulse J on the first body of a contact, -J on the second."""
        for side in ti.static(range(2)):
            b, sign = self.pair[k][side], ti.static(1.0 - 2.0 * side)
            if b >= 0:
                self.velocity[b] += sign * J / (self.mass[b] * ti.cast(self.span[b][1] - self.span[b][0], ti.f32))
                self.spin[b] += sign * (self.inverse[b] @ (self.at[k] - self.centre[b]).cross(J)) / self.kernels.dx[None]

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
                now = ti.max(pressed + (self.normal[k][3] - u.dot(n)) / self.softness(k, n), 0.0)
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
        second = mass * (arm.T @ arm + len(members) * np.diag([0.25] * dim + [0.0] * (3 - dim)))
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
