"""Rows of a comparison: every contender on every test trajectory. ``python -m workflow.scripts.errors STUDY COMPARISON OUT DEVICE``"""

import torch

from learn.compare import compare
from sim.errors import InputError
from sim.trajectory import write_json
from workflow.command import run
from workflow.contenders import contenders, settings, test_trajectories
from workflow.study import load_study

KINDS = ("reference", "solver", "learned", "trivial", "oracle", "floor")


def main(path: str, comparison: str, out: str, device: str) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError(path, f"comparisons.{comparison}.resources.gpus", 1, "this machine has no CUDA device that torch can use; leave it out")
    study = load_study(path)
    trajectories = test_trajectories(study, comparison)
    rivals = contenders(study, comparison, trajectories, KINDS, device)
    write_json(out, compare(rivals, trajectories, settings(study, comparison, trajectories)))


if __name__ == "__main__":
    run(main)
