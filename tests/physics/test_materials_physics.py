"""Materials in motion, beside the cases of ``sim.validation`` (test_ladder.py)."""

import pytest

from sim.validation.viscoplastic_slump import limits

pytestmark = pytest.mark.physics


def test_goop_without_yield_stress_is_a_fluid_and_with_an_infinite_one_a_solid():
    """Two curves of a case whose others do not hold at the resolution of a test."""
    for name, curve in limits(40)[0].items():
        assert curve.passed, f"{name}: {curve.error:.4g}, tolerance {curve.tolerance:.4g}"
