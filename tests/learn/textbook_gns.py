"""The textbook form of ``learn.gns.Network``: concatenate, MLP, ``index_add``, autograd. Same parameters, same names; the oracle of its tests."""

import torch
from torch import nn

from learn.gns import MLP


def mlp(module: MLP, x: torch.Tensor) -> torch.Tensor:
    for k, linear in enumerate(module.linears):
        x = linear(x.relu() if k else x)
    return x if module.norm is None else module.norm(x)


class TextbookNetwork(nn.Module):
    """A view of a ``Network``'s parameters; forward(nodes, edges, graph) as there, in any dtype."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, nodes, edges, graph):
        receiver, sender = graph.receiver.long(), graph.sender.long()
        encode_edge, nodes = self.network.encode_edge, mlp(self.network.encode_node, nodes)
        edges = encode_edge.repeat(graph.edges, 1) if isinstance(encode_edge, nn.Parameter) else mlp(encode_edge, edges)
        for _ in range(self.network.repeats):
            for block in self.network.processor:
                message = mlp(block.edge, torch.cat([edges, nodes[receiver], nodes[sender]], 1))
                total = torch.zeros_like(nodes).index_add(0, receiver, message)
                nodes = nodes + mlp(block.node, torch.cat([total, nodes], 1))
                edges = edges + message if block.edge_update else edges
        return mlp(self.network.decode, nodes)
