"""The report: an HTML page from a summary (``learn.compare``) and the figures, and beside it a page for every scene, with its films and tables.

Every figure in it comes from the summary; what is missing is an en dash, with the reason as a footnote where the summary knows one.
Pictures and films are embedded, so that a page can be mailed, archived and read without a network; it holds no script.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from learn.analysis import MOVING_MSE, analyse, best_learned, by_scene, over_floor, pareto_front, scene_verdict
from learn.units import duration, number
from sim.domains import DOMAINS, PARAMETERS, TRAINING_STEPS, reproduced
from sim.errors import InputError
from sim.page import file_uri, render, words
from sim.trajectory import atomic_folder, atomic_path

#: Kinds of contenders in the order of the tables, as headings of the groups.
KINDS = {
    "reference": "reference",
    "solver": "solver ladder",
    "learned": "learned",
    "trivial": "trivial baselines",
    "oracle": "oracle",
    "floor": "chaos floor",
}
_DASH = "–"


@dataclass(frozen=True)
class Asset:
    """A picture (.png, .jpg, .svg) or film (.mp4) with its caption; poster: the still that stands for a film until it plays; wide: many panels
    beside each other, which want the whole width of the page."""

    path: Path
    caption: str
    poster: Path | None = None
    wide: bool = False


@dataclass(frozen=True)
class SceneAssets:
    """What a scene's page shows beside its tables, in this order. All optional."""

    films: Sequence[Asset] = ()  # the still of the first stands in the entry
    stills: Sequence[Asset] = ()
    main: Sequence[Asset] = ()  # in the entry as well: what the comparison is about, error over run time
    figures: Sequence[Asset] = ()  # error over time, kinetic energy
    training: Sequence[Asset] = ()


@dataclass(frozen=True)
class _Media:
    """An asset as the template wants it: data URIs; kind: film, chart (which may scroll on a phone, for its small print) or still."""

    uri: str
    kind: str
    caption: str
    poster: str | None
    wide: bool


@dataclass(frozen=True)
class _Cell:
    """text; small: a second line; note: number of a footnote."""

    text: str
    small: str = ""
    note: int | None = None


@dataclass(frozen=True)
class _Row:
    """name: the cell that heads the row; heading: of the group that begins with it; tag: a second line; link: where the name leads."""

    name: str
    cells: list[_Cell]
    heading: str | None = None
    tag: str = ""
    link: str = ""


@dataclass
class _Table:
    """groups: (name, number of columns) over the columns; notes: footnotes, numbered from 1; head: over the rows' names."""

    caption: str
    columns: list[str]
    groups: list[tuple[str, int]] = field(default_factory=list)
    rows: list[_Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    head: str = "contender"

    def noted(self, text: str, reason: str | None) -> _Cell:
        """The text with a footnote where there is a reason; equal reasons share one."""
        if reason is None:
            return _Cell(text)
        if reason not in self.notes:
            self.notes.append(reason)
        return _Cell(text, note=self.notes.index(reason) + 1)

    def missing(self, reason: str | None) -> _Cell:
        """An en dash."""
        return self.noted(_DASH, reason)


def _share(value: float) -> str:
    return "0" if value == 0 else f"{number(100 * value)} %"


# Tables ---------------------------------------------------------------------------------------------------------------------


def _at(row: Mapping, key: str, at: str | None) -> float | None:
    value = row.get(key)
    return value.get(at) if isinstance(value, Mapping) else value


def _horizons(rows: Iterable[Mapping]) -> list[str]:
    """Horizons that occur, by length, "all" last."""
    found = {at for row in rows for at in row.get("rollout_mse", {})}
    return sorted(found, key=lambda at: (at == "all", int(at) if at.isdigit() else 0))


def _horizon_names(horizons: Sequence[str]) -> list[str]:
    return ["all" if at == "all" else "1 frame" if at == "1" else f"{at} frames" for at in horizons]


def _by_kind(rows: Sequence[dict]) -> list[dict]:
    """Rows in the order of ``KINDS``, otherwise as they come; kinds unknown here go last."""
    order = list(KINDS)
    return sorted(rows, key=lambda row: order.index(row["kind"]) if row["kind"] in order else len(order))


def _with_headings(rows: Sequence[dict]) -> Iterable[tuple[str | None, dict]]:
    """(heading of the group at its first row, else None; row)."""
    for kind, members in groupby(_by_kind(rows), key=lambda row: row["kind"]):
        for index, row in enumerate(members):
            yield (KINDS.get(kind, kind) if index == 0 else None), row


def _failure(row: Mapping) -> str | None:
    """Why figures of a row are missing, if because it failed."""
    return f"{row['contender']}: {row['status']}" if row.get("failures") else None


def _error_cell(table: _Table, row: Mapping, key: str, at: str) -> _Cell:
    """The median; under that of all frames, its range over trajectories and training seeds."""
    value = _at(row, key, at)
    if value is None:
        frames = row.get("frames")
        return table.missing(f"the runs have {frames} frames" if at.isdigit() and frames and frames < int(at) else _failure(row))
    spread = row.get("spread", {})
    low, high = (_at(spread.get(end, {}), key, at) for end in ("min", "max"))
    small = ""
    if at == "all" and row.get("runs", 1) > 1 and low is not None:
        ends = (number(low), "failed" if high is None else number(high))
        small = " to ".join(ends) if ends[0] != ends[1] else ""
    return _Cell(number(value), small)


def _clouds_cell(table: _Table, row: Mapping, key: str) -> _Cell:
    """A cloud metric at the quarters of the run, "0.9 / 1.7 / 2.2 / 1.9"."""
    values = row.get(key)
    if not isinstance(values, Mapping):
        values = {"1": values}
    if all(value is None for value in values.values()):
        return table.missing(_failure(row))
    return _Cell(" / ".join(_DASH if values[at] is None else number(values[at]) for at in sorted(values, key=float)))


def _contenders(rows: Sequence[dict]) -> _Table:
    """One row per contender: errors, clouds, physics, run time."""
    horizons = _horizons(rows)
    # Without static particles both means are the same numbers: shown once.
    two = any(_at(row, "rollout_mse", at) != _at(row, "rollout_mse_moving", at) for row in rows for at in horizons)
    names = ["one step", *_horizon_names(horizons)]
    table = _Table(
        "Contenders: medians over the test trajectories; in small print the least and the greatest",
        names[:],
        [("MSE, all particles" if two else "MSE", len(names))],
    )
    if two:
        table.columns += names
        table.groups.append(("MSE, moving particles", len(names)))
    shares = {"escaped": "outside, end (worst)"}
    if any(row.get("penetrated_fraction") is not None for row in rows):
        shares["penetrated"] = "in obstacles, end (worst)"
    table.columns += ["all / R²", "all / edge²", "Sinkhorn", "EMD, spacings", "spacing ratio", "energy MSE", *shares.values(), "diverges, s"]
    table.groups += [("MSE in other units", 2), ("clouds at ¼, ½, ¾, end of the run", 3), ("physics", 2 + len(shares))]
    table.columns += ["per frame", "per simulated s", "compile", "failures"]
    table.groups += [("run time", 3), ("", 1)]
    front = pareto_front(rows)
    for heading, row in _with_headings(rows):
        cells = []
        for suffix in ("", "_moving")[: 1 + two]:
            one_step = row.get(f"one_step_mse{suffix}")
            cells.append(table.missing(row.get("one_step_note") or _failure(row)) if one_step is None else _Cell(number(one_step)))
            cells += [_error_cell(table, row, f"rollout_mse{suffix}", at) for at in horizons]
        cells += [_error_cell(table, row, f"rollout_mse_per_{unit}2", "all") for unit in ("radius", "edge")]
        cells += [_clouds_cell(table, row, key) for key in ("sinkhorn", "emd", "spacing_ratio")]
        energy, failed = row.get("kinetic_energy_mse"), _failure(row)
        cells.append(table.missing(failed) if energy is None else _Cell(number(energy)))
        for key in shares:
            share, worst = row.get(f"{key}_fraction"), row.get(f"{key}_fraction_worst")
            if share is None:
                cells.append(table.missing(failed))
            else:
                cells.append(_Cell(_share(share) + (f" ({_share(worst)})" if worst is not None and worst > share else "")))
        diverges = row.get("divergence_time")
        cells.append(_Cell("never" if diverges is None else number(diverges)) if diverges is not None or not failed else table.missing(failed))
        cells += _time_cells(table, row)
        failures = row.get("failures")
        cells.append(table.missing(None) if failures is None else table.noted(f"{failures} of {row['runs']}" if failures else "0", failed))
        table.rows.append(_Row(row["contender"], cells, heading, "Pareto front" if any(row is one for one in front) else ""))
    return table


#: Cloud metrics beside those of ``_contenders``: heading, key.
_CLOUDS = {
    "density, mean": "density_error_mean",
    "density, greatest": "density_error_max",
    "centre of mass, spacings": "centre_of_mass_error",
    "front, spacings": "front_error",
    "width": "width_ratio",
    "height": "height_ratio",
    "pile angle, degrees": "pile_angle_error",
}


def _clouds(rows: Sequence[dict]) -> _Table:
    """What a rollout looks like where its particles no longer say anything: density, centre of mass, extents, slope; momentum."""
    table = _Table(
        "Clouds at ¼, ½, ¾ and the end of the run, beside the truth's",
        [*_CLOUDS, "momentum drift"],
        [("error of the", 4), ("over the true", 2), ("error of the", 1), ("worst frame", 1)],
    )
    for heading, row in _with_headings(rows):
        drift = row.get("momentum_drift")
        cells = [_clouds_cell(table, row, key) for key in _CLOUDS.values()]
        table.rows.append(_Row(row["contender"], [*cells, table.missing(_failure(row)) if drift is None else _Cell(number(drift))], heading))
    return table


def _time_cells(table: _Table, row: Mapping) -> list[_Cell]:
    """Seconds per frame with its range, per simulated second, compile time."""
    seconds, compiling = row.get("seconds_per_frame"), row.get("compile_seconds")
    if seconds is None:
        per_frame = table.missing(_failure(row))
    else:
        low, high = (row.get("timing_spread") or {}).get("seconds_per_frame", (None, None))
        per_frame = _Cell(duration(seconds), f"{duration(low)} to {duration(high)}" if low is not None else "")
    simulated = row.get("seconds_per_simulated_second")
    return [
        per_frame,
        table.missing(None) if simulated is None else _Cell(duration(simulated)),
        table.missing("timed in the rollouts of the comparison only, not interleaved") if compiling is None else _Cell(duration(compiling)),
    ]


_OUTCOMES = {
    "wins": "wins",
    "loses": "loses",
    "ties": "ties",
    "worse than trivial": "worse than a trivial baseline",
    "no rung": "no rung as accurate",
    "failed": "failed",
}


def _rollouts(value: float | str | None, table: _Table, reason: str) -> _Cell:
    """A break-even: "never", or three digits of a whole number."""
    if value is None:
        return table.missing(reason)
    return _Cell(value if isinstance(value, str) else f"{math.ceil(float(f'{value:.3g}')):,}")


def _ratio(equal: Mapping) -> _Cell:
    """A speed-up at equal error over its outcome."""
    return _Cell(_DASH if equal["ratio"] is None else f"{number(equal['ratio'])}×", _OUTCOMES.get(equal["outcome"], equal["outcome"]))


def _spread(seeds: Sequence[Mapping], table: _Table) -> _Cell:
    """The smallest and the largest speed-up of several trainings over their outcomes."""
    ratios = sorted(equal["ratio"] for equal in seeds if equal["ratio"] is not None)
    if not ratios:
        return table.missing("one training, or no rung as accurate")
    ordered = sorted(seeds, key=lambda equal: equal["ratio"] or math.inf)
    outcomes = dict.fromkeys(_OUTCOMES.get(equal["outcome"], equal["outcome"]) for equal in ordered)
    return _Cell(f"{number(ratios[0])} to {number(ratios[-1])}×", ", ".join(outcomes))


def _speed_ups(entries: Sequence[dict]) -> _Table:
    """What the learning bought, one row per learned contender."""
    repeated = any(entry["equal_error_seeds"] for entry in entries)
    table = _Table(
        f"What the learning bought; error: {entries[0]['yardstick']}",
        [
            "over the reference, accuracy aside",
            "at equal error",
            "against",
            "in the mean",
            "a tenth more error",
            *["each training"] * repeated,
            "model's error",
            "rung's error",
            "ratio",
            "against",
            "at equal error",
            "over the reference",
        ],
        [("speed-up", 5 + repeated), ("error at equal time", 4), ("break-even, rollouts", 2)],
    )
    for entry in entries:
        equal, mean, rival = entry["equal_error"], entry["equal_error_mean"], entry["equal_time"]
        paper, error = entry["speed_up_paper"], entry["error"]
        unrivalled = "no solver rung is as cheap" if rival["rung"] is None else "the rung's error is zero"
        unrivalled = "some rollouts failed" if error is None else unrivalled
        unpaid = "a tie, no such speed-up, or the cost of data and training is unknown"
        cells = [
            table.missing("reference not timed") if paper is None else _Cell(f"{number(paper)}×"),
            _ratio(equal),
            _Cell(equal["rung"] or _DASH),
            _ratio(mean),
            _ratio(entry["equal_error_slack"]),
            *[_spread(entry["equal_error_seeds"], table)] * repeated,
            table.missing("some rollouts failed") if error is None else _Cell(number(error)),
            table.missing("no solver rung is as cheap") if rival["rung"] is None else _Cell(number(rival["error"])),
            table.missing(unrivalled) if rival["ratio"] is None else _Cell(f"{number(rival['ratio'])}×"),
            _Cell(rival["rung"] or _DASH),
            _Cell("never") if equal["outcome"] == "loses" else _rollouts(entry["break_even"], table, unpaid),
            _rollouts(entry["break_even_reference"], table, unpaid),
        ]
        worse = entry["worse_than_trivial"]
        table.rows.append(_Row(entry["contender"], cells, tag=f"worse than {', '.join(worse)}" if worse else ""))
    return table


def _floors(rows: Sequence[dict]) -> _Table | None:
    """MSE of the moving particles over the chaos floor, per horizon; None without a floor."""
    if not any(row["kind"] == "floor" for row in rows):
        return None
    horizons = _horizons(rows)
    table = _Table("MSE over the chaos floor, moving particles", _horizon_names(horizons))
    for heading, row in _with_headings([row for row in rows if row["kind"] in ("solver", "learned", "trivial")]):
        over = over_floor(rows, row)
        cells = [table.missing(None) if (ratio := over.get(at)) is None else _Cell(f"{number(ratio)}×") for at in horizons]
        table.rows.append(_Row(row["contender"], cells, heading))
    return table


def _costs(rows: Sequence[dict]) -> _Table | None:
    """What data and training of the learned contenders took; None where no row says."""
    known = [row for row in rows if row.get("cost")]
    if not known:
        return None
    extra = [key for row in known for key in row["cost"] if key not in ("generation_seconds", "training_seconds")]
    keys = ["generation_seconds", "training_seconds", *dict.fromkeys(extra)]
    table = _Table("Cost of data and training", ["data generation", "training", *(key.replace("_", " ") for key in keys[2:])])
    for row in known:
        cells = []
        for key in keys:
            value = row["cost"].get(key)
            if isinstance(value, int | float) and key.endswith("seconds"):
                cells.append(_Cell(duration(value)))
            else:
                cells.append(table.missing(None) if value is None else _Cell(words(value)))
        table.rows.append(_Row(row["contender"], cells))
    return table


# Over the scenes ------------------------------------------------------------------------------------------------------------


def _glance(scenes: Sequence[dict], folder: str) -> _Table:
    """One row a scene: its best learned model beside the best trivial baseline and the solver."""
    columns = ["best learned", "its error", "best trivial", "per frame", "at equal error", "against", "in the mean", "over the reference",
               "break-even, rollouts"]  # fmt: skip
    table = _Table(f"At a glance; error: {MOVING_MSE}", columns, [("accuracy", 3), ("run time", 1), ("speed-up", 4), ("", 1)], head="scene")
    for scene in scenes:
        rows, entries, link = scene["rows"], scene["analysis"], f"{folder}/{scene['slug']}.html"
        tag = f"truth: {rows[0]['reference']}"
        best = best_learned(entries)
        if best is None:
            reason = "none finished every rollout" if entries else "no learned model was compared"
            table.rows.append(_Row(scene["name"], [table.missing(reason), *[_Cell(_DASH)] * (len(columns) - 1)], tag=tag, link=link))
            continue
        trivial = [error for row in rows if row["kind"] == "trivial" and (error := MOVING_MSE.of(row)) is not None]
        speed = next(row.cells for row in _speed_ups([best]).rows)
        cells = [
            _Cell(best["contender"]),
            _Cell(number(best["error"])),
            _Cell(number(min(trivial))) if trivial else table.missing("none compared"),
            _Cell(duration(best["seconds_per_frame"])),
            speed[1],
            speed[2],
            speed[3],
            table.missing("reference not timed") if best["speed_up_paper"] is None else speed[0],
            table.missing("a tie, nothing is saved, or what data and training cost is unknown") if speed[-2].text == _DASH else speed[-2],
        ]
        table.rows.append(_Row(scene["name"], cells, tag=tag, link=link))
    return table


def _published(scenes: Sequence[dict]) -> _Table | None:
    """Learned models on scenes that reproduce a domain of the paper, beside its Table 1; None where there are none."""
    columns = ["one step", "all frames", "ours / paper", "model", "parameters", "trajectories", "steps", "took", "particles", "frames"]
    table = _Table(
        "Beside Table 1 of Sanchez-Gonzalez et al. (2020), whose figures are in small print",
        columns,
        [("MSE, all particles", 3), ("network", 2), ("training", 3), ("test", 2)],
    )
    for scene in scenes:
        rows, name = scene["rows"], reproduced(scene["rows"][0]["scene"])
        if name is None:
            continue
        domain, variant = DOMAINS[name], scene["name"].removeprefix(name).lstrip("-, ")
        heading: str | None = name.upper().replace("_", "-") + (f", {variant}" if variant else "")
        parameters = PARAMETERS[domain.dim]
        for row in (row for row in rows if row["kind"] == "learned"):
            cost, failed = row.get("cost") or {}, _failure(row)
            one_step, rollout = row["one_step_mse"], row["rollout_mse"]["all"]
            particles = [run["particles"] for run in row["spread"]["per_trajectory"] if "particles" in run]

            def beside(value: float | None, paper: float, text: str | None = None, table: _Table = table) -> _Cell:
                shown = _DASH if value is None else text or f"{round(value):,}"
                return _Cell(shown, f"{paper:,}")

            cells = [
                _Cell(number(one_step), number(domain.one_step_mse)) if one_step is not None else table.missing(failed),
                _Cell(number(rollout), number(domain.rollout_mse)) if rollout is not None else table.missing(failed),
                _Cell(f"{number(rollout / domain.rollout_mse)}×") if rollout is not None else table.missing(failed),
                _Cell(words(row.get("settings", {}).get("model")).replace("_", " "), "gns"),
                beside(cost.get("parameters"), parameters),
                beside(cost.get("trajectories"), domain.trajectories),
                beside(cost.get("steps"), TRAINING_STEPS),
                _Cell(duration(cost["training_seconds"]), words(cost.get("device"))) if cost else table.missing("not said beside the checkpoint"),
                beside(sum(particles) / len(particles) if particles else None, domain.particles),
                beside(row["frames"], domain.steps),
            ]
            table.rows.append(_Row(row["contender"], cells, heading))
            heading = None
    return table if table.rows else None


def _all_costs(rows: Sequence[dict]) -> _Table | None:
    """``_costs`` of every learned model once, on however many scenes it was compared."""
    seen: dict[str, dict] = {}
    for row in rows:
        if row.get("cost"):
            seen.setdefault(json.dumps([row["contender"], row["cost"]], sort_keys=True), row)
    return _costs(list(seen.values()))


def _jobs(jobs: Sequence[Mapping]) -> _Table:
    """What making the results took, a row a step of the workflow."""
    columns = ["jobs", "time, all", "longest", "memory, most"]
    table = _Table("The workflow's steps, as they last ran; several at a time where there are cores", columns, head="step")
    for job in jobs:
        memory = table.missing("too short to be looked at") if job["memory_mb"] is None else _Cell(f"{number(job['memory_mb'])} MB")
        cells = [_Cell(str(job["jobs"])), _Cell(duration(job["seconds"])), _Cell(duration(job["longest_seconds"])), memory]
        table.rows.append(_Row(job["rule"].replace("_", " "), cells))
    everything = sum(job["seconds"] for job in jobs)
    table.rows.append(_Row("all", [_Cell(str(sum(job["jobs"] for job in jobs))), _Cell(duration(everything)), _Cell(""), _Cell("")]))
    return table


# Pages ----------------------------------------------------------------------------------------------------------------------


def _embed(assets: Iterable[Asset]) -> list[_Media]:
    result = []
    for asset in assets:
        kind = {".mp4": "film", ".svg": "chart"}.get(Path(asset.path).suffix.lower(), "still")
        result.append(_Media(file_uri(asset.path), kind, asset.caption, file_uri(asset.poster) if asset.poster else None, asset.wide))
    return result


def _scenes(rows: Sequence[dict], analysis: Sequence[dict]) -> list[dict]:
    """The pages' names, rows and analyses, one per scene and reference, in the order of the rows."""
    groups, entries = by_scene(rows), by_scene(analysis)
    scenes = [scene for scene, _ in groups]
    result = []
    for (scene, reference), members in groups.items():
        alone = scenes.count(scene) == 1
        result.append(
            {
                "name": scene if alone else f"{scene}, truth: {reference}",
                "slug": scene if alone else f"{scene}-{reference}".replace(" ", "-"),
                "rows": members,
                "analysis": entries.get((scene, reference), []),
            }
        )
    return result


def _page(scene: Mapping, media: SceneAssets) -> dict:
    """All that the templates show of a scene."""
    rows, entries = scene["rows"], scene["analysis"]
    first = rows[0]
    # A rollout that failed has fewer frames than were asked for.
    whole = max((row["frames"] for row in rows if row.get("frames")), default=0)
    timed = {frames for row in rows if (frames := (row.get("timing_spread") or {}).get("frames", whole)) < whole}
    facts = [
        f"truth: {first['reference']}",
        f"{first['trajectories']} test trajectories" if first.get("trajectories") else "",
        f"{first['frames']} predicted frames of {duration(first['frame_step'])}" if first.get("frames") and first.get("frame_step") else "",
        f"{first['known_frames']} known frames" if first.get("known_frames") else "",
        f"run times of the first {max(timed)}" if timed else "",
    ]
    tables = [_contenders(rows), _speed_ups(entries) if entries else None, _clouds(rows), _floors(rows), _costs(rows)]
    main, films = _embed(media.main), _embed(media.films)
    still = [_Media(film.poster, "still", f"{film.caption} Half way.", None, False) for film in films[:1] if film.poster]
    holds = ["films" if films else "", "curves over time" if media.figures else "", "trainings" if media.training else "", "settings"]
    return {
        "name": scene["name"],
        "slug": scene["slug"],
        "facts": ", ".join(fact for fact in facts if fact),
        "verdict": scene_verdict(rows),
        "main": [*still, *main],
        "moving": [*films, *_embed(media.stills)],
        "figures": [*main, *_embed(media.figures)],
        "training": _embed(media.training),
        "tables": [table for table in tables if table],
        "holds": ", ".join(part for part in holds if part),
        "settings": [(row["contender"], json.dumps(row.get("settings", {}), sort_keys=True)) for row in _by_kind(rows)],
    }


def write_report(summary: Mapping, path: str | Path, assets: Mapping[str, SceneAssets] | None = None, overview: Sequence[Asset] = ()) -> None:
    """Write the entry to ``path`` (NAME.html), last, and a page for every scene and reference to the folder NAME beside it, which is replaced.

    summary: as in ``learn.compare`` with "rows", "verdict" (the first paragraph), "hardware", "versions"; optional "title", "analysis" (by
    ``analyse``; made from the rows if absent), "jobs" (what the workflow's steps took: rule, jobs, seconds, longest_seconds, memory_mb) and
    "provenance" (name -> text, list or mapping: commands, seeds, revision, ...). assets: scene -> its pictures, which go with its first page;
    overview: pictures of all scenes together, for the entry. ``InputError``, and nothing written, for a summary without rows or verdict and for
    pictures that cannot be read; ``OSError``.
    """
    path, rows = Path(path), summary.get("rows")
    if not rows:
        raise InputError(path, "summary.rows", rows, "a report needs at least one row; run the comparison first")
    if not summary.get("verdict"):
        raise InputError(path, "summary.verdict", summary.get("verdict"), "a report begins with its verdict; make it by learn.analysis.verdict")
    title, folder = summary.get("title", "Learned simulators against their teacher"), path.with_suffix("")
    scenes = _scenes(rows, summary["analysis"] if "analysis" in summary else analyse(rows))
    left = dict(assets or {})
    pages = [_page(scene, left.pop(scene["rows"][0]["scene"], SceneAssets())) for scene in scenes]
    hardware = summary.get("hardware") or {}
    elsewhere = sorted({device for row in rows if (device := row.get("settings", {}).get("rolled out on"))})
    provenance = {name: summary.get(name) or {} for name in ("hardware", "versions")} | (summary.get("provenance") or {})
    here = Path(__file__).parent
    entry = render(
        here / "report_template.html",
        title=title,
        verdict=summary["verdict"],
        folder=folder.name,
        pages=pages,
        overview=_embed(overview),
        glance=_glance(scenes, folder.name),
        published=_published(scenes),
        costs=_all_costs(rows),
        jobs=_jobs(summary["jobs"]) if summary.get("jobs") else None,
        provenance={name: content for name, content in provenance.items() if content},
    )
    machine = f"one thread of {words(hardware['cpu'])}" if hardware.get("cpu") else "an unknown machine"
    with atomic_folder(folder) as temporary:
        for page in pages:
            text = render(
                here / "scene_template.html",
                title=f"{page['name']}: {title}",
                study=title,
                entry=path.name,
                page=page,
                pages=pages,
                machine=machine,
                elsewhere=", ".join(elsewhere),
                provenance={},
            )
            (temporary / f"{page['slug']}.html").write_bytes(text)
        if folder.is_dir():
            shutil.rmtree(folder)
    with atomic_path(path) as temporary:
        temporary.write_bytes(entry)
