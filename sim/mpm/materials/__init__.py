"""Constitutive models, one small file each.

A material owns the state its particles need and nothing else. It offers Taichi functions on particle p:
``kirchhoff(p, gradient_dt)`` advances the state by the velocity gradient times dt and returns the Kirchhoff stress tau
[dim, dim]; ``energy_density(p)`` is the elastic energy per reference volume; ``wave_speed(p)`` bounds the local sound speed;
``intact(p)`` says that the state is finite and its volume positive.
Numbers live in a field, not in the code, so that scenes which differ in numbers share compiled kernels.
"""

from sim.mpm.materials.rigid import RigidModel
from sim.mpm.materials.sand import SandModel
from sim.mpm.materials.water import WaterModel

MODELS = {"water": WaterModel, "sand": SandModel, "rigid": RigidModel}
