"""What the documents point at is there: files, studies, scenes."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "pretrained/README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    targets = [target for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()) if "://" not in target]
    lost = [target for target in targets if target.split("#")[0] and not (page.parent / target.split("#")[0]).exists()]
    assert not lost


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_name_what_there_is(page):
    """Studies of make, configurations, programs and tests. Names in capitals are the reader's to fill in; extending.md makes its own files."""
    text = page.read_text()
    studies = set(re.findall(r"STUDY=([a-z_]+)", text)) - {"name"}
    assert not [study for study in studies if not (ROOT / f"configs/studies/{study}.yaml").exists()]
    if page.name != "extending.md":
        paths = set(re.findall(r"\b((?:configs|benchmarks|tests)/[\w/]+\.(?:yaml|py))\b", text))
        assert not [path for path in paths if not re.search(r"\b[A-Z]+\b", path) and not (ROOT / path).exists()]
