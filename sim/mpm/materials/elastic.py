"""A rubber-like solid: neo-Hookean, no decomposition."""

from sim.mpm.decomposition import log1p, log1p_excess, pack, unpack
from sim.mpm.materials.strain import LeftCauchyGreen, growth, lame, push_forward
from sim.taichi_runtime import ti


@ti.data_oriented
class ElasticModel(LeftCauchyGreen):
    """tau = mu (b - I) + lambda log J I, psi = mu / 2 (tr b - d) - mu log J + lambda / 2 (log J)^2 (Bonet & Wood 2008, sec. 6.4.3).

    Decision: neo-Hookean rather than fixed corotated. It is a polynomial in b but for log J, so it needs neither F nor its
    rotation, and it resists collapse: psi grows without bound as J -> 0, where the corotated energy stays finite.
    """

    left_out = LeftCauchyGreen.left_out | {"decomposition": "the stress is a polynomial in b and log J"}

    def __init__(self, dim: int, capacity: int):
        super().__init__(dim, capacity, 3)

    @staticmethod
    def numbers(material, dim: int, stiffness: float) -> tuple[float, ...]:
        """What ``parameters`` holds; ``stiffness`` multiplies Young's modulus (a softened rung of a ladder)."""
        return *lame(material, stiffness), material.density

    @ti.func
    def kirchhoff(self, p, gradient_dt, dt):
        tau = ti.Matrix.zero(ti.f32, self.dim, self.dim)
        kept = self.broken()
        if self.sound(p, gradient_dt):
            B = push_forward(unpack(self.b[p]), gradient_dt)
            volume, _ = growth(B)
            log_J = 0.5 * log1p(ti.max(volume, -0.999999))
            tau = self.parameters[1] * B + self.parameters[0] * log_J * ti.Matrix.identity(ti.f32, self.dim)
            kept = pack(B)
        self.b[p] = kept
        return tau

    @ti.func
    def energy_density(self, p):
        """mu / 2 (tr B - 2 log J) with 2 log J = log(1 + V), V = det b - 1 = tr B + higher: neither difference cancels."""
        volume, higher = growth(unpack(self.b[p]))
        V = ti.max(volume, -0.999999)
        return 0.5 * self.parameters[1] * (log1p_excess(V) - higher) + 0.125 * self.parameters[0] * log1p(V) ** 2

    @ti.func
    def wave_speed(self, p):
        """c^2 = (mu (1 + s^2) + lambda (1 - log J)) / rho0 along a stretch s: s d tau/ds - tau. s^2 <= 1 + |b - I|."""
        B = unpack(self.b[p])
        volume, _ = growth(B)
        squeeze = ti.max(0.0, -0.5 * log1p(ti.max(volume, -0.999999)))
        return ti.sqrt((self.parameters[1] * (2.0 + B.norm()) + self.parameters[0] * (1.0 + squeeze)) / self.parameters[2])
