"""Distance to the obstacles between the nodes that hold it, for every solver that has them."""

from sim.taichi_runtime import ti


@ti.func
def between_nodes(solids: ti.template(), x, dim: ti.template()):
    """Distance and unit normal [dim] at a place x [dim, node spacings], multilinear in the nodes' values ``solids`` (normal, distance, ...).

    Between nodes the normals are averaged and stretched to length 1 again; on the middle line of a plate they cancel, and it stays 0.
    """
    low = ti.cast(x, ti.i32)
    f = x - ti.cast(low, ti.f32)
    normal, distance = ti.Vector.zero(ti.f32, dim), 0.0
    for corner in ti.static(range(2**dim)):
        at, weight = low, 1.0
        for d in ti.static(range(dim)):
            at[d] += ti.static(corner >> d & 1)
            weight *= f[d] if ti.static(corner >> d & 1) else 1.0 - f[d]
        value = solids[at]
        distance += weight * value[dim]
        for d in ti.static(range(dim)):
            normal[d] += weight * value[d]
    return distance, normal / ti.max(normal.norm(), 1e-6)
