"""One study from nothing to its report; what an edit makes again; resuming after kill -9."""

import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest
import torch
from browser import check, needs_browser
from study_tree import begin_snakemake, make_tree, planned, promised, snakemake

sys.path.insert(0, str(Path(__file__).parents[1]))

from disks import small_disk  # noqa: E402

pytestmark = pytest.mark.workflow

ROW_KEYS = {
    "scene",
    "contender",
    "kind",
    "settings",
    "one_step_mse",
    "rollout_mse",
    "rollout_mse_moving",
    "seconds_per_frame",
    "seconds_per_simulated_second",
    "compile_seconds",
    "spread",
}
KINDS = {"reference": 1, "solver": 2, "learned": 2, "trivial": 5, "oracle": 1, "floor": 1}
PICTURES = {"figures", "speed_ups", "film", "strip", "training_curve"}


def refuse(constant: str):
    raise ValueError(f"{constant} is not JSON")


@pytest.fixture(scope="module")
def summary(finished) -> dict:
    return json.loads((finished / "results" / "micro" / "summary.json").read_text(), parse_constant=refuse)


def test_summary_holds_what_it_promises(summary):
    assert {"rows", "hardware", "versions", "verdict", "analysis"} <= summary.keys()
    rows = summary["rows"]
    assert {kind: sum(row["kind"] == kind for row in rows) for kind in KINDS} == KINDS
    assert len({row["contender"] for row in rows}) == len(rows) == sum(KINDS.values())
    for row in rows:
        assert row.keys() >= ROW_KEYS and row["scene"] == "puddle"
        for key in ("rollout_mse", "rollout_mse_moving"):
            assert list(row[key]) == ["1", "5", "all"]
        assert len(row["spread"]["per_trajectory"]) == 2
    assert summary["hardware"]["cpu"] and summary["versions"]["taichi"]


def test_the_yardsticks_are_in_order(summary):
    rows = {row["contender"]: row for row in summary["rows"]}
    assert rows["teacher"]["rollout_mse"]["all"] == 0
    assert rows["oracle"]["rollout_mse"]["all"] < 1e-12
    assert rows["cfl 0.8"]["rollout_mse"]["all"] > 0
    for name in ("teacher", "cfl 0.8", "grid 2x coarser", "gns", "grid", "ballistic"):
        assert rows[name]["timing_spread"]["n"] == 5, name
    for name in ("gns", "grid"):
        assert rows[name]["settings"]["seeds"] == [0]
        assert rows[name]["cost"]["trajectories"] == 2 and rows[name]["cost"]["training_seconds"] > 0
    assert "Missed: gns on puddle" in summary["verdict"]


def test_the_report_stands_alone_and_has_a_page_a_scene(finished, summary):
    results = finished / "results" / "micro"
    entry, page = (results / "report.html").read_text(), (results / "report" / "puddle.html").read_text()
    text = re.sub(r"<[^>]+>|\s+", " ", entry)
    assert summary["verdict"][:60] in text.replace("&#39;", "'")
    for each in (entry, page):
        assert not re.findall(r"""(?:src|poster)=["'](?!data:)""", each) and "<script" not in each and "@import" not in each
    assert set(re.findall(r'href="([^"]*)"', entry)) == {"report/puddle.html"} and 'id="puddle"' in entry and 'id="provenance"' in entry
    assert set(re.findall(r'href="([^"]*)"', page)) == {"../report.html#puddle", "../report.html#provenance"}
    assert entry.count("data:video/mp4") == 0 and entry.count("data:image/svg+xml") == 2 and entry.count("data:image/png") == 1
    assert page.count("data:video/mp4") == 1 and page.count("data:image/svg+xml") == 4 and page.count("data:image/png") == 2
    ones = ("learning_data", "test_data", "errors", "timing", "rollouts", "film", "strip", "figures", "training_curve", "speed_ups")
    assert {job["rule"]: job["jobs"] for job in summary["jobs"]} == dict.fromkeys(ones, 1) | {"train": 2}
    assert "micro_gns.yaml" in text and "snakemake --config study=configs/studies/micro.yaml" in text


@needs_browser
def test_the_report_in_a_browser(finished, tmp_path):
    results = finished / "results" / "micro"
    assert len(check(results / "report.html", tmp_path).media) == 3
    assert len(check(results / "report" / "puddle.html", tmp_path).media) == 7  # the film's poster is one of them


def test_snakemake_makes_a_report_of_its_own(finished, tmp_path):
    code, output = snakemake(finished, "--report", str(tmp_path / "own.html"))
    assert code == 0 and "downloading" not in output, output
    page = (tmp_path / "own.html").read_text()
    for name in ("report.html", "puddle.html", "grid.mp4", "error_over_run_time.svg", "speed_ups.svg"):
        assert f"filename={name};" in page, name
    assert "seconds a frame, one thread each" in page


def test_every_job_leaves_log_and_benchmark(finished):
    results = finished / "results" / "micro"
    logs = {path.relative_to(results / "logs").with_suffix("") for path in (results / "logs").rglob("*.log")}
    benchmarks = {path.relative_to(results / "benchmarks").with_suffix("") for path in (results / "benchmarks").rglob("*.tsv")}
    assert logs == benchmarks and len(logs) == 13


def test_nothing_is_made_twice(finished):
    assert planned(finished) == {}


# What an edit makes again: a dry run on a copy of the finished tree ---------------------------------------------------------


def append(path: Path, text: str = "\nEDITED = True\n") -> None:
    path.write_text(path.read_text() + text)


def replace(path: Path, old: str, new: str) -> None:
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))


EDITS = {
    "solver": (
        lambda tree: append(tree / "sim" / "mpm" / "solver.py"),
        {"learning_data", "test_data", "train", "errors", "timing", "rollouts", "report", *PICTURES},
    ),
    "other solvers": (lambda tree: [append(tree / "sim" / name) for name in ("sph/wcsph.py", "sph/dfsph.py", "pbd/solver.py")], set()),
    "comment": (lambda tree: append(tree / "sim" / "mpm" / "solver.py", "\n# a comment\n"), set()),
    "network": (lambda tree: append(tree / "learn" / "gns.py"), {"train", "errors", "timing", "rollouts", "report", *PICTURES}),
    "grid emulator": (lambda tree: append(tree / "learn" / "grid_emulator.py"), {"train", "errors", "timing", "rollouts", "report", *PICTURES}),
    "metrics": (lambda tree: append(tree / "learn" / "metrics.py"), {"train", "errors", "timing", "rollouts", "report", *PICTURES}),
    "scene": (
        lambda tree: replace(tree / "configs" / "scenes" / "puddle.yaml", "sound_speed: 6.0", "sound_speed: 7.0"),
        {"learning_data", "test_data", "train", "errors", "timing", "rollouts", "report", *PICTURES},
    ),
    "model": (
        lambda tree: replace(tree / "configs" / "models" / "micro_gns.yaml", "latent: 8", "latent: 9"),
        {"train", "errors", "timing", "rollouts", "report", *PICTURES},
    ),
    "rendering": (lambda tree: append(tree / "sim" / "render.py"), {"film", "strip", "report"}),
    "template": (lambda tree: append(tree / "learn" / "report_template.html", "<!-- edited -->"), {"report"}),
    "figures": (lambda tree: append(tree / "learn" / "figures.py"), {"figures", "speed_ups", "training_curve", "report"}),
    "report": (lambda tree: append(tree / "learn" / "report.py"), {"report"}),
    "target": (lambda tree: replace(tree / "configs" / "studies" / "micro.yaml", "1.0e-12", "1.0"), {"report"}),
    "rung": (
        lambda tree: replace(tree / "configs" / "studies" / "micro.yaml", "cfl: 0.8", "cfl: 0.9"),
        {"errors", "timing", "rollouts", "figures", "speed_ups", "film", "strip", "report"},
    ),
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_makes_again_what_it_must(copied, name):
    change, expected = EDITS[name]
    change(copied)
    jobs = planned(copied)
    assert set(jobs) == expected
    if name in ("network", "grid emulator", "model"):
        assert jobs["train"] == 1  # the other model is as it was


# Devices --------------------------------------------------------------------------------------------------------------------


def test_a_study_chooses_device_and_processes(copied):
    study = copied / "configs" / "studies" / "micro.yaml"
    plain = "gns: {config: configs/models/micro_gns.yaml, data: puddle, seeds: [0]}"
    replace(study, plain, plain[:-1] + ", resources: {gpus: 2, threads: 2, mem_mb: 3000, runtime: 5}}")
    replace(study, "train: 2, valid: 1", "resources: {threads: 2}, train: 2, valid: 1")
    replace(study, "    films: [grid]", "    resources: {gpus: 1}\n    films: [grid]")
    assert planned(copied) == {}  # what runs where is no part of the result

    def command(*options, target="models/gns/seed-0.pt", program="-m learn train"):
        code, output = snakemake(copied, f"results/micro/{target}", "--dry-run", "--printshellcmds", "--force", *options)
        assert code == 0, output
        return re.search(rf"Shell command: (.* {program} .*)", output)[1]

    one = command()  # of a machine that is not said to have more
    assert "--threads 2 --device cuda" in one and "torch.distributed" not in one
    several = command("--resources", "gpu=4", "--cores", "4")
    assert "-m torch.distributed.run --standalone --nproc-per-node 2 -m learn train" in several and "--threads 2 --device cuda" in several
    replace(study, "gpus: 2, threads: 2", "gpus: 0")
    none = command()
    assert "--threads 1 --device cpu" in none and "torch.distributed" not in none
    compared = {"target": "comparisons/puddle/errors.json", "program": "-m workflow.scripts.errors"}
    filmed = {"target": "comparisons/puddle/rollouts", "program": "-m workflow.scripts.rollouts"}
    assert "errors.json cuda" in command(**compared) and "puddle cuda" in command(**filmed)
    if not torch.cuda.is_available():
        script = [sys.executable, "-m", "workflow.scripts.errors", "configs/studies/micro.yaml", "puddle", "errors.json", "cuda"]
        refused = subprocess.run(script, cwd=copied, capture_output=True, text=True)
        assert refused.returncode == 2 and "comparisons.puddle.resources.gpus = 1: this machine has no CUDA device" in refused.stderr
        assert len(refused.stderr.splitlines()) == 1 and not (copied / "errors.json").exists()
    replace(study, "gpus: 1", "gpus: 0")
    assert "errors.json cpu" in command(**compared) and "puddle cpu" in command(**filmed)
    # The command of two GPUs, on two CPU processes.
    shutil.rmtree(copied / "results" / "micro" / "training" / "gns")
    made = subprocess.run(several.replace("--threads 2 --device cuda", "--device cpu"), shell=True, cwd=copied, executable="/bin/bash")
    done = json.loads((copied / "results" / "micro" / "models" / "gns" / "seed-0.json").read_text())
    assert made.returncode == 0 and (done["processes"], done["device"], done["steps"]) == (2, "cpu", 300)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_missing_gpu_is_missed_before_the_data_are_made(copied):
    study, model = copied / "configs" / "studies" / "micro.yaml", copied / "configs" / "models" / "micro_gns.yaml"
    data, remedy = "results/micro/data/puddle/learning.json", "this machine has no CUDA device that torch can use; leave it out, or run on a machine"
    shutil.rmtree(copied / "results")
    plain = "gns: {config: configs/models/micro_gns.yaml, data: puddle, seeds: [0]}"
    gpu, films = plain[:-1] + ", resources: {gpus: 1}}", "    films: [grid]"
    asked = [
        (study, plain, gpu, "configs/studies/micro.yaml: models.gns.resources.gpus = 1"),
        (model, "training: {", "training: {device: cuda, ", "configs/models/micro_gns.yaml: training.device = 'cuda'"),
        (study, films, f"    resources: {{gpus: 1}}\n{films}", "configs/studies/micro.yaml: comparisons.puddle.resources.gpus = 1"),
    ]
    for file, old, new, fault in asked:
        replace(file, old, new)
        code, output = snakemake(copied)
        assert code == 2 and output.splitlines()[-1].startswith(f"sluice: {fault}: {remedy}"), output
        assert "Traceback" not in output and not (copied / data).exists()
        replace(file, new, old)
    replace(study, plain, gpu)
    code, output = snakemake(copied, data)  # asks for none
    assert code == 0 and (copied / data).exists(), output


ON_A_DEVICE = """
import torch
from other_device import OtherDevice

from workflow.scripts import errors, rollouts

torch.cuda.is_available, torch.cuda.get_device_name = lambda: True, lambda: "none at all"
study = "configs/studies/micro.yaml"
with OtherDevice():
    errors.main(study, "puddle", "errors.json", "cuda")
    rollouts.main(study, "puddle", "cuda", "errors.json", "truth.h5", "grid.h5")
"""


def test_a_comparison_on_a_device_is_that_of_the_cpu(copied):
    """On the made-up device of ``tests/learn/other_device.py``, as no GPU is needed to test here."""
    paths = os.pathsep.join([str(Path(__file__).parents[1] / "learn"), str(copied)])
    done = subprocess.run([sys.executable, "-c", ON_A_DEVICE], cwd=copied, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads((copied / "errors.json").read_text())
    wanted = json.loads((copied / "results" / "micro" / "comparisons" / "puddle" / "errors.json").read_text())
    for row, other in zip(found, wanted, strict=True):
        assert (row["contender"], row["runs"], row["failures"]) == (other["contender"], other["runs"], other["failures"])
        if row["kind"] == "learned":
            assert row["settings"]["rolled out on"] == "none at all" and row["seconds_per_frame"] is None and other["seconds_per_frame"] > 0
            told = [row["mean"], row["spread"]["min"], row["spread"]["max"], *row["spread"]["per_seed"], *row["spread"]["per_trajectory"]]
            assert {figures["seconds_per_frame"] for figures in told} == {None}
            for name in ("one_step_mse", "rollout_mse_moving", "spacing_ratio"):
                assert row[name] == pytest.approx(other[name], rel=1e-3)
    assert [row["contender"] for row in found if row["kind"] == "learned"] == ["gns", "grid"]
    with h5py.File(copied / "grid.h5") as film:
        (group,) = film.values()
        assert json.loads(group.attrs["meta"])["simulator"]["settings"]["rolled out on"] == "none at all"


# Resuming -------------------------------------------------------------------------------------------------------------------


def kill_when(tree: Path, ready) -> None:
    """Start the micro study and end the whole group by SIGKILL, as a power cut would, once ``ready()``."""
    process = begin_snakemake(tree)
    try:
        deadline = time.monotonic() + 600
        while not ready():
            assert process.poll() is None and time.monotonic() < deadline, process.stdout.read()
            time.sleep(0.02)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()


def test_resume_after_kill_9(tree):
    results = tree / "results" / "micro"
    run = results / "training" / "gns" / "seed-0"
    kill_when(tree, lambda: (run / "checkpoint.pt").exists())
    assert not (results / "models" / "gns" / "seed-0.pt").exists()
    rows = (run / "log.csv").read_text().splitlines()[:4]
    shards = {path: path.stat().st_mtime_ns for path in results.rglob("shard-*.h5")}
    assert len(rows) == 4 and shards
    code, output = snakemake(tree, f"{results.relative_to(tree)}/models/gns/seed-0.pt")
    assert code == 0, output
    assert (run / "log.csv").read_text().splitlines()[:4] == rows  # it went on, times and all, instead of beginning again
    assert json.loads((results / "models" / "gns" / "seed-0.json").read_text())["steps"] == 300
    assert {path: path.stat().st_mtime_ns for path in shards} == shards


def end(process: subprocess.Popen) -> None:
    """End by SIGKILL all that is left of a run, and see it gone."""
    deadline = time.monotonic() + 10
    with contextlib.suppress(ProcessLookupError):
        while time.monotonic() < deadline:
            os.killpg(process.pid, signal.SIGKILL)
            process.poll()
            time.sleep(0.01)


def test_killed_at_random_instants_it_ends_with_the_same_results(finished, tmp_path, request):
    """By turns all processes at once, as by a power cut, and Snakemake alone, whose jobs go on beside the next run; as ``make resume`` goes on."""
    kills, draw = request.config.getoption("--kills"), random.Random(0)
    # Twice the time that each has on average: some instants are early, some late, and what ends before its instant is begun anew.
    longest = 2 * float((finished / "seconds").read_text()) / kills
    unbroken = promised(finished / "results" / "micro")
    at, runs, begun, tree = [], 0, [], None
    try:
        while tree or len(at) < kills:
            if not tree:
                tree, runs = make_tree(tmp_path / f"tree-{runs}"), runs + 1
            with open(tmp_path / "output", "w") as output:
                begun.append(begin_snakemake(tree, stdout=output))
            try:
                code = begun[-1].wait(draw.uniform(0, longest) if len(at) < kills else 600)
            except subprocess.TimeoutExpired:
                at.append(len(list((tree / "results").rglob("*.tsv"))))
                if len(at) % 2:
                    end(begun[-1])
                else:
                    begun[-1].kill()
                    begun[-1].wait()
                continue
            assert code == 0, (tmp_path / "output").read_text()
            assert promised(tree / "results" / "micro") == unbroken
            tree = None
    finally:
        for process in begun:
            end(process)
    assert len(at) == kills
    print(f"\nkilled when {', '.join(map(str, at))} of {len(list((finished / 'results').rglob('*.tsv')))} jobs were done, in {runs} runs")


# A full disk ----------------------------------------------------------------------------------------------------------------


def test_the_report_on_a_full_disk(finished, tmp_path):
    """Under the summary, the pages, the entry: one line in the job's log, nothing half written, and with room the same pages."""
    made, disk = finished / "results" / "micro", tmp_path / "disk"
    command = [sys.executable, "-m", "workflow.scripts.summary", "configs/studies/micro.yaml", disk / "summary.json", disk / "report.html"]

    def write():
        done = subprocess.run(command, cwd=finished, capture_output=True, text=True)
        return done.returncode, done.stderr

    with small_disk(disk) as leave:
        summary, page, entry = ((made / name).stat().st_size for name in ("summary.json", "report/puddle.html", "report.html"))
        for free, name, left in (
            (4096, "summary.json", []),
            (summary + page // 2, "report", ["summary.json"]),
            (page + entry // 2, "report.html", ["summary.json", "report"]),  # the summary is there, and makes way for its like
        ):
            leave(free)
            assert write() == (1, f"sluice: {disk / name}: No space left on device\n")
            assert sorted(os.listdir(disk)) == sorted(["filler", *left])
        leave(None)
        assert write() == (0, "")
        for name in ("report.html", "report/puddle.html"):
            assert (disk / name).read_bytes() == (made / name).read_bytes()


# A shipped checkpoint -------------------------------------------------------------------------------------------------------

SHIPPED = """
title: "Shipped"
data:
  puddle: {scene: configs/scenes/puddle.yaml, seed: 1, test: 1}
models:
  shipped: {checkpoint: pretrained/puddle/best.pt}
comparisons:
  puddle:
    data: puddle
    trajectories: 1
    ladder: [{name: "cfl 0.8", cfl: 0.8}]
    learned: [shipped]
    timing: {frames: 5}
    films: []
    generalisation: {over: particles}
"""


def test_a_checkpoint_is_compared_without_training(copied):
    results, shipped = copied / "results" / "micro", copied / "pretrained" / "puddle"
    shipped.mkdir(parents=True)
    for name in ("best.pt", "done.json", "log.csv", "validation.csv"):
        shutil.copy2(results / "training" / "gns" / "seed-0" / name, shipped)
    shutil.copy2(results / "data" / "puddle" / "learning.json", shipped / "dataset.json")
    (copied / "configs" / "studies" / "shipped.yaml").write_text(SHIPPED)
    code, output = snakemake(copied, study="configs/studies/shipped.yaml")
    assert code == 0, output
    made = json.loads((copied / "results" / "shipped" / "summary.json").read_text())
    (row,) = [row for row in made["rows"] if row["kind"] == "learned"]
    assert row["contender"] == "shipped" and row["status"] == "ok" and row["cost"]["steps"] == 300
    page = (copied / "results" / "shipped" / "report.html").read_text()
    assert "data:video" not in page and page.count("data:image/svg+xml") == 3  # speed-ups, beyond the training, error over run time
    scene = (copied / "results" / "shipped" / "report" / "puddle.html").read_text()
    assert "data:video" not in scene and scene.count("data:image/svg+xml") == 5  # four figures and the curve of the shipped training
    assert "Median MSE of the rollout, and as a multiple of the best trivial baseline&#39;s. shipped: puddle" in page
