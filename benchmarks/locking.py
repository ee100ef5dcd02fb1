"""Does a stiff solver tell the truth? Stiff sand and goop against themselves, three times finer: the error of locking, and who shares it.

    python benchmarks/locking.py [--material sand|goop] [--young-modulus 1e8] [--model BEST.pt]

The scenes of the study ``stiffness``, fresh seeds. Truth: particles and grid three times finer, at the modulus and at 1e6 Pa. Beside it the solver
on the recorded particles and grid at moduli from there down to 3e4 Pa, and a model, if one is given, that learned from the solver at the modulus.
Mean squared errors over all frames, and the width of the heap at the end (2 to 98 % of the particles). A trajectory takes a minute or less of one
core. Rows are printed and saved as ``benchmarks/results/locking-MATERIAL.json``.
"""

import argparse
from pathlib import Path

import numpy as np
from mpm import save

from sim.ladder import solver_ladder
from sim.mpm.solver import MPMSimulator
from sim.scene import Scene, SceneFamily
from sim.simulator import rollout, start_from
from sim.trajectory import Trajectory

SEEDS = (900, 901, 902)
SOFTER = (1e7, 1e6, 1e5, 3e4)
CONFIGS = Path(__file__).resolve().parent.parent / "configs/scenes"


def truth(content: dict, material: str, modulus: float) -> Trajectory:
    """A run of the scene at a modulus, all particles three times finer, of which the central ones are recorded."""
    changed = content["materials"][material] | {"young_modulus": modulus}
    scene = Scene.from_dict(content | {"materials": {material: changed}, "refine": 3})
    solver = MPMSimulator()
    solver.load(scene)
    frames = np.array([scene.start().astype(np.float32), *(solver.frame() for _ in range(scene.frames - 1))])
    kinds, bounds = scene.particle_type(), np.array(scene.bounds)
    return Trajectory(frames, kinds, scene.frame_step, scene.radius, bounds, scene.to_dict(), scene.seed, {"name": "three times finer"})


def width(position: np.ndarray) -> float:
    """[particles, dim] -> extent along x between the quantiles .02 and .98."""
    return float(np.diff(np.quantile(position[:, 0], [0.02, 0.98]))[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--material", choices=["sand", "goop"], default="sand")
    parser.add_argument("--young-modulus", type=float, default=1e8)
    parser.add_argument("--model", help="checkpoint of a model that learned from the solver at this modulus")
    options = parser.parse_args()
    family, stiff = SceneFamily.load(CONFIGS / f"stiff_{options.material}.yaml"), options.young_modulus
    rows = []
    for seed in SEEDS:
        content = family.sample(seed).to_dict()
        truths = {modulus: truth(content, options.material, modulus) for modulus in (stiff, 1e6)}
        start = start_from(truths[stiff], 6)
        rungs = [
            (f"solver, {modulus:.0e} Pa", "solver", {"particles": "recorded", "stiffness": modulus / stiff, "frames": 16})
            for modulus in (stiff, *(softer for softer in SOFTER if softer < stiff))
        ]
        contenders = list(solver_ladder(rungs, "mpm"))
        if options.model:
            from learn.checkpoint import load_model

            contenders.append(load_model(options.model))
        for contender in contenders:
            frames = rollout(contender, start, len(truths[stiff].position) - 6).position
            errors = {f"{modulus:.0e}": float(((frames - true.position[6:]) ** 2).mean()) for modulus, true in truths.items()}
            rows.append({"seed": seed, "contender": contender.name, "mse": errors, "width": width(frames[-1])})
            print(rows[-1], flush=True)
        for modulus, true in truths.items():
            rows.append({"seed": seed, "contender": f"truth, {modulus:.0e} Pa", "mse": {}, "width": width(true.position[-1])})
            print(rows[-1], flush=True)
    save(f"locking-{options.material}", rows, len(SEEDS))


if __name__ == "__main__":
    main()
