"""Walls of the container as conditions on grid nodes, obstacles as one on what enters them."""

from sim.taichi_runtime import ti


@ti.func
def wall(v, node, low, high, friction: ti.template(), coefficient):
    """Velocity of a grid node after contact with the container's walls.

    A node on a wall may not move into it: the inward normal component is removed, and Coulomb friction takes up to
    ``coefficient`` times it from the tangential one (Stomakhin et al. 2013, sec. 8). ``friction`` is "slip", "coulomb" or
    "sticky" at compile time. node, low, high: [dim] indices; low and high lie exactly on the walls.
    """
    for axis in ti.static(range(v.n)):
        at_low, at_high = node[axis] == low[axis], node[axis] == high[axis]
        if at_low or at_high:
            if ti.static(friction == "sticky"):
                v = v * 0.0
            else:
                normal = v[axis]
                if (at_low and normal < 0.0) or (at_high and normal > 0.0):
                    v[axis] = 0.0
                    if ti.static(friction == "coulomb"):
                        speed = v.norm()
                        v *= ti.max(0.0, 1.0 - coefficient * ti.abs(normal) / ti.max(speed, 1e-12))
    return v


@ti.func
def solid(v, value, friction: ti.template()):
    """Velocity of a particle in or on an obstacle; ``value`` is (normal [dim], distance, friction), friction < 0 is sticky.

    As at a wall: no velocity into the solid, Coulomb friction on the rest, free to leave. ``friction``: "slip" or "coulomb".
    """
    if value[v.n] <= 0.0:
        normal = ti.Vector([value[d] for d in ti.static(range(v.n))])
        approach = v.dot(normal)
        if ti.static(friction == "coulomb"):
            if value[v.n + 1] < 0.0:
                v = v * 0.0
            elif approach < 0.0:
                along = v - approach * normal
                v = along * ti.max(0.0, 1.0 + value[v.n + 1] * approach / ti.max(along.norm(), 1e-12))
        elif approach < 0.0:
            v -= approach * normal
    return v
