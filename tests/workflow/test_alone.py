"""Two runs of one study at once: the second is refused in a line; a run that was killed stands in nobody's way."""

import os
import signal
import subprocess
import sys
import time

import pytest
from study_tree import ROOT, begin_snakemake, planned, snakemake

from sim.errors import InputError
from workflow.alone import hold

HOLD = """
import sys, time
from pathlib import Path
from workflow.alone import hold
hold(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(60)
"""


def begin(folder) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_study_is_held_by_one_process_until_it_ends(tmp_path):
    first, other = begin(tmp_path / "results/a"), begin(tmp_path / "results/b")
    try:
        assert first.stdout.readline() == other.stdout.readline() == "held\n", "another study has a folder of its own"
        refused = begin(tmp_path / "results/a")
        said = f"another run is at work on it (process {first.pid}); wait for its end, or end it after its running jobs: kill {first.pid}"
        assert refused.communicate(timeout=60)[1].splitlines()[-1].endswith(f"a: study = 'a': {said}")
        assert sorted(os.listdir(tmp_path / "results")) == [".a.lock", ".b.lock"]
        first.kill()
        first.wait()
        second = begin(tmp_path / "results/a")
        try:
            assert second.stdout.readline() == "held\n"
        finally:
            second.kill()
            second.communicate()
    finally:
        for process in (first, other):
            process.kill()
            process.communicate()


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "results").touch()
    with pytest.raises(InputError, match=r"results cannot be written or locked \(File exists\); mend that"):
        hold(tmp_path / "results/a")


@pytest.mark.workflow
def test_a_second_run_of_a_study_is_refused(tree):
    """By one line, whatever the run is told to do; only a dry run, which changes nothing, may look on."""
    first, lock = begin_snakemake(tree), tree / "results/.micro.lock"
    try:
        while not (lock.is_file() and lock.read_text()):
            assert first.poll() is None
            time.sleep(0.05)
        for options in ((), ("--unlock",)):
            code, output = snakemake(tree, *options)
            lines = [line for line in output.splitlines() if line.strip() and not line.startswith("Using ")]
            assert code == 2 and len(lines) == 1, output
            assert lines[0].startswith(f"sluice: results/micro: study = 'micro': another run is at work on it (process {first.pid}); wait")
        assert first.poll() is None and planned(tree) and snakemake(tree, "-nq")[0] == 0
    finally:
        os.killpg(first.pid, signal.SIGKILL)
        first.communicate()
