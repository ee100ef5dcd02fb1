"""Rigid matter: no stress and no deformation; its particles move as ``sim.mpm.rigid`` says."""

from sim.taichi_runtime import ti


@ti.data_oriented
class RigidModel:
    """Mass and velocity on the grid, nothing else."""

    left_out = {"deformation of rigid bodies": "particles follow the body's position and rotation"}

    def __init__(self, dim: int, capacity: int):
        self.dim = dim
        self.parameters = ti.field(ti.f32, 1)  # density, for readers: masses come with the particles

    @staticmethod
    def state(dim: int) -> dict[str, int]:
        """Per-particle state: name -> floats."""
        return {}

    @staticmethod
    def options(material) -> tuple:
        """What is compiled in: nothing but the model."""
        return ()

    @staticmethod
    def rest_wave_speed(material, stiffness: float) -> float:
        """No waves: bodies are moved, not integrated, whatever their time step."""
        return 0.0

    @staticmethod
    def omissions(material) -> dict[str, str]:
        """What the numbers of this material leave out: nothing."""
        return {}

    @staticmethod
    def rings(material) -> bool:
        """Whether a particle alone on the grid resists both ways, and so is an oscillator."""
        return False

    @staticmethod
    def largest_step(material, dim: int, dx: float) -> float:
        """No bound on the time step beside the Courant number's."""
        return float("inf")

    def fields(self) -> list:
        """Per-particle state fields."""
        return []

    @staticmethod
    def numbers(material, dim: int, stiffness: float) -> tuple[float, ...]:
        """What ``parameters`` holds."""
        return (material.density,)

    @ti.func
    def reset(self, p):
        """A body has no state a particle."""
        pass

    @ti.func
    def kirchhoff(self, p, gradient_dt, dt):
        return ti.Matrix.zero(ti.f32, self.dim, self.dim)

    @ti.func
    def energy_density(self, p):
        return 0.0

    @ti.func
    def wave_speed(self, p):
        return 0.0

    @ti.func
    def intact(self, p):
        return True
