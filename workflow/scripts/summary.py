"""``summary.json``, ``report.html`` and the pages of ``report/`` beside it. ``python -m workflow.scripts.summary STUDY SUMMARY REPORT``"""

from learn.report import write_report
from sim.trajectory import write_json
from workflow.command import run
from workflow.results import assets, overview, summarise
from workflow.study import load_study


def main(path: str, out: str, report: str) -> None:
    study = load_study(path)
    summary = summarise(study)
    write_json(out, summary)
    write_report(summary, report, assets(study, summary), overview(study))


if __name__ == "__main__":
    run(main)
