"""Rigid bodies of a position-based solver: shape matching (Muller et al. 2005) of particles that a fluid has displaced.

A body is a centre c, a rotation R (a quaternion), a velocity V and an angular momentum L; its particles are at c + R r. A step moves it as it
would fly, exactly; constraints then displace its particles by d, and the body takes the rigid motion nearest to them,

    c += mean d,  R = polar(sum (R0 r + d - mean d) r^T + (n s^2 / 12) R0),

where the last term is what particles, cubes of edge s that turn along, add (Muller & Chentanez 2011): the moment of inertia is that of the cubes.
Linear momentum is kept exactly, angular momentum to first order in d. The rotation is found from R0 on (Muller, Bender, Chentanez & Macklin 2016).

Decision: velocities are those of the *body*, V += (c - c before the constraints) / dt, and so the angular momentum (Muller et al. 2020), instead of
each particle's (x - x before) / dt (Macklin et al. 2014). The latter are chords of a turning body: its spin w would decay by (w dt)^2 a step, a
fifth in a second at 5 rad/s and 120 steps a second.

Walls hold the body at its corners, the hull of its particles, each a ball half a spacing thick. Their pushes J >= 0 are found together (projected
Gauss-Seidel), lest a cube that lands flat be tilted by the order of its corners. Contacts are inelastic and slip.

Lengths are in support radii, masses in those of a particle of the body. Float64, three lanes, also in 2D, where a body turns about z.
"""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from sim.rigid import rotation, turned
from sim.scene import Particles, Scene
from sim.sph.kernel import ENTRIES, SHARE, SLOPE, kernel, lattice_scale
from sim.taichi_runtime import ti

#: Iterations of the rotation at most, and the angle at which it is found.
TURNS, TURNED = 30, 1e-10
#: Sweeps over the corners at most, and the change of a push, relative to the largest, at which they end.
SWEEPS, SETTLED = 200, 1e-6
#: Corners closer to a wall than this, in spacings, take part.
NEAR = 0.5
#: Rounds of pushes, for rotations are finite; what is left of a penetration is shifted away.
ROUNDS = 3


@ti.func
def angle_of(q):
    """Rotation vector [radians] of a unit quaternion, of at most half a turn."""
    v = ti.Vector([q[1], q[2], q[3]])
    s = v.norm()
    w = ti.abs(q[0])
    factor = 2.0 / ti.max(w, 1e-3)
    if s > 1e-9:
        factor = 2.0 * ti.atan2(s, w) / s
    return ti.select(q[0] < 0.0, -factor, factor) * v


@ti.func
def difference(q, p):
    """The quaternion q p^-1."""
    v, u = ti.Vector([q[1], q[2], q[3]]), -ti.Vector([p[1], p[2], p[3]])
    w = q[0] * p[0] - v.dot(u)
    b = q[0] * u + p[0] * v + v.cross(u)
    return ti.Vector([w, b[0], b[1], b[2]])


@ti.data_oriented
class Bodies:
    """Up to ``capacity`` bodies; ``base``: particles, ``base.slot[id]`` where a particle is now (``sim.pbd.solver._Kernels``)."""

    def __init__(self, base, capacity: int, particles: int):
        self.base, self.dim, self.capacity = base, base.dim, capacity
        self.count = ti.field(ti.i32, ())
        self.span = ti.Vector.field(2, ti.i32, capacity)  # of the scene's particles
        self.rest = ti.Vector.field(3, ti.f64, particles)
        self.corner, self.own = ti.field(ti.i32, particles), ti.field(ti.f32, particles)
        self.push = ti.Vector.field(6, ti.f64, particles)
        self.centre, self.velocity, self.momentum = (ti.Vector.field(3, ti.f64, capacity) for _ in range(3))
        self.turn = ti.Vector.field(4, ti.f64, capacity)
        self.inertia, self.inverse = (ti.Matrix.field(3, 3, ti.f64, capacity) for _ in range(2))  # in the body
        self.ahead, self.ahead_turn = ti.Vector.field(3, ti.f64, capacity), ti.Vector.field(4, ti.f64, capacity)

    @staticmethod
    def sizes(dim: int, capacity: int, particles: int) -> dict[str, tuple[int, int]]:
        """Fields as ``plan`` lists them: name -> (bytes an entry, entries)."""
        fields = {"span": 8, "centre": 24, "velocity": 24, "momentum": 24, "turn": 32, "inertia": 72, "inverse inertia": 72, "centre ahead": 24,
                  "turn ahead": 32}  # fmt: skip
        own = {"rest place": 24, "corner": 4, "own density": 4, "push": 48}
        found = {name: (size, capacity) for name, size in fields.items()} | {name: (size, particles) for name, size in own.items()}
        return {f"rigid {name}": entry for name, entry in found.items()}

    @ti.func
    def put(self, b):
        """Places of a body's particles."""
        R = rotation(self.turn[b])
        for p in range(self.span[b][0], self.span[b][1]):
            at = self.centre[b] + R @ self.rest[p]
            for d in ti.static(range(self.dim)):
                self.base.x[self.base.slot[p]][d] = ti.cast(at[d], ti.f32)

    @ti.func
    def spin(self, b, q):
        """Spin [3] of a body that stands at q, by its angular momentum."""
        R = rotation(q)
        return R @ (self.inverse[b] @ (R.transpose() @ self.momentum[b]))

    @ti.func
    def lubricate(self, b, f, wet: ti.template(), pull):
        """The pressure of the film of water between a body and wall f, as a change of its velocity and momentum; ``pull``: dt / (step before)^2.

        A layer of particles needs a gap of a whole spacing; real water is under the body long before. Its pressure is taken to be that of the
        water around the gap: the mean of k over the share of the kernel that particles which face the wall leave to water, dry parts counting as
        none. Without it a light cube that had touched the floor stayed there, held down by what stands on it.
        """
        spacing, axis, side = self.base.number[self.base.SPACING], f // 2, 1.0 - 2.0 * (f % 2)
        row = ti.cast(0.5 * spacing * float(ENTRIES), ti.i32)
        share, steep = self.base.table[row][SHARE], -self.base.table[row][SLOPE]
        water, room = 0.0, 0.0
        for p in range(self.span[b][0], self.span[b][1]):
            i = self.base.slot[p]
            if self.wall_distance(self.base.x[i], f) < 1.5 * spacing:
                water += wet[i][3]
                room += ti.max(1.0 - share - self.own[p], 0.0)
        if water > 0.0:
            k = water / ti.max(room, 1e-6)
            R, mass = rotation(self.turn[b]), ti.cast(self.span[b][1] - self.span[b][0], ti.f64)
            for p in range(self.span[b][0], self.span[b][1]):
                i = self.base.slot[p]
                if self.wall_distance(self.base.x[i], f) < 1.5 * spacing:
                    # More than the constraint of the particle itself has pushed already.
                    more = ti.max(k * steep + side * self.base.shift[i][3] * self.base.wall[i][axis], 0.0)
                    push = ti.Vector.zero(ti.f64, 3)
                    push[axis] = ti.cast(pull * self.base.v[i][3] * more * side, ti.f64)
                    self.velocity[b] += push / mass
                    self.momentum[b] += (R @ self.rest[p]).cross(push)

    @ti.func
    def wall_distance(self, x, f):
        """Distance of a place to wall f."""
        axis = f // 2
        return ti.select(f % 2 == 0, x[axis] - self.base.extent[0][axis], self.base.extent[1][axis] - x[axis])

    @ti.func
    def fly(self, b, dt, kick):
        """c += V dt, after the kick; turned by the spin at the middle of the step."""
        self.velocity[b] += kick
        self.centre[b] += dt * self.velocity[b]
        q = self.turn[b]
        self.turn[b] = turned(q, dt * self.spin(b, turned(q, 0.5 * dt * self.spin(b, q))))
        self.ahead[b], self.ahead_turn[b] = self.centre[b], self.turn[b]
        self.put(b)

    @ti.func
    def match(self, b):
        """The rigid motion nearest to the displaced particles; off the walls; particles into place."""
        first, last = self.span[b][0], self.span[b][1]
        R, n = rotation(self.turn[b]), ti.cast(last - first, ti.f64)
        mean, A = ti.Vector.zero(ti.f64, 3), ti.Matrix.zero(ti.f64, 3, 3)
        for p in range(first, last):
            d = self.displaced(p)
            mean += d
            A += d.outer_product(self.rest[p])
        mean /= n
        # sum r = 0; sum (R r) r^T and the cubes' own part are R times the second moments, tr(I) / 2 - I.
        inertia = self.inertia[b]
        A += R @ (0.5 * inertia.trace() * ti.Matrix.identity(ti.f64, 3) - inertia)
        self.centre[b] += mean
        q, turns, angle = self.turn[b], 0, 1.0
        while turns < TURNS and angle > TURNED:
            M = rotation(q)
            torque = ti.Vector.zero(ti.f64, 3)
            for k in ti.static(range(3)):
                torque += ti.Vector([M[0, k], M[1, k], M[2, k]]).cross(ti.Vector([A[0, k], A[1, k], A[2, k]]))
            # A Newton step: were A = M S, the Hessian would be the inertia tr(S) - S.
            step = M @ (self.inverse[b] @ (M.transpose() @ torque))
            angle = step.norm()
            q = turned(q, step)
            turns += 1
        self.turn[b] = q
        self.hold(b)
        self.put(b)

    @ti.func
    def displaced(self, p):
        """A particle's displacement, which is thereby taken."""
        i, d = self.base.slot[p], ti.Vector.zero(ti.f64, 3)
        for a in ti.static(range(self.dim)):
            d[a] = ti.cast(self.base.shift[i][a], ti.f64)
            self.base.shift[i][a] = 0.0
        return d

    @ti.func
    def gap(self, at, f):
        """Distance of a ball half a spacing thick to wall f."""
        axis, half = f // 2, 0.5 * ti.cast(self.base.number[self.base.SPACING], ti.f64)
        below = at[axis] - ti.cast(self.base.extent[0][axis], ti.f64)
        above = ti.cast(self.base.extent[1][axis], ti.f64) - at[axis]
        return ti.select(f % 2 == 0, below, above) - half

    @ti.func
    def hold(self, b):
        """The least motion that takes all corners off the walls, in rounds; what is left of a penetration is shifted away.

        Centre and rotation are locals: read again from their fields within the loop, they were those of its start.
        """
        centre, q = self.centre[b], self.turn[b]
        spacing = ti.cast(self.base.number[self.base.SPACING], ti.f64)
        low, high = self.depths(b, centre, rotation(q))
        rounds = 0
        while (low + high).norm() > 1e-6 * spacing and rounds < ROUNDS:
            u, phi = self.lift_off(b, centre, rotation(q), spacing)
            centre += u
            q = turned(q, phi)
            low, high = self.depths(b, centre, rotation(q))
            rounds += 1
        self.centre[b], self.turn[b] = centre + low - high, q

    @ti.func
    def depths(self, b, centre, R):
        """How deep the deepest corners stand in the lower and in the upper walls, [3] each."""
        low, high = ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3)
        for p in range(self.span[b][0], self.span[b][1]):
            if self.corner[p]:
                at = centre + R @ self.rest[p]
                for d in ti.static(range(self.dim)):
                    low[d], high[d] = ti.max(low[d], -self.gap(at, 2 * d)), ti.max(high[d], -self.gap(at, 2 * d + 1))
        return low, high

    @ti.func
    def lift_off(self, b, centre, R, spacing):
        """u = sum J n / N and phi = I^-1 sum J a x n that take the corners at c + a off the walls, J >= 0."""
        first, last = self.span[b][0], self.span[b][1]
        W, mass = R @ self.inverse[b] @ R.transpose(), ti.cast(last - first, ti.f64)
        u, phi = ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3)
        for p in range(first, last):
            self.push[p] *= 0.0
        sweep, change, largest = 0, ti.cast(1.0, ti.f64), ti.cast(0.0, ti.f64)
        while sweep < SWEEPS and change > SETTLED * largest:
            sweep += 1
            change = 0.0
            for p in range(first, last):
                if self.corner[p]:
                    arm = R @ self.rest[p]
                    for f in range(2 * self.dim):
                        gap = self.gap(centre + arm, f)
                        if gap < NEAR * spacing:
                            n = ti.Vector.zero(ti.f64, 3)
                            n[f // 2] = 1.0 - 2.0 * (f % 2)
                            lever = arm.cross(n)
                            away = W @ lever
                            moved = u + phi.cross(arm)
                            before = self.push[p][f]
                            now = ti.max(before - (gap + moved.dot(n)) / (1.0 / mass + lever.dot(away)), 0.0)
                            self.push[p][f] = now
                            u += (now - before) / mass * n
                            phi += (now - before) * away
                            change = ti.max(change, ti.abs(now - before))
                            largest = ti.max(largest, now)
        return u, phi

    @ti.func
    def conclude(self, b, dt):
        """Velocity and angular momentum by what the constraints changed; velocities of the particles."""
        self.velocity[b] += (self.centre[b] - self.ahead[b]) / dt
        R = rotation(self.turn[b])
        change = angle_of(difference(self.turn[b], self.ahead_turn[b])) / dt
        self.momentum[b] += R @ (self.inertia[b] @ (R.transpose() @ change))
        self.write_velocity(b)

    @ti.func
    def write_velocity(self, b):
        """Velocities of the particles of body b: v + w x r."""
        R, w = rotation(self.turn[b]), self.spin(b, self.turn[b])
        for p in range(self.span[b][0], self.span[b][1]):
            u = self.velocity[b] + w.cross(R @ self.rest[p])
            for d in ti.static(range(self.dim)):
                self.base.v[self.base.slot[p]][d] = ti.cast(u[d], ti.f32)

    @ti.func
    def take_velocity(self, b):
        """The rigid motion nearest to the particles' velocities."""
        R, n = rotation(self.turn[b]), ti.cast(self.span[b][1] - self.span[b][0], ti.f64)
        V, L, second, own = ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3), ti.Matrix.zero(ti.f64, 3, 3), self.inertia[b]
        for p in range(self.span[b][0], self.span[b][1]):
            u, r = ti.Vector.zero(ti.f64, 3), self.rest[p]
            for d in ti.static(range(self.dim)):
                u[d] = ti.cast(self.base.v[self.base.slot[p]][d], ti.f64)
            V += u / n
            L += (R @ r).cross(u)
            second += r.norm_sqr() * ti.Matrix.identity(ti.f64, 3) - r.outer_product(r)
        # The moments of the points, without the cubes' own, give the spin, which turns the cubes too; a line of points has none about itself.
        tiny = 1e-9 * own.trace() * ti.Matrix.identity(ti.f64, 3)
        self.velocity[b] = V
        self.momentum[b] = R @ (own @ ((second + tiny).inverse() @ (R.transpose() @ L)))
        self.write_velocity(b)


#: Columns of ``body_table``.
COLUMNS = 14


def body_table(scene: Scene, particles: Particles, position: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """[bodies, COLUMNS] float64: span, centre [3], inertia [9]; and [n, 5]: a particle's place in its body, 1 for corners of the hull, its density
    by the body alone.

    ``position`` [n, dim] and ``edge`` (spacing) in support radii.
    """
    dim, rigid = scene.dim, [index for index, body in enumerate(scene.bodies) if scene.materials[body.material].model == "rigid"]
    table, places = np.zeros((len(rigid), COLUMNS)), np.zeros((len(position), 5))
    for row, index in zip(table, rigid, strict=True):
        members = np.flatnonzero(particles.body == index)
        centre = position[members].mean(0)
        arm = np.zeros((len(members), 3))
        arm[:, :dim] = position[members] - centre
        second = arm.T @ arm + len(members) * edge**2 / 12 * np.diag([1.0] * dim + [0.0] * (3 - dim))
        row[:2], row[2 : 2 + dim], row[5:14] = (members[0], members[-1] + 1), centre, (np.trace(second) * np.eye(3) - second).ravel()
        scale = edge**dim * lattice_scale(dim, edge)
        own = [scale * kernel(dim, np.sqrt(((arm - each) ** 2).sum(1))).sum() for each in arm]
        places[members, :3], places[members, 3], places[members, 4] = arm, 1.0, own
        try:
            hull = ConvexHull(arm[:, :dim]).vertices
        except (QhullError, ValueError):
            continue  # a line or a sheet of particles: all are corners
        places[members, 3] = 0.0
        places[members[hull], 3] = 1.0
    return table, places
