"""What a particle network sees: normalised node and edge features, the random-walk noise, the normalised acceleration.

After Sanchez-Gonzalez et al. (ICML 2020). Velocities and accelerations are finite differences with dt = 1, in length / model frame
and length / model frame^2. Nothing the data do not need is built: one particle type has no type embedding, data without context
no context columns.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor, nn

from learn.graph import Graph
from sim import periodic
from sim.trajectory import KINEMATIC_TYPE

if TYPE_CHECKING:
    from learn.dataset import DataSpec

#: Slots and width of the particle-type embedding of the original.
TYPE_SLOTS, TYPE_WIDTH = 9, 16

#: Below this a standard deviation is taken for zero (an axis without motion, a constant context).
SMALLEST_STD = 1e-8

InputScaling = Literal["velocity", "acceleration", "last"]
NoiseScheme = Literal["random_walk", "uncorrelated", "correlated", "last"]


def random_walk_noise(
    position: Tensor, sigma: float | Tensor, generator: torch.Generator, moving: Tensor | None = None, place: tuple[int, int] | None = None
) -> Tensor:
    """``velocity_noise`` as the paper has it, [frames, particles, dim]."""
    return velocity_noise("random_walk", position, sigma, generator, moving, place)


def velocity_noise(
    scheme: NoiseScheme,
    position: Tensor,
    sigma: float | Tensor,
    generator: torch.Generator,
    moving: Tensor | None = None,
    place: tuple[int, int] | None = None,
) -> Tensor:
    """Noise for a window of positions, summed up from noise of its C = frames - 1 velocities; [frames, particles, dim], zero in the first frame.

    By the paper's four schemes, in each of which the last velocity's noise is N(0, sigma^2) per axis, sigma [length / frame] (a number, or
    [dim]): "random_walk", every velocity adds N(0, sigma^2 / C) to the noise of the one before; "uncorrelated", every velocity has a draw of
    its own; "correlated", all have the same; "last", the last velocity alone. Particles outside ``moving`` [particles] get none.
    Drawn on the CPU, so that a seed means the same noise on every device; and for the whole batch of which these particles are a process's share
    (``place``: ``Windows.place``), so that it means the same on any number of processes.
    """
    frames, particles, dim = position.shape
    first, whole = place or (0, particles)
    draws = frames - 1 if scheme in ("random_walk", "uncorrelated") else 1
    velocity = torch.randn((draws, whole, dim), generator=generator, dtype=torch.float32)[:, first : first + particles].to(position.device)
    velocity = velocity * (sigma / math.sqrt(frames - 1) if scheme == "random_walk" else sigma)
    velocity = velocity.to(position)
    if scheme == "random_walk":
        velocity = velocity.cumsum(0)
    elif scheme == "correlated":
        velocity = velocity.expand(frames - 1, -1, -1)
    elif scheme == "last":
        velocity = torch.cat([torch.zeros_like(position[2:]), velocity])
    noise = torch.cat([torch.zeros_like(position[:1]), velocity.cumsum(0)])
    return noise if moving is None else noise * moving[:, None]


class Features(nn.Module):
    """Node and edge features and the scale of the acceleration, for one data set.

    spec: the data; sigma: noise of the last velocity [length / frame], which inflates every standard deviation to
    sqrt(std^2 + sigma^2); velocities: C, how many past velocities are seen; radius: of the connectivity [length]; wall_distance: where
    the distances to the walls are clamped [length]; scaling: "velocity", C velocities by velocity std (the paper); "acceleration", the
    last velocity by velocity std and the C - 1 past accelerations by acceleration std; "last", the last velocity alone;
    absolute: places in the training data's box on the nodes and nothing on the edges (the paper's absolute encoder; the other one knows
    relative places alone); relative_velocity: v_sender - v_receiver on the edges; ballistic: predictions start from gravity * dt^2, not from
    the mean acceleration; walls: that flight stops at the walls (slips along them), as the grid emulator's does, so that the stop need not
    be learnt.

    Along the periodic axes of ``spec`` there are no wall distances, and pairs are taken by nearest images; positions go on through the faces.
    ``bounds`` of the methods are [dim, 2], infinite along these axes, and ``period`` [dim] as in ``sim.periodic``. Raises ``ValueError``
    for absolute places in a periodic box.
    """

    def __init__(
        self,
        spec: DataSpec,
        *,
        sigma: float,
        velocities: int,
        radius: float,
        wall_distance: float,
        scaling: InputScaling,
        relative_velocity: bool,
        ballistic: bool,
        walls: bool = False,
        absolute: bool = False,
    ):
        super().__init__()
        if absolute and spec.periodic:
            raise ValueError("a periodic box has no absolute places; set encoder: relative")
        self.velocities, self.radius, self.wall_distance = velocities, radius, wall_distance
        self.scaling, self.relative_velocity, self.walls, self.absolute = scaling, relative_velocity, walls, absolute
        step = spec.frame_step * spec.stride
        base = [g * step * step for g in spec.gravity] if ballistic else spec.acceleration_mean

        def constant(name: str, values) -> None:
            # Not in the state dict: they follow from the spec, which travels in the checkpoint.
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32), persistent=False)

        def inflated(std) -> list[float]:
            return [max(math.hypot(s, sigma), SMALLEST_STD) for s in std]

        constant("velocity_mean", spec.velocity_mean)
        constant("velocity_std", inflated(spec.velocity_std))
        constant("acceleration_mean", spec.acceleration_mean)
        constant("acceleration_std", inflated(spec.acceleration_std))
        constant("acceleration_base", base)
        constant("bounds", periodic.walls(np.array(spec.bounds), spec.period).tolist())
        self.walled = [axis for axis, name in enumerate(periodic.AXES[: spec.dim]) if name not in spec.periodic]
        self.period = spec.period
        self.embedding = nn.Embedding(TYPE_SLOTS, TYPE_WIDTH) if len(spec.particle_types) > 1 else None
        self.kinematic = KINEMATIC_TYPE in spec.particle_types
        self.context = spec.context_mean is not None
        if self.context:
            constant("context_mean", spec.context_mean)
            constant("context_std", [max(s, SMALLEST_STD) for s in spec.context_std or ()])
        shown = 1 if scaling == "last" else velocities
        self.node_width = shown * spec.dim + 2 * len(self.walled) + (TYPE_WIDTH if self.embedding else 0)
        self.node_width += len(spec.context_mean or ()) + (spec.dim if absolute else 0)
        self.edge_width = 0 if absolute else spec.dim + 1 + (spec.dim if relative_velocity else 0)

    def moving(self, particle_type: Tensor) -> Tensor | None:
        """[particles] bool, or None where the data have no kinematic particle."""
        return particle_type != KINEMATIC_TYPE if self.kinematic else None

    def nodes(self, position: Tensor, particle_type: Tensor, bounds: Tensor, context: Tensor | None = None) -> Tensor:
        """[particles, node_width]: motion (oldest first), clip(distance to lower and upper walls / wall_distance, -1, 1), type embedding, context,
        and for the absolute encoder the place, -1 to 1 along every axis of the training data's box.

        position [C + 1, particles, dim], length; particle_type [particles] int64; bounds [dim, 2], length; context [particles, c].
        Axes without walls have no wall distances.
        """
        velocity = position.diff(dim=0)
        scaled = (velocity - self.velocity_mean) / self.velocity_std
        if self.scaling == "velocity":
            motion = [*scaled]
        elif self.scaling == "acceleration":
            motion = [*((velocity.diff(dim=0) - self.acceleration_mean) / self.acceleration_std), scaled[-1]]
        else:
            motion = [scaled[-1]]
        columns = motion
        if self.walled:
            place, bounds = (position[-1], bounds) if self.period is None else (position[-1][:, self.walled], bounds[self.walled])
            wall = torch.cat([place - bounds[:, 0], bounds[:, 1] - place], 1)
            columns = [*motion, (wall / self.wall_distance).clamp(-1, 1)]
        if self.embedding is not None:
            columns.append(self.embedding(particle_type))
        if self.context:
            columns.append((context - self.context_mean) / self.context_std)
        if self.absolute:
            columns.append(2 * (position[-1] - self.bounds[:, 0]) / (self.bounds[:, 1] - self.bounds[:, 0]) - 1)
        return torch.cat([column.to(self.velocity_std.dtype) for column in columns], 1)

    def edges(self, position: Tensor, graph: Graph, period: np.ndarray | None = None) -> Tensor:
        """[edges, edge_width]: (x_sender - x_receiver) / radius, its norm, and optionally (v_sender - v_receiver) / velocity std.

        position [C + 1, particles, dim], length; period [dim] of a periodic box. The absolute encoder sees none.
        """
        if self.absolute:
            return self.velocity_std.new_empty(graph.edges, 0)

        def difference(values: Tensor) -> Tensor:
            return values.index_select(0, graph.sender) - values.index_select(0, graph.receiver)

        offset = difference(position[-1])
        if period is not None:
            # Where there are walls the period is 0, and no turn is taken.
            length = torch.as_tensor(period, dtype=offset.dtype, device=offset.device)
            offset = offset - length * (offset / length.where(length > 0, torch.inf)).round()
        offset = offset / self.radius
        # Self edges have offset 0, where the norm has no gradient: vector_norm gives 0 there.
        columns = [offset, torch.linalg.vector_norm(offset, dim=1, keepdim=True)]
        if self.relative_velocity:
            columns.append(difference((position[-1] - position[-2]) / self.velocity_std))
        return torch.cat([column.to(self.velocity_std.dtype) for column in columns], 1)

    def base(self, position: Tensor, bounds: Tensor) -> Tensor:
        """Acceleration [length / frame^2] that an output of zero means: a constant [dim], or [particles, dim] where flight stops at walls."""
        if not self.walls:
            return self.acceleration_base
        inertia = 2 * position[-1] - position[-2]
        return torch.minimum(torch.maximum(inertia + self.acceleration_base, bounds[:, 0]), bounds[:, 1]) - inertia

    def acceleration(self, output: Tensor, position: Tensor, bounds: Tensor) -> Tensor:
        """Acceleration [length / frame^2] of a network's output [particles, dim] at position [C + 1, particles, dim]; bounds [dim, 2]."""
        return output * self.acceleration_std + self.base(position, bounds)

    def target(self, position: Tensor, following: Tensor) -> Tensor:
        """The output that takes position[-2:] to ``following``: ((p_next - 2 p_t + p_{t-1}) - base) / std; all [particles, dim] a frame."""
        return (following - 2 * position[-1] + position[-2] - self.base(position, self.bounds)) / self.acceleration_std
