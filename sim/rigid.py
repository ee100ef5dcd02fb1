"""Rigid bodies, whatever moves them: exact shape, motion by momenta, contacts by impulses.

A body is particles whose places in it never change, a centre c, a rotation (a quaternion), a velocity and a spin. The solvers give it
momentum (``sim.mpm.rigid`` from the grid, ``sim.sph.rigid`` from water's particles); here it meets walls, obstacles and other
bodies, and moves. Two and three dimensions share the code: a 2D body is a 3D one that turns about z.

Contacts are points: a particle, a ball half a spacing thick, against a wall, a signed distance or the faces of another body,
u.n >= -gap / dt (inelastic; no approach beyond the gap), |J_t| <= mu J_n, solved by projected Gauss-Seidel
(Catto 2005) with accumulated impulses. What rounding and rotation leave of a penetration is taken off by shifting the body.
Between bodies contact is without friction.

Positions and r are in units of the solver's length, ``unit`` [length] (MPM: a cell; SPH: the support radius, which its velocities are in too, so
that ``unit`` is 1), velocities in length/s, spin in 1/s, moments of inertia in mass unit^2. All vectors have three lanes.
"""

import numpy as np
from scipy.spatial import ConvexHull

from sim.scene import Scene
from sim.taichi_runtime import ti

#: Sweeps of the contact solver at most, and the change of an impulse, relative to the largest, at which it is done. With 60 a stone on wood sank
#: half a cell into it in ten seconds.
SWEEPS, SETTLED = 300, 1e-4
#: Friction coefficient of sticky walls and obstacles.
NO_SLIP = 1e9
#: Squared speed that stands for contacts beyond the list's end: its frame is taken back and repeated with half the step, whose gaps close
#: fewer, until the trajectory fails.
OVERFLOW = 1e30
#: Columns of the table that ``load`` takes, before the planes.
COLUMNS = 24


@ti.func
def lift(v):
    """A vector of 2, 3 or 4 entries as one of 3."""
    return ti.Vector([ti.cast(v[d] if ti.static(d < v.n) else 0.0, ti.f32) for d in range(3)])


@ti.func
def rotation(q):
    """Matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ti.Matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@ti.func
def times(M, v):
    """M v of a 3 x 3 matrix. Written out, as the next three: each of Taichi's own products takes 0.05 s to compile, and there were dozens."""
    return ti.Vector([M[i, 0] * v[0] + M[i, 1] * v[1] + M[i, 2] * v[2] for i in range(3)])


@ti.func
def back(M, v):
    """M^T v."""
    return ti.Vector([M[0, i] * v[0] + M[1, i] * v[1] + M[2, i] * v[2] for i in range(3)])


@ti.func
def product(M, N):
    """M N."""
    return ti.Matrix([[M[i, 0] * N[0, j] + M[i, 1] * N[1, j] + M[i, 2] * N[2, j] for j in range(3)] for i in range(3)])


@ti.func
def seen(R, M):
    """R M R^T: a body's tensor in space."""
    return product(product(R, M), R.transpose())


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
class Bodies:
    """State of up to ``capacity`` bodies of ``planes`` faces each; ``kernels``: the solver's particles and walls."""

    #: Gap from which on contacts are listed [units of length], in addition to what the body's speed closes in a step.
    near = 0.1

    def __init__(self, kernels, capacity: int, planes: int, particles: int, contacts: int, obstacles: bool, periodic: tuple[bool, ...]):
        self.kernels, self.dim, self.obstacles, self.periodic = kernels, kernels.dim, obstacles, periodic
        self.rest = ti.Vector.field(self.dim, ti.f32, particles)  # a particle's place in its body
        self.count, self.touching = ti.field(ti.i32, ()), ti.field(ti.i32, ())
        self.half = ti.field(ti.f32, ())  # half a particle spacing
        self.span = ti.Vector.field(2, ti.i32, capacity)  # particles span[0] .. span[1]
        # Of a particle, of the body; length; length, 0 without.
        self.mass, self.total, self.reach, self.radius = (ti.field(ti.f32, capacity) for _ in range(4))
        self.centre = ti.Vector.field(3, ti.f32, capacity)
        # In float64: a collision adds up hundreds of impulses, which in float32 cost 3e-5 of the momentum.
        self.velocity, self.spin = (ti.Vector.field(3, ti.f64, capacity) for _ in range(2))
        self.turn = ti.Vector.field(4, ti.f32, capacity)
        # Of ``turn``; of inertia and its inverse: in the body, in space.
        self.rotation, self.inertia, self.rest_inverse, self.moment, self.inverse = (ti.Matrix.field(3, 3, ti.f32, capacity) for _ in range(5))
        self.state = [self.centre, self.velocity, self.spin, self.turn]
        self.saved = [ti.Vector.field(field.n, field.dtype, capacity) for field in self.state]
        self.planes = ti.Vector.field(4, ti.f32, (capacity, planes))  # outward normal, offset from the centre; in the body
        self.faces = ti.field(ti.i32, capacity)
        self.pair = ti.Vector.field(2, ti.i32, contacts)  # bodies; the second is -1 for what does not move
        self.at, self.normal = ti.Vector.field(3, ti.f32, contacts), ti.Vector.field(4, ti.f32, contacts)  # normal and least approach
        self.impulse = ti.Vector.field(4, ti.f32, contacts)  # impulse on the first body, friction coefficient

    @staticmethod
    def sizes(dim: int, bodies: int, planes: int, particles: int, contacts: int) -> dict[str, tuple[int, int]]:
        """Fields with more than a few entries: name -> (bytes an entry, entries), as solvers' ``plan`` lists them."""
        rigid = {"span": 8, "mass": 4, "total": 4, "reach": 4, "radius": 4, "centre": 12, "velocity": 24, "spin": 24, "turn": 16, "rotation": 36,
                 "inertia": 36, "rest inverse": 36, "moment": 36, "inverse": 36, "faces": 4, "saved centre": 12, "saved velocity": 24,
                 "saved spin": 24, "saved turn": 16}  # fmt: skip
        contact = {"pair": 8, "at": 12, "normal": 16, "impulse": 16}
        return (
            {f"rigid {name}": (size, bodies) for name, size in rigid.items()}
            | {"rigid planes": (16, bodies * planes)}
            | {"rigid rest": (4 * dim, particles)}
            | {f"contact {name}": (size, contacts) for name, size in contact.items()}
        )

    # -- what differs between solvers, which override it
    @ti.func
    def unit(self):
        """[length]: what positions are counted in."""
        return 1.0

    @ti.func
    def roughness(self):
        """Friction coefficient of the walls, ``NO_SLIP`` where they are sticky."""
        return 0.0

    @ti.func
    def obstacle(self, x):
        """Distance to the obstacles, normal [3] and friction coefficient at a place [dim or 4]; called only where there are any."""
        return 1.0, ti.Vector.zero(ti.f32, 3), 0.0

    @ti.func
    def note(self, b, p):
        """What else ``write`` gives to a particle of a body."""

    @ti.func
    def arm(self, b, at):
        """From a body's centre to a place, by its nearest image in a periodic box."""
        r = at - self.centre[b]
        for d in ti.static(range(self.dim)):
            if ti.static(self.periodic[d]):
                length = ti.cast(self.kernels.extent[1][d] - self.kernels.extent[0][d], ti.f32)
                r[d] -= length * ti.round(r[d] / length)
        return r

    # -- set-up
    @ti.func
    def load(self, table: ti.template()):
        """``table`` [1 + bodies, ...] as ``body_table`` writes it."""
        self.count[None], self.half[None] = ti.cast(table[0, 0], ti.i32), ti.cast(table[0, 1], ti.f32)
        for b in range(self.count[None]):
            self.span[b] = ti.Vector([ti.cast(table[b + 1, 0], ti.i32), ti.cast(table[b + 1, 1], ti.i32)])
            self.mass[b], self.reach[b], self.radius[b] = table[b + 1, 2], table[b + 1, 3], table[b + 1, 4]
            self.total[b] = self.mass[b] * ti.cast(self.span[b][1] - self.span[b][0], ti.f32)
            self.faces[b] = ti.cast(table[b + 1, 5], ti.i32)
            for d in ti.static(range(3)):
                self.centre[b][d], self.velocity[b][d], self.spin[b][d] = table[b + 1, 6 + d], table[b + 1, 9 + d], 0.0
                for e in ti.static(range(3)):
                    self.inertia[b][d, e] = table[b + 1, 12 + 3 * d + e]
            self.rest_inverse[b] = self.inertia[b].inverse()
            self.turn[b] = ti.Vector([1.0, 0.0, 0.0, 0.0])
            self.rotation[b], self.inverse[b], self.moment[b] = ti.Matrix.identity(ti.f32, 3), self.rest_inverse[b], self.inertia[b]
            for k in range(self.faces[b]):
                for lane in ti.static(range(4)):
                    self.planes[b, k][lane] = table[b + 1, COLUMNS + 4 * k + lane]
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
        """R; inertia and its inverse in space, R I R^T."""
        R = rotation(self.turn[b])
        self.rotation[b], self.inverse[b], self.moment[b] = R, seen(R, self.rest_inverse[b]), seen(R, self.inertia[b])

    # -- one step
    @ti.func
    def touch(self, b, other, at, normal, gap, friction, dt):
        """List a contact if this substep's motion may close the gap."""
        dx = self.unit()
        speed = self.velocity[b].norm() + dx * self.spin[b].norm() * self.reach[b]
        if other >= 0:
            speed += self.velocity[other].norm() + dx * self.spin[other].norm() * self.reach[other]
        if gap < self.near + dt / dx * speed:
            k = ti.atomic_add(self.touching[None], 1)
            if k < self.pair.shape[0]:
                self.pair[k] = ti.Vector([b, other])
                self.at[k] = at
                self.normal[k] = ti.Vector([normal[0], normal[1], normal[2], -ti.max(gap, 0.0) * dx / dt])
                self.impulse[k] = ti.Vector([0.0, 0.0, 0.0, friction])

    @ti.func
    def find_contacts(self, dt):
        """Contacts of all bodies with walls, obstacles and each other, within what a step dt may close."""
        half = self.half[None]
        self.touching[None] = 0
        for b in range(self.count[None]):
            for p in range(self.span[b][0], self.span[b][1]):
                x = self.kernels.x[p]
                at = lift(x)
                # One loop over walls, obstacles and bodies: every copy of ``touch`` in the code costs a second of compilation.
                for k in range(2 * self.dim + 1 + self.count[None]):
                    other, gap, normal, friction = k - 2 * self.dim - 1, OVERFLOW, ti.Vector.zero(ti.f32, 3), 0.0
                    if other < -1:
                        axis, side = k // 2, k % 2
                        normal[axis], friction = 1.0 - 2.0 * side, self.roughness()
                        gap = (x[axis] - ti.cast(self.kernels.extent[side][axis], ti.f32)) * normal[axis]
                        for d in ti.static(range(self.dim)):
                            if ti.static(self.periodic[d]):
                                gap = ti.select(axis == d, OVERFLOW, gap)
                    elif other == -1:
                        if ti.static(self.obstacles):
                            gap, normal, friction = self.obstacle(x)
                    elif other != b and self.arm(other, at).norm() < self.reach[other] + half + 1.0:
                        gap, normal = self.outside(other, at)
                    self.touch(b, ti.max(other, -1), at, normal, gap - half, friction, dt)

    @ti.func
    def outside(self, b, at):
        """Distance of a place to a body, negative inside, and the outward normal; beyond an edge that to the farthest of the faces' planes."""
        R = self.rotation[b]
        inside = back(R, self.arm(b, at))
        distance, normal = -1e9, ti.Vector([0.0, 1.0, 0.0])
        for k in range(self.faces[b]):
            plane = self.planes[b, k]
            beyond = plane[0] * inside[0] + plane[1] * inside[1] + plane[2] * inside[2] - plane[3]
            if beyond > distance:
                distance = beyond
                normal = ti.Vector([plane[0], plane[1], plane[2]])
        length = inside.norm()
        radial = inside / ti.max(length, 1e-6)
        if self.radius[b] > 0.0:
            distance = length - self.radius[b]
            normal = radial
        return distance, times(R, normal)

    @ti.func
    def point_velocity(self, b, at):
        """Velocity of body b at a place: v + w x r."""
        return self.velocity[b] + self.unit() * self.spin[b].cross(self.arm(b, at))

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
        for side in range(2):
            b = self.pair[k][side]
            if b >= 0:
                arm = self.arm(b, self.at[k]).cross(n)
                total += 1.0 / self.total[b] + arm.dot(times(self.inverse[b], arm))
        return total

    @ti.func
    def push(self, k, J):
        """Impulse J on the first body of a contact, -J on the second."""
        for side in range(2):
            b, sign = self.pair[k][side], 1.0 - 2.0 * side
            if b >= 0:
                self.velocity[b] += sign / self.total[b] * J
                self.spin[b] += sign / self.unit() * times(self.inverse[b], self.arm(b, self.at[k]).cross(J))

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
                friction, pressed = self.impulse[k][3], total.dot(n)
                held, now, moved = total - pressed * n, pressed, 0.0
                # Along the normal, then along the slip.
                for part in range(ti.select(friction > 0.0, 2, 1)):
                    u = self.slip(k)
                    along, t = u - u.dot(n) * n, n
                    speed = along.norm()
                    if part == 1:
                        t = along / ti.max(speed, 1e-12)
                    J, softness = ti.Vector.zero(ti.f32, 3), self.softness(k, t)
                    if part == 0:
                        now = ti.max(pressed + (self.normal[k][3] - u.dot(n)) / softness, 0.0)
                        J = (now - pressed) * n
                    else:
                        stuck = held - speed / softness * t
                        J = ti.min(1.0, friction * now / ti.max(stuck.norm(), 1e-30)) * stuck - held
                    self.push(k, J)
                    total += J
                    moved += J.norm()
                for d in ti.static(range(3)):
                    self.impulse[k][d] = total[d]
                change, largest = ti.max(change, moved), ti.max(largest, now)

    @ti.func
    def move(self, b, dt):
        """c += V dt; the angular momentum, not the spin, stays as the inertia turns with the body, which turns by the spin at the middle of the
        substep. By that at its start a tumbling brick gained 4 % of its energy in two turns of 100 steps.
        """
        self.centre[b] += dt / self.unit() * self.velocity[b]
        for d in ti.static(range(self.dim)):
            if ti.static(self.periodic[d]):
                length = ti.cast(self.kernels.extent[1][d] - self.kernels.extent[0][d], ti.f32)
                self.centre[b][d] -= length * ti.floor(self.centre[b][d] / length)
        L, w, q, span = times(self.moment[b], self.spin[b]), self.spin[b], self.turn[b], 0.5 * dt
        for _half in range(2):
            q = turned(self.turn[b], span * w)
            R = rotation(q)
            w = times(R, times(self.rest_inverse[b], back(R, L)))
            span = dt
        self.turn[b], self.spin[b] = q, w
        self.refresh(b)

    @ti.func
    def travel(self, dt):
        """All bodies to their new places; the largest squared speed of a particle, one that no frame passes if contacts were too many to list."""
        fastest = 0.0
        for b in range(self.count[None]):
            self.move(b, dt)
            self.shift_inside(b)
            fastest = ti.max(fastest, self.write(b))
        if self.touching[None] > self.pair.shape[0]:
            fastest = OVERFLOW
        return fastest

    @ti.func
    def place(self, b, p, R):
        """[3] units of length: where a particle of a body is."""
        return self.centre[b] + times(R, lift(self.rest[p]))

    @ti.func
    def shift_inside(self, b):
        """Shift a body by what its deepest particles stand in walls and obstacles; thrice, for a corner between slopes."""
        half, R = self.half[None], self.rotation[b]
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
                    x[d] = at[d]
                    if ti.static(not self.periodic[d]):
                        low[d], high[d] = ti.max(low[d], bottom - at[d]), ti.max(high[d], at[d] - top)
                        x[d] = ti.min(ti.max(at[d], bottom), top)
                if ti.static(self.obstacles):
                    distance, normal, _ = self.obstacle(x)
                    if half - distance > deepest:
                        deepest = half - distance
                        for d in ti.static(range(self.dim)):
                            out[d] = normal[d]
            shift = low - high + deepest * out
            self.centre[b] += shift
            depth = shift.norm()

    @ti.func
    def write(self, b):
        """Places and velocities of a body's particles; returns the largest squared speed."""
        R, fastest = self.rotation[b], 0.0
        for p in range(self.span[b][0], self.span[b][1]):
            at = self.place(b, p, R)
            v = self.point_velocity(b, at)
            for d in ti.static(range(self.dim)):
                # The bounds only catch what is not a number, before it names a node.
                bottom, top = ti.cast(self.kernels.extent[0][d], ti.f32), ti.cast(self.kernels.extent[1][d], ti.f32)
                inside = ti.min(ti.max(at[d], bottom), top)
                if ti.static(self.periodic[d]):
                    inside = at[d] - (top - bottom) * ti.floor(at[d] / (top - bottom))
                self.kernels.x[p][d], self.kernels.v[p][d] = inside, v[d]
            self.note(b, p)
            fastest = ti.max(fastest, v.norm_sqr())
        return fastest


def body_table(scene: Scene, particles, place: np.ndarray, unit: float, wall: float, planes: int, own: float) -> np.ndarray:
    """What ``Bodies.load`` needs, [1 + bodies, COLUMNS + 4 planes] float64: spans, masses, centres, velocities, inertia, faces.

    ``place`` [n, dim]: particles' positions in units of ``unit`` [length], the lower walls at ``wall``; a body's follow each other. ``own``: second
    moment of a particle along each axis about itself, over its mass [unit^2]. Raises nothing: the scene is valid.
    """
    lower, dim = np.array(scene.bounds)[:, 0], scene.dim
    rigid = [index for index, body in enumerate(scene.bodies) if scene.materials[body.material].model == "rigid"]
    table = np.zeros((1 + len(rigid), COLUMNS + 4 * planes))
    table[0, :2] = len(rigid), particles.spacing / unit / 2
    for row, index in zip(table[1:], rigid, strict=True):
        body, members = scene.bodies[index], np.flatnonzero(particles.body == index)
        mass = scene.materials[body.material].density * particles.spacing**dim
        centre = np.zeros(3)
        centre[:dim] = place[members].mean(0)
        arm = np.zeros((len(members), 3))
        arm[:, :dim] = place[members] - centre[:dim]
        second = mass * (arm.T @ arm + len(members) * np.diag([own] * dim + [0.0] * (3 - dim)))
        faces = np.zeros((0, dim + 1))
        if body.kind == "polygon":
            faces = ConvexHull(body.vertices).equations
        elif body.kind == "box":
            bottom, top = body.extent()
            faces = np.concatenate([np.c_[-np.eye(dim), bottom], np.c_[np.eye(dim), -top]])
        # n.x + e <= 0 in space becomes n.X <= offset from the centre.
        offset = -faces[:, dim] / unit - faces[:, :dim] @ (lower / unit - wall + centre[:dim])
        ball = (body.radius or 0.0) / unit if body.kind == "ball" else 0.0
        row[:6] = members[0], members[-1] + 1, mass, np.linalg.norm(arm, axis=1).max(), ball, len(faces)
        row[6:9], row[9 : 9 + dim], row[12:21] = centre, body.velocity, (np.trace(second) * np.eye(3) - second).ravel()
        shape = row[COLUMNS : COLUMNS + 4 * len(faces)].reshape(-1, 4)
        shape[:, :dim], shape[:, 3] = faces[:, :dim], offset
    return table
