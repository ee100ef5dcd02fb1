"""The validation ladder at resolutions that take seconds, and the page it writes."""

from __future__ import annotations

import numpy as np
import pytest

from sim.validation import CASES, Curve, Outcome
from sim.validation.ladder import main, module, order, page

#: Cases held to their tolerance by every test run, at this place among their resolutions.
HERE = {"rotation": 1, "return_map": 1, "hydrostatics": 1, "standing_wave": 1, "dam_break": 1}


@pytest.mark.physics
@pytest.mark.parametrize(("case", "place"), HERE.items(), ids=HERE)
def test_case(case, place):
    outcome = module(case).run(module(case).RESOLUTIONS[place])
    for curve in outcome.curves.values():
        assert curve.passed, (curve.label, curve.error)


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
        "hydrostatics": outcomes("hydrostatics", 1, 1, 0.09), "dam_break": outcomes("dam_break", 0, 0, -0.11),
        "rotation": [*outcomes("rotation", 0, 0, 0)[:2], "time step fell below 1e-9 s"],
    }
    text, holds = page(found, tmp_path, "versions")
    assert not holds and "1 of 3 cases hold. Missed: Dam break, Rotation." in text
    assert "failed: time step fell below" in text and "label -0.11" in text
    assert sorted(path.stem for path in (tmp_path / "validation").iterdir()) == sorted(found)
    text, holds = page({"hydrostatics": found["hydrostatics"]}, tmp_path, "versions")
    assert holds and "All 1 cases hold." in text


@pytest.mark.parametrize("case", CASES)
def test_every_case_is_complete(case):
    found = module(case)
    assert isinstance(found.NUMBER, int) and len(found.RESOLUTIONS) == 3 and list(found.RESOLUTIONS) == sorted(found.RESOLUTIONS)
    assert ":" in found.__doc__.splitlines()[0], "a title, a colon, what is compared"


def test_an_unknown_case_is_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["no_such_case"])
    assert stop.value.code == 2 and "no such case" in capsys.readouterr().err
