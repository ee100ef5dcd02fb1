"""Return map: Drucker-Prager sand on single particles at yield, |s1 - s2| = sin(phi) |s1 + s2| (2D, Mohr-Coulomb)."""

import time

import numpy as np

from sim.mpm.materials.sand import SandModel
from sim.scene import Sand
from sim.taichi_runtime import start_taichi, ti
from sim.validation import Curve, Outcome

NUMBER = 2
#: Random strains an angle.
RESOLUTIONS = (100, 1000, 10000)
ANGLES = np.arange(5.0, 86.0, 5.0)


@ti.data_oriented
class _Particles:
    def __init__(self, n: int):
        self.sand, self.n = SandModel(2, n, False), n

    @ti.kernel
    def strain(self, gradient: ti.types.ndarray(ti.f32, 3), tau: ti.types.ndarray(ti.f32, 3)):
        for p in range(self.n):
            self.sand.reset(p)
            G = ti.Matrix([[gradient[p, 0, 0], gradient[p, 0, 1]], [gradient[p, 1, 0], gradient[p, 1, 1]]])
            T = self.sand.kirchhoff(p, G, 1.0)
            for i, j in ti.static(ti.ndrange(2, 2)):
                tau[p, i, j] = T[i, j]


def run(resolution: int) -> Outcome:
    """Strains pressed by up to 10 % with shears that yield. Error: the largest distance of |s1 - s2| / |s1 + s2| from sin(phi)."""
    start_taichi()
    particles, rng = _Particles(resolution), np.random.default_rng(0)
    G = rng.normal(size=(resolution, 2, 2)) * 0.1
    G += np.eye(2) * (-rng.uniform(0.01, 0.1, (resolution, 1, 1)) - np.trace(G, axis1=1, axis2=2)[:, None, None] / 2)
    G, tau = np.ascontiguousarray(G, np.float32), np.zeros((resolution, 2, 2), np.float32)
    F = np.eye(2) + G.astype(float)
    values = 0.5 * np.log(np.linalg.eigvalsh(F @ F.transpose(0, 2, 1)))
    ours, worst, seconds = [], 0.0, 0.0
    for phi in ANGLES:
        material = Sand(model="sand", young_modulus=1e5, friction_angle=phi)
        numbers = SandModel.numbers(material, 2, 1.0)
        particles.sand.parameters.from_numpy(np.array(numbers, np.float32))
        begun = time.perf_counter()
        particles.strain(G, tau)
        seconds += time.perf_counter() - begun
        # Those that yield: the trial strain lies outside the cone, not stretched.
        size, trace = np.abs(values[:, 1] - values[:, 0]) / np.sqrt(2), values.sum(1)
        yields = (trace < -1e-3) & (size > -1.01 * numbers[3] * trace)
        s = np.linalg.eigvalsh(tau[yields].astype(float))
        ratio = (s[:, 1] - s[:, 0]) / np.abs(s.sum(1))
        ours.append(ratio.mean() if len(ratio) else np.nan)
        worst = max(worst, float(np.abs(ratio - np.sin(np.radians(phi))).max()) if len(ratio) else np.inf)
    curve = Curve("largest error of |s1 - s2| / |s1 + s2|", ("friction angle [degrees]", "|s1 - s2| / |s1 + s2|"), ANGLES,
                  np.sin(np.radians(ANGLES)), np.array(ours), worst, 1e-4)  # fmt: skip
    return Outcome("return_map", resolution, resolution, {"angle": curve}, seconds)
