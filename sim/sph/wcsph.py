"""Weakly compressible SPH (Monaghan 1994) with density diffusion (Fourtakas et al. 2019) and particle shifting (Lind et al. 2012; Sun et al. 2017).

    d rho_i / dt = sum_j V (u_i - u_j) . grad W_ij + 2 delta h c sum_j V (rho_j - rho_i - rho_H) |W'| / r
    d u_i / dt   = -sum_j V (P_i + P_j) grad W_ij + g - sum_j (nu A f + V alpha h c |W'| / r) (u_ij . r_ij) r_ij / r^2
    P = p / rho^2,  p = (c^2 / gamma) (rho^gamma - 1),  rho_H = g . (x_j - x_i) / c^2,  h = 1/2

with densities over that at rest, f and A of ``sim.sph.kernel.viscous_weight``. The artificial viscosity alpha acts on what approaches. Walls
(``sim.sph.kernel``) continue the fluid: the pressure across them by P_i + g . (x' - x_i) (Adami et al. 2012), no suction, and along them by the
fluid's own gradient, which the particle's neighbours show on its own side only (TANGENT). Left out, water at a vertical wall hangs on
less than its pressure and sinks.

At a free surface and in spray there is no tension: the density of particles that are not inside does not fall below that at rest. Two
lone particles whose pressure was negative pulled each other to pieces.

Shifting moves particles down the gradient of their concentration C = sum_j V W_ij, by dx = -2 max|u| dt grad C (Sun et al. 2017, eq. 10; u: beyond
the mean, so that free flight is one), where they are away from the surface: what lacks neighbours on one side alone would be moved there. The
continuity equation counts what the flow does to the sum over the kernel, a lattice that it stirs up included; shifting evens that out again. It
changes the density with it, by 2 dx . grad C, dx . grad C for the particle and as much for its neighbours together (what the terms in dx of Sun
et al. 2019 come to where the density is even), with the mean grad C of before and after. Without, each round leaves a little: a closed box ended
with 6 % too much, under the pressure of it. A jittered lattice that starts at density one ends, evened out, that much below.

Time: velocity Verlet with predicted velocity and density (Springel 2005, section 4.2), one sweep over the pairs a step. The density is predicted with
the trend of its rate: without, sound of frequency w grew by (w dt)^4 / 4 a step, which density diffusion hid where there was enough of it; with, it
is damped by (w dt)^4 / 8, up to w dt = 0.75.
"""

from sim.mpm.decomposition import finite
from sim.sph.kernel import NORMAL, SHARE, SLOPE, SPREAD, TANGENT
from sim.taichi_runtime import ti

#: Particles count as inside the fluid where sum_j V r . grad W exceeds this share of the dimension (Lee et al. 2008: 1.5 of 2); as away from its
#: surface above the second. On a lattice the outermost layer has 0.6 to 0.75, the next 0.86 to 1, by the support.
INSIDE, AWAY = 0.75, 0.9
#: Density below which shifting takes none: the 1 % by which weakly compressible water differs from rest. What starts crowded, bodies on top of
#: each other, has no density to pay for being spread out.
LEAST = 0.99
#: Largest c dt / h, whatever Courant number is asked for, and largest nu dt / h^2 (h = 1/2). On a lattice the fastest sound has w = 1.2 c / h;
#: roughness of the lattice's own wavelength decays at 42 to 50 nu per support radius squared, beside a sticky wall at 35 to 40 more (its ``DRAG`` at
#: ``CLOSEST``), which a predicted velocity bears up to a rate of 1 / dt (``sim.stability``: sound_dt, viscosity_dt).
LARGEST_COURANT, LARGEST_VISCOUS = 0.5, 1 / 25


@ti.data_oriented
class WCSPH:
    """``base``: particles, pairs and walls (``sim.sph.solver._Kernels``). v[3] is the density over that at rest, x[3] is P."""

    def __init__(self, base, capacity: int, pairs: int):
        self.base, self.dim, self.structure = base, base.dim, base.structure
        self.rigid, self.has_rigid = base.rigid, base.has_rigid
        self.rate = ti.Vector.field(4, ti.f32, capacity)  # acceleration; lane 3: rate of the density
        self.before = ti.Vector.field(4, ti.f32, capacity)
        # Rate of the density a step before (the last lane); behind what shifting moved by.
        self.earlier = ti.Vector.field(4 if self.structure.shifting else 1, ti.f32, capacity)
        self.state = [self.rate, self.before, self.earlier]
        if self.structure.shifting:
            self.crowd = ti.Vector.field(4, ti.f32, capacity)  # gradient of the concentration; lane 3: minus the divergence of position
            self.state.append(self.crowd)
        if self.structure.no_slip:
            self.rub = ti.Vector.field(4, ti.f32, capacity)  # minus the viscous acceleration, apart from that by pressures

    @ti.func
    def sweep(self, n, g):
        """``rate`` and ``crowd`` of the current positions, velocities and densities."""
        base = self.base
        V, K, c = base.number[base.VOLUME], base.number[base.KERNEL], base.number[base.SOUND]
        gamma, delta = base.number[base.GAMMA], 2.0 * base.number[base.DELTA] * 0.5 * c
        alpha, nu = 0.5 * base.number[base.ALPHA] * c, base.number[base.THICKNESS] * base.number[base.VISCOSITY]
        for i in range(n):
            rho = base.v[i][3]
            base.x[i][3] = c * c / gamma * (ti.pow(rho, gamma) - 1.0) / (rho * rho)
            self.rate[i] = ti.Vector.zero(ti.f32, 4)
            if ti.static(self.structure.shifting):
                self.crowd[i] = ti.Vector.zero(ti.f32, 4)
            if ti.static(self.structure.no_slip):
                self.rub[i] = ti.Vector.zero(ti.f32, 4)
        scale = 20.0 * K * V
        slant = g / (c * c)
        for i in range(n):
            xi, vi = base.x[i], base.v[i]
            A, B, R = ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4), ti.Vector.zero(ti.f32, 4)
            for k in range(base.neighbours.first[i], base.neighbours.first[i + 1]):
                j = base.neighbours.other[k]
                xj = base.x[j]
                r, u = xi - xj, vi - base.v[j]
                P, jump = xi[3] + xj[3], u[3]
                r = base.neighbours.apart(r)
                r[3] = 0.0
                q2 = r.norm_sqr()
                t = 1.0 - ti.sqrt(ti.min(q2, 1.0))
                q = scale * t * t * t  # V |W'| / r
                ur = u * r
                parting = ur[0] + ur[1] + ur[2]
                fall = slant * r
                D = q * delta * (fall[0] + fall[1] + fall[2] - jump)
                F = (q * (P - alpha * ti.min(parting, 0.0) / (q2 + 1e-4))) * r
                if ti.static(self.structure.viscous):
                    f = (nu * t * ti.sqrt(t) * parting / (q2 + 1e-4)) * r
                    if ti.static(self.structure.no_slip):
                        R += f
                        self.rub[j] -= f
                    else:
                        F -= f
                # The continuity equation's part is the same for both, the diffusion's the opposite.
                F[3] = D - q * parting
                A += F
                F[3] = D + q * parting
                self.rate[j] -= F
                if ti.static(self.structure.shifting):
                    C = -q * r
                    C[3] = q * q2
                    B += C
                    C = -C
                    C[3] = q * q2
                    self.crowd[j] += C
            self.rate[i] += A
            if ti.static(self.structure.shifting):
                self.crowd[i] += B
            if ti.static(self.structure.no_slip):
                self.rub[i] += R
        if ti.static(self.has_rigid):
            self.rigid.gather(n)
            self.rigid.press(self, g)
        for i in range(n):
            self.by_walls(i, g)

    @ti.func
    def by_walls(self, i, g):
        """The walls' part, and gravity's."""
        base = self.base
        x, u = base.x[i], base.v[i]
        P = ti.max(x[3], 0.0)
        A = self.rate[i]
        fluid, beside = 1.0, 1.0
        solid, m = 0.0, ti.Vector.zero(ti.f32, 4)  # of the obstacles
        if ti.static(self.structure.obstacles):
            s, m = base.face(x, ti.static(base.faces - 1))
            if s < 1.0:
                solid = base.look(s)[SHARE]
        for f in ti.static(range(base.faces)):
            s, n = base.face(x, f)
            if s < 1.0:
                share = base.look(s)[SHARE]
                fluid *= 1.0 - share
                if ti.static(f < 2 * self.dim):
                    beside *= 1.0 - share * n.dot(m) ** 2
        if fluid < 1.0:
            for f in ti.static(range(base.faces)):
                s, n = base.face(x, f)
                if s < 1.0:
                    T = base.look(s)
                    across = A[0] * n[0] + A[1] * n[1] + A[2] * n[2]
                    along = A - across * n
                    along[3] = 0.0
                    A += (T[TANGENT] / (1.0 - T[TANGENT])) * along
            for f in ti.static(range(base.faces)):
                s, n = base.face(x, f)
                if s < 1.0:
                    T = base.look(s)
                    weight = fluid / (1.0 - T[SHARE])
                    un, gn = u[0] * n[0] + u[1] * n[1] + u[2] * n[2], g[0] * n[0] + g[1] * n[1] + g[2] * n[2]
                    # Of the whole half-space, though other walls cut it: what is along those has been scaled up to go on behind them. Only of
                    # walls one behind the other the half-spaces overlap. No pressure there is below zero.
                    whole = beside if ti.static(f == 2 * self.dim) else 1.0 - solid * n.dot(m) ** 2
                    A += whole * ti.max(-2.0 * P * T[SLOPE] - gn * T[NORMAL], -P * T[SLOPE]) * n
                    A[3] += weight * T[SLOPE] * un
                    if ti.static(self.structure.shifting):
                        C = T[SLOPE] * n
                        # A wall that presses on nothing does not make a particle an inner one: it would be shifted into the gap.
                        C[3] = ti.select(u[3] > 1.0, T[SPREAD], 0.0)
                        self.crowd[i] += weight * C
        if ti.static(self.structure.no_slip):
            A -= self.rub[i] + base.number[base.VISCOSITY] * (base.drag(x, u, False) - base.drag(x, u, True))
        self.rate[i] = A + g

    @ti.func
    def limit(self, n, g):
        """Largest stable step: c of the densest particle, the viscosity, the largest acceleration (Monaghan 1989); the largest speed; whether
        all are finite, which largest ones do not tell."""
        base = self.base
        fast, strong, dense, total = 0.0, 0.0, 1.0, 0.0
        for i in range(n):
            u, a = base.v[i], self.rate[i]
            dense = ti.max(dense, u[3])
            u[3], a[3] = 0.0, 0.0
            fast, strong = ti.max(fast, u.norm_sqr()), ti.max(strong, a.norm_sqr())
            total += u.norm_sqr() + a.norm_sqr()
        if ti.static(self.has_rigid):
            fast = ti.max(fast, self.rigid.fastest[0])
        fast, strong = ti.sqrt(fast), ti.sqrt(strong)
        c = base.number[base.SOUND] * ti.pow(dense, 0.5 * (base.number[base.GAMMA] - 1.0))
        dt = ti.min(base.number[base.CFL] * base.number[base.SPACING] / (c + fast), 0.5 * LARGEST_COURANT / c)
        dt = ti.min(dt, 0.25 * ti.sqrt(0.5 / ti.max(strong, 1e-12)))
        if ti.static(self.has_rigid):
            dt = ti.min(dt, base.number[base.LIGHT] / c)
        return ti.min(dt, 0.25 * LARGEST_VISCOUS / ti.max(base.number[base.VISCOSITY], 1e-12)), fast, finite(total)

    @ti.func
    def lean(self, n, change):
        """``rate`` when gravity has changed."""
        for i in range(n):
            self.rate[i] += change

    @ti.func
    def follow(self, i, push, C):
        """Half of what shifting a particle does to the density."""
        rho = self.base.v[i][3]
        least, shifted = ti.min(rho, LEAST), rho + push[0] * C[0] + push[1] * C[1] + push[2] * C[2]
        # Not a maximum, which loses NaN.
        self.base.v[i][3] = ti.select(shifted < least, least, shifted)

    @ti.func
    def step(self, n, dt, g, report: ti.template()):
        """One step; ``rate`` is that of its start, which a step of no length finds. Returns how many solves failed: there are none."""
        base = self.base
        if ti.static(self.has_rigid):
            self.rigid.drift(dt, g)
        shift = 0.0
        if ti.static(self.structure.shifting):
            shift = 2.0 * dt * base.stir(n)
        for i in range(n):
            a = self.rate[i]
            # What the rate of the density will be, if it changes on as it did.
            trend = 2.0 * a[3] - self.earlier[i][self.earlier.n - 1]
            self.earlier[i][self.earlier.n - 1] = a[3]
            self.before[i] = ti.Vector([a[0], a[1], a[2], trend])
            if ti.static(self.has_rigid):
                # Of a start nothing is known: no pressure.
                self.before[i] = ti.select(dt > 0.0, self.before[i], g)
            a[3] = 0.5 * (a[3] + trend)
            move = dt * base.v[i] + (0.5 * dt * dt) * a
            if ti.static(self.structure.shifting):
                C = self.crowd[i]
                push = -ti.select(C[3] > ti.static(AWAY * self.dim), shift, 0.0) * C
                move += push
                self.follow(i, push, C)
                for d in ti.static(range(3)):
                    self.earlier[i][d] = push[d]
            move[3] = 0.0
            base.x[i] += move
            base.v[i] += dt * a
            base.enclose(i)
        base.list_pairs(n, report)
        self.sweep(n, g)
        for i in range(n):
            base.v[i] += (0.5 * dt) * (self.rate[i] - self.before[i])
            inside = False
            if ti.static(self.structure.shifting):
                C, push = self.crowd[i], self.earlier[i]
                inside = C[3] > ti.static(INSIDE * self.dim)
                self.follow(i, push, C)
            base.v[i][3] = ti.select(inside, base.v[i][3], ti.max(base.v[i][3], 1.0))
            if dt == 0.0:
                self.earlier[i][self.earlier.n - 1] = self.rate[i][3]
        if ti.static(self.has_rigid):
            self.rigid.correct(dt)
        return 0
