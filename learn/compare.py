"""Error against run time: every contender on every test trajectory, then what the learning bought (McGreivy & Hakim 2024).

``compare`` takes simulators and trajectories, so it knows neither a solver nor a model. A *row* is a JSON-able dict, one per scene and
contender; everything after ``compare`` (speed-up, break-even, verdict) is a function of rows alone. ``null`` in a row is undefined, never,
or failed; ``status``, ``failures`` and ``one_step_note`` say which.
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
from typing import Any, Literal

import numpy as np

from learn import metrics
from learn.units import duration, number
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
    contenders: Sequence[Simulator], trajectory: Trajectory, settings: CompareSettings, frames: int, repeats: int = 5
) -> list[Timing]:
    """``time_interleaved`` from the start that ``compare`` gives, one contender a name: repeated trainings cost the same."""
    one_each = {contender.name: contender for contender in reversed(contenders)}
    start = start_from(trajectory, known_frames(contenders, settings))
    return time_interleaved(list(reversed(one_each.values())), start, frames, repeats)


def attach_timing(rows: list[dict], timings: Iterable[Timing], scene: str) -> list[dict]:
    """New rows in which the contenders timed on ``scene`` have the interleaved figures: median, [min, max] and n in ``timing_spread``."""
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
                "timing_spread": {"seconds_per_frame": [low, high], "n": len(timing.per_frame)},
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


# What the learning bought: functions of rows --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Yardstick:
    """The error that decides: a metric of the rows and, where that has several, its horizon or share of the rollout. Smaller is better."""

    metric: str = "rollout_mse_moving"
    at: str | None = "all"
    over: Literal["median", "mean"] = "median"  # of the trajectories

    def of(self, row: dict) -> float | None:
        """The figure of a row, None where it is undefined or failed."""
        value = (row["mean"] if self.over == "mean" else row)[self.metric]
        return value.get(self.at) if isinstance(value, dict) else value

    def known(self, row: dict) -> float:
        """``of`` a row that has it."""
        value = self.of(row)
        assert value is not None
        return value

    def __str__(self) -> str:
        name = self.metric.removesuffix("_moving").replace("_", " ").replace("mse", "MSE").replace("emd", "EMD")
        if self.metric.endswith("_moving"):
            name += " of moving particles"
        if self.over == "mean":
            name = f"mean {name}"
        if self.at is None:
            return name
        if "mse" in self.metric:
            return f"{name} over {self.at} frames"
        return f"{name} at the end" if float(self.at) == 1 else f"{name} at {float(self.at):.0%} of the run"


#: The paper's rollout MSE, without the static particles that would dilute it.
MOVING_MSE = Yardstick()


def _comparable(rows: Sequence[dict], row: dict, kinds: Sequence[str]) -> list[dict]:
    return [other for other in rows if other["kind"] in kinds and other["scene"] == row["scene"] and other["reference"] == row["reference"]]


def _rungs(rows: list[dict], model: dict, yardstick: Yardstick) -> list[dict]:
    """The solver rungs a model can be measured with: same scene and reference, no failure, error and time known."""
    return [
        row
        for row in _comparable(rows, model, SOLVERS)
        if row["failures"] == 0 and yardstick.of(row) is not None and row["seconds_per_frame"] is not None
    ]


def _floor(rows: Sequence[dict], row: dict) -> dict | None:
    floors = _comparable(rows, row, ("floor",))
    return floors[0] if floors else None


def _range(row: dict) -> tuple[float, float]:
    spread = row.get("timing_spread")
    return tuple(spread["seconds_per_frame"]) if spread else (row["seconds_per_frame"],) * 2


def speed_up_paper(rows: list[dict], model: dict) -> float | None:
    """Time of the reference over time of the model, whatever the model's error: what papers call the speed-up. None if either is unknown."""
    references = [row for row in _comparable(rows, model, ("reference",)) if row["seconds_per_frame"] is not None]
    return references[0]["seconds_per_frame"] / model["seconds_per_frame"] if references and model["seconds_per_frame"] else None


def speed_up_at_equal_error(rows: list[dict], model: dict, yardstick: Yardstick = MOVING_MSE) -> dict:
    """{"ratio", "rung", "rung_kind", "outcome"}: time of the cheapest solver rung, the reference included, that errs at most as the model
    does, over the time of the model. Above 1 the model is the cheaper one.

    Errors below the chaos floor mean nothing, so a rung need not be better than the floor. outcome: "wins"; "loses"; "ties" where the spreads
    of the timings overlap; "worse than trivial" where a trivial baseline errs less, whatever the ratio; "no rung" where no rung is as accurate,
    the reference not being timed; "failed" where the model's error or time is unknown or one of its rollouts failed.
    """
    nothing = {"ratio": None, "rung": None, "rung_kind": None}
    error = yardstick.of(model)
    if model["failures"] or error is None or model["seconds_per_frame"] is None:
        return nothing | {"outcome": "failed"}
    floor = _floor(rows, model)
    allowed = max(error, (yardstick.of(floor) or 0.0) if floor else 0.0)
    enough = [row for row in _rungs(rows, model, yardstick) if yardstick.known(row) <= allowed]
    if not enough:
        return nothing | {"outcome": "no rung"}
    rung = min(enough, key=lambda row: row["seconds_per_frame"])
    (model_low, model_high), (rung_low, rung_high) = _range(model), _range(rung)
    if worse_than_trivial(rows, model, yardstick):
        outcome = "worse than trivial"
    elif rung_low > model_high:
        outcome = "wins"
    elif model_low > rung_high:
        outcome = "loses"
    else:
        outcome = "ties"
    ratio = rung["seconds_per_frame"] / model["seconds_per_frame"]
    return {"ratio": ratio, "rung": rung["contender"], "rung_kind": rung["kind"], "outcome": outcome}


def error_at_equal_time(rows: list[dict], model: dict, yardstick: Yardstick = MOVING_MSE) -> dict:
    """{"rung", "error", "ratio"}: the most accurate solver rung that costs at most the model's time, and the model's error over its error.

    Below 1 the model is the more accurate one. rung None: no rung is as cheap. ratio None: the rung's error is zero (the reference itself).
    """
    error, seconds = yardstick.of(model), model["seconds_per_frame"]
    cheap = [row for row in _rungs(rows, model, yardstick) if seconds is not None and row["seconds_per_frame"] <= seconds]
    if not cheap:
        return {"rung": None, "error": None, "ratio": None}
    rung = min(cheap, key=yardstick.known)
    best = yardstick.known(rung)
    return {"rung": rung["contender"], "error": best, "ratio": error / best if error is not None and best > 0 else None}


def break_even(cost_seconds: float, solver_seconds: float, model_seconds: float) -> float | str:
    """Rollouts after which generation and training are paid back: cost / (t_solver - t_model), times of one rollout; "never" if <= 0."""
    saved = solver_seconds - model_seconds
    return cost_seconds / saved if saved > 0 else "never"


def pareto_front(rows: Sequence[dict], yardstick: Yardstick = MOVING_MSE) -> list[dict]:
    """Solver rungs and learned models that no other one beats in both time and error, by time; failed ones are never on it. One scene."""
    usable = [
        row
        for row in rows
        if row["kind"] in (*SOLVERS, "learned") and row["failures"] == 0 and yardstick.of(row) is not None and row["seconds_per_frame"] is not None
    ]
    front: list[dict] = []
    best = math.inf
    for row in sorted(usable, key=lambda row: (row["seconds_per_frame"], yardstick.known(row))):
        if yardstick.known(row) < best:
            front.append(row)
            best = yardstick.known(row)
    return front


def worse_than_trivial(rows: list[dict], row: dict, yardstick: Yardstick = MOVING_MSE) -> list[str]:
    """Names of the trivial baselines whose error is below the contender's; all of them if it has none because it failed."""
    error = yardstick.of(row)
    trivial = [(other["contender"], yardstick.of(other)) for other in _comparable(rows, row, ("trivial",))]
    return [name for name, bound in trivial if bound is not None and (error is None or bound < error)]


def median_trajectory(rows: list[dict], contender: str, yardstick: Yardstick = MOVING_MSE) -> int:
    """Number of the test trajectory on which a contender errs as in the (lower) median, failures being worst; of its first training seed."""
    runs = next(row for row in rows if row["contender"] == contender)["spread"]["per_trajectory"]
    runs = [run for run in runs if run["model_seed"] == runs[0]["model_seed"]]
    errors = [math.inf if (error := yardstick.of(run)) is None else error for run in runs]
    return sorted(range(len(errors)), key=errors.__getitem__)[(len(errors) - 1) // 2]


def over_floor(rows: Sequence[dict], row: dict, metric: str = "rollout_mse_moving") -> dict[str, float | None]:
    """Error over chaos floor per horizon: near 1 the rest is chance. None where there is no floor or it is zero."""
    floor = _floor(rows, row)
    values = floor[metric] if floor else {}
    return {at: value / values[at] if value is not None and values.get(at) else None for at, value in row[metric].items()}


def analyse(rows: list[dict], yardstick: Yardstick = MOVING_MSE) -> list[dict]:
    """Everything above for every learned row, JSON-able. Break-even needs ``row["cost"]`` = {"generation_seconds", "training_seconds"}.

    It is reckoned per rollout of the test's length, against the rung of ``equal_error`` and against the reference; None where unknown.
    """
    result = []
    for model in (row for row in rows if row["kind"] == "learned"):
        equal = speed_up_at_equal_error(rows, model, yardstick)
        paper = speed_up_paper(rows, model)

        def even(ratio: float | None, model: dict = model) -> float | str | None:
            if ratio is None or not model.get("cost"):
                return None
            seconds = model["seconds_per_frame"] * model["frames"]
            return break_even(model["cost"]["generation_seconds"] + model["cost"]["training_seconds"], ratio * seconds, seconds)

        front = pareto_front(_comparable(rows, model, (*SOLVERS, "learned")), yardstick)
        result.append(
            {
                "scene": model["scene"],
                "contender": model["contender"],
                "reference": model["reference"],
                "yardstick": str(yardstick),
                "error": yardstick.of(model),
                "seconds_per_frame": model["seconds_per_frame"],
                "speed_up_paper": paper,
                "equal_error": equal,
                "equal_time": error_at_equal_time(rows, model, yardstick),
                "break_even": even(equal["ratio"]),
                "break_even_reference": even(paper),
                "worse_than_trivial": worse_than_trivial(rows, model, yardstick),
                "over_floor": over_floor(rows, model),
                "pareto": any(row is model for row in front),
            }
        )
    return result


# The verdict ----------------------------------------------------------------------------------------------------------------


#: What a target may be relative to besides a contender: the least error of a trivial baseline.
BEST_TRIVIAL = "best trivial"


@dataclass(frozen=True)
class Target:
    """A figure that a study set out to reach: low <= metric of the contender (over that of ``relative_to``, if given) <= high."""

    scene: str
    contender: str
    yardstick: Yardstick
    high: float = math.inf
    low: float = -math.inf
    relative_to: str | None = None  # a contender, or ``BEST_TRIVIAL``


def missed_targets(rows: list[dict], targets: Sequence[Target]) -> list[str]:
    """One phrase per target that is not reached; a figure that is missing, or was never measured, is a target missed."""
    found = {(row["scene"], row["contender"]): row for row in rows}
    missed = []
    for target in targets:
        row = found.get((target.scene, target.contender))
        value = target.yardstick.of(row) if row else None
        what = f"{target.contender} on {target.scene}: {target.yardstick}"
        if target.relative_to is not None:
            what += f" over that of {target.relative_to}"
            key, wanted = ("kind", "trivial") if target.relative_to == BEST_TRIVIAL else ("contender", target.relative_to)
            bases = [other for other in rows if other["scene"] == target.scene and other[key] == wanted]
            divisor = min((bound for base in bases if (bound := target.yardstick.of(base)) is not None), default=None)
            value = value / divisor if value is not None and divisor else None
        if value is None:
            missed.append(f"{what} is unknown")
        elif not target.low <= value <= target.high:
            limit = f"at most {target.high:.3g}" if value > target.high else f"at least {target.low:.3g}"
            missed.append(f"{what} is {value:.3g}, not {limit}")
    return missed


def _names(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def best_learned(analysed: Sequence[dict]) -> dict | None:
    """The entry of ``analyse`` that one scene and reference are judged by; None if no learned model finished every rollout.

    Models that beat the trivial baselines come first, then one that no rung matches, then the largest ratio at equal error.
    """
    judged = [entry for entry in analysed if entry["equal_error"]["outcome"] != "failed"]
    return max(judged, key=lambda entry: (not entry["worse_than_trivial"], entry["equal_error"]["ratio"] or math.inf), default=None)


def by_scene(rows: Sequence[dict]) -> dict[tuple[str, str], list[dict]]:
    """Rows, or entries of ``analyse``, by (scene, reference): what can be compared with each other."""
    groups: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["reference"]), []).append(row)
    return groups


def scene_verdict(rows: list[dict], yardstick: Yardstick = MOVING_MSE) -> str:
    """Sentences on the rows of one scene and reference."""
    first = rows[0]
    where = (
        f"On {first['scene']} ({first['trajectories']} test {'trajectory' if first['trajectories'] == 1 else 'trajectories'} of {first['frames']} "
        f"predicted frames, truth: {first['reference']}, error: {yardstick})"
    )
    analysed = analyse(rows, yardstick)
    by_name = {row["contender"]: row for row in rows}
    best = best_learned(analysed)
    sentences = []
    if not analysed:
        sentences.append(f"{where}, no learned model was compared.")
    elif best is None:
        sentences.append(f"{where}, no learned model wins: none finished every rollout.")
    else:
        sentences += _best_model(where, best, by_name)
    for row in rows:
        if row["failures"]:
            sentences.append(f"{row['contender']} ({row['kind']}) {row['status']}.")
    for row in rows:
        better = worse_than_trivial(rows, row, yardstick) if row["kind"] in ("learned", *SOLVERS) else []
        if better:
            sentences.append(f"{row['contender']} ({row['kind']}) is worse than the trivial {_names(better)}.")
    return " ".join(sentences)


def _best_model(where: str, best: dict, by_name: dict[str, dict]) -> list[str]:
    """Who wins at equal error and by how much, at what training cost."""
    equal, name, row = best["equal_error"], best["contender"], by_name[best["contender"]]
    its = f"{name} takes {duration(best['seconds_per_frame'])} a frame at an error of {number(best['error'])}"
    sentences = []
    if best["worse_than_trivial"]:
        sentences.append(f"{where}, no learned model wins: {its}, worse than the trivial {_names(best['worse_than_trivial'])}.")
    elif equal["outcome"] == "no rung":
        sentences.append(f"{where}, no speed-up at equal error is defined: {its}, and no solver rung that was timed is as accurate.")
    else:
        rung, ratio = by_name[equal["rung"]], equal["ratio"]
        if equal["outcome"] == "wins":
            who = f"{name} wins at equal error, {number(ratio)} times faster than the solver"
        elif equal["outcome"] == "ties":
            who = f"no learned model wins at equal error; {name} ties with the solver within the spread of the timings"
        else:
            who = f"no learned model wins at equal error; the solver is {number(1 / ratio)} times faster than the best, {name}"
        match = f"{rung['contender']}, the cheapest solver rung at least as accurate, {duration(rung['seconds_per_frame'])}"
        if rung["kind"] == "reference":
            match += " (it is the reference itself: no cheaper rung reaches that error)"
        sentences.append(f"{where}, {who}: {its}, {match}.")
    if best["speed_up_paper"] is not None:
        sentences.append(f"Against the reference, accuracy aside, {name} is {number(best['speed_up_paper'])} times as fast.")
    cost = row.get("cost")
    if cost:
        data = f" on {cost['trajectories']} trajectories" if cost.get("trajectories") else ""
        sentence = f"It was trained{data} for {duration(cost['training_seconds'])}, after {duration(cost['generation_seconds'])} of data generation"
        if best["break_even"] == "never":
            sentence += ", which is never paid back at equal error"
        elif best["break_even"] is not None:
            sentence += f", paid back at equal error after {math.ceil(best['break_even'])} rollouts"
        sentences.append(sentence + ".")
    if best["over_floor"]["all"] is not None:
        sentences.append(f"Its MSE over all frames is {number(best['over_floor']['all'])} times the chaos floor.")
    return sentences


def _headline(groups: dict[tuple[str, str], list[dict]], yardstick: Yardstick) -> list[str]:
    """On how many of several scenes a learned model wins at equal error, which and by how much; how the others fall short."""
    scenes = [scene for scene, _ in groups]
    where: dict[str, list[str]] = {}
    ratios: dict[str, list[tuple[float, str, str]]] = {}
    for (scene, reference), rows in groups.items():
        place = scene if scenes.count(scene) == 1 else f"{scene} (truth: {reference})"
        analysed = analyse(rows, yardstick)
        best = best_learned(analysed)
        outcome = best["equal_error"]["outcome"] if best else "failed" if analysed else "none"
        where.setdefault(outcome, []).append(place)
        if best and best["equal_error"]["ratio"]:
            ratios.setdefault(outcome, []).append((best["equal_error"]["ratio"], best["contender"], place))
    wins = [f"{model} on {place}, {number(ratio)} times faster than the solver" for ratio, model, place in ratios.get("wins", [])]
    if wins:
        sentences = [f"At equal error ({yardstick}) a learned model wins on {len(wins)} of {len(groups)} scenes: {'; '.join(wins)}."]
    else:
        sentences = [f"No learned model wins at equal error ({yardstick}) on any of the {len(groups)} scenes."]
    if "loses" in where:
        ratio, model, place = max(ratios["loses"])
        lost = f"{len(where['loses'])} the solver is faster" if wins else f"{len(where['loses'])} the best loses to the solver"
        sentences.append(f"On {lost}, by the least on {place}, where {model} takes {number(1 / ratio)} times as long.")
    for outcome, text in (
        ("ties", "the best ties with the solver within the spread of the timings"),
        ("no rung", "no solver rung that was timed is as accurate"),
        ("worse than trivial", "the best is worse than a trivial baseline"),
        ("failed", "none finished every rollout"),
        ("none", "no learned model was compared"),
    ):
        if outcome in where:
            sentences.append(f"On {_names(where[outcome])} {text}.")
    return sentences


def verdict(rows: list[dict], targets: Sequence[Target] = (), yardstick: Yardstick = MOVING_MSE) -> str:
    """The first paragraph of a report, from figures alone: who wins at equal error and by how much, on what, at what cost, what was missed.

    Of several scenes it is a count, with what stands out; ``scene_verdict`` says the rest."""
    groups = by_scene(rows)
    sentences = _headline(groups, yardstick) if len(groups) > 1 else [scene_verdict(rows, yardstick)]
    missed = missed_targets(rows, targets)
    if missed:
        sentences.append(f"Missed: {'; '.join(missed)}.")
    elif targets:
        sentences.append(f"All {len(targets)} targets of the study are reached." if len(targets) > 1 else "The target of the study is reached.")
    return " ".join(sentences)
