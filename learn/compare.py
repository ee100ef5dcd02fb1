"""Error against run time: every contender on every test trajectory, and interleaved run times (McGreivy & Hakim 2024).

``compare`` takes simulators and trajectories, so it knows neither a solver nor a model. A *row* is a JSON-able dict, one per scene and
contender; what is made of rows (``learn.analysis``) is a function of them alone, and a module of its own, so that to edit it measures nothing again.
``null`` in a row is undefined, never, or failed; ``status``, ``failures`` and ``one_step_note`` say which.
"""

from __future__ import annotations

import math
import os
import platform
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from learn import metrics
from sim import periodic
from sim.errors import InputError
from sim.simulator import Rollout, SimulationError, Simulator, Start, rollout, start_from
from sim.trajectory import KINEMATIC_TYPE, Trajectory

#: Kinds that a learned model is a rival of: the solver ladder and its most expensive rung, the solver that made the truth.
SOLVERS = ("solver", "reference")
#: Kinds that restart only from a scene, not from positions.
_FROM_SCENE = (*SOLVERS, "floor")
#: What errors may be set over (``learn.generalisation``), besides the numbers that a scene's ``context`` names.
PARTICLES, SCENE = "particles", "scene"
#: What a target may be relative to besides a contender (``learn.analysis``): the least error of a trivial baseline.
BEST_TRIVIAL = "best trivial"
#: In a target, for the model that ``learn.analysis.best_learned`` names.
BEST_LEARNED = "best learned"


@dataclass(frozen=True)
class CompareSettings:
    """What a comparison holds fixed for every contender."""

    reference: str = "teacher"  # whose trajectories are the truth: "teacher", or "fine teacher" where the solver ran refined
    history: int = 6  # known frames; raised to what the hungriest contender needs, so that all predict the same frames
    horizons: tuple[int, ...] = metrics.HORIZONS  # [frames]
    one_step_samples: int = 10  # times, evenly spaced over a trajectory, at which a single step from true history is taken
    emd_particles: int = 500  # clouds above this are subsampled for the exact matching (cost ~ n^3)
    sinkhorn_particles: int = 300  # cost ~ n^3 as well, and several times as much
    curve_points: int = 200  # frames kept of the curves in a row


# Rollouts into rows ---------------------------------------------------------------------------------------------------------


def _drive(contender: Simulator, start: Start, frames: int) -> Rollout:
    """``rollout``; a solver that fails while it runs the known frames in ``begin`` is a failed rollout as well."""
    try:
        return rollout(contender, start, frames)
    except SimulationError as error:
        position = np.full((frames, *start.history.shape[1:]), np.nan, np.float32)
        return Rollout(position=position, seconds=math.nan, begin_seconds=math.nan, status=f"failed: {error} (frame {start.present})")


def _single_steps(contender: Simulator, trajectory: Trajectory, settings: CompareSettings, history: int) -> dict[str, float | None]:
    """One-step MSE, all and moving particles, over the sampled times; NaN if a step fails, None for what cannot restart from positions."""
    names = ("one_step_mse", "one_step_mse_moving")
    if contender.kind in _FROM_SCENE:
        return dict.fromkeys(names)
    times = np.unique(np.linspace(history - 1, len(trajectory.position) - 2, settings.one_step_samples).round().astype(int))
    steps = []
    for present in times:
        try:
            contender.begin(start_from(trajectory, history, int(present)))
            steps.append(contender.advance()[0])
        except SimulationError:
            return dict.fromkeys(names, math.nan)
    true, moving = trajectory.position[times + 1], trajectory.moving
    predicted = periodic.beside(np.stack(steps), true, trajectory.period)
    return dict(zip(names, (metrics.one_step_mse(predicted, true), metrics.one_step_mse(predicted[:, moving], true[:, moving])), strict=True))


def _measure(contender: Simulator, trajectory: Trajectory, settings: CompareSettings, history: int) -> tuple[dict, dict]:
    """(every figure, the curves by frame) of one contender on one trajectory; NaN, inf and None as in ``learn.metrics``."""
    present, frames, moving = history - 1, len(trajectory.position) - history, trajectory.moving
    run = _drive(contender, start_from(trajectory, history), frames)
    done = int(np.isfinite(run.position).all(axis=(1, 2)).sum())
    figures = _single_steps(contender, trajectory, settings, history) | metrics.evaluate(
        run.position,
        trajectory,
        present,
        horizons=settings.horizons,
        emd_particles=settings.emd_particles,
        sinkhorn_particles=settings.sinkhorn_particles,
    )
    figures |= {
        "trajectory_seed": trajectory.seed,
        "model_seed": contender.settings.get("seed"),
        "status": run.status,
        "particles": trajectory.position.shape[1],
        "context": _context_numbers(trajectory),
        "seconds_per_frame": run.seconds / done if done else math.nan,
    }
    before, true, period = trajectory.position[present, moving], trajectory.position[history:, moving], trajectory.period

    def energy(position: np.ndarray) -> np.ndarray:
        return metrics.kinetic_energy(metrics.velocities(position, before, trajectory.frame_step, period))

    curves = {
        "mse": metrics.frame_mse(periodic.beside(run.position[:, moving], true, period), true),
        "kinetic_energy": energy(run.position[:, moving]),
        "kinetic_energy_true": energy(true),
    }
    return figures, curves


def _context_numbers(trajectory: Trajectory) -> dict[str, float]:
    """Numbers that the scene's ``context`` names, the same in every frame: name -> value. They are the last columns."""
    names = trajectory.scene.get("context") or []
    if not names or trajectory.context is None:
        return {}
    return dict(zip(names, trajectory.context[0, -len(names) :].tolist(), strict=True))


def plain(value: object) -> Any:
    """JSON-able: numpy to Python, non-finite numbers to None."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _aggregate(runs: list[dict], reduce) -> dict:
    """Reduce every figure over runs. Undefined runs are left out, a failed one counts as infinitely bad: it must not flatter a median."""
    result: dict = {}
    for key, first in runs[0].items():
        if isinstance(first, dict):
            result[key] = _aggregate([run[key] for run in runs], reduce)
        else:
            values = [math.inf if math.isnan(run[key]) else run[key] for run in runs if run[key] is not None]
            result[key] = float(reduce(values)) if values else None
    return result


_LABELS = ("trajectory_seed", "model_seed", "status", "particles", "context")


def _figures(runs: list[dict]) -> list[dict]:
    return [{key: value for key, value in run.items() if key not in _LABELS} for run in runs]


def _row(
    scene: str,
    contenders: list[Simulator],
    runs: list[dict],
    curves: list[dict],
    trajectories: list[Trajectory],
    settings: CompareSettings,
    history: int,
) -> dict:
    contender, frame_step = contenders[0], trajectories[0].frame_step
    failed = [run["status"] for run in runs if run["status"] != "ok"]
    status = "ok" if not failed else f"failed in {len(failed)} of {len(runs)}: {failed[0].removeprefix('failed: ')}"
    figures = _figures(runs)
    median = _aggregate(figures, np.median)
    seeds = sorted({run["model_seed"] for run in runs if run["model_seed"] is not None})
    shown = {key: value for key, value in contender.settings.items() if key != "seed"} | ({"seeds": seeds} if seeds else {})
    length = min(len(curve["mse"]) for curve in curves)
    kept = np.unique(np.linspace(0, length - 1, settings.curve_points).round().astype(int))
    stacked = {name: np.nan_to_num(np.stack([curve[name][kept] for curve in curves]), nan=math.inf, posinf=math.inf) for name in curves[0]}
    bands = {name: {"median": np.median(values, axis=0), "min": values.min(axis=0), "max": values.max(axis=0)} for name, values in stacked.items()}
    row = {
        "scene": scene,
        "contender": contender.name,
        "kind": contender.kind,
        "settings": shown,
        "reference": settings.reference,
        "status": status,
        "failures": len(failed),
        "runs": len(runs),
        "trajectories": len(trajectories),
        "known_frames": history,
        "frames": length,
        "frame_step": frame_step,
        "one_step_note": "restarts from a scene only, not from positions" if contender.kind in _FROM_SCENE else None,
        **median,
        "seconds_per_simulated_second": median["seconds_per_frame"] / frame_step,
        "compile_seconds": None,
        "timing": "rollouts of the comparison, one after the other",
        "mean": _aggregate(figures, np.mean),
        "spread": {
            "min": _aggregate(figures, np.min),
            "max": _aggregate(figures, np.max),
            "per_seed": [{"seed": seed} | _aggregate(_figures([run for run in runs if run["model_seed"] == seed]), np.median) for seed in seeds],
            "per_trajectory": runs,
        },
        "curves": {"frame": kept + 1} | bands,
    }
    return plain(row)


def known_frames(contenders: Sequence[Simulator], settings: CompareSettings) -> int:
    """Frames that every contender is given: what the hungriest needs, so that all predict the same frames."""
    return max([settings.history, *(getattr(contender, "history", 1) for contender in contenders)])


def compare(contenders: Sequence[Simulator], trajectories: Sequence[Trajectory], settings: CompareSettings) -> list[dict]:
    """One row per scene and contender: medians over trajectories (and training seeds), means, spread, curves. Failures are rows.

    Every contender gets the same known frames and predicts all the rest of each trajectory. Contenders of one name are one row and must
    differ in ``settings["seed"]`` alone (repeated trainings); ``ValueError`` otherwise, ``InputError`` for trajectories without frames to predict.
    ``seconds_per_frame`` comes from these rollouts until ``attach_timing`` brings interleaved figures.
    """
    history = known_frames(contenders, settings)
    groups: dict[str, list[Simulator]] = {}
    for contender in contenders:
        groups.setdefault(contender.name, []).append(contender)
    for name, group in groups.items():
        fixed = [{key: value for key, value in one.settings.items() if key != "seed"} for one in group]
        if len(group) > 1 and (any(one != fixed[0] for one in fixed) or len({one.settings.get("seed") for one in group}) < len(group)):
            raise ValueError(f"contender = {name!r}: several contenders of one name may differ in settings.seed alone; rename them")
    scenes: dict[str, list[Trajectory]] = {}
    for trajectory in trajectories:
        if len(trajectory.position) <= history:
            remedy = f"needs more than the {history} known ones; give longer trajectories"
            raise InputError(f"trajectory of seed {trajectory.seed}", "frames", len(trajectory.position), remedy)
        if not trajectory.moving.any():
            raise InputError(f"trajectory of seed {trajectory.seed}", "particle_type", KINEMATIC_TYPE, "nothing in it moves; give another one")
        if not isinstance(called := trajectory.scene.get("name"), str):
            raise InputError(f"trajectory of seed {trajectory.seed}", "scene.name", called, "needs a name, which tells the rows of scenes apart")
        scenes.setdefault(called, []).append(trajectory)
    rows = []
    for scene, tests in scenes.items():
        for group in groups.values():
            measured = [_measure(contender, trajectory, settings, history) for contender in group for trajectory in tests]
            runs, curves = zip(*measured, strict=True)
            rows.append(_row(scene, group, list(runs), list(curves), tests, settings, history))
    return rows


def median_trajectory(rows: list[dict], contender: str) -> int:
    """Number of the test trajectory on which a contender's rollout MSE of moving particles is its (lower) median, failures being worst; of its first
    training seed."""
    runs = next(row for row in rows if row["contender"] == contender)["spread"]["per_trajectory"]
    runs = [run for run in runs if run["model_seed"] == runs[0]["model_seed"]]
    errors = [math.inf if (error := run["rollout_mse_moving"]["all"]) is None else error for run in runs]
    return sorted(range(len(errors)), key=errors.__getitem__)[(len(errors) - 1) // 2]


# Timing ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Timing:
    """Interleaved, warm run times of one contender. per_frame: one entry a repeat [s]; compile_seconds: what the first begin and first
    ``advance`` took beyond the later ones."""

    contender: str
    frame_step: float
    frames: int
    compile_seconds: float
    per_frame: list[float] = field(default_factory=list)
    status: str = "ok"

    @property
    def seconds_per_frame(self) -> float | None:
        """Median over repeats."""
        return float(np.median(self.per_frame)) if self.per_frame else None


def _timed_run(contender: Simulator, start: Start, frames: int) -> tuple[float, float]:
    """(begin and first advance [s], seconds per frame without begin). A block of several frames is counted whole: it was paid for."""
    clock = time.perf_counter
    begun = clock()
    contender.begin(start)
    ready = clock()
    done, opening = 0, 0.0
    while done < frames:
        done += len(contender.advance())
        opening = opening or clock() - begun
    return opening, (clock() - ready) / done


def time_interleaved(contenders: Sequence[Simulator], start: Start, frames: int, repeats: int = 5) -> list[Timing]:
    """Time contenders on one start: a warm-up each, then ``repeats`` rounds in which every contender runs all the frames once.

    The rounds start with another contender each time, so that slow drifts of the machine touch all alike. Neighbour search is inside
    ``advance``, compilation and allocation in ``begin`` and thus apart, nothing is written, and a device is synchronised because frames come
    back as host arrays. A contender that fails keeps the rounds it finished and says so. ``ValueError`` below 5 repeats.
    """
    if repeats < 5:
        raise ValueError(f"repeats = {repeats}: a median and a spread need at least 5")
    first: dict[int, float] = {}
    later: dict[int, list[float]] = {index: [] for index in range(len(contenders))}
    per_frame: dict[int, list[float]] = {index: [] for index in range(len(contenders))}
    status = dict.fromkeys(later, "ok")
    for round_ in range(-1, repeats):
        for turn in range(len(contenders)):
            index = (turn + max(round_, 0)) % len(contenders)
            if status[index] != "ok":
                continue
            try:
                # The warm-up runs all the frames too: late frames may meet code that early ones did not.
                opening, seconds = _timed_run(contenders[index], start, frames)
            except SimulationError as error:
                status[index] = f"failed: {error}"
                continue
            if round_ < 0:
                first[index] = opening
            else:
                later[index].append(opening)
                per_frame[index].append(seconds)
    return [
        Timing(
            contender=contender.name,
            frame_step=start.frame_step,
            frames=frames,
            per_frame=per_frame[index],
            status=status[index],
            compile_seconds=max(first[index] - float(np.median(later[index])), 0.0) if later[index] else math.nan,
        )
        for index, contender in enumerate(contenders)
    ]


def time_comparison(
    contenders: Sequence[Simulator], trajectory: Trajectory, settings: CompareSettings, frames: int | None = None, repeats: int = 5
) -> list[Timing]:
    """``time_interleaved`` from the start that ``compare`` gives, one contender a name: repeated trainings cost the same.

    frames None: all that ``compare`` has predicted, so that times belong to its errors. A solver's first frames are often flight, the cheapest or
    the dearest of its run."""
    one_each = {contender.name: contender for contender in reversed(contenders)}
    history = known_frames(contenders, settings)
    frames = len(trajectory.position) - history if frames is None else frames
    return time_interleaved(list(reversed(one_each.values())), start_from(trajectory, history), frames, repeats)


def attach_timing(rows: list[dict], timings: Iterable[Timing], scene: str) -> list[dict]:
    """New rows in which the contenders timed on ``scene`` have the interleaved figures: median, and in ``timing_spread`` [min, max], n, every
    round's figure (those of one round were taken one after the other) and the frames that were timed."""
    known = {timing.contender: timing for timing in timings}
    result = []
    for row in rows:
        timing = known.get(row["contender"])
        if row["scene"] == scene and timing is not None and timing.per_frame:
            low, high, median = min(timing.per_frame), max(timing.per_frame), float(np.median(timing.per_frame))
            row = row | {
                "seconds_per_frame": median,
                "seconds_per_simulated_second": median / timing.frame_step,
                "compile_seconds": timing.compile_seconds,
                "timing_spread": {"seconds_per_frame": [low, high], "n": len(timing.per_frame), "rounds": timing.per_frame, "frames": timing.frames},
                "timing": f"interleaved, median of {len(timing.per_frame)} warm runs of {timing.frames} frames",
            }
        result.append(row)
    return result


_FLAGS = ("avx2", "avx512f", "avx512_bf16", "amx_tile", "amx_bf16", "asimd", "sve", "bf16")


def hardware() -> dict:
    """What a run time belongs to: CPU model, cores this process may use, relevant instruction sets, thread settings, memory, GPU."""
    info: dict[str, str] = {}
    if Path("/proc/cpuinfo").is_file():
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            key, _, value = line.partition(":")
            info.setdefault(key.strip(), value.strip())
    flags = set((info.get("flags") or info.get("Features") or "").split())
    torch = sys.modules.get("torch")  # only asked where a contender has loaded it
    return {
        "cpu": info.get("model name") or platform.processor() or platform.machine(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "usable_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "flags": [flag for flag in _FLAGS if flag in flags],
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "threads": {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"), "torch": torch.get_num_threads() if torch else None},
        "gpu": torch.cuda.get_device_name() if torch and torch.cuda.is_available() else None,
    }


def versions() -> dict[str, str | None]:
    """Versions of what the figures depend on; None where a package is not installed. Nothing is imported for it."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in ("sluice", "numpy", "scipy", "torch", "taichi"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def summary(rows: list[dict]) -> dict:
    """The content of ``summary.json``: {"rows", "hardware", "versions"}."""
    return {"rows": rows, "hardware": hardware(), "versions": versions()}
