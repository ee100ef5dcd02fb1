"""Spectral decomposition of small symmetric matrices, accurate log1p/expm1 and a test for NaN, for constitutive models.

A symmetric matrix is a vector: (xx, yy, xy) in 2D, (xx, yy, zz, yz, xz, xy) in 3D (Voigt's order).
"""

from sim.taichi_runtime import ti


@ti.func
def log1p(y):
    """log(1 + y), accurate near 0 in float32: 2 atanh(z), z = y / (2 + y), as a series for |y| < 1/4 (error below 2e-8)."""
    result = 0.0
    if ti.abs(y) < 0.25:
        z = y / (2.0 + y)
        q = z * z
        result = 2.0 * z * (1.0 + q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0))))
    else:
        result = ti.log(1.0 + y)
    return result


@ti.func
def log1p_excess(y):
    """y - log(1 + y), accurate near 0 in float32, where it is y^2 / 2: the first term of ``log1p``'s series drops out exactly."""
    result = 0.0
    if ti.abs(y) < 0.25:
        z = y / (2.0 + y)
        q = z * z
        result = y * z - 2.0 * z * q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0)))
    else:
        result = y - ti.log(1.0 + y)
    return result


@ti.func
def expm1(y):
    """exp(y) - 1, accurate near 0 in float32: Taylor series to y^7 for |y| < 1/4 (error below 1e-9)."""
    result = 0.0
    if ti.abs(y) < 0.25:
        result = y * (1.0 + y / 2.0 * (1.0 + y / 3.0 * (1.0 + y / 4.0 * (1.0 + y / 5.0 * (1.0 + y / 6.0 * (1.0 + y / 7.0))))))
    else:
        result = ti.exp(y) - 1.0
    return result


@ti.func
def finite(y):
    """Neither infinite nor NaN, read from the bits of a float32: fast-math compiles comparisons with NaN away, and maxima drop it."""
    return (ti.bit_cast(y, ti.i32) & 0x7F800000) != 0x7F800000


@ti.func
def decompose2(s):
    """Eigenvalues of [[s0, s2], [s2, s1]] and (cos 2t, sin 2t) of the principal frame.

    No angle is halved: every isotropic function needs only the doubled angle (``assemble2``), so neither the branch near
    cos 2t = -1 nor equal eigenvalues are special.
    """
    mean, half, off = 0.5 * (s[0] + s[1]), 0.5 * (s[0] - s[1]), s[2]
    r = ti.sqrt(half * half + off * off)
    frame = ti.Vector([1.0, 0.0])
    if r > 1e-30:
        frame = ti.Vector([half / r, off / r])
    return ti.Vector([mean + r, mean - r]), frame


@ti.func
def assemble2(values, frame):
    """Symmetric matrix (xx, yy, xy) with these eigenvalues in this frame: mean I + half difference [[c, s], [s, -c]]."""
    mean, half = 0.5 * (values[0] + values[1]), 0.5 * (values[0] - values[1])
    return ti.Vector([mean + half * frame[0], mean - half * frame[0], half * frame[1]])


@ti.func
def rotate3(A: ti.template(), Q: ti.template(), p: ti.template(), q: ti.template()):
    """One Jacobi rotation in the plane (p, q) that annihilates A[p, q] (Golub & Van Loan 2013, algorithm 8.5.1)."""
    r = ti.static(3 - p - q)
    apq = A[p, q]
    if ti.abs(apq) > 1e-30:
        theta = 0.5 * (A[q, q] - A[p, p]) / apq
        t = 1.0 / (ti.abs(theta) + ti.sqrt(theta * theta + 1.0))
        if theta < 0.0:
            t = -t
        c = 1.0 / ti.sqrt(t * t + 1.0)
        s = t * c
        A[p, p] -= t * apq
        A[q, q] += t * apq
        A[p, q] = 0.0
        arp, arq = A[r, p], A[r, q]
        A[r, p] = c * arp - s * arq
        A[r, q] = s * arp + c * arq
        A[p, r], A[q, r], A[q, p] = A[r, p], A[r, q], 0.0
        for k in ti.static(range(3)):
            up, uq = Q[k, p], Q[k, q]
            Q[k, p] = c * up - s * uq
            Q[k, q] = s * up + c * uq


@ti.func
def decompose3(s):
    """Eigenvalues and eigenvectors (columns) of a symmetric 3x3 matrix by four cyclic Jacobi sweeps (quadratic convergence)."""
    A = unpack3(s)
    Q = ti.Matrix.identity(ti.f32, 3)
    for _ in range(4):
        rotate3(A, Q, 0, 1)
        rotate3(A, Q, 0, 2)
        rotate3(A, Q, 1, 2)
    return ti.Vector([A[0, 0], A[1, 1], A[2, 2]]), Q


@ti.func
def assemble3(values, Q):
    """Q diag(values) Q^T as (xx, yy, zz, yz, xz, xy)."""
    return pack3(Q @ ti.Matrix([[values[0], 0.0, 0.0], [0.0, values[1], 0.0], [0.0, 0.0, values[2]]]) @ Q.transpose())


@ti.func
def unpack2(s):
    """Full 2x2 matrix of a symmetric vector."""
    return ti.Matrix([[s[0], s[2]], [s[2], s[1]]])


@ti.func
def unpack3(s):
    """Full 3x3 matrix of a symmetric vector."""
    return ti.Matrix([[s[0], s[5], s[4]], [s[5], s[1], s[3]], [s[4], s[3], s[2]]])


@ti.func
def pack2(M):
    """Symmetric vector of a symmetric 2x2 matrix."""
    return ti.Vector([M[0, 0], M[1, 1], M[0, 1]])


@ti.func
def pack3(M):
    """Symmetric vector of a symmetric 3x3 matrix."""
    return ti.Vector([M[0, 0], M[1, 1], M[2, 2], M[1, 2], M[0, 2], M[0, 1]])


@ti.func
def unpack(s):
    """Full matrix of a symmetric vector, 2D or 3D."""
    if ti.static(s.n == 3):
        return unpack2(s)
    else:
        return unpack3(s)


@ti.func
def pack(M):
    """Symmetric vector of a symmetric matrix, 2D or 3D."""
    if ti.static(M.n == 2):
        return pack2(M)
    else:
        return pack3(M)


@ti.func
def decompose(s):
    """Eigenvalues and frame of a symmetric vector, 2D or 3D; the frame is what ``assemble`` takes."""
    if ti.static(s.n == 3):
        return decompose2(s)
    else:
        return decompose3(s)


@ti.func
def assemble(values, frame):
    """Symmetric vector with these eigenvalues in a frame of ``decompose``."""
    if ti.static(values.n == 2):
        return assemble2(values, frame)
    else:
        return assemble3(values, frame)
