"""What a scene family will build and cost, before anything is built: kernels, fields, what is left out, memory, time, disk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError
from sim.generate import SPLITS, trajectory_seed
from sim.scene import SceneFamily
from sim.solvers import solver_class

#: Particle-substeps per second of one core, by dimension and the slowest material present, on a quiet AMD EPYC with AVX-512. Sand as
#: ``make bench`` measures it (2D: 11.5-13 million for 1k to 20k particles; 3D: 2.7), and 3D water (15). 2D water as WATERDROP takes it
#: (0.29 s a trajectory): a block runs at 24-30 million, but splashes take more substeps than planned, in frames so short that their ends
#: show. Goop, elastic and snow in 2D were measured against sand (0.9, 1.25 and 0.7 times), elastic in 3D against water; goop and snow in
#: 3D are guesses from sand, whose decomposition they share. ``benchmarks/paper_data.py`` sets the estimates beside samples.
#: SPH: ``benchmarks/sph.py``, a column of water that breaks.
#: Position-based: BOXBATH as it is (0.7 s a trajectory, 5.5 iterations a substep), dam breaks of 250 to 1000 particles in 2D (10 to 13).
RATES = {
    (2, "water"): 10e6,
    (2, "sand"): 12e6,
    (2, "goop"): 11e6,
    (2, "elastic"): 15e6,
    (2, "snow"): 8.5e6,
    (2, "rigid"): 10e6,
    (3, "water"): 15e6,
    (3, "sand"): 2.7e6,
    (3, "goop"): 2.7e6,
    (3, "elastic"): 9e6,
    (3, "snow"): 2.7e6,
    (3, "rigid"): 15e6,
    (2, "pbf"): 0.4e6,
    (3, "pbf"): 0.8e6,
    (2, "wcsph"): 7.7e6,
    (3, "wcsph"): 2.5e6,
    (2, "dfsph"): 2.2e6,
    (3, "dfsph"): 1.1e6,
}

#: Scenes drawn to describe a family.
_SAMPLES = 8


@dataclass(frozen=True)
class Plan:
    """``solver``: ``MPMSimulator.plan`` of the largest of the drawn scenes; recorded and teacher particles (mean over the draws);
    substeps a frame (at rest, at the speed of a fall through the box); particle-substeps a trajectory (mean of the two);
    seconds a trajectory on one core at ``rate``; bytes a trajectory on disk."""

    solver: dict
    recorded: float
    particles: float
    substeps: tuple[int, int]
    particle_substeps: float
    rate: float
    seconds: float
    disk: float


def plan(family: SceneFamily) -> Plan:
    """Draw a few scenes and ask the solver what it would build. Raises ``InputError``; allocates and compiles nothing."""
    model = family.model
    solver = solver_class(model.solver.method)()
    scenes = [family.sample(trajectory_seed(0, "train", index)) for index in range(_SAMPLES)]
    for scene in scenes:
        solver.check_time_step(scene, family.where)
    plans = [solver.plan(scene) for scene in scenes]
    recorded, particles = (float(np.mean([each[key] for each in plans])) for key in ("recorded", "particles"))
    substeps = np.mean([each["substeps_per_frame"] for each in plans], axis=0)
    work = particles * float(substeps.mean()) * (model.frames - 1)
    rate = min(RATES[model.dim, name] for name in plans[0]["rates"])
    return Plan(
        solver=max(plans, key=lambda each: each["bytes"]),
        recorded=recorded,
        particles=particles,
        substeps=(round(substeps[0]), round(substeps[1])),
        particle_substeps=work,
        rate=rate,
        seconds=work / rate,
        disk=4.0 * model.frames * recorded * model.dim,
    )


def check_time_step(family: SceneFamily, counts: dict[str, int], seed: int) -> None:
    """Refuse a fixed time step that is above the limit at the start of any of these trajectories. Raises ``InputError``."""
    if family.model.time_step is not None:
        solver = solver_class(family.model.solver.method)()
        for split, count in counts.items():
            for index in range(count):
                solver.check_time_step(family.sample(trajectory_seed(seed, split, index), split), family.where)


def check_budget(family: SceneFamily, trajectories: int, budget: float) -> None:
    """Refuse what is estimated to need more than ``budget`` hours of one core: stiff scenes are easily asked for and never finished.

    Raises ``InputError`` with the estimate and what makes it.
    """
    found = plan(family)
    hours = trajectories * found.seconds / 3600
    if hours > budget:
        remedy = (
            f"{trajectories} trajectories x {found.particles:.0f} particles x {family.model.frames - 1} frames x "
            f"{found.substeps[0]} to {found.substeps[1]} substeps (wave speed {found.solver['wave_speed']:.3g} m/s) need about {hours:.3g} hours "
            f"of one core, more than the budget of {budget:g}; soften the material, ask for fewer, or raise --budget"
        )
        raise InputError(family.where, "--budget", budget, remedy)


def _duration(seconds: float) -> str:
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"


def _size(count: float) -> str:
    for unit, length in (("GB", 1e9), ("MB", 1e6)):
        if count >= length:
            return f"{count / length:.1f} {unit}"
    return f"{count / 1e3:.1f} kB"


def plan_text(family: SceneFamily, jobs: int = 1) -> str:
    """The plan for people, with the time and disk that the family's splits need in ``jobs`` processes."""
    found, model = plan(family), family.model
    solver = found.solver
    lines = [
        f"scene {model.name}: {solver['title']}, {solver['dim']}D, {', '.join(solver['materials'])}, {solver['walls']} walls",
        f"  particles: {found.recorded:.0f} recorded, {found.particles:.0f} simulated (mean of {_SAMPLES} draws); "
        f"{' x '.join(map(str, solver['cells']))} cells of {solver['grid_spacing']:.4g}",
        *(
            [f"  obstacles: {solver['obstacles']} in the largest draw, {solver['kinematic']} of its recorded particles are kinematic"]
            if solver["obstacles"]
            else []
        ),
        *([f"  context: {solver['context']} numbers a frame"] if solver["context"] else []),
        f"  compiled: {', '.join(solver['kernels'])}",
        f"  allocated: {_size(solver['bytes'])}",
        *(f"    {name}: {entries} x {size} bytes" for name, (size, entries) in solver["fields"].items()),
        "  left out:",
        *(f"    {name}: {reason}" for name, reason in solver["left_out"].items()),
        f"  substeps a frame: {found.substeps[0]} at rest, {found.substeps[1]} at the speed of a fall through the box, "
        f"more in an impact that squeezes (wave speed {solver['wave_speed']:.3g} m/s)",
        f"  cost of a trajectory: {found.particle_substeps / 1e6:.1f} million particle-substeps, about {_duration(found.seconds)} "
        f"on one core at {found.rate / 1e6:g} million a second; {_size(found.disk)} on disk",
    ]
    for split in SPLITS:
        count = getattr(model.splits, split)
        duration = _duration(count * found.seconds / min(jobs, max(count, 1)))
        lines.append(f"  {split}: {count} trajectories, about {duration} with --jobs {jobs}, {_size(count * found.disk)}")
    return "\n".join(lines)
