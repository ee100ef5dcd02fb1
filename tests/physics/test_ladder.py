"""The validation ladder at resolutions that take seconds, and the page it writes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sim.validation import CASES, Curve, Outcome
from sim.validation.granular_collapse import packed
from sim.validation.ladder import main, methods, module, order, page, run

#: Cases that hold and their methods, each at the least resolution that is worth its time. Those that do not hold yet are in docs/validation.md.
AFFORDABLE = {
    ("rotation", "mpm"): 32, ("return_map", "mpm"): 1000, ("hydrostatics", "mpm"): 32, ("elastic_column", "mpm"): 16, ("axial_bar", "mpm"): 4,
    ("cantilever", "mpm"): 4, ("standing_wave", "mpm"): 32, ("dam_break", "mpm"): 16, ("granular_collapse", "mpm"): 8,
    ("block_on_plane", "mpm"): 32, ("elastic_discs", "mpm"): 40, ("viscoplastic_slump", "mpm"): 80,
    ("rotation", "wcsph"): 32, ("hydrostatics", "wcsph"): 16, ("taylor_green", "wcsph"): 30, ("channel", "dfsph"): 30,
    ("lid_driven_cavity", "wcsph"): 20, ("standing_wave", "wcsph"): 16, ("elliptical_drop", "wcsph"): 30, ("elliptical_drop", "dfsph"): 120,
    ("dam_break", "wcsph"): 8, ("dam_break", "dfsph"): 8, ("rotation", "pbf"): 32, ("hydrostatics", "pbf"): 16, ("dam_break", "pbf"): 8,
    ("lid_driven_cavity", "dfsph"): 16, ("hydrostatics", "dfsph"): 16, ("taylor_green", "dfsph"): 100,
}  # fmt: skip


@pytest.mark.physics
@pytest.mark.parametrize(("case", "method"), AFFORDABLE)
def test_case(case, method):
    outcome = run(case, AFFORDABLE[case, method], method)
    assert outcome.case == case and outcome.resolution == AFFORDABLE[case, method] and outcome.seconds > 0 and outcome.particles > 0
    for name, curve in outcome.curves.items():
        assert len(curve.x) == len(curve.ours) == len(curve.reference), name
        assert np.isfinite(curve.ours).all(), name
        assert curve.passed, f"{name}: {curve.label}: {curve.error:.4g}, tolerance {curve.tolerance:.4g}"


@pytest.mark.parametrize("squeeze", [1.0, 0.3, 0.05])
def test_sand_is_packed_evenly_however_far_it_is_stretched(squeeze):
    """No two particles nearer than two thirds of their mean spacing, no place farther from one than a spacing; a plain lattice of the
    column parts into rows."""
    at, spacing = packed(2000, 1.0, 20.0), 0.1

    def gaps(particles):
        particles = particles * [1 / squeeze, squeeze]
        inside = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 60) / squeeze, np.linspace(2, 18, 60) * squeeze), -1).reshape(-1, 2)
        tree = cKDTree(particles)
        return tree.query(particles, 2)[0][:, 1].min() / spacing, tree.query(inside)[0].max() / spacing

    nearest, farthest = gaps(at)
    assert nearest > 2 / 3 and farthest < 1 and (at > 0).all() and (at < [1, 20]).all()
    if squeeze < 0.1:
        rows = (np.stack(np.meshgrid(np.arange(10), np.arange(200)), -1).reshape(-1, 2) + 0.5) * spacing
        assert gaps(rows)[0] < 0.1 and gaps(rows)[1] > 5


def outcomes(case, *errors):
    x = np.arange(3.0)
    return [
        Outcome(case, n, 10, {"thing": Curve(f"label {error}", ("x", "y"), x, x, x + error, error, 0.1)}, 0.1 * n)
        for n, error in zip(module(case).RESOLUTIONS, errors, strict=True)
    ]


def test_order_of_convergence():
    assert order((8, 16, 32), (0.4, 0.1, 0.025)) == pytest.approx(2.0)
    assert order((8, 16, 32), (-0.4, 0.2, -0.1)) == pytest.approx(1.0)


def test_the_page_says_what_failed(tmp_path):
    found = {
        "hydrostatics": {"mpm": outcomes("hydrostatics", 1, 1, 0.09)},
        "dam_break": {"mpm": outcomes("dam_break", 0, 0, -0.11), "wcsph": outcomes("dam_break", 0, 0, 0)},
        "rotation": {"mpm": [*outcomes("rotation", 0, 0, 0)[:2], "time step fell below 1e-9 s"]},
    }
    text, holds = page(found, tmp_path, "versions")
    assert not holds and "2 of 4 hold. Missed: Dam break (mpm), Rotation and free fall (mpm)." in text
    assert "failed: time step fell below" in text and "label -0.11" in text and "| wcsph | thing |" in text
    assert sorted(path.stem for path in (tmp_path / "validation").iterdir()) == sorted(found)
    text, holds = page({"hydrostatics": found["hydrostatics"]}, tmp_path, "versions")
    assert holds and "All 1 hold." in text


@pytest.mark.parametrize("case", CASES)
def test_every_case_is_complete(case):
    found = module(case)
    assert isinstance(found.NUMBER, int) and len(found.RESOLUTIONS) == 3 and list(found.RESOLUTIONS) == sorted(found.RESOLUTIONS)
    assert ":" in found.__doc__.splitlines()[0], "a title, a colon, what is compared"
    assert methods(case) and set(methods(case)) <= {"mpm", "wcsph", "dfsph", "pbf"}


def test_an_unknown_case_is_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["no_such_case"])
    assert stop.value.code == 2 and "no such case" in capsys.readouterr().err
