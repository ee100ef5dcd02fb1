"""A copy of the tree in which a test may edit sources and make results, and the smallest study that has every part."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
PARTS = ("Snakefile", "profiles", "workflow", "configs", "pretrained", "sim", "learn")

MICRO_SCENE = """
name: puddle
dim: 2
bounds: [[0.1, 0.9], [0.1, 0.9]]
gravity: [0.0, -9.8]
frame_step: 0.005
frames: 24
radius: 0.075
cells: [16, 16]
particles_per_cell: 1
jitter: 0.2
materials:
  water: {model: water, sound_speed: 6.0}
bodies:
  - material: water
    shape: {kind: box, size: [[0.25, 0.35], [0.25, 0.35]]}
    center: [[0.4, 0.6], [0.3, 0.35]]
splits: {train: 2, valid: 1, test: 2}
variants:
  larger: {bounds: [[0.1, 1.7], [0.1, 1.7]], cells: [32, 32]}
"""

MICRO_GNS = """
model: gns
settings: {latent: 8, message_passing: 1, history: 2, edge_cap: 100.0, ballistic: true}
training: {steps: 300, batch: 2, validations: 1, validation_trajectories: 1, validation_frames: 4, log_every: 5, checkpoint_every: 20}
"""

MICRO_GRID = """
model: grid_emulator
settings: {frames_per_call: 2, channels: [8], unroll: [1]}
training: {steps: 6, batch: 1, validations: 1, validation_trajectories: 1, validation_frames: 4}
"""

MICRO_STUDY = """
title: "Micro"
data:
  puddle: {scene: configs/scenes/puddle.yaml, train: 2, valid: 1, test: 2}
models:
  gns: {config: configs/models/micro_gns.yaml, data: puddle, seeds: [0]}
  grid: {config: configs/models/micro_grid.yaml, data: puddle, seeds: [0]}
comparisons:
  puddle:
    data: puddle
    trajectories: 2
    horizons: [1, 5]
    ladder:
      - {name: "cfl 0.8", cfl: 0.8}
      - {name: "grid 2x coarser", particles: recorded, coarsen: 2.0}
    learned: [gns, grid]
    timing: {frames: 10, repeats: 5}
    films: [grid]
    targets:
      - {contender: gns, metric: rollout_mse_moving, at: all, high: 1.0e-12}
"""


def make_tree(folder: Path) -> Path:
    """A copy of what a study runs from, with the micro study as ``configs/studies/micro.yaml``."""
    for part in PARTS:
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            folder.mkdir(exist_ok=True)
            shutil.copy2(ROOT / part, folder / part)
    # As Taichi's, below: kernels of the checkout, which are not what is tested.
    (ROOT / ".kernel_cache").mkdir(exist_ok=True)
    (folder / ".kernel_cache").symlink_to(ROOT / ".kernel_cache")
    (folder / "configs" / "scenes" / "puddle.yaml").write_text(MICRO_SCENE)
    (folder / "configs" / "models" / "micro_gns.yaml").write_text(MICRO_GNS)
    (folder / "configs" / "models" / "micro_grid.yaml").write_text(MICRO_GRID)
    (folder / "configs" / "studies" / "micro.yaml").write_text(MICRO_STUDY)
    return folder


def begin_snakemake(
    folder: Path,
    *options: str,
    study: str = "configs/studies/micro.yaml",
    program: tuple = ("-m", "snakemake"),
    environment: dict | None = None,
    stdout=subprocess.PIPE,
) -> subprocess.Popen:
    """Snakemake in a tree, in a process group of its own; on two cores, unless a profile is named."""
    # Compiled kernels are shared with the checkout: what is tested is the workflow, not the compiler.
    environment = os.environ | {"SLUICE_TAICHI_CACHE": str(ROOT / ".taichi_cache")} | (environment or {})
    cores = () if "--workflow-profile" in options else ("--cores", "2")
    command = [sys.executable, *program, *cores, *options, "--config", f"study={study}"]
    return subprocess.Popen(command, cwd=folder, env=environment, text=True, stdout=stdout, stderr=subprocess.STDOUT, start_new_session=True)


def snakemake(folder: Path, *options: str, **settings) -> tuple[int, str]:
    """(exit code, output)."""
    process = begin_snakemake(folder, *options, **settings)
    output, _ = process.communicate(timeout=900)
    return process.returncode, output


def planned(folder: Path, *options: str, study: str = "configs/studies/micro.yaml") -> dict[str, int]:
    """Rule -> number of jobs that a dry run would do, ``all`` left out."""
    code, output = snakemake(folder, "--dry-run", *options, study=study)
    assert code == 0, output
    if "Job stats:" not in output:
        return {}
    table = output.split("Job stats:")[1].strip().splitlines()[2:]
    rows = [line.split() for line in table[: next(i for i, line in enumerate(table) if line.startswith("total"))]]
    return {rule: int(count) for rule, count in rows if rule != "all"}


def promised(results: Path) -> dict[str, object]:
    """What any two runs of a study have in common to the bit, however often they were killed and wherever they ran: name -> content.

    Trajectory files whole; of models the weights, of tables and rows what is not a time.
    """
    import torch

    kept = {}
    for path in sorted(results.rglob("*")):
        name = str(path.relative_to(results))
        if path.suffix == ".h5":
            kept[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.suffix == ".pt" and path.name != "checkpoint.pt":
            weights = torch.load(path, weights_only=True)["state_dict"]
            kept[name] = {key: hashlib.sha256(weight.numpy().tobytes()).hexdigest() for key, weight in weights.items()}
        elif path.suffix == ".csv":
            kept[name] = [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(path.read_text().splitlines())]
        elif path.name == "errors.json":
            kept[name] = _without_times(json.loads(path.read_text()))
    return kept


def _without_times(rows):
    """All that a row tells but run times."""
    if isinstance(rows, list):
        return [_without_times(row) for row in rows]
    if isinstance(rows, dict):
        return {key: _without_times(value) for key, value in rows.items() if not key.startswith("seconds_per_")}
    return rows
