"""Model files and training states: written atomically, read with ``torch.load(weights_only=True)`` only, and checked.

A *model file* holds all that inference needs: the model's registered name, its settings, the ``DataSpec`` of its training data, its
weights, and where they come from. A *training state* holds all that resuming needs. Neither can run code when it is read.
"""

from __future__ import annotations

import hashlib
import io
import json
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import torch
from pydantic import BaseModel, ValidationError
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from learn.dataset import DataSpec
from learn.model import MODELS, build
from sim.errors import InputError
from sim.fields import entries
from sim.trajectory import atomic_path

FORMAT_VERSION = 1
#: What stands beside the tensors of a file.
PLAIN_KEYS = ("settings", "spec", "provenance", "config", "sampler", "progress")
#: Larger models are slips of the keyboard: they would exhaust memory or time before anything could say so.
MOST_PARAMETERS, MOST_TENSORS, MOST_ENTRIES = 10**8, 20_000, 10**6
MODEL_FORMAT, STATE_FORMAT = "sluice-model", "sluice-training-state"

Checked = TypeVar("Checked", bound=BaseModel)


def validate(kind: type[Checked], content: object, where: object, key: str) -> Checked:
    """``content`` as a ``kind``; the first fault is an ``InputError`` that names file, key (under ``key``), value and remedy."""
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        fault = error.errors()[0]
        path = ".".join(str(part) for part in (*([key] if key else []), *fault["loc"])) or "file"
        value, message = fault["input"], fault["msg"]
        if fault["type"] == "extra_forbidden":
            message = f"unknown key; the keys are {', '.join(sorted(kind.model_fields))}" if len(fault["loc"]) == 1 else "unknown key; remove it"
        # Of a container only the keys are shown: YAML aliases can make its text as long as they like.
        shown = list(value) if isinstance(value, dict) else value if isinstance(value, (str, int, float, type(None))) else type(value).__name__
        raise InputError(where, path, shown, message.removeprefix("Value error, ")) from None


def write_content(path: str | Path, content: dict) -> None:
    """Write what ``torch.load(weights_only=True)`` can read, atomically."""
    # By way of memory: on a full disk torch's own writer raises no OSError.
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read_content(path: str | Path, device: torch.device | str, form: str, remedy: str) -> object:
    """The content of a file, read without running code from it; ``form`` and ``remedy`` are for the ``InputError`` of one that is damaged."""
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "file", str(path), "no such file; correct the path")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if zipfile.is_zipfile(path):
                with zipfile.ZipFile(path) as archive:
                    if sum(entry.file_size for entry in archive.infolist()) > path.stat().st_size:
                        raise ValueError("it promises more than it holds")
                    if (spoilt := archive.testzip()) is not None:  # torch writes checksums and does not look at them
                        raise ValueError(f"{spoilt} has not the checksum that it was written with")
            content = torch.load(path, map_location=device, weights_only=True)
        if (count := entries(content)) > MOST_ENTRIES:
            raise ValueError(f"its parts refer to each other, {count:.3g} entries in all")
        return content
    # What a damaged or hostile file raises is open-ended (zip, pickle, storage and type errors); all of it is a bad file.
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(path, "file", reason, f"damaged, or not a {form} file; {remedy}") from None


def _read(path: str | Path, form: str, keys: Mapping[str, type], device: torch.device | str, remedy: str) -> dict:
    """The content of a file of format ``form``, checked to have ``keys`` of these types and no other."""
    content = read_content(path, device, form, remedy)
    if not isinstance(content, dict) or content.get("format") != form:
        raise InputError(path, "format", content.get("format") if isinstance(content, dict) else type(content).__name__, f"must be {form}; {remedy}")
    if content.get("format_version") != FORMAT_VERSION:
        raise InputError(path, "format_version", content.get("format_version"), f"this version reads {FORMAT_VERSION}; {remedy}")
    expected = {"format": str, "format_version": int, **keys}
    if set(content) != set(expected):
        raise InputError(path, "keys", sorted(map(str, content)), f"must be exactly {', '.join(sorted(expected))}; {remedy}")
    for key, kind in expected.items():
        if not isinstance(content[key], kind):
            raise InputError(path, key, type(content[key]).__name__, f"must be of type {kind.__name__}; {remedy}")
        if key in PLAIN_KEYS:
            try:
                json.dumps(content[key])
            except (TypeError, ValueError, RecursionError) as error:
                raise InputError(path, key, str(error), f"must be numbers and texts; {remedy}") from None
    return content


def save_model(path: str | Path, model: nn.Module, provenance: dict | None = None) -> None:
    """Write a model file.

    model: an instance of a registered class (``learn/model.py``); provenance: JSON-able, where the weights come from.
    """
    names = [name for name, place in MODELS.items() if place == (type(model).__module__, type(model).__qualname__)]
    if not names:
        raise ValueError(f"{type(model).__name__} is not registered in learn/model.py")
    write_content(
        path,
        {
            "format": MODEL_FORMAT,
            "format_version": FORMAT_VERSION,
            "model": names[0],
            "settings": json.loads(json.dumps(model.settings)),
            "spec": model.spec.to_dict(),
            "provenance": json.loads(json.dumps(provenance or {})),
            "state_dict": {name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()},
        },
    )


def read_model_file(path: str | Path, device: torch.device | str = "cpu") -> dict:
    """The checked content of a model file: keys model, settings, spec, provenance, state_dict."""
    keys = {"model": str, "settings": dict, "spec": dict, "provenance": dict, "state_dict": dict}
    return _read(path, MODEL_FORMAT, keys, device, "copy the file again or train again")


def build_model(name: str, settings: dict, spec: DataSpec, where: object, most: int = MOST_PARAMETERS) -> nn.Module:
    """A freshly initialised registered model of at most ``most`` parameters; an ``InputError`` of file ``where`` if it is unknown or cannot be."""
    if name not in MODELS:
        raise InputError(where, "model", name, f"must be one of {', '.join(sorted(MODELS))}")
    try:
        with _bounded(most):
            return build(name, settings, spec, where)
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, ArithmeticError, MemoryError) as error:  # torch reports impossible sizes in all these ways
        raise InputError(where, "settings", settings, f"no {name} can be built from this: {error}") from None


@contextmanager
def _bounded(most: int) -> Iterator[None]:
    """Stops the construction of a model of more than ``most`` parameters, before memory is written, or of more tensors than time allows."""
    numbers = tensors = 0

    def count(_: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal numbers, tensors
        numbers, tensors = numbers + (0 if parameter is None else parameter.numel()), tensors + 1
        if numbers > most or tensors > MOST_TENSORS:
            raise MemoryError(f"it has more than {most} parameters, or more than {MOST_TENSORS} tensors of them")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def load_model(path: str | Path, device: torch.device | str = "cpu") -> nn.Module:
    """The model of a model file, on ``device``, in evaluation mode. Runs no code from the file; every fault of it is an ``InputError``."""
    path = Path(path)
    content = read_model_file(path, "cpu")
    # A number takes four bytes: what has more parameters than the file has room for is not built only to be refused.
    model = build_model(content["model"], content["settings"], DataSpec.from_dict(content["spec"], path), path, path.stat().st_size // 4)
    load_weights(model, content["state_dict"], path)
    return model.to(device).eval()


def load_weights(model: nn.Module, weights: dict, where: object) -> None:
    """Copy ``weights`` (on the CPU) into ``model``; names, shapes and types must fit exactly and every number be finite, or ``InputError``."""
    own = model.state_dict()
    if set(weights) != set(own):
        raise InputError(where, "state_dict", sorted(set(map(str, weights)) ^ set(own))[:5], "names of weights do not fit the model's settings")
    for name, value in weights.items():
        dense = isinstance(value, torch.Tensor) and value.layout == torch.strided and value.device.type == "cpu"
        fits = dense and value.shape == own[name].shape and value.dtype == own[name].dtype
        if not fits or not bool(torch.isfinite(value).all()):
            shown = f"{value.dtype} {list(value.shape)}" if isinstance(value, torch.Tensor) else type(value).__name__
            raise InputError(where, f"state_dict.{name}", shown, f"must be finite, {own[name].dtype} {list(own[name].shape)}")
    model.load_state_dict(weights)


def file_hash(path: str | Path) -> str:
    """SHA-256 of a file, hexadecimal: which checkpoint made a rollout."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


#: What a training state holds besides its format, see ``learn/train.py``.
STATE_KEYS = {
    "config": dict,
    "spec": dict,
    "model": dict,
    "average": dict,
    "optimizer": dict,
    "sampler": dict,
    "generator": torch.Tensor,
    "torch_random": torch.Tensor,
    "device_random": list,
    "progress": dict,
}


def save_state(path: str | Path, state: dict) -> None:
    """Write a training state: the keys of ``STATE_KEYS``."""
    write_content(path, {"format": STATE_FORMAT, "format_version": FORMAT_VERSION, **state})


def load_state(path: str | Path, device: torch.device | str = "cpu") -> dict:
    """Read a training state, its tensors on ``device``; every fault of the file is an ``InputError``."""
    return _read(path, STATE_FORMAT, STATE_KEYS, device, "delete the run folder and train again")
