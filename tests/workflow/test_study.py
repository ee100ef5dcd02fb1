"""Studies: the shipped ones are sound and resolve; every mistake is one line with file, key, value and remedy, and nothing is written."""

import json
import re
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from study_tree import ROOT, make_tree, planned, snakemake

sys.path.insert(0, str(Path(__file__).parents[1]))

from mutations import spoil_yaml  # noqa: E402

from sim.domains import DOMAINS  # noqa: E402
from sim.errors import InputError  # noqa: E402
from sim.scene import SceneFamily  # noqa: E402
from sim.solvers import solver_class  # noqa: E402
from sim.stability import CASES  # noqa: E402
from workflow.results import trained_on  # noqa: E402
from workflow.study import load_study, rung_settings  # noqa: E402

STUDIES = list((ROOT / "configs" / "studies").glob("*.yaml"))


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A tree for tests that run nothing."""
    return make_tree(tmp_path_factory.mktemp("study") / "tree")


def write(folder: Path, change, name: str = "changed") -> str:
    """The micro study, changed in place by ``change``, as a new study; its path."""
    content = yaml.safe_load((folder / "configs" / "studies" / "micro.yaml").read_text())
    change(content)
    path = Path("configs/studies") / f"{name}.yaml"
    (folder / path).write_text(yaml.safe_dump(content))
    return str(path)


def put(*keys, value):
    """A change that sets ``content[keys[0]][keys[1]]... = value``."""

    def change(content):
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    return change


def drop(*keys):
    def change(content):
        for key in keys[:-1]:
            content = content[key]
        del content[keys[-1]]

    return change


def larger(content, learned):
    """Adds a comparison in a larger box, whose errors are drawn beside."""
    content["data"]["larger"] = content["data"]["puddle"] | {"variant": "larger"}
    content["comparisons"]["larger"] = content["comparisons"]["puddle"] | {"data": "larger", "learned": learned, "films": [], "targets": []}
    content["comparisons"]["puddle"]["generalisation"] = {"over": "scene", "with": ["larger"]}


COMPARISON = ("comparisons", "puddle")
MISTAKES = [
    (put("colour", value=1), "colour = 1: unknown key; the keys here are comparisons, data, models, stability, title"),
    (put("data", "puddle", "tests", value=3), "data.puddle.tests = 3: unknown key"),
    (put("data", "puddle", "train", value="two"), "data.puddle.train = 'two': must be of type integer"),
    (put("data", "puddle", "train", value=-1), "data.puddle.train = -1"),
    (put("data", "puddle", "train", value=0), "data.puddle.train = 0: gns is trained on this data"),
    (put("data", "puddle", "scene", value="configs/scenes/no.yaml"), "data.puddle.scene = 'configs/scenes/no.yaml': no such file"),
    (put("data", "puddle", "variant", value="stiff"), "variant = 'stiff': not among the variants"),
    (put("data", "Pud dle", value={"scene": "configs/scenes/puddle.yaml"}), "use small letters"),
    (put("data", "puddle", value=None), "data.puddle = None: must be of type object"),
    (drop("data"), "data = None: missing; add it"),
    (drop("models", "gns", "seeds"), "models.gns = ['config', 'data']: give config, data and seeds"),
    (put("models", "gns", "checkpoint", value="a.pt"), "give config, data and seeds"),
    (put("models", "gns", value={"checkpoint": "no.pt"}), "models.gns.checkpoint = 'no.pt': no such file"),
    (put("models", "gns", "config", value="no.yaml"), "models.gns.config = 'no.yaml': no such file"),
    (put("models", "gns", "config", value="configs/scenes/puddle.yaml"), "model = None: must be one of cconv, gns, grid_emulator"),
    (put("models", "gns", "data", value="pond"), "models.gns.data = 'pond': not among data: puddle"),
    (put("models", "gns", "seeds", value=[0, 0]), "models.gns.seeds"),
    (put(*COMPARISON, "data", value="pond"), "comparisons.puddle.data = 'pond': not among data: puddle"),
    (put(*COMPARISON, "trajectories", value=3), "comparisons.puddle.trajectories = 3: data.puddle.test is only 2"),
    (put(*COMPARISON, "learned", value=["gsn"]), "comparisons.puddle.learned = 'gsn': not among gns, grid"),
    (put(*COMPARISON, "films", value=["gsn"]), "comparisons.puddle.films = 'gsn': not among gns, grid"),
    (put(*COMPARISON, "timing", "repeats", value=2), "comparisons.puddle.timing.repeats = 2: a median and a spread need at least 5"),
    (put(*COMPARISON, "ladder", 0, "name", value="frozen"), "comparisons.puddle.ladder[0].name = 'frozen': another contender has this name"),
    (put(*COMPARISON, "ladder", 0, value={"name": "a"}), "comparisons.puddle.ladder[0] = ['name']: name what the rung changes"),
    (put(*COMPARISON, "ladder", 0, value={"name": "a", "coarsen": 2.0}), "comparisons.puddle.ladder[0].coarsen = 2.0: a coarser grid needs"),
    (put(*COMPARISON, "ladder", 0, value={"name": "a", "particles": 1}), "comparisons.puddle.ladder[0].particles = 1: must be teacher, recorded or"),
    (put(*COMPARISON, "ladder", 0, value={"name": "a", "particles": 9}), "comparisons.puddle.ladder[0].particles = 9: finer than the teacher's"),
    (put(*COMPARISON, "ladder", 0, "cfl", value=0), "comparisons.puddle.ladder[0].cfl = 0"),
    (put(*COMPARISON, "targets", 0, "metric", value="beauty"), "comparisons.puddle.targets[0].metric = 'beauty'"),
    (drop(*COMPARISON, "targets", 0, "high"), "give contender, metric and at least one of high and low"),
    (put(*COMPARISON, "targets", 0, "relative_to", value="nobody"), "targets[0].relative_to = 'nobody': not among"),
    (put(*COMPARISON, "targets", 0, "at", value=20), "targets[0].at = 20: rollout_mse_moving is known at 1, 5, all"),
    (drop(*COMPARISON, "targets", 0, "at"), "targets[0].at = None: rollout_mse_moving is known at"),
    (put(*COMPARISON, "targets", 0, "metric", value="emd"), "targets[0].at = 'all': emd is known at 0.25, 0.5, 0.75, 1"),
    (put(*COMPARISON, "targets", 0, "metric", value="escaped_fraction"), "targets[0].at = 'all': escaped_fraction is one figure; leave it out"),
    (put(*COMPARISON, "targets", 0, "metric", value="speed_up_at_equal_error"), "targets[0].at = 'all': speed_up_at_equal_error is one figure"),
    (put(*COMPARISON, "targets", 0, "contender", value="best"), "targets[0].contender = 'best': not among"),
    (put(*COMPARISON, "axes", value={"size": {"gns": 1, "gsn": 2}}), "comparisons.puddle.axes.size = 'gsn': not among the learned: gns"),
    (put(*COMPARISON, "axes", value={"size": {"gns": 1}}), "comparisons.puddle.axes.size = ['gns']"),
    (put(*COMPARISON, "generalisation", value={"with": []}), "comparisons.puddle.generalisation.over = None: missing"),
    (put(*COMPARISON, "generalisation", value={"over": "colour"}), "generalisation.over = 'colour': not among particles, scene, which"),
    (put(*COMPARISON, "generalisation", value={"over": "scene"}), "comparisons.puddle.generalisation.with = None: one scene has nothing"),
    (put(*COMPARISON, "generalisation", value={"over": "particles", "with": ["puddle"]}), "with = 'puddle': not among the other comparisons: none"),
    (lambda content: larger(content, ["gns"]), "generalisation.with = 'larger': must compare the same models, learned: [gns, grid]"),
    (put("models", "gns", "resources", value={"gpu": 1}), "models.gns.resources.gpu = 1: unknown key; the keys here are gpus"),
    (put("models", "gns", "resources", value={"gpus": -1}), "models.gns.resources.gpus = -1"),
    (put("data", "puddle", "resources", value={"gpus": 1}), "data.puddle.resources.gpus = 1: unknown key; the keys"),
    (put("data", "puddle", "resources", value={"threads": 0}), "data.puddle.resources.threads = 0"),
    (put(*COMPARISON, "resources", value={"gpus": 2}), "comparisons.puddle.resources.gpus = 2: 0 or 1: a comparison runs one rollout at a time"),
    (put(*COMPARISON, "resources", value={"threads": 2}), "comparisons.puddle.resources.threads = 2: unknown key; the keys here are gpus, mem_mb"),
    (put("models", "gns", "variant", value="big"), "variant = 'big': not among the variants (there are none)"),
    (put("stability", value={"a": ["rest"]}), "a study of stability has title and stability alone"),
    (lambda content: content["comparisons"].update(again=content["comparisons"]["puddle"]), "two comparisons share this one"),
]


@pytest.mark.parametrize(("change", "line"), MISTAKES)
def test_mistakes_are_named(place, monkeypatch, change, line):
    monkeypatch.chdir(place)
    with pytest.raises(InputError) as error:
        load_study(write(place, change))
    assert line in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("stability", "line"), [
    ({"a": ["rest", "unrest"]}, "stability.a[1] = 'unrest': no such case; those are young_dt, speed_dt"),
    ({"a": ["rest"], "b": ["rest"]}, "stability.b[0] = 'rest': a job runs this case already"), ({"a": []}, "stability.a = []"),
    ({"A job": ["rest"]}, "use small letters"), ({"a": "rest"}, "stability.a = 'rest': must be of type array"), ({}, "stability = []"),
    (["rest"], "stability = ['rest']: must be of type object"),
])  # fmt: skip
def test_mistakes_in_a_stability_study_are_named(place, monkeypatch, stability, line):
    monkeypatch.chdir(place)
    path = Path("configs/studies/odd.yaml")
    path.write_text(yaml.safe_dump({"title": "Odd", "stability": stability}))
    with pytest.raises(InputError) as error:
        load_study(path)
    assert line in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "- a\n- b", "title: [", "title: a\ntitle: b", "data: 3", "\0"])
def test_files_that_are_no_study(place, monkeypatch, text):
    monkeypatch.chdir(place)
    path = Path("configs/studies/odd.yaml")
    path.write_text(text)
    with pytest.raises(InputError, match="odd.yaml"):
        load_study(path)


def test_mutated_studies(place, monkeypatch):
    """Five mutations of every shipped study: it resolves, or one line names file, key, value and remedy; nothing is run and nothing written."""
    monkeypatch.chdir(place)
    before = sorted(path for path in place.rglob("*") if "__pycache__" not in path.parts)
    outcomes = []
    for trial, source in enumerate(5 * sorted(STUDIES)):
        path, rng = Path("configs/studies") / source.name, np.random.default_rng([6, trial])
        path.write_bytes(spoil_yaml(source.read_text(), rng, place / "mark"))
        begun = time.process_time()
        try:
            load_study(path)
            outcomes.append("")
        except InputError as error:
            outcomes.append(str(error))
            assert re.fullmatch(r"\S+: \S.* = .+: .+", outcomes[-1]) and len(outcomes[-1]) < 2000
        assert time.process_time() - begun < 10
        path.write_bytes(source.read_bytes())
    assert sorted(path for path in place.rglob("*") if "__pycache__" not in path.parts) == before
    assert outcomes.count("") > 0 and len(outcomes) - outcomes.count("") > 20


def test_aliases_that_grow_without_end(place, monkeypatch):
    """The schema's own messages hold what they refuse, so it must not get that far."""
    monkeypatch.chdir(place)
    path = Path("configs/studies/odd.yaml")
    path.write_text("\n".join(["a0: &a0 [x, x, x, x, x, x, x, x, x]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)),
                               "title: *a11"]))  # fmt: skip
    with pytest.raises(InputError, match="odd.yaml: file = '.* entries': aliases"):
        load_study(path)


def test_no_such_file_and_names_that_are_no_folder(place, monkeypatch):
    monkeypatch.chdir(place)
    with pytest.raises(InputError, match="No such file"):
        load_study("configs/studies/none.yaml")
    with pytest.raises(InputError, match="rename it"):
        load_study("configs/studies/My Study.yaml")


@pytest.mark.workflow
def test_a_mistake_is_one_line_exit_2_and_nothing_written(tree):
    study = write(tree, put("data", "puddle", "tests", value=3))
    before = {path: path.stat().st_mtime_ns for path in tree.rglob("*") if "__pycache__" not in path.parts}
    code, output = snakemake(tree, study=study)
    lines = [line for line in output.splitlines() if line.strip()]
    assert code == 2
    assert [line for line in lines if line.startswith("sluice: ")] == [lines[-1]] and "data.puddle.tests = 3" in lines[-1]
    assert "Traceback" not in output and len(lines) <= 2  # Snakemake names the profile it uses
    assert not (tree / "results").exists()
    assert before.keys() == {path for path in tree.rglob("*") if not {"__pycache__", ".snakemake"} & set(path.parts)}


#: Trajectories to validate and to test on where they are not a hundred each.
HELD_OUT = dict.fromkeys(("water", "sand", "goop", "waterdrop", "waterramps", "sandramps"), 30) | {"boxbath": 150}


@pytest.mark.workflow
@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "configs" / "studies").glob("*.yaml") if path.stem != "stability"))
def test_shipped_studies_resolve(place, name):
    jobs = planned(place, study=f"configs/studies/{name}.yaml")
    content = yaml.safe_load((place / "configs" / "studies" / f"{name}.yaml").read_text())
    comparisons, models = content["comparisons"].values(), content["models"].values()
    # Ablations compare learned models with each other, and generalisation a model with itself.
    assert all(len(entry["ladder"]) >= (1 if name in ("ablation", "generalisation") else 5) for entry in comparisons)
    for figure, key in (("ablation", "axes"), ("generalisation", "generalisation")):
        assert jobs.get(figure, 0) == sum(key in entry for entry in comparisons)
    assert jobs["errors"] == jobs["timing"] == jobs["figures"] == len(comparisons) and jobs["report"] == 1
    assert jobs.get("train", 0) == sum(len(model.get("seeds", [])) for model in models)


@pytest.mark.workflow
def test_the_stability_study_runs_every_case(place):
    jobs = planned(place, study="configs/studies/stability.yaml")
    study = yaml.safe_load((place / "configs" / "studies" / "stability.yaml").read_text())["stability"]
    assert jobs == {"stress": len(study), "report": 1} and sorted(sum(study.values(), [])) == sorted(CASES)


def test_the_paper_study_is_the_papers_size(monkeypatch):
    """Counts, lengths, radii of all sixteen against ``DOMAINS``, the splits against the released data's."""
    monkeypatch.chdir(ROOT)
    study = load_study("configs/studies/paper.yaml")
    assert set(study.data) == set(study.comparisons) == set(DOMAINS)
    for name, domain in DOMAINS.items():
        entry, family = study.data[name], study.families[name].model
        assert (entry["train"], family.frames - 1, family.radius, family.frame_step) == (
            domain.trajectories,
            domain.steps,
            domain.radius,
            domain.frame_step,
        )
        assert entry["valid"] == entry["test"] == HELD_OUT.get(name, 100)
        assert study.comparisons[name]["learned"] == [f"{name}_gns"]
        (model,) = study.comparisons[name]["learned"]
        assert study.models[model]["data"] == name and study.models[model]["resources"]["gpus"] == study.comparisons[name]["resources"]["gpus"] == 1
        config = study.configs[model]
        assert (config["settings"]["latent"], config["settings"]["message_passing"], config["training"]["batch"]) == (128, 10, 2)
        assert float(config["settings"]["noise"]) == 6.7e-4
    assert study.models["waterdrop_gns"]["seeds"] == [0, 1, 2]


def test_the_study_of_sixteen_has_every_domain_as_the_paper_study_has_it(monkeypatch):
    monkeypatch.chdir(ROOT)
    small, large = (load_study(f"configs/studies/{name}.yaml") for name in ("sixteen", "paper"))
    assert list(small.comparisons) == list(large.comparisons) and set(small.comparisons) == set(DOMAINS)
    cut = set()
    for name in DOMAINS:
        ours, theirs = small.families[name].to_dict(), large.families[name].to_dict()
        assert ours | {"frames": 0} == theirs | {"frames": 0}
        cut |= {name} if ours["frames"] != theirs["frames"] else set()
        for study, model in ((small, f"{name}_grid"), (large, f"{name}_gns")):
            entry = study.comparisons[name]
            assert entry["data"] == study.models[model]["data"] == name and entry["learned"] == [model]
            assert {target["contender"] for target in entry["targets"]} == {model}
        assert small.comparisons[name]["ladder"] == large.comparisons[name]["ladder"]
    assert cut == {"water_3d", "water_3d_s"}


@pytest.mark.parametrize("name", ["sixteen", "paper"])
def test_domains_can_be_deleted_from_a_copy(place, monkeypatch, name):
    """Every entry stands for itself: none refers to a part of another."""
    monkeypatch.chdir(place)
    lines = (place / "configs" / "studies" / f"{name}.yaml").read_text().splitlines(keepends=True)
    kept, domain = [], None
    for line in lines:
        if found := re.match(r"  (\w+?)(_gns|_grid)?:", line):
            domain = found[1]
        elif not line.startswith(" "):
            domain = None
        kept += [line] if domain in (None, "sandramps") else []
    (place / "configs" / "studies" / "one.yaml").write_text("".join(kept))
    study = load_study("configs/studies/one.yaml")
    assert list(study.comparisons) == list(study.data) == ["sandramps"] and len(study.models) == 1


@pytest.mark.parametrize("name", [path.stem for path in STUDIES if path.stem != "stability"])
def test_ladders_are_possible_on_their_scenes(monkeypatch, name):
    """What a solver refuses of a rung (a grid too coarse for a ramp, say) would else be found when data and trainings are done."""
    monkeypatch.chdir(ROOT)
    study = load_study(f"configs/studies/{name}.yaml")
    for comparison, entry in study.comparisons.items():
        scene = study.families[entry["data"]].sample(0)
        for rung in entry["ladder"]:
            plan = solver_class(study.method(entry["data"]))(**rung_settings(rung)).plan(scene)
            assert plan, (comparison, rung["name"])


@pytest.mark.parametrize(("over", "known"), [("particles", [(352, 616)]), ("sand.friction_angle", [(15, 30), (55, 70)])])
def test_what_a_checkpoint_was_trained_on(place, monkeypatch, over, known):
    monkeypatch.chdir(place)

    def change(content):
        content["data"]["sand"] = {"scene": "configs/scenes/sand_angles.yaml", "test": 2}
        content["models"]["heap"] = {"checkpoint": "pretrained/heap/best.pt"}
        comparison = {"data": "sand", "learned": ["heap"], "films": [], "targets": [], "generalisation": {"over": over}}
        content["comparisons"] = {"sand": content["comparisons"]["puddle"] | comparison}

    shipped = Path("pretrained/heap")
    shipped.mkdir(exist_ok=True)
    (shipped / "best.pt").touch()
    study = load_study(write(place, change))
    (shipped / "dataset.json").unlink(missing_ok=True)
    assert trained_on(study, "sand") == {}
    family = SceneFamily.load("configs/scenes/sand_angles.yaml").to_dict()
    (shipped / "dataset.json").write_text(json.dumps({"family": family, "statistics": {"particles": [352, 480.0, 616]}}))
    assert trained_on(study, "sand") == {"heap": known}


def test_one_study_keeps_nothing_of_another(place, monkeypatch):
    """The trap of ``--configfile``: a small study that silently has the large one's scenes as well."""
    monkeypatch.chdir(place)
    assert set(load_study("configs/studies/micro.yaml").data) == {"puddle"}
    folders = {load_study(f"configs/studies/{name}.yaml").folder for name in ("micro", "smoke", "paper")}
    assert len(folders) == 3


# Recipes: what makes results again ------------------------------------------------------------------------------------------


def recipes(folder: Path) -> dict[str, str]:
    """All recipes of the micro study, in a fresh interpreter's view of the sources."""
    import subprocess
    import sys

    program = """
import json
from workflow.study import load_study
study = load_study("configs/studies/micro.yaml")
made = {f"data {part}": study.data_recipe("puddle", part) for part in ("learning", "test")}
made |= {f"train {model}": study.train_recipe(model, 0) for model in ("gns", "grid")}
made |= {script: study.comparison_recipe("puddle", ("ladder", "learned"), script) for script in ("errors", "timing")}
print(json.dumps(made | {"report": study.report_recipe()}))
"""
    answer = subprocess.run([sys.executable, "-c", program], cwd=folder, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    return yaml.safe_load(answer.stdout)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


LEARNED, COMPARED = {"train gns", "train grid"}, {"errors", "timing"}
EDITS = [
    # A solver's source: its data, all that is trained on them, all that is compared with it.
    ("sim/mpm/walls.py", None, {"data learning", "data test", *LEARNED, *COMPARED}),
    ("sim/mpm/solver.py", None, {"data learning", "data test", *LEARNED, *COMPARED}),
    ("sim/sph/wcsph.py", None, set()),  # the puddle is material points'
    ("sim/pbd/solver.py", None, set()),
    ("learn/gns.py", None, {"train gns", *COMPARED}),
    ("learn/grid_emulator.py", None, {"train grid", *COMPARED}),
    ("learn/train.py", None, LEARNED),
    ("learn/metrics.py", None, {*LEARNED, *COMPARED, "report"}),  # trainings choose their best weights by it
    ("learn/compare.py", None, COMPARED | {"report"}),
    ("learn/analysis.py", None, {"report"}),  # no rollout of films either
    ("learn/report_template.html", None, {"report"}),
    ("learn/scene_template.html", None, {"report"}),
    ("sim/page.css", None, {"report"}),
    ("learn/generalisation.py", None, {"report"}),
    ("learn/figures.py", None, set()),
    ("sim/render.py", None, set()),
    ("sim/cli.py", None, set()),
    ("configs/scenes/puddle.yaml", ("sound_speed: 6.0", "sound_speed: 7.0"), {"data learning", "data test", *LEARNED}),
    ("configs/scenes/puddle.yaml", ("splits: {train: 2", "splits: {train: 9"), set()),
    ("configs/models/micro_gns.yaml", ("latent: 8", "latent: 9"), {"train gns"}),
    ("configs/studies/micro.yaml", ("test: 2", "test: 3"), {"data test", "report"}),
    ("configs/studies/micro.yaml", ("train: 2", "train: 3"), {"data learning", *LEARNED, "report"}),
    ("configs/studies/micro.yaml", ("cfl: 0.8", "cfl: 0.9"), COMPARED | {"report"}),
    ("configs/studies/micro.yaml", ("high: 1.0e-12", "high: 1.0"), {"report"}),
]


@pytest.fixture(scope="module")
def untouched(place) -> dict[str, str]:
    return recipes(place)


@pytest.mark.parametrize(("file", "change", "expected"), EDITS, ids=lambda value: value if isinstance(value, str) else None)
def test_an_edit_changes_the_recipes_it_must(place, untouched, file, change, expected):
    path = place / file
    original = path.read_bytes()
    try:
        if change is None:
            path.write_text(path.read_text() + ("\nEDITED = True\n" if path.suffix == ".py" else "<!-- edited -->"))
        else:
            edit(path, *change)
        after = recipes(place)
    finally:
        path.write_bytes(original)
    assert {name for name in after if after[name] != untouched[name]} == expected


def test_comments_and_docstrings_change_no_recipe(place, untouched):
    path = place / "sim" / "mpm" / "solver.py"
    original = path.read_text()
    try:
        path.write_text('"""Another docstring."""\n' + original[original.index('"""', 3) + 3 :] + "\n# a comment\n")
        assert recipes(place) == untouched
    finally:
        path.write_text(original)
