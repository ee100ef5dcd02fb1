"""Studies: one YAML file names data sets, models and comparisons, or cases of the stress matrix; validated here, before anything runs.

A study is chosen by ``--config study=FILE`` and read by us: Snakemake's own ``configfile`` is merged key by key with ``--configfile``, so
that a small study would silently keep the scenes of a large one. Everything of a study is under ``results/<file's stem>/``.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError, relevance

from learn.compare import BEST_LEARNED, BEST_TRIVIAL, PARTICLES, SCENE
from learn.metrics import CLOUD_METRICS, CLOUD_TIMES
from learn.variants import with_variant
from sim.errors import InputError
from sim.scene import SceneFamily, read_yaml
from sim.stability import CASES
from workflow.names import FLOOR, ORACLE, REFERENCE, TRIVIAL
from workflow.sources import ROOT, code_hash, registered_models

SCHEMA = ROOT / "workflow" / "schemas" / "study.schema.json"
#: The two parts of a data set. They are made by jobs of their own, so that more test trajectories do not mean another training.
PARTS = {"learning": ("train", "valid"), "test": ("test",)}
FIGURES = ("error_over_run_time", "error_over_time", "kinetic_energy")
_RUNG_KEYS = ("cfl", "stiffness", "coarsen", "particles", "frames", "tolerance")


def _explain(error: ValidationError, path: Path) -> InputError:
    """A fault of the schema as one line: file, key, value, remedy."""
    key, value, rule = error.json_path.removeprefix("$").removeprefix("."), error.instance, error.validator
    remedy = error.schema.get("remedy") or error.message
    if rule == "additionalProperties":
        known = error.schema.get("properties", {})
        unknown = next(name for name in value if name not in known)
        key, value = f"{key}.{unknown}" if key else unknown, value[unknown]
        remedy = f"unknown key; the keys here are {', '.join(sorted(known))}"
    elif rule == "required":
        missing = next(name for name in error.validator_value if name not in value)
        key, value, remedy = f"{key}.{missing}" if key else missing, None, "missing; add it"
    elif rule == "type":
        kinds = error.validator_value
        remedy = f"must be of type {' or '.join(kinds) if isinstance(kinds, list) else kinds}; correct the value"
    elif isinstance(value, dict | list):
        value = list(value)
    return InputError(path, key or "file", value, remedy)


def digest(*parts: object) -> str:
    """A short hash of JSON-able values."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def _texts(*patterns: str) -> list[str]:
    """What templates and style sheets hold."""
    return [path.read_text() for pattern in patterns for path in sorted(ROOT.glob(pattern)) if path.suffix != ".py"]


@dataclass(frozen=True)
class Study:
    """A validated study: its content with defaults filled in, and where each of its results lives."""

    path: Path
    content: dict
    families: dict[str, SceneFamily]
    configs: dict[str, dict]

    @property
    def name(self) -> str:
        """That of its file."""
        return self.path.stem

    @property
    def folder(self) -> Path:
        """Where all of its results are."""
        return Path("results") / self.name

    @property
    def data(self) -> dict[str, dict]:
        """Data sets by name."""
        return self.content["data"]

    @property
    def models(self) -> dict[str, dict]:
        """Models by name."""
        return self.content["models"]

    @property
    def comparisons(self) -> dict[str, dict]:
        """Comparisons by name."""
        return self.content["comparisons"]

    @property
    def stability(self) -> dict[str, list[str]]:
        """Cases of the stress matrix by job; empty in a study that compares."""
        return self.content["stability"]

    def resource(self, section: str, name: str, key: str, default: int) -> int:
        """What an entry of ``data``, ``models`` or ``comparisons`` asks the scheduler for."""
        return self.content[section][name].get("resources", {}).get(key, default)

    # -- places

    def data_folder(self, data: str, part: str) -> Path:
        """A data set's, or of a part of it (``PARTS``)."""
        return self.folder / "data" / data / part

    def data_stamp(self, data: str, part: str) -> Path:
        """Written last: the data set is complete."""
        return self.folder / "data" / data / f"{part}.json"

    def run_folder(self, model: str, seed: int | str) -> Path:
        """Of a training. No output of a rule, because Snakemake deletes outputs before it runs a rule again, and with them what resuming needs."""
        return self.folder / "training" / model / f"seed-{seed}"

    def model_files(self, model: str) -> list[Path]:
        """One file a training seed, or the checkpoint."""
        entry = self.models[model]
        if "checkpoint" in entry:
            return [Path(entry["checkpoint"])]
        return [self.folder / "models" / model / f"seed-{seed}.pt" for seed in entry["seeds"]]

    def comparison_file(self, comparison: str, name: str) -> Path:
        """A file of a comparison: errors.json, timing.json, ..."""
        return self.folder / "comparisons" / comparison / name

    def picture(self, comparison: str, name: str) -> Path:
        """A picture or film of a comparison."""
        return self.folder / "pictures" / comparison / name

    def pictures(self, comparison: str) -> list[Path]:
        """All that a report shows of a comparison."""
        films = self.comparisons[comparison]["films"]
        names = [f"{model}.{suffix}" for model in films for suffix in ("mp4", "png")] + ["strip.png"] * bool(films)
        names += ["ablation.svg"] * bool(self.comparisons[comparison]["axes"])
        names += ["generalisation.svg"] * ("generalisation" in self.comparisons[comparison])
        names += [f"{figure}.svg" for figure in FIGURES] + ["training.svg"] * bool(self.training_runs(comparison))
        return [self.picture(comparison, name) for name in names]

    @property
    def overview(self) -> list[Path]:
        """What a report shows of all comparisons together."""
        return [self.folder / "pictures" / "speed_ups.svg"] * any(entry["learned"] for entry in self.comparisons.values())

    def generalised(self, comparison: str) -> list[str]:
        """The comparisons whose trajectories its figure of generalisation draws, its own first."""
        return [comparison, *self.comparisons[comparison]["generalisation"].get("with", [])]

    def training_content(self, model: str) -> Path:
        """``dataset.json`` of what a model was trained on; of a checkpoint it may be shipped beside it."""
        entry = self.models[model]
        return Path(entry["checkpoint"]).parent / "dataset.json" if "checkpoint" in entry else self.data_stamp(entry["data"], "learning")

    def training_runs(self, comparison: str) -> dict[str, Path]:
        """The trainings behind the learned contenders: label -> folder with ``log.csv`` and ``validation.csv``.

        Of a checkpoint they may be shipped beside it; what is not there is not shown.
        """
        runs = {}
        for model in self.comparisons[comparison]["learned"]:
            entry = self.models[model]
            if "checkpoint" in entry:
                folder = Path(entry["checkpoint"]).parent
                if (folder / "log.csv").is_file() and (folder / "validation.csv").is_file():
                    runs[model] = folder
            else:
                several = len(entry["seeds"]) > 1
                runs |= {f"{model}, seed {seed}" if several else model: self.run_folder(model, seed) for seed in entry["seeds"]}
        return runs

    # -- what results depend on, besides their input files

    def method(self, data: str) -> str:
        """How the solver of a data set works: ``mpm``, ``dfsph``, ..."""
        return self.families[data].model.solver.method

    def data_recipe(self, data: str, part: str) -> str:
        """Hash of all that determines a part of a data set: the scene family as read, counts, seed, the generator's code."""
        family = {key: value for key, value in self.families[data].to_dict().items() if key not in ("splits", "variants")}
        counts = {split: self.data[data][split] for split in PARTS[part]}
        return digest(family, counts, self.data[data]["seed"], code_hash("sim.generate", method=self.method(data)))

    def train_recipe(self, model: str, seed: int | str) -> str:
        """Hash of all that determines a training: configuration, budget, seed, data, the trainer's and the model's code."""
        entry, config = self.models[model], self.configs[model]
        code = code_hash("learn.train", registered_models()[config["model"]])
        return digest(config, self.budget(model), int(seed), self.data_recipe(entry["data"], "learning"), code)

    def comparison_recipe(self, comparison: str, keys: Iterable[str], script: str) -> str:
        """Hash of the keys of a comparison that a script reads, of the models it loads, and of its code."""
        entry = self.comparisons[comparison]
        known = registered_models()
        modules = {known[self.configs[model]["model"]] for model in entry["learned"] if model in self.configs}
        if any("checkpoint" in self.models[model] for model in entry["learned"]):
            modules = set(known.values())
        return digest({key: entry[key] for key in keys}, code_hash(f"workflow.scripts.{script}", *modules, method=self.method(entry["data"])))

    def report_recipe(self) -> str:
        """Hash of what the report says beyond its input files: title, targets, settings, and its code and template."""
        requested = ("data", "models", "comparisons")
        sections = {section: {name: entry | {"resources": None} for name, entry in self.content[section].items()} for section in requested}
        return digest(self.content | sections, code_hash("workflow.scripts.summary"), _texts("sim/page.*", "learn/*.html"))

    def stress_recipe(self, job: str) -> str:
        """Hash of the code that the cases of a job run."""
        return code_hash("workflow.scripts.stress", *(f"sim.stability.{case}" for case in self.stability[job]))

    def stability_recipe(self) -> str:
        """Hash of what a stability report says beyond its input files."""
        titles = [f"sim.stability.{case}" for cases in self.stability.values() for case in cases]
        return digest(self.content, code_hash("workflow.scripts.stability_report", *titles), _texts("sim/page.*", "sim/stability/*.html"))

    def budget(self, model: str) -> dict[str, float]:
        """Of a model's trainings, where the study has one of its own."""
        return {key: self.models[model][key] for key in ("minutes", "steps") if key in self.models[model]}

    @cached_property
    def trained(self) -> list[str]:
        """Models that some comparison shows and that are trained here."""
        shown = {model for entry in self.comparisons.values() for model in entry["learned"]}
        return [model for model in self.models if model in shown and "checkpoint" not in self.models[model]]


def load_study(path: str | Path) -> Study:
    """Read and check a study. Every fault, also of the scene and model files it names, is an ``InputError``."""
    path = Path(path)
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", path.stem):
        raise InputError(path, "file", path.stem, "small letters, digits, - and _: the name of the file becomes the name of a folder; rename it")
    content = read_yaml(path)
    errors = sorted(Draft202012Validator(json.loads(SCHEMA.read_text())).iter_errors(content), key=relevance, reverse=True)
    if errors:
        # The deepest fault says most: a wrong type below beats "does not fit" above.
        raise _explain(max(errors, key=lambda error: len(error.absolute_path)), path)
    content = {"data": {}, "models": {}, "comparisons": {}, "stability": {}} | content
    known: set[str] = set()
    for job, cases in content["stability"].items():
        for index, case in enumerate(cases):
            if case not in CASES or case in known:
                remedy = "a job runs this case already; leave it out" if case in known else f"no such case; those are {', '.join(CASES)}"
                raise InputError(path, f"stability.{job}[{index}]", case, remedy)
            known.add(case)
    families, configs = {}, {}
    for name, entry in content["data"].items():
        content["data"][name] = entry = {"seed": 0, "train": 0, "valid": 0, "test": 0, **entry}
        families[name] = _family(path, name, entry)
    for name, entry in content["models"].items():
        if "checkpoint" in entry:
            if not Path(entry["checkpoint"]).is_file():
                raise InputError(path, f"models.{name}.checkpoint", entry["checkpoint"], "no such file; correct the path")
        else:
            configs[name] = _config(path, content, name, entry)
    study = Study(path, content, families, configs)
    for name, entry in content["comparisons"].items():
        content["comparisons"][name] = entry = {"horizons": [1, 5, 20, 100], "films": list(entry["learned"]), "targets": [], "axes": {}, **entry}
        entry["timing"] = {"repeats": 5, **entry.get("timing", {})}
        _check_comparison(study, name, entry)
    for name, entry in content["comparisons"].items():
        if "generalisation" in entry:
            _check_generalisation(study, name, entry)
    scenes = [families[entry["data"]].model.name for entry in content["comparisons"].values()]
    for name, scene in zip(content["comparisons"], scenes, strict=True):
        if scenes.count(scene) > 1:
            remedy = "rows are told apart by scene, and two comparisons share this one; use a variant or another study"
            raise InputError(path, f"comparisons.{name}.data", scene, remedy)
    return study


def _family(path: Path, name: str, entry: dict) -> SceneFamily:
    scene = Path(entry["scene"])
    if not scene.is_file():
        raise InputError(path, f"data.{name}.scene", entry["scene"], "no such file; correct the path")
    family = SceneFamily.load(scene, entry.get("variant"))
    return SceneFamily(family.to_dict() | {"frames": entry["frames"]}, scene) if "frames" in entry else family


def _config(path: Path, content: dict, name: str, entry: dict) -> dict:
    """The model's configuration file. Its settings are checked by the trainer, which needs torch; here only what it is about."""
    where = f"models.{name}"
    if not Path(entry["config"]).is_file():
        raise InputError(path, f"{where}.config", entry["config"], "no such file; correct the path")
    config = read_yaml(entry["config"])
    model = config.get("model") if isinstance(config, dict) else None
    if model not in registered_models():
        raise InputError(entry["config"], "model", model, f"must be one of {', '.join(sorted(registered_models()))}")
    if "variant" in entry or "variants" in config:
        config = with_variant(config, entry.get("variant"), entry["config"])
    if not isinstance(config.get("training"), dict):
        raise InputError(entry["config"], "training", config.get("training"), "must be a mapping with a budget; see configs/models/")
    data = content["data"].get(entry["data"])
    if data is None:
        raise InputError(path, f"{where}.data", entry["data"], f"not among data: {', '.join(sorted(content['data']))}")
    for split in PARTS["learning"]:
        if not data.get(split):
            raise InputError(path, f"data.{entry['data']}.{split}", data.get(split), f"{name} is trained on this data; ask for at least one")
    return config


def _check_comparison(study: Study, name: str, entry: dict) -> None:
    path, where = study.path, f"comparisons.{name}"
    data = study.data.get(entry["data"])
    if data is None:
        raise InputError(path, f"{where}.data", entry["data"], f"not among data: {', '.join(sorted(study.data))}")
    if entry["trajectories"] > data["test"]:
        raise InputError(path, f"{where}.trajectories", entry["trajectories"], f"data.{entry['data']}.test is only {data['test']}")
    for key, allowed in (("learned", study.models), ("films", entry["learned"])):
        for model in entry[key]:
            if model not in allowed:
                raise InputError(path, f"{where}.{key}", model, f"not among {', '.join(allowed) or 'no models'}")
    names = [REFERENCE, FLOOR, ORACLE, *TRIVIAL, *entry["learned"], *(rung["name"] for rung in entry["ladder"])]
    for index, rung in enumerate(entry["ladder"]):
        if names.count(rung["name"]) > 1:
            raise InputError(path, f"{where}.ladder[{index}].name", rung["name"], "another contender has this name; rename the rung")
        if rung.get("coarsen", 1) != 1 and rung.get("particles") != "recorded":
            raise InputError(path, f"{where}.ladder[{index}].coarsen", rung["coarsen"], "a coarser grid needs particles: recorded")
        finer, refine = rung.get("particles"), study.families[entry["data"]].model.refine
        if isinstance(finer, int) and finer > refine:
            remedy = f"finer than the teacher's, which are refined {refine} times; use teacher or a smaller number"
            raise InputError(path, f"{where}.ladder[{index}].particles", finer, remedy)
    for axis, models in entry["axes"].items():
        for model in models:
            if model not in entry["learned"]:
                raise InputError(path, f"{where}.axes.{axis}", model, f"not among the learned: {', '.join(entry['learned']) or 'none'}")
    for index, target in enumerate(entry["targets"]):
        for key, group in (("contender", BEST_LEARNED), ("relative_to", BEST_TRIVIAL)):
            if key in target and target[key] not in [*names, group]:
                raise InputError(path, f"{where}.targets[{index}].{key}", target[key], f"not among {', '.join([*names, group])}")
        metric, at = target["metric"], str(target["at"]) if "at" in target else None
        if metric.startswith("rollout_mse"):
            moments = [str(horizon) for horizon in entry["horizons"]] + ["all"]
        else:
            moments = [f"{share:g}" for share in CLOUD_TIMES] if metric in CLOUD_METRICS else []
        if at not in moments and not (at is None and not moments):
            remedy = f"{metric} is known at {', '.join(moments)}" if moments else f"{metric} is one figure; leave it out"
            raise InputError(path, f"{where}.targets[{index}].at", target.get("at"), remedy)


def _check_generalisation(study: Study, name: str, entry: dict) -> None:
    path, where = study.path, f"comparisons.{name}.generalisation"
    over, beside = entry["generalisation"]["over"], study.generalised(name)[1:]
    others = [other for other in study.comparisons if other != name]
    for other in beside:
        if other not in others:
            raise InputError(path, f"{where}.with", other, f"not among the other comparisons: {', '.join(others) or 'none'}")
        if study.comparisons[other]["learned"] != entry["learned"]:
            raise InputError(path, f"{where}.with", other, f"must compare the same models, learned: [{', '.join(entry['learned'])}]")
    for shown in [name, *beside]:
        known = [PARTICLES, SCENE, *study.families[study.comparisons[shown]["data"]].model.context]
        if over not in known:
            raise InputError(path, f"{where}.over", over, f"not among {', '.join(known)}, which trajectories of {shown} have")
    if over == SCENE and not beside:
        raise InputError(path, f"{where}.with", None, "one scene has nothing to be set beside; name other comparisons")


def rung_settings(rung: dict) -> dict:
    """The overrides of the solver that a rung of the ladder names."""
    return {key: rung[key] for key in _RUNG_KEYS if key in rung}
