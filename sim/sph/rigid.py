"""Rigid bodies in water (``sim.rigid``): two-way coupling with its particles.

A body's particles fill it as water's lattice would, and to a particle of water each counts as one more neighbour of the same volume that moves
with the body (Akinci et al. 2012; "boundary particles"). All that water sees of body b is a few sums over its particles p within reach,

    g_i = sum_p V grad W_ip,    S_i = sum_p V W_ip,    M_i = sum_p (x_p - x_i) (x) V grad W_ip,    K_i = A sum_p f (t / r)^2 z / s,

one entry a pair of particle and body (t: along the face, z: across it, from a plane at s). A force f_i on water at x_i is -f_i and
-(x_i - c) x f_i on the body: both momenta are kept to rounding.

Decisions:
- Volumes. Akinci et al. give boundary particles 1 / sum_p W, for bodies sampled by one layer on their surface. Ours are filled, and the lattice
  goes on across a face: V = spacing^dim is right for water on it, while 1 / sum_p W makes the outermost layer larger,
  so that water stays further away and the body displaces more than it is.
- Pressure. DFSPH: a_i = -2 k_i g_i, half of it the transpose of the rate of the density, as at walls (``sim.sph.dfsph``; Akinci et al. 2012, eq. 9,
  without the mirrored half): its velocity solve then is a projection of the velocities of water *and bodies*, and buoyancy is the water's weight by
  virtual work. WCSPH: pressures are known, not solved for, and continue across the face by their mean gradient around the
  body (Adami et al. 2012: by that of the body's motion): p_p = p_i + grad p . (x_p - x_i).
- Strong coupling. Each iteration of DFSPH's velocity solve includes the motion that its pressures give to the bodies: the operator gains
  h_i . h_j / m, of rank 3 (2D) or 6 a body, far larger than its diagonal where bodies are light. Conjugate gradients take an iteration for each
  of its few eigenvalues; Jacobi's iterations diverge, and Gissler et al. (2019), who interlink solves of water and contacts, relax. What
  corrects places alone leaves bodies where they are.
- Films. Between a wall and a face nearer than a particle is thick no water fits, and without any a light body would stay on the floor for ever.
  A gap that opens draws water from its rim: the rate of the density of water there loses the film's area times the body's speed away from
  the wall, and by the transpose the rim's pressure acts on that area (``film``); where the rim is dry, by as much less. Between bodies there are
  none. Its error is a share of the pressure, not of the buoyancy: under half a metre of water a box an eighth high rises from the floor with half
  of water's density by DFSPH; by WCSPH it stays there with a tenth.
- Contacts (``sim.rigid``) follow the pressures, once a step: what they change of a body's velocity, water answers in the next solve.
- Bodies' particles are behind the water's in all fields, [n, n + members), and are never sorted.

Units as in ``sim.sph.solver``; masses over that of a particle of water.
"""

import numpy as np
from scipy.linalg import eigh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sim.rigid import OVERFLOW, Bodies, lift, times
from sim.sph.kernel import CLOSEST, SHARE, slope
from sim.sph.neighbours import SKIN
from sim.taichi_runtime import ti

#: Depth in particle spacings from which water in a body is put back.
DEEP = 0.1
#: Width in particle spacings of a gap at a wall up to which particles may not fill it: between one layer and two.
THIN = 2.0
#: Height in spacings over its lowest particle of the sides of a body whose pressure a film takes on: three layers.
BAND = 2.5
#: Share of a step in the mean acceleration of the water around a body.
PACE = 0.05


def _two(bodies: int) -> list:
    return [ti.Vector.field(3, ti.f64, bodies) for _ in range(2)]


@ti.data_oriented
class RigidBodies(Bodies):
    """``base``: ``sim.sph.solver._Kernels``; room for so many bodies of so many faces, and pairs of their particles with water's."""

    #: A step's way is at most a share of a spacing, whatever speed the pressures give.
    near = 0.3
    #: Motions of bodies that ``flow`` and ``there`` can take: their velocities, accelerations by pressures, directions of the viscous solve.
    VELOCITY, PULL, SEARCH = range(3)

    def __init__(self, base, bodies: int, planes: int, pairs: int):
        structure = base.structure
        super().__init__(base, bodies, planes, base.capacity, base.capacity, structure.obstacles, structure.periodic)
        self.viscous, self.weak = structure.viscous, structure.method == "wcsph"
        self.members = ti.field(ti.i32, ())  # particles of all bodies
        self.first, self.other = ti.field(ti.i32, base.capacity + 1), ti.field(ti.i32, pairs)  # pairs of body particles with water's
        self.entry = ti.field(ti.i32, base.capacity)  # a water particle's with the body that ``gather`` is at
        self.begin = ti.field(ti.i32, bodies + 1)  # a body's entries
        self.particle = ti.field(ti.i32, pairs)
        self.g = ti.Vector.field(4, ti.f32, pairs)  # and S
        self.r = ti.Vector.field(3, ti.f32, pairs)  # x_i - c
        self.h, self.l = (ti.Vector.field(3, ti.f32, pairs) for _ in range(2))  # force and torque on the body by a pressure of 1
        self.bare = ti.field(ti.i32, base.capacity)  # sides of a body's particle without one of its own next to it, a bit each
        self.rim = ti.Vector.field(3, ti.f32, pairs)
        if self.weak:
            self.M = ti.Matrix.field(3, 3, ti.f32, pairs)
        else:
            self.spread = ti.field(ti.f32, pairs)  # the trace of M
        if self.viscous:
            self.K = ti.field(ti.f32, pairs)
            self.face = ti.Vector.field(4, ti.f32, pairs)  # the nearest face's normal and distance
        # Linear and angular.
        self.motion = [(self.velocity, self.spin)] + [_two(bodies) for _ in range(0 if self.weak else 1 + self.viscous)]
        if self.weak or self.viscous:
            self.force, self.torque = _two(bodies)
        if self.weak:
            self.before = _two(bodies)
            self.felt = ti.Vector.field(3, ti.f64, bodies)  # a - g of the water around a body
            self.state += [self.force, self.torque, self.felt]
            self.saved += [ti.Vector.field(3, ti.f64, bodies) for _ in range(3)]
        elif self.viscous:
            self.residual = _two(bodies)
        self.fastest = ti.field(ti.f32, 2)  # squared speed of a body's particle; what it was when the frame began

    @staticmethod
    def fields(dim: int, bodies: int, planes: int, particles: int, pairs: int, weak: bool, viscous: bool) -> dict[str, tuple[int, int]]:
        """As ``SPHSimulator.plan`` lists them."""
        found = Bodies.sizes(dim, bodies, planes, particles, particles)
        found |= {"rigid first": (4, particles + 1), "rigid entry": (4, particles)}
        found |= {f"rigid {name}": (4, pairs) for name in ("other", "particle")}
        found |= {"rigid begin": (4, bodies + 1), "rigid g": (16, pairs), "rigid r": (12, pairs), "rigid h": (12, pairs), "rigid l": (12, pairs)}
        found |= {"rigid bare": (4, particles), "rigid rim": (12, pairs)}
        found |= {"rigid M": (36, pairs)} if weak else {"rigid spread": (4, pairs)}
        found |= {"rigid K": (4, pairs), "rigid face": (16, pairs)} if viscous else {}
        vectors = ["force", "force before", "saved force"] if weak else ["pull"] + ["search", "drag", "residual"] * viscous
        found |= {f"rigid {name}": (24, bodies) for name in ("felt", "saved felt")} if weak else {}
        return found | {f"rigid {kind} {name}": (24, bodies) for name in vectors for kind in ("linear", "angular")}

    def set_velocity(self, velocity: np.ndarray) -> None:
        """Velocity and spin of the rigid motions nearest to the velocities [capacity, 3] of the bodies' particles."""
        rest, linear, angular = self.rest.to_numpy(), self.velocity.to_numpy(), self.spin.to_numpy()
        for b, (first, last) in enumerate(self.span.to_numpy()[: self.count[None]]):
            arm = np.zeros((last - first, 3))
            arm[:, : self.dim] = rest[first:last]
            R = Rotation.from_quat(self.turn.to_numpy()[b, [1, 2, 3, 0]]).as_matrix()
            arm, u = arm @ R.T, velocity[first:last]
            second = arm.T @ arm
            linear[b] = u.mean(0)
            angular[b] = np.linalg.pinv(np.trace(second) * np.eye(3) - second) @ np.cross(arm, u).sum(0)
        self.velocity.from_numpy(linear)
        self.spin.from_numpy(angular)

    def velocities(self, b: int) -> np.ndarray:
        """[n, 3] of body b's particles; those that particles carry are of before the last correction."""
        arm = self.rest.to_numpy()[slice(*self.span.to_numpy()[b])] @ self.rotation.to_numpy()[b, : self.dim, : self.dim].T
        return self.velocity.to_numpy()[b] + np.cross(self.spin.to_numpy()[b], np.pad(arm, ((0, 0), (0, 3 - self.dim))))

    # -- what ``Bodies`` asks for
    @ti.func
    def roughness(self):
        return self.kernels.number[self.kernels.ROUGH]

    @ti.func
    def obstacle(self, x):
        place = ti.Vector.zero(ti.f32, 4)
        for d in ti.static(range(self.dim)):
            place[d] = x[d]
        s, n = self.kernels.clearance(place)
        return s, lift(n), self.roughness()

    # -- pairs with water
    @ti.func
    def find_water(self, n):
        """Water near each body's particles, when water has been sorted."""
        base, near = self.kernels, self.kernels.neighbours
        reach = ti.static((1 + SKIN) ** 2)
        k = 0
        for p in range(n, n + self.members[None]):
            self.first[p] = k
            xp = base.x[p]
            near.listed_at[p] = xp
            home, rest = ti.Vector.zero(ti.i32, self.dim), near.place(xp)
            for d in ti.static(range(self.dim - 1, -1, -1)):
                home[d] = rest % near.size[None][d]
                rest = rest // near.size[None][d]
            for o in range(3**self.dim):
                cell, rest = 0, o
                for d in ti.static(range(self.dim)):
                    at = home[d] + rest % 3 - 1
                    rest = rest // 3
                    if ti.static(self.periodic[d]):
                        inner = near.size[None][d] - 2
                        at = 1 + (at - 1 + inner) % inner
                    cell = cell * near.size[None][d] + at
                if k + near.start[cell + 1] - near.start[cell] > self.other.shape[0]:
                    k = self.other.shape[0]
                    near.count[None] = near.other.shape[0]
                else:
                    for i in range(near.start[cell], near.start[cell + 1]):
                        r = near.apart(base.x[i] - xp)
                        r[3] = 0.0
                        self.other[k] = i
                        k += ti.cast(r.norm_sqr() < reach, ti.i32)
        self.first[n + self.members[None]] = k

    @ti.func
    def gather(self, n):
        """The entries: g, S and, where they are needed, M and K."""
        base = self.kernels
        V, C = base.number[base.VOLUME], base.number[base.KERNEL]
        for i in range(n):
            self.entry[i] = -1
        e = 0
        for b in range(self.count[None]):
            first = e
            self.begin[b] = e
            for p in range(self.span[b][0], self.span[b][1]):
                xp = base.x[p]
                for k in range(self.first[p], self.first[p + 1]):
                    i = self.other[k]
                    r = base.neighbours.apart(base.x[i] - xp)
                    r[3] = 0.0
                    q2 = r.norm_sqr()
                    if q2 < 1.0:
                        m = self.entry[i]
                        if m < first:
                            m = e
                            e += 1
                            self.entry[i], self.particle[m] = m, i
                            self.g[m], self.r[m] = ti.Vector.zero(ti.f32, 4), self.arm(b, lift(base.x[i]))
                            if ti.static(self.weak):
                                self.M[m] = ti.Matrix.zero(ti.f32, 3, 3)
                            else:
                                self.spread[m] = 0.0
                            if ti.static(self.viscous):
                                self.K[m] = 0.0
                                s, face = self.outside(b, lift(base.x[i]))
                                self.face[m] = ti.Vector([face[0], face[1], face[2], ti.max(s, CLOSEST)])
                        t = 1.0 - ti.sqrt(q2)
                        q = 20.0 * C * V * t * t * t
                        G = -q * r
                        G[3] = V * C * t * t * t * t * (5.0 - 4.0 * t)
                        self.g[m] += G
                        way = lift(r)
                        if ti.static(self.weak):
                            self.M[m] += q * way.outer_product(way)
                        else:
                            self.spread[m] += q * q2
                        if ti.static(self.viscous):
                            face = self.face[m]
                            # The body's velocity is that of its face, behind which it continues the water's linearly (Takeda et al. 1994).
                            z = face[0] * r[0] + face[1] * r[1] + face[2] * r[2]
                            along = ti.max(q2 - z * z, 0.0) / ti.static(self.dim - 1)
                            self.K[m] += base.number[base.THICKNESS] * ti.max(z / face[3], 1.0) * t * ti.sqrt(t) * along / (q2 + 1e-12)
            self.begin[b + 1] = e
            for m in range(first, e):
                self.h[m] = ti.static(1.0 if self.weak else 2.0) * lift(self.g[m])
                self.l[m], self.rim[m] = self.r[m].cross(self.h[m]), ti.Vector.zero(ti.f32, 3)
            for f in range(2 * self.dim + ti.static(int(self.obstacles))):
                self.film(b, f)
        self.begin[self.count[None]] = e

    @ti.func
    def wall(self, x, f):
        """Distance of a place [4] to wall f, or the obstacles, and its normal [3]."""
        s, n, axis, side = OVERFLOW, ti.Vector.zero(ti.f32, 3), f // 2, f % 2
        if f < 2 * self.dim:
            n[axis] = 1.0 - 2.0 * side
            s = (x[axis] - self.kernels.extent[side][axis]) * n[axis]
            for d in ti.static(range(self.dim)):
                if ti.static(self.periodic[d]):
                    s = ti.select(axis == d, OVERFLOW, s)
        elif ti.static(self.obstacles):
            s, n, _rough = self.obstacle(x)
        return s, n

    @ti.func
    def film(self, b, f):
        """Add to h and l of the water at the rim of the film between body b and wall f.

        The film is on the sides of the body's lattice that face the wall, nearer than THIN spacings, as far as water's particles do not fill the
        gap: the sum, at the body's particle, of the kernels of those beyond its side over that of a gap full of water. Its pressure is what the
        water pushes with, along the wall, on the sides of the body next to it, BAND spacings high, over their area: sum_i k_i |sum_p V grad W_ip|
        (``corner_share``). The pressures of single particles will not do: a tenth more than the water's bears, half a metre deep, a stone a
        tenth of a metre high."""
        base, spacing = self.kernels, 2.0 * self.half[None]
        lowest, q = OVERFLOW, 20.0 * base.number[base.KERNEL] * base.number[base.VOLUME]
        for p in range(self.span[b][0], self.span[b][1]):
            lowest = ti.min(lowest, self.wall(base.x[p], f)[0])
        if lowest < (THIN + 0.5) * spacing:
            R, force, torque, sides = self.rotation[b], ti.Vector.zero(ti.f32, 3), ti.Vector.zero(ti.f32, 3), 0.0
            for p in range(self.span[b][0], self.span[b][1]):
                s, n = self.wall(base.x[p], f)
                if s < lowest + BAND * spacing:
                    area, filled = 0.0, 0.0
                    for side in range(2 * self.dim):
                        if self.bare[p] >> side & 1:
                            out = ti.Vector([R[0, side // 2], R[1, side // 2], R[2, side // 2]]) * ti.cast(2 * (side % 2) - 1, ti.f32)
                            across = out.dot(n)
                            area += ti.max(-across, 0.0)
                            sides += (out - across * n).norm()
                    for k in range(self.first[p], self.first[p + 1]):
                        i = self.other[k]
                        way = lift(base.neighbours.apart(base.x[i] - base.x[p]))
                        t, across = 1.0 - way.norm(), way.dot(n)
                        if t > 0.0:
                            self.rim[self.entry[i]] += (q * t * t * t) * (way - across * n)
                            filled += ti.select(across < -0.5 * spacing, t * t * t * t * (5.0 - 4.0 * t), 0.0)
                    if s < (THIN + 0.5) * spacing:
                        room = base.look(0.5 * spacing)[SHARE] - base.look(ti.min(s, 1.0))[SHARE]
                        area *= 1.0 - ti.min(filled * base.number[base.KERNEL] * base.number[base.VOLUME] / ti.max(room, 1e-6), 1.0)
                        force += area * n
                        torque += area * self.arm(b, lift(base.x[p])).cross(n)
            share = 2.0 / (base.number[base.CORNER] * ti.max(sides, 1e-6))
            for m in range(self.begin[b], self.begin[b + 1]):
                weight = share * self.rim[m].norm()
                self.h[m] += weight * force
                self.l[m] += weight * torque
                self.rim[m] *= 0.0

    @ti.func
    def there(self, b, m, motion: ti.template()):
        """[3]: velocity that a ``motion`` of body b gives to the place of entry m's particle."""
        linear, angular = self.motion[motion][0][b], self.motion[motion][1][b]
        return ti.cast(linear + angular.cross(ti.cast(self.r[m], ti.f64)), ti.f32)

    # -- pressures as unknowns (DFSPH)
    @ti.func
    def surround(self, wall: ti.template(), crowd: ti.template()):
        """Add g and S to what walls give (``wall``), g and tr M to ``crowd``."""
        for m in range(self.begin[self.count[None]]):
            i, g = self.particle[m], self.g[m]
            wall[i] += g
            g[3] = self.spread[m]
            crowd[i] += g

    @ti.func
    def flow(self, push: ti.template(), motion: ti.template(), factor):
        """Rate of water's density by the bodies' motion: push[3] -= factor (h . V + l . w)."""
        for b in range(self.count[None]):
            V, w = self.motion[motion][0][b], self.motion[motion][1][b]
            for m in range(self.begin[b], self.begin[b + 1]):
                push[self.particle[m]][3] -= factor * ti.cast(V.dot(self.h[m]) + w.dot(self.l[m]), ti.f32)

    @ti.func
    def react(self, pressure: ti.template(), lane, factor):
        """Accelerations of the bodies by ``factor`` times a lane of ``pressure``: m A = sum k h, I alpha = sum k l."""
        for b in range(self.count[None]):
            F, T = ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3)
            for m in range(self.begin[b], self.begin[b + 1]):
                k = factor * pressure[self.particle[m]][lane]
                F += k * self.h[m]
                T += k * self.l[m]
            self.motion[self.PULL][0][b], self.motion[self.PULL][1][b] = F / self.total[b], times(self.inverse[b], T)

    @ti.func
    def accelerate(self, factor):
        """Velocities by the accelerations of ``react``, times ``factor``."""
        for b in range(self.count[None]):
            self.velocity[b] += factor * self.motion[self.PULL][0][b]
            self.spin[b] += factor * self.motion[self.PULL][1][b]

    @ti.func
    def rub(self, m, u):
        """Drag of a velocity relative to the body, over the viscosity: along the face, as at walls."""
        n = lift(self.face[m])
        return self.K[m] * (u - u.dot(n) * n)

    # -- viscosity, implicit
    @ti.func
    def drag(self, u: ti.template(), image: ti.template(), dtnu, motion: ti.template()):
        """image_i += dt nu K (u_i - u_b); the opposite, and the body's own momentum m V, I w, in ``force`` and ``torque``."""
        for b in range(self.count[None]):
            F = self.total[b] * self.motion[motion][0][b]
            T = times(self.moment[b], self.motion[motion][1][b])
            for m in range(self.begin[b], self.begin[b + 1]):
                i = self.particle[m]
                f = dtnu * self.rub(m, lift(u[i]) - self.there(b, m, motion))
                for d in ti.static(range(3)):
                    image[i][d] += f[d]
                F -= f
                T -= self.r[m].cross(f)
            self.force[b], self.torque[b] = F, T

    @ti.func
    def resist(self):
        """The residual of the bodies' viscous equations, R^-1 u - (what ``drag`` gave): in ``force`` and ``torque``, times R in SEARCH. Squares, in
        R, of the right side and of it."""
        size, error = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for b in range(self.count[None]):
            P, L = self.total[b] * self.velocity[b], times(self.moment[b], self.spin[b])
            F, T = P - self.force[b], L - self.torque[b]
            self.residual[0][b], self.residual[1][b] = F, T
            self.motion[self.SEARCH][0][b], self.motion[self.SEARCH][1][b] = F / self.total[b], times(self.inverse[b], T)
            size += P.dot(self.velocity[b]) + L.dot(self.spin[b])
            error += F.norm_sqr() / self.total[b] + T.dot(times(self.inverse[b], T))
        return size, error

    @ti.func
    def work(self):
        """SEARCH times its image."""
        power = ti.cast(0.0, ti.f64)
        for b in range(self.count[None]):
            power += self.motion[self.SEARCH][0][b].dot(self.force[b]) + self.motion[self.SEARCH][1][b].dot(self.torque[b])
        return power

    @ti.func
    def follow(self, step):
        """A step along SEARCH; the square of the residual that is left."""
        error = ti.cast(0.0, ti.f64)
        for b in range(self.count[None]):
            self.velocity[b] += step * self.motion[self.SEARCH][0][b]
            self.spin[b] += step * self.motion[self.SEARCH][1][b]
            F, T = self.residual[0][b] - step * self.force[b], self.residual[1][b] - step * self.torque[b]
            self.residual[0][b], self.residual[1][b] = F, T
            error += F.norm_sqr() / self.total[b] + T.dot(times(self.inverse[b], T))
        return error

    @ti.func
    def search(self, turn):
        """SEARCH: R times the residual, and ``turn`` of itself."""
        for b in range(self.count[None]):
            linear, angular = self.motion[self.SEARCH][0][b], self.motion[self.SEARCH][1][b]
            self.motion[self.SEARCH][0][b] = self.residual[0][b] / self.total[b] + turn * linear
            self.motion[self.SEARCH][1][b] = times(self.inverse[b], self.residual[1][b]) + turn * angular

    # -- pressures that are known (WCSPH)
    @ti.func
    def press(self, scheme: ti.template(), g):
        """Bodies' part in the rates of water (``sim.sph.wcsph``), and its opposite on them, ``force`` and ``torque``.

        f_i = -2 P_i g_i + M_i (a - g): the pressure goes on behind the face by its gradient in the water around the body, g - a, a being the mean
        acceleration (``scheme.before``) of some ``PACE`` of steps: 0 at rest, g in free fall. By the a_i of each particle and of the step before, a
        body of a hundredth of water's density gained forty times the energy at hand in a second, whatever the step.
        """
        base = self.kernels
        nu = base.number[base.VISCOSITY]
        for b in range(self.count[None]):
            F, T = ti.Vector.zero(ti.f64, 3), ti.Vector.zero(ti.f64, 3)
            mean, weight = ti.Vector.zero(ti.f32, 3), 1e-12
            for m in range(self.begin[b], self.begin[b + 1]):
                share = self.M[m].trace()
                mean += share * lift(scheme.before[self.particle[m]] - g)
                weight += share
            felt = self.felt[b] + PACE * (ti.cast(mean / weight, ti.f64) - self.felt[b])
            self.felt[b] = felt
            for m in range(self.begin[b], self.begin[b + 1]):
                i = self.particle[m]
                A, slope = scheme.rate[i], lift(self.g[m])
                u = lift(base.v[i]) - self.there(b, m, self.VELOCITY)
                f = times(self.M[m], ti.cast(felt, ti.f32)) - 2.0 * ti.max(base.x[i][3], 0.0) * slope
                if ti.static(self.viscous):
                    f -= nu * self.rub(m, u)
                for d in ti.static(range(3)):
                    A[d] += f[d]
                film, twist = self.h[m] - slope, self.l[m] - self.r[m].cross(slope)
                A[3] += u.dot(slope)
                A[3] -= ti.cast(self.velocity[b].dot(film) + self.spin[b].dot(twist), ti.f32)
                F += ti.max(base.x[i][3], 0.0) * film
                T += ti.max(base.x[i][3], 0.0) * twist
                scheme.rate[i] = A
                if ti.static(base.structure.shifting):
                    scheme.crowd[i] += ti.Vector([slope[0], slope[1], slope[2], self.M[m].trace()])
                F -= f
                T -= self.r[m].cross(f)
            self.force[b], self.torque[b] = F, T

    @ti.func
    def kick(self, dt, g):
        """Velocities by ``force``, ``torque`` and gravity over a time dt."""
        for b in range(self.count[None]):
            self.velocity[b] += dt * (self.force[b] / self.total[b] + lift(g))
            self.spin[b] += dt * times(self.inverse[b], self.torque[b])

    @ti.func
    def drift(self, dt, g):
        """The first half of a step of velocity Verlet: to the new places by the velocities of its middle, then those predicted for its end.

        Contacts hold both: an impulse at the middle alone would leave half a step's weight on a body at rest."""
        if dt > 0.0:
            self.keep_out(dt)
            self.put_back()
        for half in range(ti.select(dt > 0.0, 2, 0)):
            if half == 1:
                self.step(dt)
            self.kick(0.5 * dt, g)
            if half == 0:
                self.find_contacts(dt)
            else:
                for k in range(ti.min(self.touching[None], self.pair.shape[0])):
                    for d in ti.static(range(3)):
                        self.impulse[k][d] = 0.0
            self.solve()
        for b in range(self.count[None]):
            self.before[0][b], self.before[1][b] = self.force[b], self.torque[b]

    @ti.func
    def correct(self, dt):
        """The second half: by what force and torque have changed."""
        for b in range(self.count[None]):
            self.velocity[b] += (0.5 * dt / self.total[b]) * (self.force[b] - self.before[0][b])
            self.spin[b] += (0.5 * dt) * times(self.inverse[b], self.torque[b] - self.before[1][b])

    # -- motion
    @ti.func
    def fall(self, dt, g):
        """v += dt g."""
        for b in range(self.count[None]):
            self.velocity[b] += dt * lift(g)

    @ti.func
    def collide(self, dt):
        """Contacts with walls and each other, then with water that pressures have not kept out."""
        if dt > 0.0:
            self.find_contacts(dt)
            self.solve()
            self.keep_out(dt)

    @ti.func
    def step(self, dt):
        """To their new places; what contacts beyond the list's room fail with is a list of pairs that is full."""
        if dt > 0.0:
            fastest = self.travel(dt)
            if fastest >= OVERFLOW:
                self.kernels.neighbours.count[None] = self.kernels.neighbours.other.shape[0]
            else:
                self.fastest[0] = fastest

    @ti.func
    def keep_out(self, dt):
        """Water that a step would take into a body, whatever pressures do, gets no further than its face: u . n >= -distance / dt between the two, by
        an impulse on both at the water's place. Momenta are kept."""
        base = self.kernels
        for b in range(self.count[None]):
            for m in range(self.begin[b], self.begin[b + 1]):
                i = self.particle[m]
                x = lift(base.x[i])
                s, n = self.outside(b, x)
                u = lift(base.v[i]) - self.point_velocity(b, x)
                lack = -ti.max(s, 0.0) / dt - u.dot(n)
                if lack > 0.0 and s > -1.0:
                    turn = self.arm(b, x).cross(n)
                    J = ti.cast(lack / (1.0 + 1.0 / self.total[b] + turn.dot(times(self.inverse[b], turn))), ti.f32)
                    for d in ti.static(range(self.dim)):
                        base.v[i][d] += J * n[d]
                    self.velocity[b] -= J / self.total[b] * n
                    self.spin[b] -= J * times(self.inverse[b], turn)

    @ti.func
    def put_back(self):
        """Water that is DEEP in a body, onto its face."""
        base = self.kernels
        for b in range(self.count[None]):
            for m in range(self.begin[b], self.begin[b + 1]):
                i = self.particle[m]
                s, n = self.outside(b, lift(base.x[i]))
                if s < -2.0 * DEEP * self.half[None]:
                    for d in ti.static(range(self.dim)):
                        base.x[i][d] -= s * n[d]
                    base.enclose(i)

    @ti.func
    def energies(self, g):
        """Kinetic and potential."""
        kinetic, potential = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for b in range(self.count[None]):
            V, w = self.velocity[b], self.spin[b]
            kinetic += 0.5 * (self.total[b] * V.norm_sqr() + w.dot(times(self.moment[b], w)))
            potential -= ti.cast(self.total[b] * self.centre[b].dot(lift(g)), ti.f64)
        return kinetic, potential


def bare(particles: np.ndarray, bodies: np.ndarray, spacing: float) -> np.ndarray:
    """[n, 2 dim] bool: whether a body's particle [n, dim] has none of its own next to it along -x, +x, -y, ..."""
    found = np.zeros((len(particles), 2 * particles.shape[1]), bool)
    for body in np.unique(bodies):
        places = particles[bodies == body]
        tree = cKDTree(places)
        ways = [way for axis in np.eye(particles.shape[1]) for way in (-axis, axis)]
        found[bodies == body] = np.stack([tree.query(places + way * spacing)[0] > spacing / 2 for way in ways], 1)
    return found


def corner_share(dim: int, spacing: float) -> float:
    """Share of a uniform pressure that water on a wall pushes with on the lowest BAND spacings of a body's side: behind the wall there is none."""
    reach = int(1 / spacing) + 1
    across, along, rows = np.arange(reach) + 0.5, np.arange(-reach, reach + 1), np.arange(int(BAND + 0.5))
    layers = np.arange(-reach, reach + 3)
    depth, inner, side, z, row = np.meshgrid(across, across, layers + 0.5, along if dim == 3 else [0], rows + 0.5, indexing="ij")
    r = np.sqrt((depth + inner) ** 2 + (side - row) ** 2 + z**2) * spacing
    push = slope(dim, r) * (depth + inner)
    return float(push[:, :, layers >= 0].sum() / push.sum())


def lightest(particles: np.ndarray, bodies: np.ndarray, masses: np.ndarray, spacing: float, slopes: float) -> float:
    """Largest w^2 / c^2 of a body that springs between the layers of weakly compressible water on all of its faces.

    A body that moves by u changes the densities by g_i . u, pressures by c^2 times that, and feels 2 P g: a spring of stiffness 2 c^2 sum g g^T,
    with ``slopes`` = sum g^2 over the layers on one face of the lattice. particles [n, dim], bodies [n], masses [n] of a particle over water's.
    """
    largest, dim = 0.0, particles.shape[1]
    for body in np.unique(bodies):
        places, mass = particles[bodies == body], masses[bodies == body][0]
        arm = np.zeros((len(places), 3))
        arm[:, :dim] = places - places.mean(0)
        sides, K = bare(places, np.zeros(len(places)), spacing), np.zeros((6, 6))
        for side in range(2 * dim):
            n, outer = np.zeros(3), arm[sides[:, side]]
            n[side // 2] = 2 * (side % 2) - 1
            J = np.concatenate([np.tile(n, (len(outer), 1)), np.cross(outer + n * spacing / 2, n)], 1)
            K += 2 * slopes * J.T @ J
        inertia = mass * (arm.T @ arm + len(arm) * np.diag([spacing**2 / 12] * dim + [0] * (3 - dim)))
        R = np.zeros((6, 6))
        R[:3, :3], R[3:, 3:] = np.eye(3) * mass * len(arm), np.trace(inertia) * np.eye(3) - inertia
        largest = max(largest, eigh(K, R, eigvals_only=True)[-1])
    return float(largest)
