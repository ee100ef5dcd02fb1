"""What the learning bought: speed-up at equal error, break-even, the verdict (McGreivy & Hakim 2024); functions of the rows of ``learn.compare``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from learn.compare import BEST_LEARNED, BEST_TRIVIAL, SOLVERS
from learn.units import duration, number


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
        name = self.metric.removesuffix("_moving").replace("_", " ").replace("mse", "MSE").replace("emd", "EMD").replace("speed up", "speed-up")
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


def _ratios(rung: dict, model: dict) -> list[float]:
    """Time of the rung over the model's in every round of the interleaved timing; of the figures themselves where they have no rounds in common."""
    times = [(row.get("timing_spread") or {}).get("rounds", []) for row in (rung, model)]
    if not times[0] or len(times[0]) != len(times[1]):
        times = [[row["seconds_per_frame"]] for row in (rung, model)]
    return [solver / learned for solver, learned in zip(*times, strict=True)]


def speed_up_paper(rows: list[dict], model: dict) -> float | None:
    """Time of the reference over time of the model, whatever the model's error: what papers call the speed-up. None if either is unknown."""
    references = [row for row in _comparable(rows, model, ("reference",)) if row["seconds_per_frame"] is not None]
    return references[0]["seconds_per_frame"] / model["seconds_per_frame"] if references and model["seconds_per_frame"] else None


#: A speed-up that a tenth more error takes away is the ladder's rather than the model's.
SLACK = 0.1


def speed_up_at_equal_error(rows: list[dict], model: dict, yardstick: Yardstick = MOVING_MSE, slack: float = 0.0) -> dict:
    """{"ratio", "rung", "rung_kind", "outcome"}: time of the cheapest solver rung, the reference included, that errs at most as the model
    does, or by the share ``slack`` more, over the time of the model (of their medians). Above 1 the model is the cheaper one.

    Errors below the chaos floor mean nothing, so a rung need not be better than the floor. outcome: "wins" or "loses" where every round of
    the interleaved timing says so, else "ties"; "worse than trivial" where a trivial baseline errs less, whatever the ratio; "no rung" where
    none is as accurate, the reference not being timed; "failed" where the model's error or time is unknown or one of its rollouts failed.
    """
    nothing = {"ratio": None, "rung": None, "rung_kind": None}
    error = yardstick.of(model)
    if model["failures"] or error is None or model["seconds_per_frame"] is None:
        return nothing | {"outcome": "failed"}
    floor = _floor(rows, model)
    allowed = max(error * (1 + slack), (yardstick.of(floor) or 0.0) if floor else 0.0)
    enough = [row for row in _rungs(rows, model, yardstick) if yardstick.known(row) <= allowed]
    if not enough:
        return nothing | {"outcome": "no rung"}
    rung = min(enough, key=lambda row: row["seconds_per_frame"])
    ratios = _ratios(rung, model)
    if worse_than_trivial(rows, model, yardstick):
        outcome = "worse than trivial"
    elif min(ratios) > 1:
        outcome = "wins"
    elif max(ratios) < 1:
        outcome = "loses"
    else:
        outcome = "ties"
    ratio = rung["seconds_per_frame"] / model["seconds_per_frame"]
    return {"ratio": ratio, "rung": rung["contender"], "rung_kind": rung["kind"], "outcome": outcome}


def speed_ups_of_seeds(rows: list[dict], model: dict, yardstick: Yardstick = MOVING_MSE) -> list[dict]:
    """``speed_up_at_equal_error`` of each training by itself, by its own error and the time of the row; empty where there was one training."""
    seeds = model["spread"]["per_seed"]
    if len(seeds) < 2:
        return []
    return [speed_up_at_equal_error(rows, model | {yardstick.metric: seed[yardstick.metric]}, yardstick) for seed in seeds]


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


def over_floor(rows: Sequence[dict], row: dict, metric: str = "rollout_mse_moving") -> dict[str, float | None]:
    """Error over chaos floor per horizon: near 1 the rest is chance. None where there is no floor or it is zero."""
    floor = _floor(rows, row)
    values = floor[metric] if floor else {}
    return {at: value / values[at] if value is not None and values.get(at) else None for at, value in row[metric].items()}


def analyse(rows: list[dict], yardstick: Yardstick = MOVING_MSE) -> list[dict]:
    """Everything above for every learned row, JSON-able. Break-even needs ``row["cost"]`` = {"generation_seconds", "training_seconds"}.

    It is reckoned per rollout of the test's length, against the rung of ``equal_error`` and against the reference; None where unknown, and for a
    tie. ``equal_error_mean``: ``equal_error`` by means over the trajectories in place of medians, which a few bad rollouts do not move;
    ``equal_error_seeds``: of each training by itself, where there are several; ``equal_error_slack``: against rungs that err up to a tenth more.
    """
    result = []
    for model in (row for row in rows if row["kind"] == "learned"):
        equal = speed_up_at_equal_error(rows, model, yardstick)
        means = replace(yardstick, over="mean")
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
                "equal_error_mean": speed_up_at_equal_error(rows, model, means),
                "equal_error_seeds": speed_ups_of_seeds(rows, model, yardstick),
                "equal_error_slack": speed_up_at_equal_error(rows, model, yardstick, SLACK),
                "equal_time": error_at_equal_time(rows, model, yardstick),
                "break_even": None if equal["outcome"] == "ties" else even(equal["ratio"]),
                "break_even_reference": even(paper),
                "worse_than_trivial": worse_than_trivial(rows, model, yardstick),
                "over_floor": over_floor(rows, model),
                "pareto": any(row is model for row in front),
            }
        )
    return result


# The verdict ----------------------------------------------------------------------------------------------------------------

#: A target's metric: the ratio of ``speed_up_at_equal_error``.
SPEED_UP = "speed_up_at_equal_error"


@dataclass(frozen=True)
class Target:
    """A figure that a study set out to reach: low <= metric of the contender (over that of ``relative_to``, if given) <= high."""

    scene: str
    contender: str  # its name, or ``BEST_LEARNED``
    yardstick: Yardstick  # a metric of the rows, or ``SPEED_UP``
    high: float = math.inf
    low: float = -math.inf
    relative_to: str | None = None  # a contender, or ``BEST_TRIVIAL``


def _measured(rows: list[dict], target: Target, yardstick: Yardstick) -> tuple[str, float | None]:
    """Name of the target's contender, and its figure; None where that is not known, or a speed-up of a model worse than a trivial baseline."""
    same, name = [row for row in rows if row["scene"] == target.scene], target.contender
    if name == BEST_LEARNED:
        best = best_learned(analyse(same, yardstick))
        name = best["contender"] if best else name
    row = next((row for row in same if row["contender"] == name), None)
    if row is None:
        return name, None
    if target.yardstick.metric != SPEED_UP:
        return name, target.yardstick.of(row)
    equal = speed_up_at_equal_error(same, row, yardstick)
    return name, equal["ratio"] if equal["outcome"] in ("wins", "ties", "loses") else None


def missed_targets(rows: list[dict], targets: Sequence[Target], yardstick: Yardstick = MOVING_MSE) -> list[str]:
    """One phrase per target that is not reached, or for all that miss one limit of one figure; one that was never measured is a target missed.

    yardstick: the error at which contenders are equal, see ``speed_up_at_equal_error`` and ``best_learned``."""
    missed: dict[tuple[str, str], list[tuple[str, str]]] = {}  # (figure, limit) -> (who, value)
    for target in targets:
        name, value = _measured(rows, target, yardstick)
        figure = str(target.yardstick)
        if target.relative_to is not None:
            figure += f" over that of {target.relative_to}"
            key, wanted = ("kind", "trivial") if target.relative_to == BEST_TRIVIAL else ("contender", target.relative_to)
            bases = [other for other in rows if other["scene"] == target.scene and other[key] == wanted]
            divisor = min((bound for base in bases if (bound := target.yardstick.of(base)) is not None), default=None)
            value = value / divisor if value is not None and divisor else None
        above = value > target.high if value is not None else target.high < math.inf
        limit = f"at most {target.high:.3g}" if above else f"at least {target.low:.3g}"
        if value is None or not target.low <= value <= target.high:
            shown = "unknown" if value is None else f"{value:.3g}"
            missed.setdefault((figure, limit), []).append((f"{name} on {target.scene}", shown))
    phrases = []
    for (figure, limit), those in missed.items():
        if len(those) == 1:
            ((who, shown),) = those
            phrases.append(f"{who}: {figure} is {shown}, not {limit}")
        else:
            phrases.append(f"{figure} is not {limit} but {', '.join(f'{shown} ({who})' for who, shown in those)}")
    return phrases


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
            who = f"no learned model wins at equal error; {name} ties with the solver: the rounds of the timing disagree on who is faster"
        else:
            who = f"no learned model wins at equal error; the solver is {number(1 / ratio)} times faster than the best, {name}"
        match = f"{rung['contender']}, the cheapest solver rung at least as accurate, {duration(rung['seconds_per_frame'])}"
        if rung["kind"] == "reference":
            match += " (it is the reference itself: no cheaper rung reaches that error)"
        sentences.append(f"{where}, {who}: {its}, {match}.")
        sentences += _otherwise("By the mean of the errors in place of their median", equal, best["equal_error_mean"])
        sentences += _otherwise("Beside rungs that err up to a tenth more", equal, best["equal_error_slack"])
        sentences += _by_training(best["equal_error_seeds"])
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


def _otherwise(how: str, equal: dict, other: dict) -> list[str]:
    """A sentence where another measure than ``equal`` says something else."""
    if other["outcome"] == equal["outcome"] and other["ratio"] is not None and abs(math.log(other["ratio"] / equal["ratio"])) < 0.1:
        return []
    said = {
        "wins": f"it wins by {number(other['ratio'] or 1)}",
        "ties": "it ties",
        "loses": f"the solver is {number(1 / (other['ratio'] or 1))} times faster",
        "worse than trivial": "it is worse than a trivial baseline",
        "no rung": "no rung is as accurate",
        "failed": "it failed",
    }
    return [f"{how}, {said[other['outcome']]}."]


def _by_training(seeds: Sequence[dict]) -> list[str]:
    """A sentence on the outcomes of repeated trainings; none where there was one."""
    one = {
        "wins": "wins",
        "ties": "ties",
        "loses": "loses",
        "worse than trivial": "is worse than a trivial baseline",
        "no rung": "has no rung to match",
    }
    several = {
        "wins": "win",
        "ties": "tie",
        "loses": "lose",
        "worse than trivial": "are worse than a trivial baseline",
        "no rung": "have no rung to match",
    }
    parts = []
    for outcome in one:
        ratios = sorted(equal["ratio"] or math.inf for equal in seeds if equal["outcome"] == outcome)
        if ratios:
            by = f" ({', '.join(number(ratio) for ratio in ratios)})" if ratios[-1] < math.inf else ""
            who = f"each of {len(seeds)}" if len(ratios) == len(seeds) else str(len(ratios))
            verb = (several if 1 < len(ratios) < len(seeds) else one)[outcome]
            parts.append(f"{who} {verb}{by}")
    return [f"Trainings by themselves: {'; '.join(parts)}."] if parts else []


def _headline(groups: dict[tuple[str, str], list[dict]], yardstick: Yardstick) -> list[str]:
    """On how many of several scenes a learned model wins at equal error, which and by how much; how the others fall short."""
    scenes = [scene for scene, _ in groups]
    where: dict[str, list[str]] = {}
    ratios: dict[str, list[tuple[float, str, str, dict]]] = {}
    for (scene, reference), rows in groups.items():
        place = scene if scenes.count(scene) == 1 else f"{scene} (truth: {reference})"
        analysed = analyse(rows, yardstick)
        best = best_learned(analysed)
        outcome = best["equal_error"]["outcome"] if best else "failed" if analysed else "none"
        where.setdefault(outcome, []).append(place)
        if best and best["equal_error"]["ratio"]:
            ratios.setdefault(outcome, []).append((best["equal_error"]["ratio"], best["contender"], place, best["equal_error_slack"]))
    wins = []
    for ratio, model, place, slack in ratios.get("wins", []):
        left = f" ({number(slack['ratio'])} beside rungs that err up to a tenth more)" if slack["ratio"] < 0.9 * ratio else ""
        wins.append(f"{model} on {place}, {number(ratio)} times faster than the solver{left}")
    if wins:
        sentences = [f"At equal error ({yardstick}) a learned model wins on {len(wins)} of {len(groups)} scenes: {'; '.join(wins)}."]
    else:
        sentences = [f"No learned model wins at equal error ({yardstick}) on any of the {len(groups)} scenes."]
    if "loses" in where:
        ratio, model, place, _ = max(ratios["loses"], key=lambda lost: lost[0])
        lost = f"{len(where['loses'])} the solver is faster" if wins else f"{len(where['loses'])} the best loses to the solver"
        sentences.append(f"On {lost}, by the least on {place}, where {model} takes {number(1 / ratio)} times as long.")
    for outcome, text in (
        ("ties", "the best ties with the solver: the rounds of the timing disagree on who is faster"),
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
    missed = missed_targets(rows, targets, yardstick)
    if missed:
        sentences.append(f"Missed: {'; '.join(missed)}.")
    elif targets:
        sentences.append(f"All {len(targets)} targets of the study are reached." if len(targets) > 1 else "The target of the study is reached.")
    return " ".join(sentences)
