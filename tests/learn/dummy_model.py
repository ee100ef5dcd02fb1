"""A model of a few weights that only the tests of the trainer use: next velocity = A v + b, with noise so that the random state matters."""

from __future__ import annotations

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import nn


class DummySettings(BaseModel):
    model_config = ConfigDict(extra="forbid")

    noise: float = Field(0.1, ge=0)
    dropout: float = Field(0.1, ge=0, lt=1)  # draws from torch's global generator
    nan_at: float = 2.0  # from this progress on the loss is nan
    long_at: float = 0.5  # from this progress on windows have four frames


class Dummy(nn.Module):
    Settings = DummySettings
    name, kind, history = "dummy", "learned", 2

    def __init__(self, settings: DummySettings, spec):
        super().__init__()
        self.settings, self.options, self.spec = settings.model_dump(mode="json"), settings, spec
        self.linear = nn.Linear(spec.dim, spec.dim)
        self.dropout = nn.Dropout(settings.dropout)
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def window(self, progress: float) -> int:
        return 4 if progress >= self.options.long_at else 3

    def loss(self, windows, generator: torch.Generator, progress: float) -> torch.Tensor:
        self.calls += 1
        velocity = windows.position[1:] - windows.position[:-1]
        scale = torch.tensor(self.spec.velocity_std)
        velocity = velocity / scale
        noise = self.options.noise * torch.randn(velocity[:-1].shape, generator=generator)
        error = self.linear(self.dropout(velocity[:-1] + noise)) - velocity[1:]
        return (error**2).mean() * (float("nan") if progress >= self.options.nan_at else 1.0)

    def begin(self, start) -> None:
        self.state = torch.from_numpy(start.history[-2:].copy())

    @torch.no_grad()
    def advance(self):
        scale = torch.tensor(self.spec.velocity_std)
        nxt = self.state[1] + self.linear((self.state[1] - self.state[0]) / scale) * scale
        self.state = torch.stack([self.state[1], nxt])
        return nxt[None].numpy().copy()
