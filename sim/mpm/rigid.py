"""Rigid bodies among the particles of the grid (``sim.rigid``): two-way coupling.

A body gives its particles' mass and momentum to the grid (v = V + w x r, C = [w]x, no stress). Nodes that it fills to ``SOLID`` or
more (``share``) are the body's: whatever else gave them mass moves with it. Before walls and obstacles act on the grid, each body takes
the rigid motion nearest to its nodes' velocities,

    minimise sum_i mu_i |A + w x (x_i - c) - v_i|^2,  mu_i = sum_p w_ip m (times the node's mass over the rigid mass there, if it is filled),

and filled nodes get that motion. Linear and angular momentum are what they were, exactly (the normal equations), and energy can only
fall (a projection). Were filled nodes left to themselves, nothing would hold the water out: each substep a node takes up the
pressure's push, the body averages it away, and water flows in at about g dt H / dx, ten times too deep a draft. The moment of inertia
of a lone body is I = sum_p m (|r|^2 1 - r r^T) and that of the quadratic B-splines, dx^2 / 4 along each axis.

Decision: walls, obstacles and other bodies act on the *body*, not on its share of the grid. On the grid only the nodes behind a wall
would be held, a tenth of a body's mass; each substep it would regain the weight that they took off, and creep down any slope
at g dt times ten. Between bodies the grid, which they share within two cells of each other, already lets none slip.

Positions and r are in cells, velocities in m/s, spin in 1/s, moments of inertia in kg cells^2.
"""

from sim.rigid import NO_SLIP, Bodies, lift
from sim.taichi_runtime import ti

#: Nodes filled by bodies to this share of a cell are theirs: 1/2 is a body's face.
SOLID = 0.5 - 1e-3


@ti.data_oriented
class RigidBodies(Bodies):
    """``kernels``: the solver's fields and functions (particles, grid, walls, obstacles)."""

    def __init__(self, kernels, capacity: int, planes: int):
        super().__init__(kernels, capacity, planes, kernels.capacity, kernels.capacity, kernels.structure.obstacles != "none", (False,) * kernels.dim)
        self.share = ti.Vector.field(2, ti.f32, kernels.nodes)  # of a node: rigid mass, filled share of a cell

    @staticmethod
    def sizes(dim: int, bodies: int, planes: int, capacity: int, nodes: int) -> dict[str, tuple[int, int]]:
        """As ``MPMSimulator.plan`` lists them."""
        return Bodies.sizes(dim, bodies, planes, capacity, capacity) | {"rigid share": (8, nodes)}

    @ti.func
    def unit(self):
        return self.kernels.dx[None]

    @ti.func
    def roughness(self):
        return self.kernels.coefficient[None] if ti.static(self.kernels.friction != "sticky") else NO_SLIP

    @ti.func
    def obstacle(self, x):
        distance, normal = self.kernels.clearance(x)
        friction = self.kernels.solids[ti.cast(x + 0.5, ti.i32)][self.dim + 1]
        return distance, lift(normal), ti.select(friction >= 0.0, friction, NO_SLIP)

    @ti.func
    def note(self, b, p):
        """The velocity gradient, [w]x."""
        for d in ti.static(range(self.dim)):
            column = self.spin[b].cross(ti.Vector([float(d == e) for e in ti.static(range(3))]))
            for e in ti.static(range(self.dim)):
                self.kernels.C[d][p][e] = column[e]

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
        """Filled nodes and the bodies themselves to where they go; returns as ``travel`` does."""
        for clear in ti.static((True, False)):
            for b in range(self.count[None]):
                self.carry(b, dt, clear)
        return self.travel(dt)

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
