"""Divergence-free SPH (Bender & Koschier 2015, 2017): pressures that keep the velocity free of divergence and the density at rest density.

With volumes V = spacing^dim, densities relative to that at rest, G_ij = V grad W_ij and G_i = sum_j G_ij + the walls' part, a pressure k (p / rho^2)
accelerates by a_i = -sum_j (k_i + k_j) G_ij - k_i (walls' part), and changes the density at the rate sum_j (u_i - u_j) . G_ij + u_i . (walls' part),
each the transpose of the other. Two solves a step, both by Jacobi iterations with diagonal 1 / alpha = |G_i|^2 + sum_j |G_ij|^2, relaxed
by one half and accelerated (``project``), k >= 0:

    no divergence:     dt times the rate of the velocity <= 0,
    constant density:  rho + dt times the rate of the velocity <= 1.

An iteration is two sweeps over the pairs, whose gradients are stored: they, not distances, are what it reads. Pressures start from those of the step
before. A solve ends when its mean error over all particles is below ``density_error`` (``divergence_error``), after at least ``LEAST``
iterations and at most ``iterations``; one that did not end so is counted, and its frame is repeated with half the step.

Without a free surface (``full``: the water fills its box) nothing can expand: densities are then held to their mean, from both sides. That is a
linear system with a symmetric matrix and takes conjugate gradients: pressures reach across the whole box, and Jacobi's iterations only a
particle each.

Viscosity is implicit, whatever its size: conjugate gradients for u + dt nu A sum_j f (u_ij . r_ij) r_ij / r^2 = u* (Weiler et al. 2018; f and A:
``sim.sph.kernel.viscous_weight``). Each pair's force is along its line, so angular momentum is kept.
"""

from sim.mpm.decomposition import finite
from sim.sph.rigid import RigidBodies
from sim.taichi_runtime import ti

#: Motions of rigid bodies, for those of the water.
VELOCITY, PULL, SEARCH = RigidBodies.VELOCITY, RigidBodies.PULL, RigidBodies.SEARCH

#: Iterations of a solve at least.
LEAST = 2
#: Relaxation of a Jacobi iteration (Bender & Koschier 2017, section 3.3).
RELAXATION = 0.5
#: Particles with fewer neighbours than this are not held free of divergence: spray would stick together (as in SPlisHSPlasH).
FEW = {2: 7, 3: 20}
#: Excess of density that is rounding: pushed away in every step, it would drive a block in free flight apart.
ROUNDING = 2e-6
#: Residual, relative to the right side, at which the viscous solve ends.
VISCOUS_ERROR = 1e-5


@ti.data_oriented
class DFSPH:
    """Fields of the pressures; ``base`` has particles, pairs and walls (``sim.sph.solver._Kernels``)."""

    def __init__(self, base, capacity: int, pairs: int):
        self.base, self.dim, self.structure = base, base.dim, base.structure
        self.rigid, self.has_rigid = base.rigid, base.has_rigid
        self.gradient = ti.Vector.field(4, ti.f32, pairs)  # G_ij of the pairs within reach, packed; lane 3: V W
        self.near = ti.field(ti.i32, pairs)
        self.begin = ti.field(ti.i32, capacity + 1)
        self.sums = ti.Vector.field(4, ti.f32, capacity)  # sum_j G_ij; lane 3: sum_j |G_ij|^2, then alpha
        self.wall = ti.Vector.field(4, ti.f32, capacity)  # the walls' part of G_i; lane 3: density
        self.push = ti.Vector.field(4, ti.f32, capacity)  # a_i; lane 3: rate of the density
        self.source = ti.field(ti.f32, capacity)
        self.members = ti.field(ti.i32, capacity)
        self.last, self.next = ti.field(ti.f32, capacity), ti.field(ti.f32, capacity)  # pressures of the iterations before and after
        self.pressure = ti.Vector.field(2, ti.f32, capacity)  # k of the two solves: divergence, density
        self.state = [self.pressure]
        if self.structure.full:
            self.krylov = ti.Vector.field(2, ti.f32, capacity)  # direction of the search, residual
        if self.structure.viscous:
            self.drag = ti.field(ti.f32, pairs)  # A f / |G|^2
            self.residual, self.search, self.image = (ti.Vector.field(4, ti.f32, capacity) for _ in range(3))

    @ti.func
    def gather(self, n):
        """Gradients of the pairs within reach, densities, alpha."""
        base = self.base
        V, K = base.number[base.VOLUME], base.number[base.KERNEL]
        for i in range(n):
            self.sums[i] = ti.Vector.zero(ti.f32, 4)
            gradient = base.walls(base.x[i])
            gradient[3] += V * K
            self.wall[i] = gradient
            self.members[i] = 0
        if ti.static(self.has_rigid):
            self.rigid.gather(n)
            self.rigid.surround(self.wall, self.members)
        m = 0
        for i in range(n):
            self.begin[i] = m
            xi = base.x[i]
            S, rho = ti.Vector.zero(ti.f32, 4), 0.0
            first = m
            for k in range(base.neighbours.first[i], base.neighbours.first[i + 1]):
                j = base.neighbours.other[k]
                r = base.neighbours.apart(xi - base.x[j])
                r[3] = 0.0
                q2 = r.norm_sqr()
                q = ti.sqrt(ti.min(q2, 1.0))
                t = 1.0 - q
                t3 = t * t * t
                G = (-20.0 * K * V * t3) * r
                w = V * K * t3 * t * (1.0 + 4.0 * q)
                s = G.norm_sqr()
                self.near[m] = j
                H = G
                H[3] = w
                self.gradient[m] = H
                if ti.static(self.structure.viscous):
                    self.drag[m] = base.number[base.THICKNESS] * t * ti.sqrt(t) / (s + 1e-20)
                G[3] = s
                S += G
                rho += w
                back = -G
                back[3] = s
                self.sums[j] += back
                self.wall[j][3] += w
                inside = ti.cast(q2 < 1.0, ti.i32)
                self.members[j] += inside
                m += inside
            self.sums[i] += S
            self.wall[i][3] += rho
            self.members[i] += m - first
        self.begin[n] = m
        for i in range(n):
            G = self.sums[i] + self.wall[i]
            norm = G[0] * G[0] + G[1] * G[1] + G[2] * G[2] + self.sums[i][3]
            self.sums[i][3] = 1.0 / ti.max(norm, 1e-6)

    @ti.func
    def rate(self, n, field: ti.template(), motion: ti.template()):
        """push[3]: rate of the density by a velocity or acceleration ``field`` of the water and a ``motion`` of the bodies."""
        for i in range(n):
            u, g = field[i], self.wall[i]
            self.push[i][3] = u[0] * g[0] + u[1] * g[1] + u[2] * g[2]
        for i in range(n):
            ui, total = field[i], 0.0
            for m in range(self.begin[i], self.begin[i + 1]):
                j = self.near[m]
                p = (ui - field[j]) * self.gradient[m]
                d = p[0] + p[1] + p[2]
                total += d
                self.push[j][3] += d
            self.push[i][3] += total
        if ti.static(self.has_rigid):
            self.rigid.flow(self.push, motion)

    @ti.func
    def accelerate(self, n, pressure: ti.template(), which):
        """push[:3]: accelerations by pressures, a lane of ``pressure``; the bodies' too."""
        for i in range(n):
            self.push[i] = -pressure[i][which] * self.wall[i]
        for i in range(n):
            ki, total = pressure[i][which], ti.Vector.zero(ti.f32, 4)
            for m in range(self.begin[i], self.begin[i + 1]):
                j = self.near[m]
                f = (ki + pressure[j][which]) * self.gradient[m]
                total += f
                self.push[j] += f
            self.push[i] -= total
        if ti.static(self.has_rigid):
            self.rigid.react(pressure, which)

    @ti.func
    def project(self, n, which, tolerance, most):
        """Accelerated projected Jacobi iterations (Nesterov 1983, with restarts where the residual points against the last change: O'Donoghue
        & Candes 2015; Mazhar et al. 2015 for contacts) for pressures k >= 0; iterations and mean error. ``push`` is that of the last pressures.

        The error of a particle is what its density stays above rest, or, under pressure, off it on either side: counting only
        excess, as Bender & Koschier do, ends solves that have overshot, and their surplus of pressure throws particles apart.
        """
        for i in range(n):
            self.last[i] = self.pressure[i][which]
        iterations, error, pace, going = 0, 1e30, 1.0, 1
        while going:
            self.accelerate(n, self.pressure, which)
            self.rate(n, self.push, PULL)
            error = 0.0
            for i in range(n):
                left = self.source[i] + self.push[i][3]
                error += ti.select(self.pressure[i][which] > 0.0, ti.abs(left), ti.max(left, 0.0))
            error /= ti.cast(n, ti.f32)
            iterations += 1
            going = ti.cast(iterations < most and (iterations < LEAST or error > tolerance), ti.i32)
            if going:
                if ti.static(self.has_rigid):
                    for i in range(n):
                        self.next[i] = self.source[i] + self.push[i][3]
                    self.rigid.give_way(self.next, self.pressure, self.sums, which)
                gain = 0.0
                for i in range(n):
                    left = self.source[i] + self.push[i][3]
                    way = left
                    if ti.static(self.has_rigid):
                        way = self.next[i]
                    k = ti.max(self.pressure[i][which] + RELAXATION * way * self.sums[i][3], 0.0)
                    gain += left * (k - self.last[i])
                    self.next[i] = k
                ahead = 0.5 * (1.0 + ti.sqrt(1.0 + 4.0 * pace * pace))
                momentum = (pace - 1.0) / ahead
                if gain < 0.0:
                    ahead, momentum = 1.0, 0.0
                pace = ahead
                for i in range(n):
                    k = self.next[i]
                    self.pressure[i][which] = k + momentum * (k - self.last[i])
                    self.last[i] = k
        return iterations, error

    @ti.func
    def conjugate(self, n, which, tolerance, most):
        """Conjugate gradients, preconditioned by alpha, for pressures of either sign; iterations and mean absolute error."""
        self.accelerate(n, self.pressure, which)
        self.rate(n, self.push, PULL)
        power, error = ti.cast(0.0, ti.f64), 0.0
        for i in range(n):
            r = self.source[i] + self.push[i][3]
            z = r * self.sums[i][3]
            self.krylov[i] = ti.Vector([z, r])
            power += ti.cast(r * z, ti.f64)
            error += ti.abs(r)
        iterations = 0
        while iterations < most and (iterations < LEAST or error > tolerance * ti.cast(n, ti.f32)) and power > 0.0:
            self.accelerate(n, self.krylov, 0)
            self.rate(n, self.push, PULL)
            work = ti.cast(0.0, ti.f64)
            for i in range(n):
                work -= ti.cast(self.krylov[i][0] * self.push[i][3], ti.f64)
            step, fresh = ti.cast(power / work, ti.f32), ti.cast(0.0, ti.f64)
            error = 0.0
            for i in range(n):
                self.pressure[i][which] += step * self.krylov[i][0]
                r = self.krylov[i][1] + step * self.push[i][3]
                self.krylov[i][1] = r
                fresh += ti.cast(r * r * self.sums[i][3], ti.f64)
                error += ti.abs(r)
            turn = ti.cast(fresh / power, ti.f32)
            for i in range(n):
                self.krylov[i][0] = self.krylov[i][1] * self.sums[i][3] + turn * self.krylov[i][0]
            power = fresh
            iterations += 1
        return iterations, error / ti.cast(n, ti.f32)

    @ti.func
    def solve(self, n, which, dt, tolerance, most):
        """One of the two solves (0: divergence, 1: density); changes the velocities. Returns iterations and mean error (relative density).

        ``which`` is data, so that the code is there once. Pressures are times dt^2 throughout, accelerations too.
        """
        base = self.base
        self.rate(n, base.v, VELOCITY)
        mean = 0.0
        for i in range(n):
            # Density after the step, above rest.
            s = dt * self.push[i][3]
            if which == 1:
                s += self.wall[i][3] - (1.0 + ROUNDING)
            elif ti.static(not self.structure.full) and self.members[i] < ti.static(FEW[self.dim]):
                s = -1.0
            self.source[i] = s
            mean += s
            k = dt * dt * self.pressure[i][which]
            if ti.static(not self.structure.full):
                k = ti.select(s > 0.0, k, 0.0)
            self.pressure[i][which] = k
        iterations, error = 0, 1e30
        if ti.static(self.structure.full):
            for i in range(n):
                self.source[i] -= mean / ti.cast(n, ti.f32)
            iterations, error = self.conjugate(n, which, tolerance, most)
            self.accelerate(n, self.pressure, which)
        else:
            iterations, error = self.project(n, which, tolerance, most)
        for i in range(n):
            for d in ti.static(range(self.dim)):
                base.v[i][d] += self.push[i][d] / dt
            self.pressure[i][which] /= dt * dt
        if ti.static(self.has_rigid):
            self.rigid.accelerate(1.0 / dt)
        return iterations, error

    @ti.func
    def viscous_image(self, n, dtnu, u: ti.template(), motion: ti.template()):
        """``image``: the viscous operator's of a velocity field and a ``motion`` of the bodies."""
        base = self.base
        for i in range(n):
            ui = u[i]
            self.image[i] = ui
            if ti.static(self.structure.no_slip):
                self.image[i] += dtnu * base.drag(base.x[i], ui, False)
        for i in range(n):
            ui, total = u[i], ti.Vector.zero(ti.f32, 4)
            for m in range(self.begin[i], self.begin[i + 1]):
                j = self.near[m]
                G = self.gradient[m]
                p = (ui - u[j]) * G
                f = (dtnu * self.drag[m] * (p[0] + p[1] + p[2])) * G
                total += f
                self.image[j] -= f
            self.image[i] += total
        for i in range(n):
            self.image[i][3] = 0.0
        if ti.static(self.has_rigid):
            self.rigid.drag(u, self.image, dtnu, motion)

    @ti.func
    def thicken(self, n, dt, most):
        """Implicit viscosity; returns the iterations and the residual that is left, relative."""
        base = self.base
        dtnu = dt * base.number[base.VISCOSITY]
        self.viscous_image(n, dtnu, base.v, VELOCITY)
        size, error = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for i in range(n):
            b = base.v[i]
            b[3] = 0.0
            if ti.static(self.structure.no_slip):
                b += dtnu * base.drag(base.x[i], b, True)
            r = b - self.image[i]
            self.residual[i], self.search[i] = r, r
            size += ti.cast(b.norm_sqr(), ti.f64)
            error += ti.cast(r.norm_sqr(), ti.f64)
        if ti.static(self.has_rigid):
            more, left = self.rigid.resist()
            size += more
            error += left
        goal, iterations = ti.static(VISCOUS_ERROR**2) * size, 0
        while iterations < most and error > goal:
            self.viscous_image(n, dtnu, self.search, SEARCH)
            power = ti.cast(0.0, ti.f64)
            for i in range(n):
                power += ti.cast(self.search[i].dot(self.image[i]), ti.f64)
            if ti.static(self.has_rigid):
                power += self.rigid.work()
            step, left = ti.cast(error / power, ti.f32), ti.cast(0.0, ti.f64)
            for i in range(n):
                base.v[i] += step * self.search[i]
                r = self.residual[i] - step * self.image[i]
                self.residual[i] = r
                left += ti.cast(r.norm_sqr(), ti.f64)
            if ti.static(self.has_rigid):
                left += self.rigid.follow(step)
            turn = ti.cast(left / error, ti.f32)
            for i in range(n):
                self.search[i] = self.residual[i] + turn * self.search[i]
            if ti.static(self.has_rigid):
                self.rigid.search(turn)
            error = left
            iterations += 1
        return iterations, ti.cast(ti.sqrt(error / ti.max(size, 1e-300)), ti.f32)

    @ti.func
    def smooth(self, n):
        """XSPH (Monaghan 1989): u_i += xsph sum_j V W (u_j - u_i); momentum is kept."""
        base = self.base
        share = base.number[base.XSPH]
        for i in range(n):
            self.push[i] = ti.Vector.zero(ti.f32, 4)
        for i in range(n):
            ui, total = base.v[i], ti.Vector.zero(ti.f32, 4)
            for m in range(self.begin[i], self.begin[i + 1]):
                j = self.near[m]
                f = self.gradient[m][3] * (base.v[j] - ui)
                total += f
                self.push[j] -= f
            self.push[i] += total
        for i in range(n):
            base.v[i] += share * self.push[i]

    @ti.func
    def limit(self, n, g):
        """Largest step, that moves particles by a share of a spacing; the largest speed; whether all are finite, which the largest does not tell.

        To their speed and what gravity adds comes c = sqrt(2 mean k), sqrt(g H) for water at rest: the density of a particle does not change with its
        own place at first order, so pressures hold it only by their curvature, k W'' ~ k / spacing^2, a spring whose frequency is c /
        spacing. Without this limit a pool of 20 layers boiled over at steps of 0.7 spacings / sqrt(g H). Where bodies collide, k is an impulse
        over a step, hence the bound by fall and depth.
        """
        base = self.base
        fast, total, every = 0.0, 0.0, 0.0
        for i in range(n):
            u = base.v[i]
            u[3] = 0.0
            fast = ti.max(fast, u.norm_sqr())
            total += self.pressure[i][1]
            every += u.norm_sqr()
        if ti.static(self.structure.no_slip):
            for f in ti.static(range(base.faces)):
                fast = ti.max(fast, base.slide[f].norm_sqr())
        deep = 0.0
        for d in ti.static(range(self.dim)):
            deep += ti.abs(g[d]) * (base.extent[1][d] - base.extent[0][d])
        if ti.static(self.has_rigid):
            fast = ti.max(fast, self.rigid.fastest[0])
        stiff = ti.min(2.0 * ti.max(total, 0.0) / ti.cast(n, ti.f32), fast + deep)
        fast = ti.sqrt(fast)
        speed = fast + ti.sqrt(stiff)
        way = base.number[base.CFL] * base.number[base.SPACING]
        pull = g.norm()
        # speed dt + pull dt^2 = way.
        return 2.0 * way / ti.max(speed + ti.sqrt(speed * speed + 4.0 * pull * way), 1e-12), fast, finite(every + total)

    @ti.func
    def step(self, n, dt, g, report: ti.template()):
        """One step, of no length densities alone. Returns how many solves did not converge."""
        base, unsolved = self.base, 0
        base.list_pairs(n, report)
        self.gather(n)
        for which in range(ti.select(dt > 0.0, 2, 0)):
            if which == 1:
                for i in range(n):
                    base.v[i] += dt * g
                if ti.static(self.has_rigid):
                    self.rigid.fall(dt, g)
                if ti.static(self.structure.xsph):
                    self.smooth(n)
                if ti.static(self.structure.viscous):
                    taken, left = self.thicken(n, dt, ti.cast(base.number[base.ITERATIONS], ti.i32))
                    report[base.THICKENED] += ti.cast(taken, ti.f64)
                    report[base.VISCOUS] = ti.max(report[base.VISCOUS], ti.cast(left, ti.f64))
                    unsolved += ti.cast(not left <= VISCOUS_ERROR, ti.i32)
            tolerance = ti.select(which == 1, base.number[base.DENSITY_ERROR], base.number[base.DIVERGENCE_ERROR])
            iterations, error = self.solve(n, which, dt, tolerance, ti.cast(base.number[base.ITERATIONS], ti.i32))
            report[base.SOLVED + which] += ti.cast(iterations, ti.f64)
            report[base.ERROR + which] = ti.max(report[base.ERROR + which], ti.cast(error, ti.f64))
            unsolved += ti.cast(not error <= tolerance, ti.i32)
        if ti.static(self.has_rigid):
            self.rigid.collide(dt)
        for i in range(n):
            base.x[i] += dt * base.v[i]
            base.enclose(i)
        if ti.static(self.has_rigid):
            self.rigid.step(dt)
        return unsolved
