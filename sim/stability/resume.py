"""kill -9 in mid-run: the same command goes on, and its files have the bytes of an unbroken run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

import sim.cli
from sim.stability import Cell
from sim.stability.courant import MATERIALS
from sim.stability.driver import PBF, SPH
from sim.stability.refusal import FAMILY

TRAJECTORIES, DEADLINE = 6, 1500.0
#: Two bodies of water fall on a ball.
AMONG = {
    "frames": 200,
    "gravity": [0.0, -9.8],
    "obstacles": [{"kind": "ball", "radius": 0.15, "count": [1, 1], "center": [[0.4, 0.6], 0.15]}],
    "bodies": [{"material": "stuff", "shape": {"kind": "box", "size": [0.25, 0.25]}, "velocity": [[-1.0, 1.0], [-1.0, 0.0]], "count": [2, 2]}],
}
FAMILIES = {"": FAMILY | {"materials": {"stuff": MATERIALS["water"]}, "frames": 400, "gravity": [0.0, -9.8]}}
FAMILIES |= {f"{name}, two bodies and an obstacle, ": FAMILY | AMONG | {"materials": {"stuff": water}, "solver": {"method": name}}
             for name, water in SPH.items()}  # fmt: skip
FAMILIES |= {f"{name}, two bodies, ": FAMILY | AMONG | {"obstacles": [], "materials": {"stuff": water}, "solver": {"method": name}}
             for name, water in PBF.items()}  # fmt: skip


def run() -> list[Cell]:
    """Killed at a random instant and resumed, for every family of scenes."""
    return [_killed(of, family) for of, family in FAMILIES.items()]


def _killed(of: str, family: dict) -> Cell:
    """Killed once the second of six shards is there; worker processes included, as a power cut would."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "resume.yaml").write_text(yaml.safe_dump(family | {"splits": {"train": TRAJECTORIES, "valid": 0, "test": 0}}))

        def start(out: str) -> subprocess.Popen:
            options = [str(place / "resume.yaml"), "--out", str(place / out), "--shard-size", "1"]
            command = [sys.executable, "-m", sim.cli.__package__, "generate", *options]
            return subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

        def shards(out: str) -> dict[str, bytes]:
            return {path.name: path.read_bytes() for path in sorted((place / out / "train").glob("*.h5"))}

        whole = start("whole").wait(DEADLINE)
        process, since = start("broken"), time.monotonic()
        while not (place / "broken" / "train" / "shard-00001.cost.json").exists() and process.poll() is None and time.monotonic() - since < DEADLINE:
            time.sleep(0.01)
        killed = process.poll() is None
        if killed:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        left = len(shards("broken"))
        again = start("broken").wait(DEADLINE)
        unbroken, resumed = shards("whole"), shards("broken")
        same = unbroken == resumed and len(unbroken) == TRAJECTORIES
    right = whole == 0 and killed and 0 < left < TRAJECTORIES and again == 0 and same
    observed = f"killed with {left} of {TRAJECTORIES} shards written; then exit {again}, {'the same bytes' if same else 'other bytes'}"
    return Cell("resume", f"{of}kill -9 after two of six shards", right, "the same bytes as an unbroken run", observed,
                {"shards_at_kill": left, "exit": again}, time.perf_counter() - begun)  # fmt: skip
