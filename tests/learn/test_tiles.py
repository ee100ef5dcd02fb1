"""Tiles of rows against the plain operations they stand for: sums, messages, gradients, threads, and what happens without a compiler."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from learn import gns, tiles
from learn.graph import Graph, radius_graph

torch.set_num_threads(1)
NORM = gns.NORM_EPSILON

pytestmark = pytest.mark.skipif(tiles.build() is None, reason="no C++ compiler that builds learn/tiles.cpp")
PRECISIONS = [torch.float32, torch.bfloat16]


def supported(dtype: torch.dtype) -> bool:
    return tiles.supports(32, 2, dtype, torch.zeros(1))


def graph_of(particles: int, seed: int = 0, radius: float = 0.25, apart: int = 0) -> Graph:
    """A random graph without self edges; the last ``apart`` particles have no neighbours."""
    place = torch.rand(particles, 2, generator=torch.Generator().manual_seed(seed))
    place[particles - apart :] += 10 * torch.arange(1, apart + 1)[:, None]
    return radius_graph(place, radius, self_edges=False)


def case(dtype: torch.dtype, latent: int = 32, layers: int = 2, **graph):
    """Arguments of an edge pass."""
    graph = graph_of(**({"particles": 90, "apart": 2} | graph))
    generator = torch.Generator().manual_seed(1)
    rand = lambda *shape: torch.randn(shape, generator=generator)  # noqa: E731
    rest = []
    for _ in range(layers):
        rest += [rand(latent, latent) / latent**0.5, 0.1 * rand(latent)]
    rest += [1 + 0.1 * rand(latent), 0.1 * rand(latent)]
    wide = rand(latent, 3 * latent) / latent**0.5
    table, edges = rand(graph.particles, 2, latent).to(dtype), rand(graph.edges, latent).to(dtype)
    return graph, table, edges, wide[:, :latent], rest


def plainly(monkeypatch) -> None:
    monkeypatch.setattr(tiles, "build", lambda: None)


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((found.double() - wanted.double()).norm() / wanted.double().norm()).item()


def test_two_edges_by_hand():
    """Latent 32, of which two lanes are used: x0 = P[0] + Q[1] + 2 e, m = LayerNorm(relu(x0))."""
    latent = 32
    graph = Graph(torch.tensor([1, 0], dtype=torch.int32), torch.tensor([0, 1], dtype=torch.int32), torch.tensor([0, 1, 2], dtype=torch.int32))
    table, edges = torch.zeros(2, 2, latent), torch.zeros(2, latent)
    table[0, 0, 0], table[1, 1, 0], edges[0, 0], edges[1, 3] = 1, 2, 4, -1  # edge 0: 1 -> 0, lane 0: 1 + 2 + 8; edge 1: lane 3: -2, cut to 0
    rest = [torch.eye(latent), torch.zeros(latent), torch.ones(latent), torch.full((latent,), 0.5)]
    sums, updated, _ = tiles.edge_pass(graph, table, edges.clone(), 2 * torch.eye(latent), rest, NORM, True, False)
    mean = 11 / latent
    deviation = ((11 - mean) ** 2 / latent + (latent - 1) * mean**2 / latent + NORM) ** 0.5
    assert sums[0, 0] == pytest.approx((11 - mean) / deviation + 0.5, rel=1e-6)
    assert sums[0, 1:].numpy() == pytest.approx(-mean / deviation + 0.5, rel=1e-6)
    assert (sums[1] == 0.5).all()  # nothing passed the ReLU: beta alone
    assert updated[0, 0] == pytest.approx(4 + sums[0, 0].item(), rel=1e-6) and updated[1, 3] == -0.5


@pytest.mark.parametrize("update", [True, False])
@pytest.mark.parametrize(("latent", "layers"), [(32, 1), (32, 2), (64, 3), (96, 2), (128, 2)])
@pytest.mark.parametrize("dtype", PRECISIONS)
def test_a_pass_equals_plain_operations(dtype, latent, layers, update, monkeypatch):
    if not supported(dtype):
        pytest.skip("this processor does not multiply bfloat16")
    graph, table, edges, first, rest = case(dtype, latent, layers)
    found = [tiles.edge_pass(graph, table, edges.clone(), first, rest, NORM, update, keep) for keep in (False, True)]
    plainly(monkeypatch)
    wanted = gns._edge_pass(graph, torch.float64, table.double(), edges.double(), first.double(), tuple(p.double() for p in rest), update, True)
    most = 1e-6 if dtype == torch.float32 else 1e-2
    assert graph.edges % 48 and not graph.offsets.diff()[-2:].any()  # a tile is not full, and particles without edges are among them
    for sums, updated, _ in found:
        assert relative(sums, wanted[0]) < most and (sums[-2:] == 0).all()
        assert updated is None if not update else relative(updated, wanted[1]) < most
    assert all(relative(a, b) < most for a, b in zip(found[1][2], wanted[2], strict=True))
    assert torch.equal(found[0][0], found[1][0])


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("update", [True, False])
@pytest.mark.parametrize(("latent", "layers"), [(32, 1), (64, 3), (128, 2)])
@pytest.mark.parametrize("dtype", PRECISIONS)
def test_gradients_equal_autograd(dtype, latent, layers, update, threads, monkeypatch):
    """As near to float64 as the plain operations of the same precision are. Without ``update`` nobody asks for e + m, and there is no gradient
    of it."""
    if not supported(dtype):
        pytest.skip("this processor does not multiply bfloat16")
    monkeypatch.setattr(tiles, "SHARE", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    graph, table, edges, first, rest = case(dtype, latent, layers)
    generator = torch.Generator().manual_seed(2)
    weight = torch.randn(graph.particles, latent, generator=generator), torch.randn(graph.edges, latent, generator=generator).to(dtype)

    def gradients(dtype, inputs):
        inputs = [values.detach().requires_grad_() for values in inputs]
        sums, updated = gns._EdgeUpdate.apply(graph, dtype, True, *inputs)
        if not update:
            return torch.autograd.grad(sums, inputs, weight[0].to(sums.dtype))
        return torch.autograd.grad([sums, updated], inputs, [weight[0].to(sums.dtype), weight[1].to(updated.dtype, copy=True)])

    found = gradients(dtype, [table, edges, first, *rest])
    plainly(monkeypatch)
    wanted = gradients(torch.float64, [values.double() for values in (table, edges, first, *rest)])
    errors = [relative(a, b) for a, b in zip(found, wanted, strict=True)]
    plain = [relative(a, b) for a, b in zip(gradients(dtype, [table, edges, first, *rest]), wanted, strict=True)]
    assert max(errors) < 1.5 * max(plain), (errors, plain)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("widths", [(4,), (30,), (37,), (64, 64), (3, 128)])
def test_rows_of_features(dtype, widths):
    if not supported(dtype):
        pytest.skip("this processor does not multiply bfloat16")
    torch.manual_seed(0)
    module = gns.MLP(sum(widths), 64, 2, 64)
    inputs = [torch.randn(101, width) for width in widths]
    wanted = module.double()(torch.cat(inputs, 1).double(), torch.float64)
    module.float()
    with torch.inference_mode():
        assert module.tiled(dtype)
        base = torch.randn(101, 64)
        found = module.tiles(inputs, dtype, torch.empty(101, 64))
        added = module.tiles(inputs, dtype, base.clone(), residual=True)
        narrow = module.tiles(inputs, dtype, torch.empty(101, 64, dtype=dtype))
        others = [module(torch.cat(inputs, 1).to(given), dtype) for given in (torch.float64, torch.bfloat16)]
    most = 1e-6 if dtype == torch.float32 else 1e-2
    assert relative(found, wanted) < most and relative(narrow, wanted) < most
    assert (added - base - found).abs().max() < 1e-6
    # Inputs of any type; the result has the parameters'.
    assert all(other.dtype == torch.float32 and relative(other, wanted) < 2e-2 for other in others)


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_sums_do_not_depend_on_threads_or_company(dtype, monkeypatch):
    """Bitwise: the order of a receiver's sum is that of its edges, wherever its tile begins."""
    if not supported(dtype):
        pytest.skip("this processor does not multiply bfloat16")
    monkeypatch.setattr(tiles, "SHARE", 1)
    graph, table, edges, first, rest = case(dtype)
    one = tiles.edge_pass(graph, table, edges.clone(), first, rest, NORM, True, True)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    assert len(tiles._shares(graph)) == 7
    seven = tiles.edge_pass(graph, table, edges.clone(), first, rest, NORM, True, True)
    assert all(torch.equal(a, b) for a, b in zip((*one[:2], *one[2]), (*seven[:2], *seven[2]), strict=True))

    other = graph_of(31, seed=5)
    joined = Graph(
        torch.cat([other.sender, graph.sender + 31]), torch.cat([other.receiver, graph.receiver + 31]),
        torch.cat([other.offsets, graph.offsets[1:] + other.edges]),
    )  # fmt: skip
    tables, many = torch.cat([torch.randn(31, 2, 32).to(dtype), table]), torch.cat([torch.randn(other.edges, 32).to(dtype), edges])
    sums, updated, _ = tiles.edge_pass(joined, tables, many, first, rest, NORM, True, False)
    assert torch.equal(sums[31:], one[0]) and torch.equal(updated[other.edges :], one[1])


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_what_is_not_a_number_stays_visible(dtype):
    """One NaN reaches its own receiver and no other: ReLU by comparison would hide it."""
    if not supported(dtype):
        pytest.skip("this processor does not multiply bfloat16")
    graph, table, edges, first, rest = case(dtype)
    edges[3, 5] = torch.nan
    sums, updated, _ = tiles.edge_pass(graph, table, edges, first, rest, NORM, True, False)
    broken = torch.zeros(graph.particles, dtype=torch.bool)
    broken[graph.receiver[3]] = True
    assert torch.equal(sums.isnan().any(1), broken) and updated.isnan().any(1).nonzero().flatten().tolist() == [3]


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("width", [36, 37])
def test_what_is_not_a_number_stays_in_its_row(dtype, width):
    """Also where a width is odd, and pairs of bfloat16 are filled up."""
    if not supported(dtype):
        pytest.skip("this processor does not multiply bfloat16")
    module, inputs = gns.MLP(width, 64, 2, 64), torch.randn(150, width)
    inputs[3, 5] = torch.nan
    with torch.inference_mode():
        assert module(inputs, dtype).isnan().any(1).nonzero().flatten().tolist() == [3]


def test_graph_without_edges():
    empty = torch.zeros(0, dtype=torch.int32)
    graph = Graph(empty, empty, torch.zeros(4, dtype=torch.int32))
    _, _, _, first, rest = case(torch.float32)
    found = tiles.edge_pass(graph, torch.randn(3, 2, 32), torch.zeros(0, 32), first, rest, NORM, True, True)
    assert (found[0] == 0).all() and found[0].shape == (3, 32) and found[1].shape == (0, 32)


def test_what_is_taken():
    weight = torch.zeros(1)
    assert tiles.supports(128, 2, torch.float32, weight) and tiles.supports(32, tiles.MOST, torch.float32, weight)
    assert not tiles.supports(128, 2, torch.float64, weight) and not tiles.supports(128, 2, torch.float32, weight.double())
    assert not tiles.supports(100, 2, torch.float32, weight) and not tiles.supports(1024, 2, torch.float32, weight)
    assert not tiles.supports(128, tiles.MOST + 1, torch.float32, weight) and not tiles.supports(128, 0, torch.float32, weight)
    with torch.inference_mode():
        assert gns.MLP(8, 64, 2, 64).tiled(torch.float32) and not gns.MLP(8, 32, 2, 64).tiled(torch.float32)
        assert not gns.MLP(8, 64, 2, 64, norm=False).tiled(torch.float32)
    with pytest.raises(ValueError, match="in one piece"):
        tiles._pointer(torch.zeros(4, 4).t())


def program(folder: Path, code: str, **environment: str) -> subprocess.CompletedProcess:
    """Python in a process of its own, with this module's sources copied to ``folder``: nothing is built there yet."""
    (folder / "learn").mkdir()
    for name in ("tiles.py", "tiles.cpp"):
        (folder / "learn" / name).write_bytes((tiles.SOURCE.parent / name).read_bytes())
    (folder / "learn" / "graph.py").write_text("class Graph: ...")
    (folder / "learn" / "__init__.py").touch()  # a package like the checkout's, so that the first of the two is it
    whole = "import warnings, torch; from pathlib import Path; from learn import tiles; warnings.simplefilter('always')\n" + code
    return subprocess.run([sys.executable, "-c", whole], cwd=folder, env=os.environ | environment, capture_output=True, text=True, check=False)


BUILD = "print(tiles.build() is not None, *sorted(p.suffix for p in Path('.kernel_cache').glob('*')))"


def test_without_a_compiler(tmp_path):
    found = program(tmp_path, BUILD, PATH=str(tmp_path), CXX="")
    assert found.stdout.split() == ["False"] and "no C++ compiler" in found.stderr


def test_with_a_compiler_that_fails(tmp_path):
    broken = tmp_path / "broken"
    broken.write_text("#!/bin/sh\n[ \"$1\" = --version ] || { echo 'no room' >&2; exit 1; }\n")
    broken.chmod(0o755)
    found = program(tmp_path, BUILD, CXX=str(broken))
    assert found.stdout.split() == ["False"] and "did not build tiles.cpp (no room)" in found.stderr
    assert not list((tmp_path / ".kernel_cache").iterdir())  # nothing half-written


@pytest.mark.parametrize("found", [b"", None])
def test_with_a_compiler_that_cannot_be_run(tmp_path, found):
    """A program that is none, and one that is not there: the one that was asked for is not replaced by another in silence."""
    named = tmp_path / "compiler"
    if found is not None:
        named.write_bytes(found)
        named.chmod(0o755)
        named.write_bytes(b"\x7fnone")
    done = program(tmp_path, BUILD, CXX=f"{named} -v")
    assert done.stdout.split()[0] == "False" and f"{named} -v did not build tiles.cpp" in done.stderr and "Traceback" not in done.stderr


def test_where_nothing_can_be_kept(tmp_path):
    """Beside an installation of another user's: built for the process alone."""
    code = "import os; may = os.access; os.access = lambda place, *how: Path(place).name != '.kernel_cache' and may(place, *how)\n" + BUILD
    done = program(tmp_path, code)
    assert done.stdout.split() == ["True"] and not done.stderr, done.stderr


def test_narrower_vectors_give_the_same(tmp_path):
    """The other branch of the source: eight lanes, as a processor without AVX-512 gets."""
    code = """
tiles.FLAGS = ("-O3", "-march=x86-64-v3", "-std=gnu++17", "-shared", "-fPIC")
import sys; sys.path.insert(0, "."); library = tiles.build()
x, out = torch.randn(101, 48), torch.zeros(101, 48)
linears = [torch.nn.Linear(48, 48) for _ in range(3)]
given = [(l.weight.detach(), l.bias.detach()) for l in linears]
tiles.mlp([x], given, (torch.ones(48), torch.zeros(48), 1e-5), torch.float32, out)
y = x.double()
for k, l in enumerate(linears): y = torch.nn.functional.linear(y.relu() if k else y, l.weight.double(), l.bias.double())
wanted = torch.nn.functional.layer_norm(y, (48,))
print(library.width(), library.multiplies_bf16(), bool((out - wanted).norm() / wanted.norm() < 1e-6))
"""
    if "avx2" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("this processor has no AVX2")
    found = program(tmp_path, code)
    assert found.stdout.split() == ["16", "0", "True"], found.stderr


def test_a_library_is_kept(tmp_path):
    code = BUILD + "\nprint(*[p.stat().st_mtime_ns for p in Path('.kernel_cache').glob('*')])"
    found = program(tmp_path, code)
    again = subprocess.run([sys.executable, "-c", "from pathlib import Path; from learn import tiles\n" + code],
                           cwd=tmp_path, capture_output=True, text=True, check=True)  # fmt: skip
    assert found.stdout.split()[:2] == ["True", ".so"] and found.stdout == again.stdout


def test_a_model_runs_without_them(monkeypatch):
    """The same model, the plain way: what a machine without a compiler does."""
    torch.manual_seed(0)
    block = gns.Interaction(64, 2, True)
    graph = graph_of(60)
    nodes, edges = torch.randn(60, 64), torch.randn(graph.edges, 64)
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("error")
        found = block(nodes.clone(), edges.clone(), graph, torch.float32)
        plainly(monkeypatch)
        wanted = block(nodes.clone(), edges.clone(), graph, torch.float32)
    assert relative(found[0], wanted[0]) < 1e-6 and relative(found[1], wanted[1]) < 1e-6
