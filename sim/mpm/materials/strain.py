"""What materials with shear share: the left Cauchy-Green tensor as state, and the frame of a principal return map."""

import numpy as np

from sim.mpm.decomposition import assemble, decompose, expm1, finite, log1p, pack, unpack
from sim.taichi_runtime import ti

#: Smallest eigenvalue of b - I that a principal return map keeps.
CRUSHED = -0.999999
#: Below it is no rounding of -1: b has no such eigenvalue, and is broken.
IMPOSSIBLE = -1.001


def lame(material, stiffness: float) -> tuple[float, float]:
    """Lame's lambda and mu [Pa]; ``stiffness`` multiplies Young's modulus."""
    E, nu = material.young_modulus * stiffness, material.poisson_ratio
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


@ti.func
def push_forward(B, G):
    """(I + G)(I + B)(I + G)^T - I without forming I + B."""
    BG = B @ G.transpose()
    return B + G + G.transpose() + G @ G.transpose() + BG + BG.transpose() + G @ BG


@ti.func
def growth(B):
    """det(I + B) - 1 and its part of second and third order in B, both free of cancellation near B = 0."""
    higher = B.determinant()
    if ti.static(B.n == 3):
        for i in ti.static(range(3)):
            j = ti.static((i + 1) % 3)
            higher += B[i, i] * B[j, j] - B[i, j] * B[j, i]
    return B.trace() + higher, higher


@ti.data_oriented
class LeftCauchyGreen:
    """An isotropic material that carries b - I, b = F F^T (symmetric: xx, yy, xy or Voigt's order).

    Decision: b - I, not F. The response is isotropic, so b holds all that matters, and b - I keeps the digits of small strains
    in float32. What b cannot see is a reflection (det F < 0): a step with det(I + dt grad v) <= 0 leaves NaN in b - I, which
    stays until the frame's end whatever a return map would make of it, and ``intact`` has the frame rejected.
    """

    left_out = {"F": "the response is isotropic: the symmetric b = F F^T is enough"}

    def __init__(self, dim: int, capacity: int, numbers: int):
        self.dim = dim
        self.b = ti.Vector.field(dim * (dim + 1) // 2, ti.f32, capacity)
        self.parameters = ti.field(ti.f32, numbers)  # lambda, mu, density, then the material's own

    @staticmethod
    def state(dim: int) -> dict[str, int]:
        """Per-particle state: name -> floats."""
        return {"b - I": dim * (dim + 1) // 2}

    @staticmethod
    def options(material) -> tuple:
        """What is compiled in: nothing but the model."""
        return ()

    @staticmethod
    def omissions(material) -> dict[str, str]:
        """What the numbers of this material leave out: name -> reason."""
        return {}

    @staticmethod
    def rest_wave_speed(material, stiffness: float) -> float:
        """sqrt((lambda + 2 mu) / rho0): follows lambda where Poisson's ratio comes near 1/2."""
        lam, mu = lame(material, stiffness)
        return float(np.sqrt((lam + 2 * mu) / material.density))

    @staticmethod
    def rings(material) -> bool:
        """Whether a particle alone on the grid resists both ways, and so is an oscillator."""
        return True

    @staticmethod
    def largest_step(material, dim: int, dx: float) -> float:
        """No bound on the time step beside the Courant number's."""
        return np.inf

    def fields(self) -> list:
        """Per-particle state fields."""
        return [self.b]

    @ti.func
    def reset(self, p):
        """Stress-free."""
        self.b[p] = ti.Vector.zero(ti.f32, self.b.n)

    @ti.func
    def sound(self, p, G):
        """Neither broken before nor turned inside out by I + G."""
        return finite(self.b[p].sum()) and (ti.Matrix.identity(ti.f32, self.dim) + G).determinant() > 0.0

    @ti.func
    def broken(self):
        """NaN, from its bits: fast-math may take a computed one for anything."""
        return ti.Vector([ti.bit_cast(0x7FC00000, ti.f32) for _ in ti.static(range(self.b.n))])

    @ti.func
    def wave_speed(self, p):
        """sqrt((lambda + 2 mu) / rho0)."""
        return ti.sqrt((self.parameters[0] + 2.0 * self.parameters[1]) / self.parameters[2])

    @ti.func
    def intact(self, p):
        det = (unpack(self.b[p]) + ti.Matrix.identity(ti.f32, self.dim)).determinant()
        return finite(self.b[p].sum()) and finite(det) and det > 0.0


@ti.data_oriented
class Principal(LeftCauchyGreen):
    """A material whose plastic flow is a map of the principal Hencky strains e_i = log(sigma_i) of b (Simo 1992).

    A subclass gives ``return_map(p, e, dt)`` -> (e on or inside the yield surface, whether it moved), which may update the
    subclass's own state, ``stress(p, e)`` and ``energy(p, e)``. The default is Hencky's law. Singular values below 1e-3 become
    1e-3, by crushing that is not given back: float32 holds no more of b - I, and its rounding would turn the volume's sign.
    """

    left_out = LeftCauchyGreen.left_out | {"SVD": "replaced by a symmetric decomposition of b"}

    @ti.func
    def hencky(self, values):
        """log(sigma_i) = log(1 + beta_i) / 2 of the eigenvalues beta of b - I."""
        e = values
        for i in ti.static(range(self.dim)):
            e[i] = 0.5 * log1p(ti.max(values[i], CRUSHED))
        return e

    @ti.func
    def stress(self, p, e):
        """tau_i = 2 mu e_i + lambda tr e."""
        return 2.0 * self.parameters[1] * e + self.parameters[0] * e.sum()

    @ti.func
    def energy(self, p, e):
        """psi = mu e : e + lambda / 2 (tr e)^2."""
        return self.parameters[1] * e.norm_sqr() + 0.5 * self.parameters[0] * e.sum() ** 2

    @ti.func
    def kirchhoff(self, p, gradient_dt, dt):
        """Trial b <- (I + dt grad v) b (I + dt grad v)^T, return map, Kirchhoff stress."""
        tau = ti.Matrix.zero(ti.f32, self.dim, self.dim)
        kept = self.broken()
        if self.sound(p, gradient_dt):
            trial = pack(push_forward(unpack(self.b[p]), gradient_dt))
            values, frame = decompose(trial)
            least = values.min()
            if least > IMPOSSIBLE:
                e, moved = self.return_map(p, self.hencky(values), dt)
                tau = unpack(assemble(self.stress(p, e), frame))
                kept = trial
                if moved or least < CRUSHED:
                    kept = assemble(ti.Vector([expm1(2.0 * e[i]) for i in ti.static(range(self.dim))]), frame)
        self.b[p] = kept
        return tau

    @ti.func
    def energy_density(self, p):
        values, frame = decompose(self.b[p])
        return self.energy(p, self.hencky(values))
