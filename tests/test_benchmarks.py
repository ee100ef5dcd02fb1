"""The C program that the solver is timed against must compute the same thing, or the ratio means nothing."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from sim.mpm.solver import MPMSimulator


def _load_benchmark():
    """The benchmarks are scripts, no package, so the module is loaded by its path."""
    spec = importlib.util.spec_from_file_location("mpm_benchmark", Path(__file__).resolve().parent.parent / "benchmarks" / "mpm.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


benchmark = _load_benchmark()


@pytest.mark.parametrize("material, dim, friction", [("water", 2, 0.0), ("sand", 2, 0.45), ("water", 3, 0.3)])
def test_c_loop_agrees_with_the_solver(tmp_path, material, dim, friction):
    library = benchmark.build(tmp_path)
    if library is None:
        pytest.skip("no C compiler on PATH")
    scene = benchmark.block(material, dim, 20, 32, friction)
    simulator, yardstick = MPMSimulator(), benchmark.CLoop(library, scene)
    simulator.load(scene)
    for _ in range(20):
        position = simulator.frame()
        yardstick.frame(int(simulator.diagnostics()["substeps"]))
    start = scene.particles().position
    moved = np.abs(position - start).max()
    assert moved > 0.3 * scene.grid_spacing
    assert np.abs(position - yardstick.position()).max() < 1e-3 * moved
