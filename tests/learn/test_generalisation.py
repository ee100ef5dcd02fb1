"""Errors beyond the training, from rows written by hand."""

import math

import pytest

from learn.generalisation import groups, trials


def run(seed, error, particles=10, **context):
    return {"trajectory_seed": seed, "particles": particles, "context": context, "rollout_mse_moving": {"all": error}}


def row(scene, contender, kind, runs):
    return {"scene": scene, "contender": contender, "kind": kind, "spread": {"per_trajectory": runs}}


def angles(*values, errors=None):
    """One scene, a trajectory an angle: errors of the model, and of two baselines of which the better one changes."""
    errors = errors or [1e-3] * len(values)
    named = [{"sand.angle": value} for value in values]
    return [
        row("sand", "gns", "learned", [run(k, e, **name) for k, (e, name) in enumerate(zip(errors, named, strict=True))]),
        row("sand", "frozen", "trivial", [run(k, 1e-2 * (1 + k), **name) for k, name in enumerate(named)]),
        row("sand", "drop", "trivial", [run(k, 4e-2 / (1 + k), **name) for k, name in enumerate(named)]),
        row("sand", "floor", "floor", [run(k, 1e-9, **name) for k, name in enumerate(named)]),
    ]


def test_every_rollout_stands_beside_the_best_baseline_of_its_trajectory():
    found = trials(angles(5.0, 20.0, 40.0, errors=[1e-3, 2e-3, None]), "gns", "sand.angle")
    assert [trial.value for trial in found] == [5.0, 20.0, 40.0]
    assert [trial.trivial for trial in found] == pytest.approx([1e-2, 2e-2, 4e-2 / 3])
    assert [trial.ratio for trial in found] == pytest.approx([0.1, 0.1, math.inf]) and found[0].floor == 1e-9


def test_seeds_of_trajectories_count_within_a_scene():
    """Test splits of different scenes share their seeds."""
    rows = [
        row(scene, name, kind, [run(0, error, particles)])
        for scene, particles, factor in (("small", 500, 1), ("large", 2500, 5))
        for name, kind, error in (("gns", "learned", 1e-3 * factor), ("frozen", "trivial", 1e-2 * factor))
    ]
    by_size = trials(rows, "gns", "particles")
    assert [(trial.value, trial.error, trial.ratio) for trial in by_size] == [(500, 1e-3, pytest.approx(0.1)), (2500, 5e-3, pytest.approx(0.1))]
    assert [(group.name, group.trained) for group in groups(by_size, "particles", [(400, 600)])] == [("small", True), ("large", False)]
    by_scene = trials(rows, "gns", "scene")
    assert [trial.value for trial in by_scene] == [0, 1]
    assert [(group.name, group.trained) for group in groups(by_scene, "scene")] == [("small", None), ("large", None)]


def test_groups_lie_between_the_ends_of_what_was_trained_on():
    found = trials(angles(5, 15, 20, 30, 31, 40, 60, 80), "gns", "sand.angle")
    made = groups(found, "sand.angle", [(15, 30), (55, 70)])
    assert [(group.name, group.trained, [trial.value for trial in group.trials]) for group in made] == [
        ("below 15", False, [5]), ("15 to 30", True, [15, 20, 30]), ("30 to 55", False, [31, 40]), ("55 to 70", True, [60]),
        ("above 70", False, [80]),
    ]  # fmt: skip
    assert [group.name for group in groups(found[:2], "sand.angle", [(15, 30)])] == ["below 15", "15 to 30"]  # empty ones are left out
    (all_of_them,) = groups(found, "sand.angle")
    assert (all_of_them.name, all_of_them.trained, len(all_of_them.trials)) == ("all", None, 8)


def test_medians_count_failures_as_infinitely_bad():
    (group,) = groups(trials(angles(1, 2, 3, errors=[1e-3, None, 5e-3]), "gns", "sand.angle"), "sand.angle")
    assert group.median("error") == 5e-3 and group.median("value") == 2
    (group,) = groups(trials(angles(1, 2, 3, errors=[None, None, 5e-3]), "gns", "sand.angle"), "sand.angle")
    assert math.isinf(group.median("error")) and math.isinf(group.median("ratio"))


def test_a_number_that_no_context_has():
    with pytest.raises(ValueError, match=r"over = 'sand.weight': not in the context of sand, \['sand.angle'\]"):
        trials(angles(5), "gns", "sand.weight")
