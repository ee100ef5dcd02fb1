"""Figure of the speed-ups of all comparisons. ``python -m workflow.scripts.speed_ups FIGURE ROWS TIMING [ROWS TIMING ...]``"""

from learn.analysis import analyse
from learn.figures import speed_ups
from workflow.command import run
from workflow.rows import timed_rows


def main(figure: str, *places: str) -> None:
    speed_ups(analyse([row for pair in zip(places[::2], places[1::2], strict=True) for row in timed_rows(*pair)]), figure)


if __name__ == "__main__":
    run(main)
