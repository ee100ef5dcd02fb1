"""Weakly compressible water: one scalar J a particle, no deformation gradient, no decomposition."""

import numpy as np

from sim.mpm.decomposition import expm1, finite
from sim.taichi_runtime import ti


@ti.data_oriented
class WaterModel:
    """Tait pressure p = B (J^-gamma - 1), B = rho0 c^2 / gamma (Monaghan 1994, eq. 3), tau = -J p I; J <- J exp(dt tr grad v).

    With the exponential log J and grad v step as a symplectic pair. 1 + g falls short of exp(g) whatever the sign of g: a drop alone in the
    air, which breathes at a frequency of the grid, gained energy with every swing, and 2 % of the trajectories of WATER failed. exp(g) is
    taken as (12 + 6 g + g^2) / (12 - 6 g + g^2), off by g^5 / 720 in its logarithm, for exp itself took 20 % of the speed; and a step
    of |g| >= 1/2 is no step: it marks the volume as broken, so that the frame is repeated with smaller ones. (Without a bound 3 of 28
    trajectories of WATER failed; with 1 in place of 1/2 none did, but in one of 200 a drop came to hold more energy than the whole fall.)

    J may exceed 1: water then pulls, by less than B. Holding J at 1 was tried and loses the record of how far particles have
    parted; a settled drop ended a third too high. With a viscosity eta, tau += 2 eta dev(sym grad v): the kinematic viscosity
    eta / rho0 stays the same as J changes, and with it the bound on the time step.
    """

    left_out = {"F": "water needs only the volume ratio J", "decomposition": "no shear, so no principal directions"}

    def __init__(self, dim: int, capacity: int, seven: bool, viscous: bool):
        self.dim, self.seven, self.viscous = dim, seven, viscous
        self.J = ti.field(ti.f32, capacity)
        self.parameters = ti.field(ti.f32, 4)  # B, gamma, c, viscosity

    @staticmethod
    def state(dim: int) -> dict[str, int]:
        """Per-particle state: name -> floats."""
        return {"J": 1}

    @staticmethod
    def options(material) -> tuple:
        """What is compiled in: gamma = 7 needs three products where any other exponent needs a power function; viscosity."""
        return material.gamma == 7.0, material.viscosity > 0

    @staticmethod
    def omissions(material) -> dict[str, str]:
        """What the numbers of this material leave out: name -> reason."""
        return {} if material.viscosity else {"viscosity": "zero"}

    @staticmethod
    def rest_wave_speed(material, stiffness: float) -> float:
        """The speed of sound [m/s]."""
        return material.sound_speed * float(np.sqrt(stiffness))

    @staticmethod
    def rings(material) -> bool:
        """Whether a particle alone on the grid resists both ways, and so is an oscillator."""
        return True

    @staticmethod
    def largest_step(material, dim: int, dx: float) -> float:
        """dt <= dx^2 rho0 / (2 d eta), explicit diffusion of momentum."""
        return dx * dx * material.density / (2 * dim * material.viscosity) if material.viscosity else np.inf

    def fields(self) -> list:
        """Per-particle state fields."""
        return [self.J]

    @classmethod
    def numbers(cls, material, dim: int, stiffness: float) -> tuple[float, ...]:
        """What ``parameters`` holds; ``stiffness`` multiplies the bulk modulus (a softened rung of a ladder)."""
        c = cls.rest_wave_speed(material, stiffness)
        return material.density * c * c / material.gamma, material.gamma, c, material.viscosity

    @ti.func
    def reset(self, p):
        """At reference density."""
        self.J[p] = 1.0

    @ti.func
    def power(self, J):
        """J^(1 - gamma)."""
        result = 1.0
        if ti.static(self.seven):
            i2 = 1.0 / (J * J)
            result = i2 * i2 * i2
        else:
            result = J ** (1.0 - self.parameters[1])
        return result

    @ti.func
    def kirchhoff(self, p, gradient_dt, dt):
        growth = gradient_dt.trace()
        # A volume that was once turned inside out, or nearly, stays zero and so is not intact: turned twice within a frame, it would look sound.
        even = 12.0 + growth * growth
        J = self.J[p] * ti.select(ti.abs(growth) < 0.5, (even + 6.0 * growth) / (even - 6.0 * growth), 0.0)
        self.J[p] = J
        tau = ti.Matrix.identity(ti.f32, self.dim) * (-self.parameters[0] * (self.power(J) - J))
        if ti.static(self.viscous):
            shear = gradient_dt + gradient_dt.transpose() - ti.Matrix.identity(ti.f32, self.dim) * (2.0 / self.dim * growth)
            tau += (self.parameters[3] / dt) * shear
        return tau

    @ti.func
    def energy_density(self, p):
        """psi = B [(J^(1-gamma) - 1) / (gamma - 1) + J - 1], whose derivative is -p; expanded about J = 1, where float32 cancels.

        With a = (1 - gamma) log J the quotient is -log J expm1(a) / a, which has a limit at gamma = 1.
        """
        J, gamma = self.J[p], self.parameters[1]
        e = 1.0 - J
        psi = 0.5 * gamma * e * e * (1.0 + (gamma + 1.0) / 3.0 * e)
        if ti.abs(e) > 1e-2:
            a = (1.0 - gamma) * ti.log(J)
            ratio = 1.0
            if ti.abs(a) > 1e-6:
                ratio = expm1(a) / a
            psi = -ti.log(J) * ratio - e
        return self.parameters[0] * psi

    @ti.func
    def wave_speed(self, p):
        """The larger of c^2 = dp/drho = c0^2 J^(1 - gamma), in a body of water, and c^2 = dtau/dlog J / rho0 =
        c0^2 ((gamma - 1) J^(1 - gamma) + J) / gamma, of a particle alone, which gets stiffer as it is stretched."""
        J, gamma = self.J[p], self.parameters[1]
        power = self.power(J)
        return self.parameters[2] * ti.sqrt(((gamma - 1.0) * power + ti.max(J, power)) / gamma)

    @ti.func
    def intact(self, p):
        return finite(self.J[p]) and self.J[p] > 0.0
