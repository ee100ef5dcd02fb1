"""Six moments of the truth, and below them the rollouts. ``python -m workflow.scripts.strip OUT TRUTH ROLLOUT ...``"""

from sim.render import render_strip
from workflow.command import run
from workflow.names import REFERENCE
from workflow.pictures import whole


def main(out: str, truth: str, *rollouts: str) -> None:
    predictions = {predicted.simulator["name"]: predicted.position for predicted in map(whole, rollouts)}
    render_strip(out, whole(truth), predictions=predictions, name=REFERENCE)


if __name__ == "__main__":
    run(main)
