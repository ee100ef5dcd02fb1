"""The list of contenders of a comparison: the one place that knows solvers, learned models and baselines alike."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from learn.baselines import Oracle, trivial_baselines
from learn.checkpoint import load_model
from learn.compare import CompareSettings
from learn.dataset import Dataset
from learn.rollout import check_fit
from sim.ladder import solver_ladder
from sim.simulator import Kind, Simulator
from sim.trajectory import Trajectory
from workflow.names import FLOOR, REFERENCE
from workflow.study import Study, rung_settings

#: Displacement of the start for the chaos floor, in connectivity radii.
PERTURBATION = 1e-6


def test_trajectories(study: Study, comparison: str, numbers: Iterable[int] | None = None) -> list[Trajectory]:
    """The first so many of the test split, or of them those of ``numbers``. Failed ones are in no shard, so there may be fewer than asked for."""
    entry = study.comparisons[comparison]
    data = Dataset(study.data_folder(entry["data"], "test"), "test")
    return [data.trajectory(number) for number in (range(min(entry["trajectories"], len(data))) if numbers is None else numbers)]


def learned(study: Study, comparison: str, model: str, device: str = "cpu") -> list[Simulator]:
    """The model once for every training seed, on one CPU thread like the solvers or on a GPU; refused if it does not fit the test data."""
    torch.set_num_threads(1)
    entry = study.models[model]
    data = Dataset(study.data_folder(study.comparisons[comparison]["data"], "test"), "test")
    contenders = []
    for seed, path in zip(entry.get("seeds", [None]), study.model_files(model), strict=True):
        contender = load_model(path, device)
        check_fit(contender, data, path)
        contender.name = model
        contender.settings = {**contender.settings, "model": type(contender).name} | ({} if seed is None else {"seed": seed})
        if device != "cpu":
            contender.settings["rolled out on"] = torch.cuda.get_device_name()
        contenders.append(contender)
    return contenders


def contenders(study: Study, comparison: str, trajectories: list[Trajectory], kinds: tuple[str, ...], device: str = "cpu") -> list[Simulator]:
    """Contenders of the given kinds, the learned ones on ``device``."""
    entry = study.comparisons[comparison]
    rungs: list[tuple[str, Kind, dict]] = [(REFERENCE, "reference", {}), *((rung["name"], "solver", rung_settings(rung)) for rung in entry["ladder"])]
    rungs.append((FLOOR, "floor", {"perturbation": PERTURBATION * trajectories[0].radius}))
    models = [contender for model in entry["learned"] for contender in learned(study, comparison, model, device)]
    method = trajectories[0].scene.get("solver", {}).get("method", "mpm")
    made = [*solver_ladder(rungs, method), *models, *trivial_baselines(), Oracle(trajectories)]
    return [contender for contender in made if contender.kind in kinds]


def settings(study: Study, comparison: str, trajectories: list[Trajectory]) -> CompareSettings:
    """What the comparison holds fixed."""
    refined = trajectories[0].scene.get("refine", 1) > 1
    return CompareSettings(reference="fine teacher" if refined else "teacher", horizons=tuple(study.comparisons[comparison]["horizons"]))
