"""Tiles of rows through a whole MLP on the CPU: what builds and calls ``tiles.cpp``.

In separate operations every layer of every edge is written and read back, through a cache at best, and a layer's own arithmetic waits for it. Here
48 rows at a time go through all layers, the LayerNorm and the sums in the first-level cache, and the products run at what the processor's
units can do (``benchmarks/gns.py``).

Decisions: plain C++ behind a C interface, built by the compiler that is there in a few seconds and kept in ``.kernel_cache`` by its source,
compiler and processor (PyTorch's own headers would take half a minute); without a compiler, or where it fails, ``build`` says so once and the
GNS goes the plain way. Vectors are the compiler's, so that the float32 kernels serve any processor; bfloat16 needs AVX-512 BF16. Threads are
those of the OpenMP that PyTorch has loaded (others would fight its own for the cores, which wait by spinning), each with its own receivers, so
that sums have one order whatever the number of threads; gradients of weights are summed by thread, and differ in their last digits between
numbers of threads.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from learn.graph import Graph

SOURCE = Path(__file__).with_name("tiles.cpp")
FLAGS = ("-O3", "-march=native", "-std=gnu++17", "-fopenmp", "-shared", "-fPIC")
#: Layers after the first that a kernel has room for (``MOST`` in the source).
MOST = 8
#: Widest latent: beyond, a tile does not fit in the caches it was made for.
WIDEST = 512
#: Rows below which a second thread costs more than it does.
SHARE = 256

_Pointers = ctypes.c_void_p * MOST


class _Forward(ctypes.Structure):
    _fields_ = [
        ("first", ctypes.c_int64), ("last", ctypes.c_int64), ("latent", ctypes.c_int64), ("layers", ctypes.c_int64), ("inputs", ctypes.c_void_p * 2),
        ("widths", ctypes.c_int64 * 2), ("edges", ctypes.c_void_p), ("updated", ctypes.c_void_p), ("table", ctypes.c_void_p),
        ("receiver", ctypes.c_void_p), ("sender", ctypes.c_void_p), ("weight", ctypes.c_void_p), ("stride", ctypes.c_int64),
        ("bias", ctypes.c_void_p), ("weights", _Pointers), ("biases", _Pointers), ("gamma", ctypes.c_void_p), ("beta", ctypes.c_void_p),
        ("epsilon", ctypes.c_float), ("sums", ctypes.c_void_p), ("from_", ctypes.c_int64), ("to", ctypes.c_int64), ("nodes", ctypes.c_void_p),
        ("residual", ctypes.c_int64), ("hidden", _Pointers), ("z", ctypes.c_void_p), ("mean", ctypes.c_void_p), ("rstd", ctypes.c_void_p),
    ]  # fmt: skip


class _Backward(ctypes.Structure):
    _fields_ = [
        ("first", ctypes.c_int64), ("last", ctypes.c_int64), ("latent", ctypes.c_int64), ("layers", ctypes.c_int64), ("edges", ctypes.c_void_p),
        ("hidden", _Pointers), ("z", ctypes.c_void_p), ("mean", ctypes.c_void_p), ("rstd", ctypes.c_void_p), ("gamma", ctypes.c_void_p),
        ("weight", ctypes.c_void_p), ("stride", ctypes.c_int64), ("weights", _Pointers), ("receiver", ctypes.c_void_p),
        ("grad_sums", ctypes.c_void_p), ("grad_edges", ctypes.c_void_p), ("grad_input", ctypes.c_void_p), ("grad_table", ctypes.c_void_p),
        ("from_", ctypes.c_int64), ("to", ctypes.c_int64), ("grad_weight", ctypes.c_void_p), ("grad_weights", _Pointers), ("grad_biases", _Pointers),
        ("grad_gamma", ctypes.c_void_p), ("grad_beta", ctypes.c_void_p),
    ]  # fmt: skip


@cache
def build() -> ctypes.CDLL | None:
    """The kernels, from ``.kernel_cache`` or compiled into it; None, with a warning, where that cannot be done."""
    compiler = shlex.split(os.environ.get("CXX", "")) or [name for name in ("c++", "g++", "clang++") if shutil.which(name)][:1]
    if not compiler:
        warnings.warn("no C++ compiler (c++, g++, clang++, or CXX in the environment): a GNS goes the slower way on this CPU", stacklevel=2)
        return None
    try:
        version = subprocess.run([*compiler, "--version"], capture_output=True, check=True, text=True).stdout.encode()
        key = hashlib.sha256(b"\0".join([SOURCE.read_bytes(), " ".join(FLAGS).encode(), version, _processor()])).hexdigest()[:16]
        place = SOURCE.parent.parent / ".kernel_cache"
        library = place / f"tiles-{key}.so"
        if library.exists():
            return _declared(ctypes.CDLL(str(library)))
        with contextlib.suppress(OSError):
            place.mkdir(exist_ok=True)
        kept = os.access(place, os.W_OK)  # an installation may be another user's: then every process builds its own
        with tempfile.TemporaryDirectory(dir=place if kept else None) as scratch:
            made = Path(scratch) / "tiles.so"
            subprocess.run([*compiler, *FLAGS, str(SOURCE), "-o", str(made)], capture_output=True, check=True, text=True)
            if kept:
                made = made.replace(library)  # whoever builds at the same time builds the same
            return _declared(ctypes.CDLL(str(made)))
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        why = reason[0] if reason else error
        warnings.warn(f"{' '.join(compiler)} did not build {SOURCE.name} ({why}): a GNS goes the slower way on this CPU", stacklevel=2)
        return None


def _processor() -> bytes:
    """What ``-march=native`` depends on: a home folder may be shared by unlike machines."""
    try:
        return next(line for line in Path("/proc/cpuinfo").read_bytes().splitlines() if line.startswith((b"flags", b"Features")))
    except (OSError, StopIteration):
        return platform.processor().encode()


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    for name, structure in (("forward", _Forward), ("backward", _Backward)):
        for dtype in ("f32", "bf16"):
            function = getattr(library, f"{name}_{dtype}")
            function.argtypes, function.restype = [ctypes.POINTER(structure), ctypes.c_int64], None
    for name in ("width", "multiplies_bf16"):
        getattr(library, name).restype = ctypes.c_int64
    return library


def supports(latent: int, layers: int, dtype: torch.dtype, weight: Tensor) -> bool:
    """Whether the kernels take an MLP of this width, with so many layers after the first, products in ``dtype``, this weight [outputs, inputs]."""
    if weight.device.type != "cpu" or weight.dtype != torch.float32 or dtype not in (torch.float32, torch.bfloat16):
        return False
    if not 1 <= layers <= MOST or latent > WIDEST or (library := build()) is None:
        return False
    return latent % library.width() == 0 and (dtype == torch.float32 or bool(library.multiplies_bf16()))


def _run(name: str, dtype: torch.dtype, calls: Sequence[ctypes.Structure]) -> None:
    """One kernel with every call's arguments, each on its own thread."""
    function = getattr(build(), f"{name}_{'f32' if dtype == torch.float32 else 'bf16'}")
    function((type(calls[0]) * len(calls))(*calls), len(calls))


def _pointer(tensor: Tensor | None) -> int | None:
    if tensor is None:
        return None
    if not tensor.is_contiguous():
        raise ValueError(f"a tensor of shape {list(tensor.shape)} and strides {tensor.stride()}: it must lie in one piece")
    return tensor.data_ptr()


def _pointers(tensors: list[Tensor]) -> ctypes.Array:
    return _Pointers(*map(_pointer, tensors))


def _shares(graph: Graph) -> list[tuple[int, int, int, int]]:
    """Receivers from, to, and their edges from, to, for every thread: about equally many edges each."""
    count = min(torch.get_num_threads(), max(graph.edges // SHARE, 1))
    if count == 1:
        return [(0, graph.particles, 0, graph.edges)]
    offsets = graph.offsets.numpy()
    cuts = [0, *(int(offsets.searchsorted(graph.edges * part // count)) for part in range(1, count)), graph.particles]
    return [(a, b, int(offsets[a]), int(offsets[b])) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]


def edge_pass(
    graph: Graph, table: Tensor, edges: Tensor, first: Tensor, rest: Sequence[Tensor], epsilon: float, update: bool, keep: bool
) -> tuple[Tensor, Tensor | None, tuple[Tensor, ...]]:
    """``learn.gns._edge_pass``: the same arguments and results, edges [edges, latent], ``dtype`` being that of ``edges``."""
    *layers, gamma, beta = rest
    receiver, sender = graph.receiver.int(), graph.sender.int()
    latent, count, dtype = len(gamma), len(layers) // 2, edges.dtype
    sums = gamma.new_empty(graph.particles, latent)
    updated = None if not update else torch.empty_like(edges) if keep else edges
    hidden = [torch.empty_like(edges) for _ in range(count)] if keep else []
    z, mean, rstd = (torch.empty_like(edges), *gamma.new_empty(2, len(edges), 1)) if keep else (None, None, None)
    calls = []
    for low, high, begin, end in _shares(graph):
        calls.append(_Forward(
            first=begin, last=end, latent=latent, layers=count, edges=_pointer(edges), updated=_pointer(updated), table=_pointer(table),
            receiver=_pointer(receiver), sender=_pointer(sender), weight=first.data_ptr(), stride=first.stride(0),
            weights=_pointers(layers[::2]), biases=_pointers(layers[1::2]), gamma=_pointer(gamma), beta=_pointer(beta), epsilon=epsilon,
            sums=_pointer(sums), from_=low, to=high, hidden=_pointers(hidden), z=_pointer(z), mean=_pointer(mean), rstd=_pointer(rstd),
        ))  # fmt: skip
    _run("forward", dtype, calls)
    return sums, updated, (*hidden, z, mean, rstd)


def edge_gradient(
    graph: Graph, edges: Tensor, first: Tensor, rest: list[Tensor], kept: list[Tensor], grad_sums: Tensor, grad_edges: Tensor
) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    """Gradients of ``edge_pass``: of table (receivers' part; the senders' is not filled), of every edge's first sum, of first, of rest.

    grad_sums [particles, latent] float32; grad_edges [edges, latent]: of e + m, becomes that of e in place.
    """
    *layers, gamma, _ = rest
    *hidden, z, mean, rstd = kept
    weights, receiver = layers[::2], graph.receiver.int()
    latent, count, dtype = len(gamma), len(weights), edges.dtype
    grad_table, grad_input, grad_sums = edges.new_empty(graph.particles, 2, latent), torch.empty_like(edges), grad_sums.contiguous()
    shares = _shares(graph)
    found = [gamma.new_zeros(latent * (latent * (count + 1) + count + 2)) for _ in shares]
    sizes = [latent * latent] * (count + 1) + [latent] * (count + 2)
    calls = []
    for (low, high, begin, end), gradients in zip(shares, found, strict=True):
        parts = gradients.split(sizes)
        calls.append(_Backward(
            first=begin, last=end, latent=latent, layers=count, edges=_pointer(edges), hidden=_pointers(hidden), z=_pointer(z),
            mean=_pointer(mean), rstd=_pointer(rstd), gamma=_pointer(gamma), weight=first.data_ptr(), stride=first.stride(0),
            weights=_pointers(weights), receiver=_pointer(receiver), grad_sums=_pointer(grad_sums), grad_edges=_pointer(grad_edges),
            grad_input=_pointer(grad_input), grad_table=_pointer(grad_table), from_=low, to=high, grad_weight=_pointer(parts[0]),
            grad_weights=_pointers(parts[1 : count + 1]), grad_biases=_pointers(parts[count + 1 : 2 * count + 1]),
            grad_gamma=_pointer(parts[-2]), grad_beta=_pointer(parts[-1]),
        ))  # fmt: skip
    _run("backward", dtype, calls)
    grad_first, *others = sum(found[1:], found[0]).split(sizes)
    pairs = zip(others[:count], others[count : 2 * count], strict=True)
    layers = [part for weight, bias in pairs for part in (weight.view(latent, latent), bias)]
    return grad_table, grad_input, grad_first.view(latent, latent), [*layers, *others[-2:]]


def mlp(
    inputs: list[Tensor],
    linears: list[tuple[Tensor, Tensor]],
    norm: tuple[Tensor, Tensor, float],
    dtype: torch.dtype,
    out: Tensor,
    residual: bool = False,
) -> Tensor:
    """LayerNorm(MLP[inputs]), products in ``dtype``, for every row, into ``out`` or, with ``residual``, added to it; no gradient.

    inputs: one or two of [rows, width], side by side; linears: weight, bias of every layer; norm: gamma, beta, epsilon; out [rows, latent],
    float32 or, without ``residual``, ``dtype``.
    """
    inputs = [values.float().contiguous() for values in inputs]
    (first, bias), *rest = linears
    rows, wide = len(out), out.dtype == torch.float32
    widths = [values.shape[1] for values in inputs]
    threads = min(torch.get_num_threads(), max(rows // SHARE, 1))
    cuts = [rows * part // threads for part in range(threads + 1)]
    calls = [
        _Forward(
            first=begin, last=end, latent=out.shape[1], layers=len(rest), inputs=(ctypes.c_void_p * 2)(*map(_pointer, inputs)),
            widths=(ctypes.c_int64 * 2)(*widths), updated=None if wide else _pointer(out), nodes=_pointer(out) if wide else None,
            weight=first.data_ptr(), stride=first.stride(0), bias=_pointer(bias), weights=_pointers([weight for weight, _ in rest]),
            biases=_pointers([bias for _, bias in rest]), gamma=_pointer(norm[0]), beta=_pointer(norm[1]), epsilon=norm[2], residual=int(residual),
        )
        for begin, end in zip(cuts[:-1], cuts[1:], strict=True)
    ]  # fmt: skip
    _run("forward", dtype, calls)
    return out
