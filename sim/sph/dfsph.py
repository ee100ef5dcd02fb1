"""Divergence-free SPH: two pressure solves a step, for the velocity and for the places (Bender & Koschier 2015, 2017; Hu & Adams 2007).

With volumes V = spacing^dim, densities relative to that at rest, G_ij = V grad W_ij and w_i the walls' part, a pressure k (p / rho^2) accelerates by
a_i = -sum_j (k_i + k_j) G_ij - b k_i w_i and changes the density at the rate sum_j (u_i - u_j) . G_ij + b u_i . w_i, each the transpose of the
other: solves are projections. Both are linear, by conjugate gradients with diagonal 1 / alpha = |G_i|^2 + sum_j |G_ij|^2, G_i = sum_j G_ij + b w_i:

    no divergence:     the rate of the velocities becomes 0; changes velocities,
    constant density:  rho + the change by dt u, and by shifting, becomes 1; changes places alone.

Decisions, each against what was here before (as Bender & Koschier: k >= 0, relaxed Jacobi iterations, density corrected by velocities):
- Either sign. Inside the water (``INSIDE``) the divergence is 0 from both sides, elsewhere a particle answers only to what approaches, in an
  equation like the others: cut off at k >= 0, sums of pressures that were solved for together throw particles. Water in tension holds together
  (rotating square patch, elliptical drop), and what the density pushes apart does not fly on.
- Places, not velocities, are corrected by densities (Hu & Adams 2007): by velocities a dam break gained 3 % of energy, and pools boiled. Gaps
  close where the pressure is positive; in tension, where pulling on pairs of particles leads to pairing, shifting keeps them even.
- Mirrored walls (b = 2): the fluid behind a wall has the particle's own pressure and the opposite normal velocity. With b = 1 a wall acts by the
  particle's pressure alone, which was twice what it should be. Densities are of layers that stay (``sim.sph.kernel``): b = 1.
- Along a wall half of the neighbours are missing, and of a gradient. Pairs beside one are stretched along it (``sim.sph.kernel.STRETCH``), the mean
  of both ends, so that transposes stay transposes and pairs keep momentum. Where bodies are (``sim.sph.rigid``), b = 2 too, without the stretch.
- Shifting (Lind et al. 2012; Sun et al. 2017) by min(2 dt max|u|, ``lattice_shift``) down the gradient of the concentration, inside. It is part of
  what the density solve sees.

Without a free surface (``full``: the water fills its box) nothing can expand: divergences and pressures are then free of their mean, both, so that
the solve is a projection still (of divergences alone, noise gained a fifth of its energy in a step), and shifting alone keeps the density even.

A solve starts from the pressures of the step before and ends when its mean error over all particles is below ``density_error``
(``divergence_error``), the one of velocities also below ``RELATIVE`` of what it began with: the mean over a deep pool would pass
before anything had reached its lower layers. It takes at least ``LEAST`` iterations and at most ``iterations``; one that did not end so is
counted, and its frame is repeated with half the step. An iteration is two sweeps over the pairs, whose gradients are stored: they, not distances,
are what it reads.

Viscosity is implicit, whatever its size: conjugate gradients for u + dt nu A sum_j f (u_ij . r_ij) r_ij / r^2 = u* (Weiler et al. 2018; f and A:
``sim.sph.kernel.viscous_weight``). Each pair's force is along its line, so angular momentum is kept.
"""

from sim.mpm.decomposition import finite
from sim.sph.kernel import SHARE, SPREAD, STRETCH
from sim.sph.rigid import RigidBodies
from sim.sph.wcsph import INSIDE
from sim.taichi_runtime import ti

#: Motions of rigid bodies, for those of the water.
VELOCITY, PULL, SEARCH = RigidBodies.VELOCITY, RigidBodies.PULL, RigidBodies.SEARCH
#: The two solves, of velocities and of places.
DIVERGENCE, DENSITY = range(2)

#: Iterations of a solve at least.
LEAST = 2
#: Particles whose kernels are emptier, as a share of what is ``INSIDE``, are spray, which is not held free of divergence: it would stick together
#: (as those of few neighbours in SPlisHSPlasH).
SPRAY = 0.5
#: Share of the mean divergence at which its solve ends, and what is rounding of it.
RELATIVE, ROUNDING = 0.2, 1e-6
#: Share of the pressures of the step before that a solve starts from. From all of them a pool of 64 layers keeps moving a little, kinetic energy
#: 3e-5 of rho g H V, and its pressures are 5 % low; from this 3e-6 and 0.2 %, for twice the iterations in 3D. Why is not proven: taking out
#: what alternates between neighbours did not help, nor did a tighter goal.
WARM = 0.9
#: Rate of the density times the step by which water that no pressure holds to a wall leaves it.
SUCTION = 1e-5
#: Excess of density that is rounding: pushed away in every step, it would drive a block in free flight apart.
EXCESS = 2e-6
#: Residual, relative to the right side, at which the viscous solve ends.
VISCOUS_ERROR = 1e-5


@ti.data_oriented
class DFSPH:
    """Fields of the pressures; ``base`` has particles, pairs and walls (``sim.sph.solver._Kernels``)."""

    def __init__(self, base, capacity: int, pairs: int):
        self.base, self.dim, self.structure = base, base.dim, base.structure
        self.rigid, self.has_rigid = base.rigid, base.has_rigid
        self.gradient = ti.Vector.field(4, ti.f32, pairs)  # G_ij of the pairs within reach, stretched, packed; lane 3: V W
        self.near = ti.field(ti.i32, pairs)
        self.begin = ti.field(ti.i32, capacity + 1)
        self.sums = ti.Vector.field(4, ti.f32, capacity)  # sum_j G_ij, stretched; lane 3: sum_j |G_ij|^2
        self.alpha = ti.Vector.field(2, ti.f32, capacity)  # of the two solves
        self.wall = ti.Vector.field(4, ti.f32, capacity)  # w_i; lane 3: density
        self.crowd = ti.Vector.field(4, ti.f32, capacity)  # gradient of the concentration; lane 3: minus the divergence of position
        self.stretch = ti.Vector.field(4, ti.f32, capacity)  # along walls
        if self.structure.obstacles:
            self.slant = ti.Vector.field(4, ti.f32, capacity)  # normal of the obstacles; lane 3: stretch along them, less 1
        self.push = ti.Vector.field(4, ti.f32, capacity)  # a_i; lane 3: rate of the density
        self.move = ti.Vector.field(4, ti.f32, capacity)  # of a step, before the density is corrected
        self.active = ti.field(ti.f32, capacity)  # whether a particle has an equation
        self.source = ti.field(ti.f32, capacity)
        self.search = ti.Vector.field(1, ti.f32, capacity)
        self.pressure = ti.Vector.field(2, ti.f32, capacity)  # k of the two solves; of places, times dt^2
        self.state = [self.pressure]
        if self.structure.viscous:
            self.drag = ti.field(ti.f32, pairs)  # A f / r^2
            self.residual, self.turn, self.image = (ti.Vector.field(4, ti.f32, capacity) for _ in range(3))

    @ti.func
    def beside(self, i):
        """What walls add to ``wall`` and ``crowd``, ``stretch``."""
        base = self.base
        x = base.x[i]
        gradient, spread, along = base.walls(x), 0.0, ti.Vector([1.0, 1.0, 1.0, 1.0])
        for f in ti.static(range(base.faces)):
            s, n = base.face(x, f)
            if ti.static(f == 2 * self.dim):
                self.slant[i] = ti.Vector.zero(ti.f32, 4)
            if s < 1.0:
                T = base.look(s)
                spread += (1.0 - gradient[3]) / (1.0 - T[SHARE]) * T[SPREAD]
                if ti.static(f < 2 * self.dim):
                    for d in ti.static(range(self.dim)):
                        if ti.static(d != f // 2):
                            along[d] *= 1.0 + T[STRETCH]
                else:
                    n[3] = T[STRETCH]
                    self.slant[i] = n
        self.wall[i] = gradient
        gradient[3] = spread
        self.crowd[i] = gradient
        self.stretch[i] = along

    @ti.func
    def gather(self, n):
        """Gradients of the pairs within reach, densities, alpha."""
        base = self.base
        V, K = base.number[base.VOLUME], base.number[base.KERNEL]
        for i in range(n):
            self.sums[i] = ti.Vector.zero(ti.f32, 4)
            self.beside(i)
            self.wall[i][3] += V * K
        if ti.static(self.has_rigid):
            self.rigid.gather(n)
            self.rigid.surround(self.wall, self.crowd)
        m = 0
        for i in range(n):
            self.begin[i] = m
            xi, along = base.x[i], self.stretch[i]
            S, C, rho = ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4), 0.0
            for k in range(base.neighbours.first[i], base.neighbours.first[i + 1]):
                j = base.neighbours.other[k]
                r = base.neighbours.apart(xi - base.x[j])
                r[3] = 0.0
                q2 = r.norm_sqr()
                q = ti.sqrt(ti.min(q2, 1.0))
                t = 1.0 - q
                t3 = t * t * t
                scale = 20.0 * K * V * t3
                w = V * K * t3 * t * (1.0 + 4.0 * q)
                G = -scale * r
                H = 0.5 * (along + self.stretch[j]) * G
                if ti.static(self.structure.obstacles):
                    for p in ti.static((i, j)):
                        a = self.slant[p]
                        across = a[0] * H[0] + a[1] * H[1] + a[2] * H[2]
                        for d in ti.static(range(self.dim)):
                            H[d] += 0.5 * a[3] * (H[d] - across * a[d])
                if ti.static(self.structure.viscous):
                    self.drag[m] = base.number[base.THICKNESS] * t * ti.sqrt(t) / (q2 + 1e-12)
                self.near[m] = j
                H[3] = 0.0
                s = H.norm_sqr()
                H[3] = w
                self.gradient[m] = H
                G[3] = scale * q2
                C += G
                G = -G
                G[3] = scale * q2
                self.crowd[j] += G
                H[3] = s
                S += H
                H = -H
                H[3] = s
                self.sums[j] += H
                rho += w
                self.wall[j][3] += w
                m += ti.cast(q2 < 1.0, ti.i32)
            self.sums[i] += S
            self.crowd[i] += C
            self.wall[i][3] += rho
        self.begin[n] = m
        for i in range(n):
            for which in ti.static((DIVERGENCE, DENSITY)):
                G = self.sums[i] + ti.static(2.0 - which) * self.wall[i]
                self.alpha[i][which] = 1.0 / ti.max(G[0] * G[0] + G[1] * G[1] + G[2] * G[2] + self.sums[i][3], 1e-6)

    @ti.func
    def rate(self, n, which, field: ti.template(), motion: ti.template(), factor):
        """push[3]: rate of the density by a ``field`` of the water and ``factor`` times a ``motion`` of the bodies, as the solve ``which`` has it."""
        b = 2.0 - ti.cast(which, ti.f32)
        for i in range(n):
            u, w = field[i], self.wall[i]
            self.push[i][3] = b * (u[0] * w[0] + u[1] * w[1] + u[2] * w[2])
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
            self.rigid.flow(self.push, motion, 0.5 * b * factor)

    @ti.func
    def accelerate(self, n, which, pressure: ti.template(), lane):
        """push[:3]: accelerations by a lane of ``pressure``; the bodies' too."""
        b = 2.0 - ti.cast(which, ti.f32)
        for i in range(n):
            self.push[i] = -b * pressure[i][lane] * self.wall[i]
        for i in range(n):
            ki, total = pressure[i][lane], ti.Vector.zero(ti.f32, 4)
            for m in range(self.begin[i], self.begin[i + 1]):
                j = self.near[m]
                f = (ki + pressure[j][lane]) * self.gradient[m]
                total += f
                self.push[j] += f
            self.push[i] -= total
        if ti.static(self.has_rigid):
            self.rigid.react(pressure, lane, 0.5 * b)

    @ti.func
    def level(self, n, field: ti.template(), lane: ti.template()):
        """Take from a lane of a field its mean, without a free surface."""
        if ti.static(self.structure.full):
            total = ti.cast(0.0, ti.f64)
            for i in range(n):
                total += ti.cast(field[i][lane], ti.f64)
            mean = ti.cast(total / n, ti.f32)
            for i in range(n):
                field[i][lane] -= mean

    @ti.func
    def conjugate(self, n, which, tolerance, most):
        """Conjugate gradients, preconditioned by alpha, from the pressures as they are; iterations and mean error. ``source`` is the residual. The
        first search is along the pressures themselves, by a step of 1."""
        iterations, error, power, going = -1, 1e30, ti.cast(0.0, ti.f64), True
        self.level(n, self.pressure, 0)
        for i in range(n):
            self.search[i][0] = self.pressure[i][which]
        while going:
            self.accelerate(n, which, self.search, 0)
            self.rate(n, which, self.push, PULL, 1.0)
            step, turn = 1.0, 0.0
            if iterations >= 0:
                work = ti.cast(0.0, ti.f64)
                for i in range(n):
                    work -= ti.cast(self.search[i][0] * self.push[i][3], ti.f64)
                # alpha is within a factor of ten of the inverse: less work than that is rounding.
                step = ti.cast(power / ti.max(work, 1e-3 * power), ti.f32)
            fresh, size = ti.cast(0.0, ti.f64), 0.0
            for i in range(n):
                self.push[i][3] = self.source[i] + step * self.push[i][3]
            self.level(n, self.push, 3)
            for i in range(n):
                if iterations >= 0:
                    self.pressure[i][which] += step * self.search[i][0]
                r = self.active[i] * self.push[i][3]
                self.source[i] = r
                fresh += ti.cast(r * r * self.alpha[i][which], ti.f64)
                size += ti.abs(r)
            if iterations >= 0:
                turn = ti.cast(fresh / power, ti.f32)
            for i in range(n):
                self.search[i][0] = self.source[i] * self.alpha[i][which] + turn * self.search[i][0]
            self.level(n, self.search, 0)
            power, error = fresh, size / ti.cast(n, ti.f32)
            iterations += 1
            going = iterations < most and (iterations < LEAST or error > tolerance) and power > 0.0
        return iterations, error

    @ti.func
    def solve(self, n, which, dt, tolerance, most):
        """DIVERGENCE changes the velocities, DENSITY leaves in push[:3] by what ``move`` is to be corrected. Returns iterations and mean error, of
        relative density. Pressures are times dt^2 here. ``which`` is data, so that the code is there once."""
        base = self.base
        scale = 1.0
        if which == DIVERGENCE:
            scale = dt * dt
            for i in range(n):
                self.move[i] = dt * base.v[i]
        self.rate(n, which, self.move, VELOCITY, dt)
        size = 0.0
        self.level(n, self.push, 3)
        for i in range(n):
            s, spread, on = self.push[i][3], self.crowd[i][3], 1.0
            if which == DENSITY:
                s += self.wall[i][3] - (1.0 + EXCESS)
            if ti.static(not self.structure.full):
                inside, near = spread > ti.static(INSIDE * self.dim), spread > ti.static(SPRAY * INSIDE * self.dim)
                if which == DIVERGENCE:
                    w = self.wall[i]
                    held = w[0] * w[0] + w[1] * w[1] + w[2] * w[2] == 0.0 or self.pressure[i][DIVERGENCE] > 0.0 or s > -SUCTION
                    on = ti.cast((inside and held) or (near and s > 0.0), ti.f32)
                else:
                    on = ti.cast(s > 0.0 or (inside and self.pressure[i][DIVERGENCE] > 0.0), ti.f32)
            self.active[i] = on
            self.source[i] = s
            self.pressure[i][which] *= WARM * scale * on
            size += on * ti.abs(s)
        goal = tolerance
        if which == DIVERGENCE:
            goal = ti.min(goal, ti.max(RELATIVE * size / ti.cast(n, ti.f32), ROUNDING))
        iterations, error = self.conjugate(n, which, goal, most)
        self.accelerate(n, which, self.pressure, which)
        for i in range(n):
            self.pressure[i][which] /= scale
            if which == DIVERGENCE:
                for d in ti.static(range(self.dim)):
                    base.v[i][d] += self.push[i][d] / dt
        if ti.static(self.has_rigid):  # noqa: SIM102 (what bodies need is compiled only where they are)
            if which == DIVERGENCE:
                self.rigid.accelerate(1.0 / dt)
        return iterations, error

    @ti.func
    def advance(self, n, dt):
        """``move``: by velocities, after contacts, and shifting."""
        base = self.base
        if ti.static(self.has_rigid):
            self.rigid.collide(dt)
        shift = ti.min(2.0 * dt * base.stir(n), base.number[base.SHIFT])
        for i in range(n):
            move = dt * base.v[i] - ti.select(self.crowd[i][3] > ti.static(INSIDE * self.dim), shift, 0.0) * self.crowd[i]
            move[3] = 0.0
            self.move[i] = move

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
                r = base.neighbours.apart(base.x[i] - base.x[j])
                r[3] = 0.0
                p = (ui - u[j]) * r
                f = (dtnu * self.drag[m] * (p[0] + p[1] + p[2])) * r
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
            self.residual[i], self.turn[i] = r, r
            size += ti.cast(b.norm_sqr(), ti.f64)
            error += ti.cast(r.norm_sqr(), ti.f64)
        if ti.static(self.has_rigid):
            more, left = self.rigid.resist()
            size += more
            error += left
        goal, iterations = ti.static(VISCOUS_ERROR**2) * size, 0
        while iterations < most and error > goal:
            self.viscous_image(n, dtnu, self.turn, SEARCH)
            power = ti.cast(0.0, ti.f64)
            for i in range(n):
                power += ti.cast(self.turn[i].dot(self.image[i]), ti.f64)
            if ti.static(self.has_rigid):
                power += self.rigid.work()
            step, left = ti.cast(error / power, ti.f32), ti.cast(0.0, ti.f64)
            for i in range(n):
                base.v[i] += step * self.turn[i]
                r = self.residual[i] - step * self.image[i]
                self.residual[i] = r
                left += ti.cast(r.norm_sqr(), ti.f64)
            if ti.static(self.has_rigid):
                left += self.rigid.follow(step)
            turn = ti.cast(left / error, ti.f32)
            for i in range(n):
                self.turn[i] = self.residual[i] + turn * self.turn[i]
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

        To their speed and what gravity adds comes c = sqrt(mean k), k > 0, sqrt(g H / 2) for water at rest: the density of a particle does not change
        with its own place at first order, so pressures hold it only by their curvature, k W'' ~ k / spacing^2, a spring whose frequency is c /
        spacing. Without this limit a pool of 20 layers boiled over at steps of 0.7 spacings / sqrt(g H). Where bodies collide, k is an impulse
        over a step, hence the bound by fall and depth.
        """
        base = self.base
        fast, total, every = 0.0, 0.0, 0.0
        for i in range(n):
            u = base.v[i]
            u[3] = 0.0
            fast = ti.max(fast, u.norm_sqr())
            total += ti.max(self.pressure[i][DIVERGENCE], 0.0)
            every += u.norm_sqr()
        if ti.static(self.structure.no_slip):
            for f in ti.static(range(base.faces)):
                fast = ti.max(fast, base.slide[f].norm_sqr())
        deep = 0.0
        for d in ti.static(range(self.dim)):
            deep += ti.abs(g[d]) * (base.extent[1][d] - base.extent[0][d])
        if ti.static(self.has_rigid):
            fast = ti.max(fast, self.rigid.fastest[0])
        stiff = ti.min(total / ti.cast(n, ti.f32), fast + deep)
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
        if dt > 0.0:
            most = ti.cast(base.number[base.ITERATIONS], ti.i32)
            for i in range(n):
                base.v[i] += dt * g
            if ti.static(self.has_rigid):
                self.rigid.fall(dt, g)
            if ti.static(self.structure.xsph):
                self.smooth(n)
            if ti.static(self.structure.viscous):
                taken, left = self.thicken(n, dt, most)
                report[base.THICKENED] += ti.cast(taken, ti.f64)
                report[base.VISCOUS] = ti.max(report[base.VISCOUS], ti.cast(left, ti.f64))
                unsolved += ti.cast(not left <= VISCOUS_ERROR, ti.i32)
            for which in range(ti.static(2 - int(self.structure.full))):
                tolerance = base.number[base.DIVERGENCE_ERROR]
                if which == DENSITY:
                    tolerance = base.number[base.DENSITY_ERROR]
                    self.advance(n, dt)
                iterations, error = self.solve(n, which, dt, tolerance, most)
                report[base.SOLVED + which] += ti.cast(iterations, ti.f64)
                report[base.ERROR + which] = ti.max(report[base.ERROR + which], ti.cast(error, ti.f64))
                unsolved += ti.cast(not error <= tolerance, ti.i32)
            if ti.static(self.structure.full):
                self.advance(n, dt)
            for i in range(n):
                move = self.move[i]
                if ti.static(not self.structure.full):
                    move += self.push[i]
                move[3] = 0.0
                base.x[i] += move
                base.enclose(i)
            if ti.static(self.has_rigid):
                # What corrects densities moves bodies too, and not on.
                self.rigid.accelerate(1.0 / dt)
                self.rigid.step(dt)
                self.rigid.accelerate(-1.0 / dt)
                self.rigid.put_back()
        return unsolved
