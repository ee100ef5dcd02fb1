"""Pairs of particles within reach: counting sort into cells, a list of pairs with a skin (Verlet 1967), each pair once.

Lengths are in support radii. Cells are 1 + ``SKIN`` wide. Particles are kept in the order of their cells, the last axis running fastest, so
that what a particle's cell and its neighbours along that axis hold is one run of indices. A particle is paired with those after it in its
own run and with all in the runs of half of the cells around (2 runs in 2D, 5 in 3D); both ends of a pair get their part at once (``+=``: plain
additions on one thread). The list serves until some particle has moved by half the skin.

Decisions, measured: half the pairs with a scatter beat all pairs by a third; appending without a branch, ``other[k] = j; k += near``, beats a
branch that is taken every second time; sorting the state itself, not an index, keeps a pair's two ends in the cache.
"""

from sim.taichi_runtime import ti

#: Added to the support radius where pairs are listed.
SKIN = 0.1
#: Room in the list of pairs, as a multiple of those of a lattice at rest.
ROOM = 2.5
#: Cells along a periodic axis: with fewer a pair would be met twice.
FEWEST = 3
#: Offsets of the cells after a particle's own, half of those around it; for periodic boxes, whose runs wrap around.
FORWARD: dict[int, list[tuple[int, ...]]] = {
    2: [(0, 1), (1, -1), (1, 0), (1, 1)],
    3: [(0, 0, 1), (0, 1, -1), (0, 1, 0), (0, 1, 1), *((1, y, z) for y in (-1, 0, 1) for z in (-1, 0, 1))],
}


@ti.data_oriented
class Neighbours:
    """``capacity`` particles, ``cells`` (padded by one on each side), ``pairs`` at most. ``periodic`` [dim] of bool."""

    def __init__(self, dim: int, capacity: int, cells: int, pairs: int, periodic: tuple[bool, ...]):
        self.dim, self.capacity, self.periodic, self.wraps = dim, capacity, periodic, any(periodic)
        self.size = ti.Vector.field(dim, ti.i32, ())  # cells along each axis, with padding
        self.edge = ti.Vector.field(dim, ti.f32, ())  # 1 / width of a cell
        self.length = ti.Vector.field(4, ti.f32, ())  # of the box
        self.start, self.cursor = ti.field(ti.i32, cells + 2), ti.field(ti.i32, cells + 2)
        self.cell, self.to = ti.field(ti.i32, capacity), ti.field(ti.i32, capacity)
        self.first, self.other = ti.field(ti.i32, capacity + 1), ti.field(ti.i32, pairs)
        self.listed_at = ti.Vector.field(4, ti.f32, capacity)
        self.count = ti.field(ti.i32, ())  # pairs listed; ``other`` is full if its length

    @ti.func
    def apart(self, r):
        """Nearest image of a difference of positions."""
        for d in ti.static(range(self.dim)):
            if ti.static(self.periodic[d]):
                r[d] -= self.length[None][d] * ti.round(r[d] / self.length[None][d])
        return r

    @ti.func
    def place(self, x):
        """Index of the cell of a position."""
        c = 0
        for d in ti.static(range(self.dim)):
            k = ti.cast(x[d] * self.edge[None][d], ti.i32) + 1
            c = c * self.size[None][d] + ti.min(ti.max(k, 1), self.size[None][d] - 2)
        return c

    @ti.func
    def sort(self, x: ti.template(), n):
        """``to[i]``: where particle i goes; ``start``: first particle of each cell. Stable."""
        total = 1
        for d in ti.static(range(self.dim)):
            total *= self.size[None][d]
        for c in range(total + 2):
            self.start[c] = 0
        for i in range(n):
            c = self.place(x[i])
            self.cell[i] = c
            self.start[c + 1] += 1
        for c in range(total + 1):
            self.start[c + 1] += self.start[c]
        for c in range(total + 1):
            self.cursor[c] = self.start[c]
        for i in range(n):
            k = self.cursor[self.cell[i]]
            self.to[i] = k
            self.cursor[self.cell[i]] = k + 1

    @ti.func
    def run(self, x: ti.template(), i, begin, end, k):
        """Append those of a run of particles that are near particle i; returns the length of the list."""
        xi = x[i]
        reach = ti.static((1 + SKIN) ** 2)
        if k + end - begin > self.other.shape[0]:
            # Full: nothing more is written, and ``count`` says so.
            k = self.other.shape[0]
        else:
            for j in range(begin, end):
                r = xi - x[j]
                r[3] = 0.0
                if ti.static(self.wraps):
                    r = self.apart(r)
                self.other[k] = j
                k += ti.cast(r.norm_sqr() < reach, ti.i32)
        return k

    @ti.func
    def pair(self, x: ti.template(), n):
        """The list, of particles that ``sort`` has put in order."""
        k = 0
        for i in range(n):
            self.first[i] = k
            c = self.place(x[i])
            if ti.static(self.wraps):
                at, rest = ti.Vector.zero(ti.i32, self.dim), c
                for d in ti.static(range(self.dim - 1, -1, -1)):
                    at[d] = rest % self.size[None][d]
                    rest = rest // self.size[None][d]
                k = self.run(x, i, i + 1, self.start[c + 1], k)
                for o in ti.static(range(len(FORWARD[self.dim]))):
                    a = 0
                    for d in ti.static(range(self.dim)):
                        b = at[d] + ti.static(FORWARD[self.dim][o][d])
                        if ti.static(self.periodic[d]):
                            inner = self.size[None][d] - 2
                            b = 1 + (b - 1 + inner) % inner
                        a = a * self.size[None][d] + b
                    k = self.run(x, i, self.start[a], self.start[a + 1], k)
            else:
                k = self.run(x, i, i + 1, self.start[c + 2], k)
                row = c + self.size[None][self.dim - 1]
                if ti.static(self.dim == 2):
                    k = self.run(x, i, self.start[row - 1], self.start[row + 2], k)
                else:
                    k = self.run(x, i, self.start[row - 1], self.start[row + 2], k)
                    for o in range(3):
                        ahead = c + (self.size[None][1] + o - 1) * self.size[None][2]
                        k = self.run(x, i, self.start[ahead - 1], self.start[ahead + 2], k)
            self.listed_at[i] = x[i]
        self.first[n] = k
        self.count[None] = k

    @ti.func
    def stale(self, x: ti.template(), n):
        """Whether some particle has moved by half the skin since the list was made."""
        far = 0.0
        for i in range(n):
            r = x[i] - self.listed_at[i]
            r[3] = 0.0
            if ti.static(self.wraps):
                r = self.apart(r)
            far = ti.max(far, r.norm_sqr())
        return far > ti.static((SKIN / 2) ** 2)
