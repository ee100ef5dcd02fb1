"""GNS on a CUDA device: a search on the device, and Triton kernels that take a tile of edges through a whole MLP.

A GNS in separate operations writes every layer of every edge to memory and reads it back, a few dozen passes over edges x latent a block. Here
a program loads a tile of edges once, gathers what its particles contribute, goes through three layers and the LayerNorm in registers, and writes
the new edges and the messages. Messages are summed along each receiver's run of edges, without atomics, so that a step is the same step every
time (but for losses over several calls, whose gradient reaches the places of particles by PyTorch's atomic additions).

Shapes are those of a capacity, never of the number of edges: what exceeds it is counted, and nobody but whoever reads that count waits
for the device, so a step can be a CUDA graph (``learn.replay``).

Decisions: products and edge latents in bf16; sums, LayerNorm and particle latents float32, as on the CPU. For training hidden layers are kept: to
make them again costs more than to write and read them. Weight gradients are batched products of kept tiles; in registers they would leave
no room for the layers. Rows travel by tensor descriptors: pointers to a tile's elements would fill half the registers. A program ends
with its tile: programs that stay and hold the weights leave room for one each a processor, and nothing hides its waiting (a third
slower). Particles are not sorted by place: their table of contributions fits in the cache that all programs share.
``TRITON_INTERPRET=1`` runs the kernels on a CPU, which is how they are tested, in float32.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor, nn
from torch.nn import functional as F
from triton.tools.tensor_descriptor import TensorDescriptor

from learn.graph import Graph

if TYPE_CHECKING:
    from learn.gns import MLP, Network

#: Rows a program takes, and its warps: what leaves all layers in registers (of Hopper, at latent 128). Backward's divide forward's. Encoders stay
#: below 64 rows: from there on Triton (3.6) multiplies by warp groups, and does so with an encoder's 16 inputs through addresses that are not
#: always its own (found by compute-sanitizer).
FORWARD = {"encoder": (32, 4), "edge": (64, 4), "node": (32, 8)}
BACKWARD = {"encoder": (32, 4), "edge": (32, 4), "node": (32, 8)}
#: Parts that a weight's gradient is summed in.
PARTS = 32
#: Edges a graph has room for are a multiple of this.
ROOMS = 128
#: Most cells along an axis of the search, by dimension: beyond, cells are larger than the radius.
MOST_CELLS = {2: 1024, 3: 128}
#: Latent widths the kernels are made for.
LATENTS = (16, 32, 64, 128)


# -- graphs -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PaddedGraph(Graph):
    """A ``Graph`` with room for more edges, all on the device; senders of one receiver are in no order.

    ``edges`` is what there is room for: sender, receiver are 0 beyond the last edge; offsets, none above the room; found [particles + 1] int64: what
    they would be with room for all.
    """

    found: Tensor

    @cached_property
    def count(self) -> Tensor:
        """[1] int32: edges that are there."""
        return self.offsets[-1:]

    @cached_property
    def reverse(self) -> Tensor:
        """[edges] int32: as in ``Graph``, whose sorting wants senders in order."""
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
        self.capacity = -(-capacity // ROOMS) * ROOMS
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
                position,
                cell,
                order,
                starts,
                particles,
                offsets,
                sender,
                receiver,
                counts,
                self.limit,
                self.capacity,
                *self.shape,
                DIM=self.dim,
                CHUNK=32,
                SELF=self.self_edges,
                WRITE=write,
                num_warps=1,
            )

        kernel(False)
        torch.cumsum(counts, 0, out=offsets[1:])
        kernel(True)
        torch.maximum(self.most, offsets[-1], out=self.most)
        return PaddedGraph(sender, receiver, offsets.clamp(max=self.capacity).int(), offsets)


# -- MLPs ---------------------------------------------------------------------------------------------------------------------
# x -> LayerNorm(W2 relu(W1 relu(first) + b1) + b2) with two hidden layers, where first is
#   encoder: W0 x + b0
#   edge: W0 e + table[0, receiver] + table[1, sender] + b0; the result is the message, e + message the new edge
#   node: W0 [sum, v] + b0; the result is added to v


@triton.jit(do_not_specialize=["particles", "padded"])
def _forward_kernel(x, x2, table, receiver, sender, count, particles, w0, b0, w1, b1, w2, b2, gamma, beta, out, message, hidden, scales, padded,
                    epsilon, WIDTH: tl.constexpr, LATENT: tl.constexpr, BLOCK: tl.constexpr, KIND: tl.constexpr, UPDATE: tl.constexpr,
                    KEEP: tl.constexpr):  # fmt: skip
    # With KEEP for backward: hidden [3 padded, latent], after the LayerNorm's division, after W1, after W0; scales [padded], what it divided by.
    # Rows that are not there become 0: backward multiplies them by 0, which does not make nothing of everything.
    total, j, first = tl.load(count), tl.arange(0, LATENT), tl.program_id(0) * BLOCK
    row = first + tl.arange(0, BLOCK)
    live = row < total
    z = tl.zeros([BLOCK, LATENT], tl.float32)
    if first < total:
        h = tl.dot(x.load([first, 0]).to(w0.dtype), w0.load([0, 0]).T) + tl.load(b0 + j)[None, :]
        if KIND == "node":
            h = tl.dot(x2.load([first, 0]).to(w0.dtype), w0.load([0, LATENT]).T, h)
        if KIND == "edge":
            to = tl.load(receiver + row, mask=live, other=0)
            come = tl.load(sender + row, mask=live, other=0) + particles
            gathered = tl.load(table + to[:, None] * LATENT + j[None, :]).to(tl.float32)
            h += gathered + tl.load(table + come[:, None] * LATENT + j[None, :]).to(tl.float32)
        low = tl.maximum(h, 0.0).to(w0.dtype)
        if KEEP:
            hidden.store([2 * padded + first, 0], low)
        low = tl.maximum(tl.dot(low, w1.load([0, 0]).T) + tl.load(b1 + j)[None, :], 0.0).to(w0.dtype)
        if KEEP:
            hidden.store([padded + first, 0], low)
        z = tl.dot(low, w2.load([0, 0]).T) + tl.load(b2 + j)[None, :]
        z -= (tl.sum(z, 1) / LATENT)[:, None]
        scale = tl.rsqrt(tl.sum(z * z, 1) / LATENT + epsilon)
        z *= scale[:, None]
        if KEEP:
            hidden.store([first, 0], z.to(w0.dtype))
            tl.store(scales + row, scale)
        z = z * tl.load(gamma + j)[None, :] + tl.load(beta + j)[None, :]
        if KIND == "edge":
            message.store([first, 0], z.to(w0.dtype))
            if UPDATE:
                z += x.load([first, 0]).to(tl.float32)
        if KIND == "node":
            z += x2.load([first, 0])
        z = tl.where(live[:, None], z, 0.0)
    elif KEEP:
        for part in range(3):
            hidden.store([part * padded + first, 0], z.to(w0.dtype))
    if UPDATE:
        out.store([first, 0], z.to(out.dtype))


@triton.jit(do_not_specialize=["padded"])
def _backward_kernel(receiver, count, w0, w1, w2, gamma, hidden, scales, grad_out, grad_sums, grad_x, grad_x2, grad_hidden, partial, padded,
                     WIDTH: tl.constexpr, LATENT: tl.constexpr, BLOCK: tl.constexpr, KIND: tl.constexpr, UPDATE: tl.constexpr):  # fmt: skip
    # grad_hidden [3 padded, latent]: gradients after W2, W1, W0, 0 in rows that are not there.
    # partial [programs, 5, latent]: this tile's share of the gradients of gamma, beta, b2, b1, b0.
    total, j, first = tl.load(count), tl.arange(0, LATENT), tl.program_id(0) * BLOCK
    share = partial + tl.program_id(0) * 5 * LATENT + j
    row = first + tl.arange(0, BLOCK)
    live = row < total
    if first < total:
        z = hidden.load([first, 0]).to(tl.float32)
        if KIND == "edge":
            to = tl.load(receiver + row, mask=live, other=0)
            g = tl.load(grad_sums + to[:, None] * LATENT + j[None, :])
            if UPDATE:
                g += grad_out.load([first, 0]).to(tl.float32)
        else:
            g = grad_out.load([first, 0]).to(tl.float32)
        g = tl.where(live[:, None], g, 0.0)
        tl.store(share, tl.sum(g * z, 0))
        tl.store(share + LATENT, tl.sum(g, 0))
        g *= tl.load(gamma + j)[None, :]
        g = (g - (tl.sum(g, 1) / LATENT)[:, None] - z * (tl.sum(g * z, 1) / LATENT)[:, None]) * tl.load(scales + row)[:, None]
        tl.store(share + 2 * LATENT, tl.sum(g, 0))
        low = g.to(w0.dtype)
        grad_hidden.store([first, 0], low)
        g = tl.where(hidden.load([padded + first, 0]) > 0, tl.dot(low, w2.load([0, 0])), 0.0)
        tl.store(share + 3 * LATENT, tl.sum(g, 0))
        low = g.to(w0.dtype)
        grad_hidden.store([padded + first, 0], low)
        g = tl.where(hidden.load([2 * padded + first, 0]) > 0, tl.dot(low, w1.load([0, 0])), 0.0)
        tl.store(share + 4 * LATENT, tl.sum(g, 0))
        low = g.to(w0.dtype)
        grad_hidden.store([2 * padded + first, 0], low)
        back = tl.dot(low, w0.load([0, 0]))
        if KIND == "edge" and UPDATE:
            back += grad_out.load([first, 0]).to(tl.float32)
        grad_x.store([first, 0], back.to(grad_x.dtype))
        if KIND == "node":
            grad_x2.store([first, 0], tl.dot(low, w0.load([0, LATENT])) + grad_out.load([first, 0]))
    else:
        for part in range(3):
            grad_hidden.store([part * padded + first, 0], tl.zeros([BLOCK, LATENT], w0.dtype))
        for part in range(5):
            tl.store(share + part * LATENT, tl.zeros([LATENT], tl.float32))


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
        at_row = values + row.to(tl.int64)[:, None] * LATENT  # beyond 2^31 numbers in large graphs
        total += tl.sum(tl.load(at_row + j[None, :], mask=live[:, None], other=0.0).to(tl.float32), 0)
    tl.store(out + i * LATENT + j, total.to(out.dtype.element_ty))


def _segment_sum(values: Tensor, graph: PaddedGraph, out: Tensor, order: Tensor | None = None) -> Tensor:
    """out [particles, latent]: sums of values [capacity, latent] over each particle's edges, taken through ``order``."""
    _segment_sum_kernel[(graph.particles,)](
        values, values if order is None else order, graph.offsets, out, LATENT=values.shape[1], CHUNK=8, ORDERED=order is not None, num_warps=1
    )
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
        """As the kernels take them."""
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
            second, third = others
            self._of[mlp] = Weights(first, second, third, vectors, width)

    @torch.no_grad()
    def refresh(self) -> None:
        """Copy the network's weights as they are now."""
        torch._foreach_copy_(self._copies, self._sources)

    def __getitem__(self, mlp: MLP) -> Weights:
        return self._of[mlp]


@dataclass(frozen=True)
class _Kept:
    """What backward needs of an MLP's forward pass; rows in whole tiles."""

    hidden: Tensor  # [3, padded, latent]: normalised, after W1, after W0
    scales: Tensor  # [padded]: 1 / standard deviation


def _tiled(values: Tensor, tile: int) -> TensorDescriptor:
    return TensorDescriptor.from_tensor(values, [tile, values.shape[1]])


def _run_forward(
    kind: str,
    weights: Weights,
    x: Tensor,
    out: Tensor | None,
    count: Tensor,
    *,
    keep: bool,
    x2: Tensor | None = None,
    table: Tensor | None = None,
    graph: Any = None,
    message: Tensor | None = None,
) -> _Kept | None:
    from learn.gns import NORM_EPSILON

    tile, warps = FORWARD[kind]
    latent, tiles, edge = len(weights.second), triton.cdiv(len(x), tile), kind == "edge"
    kept: Any = None
    if keep:
        kept = _Kept(x.new_empty(3, tiles * tile, latent, dtype=weights.first.dtype), x.new_empty(tiles * tile, dtype=torch.float32))
    given, none = _tiled(x, tile), x
    _forward_kernel[(tiles,)](
        given, given if x2 is None else _tiled(x2, tile), table if edge else none, graph.receiver if edge else none, graph.sender if edge else none,
        count, graph.particles if edge else 0, *weights.arguments(), given if out is None else _tiled(out, tile),
        given if message is None else _tiled(message, tile), _tiled(kept.hidden.flatten(0, 1), tile) if keep else given,
        kept.scales if keep else none, tiles * tile, NORM_EPSILON,
        WIDTH=weights.width, LATENT=latent, BLOCK=tile, KIND=kind, UPDATE=out is not None, KEEP=keep, num_warps=warps)  # fmt: skip
    return kept


def _run_backward(
    kind: str,
    weights: Weights,
    x: Tensor,
    kept: _Kept,
    count: Tensor,
    grad_out: Tensor | None,
    grad_x: Tensor,
    *,
    grad_x2: Tensor | None = None,
    graph: Any = None,
    grad_sums: Tensor | None = None,
):
    """Writes grad_x and grad_x2; returns the gradients after W2, W1, W0 [3, rows, latent] and those of [b0, b1, b2, gamma, beta]."""
    tile, warps = BACKWARD[kind]
    (_, padded, latent), rows, edge = kept.hidden.shape, len(x), kind == "edge"
    tiles = padded // tile
    grad_hidden = torch.empty_like(kept.hidden)
    partial = x.new_empty(tiles, 5, latent, dtype=torch.float32)
    first, _, second, _, third, _, gamma, _ = weights.arguments()
    given, none = _tiled(grad_x, tile), x
    _backward_kernel[(tiles,)](
        graph.receiver if edge else none, count, first, second, third, gamma, _tiled(kept.hidden.flatten(0, 1), tile), kept.scales,
        given if grad_out is None else _tiled(grad_out, tile), grad_sums if edge else none, given,
        given if grad_x2 is None else _tiled(grad_x2, tile),
        _tiled(grad_hidden.flatten(0, 1), tile), partial, padded,
        WIDTH=weights.width, LATENT=latent, BLOCK=tile, KIND=kind, UPDATE=grad_out is not None, num_warps=warps)  # fmt: skip
    grad_gamma, grad_beta, grad_b2, grad_b1, grad_b0 = partial.sum(0)
    return grad_hidden[:, :rows], (grad_b0, grad_b1, grad_b2, grad_gamma, grad_beta)


class _Products:
    """Gradients of weights [latent, latent], left [n, rows, latent]^T right [n, rows, latent] each, in parts that are summed in float32 all at
    once: one product of so many rows for so small a result keeps few processors busy."""

    def __init__(self, most: int, like: Tensor, *rows: int):
        self.parts = math.gcd(PARTS, *rows)
        self.values, self.count = like.new_empty(most, self.parts, like.shape[-1], like.shape[-1]), 0

    def add(self, left: Tensor, right: Tensor) -> None:
        n, rows, latent = left.shape
        out = self.values[self.count : self.count + n].view(n * self.parts, latent, latent)
        shape = (n * self.parts, rows // self.parts, latent)
        torch.bmm(left.reshape(shape).mT, right.reshape(shape), out=out)
        self.count += n

    def sums(self) -> Tensor:
        """[n, latent, latent] float32."""
        return self.values[: self.count].sum(1, dtype=torch.float32)


class _Encoder(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights: Weights, count: Tensor, keep: bool, out_dtype: torch.dtype, x: Tensor, *parameters: Tensor):
        inputs = x.shape[1]
        x = F.pad(x, (0, weights.width - inputs)).to(weights.first.dtype)
        out = x.new_empty(len(x), len(weights.second), dtype=out_dtype)
        ctx.kept = _run_forward("encoder", weights, x, out, count, keep=keep)
        ctx.weights, ctx.inputs = weights, inputs
        ctx.save_for_backward(x, count)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor):
        x, count = ctx.saved_tensors
        # The node encoder's is float32, the edge encoder's in the precision of products: one kernel for both.
        grad = grad.to(x.dtype).contiguous()
        grad_x = torch.zeros_like(x, dtype=torch.float32)
        grads, (b0, b1, b2, gamma, beta) = _run_backward("encoder", ctx.weights, x, ctx.kept, count, grad, grad_x)
        products = _Products(2, grads, len(x))
        products.add(grads[:2], ctx.kept.hidden[1:, : len(x)])
        second, first = products.sums()
        parts = x.view(products.parts, -1, x.shape[1])
        zeroth = (grads[2].reshape(products.parts, -1, grads.shape[-1]).mT @ parts).sum(0, dtype=torch.float32)
        return None, None, None, None, grad_x[:, : ctx.inputs], zeroth[:, : ctx.inputs], b0, first, b1, second, b2, gamma, beta


class _Block(torch.autograd.Function):
    """One block of message passing; the edges' gradient comes back from the next block alone."""

    @staticmethod
    def forward(
        ctx,
        edge: Weights,
        node: Weights,
        graph: PaddedGraph,
        count: Tensor,
        update: bool,
        keep: bool,
        nodes: Tensor,
        edges: Tensor,
        *parameters: Tensor,
    ):
        low = nodes.to(edge.first.dtype)
        table = torch.bmm(low.expand(2, -1, -1), _pair(edge).mT)
        message = torch.empty_like(edges)
        updated = None if not update else torch.empty_like(edges) if keep else edges
        kept_edge = _run_forward("edge", edge, edges, updated, graph.count, keep=keep, table=table, graph=graph, message=message)
        sums = _segment_sum(message, graph, torch.empty_like(nodes))
        following = torch.empty_like(nodes)
        kept_node = _run_forward("node", node, sums, following, count, keep=keep, x2=nodes)
        ctx.edge, ctx.node, ctx.graph, ctx.kept = edge, node, graph, (kept_edge, kept_node)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(low, edges, sums, count)
        return following, updated

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_nodes: Tensor, grad_edges: Tensor | None):
        low, edges, sums, count = ctx.saved_tensors
        graph, (kept_edge, kept_node), (rows, latent) = ctx.graph, ctx.kept, low.shape
        grad_sums, grad_own, grad_e = torch.empty_like(sums), torch.empty_like(sums), torch.empty_like(edges)
        node, node_vectors = _run_backward("node", ctx.node, sums, kept_node, count, grad_nodes.contiguous(), grad_sums, grad_x2=grad_own)
        grad_edges = None if grad_edges is None else grad_edges.contiguous()
        edge, edge_vectors = _run_backward("edge", ctx.edge, edges, kept_edge, graph.count, grad_edges, grad_e, graph=graph, grad_sums=grad_sums)
        grad_table = torch.empty_like(low.expand(2, -1, -1), memory_format=torch.contiguous_format)
        _segment_sum(edge[2], graph, grad_table[0])
        _segment_sum(edge[2], graph, grad_table[1], graph.reverse)
        grad_own += torch.bmm(grad_table, _pair(ctx.edge)).sum(0, dtype=torch.float32)

        products = _Products(9, edge, rows, len(edges))
        products.add(edge[2:], edges[None])
        products.add(grad_table, low.expand(2, -1, -1))
        products.add(edge[:2], kept_edge.hidden[1:, : len(edges)])
        products.add(node[2:], sums.to(low.dtype)[None])
        products.add(node[2:], low[None])
        products.add(node[:2], kept_node.hidden[1:, :rows])
        own, *rest = products.sums().split([3, 2, 2, 2])
        edge_weights = own.transpose(0, 1).reshape(latent, 3 * latent), rest[0][1], rest[0][0]
        node_weights = rest[1].transpose(0, 1).reshape(latent, 2 * latent), rest[2][1], rest[2][0]
        return None, None, None, None, None, None, grad_own, grad_e, *_each(edge_weights, edge_vectors), *_each(node_weights, node_vectors)


def _pair(weights: Weights) -> Tensor:
    """[2, latent, latent]: the first layer's share of an edge's receiver and of its sender."""
    return weights.first.view(len(weights.first), 3, -1)[:, 1:].transpose(0, 1)


def _each(weights: tuple[Tensor, ...], vectors: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """In the order of ``_parameters``."""
    b0, b1, b2, gamma, beta = vectors
    zeroth, first, second = weights
    return zeroth, b0, first, b1, second, b2, gamma, beta


def _parameters(mlp: MLP) -> list[Tensor]:
    assert mlp.norm is not None
    return [p for linear in mlp.linears for p in (linear.weight, linear.bias)] + [mlp.norm.weight, mlp.norm.bias]


def supports(network: Network) -> bool:
    """Whether the kernels are made for networks of this shape: two hidden layers, a width of ``LATENTS``, the relative encoder."""
    latent = network.decode.linears[0].in_features
    return not isinstance(network.encode_edge, nn.Parameter) and len(network.decode.linears) == 3 and latent in LATENTS


def forward(network: Network, nodes: Tensor, edges: Tensor, graph: PaddedGraph) -> Tensor:
    """``Network.forward`` on a ``PaddedGraph``, by the weights in ``network.shadow``: [particles, dim]."""
    shadow = network.shadow
    assert shadow is not None
    keep = torch.is_grad_enabled()
    rows = torch.full((1,), len(nodes), dtype=torch.int32, device=nodes.device)
    dtype = shadow.dtype
    nodes = _Encoder.apply(shadow[network.encode_node], rows, keep, torch.float32, nodes, *_parameters(network.encode_node))
    edges = _Encoder.apply(shadow[network.encode_edge], graph.count, keep, dtype, edges, *_parameters(network.encode_edge))
    for _ in range(network.repeats):
        for block in network.processor:
            nodes, updated = _Block.apply(
                shadow[block.edge],
                shadow[block.node],
                graph,
                rows,
                block.edge_update,
                keep,
                nodes,
                edges,
                *_parameters(block.edge),
                *_parameters(block.node),
            )
            edges = edges if updated is None else updated
    return network.decode(nodes, dtype)
