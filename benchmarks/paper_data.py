"""How long does it take to make the paper's 2D data, all domains at full counts? Estimated by ``plan``, confirmed on a sample.

    python benchmarks/paper_data.py [--sample 2]

``plan`` draws eight scenes of a domain and reckons their particle-substeps over stated rates. The first of these are run to their end, and
their CPU seconds (without compiling) are set against the estimate for the same scenes; the hours by sample are the estimated ones times
that ratio. Hours are of two processes on two cores that do not slow each other down (``benchmarks/mpm.py`` measures how far they do).
Rows are printed and saved as ``benchmarks/results/paper_data.json``.
"""

import argparse

from mpm import ROOT, save, timed

from sim.domains import DOMAINS
from sim.generate import SPLITS, simulate, trajectory_seed
from sim.plan import RATES, plan
from sim.scene import SceneFamily

SCENES = ROOT.parent / "configs" / "scenes"


def measure(family: SceneFamily, sample: int) -> dict:
    """One row; ``ratio`` is the sample's CPU seconds over those that ``plan`` reckons for it."""
    from sim.mpm.solver import MPMSimulator

    found, model, solver, spent, reckoned = plan(family), family.model, MPMSimulator(), 0.0, 0.0
    for index in range(sample):
        scene = family.sample(trajectory_seed(0, "train", index))
        solver.load(scene)  # compiled, and not timed again
        seconds, trajectory = timed(lambda scene=scene: simulate(solver, scene))
        if not trajectory.ok:
            raise SystemExit(f"{model.name}: trajectory {index} {trajectory.status}")
        spent += seconds
        planned = solver.plan(scene)
        substeps = sum(planned["substeps_per_frame"]) / 2 * (model.frames - 1)
        reckoned += planned["particles"] * substeps / min(RATES[model.dim, material] for material in planned["materials"])
    count = sum(getattr(model.splits, split) for split in SPLITS)
    hours = count * found.seconds / 3600 / 2
    return {"domain": model.name, "trajectories": count, "particles": found.recorded, "frames": model.frames,
            "seconds": found.seconds, "ratio": spent / reckoned, "hours_by_plan": hours, "hours_by_sample": hours * spent / reckoned,
            "disk_gb": count * found.disk / 1e9}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description="Hours for the paper's 2D data on two cores")
    parser.add_argument("--sample", type=int, default=2, help="trajectories of each domain to run (default 2)")
    sample = parser.parse_args().sample
    rows = []
    print(f"{'domain':14}{'trajectories':>13}{'particles':>10}{'s each':>8}{'sample/plan':>12}{'hours by plan':>14}{'by sample':>10}{'GB':>7}")
    for name in DOMAINS:
        path = SCENES / f"{name}.yaml"
        if path.exists() and (family := SceneFamily.load(path)).model.dim == 2:
            rows.append(measure(family, sample))
            print("{domain:14}{trajectories:13}{particles:10.0f}{seconds:8.2f}{ratio:12.2f}{hours_by_plan:14.2f}{hours_by_sample:10.2f}"
                  "{disk_gb:7.1f}".format(**rows[-1]), flush=True)  # fmt: skip
    total = {key: sum(row[key] for row in rows) for key in ("hours_by_plan", "hours_by_sample", "disk_gb")}
    print("all together: {hours_by_plan:.1f} hours on two cores by plan, {hours_by_sample:.1f} by sample, {disk_gb:.0f} GB".format(**total))
    save("paper_data", rows, sample)


if __name__ == "__main__":
    main()
