"""Figures of a comparison. ``python -m workflow.scripts.figures ROWS TIMING RUN_TIME TIME ENERGY``"""

from learn import figures
from workflow.command import run
from workflow.rows import timed_rows


def main(rows: str, timing: str, run_time: str, time: str, energy: str) -> None:
    timed = timed_rows(rows, timing)
    figures.error_over_run_time(timed, run_time)
    figures.error_over_time(timed, time)
    figures.kinetic_energy(timed, energy)


if __name__ == "__main__":
    run(main)
