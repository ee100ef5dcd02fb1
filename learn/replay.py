"""Steps of a GNS as CUDA graphs: a rollout's, and a training's with its optimiser.

A step of a GNS is a few hundred small kernels, and to launch them takes a fast GPU longer than to run them. Captured once, over tensors that stay
where they are, a step is one launch; nothing in it waits for the host. What differs from step to step (a batch, its noise, the learning
rate) is copied into those tensors before; results are read when somebody wants to know them.

Decisions: whole steps are captured, not parts, since every part has a search before it. Shapes are capacities (``learn.fused``): batches of fewer
particles are filled up by rows that count for nothing, and a step whose edges exceed their capacity is no step, the capacity is raised. On a CPU
(the tests') the same functions are called without a graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from learn.dataset import Windows
from learn.fused import Search, Shadow
from learn.graph import radius_graph

if TYPE_CHECKING:
    from learn.gns import GNS, _State

#: Room for this many times the edges of the first batch of a training.
ROOM = 1.25


class Replay:
    """A function of tensors that stay, captured at the first call; ``prepare`` is called before it is warmed up and again after.

    It keeps neither: an owner that its own graph refers to, and with it the graph's memory, would wait for the garbage collector.
    """

    def __init__(self, device: torch.device):
        self.device = device
        self.graph: Any = None

    def __call__(self, function: Callable[[], None], prepare: Callable[[], None] = lambda: None) -> None:
        if self.device.type != "cuda":
            function()
            return
        if self.graph is None:
            prepare()
            stream = torch.cuda.Stream(self.device)
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                function()  # compiles kernels, which a capture must not
                function()
            torch.cuda.current_stream().wait_stream(stream)
            prepare()
            self.graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self.graph):
                function()
        self.graph.replay()


def _searching(model: GNS, bounds: np.ndarray, examples: int, capacity: int) -> Search:
    return Search(bounds, model.radius, examples, capacity, model.options.self_edges, model.features.bounds.device)


@contextmanager
def _using(model: GNS, search: Search, shadow: Shadow) -> Iterator[None]:
    # For one step, not for good: validation rolls out between two steps of a training, whose graph goes on reading its own shadow.
    model.search, model.network.shadow = search, shadow
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
        self.search = _searching(model, states[0].start.bounds, len(counts), math.ceil(model.options.edge_cap * first) + 1)
        self.shadow = Shadow(model.network)
        self.shadow.refresh()
        self.replay = Replay(device)

    def _step(self) -> None:
        model, position = self.model, self.position
        with _using(model, self.search, self.shadow):
            context = None if self.context is None else self.context[self.example]
            graph = self.search(position[-1], self.example, self.particles)
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


class _Input:
    """A tensor that stays where it is, and two of the host's that fill it in turn: one is written while the device may still read the other."""

    def __init__(self, device: torch.device, *shape: int, dtype: torch.dtype = torch.float32):
        self.value = torch.zeros(shape, dtype=dtype, device=device)
        self._staging = [torch.zeros(shape, dtype=dtype, pin_memory=device.type == "cuda") for _ in range(2)]

    def fill(self, turn: int, given: Tensor) -> None:
        """With ``given``, and zeros for rows (the second axis, of one the first) that it has not."""
        staging, axis = self._staging[turn], min(given.ndim - 1, 1)
        rows = given.shape[axis]
        staging.narrow(axis, 0, rows).copy_(given)
        staging.narrow(axis, rows, staging.shape[axis] - rows).zero_()
        self.value.copy_(staging, non_blocking=True)


class TrainingReplay:
    """Training steps on batches of at most ``rows`` particles: loss, gradient, clipping, Adam, the average of the weights.

    A step whose loss or gradient is not finite, or whose edges exceed their capacity, changes nothing; ``settle`` tells.
    """

    def __init__(self, model: GNS, parameters: list[nn.Parameter], optimizer, average: dict[str, Tensor], clip: float, first: Windows, rows: int):
        self.model, self.parameters, self.optimizer, self.clip, self.average = model, parameters, optimizer, clip, average
        # Rows in whole tiles, and in whole parts of sums.
        self.device, self.rows, self.frames = model.features.bounds.device, -(-rows // 64) * 64, len(first.position)
        self.examples, (_, particles, dim) = first.examples, first.position.shape
        graph = radius_graph(first.position[model.velocities], model.radius, first.example, model.options.self_edges)
        edges = max(graph.edges, particles)  # without self edges there may be none at first
        self.capacity, rows = math.ceil(ROOM * edges * rows / particles), self.rows

        def given(*shape: int, dtype: torch.dtype = torch.float32) -> _Input:
            return _Input(self.device, *shape, dtype=dtype)

        self.position, self.noise = given(self.frames, rows, dim), given(model.velocities + 1, rows, dim)
        self.kinds, self.example, self.counted = given(rows, dtype=torch.int64), given(rows, dtype=torch.int64), given(rows, dtype=torch.bool)
        self.context = None if first.context is None else given(*first.context.shape)
        self.numbers = given(3)  # learning rate, decay of the average, 1 where nothing is to change
        # Losses, gradient norms, steps with a number that is not finite, steps without room; and the edges of the largest graph.
        self.totals = torch.zeros(4, dtype=torch.float64, device=self.device)
        self.most = torch.zeros((), dtype=torch.int64, device=self.device)
        self._copied = [torch.cuda.Event() for _ in range(2)] if self.device.type == "cuda" else None
        self._turn, self._still = 0, False
        self.shadow = Shadow(model.network)
        self._begin()

    def _begin(self) -> None:
        self.search = _searching(self.model, np.asarray(self.model.spec.bounds), self.examples, self.capacity)
        self.replay = Replay(self.device)

    def _prepare(self) -> None:
        """Warming up must not train."""
        self._still = not self._still
        self.numbers.value[2] = float(self._still)
        for parameter in self.parameters:
            parameter.grad = None
        self.totals.zero_()
        self.most.zero_()

    def _step(self) -> None:
        model = self.model
        self.shadow.refresh()
        self.search.most.zero_()  # of this step's graphs alone: the next ones may have room
        with _using(model, self.search, self.shadow):
            context = None if self.context is None else self.context.value
            windows = Windows(self.position.value, self.kinds.value, self.example.value, context, counted=self.counted.value)
            for parameter in self.parameters:
                parameter.grad = None
            loss = model.loss_under(self.noise.value, windows)
            loss.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.clip)
        room, finite = self.search.most <= self.search.capacity, loss.isfinite() & norm.isfinite()
        rate, decay, still = self.numbers.value
        good = room & finite & (still == 0)
        parts = torch.where(good, loss.detach(), 0), torch.where(good, norm, 0), room & ~finite, ~room
        self.totals += torch.stack([part.double() for part in parts])
        torch.maximum(self.most, self.search.most, out=self.most)
        self.optimizer.step(rate, found_inf=1 - good.float())
        own = model.state_dict()
        names = [name for name, value in own.items() if value.is_floating_point()]
        share = torch.where(good, 1 - decay, 0.0)
        averages = [self.average[name] for name in names]
        difference = torch._foreach_sub([own[name] for name in names], averages)
        torch._foreach_mul_(difference, share)
        torch._foreach_add_(averages, difference)

    def step(self, windows: Windows, generator: torch.Generator, rate: float, decay: float) -> None:
        """One step on ``windows``, which are on the host, as is the generator of their noise; returns before the device has made it."""
        turn, count = self._turn, windows.position.shape[1]
        self._turn = 1 - turn
        if self._copied:
            self._copied[turn].synchronize()
        self.position.fill(turn, windows.position)
        self.noise.fill(turn, self.model.noise(windows, generator))
        self.kinds.fill(turn, windows.particle_type)
        self.example.fill(turn, windows.example)
        self.counted.fill(turn, torch.ones(count, dtype=torch.bool))
        self.numbers.fill(turn, torch.tensor([rate, decay, 0.0]))
        if self.context is not None:
            self.context.fill(turn, windows.context)
        if self._copied:
            self._copied[turn].record()
        self.replay(self._step, self._prepare)

    def settle(self) -> tuple[float, float, int, int]:
        """Since the last time: sums of losses and of gradient norms, steps that were none for a number that is not finite, and for want of room
        (there is more afterwards). Waits for the device."""
        loss, norm, bad, full = self.totals.tolist()
        self.totals.zero_()
        if full:
            self.capacity = math.ceil(ROOM * int(self.most))
            self._begin()
        self.most.zero_()
        return loss, norm, int(bad), int(full)
