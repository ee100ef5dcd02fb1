"""A GPU that a study asks for and a machine has not: found before anything runs, not when the data are made."""

from __future__ import annotations

from typing import Literal

from sim.errors import InputError
from workflow.study import Study


def check_gpu(study: Study, section: Literal["models", "comparisons"], name: str) -> None:
    """``InputError`` where torch finds no CUDA device for an entry that asks for one; it names what asks, the study or the model's configuration."""
    import torch  # takes seconds, and most studies never come here

    if torch.cuda.is_available():
        return
    remedy = "this machine has no CUDA device that torch can use; leave it out, or run on a machine that has one"
    asked = study.resource(section, name, "gpus", 0)
    if asked:
        raise InputError(study.path, f"{section}.{name}.resources.gpus", asked, remedy)
    raise InputError(study.models[name]["config"], "training.device", "cuda", remedy)
