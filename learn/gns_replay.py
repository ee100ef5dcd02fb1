"""Steps of a GNS as CUDA graphs (``learn.replay``): a rollout's, and the room of a training's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from learn.fused import Search, Shadow
from learn.graph import radius_graph
from learn.replay import Replay

if TYPE_CHECKING:
    from learn.gns import GNS, _State


class GNSRoom:
    """Room for the graphs of a GNS' step (``learn.replay.Room``), and its weights in bf16."""

    def __init__(self, model: GNS, bounds: np.ndarray, examples: int, edges: int):
        self.search = Search(bounds, model.radius, examples, edges, model.options.self_edges, model.features.bounds.device)
        self.capacity, self.most = [self.search.capacity], self.search.most.view(1)
        self.shadow = Shadow(model.network)

    @contextmanager
    def used(self, model: GNS) -> Iterator[None]:
        """By one step, not for good: validation rolls out between two steps of a training, whose graph goes on reading its own shadow."""
        model.search, model.network.shadow = self.search, self.shadow
        try:
            yield
        finally:
            model.search = model.network.shadow = None


class RolloutReplay:
    """Steps of the rollouts ``which`` together. ``compute`` predicts, ``accept`` makes that the present."""

    def __init__(self, model: GNS, which: list[int], states: Sequence[_State], bounds: Tensor):
        self.model, self.which, self.states = model, which, [states[number] for number in which]
        self.bounds, device = bounds, model.features.bounds.device
        counts = [len(state.kinds) for state in self.states]
        self.ends = np.cumsum([0, *counts])
        self.last = torch.from_numpy(self.ends).to(device)
        self.kinds = torch.cat([state.kinds for state in self.states])
        self.example = torch.repeat_interleave(torch.arange(len(counts), device=device), torch.tensor(counts, device=device))
        self.particles = torch.tensor([len(self.kinds)], dtype=torch.int32, device=device)
        self.position = torch.cat([state.position for state in self.states], 1)
        self.following = self.position.clone()
        self.known = [state.known(model.spec.stride) for state in self.states]
        self.context = None
        if model.features.context:
            self.context = torch.zeros(len(counts), len(self.states[0].context), device=device)
        first = 0
        for state in self.states:
            edges = state.first_edges or radius_graph(state.position[-1], model.radius, None, model.options.self_edges).edges
            first += state.measure(edges)
        self.room = GNSRoom(model, states[0].start.bounds, len(counts), math.ceil(model.options.edge_cap * first) + 1)
        self.room.shadow.refresh()
        self.replay = Replay(device)

    def _step(self) -> None:
        model, position = self.model, self.position
        with self.room.used(model):
            context = None if self.context is None else self.context[self.example]
            graph = self.room.search(position[-1], self.example, self.particles)
            output = model._predict(position, graph, self.kinds, self.bounds, context)
            acceleration = model.features.acceleration(output, position, self.bounds)
        frames = []
        for state, known, a, b in zip(self.states, self.known, self.ends[:-1], self.ends[1:], strict=True):
            own = position[:, a:b]
            following = model.following(state, own, acceleration[a:b], known)
            frames.append(model.between(state, own, acceleration[a:b], following, known))
        self.frames = torch.cat(frames, 1)
        self.following.copy_(torch.cat([position[1:], self.frames[-1:]]))
        # Counted before they are cut off at the capacity: a clump must not look smaller than it is.
        self.found = graph.found[self.last]

    def compute(self) -> tuple[list[np.ndarray], list[int]]:
        """The next frames [stride, particles, dim] of each, and the edges that each has."""
        for state, known in zip(self.states, self.known, strict=True):
            if known is not None:
                known.copy_(state.known(self.model.spec.stride))
        if self.context is not None:
            self.context.copy_(torch.from_numpy(np.stack([state.context for state in self.states])))
        self.replay(self._step)
        frames, edges = self.frames.float().cpu().numpy(), np.diff(self.found.tolist()).tolist()
        return [np.ascontiguousarray(frames[:, a:b]) for a, b in zip(self.ends[:-1], self.ends[1:], strict=True)], edges

    def accept(self) -> None:
        """Go on from the frames that ``compute`` returned."""
        self.position.copy_(self.following)
        for state in self.states:
            state.present += self.model.spec.stride

    def release(self) -> None:
        """Hand the present back to the states, for another set of them."""
        for state, a, b in zip(self.states, self.ends[:-1], self.ends[1:], strict=True):
            state.position = self.position[:, a:b].clone()
