"""Sluice: from scene files to a report. ``snakemake --config study=configs/studies/demo.yaml``; options in profiles/default/config.yaml."""

import os
import re
import sys

sys.path.insert(0, workflow.basedir)

from sim.errors import InputError
from workflow.alone import hold
from workflow.gpu import check_gpu
from workflow.sources import code_hash
from workflow.study import PARTS, load_study


def refuse(error):
    """Snakemake turns every exception into a traceback of its own; a mistake in a study is one line and exit code 2."""
    print(f"sluice: {error}", file=sys.stderr, flush=True)
    os._exit(2)


try:
    STUDY = load_study(config.get("study", "configs/studies/smoke.yaml"))
    # Short options may be joined: -nq.
    dry = any(word in ("--dry-run", "--dryrun") or re.fullmatch("-[A-Za-z]*n[A-Za-z]*", word) for word in sys.argv[1:])
    if workflow.is_main_process and not dry:
        hold(STUDY.folder)
except InputError as error:
    refuse(error)

RESULTS = str(STUDY.folder)
PYTHON = sys.executable


if STUDY.stability:

    include: "workflow/rules/stability.smk"

else:

    include: "workflow/rules/data.smk"
    include: "workflow/rules/train.smk"
    include: "workflow/rules/compare.smk"
    include: "workflow/rules/pictures.smk"
    include: "workflow/rules/report.smk"


onstart:
    # Of the jobs that are to run here: data can be made on one machine for a training on another.
    try:
        if workflow.is_main_process and workflow.local_exec:
            for job in workflow.dag.needrun_jobs():
                if job.rule.name in ("train", "errors", "rollouts") and job.resources.gpu:
                    check_gpu(STUDY, *(("models", job.wildcards.model) if job.rule.name == "train" else ("comparisons", job.wildcards.comparison)))
    except InputError as error:
        refuse(error)


wildcard_constraints:
    data="[a-z0-9][a-z0-9_-]*",
    model="[a-z0-9][a-z0-9_-]*",
    seed=r"\d+",
    comparison="[a-z0-9][a-z0-9_-]*",
    job="[a-z0-9][a-z0-9_-]*",


localrules:
    all,


rule all:
    default_target: True
    input:
        f"{RESULTS}/report.html",
        f"{RESULTS}/summary.json",
