import pytest

from sim.mpm.solver import MPMSimulator


def pytest_addoption(parser):
    parser.addoption("--kills", type=int, default=2, help="random instants at which the micro study is killed (tests/workflow/test_end_to_end.py)")


@pytest.fixture(scope="module")
def water():
    """One solver for all 2D scenes of water in a file: they share its kernels."""
    return MPMSimulator()


@pytest.fixture(scope="module")
def sand():
    """The same for sand; all of it has rough walls."""
    return MPMSimulator()


@pytest.fixture
def built(monkeypatch):
    """What Taichi is asked for: {"fields": [(bytes an entry, entries)], "kernels": {names}}."""
    from taichi.lang.kernel_impl import Kernel

    from sim.taichi_runtime import ti

    found = {"fields": [], "kernels": set()}

    def record(owner, name, width):
        original = getattr(owner, name)

        def create(*arguments, **options):
            result = original(*arguments, **options)
            entries = 1
            for edge in result.shape:
                entries *= edge
            found["fields"].append(((8 if result.dtype == ti.f64 else 4) * width(result), entries))
            return result

        monkeypatch.setattr(owner, name, staticmethod(create) if isinstance(owner, type) else create)

    record(ti, "field", lambda _: 1)
    record(ti.Matrix, "field", lambda result: result.n * result.m)  # vectors come through here too
    compile_one = Kernel.materialize

    def materialize(self, *arguments, **options):
        if self.func.__module__ in ("sim.mpm.solver", "sim.sph.solver", "sim.pbd.solver"):
            found["kernels"].add(self.func.__name__)
        return compile_one(self, *arguments, **options)

    monkeypatch.setattr(Kernel, "materialize", materialize)
    return found
