"""Figures of a comparison and of a training, from rows and CSV files alone. The suffix of the path (.svg, .png) chooses the format.

One colour a kind in every figure, from Okabe & Ito's (2008) palette, which stays apart under the common colour-vision deficiencies; contenders
of one kind differ in shade and dash.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402 - the backend must be chosen first
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.colors import to_rgb  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from learn.analysis import MOVING_MSE, Yardstick, pareto_front  # noqa: E402
from learn.compare import PARTICLES, SCENE  # noqa: E402
from learn.generalisation import Trial, groups, trials  # noqa: E402
from sim.errors import InputError  # noqa: E402
from sim.trajectory import atomic_path  # noqa: E402

COLOURS = {"reference": "#000000", "solver": "#0072B2", "learned": "#D55E00", "trivial": "#7A7A7A", "oracle": "#009E73", "floor": "#CC79A7"}
MARKERS = {"reference": "*", "solver": "o", "learned": "s", "trivial": "X", "oracle": "D", "floor": "_"}
KIND_NAMES = {
    "reference": "reference",
    "solver": "solver ladder",
    "learned": "learned",
    "trivial": "trivial",
    "oracle": "oracle",
    "floor": "chaos floor",
}
_DASHES = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (4, 1.2, 1, 1.2)))
_STYLE = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "savefig.dpi": 150,
    "svg.hashsalt": "sluice",
    "legend.frameon": False,
    "legend.fontsize": 9,
}


def _save(figure: Figure, path: str | Path) -> None:
    """Write atomically, without the date, so that equal rows give equal files."""
    suffix = Path(path).suffix.lstrip(".")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=suffix, metadata={"Date": None} if suffix == "svg" else None)
    plt.close(figure)


def _one_scene(rows: Sequence[dict]) -> str:
    """The scene that all rows are about; ``ValueError`` for none or several, whose errors share no axis."""
    scenes = sorted({row["scene"] for row in rows})
    if len(scenes) != 1:
        raise ValueError(f"rows = {scenes}: a figure shows one scene")
    return scenes[0]


def _shades(rows: Sequence[dict]) -> list[tuple[tuple[float, ...], object]]:
    """(colour, dash) of every row: the colour of its kind, lightened and dashed along the contenders of that kind."""
    result: list[tuple[tuple[float, ...], object]] = []
    for row in rows:
        kin = [other["contender"] for other in rows if other["kind"] == row["kind"]]
        rank = kin.index(row["contender"])
        light = 0.55 * rank / max(len(kin) - 1, 1)
        colour = tuple(light + (1 - light) * channel for channel in to_rgb(COLOURS[row["kind"]]))
        result.append((colour, _DASHES[rank % len(_DASHES)]))
    return result


#: Where a label may stand: (distance [points], direction) around its point, best first.
_ANGLES = (0, 180, 35, -35, 145, -145, 90, -90, 65, -65, 115, -115)
_PLACES = [(radius, math.radians(angle)) for radius in (9, 14, 20, 28, 38, 50, 64, 80) for angle in _ANGLES]


def _place_labels(
    axes: Axes, points: Sequence[tuple[float, float]], labels: Sequence[str | None], colours: Sequence, lines: Sequence[np.ndarray]
) -> None:
    """Write each label at the nearest free place around its point: off the other labels, all points and lines ([n, 2]), inside the axes.

    None is no label, but its point is kept free.
    """
    figure = axes.figure
    figure.canvas.draw()
    renderer, frame, size = figure.canvas.get_renderer(), axes.get_window_extent(), figure.dpi / 72
    pixels = axes.transData.transform(points)
    strokes = [pixels[:0]]
    for line in lines:
        for one, other in pairwise(axes.transData.transform(line)):
            strokes.append(np.linspace(one, other, max(int(math.dist(one, other) / (4 * size)), 1) + 1))
    stroke = np.concatenate(strokes)
    # Taken boxes, [n, 4]: left, low, right, high.
    taken = np.concatenate([np.hstack([pixels - 7 * size, pixels + 7 * size]), np.hstack([stroke - size, stroke + size])])
    directions = np.array([(math.cos(angle), math.sin(angle)) for _, angle in _PLACES])
    radii = np.array([radius for radius, _ in _PLACES])
    distances = np.linalg.norm(pixels[:, None] - pixels, axis=2)
    crowd = np.exp(-distances / (40 * size)).sum(axis=1)
    for index in np.argsort(-crowd, kind="stable"):  # the crowded points choose first
        label = labels[index]
        if label is None:
            continue
        text = axes.annotate(label, points[index], textcoords="offset points", xytext=(0, 0), fontsize=8.5, color=colours[index])
        extent = text.get_window_extent(renderer)
        anchor = np.where(directions[:, 0] > 0.2, 0.0, np.where(directions[:, 0] < -0.2, 1.0, 0.5))
        low = pixels[index] + radii[:, None] * size * directions - np.stack([anchor * extent.width, np.full(len(radii), extent.height / 2)], 1)
        boxes = np.hstack([low, low + [extent.width, extent.height]])
        sides = np.minimum(boxes[:, None, 2:], taken[:, 2:]) - np.maximum(boxes[:, None, :2], taken[:, :2])
        clash = np.clip(sides, 0, None).prod(axis=2).sum(axis=1)
        outside = (low < [frame.x0, frame.y0]).any(axis=1) | (boxes[:, 2:] > [frame.x1, frame.y1]).any(axis=1)
        best = int(np.argmin(clash + 1e6 * outside))
        taken = np.vstack([taken, boxes[best]])
        text.set_position(tuple((low[best] - pixels[index]) / size))
        if radii[best] > 20:
            leader = {"arrowstyle": "-", "color": "#9A9A9A", "lw": 0.6, "shrinkA": 0, "shrinkB": 4}
            edge = np.clip(pixels[index], boxes[best, :2], boxes[best, 2:])
            axes.annotate("", points[index], textcoords="offset points", xytext=tuple((edge - pixels[index]) / size), arrowprops=leader)


#: Rungs that are all named in a figure: the names of more would cover the points, so of more those on the front are.
MOST_NAMED = 16


def error_over_run_time(rows: Sequence[dict], path: str | Path, yardstick: Yardstick = MOVING_MSE) -> None:
    """Error over seconds per frame, log-log, one point a contender, whiskers from least to most over trajectories and timings.

    Of more than ``MOST_NAMED`` rungs of a solver those on the front are named.

    The front of solver and learned contenders is a line, the chaos floor a band in which errors mean nothing. An error of zero (the
    reference) has no place on a log axis: it sits at the lower edge. Contenders without error or time are listed under the axes.
    """
    scene = _one_scene(rows)
    shown = [row for row in rows if row["kind"] not in ("floor", "oracle")]
    drawn = [row for row in shown if yardstick.of(row) is not None and row["seconds_per_frame"]]
    left_out = [f"{row['contender']} ({row['status']})" for row in shown if not any(row is other for other in drawn)]
    floors = [yardstick.known(row) for row in rows if row["kind"] == "floor" and yardstick.of(row)]
    positive = [yardstick.known(row) for row in drawn if yardstick.known(row) > 0]
    low = 10 ** (math.floor(math.log10(min(positive))) - 1) if positive else 1e-9
    ground = 2 * low  # where an error of zero is drawn
    lines = []
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(figsize=(8.5, 5.6), layout="constrained")
        axes.set(xscale="log", yscale="log", xlabel="run time, seconds per frame", ylabel=str(yardstick), title=f"{scene}: error over run time")
        points = [(row["seconds_per_frame"], max(yardstick.known(row), ground)) for row in drawn]
        for row, (x, y) in zip(drawn, points, strict=True):
            colour = COLOURS[row["kind"]]
            worst, least = yardstick.of(row["spread"]["max"]), yardstick.of(row["spread"]["min"])
            if y > ground and worst is not None and least:
                lines.append(np.array([(x, max(least, low)), (x, worst)]))
                axes.plot(*lines[-1].T, color=colour, lw=1, alpha=0.45, zorder=2)
            if row.get("timing_spread"):
                lines.append(np.array([(seconds, y) for seconds in row["timing_spread"]["seconds_per_frame"]]))
                axes.plot(*lines[-1].T, color=colour, lw=1, alpha=0.45, zorder=2)
            hollow = {"markerfacecolor": "white"} if row["failures"] else {}
            axes.plot(x, y, MARKERS[row["kind"]], color=colour, markersize=13 if row["kind"] == "reference" else 8, zorder=4, clip_on=False, **hollow)
        on_front = pareto_front(list(rows), yardstick)
        front = [(row["seconds_per_frame"], max(yardstick.known(row), ground)) for row in on_front]
        if len(front) > 1:
            lines.append(np.array(front))
            axes.plot(*lines[-1].T, color="#444444", lw=1.2, ls=(0, (4, 2)), zorder=1)
        band = bool(floors) and floors[0] > low
        if band:
            axes.axhspan(low, floors[0], color=COLOURS["floor"], alpha=0.18, lw=0, zorder=0)
        if points:
            times, errors = np.array(points).T
            axes.set_xlim(times.min() / 3, times.max() * 3)
            axes.set_ylim(low, max(errors.max(), *floors) * 4 if floors else errors.max() * 4)
        kinds = [kind for kind in COLOURS if any(row["kind"] == kind for row in drawn)]
        handles = [
            plt.Line2D([], [], color=COLOURS[kind], marker=MARKERS[kind], ls="", markersize=11 if kind == "reference" else 7, label=KIND_NAMES[kind])
            for kind in kinds
        ]
        if any(row["failures"] for row in drawn):
            handles.append(plt.Line2D([], [], color="#444444", marker="o", markerfacecolor="white", ls="", label="some rollouts failed"))
        if len(front) > 1:
            handles.append(plt.Line2D([], [], color="#444444", lw=1.2, ls=(0, (4, 2)), label="Pareto front"))
        if band:
            handles.append(plt.Rectangle((0, 0), 1, 1, color=COLOURS["floor"], alpha=0.3, lw=0, label=KIND_NAMES["floor"]))
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles) if len(handles) < 6 else math.ceil(len(handles) / 2))
        notes = []
        if any(yardstick.of(row) == 0 for row in drawn):
            notes.append("At the lower edge: error exactly zero.")
        if floors and not band:
            notes.append(f"Chaos floor below the axis: {floors[0]:.1e}.")
        if left_out:
            notes.append("Not drawn: " + "; ".join(left_out) + ".")
        rungs = sum(row["kind"] == "solver" for row in drawn)
        named = {row["contender"] for row in (drawn if rungs <= MOST_NAMED else on_front)}
        if rungs > MOST_NAMED:
            notes.append(f"Of {rungs} settings of the solver those on the front are named; the tables have all.")
        if notes:
            figure.supxlabel("\n".join(notes), fontsize=8.5, color="#555555", wrap=True)
        labels = [row["contender"] if row["kind"] != "solver" or row["contender"] in named else None for row in drawn]
        _place_labels(axes, points, labels, [COLOURS[row["kind"]] for row in drawn], lines)
        _save(figure, path)


def _curve(row: dict, name: str, part: str) -> np.ndarray:
    """[frames] of a row's curve with NaN for null."""
    return np.array([math.nan if value is None else value for value in row["curves"][name][part]], float)


#: Contenders of one kind that a figure over time shows: of more, shades and dashes are not told apart.
_MOST_CURVES = 8


def _distinct(rows: Sequence[dict]) -> tuple[list[dict], str]:
    """Rows whose curves one figure can show, of each kind the ``_MOST_CURVES`` of least error over all frames, and what to say of the others."""
    error = {row["contender"]: value if (value := MOVING_MSE.of(row)) is not None else math.inf for row in rows}
    shown, notes = [], []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        kin = [row["contender"] for row in rows if row["kind"] == kind]
        shown += sorted(kin, key=error.__getitem__)[:_MOST_CURVES]
        if len(kin) > _MOST_CURVES:
            notes.append(f"{KIND_NAMES[kind]}: the {_MOST_CURVES} of {len(kin)} with the least error over all frames")
    return [row for row in rows if row["contender"] in shown], "; ".join(notes)


def _legend(figure: Figure, note: str) -> None:
    """Of the curves in the figure: on its right, or below, in columns, where that would take the axes' room."""
    names = figure.axes[0].get_legend_handles_labels()[1]
    longest = max(len(name) for name in names)
    if note:
        figure.axes[0].set_xlabel(f"{figure.axes[0].get_xlabel()}\n({note})")
    if len(names) <= 16 and longest <= 40:
        figure.legend(loc="outside right center")
    else:
        columns = 3 if longest <= 44 else 2
        width, height = figure.get_size_inches()
        figure.set_size_inches(width, height + 0.19 * math.ceil(len(names) / columns))
        figure.legend(loc="outside lower center", ncols=columns)


def _time_axes(scene: str, label: str, title: str) -> tuple[Figure, Axes]:
    figure, axes = plt.subplots(figsize=(9.5, 5.2), layout="constrained")
    axes.set(xlabel="time after the known frames, s", ylabel=label, title=f"{scene}: {title}")
    return figure, axes


def error_over_time(rows: Sequence[dict], path: str | Path) -> None:
    """Mean squared distance per axis of the moving particles in each frame, log scale: median and min-max band over trajectories.

    The chaos floor, the error of the solver against itself, is a line of its own; contenders without any error (reference, oracle) are left out.
    """
    scene = _one_scene(rows)
    with plt.rc_context(_STYLE):
        figure, axes = _time_axes(scene, "MSE of moving particles in the frame, length²", "error over time (median; band: least to most)")
        axes.set_yscale("log")
        shown, note = _distinct(rows)
        for row, (colour, dash) in zip(shown, _shades(shown), strict=True):
            time = np.array(row["curves"]["frame"]) * row["frame_step"]
            median, least, most = (_curve(row, "mse", part) for part in ("median", "min", "max"))
            if not (median > 0).any():
                continue
            # A log axis has no zero: frames without error are gaps.
            median, least = np.where(median > 0, median, np.nan), np.where(least > 0, least, np.nan)
            if row["kind"] in ("learned", "floor"):
                axes.fill_between(time, least, most, color=colour, alpha=0.15, lw=0)
            axes.plot(time, median, color=colour, ls=dash, lw=2 if row["kind"] in ("learned", "floor") else 1.3, label=row["contender"])
        _legend(figure, note)
        _save(figure, path)


def kinetic_energy(rows: Sequence[dict], path: str | Path) -> None:
    """Kinetic energy per unit mass over time, median over trajectories: the truth in black under the contenders; floor and oracle left out."""
    scene = _one_scene(rows)
    shown, note = _distinct([row for row in rows if row["kind"] not in ("floor", "oracle", "reference")])
    with plt.rc_context(_STYLE):
        figure, axes = _time_axes(scene, "kinetic energy per unit mass, length²/s²", "kinetic energy (median)")
        time = np.array(rows[0]["curves"]["frame"]) * rows[0]["frame_step"]
        truth = _curve(rows[0], "kinetic_energy_true", "median")
        axes.plot(time, truth, color=COLOURS["reference"], lw=2.6, label=f"truth ({rows[0]['reference']})")
        for row, (colour, dash) in zip(shown, _shades(shown), strict=True):
            width = 2 if row["kind"] == "learned" else 1.3
            axes.plot(time, _curve(row, "kinetic_energy", "median"), color=colour, ls=dash, lw=width, label=row["contender"])
        # A contender that falls for ever is not worth the scale: the truth keeps most of the height.
        axes.set_ylim(0, 1.5 * float(np.nanmax(truth)) if np.nanmax(truth) > 0 else None)
        _legend(figure, note)
        _save(figure, path)


#: Outcome at equal error -> marker, kind whose colour it has. An outcome without a ratio is words.
_OUTCOMES = {"wins": ("s", "learned"), "ties": ("D", "learned"), "loses": ("v", "learned"), "worse than trivial": ("X", "trivial")}


def speed_ups(analysis: Sequence[dict], path: str | Path) -> None:
    """Every learned contender of all scenes, a line each: its speed-up at equal error, filled, and over the reference, accuracy aside, hollow.

    analysis: by ``learn.analysis.analyse``, of rows whose run times are interleaved. Right of 1 the model is the faster one.
    """
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(figsize=(8.5, 1.4 + 0.27 * len(analysis)), layout="constrained")
        axes.set(xscale="log", xlabel="time of the solver over time of the model (right of 1: the model is faster)", ylim=(len(analysis) - 0.4, -0.6))
        axes.axvline(1, color=COLOURS["reference"], lw=1.2)
        axes.grid(False, axis="y")
        outcomes = [entry["equal_error"]["outcome"] for entry in analysis]
        for place, (entry, outcome) in enumerate(zip(analysis, outcomes, strict=True)):
            ratio, paper = entry["equal_error"]["ratio"], entry["speed_up_paper"]
            if place and entry["scene"] != analysis[place - 1]["scene"]:
                axes.axhline(place - 0.5, color="#D0D0D0", lw=0.8)
            if ratio and paper:
                axes.plot([ratio, paper], [place] * 2, color="#BBBBBB", lw=1, zorder=1)
            if paper:
                axes.plot(paper, place, "o", color=COLOURS["reference"], markerfacecolor="white", markersize=6)
            if ratio:
                marker, kind = _OUTCOMES[outcome]
                axes.plot(ratio, place, marker, color=COLOURS[kind], markersize=7, zorder=3)
            else:
                axes.text(0.01, place, outcome, transform=axes.get_yaxis_transform(), va="center", fontsize=8.5, color="#555555")
        axes.set_yticks(range(len(analysis)), [f"{entry['scene']}: {entry['contender']}" for entry in analysis])
        low, high = axes.get_xlim()
        axes.set_xlim(min(low, 0.5) / (1 + 3 * (not set(outcomes) <= _OUTCOMES.keys())), max(high, 2))
        handles = [
            plt.Line2D([], [], ls="", marker=marker, color=COLOURS[kind], label=f"at equal error: {outcome}")
            for outcome, (marker, kind) in _OUTCOMES.items()
            if outcome in outcomes
        ]
        paper = "over the reference, accuracy aside"
        handles.append(plt.Line2D([], [], ls="", marker="o", color=COLOURS["reference"], markerfacecolor="white", label=paper))
        figure.legend(handles=handles, loc="outside upper center", ncols=2)
        _save(figure, path)


#: Errors that a figure of ablations shows: as the paper's, of one step and of the whole rollout.
ABLATED = (Yardstick("one_step_mse_moving", None), MOVING_MSE)


def ablation(rows: Sequence[dict], axes: dict[str, dict[str, str | float]], path: str | Path) -> None:
    """One-step and rollout error of trainings that differ in one thing: a column an axis (name -> contender -> its value there), a dot a training
    seed, a line their median. A seed without an error, whose rollouts failed, is a cross at the top."""
    found = {row["contender"]: row for row in rows}
    _one_scene(rows)
    with plt.rc_context(_STYLE):
        size = (1.1 + 2.1 * len(axes), 5.4)
        figure, panels = plt.subplots(len(ABLATED), len(axes), figsize=size, sharey="row", squeeze=False, layout="constrained")
        for line, yardstick in zip(panels, ABLATED, strict=True):
            for panel, models in zip(line, axes.values(), strict=True):
                values = [[yardstick.of(seed) for seed in found[model]["spread"]["per_seed"]] for model in models]
                medians = [np.median([math.inf if value is None else value for value in seeds]) for seeds in values]
                for place, seeds in enumerate(values):
                    known = [value for value in seeds if value is not None]
                    panel.plot([place] * len(known), known, "o", color=COLOURS["learned"], alpha=0.45, markersize=5, lw=0)
                    if len(known) < len(seeds):
                        panel.plot(place, 0.97, "x", color=COLOURS["reference"], transform=panel.get_xaxis_transform())
                panel.plot(range(len(medians)), [value if math.isfinite(value) else math.nan for value in medians], color=COLOURS["learned"], lw=1.6)
                panel.set(yscale="log", xlim=(-0.4, len(models) - 0.6))
                panel.set_xticks(range(len(models)), [str(value) for value in models.values()])
            line[0].set_ylabel(f"{yardstick}, length\u00b2".replace(" of moving particles", "").replace("rollout MSE over all frames", "rollout MSE"))
        for panel, axis in zip(panels[-1], axes, strict=True):
            panel.set_xlabel(axis)
        _save(figure, path)


def generalisation(rows: Sequence[dict], over: str, trained: Mapping[str, Sequence[tuple[float, float]]], path: str | Path) -> None:
    """Rollout error beyond the training, a column a learned contender: above as it is, below over that of the trajectory's best trivial baseline.
    A dot a rollout; a bar the median of a scene, or of what lies between the ends of what was trained on, which is shaded; a cross at the top a
    rollout that failed. Over particles, where scenes may lie above each other, every scene has a marker.

    rows: of one scene or several; over: as in ``learn.generalisation``; trained: contender -> [low, high] of ``over``, where known."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    models = list(dict.fromkeys(row["contender"] for row in rows if row["kind"] == "learned"))
    with plt.rc_context(_STYLE):
        size = (1.5 + 5.2 * len(models), 6.4)
        figure, panels = plt.subplots(2, len(models), figsize=size, sharex=True, sharey="row", squeeze=False, layout="constrained")
        notes = []
        several = over == PARTICLES and len(scenes) > 1
        shapes = {scene: _SCENE_MARKERS[index % len(_SCENE_MARKERS)] for index, scene in enumerate(scenes)} if several else {}
        for (above, below), model in zip(panels.T, models, strict=True):
            found = trials(rows, model, over)
            ranges = trained.get(model, ())
            for panel in (above, below):
                panel.set(yscale="log", xscale="log" if over == PARTICLES else "linear")
                for low, high in ranges:
                    panel.axvspan(low, high, color=COLOURS["oracle"], alpha=0.13, lw=0, zorder=0)
            for panel, key, kind in ((above, "trivial", "trivial"), (above, "error", "learned"), (below, "ratio", "learned")):
                for scene in scenes:
                    members = [trial for trial in found if trial.scene == scene]
                    _dots(panel, members, key, COLOURS[kind], shapes.get(scene, MARKERS[kind]))
            floors = [trial.floor for trial in found if trial.floor]
            lowest = min([trial.error for trial in found if trial.error > 0], default=0.0)
            if floors and max(floors) > lowest / 10:
                _dots(above, [trial for trial in found if trial.floor], "floor", COLOURS["floor"], MARKERS["floor"])
            elif floors:
                notes.append(f"Chaos floor of {model} below the axis: at most {max(floors):.1e}.")
            below.axhline(1, color=COLOURS["trivial"], lw=1.2, ls=(0, (4, 2)))
            for group in groups(found, over, ranges):
                ends = _ends([trial.value for trial in group.trials], over)
                for panel, key, colour in ((above, "error", "learned"), (above, "trivial", "trivial"), (below, "ratio", "learned")):
                    if math.isfinite(group.median(key)):
                        panel.plot(ends, [group.median(key)] * 2, color=COLOURS[colour], lw=2.4, zorder=3, solid_capstyle="butt")
            above.set_title(model)
            below.set_xlabel({PARTICLES: "particles", SCENE: ""}.get(over, over.replace(".", " ").replace("_", " ")))
            if over == SCENE:
                below.set_xticks(range(len(scenes)), scenes)
        panels[0, 0].set_ylabel("rollout MSE, length\u00b2")
        panels[1, 0].set_ylabel("over the best trivial baseline's")
        handles = [
            plt.Line2D([], [], color=COLOURS[kind], marker="s" if several else MARKERS[kind], ls="", label=label)
            for kind, label in (("learned", "learned, a rollout"), ("trivial", "best trivial baseline of the trajectory"))
        ]
        for scene, marker in shapes.items():
            handles.append(plt.Line2D([], [], color="#444444", marker=marker, markerfacecolor="none", ls="", label=scene))
        handles.append(plt.Line2D([], [], color="#444444", lw=2.4, label="median"))
        if any(trained.values()):
            handles.append(plt.Rectangle((0, 0), 1, 1, color=COLOURS["oracle"], alpha=0.25, lw=0, label="trained on"))
        figure.legend(handles=handles, loc="outside upper center", ncols=3 if several else 2)
        if notes:
            figure.supxlabel("\n".join(notes), fontsize=8.5, color="#555555", wrap=True)
        _save(figure, path)


#: One a scene, where several share an axis.
_SCENE_MARKERS = ("s", "o", "^", "D", "v", "P")


def _ends(values: Sequence[float], over: str) -> tuple[float, float]:
    """Where the bar of a median begins and ends: a little beyond the values."""
    if over == PARTICLES:
        return min(values) / 1.08, max(values) * 1.08
    beyond = 0.3 if over == SCENE else 0.5
    return min(values) - beyond, max(values) + beyond


def _dots(panel: Axes, found: Sequence[Trial], key: str, colour: str, marker: str) -> None:
    """Trials by their values; crosses at the top for those without an error."""
    known = [(trial.value, getattr(trial, key)) for trial in found if math.isfinite(getattr(trial, key))]
    panel.plot(*np.array(known).reshape(-1, 2).T, marker, color=colour, alpha=0.45, markersize=5, lw=0)
    failed = [trial.value for trial in found if math.isinf(getattr(trial, key))]
    if failed:
        panel.plot(failed, [0.97] * len(failed), "x", color=COLOURS["reference"], transform=panel.get_xaxis_transform(), lw=0)


def _read_columns(path: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a CSV file as float arrays; ``InputError`` where the file, a column or a number is missing."""
    try:
        with path.open(newline="") as file:
            lines = list(csv.DictReader(file))
        return {column: np.array([float(line[column]) for line in lines]) for column in columns}
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(path, "columns", list(columns), f"not readable as a training log ({error}); train again or correct the path") from None


def _smooth(values: np.ndarray, count: int) -> np.ndarray:
    """Centred running median over ``count`` entries, shorter at the ends."""
    return np.array([np.median(values[max(0, i - count // 2) : i + count // 2 + 1]) for i in range(len(values))])


def training_curve(runs: Mapping[str, str | Path], path: str | Path) -> None:
    """Training loss (running median over the raw values) and validation rollout MSE over training time, one colour a run.

    runs: label -> run folder with ``log.csv`` (step, seconds, loss) and ``validation.csv`` (step, seconds, rollout_mse). ``InputError``
    for a file that cannot be read.
    """
    palette = [COLOURS[kind] for kind in ("learned", "solver", "oracle", "floor", "reference")]
    with plt.rc_context(_STYLE):
        figure, (above, below) = plt.subplots(2, 1, figsize=(8.5, 6), sharex=True, layout="constrained")
        for index, (label, folder) in enumerate(runs.items()):
            colour, dash = palette[index % len(palette)], _DASHES[index // len(palette) % len(_DASHES)]
            log = _read_columns(Path(folder) / "log.csv", ("step", "seconds", "loss"))
            validation = _read_columns(Path(folder) / "validation.csv", ("step", "seconds", "rollout_mse"))
            steps = int(log["step"][-1]) if len(log["step"]) else 0
            above.plot(log["seconds"] / 60, log["loss"], color=colour, lw=0.6, alpha=0.3)
            above.plot(
                log["seconds"] / 60,
                _smooth(log["loss"], max(len(log["loss"]) // 30, 1)),
                color=colour,
                ls=dash,
                lw=1.8,
                label=f"{label} ({steps:,} steps)",
            )
            below.plot(validation["seconds"] / 60, validation["rollout_mse"], color=colour, ls=dash, lw=1.6, marker="o", markersize=4)
        above.set(yscale="log", ylabel="training loss", title="training")
        below.set(yscale="log", ylabel="validation rollout MSE, length²", xlabel="training time, minutes")
        figure.legend(loc="outside upper center", ncols=3)
        _save(figure, path)
