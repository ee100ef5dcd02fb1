"""Errors beyond the training: over the number of particles, over a number of the context, or scene by scene.

A function of rows alone, like all that follows ``learn.compare.compare``. Every error stands beside that of the best trivial baseline on the same
trajectory, for in a larger scene all moves farther: errors in length^2 grow there without a model being any worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from learn.analysis import MOVING_MSE, Yardstick
from learn.compare import PARTICLES, SCENE


@dataclass(frozen=True)
class Trial:
    """One rollout of a learned model: value: of what errors are set over (of ``SCENE``, the scene's place among the rows); error: infinite if it
    failed; trivial: the least error of a trivial baseline on this trajectory; floor: the chaos floor's, None without one."""

    scene: str
    value: float
    error: float
    trivial: float
    floor: float | None

    @property
    def ratio(self) -> float:
        """Error over the best trivial baseline's."""
        return self.error / self.trivial if self.trivial > 0 else math.inf


@dataclass(frozen=True)
class Group:
    """Trials of one scene, or with values between two ends of what was trained on; trained: whether it was trained on, None if unknown."""

    name: str
    trained: bool | None
    trials: tuple[Trial, ...]

    def median(self, key: str) -> float:
        """Of ``value``, ``error``, ``trivial`` or ``ratio``; infinite if half of them failed."""
        return float(np.median([getattr(trial, key) for trial in self.trials]))


def _errors(rows: Sequence[dict], kind: str, yardstick: Yardstick) -> dict[tuple[str, int], float]:
    """(scene, seed of the trajectory) -> least error of a contender of a kind; failed ones have none."""
    least: dict[tuple[str, int], float] = {}
    for row in rows:
        for run in row["spread"]["per_trajectory"] if row["kind"] == kind else ():
            error, key = yardstick.of(run), (row["scene"], run["trajectory_seed"])
            if error is not None:
                least[key] = min(error, least.get(key, math.inf))
    return least


def trials(rows: Sequence[dict], model: str, over: str, yardstick: Yardstick = MOVING_MSE) -> list[Trial]:
    """All rollouts of a learned contender, in the order of the rows; rows: of one scene or several. ``ValueError`` if ``over`` is in no context."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    trivial, floor = (_errors(rows, kind, yardstick) for kind in ("trivial", "floor"))
    found = []
    for row in (row for row in rows if row["contender"] == model):
        for run in row["spread"]["per_trajectory"]:
            if over not in (PARTICLES, SCENE, *run["context"]):
                raise ValueError(f"over = {over!r}: not in the context of {row['scene']}, {sorted(run['context'])}")
            value = {PARTICLES: run["particles"], SCENE: scenes.index(row["scene"]), **run["context"]}[over]
            error, key = yardstick.of(run), (row["scene"], run["trajectory_seed"])
            found.append(Trial(row["scene"], value, math.inf if error is None else error, trivial[key], floor.get(key)))
    return found


def groups(found: Sequence[Trial], over: str, trained: Sequence[tuple[float, float]] = ()) -> list[Group]:
    """Trials by scene, or over a number of the context by the intervals between the ends of what was ``trained`` on ([low, high], ascending)."""
    if over in (PARTICLES, SCENE):
        by_scene: dict[str, list[Trial]] = {}
        for trial in found:
            by_scene.setdefault(trial.scene, []).append(trial)

        def inside(members: list[Trial]) -> bool | None:
            return all(any(low <= trial.value <= high for low, high in trained) for trial in members) if trained and over == PARTICLES else None

        return [Group(scene, inside(members), tuple(members)) for scene, members in by_scene.items()]
    ends = [-math.inf, *sorted(end for ends in trained for end in ends), math.inf]
    result = []
    for low, high in zip(ends[:-1], ends[1:], strict=True):
        # An end of what was trained on belongs to it.
        known = any(low >= first and high <= last for first, last in trained)
        members = [trial for trial in found if (low <= trial.value <= high if known else low < trial.value < high)]
        if members:
            result.append(Group(_interval(low, high), known if trained else None, tuple(members)))
    return result


def _interval(low: float, high: float) -> str:
    if math.isinf(low):
        return f"below {high:g}" if math.isfinite(high) else "all"
    return f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
