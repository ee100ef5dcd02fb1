"""Walls of the container as a condition on grid nodes."""

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
