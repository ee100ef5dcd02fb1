"""Grid emulator: particles -> grid -> small sparse U-Net -> the next m frames at once -> particles.

After NeuralMPM (Rochman-Sharabi, Lewin, Louppe 2024, arXiv 2408.15753), with four changes: the network runs on *occupied* nodes
only (a dense 40 x 40 U-Net spends nine tenths of its work on empty air, and a batch of scenes needs no padding), it answers for the
*deviation from flight* (free flight and its end at a wall need not be learnt), it is read once, at the particles' starting places
(the flow map over m frames, so no second transfer per frame), and it may blend a particle's velocity towards the grid's (PIC/FLIP).

One call, all lengths in box units and times in model frames (dt = 1):

    w_ip   = prod_a (1 - |x_p - x_i|_a / H_a)_+                              bilinear weights, node i, particle p
    vbar_i = sum_p w_ip v_p / (sum_p w_ip + eps)                             particles to grid, each material by itself
    f_pj   = clip(x_p + j v_p + g j (j + 1) / 2, box)                        flight, j = 1 .. m; inelastic slip walls
    (u_i1 .. u_im, b_i) = U-Net(density_i, vbar_i, accelerations_i, walls_i, density in flight_i)      for each material
    x_pj   = f_pj + sum_(k <= j) [ sum_i w_ip s_k u_ik + b_p (sum_i w_ip vbar_i - v_p) ],    b_p = sum_i w_ip b_i

Materials that move have a density and a velocity field each, and a particle reads those of its own (as in NeuralMPM: where two meet, one field would
make them one); kinematic particles, obstacles, are a density alone. One velocity field a material does not keep a body rigid,
so in rollouts the particles of each rigid body take the nearest places that are a motion of its shape (learn/rigidity.py).

Of other transfers, no blend (FLIP) has 1.5 to 8 times the rollout error, affine particles (APIC) do not help, and quadratic B-splines, better for
water, are not settled (docs/studies.md, "Transfers of the grid emulator").

The clip acts on the flight alone: nothing stops a wrong deviation from leaving the box, so escapes stay visible.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, PositiveInt, model_validator
from torch import Tensor, nn
from torch.nn import functional

from learn.dataset import DataSpec, Windows
from learn.features import random_walk_noise
from learn.model import check_start
from learn.relaxation import Relaxation, relax
from learn.rigidity import matched, rigid_bodies
from sim.errors import InputError
from sim.simulator import Start
from sim.trajectory import KINEMATIC_TYPE

Share = Annotated[float, Field(gt=0, le=1)]
#: Larger grids come of a wrong ``cell`` or ``margin``, and would exhaust the memory.
MOST_NODES = 3 * 10**7


class GridEmulatorSettings(BaseModel):
    """Options of ``GridEmulator``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    frames_per_call: int = Field(8, ge=1, le=10_000)  # m: model frames that one network call predicts
    history: int = Field(2, ge=2)  # model frames of input: history - 1 velocities, the last one and their differences
    cell: float = Field(2.0, gt=0)  # H in particle spacings (rounded so that whole cells fill the box)
    margin: int = Field(2, ge=1)  # cells kept outside each wall; a particle beyond them flies ballistically, unseen
    channels: list[PositiveInt] = Field([32, 48, 64], min_length=1)  # width of each level of the U-Net, finest first; each halves the resolution
    blocks: int = Field(1, ge=1)  # residual convolutions at each level, on the way down and again on the way up
    wall_reach: float = Field(4.0, gt=0)  # distance in cells at which the wall features saturate
    noise: float = Field(0.02, ge=0, le=1e6)  # std of the last input velocity's noise in velocity stds (random walk over the history)
    unroll: list[int] = Field([1, 2, 4], min_length=1)  # calls a training window spans; equal shares of the training
    walls: bool = True  # the flight that the network corrects stops at the walls; off: it goes through them
    preview: list[Share] = Field([0.5, 1.0], max_length=8)  # shares of a call after which the network is shown the density that flight leads to
    select: int = Field(0, ge=0)  # windows of a batch that are trained on, half of them drawn by how far they are from flight; 0: all
    relaxation: Relaxation | None = None  # of rollouts: crowded particles are pushed apart after every call, see learn.relaxation
    floor: float = Field(0.03, gt=0, le=1e6)  # least scale of a frame's loss, in particle spacings: below it the loss would be all noise

    @model_validator(mode="after")
    def _ascending(self) -> GridEmulatorSettings:
        if self.unroll != sorted(self.unroll) or self.unroll[0] < 1:
            raise ValueError("unroll must be ascending numbers of calls")
        return self


class _StencilConv(torch.autograd.Function):
    """y_i = b + sum_k W_k x_(i+k) over the occupied nodes: gather the stencil's rows, one matrix product.

    The backward pass gathers too (the adjoint of a gather along a symmetric stencil is the gather along the reversed one), which is
    five times faster than autograd's scatter and has one order of summation.
    """

    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, bias: Tensor, neighbours: Tensor) -> Tensor:
        columns = _gather(x, neighbours)
        ctx.save_for_backward(columns, weight, neighbours)
        return torch.addmm(bias, columns, weight.reshape(-1, weight.shape[2]))

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        columns, weight, neighbours = ctx.saved_tensors
        grad = grad.contiguous()
        back = None
        if ctx.needs_input_grad[0]:
            back = _gather(grad, neighbours) @ weight.flip(0).transpose(1, 2).reshape(-1, weight.shape[1])
        return back, (columns.t() @ grad).view_as(weight), grad.sum(0), None


def _gather(x: Tensor, neighbours: Tensor) -> Tensor:
    """Rows of the stencil, [A, K C]; the index A means "empty" and gives zeros."""
    padded = torch.cat([x, x.new_zeros(1, x.shape[1])])
    return padded.index_select(0, neighbours.reshape(-1)).view(neighbours.shape[0], -1)


class StencilConv(nn.Module):
    """3^d convolution over occupied nodes (submanifold: outputs where inputs are). weight [3^d, C_in, C_out]."""

    def __init__(self, dim: int, inputs: int, outputs: int):
        super().__init__()
        # First registered, then written: a model that is too large stops there (``learn.checkpoint.build_model``).
        self.weight = nn.Parameter(torch.empty(3**dim, inputs, outputs))
        with torch.no_grad():
            self.weight.normal_().mul_((2 / (3**dim * inputs)) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor, neighbours: Tensor) -> Tensor:
        """[A, C_in], [A, 3^d] -> [A, C_out]."""
        if not torch.is_grad_enabled():  # autograd's bookkeeping costs as much as a small convolution
            return torch.addmm(self.bias, _gather(x, neighbours), self.weight.view(-1, self.weight.shape[2]))
        return _StencilConv.apply(x, self.weight, self.bias, neighbours)


class Residual(nn.Module):
    """x + conv(relu(x))."""

    def __init__(self, dim: int, channels: int):
        super().__init__()
        self.convolution = StencilConv(dim, channels, channels)
        with torch.no_grad():
            self.convolution.weight.mul_(0.7)

    def forward(self, x: Tensor, neighbours: Tensor) -> Tensor:
        """x [nodes, channels], neighbours as of ``StencilConv``."""
        return x + self.convolution(functional.relu(x), neighbours)


@dataclass(frozen=True)
class Level:
    """Occupied nodes of one resolution, all examples of a batch together.

    neighbours [A, 3^d]: rows of the stencil, A where empty; child [A]: row of the node in the next coarser level's 2^d-fold
    unfolded rows, ``parent * 2^d + corner``; coarse: rows of the next coarser level. The coarsest level has no child.
    """

    neighbours: Tensor
    child: Tensor | None = None
    coarse: int = 0


class NodeRoom:
    """Occupied nodes of ``examples`` windows in tables of a fixed length, for captured steps (``learn.replay``): nothing waits for their number.

    capacity: rows of each level, to which one is added that everything nowhere belongs to; most [levels] int64: nodes of the fullest grid
    of each level, those without a row too. The id behind the last one means nowhere. Rows that no node has are read by nobody, so that
    no gradient enters them.
    """

    def __init__(self, capacity: list[int], examples: int, device: torch.device):
        self.capacity, self.examples = capacity, examples
        self.most = torch.zeros(len(capacity), dtype=torch.int64, device=device)

    def pack(self, level: int, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Ids [capacity + 1] of the nodes under ``mask`` [ids], nowhere in the rows that are left; row [ids + 1] of each id, for one that is not
        occupied the row behind the last, which means "empty" to a stencil."""
        capacity, nowhere = self.capacity[level], len(mask)
        place = mask.cumsum(0)
        self.most[level : level + 1] = torch.maximum(self.most[level : level + 1], place[-1:])
        ids = torch.arange(nowhere, device=mask.device)
        kept = mask & (place <= capacity)
        active = torch.full((capacity + 1,), nowhere, device=mask.device)
        active.scatter_(0, torch.where(kept, place - 1, capacity), torch.where(kept, ids, nowhere))
        row = torch.where(kept, place - 1, torch.where(mask, capacity, capacity + 1))
        return active, torch.cat([row, torch.full((1,), capacity, device=mask.device)])


class SparseGrid(nn.Module):
    """Index tables of a fixed regular grid and its halvings; finds the occupied nodes of each level.

    ``shape`` [d]: nodes of the finest level. Each level is stored with a ring of one empty node, so that no stencil wraps round.
    """

    def __init__(self, shape: list[int], levels: int):
        super().__init__()
        dim = len(shape)
        if math.prod(shape) > MOST_NODES:
            raise MemoryError(f"a grid of {' x '.join(map(str, shape))} nodes; enlarge cell, or lessen margin")
        self.dim, self.sizes = dim, []
        self.shape, self.shapes = list(shape), []
        for level in range(levels):
            padded = torch.tensor(shape) + 2
            strides = torch.tensor([int(padded[a + 1 :].prod()) for a in range(dim)])
            offsets = torch.tensor(list(itertools.product((-1, 0, 1), repeat=dim)))
            self.register_buffer(f"offset{level}", offsets @ strides, persistent=False)
            self.register_buffer(f"stride{level}", strides, persistent=False)
            self.sizes.append(int(padded.prod()))
            self.shapes.append(list(shape))
            shape = [(extent + 1) // 2 for extent in shape]
            # Parent and corner of every node; the ring has none and is never occupied.
            coordinate = torch.stack(torch.meshgrid(*[torch.arange(-1, int(p) - 1) for p in padded], indexing="ij"), -1).reshape(-1, dim)
            coarse = torch.tensor([int((torch.tensor(shape) + 2)[a + 1 :].prod()) for a in range(dim)])
            corner = (coordinate % 2) @ torch.tensor([2 ** (dim - 1 - a) for a in range(dim)])
            parent = (torch.div(coordinate, 2, rounding_mode="floor") + 1) @ coarse
            self.register_buffer(f"parent{level}", parent, persistent=False)
            self.register_buffer(f"corner{level}", corner, persistent=False)

    def occupy(self, nodes: Tensor, examples: int, room: NodeRoom | None = None) -> tuple[Tensor, Tensor, list[Level]]:
        """Levels occupied by ``nodes``, flat finest ids of any shape with ``example * sizes[0]`` added.

        Returns the occupied ids [A] ascending, their row by id [examples * sizes[0]], and the levels, finest first; with ``room`` the tables of
        ``NodeRoom``, and ``nodes`` may hold its "nowhere", ``examples * sizes[0]``.
        """
        ids, corner = nodes.reshape(-1), None
        every = ids  # those without room as well: a coarser level counts them
        levels: list[Level] = []
        for level, size in enumerate(self.sizes):
            total = examples * size
            if room is None:
                mask = torch.zeros(total, dtype=torch.bool, device=ids.device)
                mask[ids] = True
                active = mask.nonzero().squeeze(1)
                lookup = torch.full((total,), len(active), device=ids.device)
                lookup[active] = torch.arange(len(active), device=ids.device)
                around = active[:, None] + getattr(self, f"offset{level}")
            else:
                mask = torch.zeros(total + 1, dtype=torch.bool, device=ids.device).index_fill_(0, every, True)
                active, lookup = room.pack(level, mask[:-1])
                around = (active[:, None] + getattr(self, f"offset{level}")).clamp(max=total)
            if levels:
                levels[-1] = Level(levels[-1].neighbours, lookup[ids] * 2**self.dim + corner, len(active))
            else:
                finest, rows = active, lookup
            levels.append(Level(lookup[around]))
            if level + 1 < len(self.sizes):
                ids, corner = self._parents(level, active), getattr(self, f"corner{level}")[active % size]
                every = ids if room is None else self._parents(level, every)
        return finest, rows, levels

    def _parents(self, level: int, ids: Tensor) -> Tensor:
        size = self.sizes[level]
        return getattr(self, f"parent{level}")[ids % size] + ids // size * self.sizes[level + 1]


class SparseUNet(nn.Module):
    """U-Net over the occupied nodes: 2^d-strided convolutions down and up, residual blocks, added skips, linear output from zero."""

    def __init__(self, dim: int, inputs: int, channels: list[int], outputs: int, blocks: int):
        super().__init__()
        self.corners = 2**dim
        self.enter = StencilConv(dim, inputs, channels[0])
        self.down = nn.ModuleList(nn.Linear(self.corners * a, b) for a, b in itertools.pairwise(channels))
        self.up = nn.ModuleList(nn.Linear(b, self.corners * a) for a, b in itertools.pairwise(channels))
        self.encode = nn.ModuleList(nn.ModuleList(Residual(dim, c) for _ in range(blocks)) for c in channels)
        self.decode = nn.ModuleList(nn.ModuleList(Residual(dim, c) for _ in range(blocks)) for c in channels[:-1])
        self.leave = nn.Linear(channels[0], outputs)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, x: Tensor, levels: list[Level]) -> Tensor:
        """[A, inputs] at the finest level -> [A, outputs]."""
        x, skips = self.enter(x, levels[0].neighbours), []
        for depth, level in enumerate(levels):
            for block in self.encode[depth]:
                x = block(x, level.neighbours)
            if level.child is not None:
                skips.append(x)
                unfolded = x.new_zeros(level.coarse * self.corners, x.shape[1]).index_copy(0, level.child, functional.relu(x))
                x = self.down[depth](unfolded.view(level.coarse, -1))
        for depth in reversed(range(len(skips))):
            level = levels[depth]
            x = self.up[depth](functional.relu(x)).view(-1, skips[depth].shape[1]).index_select(0, level.child) + skips[depth]
            for block in self.decode[depth]:
                x = block(x, level.neighbours)
        return self.leave(functional.relu(x))


class GridEmulator(nn.Module):
    """The grid emulator as a learned model and as a simulator; the equations are at the head of this file.

    Raises ``InputError`` for data that it is not made for (periodic boxes, grids too large).
    """

    Settings = GridEmulatorSettings
    name = "grid_emulator"
    kind = "learned"

    def __init__(self, settings: GridEmulatorSettings, spec: DataSpec):
        super().__init__()
        if spec.periodic:
            raise InputError("grid_emulator", "periodic", list(spec.periodic), "its grid ends at walls all around; train a gns on periodic boxes")
        self.options, self.spec = settings, spec
        self.settings = settings.model_dump()
        dim, m = spec.dim, settings.frames_per_call
        self.history = (settings.history - 1) * spec.stride + 1
        bounds = torch.tensor(spec.bounds, dtype=torch.float32)
        extent = bounds[:, 1] - bounds[:, 0]
        cells = torch.clamp((extent / (settings.cell * spec.spacing)).round(), min=1)
        nodes = [int(c) + 1 + 2 * settings.margin for c in cells]
        self.grid = SparseGrid(nodes, len(settings.channels))
        step = spec.frame_step * spec.stride

        def constant(name: str, value: object) -> None:
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)

        constant("bounds", bounds)
        constant("cell", extent / cells)
        constant("origin", bounds[:, 0] - settings.margin * extent / cells)
        constant("gravity", torch.tensor(spec.gravity) * step * step)
        # Isotropic scales: a mirrored or turned scene has the same features.
        constant("velocity_scale", max(float(np.sqrt(np.mean(np.square(spec.velocity_std)))), 1e-12))
        constant("acceleration_scale", max(float(np.sqrt(np.mean(np.square(spec.acceleration_std)))), 1e-12))
        # Deviations from flight grow like a random walk of accelerations.
        constant("frame_scale", torch.arange(1, m + 1).float().sqrt() * self.acceleration_scale)
        # One particle per cell of its own: density 1 in the bulk.
        constant("particle_mass", float(spec.spacing**dim / (extent / cells).prod()))
        self.register_buffer("corners", torch.tensor(list(itertools.product((0, 1), repeat=dim))), persistent=False)
        self.register_buffer("corner_ids", self.corners @ self.grid.stride0, persistent=False)
        self.register_buffer("nodes", torch.tensor(nodes), persistent=False)
        self.register_buffer("types", torch.tensor(spec.particle_types), persistent=False)
        previewed = [max(round(share * m), 1) - 1 for share in settings.preview]
        self.register_buffer("previewed", torch.tensor(previewed, dtype=torch.int64), persistent=False)
        self.register_buffer("frame", torch.arange(1, m + 1)[:, None].float(), persistent=False)
        moving = [kind for kind in spec.particle_types if kind != KINEMATIC_TYPE] or [KINEMATIC_TYPE]  # a data set may hold kinematic particles alone
        columns = [column for column, kind in enumerate(spec.particle_types) if kind in moving]
        self.register_buffer("moving", torch.tensor(moving), persistent=False)
        self.register_buffer("columns", torch.tensor(columns), persistent=False)
        self.fixed = KINEMATIC_TYPE in spec.particle_types
        self.room: NodeRoom | None = None  # of occupied nodes, where steps are replayed
        self.context = 0 if spec.context_mean is None else len(spec.context_mean)
        if self.context:
            constant("context_mean", spec.context_mean)
            constant("context_std", np.maximum(spec.context_std or (), 1e-8))
        materials = len(moving)
        inputs = len(spec.particle_types) + materials * dim * (settings.history - 1) + 2 * dim + len(settings.preview) + self.context
        self.network = SparseUNet(dim, inputs, settings.channels, materials * (m * dim + 1), settings.blocks)

    # ---- one call -------------------------------------------------------------------------------------------------------------------

    def weights(self, position: Tensor, example: Tensor) -> tuple[Tensor, Tensor]:
        """Flat node ids [N, 2^d] (offset by the example) and bilinear weights [N, 2^d] of positions [N, d]; zero weight off the grid."""
        place = (position - self.origin) / self.cell
        base = torch.minimum(place.detach().floor().long().clamp(min=0), self.nodes - 2)
        fraction = place - base
        inside = ((fraction >= 0) & (fraction <= 1)).all(1)
        # CUDA has no products of integer matrices.
        node = (((base + 1) * self.grid.stride0).sum(1) + example * self.grid.sizes[0])[:, None] + self.corner_ids
        factor = torch.where(self.corners.bool(), fraction[:, None], 1 - fraction[:, None])
        weight = factor[:, :, 0]
        for axis in range(1, factor.shape[2]):  # the gradient of ``prod`` waits for a GPU
            weight = weight * factor[:, :, axis]
        return node, torch.where(inside[:, None], weight, 0)

    def to_grid(self, value: Tensor, row: Tensor, weight: Tensor, rows: int) -> Tensor:
        """Weighted sums [A, F] of particle values [N, F]: sum_p w_ip f_p."""
        spread = (weight[:, :, None] * value[:, None]).reshape(-1, value.shape[1])
        return value.new_zeros(rows, value.shape[1]).index_add(0, row.reshape(-1), spread)

    def to_particles(self, value: Tensor, row: Tensor, weight: Tensor) -> Tensor:
        """Interpolated node values [N, F] of [A, F]: sum_i w_ip f_i."""
        return (value.index_select(0, row.reshape(-1)).view(*row.shape, -1) * weight[:, :, None]).sum(1)

    def node_features(self, node: Tensor, density: Tensor, velocity: Tensor, ahead: Tensor, context: Tensor | None) -> Tensor:
        """[A, inputs] of the flat node ids [A], the density per type [A, types], the mean velocities [A, materials, history - 1, d], newest
        first, and the mean densities in flight [A, previews].

        Density; newest velocity / velocity scale; its differences to the older ones / acceleration scale; signed distance to each wall
        in cells, clipped to +-wall_reach and divided by it; density in flight - 1; the normalised context of the node's example.
        """
        size, reach = self.grid.sizes[0], self.options.wall_reach
        padded = self.nodes + 2
        coordinate = (torch.div((node % size)[:, None], self.grid.stride0, rounding_mode="floor") % padded - 1).float()
        walls = torch.cat([coordinate - self.options.margin, self.nodes - 1 - self.options.margin - coordinate], 1)
        parts = [
            density,
            (velocity[:, :, 0] / self.velocity_scale).flatten(1),
            ((velocity[:, :, :-1] - velocity[:, :, 1:]) / self.acceleration_scale).flatten(1),
            walls.clamp(-reach, reach) / reach,
            (ahead - 1).clamp(-1, 3),
        ]
        if self.context:
            given = (context - self.context_mean) / self.context_std
            parts.append(given[(node // size).clamp(max=len(given) - 1)])
        return torch.cat(parts, 1)

    def density(self, position: Tensor, example: Tensor, examples: int, counted: Tensor | None = None) -> Tensor:
        """[N, k]: density, 1 in the bulk, that particles see among themselves at k sets of places [k, N, d]: sum_i w_ip m sum_q w_iq."""
        sets = len(position)
        node, weight = self.weights(position.flatten(0, 1), (example + examples * torch.arange(sets, device=example.device)[:, None]).flatten())
        if counted is not None:
            weight = weight * counted.repeat(sets)[:, None]
        grid = weight.new_zeros(sets * examples * self.grid.sizes[0]).index_add(0, node.reshape(-1), weight.reshape(-1))
        return (grid.index_select(0, node.reshape(-1)).view_as(weight) * weight).sum(1).view(sets, position.shape[1]).t() * self.particle_mass

    def call(
        self, history: Tensor, kind: Tensor, example: Tensor, examples: int, context: Tensor | None = None, counted: Tensor | None = None
    ) -> Tensor:
        """The next m positions [m, N, d] of a history [history, N, d]; context [examples, c]. Kinematic particles come out unprescribed, particles
        outside ``counted`` [N] (with ``room`` only, see ``Windows``) are seen by nobody."""
        dim, m = self.spec.dim, self.options.frames_per_call
        position = history[-1]
        velocity = (history[1:] - history[:-1]).flip(0).transpose(0, 1)
        flight = position[:, None] + velocity[:, :1] * self.frame + self.gravity * (self.frame * (self.frame + 1) / 2)
        if self.options.walls:
            flight = torch.minimum(torch.maximum(flight, self.bounds[:, 0]), self.bounds[:, 1])
        node, weight = self.weights(position, example)
        if counted is not None:
            node, weight = torch.where(counted[:, None], node, examples * self.grid.sizes[0]), weight * counted[:, None]
        occupied, rows, levels = self.grid.occupy(node, examples, self.room)
        row = rows[node]
        one_hot, material = (kind[:, None] == self.types).to(position.dtype), (kind[:, None] == self.moving).to(position.dtype)
        ahead = self.density(flight.index_select(1, self.previewed).transpose(0, 1), example, examples, counted)
        own = (material[:, :, None] * velocity.flatten(1)[:, None]).flatten(1)
        sums = self.to_grid(torch.cat([one_hot, own, ahead], 1), row, weight, len(occupied))
        mass, sums, ahead = sums.split((one_hot.shape[1], own.shape[1], ahead.shape[1]), 1)
        # Isolated particles leave nodes almost without mass: the constant keeps their gradients bounded.
        mean = sums.view(len(mass), len(self.moving), -1) / (mass.index_select(1, self.columns)[:, :, None] + 1e-3)
        ahead = ahead / (mass.sum(1, keepdim=True) + 1e-3)
        mean = mean.view(*mean.shape[:2], *velocity.shape[1:])
        output = self.network(self.node_features(occupied, mass * self.particle_mass, mean, ahead, context), levels)
        fields = torch.cat([output.view(len(mass), len(self.moving), -1), mean[:, :, 0]], 2)
        read = self.to_particles(fields.flatten(1), row, weight)
        if len(self.moving) > 1:
            read = (read.view(len(position), len(self.moving), -1) * material[:, :, None]).sum(1)
        deviation, blend, grid_velocity = read.split((m * dim, 1, dim), 1)
        deviation = deviation.view(-1, m, dim) * self.frame_scale[:, None] + (blend * (grid_velocity - velocity[:, 0]))[:, None]
        return (flight + deviation.cumsum(1)).transpose(0, 1)

    # ---- training -------------------------------------------------------------------------------------------------------------------

    @property
    def replayable(self) -> bool:
        """Whether training steps can be CUDA graphs (``learn.replay``): on a GPU."""
        return self.bounds.device.type == "cuda"

    def measure(self, windows: Windows) -> list[int]:
        """Nodes of each level that ``windows`` occupy in the first call."""
        position, device = windows.position[self.options.history - 1].to(self.bounds.device), self.bounds.device
        node, _ = self.weights(position, windows.example.to(device))
        return [len(level.neighbours) for level in self.grid.occupy(node, windows.examples)[2]]

    def make_room(self, capacity: list[int], examples: int) -> NodeRoom:
        """For steps on so many windows, which occupy at most ``capacity`` nodes of each level, or all there are (``learn.replay``)."""
        inner = [examples * math.prod(shape) for shape in self.grid.shapes]
        return NodeRoom([min(count, most) for count, most in zip(capacity, inner, strict=True)], examples, self.bounds.device)

    @contextmanager
    def using(self, room: NodeRoom) -> Iterator[None]:
        """One training step in ``room``."""
        self.room = room
        try:
            yield
        finally:
            self.room = None

    def calls(self, progress: float) -> int:
        """Calls unrolled at this share of the training."""
        unroll = self.options.unroll
        return unroll[min(int(progress * len(unroll)), len(unroll) - 1)]

    def window(self, progress: float) -> int:
        """Model frames of a training window: the history and ``calls`` blocks of m."""
        return self.options.history + self.calls(progress) * self.options.frames_per_call

    def loss(self, windows: Windows, generator: torch.Generator, progress: float) -> Tensor:
        """Mean over calls, frames, moving particles and axes of |x - (x_true + e)|^2 / scale_j^2.

        e: the noise of the last input position, so that the targets move with the noisy start; scale_j: the rms deviation of the
        window's frame j of a call from ballistic flight, at least ``floor`` spacings (otherwise free flight would be all noise).
        """
        windows = self.pick(windows, generator)
        return self.loss_under(self.noise(windows, generator), windows)

    def pick(self, windows: Windows, generator: torch.Generator) -> Windows:
        """The windows of a batch that are trained on (``select``)."""
        select = self.options.select
        if windows.place is not None:  # of its own windows a process selects its share, and judges them by their own deviations
            select = max(round(select * len(windows.example) / windows.place[1]), 1 if select else 0)
        return self._select(windows, select, generator) if 0 < select < windows.examples else windows

    def noise(self, windows: Windows, generator: torch.Generator) -> Tensor:
        """Noise of the input of ``windows`` [history, N, d]."""
        moving = windows.particle_type != KINEMATIC_TYPE
        sigma = self.options.noise * torch.tensor(self.spec.velocity_std, dtype=torch.float32, device=windows.position.device)
        return random_walk_noise(windows.position[: self.options.history], sigma, generator, moving, windows.place)

    def loss_under(self, noise: Tensor, windows: Windows) -> Tensor:
        """``loss`` of all the windows with this noise."""
        history, m, counted = self.options.history, self.options.frames_per_call, windows.counted
        judged = moving = windows.particle_type != KINEMATIC_TYPE
        if counted is not None:
            judged = moving & counted
        count = judged.sum() * self.spec.dim
        state = windows.position[:history] + noise
        target = windows.position[history:] + noise[-1]
        scale = self._scale(windows.position, judged, count)
        examples = windows.examples if self.room is None else self.room.examples
        errors = []
        for first in range(0, len(target), m):
            context = None if windows.context is None else windows.context[history - 1 + first]
            future = self.call(state, windows.particle_type, windows.example, examples, context, counted)
            truth = target[first : first + m]
            if self.fixed:
                future = torch.where(moving[:, None], future, truth)
            errors.append(torch.where(judged[:, None], future - truth, 0).square().sum((1, 2)) / count)
            state = torch.cat([state, future])[-history:]
        return (torch.cat(errors) / scale.square()).mean()

    def _scale(self, position: Tensor, judged: Tensor, count: Tensor) -> Tensor:
        """[K m]: rms deviation of the window's frames after the history from ballistic flight, floored; ``count``: coordinates of ``judged`` [N]."""
        now = self.options.history - 1
        frame = torch.arange(1, len(position) - now, dtype=position.dtype, device=position.device)[:, None, None]
        flight = position[now] + (position[now] - position[now - 1]) * frame + self.gravity * frame * (frame + 1) / 2
        deviation = (torch.where(judged[:, None], position[now + 1 :] - flight, 0).square().sum((1, 2)) / count).sqrt()
        return deviation.clamp(min=self.options.floor * self.spec.spacing)

    def _select(self, windows: Windows, count: int, generator: torch.Generator) -> Windows:
        """``count`` of the windows, without replacement, with p = 1/2 uniform + 1/2 proportional to the rms deviation from flight.

        A window in thirty holds the first touch of a wall, and nine tenths of the error of a batch: uniform sampling starves on it.
        """
        step = self.spec.frame_step * self.spec.stride
        position = windows.position
        gravity = torch.tensor(self.spec.gravity, dtype=torch.float32, device=position.device) * step * step
        ends = torch.bincount(windows.example).cumsum(0).tolist()
        parts = [slice(first, last) for first, last in zip([0, *ends[:-1]], ends, strict=True)]
        energy = []
        for part in parts:  # one by one: small enough for a core's cache, which is four times as fast
            own = position[:, part]
            energy.append((own[2:] - 2 * own[1:-1] + own[:-2] - gravity).square().sum() / own.shape[1])
        rms = torch.stack(energy).sqrt().cpu()
        chance = 0.5 / windows.examples + 0.5 * rms / rms.sum().clamp(min=1e-30)
        chosen = torch.multinomial(chance, count, generator=generator).sort().values.tolist()
        kept = [parts[number] for number in chosen]
        counts = torch.tensor([part.stop - part.start for part in kept], device=position.device)
        return Windows(
            torch.cat([position[:, part] for part in kept], 1),
            torch.cat([windows.particle_type[part] for part in kept]),
            torch.repeat_interleave(torch.arange(count, device=position.device), counts),
            None if windows.context is None else windows.context[:, chosen],
        )

    # ---- simulation -----------------------------------------------------------------------------------------------------------------

    def begin(self, start: Start) -> None:
        """Load the last ``history`` model frames of the start. Raises ``ValueError`` on a start that is not of the model's kind."""
        check_start(start, self.spec, self.history)
        device = self.bounds.device
        known = np.ascontiguousarray(start.history[-self.history :: self.spec.stride], np.float32)
        self._state = torch.from_numpy(known).to(device)
        self._kind = torch.as_tensor(start.particle_type, dtype=torch.int64, device=device)
        self._example = torch.zeros_like(self._kind)
        self._frame, self._bounds = start.present, np.asarray(start.bounds, np.float64)
        self._bodies = [(body, known[-1, body]) for body in rigid_bodies(known[-1], start.particle_type, self.spec.spacing)]
        self._context = None if start.context is None else torch.as_tensor(start.context, dtype=torch.float32, device=device)
        self._kinematic = None if start.kinematic is None else torch.as_tensor(start.kinematic, dtype=torch.float32, device=device)

    @torch.inference_mode()
    def advance(self) -> np.ndarray:
        """The next m * stride file frames [m * stride, particles, dim], linear between model frames."""
        stride = self.spec.stride
        context = None if self._context is None else self._context[self._frame : self._frame + 1]
        future = self.call(self._state, self._kind, self._example, 1, context)
        if self._kinematic is not None:
            frames = self._frame + stride * torch.arange(1, len(future) + 1, device=future.device)
            future[:, self._kind == KINEMATIC_TYPE] = self._kinematic[frames.clamp(max=len(self._kinematic) - 1)]
        if self.options.relaxation is not None:
            fixed = None if self._kinematic is None else (self._kind == KINEMATIC_TYPE).cpu().numpy()
            last = future[-1].cpu().numpy().astype(np.float64)
            moved = relax(last, self._bounds, self.spec.spacing, self.options.relaxation, fixed) - last
            future = future + torch.from_numpy(moved.astype(np.float32)).to(future.device) * (self.frame / len(future))[:, None]
        self._keep_rigid(future)
        before = torch.cat([self._state[-1:], future[:-1]])
        self._state = torch.cat([self._state, future])[-self.options.history :]
        self._frame += stride * len(future)
        if stride > 1:
            share = torch.arange(1, stride + 1, device=future.device).view(1, -1, 1, 1) / stride
            future = (before[:, None] + share * (future - before)[:, None]).flatten(0, 1)
            self._keep_rigid(future)  # straight lines shrink what turns
        return future.cpu().numpy()

    def _keep_rigid(self, frames: Tensor) -> None:
        """Put the particles of rigid bodies where their shape is kept, in place; frames [frames, N, d]."""
        for body, shape in self._bodies:
            frames[:, body] = torch.from_numpy(matched(frames[:, body].cpu().numpy(), shape).astype(np.float32)).to(frames.device)
