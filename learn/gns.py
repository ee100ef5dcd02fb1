"""GNS: message passing on the radius graph of the particles (Sanchez-Gonzalez et al., ICML 2020, arXiv 2002.09405).

Encoder, M blocks of message passing, decoder, exactly as published; ``tests/learn/textbook_gns.py`` holds the textbook form, with the
same parameters by name. What differs is the order of the arithmetic:

- The first layer of an edge's MLP is split, W [e, v_r, v_s] = W_e e + W_r v_r + W_s v_s, and the last two are computed once per
  particle instead of once per edge: two fifths fewer operations.
- The edges go through a block in runs (``Graph.runs``), through all its layers at once, so that what a layer writes is still in the
  cache when the next one reads it. Forward and backward are written out for it.
- Edges are sorted by receiver, so messages are summed without scatter; gradients to senders are gathered along the reverse edges.

Large graphs spend a few per cent of a training step on page faults; MALLOC_TRIM_THRESHOLD_ and MALLOC_MMAP_THRESHOLD_ (glibc, say
10000000000) in the environment avoid them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, PositiveInt, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from learn import tiles
from learn.features import Features, InputScaling, NoiseScheme, velocity_noise
from learn.graph import Graph, radius_graph
from learn.model import check_start
from learn.relaxation import Relaxation, relax
from sim import periodic
from sim.simulator import SimulationError, Start
from sim.trajectory import KINEMATIC_TYPE

if TYPE_CHECKING:
    from learn.dataset import DataSpec, Windows
    from learn.fused import Search, Shadow
    from learn.gns_replay import GNSRoom, RolloutReplay

#: Added to the variance by every LayerNorm (torch's default).
NORM_EPSILON = 1e-5


class GNSSettings(BaseModel):
    """Options of a GNS; the defaults are the paper's."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    latent: int = Field(128, ge=1)  # width of all hidden layers and latents
    hidden_layers: int = Field(2, ge=1)  # hidden layers of every MLP
    message_passing: int = Field(10, ge=1)  # M, blocks of the processor
    shared: bool = False  # one block, used M times
    edge_update: bool = True  # blocks update the edges as well, e += m; without it they see the encoded edges alone, as in a port's older models
    history: int = Field(5, ge=1)  # C, velocities the model is given; the noise is on all of them
    inputs: InputScaling = "velocity"  # what is made of them, see learn.features.Features; "acceleration" serves sparse impacts
    encoder: Literal["relative", "absolute"] = "relative"  # absolute: places in the box on the nodes, a learnt constant on the edges
    relative_velocity: bool = False  # relative velocity among the edge features
    self_edges: bool = True  # every particle also sends to itself
    radius: float | None = Field(None, gt=0)  # connectivity radius in particle spacings; None: the data's
    wall_distance: float | None = Field(None, gt=0)  # clamp of the wall distances in particle spacings; None: the connectivity radius
    noise: float = Field(0.3, ge=0, le=1e6)  # sigma of the last velocity's noise (the paper's 6.7e-4 is .25-.5 of its velocity std)
    noise_unit: Literal["velocity_std", "absolute"] = "velocity_std"  # of ``noise``: rms velocity std over the axes, or length / model frame
    noise_scheme: NoiseScheme = "random_walk"  # see learn.features.velocity_noise
    ballistic: bool = False  # predictions start from gravity * dt^2 instead of the mean acceleration
    walls: bool = False  # with ``ballistic``: that flight stops at the walls; nothing stops a wrong prediction, so escapes stay visible
    unroll: tuple[PositiveInt, ...] = Field((1,), min_length=1)  # calls the loss is unrolled over, in equal shares of the training: (1, 2, 4)
    flight_below: int = Field(0, ge=0)  # with ``ballistic``: particles with fewer neighbours than this fly; nothing is near that could hold them up
    # Impacts hold most of the acceleration's variance in a per cent of the particles: beyond this many standard deviations an error counts
    # linearly (Charbonnier's loss 2 h^2 (sqrt(1 + e^2 / h^2) - 1)); None: squared, as in the paper.
    huber: float | None = Field(None, gt=0)
    # Of products and edge latents; particle latents, sums and weight gradients stay f32. A CPU without bf16 units (AMX, AVX-512 BF16)
    # emulates bf16, many times slower than f32.
    precision: Literal["f32", "bf16"] = "f32"
    relaxation: Relaxation | None = None  # of rollouts: crowded particles are pushed apart after every call, see learn.relaxation
    edge_cap: float = Field(4.0, gt=1)  # a rollout fails when its edges exceed this multiple of their first number (it clumps)

    @model_validator(mode="after")
    def _go_together(self) -> GNSSettings:
        if self.walls and not self.ballistic:
            raise ValueError("walls stops the ballistic flight; set ballistic: true with it")
        if self.flight_below and not self.ballistic:
            raise ValueError("flight_below means ballistic flight; set ballistic: true with it")
        if self.relative_velocity and self.encoder == "absolute":
            raise ValueError("relative_velocity is a feature of the edges, which the absolute encoder does not see; set encoder: relative")
        return self


class MLP(nn.Module):
    """Linear layers with ReLU between; LayerNorm at the end unless ``norm`` is False.

    Weights N(0, 1 / fan_in), truncated at two standard deviations, biases 0, as in the original.
    """

    def __init__(self, inputs: int, latent: int, hidden_layers: int, outputs: int, norm: bool = True):
        super().__init__()
        widths = [inputs, *[latent] * hidden_layers, outputs]
        self.linears = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.norm = nn.LayerNorm(outputs, eps=NORM_EPSILON) if norm else None
        for linear in self.linears:
            std = 1 / math.sqrt(linear.in_features)
            nn.init.trunc_normal_(linear.weight, std=std, a=-2 * std, b=2 * std)
            nn.init.zeros_(linear.bias)

    def rest(self) -> list[Tensor]:
        """Weight, bias of every layer but the first, then LayerNorm's weight and bias."""
        assert self.norm is not None
        return [p for linear in self.linears[1:] for p in (linear.weight, linear.bias)] + [self.norm.weight, self.norm.bias]

    def tiled(self, dtype: torch.dtype) -> bool:
        """Whether ``tiles.mlp`` can take this: for rollouts, which need no gradient."""
        widths, weight = {linear.out_features for linear in self.linears}, self.linears[0].weight
        if self.norm is None or len(widths) > 1 or torch.is_grad_enabled():
            return False
        return tiles.supports(widths.pop(), len(self.linears) - 1, dtype, weight)

    def tiles(self, inputs: list[Tensor], dtype: torch.dtype, out: Tensor, residual: bool = False) -> Tensor:
        """``tiles.mlp`` of this."""
        assert self.norm is not None
        norm = (self.norm.weight, self.norm.bias, NORM_EPSILON)
        return tiles.mlp(inputs, [(linear.weight, linear.bias) for linear in self.linears], norm, dtype, out, residual)

    def forward(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """[rows, inputs] -> [rows, outputs], products in ``dtype``, the result in the parameters' type."""
        if self.tiled(dtype):
            return self.tiles([x], dtype, self.linears[0].weight.new_empty(len(x), self.linears[-1].out_features))
        return self.finish(_linear(x, self.linears[0].weight, self.linears[0].bias, dtype), dtype)

    def finish(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """All that follows the first linear layer."""
        for linear in self.linears[1:]:
            x = _linear(x.relu(), linear.weight, linear.bias, dtype)
        x = x.to(self.linears[0].weight.dtype)
        return x if self.norm is None else self.norm(x)


def _linear(x: Tensor, weight: Tensor, bias: Tensor | None, dtype: torch.dtype) -> Tensor:
    return F.linear(x.to(dtype), weight.to(dtype), None if bias is None else bias.to(dtype))


def _bag_sum(values: Tensor, order: Tensor, offsets: Tensor) -> Tensor:
    """[n, width]: sums of ``values[order[offsets[i]:offsets[i + 1]]]``, gathered and summed in one pass."""
    return torch.embedding_bag(values, order, offsets, mode=0, include_last_offset=True)[0]


def _edge_pass(graph: Graph, dtype: torch.dtype, table: Tensor, edges: Tensor, first: Tensor, rest: tuple[Tensor, ...], update: bool, keep: bool):
    """Messages m = MLP[e, v_r, v_s], their sums over each receiver's edges, and e + m (None without ``update``), one run of edges after the other.

    table [particles, 2, latent]: the particles' share of the first layer, as receiver (bias included) and as sender; edges
    [edges, latent]; first [latent, latent]: the edges' share of the first weight; rest: as ``MLP.rest``. Returns sums [particles, latent]
    (parameters' type), e + m (in ``dtype``), and what backward needs: the hidden layers, the last linear output, its mean and 1 / std.
    Without ``keep`` e is updated in place and one run's buffers serve all.
    """
    if tiles.supports(table.shape[2], len(rest) // 2 - 1, dtype, first):
        return tiles.edge_pass(graph, table, edges, first, rest, NORM_EPSILON, update, keep)
    *layers, gamma, beta = rest
    weights, biases = [w.to(dtype).t() for w in layers[::2]], [b.to(dtype) for b in layers[1::2]]
    first, rows = first.to(dtype).t(), table.flatten(0, 1)
    count, latent = len(edges) if keep else max(len(run.order) for run in graph.runs), len(gamma)
    hidden = [edges.new_empty(count, latent) for _ in weights]
    z, mean, rstd = edges.new_empty(count, latent), gamma.new_empty(count, 1), gamma.new_empty(count, 1)
    updated = None if not update else torch.empty_like(edges) if keep else edges
    sums = gamma.new_empty(graph.particles, latent)
    twos = torch.arange(0, 2 * max(len(run.order) for run in graph.runs) + 1, 2, dtype=torch.int32, device=edges.device)
    for run in graph.runs:
        size = len(run.order)
        kept = run.edges if keep else slice(size)
        x = _bag_sum(rows, run.pairs, twos[: size + 1]).addmm_(edges[run.edges], first)
        x = torch.clamp_min(x, 0, out=hidden[0][kept])
        for k in range(1, len(weights)):
            x = torch.addmm(biases[k - 1], x, weights[k - 1], out=hidden[k][kept]).relu_()
        x = torch.addmm(biases[-1], x, weights[-1], out=z[kept])
        x = x if x.device.type == "cpu" else x.to(gamma.dtype)  # the CPU's kernel takes bf16 with weights in f32, and is spared a copy
        message, mean[kept], rstd[kept] = torch.native_layer_norm(x, (latent,), gamma, beta, NORM_EPSILON)
        sums[run.receivers] = _bag_sum(message, run.order, run.offsets)
        if updated is not None:
            torch.add(edges[run.edges], message.to(dtype), out=updated[run.edges])
    return sums, updated, (*hidden, z, mean, rstd)


def _edge_pass_in_place(graph: Graph, dtype: torch.dtype, update: bool, table: Tensor, edges: Tensor, first: Tensor, *rest: Tensor):
    return _edge_pass(graph, dtype, table, edges, first, rest, update, keep=False)[:2]


class _EdgeUpdate(torch.autograd.Function):
    """``_edge_pass`` with its gradient, run by run as well."""

    @staticmethod
    def forward(ctx, graph: Graph, dtype: torch.dtype, update: bool, table: Tensor, edges: Tensor, first: Tensor, *rest: Tensor):
        sums, updated, kept = _edge_pass(graph, dtype, table, edges, first, rest, update, keep=True)
        ctx.graph, ctx.dtype, ctx.layers = graph, dtype, len(rest) // 2 - 1
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(edges, first, *rest, *kept)
        return sums, updated

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_sums: Tensor, grad_updated: Tensor | None):
        graph, dtype, n = ctx.graph, ctx.dtype, ctx.layers
        edges, first, *saved = ctx.saved_tensors
        if tiles.supports(edges.shape[1], n, dtype, first):
            rest, kept = saved[: 2 * n + 2], saved[2 * n + 2 :]
            grad_edges = torch.zeros_like(edges) if grad_updated is None else grad_updated.contiguous()
            grad_table, grad_input, grad_first, rest = tiles.edge_gradient(graph, edges, first, rest, kept, grad_sums, grad_edges)
            grad_table[:, 1] = _bag_sum(grad_input, graph.reverse, graph.offsets)
            return None, None, None, grad_table, grad_edges, grad_first, *rest
        weights, (gamma, beta), (*hidden, z, mean, rstd) = saved[: 2 * n : 2], saved[2 * n : 2 * n + 2], saved[2 * n + 2 :]
        grad_first, grad_weights = torch.zeros_like(first), [torch.zeros_like(w) for w in weights]
        grad_biases = [torch.zeros_like(gamma) for _ in weights]
        grad_gamma, grad_beta = torch.zeros_like(gamma), torch.zeros_like(beta)
        first, weights = first.to(dtype), [w.to(dtype) for w in weights]
        # ``Network`` hands e + m to the next block alone, so its gradient is nobody else's: it becomes e's own in place.
        grad_edges = torch.zeros_like(edges) if grad_updated is None else grad_updated.contiguous()
        grad_input = torch.empty_like(edges)  # of the first layer's sum: what every edge sends back to its two particles
        grad_table = edges.new_empty(graph.particles, 2, len(gamma))
        for run in graph.runs:
            at = run.edges
            gradient = grad_sums.index_select(0, graph.receiver[at])
            gradient.add_(grad_edges[at])
            gradient, gamma_part, beta_part = torch.ops.aten.native_layer_norm_backward(
                gradient, z[at].to(gamma.dtype), [len(gamma)], mean[at], rstd[at], gamma, beta, [True, True, True]
            )
            grad_gamma += gamma_part
            grad_beta += beta_part
            gradient = gradient.to(dtype)
            for k in reversed(range(n)):
                grad_weights[k] += gradient.t() @ hidden[k][at]
                grad_biases[k] += gradient.sum(0, dtype=gamma.dtype)
                gradient = gradient @ weights[k]
                out = grad_input[at] if k == 0 else gradient
                gradient = torch.ops.aten.threshold_backward.grad_input(gradient, hidden[k][at], 0, grad_input=out)
            grad_first += gradient.t() @ edges[at]
            grad_edges[at].addmm_(gradient, first)
            grad_table[run.receivers, 0] = _bag_sum(gradient, run.order, run.offsets)
        grad_table[:, 1] = _bag_sum(grad_input, graph.reverse, graph.offsets)
        layers = [gradient for pair in zip(grad_weights, grad_biases, strict=True) for gradient in pair]
        return None, None, None, grad_table, grad_edges, grad_first, *layers, grad_gamma, grad_beta


class Interaction(nn.Module):
    """One block of message passing: m = MLP_e[e, v_r, v_s], v += MLP_v[sum of m over incoming edges, v], e += m if ``edge_update``."""

    def __init__(self, latent: int, hidden_layers: int, edge_update: bool):
        super().__init__()
        self.edge = MLP(3 * latent, latent, hidden_layers, latent)
        self.node = MLP(2 * latent, latent, hidden_layers, latent)
        self.latent, self.edge_update = latent, edge_update

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """nodes [particles, latent], edges [edges, latent] -> both, updated."""
        d = self.latent
        edge, node = self.edge.linears[0], self.node.linears[0]
        weight = torch.cat([edge.weight[:, d : 2 * d], edge.weight[:, 2 * d :]])
        table = _linear(nodes, weight, F.pad(edge.bias, (0, d)), dtype).view(-1, 2, d)
        step = _EdgeUpdate.apply if torch.is_grad_enabled() else _edge_pass_in_place
        sums, updated = step(graph, dtype, self.edge_update, table, edges, edge.weight[:, :d], *self.edge.rest())
        if self.node.tiled(dtype):
            return self.node.tiles([sums, nodes], dtype, nodes, residual=True), edges if updated is None else updated
        own = _linear(nodes, node.weight[:, d:], node.bias, dtype)
        update = self.node.finish(own + _linear(sums, node.weight[:, :d], None, dtype), dtype)
        return nodes + update, edges if updated is None else updated


class Network(nn.Module):
    """Encode, process, decode: node and edge features to the normalised acceleration."""

    def __init__(self, settings: GNSSettings, node_width: int, edge_width: int, dim: int):
        super().__init__()
        latent, hidden = settings.latent, settings.hidden_layers
        self.encode_node = MLP(node_width, latent, hidden, latent)
        absolute = settings.encoder == "absolute"
        self.encode_edge = nn.Parameter(torch.zeros(latent)) if absolute else MLP(edge_width, latent, hidden, latent)
        self.repeats = settings.message_passing if settings.shared else 1
        self.processor = nn.ModuleList(Interaction(latent, hidden, settings.edge_update) for _ in range(settings.message_passing // self.repeats))
        self.decode = MLP(latent, latent, hidden, dim, norm=False)
        self.low_precision = settings.precision == "bf16"
        self.shadow: Shadow | None = None  # what fused kernels read, while it is they that run

    def forward(self, nodes: Tensor, edges: Tensor, graph: Any) -> Tensor:
        """nodes [particles, node_width], edges [edges, edge_width] -> [particles, dim]; graph: a ``Graph``, for fused kernels a ``PaddedGraph``."""
        if self.shadow is not None:
            from learn import fused  # not above: Triton comes with CUDA builds of torch alone

            return fused.forward(self, nodes, edges, graph)
        dtype = torch.bfloat16 if self.low_precision else nodes.dtype
        nodes = self.encode_node(nodes, dtype)
        if isinstance(self.encode_edge, nn.Parameter):
            edges = self.encode_edge.to(dtype).repeat(graph.edges, 1)
        elif self.encode_edge.tiled(dtype):
            edges = self.encode_edge.tiles([edges], dtype, nodes.new_empty(graph.edges, nodes.shape[1], dtype=dtype))
        else:
            edges = torch.cat([self.encode_edge(edges[run.edges], dtype).to(dtype) for run in graph.runs])
        for _ in range(self.repeats):
            for block in self.processor:
                nodes, edges = block(nodes, edges, graph, dtype)
        return self.decode(nodes, dtype)


@dataclass
class _State:
    """A rollout: positions [C + 1, particles, dim] float64, types, indices of kinematic particles (None: there are none), gravity [length / model
    frame^2], the frame it is at, edges of its first graph."""

    start: Start
    position: Tensor
    kinds: Tensor
    fixed: Tensor | None
    gravity: Tensor
    present: int
    first_edges: int | None = None

    @property
    def context(self) -> np.ndarray:
        """[c]: of the present frame."""
        assert self.start.context is not None
        return self.start.context[min(self.present, len(self.start.context) - 1)]

    def measure(self, edges: int) -> int:
        """The edges of the first graph are what later ones are measured by; without self edges there may be none."""
        self.first_edges = self.first_edges or max(edges, len(self.kinds))
        return self.first_edges

    def known(self, stride: int) -> Tensor | None:
        """[stride, k, dim]: where the kinematic particles are in the next frames."""
        if self.fixed is None or self.start.kinematic is None:
            return None
        places = self.start.kinematic[np.minimum(self.present + 1 + np.arange(stride), len(self.start.kinematic) - 1)]
        return torch.as_tensor(places, dtype=self.position.dtype, device=self.position.device)


class GNS(nn.Module):
    """The learned simulator: features, network, semi-implicit Euler v' = v + a, p' = p + v' with dt = 1 (``learn.model.LearnedModel``)."""

    Settings: ClassVar[type[BaseModel]] = GNSSettings
    kind: ClassVar[str] = "learned"
    name = "gns"

    def __init__(self, settings: GNSSettings, spec: DataSpec):
        super().__init__()
        self.options, self.settings, self.spec = settings, settings.model_dump(mode="json"), spec
        self.velocities = settings.history
        self.history = self.velocities * spec.stride + 1
        scale = math.sqrt(sum(s * s for s in spec.velocity_std) / spec.dim) if settings.noise_unit == "velocity_std" else 1.0
        self.sigma = settings.noise * scale
        self.radius = spec.radius if settings.radius is None else settings.radius * spec.spacing
        self.features = Features(
            spec,
            sigma=self.sigma,
            velocities=self.velocities,
            radius=self.radius,
            scaling=settings.inputs,
            wall_distance=self.radius if settings.wall_distance is None else settings.wall_distance * spec.spacing,
            absolute=settings.encoder == "absolute",
            relative_velocity=settings.relative_velocity,
            ballistic=settings.ballistic,
            walls=settings.walls,
        )
        self.network = Network(settings, self.features.node_width, self.features.edge_width, spec.dim)
        self.search: Search | None = None  # of graphs on the device, where steps are replayed

    def _graph(self, position: Tensor, example: Tensor | None, period: np.ndarray | None, present: Tensor | None = None) -> Graph:
        if self.search is not None:
            return self.search(position, example, present)
        return radius_graph(position, self.radius, example, self.options.self_edges, period)

    @property
    def replayable(self) -> bool:
        """Whether steps of this model can be CUDA graphs of fused kernels (``learn.fused``, ``learn.replay``): in bf16, in a box with walls, on a GPU
        that they were written for (Hopper; on others they were never run)."""
        device = self.features.bounds.device
        if device.type != "cuda" or not self.network.low_precision or self.spec.periodic or find_spec("triton") is None:
            return False
        from learn import fused

        return torch.cuda.get_device_capability(device) >= (9, 0) and fused.supports(self.network)

    def measure(self, windows: Windows) -> list[int]:
        """Edges of the first graph of ``windows``; at least the particles, as without self edges there may be none at first."""
        graph = radius_graph(windows.position[self.velocities], self.radius, windows.example, self.options.self_edges)
        return [max(graph.edges, windows.position.shape[1])]

    def make_room(self, capacity: list[int], examples: int) -> GNSRoom:
        """For steps on so many windows, whose graphs have at most ``capacity`` edges (``learn.replay``)."""
        from learn.gns_replay import GNSRoom

        return GNSRoom(self, np.asarray(self.spec.bounds), examples, *capacity)

    @contextmanager
    def using(self, room: GNSRoom) -> Iterator[None]:
        """One training step in ``room``, by the weights as they are now."""
        room.shadow.refresh()
        with room.used(self):
            yield

    def calls(self, progress: float) -> int:
        """Model calls the loss is unrolled over at this share of the training."""
        unroll = self.options.unroll
        return unroll[min(int(progress * len(unroll)), len(unroll) - 1)]

    def window(self, progress: float) -> int:
        return self.velocities + 1 + self.calls(progress)

    def loss(self, windows: Windows, generator: torch.Generator, progress: float) -> Tensor:
        """Squared error of the normalised acceleration, summed over axes, averaged over particles that move.

        The window's input gets noise (``noise_scheme``); the target is the acceleration that brings the *noisy* last velocity to the true
        next one (later positions are shifted by the last position's noise). Unrolled over several calls, call j is judged by its
        position: error / (acceleration std * j (j + 1) / 2), the number of times an acceleration error has entered it by then; the
        mean over the calls is returned, which for one call is the paper's loss.
        """
        return self.loss_under(self.noise(windows, generator), windows)

    def pick(self, windows: Windows, generator: torch.Generator) -> Windows:
        """All of them."""
        return windows

    def noise(self, windows: Windows, generator: torch.Generator) -> Tensor:
        """[C + 1, particles, dim]: of the positions a model is given, as ``loss`` draws it."""
        moving = self.features.moving(windows.particle_type)
        return velocity_noise(self.options.noise_scheme, windows.position[: self.velocities + 1], self.sigma, generator, moving, windows.place)

    def loss_under(self, noise: Tensor, windows: Windows) -> Tensor:
        """``loss`` with this noise."""
        given = self.velocities + 1
        moving, counted = self.features.moving(windows.particle_type), windows.counted
        judged = moving if counted is None else counted if moving is None else moving & counted
        present = None if counted is None else counted.sum(dtype=torch.int32).view(1)
        position = windows.position[:given] + noise
        total = position.new_zeros(())
        calls = len(windows.position) - given
        for call in range(1, calls + 1):
            context = None if windows.context is None else windows.context[given + call - 2][windows.example]
            graph = self._graph(position[-1], windows.example, self.features.period, present)
            output = self._predict(position, graph, windows.particle_type, self.features.bounds, context, self.features.period)
            following = windows.position[given + call - 1] + noise[-1]
            error = (output - self.features.target(position, following)) / (call * (call + 1) / 2)
            square = error.square().sum(1)
            if self.options.huber is not None:
                square = 2 * self.options.huber**2 * ((1 + square / self.options.huber**2).sqrt() - 1)
            total = total + (square.mean() if judged is None else torch.where(judged, square, 0).sum() / judged.sum())
            if call < calls:
                predicted = 2 * position[-1] - position[-2] + self.features.acceleration(output, position, self.features.bounds)
                if moving is not None:
                    predicted = torch.where(moving[:, None], predicted, following)
                position = torch.cat([position[1:], predicted[None]])
        return total / calls

    def _predict(
        self, position: Tensor, graph: Graph, particle_type: Tensor, bounds: Tensor, context: Tensor | None, period: np.ndarray | None = None
    ) -> Tensor:
        output = self.network(self.features.nodes(position, particle_type, bounds, context), self.features.edges(position, graph, period), graph)
        if self.options.flight_below:
            neighbours = graph.offsets.diff() - int(self.options.self_edges)
            output = output * (neighbours >= self.options.flight_below)[:, None]
        return output

    def begin(self, start: Start) -> None:
        """Take the last C + 1 model frames of the start. Raises ``ValueError`` on a start that is not of the model's kind."""
        self.begin_many([start])

    def begin_many(self, starts: Sequence[Start]) -> None:
        """Begin from several starts in one box, to be advanced together by ``advance_many``."""
        for start in starts:
            check_start(start, self.spec, self.history)
            axes = periodic.axes(start.scene)
            if axes != self.spec.periodic:
                raise ValueError(f"the start's box is periodic along {list(axes)}, the model's along {list(self.spec.periodic)}")
            if not np.array_equal(start.bounds, starts[0].bounds):
                raise ValueError(f"bounds {np.asarray(start.bounds).tolist()} beside {np.asarray(starts[0].bounds).tolist()}: one box a batch")
        device = self.features.bounds.device
        self._bounds = torch.as_tensor(starts[0].walls, device=device)
        self._states: list[_State] = []
        self._replay: RolloutReplay | None = None
        for start in starts:
            # Positions in float64: differences of float32 positions lose the last digits of small accelerations, frame after frame.
            frames = start.history[len(start.history) - self.history :: self.spec.stride].astype(np.float64)
            kinds = torch.from_numpy(start.particle_type.astype(np.int64)).to(device)
            fixed = None if start.kinematic is None else torch.from_numpy(np.flatnonzero(start.particle_type == KINEMATIC_TYPE)).to(device)
            gravity = torch.as_tensor(start.gravity * (start.frame_step * self.spec.stride) ** 2, dtype=torch.float64, device=device)
            self._states.append(_State(start, torch.from_numpy(frames).to(device), kinds, fixed, gravity, start.present))

    def advance(self) -> np.ndarray:
        """The next ``stride`` frames: one prediction, and frames between. Raises ``SimulationError`` when the particles clump."""
        (found,) = self.advance_many([0])
        if isinstance(found, SimulationError):
            raise found
        return found

    @torch.inference_mode()
    def advance_many(self, which: Sequence[int]) -> list[np.ndarray | SimulationError]:
        """``advance`` of these starts, as one graph: frames, or why there are none."""
        if self.replayable and self.options.relaxation is None:
            return self._replayed(list(which))
        states = [self._states[number] for number in which]
        counts = [state.position.shape[1] for state in states]
        position = torch.cat([state.position for state in states], 1)
        kinds, example = torch.cat([state.kinds for state in states]), None
        if len(states) > 1:
            example = torch.repeat_interleave(torch.tensor(counts))
        context = None
        if self.features.context:
            context = torch.as_tensor(np.repeat(np.stack([state.context for state in states]), counts, axis=0), device=position.device)
        period = states[0].start.period
        graph = radius_graph(position[-1], self.radius, example, self.options.self_edges, period)
        ends = np.cumsum([0, *counts])
        edges = graph.offsets[torch.from_numpy(ends)].diff().tolist()
        if failed := self._clumped(which, edges):
            return self._without(failed, which)
        output = self._predict(position, graph, kinds, self._bounds, context, period)
        acceleration = self.features.acceleration(output, position, self._bounds)
        return [self._follow(state, acceleration[first:last]) for state, first, last in zip(states, ends[:-1], ends[1:], strict=True)]

    def _clumped(self, which: Sequence[int], edges: Sequence[int]) -> dict[int, SimulationError]:
        """What has more edges than it may; the first numbers of edges set the measure."""
        failed = {}
        for number, own in zip(which, edges, strict=True):
            state = self._states[number]
            first = state.measure(own)
            if own > self.options.edge_cap * first:
                cap = f"{self.options.edge_cap:g} x the {first} of the start"
                failed[number] = SimulationError(f"particles clump: {own} edges, {cap} exceeded")
        return failed

    def _without(self, failed: dict[int, SimulationError], which: Sequence[int]) -> list[np.ndarray | SimulationError]:
        """``advance_many`` without what has clumped: its edges may be too many to go through."""
        others = [number for number in which if number not in failed]
        found = dict(zip(others, self.advance_many(others), strict=True)) if others else {}
        return [failed[number] if number in failed else found[number] for number in which]

    def _replayed(self, which: list[int]) -> list[np.ndarray | SimulationError]:
        from learn.gns_replay import RolloutReplay

        if self._replay is None or self._replay.which != which:
            if self._replay is not None:
                self._replay.release()
            self._replay = RolloutReplay(self, which, self._states, self._bounds)
        frames, edges = self._replay.compute()
        if failed := self._clumped(which, edges):
            return self._without(failed, which)
        self._replay.accept()
        return list(frames)

    def _follow(self, state: _State, acceleration: Tensor) -> np.ndarray:
        """The frames up to the one that an acceleration leads to."""
        start, known = state.start, state.known(self.spec.stride)
        following = self.following(state, state.position, acceleration, known)
        if self.options.relaxation is not None:
            fixed = None if state.fixed is None else (state.kinds == KINEMATIC_TYPE).cpu().numpy()
            relaxed = relax(following.cpu().numpy(), start.bounds, self.spec.spacing, self.options.relaxation, fixed, start.period)
            following = torch.from_numpy(relaxed).to(following.device)
        frames = self.between(state, state.position, acceleration, following, known)
        state.position = torch.cat([state.position[1:], frames[-1:]])
        state.present += self.spec.stride
        return periodic.wrapped(frames.cpu().numpy(), start.bounds, start.period).astype(np.float32)

    def following(self, state: _State, position: Tensor, acceleration: Tensor, known: Tensor | None) -> Tensor:
        """[particles, dim]: position [C + 1, particles, dim] one call on; known [stride, k, dim]: kinematic particles' positions until then."""
        following = 2 * position[-1] - position[-2] + acceleration
        return following if known is None else following.index_copy(0, state.fixed, known[-1])

    def between(self, state: _State, position: Tensor, acceleration: Tensor, following: Tensor, known: Tensor | None) -> Tensor:
        """[stride, particles, dim]: the frames up to ``following``.

        x(s) = x0 + s (x1 - x0) - s (1 - s) a / 2 with the predicted acceleration a kept between 0 and gravity: exact in free
        flight, straight through an impact, which a parabola would carry into the wall.
        """
        stride, last = self.spec.stride, position[-1]
        fall = acceleration.to(last.dtype).clamp(state.gravity.clamp(max=0), state.gravity.clamp(min=0))
        share = torch.arange(1, stride + 1, dtype=last.dtype, device=last.device)[:, None, None] / stride
        frames = last + share * (following - last) - share * (1 - share) / 2 * fall
        return frames if known is None else frames.index_copy(1, state.fixed, known)
