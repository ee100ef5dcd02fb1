"""The validation ladder at its middle resolution, and the page it writes."""

from __future__ import annotations

import numpy as np
import pytest

from sim.validation.__main__ import cases, main, page
from sim.validation.case import Case, Result, order

#: Minutes a resolution; ``make validate`` runs them.
SLOW = {"granular_collapse"}


@pytest.mark.physics
@pytest.mark.parametrize("case", [case for case in cases() if case.name not in SLOW], ids=lambda case: case.name)
def test_case(case):
    result = case.run(case.resolutions[1])
    assert result.error <= case.tolerance, result.found


def results(*errors):
    curve = (np.arange(3.0), np.arange(3.0))
    return [Result(n, error, f"error {error}", curve, curve, 0.1 * n) for n, error in zip((8, 16, 32), errors, strict=True)]


def test_order_of_convergence():
    assert order(results(0.4, 0.1, 0.025)) == pytest.approx(2.0)
    assert order(results(0.4, 0.2, 0.1)) == pytest.approx(1.0)


def test_the_page_says_what_failed(tmp_path):
    known = [case.name for case in cases()]
    good, bad, broken = known[:3]
    tolerance = {case.name: case.tolerance for case in cases()}
    found = {
        good: results(1, 1, 0.9 * tolerance[good]), bad: results(0, 0, 1.1 * tolerance[bad]),
        broken: [*results(0, 0, 0)[:2], "time step fell below 1e-9 s"],
    }
    text, holds = page(found, tmp_path, "versions")
    assert not holds and "1 of 3 cases hold" in text
    titles = {case.name: case.title for case in cases()}
    verdict = next(line for line in text.splitlines() if line.startswith("1 of 3"))
    assert titles[bad] in verdict and titles[broken] in verdict and titles[good] not in verdict
    assert "failed: time step fell below" in text
    assert sorted(path.stem for path in (tmp_path / "validation").iterdir()) == sorted(found)
    text, holds = page({good: found[good]}, tmp_path, "versions")
    assert holds and "All 1 cases hold" in text


def test_every_case_is_complete():
    numbers = [(case.number, case.name) for case in cases()]
    assert numbers == sorted(numbers) and len({name for _, name in numbers}) == len(numbers)
    for case in cases():
        assert isinstance(case, Case) and len(case.resolutions) == 3 and list(case.resolutions) == sorted(case.resolutions) and case.tolerance > 0


def test_an_unknown_case_is_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["no_such_case"])
    assert stop.value.code == 2 and "no such case" in capsys.readouterr().err
