"""From the files of finished jobs to the summary and the pictures of a report."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import numpy as np

from learn.analysis import Target, Yardstick, analyse, verdict
from learn.compare import PARTICLES, SCENE
from learn.generalisation import groups, trials
from learn.report import Asset, SceneAssets
from learn.units import number
from sim.scene import SceneFamily
from workflow.rows import timed_rows
from workflow.study import PARTS, Study


def _read(path: str | Path) -> dict:
    return json.loads(Path(path).read_text())


def _cost(study: Study, model: str) -> dict | None:
    """What data and training of a model took; of a checkpoint, what is shipped beside it says so (``dataset.json``, ``done.json``)."""
    content = study.training_content(model)
    if "checkpoint" in study.models[model]:
        done = [content.with_name("done.json")]
        if not (content.is_file() and done[0].is_file()):
            return None
    else:
        done = [path.with_suffix(".json") for path in study.model_files(model)]
    splits = _read(content)["splits"]
    runs = [_read(path) for path in done]
    return {
        "generation_seconds": sum(sum(splits[split]["cost"].values()) for split in PARTS["learning"] if split in splits),
        "training_seconds": float(np.mean([run["seconds"] for run in runs])),
        "trajectories": splits["train"]["ok"],
        "parameters": runs[0]["parameters"],
        "steps": int(np.mean([run["steps"] for run in runs])),
        "device": runs[0]["device"],
    }


def trained_on(study: Study, comparison: str) -> dict[str, list[tuple[float, float]]]:
    """Learned contender -> [low, high] of what its training had of the number that a comparison sets errors over; left out where unknown."""
    over, known = study.comparisons[comparison]["generalisation"]["over"], {}
    for model in study.comparisons[comparison]["learned"]:
        place = study.training_content(model)
        if over == SCENE or not place.is_file():
            continue
        content = _read(place)
        if over == PARTICLES:
            least, _, most = content["statistics"]["particles"]
            known[model] = [(least, most)]
        else:
            spreads = SceneFamily(content["family"], place).spreads
            known[model] = sorted(spreads[tuple(over.split("."))]["train"]) if tuple(over.split(".")) in spreads else []
    return known


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


def jobs(study: Study) -> list[dict]:
    """What the steps of the workflow took when they last ran, by Snakemake's benchmarks; the longest first."""
    found: dict[str, list[dict]] = {}
    # What a study no longer has may have left files.
    names = {*study.data, *study.comparisons}
    names |= {f"{model}-{seed}" for model in study.trained for seed in study.models[model]["seeds"]}
    names |= {f"{comparison}-{model}" for comparison, entry in study.comparisons.items() for model in entry["films"]}
    files = [(path.parent.name, path) for path in study.folder.glob("benchmarks/*/*.tsv") if path.stem in names]
    once = study.folder / "benchmarks" / "speed_ups.tsv"
    for rule, path in [*files, *([("speed_ups", once)] if once.is_file() else [])]:
        with path.open(newline="") as file:
            found.setdefault(rule, []).extend(csv.DictReader(file, delimiter="\t"))
    result = []
    for rule, lines in found.items():
        seconds, memory = [float(line["s"]) for line in lines], [float(line["max_rss"]) for line in lines if line["max_rss"] not in ("-", "NA")]
        result.append(
            {"rule": rule, "jobs": len(lines), "seconds": sum(seconds), "longest_seconds": max(seconds), "memory_mb": max(memory, default=None)}
        )
    return sorted(result, key=lambda job: -job["seconds"])


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
        "title": study.content["title"],
        "rows": rows,
        "hardware": hardware,
        "versions": versions,
        "analysis": analyse(rows),
        "verdict": verdict(rows, targets),
        "jobs": jobs(study),
        "provenance": provenance,
    }


def _generalisation(study: Study, comparison: str, summary: dict) -> str:
    """The medians of the figure of generalisation in words."""
    scenes = [study.families[study.comparisons[name]["data"]].model.name for name in study.generalised(comparison)]
    rows = [row for scene in scenes for row in summary["rows"] if row["scene"] == scene]
    over, trained = study.comparisons[comparison]["generalisation"]["over"], trained_on(study, comparison)
    said = []
    for model in study.comparisons[comparison]["learned"]:
        parts = [
            f"{group.name}{' (trained on)' if group.trained else ''} {number(group.median('error'))}, {number(group.median('ratio'))} times"
            for group in groups(trials(rows, model, over), over, trained.get(model, ()))
        ]
        said.append(f"{model}: {'; '.join(parts)}.")
    return f"Beyond the training. Median MSE of the rollout, and as a multiple of the best trivial baseline's. {' '.join(said)}"


def overview(study: Study) -> list[Asset]:
    """Pictures of all scenes together."""
    caption = "Each learned model's speed-up at equal error, filled, and over the reference, as papers usually count it, hollow."
    return [Asset(path, caption) for path in study.overview]


def assets(study: Study, summary: dict) -> dict[str, SceneAssets]:
    """Scene -> its pictures, as the rules made them."""
    result = {}
    for comparison, entry in study.comparisons.items():
        scene = study.families[entry["data"]].model.name

        def picture(name: str, comparison: str = comparison) -> Path:
            return study.picture(comparison, name)

        ablations = "Ablations: each training a dot, their median a line."
        count = next(row["trajectories"] for row in summary["rows"] if row["scene"] == scene)
        films = [
            Asset(
                picture(f"{model}.mp4"),
                poster=picture(f"{model}.png"),
                caption=f"Teacher, {model}, and their distance; of {count} test trajectories the one of {entry['films'][0]}'s median error.",
            )
            for model in entry["films"]
        ]
        result[scene] = SceneAssets(
            films=films,
            stills=[Asset(picture("strip.png"), "The same trajectory at six moments: teacher above, learned below.", wide=True)] if films else [],
            main=[
                *([Asset(picture("ablation.svg"), ablations, wide=len(entry["axes"]) > 3)] if entry["axes"] else []),
                *([Asset(picture("generalisation.svg"), _generalisation(study, comparison, summary))] if "generalisation" in entry else []),
                Asset(picture("error_over_run_time.svg"), "Error over run time, one thread each, the same machine."),
            ],
            figures=[
                Asset(picture("error_over_time.svg"), "Error over time, with the chaos floor."),
                Asset(picture("kinetic_energy.svg"), "Kinetic energy over time."),
            ],
            training=[Asset(picture("training.svg"), "Training loss and validation rollouts.")] if study.training_runs(comparison) else [],
        )
    return result
