"""Figures: every contender is in them, labels keep apart and inside, files are whole and repeatable."""

import math

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.transforms import Bbox

from learn import figures
from sim.errors import InputError


def row(name, kind, error, seconds, failures=0, scene="sand"):
    def curve(level):
        parts = (("median", 1), ("min", 0.5), ("max", 2))
        return {part: [None if level is None else level * k * factor for k in (1, 2, 3)] for part, factor in parts}

    return {
        "scene": scene,
        "reference": "teacher",
        "contender": name,
        "kind": kind,
        "failures": failures,
        "status": "failed in 1 of 3" if failures else "ok",
        "rollout_mse_moving": {"all": error},
        "seconds_per_frame": seconds,
        "frame_step": 0.01,
        "timing_spread": {"seconds_per_frame": [seconds * 0.9, seconds * 1.2], "n": 5} if seconds else None,
        "spread": {end: {"rollout_mse_moving": {"all": error and error * factor}} for end, factor in (("min", 0.5), ("max", 2))},
        "curves": {"frame": [1, 50, 100], "mse": curve(error), "kinetic_energy": curve(1.1), "kinetic_energy_true": curve(1.0)},
    }


ROWS = [
    row("teacher", "reference", 0.0, 2e-3),
    *(row(f"dt x{k}", "solver", 1e-6 * k, 2e-3 / k) for k in (2, 3, 4)),
    *(row(f"twin {k}", "solver", 1.02e-6 * k, 2.05e-3 / k) for k in (2, 3, 4)),
    row("gns", "learned", 1e-5, 1e-3),
    row("shaky", "learned", 3e-5, 2e-4, failures=1),
    row("dead", "learned", None, 1e-3, failures=3),
    row("frozen", "trivial", 1e-2, 1e-6),
    row("oracle", "oracle", 0.0, 1e-5),
    row("floor", "floor", 3e-7, 2e-3),
]


@pytest.fixture
def kept(monkeypatch):
    """The figures that were saved, kept open."""
    found = []
    monkeypatch.setattr(figures.plt, "close", found.append)
    yield found
    monkeypatch.undo()
    plt.close("all")


def test_ablation_shows_every_training_and_medians(tmp_path, kept):
    def ablated(name, errors):
        seeds = [{"seed": k, "one_step_mse_moving": 1e-9 if e else None, "rollout_mse_moving": {"all": e}} for k, e in enumerate(errors)]
        found = row(name, "learned", 1e-5, 1e-3)
        return found | {"spread": found["spread"] | {"per_seed": seeds}}

    rows = [*ROWS, ablated("base", [1e-4, 3e-4, 2e-4]), ablated("small", [4e-3, None, 1e-3]), ablated("shared", [2e-4, 2e-4, 5e-4])]
    figures.ablation(rows, {"steps": {"small": 1, "base": 5}, "blocks": {"base": "own", "shared": "one"}}, tmp_path / "figure.svg")
    one_step, rollout = kept[0].axes[:2], kept[0].axes[2:]
    assert len(one_step) == len(rollout) == 2
    dots = [sorted(line.get_ydata()) for line in rollout[0].lines if line.get_linestyle() == "None" and line.get_marker() == "o"]
    assert dots == [[1e-3, 4e-3], [1e-4, 2e-4, 3e-4]]
    # The median of a failure and two errors is the larger one.
    assert [line.get_ydata().tolist() for line in rollout[0].lines if line.get_linestyle() == "-"] == [[4e-3, 2e-4]]
    assert sum(line.get_marker() == "x" for line in rollout[0].lines) == 1
    assert [label.get_text() for label in rollout[1].get_xticklabels()] == ["own", "one"] and rollout[0].get_xlabel() == "steps"


def test_generalisation_shows_every_rollout_medians_and_what_was_trained_on(tmp_path, kept):
    def shown(scene, name, kind, errors):
        runs = [
            {"trajectory_seed": k, "particles": {"small": 500, "large": 2500}[scene] + k, "context": {}, "rollout_mse_moving": {"all": error}}
            for k, error in enumerate(errors)
        ]
        return row(name, kind, 1e-5, 1e-3, scene=scene) | {"spread": {"per_trajectory": runs}}

    rows = [
        shown("small", "gns", "learned", [1e-4, 2e-4, 3e-4]),
        shown("small", "frozen", "trivial", [1e-2] * 3),
        shown("small", "floor", "floor", [1e-12] * 3),
        shown("large", "gns", "learned", [4e-3, None, 6e-3]),
        shown("large", "frozen", "trivial", [2e-3] * 3),
    ]
    figures.generalisation(rows, "particles", {"gns": [(450, 600)]}, tmp_path / "figure.svg")
    above, below = kept[0].axes

    def lines(panel, marker):
        return [list(zip(*line.get_data(), strict=True)) for line in panel.lines if line.get_marker() == marker]

    # A marker a scene; the baseline's first, in grey.
    assert lines(above, "s") == [[(500, 1e-2), (501, 1e-2), (502, 1e-2)], [(500, 1e-4), (501, 2e-4), (502, 3e-4)]]
    assert lines(above, "o") == [[(2500, 2e-3), (2501, 2e-3), (2502, 2e-3)], [(2500, 4e-3), (2502, 6e-3)]]
    assert [ratio for _, ratio in lines(below, "s")[0] + lines(below, "o")[0]] == pytest.approx([0.01, 0.02, 0.03, 2, 3])
    assert {"small", "large", "trained on"} <= {text.get_text() for text in kept[0].legends[0].get_texts()}
    assert [[x for x, _ in crosses] for crosses in lines(above, "x")] == [[2501]] == [[x for x, _ in crosses] for crosses in lines(below, "x")]
    # Bars: medians, a failure being infinitely bad, just beyond their particles; the line at 1 is a baseline's.
    bars = [(line.get_ydata()[0], *line.get_xdata()) for line in above.lines if line.get_linewidth() == 2.4 and line.get_color() == "#D55E00"]
    assert [height for height, *_ in bars] == [2e-4, 6e-3] and bars[0][1] < 500 and bars[0][2] > 502
    assert [line.get_ydata()[0] for line in below.lines if line.get_linewidth() == 2.4] == pytest.approx([0.02, 3])
    assert (above.patches[0].get_x(), above.patches[0].get_width()) == (450, 150)
    assert above.get_xscale() == above.get_yscale() == below.get_yscale() == "log"
    assert "Chaos floor of gns below the axis: at most 1.0e-12." in kept[0].get_supxlabel()

    figures.generalisation(rows, "scene", {}, tmp_path / "scenes.svg")
    assert [label.get_text() for label in kept[1].axes[1].get_xticklabels()] == ["small", "large"] and not kept[1].axes[0].patches
    first = (tmp_path / "scenes.svg").read_bytes()
    figures.generalisation(rows, "scene", {}, tmp_path / "scenes.svg")
    assert (tmp_path / "scenes.svg").read_bytes() == first


def test_error_over_run_time(tmp_path, kept):
    path = tmp_path / "figure.png"
    figures.error_over_run_time(ROWS, path)
    figure, axes = kept[0], kept[0].axes[0]
    texts = [text for text in axes.texts if text.get_text()]
    assert {text.get_text() for text in texts} == {row["contender"] for row in ROWS} - {"dead", "oracle", "floor"}
    frame, boxes = axes.get_window_extent(), [text.get_window_extent() for text in texts]
    for index, box in enumerate(boxes):
        assert box.x0 >= frame.x0 - 1 and box.x1 <= frame.x1 + 1 and box.y0 >= frame.y0 - 1 and box.y1 <= frame.y1 + 1, texts[index]
        for other in range(index):
            wide, high = (min(getattr(box, end), getattr(boxes[other], end)) for end in ("x1", "y1"))
            apart = wide - max(box.x0, boxes[other].x0) < 1 or high - max(box.y0, boxes[other].y0) < 1
            assert apart, (texts[index], texts[other])
    notes = figure._supxlabel.get_text()
    assert "dead (failed" in notes and "error exactly zero" in notes
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["reference", "solver ladder", "learned", "trivial", "some rollouts failed", "Pareto front", "chaos floor"]
    assert path.stat().st_size > 5000


def test_a_chaos_floor_below_the_axis_is_said(tmp_path, kept):
    figures.error_over_run_time([ROWS[0], ROWS[1], row("floor", "floor", 1e-15, 1e-3)], tmp_path / "figure.png")
    assert "Chaos floor below the axis: 1.0e-15" in kept[0]._supxlabel.get_text()
    assert kept[0].axes[0].get_ylim()[0] > 1e-9


def test_speed_ups_show_every_learned_model_both_ways(tmp_path, kept):
    def entry(scene, name, outcome, ratio, paper):
        return {"scene": scene, "contender": name, "equal_error": {"outcome": outcome, "ratio": ratio}, "speed_up_paper": paper}

    analysis = [
        entry("sand", "gns", "loses", 0.1, 2.0),
        entry("sand", "grid", "wins", 3.0, 9.0),
        entry("mud", "gns", "worse than trivial", 5.0, 6.0),
        entry("mud", "dead", "failed", None, 7.0),
        entry("mud", "alone", "no rung", None, None),
    ]
    figures.speed_ups(analysis, tmp_path / "figure.svg")
    (axes,) = kept[0].axes
    marks = {(line.get_marker(), *line.get_xdata(), *line.get_ydata()) for line in axes.lines if len(line.get_xdata()) == 1}
    assert {("v", 0.1, 0), ("s", 3.0, 1), ("X", 5.0, 2), *(("o", paper, place) for place, paper in enumerate((2.0, 9.0, 6.0, 7.0)))} == marks
    assert [(text.get_text(), text.get_position()[1]) for text in axes.texts] == [("failed", 3), ("no rung", 4)]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sand: gns", "sand: grid", "mud: gns", "mud: dead", "mud: alone"]
    low, high = axes.get_xlim()
    assert low < 0.1 and high > 9 and axes.get_ylim() == (4.6, -0.6)
    assert [text.get_text() for text in kept[0].legends[0].get_texts()] == [
        "at equal error: wins",
        "at equal error: loses",
        "at equal error: worse than trivial",
        "over the reference, accuracy aside",
    ]


def test_curves_show_every_contender(tmp_path, kept):
    figures.error_over_time(ROWS, tmp_path / "error.svg")
    figures.kinetic_energy(ROWS, tmp_path / "energy.svg")
    error, energy = ([text.get_text() for text in figure.legends[0].get_texts()] for figure in kept)
    assert set(error) == {row["contender"] for row in ROWS} - {"teacher", "oracle", "dead"}
    assert energy[0] == "truth (teacher)" and {"gns", "frozen", "dt x4"} < set(energy) and "oracle" not in energy
    np.testing.assert_allclose(kept[1].axes[0].lines[0].get_xdata(), [0.01, 0.5, 1.0])


@pytest.mark.parametrize("draw", [figures.error_over_time, figures.kinetic_energy])
def test_of_many_contenders_the_most_accurate_have_curves_and_the_legend_leaves_them_room(tmp_path, kept, draw):
    many = [row(f"a network whose name says all that it does, number {k}", "learned", 1e-5 * (40 - k), 1e-3) for k in range(20)]
    draw([*ROWS, *many], tmp_path / "figure.svg")
    (figure,) = kept
    (legend,) = figure.legends
    shown = [text.get_text() for text in legend.get_texts() if text.get_text().endswith(tuple("0123456789")) and "network" in text.get_text()]
    assert [name.split()[-1] for name in shown] == [str(k) for k in range(14, 20)]  # with gns and shaky, of 1e-5 and 3e-5, these are the best eight
    assert "learned: the 8 of 23 with the least error" in figure.axes[0].get_xlabel()
    renderer, window = figure.canvas.get_renderer(), figure.bbox
    box = Bbox.union([text.get_window_extent(renderer) for text in legend.get_texts()])
    axes = figure.axes[0].get_window_extent(renderer)
    assert box.x0 >= window.x0 and box.x1 <= window.x1 and box.y0 >= window.y0
    assert not box.overlaps(figure.axes[0].get_tightbbox(renderer))
    assert axes.width > 0.8 * window.width and axes.height > 3.5 * figure.dpi


def test_equal_rows_give_equal_files(tmp_path):
    for name in ("one.svg", "two.svg"):
        figures.error_over_time(ROWS, tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


@pytest.mark.parametrize("rows", [[], [ROWS[0], row("gns", "learned", 1, 1, scene="water")]])
def test_a_figure_shows_one_scene(tmp_path, rows):
    for figure in (figures.error_over_run_time, figures.error_over_time, figures.kinetic_energy):
        with pytest.raises(ValueError, match="one scene"):
            figure(rows, tmp_path / "figure.png")
    assert not list(tmp_path.iterdir())


def write_run(folder, steps):
    folder.mkdir()
    log = "\n".join(f"{10 * k},{k},{math.exp(-k / 20)},1e-4" for k in range(1, steps))
    (folder / "log.csv").write_text("step,seconds,loss,lr\n" + log + "\n")
    (folder / "validation.csv").write_text("step,seconds,rollout_mse,spacing_ratio\n100,10,0.1,0.9\n200,20,0.05,0.95\n")
    return folder


def test_training_curve(tmp_path, kept):
    figures.training_curve({"gns": write_run(tmp_path / "a", 50), "emulator": write_run(tmp_path / "b", 30)}, tmp_path / "training.png")
    above, below = kept[0].axes
    assert [text.get_text() for text in kept[0].legends[0].get_texts()] == ["gns (490 steps)", "emulator (290 steps)"]
    np.testing.assert_allclose(below.lines[0].get_xydata(), [[10 / 60, 0.1], [20 / 60, 0.05]])
    assert len(above.lines) == 4


def test_smooth_is_a_running_median():
    np.testing.assert_array_equal(figures._smooth(np.array([1.0, 9.0, 2.0, 3.0]), 3), [5.0, 2.0, 3.0, 2.5])


@pytest.mark.parametrize("content", [None, "step,seconds\n1,2\n", "step,seconds,loss\n1,2,x\n", "step,seconds,loss\n1,2\n"])
def test_a_broken_log_is_named(tmp_path, content):
    folder = write_run(tmp_path / "run", 5)
    (folder / "log.csv").unlink()
    if content is not None:
        (folder / "log.csv").write_text(content)
    with pytest.raises(InputError, match="log.csv: columns"):
        figures.training_curve({"gns": folder}, tmp_path / "training.png")
    assert not (tmp_path / "training.png").exists()


def test_of_many_rungs_those_on_the_front_are_named(tmp_path, kept):
    def named(rungs):
        worse = [row(f"worse {k}", "solver", 1e-3 * k, 2e-3 / k) for k in range(1, rungs - 1)]
        best = [row("slow", "solver", 1e-6, 2e-3), row("fast", "solver", 1e-5, 1e-4)]
        figures.error_over_run_time([*best, *worse, row("gns", "learned", 1e-2, 1e-3)], tmp_path / "many.svg")
        return {text.get_text() for text in kept[-1].axes[0].texts} - {""}, kept[-1].get_supxlabel()

    names, note = named(figures.MOST_NAMED)
    assert len(names) == figures.MOST_NAMED + 1 and note == ""
    names, note = named(figures.MOST_NAMED + 1)
    assert names == {"slow", "fast", "gns"} and note.startswith(f"Of {figures.MOST_NAMED + 1} settings of the solver those on the front are named")
