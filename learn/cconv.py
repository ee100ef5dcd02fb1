"""CConv: continuous convolutions on the particles and on the walls around them (Ummenhofer, Prantl, Thuerey, Koltun, ICLR 2020).

A particle first flies on under gravity; what its neighbours and the walls there make of that flight is a correction of its place. All times
are in model frames (dt = 1):

    v* = v + g,    x* = x + (v + v*) / 2,    x' = x* + s F(x*, v*),    v' = x' - x

F is a stack of continuous convolutions. One sums over the neighbours j of a particle i within R, itself left out,

    (f * G)_i = sum_j a(|x_j - x_i| / R) f_j G(L((x_j - x_i) / R)),    a(r) = (1 - r^2)^3

G is a filter of K^d cells, read by multilinear interpolation (the outer cells' centres lie on the boundary); L maps the ball to the cube and
preserves volume (Griepentrog et al. 2008). Of the input a first layer makes three parts, c_0 wide each: the convolution over the particles, one over
the boundary, and a linear map of the particle itself; every later layer is the convolution plus a linear map of relu(input), plus the input where
the widths agree.

Particles bring (1, v* / velocity scale, and what the data have of types and context); the boundary brings normals: the walls of the box are covered
with a layer of particles that carry the inward normal, as densely as the original samples its boxes (0.64 spacings apart). Decisions: kinematic
particles have no normal in any data set, so they carry a column of their own, and enter at their prescribed places of the *next* frame; lengths
are learnt in the data's units (s: rms acceleration std; velocity scale: rms velocity std), so that one initialisation serves all data.

The gradient leaves out how the weights of the interpolation depend on places, as the original's does; through an unrolled step it passes by x*
and v*. The arithmetic is ordered for the processor: one product makes what every cell of every sender's filter contributes, [N, C_in] @
[C_in, K^d C_out], and one weighted bag sums, for each receiver, the 2^d cells that each of its pairs reads.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, PositiveInt
from torch import Tensor, nn
from torch.nn.functional import relu

from learn.checkpoint import load_weights, read_content
from learn.dataset import DataSpec
from learn.features import SMALLEST_STD
from learn.graph import radius_graph
from learn.model import check_start
from learn.relaxation import Relaxation, relax
from sim import periodic
from sim.errors import InputError
from sim.simulator import SimulationError, Start
from sim.trajectory import KINEMATIC_TYPE, PARTICLE_TYPES

if TYPE_CHECKING:
    from learn.dataset import Windows

#: Distance of the particles on walls in particle spacings: the original draws 1.9 of them per disc of a particle's radius (half a spacing).
WALL_SPACING = 0.5 * math.sqrt(math.pi / 1.9)
#: Neighbours at which a particle's weight in the loss falls to 1 / e, as a share of those that a full ball holds: 40 of 47.7 in the original.
CROWD = 40 / (4 / 3 * math.pi * 2.25**3)
#: Added to squared errors in units of s^2, under the root: 1e-9 m^2 at the original's s = 1 / 128 m.
SOFTENING = 1e-9 * 128**2
#: More of them on a wall than this come of a wrong spacing, and would exhaust the memory.
MOST_WALL_PARTICLES = 10**7


class CConvSettings(BaseModel):
    """Options of a CConv; the defaults are the paper's."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    channels: tuple[PositiveInt, ...] = Field((32, 64, 64), min_length=1)  # c_0 (the second layer's input is three times as wide), c_1, ...
    kernel: int = Field(4, ge=2)  # K, cells of a filter along each axis
    radius: float = Field(2.25, gt=0)  # R in particle spacings; the paper's extent is 6 particle radii x 1.5
    exponent: float = Field(0.5, gt=0, le=2)  # gamma of the loss |x - x_true|^gamma; the paper's lets the few particles that hit a wall count little
    unroll: tuple[PositiveInt, ...] = Field((2,), min_length=1)  # calls the loss is unrolled over, in equal shares of the training
    relaxation: Relaxation | None = None  # of rollouts: crowded particles are pushed apart after every call, see learn.relaxation
    edge_cap: float = Field(4.0, gt=1)  # a rollout fails when its pairs exceed this multiple of their first number (it clumps)


# -- geometry ------------------------------------------------------------------------------------------------------------------------


def disc_to_square(x: Tensor) -> Tensor:
    """[n, 2] in the unit disc -> [n, 2] in [-1, 1]^2, areas times 4 / pi: (sign(x) r, sign(x) r 4/pi atan(y / x)) where |y| <= |x|, else swapped."""
    first, second = x.unbind(1)
    wide = second.abs() <= first.abs()
    major, minor = torch.where(wide, first, second), torch.where(wide, second, first)
    radius = torch.linalg.vector_norm(x, dim=1).copysign(major)
    angle = torch.atan(minor / torch.where(major == 0, 1, major))
    other = radius * angle * (4 / math.pi)
    return torch.stack([torch.where(wide, radius, other), torch.where(wide, other, radius)], 1)


def ball_to_cube(x: Tensor) -> Tensor:
    """[n, d] in the unit ball -> [n, d] in [-1, 1]^d, all volumes stretched alike; d is 2 or 3 (Griepentrog, Hoeppner, Kaiser, Rehberg 2008).

    3D by way of a cylinder along z: (x, y) sqrt(3 r / (r + |z|)), sign(z) r where 5/4 z^2 > x^2 + y^2; else (x, y) r / sqrt(x^2 + y^2), 3/2 z.
    """
    if x.shape[1] == 2:
        return disc_to_square(x)
    plane, z = x[:, :2], x[:, 2]
    flat, radius = plane.square().sum(1), torch.linalg.vector_norm(x, dim=1)
    cap = 1.25 * z.square() > flat
    tiny = torch.finfo(x.dtype).tiny
    widen = torch.where(cap, (3 * radius / (radius + z.abs()).clamp(min=tiny)).sqrt(), radius / flat.sqrt().clamp(min=tiny))
    height = torch.where(cap, radius.copysign(z), 1.5 * z)
    return torch.cat([disc_to_square(plane * widen[:, None]), height[:, None]], 1)


def wall_counts(extent: np.ndarray, spacing: float) -> np.ndarray:
    """Particles along each edge of a box of lengths ``extent``, [dim] int; ``InputError`` for more of them on a wall than memory holds."""
    counts = np.maximum(np.round(extent / spacing), 1)
    if not counts.prod() / counts.min() <= MOST_WALL_PARTICLES:
        shown = " x ".join(f"{count:g}" for count in counts)
        raise InputError("cconv", "spacing", spacing, f"{shown} particles along the walls of the box; train on data of another spacing")
    return counts.astype(int)


def wall_particles(bounds: np.ndarray, spacing: float, period: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Positions and inward unit normals, both [particles, dim], on the walls of a box, about ``spacing`` apart, none on an edge.

    bounds [dim, 2]; period [dim] as in ``sim.periodic``: a box that repeats itself along an axis has no walls across it.
    """
    bounds = np.asarray(bounds, float)
    extent = bounds[:, 1] - bounds[:, 0]
    counts = wall_counts(extent, spacing)
    axes = [low + (np.arange(count) + 0.5) * length / count for low, count, length in zip(bounds[:, 0], counts, extent, strict=True)]
    positions, normals = [np.empty((0, len(bounds)))], [np.empty((0, len(bounds)))]
    walled = [axis for axis in range(len(bounds)) if period is None or not period[axis]]
    for axis, side in itertools.product(walled, range(2)):
        face = [*axes[:axis], bounds[axis, side : side + 1], *axes[axis + 1 :]]
        positions.append(np.stack(np.meshgrid(*face, indexing="ij"), -1).reshape(-1, len(bounds)))
        normals.append(np.broadcast_to(np.eye(len(bounds))[axis] * (1 - 2 * side), positions[-1].shape))
    return np.concatenate(positions), np.concatenate(normals)


class Walls:
    """The particles on the walls of a box, and which of them particles of the fluid see; bounds [dim, 2], period [dim] as in ``sim.periodic``."""

    def __init__(self, bounds: np.ndarray, spacing: float, radius: float, period: np.ndarray | None = None):
        self.period, self.radius = period, radius
        self.bounds = periodic.walls(bounds, period)
        self.position, self.normal = wall_particles(bounds, WALL_SPACING * spacing, period)
        self._tree = periodic.tree(self.position, period)

    def pairs(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Indices of wall particles and of the ``position`` [n, dim] within ``radius`` of them, [pairs] each."""
        near = np.flatnonzero(((position - self.bounds[:, 0] < self.radius) | (self.bounds[:, 1] - position < self.radius)).any(1))
        found = self._tree.sparse_distance_matrix(periodic.tree(position[near], self.period), self.radius, output_type="ndarray")
        return found["i"], near[found["j"]]

    def shortest(self, offset: Tensor) -> Tensor:
        """The shortest image of offsets [n, dim]."""
        if self.period is None:
            return offset
        # Where there are walls the period is 0, and no turn is taken.
        length = torch.as_tensor(self.period, dtype=offset.dtype, device=offset.device)
        return offset - length * (offset / length.where(length > 0, torch.inf)).round()


@dataclass(frozen=True)
class Pairs:
    """Pairs of points and the 2^d cells of a filter that each reads: a sparse matrix from [inner * cells] to [outer], of the interpolation's weights.

    outer [pairs] int32, ascending; place [pairs, 2^d] int32: inner point * cells + cell; weight [pairs, 2^d]: with the window a.
    """

    outer: Tensor
    place: Tensor
    weight: Tensor
    size: tuple[int, int]  # outer points, inner points * cells

    @classmethod
    def between(cls, offset: Tensor, outer: Tensor, inner: Tensor, size: tuple[int, int], kernel: int) -> Pairs:
        """offset [pairs, d]: (x_sender - x_receiver) / R; outer, inner [pairs]: indices; size: number of outer and inner points."""
        dim = offset.shape[1]
        window = (1 - offset.square().sum(1)).clamp(min=0) ** 3
        cell = (ball_to_cube(offset) + 1) * (0.5 * (kernel - 1))
        base = cell.floor().clamp(0, kernel - 2)
        fraction = (cell - base).clamp(0, 1)
        # The first axis is the fastest, as in the published weights.
        number, weight = inner[:, None].int() * kernel**dim, window[:, None]
        for axis in range(dim):
            low = base[:, axis].int() * kernel**axis
            number = torch.cat([number + low[:, None], number + (low + kernel**axis)[:, None]], 1)
            share = fraction[:, axis, None]
            weight = torch.cat([weight * (1 - share), weight * share], 1)
        return cls(outer.int(), number, weight, (size[0], size[1] * kernel**dim))

    @cached_property
    def offsets(self) -> Tensor:
        """[outer + 1] int32: where each outer point's cells begin."""
        return _starts(self.outer, self.size[0]) * self.place.shape[1]

    @cached_property
    def adjoint(self) -> tuple[Tensor, Tensor, Tensor]:
        """Outer point and weight of every cell read, sorted by the cell, and where each cell's begin [inner * cells + 1]."""
        place, order = torch.sort(self.place.flatten(), stable=True)
        return self.outer[order // self.place.shape[1]], self.weight.flatten()[order], _starts(place, self.size[1])

    def gather(self, table: Tensor) -> Tensor:
        """[inner * cells, C] -> [outer, C]."""
        return _Gather.apply(table, self)

    def scatter(self, values: Tensor) -> Tensor:
        """[outer, C] -> [inner * cells, C]: the adjoint of ``gather``. Without gradient."""
        outer, weight, offsets = self.adjoint
        return _bags(values, outer, offsets, weight)


def _starts(index: Tensor, count: int) -> Tensor:
    """[count + 1] int32: where the runs of an ascending index [n] begin."""
    return torch.searchsorted(index, torch.arange(count + 1, device=index.device, dtype=index.dtype), out_int32=True)


def _bags(table: Tensor, rows: Tensor, offsets: Tensor, weight: Tensor) -> Tensor:
    """Weighted sums of ``table[rows[offsets[i]:offsets[i + 1]]]``, gathered and summed in one pass."""
    return torch.embedding_bag(table, rows, offsets, mode=0, include_last_offset=True, per_sample_weights=weight)[0]


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table: Tensor, pairs: Pairs) -> Tensor:
        ctx.pairs = pairs
        return _bags(table, pairs.place.flatten(), pairs.offsets, pairs.weight.flatten())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.pairs.scatter(gradient.contiguous()), None


# -- network -------------------------------------------------------------------------------------------------------------------------


class ContinuousConv(nn.Module):
    """The convolution at the head of this file, with a bias. weight [C_in, K^d, C_out], first axis of space fastest."""

    def __init__(self, inputs: int, outputs: int, cells: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(inputs, cells, outputs))
        nn.init.uniform_(self.weight, -0.05, 0.05)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, features: Tensor, pairs: Pairs) -> Tensor:
        """[senders, C_in] -> [receivers, C_out]; the receivers are the pairs' outer points."""
        table = (features @ self.weight.flatten(1)).view(-1, len(self.bias))
        return pairs.gather(table) + self.bias

    def from_boundary(self, features: Tensor, pairs: Pairs) -> Tensor:
        """The same for many senders with few channels, the pairs' outer points; no gradient to them. [senders, C_in] -> [receivers, C_out]."""
        inputs, cells, outputs = self.weight.shape
        columns = pairs.scatter(features).view(-1, cells * inputs)
        return columns @ self.weight.transpose(0, 1).reshape(-1, outputs) + self.bias


class Layer(nn.Module):
    """Convolution and linear map of relu(x), plus x where the widths agree."""

    def __init__(self, inputs: int, outputs: int, cells: int):
        super().__init__()
        self.conv, self.dense = ContinuousConv(inputs, outputs, cells), _dense(inputs, outputs)

    def forward(self, x: Tensor, pairs: Pairs) -> Tensor:
        """[particles, inputs] -> [particles, outputs]."""
        y = relu(x)
        out = self.conv(y, pairs) + self.dense(y)
        return out + x if out.shape == x.shape else out


def _dense(inputs: int, outputs: int) -> nn.Linear:
    linear = nn.Linear(inputs, outputs)
    nn.init.xavier_uniform_(linear.weight)
    nn.init.zeros_(linear.bias)
    return linear


class Network(nn.Module):
    """F: features of particles and of the boundary to corrections in units of s."""

    def __init__(self, settings: CConvSettings, dim: int, inputs: int, boundary: int):
        super().__init__()
        cells, first, *rest = settings.kernel**dim, *settings.channels
        self.fluid, self.dense = ContinuousConv(inputs, first, cells), _dense(inputs, first)
        self.boundary = ContinuousConv(boundary, first, cells)
        self.layers = nn.ModuleList(Layer(a, b, cells) for a, b in itertools.pairwise([3 * first, *rest, dim]))

    def forward(self, features: Tensor, pairs: Pairs, boundary: Tensor, boundary_pairs: Pairs) -> Tensor:
        """features [particles, inputs], boundary [points, boundary]; ``boundary_pairs`` has the boundary outside -> [particles, dim]."""
        x = torch.cat([self.boundary.from_boundary(boundary, boundary_pairs), self.fluid(features, pairs), self.dense(features)], 1)
        for layer in self.layers:
            x = layer(x, pairs)
        return x


class CConv(nn.Module):
    """The learned simulator (``learn.model.LearnedModel``); the equations are at the head of this file."""

    Settings: ClassVar[type[BaseModel]] = CConvSettings
    kind: ClassVar[str] = "learned"
    name = "cconv"

    def __init__(self, settings: CConvSettings, spec: DataSpec):
        super().__init__()
        self.options, self.settings, self.spec = settings, settings.model_dump(mode="json"), spec
        self.history = spec.stride + 1
        self.radius = settings.radius * spec.spacing
        wall_counts(np.ptp(spec.bounds, axis=1), WALL_SPACING * spec.spacing)  # now, not when a rollout begins
        ball = {2: math.pi, 3: 4 / 3 * math.pi}[spec.dim] * settings.radius**spec.dim
        self.crowd = CROWD * ball
        step = spec.frame_step * spec.stride

        def constant(name: str, value: object) -> None:
            # Not in the state dict: they follow from the spec, which travels in the checkpoint.
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)

        constant("gravity", torch.tensor(spec.gravity) * step * step)
        constant("velocity_scale", max(float(np.sqrt(np.mean(np.square(spec.velocity_std)))), SMALLEST_STD))
        constant("scale", max(float(np.sqrt(np.mean(np.square(spec.acceleration_std)))), SMALLEST_STD))
        moving = [kind for kind in spec.particle_types if kind != KINEMATIC_TYPE]
        self.register_buffer("types", torch.tensor(moving), persistent=False)
        self.kinematic = KINEMATIC_TYPE in spec.particle_types
        self.context = 0 if spec.context_mean is None else len(spec.context_mean)
        if self.context:
            constant("context_mean", spec.context_mean)
            constant("context_std", np.maximum(spec.context_std or (), SMALLEST_STD))
        kinds = len(moving) if len(moving) > 1 else 0
        self.network = Network(settings, spec.dim, 1 + spec.dim + kinds + self.context, spec.dim + self.kinematic)

    @cached_property
    def walls(self) -> Walls:
        """Those of the training data's box."""
        return Walls(np.array(self.spec.bounds), self.spec.spacing, self.radius, self.spec.period)

    def call(self, position: Tensor, following: Tensor, kind: Tensor, example: Tensor | None, walls: Walls,
             context: Tensor | None = None) -> tuple[Tensor, Tensor]:  # fmt: skip
        """The next positions [N, d] of position [2, N, d], and how many moving neighbours each particle has [N].

        following [N, d]: where kinematic particles will be (other rows are not read); kind [N]; example [N], ascending, or None: there is one;
        context [N, c]. Kinematic particles come out at ``following``.
        """
        before, now = position
        velocity = now - before + self.gravity
        place = now + velocity - 0.5 * self.gravity
        moving = kind != KINEMATIC_TYPE
        if self.kinematic:
            place = torch.where(moving[:, None], place, following)
        features = [torch.ones_like(velocity[:, :1]), velocity / self.velocity_scale]
        if len(self.types) > 1:
            features.append(kind[:, None] == self.types)
        if self.context:
            features.append((context - self.context_mean) / self.context_std)
        features = torch.cat([column.to(self.gravity.dtype) for column in features], 1)
        if self.kinematic:
            features = features[moving]
        pairs, boundary, boundary_pairs = self._around(place.detach(), moving, example, walls)
        correction = (self.network(features, pairs, boundary, boundary_pairs) * self.scale).to(place.dtype)
        count = pairs.offsets.diff() // pairs.place.shape[1]
        if not self.kinematic:
            return place + correction, count
        row = moving.nonzero().squeeze(1)
        return place.index_add(0, row, correction), count.new_zeros(len(kind)).index_copy(0, row, count)

    def _around(self, position: Tensor, moving: Tensor, example: Tensor | None, walls: Walls) -> tuple[Pairs, Tensor, Pairs]:
        """Pairs of moving particles, features of the boundary (kinematic particles, then walls), and its pairs with moving particles."""

        def pairs(offset: Tensor, outer: Tensor, inner: Tensor, size: tuple[int, int]) -> Pairs:
            return Pairs.between((walls.shortest(offset) / self.radius).to(self.gravity.dtype), outer, inner, size, self.options.kernel)

        graph = radius_graph(position, self.radius, example, self_edges=False, period=walls.period)
        sender, receiver = graph.sender.long(), graph.receiver.long()
        offset = position.index_select(0, sender) - position.index_select(0, receiver)
        # Index of a particle among those that move, and among those that do not.
        rank = torch.where(moving, moving.cumsum(0), (~moving).cumsum(0)) - 1
        count = int(moving.sum())
        among = moving[sender] & moving[receiver]
        fluid = pairs(offset[among], rank[receiver[among]], rank[sender[among]], (count, count))
        fixed = len(moving) - count
        beside = ~moving[sender] & moving[receiver]
        mine = position[moving]
        wall, seen = (torch.from_numpy(index).to(position.device) for index in walls.pairs(mine.cpu().numpy()))
        near = torch.from_numpy(walls.position).to(position)[wall] - mine[seen]
        outer, inner = torch.cat([rank[sender[beside]], fixed + wall]), torch.cat([rank[receiver[beside]], seen])
        boundary = pairs(torch.cat([offset[beside], near]), outer, inner, (fixed + len(walls.position), count))
        features = torch.from_numpy(walls.normal).to(self.gravity)
        if self.kinematic:
            unknown = torch.cat([features.new_zeros(fixed, features.shape[1]), features.new_ones(fixed, 1)], 1)
            features = torch.cat([unknown, torch.cat([features, features.new_zeros(len(features), 1)], 1)])
        return fluid, features, boundary

    # ---- training ------------------------------------------------------------------------------------------------------------------

    def calls(self, progress: float) -> int:
        """Model calls the loss is unrolled over at this share of the training."""
        unroll = self.options.unroll
        return unroll[min(int(progress * len(unroll)), len(unroll) - 1)]

    def window(self, progress: float) -> int:
        return 2 + self.calls(progress)

    def loss(self, windows: Windows, generator: torch.Generator, progress: float) -> Tensor:
        """Mean over calls and moving particles of exp(-neighbours / crowd) (|x - x_true| / s)^gamma: the original's, in units of s.

        ``crowd`` is .84 of the neighbours that a full ball has. There is no noise, so nothing is drawn from ``generator``.
        """
        state, moving = windows.position[:2], windows.particle_type != KINEMATIC_TYPE
        calls = len(windows.position) - 2
        total = state.new_zeros(())
        for call in range(calls):
            truth = windows.position[2 + call]
            context = None if windows.context is None else windows.context[1 + call][windows.example]
            predicted, neighbours = self.call(state, truth, windows.particle_type, windows.example, self.walls, context)
            square = ((predicted - truth) / self.scale).square().sum(1)
            error = (square + SOFTENING) ** (self.options.exponent / 2) * torch.exp(-neighbours / self.crowd)
            total = total + (error[moving] if self.kinematic else error).mean()
            state = torch.stack([state[1], predicted])
        return total / calls

    # ---- simulation ----------------------------------------------------------------------------------------------------------------

    def begin(self, start: Start) -> None:
        """Load the last two model frames of the start; the walls are its box's. Raises ``ValueError`` on a start that is not of the model's kind."""
        device = self.gravity.device
        check_start(start, self.spec, self.history)
        # Positions in float64: differences of float32 positions lose the last digits of small velocities, frame after frame.
        frames = start.history[len(start.history) - self.history :: self.spec.stride].astype(np.float64)
        self._state = torch.from_numpy(frames).to(device)
        self._kind = torch.from_numpy(start.particle_type.astype(np.int64)).to(device)
        self._walls = Walls(start.bounds, self.spec.spacing, self.radius, start.period)
        self._start, self._present, self._first_pairs = start, start.present, 0

    @torch.inference_mode()
    def advance(self) -> np.ndarray:
        """The next ``stride`` frames, linear between model frames. Raises ``SimulationError`` when the particles clump."""
        start, stride, (_, now) = self._start, self.spec.stride, self._state
        context, known, following = None, None, now
        if start.context is not None:
            row = torch.as_tensor(start.context[min(self._present, len(start.context) - 1)], device=now.device)
            context = row.expand(len(now), -1)
        if start.kinematic is not None:
            known = start.kinematic[np.minimum(self._present + 1 + np.arange(stride), len(start.kinematic) - 1)]
            known = torch.as_tensor(known, dtype=now.dtype, device=now.device)
            following = now.clone()
            following[self._kind == KINEMATIC_TYPE] = known[-1]
        predicted, neighbours = self.call(self._state, following, self._kind, None, self._walls, context)
        pairs = int(neighbours.sum()) + len(now)
        self._first_pairs = self._first_pairs or pairs
        if pairs > self.options.edge_cap * self._first_pairs:
            raise SimulationError(f"particles clump: {pairs} pairs, {self.options.edge_cap:g} x the {self._first_pairs} of the start exceeded")
        if self.options.relaxation is not None:
            fixed = None if known is None else (self._kind == KINEMATIC_TYPE).cpu().numpy()
            relaxed = relax(predicted.cpu().numpy(), start.bounds, self.spec.spacing, self.options.relaxation, fixed, start.period)
            predicted = torch.from_numpy(relaxed).to(now.device)
        share = torch.arange(1, stride + 1, dtype=now.dtype, device=now.device)[:, None, None] / stride
        frames = now + share * (predicted - now)
        if known is not None:
            frames[:, self._kind == KINEMATIC_TYPE] = known
        self._state = torch.stack([now, predicted])
        self._present += stride
        return periodic.wrapped(frames.cpu().numpy(), start.bounds, start.period).astype(np.float32)


# -- published weights ---------------------------------------------------------------------------------------------------------------


def load_published(path: str | Path, spacing: float = 0.05, frame_step: float = 0.02) -> CConv:
    """The CConv of a weights file of the original's PyTorch program (isl-org/DeepLagrangianFluids): a state dict, or one under ``model``.

    spacing [m], frame_step [s]: those of its data, which the file does not hold (the defaults are the published ones'). Filter size and channels
    follow from the shapes, gravity is in the file. The box of its spec, the unit cube, means nothing: a rollout brings its own, whose walls should
    lie 0.7 spacings from water at rest, as in its data, not half a spacing as ours do (``benchmarks/cconv.py``). Reads weights only and runs no
    code; every fault of the file is an ``InputError``.
    """
    path = Path(path)
    content = read_content(path, "cpu", "published CConv", "copy the file again")
    weights = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(weights, dict) or not all(isinstance(name, str) and isinstance(value, Tensor) for name, value in weights.items()):
        raise InputError(path, "state_dict", type(weights).__name__, "must map names to tensors; give a file of the original's training program")
    remedy = "not the original's network; give a file of its training program"

    def shape(name: str, axes: int) -> torch.Size:
        found = weights.get(name)
        if found is None or found.ndim != axes:
            raise InputError(path, name, None if found is None else list(found.shape), f"must be a tensor of {axes} axes; {remedy}")
        return found.shape

    kernel, count = shape("conv0_fluid.kernel", 5), sum(name.startswith("conv") and name.endswith(".kernel") for name in weights) - 2
    channels = [kernel[4]] + [shape(f"conv{k}.kernel", 5)[4] for k in range(1, count)]
    if len(set(kernel[:3])) != 1 or kernel[3] != 4:
        raise InputError(path, "conv0_fluid.kernel", list(kernel), "must have cubic filters and 4 input channels, 1 and the velocity")
    gravity = tuple(weights["gravity"].double().flatten().tolist()) if "gravity" in weights else ()
    try:
        spec = DataSpec(
            dim=3,
            bounds=((0.0, 1.0),) * 3,
            radius=2.25 * spacing,
            spacing=spacing,
            frame_step=frame_step,
            stride=1,
            gravity=gravity,
            particle_types=(PARTICLE_TYPES["water"],),
            velocity_mean=(0.0,) * 3,
            acceleration_mean=(0.0,) * 3,
            # Scales of its input and output: 1 m / s and 1 / 128 m.
            velocity_std=(frame_step,) * 3,
            acceleration_std=(1 / 128,) * 3,
        )
        model = CConv(CConvSettings(channels=tuple(channels), kernel=kernel[0]), spec)
    except ValueError as error:
        raise InputError(path, "state_dict", str(error), remedy) from None
    names = {"conv0_fluid": "fluid", "conv0_obstacle": "boundary", "dense0_fluid": "dense"}
    for k in range(1, count + 1):
        names |= {f"conv{k}": f"layers.{k - 1}.conv", f"dense{k}": f"layers.{k - 1}.dense"}
    parts = {f"{module}.{part}" for module in names for part in ("bias", "kernel" if module.startswith("conv") else "weight")}
    unfit = parts ^ {name for name in weights if name != "gravity" and not name.endswith(".offset")}
    if unfit:
        raise InputError(path, "names", sorted(map(str, unfit))[:5], f"missing from or unknown to a network of {count + 1} layers; {remedy}")
    own = {}
    for name in parts:
        (module, part), value = name.split("."), weights[name]
        if part == "kernel" and value.ndim == 5:
            # [z, y, x, C_in, C_out] -> [C_in, cells, C_out]; x stays the fastest.
            value = value.flatten(0, 2).transpose(0, 1)
        own[f"network.{names[module]}.{'weight' if part == 'kernel' else part}"] = value.contiguous()
    load_weights(model, own, path)
    return model.eval()
