"""A process of the tests of parallel training: the gradient of one step by the processes together (``gradient``), or a run that stops itself."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import torch

from learn.train import Trainer, load_config


def gradient(trainer: Trainer) -> list[torch.Tensor]:
    """Of all parameters, as a step would use it; the loss last."""
    windows = trainer.sampler.next(trainer.model.window(0.0))
    loss = trainer.model.loss(windows, trainer.generator, 0.0)
    loss.backward()
    loss_value = trainer._join(float(loss.detach()), windows)
    return [*(parameter.grad.clone() for parameter in trainer.parameters), torch.tensor(loss_value)]


if __name__ == "__main__":
    task, config, data, out = sys.argv[1:]
    torch.set_num_threads(1)
    trainer = Trainer(load_config(config), data, Path(out) / "run")
    if task == "gradient":
        found = gradient(trainer)
        if trainer.processes.leads:
            torch.save(found, Path(out) / "gradient.pt")
        trainer.processes.close()
    elif task == "killed":
        # One process dies at once, in the middle of the run; torchrun ends the other.
        step = trainer._train_step

        def dying(progress: float) -> None:
            if trainer.step == 7 and trainer.processes.rank == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            step(progress)

        trainer._train_step = dying
        trainer.run()
    else:
        trainer.run()
