"""Rows of a comparison: every contender on every test trajectory. ``python -m workflow.scripts.errors STUDY COMPARISON OUT DEVICE``"""

from learn.compare import compare
from sim.trajectory import write_json
from workflow.command import run
from workflow.contenders import contenders, settings, test_trajectories
from workflow.gpu import check_gpu
from workflow.study import load_study

KINDS = ("reference", "solver", "learned", "trivial", "oracle", "floor")


def main(path: str, comparison: str, out: str, device: str) -> None:
    study = load_study(path)
    if device == "cuda":
        check_gpu(study, "comparisons", comparison)
    trajectories = test_trajectories(study, comparison)
    rows = compare(contenders(study, comparison, trajectories, KINDS, device), trajectories, settings(study, comparison, trajectories))
    if device != "cpu":
        # A GPU's time is no rival of a CPU's: the only times are those of timing.json.
        for row in rows:
            if row["kind"] == "learned":
                row |= {"seconds_per_frame": None, "seconds_per_simulated_second": None}
                spread = row["spread"]
                for figures in (row["mean"], spread["min"], spread["max"], *spread["per_seed"], *spread["per_trajectory"]):
                    figures["seconds_per_frame"] = None
    write_json(out, rows)


if __name__ == "__main__":
    run(main)
