"""Snow: fixed corotated elasticity that yields in compression and stretch, and hardens as it is packed."""

import numpy as np

from sim.mpm.decomposition import expm1, finite
from sim.mpm.materials.strain import LeftCauchyGreen, Principal, lame
from sim.taichi_runtime import ti


@ti.data_oriented
class SnowModel(Principal):
    """Stomakhin et al. 2013, sec. 5: psi = h [mu sum (sigma_i - 1)^2 + lambda / 2 (J - 1)^2] of the elastic part, h = exp(xi (1 - J_P)).

    tau_i = h [2 mu (sigma_i - 1) sigma_i + lambda (J - 1) J]. Elastic singular values are held in [1 - theta_c, 1 + theta_s];
    what is cut off changes the plastic volume J_P: packed snow (J_P < 1) hardens, torn snow loses its strength.
    """

    def __init__(self, dim: int, capacity: int):
        super().__init__(dim, capacity, 6)  # ..., xi, log(1 - theta_c), log(1 + theta_s)
        self.J = ti.field(ti.f32, capacity)

    @staticmethod
    def state(dim: int) -> dict[str, int]:
        return Principal.state(dim) | {"plastic J": 1}

    def fields(self) -> list:
        return [self.b, self.J]

    @staticmethod
    def numbers(material, dim: int, stiffness: float) -> tuple[float, ...]:
        """What ``parameters`` holds; ``stiffness`` multiplies Young's modulus (a softened rung of a ladder)."""
        strains = np.log1p(-material.critical_compression), np.log1p(material.critical_stretch)
        return *lame(material, stiffness), material.density, material.hardening, *strains

    @ti.func
    def reset(self, p):
        self.b[p] = ti.Vector.zero(ti.f32, self.b.n)
        self.J[p] = 1.0

    @ti.func
    def hardening(self, p):
        """h = exp(xi (1 - J_P))."""
        return ti.exp(self.parameters[3] * (1.0 - self.J[p]))

    @ti.func
    def return_map(self, p, e, dt):
        """Elastic log stretches cut to [log(1 - theta_c), log(1 + theta_s)]; J_P takes what is cut off."""
        result = ti.min(ti.max(e, self.parameters[4]), self.parameters[5])
        cut = e.sum() - result.sum()
        moved = (e - result).norm_sqr() > 0.0
        if moved:
            self.J[p] *= ti.exp(cut)
        return result, moved

    @ti.func
    def stress(self, p, e):
        lam, mu, volume = self.parameters[0], self.parameters[1], e.sum()
        result = e
        for i in ti.static(range(self.dim)):
            result[i] = 2.0 * mu * expm1(e[i]) * ti.exp(e[i]) + lam * expm1(volume) * ti.exp(volume)
        return self.hardening(p) * result

    @ti.func
    def energy(self, p, e):
        psi = 0.5 * self.parameters[0] * expm1(e.sum()) ** 2
        for i in ti.static(range(self.dim)):
            psi += self.parameters[1] * expm1(e[i]) ** 2
        return self.hardening(p) * psi

    @ti.func
    def wave_speed(self, p):
        """c^2 = h (2 mu s^2 + lambda J^2) / rho0 with the largest stretch s and J <= s^d that the yield surface allows."""
        modulus = (self.parameters[0] + 2.0 * self.parameters[1]) * ti.exp(2.0 * self.dim * self.parameters[5])
        return ti.sqrt(self.hardening(p) * modulus / self.parameters[2])

    @ti.func
    def intact(self, p):
        return LeftCauchyGreen.intact(self, p) and finite(self.J[p]) and self.J[p] > 0.0
