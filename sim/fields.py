"""What all parts of a scene's description share: strict models, numbers, sampling ranges, and errors that name key, value and remedy."""

from __future__ import annotations

import json
import math
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from sim.trajectory import LARGEST

Positive = Annotated[float, Field(gt=0, le=LARGEST, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
#: A fixed number or a [low, high] range that is sampled uniformly.
Range = Finite | tuple[Finite, Finite]
#: Coulomb's coefficient of a wall or an obstacle; ``sticky`` holds everything that touches.
Friction = Annotated[float, Field(ge=0, allow_inf_nan=False)] | Literal["sticky"]


class Strict(BaseModel):
    """A part of a scene: unknown keys are refused, and nothing changes after it was read."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def sample(value: Range, rng: np.random.Generator) -> float:
    """The number, or one drawn uniformly from the range."""
    return float(rng.uniform(*value)) if isinstance(value, tuple) else float(value)


def mistake(key: str, value: object, remedy: str) -> ValueError:
    """A validator's error that carries key, value and remedy to ``sim.scene.explain_validation``."""
    return ValueError(json.dumps({"key": key, "value": value, "remedy": remedy}))


def check_vectors(where: str, vectors: dict[str, list | None], dim: int) -> None:
    """Each given vector needs ``dim`` entries, low not above high in any."""
    for key, values in vectors.items():
        if values is not None and len(values) != dim:
            raise mistake(f"{where}.{key}", values, f"needs {dim} entries, one per axis")
        for axis, value in enumerate(values or []):
            check_range(f"{where}.{key}[{axis}]", value)


def check_range(key: str, value: Range, least: float | None = None, remedy: str = "") -> None:
    """Low must not exceed high, nor (if given) fall below ``least``."""
    low, high = value if isinstance(value, tuple) else (value, value)
    if low > high:
        raise mistake(key, value, "low must not exceed high")
    if least is not None and low < least:
        raise mistake(key, value, remedy)


def entries(content: object, known: dict[int, float] | None = None) -> float:
    """How many entries nested dicts, lists and tuples have once every reference is followed: more than memory holds in some lines that refer
    to each other, infinitely many in what holds itself."""
    if not isinstance(content, (dict, list, tuple)):
        return 1
    known = {} if known is None else known
    if id(content) not in known:
        known[id(content)] = math.inf  # until it is known: who meets it before is inside it
        known[id(content)] = 1 + sum(entries(value, known) for value in (content.values() if isinstance(content, dict) else content))
    return known[id(content)]
