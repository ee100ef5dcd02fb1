"""Scenes: what a trajectory is made of. A *family* (a YAML file with sampling ranges) and a seed give one resolved scene.

Units are SI on a box of about one metre unless a file says otherwise. Random numbers come from NumPy's ``Generator``, never
from a solver. Decision: the grid is given in cells along the box and the particle spacing in particles per cell, so that a
wall always lies on a grid node and mass is exact; lengths that would have to agree with each other cannot disagree.
"""

from __future__ import annotations

import copy
import dataclasses
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError, model_serializer, model_validator
from scipy.spatial import ConvexHull, cKDTree

from sim.container import Container, ContainerFamily
from sim.errors import InputError
from sim.fields import Finite, Friction, Positive, Range, entries
from sim.fields import Strict as _Strict
from sim.fields import mistake as _mistake
from sim.fields import sample as _sample
from sim.obstacles import Obstacle, ObstacleFamily, boundary_particles, combine, outside, within
from sim.trajectory import KINEMATIC_TYPE, PARTICLE_TYPES

if TYPE_CHECKING:
    from sim.simulator import Start

#: Names of the splits, in the order that seeds count them.
SPLITS = ("train", "valid", "test")

_TRIES = 2000
#: More particles than this in one body are a slip of the keyboard, and would exhaust the memory before anything could say so.
_MOST_PARTICLES = 100_000_000


def _only(low: float, high: float, remedy: str) -> AfterValidator:
    """low <= value < high, or an error with this remedy."""

    def check(value: float) -> float:
        if not low <= value < high:
            raise _mistake("", value, remedy)
        return value

    return AfterValidator(check)


#: Shear yield stress, cohesion or viscosity: from nothing to more than any particle will feel, but within float32.
_Resistance = Annotated[Finite, _only(0, 1e30, "must not be negative, nor 1e30 or more (0 means none)")]


_PoissonRatio = Annotated[Finite, _only(0, 0.5, "must lie in 0 .. 0.4999: at 1/2 a solid is incompressible and its wave speed infinite")]


class Water(_Strict):
    """Weakly compressible water, Tait pressure p = (rho0 c^2 / gamma) (J^-gamma - 1) (Batchelor 1967; Monaghan 1994, eq. 3).

    viscosity [Pa s]: dynamic, at reference density. An incompressible solver (``Incompressible``) has no use for the speed of sound [m/s]; the
    others need it."""

    model: Literal["water"]
    density: Positive = 1000.0
    sound_speed: Positive | None = None
    gamma: Annotated[float, Field(ge=1, le=10)] = 7.0
    viscosity: _Resistance = 0.0


class _Solid(_Strict):
    """density [kg/m^3], young_modulus [Pa]."""

    density: Positive
    young_modulus: Positive
    poisson_ratio: _PoissonRatio = 0.3


class Sand(_Solid):
    """Drucker-Prager sand on Hencky strain (Klar et al. 2016). friction_angle [degrees], cohesion [Pa]."""

    model: Literal["sand"]
    density: Positive = 1800.0
    friction_angle: Annotated[Finite, _only(0, 90, "must lie in 0 .. 89 degrees: at 90 no slope would ever yield")]
    cohesion: _Resistance = 0.0

    @model_validator(mode="after")
    def _has_a_tip(self) -> Sand:
        if self.cohesion and self.friction_angle < 1:
            raise _mistake("cohesion", self.cohesion, "needs a friction_angle of at least 1 degree, lest it carry any tension; use goop for less")
        return self


class Goop(_Solid):
    """Von Mises viscoplastic goop on Hencky strain (Simo & Hughes 1998). yield_stress [Pa]: in shear, 0 is a fluid; viscosity [Pa s]."""

    model: Literal["goop"]
    density: Positive = 1000.0
    yield_stress: _Resistance
    viscosity: _Resistance = 0.0


class Elastic(_Solid):
    """Neo-Hookean rubber (Bonet & Wood 2008)."""

    model: Literal["elastic"]
    density: Positive = 1000.0


class Snow(_Solid):
    """Hardening snow (Stomakhin et al. 2013, table 2): singular values are held in [1 - critical_compression, 1 + critical_stretch]."""

    model: Literal["snow"]
    density: Positive = 400.0
    young_modulus: Positive = 1.4e5
    poisson_ratio: _PoissonRatio = 0.2
    critical_compression: Annotated[float, Field(gt=0, lt=1)] = 0.025
    critical_stretch: Annotated[float, Field(gt=0, le=1)] = 0.0075
    hardening: Annotated[float, Field(ge=0, le=30)] = 10.0


class Rigid(_Strict):
    """Bodies that keep their shape exactly and move by the forces of everything around them."""

    model: Literal["rigid"]
    density: Positive


Material = Annotated[Water | Sand | Goop | Elastic | Snow | Rigid, Field(discriminator="model")]


class BoxShape(_Strict):
    """A box with edges ``size`` (one range per axis), rounded to whole particle spacings."""

    kind: Literal["box"]
    size: list[Range]


class BallShape(_Strict):
    """A disc (2D) or ball (3D)."""

    kind: Literal["ball"]
    radius: Range


class PolygonShape(_Strict):
    """A random convex polygon (2D): the hull of ``corners`` points at random angles on a circle of radius ``radius``."""

    kind: Literal["polygon"]
    radius: Range
    corners: tuple[Annotated[int, Field(ge=3)], Annotated[int, Field(ge=3, le=64)]] = (4, 8)


class BodyFamily(_Strict):
    """``count`` bodies of one material. ``center`` defaults to anywhere in the box where the body fits."""

    material: str
    shape: Annotated[BoxShape | BallShape | PolygonShape, Field(discriminator="kind")]
    count: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0, le=64)]] = (1, 1)
    center: list[Range] | None = None
    velocity: list[Range] | None = None


#: A face of the box: axis and side, as in ``y-`` for the floor of a 2D scene.
Face = Literal["x-", "x+", "y-", "y+", "z-", "z+"]


class Walls(_Strict):
    """Separating walls with Coulomb friction: 0 is free slip, ``sticky`` holds everything that touches.

    velocity [m/s]: of walls that slide in their own plane and, being sticky, drag water along (SPH)."""

    friction: Friction = 0.0
    velocity: dict[Face, list[Finite]] = {}

    @model_serializer(mode="wrap")
    def _without_what_is_absent(self, handler) -> dict:
        content = handler(self)
        return content if content.get("velocity") else {key: value for key, value in content.items() if key != "velocity"}


class MaterialPoints(_Strict):
    """MLS-MPM, the default (``sim.mpm``)."""

    method: Literal["mpm"]


#: Radius of the SPH kernel, in particle spacings.
_Support = Annotated[Finite, _only(1.5, 4.0, "must lie in 1.5 .. 4 particle spacings: below it neighbours are missed, above it the kernel smears")]


class WeaklyCompressible(_Strict):
    """Weakly compressible SPH (``sim.sph.wcsph``).

    support [particle spacings]; artificial_viscosity: Monaghan's alpha; density_diffusion: delta; shifting: particles are kept evenly spread,
    which is what lets water bear tension where it is not at a free surface; without it, no pressure is negative."""

    method: Literal["wcsph"]
    support: _Support = 2.5
    artificial_viscosity: Annotated[float, Field(ge=0, le=1)] = 0.02
    density_diffusion: Annotated[float, Field(ge=0, le=1)] = 0.1
    shifting: bool = True


class Incompressible(_Strict):
    """Divergence-free SPH (``sim.sph.dfsph``).

    support [particle spacings]; density_error, divergence_error: mean error at which a solve ends, relative density (over a step);
    iterations of a solve at most; xsph: share of the neighbours' mean velocity that a particle takes on in every step. Without any, the noise of
    particles that jostle under pressure stays in water at rest: 2e-5 of rho g H V (hydrostatics, 32 cells), with 0.05 a fifth of that."""

    method: Literal["dfsph"]
    support: _Support = 2.0
    density_error: Annotated[float, Field(gt=0, le=0.1)] = 5e-4
    divergence_error: Annotated[float, Field(gt=0, le=0.1)] = 1e-3
    iterations: Annotated[int, Field(ge=1, le=10_000)] = 100
    xsph: Annotated[float, Field(ge=0, lt=1)] = 0.05


class PositionBased(_Strict):
    """Position-based fluid and rigid bodies (``sim.pbd.solver``).

    support [particle spacings]; substeps of a frame at least (FleX takes two); density_error: mean error, relative density, at which a solve ends;
    iterations of a solve at most; xsph: share of the neighbours' mean velocity that a particle takes on in every step (0.01 as published);
    tensile: strength of s_corr, which parts pairs that are closer than the spacing: at 0.01 the closest of water at rest are 0.89 of it apart instead
    of 0.77, above 0.02 it does not come to rest."""

    method: Literal["pbf"]
    support: _Support = 2.0
    substeps: Annotated[int, Field(ge=1, le=1000)] = 2
    density_error: Annotated[float, Field(gt=0, le=0.1)] = 5e-4
    iterations: Annotated[int, Field(ge=1, le=10_000)] = 1000
    xsph: Annotated[float, Field(ge=0, lt=1)] = 0.01
    tensile: Annotated[float, Field(ge=0, le=0.02)] = 0.01


Solver = Annotated[MaterialPoints | WeaklyCompressible | Incompressible | PositionBased, Field(discriminator="method")]


class Splits(_Strict):
    """Trajectories of each split, where a command does not say how many."""

    train: Annotated[int, Field(ge=0)]
    valid: Annotated[int, Field(ge=0)]
    test: Annotated[int, Field(ge=0)]


class _Physics(_Strict):
    """What a family and a resolved scene share."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    dim: Literal[2, 3]
    bounds: list[tuple[Finite, Finite]]
    gravity: list[Finite]
    frame_step: Positive
    frames: Annotated[int, Field(ge=2, le=1_000_000)]
    radius: Positive
    cells: list[Annotated[int, Field(ge=4, le=4096)]]
    particles_per_cell: Annotated[int, Field(ge=1, le=4)] = 2
    refine: Annotated[int, Field(ge=1, le=8)] = 1
    jitter: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    cfl: Annotated[float, Field(gt=0, le=4)] = 0.4
    #: Fixed length of a substep [s], for runs that must share one; absent: as long as the limits allow, frame by frame.
    time_step: Positive | None = None
    walls: Walls = Walls()
    solver: Solver = MaterialPoints(method="mpm")
    #: Axes along which the box repeats itself ("x", ...), without walls there (SPH).
    periodic: list[Literal["x", "y", "z"]] = []
    materials: dict[str, Material]
    #: Material numbers ("material.key") that every frame's context repeats, after the container's acceleration if there is one.
    context: list[str] = []

    @model_serializer(mode="wrap")
    def _without_what_is_absent(self, handler) -> dict:
        """A scene without time step, obstacles, container, periodic axis or context, for the default solver, reads as if there were no such thing."""
        content = handler(self)
        absent = {key for key in ("time_step", "obstacles", "container", "context", "periodic") if not content.get(key)}
        if self.solver.method == "mpm":
            absent.add("solver")
        return {key: value for key, value in content.items() if key not in absent}

    @property
    def grid_spacing(self) -> float:
        """Edge of a grid cell of the *recorded* resolution; the teacher's is this over ``refine``."""
        return (self.bounds[0][1] - self.bounds[0][0]) / self.cells[0]

    @property
    def spacing(self) -> float:
        """Spacing of the recorded particles; the teacher's is this over ``refine``."""
        return self.grid_spacing / self.particles_per_cell

    @model_validator(mode="after")
    def _consistent(self) -> _Physics:
        for key in ("bounds", "gravity", "cells"):
            if len(getattr(self, key)) != self.dim:
                raise _mistake(key, getattr(self, key), f"needs {self.dim} entries, one per axis")
        for axis, (lower, upper) in enumerate(self.bounds):
            if not lower < upper:
                raise _mistake(f"bounds[{axis}]", [lower, upper], "lower must be below upper")
        edges = [(upper - lower) / cells for (lower, upper), cells in zip(self.bounds, self.cells, strict=True)]
        if max(edges) > min(edges) * (1 + 1e-6):
            square = [max(4, round((upper - lower) / edges[0])) for lower, upper in self.bounds]
            raise _mistake("cells", self.cells, f"cells must be square (edges {[round(edge, 6) for edge in edges]}); try {square}")
        if self.radius < self.spacing:
            remedy = f"below the particle spacing {self.spacing:.6g}: no particle would have a neighbour; use at least {1.5 * self.spacing:.4g}"
            raise _mistake("radius", self.radius, remedy)
        if self.time_step is not None:
            steps = max(1, int(np.ceil(self.frame_step / self.time_step - 1e-6)))
            if abs(steps * self.time_step - self.frame_step) > 1e-6 * self.frame_step:
                remedy = f"must divide frame_step {self.frame_step:g}; {self.frame_step / steps:.8g} does, in {steps} steps"
                raise _mistake("time_step", self.time_step, remedy)
        if not self.materials:
            raise _mistake("materials", {}, "name at least one material")
        for name, material in self.materials.items():
            if self.dim == 3 and isinstance(material, Sand) and material.friction_angle > 36.9:
                remedy = "a compression-matched Drucker-Prager cone cannot yield in triaxial extension above 36.9 degrees in 3D; use less"
                raise _mistake(f"materials.{name}.friction_angle", material.friction_angle, remedy)
        self._check_solver()
        for index, entry in enumerate(self.context):
            name, _, key = entry.partition(".")
            if not isinstance(getattr(self.materials.get(name), key, None), float):
                raise _mistake(f"context[{index}]", entry, "must be material.key with a number in it, as in sand.friction_angle")
        return self

    def _check_solver(self) -> None:
        """What the chosen solver cannot do, or needs."""
        method = self.solver.method
        if method == "pbf":
            return self._check_position_based()
        axes = "xyz"[: self.dim]
        for index, axis in enumerate(self.periodic):
            if method == "mpm" or axis not in axes or axis in self.periodic[:index]:
                remedy = f"must name each of {list(axes)} at most once"
                if method == "mpm":
                    remedy = "MPM has no periodic boxes; choose solver.method wcsph or dfsph"
                raise _mistake(f"periodic[{index}]", axis, remedy)
        for face, velocity in self.walls.velocity.items():
            across = "xyz".index(face[0])
            where = f"walls.velocity.{face}"
            if method == "mpm" or self.walls.friction != "sticky":
                remedy = "only sticky walls of SPH scenes drag water along; set walls.friction: sticky and solver.method wcsph or dfsph"
                raise _mistake(where, velocity, remedy)
            if across >= self.dim or face[0] in self.periodic or len(velocity) != self.dim or velocity[across] != 0:
                raise _mistake(where, velocity, f"must be the velocity of a wall of this box, {self.dim} entries, none through the wall itself")
        if method != "mpm" and self.walls.friction not in (0, "sticky"):
            raise _mistake("walls.friction", self.walls.friction, "SPH walls slip (0) or hold viscous water (sticky); MPM has Coulomb friction")
        for index, obstacle in enumerate(getattr(self, "obstacles", [])):
            if method != "mpm" and obstacle.friction not in (None, self.walls.friction):
                remedy = "in SPH scenes obstacles slip or hold water as the walls do; leave it out"
                raise _mistake(f"obstacles[{index}].friction", obstacle.friction, remedy)
        waters = [name for name, material in self.materials.items() if isinstance(material, Water)]
        if method != "mpm" and not waters and all(isinstance(material, Rigid) for material in self.materials.values()):
            raise _mistake("materials", list(self.materials), "SPH moves water, and rigid bodies in it; add water, or choose another solver.method")
        for name, material in self.materials.items():
            if method != "mpm" and material.model not in ("water", "rigid"):
                raise _mistake(f"materials.{name}.model", material.model, "SPH moves water and rigid bodies; MPM (leave solver out) all materials")
            if method != "mpm" and name in waters[1:]:
                raise _mistake(f"materials.{name}.model", "water", f"SPH scenes hold one kind of water, here {waters[0]}; leave one out")
            if method in ("mpm", "wcsph") and isinstance(material, Water) and material.sound_speed is None:
                raise _mistake(f"materials.{name}.sound_speed", None, f"missing, and {method} needs it: at least ten times the largest speed")

    def _check_position_based(self) -> None:
        if self.periodic:
            raise _mistake("periodic", self.periodic, "position-based scenes have walls all around; leave it out or choose solver.method dfsph")
        if self.walls.friction != 0 or self.walls.velocity:
            key = "friction" if self.walls.friction != 0 else "velocity"
            raise _mistake(f"walls.{key}", getattr(self.walls, key), "position-based walls slip and stand still; leave it out")
        if obstacles := getattr(self, "obstacles", []):
            kinds = [obstacle.kind for obstacle in obstacles]
            raise _mistake("obstacles", kinds, "position-based scenes have none; leave it out or choose solver.method dfsph")
        waters = [name for name, material in self.materials.items() if material.model == "water"]
        for name, material in self.materials.items():
            where = f"materials.{name}"
            if material.model not in ("water", "rigid"):
                remedy = "position-based scenes hold water and rigid bodies; MPM (leave solver out) all materials"
                raise _mistake(f"{where}.model", material.model, remedy)
            if name in waters[1:]:
                raise _mistake(f"{where}.model", "water", f"position-based scenes hold one kind of water, here {waters[0]}; leave one out")
            if isinstance(material, Water) and material.viscosity:
                remedy = "position-based water has none but solver.xsph; use 0, or solver.method dfsph"
                raise _mistake(f"{where}.viscosity", material.viscosity, remedy)


class _FamilyModel(_Physics):
    bodies: list[BodyFamily]
    obstacles: list[ObstacleFamily] = []
    container: ContainerFamily | None = None
    splits: Splits
    variants: dict[str, dict[str, Any]] = {}

    @model_validator(mode="after")
    def _bodies_fit(self) -> _FamilyModel:
        if not self.bodies or all(body.count[1] == 0 for body in self.bodies):
            raise _mistake("bodies", [], "an empty scene: add at least one body")
        for index, obstacle in enumerate(self.obstacles):
            obstacle.check(f"obstacles[{index}]", self.dim, self.grid_spacing)
        if self.container is not None:
            self.container.check(self.dim)
        for index, body in enumerate(self.bodies):
            where = f"bodies[{index}]"
            if body.material not in self.materials:
                raise _mistake(f"{where}.material", body.material, f"not among materials {sorted(self.materials)}")
            if body.count[0] > body.count[1]:
                raise _mistake(f"{where}.count", list(body.count), "low must not exceed high")
            if isinstance(body.shape, PolygonShape) and self.dim != 2:
                raise _mistake(f"{where}.shape.kind", "polygon", "polygons are 2D; use box or ball")
            lists = {"center": body.center, "velocity": body.velocity, "shape.size": getattr(body.shape, "size", None)}
            scalars = {"shape.radius": getattr(body.shape, "radius", None), "shape.corners": getattr(body.shape, "corners", None)}
            for key, values in lists.items():
                if values is not None and len(values) != self.dim:
                    raise _mistake(f"{where}.{key}", values, f"needs {self.dim} entries, one per axis")
            entries = {f"{key}[{axis}]": value for key, values in lists.items() for axis, value in enumerate(values or [])}
            for key, value in (scalars | entries).items():
                low, high = value if isinstance(value, tuple) else (value, value)
                if value is not None and low > high:
                    raise _mistake(f"{where}.{key}", value, "low must not exceed high")
                if value is not None and key.startswith("shape") and key != "shape.corners" and low < self.spacing:
                    raise _mistake(f"{where}.{key}", value, f"must be at least one particle spacing ({self.spacing:.6g})")
        return self


def check_particles(name: str, particles: str | int) -> None:
    """Raise ``InputError`` unless this is a solver's setting ``particles``, see ``Scene.refinement``."""
    if particles not in ("teacher", "recorded") and not (type(particles) is int and particles > 0):
        raise InputError(name, "particles", particles, "must be teacher, recorded or how many times finer than those")


@dataclass(frozen=True)
class Particles:
    """position, velocity [n, dim] float64; material, body [n] (indices into the scene's materials and bodies), both one contiguous
    range a value; tracked: indices of the recorded ones."""

    position: np.ndarray
    velocity: np.ndarray
    material: np.ndarray
    body: np.ndarray
    tracked: np.ndarray
    spacing: float


class Body(_Strict):
    """A resolved body: ``kind`` box (lower, upper), ball (center, radius) or polygon (vertices)."""

    material: str
    kind: Literal["box", "ball", "polygon"]
    velocity: list[Finite]
    lower: list[Finite] | None = None
    upper: list[Finite] | None = None
    center: list[Finite] | None = None
    radius: Positive | None = None
    vertices: list[list[Finite]] | None = None

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the bounding box."""
        if self.kind == "box":
            return np.array(self.lower), np.array(self.upper)
        if self.kind == "ball":
            return np.array(self.center) - self.radius, np.array(self.center) + self.radius
        vertices = np.array(self.vertices)
        return vertices.min(0), vertices.max(0)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """[n] bool: which points [n, dim] lie in the body."""
        if self.kind == "box":
            return np.ones(len(points), bool)
        if self.kind == "ball":
            return ((points - np.array(self.center)) ** 2).sum(1) <= np.array(self.radius) ** 2
        equations = ConvexHull(self.vertices).equations
        return (points @ equations[:, :-1].T + equations[:, -1] <= 0).all(1)


class Scene(_Physics):
    """A fully resolved scene: nothing left to sample but the lattice jitter, which ``seed`` determines."""

    seed: Annotated[int, Field(ge=0)]
    bodies: list[Body]
    obstacles: list[Obstacle] = []
    container: Container | None = None

    @model_validator(mode="after")
    def _not_empty(self) -> Scene:
        if not self.bodies:
            raise _mistake("bodies", [], "an empty scene: add at least one body")
        for index, obstacle in enumerate(self.obstacles):
            obstacle.check(f"obstacles[{index}]", self.dim)
        return self

    def to_dict(self) -> dict:
        """Plain JSON, with the derived lengths beside the inputs for readers that are not this code."""
        return self.model_dump(mode="json") | {"spacing": self.spacing, "grid_spacing": self.grid_spacing}

    @classmethod
    def from_dict(cls, content: dict, where: object = "scene") -> Scene:
        """Inverse of ``to_dict``; raises ``InputError``."""
        content = {key: value for key, value in content.items() if key not in ("spacing", "grid_spacing")}
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise explain_validation(error, where) from None

    def particles(self, refine: int | None = None) -> Particles:
        """Lattice particles of all bodies, ``refine`` times finer per axis than the recorded ones (default: the teacher's).

        Packing: one recorded particle per cube of edge ``spacing``, mass density * spacing^dim. A body is the union of the
        lattice cubes whose centres lie in it, so its mass is the same at every refinement. The recorded particle of a cube
        is the central one of its refine^dim particles, or one of the 2^dim central ones drawn at random (unbiased) when
        ``refine`` is even. ``refine=1`` gives the recorded particles of the *same* layout: the same set in every rung. So does anything
        between 1 and the teacher's: a coarser lattice in the same cubes, where one of each cube's central particles is put where the teacher's is.
        """
        if refine not in (None, 1, self.refine):
            return self._between(refine)
        coarse = refine == 1
        k, dim, spacing = self.refine, self.dim, self.spacing
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, 1]))
        offsets = (np.stack(np.meshgrid(*[np.arange(k)] * dim, indexing="ij"), -1).reshape(-1, dim) + 0.5) / k - 0.5
        reach = np.abs(offsets).max(1)
        central = np.flatnonzero(reach <= reach.min() + 1e-9)
        parts = []
        names = list(self.materials)
        for index, body in enumerate(self.bodies):
            lower, upper = body.extent()
            counts = np.maximum(np.rint((upper - lower) / spacing).astype(int), 1)
            start = (lower + upper) / 2 - counts * spacing / 2
            cubes = start + (np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), -1).reshape(-1, dim) + 0.5) * spacing
            cubes = cubes[body.inside(cubes)]
            position = cubes[:, None] + offsets * spacing
            # A rigid body's particles are its shape: they stay on the lattice.
            jitter = 0.0 if isinstance(self.materials[body.material], Rigid) else self.jitter
            position = position + rng.uniform(-0.5, 0.5, position.shape) * jitter * spacing / k
            choice = central[rng.integers(len(central), size=len(cubes))]
            tracked = np.zeros(position.shape[:2], bool)
            tracked[np.arange(len(cubes)), choice] = True
            parts.append((position.reshape(-1, dim), tracked.ravel(), names.index(body.material), body.velocity, index))
        # Solvers loop over one contiguous range per material.
        parts.sort(key=lambda part: part[2])
        position = np.concatenate([part[0] for part in parts])
        tracked = np.concatenate([part[1] for part in parts])
        material = np.concatenate([np.full(len(part[0]), part[2]) for part in parts])
        bodies = np.concatenate([np.full(len(part[0]), part[4]) for part in parts])
        velocity = np.concatenate([np.tile(np.asarray(part[3], float), (len(part[0]), 1)) for part in parts])
        if coarse:
            position, velocity, material, bodies = position[tracked], velocity[tracked], material[tracked], bodies[tracked]
            tracked = np.ones(len(position), bool)
        return Particles(position, velocity, material, bodies, np.flatnonzero(tracked), spacing if coarse else spacing / k)

    def _between(self, refine: int) -> Particles:
        recorded, own = self.particles(refine=1), self.model_copy(update={"refine": refine}).particles()
        position = own.position.copy()
        position[own.tracked] = recorded.position
        return dataclasses.replace(own, position=position)

    @classmethod
    def of(cls, start: Start) -> Scene:
        """The scene a start is of. Raises ``InputError`` where its particles are not those of the file, in their order: another version's file."""
        scene = cls.from_dict(start.scene)
        if not np.array_equal(scene.particle_type(), start.particle_type):
            remedy = "its particles are in another order than the scene's: written by an earlier version; generate the data set again"
            raise InputError(scene.name, "particle_type", f"{len(start.particle_type)} particles", remedy)
        return scene

    def refinement(self, particles: Literal["teacher", "recorded"] | int) -> int:
        """How much finer than the recorded ones a solver's particles are, by its setting ``particles``. Raises ``InputError``."""
        if isinstance(particles, str):
            return self.refine if particles == "teacher" else 1
        if particles > self.refine:
            raise InputError(self.name, "particles", particles, f"finer than the teacher's, which are refined {self.refine} times; use teacher")
        return particles

    @cached_property
    def surfaces(self) -> list:
        """The obstacles as particles in the box meet them."""
        return within(self.obstacles, np.array(self.bounds))

    @cached_property
    def boundary(self) -> np.ndarray:
        """[k, dim] float64: the kinematic particles of the obstacles, at the recorded spacing."""
        return boundary_particles(self.surfaces, np.array(self.bounds), self.spacing) if self.obstacles else np.empty((0, self.dim))

    def start(self) -> np.ndarray:
        """[recorded particles, dim] float64 at frame 0: those that move, then the kinematic ones."""
        return np.concatenate([self.particles(refine=1).position, self.boundary])

    def particle_type(self) -> np.ndarray:
        """[recorded particles] int8, ids of ``PARTICLE_TYPES``, in the order of ``start``."""
        kinds = np.array([PARTICLE_TYPES[material.model] for material in self.materials.values()], np.int8)
        return np.concatenate([kinds[self.particles(refine=1).material], np.full(len(self.boundary), KINEMATIC_TYPE, np.int8)])

    def acceleration(self) -> np.ndarray:
        """[frames, dim] float64: what the box undergoes from each frame to the next, m/s^2; zero without a container."""
        if self.container is None:
            return np.zeros((self.frames, self.dim))
        return self.container.acceleration(self.frames, self.frame_step)

    def context_values(self) -> np.ndarray | None:
        """[frames, c] float32: the box's acceleration (dim columns) if it is shaken, then the numbers that ``context`` names; None for neither.

        Row k holds for the step from frame k to k + 1.
        """
        numbers = [getattr(self.materials[name], key) for name, _, key in (entry.partition(".") for entry in self.context)]
        columns = [self.acceleration()] if self.container is not None else []
        columns += [np.tile(numbers, (self.frames, 1))] if numbers else []
        return np.concatenate(columns, 1).astype(np.float32) if columns else None


class SceneFamily:
    """A validated scene file; ``sample(seed)`` draws a ``Scene``. Every mistake in it is an ``InputError``."""

    def __init__(self, content: dict, where: object, variant: str | None = None):
        self.where = where
        if not isinstance(content, dict):
            raise InputError(where, "file", content, "must be a mapping of keys to values")
        variants = content.get("variants") or {}
        if variant is not None:
            if not isinstance(variants, dict) or not isinstance(variants.get(variant), dict):
                raise InputError(where, "variant", variant, f"not among the variants {sorted(variants)}")
            content = _merged(content, variants[variant])
            content["name"] = f"{content.get('name')}-{variant}"
        content, self.spreads = _without_spreads(content, where)
        self.model = self._validated(content)
        for (name, key), spread in self.spreads.items():
            for value in {end for ranges in spread.values() for ends in ranges for end in ends}:
                self._validated(_merged(content, {"materials": {name: {key: value}}}))
        folder = Path(str(where)).parent
        self._meshes = {
            index: obstacle.read(folder, where, f"obstacles[{index}]")
            for index, obstacle in enumerate(self.model.obstacles)
            if obstacle.kind == "mesh"
        }

    def _validated(self, content: dict) -> _FamilyModel:
        try:
            return _FamilyModel.model_validate(content)
        except ValidationError as error:
            raise explain_validation(error, self.where) from None

    @classmethod
    def load(cls, path: str | Path, variant: str | None = None) -> SceneFamily:
        """Read a family from YAML; every mistake is an ``InputError`` naming file, key, value and remedy."""
        return cls(read_yaml(path), path, variant)

    def to_dict(self) -> dict:
        """Plain JSON, of which another family can be made."""
        content = self.model.model_dump(mode="json")
        for (name, key), spread in self.spreads.items():
            content["materials"][name][key] = {split: [list(ends) for ends in ranges] for split, ranges in spread.items()}
        return content

    def sample(self, seed: int, split: str = "train") -> Scene:
        """Draw one scene of a split (they differ where a material number's ranges do). Bodies and obstacles are placed by rejection
        until they lie inside the box and bodies apart from each other and from obstacles. Raises ``InputError`` where that cannot be done."""
        model = self.model
        rng = np.random.default_rng(np.random.SeedSequence([seed, 0]))
        shared = {name: getattr(model, name) for name in _Physics.model_fields}
        # Streams of their own: a family that gains a range or a container keeps its bodies.
        spread_rng = np.random.default_rng(np.random.SeedSequence([seed, 3]))
        for (name, key), spread in self.spreads.items():
            drawn = shared["materials"][name].model_copy(update={key: _draw(spread[split], spread_rng)})
            shared["materials"] = shared["materials"] | {name: drawn}
        if model.container is not None:
            shared["container"] = model.container.draw(np.random.default_rng(np.random.SeedSequence([seed, 4])))
        solids = [index for index, solid in enumerate(model.obstacles) for _ in range(int(rng.integers(solid.count[0], solid.count[1] + 1)))]
        chosen = [index for index, body in enumerate(model.bodies) for _ in range(int(rng.integers(body.count[0], body.count[1] + 1)))]
        if not chosen:
            chosen = [0]
        reason = ("bodies", "outside the box")
        for _ in range(_TRIES):
            bodies: list[Body] = []
            obstacles, misplaced = self._obstacles(solids, rng)
            if misplaced:
                reason = misplaced
                continue
            for index in chosen:
                body = self._place(model.bodies[index], rng)
                fault = self._fault(body, bodies, obstacles)
                if fault:
                    reason = (f"bodies[{index}]", fault)
                    break
                bodies.append(body)
            else:
                return Scene(seed=seed, bodies=bodies, obstacles=obstacles, **shared)
        remedy = f"{reason[1]} in each of {_TRIES} draws; make it smaller, move its center or allow fewer bodies"
        raise InputError(self.where, reason[0], f"seed {seed}", remedy)

    def _obstacles(self, chosen: list[int], rng: np.random.Generator) -> tuple[list, tuple[str, str] | None]:
        """Obstacles of the chosen families, or the first fault (key, why)."""
        bounds = np.array(self.model.bounds)
        placed: list[Obstacle] = []
        for index in chosen:
            solid = self.model.obstacles[index]
            obstacle = solid.place_mesh(bounds, rng, self._meshes[index]) if solid.kind == "mesh" else solid.place(bounds, rng)
            fault = outside(obstacle, getattr(solid, "center", 0) is None and getattr(solid, "vertices", None) is None, bounds)
            if fault:
                return placed, (f"obstacles[{index}]", fault)
            placed.append(obstacle)
        return placed, None

    def _place(self, family: BodyFamily, rng: np.random.Generator) -> Body:
        model, shape, spacing = self.model, family.shape, self.model.spacing
        lower, upper = np.array(model.bounds).T
        outline: np.ndarray | None = None
        if shape.kind == "box":
            half = np.array([max(1, round(_sample(edge, rng) / spacing)) * spacing for edge in shape.size]) / 2
        else:
            radius = _sample(shape.radius, rng)
            half = np.full(model.dim, radius)
            if shape.kind == "polygon":
                angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(shape.corners[0], shape.corners[1] + 1))))
                outline = radius * np.stack([np.cos(angles), np.sin(angles)], -1)
        if family.center is None:
            room = np.maximum(upper - lower - 2 * half, 0)
            center = lower + half + rng.uniform(size=model.dim) * room
        else:
            center = np.array([_sample(value, rng) for value in family.center])
        velocity = [_sample(value, rng) for value in family.velocity] if family.velocity else [0.0] * model.dim
        common: dict[str, Any] = {"material": family.material, "kind": shape.kind, "velocity": velocity}
        if shape.kind == "box":
            return Body(lower=(center - half).tolist(), upper=(center + half).tolist(), **common)
        if shape.kind == "ball":
            return Body(center=center.tolist(), radius=radius, **common)
        return Body(vertices=(center + outline).tolist(), **common)

    def _fault(self, body: Body, others: list[Body], obstacles: list) -> str | None:
        model = self.model
        lower, upper = np.array(model.bounds).T
        low, high = body.extent()
        if (low < lower - 1e-9).any() or (high > upper + 1e-9).any():
            return "outside the box"
        particles = float(np.prod((high - low) / model.spacing + 1)) * model.refine**model.dim
        if particles > _MOST_PARTICLES:
            remedy = f"a body would hold {particles:.1g} particles; use fewer cells, particles_per_cell or refine"
            raise InputError(self.where, "cells", model.cells, remedy)
        if not len(_cube_centers(body, model.spacing)):
            return "too thin to hold a particle"
        if obstacles and combine(obstacles, _cube_centers(body, model.spacing))[0].min() < model.spacing / 2:
            return "overlapping an obstacle"
        for other in others:
            other_low, other_high = other.extent()
            if (low < other_high + model.spacing).all() and (other_low < high + model.spacing).all():
                distance = cKDTree(_cube_centers(other, model.spacing)).query(_cube_centers(body, model.spacing))[0]
                if distance.min() < 1.5 * model.spacing:
                    return "overlapping another body"
        return None


def _cube_centers(body: Body, spacing: float) -> np.ndarray:
    lower, upper = body.extent()
    counts = np.maximum(np.rint((upper - lower) / spacing).astype(int), 1)
    start = (lower + upper) / 2 - counts * spacing / 2
    cubes = start + (np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), -1).reshape(-1, len(counts)) + 0.5) * spacing
    return cubes[body.inside(cubes)]


#: A material number of a family that varies: one range, several (drawn from in proportion to their widths), or those by split.
_Ranges = tuple[Finite, Finite] | list[tuple[Finite, Finite]]
_Spread = _Ranges | dict[Literal["train", "valid", "test"], _Ranges]


def _without_spreads(content: dict, where: object) -> tuple[dict, dict[tuple[str, str], dict[str, list[tuple[float, float]]]]]:
    """A family's content with one number in place of each varying one, and (material, key) -> split -> ranges."""
    spreads: dict[tuple[str, str], dict[str, list[tuple[float, float]]]] = {}
    materials = content.get("materials")
    for name, material in materials.items() if isinstance(materials, dict) else ():
        for key, value in material.items() if isinstance(material, dict) else ():
            if not isinstance(value, (list, tuple, dict)):
                continue
            place = f"materials.{name}.{key}"
            remedy = "must be a number, a range [low, high], several ranges, or those for each of train, valid, test"
            try:
                spread: Any = TypeAdapter(_Spread).validate_python(value)
            except ValidationError:
                raise InputError(where, place, value, remedy) from None
            each = spread if isinstance(spread, dict) else dict.fromkeys(SPLITS, spread)
            by_split = {split: [ranges] if isinstance(ranges, tuple) else ranges for split, ranges in each.items()}
            if set(by_split) != set(SPLITS) or not all(by_split.values()):
                raise InputError(where, place, value, remedy)
            if any(low > high for ranges in by_split.values() for low, high in ranges):
                raise InputError(where, place, value, "low must not exceed high")
            spreads[name, key] = by_split
    for (name, key), ranges_by_split in spreads.items():
        content = _merged(content, {"materials": {name: {key: ranges_by_split["train"][0][0]}}})
    return content, spreads


def _draw(ranges: list[tuple[float, float]], rng: np.random.Generator) -> float:
    """Uniform over a union of ranges."""
    widths = np.array([high - low for low, high in ranges])
    shares = widths / widths.sum() if widths.sum() > 0 else np.full(len(ranges), 1 / len(ranges))
    return float(rng.uniform(*ranges[int(rng.choice(len(ranges), p=shares))]))


def _merged(base: dict, change: dict) -> dict:
    result = copy.deepcopy(base)
    for key, value in change.items():
        result[key] = _merged(result[key], value) if isinstance(value, dict) and isinstance(result.get(key), dict) else value
    return result


_JSON_TAGS = {f"tag:yaml.org,2002:{kind}" for kind in ("null", "bool", "int", "float", "str", "seq", "map")}


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses duplicate keys, which plain YAML loaders silently let win, and knows what JSON knows: no dates, bytes, sets."""

    yaml_constructors = {tag: make for tag, make in yaml.SafeLoader.yaml_constructors.items() if tag is None or tag in _JSON_TAGS}
    yaml_implicit_resolvers = {
        first: [entry for entry in entries if entry[0] in _JSON_TAGS] for first, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


def _unique_mapping(loader: yaml.SafeLoader, node: yaml.MappingNode, deep: bool = False) -> dict:
    mapping: dict = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=deep)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is not text", key_node.start_mark)
        if key in mapping:
            raise yaml.constructor.ConstructorError(None, None, f"duplicate key {key!r}", key_node.start_mark)
        mapping[key] = loader.construct_object(value_node, deep=deep)
    return mapping


_UniqueKeyLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _unique_mapping)


#: Longer than this in characters, or than this in entries once its aliases are followed, a file is no configuration but a slip or a bomb.
_MOST_CHARACTERS, _MOST_ENTRIES = 1 << 18, 1 << 16


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file with the safe loader; duplicate keys, and files too long to be configurations, are refused. Raises ``InputError``."""
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read(_MOST_CHARACTERS + 1)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "file", getattr(error, "strerror", None) or "not text", "give a readable YAML file") from None
    if len(text) > _MOST_CHARACTERS:
        raise InputError(path, "file", f"{text[:20]}...", f"longer than {_MOST_CHARACTERS} characters; give a configuration")
    try:
        content = yaml.load(text, _UniqueKeyLoader)  # noqa: S506 (a SafeLoader)
    except (yaml.YAMLError, ValueError, LookupError, RecursionError) as error:  # a tag and no value under it is a LookupError
        mark = getattr(error, "problem_mark", None)
        place, fault = f"line {mark.line + 1}" if mark else "file", getattr(error, "problem", None) or str(error)
        raise InputError(path, place, fault, "not valid YAML; correct the line") from None
    if (count := entries(content)) > _MOST_ENTRIES:
        remedy = "aliases (*name) make it longer than any configuration, or hold themselves; write out what they stand for"
        raise InputError(path, "file", f"{count:.3g} entries", remedy)
    return content


def explain_validation(error: ValidationError, where: object) -> InputError:
    """The first fault of a pydantic error as an ``InputError``."""
    first = error.errors(include_url=False)[0]
    path, value, location = "", first["input"], first["loc"]
    for place, part in enumerate(location):
        # pydantic names the branch of a union after the key; that is not a key of the file.
        tagged = place > 0 and (location[place - 1] in ("shape", "solver") or (place == 2 and location[0] in ("materials", "obstacles")))
        branch = tagged or (place > 0 and (str(part) in ("float", "str", "constrained-float") or "[" in str(part)))
        if isinstance(part, int):
            path += f"[{part}]"
        elif not branch:
            path += f".{part}" if path else part
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "value_error":
        try:
            detail = json.loads(message)
            return InputError(where, ".".join(filter(None, [path, detail["key"]])), detail["value"], detail["remedy"])
        except (ValueError, KeyError, TypeError):
            pass
    if first["type"] == "extra_forbidden":
        message = "unknown key; remove it or correct its spelling"
    elif first["type"] == "missing":
        message = "missing; add it"
        value = None
    else:
        message = message[0].lower() + message[1:] + "; correct the value"
    return InputError(where, path or "file", value, message)
