"""The forward pass of the PyTorch port github.com/geoelements/gns, stated again from its ``learned_simulator.py`` and ``graph_network.py``.

Without torch_geometric: all pairs by brute force. Weights by the names of its state_dict. The oracle of the exchange.
The port itself (commit 3b8fb5c and the one before, with torch_geometric 2.6.1 and torch_cluster 1.6.3) was run once beside it and beside
imported and exported models, width 128, 10 blocks, 2D and 3D, 150 particles, up to 28 neighbours: the largest difference of a component
was 5e-6 of the largest of its axis, 7e-7 of an acceleration's standard deviation.
"""

import torch
from torch.nn import functional as F

ROOT = "_encode_process_decode."


def state_dict(dim: int, latent: int, blocks: int, layers: int = 2, velocities: int = 5, material: bool = False, seed: int = 0) -> dict:
    """Random weights under the port's names; biases and LayerNorms away from 0 and 1, so that none can be forgotten."""
    generator, weights = torch.Generator().manual_seed(seed), {}

    def linear(name: str, inputs: int, outputs: int) -> None:
        weights[f"{name}.weight"] = torch.randn((outputs, inputs), generator=generator) / inputs**0.5
        weights[f"{name}.bias"] = 0.3 * torch.randn(outputs, generator=generator)

    def mlp(name: str, inputs: int, outputs: int, norm: str | None) -> None:
        widths = [inputs, *[latent] * layers, outputs]
        for k in range(layers + 1):
            linear(f"{name}NN-{k}", widths[k], widths[k + 1])
        if norm:
            weights[f"{norm}.weight"] = 1 + 0.3 * torch.randn(outputs, generator=generator)
            weights[f"{norm}.bias"] = 0.3 * torch.randn(outputs, generator=generator)

    weights["_particle_type_embedding.weight"] = torch.randn((9, 16), generator=generator)
    sizes = {"_encoder.node_fn": (velocities + 2) * dim + 16 + material, "_encoder.edge_fn": dim + 1}
    for k in range(blocks):
        sizes |= {f"_processor.gnn_stacks.{k}.node_fn": 2 * latent, f"_processor.gnn_stacks.{k}.edge_fn": 3 * latent}
    for name, inputs in sizes.items():
        mlp(f"{ROOT}{name}.0.", inputs, latent, f"{ROOT}{name}.1")
    mlp(f"{ROOT}_decoder.node_fn.", latent, dim, None)
    return weights


class Port:
    """``LearnedSimulator`` of the port as ``train.py`` makes it. edges: "updated" (since December 2024) or "doubled" (before)."""

    def __init__(self, weights: dict, metadata: dict, edges: str, noise_std: float = 6.7e-4):
        self.weights, self.metadata, self.edges, self.noise_std = weights, metadata, edges, noise_std

    def mlp(self, name: str, x: torch.Tensor, norm: bool = True) -> torch.Tensor:
        layers, k = f"{ROOT}{name}.0." if norm else f"{ROOT}{name}.", 0
        while f"{layers}NN-{k}.weight" in self.weights:
            x = F.linear(x.relu() if k else x, self.weights[f"{layers}NN-{k}.weight"], self.weights[f"{layers}NN-{k}.bias"])
            k += 1
        return F.layer_norm(x, x.shape[-1:], self.weights[f"{ROOT}{name}.1.weight"], self.weights[f"{ROOT}{name}.1.bias"]) if norm else x

    def statistics(self, kind: str) -> tuple[torch.Tensor, torch.Tensor]:
        mean, std = (torch.tensor(self.metadata[f"{kind}_{moment}"], dtype=torch.float32) for moment in ("mean", "std"))
        return mean, torch.sqrt(std**2 + self.noise_std**2)

    def accelerations(self, position: torch.Tensor, types: torch.Tensor, example: torch.Tensor, material: torch.Tensor | None = None) -> torch.Tensor:
        """[particles, dim], length / frame^2. position [particles, frames, dim], types and example [particles]; material [particles]."""
        count, radius = len(position), self.metadata["default_connectivity_radius"]
        last = position[:, -1]
        near = (torch.cdist(last.double(), last.double()) < radius) & (example[:, None] == example[None])
        receiver, sender = near.nonzero().T
        mean, std = self.statistics("vel")
        bounds, limit = torch.tensor(self.metadata["bounds"], dtype=torch.float32), self.metadata.get("boundary_augment", 1.0)
        walls = torch.cat([last - bounds[:, 0], bounds[:, 1] - last], 1)
        nodes = [((position[:, 1:] - position[:, :-1] - mean) / std).reshape(count, -1), torch.clamp(walls / radius, -limit, limit)]
        nodes.append(self.weights["_particle_type_embedding.weight"][types])
        if material is not None:
            nodes.append(material[:, None])
        offset = (last[sender] - last[receiver]) / radius
        e = self.mlp("_encoder.edge_fn", torch.cat([offset, offset.norm(dim=1, keepdim=True)], 1))
        x = self.mlp("_encoder.node_fn", torch.cat(nodes, 1))
        block = 0
        while f"{ROOT}_processor.gnn_stacks.{block}.node_fn.1.weight" in self.weights:
            message = self.mlp(f"_processor.gnn_stacks.{block}.edge_fn", torch.cat([x[receiver], x[sender], e], 1))
            total = torch.zeros_like(x).index_add(0, receiver, message)
            x = x + self.mlp(f"_processor.gnn_stacks.{block}.node_fn", torch.cat([total, x], 1))
            e = e + (message if self.edges == "updated" else e)
            block += 1
        mean, std = self.statistics("acc")
        return self.mlp("_decoder.node_fn", x, norm=False) * std + mean
