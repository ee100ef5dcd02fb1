"""Figure of a comparison's ablations. ``python -m workflow.scripts.ablation STUDY COMPARISON ROWS FIGURE``"""

import json
from pathlib import Path

from learn.figures import ablation
from workflow.command import run
from workflow.study import load_study


def main(study: str, comparison: str, rows: str, figure: str) -> None:
    ablation(json.loads(Path(rows).read_text()), load_study(study).comparisons[comparison]["axes"], figure)


if __name__ == "__main__":
    run(main)
