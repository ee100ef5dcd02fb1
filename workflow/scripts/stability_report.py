"""Summary and pages of a stability study. ``python -m workflow.scripts.stability_report STUDY SUMMARY REPORT PAGE CELLS ...``"""

import json
from pathlib import Path

from sim.stability.report import verdict, write_page, write_report
from sim.trajectory import write_json
from workflow.command import run
from workflow.results import how_to_repeat
from workflow.study import load_study


def main(path: str, out: str, report: str, page: str, *cells: str) -> None:
    study, found = load_study(path), [json.loads(Path(each).read_text()) for each in cells]
    rows = [row for each in found for row in each["rows"]]
    summary = {"title": study.content["title"], "verdict": verdict(rows), "rows": rows, "provenance": how_to_repeat(study)}
    summary |= {key: found[0][key] for key in ("hardware", "versions")}
    write_json(out, summary)
    write_report(summary, report)
    write_page(summary, page)


if __name__ == "__main__":
    run(main)
