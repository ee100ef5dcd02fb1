"""Materials in motion, beside the cases of ``sim.validation`` (test_ladder.py)."""

import numpy as np
import pytest

from sim.validation.viscoplastic_slump import HALF, HEIGHT, RHO, YIELD, G, deposit, slump

pytestmark = pytest.mark.physics


def test_goop_without_yield_stress_runs_on_and_with_a_large_one_stands():
    """The slump's column: a viscous fluid goes on, well beyond where the goop of the case stops; an elastic solid stands.

    A fluid should be at the walls by then; its film, two cells thick here and held at the floor, is slower.
    """
    arrested = deposit(np.zeros(1), YIELD / (RHO * G), HALF * HEIGHT)[1]
    _, path, *_ = slump(20, yield_stress=0.0)
    assert np.abs(path[-1][:, 0]).max() > 1.25 * arrested
    x, path, h, n, _ = slump(20, yield_stress=1e9)
    assert np.abs(path[-1][:, 0]).max() < HALF * 1.03
    # Its weight widens it by 1.3 %: no column of particles but those at the rim changes its cell.
    assert h[np.abs(x) < 0.7 * HALF] == pytest.approx(n * 0.025**2 / (2 * HALF), rel=1e-6)
