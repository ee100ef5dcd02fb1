"""From the files of finished jobs to the summary and the pictures of a report."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np

from learn.compare import Target, Yardstick, analyse, verdict
from learn.report import Asset, SceneAssets
from workflow.rows import timed_rows
from workflow.study import PARTS, Study


def _read(path: str | Path) -> dict:
    return json.loads(Path(path).read_text())


def _cost(study: Study, model: str) -> dict | None:
    """What data and training of a model took; of a checkpoint, what is shipped beside it says so (``dataset.json``, ``done.json``)."""
    entry = study.models[model]
    if "checkpoint" in entry:
        folder = Path(entry["checkpoint"]).parent
        content, done = folder / "dataset.json", [folder / "done.json"]
        if not (content.is_file() and done[0].is_file()):
            return None
    else:
        content = study.data_stamp(entry["data"], "learning")
        done = [path.with_suffix(".json") for path in study.model_files(model)]
    splits = _read(content)["splits"]
    runs = [_read(path) for path in done]
    return {
        "generation_seconds": sum(sum(splits[split]["cost"].values()) for split in PARTS["learning"] if split in splits),
        "training_seconds": float(np.mean([run["seconds"] for run in runs])),
        "trajectories": splits["train"]["ok"], "parameters": runs[0]["parameters"], "steps": int(np.mean([run["steps"] for run in runs])),
        "device": runs[0]["device"],
    }


def _targets(study: Study, comparison: str, scene: str) -> list[Target]:
    targets = []
    for entry in study.comparisons[comparison]["targets"]:
        limits = {key: entry[key] for key in ("high", "low", "relative_to") if key in entry}
        yardstick = Yardstick(entry["metric"], str(entry["at"]) if "at" in entry else None, entry.get("over", "median"))
        targets.append(Target(scene, entry["contender"], yardstick, **limits))
    return targets


def how_to_repeat(study: Study) -> dict[str, str]:
    """How to make the report again, and of which revision it is where Git knows."""
    facts = {"study": str(study.path), "command": f"snakemake --config study={study.path}"}
    git = subprocess.run(["git", "describe", "--always", "--dirty", "--abbrev=12"], capture_output=True, text=True)
    if git.returncode == 0:
        facts["revision"] = git.stdout.strip()
    return facts


def _provenance(study: Study) -> dict:
    data = {
        name: {key: entry[key] for key in ("scene", "variant", "frames", "seed", "train", "valid", "test") if key in entry}
        for name, entry in study.data.items()
    }
    return {"how to repeat": how_to_repeat(study), "data": data, "models": study.models}


def summarise(study: Study) -> dict:
    """The content of ``summary.json``: rows, hardware, versions, and what follows from the rows."""
    rows, targets, machines, versions = [], [], {}, {}
    for comparison, entry in study.comparisons.items():
        places = [study.comparison_file(comparison, name) for name in ("errors.json", "timing.json")]
        timed = timed_rows(*places)
        costs = {model: _cost(study, model) for model in entry["learned"]}
        rows += [row | {"cost": costs[row["contender"]]} if costs.get(row["contender"]) else row for row in timed]
        targets += _targets(study, comparison, timed[0]["scene"])
        measured = _read(places[1])
        machines[comparison], versions = measured["hardware"], measured["versions"]
    hardware = next(iter(machines.values()))
    provenance = _provenance(study)
    if any(machine != hardware for machine in machines.values()):
        # Each comparison is timed on one machine, but a cluster may give another one to the next.
        provenance["timed on"] = machines
    return {
        "title": study.content["title"], "rows": rows, "hardware": hardware, "versions": versions, "analysis": analyse(rows),
        "verdict": verdict(rows, targets), "provenance": provenance,
    }


def assets(study: Study, summary: dict) -> dict[str, SceneAssets]:
    """Scene -> its pictures, as the rules made them."""
    result = {}
    for comparison, entry in study.comparisons.items():
        scene = study.families[entry["data"]].model.name

        def picture(name: str, comparison: str = comparison) -> Path:
            return study.picture(comparison, name)

        count = next(row["trajectories"] for row in summary["rows"] if row["scene"] == scene)
        films = [
            Asset(
                picture(f"{model}.mp4"), poster=picture(f"{model}.png"),
                caption=f"Teacher, {model}, and their distance; of {count} test trajectories the one of {entry['films'][0]}'s median error.",
            )
            for model in entry["films"]
        ]
        result[scene] = SceneAssets(
            films=films,
            stills=[Asset(picture("strip.png"), "The same trajectory at six moments: teacher above, learned below.")] if films else [],
            figures=[
                *([Asset(picture("ablation.svg"), "Ablations: each training a dot, their median a line.")] if entry["axes"] else []),
                Asset(picture("error_over_run_time.svg"), "Error over run time, one thread each, the same machine."),
                Asset(picture("error_over_time.svg"), "Error over time, with the chaos floor."),
                Asset(picture("kinetic_energy.svg"), "Kinetic energy over time."),
            ],
            training=[Asset(picture("training.svg"), "Training loss and validation rollouts.")] if study.training_runs(comparison) else [],
        )
    return result
