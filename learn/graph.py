"""Radius graphs: all pairs of particles within a distance, sorted by receiver.

The order is what makes message passing cheap: the messages to one particle lie side by side, so they are summed without
atomics or scatter, and a block of receivers owns a contiguous block of edges that stays in cache from layer to layer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from sim import periodic

#: Edges that pass through the layers of an edge MLP together: few enough to stay in a cache of a few MiB, enough to hide the cost of a call.
RUN = 2048


@dataclass(frozen=True)
class Graph:
    """Directed edges sorted by (receiver, sender); symmetric (with every edge its reverse).

    sender, receiver [edges] int32: particle indices; offsets [particles + 1] int32: the edges that particle i receives are
    ``offsets[i]:offsets[i + 1]``.
    """

    sender: Tensor
    receiver: Tensor
    offsets: Tensor

    @property
    def edges(self) -> int:
        """Number of edges, self edges included."""
        return len(self.sender)

    @property
    def particles(self) -> int:
        """Number of particles."""
        return len(self.offsets) - 1

    @cached_property
    def reverse(self) -> Tensor:
        """[edges] int32: ``reverse[e]`` is the edge that runs against e. As the graph is symmetric, the edges that particle i *sends*
        are ``reverse[offsets[i]:offsets[i + 1]]``."""
        return torch.argsort(self.sender.long() * self.particles + self.receiver).int()

    @cached_property
    def runs(self) -> list[Run]:
        """The receivers, in order, cut so that each run has at most ``RUN`` edges (a particle with more is a run of its own)."""
        # A device that is bound by launches, not by caches, takes all edges at once.
        size = RUN if self.sender.device.type == "cpu" else self.edges
        offsets = self.offsets.cpu().numpy()
        pairs = torch.stack([2 * self.receiver, 2 * self.sender + 1], 1).flatten()
        longest = max(size, int(np.diff(offsets).max()))
        order = torch.arange(longest, dtype=torch.int32, device=self.sender.device)
        runs, first = [], 0
        while first < self.particles:
            last = max(int(np.searchsorted(offsets, offsets[first] + size, side="right")) - 1, first + 1)
            a, b = int(offsets[first]), int(offsets[last])
            runs.append(Run(slice(first, last), slice(a, b), self.offsets[first : last + 1] - a, order[: b - a], pairs[2 * a : 2 * b]))
            first = last
        return runs


@dataclass(frozen=True)
class Run:
    """Consecutive receivers and the edges they receive.

    offsets [receivers + 1] int32: as in ``Graph``, from the run's first edge; order [edges] int32: 0, 1, ...; pairs [2 edges] int32: for
    every edge its two rows in a [particles, 2, width] table (flattened over the first two axes) that holds what a particle contributes
    as a receiver and what as a sender: 2 receiver, 2 sender + 1.
    """

    receivers: slice
    edges: slice
    offsets: Tensor
    order: Tensor
    pairs: Tensor


def radius_graph(position: Tensor, radius: float, example: Tensor | None = None, self_edges: bool = True, period: np.ndarray | None = None) -> Graph:
    """All ordered pairs with |x_i - x_j| <= radius, no cap on the neighbours (Sanchez-Gonzalez et al. 2020).

    position [particles, dim], length; radius: length; example [particles], ascending: pairs join only within one example (None: there
    is one); self_edges: every particle also sends to itself; period [dim] of a periodic box: distances are those of nearest images. They are
    taken in float64 of the given positions. Raises ``FloatingPointError`` on a position that is not finite.
    """
    points = position.detach().cpu().numpy().astype(np.float64)
    count = len(points)
    if not np.isfinite(points).all():
        raise FloatingPointError("radius_graph: a position is not finite")
    if example is None:
        bounds = np.array([0, count])
    else:
        label = example.cpu().numpy()
        bounds = np.r_[0, np.flatnonzero(np.diff(label)) + 1, count]
    trees = ((a, periodic.tree(points[a:b], period)) for a, b in zip(bounds[:-1], bounds[1:], strict=True))
    pairs = np.concatenate([tree.query_pairs(radius, output_type="ndarray") + a for a, tree in trees])
    low, high = pairs[:, 0], pairs[:, 1]
    key = np.concatenate([low * count + high, high * count + low, np.arange(count if self_edges else 0) * (count + 1)])
    key.sort()
    receiver = key // count
    offsets = np.zeros(count + 1, np.int32)
    np.cumsum(np.bincount(receiver, minlength=count), out=offsets[1:])
    tensors = (torch.from_numpy(array.astype(np.int32)).to(position.device) for array in (key - receiver * count, receiver, offsets))
    return Graph(*tensors)
