"""The contract of learned models, and the registry that builds one by its name."""

from __future__ import annotations

import math
from importlib import import_module
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
import torch
from pydantic import BaseModel, ValidationError
from torch import Tensor

from sim.errors import InputError
from sim.simulator import Start

if TYPE_CHECKING:
    from learn.dataset import DataSpec, Windows


class LearnedModel(Protocol):
    """An ``nn.Module`` that is also a ``sim.simulator.Simulator``.

    history: (unstrided) frames of the ``Start`` it needs. ``settings`` is the full dict of its ``Settings``.
    """

    Settings: ClassVar[type[BaseModel]]
    name: str
    kind: ClassVar[str]
    settings: dict
    history: int

    def __init__(self, settings: BaseModel, spec: DataSpec): ...

    def window(self, progress: float) -> int:
        """(Strided) frames a training window needs at this share of the training, 0..1."""

    def loss(self, windows: Windows, generator: torch.Generator, progress: float) -> Tensor:
        """Scalar, differentiable; all its random numbers come from ``generator`` (on the CPU)."""

    def begin(self, start: Start) -> None: ...

    def advance(self) -> np.ndarray: ...


def check_start(start: Start, spec: DataSpec, history: int) -> None:
    """Raises ``ValueError`` on a start that a model of data ``spec`` cannot begin from; history: (unstrided) frames that it needs."""
    if start.history.shape[2] != spec.dim:
        raise ValueError(f"the start has {start.history.shape[2]} dimensions, the model {spec.dim}")
    if len(start.history) < history:
        raise ValueError(f"the start has {len(start.history)} frames, the model needs {history}")
    if not math.isclose(start.frame_step, spec.frame_step, rel_tol=1e-6):
        raise ValueError(f"the start's frame step is {start.frame_step} s, the model's {spec.frame_step} s")
    unknown = sorted(set(np.unique(start.particle_type).tolist()) - set(spec.particle_types))
    if unknown:
        raise ValueError(f"particle types {unknown} are not among the model's {list(spec.particle_types)}")


#: name -> module and class, imported when built.
MODELS = {"gns": ("learn.gns", "GNS"), "grid_emulator": ("learn.grid_emulator", "GridEmulator"), "cconv": ("learn.cconv", "CConv")}


def model_class(name: str) -> type[LearnedModel]:
    """The class of a model by its name. Raises ``InputError`` on an unknown name."""
    if name not in MODELS:
        raise InputError("model", "name", name, f"known models: {', '.join(sorted(MODELS))}")
    module, attribute = MODELS[name]
    return getattr(import_module(module), attribute)


def build(name: str, settings: dict, spec: DataSpec, where: object = "model") -> LearnedModel:
    """A freshly initialised model (from torch's global random state). ``settings``: what differs from the defaults.

    Raises ``InputError``, with ``where`` for the file, on an unknown model, an unknown key or an impossible value.
    """
    kind = model_class(name)
    try:
        checked = kind.Settings.model_validate(settings)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "settings"
        if first["type"] == "extra_forbidden":
            remedy = f"unknown; {name} has {', '.join(kind.Settings.model_fields)}"
        else:
            remedy = first["msg"]
        raise InputError(where, key, first["input"], remedy) from None
    return kind(checked, spec)
