"""Dry sand: Drucker-Prager plasticity on Hencky strain, carried by the left Cauchy-Green tensor."""

import numpy as np

from sim.mpm.decomposition import assemble2, assemble3, decompose2, decompose3, expm1, finite, log1p, pack2, pack3, unpack2, unpack3
from sim.taichi_runtime import ti


@ti.func
def push_forward(B, G):
    """(I + G)(I + B)(I + G)^T - I without forming I + B."""
    BG = B @ G.transpose()
    return B + G + G.transpose() + G @ G.transpose() + BG + BG.transpose() + G @ BG


@ti.data_oriented
class SandModel:
    """Drucker-Prager elastoplastic sand (Klar et al. 2016, sec. 6) with volume correction (Tampubolon et al. 2017, sec. 4.3.4).

    Hencky strain e_i = log(sigma_i) in the principal frame of b = F F^T; tau_i = 2 mu e_i + lambda tr e. Yield surface
    |dev e| + k tr e = 0, k = alpha (d lambda + 2 mu) / (2 mu). In 2D alpha = sin(phi) / sqrt(2), which gives
    |s1 - s2| = sin(phi) |s1 + s2| exactly; in 3D alpha = sqrt(2/3) 2 sin(phi) / (3 - sin(phi)) (compression cone). In
    tension the stress is zero; the volume gained there is remembered (``v``) and given back before pressure builds up.

    Decision: b - I, not F, is carried. The response is isotropic, so b holds all that matters; it needs one symmetric
    decomposition without angles in which no reflection can hide, and b - I keeps the digits of small strains in float32.
    """

    left_out = {"F": "the response is isotropic: the symmetric b = F F^T is enough", "SVD": "replaced by a symmetric decomposition of b"}

    def __init__(self, dim: int, capacity: int):
        self.dim = dim
        self.b = ti.Vector.field(dim * (dim + 1) // 2, ti.f32, capacity)
        self.v = ti.field(ti.f32, capacity)
        self.parameters = ti.field(ti.f32, 4)  # lambda, mu, k, density

    @staticmethod
    def state(dim: int) -> dict[str, int]:
        """Per-particle state: name -> floats."""
        return {"b - I": dim * (dim + 1) // 2, "volume gain": 1}

    @staticmethod
    def options(material) -> tuple:
        """What is compiled in: nothing but the model."""
        return ()

    @staticmethod
    def rest_wave_speed(material, stiffness: float) -> float:
        E, nu = material.young_modulus * stiffness, material.poisson_ratio
        return float(np.sqrt(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / material.density))

    def fields(self) -> list:
        """Per-particle state fields."""
        return [self.b, self.v]

    @staticmethod
    def numbers(material, dim: int, stiffness: float) -> tuple[float, ...]:
        """What ``parameters`` holds; ``stiffness`` multiplies Young's modulus (a softened rung of a ladder)."""
        E, nu = material.young_modulus * stiffness, material.poisson_ratio
        lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
        sin_phi = np.sin(np.radians(material.friction_angle))
        alpha = sin_phi / np.sqrt(2) if dim == 2 else np.sqrt(2 / 3) * 2 * sin_phi / (3 - sin_phi)
        return lam, mu, alpha * (dim * lam + 2 * mu) / (2 * mu), material.density

    @ti.func
    def reset(self, p):
        """Stress-free."""
        self.b[p] = self.b[p] * 0.0
        self.v[p] = 0.0

    @ti.func
    def return_map(self, e, v):
        """Principal Hencky strain and stored volume -> the same on or inside the yield surface, and whether it moved."""
        k = self.parameters[2]
        trace = e.sum() + v
        mean = trace / self.dim
        dev = e - e.sum() / self.dim
        size = dev.norm()
        moved = v != 0.0
        gain = 0.0
        result = dev + mean
        if trace >= 0.0:
            result = e * 0.0
            gain = trace
            moved = True
        elif size + k * trace > 0.0:
            result = dev * (-k * trace / size) + mean
            moved = True
        return result, gain, moved

    @ti.func
    def stress(self, e):
        """Principal Kirchhoff stress 2 mu e_i + lambda tr e."""
        return 2.0 * self.parameters[1] * e + self.parameters[0] * e.sum()

    @ti.func
    def principal(self, values):
        """Hencky strain log(sigma_i) = log(1 + beta_i) / 2 of the eigenvalues beta of b - I."""
        e = values
        for i in ti.static(range(self.dim)):
            e[i] = 0.5 * log1p(ti.max(values[i], -0.999999))
        return e

    @ti.func
    def kirchhoff(self, p, gradient_dt):
        """Trial b <- (I + dt grad v) b (I + dt grad v)^T, return map, Kirchhoff stress."""
        tau = ti.Matrix.zero(ti.f32, self.dim, self.dim)
        if ti.static(self.dim == 2):
            trial = pack2(push_forward(unpack2(self.b[p]), gradient_dt))
            values, frame = decompose2(trial)
            e, gain, moved = self.return_map(self.principal(values), self.v[p])
            tau = unpack2(assemble2(self.stress(e), frame))
            if moved:
                trial = assemble2(ti.Vector([expm1(2.0 * e[0]), expm1(2.0 * e[1])]), frame)
            self.b[p], self.v[p] = trial, gain
        else:
            trial = pack3(push_forward(unpack3(self.b[p]), gradient_dt))
            values, frame = decompose3(trial)
            e, gain, moved = self.return_map(self.principal(values), self.v[p])
            tau = unpack3(assemble3(self.stress(e), frame))
            if moved:
                trial = assemble3(ti.Vector([expm1(2.0 * e[0]), expm1(2.0 * e[1]), expm1(2.0 * e[2])]), frame)
            self.b[p], self.v[p] = trial, gain
        return tau

    @ti.func
    def energy_density(self, p):
        """psi = mu e : e + lambda / 2 (tr e)^2."""
        e = ti.Vector.zero(ti.f32, self.dim)
        if ti.static(self.dim == 2):
            values, frame = decompose2(self.b[p])
            e = self.principal(values)
        else:
            values, frame = decompose3(self.b[p])
            e = self.principal(values)
        return self.parameters[1] * e.norm_sqr() + 0.5 * self.parameters[0] * e.sum() ** 2

    @ti.func
    def wave_speed(self, p):
        """sqrt((lambda + 2 mu) / rho)."""
        return ti.sqrt((self.parameters[0] + 2.0 * self.parameters[1]) / self.parameters[3])

    @ti.func
    def intact(self, p):
        det = 0.0
        if ti.static(self.dim == 2):
            det = (unpack2(self.b[p]) + ti.Matrix.identity(ti.f32, 2)).determinant()
        else:
            det = (unpack3(self.b[p]) + ti.Matrix.identity(ti.f32, 3)).determinant()
        return finite(det + self.v[p]) and det > 0.0
