"""The walls of a box as particles of SPH and of the position-based solver meet them: a table over the distance (``sim.sph.kernel.wall_table``)."""

from sim.sph.kernel import ENTRIES, SHARE, SLOPE
from sim.taichi_runtime import ti

#: Distance from a wall, in support radii, at which particles are stopped.
HAIR = 1e-4


@ti.data_oriented
class Walls:
    """Fields that the loader fills: ``extent`` (lower and upper corner [support radii]) and ``table``. periodic [dim] of bool: no walls there."""

    def __init__(self, dim: int, periodic: tuple[bool, ...]):
        self.dim, self.periodic, self.faces = dim, periodic, 2 * dim
        self.extent = ti.Vector.field(4, ti.f32, 2)
        self.table = ti.Vector.field(7, ti.f32, ENTRIES + 2)

    @ti.func
    def look(self, s):
        """``wall_table`` at a distance s <= 1."""
        u = ti.max(s, 0.0) * float(ENTRIES)
        # NaN is any index.
        k = ti.min(ti.max(ti.cast(u, ti.i32), 0), ENTRIES)
        f = u - ti.cast(k, ti.f32)
        return (1.0 - f) * self.table[k] + f * self.table[k + 1]

    @ti.func
    def face(self, x, f: ti.template()):
        """What a particle at x meets: the f-th of ``faces``."""
        return self.wall_face(x, f)

    @ti.func
    def wall_face(self, x, f: ti.template()):
        """Distance to a wall and the normal away from it; 2 for one that is not there."""
        s, n = 2.0, ti.Vector.zero(ti.f32, 4)
        if ti.static(not self.periodic[f // 2]):
            if ti.static(f % 2 == 0):
                s, n[f // 2] = x[f // 2] - self.extent[0][f // 2], 1.0
            else:
                s, n[f // 2] = self.extent[1][f // 2] - x[f // 2], -1.0
        return s, n

    @ti.func
    def walls(self, x):
        """Gradient of the share of the kernel that lies in walls, and (lane 3) the share.

        What is fluid of the kernel is taken as the product of what each wall leaves: exact for one wall, and smooth in corners.
        """
        fluid, gradient = 1.0, ti.Vector.zero(ti.f32, 4)
        for f in ti.static(range(self.faces)):
            s, n = self.face(x, f)
            if s < 1.0:
                T = self.look(s)
                gradient = (1.0 - T[SHARE]) * gradient + (fluid * T[SLOPE]) * n
                fluid *= 1.0 - T[SHARE]
        gradient[3] = 1.0 - fluid
        return gradient
