"""Loss and validation error of trainings. ``python -m workflow.scripts.training_curve OUT LABEL=RUN ...``"""

from learn.figures import training_curve
from workflow.command import run


def main(out: str, *runs: str) -> None:
    training_curve(dict(run.split("=", 1) for run in runs), out)


if __name__ == "__main__":
    run(main)
