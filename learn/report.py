"""The report: one self-contained HTML page from a summary (``learn.compare``), the figures and the films.

Every figure in it comes from the summary; what is missing is an en dash, with the reason as a footnote where the summary knows one.
Pictures and films are embedded, so that the page can be mailed, archived and read without a network; it holds no script.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import jinja2

from learn.compare import analyse, over_floor, pareto_front
from sim.errors import InputError
from sim.trajectory import atomic_path

#: Kinds of contenders in the order of the tables, as headings of the groups.
KINDS = {
    "reference": "reference", "solver": "solver ladder", "learned": "learned", "trivial": "trivial baselines", "oracle": "oracle",
    "floor": "chaos floor",
}
_MEDIA = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".svg": "image/svg+xml", ".mp4": "video/mp4"}
_DASH = "–"


@dataclass(frozen=True)
class Asset:
    """A picture (.png, .jpg, .svg) or film (.mp4) with its caption; poster: the still that stands for a film until it plays."""

    path: Path
    caption: str
    poster: Path | None = None


@dataclass(frozen=True)
class SceneAssets:
    """What a scene's section shows beside its tables, in this order: films and stills, figures, training curve. All optional."""

    films: Sequence[Asset] = ()
    stills: Sequence[Asset] = ()
    figures: Sequence[Asset] = ()  # error over run time first, then error over time, kinetic energy
    training: Sequence[Asset] = ()


@dataclass(frozen=True)
class _Media:
    """An asset as the template wants it: data URIs."""

    uri: str
    film: bool
    caption: str
    poster: str | None


@dataclass(frozen=True)
class _Cell:
    """text; small: a second line; note: number of a footnote."""

    text: str
    small: str = ""
    note: int | None = None


@dataclass
class _Table:
    """groups: (name, number of columns) over the columns; rows: (heading or None, name, tag, cells); notes: footnotes, numbered from 1."""

    caption: str
    columns: list[str]
    groups: list[tuple[str, int]] = field(default_factory=list)
    rows: list[tuple[str | None, str, str, list[_Cell]]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

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


# Numbers --------------------------------------------------------------------------------------------------------------------


def number(value: float) -> str:
    """Two significant digits, scientific outside 0.01..9999: 1.2e-4, 0.33, 17, 1200."""
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return "∞" if value > 0 else _DASH
    if 0.01 <= abs(value) < 9999.5:
        rounded = float(f"{value:.2g}")
        return f"{rounded:.0f}" if abs(rounded) >= 10 else f"{rounded:.2g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def duration(seconds: float) -> str:
    """A time with its unit: 0.84 ms, 1.2 s, 7.5 min, 3.1 h."""
    for limit, unit, name in ((1e-3, 1e-6, "µs"), (1.0, 1e-3, "ms"), (120.0, 1.0, "s"), (7200.0, 60.0, "min")):
        if seconds < limit:
            return f"{seconds / unit:.3g} {name}"
    return f"{seconds / 3600:.3g} h"


def _share(value: float) -> str:
    return "0" if value == 0 else f"{100 * value:.2g} %"


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
        "Contenders: medians over the test trajectories; in small print the least and the greatest", names[:],
        [("MSE, all particles" if two else "MSE", len(names))],
    )
    if two:
        table.columns += names
        table.groups.append(("MSE, moving particles", len(names)))
    table.columns += ["all / R²", "all / edge²", "Sinkhorn", "EMD, spacings", "spacing ratio", "energy MSE", "escaped, end (worst)", "diverges, s"]
    table.groups += [("MSE in other units", 2), ("clouds at ¼, ½, ¾, end of the run", 3), ("physics", 3)]
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
        energy, escaped, worst = (row.get(key) for key in ("kinetic_energy_mse", "escaped_fraction", "escaped_fraction_worst"))
        failed = _failure(row)
        cells.append(table.missing(failed) if energy is None else _Cell(number(energy)))
        if escaped is None:
            cells.append(table.missing(failed))
        else:
            cells.append(_Cell(_share(escaped) + (f" ({_share(worst)})" if worst is not None and worst > escaped else "")))
        diverges = row.get("divergence_time")
        cells.append(_Cell("never" if diverges is None else number(diverges)) if diverges is not None or not failed else table.missing(failed))
        cells += _time_cells(table, row)
        failures = row.get("failures")
        cells.append(table.missing(None) if failures is None else table.noted(f"{failures} of {row['runs']}" if failures else "0", failed))
        table.rows.append((heading, row["contender"], "Pareto front" if any(row is one for one in front) else "", cells))
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
        per_frame, table.missing(None) if simulated is None else _Cell(duration(simulated)),
        table.missing("timed in the rollouts of the comparison only, not interleaved") if compiling is None else _Cell(duration(compiling)),
    ]


_OUTCOMES = {
    "wins": "wins", "loses": "loses", "ties": "ties", "worse than trivial": "worse than a trivial baseline", "no rung": "no rung as accurate",
    "failed": "failed",
}


def _rollouts(value: float | str | None, table: _Table, reason: str) -> _Cell:
    """A break-even: "never", or three digits of a whole number."""
    if value is None:
        return table.missing(reason)
    return _Cell(value if isinstance(value, str) else f"{math.ceil(float(f'{value:.3g}')):,}")


def _speed_ups(entries: Sequence[dict]) -> _Table:
    """What the learning bought, one row per learned contender."""
    table = _Table(
        f"What the learning bought; error: {entries[0]['yardstick']}",
        [
            "over the reference, accuracy aside", "at equal error", "against", "model's error", "rung's error", "ratio", "against",
            "at equal error", "over the reference",
        ],
        [("speed-up", 3), ("error at equal time", 4), ("break-even, rollouts", 2)],
    )
    for entry in entries:
        equal, rival = entry["equal_error"], entry["equal_time"]
        outcome = _OUTCOMES.get(equal["outcome"], equal["outcome"])
        paper, error = entry["speed_up_paper"], entry["error"]
        unrivalled = "no solver rung is as cheap" if rival["rung"] is None else "the rung's error is zero"
        unrivalled = "some rollouts failed" if error is None else unrivalled
        unpaid = "no such speed-up, or the cost of data and training is unknown"
        cells = [
            table.missing("reference not timed") if paper is None else _Cell(f"{number(paper)}×"),
            _Cell(_DASH, outcome) if equal["ratio"] is None else _Cell(f"{number(equal['ratio'])}×", outcome),
            _Cell(equal["rung"] or _DASH),
            table.missing("some rollouts failed") if error is None else _Cell(number(error)),
            table.missing("no solver rung is as cheap") if rival["rung"] is None else _Cell(number(rival["error"])),
            table.missing(unrivalled) if rival["ratio"] is None else _Cell(f"{number(rival['ratio'])}×"),
            _Cell(rival["rung"] or _DASH),
            _Cell("never") if equal["outcome"] == "loses" else _rollouts(entry["break_even"], table, unpaid),
            _rollouts(entry["break_even_reference"], table, unpaid),
        ]
        worse = entry["worse_than_trivial"]
        table.rows.append((None, entry["contender"], f"worse than {', '.join(worse)}" if worse else "", cells))
    return table


def _floors(rows: Sequence[dict]) -> _Table | None:
    """MSE of the moving particles over the chaos floor, per horizon; None without a floor."""
    if not any(row["kind"] == "floor" for row in rows):
        return None
    horizons = _horizons(rows)
    table = _Table("MSE over the chaos floor, moving particles", _horizon_names(horizons))
    for heading, row in _with_headings([row for row in rows if row["kind"] in ("solver", "learned", "trivial")]):
        over = over_floor(rows, row)
        cells = [_Cell(f"{number(over[at])}×") if over.get(at) is not None else table.missing(None) for at in horizons]
        table.rows.append((heading, row["contender"], "", cells))
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
                cells.append(table.missing(None) if value is None else _Cell(_plain_text(value)))
        table.rows.append((None, row["contender"], "", cells))
    return table


# Page -----------------------------------------------------------------------------------------------------------------------


def _plain_text(value: object) -> str:
    """A JSON value for reading: lists by commas, mappings as "key value"."""
    if value is None:
        return _DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain_text(inner)}" for key, inner in value.items()) or _DASH
    if isinstance(value, list | tuple):
        return ", ".join(_plain_text(inner) for inner in value) or _DASH
    return str(value)


def _uri(path: Path) -> str:
    """The file as a data URI; ``InputError`` where it is missing or of an unknown kind."""
    path = Path(path)
    if path.suffix.lower() not in _MEDIA:
        raise InputError(path, "suffix", path.suffix, f"a report embeds {', '.join(_MEDIA)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, "file", error.strerror, "make the picture first or leave it out") from None
    return f"data:{_MEDIA[path.suffix.lower()]};base64,{base64.b64encode(data).decode()}"


def _embed(assets: Iterable[Asset]) -> list[_Media]:
    return [
        _Media(_uri(asset.path), Path(asset.path).suffix.lower() == ".mp4", asset.caption, _uri(asset.poster) if asset.poster else None)
        for asset in assets
    ]


def _sections(rows: Sequence[dict], analysis: Sequence[dict], assets: Mapping[str, SceneAssets]) -> list[dict]:
    """One section per scene and reference, in the order of the rows; a scene's pictures go with its first section."""
    groups: dict[tuple[str, str | None], list[dict]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row.get("reference")), []).append(row)
    sections, shown = [], set()
    for (scene, reference), members in groups.items():
        media = assets.get(scene, SceneAssets()) if scene not in shown else SceneAssets()
        shown.add(scene)
        entries = [entry for entry in analysis if entry["scene"] == scene and entry.get("reference") == reference]
        first = members[0]
        tables = [_contenders(members), _speed_ups(entries) if entries else None, _floors(members), _costs(members)]
        facts = [
            f"truth: {reference}" if reference else "", f"{first['trajectories']} test trajectories" if first.get("trajectories") else "",
            f"{first['frames']} predicted frames of {duration(first['frame_step'])}" if first.get("frames") and first.get("frame_step") else "",
            f"{first['known_frames']} known frames" if first.get("known_frames") else "",
        ]
        sections.append({
            "scene": scene, "facts": ", ".join(fact for fact in facts if fact),
            "moving": _embed([*media.films, *media.stills]), "figures": _embed(media.figures), "training": _embed(media.training),
            "tables": [table for table in tables if table],
            "settings": [(row["contender"], json.dumps(row.get("settings", {}), sort_keys=True)) for row in _by_kind(members)],
        })
    return sections


def write_report(summary: Mapping, path: str | Path, assets: Mapping[str, SceneAssets] | None = None) -> None:
    """Write the page, complete or not at all.

    summary: as in ``learn.compare`` with "rows", "verdict" (the first paragraph), "hardware", "versions"; optional "title", "analysis" (by
    ``analyse``; made from the rows if absent) and "provenance" (name -> text, list or mapping: commands, seeds, revision, ...).
    assets: scene -> its pictures. ``InputError`` for a summary without rows or verdict, and for pictures that cannot be read.
    """
    rows = summary.get("rows")
    if not rows:
        raise InputError(path, "summary.rows", rows, "a report needs at least one row; run the comparison first")
    if not summary.get("verdict"):
        raise InputError(path, "summary.verdict", summary.get("verdict"), "a report begins with its verdict; make it by learn.compare.verdict")
    analysis = summary["analysis"] if "analysis" in summary else analyse(rows)
    provenance = {name: summary.get(name) or {} for name in ("hardware", "versions")}
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.get_template("report_template.html").render(
        title=summary.get("title", "Learned simulators against their teacher"), verdict=summary["verdict"],
        sections=_sections(rows, analysis, assets or {}), text=_plain_text,
        provenance={name: content for name, content in [*provenance.items(), *(summary.get("provenance") or {}).items()] if content},
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(page.encode())
