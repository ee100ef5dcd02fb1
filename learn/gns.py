"""GNS: message passing on the radius graph of the particles (Sanchez-Gonzalez et al., ICML 2020, arXiv 2002.09405).

Encoder, M blocks of message passing, decoder, exactly as published; ``tests/learn/textbook_gns.py`` holds the textbook form, with the
same parameters by name. What differs is the order of the arithmetic:

- The first layer of an edge's MLP is split, W [e, v_r, v_s] = W_e e + P[r] + Q[s], and P, Q and the node MLP's own share of v come from
  one product per particle instead of one per edge: a third fewer operations.
- The edges go through a block in runs of ``EDGE_BLOCK``, through all its layers at once, so that what a layer writes is still in the
  cache when the next one reads it. This alone doubles the speed of the matrix products. Forward and backward are written out for it.
- Edges are sorted by receiver, so messages are summed without scatter; gradients to senders are a gather along the reverse edges.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional as F

from learn.features import Features, InputScaling, random_walk_noise
from learn.graph import Graph, radius_graph
from sim.simulator import SimulationError, Start
from sim.trajectory import KINEMATIC_TYPE

if TYPE_CHECKING:
    from learn.dataset import DataSpec, Windows

#: Edges that go through an edge MLP together on the CPU: at latent 128 a float32 buffer of them takes half of a 512 KiB L2 cache.
EDGE_BLOCK = 512


class Settings(BaseModel):
    """Options of a GNS; the defaults are the paper's."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    latent: int = Field(128, ge=1)  # width of all hidden layers and latents
    hidden_layers: int = Field(2, ge=1)  # hidden layers of every MLP
    message_passing: int = Field(10, ge=1)  # M, blocks of the processor
    shared: bool = False  # one block, used M times
    history: int = Field(5, ge=1)  # C, velocities the model is given; the noise walks along all of them
    inputs: InputScaling = "velocity"  # what is made of them, see learn.features.Features; "acceleration" serves sparse impacts
    relative_velocity: bool = False  # relative velocity among the edge features
    radius: float | None = Field(None, gt=0)  # connectivity radius in particle spacings; None: the data's
    wall_distance: float | None = Field(None, gt=0)  # clamp of the wall distances in particle spacings; None: the connectivity radius
    noise: float = Field(0.3, ge=0)  # sigma of the last velocity's noise (the paper's 6.7e-4 is .25-.5 of its velocity std)
    noise_unit: Literal["velocity_std", "absolute"] = "velocity_std"  # of ``noise``: rms velocity std over the axes, or length / model frame
    ballistic: bool = False  # predictions start from gravity * dt^2 instead of the mean acceleration
    unroll: tuple[int, ...] = (1,)  # calls the loss is unrolled over, in equal shares of the training: (1, 2, 4)
    precision: Literal["f32", "bf16"] = "f32"  # of products and edge latents; particle latents, sums and weight gradients stay f32
    edge_cap: float = Field(4.0, gt=1)  # a rollout fails when its edges exceed this multiple of their first number (it clumps)


class MLP(nn.Module):
    """Linear layers with ReLU between; LayerNorm at the end unless ``norm`` is False.

    Weights N(0, 1 / fan_in), truncated at two standard deviations, biases 0, as in the original.
    """

    def __init__(self, inputs: int, latent: int, hidden_layers: int, outputs: int, norm: bool = True):
        super().__init__()
        widths = [inputs, *[latent] * hidden_layers, outputs]
        self.linears = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.norm = nn.LayerNorm(outputs) if norm else None
        for linear in self.linears:
            std = 1 / math.sqrt(linear.in_features)
            nn.init.trunc_normal_(linear.weight, std=std, a=-2 * std, b=2 * std)
            nn.init.zeros_(linear.bias)

    def rest(self) -> list[Tensor]:
        """Weight, bias of every layer but the first, then LayerNorm's weight and bias."""
        return [p for linear in self.linears[1:] for p in (linear.weight, linear.bias)] + [self.norm.weight, self.norm.bias]

    def forward(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """[rows, inputs] -> [rows, outputs], products in ``dtype``, the result in the parameters' type."""
        return self.finish(_linear(x, self.linears[0].weight, self.linears[0].bias, dtype), dtype)

    def finish(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """All that follows the first linear layer."""
        for linear in self.linears[1:]:
            x = _linear(x.relu(), linear.weight, linear.bias, dtype)
        x = x.to(self.linears[0].weight.dtype)
        return x if self.norm is None else self.norm(x)


def _linear(x: Tensor, weight: Tensor, bias: Tensor | None, dtype: torch.dtype) -> Tensor:
    return F.linear(x.to(dtype), weight.to(dtype), None if bias is None else bias.to(dtype))


def _layer_norm_backward(gradient: Tensor, z: Tensor, mean: Tensor, rstd: Tensor, gamma: Tensor, beta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return torch.ops.aten.native_layer_norm_backward(gradient, z, [z.shape[1]], mean, rstd, gamma, beta, [True, True, True])


def _block_sum(values: Tensor, order: Tensor, offsets: Tensor) -> Tensor:
    """[n, width]: sum over ``values[order[offsets[i]:offsets[i + 1]]]``, one pass, no scatter."""
    return torch.embedding_bag(values, order, offsets, mode=0, include_last_offset=True)[0]


class _EdgeUpdate(torch.autograd.Function):
    """The edge MLP of one block, run by run: messages m = MLP[e, v_r, v_s], their sums over the receivers, and e + m.

    forward(graph, dtype, p, q, edges, first, rest...): p, q [particles, latent]: the receiver's and the sender's share of the first
    layer, its bias included in p; edges [edges, latent]; first [latent, latent]: the edges' share of the first weight; rest: as
    ``MLP.rest``. Returns sums [particles, latent] (parameters' type) and edges + m (in ``dtype``).
    """

    @staticmethod
    def forward(ctx, graph: Graph, dtype: torch.dtype, p: Tensor, q: Tensor, edges: Tensor, first: Tensor, *rest: Tensor):
        *layers, gamma, beta = rest
        weights, biases = [w.to(dtype) for w in layers[::2]], [b.to(dtype) for b in layers[1::2]]
        count, latent = len(edges), len(first)
        hidden = [torch.empty(count, latent, dtype=dtype, device=edges.device) for _ in weights]
        z, mean, rstd = torch.empty(count, latent, dtype=dtype, device=edges.device), gamma.new_empty(count, 1), gamma.new_empty(count, 1)
        updated = torch.empty_like(edges)
        sums = gamma.new_empty(graph.particles, latent)
        order = torch.arange(count, dtype=torch.int32, device=edges.device)
        first_t = first.to(dtype).t()
        for block in graph.blocks(_run(edges)):
            run = block.edges
            x = torch.index_select(p, 0, graph.receiver[run], out=hidden[0][run])
            x.add_(q.index_select(0, graph.sender[run])).addmm_(edges[run], first_t).relu_()
            for k in range(1, len(weights)):
                x = torch.addmm(biases[k - 1], x, weights[k - 1].t(), out=hidden[k][run]).relu_()
            x = torch.addmm(biases[-1], x, weights[-1].t(), out=z[run])
            message, mean[run], rstd[run] = torch.native_layer_norm(x.to(gamma.dtype), (latent,), gamma, beta, 1e-5)
            sums[block.receivers] = _block_sum(message, order[: len(message)], block.offsets)
            torch.add(edges[run], message.to(dtype), out=updated[run])
        ctx.graph, ctx.dtype = graph, dtype
        ctx.save_for_backward(edges, first, gamma, beta, z, mean, rstd, *hidden, *layers[::2])
        return sums, updated

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_sums: Tensor, grad_updated: Tensor):
        graph, dtype = ctx.graph, ctx.dtype
        edges, first, gamma, beta, z, mean, rstd, *others = ctx.saved_tensors
        half = len(others) // 2
        hidden, weights = others[:half], [w.to(dtype) for w in others[half:]]
        first_d = first.to(dtype)
        grad_first = torch.zeros_like(first)
        grad_weights = [torch.zeros_like(w) for w in others[half:]]
        grad_biases = [torch.zeros_like(gamma) for _ in weights]
        grad_gamma, grad_beta = torch.zeros_like(gamma), torch.zeros_like(beta)
        grad_edges = torch.empty_like(edges)
        grad_input = torch.empty_like(edges)  # of the first layer's sum, which is what each edge sends back to p and q
        grad_p = torch.empty_like(grad_sums, dtype=dtype)
        order = torch.arange(len(edges), dtype=torch.int32, device=edges.device)
        for block in graph.blocks(_run(edges)):
            run = block.edges
            gradient = grad_sums.index_select(0, graph.receiver[run])
            gradient.add_(grad_updated[run])
            gradient, gamma_part, beta_part = _layer_norm_backward(gradient, z[run].to(gamma.dtype), mean[run], rstd[run], gamma, beta)
            grad_gamma += gamma_part
            grad_beta += beta_part
            gradient = gradient.to(dtype)
            for k in reversed(range(len(weights))):
                grad_weights[k] += gradient.t() @ hidden[k][run]
                grad_biases[k] += gradient.sum(0)
                out = grad_input[run] if k == 0 else torch.empty_like(gradient)
                gradient = torch.mm(gradient, weights[k], out=out)
                torch.ops.aten.threshold_backward(gradient, hidden[k][run], 0, grad_input=gradient)
            grad_first += gradient.t() @ edges[run]
            torch.addmm(grad_updated[run], gradient, first_d, out=grad_edges[run])
            grad_p[block.receivers] = _block_sum(gradient, order[: len(gradient)], block.offsets)
        grad_q = _block_sum(grad_input, graph.reverse, graph.offsets)
        layers = [g for pair in zip(grad_weights, grad_biases, strict=True) for g in pair]
        return None, None, grad_p, grad_q, grad_edges, grad_first, *layers, grad_gamma, grad_beta


def _run(edges: Tensor) -> int:
    """Edges in one run: a cache's worth on the CPU, all of them on a device that is bound by launches."""
    return EDGE_BLOCK if edges.device.type == "cpu" else max(len(edges), 1)


class Interaction(nn.Module):
    """One block of message passing: m = MLP_e[e, v_r, v_s], v += MLP_v[sum of m over incoming edges, v], e += m."""

    def __init__(self, latent: int, hidden_layers: int):
        super().__init__()
        self.edge = MLP(3 * latent, latent, hidden_layers, latent)
        self.node = MLP(2 * latent, latent, hidden_layers, latent)
        self.latent = latent

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """nodes [particles, latent], edges [edges, latent] -> both, updated."""
        d = self.latent
        edge, node = self.edge.linears[0], self.node.linears[0]
        weight = torch.cat([edge.weight[:, d : 2 * d], edge.weight[:, 2 * d :], node.weight[:, d:]])
        bias = torch.cat([edge.bias, torch.zeros_like(edge.bias), node.bias])
        p, q, own = _linear(nodes, weight, bias, dtype).split(d, 1)
        sums, edges = _EdgeUpdate.apply(graph, dtype, p.contiguous(), q.contiguous(), edges, edge.weight[:, :d], *self.edge.rest())
        update = self.node.finish(own + _linear(sums, node.weight[:, :d], None, dtype), dtype)
        return nodes + update, edges


class Network(nn.Module):
    """Encode, process, decode: node and edge features to the normalised acceleration."""

    def __init__(self, settings: Settings, node_width: int, edge_width: int, dim: int):
        super().__init__()
        latent, hidden = settings.latent, settings.hidden_layers
        self.encode_node = MLP(node_width, latent, hidden, latent)
        self.encode_edge = MLP(edge_width, latent, hidden, latent)
        self.repeats = settings.message_passing if settings.shared else 1
        self.processor = nn.ModuleList(Interaction(latent, hidden) for _ in range(settings.message_passing // self.repeats))
        self.decode = MLP(latent, latent, hidden, dim, norm=False)
        self.low_precision = settings.precision == "bf16"

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph) -> Tensor:
        """nodes [particles, node_width], edges [edges, edge_width] -> [particles, dim]."""
        dtype = torch.bfloat16 if self.low_precision else nodes.dtype
        nodes = self.encode_node(nodes, dtype)
        edges = self.encode_edge(edges, dtype).to(dtype)
        for _ in range(self.repeats):
            for block in self.processor:
                nodes, edges = block(nodes, edges, graph, dtype)
        return self.decode(nodes, dtype)


class GNS(nn.Module):
    """The learned simulator: features, network, semi-implicit Euler v' = v + a, p' = p + v' with dt = 1 (``learn.model.LearnedModel``)."""

    Settings: ClassVar[type[BaseModel]] = Settings
    kind: ClassVar[str] = "learned"
    name = "gns"

    def __init__(self, settings: Settings, spec: DataSpec):
        super().__init__()
        self.options, self.settings, self.spec = settings, settings.model_dump(mode="json"), spec
        self.velocities = settings.history
        self.history = self.velocities * spec.stride + 1
        scale = math.sqrt(sum(s * s for s in spec.velocity_std) / spec.dim) if settings.noise_unit == "velocity_std" else 1.0
        self.sigma = settings.noise * scale
        self.radius = spec.radius if settings.radius is None else settings.radius * spec.spacing
        self.features = Features(
            spec, sigma=self.sigma, velocities=self.velocities, radius=self.radius, scaling=settings.inputs,
            wall_distance=self.radius if settings.wall_distance is None else settings.wall_distance * spec.spacing,
            relative_velocity=settings.relative_velocity, ballistic=settings.ballistic,
        )
        self.network = Network(settings, self.features.node_width, self.features.edge_width, spec.dim)

    def calls(self, progress: float) -> int:
        """Model calls the loss is unrolled over at this share of the training."""
        unroll = self.options.unroll
        return unroll[min(int(progress * len(unroll)), len(unroll) - 1)]

    def window(self, progress: float) -> int:
        return self.velocities + 1 + self.calls(progress)

    def loss(self, windows: Windows, generator: torch.Generator, progress: float) -> Tensor:
        """Squared error of the normalised acceleration, summed over axes, averaged over particles that move.

        The window's input gets a random-walk noise; the target is the acceleration that brings the *noisy* last velocity to the true
        next one (later positions are shifted by the last position's noise). Unrolled over several calls, call j is judged by its
        position: error / (acceleration std * j (j + 1) / 2), the number of times an acceleration error has entered it by then; the
        mean over the calls is returned, which for one call is the paper's loss.
        """
        given = self.velocities + 1
        moving = self.features.moving(windows.particle_type)
        noise = random_walk_noise(windows.position[:given], self.sigma, generator, moving)
        position = windows.position[:given] + noise
        total = position.new_zeros(())
        calls = len(windows.position) - given
        for call in range(1, calls + 1):
            context = windows.context[given + call - 2][windows.example] if self.features.context else None
            graph = radius_graph(position[-1], self.radius, windows.example)
            output = self._predict(position, graph, windows.particle_type, self.features.bounds, context)
            following = windows.position[given + call - 1] + noise[-1]
            error = (output - self.features.target(position, following)) / (call * (call + 1) / 2)
            square = error.square().sum(1)
            total = total + (square if moving is None else square[moving]).mean()
            if call < calls:
                predicted = 2 * position[-1] - position[-2] + self.features.acceleration(output)
                if moving is not None:
                    predicted = torch.where(moving[:, None], predicted, following)
                position = torch.cat([position[1:], predicted[None]])
        return total / calls

    def _predict(self, position: Tensor, graph: Graph, particle_type: Tensor, bounds: Tensor, context: Tensor | None) -> Tensor:
        return self.network(self.features.nodes(position, particle_type, bounds, context), self.features.edges(position, graph), graph)

    def begin(self, start: Start) -> None:
        """Take the last C + 1 model frames of the start. Raises ``ValueError`` on a start that is not of the model's kind."""
        spec = self.spec
        if start.history.shape[2] != spec.dim:
            raise ValueError(f"the start has {start.history.shape[2]} dimensions, the model {spec.dim}")
        if len(start.history) < self.history:
            raise ValueError(f"the start has {len(start.history)} frames, the model needs {self.history}")
        if not math.isclose(start.frame_step, spec.frame_step, rel_tol=1e-6):
            raise ValueError(f"the start's frame step is {start.frame_step} s, the model's {spec.frame_step} s")
        unknown = sorted(set(np.unique(start.particle_type).tolist()) - set(spec.particle_types))
        if unknown:
            raise ValueError(f"particle types {unknown} are not among the model's {list(spec.particle_types)}")
        device = self.features.bounds.device
        # Positions in float64: differences of float32 positions lose the last digits of small accelerations, frame after frame.
        frames = start.history[len(start.history) - self.history :: spec.stride].astype(np.float64)
        self._position = torch.from_numpy(frames).to(device)
        self._type = torch.from_numpy(start.particle_type.astype(np.int64)).to(device)
        self._bounds = torch.as_tensor(np.asarray(start.bounds, np.float64), device=device)
        self._start, self._present, self._first_edges = start, start.present, None

    @torch.inference_mode()
    def advance(self) -> np.ndarray:
        """The next ``stride`` frames: one prediction, linear in between. Raises ``SimulationError`` when the particles clump."""
        start, stride, count = self._start, self.spec.stride, self._position.shape[1]
        context = None
        if self.features.context:
            row = torch.as_tensor(start.context[min(self._present, len(start.context) - 1)], device=self._position.device)
            context = row.expand(count, -1)
        graph = radius_graph(self._position[-1], self.radius)
        self._first_edges = self._first_edges or graph.edges
        if graph.edges > self.options.edge_cap * self._first_edges:
            raise SimulationError(f"particles clump: {graph.edges} edges, {self.options.edge_cap:g} x the {self._first_edges} of the start exceeded")
        output = self._predict(self._position, graph, self._type, self._bounds, context)
        last = self._position[-1]
        following = 2 * last - self._position[-2] + self.features.acceleration(output)
        share = torch.arange(1, stride + 1, dtype=last.dtype, device=last.device)[:, None, None] / stride
        frames = last + share * (following - last)
        if start.kinematic is not None:
            known = np.minimum(self._present + 1 + np.arange(stride), len(start.kinematic) - 1)
            frames[:, self._type == KINEMATIC_TYPE] = torch.as_tensor(start.kinematic[known], dtype=last.dtype, device=last.device)
        self._position = torch.cat([self._position[1:], frames[-1:]])
        self._present += stride
        return frames.to("cpu", torch.float32).numpy()
