"""What the cells of the stress matrix say together: a summary (rows and a verdict in words), one self-contained page with pictures, one of text."""

from __future__ import annotations

import importlib
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from sim.page import data_uri, render
from sim.stability import BOUND, Cell
from sim.trajectory import atomic_path

#: Points of a curve in the summary: more show nothing on a page.
_POINTS = 200
_OUTCOMES = {"bounded": "energy bounded", "grew": "energy grew", "not finite": "failed and said so"}
_COLOURS = {"bounded": "C0", "grew": "C1", "not finite": "C3"}
#: Case -> (key of its map's other axis, that axis' name, the solver's limit, the step that Courant numbers are multiples of).
MAPS = {
    "young_dt": ("young_modulus", "Young's modulus E [Pa]", "0.4 dx / (c + v)", "dx / (c + v)"),
    "speed_dt": ("speed", "speed v [m/s]", "0.4 dx / (c + v)", "dx / (c + v)"),
    "sound_dt": ("sound_speed", "speed of sound c [m/s]", "0.4 d / c", "d / c"),
    "viscosity_dt": ("viscosity", "kinematic viscosity [m2/s]", "h^2 / (25 nu)", "h^2 / nu"),
    "fall_dt": ("speed", "speed v [m/s]", "(v + sqrt(g H)) dt + g dt^2 = 0.4 d", "= d"),
}


def _plain(value):
    """JSON's own numbers; None for what is not finite."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | float | np.number):
        return float(value) if math.isfinite(value) else None
    return value


def row(cell: Cell) -> dict:
    """A cell as it stands in ``summary.json``."""
    curves = {}
    for name, series in cell.curves.items():
        chosen = np.unique(np.linspace(0, len(series.x) - 1, _POINTS).astype(int))
        curves[name] = {"axes": list(series.axes), **{key: [_plain(each) for each in getattr(series, key)[chosen]] for key in ("x", "y")}}
    return {
        "case": cell.case,
        "cell": cell.cell,
        "right": bool(cell.right),
        "expected": cell.expected,
        "observed": cell.observed,
        "numbers": {key: _plain(value) for key, value in cell.numbers.items()},
        "seconds": cell.seconds,
        "curves": curves,
    }


def title(case: str) -> str:
    """First line of a case's docstring."""
    return (importlib.import_module(f"sim.stability.{case}").__doc__ or case).splitlines()[0].rstrip(".")


def onset(rows: Sequence[Mapping]) -> float:
    """The smallest refused step of a map that was not bounded, over its limit."""
    steps = [one["numbers"] for one in rows if one["numbers"].get("refused")]
    return min((one["time_step"] / one["limit"] for one in steps if one["outcome"] != "bounded"), default=math.inf)


def verdict(rows: Sequence[Mapping]) -> str:
    """In words: how many cells react rightly, which do not, and how far the limits of the time step are from what they guard against."""
    wrong = [one for one in rows if not one["right"]]
    cases = len({one["case"] for one in rows})
    count = f"All {len(rows)} cells of {cases} cases" if not wrong else f"{len(rows) - len(wrong)} of {len(rows)} cells of {cases} cases"
    text = f"{count} react as they should."
    if wrong:
        named = [f"{one['case'].replace('_', ' ')}, {one['cell']} ({one['observed']})" for one in wrong]
        text += f" Wrong: {'; '.join(named)}."
    maps = [cells for case in MAPS if (cells := [one for one in rows if one["case"] == case])]
    if maps:
        accepted = sum((accepted_steps(cells) for cells in maps), Counter())
        first = sorted({f"{onset(cells):.2g}" for cells in maps}, key=float)
        text += (
            f" Of {accepted.total()} fixed time steps that were accepted on {len(maps)} map{'s' if len(maps) > 1 else ''}, {accepted['grew']} gained "
            f"energy unnoticed and {accepted['not finite']} failed and said so; of those refused, run all the same, the first to go wrong was "
            f"{' to '.join(dict.fromkeys((first[0], first[-1])))} times the limit."
        )
    return text


def accepted_steps(rows: Sequence[Mapping]) -> Counter[str]:
    """Outcome -> how many fixed steps of a map that were accepted came to it."""
    return Counter(one["numbers"]["outcome"] for one in rows if one["numbers"].get("refused") is False)


def map_figure(rows: Sequence[Mapping], case: str):
    """A map: every fixed step by what became of the energy, filled where it was accepted; the limits; the steps of the adaptive run."""
    from matplotlib.figure import Figure

    key, name, bound, unit = MAPS[case]
    figure = Figure(figsize=(8, 5.2), layout="constrained")
    panel = figure.subplots()
    fixed = [one["numbers"] for one in rows if one["case"] == case and "courant" in one["numbers"]]
    for refused, outcome in ((refused, outcome) for refused in (False, True) for outcome in _COLOURS):
        chosen = [one for one in fixed if one["refused"] == refused and one["outcome"] == outcome]
        if chosen:
            colour = _COLOURS[outcome]
            panel.plot([one[key] for one in chosen], [one["time_step"] for one in chosen], "s", ms=5, color=colour,
                       mfc="none" if refused else colour, label=f"{'refused' if refused else 'accepted'}; {_OUTCOMES[outcome]}")  # fmt: skip
    columns = {one[key]: one for one in fixed}
    x = sorted(columns)
    panel.plot(x, [columns[each]["limit"] for each in x], "k-", lw=1.5, label=f"limit of the solver, {bound}")
    panel.plot(x, [columns[each]["time_step"] / columns[each]["courant"] for each in x], "k--", lw=1.2, label=unit)
    adaptive = [one["numbers"] for one in rows if one["case"] == case and "courant" not in one["numbers"]]
    at = np.array([one[key] for one in adaptive])
    low, high = (np.array([one[name] for one in adaptive], float) for name in ("smallest_dt", "largest_dt"))
    if len(at):
        panel.errorbar(at * 1.13, high, yerr=[high - low, 0 * high], fmt="_", color="C2", ms=8, capsize=3,
                       label="adaptive run: largest to smallest step")  # fmt: skip
    panel.set(xscale="log", yscale="log", xlabel=name, ylabel="time step dt [s]")
    panel.legend(fontsize=8)
    return figure


def curve_figure(rows: Sequence[Mapping]):
    """Energy over time of the cells of one case."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.6), layout="constrained")
    panel = figure.subplots()
    curves = [(name, curve) for one in rows for name, curve in one["curves"].items()]
    for index, (name, curve) in enumerate(curves):
        end = curve["x"][-1] or 1.0
        colour = f"C{index}" if len(curves) <= 10 else colormaps["viridis"](index / (len(curves) - 1))
        panel.plot(np.array(curve["x"]) / end, curve["y"], lw=1.2, color=colour, label=name)
    panel.axhline(BOUND, color="C3", ls=":", lw=1.2, label="bound")
    low, high = panel.get_ylim()
    panel.set(xlabel="time / duration of the run", ylabel="energy at hand / the start's", ylim=(min(0.0, low), max(1.6, high)))
    figure.legend(fontsize=7, loc="outside right upper", ncols=1 if len(curves) <= 18 else 2)
    return figure


def _uri(figure) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="svg")
    return data_uri(data.getvalue(), ".svg")


def _shown(numbers: Mapping) -> str:
    parts = [f"{key.replace('_', ' ')} {value:.4g}" if isinstance(value, float) else f"{key.replace('_', ' ')}: {value}"
             for key, value in numbers.items() if value is not None]  # fmt: skip
    return ", ".join(parts)


def write_report(summary: Mapping, path: str | Path) -> None:
    """Write the page, complete or not at all. summary: "title", "verdict" (the first paragraph), "rows", "hardware", "versions", "provenance"."""
    sections = []
    for case, members in groupby(summary["rows"], key=lambda one: one["case"]):
        rows, pictures = list(members), []
        if case in MAPS:
            accepted = accepted_steps(rows)
            told = (
                f"Each mark is a run at a fixed time step. {accepted.total()} were accepted, of which {accepted['grew']} gained energy unnoticed and "
                f"{accepted['not finite']} failed and said so. What is refused was run all the same: the first to go wrong was {onset(rows):.2g} "
                "times the limit."
            )
            pictures.append((_uri(map_figure(rows, case)), told))
        if any(one["curves"] for one in rows):
            pictures.append((_uri(curve_figure(rows)), "Kinetic, potential and elastic energy, over what there is to release; 1 at the start."))
        wrong = sum(not one["right"] for one in rows)
        # The cells of a map are told by its picture; the table holds those that went wrong and the adaptive runs.
        listed = [one for one in rows if not one["right"] or "courant" not in one["numbers"]] if case in MAPS else rows
        sections.append({"case": case, "title": title(case), "rows": listed, "pictures": pictures, "cells": len(rows), "wrong": wrong,
                         "seconds": sum(one["seconds"] for one in rows)})  # fmt: skip
    page = render(
        Path(__file__).parent / "report_template.html",
        title=summary["title"],
        verdict=summary["verdict"],
        sections=sections,
        shown=_shown,
        provenance={name: summary[name] for name in ("hardware", "versions")} | {"how to repeat": summary["provenance"]},
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(page)


_INTRODUCTION = """# Stability

What the solvers do when they are asked for too much: a matrix of stresses, a cell at a time. A case is a file of `sim/stability/` and says of each of
its cells what reaction is right: the energy stays bounded (at most {bound:g} times what there was to release), or the run is refused before it
begins, or it ends as failed with its reason. Nothing may go wrong unnoticed. Steps adapt by default; a fixed one (`time_step` of a scene) above the
limit is refused with the limit and what sets it, and is never shortened silently.

This page is `results/stability/stability.md` of `make study STUDY=stability`; `report.html` beside it has every cell, the maps and the energies over
time.

"""


def write_page(summary: Mapping, path: str | Path) -> None:
    """Write docs/stability.md: the verdict, a table of the cases, and the cells that are wrong. summary: as of ``write_report``."""
    lines = ["| case | cells | right | seconds |", "|---|---|---|---|"]
    wrong = [one for one in summary["rows"] if not one["right"]]
    for case, members in groupby(summary["rows"], key=lambda one: one["case"]):
        rows = list(members)
        right, seconds = sum(one["right"] for one in rows), sum(one["seconds"] for one in rows)
        lines.append(f"| `{case}`: {title(case)} | {len(rows)} | {right} | {seconds:.1f} |")
    if wrong:
        lines += ["", "## Wrong", "| case | cell | right would be | observed |", "|---|---|---|---|"]
        lines += [f"| `{one['case']}` | {one['cell']} | {one['expected']} | {one['observed']} |" for one in wrong]
    hardware, versions = summary["hardware"], summary["versions"]
    told = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    text = _INTRODUCTION.format(bound=BOUND) + summary["verdict"] + "\n\n" + "\n".join(lines) + f"\n\nOn {hardware['cpu']}, {told}.\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text)
