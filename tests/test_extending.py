"""docs/extending.md works: its files and edits are made in a copy of the source tree, its commands are run there, in order."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from sim.trajectory import ShardReader

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/extending.md"
#: What is copied: the code, and what the commands of the page read.
PARTS = ("sim", "learn", "workflow", "Snakefile", "pyproject.toml", "tests/conftest.py", "tests/sim/experiments.py")

#: Commands of one section in one process, as a shell would start them: sluice-sim, sluice-learn and python less their start-up, and snakemake.
RUNNER = """
import json, runpy, subprocess, sys
import learn.cli, sim.cli
mains = {"sluice-sim": sim.cli.main, "sluice-learn": learn.cli.main}
for program, *arguments in json.loads(sys.argv[1]):
    print("$", program, *arguments, flush=True)
    if program in mains:
        code = mains[program](arguments)
    elif program == "snakemake":
        code = subprocess.run([sys.executable, "-m", program, "--cores", "2", *arguments], stderr=subprocess.STDOUT).returncode
    elif arguments[0] == "-m":
        import pytest
        code = pytest.main(arguments[2:])
    else:
        sys.argv = arguments
        runpy.run_path(arguments[0], run_name="__main__")
        code = 0
    if code:
        sys.exit(f"exit code {int(code)}")
"""


@dataclass
class Section:
    files: dict[str, str] = field(default_factory=dict)
    edits: list[tuple[str, str]] = field(default_factory=list)
    commands: list[list[str]] = field(default_factory=list)


def sections() -> dict[str, Section]:
    """Heading -> its blocks; a block is a file, an edit of one, or commands, and nothing else."""
    found: dict[str, Section] = {}
    for part in re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)[1:]:
        section = found.setdefault(part.splitlines()[0], Section())
        for kind, name, text in re.findall(r"^```(\w+) ?(\S*)\n(.*?)^```$", part, flags=re.MULTILINE | re.DOTALL):
            if kind == "diff":
                section.edits.append((name, text))
            elif kind == "sh":
                section.commands += [line.split() for line in text.splitlines()]
            else:
                assert name, f"{part.splitlines()[0]}: a block of {kind} without a file's name"
                section.files[name] = text
    return found


def edited(text: str, diff: str) -> str:
    """``text`` after a diff without line numbers: what each hunk takes away and keeps must stand in it once, as whole lines."""
    for hunk in diff.split("@@\n"):
        lines = hunk.splitlines(keepends=True)
        before, after = ("\n" + "".join(line[1:] for line in lines if line[0] in kept) for kept in (" -", " +"))
        assert ("\n" + text).count(before) == 1, f"not once in the file:{before}"
        text = ("\n" + text).replace(before, after)[1:]
    return text


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """The copy, with all files and edits of the page."""
    folder = tmp_path_factory.mktemp("extended")
    for part in PARTS:
        target = folder / part
        target.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / part, target)
    for section in sections().values():
        for name, text in section.files.items():
            assert not (ROOT / name).exists(), f"{name} is in the repository already"
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        for name, diff in section.edits:
            (folder / name).write_text(edited((folder / name).read_text(), diff))
    return folder


@pytest.fixture(scope="module")
def ran(tree):
    """Runs the sections up to a given one, each once."""
    done = set()

    def run(*headings):
        for heading, section in sections().items():
            if heading in headings and heading not in done:
                environment = os.environ | {"PYTHONPATH": str(tree)}
                answer = subprocess.run([sys.executable, "-c", RUNNER, json.dumps(section.commands)], cwd=tree, capture_output=True, text=True,
                                        env=environment, timeout=300)  # fmt: skip
                assert answer.returncode == 0, f"{heading}\n{answer.stdout}\n{answer.stderr}"
                done.add(heading)
        return tree

    return run


def trajectory(path):
    with ShardReader(path) as reader:
        return reader.read(reader.indices()[0])


def test_the_page_has_its_five_examples():
    assert list(sections()) == ["A scene", "A material", "A model", "A metric", "A study"]
    assert all(section.commands for section in sections().values())


def test_the_page_is_in_house_style(tree):
    answer = subprocess.run([sys.executable, "-m", "ruff", "check", "--no-cache", "."], cwd=tree, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout


def test_a_scene(ran):
    folder = ran("A scene")
    one, tall, smooth = (trajectory(folder / f"data/{name}/test/shard-00000.h5") for name in ("bump", "bump-tall", "bump-smooth"))
    assert [each.scene["name"] for each in (one, tall, smooth)] == ["bump", "bump-tall", "bump-smooth"]
    assert all(each.ok and (~each.moving).any() for each in (one, tall, smooth))
    assert tall.scene["obstacles"][0]["radius"] == 0.15 and smooth.scene["materials"]["water"]["viscosity"] == 2.0
    # The column broke, and the viscous one is slower.
    fronts = [each.position[-1, each.moving, 0].max() for each in (one, smooth)]
    assert fronts[0] > fronts[1] > 0.3
    assert picture(folder / "bump.png")


def picture(path):
    """Whether it is a picture that shows more than its ground."""
    from imageio.v3 import imread

    return len(np.unique(imread(path).reshape(-1, 3), axis=0)) > 20


def test_a_material(ran):
    folder = ran("A material")
    hard, soft = (trajectory(folder / f"data/{name}/test/shard-00000.h5") for name in ("slump", "slump-soft"))
    assert hard.ok and soft.ok and (hard.particle_type == 2).all()
    start, *ends = (each.position[frame, :, 1].max() / hard.scene["spacing"] for each, frame in ((hard, 0), (hard, -1), (soft, -1)))
    assert start - 1 > ends[0] > ends[1] + 1  # both slump, the one that hardens by less
    assert picture(folder / "slump.png")


def test_a_model(ran):
    folder = ran("A scene", "A model")
    rows = (folder / "runs/lone/log.csv").read_text().splitlines()
    losses = [float(line.split(",")[2]) for line in rows[1:]]
    assert losses[-1] < 0.9 * losses[0]
    predicted = trajectory(folder / "runs/lone/test.h5")
    assert predicted.ok and predicted.simulator["name"] == "lone" and len(predicted.position) == 51
    true = trajectory(folder / "data/bump/test/shard-00000.h5")
    assert (predicted.position[:, ~true.moving] == true.position[:, ~true.moving]).all()


def test_a_metric(ran):
    folder = ran("A scene", "A model", "A metric")
    rows = {row["contender"]: row for row in json.loads((folder / "rows.json").read_text())}
    for name in ("lone", "frozen", "ballistic"):
        assert set(rows[name]["hausdorff"]) == {"0.25", "0.5", "0.75", "1"}
        assert rows[name]["hausdorff"]["1"] > 0 and rows[name]["spread"]["max"]["hausdorff"]["1"] >= rows[name]["hausdorff"]["1"]
    schema = json.loads((folder / "workflow/schemas/study.schema.json").read_text())
    assert "hausdorff" in schema["$defs"]["target"]["properties"]["metric"]["enum"]


def test_a_study(tree):
    """The dry run plans every job, and the page's tables name every key that a study may have."""
    command = ["-m", "snakemake", "-n", "--cores", "2", "--config", "study=configs/studies/bump.yaml"]
    answer = subprocess.run([sys.executable, *command], cwd=tree, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(tree)})
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert re.search(r"^train +3$", answer.stdout, re.MULTILINE) and re.search(r"^film +1$", answer.stdout, re.MULTILINE)
    assert sections()["A study"].commands == [command[1:3] + command[5:]]
    schema = json.loads((ROOT / "workflow/schemas/study.schema.json").read_text())
    named = set(re.findall(r"`(\w+)`", PAGE.read_text().split("## A study")[1]))
    parts = [schema["$defs"][part]["properties"] for part in ("data", "model", "comparison", "rung", "target")]
    assert {key for part in parts for key in part} - named == set()
