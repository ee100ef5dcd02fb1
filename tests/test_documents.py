"""What the documents point at is there: files, studies, scenes."""

import re
from pathlib import Path

import pytest

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
    studies = set(re.findall(r"STUDY=([a-z_]+)", text)) - {"name"}
    assert not [study for study in studies if not (ROOT / f"configs/studies/{study}.yaml").exists()]
    if page.name != "extending.md":
        paths = set(re.findall(r"\b((?:configs|benchmarks|tests)/[\w/]+\.(?:yaml|py))\b", text))
        assert not [path for path in paths if not re.search(r"\b[A-Z]+\b", path) and not (ROOT / path).exists()]
