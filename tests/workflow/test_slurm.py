"""The SLURM profile on a real SLURM of one node, which the test starts: the smoke study, jobs that are killed, a job that fails."""

import os
import re
import signal
import subprocess
import time

import psutil
import pytest
from slurm_cluster import Cluster, NoCluster
from study_tree import MICRO_STUDY, begin_snakemake, make_tree, promised, snakemake

pytestmark = [pytest.mark.workflow, pytest.mark.slurm]

SMOKE = "configs/studies/smoke.yaml"
PROFILE = ("--workflow-profile", "profiles/slurm")
#: Snakemake with a plugin that looks every two seconds: as it is, it waits ten seconds longer after every look that finds no job ended, and of a
#: minute's study these would be the most.
PROGRAM = ("-c", """
import sys
import snakemake_executor_plugin_slurm as slurm
slurm.Executor.next_seconds_between_status_checks = property(lambda self: 2, lambda self, value: None)
from snakemake.cli import main
sys.exit(main())
""")  # fmt: skip


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    try:
        cluster = Cluster(tmp_path_factory.mktemp("slurm"))
    except NoCluster as reason:
        pytest.skip(f"SLURM cannot be started here: {reason}")
    yield cluster
    cluster.stop()


@pytest.fixture(scope="module")
def smoke(cluster, tmp_path_factory):
    """The smoke study by SLURM, two of whose jobs were ended from outside, by ``scancel`` and by kill -9 of a process: (tree, output, what the killed
    training had logged)."""
    tree = make_tree(tmp_path_factory.mktemp("smoke") / "tree")
    study = (tree / SMOKE).read_text()
    assert study.count("    timing:") == 1
    (tree / SMOKE).write_text(study.replace("    timing:", "    resources: {mem_mb: 3500, runtime: 30}\n    timing:"))
    results = tree / "results" / "smoke"
    settings = {"program": PROGRAM, "environment": cluster.environment, "study": SMOKE}
    with open(tree / "output", "w+") as output:
        process = begin_snakemake(tree, *PROFILE, stdout=output, **settings)
        try:
            wait(process, lambda: any(results.rglob("train/shard-*.h5")))
            cluster.ask("scancel", job_of(cluster, "learning_data"))
            wait(process, lambda: (results / "training" / "gns" / "seed-0" / "checkpoint.pt").exists())
            logged = (results / "training" / "gns" / "seed-0" / "log.csv").read_text().splitlines()[:2]
            os.kill(training(tree), signal.SIGKILL)
            assert process.wait(timeout=900) == 0, (tree / "output").read_text()
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    return tree, (tree / "output").read_text(), logged


def wait(process: subprocess.Popen, ready) -> None:
    deadline = time.monotonic() + 600
    while not ready():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)


def job_of(cluster: Cluster, rule: str) -> str:
    """Number of the running job of a rule."""
    jobs = dict(line.split() for line in cluster.ask("squeue", "--noheader", "--states=running", "--format=%k %i").splitlines())
    (number,) = [number for comment, number in jobs.items() if comment.startswith(f"rule_{rule}")]
    return number


def training(tree) -> int:
    """The process that trains the GNS in a tree."""
    for process in psutil.process_iter(["cmdline", "cwd"]):
        line = process.info["cmdline"] or []
        if line[1:4] == ["-m", "learn", "train"] and "results/smoke/training/gns/seed-0" in line and process.info["cwd"] == str(tree):
            return process.pid
    raise AssertionError("no such process")


def asked(cluster: Cluster, output: str, rule: str) -> dict[str, str]:
    """What the last job of a rule asked SLURM for."""
    number = re.findall(rf"SLURM jobid (\d+) \(log: \S*/rule_{rule}/", output)[-1]
    return dict(field.split("=", 1) for field in cluster.ask("scontrol", "show", "job", number).split() if "=" in field)


def test_the_smoke_study_ends_well_though_jobs_are_killed(smoke):
    tree, output, logged = smoke
    assert (tree / "results" / "smoke" / "report.html").stat().st_size > 10_000
    assert re.search(r"(\d+) of \1 steps \(100%\) done", output)
    assert "SLURM status is: 'CANCELLED'" in output and "SLURM status is: 'FAILED'" in output and output.count("Trying to restart job") == 2
    rows = (tree / "results" / "smoke" / "training" / "gns" / "seed-0" / "log.csv").read_text().splitlines()
    assert rows[:2] == logged  # times and all: it went on at its checkpoint


def test_results_are_those_of_a_local_run(smoke, tmp_path):
    local = make_tree(tmp_path / "local")
    code, output = snakemake(local, "results/smoke/models/gns/seed-0.pt", "results/smoke/data/sand/test.json", study=SMOKE)
    assert code == 0, output
    here, there = promised(local / "results" / "smoke"), promised(smoke[0] / "results" / "smoke")
    assert sum(name.endswith(".h5") for name in here) == 4 and "models/gns/seed-0.pt" in here and "training/gns/seed-0/log.csv" in here
    assert {name: there.get(name) for name in here} == here


def test_jobs_ask_for_what_they_need(cluster, smoke):
    data, timing = asked(cluster, smoke[1], "learning_data"), asked(cluster, smoke[1], "timing")
    assert (data["NumCPUs"], data["MinMemoryNode"], data["TimeLimit"]) == ("2", "2000M", "01:00:00")
    assert data["OverSubscribe"] == "OK" and timing["OverSubscribe"] == "NO"  # a timing has its machine for itself
    for rule in ("errors", "timing", "rollouts"):
        job = asked(cluster, smoke[1], rule)
        assert (job["MinMemoryNode"], job["TimeLimit"]) == ("3500M", "00:30:00"), rule


BROKEN = MICRO_STUDY.replace("seeds: [0]}", "seeds: [0], resources: {gpus: 2, threads: 1, mem_mb: 3000, runtime: 90}}", 1)


def test_a_failure_is_reported_and_gpus_are_asked_for(cluster, tmp_path):
    tree = make_tree(tmp_path / "tree")
    study = "configs/studies/broken.yaml"
    (tree / study).write_text(BROKEN)
    config = tree / "configs" / "models" / "micro_gns.yaml"
    config.write_text(config.read_text().replace("batch: 2", "batch: 0"))  # which the trainer finds, not the study
    settings = {"program": PROGRAM, "environment": cluster.environment, "study": study}
    code, output = snakemake(tree, "results/broken/models/gns/seed-0.pt", *PROFILE, "--retries", "0", **settings)
    assert code == 1 and "Error in rule train" in output and "SLURM status is: 'FAILED'" in output
    assert "log: results/broken/logs/train/gns-0.log, " in output and "training.batch = 0" in output  # where to look, and what is there
    (log,) = (tree / ".snakemake" / "slurm_logs" / "rule_train").rglob("*.log")
    assert str(log) in output
    job = asked(cluster, output, "train")
    assert (job["TresPerJob"], job["NumCPUs"], job["NumNodes"]) == ("gres:gpu:2", "2", "1")
    assert (job["MinMemoryNode"], job["TimeLimit"]) == ("3000M", "01:30:00")
    assert "nproc-per-node 2" in output and "--device cuda" in output
