"""What the documents point at is there: files, studies, scenes."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from learn.baselines import Frozen, Oracle
from learn.compare import CompareSettings, Timing, attach_timing, compare
from sim.trajectory import Trajectory, write_shard

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "pretrained/README.md", *sorted((ROOT / "docs").glob("*.md"))]


def anchors(page: Path) -> set[str]:
    """What a page's headings are linked by, as GitHub makes it, and its own anchors."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return set(re.findall(r'<a id="([^"]+)"', text)) | {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if "://" not in link and (not target.exists() or (anchor and anchor not in anchors(target))):
            lost.append(link)
    assert not lost


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_name_what_there_is(page):
    """Studies of make, configurations, programs and tests. Names in capitals are the reader's to fill in; extending.md makes its own files."""
    text = page.read_text()
    studies = set(re.findall(r"STUDY=([a-z_]+)", text)) - ({"name", "bump"} if page.name == "extending.md" else {"name"})
    assert not [study for study in studies if not (ROOT / f"configs/studies/{study}.yaml").exists()]
    if page.name != "extending.md":
        paths = set(re.findall(r"\b((?:configs|benchmarks|tests)/[\w/]+\.(?:yaml|py))\b", text))
        assert not [path for path in paths if not re.search(r"\b[A-Z]+\b", path) and not (ROOT / path).exists()]


def test_the_page_of_formats_names_every_key(tmp_path):
    """What is written and not named in docs/format.md nobody can read; what is named and not written nobody finds."""
    frames = np.random.default_rng(0).uniform(0.3, 0.7, (12, 5, 2)).astype(np.float32)
    scene = {"name": "hand", "gravity": [0, -9.8], "spacing": 0.05}
    trajectory = Trajectory(frames, np.full(5, 5, np.int8), 0.01, 0.1, np.array([[0.0, 1.0]] * 2), scene, 1, {"name": "hand"})
    write_shard(tmp_path / "shard-00000.h5", {0: trajectory})
    with h5py.File(tmp_path / "shard-00000.h5") as file:
        meta, attributes, data = json.loads(file["000000"].attrs["meta"]), dict(file.attrs), list(file["000000"])
    settings = CompareSettings(horizons=(1, 5), one_step_samples=2, curve_points=3)
    rows = attach_timing(compare([Frozen(), Oracle([trajectory])], [trajectory], settings), [Timing("frozen", 0.01, 5, 0.1, [0.1] * 5)], "hand")
    row = next(row for row in rows if row["contender"] == "frozen")
    page = (ROOT / "docs/format.md").read_text()
    named = set(re.findall(r"`(\w+)`", page))
    assert {*meta, *attributes, *data, *row, *Trajectory.__dataclass_fields__} - named == set()
    tables = page.split("A row is one contender on one scene:")[1].split("\n\n")[1]
    keys = {key for line in tables.splitlines()[2:] for key in re.findall(r"`(\w+)`", line.split("|")[1])}
    assert keys - set(row) == {"cost"}  # which the study adds to learned models
