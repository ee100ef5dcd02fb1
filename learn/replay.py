"""Training steps as CUDA graphs.

A step is some hundred small kernels, and to launch them takes a fast GPU longer than to run them. Captured once, over tensors that stay
where they are, a step is one launch; nothing in it waits for the host. What differs from step to step (a batch, its noise, the learning
rate) is copied into those tensors before; results are read when somebody wants to know them.

Decisions: whole steps are captured, optimiser and average of the weights included, since every part has a search before it. Shapes are capacities:
batches of fewer particles are filled up by rows that count for nothing, and a step whose edges (or occupied nodes) exceed their capacity is no step,
the capacity is raised. On a CPU (the tests') the same functions are called without a graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from learn.dataset import Windows

#: Room for this many times what the first batch of a training has.
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


class Room(Protocol):
    """What a model's step has room for.

    capacity: numbers of edges, or of nodes of each level; most [of ``capacity``'s length] int64: those of the fullest graph since it was zeroed.
    """

    capacity: list[int]
    most: Tensor


class Replayable(Protocol):
    """A model whose training steps can be captured."""

    def state_dict(self) -> dict[str, Tensor]:
        """As of ``torch.nn.Module``."""

    def pick(self, windows: Windows, generator: torch.Generator) -> Windows:
        """The windows of a batch that the loss is of."""

    def noise(self, windows: Windows, generator: torch.Generator) -> Tensor:
        """Noise of their input [frames, N, d]."""

    def loss_under(self, noise: Tensor, windows: Windows) -> Tensor:
        """The loss [], reading nothing on the host while there is ``room``."""

    def measure(self, windows: Windows) -> list[int]:
        """What ``windows`` take of the capacities."""

    def make_room(self, capacity: list[int], examples: int) -> Room:
        """At least of these capacities, for batches of so many windows."""

    def using(self, room: Room) -> AbstractContextManager[None]:
        """One step, in ``room``."""


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
    """Training steps on batches like ``first``, of windows of at most ``largest`` particles.

    A step is loss, gradient, clipping, optimiser and the average of the weights. One whose loss or gradient is not finite, or that has no room,
    changes nothing; ``settle`` tells.
    """

    def __init__(
        self, model: Replayable, parameters: list[nn.Parameter], optimizer, average: dict[str, Tensor], clip: float, first: Windows, largest: int
    ):
        self.model, self.parameters, self.optimizer, self.clip, self.average = model, parameters, optimizer, clip, average
        self.device, self.frames = parameters[0].device, len(first.position)
        # The real draws begin with the first step.
        first = model.pick(first, torch.Generator())
        self.examples, (_, particles, dim) = first.examples, first.position.shape
        rows = self.examples * largest
        self.capacity = [math.ceil(ROOM * count * rows / particles) for count in model.measure(first)]
        self.rows = rows = -(-rows // 64) * 64  # in whole tiles, and in whole parts of sums

        def given(*shape: int, dtype: torch.dtype = torch.float32) -> _Input:
            return _Input(self.device, *shape, dtype=dtype)

        noise = len(model.noise(first, torch.Generator()))
        self.position, self.noise = given(self.frames, rows, dim), given(noise, rows, dim)
        self.kinds, self.example, self.counted = given(rows, dtype=torch.int64), given(rows, dtype=torch.int64), given(rows, dtype=torch.bool)
        self.context = None if first.context is None else given(*first.context.shape)
        self.numbers = given(3)  # learning rate, decay of the average, 1 where nothing is to change
        # Losses, gradient norms, steps with a number that is not finite, steps without room; and what the largest graph had.
        self.totals = torch.zeros(4, dtype=torch.float64, device=self.device)
        self.most = torch.zeros(len(self.capacity), dtype=torch.int64, device=self.device)
        self._copied = [torch.cuda.Event() for _ in range(2)] if self.device.type == "cuda" else None
        self._turn, self._still = 0, False
        self._begin()

    def _begin(self) -> None:
        self.room = self.model.make_room(self.capacity, self.examples)
        self.limit = torch.tensor(self.room.capacity, device=self.device)
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
        self.room.most.zero_()  # of this step's graphs alone: the next ones may have room
        with model.using(self.room):
            context = None if self.context is None else self.context.value
            windows = Windows(self.position.value, self.kinds.value, self.example.value, context, counted=self.counted.value)
            for parameter in self.parameters:
                parameter.grad = None
            loss = model.loss_under(self.noise.value, windows)
            loss.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.clip)
        room, finite = (self.room.most <= self.limit).all(), loss.isfinite() & norm.isfinite()
        rate, decay, still = self.numbers.value
        good = room & finite & (still == 0)
        parts = torch.where(good, loss.detach(), 0), torch.where(good, norm, 0), room & ~finite, ~room
        self.totals += torch.stack([part.double() for part in parts])
        torch.maximum(self.most, self.room.most, out=self.most)
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
        windows = self.model.pick(windows, generator)
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
            self.capacity = [max(math.ceil(ROOM * most), old) for most, old in zip(self.most.tolist(), self.room.capacity, strict=True)]
            self._begin()
        self.most.zero_()
        return loss, norm, int(bad), int(full)
