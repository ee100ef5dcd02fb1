"""Captured training steps (``learn.replay``), without a graph, beside plain ones: what tests of both replayable models need."""

import copy

import pytest
import torch

from learn.dataset import Windows
from learn.replay import TrainingReplay
from learn.train import OPTIMIZERS


def assert_replayed_as_plain(plain: torch.nn.Module, batches: list[Windows], largest: int, optimizer: str, rel: float) -> float:
    """One step on each batch: the same losses (to ``rel``), gradient norms, weights and averages; returns the sum of the losses."""
    replayed, found = copy.deepcopy(plain), []
    for model, fast in ((plain, False), (replayed, True)):
        parameters, generator = list(model.parameters()), torch.Generator().manual_seed(7)
        rule, average = OPTIMIZERS[optimizer](parameters, 0.1), {name: value.clone() for name, value in model.state_dict().items()}
        replay = TrainingReplay(model, parameters, rule, average, 1.0, batches[0], largest) if fast else None
        losses = norms = 0.0
        for step, windows in enumerate(batches):
            if replay:
                replay.step(windows, generator, 1e-2 / (step + 1), 0.5)
                continue
            for parameter in parameters:
                parameter.grad = None
            loss = model.loss(windows, generator, 0.0)
            loss.backward()
            losses, norms = losses + loss.item(), norms + torch.nn.utils.clip_grad_norm_(parameters, 1.0).item()
            rule.step(1e-2 / (step + 1))
            for name, value in model.state_dict().items():
                average[name].lerp_(value, 0.5)
        if replay:
            losses, norms, *none = replay.settle()
            assert none == [0, 0] and replay.settle() == (0.0, 0.0, 0, 0)
        found.append((losses, norms, model.state_dict(), average))
    (losses, norms, weights, average), (fast_losses, fast_norms, fast_weights, fast_average) = found
    assert fast_losses == pytest.approx(losses, rel=rel) and fast_norms == pytest.approx(norms, rel=1e-4)
    for name in weights:
        torch.testing.assert_close(fast_weights[name], weights[name], rtol=1e-3, atol=2e-5)
        torch.testing.assert_close(fast_average[name], average[name], rtol=1e-3, atol=2e-5)
    return losses
