"""Sand: Drucker-Prager plasticity on Hencky strain."""

import numpy as np

from sim.mpm.decomposition import finite
from sim.mpm.materials.strain import LeftCauchyGreen, Principal, lame
from sim.taichi_runtime import ti


@ti.data_oriented
class SandModel(Principal):
    """Drucker-Prager elastoplastic sand (Klar et al. 2016, sec. 6) with volume correction (Tampubolon et al. 2017, sec. 4.3.4).

    Yield surface |dev e| + k (tr e - tip) = 0, k = alpha (d lambda + 2 mu) / (2 mu). In 2D alpha = sin(phi) / sqrt(2), which gives
    |s1 - s2| = sin(phi) |s1 + s2| exactly; in 3D alpha = sqrt(2/3) 2 sin(phi) / (3 - sin(phi)) (compression cone). The tip
    lies at tr tau = d C cot(phi) for a cohesion C (0: in tension the stress is zero). The volume gained beyond the tip is
    remembered (``v``) and given back before pressure builds up.
    """

    def __init__(self, dim: int, capacity: int, cohesive: bool):
        super().__init__(dim, capacity, 5)  # ..., k, tr e at the tip
        self.cohesive = cohesive
        self.v = ti.field(ti.f32, capacity)

    @staticmethod
    def state(dim: int) -> dict[str, int]:
        return Principal.state(dim) | {"volume gain": 1}

    @staticmethod
    def options(material) -> tuple:
        """Whether the tip of the cone is shifted."""
        return (material.cohesion > 0,)

    @staticmethod
    def omissions(material) -> dict[str, str]:
        return {} if material.cohesion else {"cohesion": "zero: the cone's tip is at the origin"}

    @staticmethod
    def rings(material) -> bool:
        """Without cohesion it does not: stretched, sand is slack."""
        return material.cohesion > 0

    def fields(self) -> list:
        return [self.b, self.v]

    @staticmethod
    def numbers(material, dim: int, stiffness: float) -> tuple[float, ...]:
        """What ``parameters`` holds; ``stiffness`` multiplies Young's modulus (a softened rung of a ladder)."""
        lam, mu = lame(material, stiffness)
        phi = np.radians(material.friction_angle)
        alpha = np.sin(phi) / np.sqrt(2) if dim == 2 else np.sqrt(2 / 3) * 2 * np.sin(phi) / (3 - np.sin(phi))
        tip = dim * material.cohesion / np.tan(phi) / (dim * lam + 2 * mu) if material.cohesion else 0.0
        return lam, mu, material.density, alpha * (dim * lam + 2 * mu) / (2 * mu), tip

    @ti.func
    def reset(self, p):
        self.b[p] = ti.Vector.zero(ti.f32, self.b.n)
        self.v[p] = 0.0

    @ti.func
    def return_map(self, p, e, dt):
        """With the stored volume v: back to the tip, to the cone at the same volume and deviatoric direction, or unchanged."""
        k, v = self.parameters[3], self.v[p]
        trace = e.sum() + v
        mean = trace / self.dim
        dev = e - e.sum() / self.dim
        size = dev.norm()
        moved = v != 0.0
        gain = 0.0
        result = dev + mean
        tip = 0.0
        if ti.static(self.cohesive):
            tip = self.parameters[4]
        if trace >= tip:
            result = e * 0.0 + tip / self.dim
            gain = trace - tip
            moved = True
        elif size + k * (trace - tip) > 0.0:
            result = dev * (-k * (trace - tip) / size) + mean
            moved = True
        self.v[p] = gain
        return result, moved

    @ti.func
    def intact(self, p):
        return LeftCauchyGreen.intact(self, p) and finite(self.v[p])
