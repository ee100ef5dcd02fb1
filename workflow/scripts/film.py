"""Film and still of a rollout beside its truth. ``python -m workflow.scripts.film TRUTH ROLLOUT TIMING FILM STILL``"""

import json
from pathlib import Path

from sim.render import render_comparison
from workflow.command import run
from workflow.names import REFERENCE
from workflow.pictures import speed_note, whole


def main(truth_shard: str, rollout_shard: str, timing: str, film: str, still: str) -> None:
    truth, predicted = whole(truth_shard), whole(rollout_shard)
    model = predicted.simulator["name"]
    note = speed_note(json.loads(Path(timing).read_text())["timings"], model)
    for picture in (film, still):
        moment = truth.frame_step * len(truth.position) / 2
        render_comparison(picture, truth, predicted.position, names=(REFERENCE, model), note=note, time=moment)


if __name__ == "__main__":
    run(main)
