"""Interleaved run times of a comparison, and what they were measured on. ``python -m workflow.scripts.timing STUDY COMPARISON OUT``"""

import dataclasses

from learn.compare import hardware, plain, time_comparison, versions
from sim.trajectory import write_json
from workflow.command import run
from workflow.contenders import contenders, settings, test_trajectories
from workflow.study import load_study

#: Oracle and chaos floor are yardsticks of error; their times mean nothing.
KINDS = ("reference", "solver", "learned", "trivial")


def main(path: str, comparison: str, out: str) -> None:
    study = load_study(path)
    wanted = study.comparisons[comparison]["timing"]
    trajectories = test_trajectories(study, comparison, [0])
    rivals = contenders(study, comparison, trajectories, KINDS)
    timings = time_comparison(rivals, trajectories[0], settings(study, comparison, trajectories), wanted.get("frames"), wanted["repeats"])
    write_json(out, {"timings": plain([dataclasses.asdict(timing) for timing in timings]), "hardware": hardware(), "versions": versions()})


if __name__ == "__main__":
    run(main)
