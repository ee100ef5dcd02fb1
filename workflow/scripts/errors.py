"""Rows of a comparison: every contender on every test trajectory. ``python -m workflow.scripts.errors STUDY COMPARISON OUT``"""

from learn.compare import compare
from sim.trajectory import write_json
from workflow.command import run
from workflow.contenders import contenders, settings, test_trajectories
from workflow.study import load_study

KINDS = ("reference", "solver", "learned", "trivial", "oracle", "floor")


def main(path: str, comparison: str, out: str) -> None:
    study = load_study(path)
    trajectories = test_trajectories(study, comparison)
    write_json(out, compare(contenders(study, comparison, trajectories, KINDS), trajectories, settings(study, comparison, trajectories)))


if __name__ == "__main__":
    run(main)
