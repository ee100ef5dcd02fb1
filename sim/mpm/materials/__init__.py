"""Constitutive models, one small file each.

A material owns the state its particles need and nothing else. It offers Taichi functions on particle p:
``kirchhoff(p, gradient_dt, dt)`` advances the state by the velocity gradient times dt and returns the Kirchhoff stress tau
[dim, dim]; ``energy_density(p)`` is the elastic energy per reference volume; ``wave_speed(p)`` bounds the local sound speed;
``intact(p)`` says that the state is finite and its volume positive.
Numbers live in a field, not in the code, so that scenes which differ in numbers share compiled kernels.
On the host it says what it is: ``state``, ``fields``, ``numbers``, ``options`` (what is compiled in), ``left_out`` (by the model)
and ``omissions`` (by the numbers), ``rest_wave_speed``, and two bounds on dt beside the Courant number's: ``largest_step``, ``rings``.
"""

from typing import Any

from sim.mpm.materials.elastic import ElasticModel
from sim.mpm.materials.goop import GoopModel
from sim.mpm.materials.rigid import RigidModel
from sim.mpm.materials.sand import SandModel
from sim.mpm.materials.snow import SnowModel
from sim.mpm.materials.water import WaterModel

#: name -> class. Any: a contract of Taichi functions, which no protocol describes.
MODELS: dict[str, Any] = {"water": WaterModel, "sand": SandModel, "goop": GoopModel, "elastic": ElasticModel, "snow": SnowModel, "rigid": RigidModel}
