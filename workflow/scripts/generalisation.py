"""Figure of errors beyond the training. ``python -m workflow.scripts.generalisation STUDY COMPARISON FIGURE ROWS ...``"""

import json
from pathlib import Path

from learn.figures import generalisation
from workflow.command import run
from workflow.results import trained_on
from workflow.study import load_study


def main(path: str, comparison: str, figure: str, *rows: str) -> None:
    study = load_study(path)
    found = [row for place in rows for row in json.loads(Path(place).read_text())]
    generalisation(found, study.comparisons[comparison]["generalisation"]["over"], trained_on(study, comparison), figure)


if __name__ == "__main__":
    run(main)
