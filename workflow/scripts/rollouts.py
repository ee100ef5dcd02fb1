"""The rollouts to be filmed, one shard each, and their truth. ``python -m workflow.scripts.rollouts STUDY COMPARISON DEVICE ROWS TRUTH SHARD ...``

Filmed is the test trajectory on which the first film's contender has its median error, so that neither the best nor the worst stands for all.
"""

import json
from pathlib import Path

from learn.compare import median_trajectory
from learn.rollout import rollout_trajectory
from sim.trajectory import write_shard
from workflow.command import run
from workflow.contenders import learned, test_trajectories
from workflow.gpu import check_gpu
from workflow.study import load_study


def main(path: str, comparison: str, device: str, errors: str, truth: str, *shards: str) -> None:
    study = load_study(path)
    if device == "cuda":
        check_gpu(study, "comparisons", comparison)
    films = study.comparisons[comparison]["films"]
    rows = json.loads(Path(errors).read_text())
    number = median_trajectory(rows, films[0])
    (trajectory,) = test_trajectories(study, comparison, [number])
    write_shard(truth, {number: trajectory})
    for model, shard in zip(films, shards, strict=True):
        contender = learned(study, comparison, model, device)[0]
        simulator = {"name": model, "kind": contender.kind, "settings": contender.settings}
        # From the frames that the comparison gives to all, on the device it ran on, so that the film shows what the rows measured.
        write_shard(shard, {number: rollout_trajectory(contender, trajectory, None, simulator, rows[0]["known_frames"])[0]})


if __name__ == "__main__":
    run(main)
