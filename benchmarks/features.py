"""What does a part of a scene cost, where there is one, that a scene without it is spared? One core.

    python benchmarks/features.py [--quick]

Each row is a pair of scenes of the same block of particles that differ in one feature. Both advance in turn in one process on one
thread; cost is CPU time a particle and substep, the ratio is the median of the rounds' ratios. The bytes of ``plan`` are beside it. Rows are
printed and saved as ``benchmarks/results/features.json``.
"""

import argparse
from functools import partial

import numpy as np
from mpm import advance, block, save, timed

from sim.scene import Scene

#: Particles along an edge of the block, cells along an edge of the box: 5k particles in 2D, 6k in 3D.
PLANE, CUBE = (71, 128), (18, 32)


def scene(dim: int = 2, model: str = "water", **changes) -> dict:
    """The dam break of ``benchmarks/mpm.py``, as a mapping; ``model`` is water, sand or elastic, of about one wave speed."""
    content = block("water" if model == "elastic" else model, dim, *(PLANE if dim == 2 else CUBE)).to_dict()
    if model == "elastic":
        content["materials"]["water"] = {"model": "elastic", "density": 1000.0, "young_modulus": 6e5, "poisson_ratio": 0.3}
    return content | changes


def two_materials() -> dict:
    """The block as two of half its height and of one material under two names."""
    content = scene()
    (body,) = content["bodies"]
    (x, y), middle = body["upper"], body["upper"][1] / 2
    water = content["materials"]["water"]
    bodies = [body | {"upper": [x, middle]}, body | {"material": "brine", "lower": [0.0, middle], "upper": [x, y]}]
    return content | {"materials": {"water": water, "brine": water}, "bodies": bodies}


def with_box() -> dict:
    """A rigid box of four cells' edge beside the block."""
    content = scene()
    box = {"material": "box", "kind": "box", "lower": [0.75, 0.25], "upper": [0.78125, 0.28125], "velocity": [0.0, 0.0]}
    return content | {"materials": content["materials"] | {"box": {"model": "rigid", "density": 500.0}}, "bodies": [*content["bodies"], box]}


def shaken() -> dict:
    """The box moves to and fro."""
    return scene(container={"sines": [{"amplitude": [2.0, 0.0], "frequency": 1.0, "phase": 0.0}]})


BALL = {"kind": "ball", "center": [0.8, 0.2], "radius": 0.1}
#: feature -> scenes without and with it.
PAIRS = {
    "shear strain (b - I)": (scene(), scene(model="elastic")),
    "decomposition, return map": (scene(model="elastic"), scene(model="sand")),
    "wall friction": (scene(), scene(walls={"friction": 0.3})),
    "obstacles": (scene(), scene(obstacles=[BALL])),
    "second material": (scene(), two_materials()),
    "context: a shaken box": (scene(), shaken()),
    "rigid bodies": (scene(), with_box()),
    "third dimension": (scene(), scene(dim=3)),
}


def measure(feature: str, rounds: int, target: float) -> dict:
    """One row; a round lasts about ``target`` seconds a side."""
    from sim.mpm.solver import MPMSimulator

    scenes = [Scene.from_dict(content) for content in PAIRS[feature]]
    solvers, frames = [MPMSimulator(), MPMSimulator()], []
    for solver, each in zip(solvers, scenes, strict=True):
        solver.load(each)
        solver.frame()
        frames.append(max(1, int(np.ceil(target / max(timed(solver.frame)[0], 1e-4)))))
    counts = [len(each.particles().position) for each in scenes]
    costs = []
    for _ in range(rounds):
        found = [timed(partial(advance, solver, n)) for solver, n in zip(solvers, frames, strict=True)]
        costs.append([spent / (count * sum(substeps)) * 1e9 for (spent, substeps), count in zip(found, counts, strict=True)])
    costs = np.array(costs)
    sizes = [solver.plan(each)["bytes"] / count for solver, each, count in zip(solvers, scenes, counts, strict=True)]
    row = {"feature": feature, "ratio": float(np.median(costs[:, 1] / costs[:, 0]))}
    for side, name in enumerate(("without", "with")):
        row |= {f"{name}_ns": float(np.median(costs[:, side])), f"{name}_bytes_a_particle": sizes[side]}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description="Cost of a substep with a feature over one without")
    parser.add_argument("--quick", action="store_true", help="five short rounds a case instead of nine of half a second")
    quick = parser.parse_args().quick
    rounds, target = (5, 0.1) if quick else (9, 0.5)
    rows = []
    print(f"{'feature':28}{'ns a particle-substep':>24}{'ratio':>7}{'bytes a particle, grid included':>34}")
    for feature in PAIRS:
        row = measure(feature, rounds, target)
        rows.append(row)
        print("{feature:28}{without_ns:12.1f} -> {with_ns:8.1f}{ratio:7.2f}{without_bytes_a_particle:20.0f} -> {with_bytes_a_particle:10.0f}"
              .format(**row), flush=True)  # fmt: skip
    save("features", rows, rounds)


if __name__ == "__main__":
    main()
