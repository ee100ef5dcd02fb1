"""Goop: a von Mises (Bingham) viscoplastic solid on Hencky strain."""

import numpy as np

from sim.mpm.decomposition import log1p, unpack
from sim.mpm.materials.strain import Principal, growth, lame
from sim.taichi_runtime import ti


@ti.data_oriented
class GoopModel(Principal):
    """Rigid-plastic flow at the shear yield stress tau_y, overstress viscosity eta (Perzyna 1966; Simo & Hughes 1998, sec. 3.4 and 2.7).

    tau = 2 mu dev e + (lambda + 2 mu / d) tr e. Yield surface |dev tau| = sqrt(2) tau_y; beyond it the plastic strain rate is
    (|dev tau| - sqrt(2) tau_y) / (2 eta) along dev tau, so that steady shear needs tau_y + eta gamma' (Bingham 1922). The
    implicit return |dev tau| = sqrt(2) tau_y + overstress eta / (eta + mu dt) holds for any dt; eta = 0 is rate-independent.
    tau_y = 0 without viscosity is a fluid: no deviatoric stress; a very large one is an elastic solid.
    """

    def __init__(self, dim: int, capacity: int, viscous: bool):
        super().__init__(dim, capacity, 5)  # ..., |dev e| at yield, viscosity
        self.viscous = viscous

    @staticmethod
    def options(material) -> tuple:
        """Whether there is a viscosity."""
        return (material.viscosity > 0,)

    @staticmethod
    def omissions(material) -> dict[str, str]:
        return {} if material.viscosity else {"viscosity": "zero: rate-independent"}

    @staticmethod
    def numbers(material, dim: int, stiffness: float) -> tuple[float, ...]:
        """What ``parameters`` holds; ``stiffness`` multiplies Young's modulus (a softened rung of a ladder)."""
        lam, mu = lame(material, stiffness)
        return lam, mu, material.density, material.yield_stress / (np.sqrt(2) * mu), material.viscosity

    @ti.func
    def return_map(self, p, e, dt):
        """Back along the deviator to the yield surface, or to the overstress of the viscosity; the volume stays."""
        limit, mean = self.parameters[3], e.sum() / self.dim
        dev = e - mean
        size = dev.norm()
        result, moved = e, False
        if size > limit:
            target = limit
            if ti.static(self.viscous):
                target = limit + (size - limit) * self.parameters[4] / (self.parameters[4] + self.parameters[1] * dt)
            result = dev * (target / size) + mean
            moved = True
        return result, moved

    @ti.func
    def wave_speed(self, p):
        """c^2 = (lambda + 2 mu - min tau_i) / rho0: along a principal axis s d tau/ds - tau. The least strain is bounded by
        mean - sqrt((d - 1) / d) |dev| of b - I, which is exact in 2D."""
        lam, mu, rho = self.parameters[0], self.parameters[1], self.parameters[2]
        B = unpack(self.b[p])
        mean = B.trace() / self.dim
        least = mean - ti.sqrt((self.dim - 1.0) / self.dim) * (B - mean * ti.Matrix.identity(ti.f32, self.dim)).norm()
        volume, _ = growth(B)
        tau = mu * log1p(ti.max(least, -0.999999)) + 0.5 * lam * log1p(ti.max(volume, -0.999999))
        return ti.sqrt((lam + 2.0 * mu + ti.max(0.0, -tau)) / rho)
