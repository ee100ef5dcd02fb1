"""All cells of some cases of the stress matrix. ``python -m workflow.scripts.stress OUT CASE ...``"""

import importlib

from learn.compare import hardware, versions
from sim.stability.report import row
from sim.trajectory import write_json
from workflow.command import run


def main(out: str, *cases: str) -> None:
    rows = []
    for case in cases:
        found = [row(cell) for cell in importlib.import_module(f"sim.stability.{case}").run()]
        print(f"{case}: {sum(one['right'] for one in found)} of {len(found)} cells right", flush=True)
        rows += found
    write_json(out, {"rows": rows, "hardware": hardware(), "versions": versions()})


if __name__ == "__main__":
    run(main)
