"""Particles of one material without a grid, for tests of constitutive models."""

import numpy as np

from sim.taichi_runtime import ti

array1, array3 = ti.types.ndarray(ti.f32, 1), ti.types.ndarray(ti.f32, 3)


@ti.data_oriented
class Experiments:
    """n particles, each an experiment of its own: prescribed velocity gradients in, stresses out."""

    def __init__(self, model, dim, n, *options):
        self.model, self.dim, self.n = model(dim, n, *options), dim, n
        self.tau = np.zeros((n, dim, dim), np.float32)
        self.energy, self.speed, self.intact = (np.zeros(n, np.float32) for _ in range(3))

    def set(self, material):
        self.model.parameters.from_numpy(np.array(self.model.numbers(material, self.dim, 1.0), np.float32))

    def strain(self, gradient, dt=1.0):
        """One step with these [n, dim, dim] gradients times dt; returns tau [n, dim, dim] in float64."""
        self.step(np.ascontiguousarray(gradient, np.float32), dt, self.tau, self.energy, self.speed, self.intact)
        return self.tau.astype(float)

    @ti.kernel
    def step(self, gradient: array3, dt: ti.f32, tau: array3, energy: array1, speed: array1, intact: array1):
        for p in range(self.n):
            G = ti.Matrix.zero(ti.f32, self.dim, self.dim)
            for i, j in ti.static(ti.ndrange(self.dim, self.dim)):
                G[i, j] = gradient[p, i, j]
            stress = self.model.kirchhoff(p, G, dt)
            for i, j in ti.static(ti.ndrange(self.dim, self.dim)):
                tau[p, i, j] = stress[i, j]
            energy[p], speed[p] = self.model.energy_density(p), self.model.wave_speed(p)
            intact[p] = ti.cast(self.model.intact(p), ti.f32)

    @ti.kernel
    def reset(self):
        for p in range(self.n):
            self.model.reset(p)
