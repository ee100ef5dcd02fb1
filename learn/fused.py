"""GNS on a CUDA device: a search on the device, and Triton kernels that take a tile of edges through a whole MLP.

A GNS in separate operations writes every layer of every edge to memory and reads it back, a few dozen passes over edges x latent a block. Here
a program loads a tile of edges once, gathers what their particles contribute, goes through three layers and the LayerNorm in registers,
and writes the new edges and the messages: three passes. Backward does the layers again instead of keeping them. Messages are summed along
each receiver's run of edges, without atomics, so that a step is the same step every time.

Shapes are those of a capacity, never of the number of edges: what exceeds it is counted, and nobody but whoever reads that count waits
for the device, so a step can be a CUDA graph (``learn.replay``).

Decisions: products and edge latents in the network's precision (float32 as three TF32 products, which rounds like float32); sums, LayerNorm and
particle latents float32, as on the CPU. Weight gradients are batched products of stored tiles: kept in registers they would leave no room
for the layers. Particles are not sorted by place: their table of contributions fits in the cache that all programs share.
``TRITON_INTERPRET=1`` runs the kernels on a CPU, which is how they are tested.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor, nn
from torch.nn import functional as F
from triton.tools.tensor_descriptor import TensorDescriptor

if TYPE_CHECKING:
    from learn.gns import MLP, Network

#: Edges a program takes, and its warps; in backward it holds more of each edge.
TILE, WARPS = 128, 8
BACKWARD_TILE, BACKWARD_WARPS = 32, 8
#: Particles a program takes: few, so that a few thousand keep all processors busy.
NODE_TILE, NODE_WARPS = 32, 8
#: The capacity is a multiple of the tiles and of the parts that a weight's gradient is summed in.
PARTS = 64
#: Most cells along an axis of the search, by dimension: beyond, cells are larger than the radius.
MOST_CELLS = {2: 1024, 3: 128}
#: Latent widths the kernels are made for.
LATENTS = (16, 32, 64, 128)


# -- graphs -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PaddedGraph:
    """``learn.graph.Graph`` with room for ``capacity`` edges, all on the device; senders of one receiver are in no order.

    sender, receiver [capacity] int32 (0 beyond the last edge); offsets [particles + 1] int32, none above the capacity; found [] int64:
    the number of edges there should be.
    """

    sender: Tensor
    receiver: Tensor
    offsets: Tensor
    found: Tensor

    @property
    def edges(self) -> int:
        return len(self.sender)

    @property
    def particles(self) -> int:
        return len(self.offsets) - 1

    @cached_property
    def count(self) -> Tensor:
        """[1] int32: edges that are there."""
        return self.offsets[-1:]

    @cached_property
    def reverse(self) -> Tensor:
        """[capacity] int32: as in ``Graph``."""
        found = torch.zeros_like(self.sender)
        block = 64
        _reverse_kernel[(triton.cdiv(self.edges, block),)](self.sender, self.receiver, self.offsets, self.count, found, BLOCK=block, CHUNK=16)
        return found


@triton.jit
def _reverse_kernel(sender, receiver, offsets, count, found, BLOCK: tl.constexpr, CHUNK: tl.constexpr):
    edge = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    total = tl.load(count)
    live = edge < total
    own = tl.load(receiver + edge, mask=live, other=-1)
    other = tl.load(sender + edge, mask=live, other=0)
    first = tl.load(offsets + other, mask=live, other=0)
    last = tl.load(offsets + other + 1, mask=live, other=0)
    result = tl.zeros([BLOCK], tl.int32)
    step = tl.arange(0, CHUNK)
    for at in range(0, tl.max(last - first, 0), CHUNK):
        place = first[:, None] + at + step[None, :]
        valid = place < last[:, None]
        hit = (tl.load(sender + place, mask=valid, other=-2) == own[:, None]) & valid
        result += tl.sum(tl.where(hit, place, 0), 1)
    tl.store(found + edge, result, mask=live)


@triton.jit(do_not_specialize=["capacity"])
def _neighbours_kernel(position, cell, order, starts, particles, offsets, sender, receiver, counts, limit, capacity,
                       SHAPE_X: tl.constexpr, SHAPE_Y: tl.constexpr, SHAPE_Z: tl.constexpr, DIM: tl.constexpr, CHUNK: tl.constexpr,
                       SELF: tl.constexpr, WRITE: tl.constexpr):  # fmt: skip
    # A program per receiver. Cells are numbered with the last axis fastest, so three neighbours along it are one run of sorted particles.
    i = tl.program_id(0)
    total = 0
    if i < tl.load(particles):
        own = tl.load(cell + i)
        cells: tl.constexpr = SHAPE_X * SHAPE_Y * SHAPE_Z
        within = (own % cells).to(tl.int32)
        if DIM == 3:
            x, y, z = within // (SHAPE_Y * SHAPE_Z), (within // SHAPE_Z) % SHAPE_Y, within % SHAPE_Z
        else:
            x, y, z = within * 0, within // SHAPE_Z, within % SHAPE_Z
        base = own - within
        low, high = tl.maximum(z - 1, 0), tl.minimum(z + 1, SHAPE_Z - 1)
        px = tl.load(position + i * DIM)
        py = tl.load(position + i * DIM + 1)
        if DIM == 3:
            pz = tl.load(position + i * DIM + 2)
        write = 0
        if WRITE:
            write = tl.load(offsets + i)
        lane, radius_squared = tl.arange(0, CHUNK), tl.load(limit)
        for row in range(3 ** (DIM - 1)):
            xx, yy = x + (row // 3) - 1 if DIM == 3 else x, y + (row % 3) - 1
            if (xx >= 0) & (xx < SHAPE_X) & (yy >= 0) & (yy < SHAPE_Y):
                line = base + (xx * SHAPE_Y + yy) * SHAPE_Z
                first, last = tl.load(starts + line + low), tl.load(starts + line + high + 1)
                for at in range(first, last, CHUNK):
                    valid = at + lane < last
                    j = tl.load(order + at + lane, mask=valid, other=0)
                    dx = tl.load(position + j * DIM, mask=valid, other=0.0) - px
                    dy = tl.load(position + j * DIM + 1, mask=valid, other=0.0) - py
                    square = dx * dx + dy * dy
                    if DIM == 3:
                        dz = tl.load(position + j * DIM + 2, mask=valid, other=0.0) - pz
                        square += dz * dz
                    near = valid & (square <= radius_squared)
                    if not SELF:
                        near = near & (j != i)
                    ones = near.to(tl.int32)
                    if WRITE:
                        place = write + total + tl.cumsum(ones, 0) - 1
                        kept = near & (place < capacity)
                        tl.store(sender + place, j.to(tl.int32), mask=kept)
                        tl.store(receiver + place, (j * 0 + i).to(tl.int32), mask=kept)
                    total += tl.sum(ones, 0)
    if not WRITE:
        tl.store(counts + i, total)


class Search:
    """Radius graphs of particles in boxes of one size: ``learn.graph.radius_graph`` on the device.

    bounds [dim, 2], radius: length, no axis periodic; examples: number of boxes; capacity: edges there is room for; ``most``
    [] int64: edges of the largest graph yet, those without room too. Particles out of their box are found like any others; they share its outermost
    cells, so many of them cost time.
    """

    def __init__(self, bounds: np.ndarray, radius: float, examples: int, capacity: int, self_edges: bool, device: torch.device):
        bounds = np.asarray(bounds, float)
        self.self_edges = self_edges
        tile = math.lcm(TILE, BACKWARD_TILE, PARTS)
        self.capacity = -(-capacity // tile) * tile
        self.most = torch.zeros((), dtype=torch.int64, device=device)
        self.dim = len(bounds)
        cells = [int(min(max((b - a) // radius, 1), MOST_CELLS[self.dim])) for a, b in bounds]
        self.shape = (1,) * (3 - self.dim) + tuple(cells)

        def constant(values) -> Tensor:
            return torch.tensor(values, dtype=torch.float64, device=device)

        self.limit = constant([radius**2])  # a kernel takes a number as float32
        self.lower, self.last = constant(bounds[:, 0]), constant([n - 1 for n in cells])
        # A hair larger than the radius divides the box: rounding must not put two particles within it two cells apart.
        self.size = constant([max((b - a) / n, radius) * (1 + 1e-9) for (a, b), n in zip(bounds, cells, strict=True)])
        self.strides = torch.tensor([math.prod(cells[axis + 1 :]) for axis in range(self.dim)], device=device)
        self.cells = math.prod(cells)
        self.lines = torch.arange(examples * self.cells + 1, device=device)

    def __call__(self, position: Tensor, example: Tensor | None, particles: Tensor) -> PaddedGraph:
        """position [rows, dim] of which the first ``particles`` [1] are meant; example [rows] int64: pairs join within one (None: one box)."""
        position = position.detach().double().contiguous()
        place = ((position - self.lower) / self.size).floor().minimum(self.last).clamp(min=0).nan_to_num()
        cell = (place.long() * self.strides).sum(1)
        if example is not None:
            cell = cell + example * self.cells
        rows = torch.arange(len(position), device=position.device)
        # What lies beyond ``particles`` is sorted behind everything, where no run of cells reaches.
        sorting = torch.where(rows < particles, cell, self.lines[-1])
        ordered, order = sorting.sort(stable=True)
        starts = torch.searchsorted(ordered, self.lines, out_int32=True)
        counts = torch.zeros(len(position), dtype=torch.int32, device=position.device)
        offsets = torch.zeros(len(position) + 1, dtype=torch.int64, device=position.device)
        sender, receiver = (torch.zeros(self.capacity, dtype=torch.int32, device=position.device) for _ in range(2))

        def kernel(write: bool) -> None:
            _neighbours_kernel[(len(position),)](
                position, cell, order, starts, particles, offsets, sender, receiver, counts, self.limit, self.capacity,
                *self.shape, DIM=self.dim, CHUNK=32, SELF=self.self_edges, WRITE=write, num_warps=1)

        kernel(False)
        torch.cumsum(counts, 0, out=offsets[1:])
        kernel(True)
        torch.maximum(self.most, offsets[-1], out=self.most)
        return PaddedGraph(sender, receiver, offsets.clamp(max=self.capacity).int(), offsets[-1])


# -- MLPs ---------------------------------------------------------------------------------------------------------------------
# x -> LayerNorm(W2 relu(W1 relu(first) + b1) + b2) with two hidden layers, where first is
#   encoder: W0 x + b0
#   edge: W0 e + table[0, receiver] + table[1, sender] + b0; the result is the message, e + message the new edge
#   node: W0 [sum, v] + b0; the result is added to v


@triton.jit
def _first_layer(x, x2, table, own, other, particles, live, row, j, w0, b0, WIDTH: tl.constexpr, LATENT: tl.constexpr,
                 KIND: tl.constexpr):  # fmt: skip
    k = tl.arange(0, WIDTH)
    value = tl.load(x + row[:, None] * WIDTH + k[None, :], mask=live[:, None], other=0.0)
    h = tl.dot(value.to(w0.dtype), w0.load([0, 0]).T) + tl.load(b0 + j)[None, :]
    if KIND == "node":
        value = tl.load(x2 + row[:, None] * LATENT + k[None, :], mask=live[:, None], other=0.0)
        h = tl.dot(value.to(w0.dtype), w0.load([0, LATENT]).T, h)
    if KIND == "edge":
        h += tl.load(table + own[:, None] * LATENT + j[None, :], mask=live[:, None], other=0.0).to(tl.float32)
        h += tl.load(table + (particles + other)[:, None] * LATENT + j[None, :], mask=live[:, None], other=0.0).to(tl.float32)
    return tl.maximum(h, 0.0)


@triton.jit
def _layer(h, w, b, j):
    return tl.dot(h.to(w.dtype), w.load([0, 0]).T) + tl.load(b + j)[None, :]


@triton.jit(do_not_specialize=["particles", "rows"])
def _forward_kernel(x, x2, table, receiver, sender, count, particles, w0, b0, w1, b1, w2, b2, gamma, beta, out, message, rows, epsilon,
                    WIDTH: tl.constexpr, LATENT: tl.constexpr, BLOCK: tl.constexpr, KIND: tl.constexpr, UPDATE: tl.constexpr):  # fmt: skip
    first = tl.program_id(0) * BLOCK
    total = tl.load(count)
    row, j = first + tl.arange(0, BLOCK), tl.arange(0, LATENT)
    live, there = row < total, row < rows
    at = row[:, None] * LATENT + j[None, :]
    # Rows that are not there become 0: backward multiplies them by 0, which does not make nothing of everything.
    z = tl.zeros([BLOCK, LATENT], tl.float32)
    if first < total:
        own, other = row, row
        if KIND == "edge":
            own = tl.load(receiver + row, mask=live, other=0)
            other = tl.load(sender + row, mask=live, other=0)
        h = _first_layer(x, x2, table, own, other, particles, live, row, j, w0, b0, WIDTH, LATENT, KIND)
        h = tl.maximum(_layer(h, w1, b1, j), 0.0)
        z = _layer(h, w2, b2, j)
        z -= (tl.sum(z, 1) / LATENT)[:, None]
        z *= tl.rsqrt(tl.sum(z * z, 1) / LATENT + epsilon)[:, None]
        z = z * tl.load(gamma + j)[None, :] + tl.load(beta + j)[None, :]
        if KIND == "edge":
            tl.store(message + at, z.to(message.dtype.element_ty), mask=live[:, None])
            if UPDATE:
                z += tl.load(x + at, mask=live[:, None], other=0.0).to(tl.float32)
        if KIND == "node":
            z += tl.load(x2 + at, mask=live[:, None], other=0.0)
        z = tl.where(live[:, None], z, 0.0)
    if UPDATE:
        tl.store(out + at, z.to(out.dtype.element_ty), mask=there[:, None])


@triton.jit(do_not_specialize=["particles", "capacity"])
def _backward_kernel(x, x2, table, receiver, sender, count, particles, w0, b0, w1, b1, w2, b2, gamma, beta, grad_out, grad_sums,
                     grad_x, grad_x2, hidden, grad_hidden, partial, capacity, epsilon, WIDTH: tl.constexpr, LATENT: tl.constexpr,
                     BLOCK: tl.constexpr, KIND: tl.constexpr, UPDATE: tl.constexpr):  # fmt: skip
    # hidden [2, capacity, latent]: after W1 and after W0; grad_hidden [3, ...]: gradients after W2, W1, W0; rows that are not there become 0.
    # partial [programs, 5, latent]: this tile's share of the gradients of gamma, beta, b2, b1, b0.
    program = tl.program_id(0)
    first = program * BLOCK
    total = tl.load(count)
    row, j = first + tl.arange(0, BLOCK), tl.arange(0, LATENT)
    live, there = row < total, row < capacity
    at = row[:, None] * LATENT + j[None, :]
    size = capacity.to(tl.int64) * LATENT
    if first < total:
        own, other = row, row
        if KIND == "edge":
            own = tl.load(receiver + row, mask=live, other=0)
            other = tl.load(sender + row, mask=live, other=0)
        h1 = _first_layer(x, x2, table, own, other, particles, live, row, j, w0, b0, WIDTH, LATENT, KIND)
        h1 = h1.to(hidden.dtype.element_ty)
        tl.store(hidden + size + at, h1, mask=there[:, None])
        h2 = tl.maximum(_layer(h1, w1, b1, j), 0.0).to(hidden.dtype.element_ty)
        tl.store(hidden + at, h2, mask=there[:, None])
        z = _layer(h2, w2, b2, j)
        z -= (tl.sum(z, 1) / LATENT)[:, None]
        scale = tl.rsqrt(tl.sum(z * z, 1) / LATENT + epsilon)
        z *= scale[:, None]
        if KIND == "edge":
            g = tl.load(grad_sums + own[:, None] * LATENT + j[None, :], mask=live[:, None], other=0.0)
            if UPDATE:
                g += tl.load(grad_out + at, mask=live[:, None], other=0.0).to(tl.float32)
        else:
            g = tl.load(grad_out + at, mask=live[:, None], other=0.0).to(tl.float32)
        share = partial + program * 5 * LATENT + j
        tl.store(share, tl.sum(g * z, 0))
        tl.store(share + LATENT, tl.sum(g, 0))
        g *= tl.load(gamma + j)[None, :]
        g = (g - (tl.sum(g, 1) / LATENT)[:, None] - z * (tl.sum(g * z, 1) / LATENT)[:, None]) * scale[:, None]
        tl.store(share + 2 * LATENT, tl.sum(g, 0))
        low = g.to(grad_hidden.dtype.element_ty)
        tl.store(grad_hidden + at, low, mask=there[:, None])
        g = tl.where(h2 > 0, tl.dot(low, w2.load([0, 0])), 0.0)
        tl.store(share + 3 * LATENT, tl.sum(g, 0))
        low = g.to(grad_hidden.dtype.element_ty)
        tl.store(grad_hidden + size + at, low, mask=there[:, None])
        g = tl.where(h1 > 0, tl.dot(low, w1.load([0, 0])), 0.0)
        tl.store(share + 4 * LATENT, tl.sum(g, 0))
        low = g.to(grad_hidden.dtype.element_ty)
        tl.store(grad_hidden + 2 * size + at, low, mask=there[:, None])
        k = tl.arange(0, WIDTH)
        back = tl.dot(low, w0.load([0, 0]))
        if KIND == "edge" and UPDATE:
            back += tl.load(grad_out + at, mask=live[:, None], other=0.0).to(tl.float32)
        tl.store(grad_x + row[:, None] * WIDTH + k[None, :], back.to(grad_x.dtype.element_ty), mask=live[:, None])
        if KIND == "node":
            back = tl.dot(low, w0.load([0, LATENT]))
            back += tl.load(grad_out + at, mask=live[:, None], other=0.0)
            tl.store(grad_x2 + at, back, mask=live[:, None])
    else:
        nothing = tl.zeros([BLOCK, LATENT], tl.float32)
        for part in range(2):
            tl.store(hidden + part * size + at, nothing.to(hidden.dtype.element_ty), mask=there[:, None])
        for part in range(3):
            tl.store(grad_hidden + part * size + at, nothing.to(grad_hidden.dtype.element_ty), mask=there[:, None])
        for part in range(5):
            tl.store(partial + (program * 5 + part) * LATENT + j, tl.zeros([LATENT], tl.float32))


@triton.jit
def _segment_sum_kernel(values, order, offsets, out, LATENT: tl.constexpr, CHUNK: tl.constexpr, ORDERED: tl.constexpr):
    i, j = tl.program_id(0), tl.arange(0, LATENT)
    first, last = tl.load(offsets + i), tl.load(offsets + i + 1)
    total = tl.zeros([LATENT], tl.float32)
    for at in range(first, last, CHUNK):
        row = at + tl.arange(0, CHUNK)
        live = row < last
        if ORDERED:
            row = tl.load(order + row, mask=live, other=0)
        total += tl.sum(tl.load(values + row[:, None] * LATENT + j[None, :], mask=live[:, None], other=0.0).to(tl.float32), 0)
    tl.store(out + i * LATENT + j, total.to(out.dtype.element_ty))


def _segment_sum(values: Tensor, graph: PaddedGraph, out: Tensor, order: Tensor | None = None) -> Tensor:
    """out [particles, latent]: sums of values [capacity, latent] over each particle's edges, taken through ``order``."""
    _segment_sum_kernel[(graph.particles,)](
        values, values if order is None else order, graph.offsets, out, LATENT=values.shape[1], CHUNK=8, ORDERED=order is not None, num_warps=1)
    return out


@dataclass(frozen=True)
class Weights:
    """What the kernels read of an MLP: weights in the precision of products, the rest float32.

    ``first`` [latent, inputs] is read in blocks of ``width`` inputs.
    """

    first: Tensor
    second: Tensor
    third: Tensor
    vectors: tuple[Tensor, ...]  # b0, b1, b2, gamma, beta
    width: int

    def arguments(self) -> tuple:
        b0, b1, b2, gamma, beta = self.vectors
        latent = len(self.second)
        first = TensorDescriptor.from_tensor(self.first, [latent, self.width])
        second, third = (TensorDescriptor.from_tensor(weight, [latent, latent]) for weight in (self.second, self.third))
        return first, b0, second, b1, third, b2, gamma, beta


class Shadow:
    """A network's weights in the precision of its products, one copy for all kernels; ``refresh`` after they have changed."""

    def __init__(self, network: Network):
        self.dtype = torch.bfloat16 if network.low_precision else torch.float32
        mlps = [network.encode_node, network.encode_edge, *(mlp for block in network.processor for mlp in (block.edge, block.node))]
        self._sources, self._copies, self._of = [], [], {}
        for mlp in mlps:
            sources = [linear.weight for linear in mlp.linears]
            first, *others = copies = [torch.empty_like(weight, dtype=self.dtype) for weight in sources]
            width = len(first)
            if mlp in (network.encode_node, network.encode_edge):
                inputs, width = first.shape[1], max(16, triton.next_power_of_2(first.shape[1]))
                first = first.new_zeros(len(first), width)  # zeros for inputs that there are not
                copies[0] = first[:, :inputs]
            self._sources += sources
            self._copies += copies
            vectors = (*(linear.bias for linear in mlp.linears), mlp.norm.weight, mlp.norm.bias)
            self._of[mlp] = Weights(first, *others, vectors, width)

    @torch.no_grad()
    def refresh(self) -> None:
        torch._foreach_copy_(self._copies, self._sources)

    def __getitem__(self, mlp: MLP) -> Weights:
        return self._of[mlp]


def _run_forward(kind: str, weights: Weights, x: Tensor, out: Tensor | None, count: Tensor, *, x2: Tensor | None = None, table: Tensor | None = None,
                 graph: PaddedGraph | None = None, message: Tensor | None = None, update: bool = True) -> None:
    from learn.gns import NORM_EPSILON

    tile, warps = (TILE, WARPS) if kind == "edge" else (NODE_TILE, NODE_WARPS)
    if kind == "encoder" and len(x) % TILE == 0:
        tile, warps = TILE, WARPS
    none = x
    _forward_kernel[(triton.cdiv(len(x), tile),)](
        x, none if x2 is None else x2, none if table is None else table, graph.receiver if kind == "edge" else none,
        graph.sender if kind == "edge" else none, count, graph.particles if kind == "edge" else 0, *weights.arguments(),
        none if out is None else out, none if message is None else message, len(x), NORM_EPSILON,
        WIDTH=x.shape[1], LATENT=len(weights.second), BLOCK=tile, KIND=kind, UPDATE=update, num_warps=warps)


def _run_backward(kind: str, weights: Weights, x: Tensor, count: Tensor, grad_out: Tensor | None, *, x2: Tensor | None = None,
                  table: Tensor | None = None, graph: PaddedGraph | None = None, grad_sums: Tensor | None = None, grad_x_dtype: torch.dtype):
    """(grad_x, grad_x2, gradient after W0 [rows, latent], weight gradients [W1, W2], partial sums of the vectors, W0's share of x)."""
    from learn.gns import NORM_EPSILON

    rows, latent, dtype = len(x), len(weights.second), weights.first.dtype
    large = kind == "edge" or rows % TILE == 0
    tile, warps = (BACKWARD_TILE, BACKWARD_WARPS) if large else (NODE_TILE, NODE_WARPS)
    programs = triton.cdiv(rows, tile)
    grad_x = torch.zeros_like(x, dtype=grad_x_dtype) if kind == "encoder" else torch.empty_like(x, dtype=grad_x_dtype)
    grad_x2 = None if x2 is None else torch.empty_like(x2)
    hidden, grad_hidden = (torch.empty(count_, rows, latent, dtype=dtype, device=x.device) for count_ in (2, 3))
    partial = torch.empty(programs, 5, latent, dtype=torch.float32, device=x.device)
    none = x
    _backward_kernel[(programs,)](
        x, none if x2 is None else x2, none if table is None else table, graph.receiver if kind == "edge" else none,
        graph.sender if kind == "edge" else none, count, graph.particles if kind == "edge" else 0, *weights.arguments(),
        none if grad_out is None else grad_out, none if grad_sums is None else grad_sums, grad_x, none if grad_x2 is None else grad_x2,
        hidden, grad_hidden, partial, rows, NORM_EPSILON,
        WIDTH=x.shape[1], LATENT=latent, BLOCK=tile, KIND=kind, UPDATE=grad_out is not None, num_warps=warps)
    second, first = _outer(grad_hidden[:2], hidden)
    grad_gamma, grad_beta, grad_b2, grad_b1, grad_b0 = partial.sum(0)
    return grad_x, grad_x2, grad_hidden[2], (first, second), (grad_b0, grad_b1, grad_b2, grad_gamma, grad_beta)


def _outer(left: Tensor, right: Tensor) -> Tensor:
    """[n, a, b] float32: left [n, rows, a]^T right [n, rows, b], in parts that are summed in float32: one product of so many rows for so small a
    result keeps few processors busy."""
    n, rows, a = left.shape
    parts = math.gcd(PARTS, rows)
    product = left.reshape(n * parts, rows // parts, a).mT @ right.reshape(n * parts, rows // parts, -1)
    return product.view(n, parts, a, -1).sum(1, dtype=torch.float32)


class _Encoder(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights: Weights, count: Tensor, inputs: int, out_dtype: torch.dtype, x: Tensor, *parameters: Tensor):
        x = F.pad(x, (0, weights.first.shape[1] - inputs)).to(weights.first.dtype)
        out = torch.empty(len(x), len(weights.second), dtype=out_dtype, device=x.device)
        _run_forward("encoder", weights, x, out, count)
        ctx.weights, ctx.inputs = weights, inputs
        ctx.save_for_backward(x, count)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor):
        x, count = ctx.saved_tensors
        grad_x, _, after, (first, second), (b0, b1, b2, gamma, beta) = _run_backward(
            "encoder", ctx.weights, x, count, grad.contiguous(), grad_x_dtype=torch.float32)
        (zeroth,) = _outer(after[None], x[None])
        return None, None, None, None, grad_x[:, : ctx.inputs], zeroth[:, : ctx.inputs], b0, first, b1, second, b2, gamma, beta


class _Block(torch.autograd.Function):
    """One block of message passing; the edges' gradient comes back from the next block alone."""

    @staticmethod
    def forward(ctx, edge: Weights, node: Weights, graph: PaddedGraph, count: Tensor, update: bool, keep: bool, nodes: Tensor, edges: Tensor,
                *parameters: Tensor):
        latent = nodes.shape[1]
        table = torch.bmm(nodes.to(edge.first.dtype).expand(2, -1, -1), _pair(edge, latent).mT)
        message = torch.empty_like(edges)
        updated = torch.empty_like(edges) if update and keep else edges
        _run_forward("edge", edge, edges, updated, graph.count, table=table, graph=graph, message=message, update=update)
        sums = _segment_sum(message, graph, torch.empty_like(nodes))
        following = torch.empty_like(nodes)
        _run_forward("node", node, sums, following, count, x2=nodes)
        ctx.edge, ctx.node, ctx.graph, ctx.update = edge, node, graph, update
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(nodes, edges, table, sums, count)
        return following, updated if update else None

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_nodes: Tensor, grad_edges: Tensor | None):
        nodes, edges, table, sums, count = ctx.saved_tensors
        edge, node, graph, latent = ctx.edge, ctx.node, ctx.graph, nodes.shape[1]
        grad_sums, grad_own, after, (node_first, node_second), node_vectors = _run_backward(
            "node", node, sums, count, grad_nodes.contiguous(), x2=nodes, grad_x_dtype=torch.float32)
        node_zeroth = _outer(after.expand(2, -1, -1), torch.stack([sums, nodes]).to(after.dtype)).transpose(0, 1).reshape(latent, 2 * latent)
        grad_edges, _, after, (edge_first, edge_second), edge_vectors = _run_backward(
            "edge", edge, edges, graph.count, None if grad_edges is None else grad_edges.contiguous(), table=table, graph=graph,
            grad_sums=grad_sums, grad_x_dtype=edges.dtype)
        grad_table = torch.empty_like(table)
        _segment_sum(after, graph, grad_table[0])
        _segment_sum(after, graph, grad_table[1], graph.reverse)
        grad_own += torch.bmm(grad_table, _pair(edge, latent)).sum(0, dtype=torch.float32)
        low = nodes.to(grad_table.dtype)
        edge_zeroth = torch.cat([_outer(after[None], edges[None]), _outer(grad_table, low.expand(2, -1, -1))])
        edge_zeroth = edge_zeroth.transpose(0, 1).reshape(latent, 3 * latent)
        return (None, None, None, None, None, None, grad_own, grad_edges, *_interleave(edge_zeroth, edge_first, edge_second, edge_vectors),
                *_interleave(node_zeroth, node_first, node_second, node_vectors))  # fmt: skip


def _pair(weights: Weights, latent: int) -> Tensor:
    """[2, latent, latent]: the first layer's share of an edge's receiver and of its sender."""
    return weights.first.view(latent, 3, latent)[:, 1:].transpose(0, 1)


def _interleave(zeroth: Tensor, first: Tensor, second: Tensor, vectors: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    b0, b1, b2, gamma, beta = vectors
    return zeroth, b0, first, b1, second, b2, gamma, beta


def _parameters(mlp: MLP) -> list[Tensor]:
    return [p for linear in mlp.linears for p in (linear.weight, linear.bias)] + [mlp.norm.weight, mlp.norm.bias]


def supports(network: Network) -> bool:
    """Whether the kernels are made for networks of this shape: two hidden layers, a width of ``LATENTS``, the relative encoder."""
    latent = network.decode.linears[0].in_features
    return not isinstance(network.encode_edge, nn.Parameter) and len(network.decode.linears) == 3 and latent in LATENTS


def forward(network: Network, nodes: Tensor, edges: Tensor, graph: PaddedGraph) -> Tensor:
    """``Network.forward`` on a ``PaddedGraph``, by the weights in ``network.shadow``."""
    shadow = network.shadow
    keep = torch.is_grad_enabled()
    rows = torch.full((1,), len(nodes), dtype=torch.int32, device=nodes.device)
    dtype = shadow.dtype
    nodes = _Encoder.apply(shadow[network.encode_node], rows, nodes.shape[1], torch.float32, nodes, *_parameters(network.encode_node))
    edges = _Encoder.apply(shadow[network.encode_edge], graph.count, edges.shape[1], dtype, edges, *_parameters(network.encode_edge))
    for _ in range(network.repeats):
        for block in network.processor:
            nodes, updated = _Block.apply(
                shadow[block.edge], shadow[block.node], graph, rows, block.edge_update, keep, nodes, edges,
                *_parameters(block.edge), *_parameters(block.node))
            edges = edges if updated is None else updated
    return network.decode(nodes, dtype)
