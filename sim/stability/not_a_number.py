"""NaN and infinity injected: caught within the frame, and the trajectory is in no file."""

import tempfile
import time
from pathlib import Path

import numpy as np

from sim.errors import RunError
from sim.generate import generate, simulate
from sim.scene import SceneFamily
from sim.stability import Cell
from sim.stability.courant import MATERIALS
from sim.stability.driver import PBF, SPH, solver_for, way
from sim.stability.refusal import FAMILY

#: Frame before which a teacher goes wrong.
WHEN = 4
#: What a material carries by ``state``, or water of a method.
STATES = {
    "water": ("position", "velocity", "velocity gradient", "stuff.J"), "sand": ("position", "velocity", "velocity gradient", "stuff.b - I"),
    "wcsph": ("position", "velocity", "density"), "dfsph": ("position", "velocity"),
    "pbf": ("position", "velocity"),
}  # fmt: skip


class Poisoned:
    """A teacher that writes ``value`` into a particle before frame ``WHEN``."""

    name, kind, compile_seconds = "poisoned", "solver", 0.0
    settings: dict = {}
    where, value = "velocity", np.nan

    def load(self, scene) -> None:
        self.solver, self.count = solver_for(scene), 0
        self.solver.load(scene)

    def frame(self) -> np.ndarray:
        self.count += 1
        if self.count == WHEN:
            self.solver.inject(self.where, 7, self.value)
        return self.solver.frame()

    def diagnostics(self) -> dict[str, float]:
        return self.solver.diagnostics()


def _family(name: str) -> SceneFamily:
    changes = {"materials": {"stuff": (MATERIALS | SPH | PBF)[name]}, "frames": 8, "gravity": [0.0, -9.8]}
    return SceneFamily(FAMILY | changes | way(name), "nan.yaml")


def run() -> list[Cell]:
    """Every field of two materials and of water by the other methods, then data sets."""
    cells = []
    for name, fields in STATES.items():
        teacher = Poisoned()
        for where in fields:
            for value in (np.nan, np.inf):
                begun = time.perf_counter()
                teacher.where, teacher.value = where, value
                trajectory = simulate(teacher, _family(name).sample(0))
                kept = len(trajectory.position) == WHEN and bool(np.isfinite(trajectory.position).all())
                right = trajectory.status.startswith("failed: ") and trajectory.status.endswith(f"(frame {WHEN})") and kept
                cells.append(Cell("not_a_number", f"{name}, {value:g} in its {where.removeprefix('stuff.')}", right,
                                  "failed within the frame; the frames before it are sound", trajectory.status, {},
                                  time.perf_counter() - begun))  # fmt: skip
    for name in ("water", *SPH, *PBF):
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as place:
            try:
                generate(_family(name), {"train": 2}, Path(place) / "out", teacher=Poisoned)
                said = "accepted"
            except RunError as error:
                said = str(error).replace(f"{place}/", "")
            files = sorted(path.name for path in Path(place).rglob("*.h5"))
        right = "all 2 trajectories of train failed; the first: failed: " in said and not files
        cells.append(Cell("not_a_number", f"{name}, a data set of poisoned trajectories", right, "nothing written, every failure named", said,
                          {"files": ", ".join(files) or None}, time.perf_counter() - begun))  # fmt: skip
    return cells
