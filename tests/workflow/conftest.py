"""Trees to run studies in."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from study_tree import make_tree, snakemake  # noqa: E402 - found by the line above


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return make_tree(tmp_path / "tree")


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree in which the micro study has been made; not to be changed by a test."""
    folder = make_tree(tmp_path_factory.mktemp("micro") / "tree")
    begun = time.monotonic()
    code, output = snakemake(folder)
    assert code == 0, output
    (folder / "seconds").write_text(str(time.monotonic() - begun))
    return folder


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished tree, times and Snakemake's records included."""
    return shutil.copytree(finished, tmp_path / "tree", symlinks=True)
