"""All cells of a case of the stress matrix. ``python -m workflow.scripts.stability_case CASE OUT``"""

import importlib
import sys

from learn.compare import hardware, versions
from sim.stability.report import row
from sim.trajectory import write_json


def main(case: str, out: str) -> None:
    cells = importlib.import_module(f"sim.stability.{case}").run()
    write_json(out, {"rows": [row(cell) for cell in cells], "hardware": hardware(), "versions": versions()})


if __name__ == "__main__":
    main(*sys.argv[1:])
