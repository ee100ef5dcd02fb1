"""The generic profile on a scheduler of a few lines that takes and gives what PBS does: qsub, qstat -xf, qdel."""

import os
import re
import signal
import subprocess
import time

import pytest
from study_tree import ROOT, begin_snakemake

pytestmark = pytest.mark.workflow

QSUB = """#!/bin/sh
for script; do :; done
id=$(mktemp -d "$SPOOL/XXXXXX")
echo "$@" > "$id/asked"
( setsid sh "$script" > "$id/out" 2>&1 < /dev/null & echo $! > "$id/pid"; wait $!; echo $? > "$id/exit" ) > /dev/null 2>&1 &
basename "$id"
"""
QSTAT = """#!/bin/sh
test "$1" = -xf && test -d "$SPOOL/$2" || exit 153
echo "Job Id: $2"
if test -f "$SPOOL/$2/exit"; then
    echo "    job_state = F"
    echo "    Exit_status = $(cat "$SPOOL/$2/exit")"
else
    echo "    job_state = R"
fi
"""
QDEL = """#!/bin/sh
for id; do kill -9 -- "-$(cat "$SPOOL/$id/pid")"; done
"""


@pytest.fixture
def scheduler(tmp_path):
    """(environment, folder of a job each)"""
    programs, spool = tmp_path / "bin", tmp_path / "spool"
    programs.mkdir()
    spool.mkdir()
    for name, text in (("qsub", QSUB), ("qstat", QSTAT), ("qdel", QDEL)):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    return {"PATH": f"{programs}:{os.environ['PATH']}", "SPOOL": str(spool)}, spool


def test_a_training_ends_well_though_its_job_is_killed(tree, scheduler):
    environment, spool = scheduler
    results = tree / "results" / "micro"
    # Looking every second: for tests.
    options = ("results/micro/models/gns/seed-0.pt", "--workflow-profile", "profiles/generic", "--seconds-between-status-checks", "1")
    process = begin_snakemake(tree, *options, environment=environment)
    run = results / "training" / "gns" / "seed-0"
    deadline = time.monotonic() + 600
    while not (run / "checkpoint.pt").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    logged = (run / "log.csv").read_text().splitlines()[:2]
    (job,) = [job for job in spool.iterdir() if "train" in (job / "asked").read_text().split() and not (job / "exit").exists()]
    os.killpg(int((job / "pid").read_text()), signal.SIGKILL)
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output
    assert "Error in rule train" in output and "Trying to restart job" in output and job.name in output
    assert (run / "log.csv").read_text().splitlines()[:2] == logged  # it went on at its checkpoint
    asked = {re.search(r"-N (\w+)", text)[1]: text for text in ((job / "asked").read_text() for job in spool.iterdir())}
    assert "select=1:ncpus=2:mem=2000mb:ngpus=0" in asked["learning_data"] and "walltime=3600" in asked["learning_data"]
    assert "select=1:ncpus=1:mem=4000mb:ngpus=0" in asked["train"] and "place=free" in asked["train"] and "walltime=72600" in asked["train"]


@pytest.mark.parametrize(("answer", "code", "status"), [
    ("job_state = R", 0, "running"), ("job_state = F\n    Exit_status = 0", 0, "success"), ("job_state = F\n    Exit_status = 271", 0, "failed"),
    ("job_state = F", 0, "failed"), ("qstat: Unknown Job Id 7.server", 153, "failed"), ("qstat: cannot connect to server", 111, "running"),
])  # fmt: skip
def test_what_became_of_a_job(tmp_path, answer, code, status):
    (tmp_path / "qstat").write_text(f"#!/bin/sh\necho 'Job Id: 7.server\n    {answer}'\nexit {code}\n")
    (tmp_path / "qstat").chmod(0o755)
    command = ["sh", "profiles/generic/status.sh", "7.server"]
    found = subprocess.run(command, cwd=ROOT, env={"PATH": f"{tmp_path}:{os.environ['PATH']}"}, capture_output=True, text=True)
    assert found.stdout == f"{status}\n" and found.returncode == 0
