"""Materials in motion, beside the cases of ``sim.validation`` (test_ladder.py)."""

import numpy as np
import pytest

from sim.validation.viscoplastic_slump import BOX, HALF, HEIGHT, slump

pytestmark = pytest.mark.physics


def test_goop_without_yield_stress_runs_on_and_with_a_large_one_stands():
    """The slump's column: a viscous fluid goes on to the walls, far beyond where goop of the case stops (0.48); an elastic solid stands."""
    _, position, *_ = slump(20, yield_stress=0.0)
    assert np.abs(position[:, 0]).max() > 0.9 * BOX[0] and position[:, 1].max() < 0.6 * HEIGHT
    x, position, h, *_ = slump(20, yield_stress=1e9)
    assert np.abs(position[:, 0]).max() < HALF * 1.03
    # Its weight shortens it by rho g H / 2 M = 0.6 % and widens it as much; a cell at the rim may hold a column of particles less.
    assert h[np.abs(x) < 0.7 * HALF] == pytest.approx(HEIGHT, rel=0.03)
