"""Folders of resumable work: kept for the same recipe, emptied for another, never written by two jobs."""

import subprocess
import sys
import time

from study_tree import ROOT


def keep(folder, recipe: str, command: str) -> subprocess.Popen:
    arguments = [sys.executable, "-m", "workflow.scripts.keep", str(folder), recipe, "--", "bash", "-c", command]
    return subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, text=True)


def test_work_is_kept_for_its_recipe_alone(tmp_path):
    folder = tmp_path / "deep" / "run"
    add = f"mkdir -p {folder} && echo x >> {folder}/work"
    for recipe, lines in (("a", 1), ("a", 2), ("b", 1), ("a", 1)):
        assert keep(folder, recipe, add).wait() == 0
        assert (folder / "work").read_text() == "x\n" * lines


def test_exit_code_is_the_commands(tmp_path):
    assert keep(tmp_path / "run", "a", "exit 7").wait() == 7


def test_a_second_job_waits_for_the_first_however_it_ends(tmp_path):
    folder = tmp_path / "run"
    first = keep(folder, "a", f"mkdir -p {folder}; touch {folder}/begun; exec sleep 60")
    while not (folder / "begun").exists():
        assert first.poll() is None
        time.sleep(0.05)
    second = keep(folder, "a", f"touch {folder}/second")
    assert "waiting" in second.stderr.readline()
    assert not (folder / "second").exists()
    first.kill()
    assert second.wait(30) == 0 and (folder / "second").exists()
