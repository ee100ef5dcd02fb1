"""Data-parallel training: the processes of one ``torchrun``, or one process alone.

    torchrun --nproc-per-node 2 -m learn train CONFIG --data DIR --out RUN

``batch`` is that of all processes together: each takes its windows of it, draws the noise of all and keeps its own, and gradients are
summed, weighted by the particles they are means over. So a step is the same step on any number of processes, up to rounding, and a run is resumed
on another number. Process 0 alone validates and writes; what it decides, the others do.

Decision: plain all-reduce of one flat buffer, not ``DistributedDataParallel``: its mean over processes is wrong where windows differ in
size, and its hooks gain nothing where a step's backward takes a hundred times as long as the sum of a million numbers.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import timedelta

import numpy as np
import torch
from torch import nn

from sim.errors import InputError, RunError

#: The others wait while process 0 validates.
PATIENCE = timedelta(days=7)


class Processes:
    """All processes of a run; ``rank`` of ``size``. gloo on CPUs, NCCL on GPUs, one each. Raises ``InputError`` where there are too few GPUs."""

    def __init__(self, device: torch.device, where: object):
        self.rank, self.size, self.device = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)), device
        if self.size > 1:
            from torch import distributed

            self._distributed = distributed
            if device.type == "cuda":
                local = int(os.environ["LOCAL_RANK"])
                if local >= torch.cuda.device_count():
                    raise InputError(where, "--nproc-per-node", local + 1, f"this machine has {torch.cuda.device_count()} CUDA devices")
                self.device = torch.device("cuda", local)
                torch.cuda.set_device(self.device)
            if not distributed.is_initialized():
                distributed.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=PATIENCE)

    @property
    def leads(self) -> bool:
        """Whether this process writes."""
        return self.rank == 0

    def share(self, rows: np.ndarray) -> slice:
        """Which rows of a batch are this process's: contiguous, as even as they go."""
        edges = np.linspace(0, len(rows), self.size + 1).round().astype(int)
        return slice(int(edges[self.rank]), int(edges[self.rank + 1]))

    def _sum(self, buffer: torch.Tensor) -> torch.Tensor:
        try:
            self._distributed.all_reduce(buffer)
        except RuntimeError as error:
            raise RunError(f"another process of this run has ended ({str(error).splitlines()[0]}); give the same command again to resume") from None
        return buffer

    def add(self, parameters: Iterable[nn.Parameter], values: list[float]) -> list[float]:
        """Sum gradients over all processes, in place, and ``values``. A parameter that has none anywhere keeps none."""
        if self.size == 1:
            return values
        parameters = list(parameters)
        given = [float(parameter.grad is not None) for parameter in parameters]
        parts = [(torch.zeros_like(parameter) if parameter.grad is None else parameter.grad).flatten() for parameter in parameters]
        extra = torch.tensor([*given, *values], device=self.device)
        buffer = self._sum(torch.cat([*parts, extra]))
        *parts, extra = buffer.split([*(len(part) for part in parts), len(extra)])
        for parameter, part, some in zip(parameters, parts, extra.tolist(), strict=False):
            parameter.grad = part.view_as(parameter) if some else None
        return extra[len(parameters) :].tolist()

    def agree(self, progress: float, stop: bool) -> tuple[float, bool]:
        """``progress`` of process 0, and whether any process is to stop."""
        if self.size == 1:
            return progress, stop
        buffer = torch.tensor([progress if self.leads else 0.0, float(stop)], dtype=torch.float64, device=self.device)
        progress, stopping = self._sum(buffer).tolist()
        return progress, stopping > 0

    def close(self) -> None:
        """Leave the group."""
        if self.size > 1 and self._distributed.is_initialized():
            self._distributed.destroy_process_group()
