"""MLS-MPM (Hu et al. 2018) with APIC transfers (Jiang et al. 2015) and quadratic B-splines, 2D and 3D from one source.

Decisions, measured on a CPU:
- one kernel a frame, serial, with the substep loop inside: five times faster than a kernel a substep, because atomics become
  plain additions and the launch is paid once a frame; one thread per trajectory is bitwise reproducible;
- numbers (sizes, materials, time step) are arguments and fields, structure (dimension, materials present, wall kind) is
  compiled in: scenes that differ in numbers share kernels;
- on a GPU the same functions run as parallel loops, one kernel a substep.
"""

import time

import numpy as np

from sim.errors import InputError
from sim.mpm.materials import MODELS
from sim.mpm.walls import wall
from sim.scene import Scene
from sim.simulator import Kind, SimulationError, Start
from sim.taichi_runtime import start_taichi, ti

#: Grid coordinate of the lower walls: they lie on a line of nodes, with one line of ghost nodes behind.
WALL = 1
#: A frame whose Courant number grew beyond this multiple of the requested one is taken back and repeated with half the step.
COURANT_GROWTH = 1.5
#: Halvings of the planned step before a trajectory is given up.
MAX_HALVINGS = 6


def _power_of_two(n: int) -> int:
    return 1 << max(int(n) - 1, 15).bit_length()


@ti.data_oriented
class _Kernels:
    """Fields and compiled code for one structure: dimension, materials present, wall kind; capacities in particles and nodes."""

    def __init__(self, dim: int, models: tuple[str, ...], friction: str, capacity: int, nodes: tuple[int, ...], serial: bool):
        self.dim, self.models, self.friction, self.capacity, self.nodes = dim, models, friction, capacity, nodes
        self.x = ti.Vector.field(dim, ti.f32, capacity)
        self.v = ti.Vector.field(dim, ti.f32, capacity)
        self.C = ti.Matrix.field(dim, dim, ti.f32, capacity)
        self.materials = [MODELS[model](dim, capacity) for model in models]
        self.grid = ti.Vector.field(dim + 1, ti.f32, nodes)  # momentum, then velocity; mass last
        self.range = ti.field(ti.i32, len(models) + 1)  # particles of material m: range[m] .. range[m + 1]
        self.mass_volume = ti.Vector.field(2, ti.f32, len(models))
        self.extent = ti.Vector.field(dim, ti.i32, 2)  # node indices of the walls
        self.limits = ti.Vector.field(dim, ti.f32, 2)  # walls in grid coordinates, in cells
        self.fastest = ti.field(ti.f32, ())
        self.state = [self.x, self.v, self.C, *(field for material in self.materials for field in material.fields())]
        self.saved = [
            ti.field(ti.f32, capacity) if isinstance(field, ti.ScalarField) else ti.Matrix.field(field.n, field.m, ti.f32, capacity)
            if field.m > 1 else ti.Vector.field(field.n, ti.f32, capacity) for field in self.state
        ]
        self.frame = self.frame_serial if serial else self.frame_parallel

    def field_names(self) -> list[str]:
        """Per-particle and per-node fields, as ``plan`` lists them."""
        return ["x", "v", "C", *(f"{model}.{name}" for model in self.models for name in MODELS[model].state), "grid"]

    # x is stored in cells, from the padded corner; velocities in length per second.
    @ti.func
    def weights(self, fx):
        """Quadratic B-spline weights of the three nodes along each axis; fx in [0.5, 1.5)."""
        return ti.Matrix.rows([0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2])

    @ti.func
    def clear_node(self, I):
        self.grid[I] = ti.Vector.zero(ti.f32, self.dim + 1)

    @ti.func
    def p2g(self, m: ti.template(), p, dt, dx):
        """Particle to grid: m_i += w m, (mv)_i += w [m v + (m C - dt V0 4 / dx^2 tau)(x_i - x_p)] (Hu et al. 2018, eq. 29)."""
        tau = self.materials[m].kirchhoff(p, dt * self.C[p])
        mass, volume = self.mass_volume[m][0], self.mass_volume[m][1]
        affine = (mass * dx) * self.C[p] - (dt * volume * 4.0 / dx) * tau
        x = self.x[p]
        base = ti.cast(x - 0.5, ti.i32)
        fx = x - ti.cast(base, ti.f32)
        w = self.weights(fx)
        momentum = mass * self.v[p] - affine @ fx
        if ti.static(self.dim == 2):
            for i, j in ti.static(ti.ndrange(3, 3)):
                self.scatter(base + ti.Vector([i, j]), w[i, 0] * w[j, 1], momentum + affine @ ti.Vector([float(i), float(j)]), mass)
        else:
            for i in range(3):
                for j in range(3):
                    wij = w[i, 0] * w[j, 1]
                    row = momentum + affine @ ti.Vector([float(i), float(j), 0.0])
                    for k in ti.static(range(3)):
                        self.scatter(base + ti.Vector([i, j, k]), wij * w[k, 2], row + affine @ ti.Vector([0.0, 0.0, float(k)]), mass)

    @ti.func
    def scatter(self, node, weight, momentum, mass):
        value = ti.Vector.zero(ti.f32, self.dim + 1)
        for d in ti.static(range(self.dim)):
            value[d] = weight * momentum[d]
        value[self.dim] = weight * mass
        self.grid[node] += value

    @ti.func
    def update_node(self, I, dt, gravity, coefficient):
        """Momentum to velocity, gravity, walls."""
        cell = self.grid[I]
        mass = cell[self.dim]
        if mass > 0.0:
            v = ti.Vector.zero(ti.f32, self.dim)
            for d in ti.static(range(self.dim)):
                v[d] = cell[d] / mass + dt * gravity[d]
            # A name of its own: reassigning v from a function inside a branch is stored with its old value (Taichi 1.7.4).
            u = wall(v, I, self.extent[0], self.extent[1], self.friction, coefficient)
            for d in ti.static(range(self.dim)):
                cell[d] = u[d]
            self.grid[I] = cell

    @ti.func
    def extrapolate(self, axis: ti.template(), I):
        """Ghost nodes behind both walls of an axis: v(-1) = 2 v(0) - v(1).

        Any linear velocity field is then interpolated exactly up to the wall: nothing creeps into it, and tr C is the true
        compression there. With held nodes in place of ghosts, C underrates the compression in the last half cell and water
        piles up on the floor at reference density (more than half of a drop's particles did).
        """
        for side in ti.static(range(2)):
            ghost = ti.Vector([I[d] for d in ti.static(range(self.dim))])
            held = ti.Vector([I[d] for d in ti.static(range(self.dim))])
            inner = ti.Vector([I[d] for d in ti.static(range(self.dim))])
            ghost[axis] = self.extent[side][axis] + ti.static(2 * side - 1)
            held[axis] = self.extent[side][axis]
            inner[axis] = self.extent[side][axis] - ti.static(2 * side - 1)
            known = self.grid[inner][self.dim] > 0.0
            for d in ti.static(range(self.dim)):
                v = self.grid[held][d]
                if known:
                    v = 2.0 * v - self.grid[inner][d]
                self.grid[ghost][d] = v
            # Corners: the next axis must see this line as known.
            self.grid[ghost][self.dim] = self.grid[held][self.dim]

    @ti.func
    def gather(self, node):
        cell = self.grid[node]
        v = ti.Vector.zero(ti.f32, self.dim)
        for d in ti.static(range(self.dim)):
            v[d] = cell[d]
        return v

    @ti.func
    def g2p(self, p, dt, dx):
        """Grid to particle: v = sum w v_i, C = 4 / dx^2 sum w v_i (x_i - x_p)^T, x += dt v; a wall stops what would cross it."""
        x = self.x[p]
        base = ti.cast(x - 0.5, ti.i32)
        fx = x - ti.cast(base, ti.f32)
        w = self.weights(fx)
        v = ti.Vector.zero(ti.f32, self.dim)
        C = ti.Matrix.zero(ti.f32, self.dim, self.dim)
        if ti.static(self.dim == 2):
            for i, j in ti.static(ti.ndrange(3, 3)):
                wv = w[i, 0] * w[j, 1] * self.gather(base + ti.Vector([i, j]))
                v += wv
                C += wv.outer_product(ti.Vector([float(i), float(j)]))
        else:
            for i in range(3):
                for j in range(3):
                    wij = w[i, 0] * w[j, 1]
                    row = ti.Vector.zero(ti.f32, 3)
                    last = ti.Vector.zero(ti.f32, 3)
                    for k in ti.static(range(3)):
                        wv = wij * w[k, 2] * self.gather(base + ti.Vector([i, j, k]))
                        row += wv
                        last += float(k) * wv
                    v += row
                    C += row.outer_product(ti.Vector([float(i), float(j), 0.0])) + last.outer_product(ti.Vector([0.0, 0.0, 1.0]))
        C = (4.0 / dx) * (C - v.outer_product(fx))
        x += (dt / dx) * v
        for d in ti.static(range(self.dim)):
            inside = ti.min(ti.max(x[d], self.limits[0][d]), self.limits[1][d])
            if inside != x[d]:
                v[d] = 0.0
            x[d] = inside
        self.x[p], self.v[p], self.C[p] = x, v, C
        ti.atomic_max(self.fastest[None], v.norm_sqr())

    @ti.func
    def report(self, m: ti.template(), p, dx, out: ti.template()):
        """Position (in cells), velocity, elastic energy per volume, wave speed of one particle."""
        for d in ti.static(range(self.dim)):
            out[p, d] = self.x[p][d]
            out[p, self.dim + d] = self.v[p][d]
        out[p, 2 * self.dim] = self.materials[m].energy_density(p)
        out[p, 2 * self.dim + 1] = self.materials[m].wave_speed(p)

    @ti.kernel
    def frame_serial(self, substeps: ti.i32, dt: ti.f32, dx: ti.f32, gravity: ti.types.vector(3, ti.f32), coefficient: ti.f32, out: ti.types.ndarray(ti.f32, 2)):  # noqa: E501
        ti.loop_config(serialize=True)
        for s in range(substeps + 1):
            if s < substeps:
                if ti.static(self.dim == 2):
                    for i in range(self.extent[1][0] + 2):
                        for j in range(self.extent[1][1] + 2):
                            self.clear_node(ti.Vector([i, j]))
                else:
                    for i in range(self.extent[1][0] + 2):
                        for j in range(self.extent[1][1] + 2):
                            for k in range(self.extent[1][2] + 2):
                                self.clear_node(ti.Vector([i, j, k]))
                for m in ti.static(range(len(self.models))):
                    for p in range(self.range[m], self.range[m + 1]):
                        self.p2g(m, p, dt, dx)
                if ti.static(self.dim == 2):
                    for i in range(self.extent[1][0] + 2):
                        for j in range(self.extent[1][1] + 2):
                            self.update_node(ti.Vector([i, j]), dt, gravity, coefficient)
                else:
                    for i in range(self.extent[1][0] + 2):
                        for j in range(self.extent[1][1] + 2):
                            for k in range(self.extent[1][2] + 2):
                                self.update_node(ti.Vector([i, j, k]), dt, gravity, coefficient)
                for axis in ti.static(range(self.dim)):
                    if ti.static(self.dim == 2):
                        for i in range(self.extent[1][1 - axis] + 2):
                            self.extrapolate(axis, ti.Vector([i, i]))
                    else:
                        for i in range(self.extent[1][(axis + 1) % 3] + 2):
                            for j in range(self.extent[1][(axis + 2) % 3] + 2):
                                I = ti.Vector([0, 0, 0])
                                I[(axis + 1) % 3], I[(axis + 2) % 3] = i, j
                                self.extrapolate(axis, I)
                for p in range(self.range[ti.static(len(self.models))]):
                    self.g2p(p, dt, dx)
            else:
                for m in ti.static(range(len(self.models))):
                    for p in range(self.range[m], self.range[m + 1]):
                        self.report(m, p, dx, out)

    def frame_parallel(self, substeps: int, dt: float, dx: float, gravity, coefficient: float, out: np.ndarray) -> None:
        for _ in range(substeps):
            self.substep_parallel(dt, dx, gravity, coefficient)
        self.report_parallel(dx, out)

    @ti.kernel
    def substep_parallel(self, dt: ti.f32, dx: ti.f32, gravity: ti.types.vector(3, ti.f32), coefficient: ti.f32):
        for I in ti.grouped(self.grid):
            self.clear_node(I)
        for m in ti.static(range(len(self.models))):
            for p in range(self.range[m], self.range[m + 1]):
                self.p2g(m, p, dt, dx)
        for I in ti.grouped(self.grid):
            self.update_node(I, dt, gravity, coefficient)
        for I in ti.grouped(self.grid):
            for axis in ti.static(range(self.dim)):
                if I[axis] == 0:
                    self.extrapolate(axis, I)
        for p in range(self.range[ti.static(len(self.models))]):
            self.g2p(p, dt, dx)

    @ti.kernel
    def report_parallel(self, dx: ti.f32, out: ti.types.ndarray(ti.f32, 2)):
        for m in ti.static(range(len(self.models))):
            for p in range(self.range[m], self.range[m + 1]):
                self.report(m, p, dx, out)

    @ti.kernel
    def load(self, data: ti.types.ndarray(ti.f32, 2)):
        """Positions and velocities from [n, 2 dim]; stress-free, no affine velocity."""
        for m in ti.static(range(len(self.models))):
            for p in range(self.range[m], self.range[m + 1]):
                for d in ti.static(range(self.dim)):
                    self.x[p][d] = data[p, d]
                    self.v[p][d] = data[p, self.dim + d]
                self.C[p] = ti.Matrix.zero(ti.f32, self.dim, self.dim)
                self.materials[m].reset(p)

    @ti.kernel
    def save(self):
        for p in range(self.range[ti.static(len(self.models))]):
            for f in ti.static(range(len(self.state))):
                self.saved[f][p] = self.state[f][p]

    @ti.kernel
    def restore(self):
        for p in range(self.range[ti.static(len(self.models))]):
            for f in ti.static(range(len(self.state))):
                self.state[f][p] = self.saved[f][p]


class MPMSimulator:
    """The solver under the ``Simulator`` contract; also driven directly by ``load`` and ``frame``.

    Overrides make the rungs of a solver ladder: ``cfl`` (Courant number; default the scene's), ``stiffness`` (factor on the
    elastic moduli), ``coarsen`` (factor on the grid spacing of the recorded resolution; implies the recorded particles),
    ``particles`` ("teacher": refined as the scene says; "recorded": the tracked set alone, on the recorded grid),
    ``perturbation`` (length: random displacement of the start, for the chaos floor).
    """

    def __init__(self, *, name: str = "mpm", kind: Kind = "reference", cfl: float | None = None, stiffness: float = 1.0, coarsen: float = 1.0,
                 particles: str = "teacher", perturbation: float = 0.0, serial: bool | None = None):
        if particles not in ("teacher", "recorded"):
            raise InputError(name, "particles", particles, "must be teacher or recorded")
        if particles == "teacher" and coarsen != 1.0:
            raise InputError(name, "coarsen", coarsen, "a coarser grid needs particles: recorded")
        self.name, self.kind = name, kind
        self.settings = {"cfl": cfl, "stiffness": stiffness, "coarsen": coarsen, "particles": particles, "perturbation": perturbation}
        self.serial = serial
        self.compile_seconds = 0.0
        self._kernels: _Kernels | None = None
        self._scene: Scene | None = None

    # -- the state at frame 0
    def load(self, scene: Scene) -> None:
        """Set the state of frame 0; allocates and compiles on first use of a structure (``compile_seconds``)."""
        begun = time.perf_counter()
        serial = (start_taichi() == "cpu") if self.serial is None else self.serial
        refine = scene.refine if self.settings["particles"] == "teacher" else 1
        particles = scene.particles(refine)
        lower, upper = np.array(scene.bounds).T
        cells = np.maximum(np.rint(np.array(scene.cells) * refine / self.settings["coarsen"]).astype(int), 4)
        self.dx = float((upper[0] - lower[0]) / cells[0])
        # A coarser grid whose cells do not divide every edge alike is refused rather than stretched.
        if np.abs((upper - lower) / cells - self.dx).max() > 1e-6 * self.dx:
            raise InputError(scene.name, "coarsen", self.settings["coarsen"], f"does not divide the box {scene.cells} evenly")
        models = tuple(material.model for material in scene.materials.values())
        friction = scene.walls.friction
        structure = (scene.dim, models, "sticky" if friction == "sticky" else "coulomb" if friction > 0 else "slip")
        capacity = _power_of_two(len(particles.position))
        nodes = tuple(int(c) + 2 * WALL + 1 for c in cells)
        old = self._kernels
        if old is None or (old.dim, old.models, old.friction) != structure or old.nodes != nodes or old.capacity < capacity:
            self._kernels = _Kernels(*structure, capacity, nodes, serial)
        kernels = self._kernels
        self._scene, self._lower, self._n = scene, lower, len(particles.position)
        self._tracked = particles.tracked
        volume = particles.spacing**scene.dim
        kernels.range.from_numpy(np.searchsorted(particles.material, np.arange(len(models) + 1)).astype(np.int32))
        kernels.mass_volume.from_numpy(np.array([[material.density * volume, volume] for material in scene.materials.values()], np.float32))
        self._masses = np.array([material.density * volume for material in scene.materials.values()])[particles.material]
        self._volume = volume
        kernels.extent.from_numpy(np.stack([np.full(scene.dim, WALL), WALL + cells]).astype(np.int32))
        # Keep particles a hair inside, so that what is recorded is inside in float32 too.
        hair = 1e-4
        kernels.limits.from_numpy(np.stack([np.full(scene.dim, WALL + hair), WALL + cells - hair]).astype(np.float32))
        for model, material in zip(kernels.materials, scene.materials.values(), strict=True):
            model.configure(material, self.settings["stiffness"])
        position = particles.position
        if self.settings["perturbation"]:
            position = position + np.random.default_rng(np.random.SeedSequence([scene.seed, 2])).normal(size=position.shape) * self.settings["perturbation"]
        start = np.concatenate([(position - lower) / self.dx + WALL, particles.velocity], 1).astype(np.float32)
        kernels.load(np.ascontiguousarray(start))
        self._gravity = ti.Vector([*scene.gravity, 0.0][:3], ti.f32)
        self._coefficient = 0.0 if friction == "sticky" else float(friction)
        self._cfl = self.settings["cfl"] or scene.cfl
        self._out = np.zeros((self._n, 2 * scene.dim + 2), np.float32)
        kernels.fastest[None] = 0.0
        kernels.save()
        self._run(0, 0.0)
        self._diagnose(0, float("inf"))
        self.compile_seconds += time.perf_counter() - begun

    def _run(self, substeps: int, dt: float) -> None:
        self._kernels.frame(substeps, dt, self.dx, self._gravity, self._coefficient, self._out)

    def _diagnose(self, substeps: int, dt: float) -> None:
        dim, out = self._scene.dim, self._out.astype(np.float64)
        position = (out[:, :dim] - WALL) * self.dx + self._lower
        speed2 = (out[:, dim : 2 * dim] ** 2).sum(1)
        self._position = position
        self._diagnostics = {
            "kinetic_energy": float(0.5 * (self._masses * speed2).sum()),
            "potential_energy": float(-(self._masses[:, None] * position * np.asarray(self._scene.gravity)).sum()),
            "elastic_energy": float(self._volume * out[:, 2 * dim].sum()),
            "max_speed": float(np.sqrt(speed2.max(initial=0.0))),
            "wave_speed": float(out[:, 2 * dim + 1].max(initial=0.0)),
            "substeps": float(substeps),
            "dt": float(dt) if np.isfinite(dt) else 0.0,
        }

    def frame(self) -> np.ndarray:
        """Advance one frame; positions of the recorded particles, [n, dim] float32. Raises ``SimulationError``.

        dt <= cfl dx / (c + |v|) with the current wave speed and the speed that gravity can add within the frame; substeps
        divide the frame exactly. A frame whose Courant number outgrew the plan is taken back and repeated with half the step.
        """
        kernels, scene, known = self._kernels, self._scene, self._diagnostics
        reach = float(np.linalg.norm(scene.gravity)) * scene.frame_step
        substeps = max(1, int(np.ceil(scene.frame_step * (known["wave_speed"] + known["max_speed"] + reach) / (self._cfl * self.dx))))
        kernels.save()
        for attempt in range(MAX_HALVINGS + 1):
            dt = scene.frame_step / substeps
            kernels.fastest[None] = 0.0
            self._run(substeps, dt)
            # Sums carry a NaN to the host, where fast-math cannot optimise the test away.
            if np.isfinite(self._out.sum(dtype=np.float64)):
                fastest = float(np.sqrt(kernels.fastest[None]))
                self._diagnose(substeps, dt)
                speed = max(fastest, self._diagnostics["max_speed"])
                courant = dt * (speed + self._diagnostics["wave_speed"]) / self.dx
                if courant <= COURANT_GROWTH * self._cfl and dt * speed <= self.dx:
                    self._diagnostics["max_speed"] = self._diagnostics["max_speed"]
                    return self._position[self._tracked].astype(np.float32)
            if attempt < MAX_HALVINGS:
                kernels.restore()
                substeps *= 2
        raise SimulationError(f"time step fell below {dt:.3g} s without a finite, stable frame")

    def diagnostics(self) -> dict[str, float]:
        """Energies [J per unit depth in 2D], max speed and wave speed [m/s], substeps and dt [s] of the current frame."""
        return dict(self._diagnostics)

    # -- the Simulator contract
    def begin(self, start: Start) -> None:
        """Run the known frames from the scene's own start, so that the solver stands where the history ends."""
        self.load(Scene.from_dict(start.scene))
        for _ in range(start.present):
            self.frame()

    def advance(self) -> np.ndarray:
        return self.frame()[None]
