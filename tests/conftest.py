import pytest

from sim.mpm.solver import MPMSimulator


@pytest.fixture(scope="module")
def water():
    """One solver for all 2D scenes of water in a file: they share its kernels."""
    return MPMSimulator()


@pytest.fixture(scope="module")
def sand():
    """The same for sand; all of it has rough walls."""
    return MPMSimulator()
