"""Weakly compressible water: one scalar J a particle, no deformation gradient, no decomposition."""

import numpy as np

from sim.taichi_runtime import ti


@ti.data_oriented
class WaterModel:
    """Tait pressure p = B (J^-gamma - 1), B = rho0 c^2 / gamma (Monaghan 1994, eq. 3), tau = -J p I; J <- J (1 + dt tr grad v).

    J may exceed 1: water then pulls, by less than B. Holding J at 1 was tried and loses the record of how far particles have
    parted; a settled drop ended a third too high.
    """

    state = ("J",)
    left_out = {"F": "water needs only the volume ratio J", "decomposition": "no shear, so no principal directions"}

    def __init__(self, dim: int, capacity: int):
        self.dim = dim
        self.J = ti.field(ti.f32, capacity)
        self.parameters = ti.field(ti.f32, 3)  # B, gamma, c

    def fields(self) -> list:
        """Per-particle state fields."""
        return [self.J]

    def configure(self, material, stiffness: float) -> None:
        """Load the material's numbers; ``stiffness`` multiplies the bulk modulus (a softened rung of a ladder)."""
        c = material.sound_speed * np.sqrt(stiffness)
        self.parameters.from_numpy(np.array([material.density * c * c / material.gamma, material.gamma, c], np.float32))

    @ti.func
    def reset(self, p):
        """At reference density."""
        self.J[p] = 1.0

    @ti.func
    def kirchhoff(self, p, gradient_dt):
        J = self.J[p] * (1.0 + gradient_dt.trace())
        self.J[p] = J
        pressure = self.parameters[0] * (J ** (-self.parameters[1]) - 1.0)
        return ti.Matrix.identity(ti.f32, self.dim) * (-J * pressure)

    @ti.func
    def energy_density(self, p):
        """psi = B [(J^(1-gamma) - 1) / (gamma - 1) + J - 1], whose derivative is -p; expanded about J = 1 where f32 cancels."""
        J, B, gamma = self.J[p], self.parameters[0], self.parameters[1]
        e = 1.0 - J
        near = 0.5 * gamma * e * e
        full = B * 0.0
        if e > 1e-2 and gamma > 1.0 + 1e-6:
            full = (J ** (1.0 - gamma) - 1.0) / (gamma - 1.0) + J - 1.0
        else:
            full = near * (1.0 + (gamma + 1.0) / 3.0 * e)
        return B * full

    @ti.func
    def wave_speed(self, p):
        """c = c0 J^(-(gamma - 1) / 2), from c^2 = dp/drho."""
        return self.parameters[2] * self.J[p] ** (-0.5 * (self.parameters[1] - 1.0))
