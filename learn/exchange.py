"""Models of the most used PyTorch port of GNS (github.com/geoelements/gns), read and written with equal outputs.

The port's model is a plain state_dict, ``model-<step>.pt``; sizes follow from its shapes, all else from the ``metadata.json`` of its data and
the options of its ``train.py``. Both sides are the published model (Sanchez-Gonzalez et al. 2020). What differs, and how it is carried over:

===========================  ===================================  ==========================================================
                             the port                             here
===========================  ===================================  ==========================================================
input of an edge's MLP       receiver, sender, edge               edge, receiver, sender: columns change places
edges after a block          e + m; until December 2024 2 e       e + m; ``edge_update: false`` keeps e: columns times 2^block
type embedding (9 x 16)      always there                         none for one type: its vector goes into the first bias
distances to the walls       clip(d / R, -L, L)                   clip(d / (L R), -1, 1): columns times L
material property            a column, as it is                   a context of one number: columns / std, mean into the bias
predictions start from       the mean acceleration                gravity dt^2 if ``ballistic``: into the decoder's bias
neighbours                   128 at most                          all
===========================  ===================================  ==========================================================

Outputs are equal to the rounding of float32, on graphs in which no particle has more than 128 neighbours. An angle of friction is the one
number that the data differ in: the port's hold its tangent, ours degrees (data are converted, ``sim.importing``, ``sim.export``). No linear layer
does that, so a model that sees it wants, on either side, what it was trained on.

Decision: a state_dict does not say whether it was trained before or after the port's commit 3b8fb5c ("fix message passing", 11 December
2024; its releases up to v1.1.1 are older), and the wrong guess moves particles wrongly without a word: so the reader must be told.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat
from torch import Tensor

from learn.checkpoint import build_model, load_weights, read_content, validate, write_content
from learn.dataset import DataSpec
from learn.features import SMALLEST_STD, TYPE_SLOTS, TYPE_WIDTH
from learn.gns import GNS
from sim.errors import InputError, RunError
from sim.trajectory import atomic_folder, vacant, write_json

#: ``--noise_std`` of the port's ``train.py`` when it is not given [length / frame].
NOISE_STD = 6.7e-4

_ROOT = "_encode_process_decode."
_EMBEDDING = "_particle_type_embedding.weight"
_FIRST = f"{_ROOT}_encoder.node_fn.0.NN-0."  # the first layer of the node encoder

#: What the port does not have, by the settings that leave it out.
_PUBLISHED = {
    "inputs": "velocity",
    "encoder": "relative",
    "relative_velocity": False,
    "self_edges": True,
    "walls": False,
    "flight_below": 0,
    "relaxation": None,
}

Positive = Annotated[FiniteFloat, Field(gt=0)]


class Metadata(BaseModel):
    """What is read of a ``metadata.json``. The last five are no keys of the port: ``export_model`` adds them."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    dim: Literal[2, 3]
    bounds: list[list[FiniteFloat]]
    default_connectivity_radius: Positive
    dt: Positive
    vel_mean: list[FiniteFloat]
    vel_std: list[FiniteFloat]
    acc_mean: list[FiniteFloat]
    acc_std: list[FiniteFloat]
    boundary_augment: Positive = 1.0
    noise_std: Annotated[FiniteFloat, Field(ge=0)] = NOISE_STD
    edges: Literal["updated", "doubled"] | None = None
    spacing: Positive | None = None
    gravity: list[FiniteFloat] | None = None
    particle_types: list[int] | None = None


def read_metadata(path: str | Path, **given: object) -> Metadata:
    """The metadata of a rollout, or of the data where the file does not tell them apart, with the keys ``given`` in place of its own.

    Every fault is an ``InputError``, a key that is in neither as well.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, "file", str(error), "must be the metadata.json of the model's data") from None
    if isinstance(content, dict) and isinstance(content.get("rollout"), dict):
        content = content["rollout"]
    if isinstance(content, dict):
        content = content | {key: value for key, value in given.items() if value is not None}
    metadata = validate(Metadata, content, path, "")
    for key, value in metadata:
        if value is None:
            raise InputError(path, key, None, f"the port's metadata do not say; give --{'types' if key == 'particle_types' else key}")
    return metadata


def import_model(
    path: str | Path,
    metadata: str | Path,
    *,
    edges: Literal["updated", "doubled"] | None = None,
    noise_std: float | None = None,
    spacing: float | None = None,
    gravity: Sequence[float] | None = None,
    particle_types: Sequence[int] | None = None,
) -> GNS:
    """The GNS of a ``model-<step>.pt`` of the port and the ``metadata.json`` of its data.

    edges: what the port's version did to them after a block, "updated" (since 11 December 2024) or "doubled" (before); noise_std: as given
    to its ``train.py`` [length / frame]; spacing of the particles [length]; gravity [length / s^2]; particle_types: ids it was trained on.
    Metadata written by ``export_model`` hold all of them. Runs no code from the file; every fault of what is given is an ``InputError``.
    """
    path = Path(path)
    known: Any = read_metadata(metadata, edges=edges, noise_std=noise_std, spacing=spacing, gravity=gravity, particle_types=particle_types)
    weights: Any = read_content(path, "cpu", "geoelements/gns model", "copy the file again")
    settings, context = _sizes(weights, known.dim, path)
    settings |= {"noise": known.noise_std, "noise_unit": "absolute", "edge_update": known.edges == "updated"}
    if known.boundary_augment != 1:
        settings["wall_distance"] = known.boundary_augment * known.default_connectivity_radius / known.spacing
    try:
        spec = DataSpec(
            dim=known.dim,
            bounds=known.bounds,
            radius=known.default_connectivity_radius,
            spacing=known.spacing,
            frame_step=known.dt,
            stride=1,
            gravity=known.gravity,
            particle_types=tuple(sorted(set(known.particle_types))),
            velocity_mean=known.vel_mean,
            velocity_std=known.vel_std,
            acceleration_mean=known.acc_mean,
            acceleration_std=known.acc_std,
            context_mean=(0.0,) if context else None,
            context_std=(1.0,) if context else None,
        )
    except ValueError as error:
        raise InputError(metadata, "metadata", str(error), "correct it, or the option that says so") from None
    model = build_model("gns", settings, spec, path)
    wanted = {name: list(value.shape) for name, value in port_weights(model).items()}
    found = {name: list(value.shape) for name, value in weights.items()}
    if found != wanted:
        name = min(name for name in found | wanted if found.get(name) != wanted.get(name))
        raise InputError(path, name, found.get(name), f"must be {wanted.get(name, 'absent')} beside the other weights")
    load_weights(model, _own_weights(model, weights), path)
    return model.eval()


def export_model(model: GNS, out: str | Path) -> dict:
    """Write ``model-0.pt`` and ``metadata.json`` into the new folder ``out``, as the port reads them, and return the metadata.

    These hold, beside what the port reads, what ``import_model`` needs and the sizes that ``train.py`` fixes (``latent_dim`` and so on, by the
    names of the port's ``LearnedSimulator``). Complete or absent. Raises ``InputError`` for a model that the port cannot be, ``RunError`` where
    nothing can be written.
    """
    out = vacant(out)
    if not isinstance(model, GNS):
        raise InputError("model", "name", model.name, "only a gns can go to geoelements/gns")
    spec, options = model.spec, model.options
    for key, value in _PUBLISHED.items():
        if getattr(options, key) != value:
            raise InputError("model", f"settings.{key}", getattr(options, key), f"geoelements/gns knows {value} only")
    if spec.stride != 1:
        raise InputError("model", "data.stride", spec.stride, "geoelements/gns knows 1 only")
    if spec.periodic:
        raise InputError("model", "periodic", list(spec.periodic), "geoelements/gns knows walls all around only")
    if len(spec.context_mean or ()) > 1:
        raise InputError("model", "context", len(spec.context_mean or ()), "geoelements/gns knows one number only, a material property")
    weights = port_weights(model)
    metadata = {
        "dim": spec.dim,
        "bounds": spec.bounds,
        "default_connectivity_radius": model.radius,
        "dt": spec.frame_step,
        "sequence_length": None,
        "vel_mean": spec.velocity_mean,
        "acc_mean": spec.acceleration_mean,
        # It divides by the standard deviation of an axis without motion.
        "vel_std": [max(s, SMALLEST_STD) for s in spec.velocity_std],
        "acc_std": [max(s, SMALLEST_STD) for s in spec.acceleration_std],
        "boundary_augment": model.features.wall_distance / model.radius,
        "nnode_in": weights[f"{_FIRST}weight"].shape[1],
        "nedge_in": spec.dim + 1,
        "latent_dim": options.latent,
        "mlp_hidden_dim": options.latent,
        "nmlp_layers": options.hidden_layers,
        "nmessage_passing_steps": options.message_passing,
        "input_sequence_length": model.velocities + 1,
        "noise_std": model.sigma,
        "edges": "updated" if options.edge_update else "doubled",
        "spacing": spec.spacing,
        "gravity": spec.gravity,
        "particle_types": spec.particle_types,
    }
    try:
        with atomic_folder(out) as folder:
            write_json(folder / "metadata.json", metadata)
            write_content(folder / "model-0.pt", weights)
    except OSError as error:
        raise RunError(f"{out}: cannot be written: {error.strerror or error}") from None
    return metadata


def port_weights(model: GNS) -> dict[str, Tensor]:
    """The model as a state_dict of the port, float32, in the port's order: name -> [outputs, inputs] or [outputs]."""
    own = {name: value.detach().cpu().double() for name, value in model.state_dict().items()}
    features, port = model.features, {}
    port[_EMBEDDING] = own["features.embedding.weight"] if features.embedding else torch.zeros(TYPE_SLOTS, TYPE_WIDTH, dtype=torch.float64)
    port |= {name: own[ours] for ours, name in _names(model)}
    for name, before in _edge_layers(model):
        edge, ends = port[name].split((model.options.latent, 2 * model.options.latent), 1)
        port[name] = torch.cat([ends, edge / before], 1)
    motion, walls, types, context = port[f"{_FIRST}weight"].split(_columns(model), 1)
    if features.embedding is None:
        types = types.new_zeros(len(types), TYPE_WIDTH)
    if features.context:
        mean, std = features.context_mean.cpu().double(), features.context_std.cpu().double()
        port[f"{_FIRST}bias"] = port[f"{_FIRST}bias"] - context @ (mean / std)
        context = context / std
    port[f"{_FIRST}weight"] = torch.cat([motion, walls * (model.radius / features.wall_distance), types, context], 1)
    base = (features.acceleration_base - features.acceleration_mean).cpu().double() / features.acceleration_std.cpu().double()
    last = f"{_ROOT}_decoder.node_fn.NN-{model.options.hidden_layers}.bias"
    port[last] = port[last] + base
    return {name: value.float() for name, value in port.items()}


def _own_weights(model: GNS, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Inverse of ``port_weights`` for a model as ``import_model`` builds it (not ballistic, its context as it is)."""
    port, features = {name: value.double() for name, value in weights.items()}, model.features
    for name, before in _edge_layers(model):
        ends, edge = port[name].split((2 * model.options.latent, model.options.latent), 1)
        port[name] = torch.cat([edge * before, ends], 1)
    motion, walls, _, context = _columns(model)
    motion, walls, types, context = port[f"{_FIRST}weight"].split((motion, walls, TYPE_WIDTH, context), 1)
    if features.embedding is None:
        (only,) = model.spec.particle_types
        port[f"{_FIRST}bias"] = port[f"{_FIRST}bias"] + types @ port[_EMBEDDING][only]
        types = types[:, :0]
    port[f"{_FIRST}weight"] = torch.cat([motion, walls * (features.wall_distance / model.radius), types, context], 1)
    own = {ours: port[name] for ours, name in _names(model)}
    if features.embedding:
        own["features.embedding.weight"] = port[_EMBEDDING]
    return {name: value.float() for name, value in own.items()}


def _names(model: GNS) -> list[tuple[str, str]]:
    """(our name, the port's) of every weight but the embedding; a shared block has as many of the port's as it is used."""
    pairs = [("encode_node.", "_encoder.node_fn."), ("encode_edge.", "_encoder.edge_fn.")]
    for number in range(model.options.message_passing):
        for part in ("node", "edge"):
            pairs.append((f"processor.{number % len(model.network.processor)}.{part}.", f"_processor.gnn_stacks.{number}.{part}_fn."))
    names = []
    for kind in ("weight", "bias"):
        for layer in range(model.options.hidden_layers + 1):
            names += [(f"{ours}linears.{layer}.{kind}", f"{name}0.NN-{layer}.{kind}") for ours, name in pairs]
            names.append((f"decode.linears.{layer}.{kind}", f"_decoder.node_fn.NN-{layer}.{kind}"))
        names += [(f"{ours}norm.{kind}", f"{name}1.{kind}") for ours, name in pairs]
    return [(f"network.{ours}", f"{_ROOT}{name}") for ours, name in names]


def _edge_layers(model: GNS) -> list[tuple[str, float]]:
    """(the port's name, by how much its edges are larger than ours) of the first layer of every block's edge MLP."""
    blocks = range(model.options.message_passing)
    return [(f"{_ROOT}_processor.gnn_stacks.{k}.edge_fn.0.NN-0.weight", 1.0 if model.options.edge_update else 2.0**k) for k in blocks]


def _columns(model: GNS) -> tuple[int, int, int, int]:
    """Node features: velocities, distances to the walls, type embedding, context."""
    features, dim = model.features, model.spec.dim
    return model.velocities * dim, 2 * dim, TYPE_WIDTH if features.embedding else 0, len(features.context_mean) if features.context else 0


def _sizes(weights: object, dim: int, where: Path) -> tuple[dict, bool]:
    """Settings that the shapes of a state_dict of the port tell, and whether there is a material property."""
    if not isinstance(weights, dict) or f"{_FIRST}weight" not in weights:
        found = sorted(map(str, weights))[:5] if isinstance(weights, dict) else type(weights).__name__
        raise InputError(where, "state_dict", found, "not a model of geoelements/gns (its model-<step>.pt, not train_state-<step>.pt)")
    for name, value in weights.items():
        # Contiguous, since a small file can hold a tensor of any shape otherwise.
        dense = isinstance(value, Tensor) and value.layout == torch.strided and value.is_contiguous() and value.device.type == "cpu"
        if not dense or value.dtype != torch.float32:
            shown = f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            raise InputError(where, str(name), shown, "must be a dense float32 tensor")
    first = list(weights[f"{_FIRST}weight"].shape)
    history, rest = divmod(first[-1] - TYPE_WIDTH - 2 * dim, dim)
    if len(first) != 2 or history < 1 or rest > 1:
        remedy = f"must have {TYPE_WIDTH} + {2 * dim} columns, {dim} for each velocity, and one for a material property if there is one"
        raise InputError(where, f"{_FIRST}weight", first, remedy)
    layers = sum(f"{_ROOT}_decoder.node_fn.NN-{k}.weight" in weights for k in range(len(weights)))
    blocks = sum(f"{_ROOT}_processor.gnn_stacks.{k}.node_fn.1.weight" in weights for k in range(len(weights)))
    return {"latent": first[0], "hidden_layers": max(layers - 1, 1), "message_passing": max(blocks, 1), "history": history}, rest == 1
